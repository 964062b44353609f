"""Calibration of a stereo pair of cameras from views of a chessboard; usable on its own.

found = calibrate_stereo(left_images, right_images, Board((9, 6), 8e-3), table_view=0, board_thickness=3e-3)
found.rig, found.rms_px, found.assessment.verdict
"""

from importlib import import_module
from typing import TYPE_CHECKING, Any

from calibration.board.target import Board
from calibration.cameras.camera import Camera, StereoRig, triangulate
from calibration.kit.errors import CalibrationError, DiscTrackError, RigFileError

if TYPE_CHECKING:
    from calibration.board.chessboard import BoardNotFound, CornerView, find_corners
    from calibration.fit.refinement import refine_stereo
    from calibration.fit.stereo_model import Observations, StereoModel, Terms
    from calibration.points import calibrate_from_points
    from calibration.stereo import CalibrationSettings, StereoCalibration, calibrate_from_corners, calibrate_stereo

# Imported when asked for: the physics needs the camera model and the errors, not the image library behind these.
_ON_DEMAND = {
    "board.chessboard": ("BoardNotFound", "CornerView", "find_corners"),
    "points": ("calibrate_from_points",),
    "fit.refinement": ("refine_stereo",),
    "fit.stereo_model": ("Observations", "StereoModel", "Terms"),
    "judge.tolerances": ("BoardTolerances",),
    "stereo": ("CalibrationSettings", "StereoCalibration", "calibrate_from_corners", "calibrate_stereo"),
}


def __getattr__(name: str) -> Any:
    for module, names in _ON_DEMAND.items():
        if name in names:
            return getattr(import_module(f"calibration.{module}"), name)
    raise AttributeError(f"module 'calibration' has no attribute '{name}'")


__all__ = [
    "Board",
    "BoardNotFound",
    "BoardTolerances",
    "CalibrationError",
    "CalibrationSettings",
    "Camera",
    "CornerView",
    "DiscTrackError",
    "Observations",
    "RigFileError",
    "StereoCalibration",
    "StereoModel",
    "StereoRig",
    "Terms",
    "calibrate_from_corners",
    "calibrate_from_points",
    "calibrate_stereo",
    "find_corners",
    "refine_stereo",
    "triangulate",
]
