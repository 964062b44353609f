"""Fixtures that every test may ask for."""

import os
from pathlib import Path

os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")  # before numpy is loaded; as the command line does, for speed

import numpy as np
import pytest

REPOSITORY = Path(__file__).resolve().parents[1]


@pytest.fixture
def rng() -> np.random.Generator:
    """Seeded, so that a failure can be repeated."""
    return np.random.default_rng(20140703)


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
