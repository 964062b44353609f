"""Pose of the disc from the dots seen by two cameras: Levenberg-Marquardt on position and rotation.

The unknowns are a translation and a rotation vector in world axes that multiplies from the left, so that nothing is
singular at theta = 0; psi, theta, phi follow at the border (`frames.euler_from_rotation`).
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from calibration.arrays import Array, Mask
from calibration.camera import StereoRig, project_with_slopes
from disctrack import frames
from disctrack.track.least_squares import BatchFit, State, levenberg_marquardt

MIN_DOTS = 3  # six unknowns, two numbers per dot
# A dot is refused when chi-square falls without it by more than twice this, times what is usual for the other dots:
# chance alone does it once in 3e5 dots.
OUTLIER_CHI_SQUARE = 25.0
MAX_REJECTED = 4


@dataclass(frozen=True)
class PoseFits:
    """Poses of n frames with what is needed to judge them."""

    R_world_body: Array  # (n, 3, 3); NaN where there is no pose
    t_world_body: Array  # (n, 3) [m]
    covariance: Array  # (n, 6, 6) POSE_COMPONENTS, from the markers' covariances alone
    sensitivity: Array  # (n, 6, 30) d pose / d RIG_PARAMETERS with the markers held fixed
    residuals_px: Array  # (n, 2, m, 2) observed - projected, also of rejected dots; NaN where a dot was not seen
    used: Mask  # (n, 2, m)
    chi_square: Array  # (n,)
    degrees_of_freedom: NDArray[np.int64]  # (n,)
    converged: Mask  # (n,)

    @property
    def reduced_chi_square(self) -> Array:
        """(n,) chi-square per degree of freedom; NaN where nothing is left over."""
        return np.where(self.degrees_of_freedom > 0, self.chi_square / np.maximum(self.degrees_of_freedom, 1), np.nan)


def marker_pixels(R: Array, t: Array, rig: StereoRig, centres_body: Array) -> tuple[Array, Array]:
    """Images of the dots' centres (n, 2, m, 2) and their derivative (n, 2, m, 2, 6) by POSE_COMPONENTS.

    R (n, 3, 3), t (n, 3): body -> world; centres_body (m, 3).
    """
    arm = centres_body @ np.swapaxes(R, 1, 2)  # (n, m, 3)
    pixels, jacobians = [], []
    for camera, (R_cw, t_cw) in zip(rig.cameras, rig.camera_poses(), strict=True):
        view, d_camera = project_with_slopes((arm + t[:, None]) @ R_cw.T + t_cw, camera)
        d_world = d_camera @ R_cw
        jacobians.append(np.concatenate([d_world, np.cross(arm[..., None, :], d_world)], axis=-1))
        pixels.append(view)
    return np.stack(pixels, axis=1), np.stack(jacobians, axis=1)


def whitening(covariance: Array) -> Array:
    """W (..., 2, 2) with W C W^T = 1 for covariances C (..., 2, 2); zeros where C is not a covariance."""
    a, b, c = covariance[..., 0, 0], covariance[..., 0, 1], covariance[..., 1, 1]
    W = np.zeros_like(covariance)
    with np.errstate(invalid="ignore", divide="ignore"):
        remaining = c - b * b / a
        good = (a > 0) & (remaining > 0) & np.isfinite(remaining)
        l11, l22 = np.sqrt(a), np.sqrt(remaining)
        W[..., 0, 0] = np.where(good, 1 / l11, 0.0)
        W[..., 1, 0] = np.where(good, -b / (a * l22), 0.0)
        W[..., 1, 1] = np.where(good, 1 / l22, 0.0)
    return W


def fit_poses(
    markers_px: Array,
    markers_covariance_px2: Array,
    rig: StereoRig,
    centres_body: Array,
    R_start: Array,
    t_start: Array,
    *,
    reject_outliers: bool = True,
    with_sensitivity: bool = True,
) -> PoseFits:
    """Fit the poses of n frames at once.

    markers_px (n, 2, m, 2), NaN where a dot was not seen; markers_covariance_px2 (n, 2, m, 2, 2); centres_body (m, 3)
    [m]; R_start (n, 3, 3), t_start (n, 3) a pose within a few pixels. A frame with fewer than three dot images, or
    without a start, is NaN. One camera alone is enough for a pose; its covariance tells how much worse it is.
    """
    n = len(markers_px)
    seen = np.asarray(np.isfinite(markers_px).all(-1))
    seen &= np.isfinite(markers_covariance_px2).all((-1, -2))
    possible = np.asarray(np.isfinite(R_start).all((1, 2)))
    possible &= np.isfinite(t_start).all(1)
    used = seen & possible[:, None, None]
    W = whitening(np.where(seen[..., None, None], markers_covariance_px2, np.eye(2)))
    observed = np.where(seen[..., None], markers_px, 0.0)
    R = np.where(possible[:, None, None], R_start, _safe_rotation(R_start, possible))
    t = np.where(possible[:, None], t_start, _safe_translation(t_start, possible))
    if not possible.any():
        return _empty(n, markers_px.shape[2], seen)

    rows = np.arange(n)
    converged = np.zeros(n, bool)
    for _ in range(MAX_REJECTED + 1):
        fit = _minimise(observed[rows], W[rows], used[rows], rig, centres_body, R[rows], t[rows])
        R[rows], t[rows] = fit.state
        converged[rows] = fit.converged
        if not reject_outliers:
            break
        worst = _worst_dot(observed, W, used, rig, centres_body, R, t, rows)
        rows = worst
        if rows.size == 0:
            break

    pixels, J = marker_pixels(R, t, rig, centres_body)
    enough = used.sum((1, 2)) >= MIN_DOTS
    JW = np.where(used[..., None, None], W @ J, 0.0).reshape(n, -1, 6)
    normal = np.swapaxes(JW, 1, 2) @ JW
    good = enough & converged & (np.linalg.cond(np.where(enough[:, None, None], normal, np.eye(6))) < 1e16)
    covariance = np.full((n, 6, 6), np.nan)
    covariance[good] = np.linalg.inv(normal[good])
    residuals = np.where(seen[..., None], observed - pixels, np.nan)
    whitened = np.where(used[..., None], (W @ (observed - pixels)[..., None])[..., 0], 0.0)
    sensitivity = np.full((n, 6, 30), np.nan)
    if with_sensitivity and good.any():
        for block in np.array_split(np.flatnonzero(good), max(1, good.sum() // 512)):
            _, _, d_rig = rig.project_with_jacobians(centres_body @ np.swapaxes(R[block], 1, 2) + t[block][:, None])
            DW = np.where(used[block][..., None, None], W[block] @ d_rig, 0.0).reshape(len(block), -1, 30)
            sensitivity[block] = -covariance[block] @ (np.swapaxes(JW[block], 1, 2) @ DW)
    return PoseFits(
        R_world_body=np.where(good[:, None, None], R, np.nan),
        t_world_body=np.where(good[:, None], t, np.nan),
        covariance=covariance,
        sensitivity=sensitivity,
        residuals_px=np.where(good[:, None, None, None], residuals, np.nan),
        used=used & good[:, None, None],
        chi_square=np.where(good, np.sum(whitened**2, axis=(1, 2, 3)), np.nan),
        degrees_of_freedom=np.where(good, 2 * used.sum((1, 2)) - 6, 0),
        converged=good,
    )


def _minimise(observed: Array, W: Array, used: Mask, rig: StereoRig, centres: Array, R: Array, t: Array) -> BatchFit:
    n = len(observed)

    def evaluate(state: State) -> tuple[Array, Array]:
        pixels, J = marker_pixels(state[0], state[1], rig, centres)
        residual = np.where(used[..., None], (W @ (observed - pixels)[..., None])[..., 0], 0.0)
        jacobian = np.where(used[..., None, None], W @ J, 0.0)
        return residual.reshape(n, -1), jacobian.reshape(n, -1, 6)

    def retract(state: State, step: Array) -> State:
        return frames.rotation_from_vector(step[:, 3:]) @ state[0], state[1] + step[:, :3]

    return levenberg_marquardt(evaluate, retract, (R, t))


def _worst_dot(
    observed: Array,
    W: Array,
    used: Mask,
    rig: StereoRig,
    centres: Array,
    R: Array,
    t: Array,
    rows: NDArray[np.intp],
) -> NDArray[np.intp]:
    """Strike the worst outlier of each of the rows from `used`; returns the rows that must be fitted again."""
    pixels, J = marker_pixels(R[rows], t[rows], rig, centres)
    count = used[rows].sum((1, 2))
    residual = np.where(used[rows][..., None], (W[rows] @ (observed[rows] - pixels)[..., None])[..., 0], 0.0)
    chi_square = np.sum(residual**2, axis=(1, 2, 3))
    # a dot's part is at most the whole: of other frames none can be an outlier
    far = np.flatnonzero((chi_square > 2 * OUTLIER_CHI_SQUARE) & (count > MIN_DOTS + 1))
    if not len(far):
        return rows[far]
    rows, chi_square, count = rows[far], chi_square[far], count[far]
    residual = residual[far].reshape(len(far), -1, 2)
    JW = np.where(used[rows][..., None, None], W[rows] @ J[far], 0.0).reshape(len(rows), -1, 2, 6)
    normal = np.einsum("ndij,ndik->njk", JW, JW)
    possible = np.linalg.cond(normal) < 1e16
    inverse = np.linalg.inv(np.where(possible[:, None, None], normal, np.eye(6)))
    leverage = JW @ inverse[:, None] @ np.swapaxes(JW, 2, 3)
    # by what chi-square falls without the dot: its residual, freed of its own pull on the pose (two numbers)
    left_out = np.eye(2) - leverage
    left_out[np.linalg.det(left_out) < 1e-9] = 1e300 * np.eye(2)  # nothing but this dot fixes the pose there
    drop = np.einsum("ndi,ndi->nd", residual, np.linalg.solve(left_out, residual[..., None])[..., 0])
    worst = drop.argmax(axis=1)
    largest = drop[np.arange(len(rows)), worst]
    # what is usual for the frame's other dots: a rig that is off by a little must not strike good ones, and no pose may
    # depend on which other frames are in the run
    usual = np.maximum(1.0, (chi_square - largest) / np.maximum(2 * count - 8, 1))
    struck = possible & (largest > 2 * OUTLIER_CHI_SQUARE * usual)
    used.reshape(len(used), -1)[rows[struck], worst[struck]] = False
    return rows[struck]


def _safe_rotation(R: Array, possible: Mask) -> Array:
    return R[np.argmax(possible)] if possible.any() else np.eye(3)


def _safe_translation(t: Array, possible: Mask) -> Array:
    return t[np.argmax(possible)] if possible.any() else np.zeros(3)


def _empty(n: int, m: int, seen: Mask) -> PoseFits:
    nan = np.nan
    return PoseFits(
        np.full((n, 3, 3), nan),
        np.full((n, 3), nan),
        np.full((n, 6, 6), nan),
        np.full((n, 6, 30), nan),
        np.full((n, 2, m, 2), nan),
        np.zeros_like(seen),
        np.full(n, nan),
        np.zeros(n, np.int64),
        np.zeros(n, bool),
    )
