"""Where the compiled inner loops are kept, and what is said while they are compiled."""

import os
import runpy
import subprocess
import sys
import time

import numpy as np
import pytest

from calibration.kit.compiled import njit
from disctrack import cli
from disctrack.progress import compiling
from disctrack.trajectory.file import read_trajectory


def test_a_read_only_home_and_installation_get_a_cache_of_their_own(monkeypatch, tmp_path, capsys):
    monkeypatch.delitem(sys.modules, "numba", raising=False)
    for name in ("NUMBA_CACHE_DIR", "MPLCONFIGDIR"):
        monkeypatch.setenv(name, "")  # so that it is as before after the test
        monkeypatch.delenv(name)
    monkeypatch.setattr("tempfile.tempdir", str(tmp_path))
    cli._keep_compiled_loops_somewhere()
    assert "NUMBA_CACHE_DIR" not in os.environ  # this checkout can be written to
    monkeypatch.setattr(os, "access", lambda path, mode: False)
    cli._keep_compiled_loops_somewhere()
    folder = os.environ["NUMBA_CACHE_DIR"]
    assert os.path.isdir(folder)
    assert folder.startswith(str(tmp_path))
    assert os.environ["MPLCONFIGDIR"].startswith(folder)  # what matplotlib finds of fonts is kept there, too
    said = capsys.readouterr().err.splitlines()
    assert len(said) == 1
    assert folder in said[0]


@pytest.mark.statistical
def test_compiling_is_announced_and_slow_loading_is_not(capsys, tmp_path):
    file, told = tmp_path / "loops.py", []
    for source in ("def twice(x):\n    return 2 * x\n", "def twice(x):\n    return x + x  # otherwise\n"):
        file.write_text(source)
        for _ in range(2):
            loops = runpy.run_path(str(file))
            with compiling("corners", 8):
                assert njit(loops["twice"], cache=True)(2) == 4
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
