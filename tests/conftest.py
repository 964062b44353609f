"""Fixtures that every test may ask for, and the three circles of tests: default, statistical, slow."""

import os
import re
import subprocess
import sys
import time
from collections.abc import Iterator
from pathlib import Path

os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")  # before numpy is loaded; as the command line does, for speed

import numpy as np
import pytest
from numba.core.event import install_timer

from disctrack.cli import main

REPOSITORY = Path(__file__).resolve().parents[1]
CIRCLES = ("slow", "statistical")  # run when they are named: -m statistical, -m slow, or the test itself
DEFAULT_TEST_S = 2.0  # of processor time: some two thousand tests share three minutes of two cores
REFERENCE_S = 0.01  # what `_reference` takes on the processor that the limit was set on


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


@pytest.hookimpl(wrapper=True)
def pytest_runtest_call(item: pytest.Item) -> Iterator[None]:
    """Fail a default test that takes more than its share; a slower or busier processor may take longer.

    What numba compiles on the way is not the test's: whichever asks first for a function pays for all.
    """
    start, compiling = _processor_time(), []
    with install_timer("numba:compile", compiling.append):
        result = yield
    used = _processor_time() - start - sum(compiling)
    item.user_properties.append(("processor_s", round(used, 2)))  # for --junitxml
    if used > DEFAULT_TEST_S and not circle_of(item):
        limit = DEFAULT_TEST_S * max(1.0, max(_reference() for _ in range(5)) / REFERENCE_S)
        if used > limit:
            pytest.fail(
                f"{used:.1f} s of processor time, {limit:.1f} s allowed: compute less, share it in a fixture, "
                "or mark it statistical (runs in CI) or slow (runs on demand)",
                pytrace=False,
            )
    return result


def _reference() -> float:
    """Processor time of a fixed piece of work, half in Python and half in NumPy [s]."""
    start = time.process_time()
    sum(i * i for i in range(100_000))
    matrix = np.ones((200, 200))
    for _ in range(10):
        matrix = np.tanh(matrix @ matrix / 200)
    return time.process_time() - start


def _processor_time() -> float:
    """Of this process and of those that it has started and seen to their end [s]."""
    return time.process_time() + sum(os.times()[2:4])


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
