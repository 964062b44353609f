"""Calibration views from files."""

from __future__ import annotations

import glob
import os
from collections.abc import Sequence
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray

from calibration.board import Board
from calibration.errors import CalibrationError
from calibration.stereo import CalibrationSettings, Progress, StereoCalibration, calibrate_stereo


def find_pairs(left: str, right: str, folder: str | os.PathLike[str] = ".") -> list[tuple[Path, Path]]:
    """Files of two patterns (left*.jpg, right*.jpg), sorted by name and paired in that order.

    Raises CalibrationError if a pattern matches nothing or the numbers differ.
    """
    sides = []
    for name, pattern in (("left", left), ("right", right)):
        found = sorted(Path(p) for p in glob.glob(str(Path(folder) / pattern)) if Path(p).is_file())
        if not found:
            raise CalibrationError(f"{Path(folder) / pattern}: no {name} calibration view matches this pattern")
        sides.append(found)
    if len(sides[0]) != len(sides[1]):
        raise CalibrationError(
            f"{len(sides[0])} left views match {left!r} but {len(sides[1])} right ones match {right!r}: views are "
            f"pairs; the last ones are {sides[0][-1].name} and {sides[1][-1].name}"
        )
    return list(zip(*sides, strict=True))


def read_image(path: str | os.PathLike[str]) -> NDArray:
    """An image as it was written, 8 or 16 bit, grey or colour. Raises CalibrationError if it cannot be decoded."""
    try:
        data = np.fromfile(path, dtype=np.uint8)
    except OSError as error:
        raise CalibrationError(f"{path}: cannot be read ({error.strerror or error})") from error
    try:
        image = cv2.imdecode(data, cv2.IMREAD_UNCHANGED) if data.size else None
    except cv2.error:
        image = None
    if image is None:
        raise CalibrationError(f"{path}: not an image that can be decoded ({data.size} bytes): damaged or cut short?")
    return image


def calibrate_files(
    pairs: Sequence[tuple[str | os.PathLike[str], str | os.PathLike[str]]],
    board: Board,
    settings: CalibrationSettings | None = None,
    table_view: int | None = None,
    board_thickness: float = 0.0,
    progress: Progress | None = None,
) -> StereoCalibration:
    """`calibrate_stereo` on files. Raises CalibrationError that names the file."""
    left = [read_image(a) for a, _ in pairs]
    right = [read_image(b) for _, b in pairs]
    names = [(str(a), str(b)) for a, b in pairs]
    return calibrate_stereo(left, right, board, settings, table_view, board_thickness, names, progress)
