"""The measured motion of one recording, with uncertainties and the status of every frame."""

from collections.abc import Callable, Iterable
from dataclasses import dataclass, replace
from enum import IntEnum
from typing import TYPE_CHECKING, ClassVar, TypeVar

import numpy as np

from calibration.cameras.camera import StereoRig
from calibration.kit.brief import Brief
from calibration.kit.types import AnyArray, Array, Codes, Indices, Mask
from disctrack.disc import AIR_DENSITY, Disc
from disctrack.findings import Finding
from disctrack.frames import euler_jacobian

if TYPE_CHECKING:
    import xarray


class FrameStatus(IntEnum):
    """Whether a frame has a pose, and why not; reports print `sentence`.

    >>> bool((read_trajectory("clip").frame_status == FrameStatus.MEASURED).all())
    True
    """

    sentence: str

    MEASURED = 0, "measured with both cameras"
    ONE_CAMERA = 1, "measured with one camera: sigma along its view is large"
    FEW_MARKERS = 2, "measured with fewer than 6 good dot images: sigma is larger"
    MARKERS_NOT_FOUND = 3, "fewer than 3 dots found: outside the field, hidden, or blurred"
    NOT_CONVERGED = 4, "no pose fits the dots: two exchanged, or the rig does not belong to this recording"
    UNREADABLE = 5, "image file could not be read"
    NOT_PROCESSED = 6, "not processed"
    STILL = 7, "left out: nothing moves before the start or after the end; --all measures them, too"
    REPEATED = 8, "both images are copies of earlier ones, while the disc moves: the recorder lost this frame"
    CONTRADICTED = 9, "refused: the dots contradict each other beyond their noise (glare, a hand, an exchanged image)"
    JUMPED = 10, "refused: no motion leads from the frames before or after to this pose (exchanged frames?)"

    def __new__(cls, value: int, sentence: str = "") -> "FrameStatus":
        """A number with its sentence."""
        member = int.__new__(cls, value)
        member._value_, member.sentence = value, sentence
        return member

    @property
    def has_pose(self) -> bool:
        """True if the frame has a pose, perhaps with a large sigma."""
        return self in (FrameStatus.MEASURED, FrameStatus.ONE_CAMERA, FrameStatus.FEW_MARKERS)

    @property
    def looked_for(self) -> bool:
        """True if the frame was processed, with or without success."""
        return self not in (FrameStatus.NOT_PROCESSED, FrameStatus.STILL)


class MarkerStatus(IntEnum):
    """Whether a dot has a measured centre, and why not.

    >>> MarkerStatus(int(read_trajectory("clip").marker_status[0, 0, 0])).name
    'MEASURED'
    """

    MEASURED = 0
    OUTSIDE = 1  # its window leaves the image
    LOW_CONTRAST = 2
    OCCLUDED = 3  # the grey values do not fit a dot: partly hidden, or crossed by the edge of a glare
    NOT_CONVERGED = 4
    BLURRED = 5
    REJECTED = 6  # inconsistent with the other dots of the frame
    NOT_LOOKED_FOR = 7


@dataclass(frozen=True, repr=False)
class Trajectory(Brief):
    """Pose of the disc in every frame of a recording; arrays are as long as the recording.

    n frames, m markers. NaN for missing values; `frame_status` gives the reason.

        >>> trajectory = read_trajectory("clip")
        >>> trajectory.q.shape, trajectory.coordinate_sigma.shape
        ((300, 6), (300, 6))
    """

    read_by: ClassVar[str] = "disctrack.trajectory.file:read_trajectory"
    held_as: ClassVar[str] = "trajectory"

    time: Array  # (n,) [s] of mid exposure: i / frame_rate for frame i, or the camera's timestamps
    frame: Indices  # (n,) number of the frame in its sequence
    q: Array  # (n, 6) x, y, z [m], psi, theta, phi [rad] unwrapped
    pose_covariance: Array  # (n, 6, 6) noise of this frame, in POSE_COMPONENTS (frames.py); without calibration
    calibration_sensitivity: Array  # (n, 6, 30) d pose / d RIG_PARAMETERS at fixed pixels; common to all frames
    # (n, 6, 6) constant and slowly varying errors other than the rig's: misfit of the dots beyond noise
    systematic_covariance: Array
    quaternion: Array  # (n, 4) w, x, y, z; body to world, continuous
    frame_status: Codes  # (n,) FrameStatus
    reprojection_rms_px: Array  # (n, 2) per camera
    reduced_chi_square: Array  # (n,) of the pose fit
    markers_px: Array  # (n, 2, m, 2) images of the dots' centres, not centres of the ellipses
    markers_covariance_px2: Array  # (n, 2, m, 2, 2)
    markers_residual_px: Array  # (n, 2, m, 2) observed - projected
    marker_status: Codes  # (n, 2, m) MarkerStatus
    disc: Disc  # with the marker centres that the fits used, refined or declared
    rig: StereoRig
    frame_rate: float  # [Hz]
    gravity: float  # [m/s^2]
    air_density: float = AIR_DENSITY  # [kg/m^3]
    # Shift of the table's plane from the board to the plane on which the disc rolls, beyond its uncertainty: height at
    # the origin [m], slopes along x and y. If not zero, the board is bent or the table is not flat
    table_moved: tuple[float, float, float] = (0.0, 0.0, 0.0)
    findings: tuple[Finding, ...] = ()  # of the measurement

    def __len__(self) -> int:
        return len(self.time)

    def facts(self) -> dict[str, str]:
        """Summary for `repr` (`Brief`)."""
        shown = {"frames": f"{len(self)} at {self.frame_rate:g} Hz", "measured": f"{int(self.measured.sum())}"}
        good = self.measured
        if good.any():
            theta = np.degrees(self.q[good, 4])
            sigma = np.nanmedian(self.coordinate_sigma[good], axis=0)
            shown |= {
                "theta": f"{theta[0]:.3g} to {theta[-1]:.3g} deg",
                "sigma": f"{1e6 * sigma[:3].max():.2g} µm, theta {np.degrees(sigma[4]) * 1e3:.2g} mdeg",
            }
        return shown | {"disc": f"{2e3 * self.disc.radius:g} mm, {self.disc.n_markers} dots"}

    def to_xarray(self) -> "xarray.Dataset":
        """The trajectory as `xarray.Dataset` with time, units and both sigmas; the disc's sizes are attributes."""
        from disctrack.trajectory.file import to_xarray

        return to_xarray(self)

    @property
    def looked_for(self) -> Mask:
        """(n,) True if the frame was processed, with or without success."""
        return np.isin(self.frame_status, [int(status) for status in FrameStatus if status.looked_for])

    @property
    def measured(self) -> Mask:
        """(n,) True if the frame has a pose."""
        return np.asarray(np.isfinite(self.q).all(axis=1))

    @property
    def calibration_covariance(self) -> Array:
        """(n, 6, 6) covariance of pose errors common to frames: from the rig, and `systematic_covariance`."""
        S = self.calibration_sensitivity
        return S @ self.rig.covariance @ np.swapaxes(S, -1, -2) + self.systematic_covariance

    @property
    def coordinate_sigma(self) -> Array:
        """(n, 6) standard deviation of q from this frame's noise alone [m, rad]; psi and phi grow as 1/sin theta."""
        return coordinate_sigma(self.q, self.pose_covariance)

    @property
    def calibration_sigma(self) -> Array:
        """(n, 6) standard deviation of the errors of q that are common to frames [m, rad]."""
        return coordinate_sigma(self.q, self.calibration_covariance)


Frames = TypeVar("Frames")  # a trajectory, or another dataclass of arrays that have one row per frame


def _changed(whole: Frames, change: Callable[[str, AnyArray], AnyArray]) -> Frames:
    """Copy with `change` (name, array -> array) applied to all arrays."""
    arrays = {name: change(name, value) for name, value in vars(whole).items() if isinstance(value, np.ndarray)}
    return type(whole)(**vars(whole) | arrays)


def part(whole: Frames, rows: slice | Mask) -> Frames:
    """These frames only."""
    return _changed(whole, lambda name, value: value[rows])


def joined(pieces: Iterable[Frames]) -> Frames:
    """Successive parts as one; fields without frames are those of the first part."""
    first, *others = pieces
    return _changed(first, lambda name, value: np.concatenate([value, *(vars(piece)[name] for piece in others)]))


def at_full_length(part: Trajectory, n: int, start: int, timestamps: Array | None = None) -> Trajectory:
    """Extend a trajectory of frames start.. to all n frames; the others are NaN with the status NOT_PROCESSED.

    timestamps (n,) [s] if the camera wrote them; otherwise frames are evenly spaced.
    """
    if len(part) == n:
        return part
    time = np.arange(n) / part.frame_rate if timestamps is None else np.array(timestamps, float)
    time[start : start + len(part)] = part.time
    whole = _changed(part, lambda name, value: among(n, start, value, _FILL.get(name)))
    return replace(whole, frame=np.arange(n), time=time)


_FILL = {"frame_status": FrameStatus.NOT_PROCESSED, "marker_status": MarkerStatus.NOT_LOOKED_FOR}


def among(n: int, start: int, rows: AnyArray, fill: float | None = None) -> AnyArray:
    """Rows of frames start.. in an array of n frames; the others are `fill`, by default NaN, or 0 for integers."""
    empty = np.nan if rows.dtype.kind == "f" else 0
    whole = np.full((n, *rows.shape[1:]), empty if fill is None else fill, rows.dtype)
    whole[start : start + len(rows)] = rows
    return whole


def coordinate_sigma(q: Array, pose_covariance: Array) -> Array:
    """(n, 6) standard deviations of q (n, 6) from the covariance (n, 6, 6) of POSE_COMPONENTS, in the units of q.

    NaN if q is NaN, or if an angle is undetermined.
    """
    J = euler_jacobian(q[:, 3], q[:, 4])
    rotation = np.einsum("nij,njk,nik->ni", J, pose_covariance[:, 3:, 3:], J)
    position = np.einsum("nii->ni", pose_covariance[:, :3, :3])
    variance = np.concatenate([position, rotation], axis=1)
    return np.sqrt(np.where(variance >= 0, variance, np.nan))
