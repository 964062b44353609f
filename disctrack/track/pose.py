"""Pose of the disc from the dots seen by two cameras: Levenberg-Marquardt on position and rotation.

The unknowns are a translation and a rotation vector in world axes, applied from the left, so that theta = 0 is not
singular; psi, theta, phi are computed from the result (`frames.euler_from_rotation`).
"""

from dataclasses import dataclass, field, replace

import numpy as np

from calibration.cameras.camera import N_RIG, StereoRig, by_turning
from calibration.kit.least_squares import normal_of_rows
from calibration.kit.types import AnyArray, Array, Indices, Mask
from disctrack.analyse.quantities import SIGMAS
from disctrack.disc import Disc
from disctrack.faults.dots import marker_pixels
from disctrack.track import _pose_kernel as kernel

MIN_DOTS = 3  # six unknowns, two coordinates per dot
TOLERANCE = 1e-3  # standard deviations: the Gauss-Newton step at which a pose has converged


@dataclass(frozen=True)
class PoseFits:
    """Poses of n frames, with covariances and residuals."""

    R_world_body: Array  # (n, 3, 3); NaN where there is no pose
    t_world_body: Array  # (n, 3) [m]
    covariance: Array  # (n, 6, 6) POSE_COMPONENTS, from the markers' covariances alone
    sensitivity: Array  # (n, 6, 30) d pose / d RIG_PARAMETERS with the markers held fixed
    residuals_px: Array  # (n, 2, m, 2) observed - projected, also of rejected dots; NaN where a dot was not seen
    used: Mask  # (n, 2, m)
    chi_square: Array  # (n,)
    degrees_of_freedom: AnyArray  # (n,) whole numbers
    converged: Mask  # (n,)

    @property
    def reduced_chi_square(self) -> Array:
        """(n,) chi-square per degree of freedom; NaN if there is none."""
        return np.where(self.degrees_of_freedom > 0, self.chi_square / np.maximum(self.degrees_of_freedom, 1), np.nan)


@dataclass(frozen=True)
class DotsInFrames:
    """Dots seen in n frames, and poses to within a few pixels.

    Methods take a `shift` (30 + 2m + j,) of the shared parameters: RIG_PARAMETERS, positions of the dots in body axes,
    and j further ones.
    """

    rig: StereoRig
    disc: Disc
    pixels: Array  # (n, 2, m, 2); NaN where a dot was not seen
    covariance: Array  # (n, 2, m, 2, 2) [px^2]
    R: Array  # (n, 3, 3); NaN where there is no pose
    t: Array  # (n, 3) [m]
    # (n, 2, m, 2, j) derivatives of the pixels by the further parameters; by default there are none
    further: Array = field(default_factory=lambda: np.zeros((1, 1, 1, 2, 0)))

    @property
    def posed(self) -> Mask:
        """(n,) True where there is a pose."""
        return np.asarray(np.isfinite(self.t).all(axis=1))

    def at(self, rows: Indices | slice) -> "DotsInFrames":
        """Some of the frames."""
        parts = {name: getattr(self, name)[rows] for name in ("pixels", "covariance", "R", "t")}
        return replace(self, **parts)

    def delayed(self, rows: Indices) -> "DotsInFrames":
        """Some of the frames, with a further parameter: frame periods by which the right camera is ahead.

        rows : frames with both neighbours
        """
        by_delay = 0.5 * (self.pixels[rows + 1] - self.pixels[rows - 1])
        by_delay[:, 0] = 0.0
        return replace(self.at(rows), further=by_delay[..., None])

    def shifted(self, shift: Array) -> "DotsInFrames":
        """Rig and positions of the dots after the shift, and pixels without the effect of the further parameters."""
        places = slice(N_RIG, N_RIG + 2 * self.disc.n_markers)
        moved = np.column_stack([shift[places].reshape(-1, 2), np.zeros(self.disc.n_markers)])
        pixels = self.pixels - self.further @ shift[places.stop :]
        disc = replace(self.disc, marker_centres_body=self.disc.marker_centres_body + moved)
        return replace(self, rig=self.rig.perturbed(shift[:N_RIG]), disc=disc, pixels=pixels)

    def fitted(self, reject: bool, shift: Array | None = None) -> "tuple[DotsInFrames, PoseFits]":
        """The frames with poses fitted, after the shift if there is one; if a fit fails, the pose is kept."""
        moved = self if shift is None else self.shifted(shift)
        fits = fit_poses(moved, reject_outliers=reject, with_sensitivity=False)
        ok = fits.converged
        R = np.where(ok[:, None, None], fits.R_world_body, self.R)
        return replace(self, R=R, t=np.where(ok[:, None], fits.t_world_body, self.t)), fits

    def normal(self, shift: Array, used: Mask, free: Mask) -> tuple[Array, Array, float]:
        """Normal matrix (k, k) and gradient (k,) of the free shared parameters, with the poses eliminated; chi-square.

        used : (n, 2, m) dots that are included; free : (30 + 2m + j,)
        """
        moved = self.shifted(shift)
        arm, W = moved.disc.marker_centres_body @ np.swapaxes(self.R, 1, 2), whitening(self.covariance)
        projected, by_point, by_rig = moved.rig.project_with_jacobians(arm + self.t[:, None])
        residuals = W @ (moved.pixels - projected)[..., None]
        by_pose = W @ np.concatenate([by_point, by_turning(by_point, arm[:, None])], axis=-1)
        by_shared = np.zeros((*projected.shape, len(free)))
        by_shared[..., :N_RIG] = W @ by_rig
        # displacing a dot on the body moves its image as displacing the body does, in body axes
        by_place = by_pose[..., :3] @ self.R[:, None, None, :, :2]
        for k in range(self.disc.n_markers):
            by_shared[:, :, k, :, N_RIG + 2 * k : N_RIG + 2 * k + 2] = by_place[:, :, k]
        by_shared[..., N_RIG + 2 * self.disc.n_markers :] = W @ self.further
        rows = np.concatenate([by_pose, by_shared[..., free], residuals], axis=-1)
        rows = np.where((used & np.isfinite(rows).all(axis=(-2, -1)))[..., None, None], rows, 0.0)
        square = normal_of_rows(rows.reshape(len(rows), -1, rows.shape[-1]), 6).eliminated()
        return square[:-1, :-1], square[:-1, -1], float(square[-1, -1])


def dots_at(R: Array, t: Array, rig: StereoRig, disc: Disc) -> tuple[Array, Array]:
    """Images of a disc's dots (n, 2, m, 2), and affine maps (n, 2, m, 2, 2) [px/m] from its plane to the image."""
    pixels, J = marker_pixels(R, t, rig, disc.marker_centres_body)
    return pixels, J[..., :3] @ R[:, None, None, :, :2]  # displacing a dot moves its image as displacing the disc does


def stacked(rig: StereoRig) -> tuple[Array, Array, Array]:
    """INTRINSIC_PARAMETERS (2, 9), R_camera_world (2, 3, 3), t_camera_world (2, 3) of the cameras."""
    R, t = zip(*rig.camera_poses(), strict=True)
    return np.stack([camera.parameters for camera in rig.cameras]), np.stack(R), np.stack(t)


def whitening(covariance: Array) -> Array:
    """W (..., 2, 2) with W C W^T = 1 for covariances C (..., 2, 2); zeros if C is not a covariance."""
    a, b, c = covariance[..., 0, 0], covariance[..., 0, 1], covariance[..., 1, 1]
    with np.errstate(invalid="ignore", divide="ignore"):
        l11, l22 = np.sqrt(a), np.sqrt(c - b * b / a)
        W = np.stack([1 / l11, np.zeros_like(a), -b / (a * l22), 1 / l22], axis=-1).reshape(covariance.shape)
    good = np.isfinite(l22) & np.isfinite(W).all(axis=(-2, -1))
    return np.where(good[..., None, None], W, 0.0)


def fit_poses(seen: DotsInFrames, *, reject_outliers: bool = True, with_sensitivity: bool = True) -> PoseFits:
    """Fit the poses of n frames at once, with the poses in `seen` as initial guess.

    A frame with fewer than three dot images, or without an initial guess, is NaN. One camera alone determines a pose,
    with a larger covariance. `seen.further` is not used.
    """
    n, rig = len(seen.t), seen.rig
    there = np.asarray(np.isfinite(seen.pixels).all(-1))
    used = there & np.isfinite(seen.covariance).all((-1, -2)) & seen.posed[:, None, None]
    observed = np.where(there[..., None], seen.pixels, 0.0)
    covariance = np.ascontiguousarray(seen.covariance, float)
    R, t = np.array(seen.R, float, order="C"), np.array(seen.t, float, order="C")
    good = np.zeros(n, bool)
    shape, centres = observed.shape, np.ascontiguousarray(seen.disc.marker_centres_body, float)
    filled = pixels, whitened, JW = np.full(shape, np.nan), np.zeros(shape), np.zeros((*shape, 6))
    rows = np.flatnonzero(seen.posed)
    while rows.size:
        kernel.fit(rows, observed, covariance, used, stacked(rig), centres, TOLERANCE, R, t, good, filled)
        rows = _strike_worst_dot(whitened, JW, used, rows) if reject_outliers else rows[:0]

    JW = JW.reshape(n, -1, 6)
    good &= used.sum((1, 2)) >= MIN_DOTS
    normal = np.swapaxes(JW[good], 1, 2) @ JW[good]
    regular = np.linalg.cond(normal, 1) < 1e16
    good[good] = regular
    pose_covariance = np.full((n, 6, 6), np.nan)
    pose_covariance[good] = np.linalg.inv(normal[regular])
    sensitivity = np.full((n, 6, N_RIG), np.nan)
    W = whitening(np.where(used[..., None, None], covariance, 0.0))
    if with_sensitivity:
        d_rig = rig.project_with_jacobians(centres @ np.swapaxes(R[good], 1, 2) + t[good][:, None])[2]
        by_rig = np.swapaxes(JW[good], 1, 2) @ (W[good] @ d_rig).reshape(-1, JW.shape[1], N_RIG)
        sensitivity[good] = -pose_covariance[good] @ by_rig
    return PoseFits(
        R_world_body=np.where(good[:, None, None], R, np.nan),
        t_world_body=np.where(good[:, None], t, np.nan),
        covariance=pose_covariance,
        sensitivity=sensitivity,
        residuals_px=np.where((there & good[:, None, None])[..., None], observed - pixels, np.nan),
        used=used & good[:, None, None],
        chi_square=np.where(good, np.sum(whitened**2, axis=(1, 2, 3)), np.nan),
        degrees_of_freedom=np.where(good, 2 * used.sum((1, 2)) - 6, 0),
        converged=good,
    )


def _strike_worst_dot(residual: Array, JW: Array, used: Mask, rows: Indices) -> Indices:
    """Remove the worst outlier of each of the rows from `used`; returns the rows that must be fitted again.

    A dot is an outlier if chi-square decreases without it by more than 2 SIGMAS^2, times the reduced chi-square of the
    other dots: by chance once in 3e5 dots.

    residual (n, 2, m, 2), JW (n, 2, m, 2, 6): whitened, zeros for dots that are not used
    """
    count = used[rows].sum((1, 2))
    chi_square = np.sum(residual[rows] ** 2, axis=(1, 2, 3))
    # the decrease by one dot is at most chi-square itself: no other frame can have an outlier
    far = np.flatnonzero((chi_square > 2 * SIGMAS**2) & (count > MIN_DOTS + 1))
    if not len(far):
        return rows[far]
    rows, chi_square, count = rows[far], chi_square[far], count[far]
    residual, JW = residual[rows].reshape(len(rows), -1, 2), JW[rows].reshape(len(rows), -1, 2, 6)
    normal = np.einsum("ndij,ndik->njk", JW, JW)
    possible = np.linalg.cond(normal) < 1e16
    inverse = np.linalg.inv(np.where(possible[:, None, None], normal, np.eye(6)))
    leverage = JW @ inverse[:, None] @ np.swapaxes(JW, 2, 3)
    # decrease of chi-square without the dot: r^T (1 - leverage)^-1 r
    left_out = np.eye(2) - leverage
    left_out[np.linalg.det(left_out) < 1e-9] = 1e300 * np.eye(2)  # the pose is not determined without this dot
    drop = np.einsum("ndi,ndi->nd", residual, np.linalg.solve(left_out, residual[..., None])[..., 0])
    worst = drop.argmax(axis=1)
    largest = drop[np.arange(len(rows)), worst]
    # relative to the other dots of the frame: a small error of the rig must not remove good dots, and a pose must not
    # depend on the other frames in the call
    usual = np.maximum(1.0, (chi_square - largest) / np.maximum(2 * count - 8, 1))
    struck = possible & (largest > 2 * SIGMAS**2 * usual)
    used.reshape(len(used), -1)[rows[struck], worst[struck]] = False
    return rows[struck]
