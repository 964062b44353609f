"""A disk that was pulled is not a disc that was not found."""

from pathlib import Path
from types import SimpleNamespace

import pytest

from disctrack.errors import RecordingError, TrackingError
from disctrack.recording.readers.blocks import Unreadable
from disctrack.track.measurement import refuse_unreadable

RECORDING = SimpleNamespace(folder=Path("rec"))


def lost(n):
    return [Unreadable(n - i, i % 2, f"left/{n - i}.png: cannot be read: No such device.") for i in range(n)]


def test_most_images_unreadable_is_the_cause_that_is_told():
    with pytest.raises(
        RecordingError, match=r"rec: the files cannot be read: 150 of 200 images, the first: left/1\.png"
    ):
        refuse_unreadable(RECORDING, lost(150), 200, TrackingError("found in none"))


def test_a_few_are_not():
    refuse_unreadable(RECORDING, lost(100), 200, TrackingError("found in none"))
