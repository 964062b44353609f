"""Whether the two images of a pair show the board in one place: views that fit after all, boards that moved between."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from calibration.arrays import Array, Mask
from calibration.errors import CalibrationError
from calibration.model_choice import fit_poses
from calibration.refinement import Refinement, refine_stereo
from calibration.stereo_model import Observations, StereoModel, Terms, predict, predict_pixels

MOVED = 2.0  # times what corners' scatter makes of a board at rest, and times that scatter, that motion is named
ROUGH = Terms("k1 k2", "flat")


def view_rms(observations: Observations, model: StereoModel) -> Array:
    """Root mean square misfit of each view (n_views,) [px]; NaN where nothing was seen."""
    residuals = observations.pixels - predict_pixels(model, observations)
    square = np.nan_to_num(np.sum(residuals**2, axis=-1), nan=np.inf)
    n = len(model.R_left_board)
    count = np.bincount(observations.view, minlength=n)
    with np.errstate(invalid="ignore"):
        rms: Array = np.sqrt(np.bincount(observations.view, square, minlength=n) / np.where(count, count, np.nan))
    return rms


def readmitted(
    observations: Observations, start: StereoModel, nominal: Array, agrees: Mask, ratio: float
) -> tuple[StereoModel, Mask]:
    """Start model and views (n_views,) that fit it within `ratio` times the median of those that agreed at first.

    The pose of a board in one camera alone, from rough intrinsics, may be degrees off; both cameras together tell.
    """
    if agrees.all() or agrees.sum() < 3:
        return start, agrees
    try:
        fit = refine_stereo(observations[agrees[observations.view]], start, nominal, ROUGH)
        model = fit_poses(observations, fit.model, max(fit.unexplained_sigma, 1e-3))
    except CalibrationError:
        return start, agrees
    rms = view_rms(observations, model)
    with np.errstate(invalid="ignore"):
        return model, agrees | (rms < ratio * np.nanmedian(rms[agrees]))


@dataclass(frozen=True)
class PairMotion:
    """How far the board moved between the two exposures of a pair: root median square over the pairs."""

    distance: float  # [m]
    pixels: float  # [px] in the right image
    scatter: float  # [px] of the corners within an image, about a pose of its own
    at_rest: float  # [px] what this scatter alone would give for `pixels`

    @property
    def is_seen(self) -> bool:
        """True if it is far beyond what corners that scatter so would show of a board at rest."""
        return self.pixels > MOVED * max(self.scatter, self.at_rest)


def motion_between_exposures(refinement: Refinement) -> PairMotion | None:
    """What the two images of each pair, each with a pose of its own, say of the board's motion between them.

    To first order at the common minimum; None with fewer than three pairs.
    """
    o, weights = refinement.problem.observations, refinement.problem.weights
    model = refinement.model
    pixels, _, d_pose, _ = predict(model, o)
    residuals = o.pixels - pixels
    distances, shifts, noise, rest, whitened, freedom = [], [], [], 0.0, 0.0, 0
    for v in np.unique(o.view):
        own = []
        for camera in (0, 1):
            use = (o.view == v) & (o.camera == camera)
            J, r, W = d_pose[use], residuals[use], weights[use]
            if len(r) < 8:
                break
            WJ = W @ J
            H, g = np.einsum("mij,mik->jk", J, WJ), np.einsum("mij,mi->j", WJ, r)
            step = np.linalg.solve(H, g)
            left_over = r - J @ step
            rest, freedom = rest + float(np.sum(left_over**2)), freedom + 2 * len(r) - 6
            whitened += float(np.einsum("mi,mij,mj->", left_over, W, left_over))
            own.append((step, J, np.linalg.inv(H)))
        if len(own) == 2:
            step, J = own[1][0] - own[0][0], own[1][1]
            middle = model.R_left_board[v] @ model.points.mean(0)
            distances.append(float(np.linalg.norm(step[3:] + np.cross(step[:3], middle))))
            shifts.append(float(np.sqrt(np.mean(np.sum((J @ step) ** 2, axis=-1)))))
            noise.append(float(np.einsum("mij,jk,mik->", J, own[0][2] + own[1][2], J) / len(J)))
    if len(shifts) < 3:
        return None
    freedom = max(freedom, 1)
    at_rest = float(np.sqrt(np.median(noise) * whitened / freedom))
    scatter = float(np.sqrt(2 * rest / freedom))
    return PairMotion(float(np.median(distances)), float(np.median(shifts)), scatter, at_rest)
