"""Poses while the camera runs: one pair in, one pose out, with the state of the tracking kept in between.

The same compiled loop as for recordings, one pair at a time. What `track` estimates from a whole recording (positions
of the dots, their scatter) is not known yet: so use a disc that was measured before.
"""

from dataclasses import dataclass

import numpy as np

from calibration.cameras.camera import StereoRig
from calibration.kit.types import AnyArray, Array, Image, checked, grey_values
from disctrack import frames
from disctrack.disc import Disc
from disctrack.errors import ArgumentError
from disctrack.track.dots.template import dot_centres
from disctrack.track.follow.following import Follower, Tables, empty_tables, follow_block, maps_of
from disctrack.track.follow.tracking import check_images
from disctrack.track.pose import DotsInFrames, fit_poses
from disctrack.track.refine.assembly import status_of
from disctrack.trajectory import FrameStatus, coordinate_sigma


@dataclass(frozen=True, repr=False)
class LivePose:
    """Pose of the disc in one pair, with its quality; NaN if `status` has no pose.

    >>> tracker, pairs = Tracker("clip/results/rig.h5", read_trajectory("clip")), open_pairs("clip")
    >>> pose = tracker.next(pairs.left.read(0), pairs.right.read(0))
    >>> pose.q.shape, pose.sigma.shape
    ((6,), (6,))
    """

    frame: int  # number of the pair, from 0
    q: Array  # (6,) x, y, z [m], psi, theta, phi [rad]; angles unwrapped since the disc was last found
    R_world_body: Array  # (3, 3)
    covariance: Array  # (6, 6) noise of this pair, in POSE_COMPONENTS (frames.py); calibration not included
    status: FrameStatus
    markers_px: Array  # (2, m, 2) centres of the dots; NaN where a dot was not measured
    residuals_px: Array  # (2, m, 2) observed - projected
    reduced_chi_square: float

    @property
    def sigma(self) -> Array:
        """(6,) standard deviation of q by this pair's noise [m, rad]; psi and phi grow as 1 / sin(theta)."""
        return np.asarray(coordinate_sigma(self.q[None], self.covariance[None])[0])

    def __repr__(self) -> str:
        if not self.status.has_pose:
            return f"LivePose(frame {self.frame}: {self.status.sentence})"
        x, y, z = 1e3 * self.q[:3]
        psi, theta, phi = np.degrees(self.q[3:])
        return (
            f"LivePose(frame {self.frame}: x {x:.4f} y {y:.4f} z {z:.4f} mm, psi {psi:.3f} theta {theta:.4f} "
            f"phi {phi:.3f} deg, {self.status.name.lower()})"
        )


class Tracker:
    """Follows the disc through a live sequence of pairs.

    rig, disc : of the set-up, from `read_rig` and a trajectory or recording; nothing is refined over the sequence
    With the first pairs the code is compiled (once per installation) and the disc is searched for; later pairs take
    about a millisecond each. If the disc is not found, `status` says so, and the next pair is searched.

        >>> tracker, pairs = Tracker("clip/results/rig.h5", read_trajectory("clip")), open_pairs("clip")
        >>> tracker.next(pairs.left.read(0), pairs.right.read(0)).status.name
        'MEASURED'
    """

    @checked
    def __init__(self, rig: StereoRig, disc: Disc) -> None:
        self.rig, self.disc = rig, disc
        self.frame = -1
        self._follower = Follower(rig, disc, maps_of(rig))
        self._angles: Array | None = None  # of the last pose

    def __repr__(self) -> str:
        state = "following the disc" if self._follower.lost is None else "searching"
        return f"Tracker({self.disc.n_markers} dots, {self.frame + 1} pairs seen, {state})"

    def next(self, left: Image, right: Image) -> LivePose:
        """Pose in the next pair; images (height, width) of one real type.

        Raises ArgumentError if they are no images, TrackingError if the rig was calibrated at another size.
        """
        self.frame += 1
        left, right = grey_values(left, "left"), grey_values(right, "right")
        if left.dtype != right.dtype or left.shape != right.shape or left.ndim != 2:
            raise ArgumentError(
                f"left is an image of shape {left.shape} {left.dtype}, right of {right.shape} {right.dtype}; expected "
                "(height, width), both of one type"
            )
        check_images(left.shape[::-1], self.rig)
        images: AnyArray = np.stack([left, right])[None]
        rows = empty_tables(1, self.disc.n_markers)
        follow_block(self._follower, images, np.ones((1, 2), bool), rows, 0)
        return self._pose(rows)

    def _pose(self, rows: Tables) -> LivePose:
        """Pose of one pair from its row of the tables; without a pose the pair has no dots either."""
        followed = rows.frame_status
        if followed[0] != FrameStatus.MEASURED:
            self._angles, rows = None, empty_tables(1, self.disc.n_markers)
        _, pixels, covariance = dot_centres(rows.results, rows.status)
        seen = DotsInFrames(self.rig, self.disc, pixels, covariance, rows.R, rows.t)
        fit = fit_poses(seen, with_sensitivity=False)
        angles = np.full(3, np.nan)
        if fit.converged[0]:
            angles = frames.euler_from_rotation(fit.R_world_body[0])
            if self._angles is not None:
                angles = frames.unwrap_euler(np.stack([self._angles, angles]))[1]
            self._angles = angles
        return LivePose(
            self.frame,
            np.concatenate([fit.t_world_body[0], angles]),
            fit.R_world_body[0],
            fit.covariance[0],
            FrameStatus(status_of(followed, seen, fit)[0]),
            seen.pixels[0],
            fit.residuals_px[0],
            float(fit.reduced_chi_square[0]),
        )
