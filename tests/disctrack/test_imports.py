"""Imports point one way: between the folders, in a diagnosis, and the physics needs numpy and scipy alone."""

import ast
import subprocess
import sys
from functools import cache
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parents[2]
PHYSICS = (
    "frames",
    "disc",
    "trajectory",
    "rolling",
    "analyse.derivatives",
    "analyse.contact",
    "analyse.energy",
    "analyse.analysis",
    "track.pose",
)
PACKAGES = ("calibration", "disctrack")
FORBIDDEN = ("cv2", "h5py", "matplotlib", "skimage", "tqdm")


def run(code: str) -> subprocess.CompletedProcess:
    return subprocess.run([sys.executable, "-c", code], cwd=ROOT, capture_output=True, text=True, timeout=120)


@pytest.mark.statistical
def test_physics_imports_no_image_file_or_plot_library():
    block = "import sys\n" + "".join(f"sys.modules[{name!r}] = None\n" for name in FORBIDDEN)
    done = run(block + "".join(f"import disctrack.{module}\n" for module in PHYSICS))
    assert done.returncode == 0, done.stderr


def test_the_block_is_felt_where_such_a_library_is_needed():
    done = run("import sys\nsys.modules['h5py'] = None\nimport disctrack.trajectory.file")
    assert "ModuleNotFoundError" in done.stderr


def test_importing_the_package_loads_nothing_heavy():
    heavy = {"numpy", "cv2", "scipy", "matplotlib", "h5py", "numba"}
    for module in ("disctrack", "disctrack.cli"):  # which tells NumPy how many threads it may have
        done = run(f"import {module}, sys; print(sorted({heavy!r} & set(sys.modules)))")
        assert done.stdout.strip() == "[]", done.stdout + done.stderr


@pytest.mark.statistical
def test_a_measurement_waits_for_no_part_of_scipy():
    """Each takes from a tenth to half a second: more than following the disc through the sample recording."""
    rooms = ("calibrate.stage", "track.measurement", "track.video_overlay", "analyse.declaration")
    stages = ", ".join(f"disctrack.{room}" for room in rooms)
    parts = [f"scipy.{part}" for part in ("linalg", "optimize", "special", "stats")]
    for asked, expected in ((stages, "[]"), (f"{stages}, scipy.optimize", "['scipy.linalg', ")):
        done = run(f"import {asked}, sys; print([part for part in {parts} if part in sys.modules])")
        assert done.stdout.startswith(expected), done.stdout + done.stderr


def test_every_public_name_is_there():
    import disctrack

    there = {name: getattr(disctrack, name) for name in disctrack.__all__}
    assert all(item is not None for item in there.values())
    assert set(there) <= set(dir(disctrack))
    with pytest.raises(AttributeError, match="no attribute 'nothing'"):
        disctrack.nothing  # noqa: B018


# Each folder or module of disctrack/ may ask for what stands above it, at whatever place in the file it does so. A new
# one belongs where what it needs is above, and what needs it below; names in one row know nothing of each other.
STAIRS = (
    ("frames", "errors", "numbers", "progress", "processes"),  # words shared by all
    ("findings",),
    ("disc", "files"),
    ("report",),
    ("trajectory", "rolling", "recording"),
    ("faults",),
    ("analyse",),
    ("track",),
    ("synthetic", "discrepancy"),
    ("diagnosis", "calibrate"),
    ("first_look", "examples", "validate", "batch"),
    ("commands",),
    ("cli",),
    ("__main__",),
)
ROOMS_OF_CALIBRATION = ("kit", "board", "cameras", "fit", "judge")  # each asks for those before it


@cache
def statements(file: Path) -> list[ast.AST]:
    """All imports, conditions and classes of a file."""
    tree = ast.parse(file.read_text(encoding="utf-8"))
    return [node for node in ast.walk(tree) if isinstance(node, (ast.Import, ast.ImportFrom, ast.If, ast.ClassDef))]


@pytest.fixture(scope="module", autouse=True)
def sources_are_read_once() -> None:
    for file in (file for package in PACKAGES for file in (ROOT / package).rglob("*.py")):
        statements(file)


@cache
def imported(file: Path) -> set[str]:
    """Modules of ours that a file asks for, but for types."""
    for_types = {
        below
        for node in statements(file)
        if isinstance(node, ast.If) and "TYPE_CHECKING" in ast.dump(node.test)
        for below in ast.walk(node)
    }
    found = set()
    for node in statements(file):
        if node in for_types:
            continue
        if isinstance(node, ast.Import):
            found |= {alias.name for alias in node.names}
        elif isinstance(node, ast.ImportFrom) and node.module:
            found |= {f"{node.module}.{alias.name}" for alias in node.names}
    return {name for name in found if name.split(".")[0] in PACKAGES}


def files_asked_for() -> dict[str, set[str]]:
    """File, as a module -> files that it asks for, at whatever place in it."""
    files = {
        ".".join(file.relative_to(ROOT).with_suffix("").parts).removesuffix(".__init__"): file
        for package in PACKAGES
        for file in (ROOT / package).rglob("*.py")
    }

    def file_of(name: str) -> str:
        return name if name in files else file_of(name.rpartition(".")[0])  # a class or a function lies in its file

    return {name: {file_of(other) for other in imported(file)} - {name} for name, file in files.items()}


def dependencies() -> dict[tuple[str, str], set[str]]:
    """(folder, folder that it asks for) -> files that do."""
    found: dict[tuple[str, str], set[str]] = {}
    for file in (ROOT / "disctrack").rglob("*.py"):
        own = file.relative_to(ROOT / "disctrack").parts[0].removesuffix(".py")
        for name in imported(file):
            package, other = f"{name}.__init__".split(".")[:2]
            if package == "disctrack" and "__init__" not in (own, other) and other != own:
                found.setdefault((own, other), set()).add(file.name)
    return found


def test_folders_ask_only_for_what_stands_above_them():
    step = {name: i for i, names in enumerate(STAIRS) for name in names}
    upwards = {}
    for (own, other), files in dependencies().items():
        assert own in step, f"{own}: give it a place in STAIRS"
        if other in step and step[other] >= step[own]:
            upwards[own, other] = sorted(files)
    assert upwards == {}


def test_every_room_has_a_place_on_the_stairs():
    """With `calibration` and the package's face these are 29 units on 10 levels."""
    rooms = {file.parent.name for file in (ROOT / "disctrack").glob("*/*.py")}
    modules = {file.stem for file in (ROOT / "disctrack").glob("*.py")} - {"__init__"}
    assert {name for names in STAIRS for name in names} == rooms | modules
    assert ("batch", "diagnosis") in dependencies()  # the reading sees what is asked for inside a function


def test_calibration_never_imports_disctrack():
    for file in (ROOT / "calibration").rglob("*.py"):
        assert not any(name.split(".")[0] == "disctrack" for name in imported(file)), file


def test_rooms_of_the_calibration_ask_only_for_those_before_them():
    for own, room in enumerate(ROOMS_OF_CALIBRATION):
        for file in (ROOT / "calibration" / room).rglob("*.py"):
            asked = {f"{name}.__init__".split(".")[1] for name in imported(file) if name.startswith("calibration")}
            assert asked <= {*ROOMS_OF_CALIBRATION[: own + 1]}, file


def test_no_file_asks_for_one_that_asks_for_it():
    asked = files_asked_for()
    assert ("disctrack.trajectory", "disctrack.trajectory.exchange.xarray") in {(a, b) for a in asked for b in asked[a]}
    # the object that people hold offers it as a verb; it is looked up when it is called
    asked["disctrack.trajectory"].remove("disctrack.trajectory.exchange.xarray")
    while len(asked) > 0:
        free = {name for name, others in asked.items() if not others & asked.keys()}
        assert free, {name: sorted(others & asked.keys()) for name, others in asked.items()}
        asked = {name: others for name, others in asked.items() if name not in free}


def test_a_public_class_has_a_name_of_its_own():
    """Plan, Motion or Found say nothing where two things bear the name; each example speaks its own language."""
    places: dict[str, list[str]] = {}
    for file in (file for package in PACKAGES for file in (ROOT / package).rglob("*.py")):
        if "examples" not in file.parts:
            for node in (node for node in statements(file) if isinstance(node, ast.ClassDef)):
                places.setdefault(node.name, []).append(file.name)
    assert {name: files for name, files in places.items() if len(files) > 1 and name[0] != "_"} == {}


def test_discrepancy_knows_no_disc():
    asked = {name for file in (ROOT / "disctrack" / "discrepancy").rglob("*.py") for name in imported(file)}
    rooms = {name.split(".")[1] for name in asked if name.startswith("disctrack.")}
    assert "system" in {name.split(".")[2] for name in asked if name.startswith("disctrack.discrepancy.")}
    assert not rooms & {"diagnosis", "disc", "rolling", "trajectory", "track", "analyse"}
