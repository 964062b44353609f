"""The command line by elapsed time: first and later starts.

pytest -m slow -p benchmark --dist=no tests/benchmarks/bench_commands.py
"""

import os
import subprocess
import sys
from pathlib import Path

import pytest

from disctrack.recording.declaration import Recording

pytestmark = pytest.mark.slow


def disctrack(*words: object, **environment: str) -> None:
    """A command in a process of its own."""
    command = [sys.executable, "-m", "disctrack", *map(str, words)]
    subprocess.run(command, env=os.environ | environment, stdout=subprocess.DEVNULL, check=True)


@pytest.mark.benchmark(group="a command")
@pytest.mark.parametrize("command", ["run", "run --no-figures --no-video", "analyse", "diagnose"])
@pytest.mark.parametrize("start", ["first", "later"])
def test_start(benchmark, recording: Recording, tmp_path: Path, command: str, start: str) -> None:
    """A first one has nothing compiled."""
    name, *options = command.split()
    disctrack("run", recording.folder, "-o", tmp_path, "--no-figures", "--no-video")
    what = (recording.folder, "-o", tmp_path) if name == "run" else (tmp_path / "trajectory.h5",)
    compiled = {"NUMBA_CACHE_DIR": str(tmp_path / "compiled")} if start == "first" else {}
    words = (name, *what, "--overwrite", *options)
    benchmark.pedantic(disctrack, words, compiled, rounds=1 if start == "first" else 3)
