"""Fixtures that every test may ask for, and the three circles of tests: default, statistical, slow."""

import os
import re
import subprocess
import sys
from pathlib import Path

os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")  # before numpy is loaded; as the command line does, for speed

import numpy as np
import pytest

from disctrack.cli import main

REPOSITORY = Path(__file__).resolve().parents[1]
CIRCLES = ("slow", "statistical")  # run when they are named: -m statistical, -m slow, or the test itself


def circle_of(item: pytest.Item) -> str | None:
    """Of a marked test; one case of a statistical test may be slow."""
    return next(filter(item.get_closest_marker, CIRCLES), None)


def pytest_collection_modifyitems(config: pytest.Config, items: list[pytest.Item]) -> None:
    """Leave out the circles that nobody named."""
    named = set(re.findall(r"\w+", config.getoption("markexpr")))
    asked = {argument.partition("[")[0] for argument in config.args if "::" in argument}
    left_out = [
        item
        for item in items
        if (circle := circle_of(item)) and circle not in named and item.nodeid.partition("[")[0] not in asked
    ]
    if left_out:
        config.hook.pytest_deselected(items=left_out)
        items[:] = [item for item in items if item not in set(left_out)]


def pytest_sessionstart(session: pytest.Session) -> None:
    """Compile the inner loops once, before each of several workers does."""
    if getattr(session.config.option, "numprocesses", None) and not session.config.option.collectonly:
        subprocess.run([sys.executable, "-m", "disctrack", "warm-up"], cwd=REPOSITORY, check=True, capture_output=True)


@pytest.fixture
def rng() -> np.random.Generator:
    """Seeded, so that a failure can be repeated."""
    return np.random.default_rng(20140703)


@pytest.fixture
def cli(capsys: pytest.CaptureFixture[str]):
    """Runs a command, which ends with this exit code; what it printed, out and err."""

    def run(*words: object, code: int = 0):
        assert main([str(word) for word in words]) == code
        return capsys.readouterr()

    return run


@pytest.fixture(scope="session")
def shared_data() -> Path:
    """Folder with the reference recordings and photographs, beside the repository or named by DISCTRACK_SHARED."""
    named = os.environ.get("DISCTRACK_SHARED")
    candidates = [Path(named), Path(named) / "data"] if named else []
    candidates += [base.parent / "shared" / "data" for base in (REPOSITORY, *REPOSITORY.parents)]
    for folder in candidates:
        if (folder / "rec_a" / "recording.toml").is_file():
            return folder
    pytest.skip("no ../shared/data beside the repository, and DISCTRACK_SHARED does not name it")


@pytest.fixture(scope="session")
def sample_clip() -> Path:
    """The short recording that comes with the sources."""
    folder = REPOSITORY / "sample_data" / "clip"
    if not (folder / "recording.toml").is_file():
        pytest.skip("sample_data/clip is not in this checkout")
    return folder
