"""Imports point one way: the physics needs numpy and scipy alone, calibration never asks for disctrack."""

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
