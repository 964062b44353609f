"""Calibration of a stereo pair of cameras from views of a chessboard; usable on its own.

found = calibrate_stereo(left_images, right_images, Board((9, 6), 8e-3), table_view=0, board_thickness=3e-3)
found.rig, found.rms_px, found.assessment.verdict
"""

from typing import TYPE_CHECKING

from calibration.kit.public import imported_when_used

# The physics imports the camera model and the errors without the image library of the others.
if TYPE_CHECKING:
    from calibration.board.chessboard import BoardNotFound as BoardNotFound
    from calibration.board.chessboard import CornerView as CornerView
    from calibration.board.chessboard import find_corners as find_corners
    from calibration.board.target import Board as Board
    from calibration.cameras.camera import Camera as Camera
    from calibration.cameras.camera import StereoRig as StereoRig
    from calibration.cameras.camera import triangulate as triangulate
    from calibration.fit.refinement import refine_stereo as refine_stereo
    from calibration.fit.stereo_model import Observations as Observations
    from calibration.fit.stereo_model import StereoModel as StereoModel
    from calibration.judge.tolerances import BoardTolerances as BoardTolerances
    from calibration.kit.errors import CalibrationError as CalibrationError
    from calibration.kit.errors import DiscTrackError as DiscTrackError
    from calibration.kit.errors import RigFileError as RigFileError
    from calibration.stereo import StereoCalibration as StereoCalibration
    from calibration.stereo import calibrate_from_corners as calibrate_from_corners
    from calibration.stereo import calibrate_from_points as calibrate_from_points
    from calibration.stereo import calibrate_stereo as calibrate_stereo

__getattr__, __all__ = imported_when_used(__file__)
