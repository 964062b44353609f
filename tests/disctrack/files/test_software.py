"""Results and compiled loops belong to the sources that made them; where loops are kept, and what is said meanwhile."""

import importlib
import os
import re
import shutil
import subprocess
import sys
import time
from pathlib import Path

import numpy as np
import pytest

import calibration
import disctrack
from calibration.kit import compiled
from calibration.kit.compiled import njit
from disctrack import cli, read_trajectory
from disctrack.progress import compiling

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


def test_a_read_only_home_and_installation_get_a_cache_of_their_own(monkeypatch, tmp_path):
    monkeypatch.setattr(compiled.config, "CACHE_DIR", "")
    assert compiled._folder().parent == Path(compiled.__file__).parent / "__pycache__"  # which can be written to
    monkeypatch.setattr("tempfile.tempdir", str(tmp_path))
    monkeypatch.setattr(os, "access", lambda path, mode: Path(path).is_relative_to(tmp_path))
    folder = compiled._folder().parent
    assert folder.parent == tmp_path
    assert folder.stat().st_mode & 0o777 == 0o700


@pytest.mark.statistical
def test_compiling_is_announced_and_slow_loading_is_not(capsys, monkeypatch, tmp_path):
    file, told = tmp_path / "loops.py", []
    monkeypatch.syspath_prepend(tmp_path)
    for source in ("def twice(x):\n    return 2 * x\n", "def twice(x):\n    return x + x  # otherwise\n"):
        file.write_text(source)
        for _ in range(2):
            monkeypatch.delitem(sys.modules, "loops", raising=False)
            loops = importlib.import_module("loops")  # numba imports it, too, when it loads
            with compiling("corners", 8):
                assert njit(loops.twice, cache=True)(2) == 4
                time.sleep(1.2)  # a busy machine is no compiler
            told.append(capsys.readouterr().err)
    announced = "compiling the inner loops of corners: once per installation, about 8 s"
    assert [announced in text for text in told] == [True, False, True, False]
    assert told[1] == ""


AT_ONCE = """
from calibration.kit.compiled import njit, one_at_a_time

@njit(cache=True)
def twice(x):
    return 2 * x

told = []
with one_at_a_time(lambda: told.append(1)):
    twice(2)
print(bool(told))
"""


@pytest.mark.statistical
def test_of_processes_that_begin_at_once_one_compiles_and_the_others_load(tmp_path):
    file, home = tmp_path / "loop.py", os.path.dirname(os.path.dirname(cli.__file__))
    file.write_text(AT_ONCE)
    environment = os.environ | {"NUMBA_CACHE_DIR": str(tmp_path), "PYTHONPATH": home}
    words = [sys.executable, str(file)]
    begun = [subprocess.Popen(words, env=environment, stdout=subprocess.PIPE, text=True) for _ in range(2)]
    assert sorted(process.communicate()[0] for process in begun) == ["False\n", "True\n"]
    assert [process.returncode for process in begun] == [0, 0]


@pytest.mark.slow
def test_loops_compiled_now_and_loops_loaded_give_the_same_bits(sample_clip, tmp_path):
    """A part that is not inlined exists twice, optimised differently: which one runs depends on who compiled it."""
    environment = os.environ | {"NUMBA_CACHE_DIR": str(tmp_path / "cache")}
    found = []
    for name in ("compiled", "loaded"):
        words = ["run", str(sample_clip), "-o", str(tmp_path / name), "--frames", "0:24", "--no-figures", "--no-video"]
        subprocess.run([sys.executable, "-m", "disctrack", *words], env=environment, check=True, capture_output=True)
        found.append(read_trajectory(tmp_path / name / "trajectory.h5"))
    for name in ("q", "markers_px", "pose_covariance"):
        np.testing.assert_array_equal(*(getattr(trajectory, name) for trajectory in found))
