"""What is measured: the sample, or the recording of image files that DISCTRACK_BENCHMARK names, with its rig."""

import os
from pathlib import Path

import cv2
import numpy as np
import pytest

from calibration import StereoRig
from disctrack import Recording, calibrate_recording, open_pairs, read_recording
from disctrack.track.measurement import ImagePairs
from tests.pipeline.conftest import images_of

MOST = 300  # pairs that are kept in memory


@pytest.fixture(scope="session")
def recording(sample_clip: Path) -> Recording:
    """Of image files."""
    return read_recording(Path(os.environ.get("DISCTRACK_BENCHMARK", sample_clip)))


@pytest.fixture(scope="session")
def rig(recording: Recording) -> StereoRig:
    """As `disctrack run` calibrates it."""
    return calibrate_recording(recording)[0].rig


@pytest.fixture
def pairs(recording: Recording) -> ImagePairs:
    """Opened anew, so that nothing is known of them yet."""
    return open_pairs(recording, (0, MOST))


@pytest.fixture(scope="session")
def images(recording: Recording) -> np.ndarray:
    """The frames in memory, (n, 2, height, width)."""
    cv2.setNumThreads(1)
    return images_of(recording, MOST)
