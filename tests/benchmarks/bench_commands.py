"""The command line by elapsed time: first and later starts, a batch beside independent processes.

pytest -m slow -p benchmark --dist=no tests/benchmarks/bench_commands.py
"""

import os
import shutil
import subprocess
import sys
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import Any

import pytest

from disctrack.processes import ONE_THREAD
from disctrack.recording.declaration import Recording
from tests.pipeline.conftest import linked, naming_rig

pytestmark = pytest.mark.slow
COPIES = 4  # of the recording in a batch
Benchmark = Any  # the fixture of pytest-benchmark


def disctrack(*words: object, **environment: str) -> None:
    """A command in a process of its own."""
    command = [sys.executable, "-m", "disctrack", *map(str, words)]
    subprocess.run(command, env=os.environ | environment, stdout=subprocess.DEVNULL, check=True)


@pytest.mark.benchmark(group="a command")
@pytest.mark.parametrize("options", [[], ["--no-figures", "--no-video"]], ids=["run", "run without pictures"])
def test_run(benchmark: Benchmark, recording: Recording, tmp_path: Path, options: list[str]) -> None:
    benchmark.pedantic(disctrack, ("run", recording.folder, "-o", tmp_path, "--overwrite", *options), rounds=3)


@pytest.mark.benchmark(group="a command")
@pytest.mark.parametrize("command", ["run", "diagnose"])
def test_first_start(benchmark: Benchmark, recording: Recording, tmp_path: Path, command: str) -> None:
    """With nothing compiled."""
    disctrack("run", recording.folder, "-o", tmp_path, "--no-figures", "--no-video")
    what = (recording.folder, "-o", tmp_path, "--overwrite") if command == "run" else (tmp_path / "trajectory.h5",)
    benchmark.pedantic(disctrack, (command, *what), {"NUMBA_CACHE_DIR": str(tmp_path / "compiled")}, rounds=1)


@pytest.mark.benchmark(group="a command")
@pytest.mark.parametrize("command", ["analyse", "diagnose"])
def test_later_start(benchmark: Benchmark, recording: Recording, tmp_path: Path, command: str) -> None:
    disctrack("run", recording.folder, "-o", tmp_path, "--no-figures", "--no-video")
    benchmark.pedantic(disctrack, (command, tmp_path / "trajectory.h5", "--overwrite"), rounds=3)


@pytest.mark.benchmark(group=f"a batch of {COPIES}")
@pytest.mark.parametrize(
    ("processes", "side_by_side"), [(1, 1), (1, 2), (2, 1)], ids=["one after the other", "-j 2", "two commands"]
)
def test_batch(benchmark: Benchmark, recording: Recording, tmp_path: Path, processes: int, side_by_side: int) -> None:
    rig = tmp_path / "rig.h5"
    disctrack("calibrate", recording.folder, "-o", rig, "--no-figures")
    for i in range(COPIES):
        folder = linked(recording.folder.resolve(), tmp_path / f"half {i % 2}" / f"copy {i}", os.symlink)
        (folder / "recording.toml").write_text(naming_rig(recording.file.read_text(encoding="utf-8"), rig))
    halves = [tmp_path / "half 0", tmp_path / "half 1"]
    roots = [[half] for half in halves] if processes == 2 else [halves]

    def batch(folders: list[Path]) -> None:
        disctrack("batch", *folders, "-j", side_by_side, "--no-report", **ONE_THREAD)

    def run() -> None:
        with ThreadPoolExecutor(processes) as pool:
            list(pool.map(batch, roots))

    def anew() -> None:
        for results in tmp_path.rglob("*results"):
            shutil.rmtree(results)

    benchmark.pedantic(run, setup=anew, rounds=2)
