"""Calibration of a stereo pair of cameras from views of a chessboard; usable on its own.

found = calibrate_stereo(left_images, right_images, Board((9, 6), 8e-3), table_view=0, board_thickness=3e-3)
found.rig, found.rms_px, found.assessment.verdict
"""

from calibration.board import Board
from calibration.camera import Camera, StereoRig, triangulate
from calibration.chessboard import BoardNotFound, CornerView, find_corners
from calibration.errors import CalibrationError, DiscTrackError, RigFileError
from calibration.refinement import Observations, StereoModel, Terms, refine_stereo
from calibration.stereo import CalibrationSettings, StereoCalibration, calibrate_from_corners, calibrate_stereo

__all__ = [
    "Board",
    "BoardNotFound",
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
    "calibrate_stereo",
    "find_corners",
    "refine_stereo",
    "triangulate",
]
