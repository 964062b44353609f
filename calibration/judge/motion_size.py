"""How far boards may have moved between the two exposures of a pair where no motion is refined, and what that does.

Motions that no pair shows for itself are seen in all of them together: their variances are those of restricted maximum
likelihood (Patterson and Thompson 1971), to first order about a minimum with one place of the board for both images,
everything else free to follow. The estimate stays: where a few views tell, it is the steadier one, and by pairs that
were synchronised the better one. Its covariance contains them, as that of any estimate whose weights are not those of
the errors. What lies in one image as a whole for another reason, errors that neighbouring corners share or a
lens beyond its polynomial, is in it likewise.
"""

from dataclasses import dataclass, replace

import numpy as np
import scipy
from numpy.typing import NDArray

from calibration.fit.board_motion import BoardMotion, motions, split
from calibration.fit.refinement import Refinement
from calibration.fit.stereo_model import predict
from calibration.kit.arrays import Array
from calibration.kit.least_squares import Normal

FREE = BoardMotion(1e3, 1e3)  # as good as nothing known beforehand
NONE = 1e-7  # [rad], and of the board's distance: less than any view tells
ROUGH = 0.02  # in the sizes' logarithms, and in the logarithm of the likelihood
START = ((1e-4, 1e-4), (1e-3, 1e-4), (1e-5, 1e-5))  # [rad], and of the distance


@dataclass(frozen=True)
class LikelyMotion:
    """What all pairs together say of the boards' motions."""

    size: BoardMotion
    pixels: float  # [px] rms displacement of a corner in the right image by such a motion
    gradients: Array  # (n_views, s, s) covariance of what it adds to each view's gradient by the shared parameters


def likely_motion(refinement: Refinement) -> LikelyMotion | None:
    """The most likely size of the motions; None where fewer than three pairs could tell it.

    refinement : at its minimum, with one place of the board for both images of a pair
    """
    o, problem = refinement.problem.observations, refinement.problem
    n = problem.n_views
    seen = [np.bincount(o.view[o.camera == c], minlength=n) >= 4 for c in (0, 1)]
    pairs = np.flatnonzero(seen[0] & seen[1])
    if len(pairs) < 3:
        return None
    model = split(refinement.model)
    normal = replace(problem, motion=FREE).linearise(model)
    # noise: what scatters within an image, about a pose of its own
    pull, own = normal.own_gradient, normal.own_held()
    left = float(normal.costs.sum() - np.sum(pull * np.linalg.solve(own, pull[..., None])[..., 0]))
    noise = max(left, 1e-12) / max(2 * len(o) - 6 * len(np.unique(2 * o.view + o.camera)), 1)
    s = problem.stereo_basis.shape[1]  # the board's shape is held: it is known far better than such motions move it
    of_cameras = replace(
        normal,
        shared=normal.shared[:s, :s] / noise,
        cross=normal.cross[:, :s] / noise,
        own=own / noise,
        gradient=normal.gradient[:, :s] / noise,
        own_gradient=pull / noise,
        prior=normal.prior[:s, :s] / noise,
        prior_gradient=normal.prior_gradient[:s] / noise,
    )
    by_poses = motions(model)[1]
    distance = float(np.median(np.linalg.norm(model.t_left_board[pairs], axis=1)))

    def weights(sizes: Array) -> Array:
        turn, part = np.exp(np.clip(sizes, np.log(NONE), 0.0))
        return BoardMotion(float(turn), float(part) * distance).weights

    def unlikely(sizes: Array) -> float:
        return _minus_twice_log_likelihood(of_cameras, by_poses[pairs], pairs, weights(sizes))

    # an attribute of `scipy` is imported when it is asked for: a measurement with a rig does not wait for it
    search = {"method": "Nelder-Mead", "options": {"xatol": ROUGH, "fatol": ROUGH}}
    tried = [scipy.optimize.minimize(unlikely, np.log(start), **search) for start in START]
    w = weights(min(tried, key=lambda one: float(one.fun)).x)
    right = own[:, 6:, 6:]
    both = own[:, :6, :6] + right
    cross = normal.cross[:, :, :6] + normal.cross[:, :, 6:]
    to_gradient = normal.cross[:, :, 6:] - cross @ np.linalg.solve(both, right)
    to_step = np.linalg.inv(by_poses[:, :, 6:]) / np.sqrt(w)
    into = to_gradient @ to_step
    into[~(seen[0] & seen[1])] = 0.0
    use = (o.camera == 1) & np.isin(o.view, pairs)
    moved = predict(refinement.model, o[use])[2] @ to_step[o.view[use]]
    return LikelyMotion(
        BoardMotion(float(w[0] ** -0.5), float(w[3] ** -0.5)),
        float(np.sqrt(np.mean(np.sum(moved**2, axis=(1, 2))))),
        into @ np.swapaxes(into, 1, 2),
    )


def _minus_twice_log_likelihood(normal: Normal, by_poses: Array, pairs: NDArray[np.intp], weights: Array) -> float:
    """Of motions with these inverse variances (6,), all else marginalised; a constant is left out.

    normal : with 12 numbers for the places of a board, whose two halves nothing holds together yet
    """
    own = normal.own.copy()
    own[pairs] += np.swapaxes(by_poses, 1, 2) * weights @ by_poses
    moving = replace(normal, own=own)
    information = moving.eliminated()[0]
    if np.diag(information).min() <= 0.0:  # motions so large that nothing is left of how the cameras stand
        return np.inf
    scale = 1.0 / np.sqrt(np.diag(information))
    information = information * scale[:, None] * scale
    sign, volume = np.linalg.slogdet(information)
    if sign <= 0.0:
        return np.inf
    gained = moving.gain(*moving.step())
    volume += float(np.linalg.slogdet(own)[1].sum() - 2 * np.log(scale).sum())
    return float(volume) - gained - len(pairs) * float(np.log(weights).sum())
