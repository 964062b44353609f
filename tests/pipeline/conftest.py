"""A short recording and a rig that was calibrated once, for tests that go through the command line."""

import os
import shutil
from pathlib import Path

import cv2
import numpy as np
import pytest

from disctrack import open_pairs
from disctrack.cli import main

SHORT = 24  # frames: enough for the noise to be measured
QUICK = ["--no-figures", "--no-video"]


@pytest.fixture(scope="session")
def short_recording(sample_clip, tmp_path_factory) -> Path:
    """The first frames of it, with all calibration views; not to be changed by a test."""
    folder = tmp_path_factory.mktemp("recordings") / "short"
    shutil.copytree(sample_clip / "calibration", folder / "calibration")
    shutil.copy(sample_clip / "recording.toml", folder)
    for camera in ("left", "right"):
        (folder / camera).mkdir()
        for file in sorted((sample_clip / camera).iterdir())[:SHORT]:
            shutil.copy(file, folder / camera)
    return folder


@pytest.fixture(scope="session")
def rig_file(short_recording, tmp_path_factory) -> Path:
    """Rig of the short recording."""
    path = tmp_path_factory.mktemp("rig") / "rig.h5"
    assert main(["calibrate", str(short_recording), "-o", str(path), "--no-figures"]) == 0
    return path


@pytest.fixture(scope="session")
def untouched_file(short_recording, rig_file, tmp_path_factory) -> Path:
    """Trajectory of the short recording, with this rig; not to be changed by a test."""
    file = tmp_path_factory.mktemp("untouched") / "trajectory.h5"
    assert main(["track", str(short_recording), "--rig", str(rig_file), "-o", str(file), *QUICK]) == 0
    return file


def linked(recording: Path, folder: Path, link=os.link) -> Path:
    """A recording of the same images as links: a test replaces them, and never writes into them."""

    def copy(source: str, target: str) -> None:
        (shutil.copy if source.endswith(".toml") else link)(source, target)

    left_out = shutil.ignore_patterns("results")
    return Path(shutil.copytree(recording, folder, copy_function=copy, ignore=left_out, dirs_exist_ok=True))


def edit(recording: Path, written: str, found: str) -> None:
    """Replace what is written in its declaration."""
    text = (recording / "recording.toml").read_text()
    assert written in text
    (recording / "recording.toml").write_text(text.replace(written, found, 1))


def contents(folder: Path) -> dict[str, bytes]:
    return {str(file.relative_to(folder)): file.read_bytes() for file in folder.rglob("*") if file.is_file()}


def grey_values(folder: Path) -> np.ndarray:
    """Of all images in it, in the order of their names."""
    return np.stack([cv2.imread(str(file), cv2.IMREAD_UNCHANGED) for file in sorted(folder.iterdir())])


def images_of(recording, n: int | None = None) -> np.ndarray:
    """(n, 2, height, width) of the first pairs of a recording."""
    pairs = open_pairs(recording)
    return np.stack([[pairs.left.read(i), pairs.right.read(i)] for i in range(n or len(pairs))])


@pytest.fixture
def recording(short_recording, rig_file, tmp_path) -> Path:
    """A copy of the short recording that names the rig file; a test may damage it."""
    folder = tmp_path / "recording"
    for camera in ("left", "right"):
        linked(short_recording / camera, folder / camera)
    text = (short_recording / "recording.toml").read_text()
    views_and_table = text[text.index("[calibration]") : text.index("[gravity]")]
    named = f'[calibration]\nrig = "{rig_file.as_posix()}"\n\n'
    (folder / "recording.toml").write_text(text.replace(views_and_table, named))
    return folder
