"""Imports point one way: between the folders, in a diagnosis, and the physics needs numpy and scipy alone."""

import ast
import subprocess
import sys
from collections import Counter
from functools import cache
from graphlib import TopologicalSorter
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parents[2]
ANALYSIS = ("derivatives", "quantities", "contact", "analysis")
PHYSICS = ("frames", "disc", "trajectory", "rolling", *(f"analyse.{name}" for name in ANALYSIS), "track.pose")
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


def rows_of_the_page() -> list[list[str]]:
    """Rooms of disctrack as the page for contributors has them, one row a line."""
    page = (ROOT / "disctrack" / "docs" / "contributing.md").read_text(encoding="utf-8")
    block = page.partition("Who imports whom")[2].partition("\n\n")[2].partition("\n\n")[0]
    return [line.split() for line in block.splitlines()]


# Each folder or module of a package may ask for what stands above it, at whatever place in the file it does so. A new
# one belongs where what it needs is above, and what needs it below; names in one row know nothing of each other.
CALIBRATION = ("kit", "board cameras", "fit", "judge", "stereo", "rig_file")
STAIRS = {"calibration": [row.split() for row in CALIBRATION], "disctrack": (*rows_of_the_page(), ("__main__",))}
SOURCES = {
    ".".join(file.relative_to(ROOT).with_suffix("").parts).removesuffix(".__init__"): file
    for package in PACKAGES
    for file in sorted((ROOT / package).rglob("*.py"))
}


@cache
def statements(file: str) -> list[ast.AST]:
    """All imports, conditions and classes of a file."""
    tree = ast.parse(SOURCES[file].read_text(encoding="utf-8"))
    return [node for node in ast.walk(tree) if isinstance(node, (ast.Import, ast.ImportFrom, ast.If, ast.ClassDef))]


@cache
def asked_for(file: str) -> set[str]:
    """Files of ours that a file asks for, at whatever place in it, but for types."""
    conditions = [node for node in statements(file) if isinstance(node, ast.If)]
    for_types = {below for node in conditions if "TYPE_CHECKING" in ast.dump(node.test) for below in ast.walk(node)}
    found = set()
    for node in statements(file):
        if isinstance(node, ast.Import):
            found |= {alias.name for alias in node.names if node not in for_types}
        elif isinstance(node, ast.ImportFrom) and node.module:
            found |= {f"{node.module}.{alias.name}" for alias in node.names if node not in for_types}
    return {file_of(name) for name in found if name.split(".")[0] in PACKAGES} - {file}


def file_of(name: str) -> str:
    return name if name in SOURCES else file_of(name.rpartition(".")[0])  # a class or a function lies in its file


@pytest.fixture(scope="module", autouse=True)
def sources_are_read_once() -> None:
    for file in SOURCES:
        asked_for(file)


def between_rooms(package: str) -> dict[tuple[str, str], list[str]]:
    """(room, room that it asks for) -> files that do; a room is a folder or a module of the package."""
    found: dict[tuple[str, str], list[str]] = {}
    for file in SOURCES:
        for other in asked_for(file):
            (one, *own), (two, *theirs) = file.split("."), other.split(".")
            if one == two == package and own and theirs and own[0] != theirs[0]:
                found.setdefault((own[0], theirs[0]), []).append(file)
    return found


@pytest.mark.parametrize("package", PACKAGES)
def test_rooms_ask_only_for_what_stands_above_them(package):
    step = {name: i for i, names in enumerate(STAIRS[package]) for name in names}
    rooms = {file.split(".")[1] for file in SOURCES if file.startswith(f"{package}.")}
    assert step.keys() == rooms, "every room has a place"
    assert {pair: files for pair, files in between_rooms(package).items() if step[pair[1]] >= step[pair[0]]} == {}


def test_what_is_asked_for_inside_a_function_is_seen():
    assert ("batch", "diagnosis") in between_rooms("disctrack")


def test_calibration_never_imports_disctrack():
    assert not [file for file in SOURCES if file.startswith("calibration") and "disctrack" in str(asked_for(file))]


def test_no_file_asks_for_one_that_asks_for_it():
    asked = {file: asked_for(file) for file in SOURCES}
    # the object that people hold offers it as a verb; it is looked up when it is called
    asked["disctrack.trajectory"] = asked["disctrack.trajectory"] - {"disctrack.trajectory.file"}
    assert asked["disctrack.trajectory"] != asked_for("disctrack.trajectory")
    TopologicalSorter(asked).prepare()  # raises an error that names a circle


def test_a_public_class_has_a_name_of_its_own():
    """Plan, Motion or Found say nothing where two things bear the name; each example speaks its own language."""
    files = [file for file in SOURCES if not file.startswith("disctrack.examples")]
    classes = Counter(node.name for file in files for node in statements(file) if isinstance(node, ast.ClassDef))
    assert [name for name, n in classes.items() if n > 1 and name[0] != "_"] == []


def test_discrepancy_knows_no_disc():
    asked = {other for file in SOURCES if file.startswith("disctrack.discrepancy") for other in asked_for(file)}
    assert "disctrack.discrepancy.system" in asked
    rooms = {other.split(".")[1] for other in asked if other.startswith("disctrack.")}
    assert not rooms & {"diagnosis", "disc", "rolling", "trajectory", "track", "analyse"}
