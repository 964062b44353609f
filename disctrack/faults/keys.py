"""The keys of the `faults` of a scene; by default there are none."""

import math
from dataclasses import dataclass, field

import numpy as np

from calibration.kit.types import Array
from disctrack.files.toml_tree import MOST, NOT_NEGATIVE, POSITIVE, limited

Pair = tuple[float, float]
Triple = tuple[float, float, float]


@dataclass(frozen=True)
class CameraFault:
    """Changes of one camera after its calibration."""

    rotation_deg: Triple = (0.0, 0.0, 0.0)  # rotation vector in the camera's own axes
    translation_mm: Triple = (0.0, 0.0, 0.0)  # of the camera, in its own axes
    focal_scale: float = limited(1.0, POSITIVE)
    k1_change: float = 0.0
    principal_point_change_px: Pair = (0.0, 0.0)
    missing_frames: tuple[int, ...] = ()


@dataclass(frozen=True)
class Occluder:
    """A dark rod in front of one camera, straight in its image, from the first to the last given frame."""

    camera: str = "left"
    centre_px: Pair = (256.0, 256.0)
    angle_deg: float = 0.0  # of its axis, from x towards y
    width_px: float = limited(20.0, POSITIVE)
    length_px: float = limited(1e4, POSITIVE)
    grey: float = 40.0
    first_frame: int = 0
    last_frame: int = limited(10**9, (-MOST, math.inf))


@dataclass(frozen=True)
class Faults:
    """Undeclared faults: they change the images and truth.h5, but not recording.toml."""

    right_delay_s: float = 0.0  # delay of the right camera relative to the left
    frame_rate_hz: float = limited(0.0, NOT_NEGATIVE)  # true initial frame rate; 0: the declared one
    frame_interval_growth: float = 0.0  # relative growth of the time between frames per second: a clock that slows down
    misprint_mm: tuple[Pair, ...] = ()  # true minus declared centre of each dot
    misprint_sigma_mm: float = limited(0.0, NOT_NEGATIVE)  # standard deviation of additional random misprints
    pattern_offset_mm: Pair = (0.0, 0.0)  # of the centre of paper and dots from that of the disc
    pattern_turn_deg: float = 0.0  # rotation of paper and dots about the axis of the disc
    pattern_scale: float = limited(1.0, POSITIVE)  # true over declared distances of the dots from the pattern's middle
    pattern_height_mm: float = 0.0  # of the dots above half the thickness: paper and glue
    table_turn_deg: Pair = (0.0, 0.0)  # rotation vector, x and y, of the true table in the axes of the table view
    table_height_mm: float = 0.0  # of the true table in those axes
    exposure_s: float = limited(0.0, NOT_NEGATIVE)  # true exposure; 0: that of the cameras
    ellipse_centre_share: float = 0.0  # uncorrected share of the shift of ellipse centres; does not change the images
    hidden_markers: tuple[int, ...] = ()  # dots that have come off
    left: CameraFault = field(default_factory=CameraFault)
    right: CameraFault = field(default_factory=CameraFault)
    occluders: tuple[Occluder, ...] = ()

    def true_times(self, since: Array, rate: float) -> Array:
        """True times [s] after the first frame of frames at `since` by the clock with this declared rate [Hz]."""
        ratio = self.frame_rate_hz / rate if self.frame_rate_hz else 1.0
        return np.asarray(since * (1.0 + 0.5 * self.frame_interval_growth * since) / ratio, float)
