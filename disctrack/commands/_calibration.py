"""Calibration as the commands need it: the source of the views from their options."""

from __future__ import annotations

import argparse
from pathlib import Path

from calibration import Board, CalibrationSettings
from disctrack.calibrate.stage import CalibrationSource, calibrate_into, given_rig, source_of
from disctrack.calibrate.views import find_views
from disctrack.errors import RecordingError
from disctrack.recording.declaration import read_recording

__all__ = ["calibrate_into", "given_rig", "settings_of", "source_of", "source_of_patterns", "source_of_recording"]


def settings_of(arguments: argparse.Namespace) -> CalibrationSettings:
    """Settings from the options of `add_calibration_options`."""
    return CalibrationSettings(distortion=arguments.distortion, board=arguments.board)


def source_of_recording(arguments: argparse.Namespace) -> CalibrationSource:
    """Views that a recording names. Raises RecordingError."""
    return source_of(read_recording(arguments.recording), settings_of(arguments))


def source_of_patterns(arguments: argparse.Namespace) -> CalibrationSource:
    """Views named on the command line. Raises RecordingError."""
    given = {
        "--left": arguments.left,
        "--right": arguments.right,
        "--corners": arguments.corners,
        "--square-mm": arguments.square_mm,
    }
    missing = [option for option, value in given.items() if value is None]
    if missing:
        raise RecordingError(f"{', '.join(missing)} missing: give a recording's folder, or all of {', '.join(given)}.")
    return CalibrationSource(
        arguments.left,
        find_views(arguments.left, arguments.right, Path()),
        Board(arguments.corners, arguments.square_mm * 1e-3),
        arguments.table_view,
        arguments.board_thickness_mm * 1e-3,
        settings_of(arguments),
    )
