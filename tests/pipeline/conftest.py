"""A short recording and a rig that was calibrated once, for tests that go through the command line."""

import os
import shutil
from pathlib import Path

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


def naming_rig(declaration: str, rig: Path) -> str:
    """The declaration with a rig file in place of its views and their table."""
    start, end = declaration.index("[calibration]"), declaration.index("[gravity]")
    return f'{declaration[:start]}[calibration]\nrig = "{rig.as_posix()}"\n\n{declaration[end:]}'


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
    (folder / "recording.toml").write_text(naming_rig((short_recording / "recording.toml").read_text(), rig_file))
    return folder
