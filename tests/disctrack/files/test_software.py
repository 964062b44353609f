"""Results and compiled loops belong to the sources that made them."""

import re
import shutil
import subprocess
import sys
from pathlib import Path

import pytest

import calibration
import disctrack
from calibration.kit import compiled

ROOT = Path(disctrack.__file__).parents[1]


def run(code: str, home: Path) -> str:
    done = subprocess.run([sys.executable, "-c", code], cwd=home, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr
    return done.stdout.strip()


@pytest.mark.statistical
def test_a_result_counts_only_for_the_sources_that_made_it(tmp_path):
    for package in (calibration, disctrack):
        home = Path(package.__file__).parent
        shutil.copytree(home, tmp_path / home.name, ignore=shutil.ignore_patterns("__pycache__", "*.md", "pictures"))
    code = (
        "from disctrack.trajectory.file import Provenance\n"
        "made = Provenance('r', {}, {})\nprint(made.version, made.fingerprint)"
    )
    version, first = run(code, tmp_path).split()
    assert version.startswith(f"{disctrack.__version__}+")
    for beside in ("examples/_command.py", "first_look/check.py"):
        with (tmp_path / "disctrack" / beside).open("a") as source:
            source.write("# a remark\n")
    assert run(code, tmp_path).split()[1] == first
    for within in ("disctrack/track/dots/_kernels.py", "calibration/cameras/camera.py"):
        with (tmp_path / within).open("a") as source:
            source.write("A_NUMBER = 1\n")
        _, changed = run(code, tmp_path).split()
        assert changed != first
        first = changed


@pytest.mark.statistical
def test_a_compiled_loop_is_compiled_anew_when_what_it_calls_in_another_file_has_changed(tmp_path):
    inner = "from calibration.kit.compiled import njit\n\n@njit\ndef f(x):\n    return x + {}\n"
    outer = (
        "from calibration.kit.compiled import njit\nfrom disctrack._inner import f\n\n"
        "@njit(cache=True)\ndef g(x):\n    return f(x)\n"
    )
    for package in ("calibration", "calibration/kit", "disctrack"):
        (tmp_path / package).mkdir()
        (tmp_path / package / "__init__.py").touch()
    shutil.copy(Path(compiled.__file__), tmp_path / "calibration" / "kit" / "compiled.py")
    (tmp_path / "disctrack" / "_outer.py").write_text(outer)
    code = "from disctrack._outer import g; print(g(1), sum(g.stats.cache_hits.values()))"
    for added, hits in ((1, 0), (1, 1), (2, 0)):
        (tmp_path / "disctrack" / "_inner.py").write_text(inner.format(added))
        assert run(code, tmp_path) == f"{1 + added} {hits}"


def test_every_file_with_a_compiled_loop_that_is_kept_counts_for_what_is_kept():
    counted = {file for pattern in compiled.WITH_COMPILED for file in ROOT.glob(pattern)}
    assert ROOT / "disctrack/rolling/effects/base.py" in counted  # helpers that laws call
    for file in (*ROOT.glob("calibration/**/*.py"), *ROOT.glob("disctrack/**/*.py")):
        if file.name != "compiled.py" and re.search(r"\bcache=True", source := file.read_text()):
            assert file in counted, file
            assert not re.search(r"import numba|from numba import .*\b(n?jit|cfunc)\b", source), file
