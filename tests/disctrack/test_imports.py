"""Imports point one way: between the folders, in a diagnosis, and the physics needs numpy and scipy alone."""

import ast
import subprocess
import sys
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
    "track.least_squares",
    "track.pose",
)
FORBIDDEN = ("cv2", "h5py", "matplotlib", "skimage", "tqdm")


def run(code: str) -> subprocess.CompletedProcess:
    return subprocess.run([sys.executable, "-c", code], cwd=ROOT, capture_output=True, text=True, timeout=120)


@pytest.mark.parametrize("module", PHYSICS)
def test_physics_imports_no_image_file_or_plot_library(module):
    block = "import sys\n" + "".join(f"sys.modules[{name!r}] = None\n" for name in FORBIDDEN)
    done = run(f"{block}import disctrack.{module}")
    assert done.returncode == 0, done.stderr


def test_the_block_is_felt_where_such_a_library_is_needed():
    done = run("import sys\nsys.modules['h5py'] = None\nimport disctrack.files.trajectory_file")
    assert "ModuleNotFoundError" in done.stderr


def test_calibration_never_imports_disctrack():
    for file in (ROOT / "calibration").rglob("*.py"):
        for node in ast.walk(ast.parse(file.read_text(encoding="utf-8"))):
            names = [alias.name for alias in node.names] if isinstance(node, ast.Import) else []
            names += [node.module or ""] if isinstance(node, ast.ImportFrom) else []
            assert not any(name.split(".")[0] == "disctrack" for name in names), file


def test_importing_the_package_loads_nothing_heavy():
    heavy = {"cv2", "scipy", "matplotlib", "h5py", "numba"}
    done = run(f"import disctrack, sys; print(sorted({heavy!r} & set(sys.modules)))")
    assert done.stdout.strip() == "[]", done.stdout + done.stderr


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
    ("__version__", "frames", "disc", "published", "progress"),  # words shared by all
    ("errors", "trajectory"),
    ("files", "regular_precession"),
    ("rolling",),
    ("readers", "recording", "pages", "scene"),
    ("track", "render"),  # the measurement; the same physics forwards
    ("analyse",),
    ("calibrate", "repeats", "diagnosis"),
    ("first_look", "examples", "validate", "batch", "docs"),
    ("commands",),
    ("cli",),
    ("__main__",),
)
# An object that people hold may offer a verb that lives further down; it is looked up when it is called.
ON_CALL = {("trajectory", "files"): "Trajectory.to_xarray"}
ROOMS_OF_DIAGNOSIS = {"engine": (), "disc": ("engine",), "pages": ("engine", "disc"), "trials": ("engine", "disc"),
                      "equations": ("engine", "pages")}  # fmt: skip


def imported(file: Path) -> set[str]:
    """Modules of ours that a file asks for, but for types."""
    tree = ast.parse(file.read_text(encoding="utf-8"))
    for_types = {
        below
        for node in ast.walk(tree)
        if isinstance(node, ast.If) and "TYPE_CHECKING" in ast.dump(node.test)
        for below in ast.walk(node)
    }
    found = set()
    for node in ast.walk(tree):
        if node in for_types:
            continue
        if isinstance(node, ast.Import):
            found |= {alias.name for alias in node.names}
        elif isinstance(node, ast.ImportFrom) and node.module:
            found |= {f"{node.module}.{alias.name}" for alias in node.names}
    return {name for name in found if name.startswith("disctrack.")}


def dependencies() -> dict[tuple[str, str], set[str]]:
    """(folder, folder that it asks for) -> files that do."""
    found: dict[tuple[str, str], set[str]] = {}
    for file in (ROOT / "disctrack").rglob("*.py"):
        own = file.relative_to(ROOT / "disctrack").parts[0].removesuffix(".py")
        for name in imported(file):
            other = name.split(".")[1]
            if other != own and own != "__init__":
                found.setdefault((own, other), set()).add(file.name)
    return found


def test_folders_ask_only_for_what_stands_above_them():
    step = {name: i for i, names in enumerate(STAIRS) for name in names}
    upwards = {}
    for (own, other), files in dependencies().items():
        assert own in step, f"{own}: give it a place in STAIRS"
        if other in step and step[other] >= step[own] and (own, other) not in ON_CALL:
            upwards[own, other] = sorted(files)
    assert upwards == {}


def test_every_name_of_the_stairs_is_there_and_the_exceptions_are_needed():
    there = {file.name.removesuffix(".py") for file in (ROOT / "disctrack").iterdir()}
    assert {name for names in STAIRS for name in names} - there == {"__version__"}  # of the package itself
    assert set(ON_CALL) <= set(dependencies())
    assert ("batch", "diagnosis") in dependencies()  # the reading sees what is asked for inside a function


@pytest.mark.parametrize("room", ROOMS_OF_DIAGNOSIS)
def test_the_engine_of_a_diagnosis_knows_no_disc_and_no_page(room):
    for file in (ROOT / "disctrack" / "diagnosis" / room).rglob("*.py"):
        rooms = {name.split(".")[2] for name in imported(file) if name.startswith("disctrack.diagnosis.")}
        assert rooms & set(ROOMS_OF_DIAGNOSIS) <= {room, *ROOMS_OF_DIAGNOSIS[room]}, file
