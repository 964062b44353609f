"""Whether the two images of a pair show the board in one place: views that fit after all, boards that moved between."""

from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass, field, replace

import numpy as np

from calibration.fit.board_motion import BoardMotion
from calibration.fit.model_choice import fit_poses
from calibration.fit.normal_equations import inverse_covariance
from calibration.fit.refinement import Refinement
from calibration.fit.stereo_model import Observations, StereoModel, predict, predict_pixels
from calibration.judge.motion_size import likely_motion
from calibration.kit.arrays import Array

MOVED = 2.0  # times what corners' scatter makes of a board at rest, and times that scatter, that motion is named
MIN_POINTS = 8  # of an image, to tell the board's pose by itself
LEAST_PAIRS = 6  # fewer cannot judge one another: one tells how the cameras stand, and a median is of the others
# Times the usual misfit. Of Gaussian motions (F of 6 and 24 degrees of freedom) one in 10^9 is as far; the motions of
# hand-held boards have longer tails.
TOO_FAR = 5.0
Pose = tuple[Array, Array]  # rotation (3, 3) and translation (3,) of the board in the left camera's axes


def own_places(
    observations: Observations, model: StereoModel, apart: Sequence[int], right_poses: Mapping[int, Pose]
) -> tuple[Observations, StereoModel]:
    """Give the right images of some pairs a place of the board of their own, behind those of the views, in order.

    model : poses of the board for every view; right_poses : (R, t) in the left camera's axes by the right image alone
    """
    n, place = len(model.R_left_board), observations.view.copy()
    for k, view in enumerate(apart):
        place[(observations.view == view) & (observations.camera == 1)] = n + k
    if not apart:
        return observations, model
    R, t = zip(*(right_poses[view] for view in apart), strict=True)
    model = replace(
        model,
        R_left_board=np.concatenate([model.R_left_board, np.stack(R)]),
        t_left_board=np.concatenate([model.t_left_board, np.stack(t)]),
    )
    return replace(observations, view=place), model


@dataclass(frozen=True)
class PairsJudged:
    """Which pairs show the board in one place, as cameras that were refined see it."""

    model: StereoModel  # its poses those of the views: of both images together, or of the left one of a pair apart
    right_poses: dict[int, Pose]  # of the right image alone, in the left camera's axes, for pairs
    apart: dict[int, str]  # view -> why its two images are not taken for one place
    bad_images: dict[tuple[int, int], str]  # (view, camera) -> why it cannot be used even alone
    left_poses: dict[int, Pose] = field(default_factory=dict)  # of the left image alone, for pairs, once judged


def judge_pairs(
    observations: Observations, fit: Refinement, apart: Sequence[int], elsewhere: Collection[int] = ()
) -> PairsJudged:
    """Compare the poses of both images together with those of each image alone.

    A common pose has six parameters less. What chi-square it costs, with everything that all views share refined again,
    tells how far the board moved: some of it in every pair, as boards bend and lenses are not as modelled. A pair is
    apart where it costs TOO_FAR (in amplitude) more than the median pair; so never more than half of them are. The
    median of fewer than LEAST_PAIRS tells nothing, and none of so few is set apart, nor one that alone tells how the
    cameras stand.

    observations : with the views' numbers; fit : of the same, the pairs `apart` with places of their own
    elsewhere : views at which the cameras stood otherwise to each other: no measure of what is usual
    """
    observations = observations[np.argsort(observations.view, kind="stable")]
    model, n = fit.model, len(fit.model.R_left_board) - len(apart)
    sigma = max(fit.unexplained_sigma, 1e-3)
    places = {view: n + k for k, view in enumerate(apart)}
    both = [
        int(v)
        for v in np.unique(observations.view)
        if min(np.sum((observations.view == v) & (observations.camera == c)) for c in (0, 1)) >= MIN_POINTS
    ]
    begun = {v: (model.R_left_board[places.get(v, v)], model.t_left_board[places.get(v, v)]) for v in both}
    views = replace(model, R_left_board=model.R_left_board[:n], t_left_board=model.t_left_board[:n], boards_right=None)
    behind = np.unique(observations.view[~np.isfinite(predict_pixels(views, observations)).all(axis=1)])
    in_sight = observations[~np.isin(observations.view, behind)]
    together = fit_poses(in_sight, views, sigma)
    seen_alone, alone = own_places(observations, views, both, begun)
    seen_alone = seen_alone[np.argsort(seen_alone.view, kind="stable")]
    alone = fit_poses(seen_alone, alone, sigma)
    square, count = _misfit(seen_alone, alone, n + len(both))
    image_rms = np.sqrt(square / np.maximum(count, 1))
    typical = float(np.median(image_rms[count > 0]))
    bad: dict[tuple[int, int], str] = {}
    if np.sum(count > 0) >= LEAST_PAIRS:
        for place in np.flatnonzero(image_rms > TOO_FAR * typical):
            v = int(place) if place < n else both[place - n]
            camera = 1 if place >= n or not np.any((observations.view == v) & (observations.camera == 0)) else 0
            bad[v, camera] = f"RMS {image_rms[place]:.3f} px by itself, the median image has {typical:.3f} px"
    found = {}
    if len(both) >= LEAST_PAIRS:
        cost = _cost_of_one_place(fit, (in_sight, together), (seen_alone, alone), both, places)
        square_together, _ = _misfit(observations, together, n)
        usual = cost[[v not in elsewhere for v in both]]
        for k in np.flatnonzero(cost > TOO_FAR**2 * max(float(np.median(usual)), 6.0)):
            misfit = np.sqrt(square_together[both[k]] / (count[both[k]] + count[n + k]))
            found[both[k]] = f"{misfit:.2g} px if they did, where the median image has {typical:.2g} px"
    found |= {v: "behind a camera if they did" for v in both if v in behind}
    right = {v: (alone.R_left_board[n + k], alone.t_left_board[n + k]) for k, v in enumerate(both)}
    left = {v: (alone.R_left_board[v], alone.t_left_board[v]) for v in both}
    R, t = together.R_left_board.copy(), together.t_left_board.copy()
    for v in found:
        R[v], t[v] = left[v]
    return PairsJudged(replace(together, R_left_board=R, t_left_board=t), right, found, bad, left)


def _cost_of_one_place(
    fit: Refinement,
    together: tuple[Observations, StereoModel],
    alone: tuple[Observations, StereoModel],
    both: Sequence[int],
    apart: Mapping[int, int],
) -> Array:
    """Chi-square that one place of the board for both images costs, for each of the pairs `both`; others as they are.

    To first order about the fit, whose shared parameters follow; 0 where the other views leave them open.
    """
    parts = []
    for observations, model in (together, alone):
        problem = replace(
            fit.problem,
            observations=observations,
            weights=inverse_covariance(observations.covariance, max(fit.unexplained_sigma, 1e-3) ** 2),
            n_views=len(model.R_left_board),
            huber=3.0,
            motion=None,
        )
        normal = problem.linearise(model)
        H, g = normal.told_by_each()
        lost = ~(np.isfinite(H).all(axis=(1, 2)) & np.isfinite(g).all(axis=1))  # a pose behind a camera
        H[lost], g[lost] = 0.0, 0.0
        parts.append((H, g, np.nan_to_num(normal.costs, posinf=1e12), normal))
    (H_one, g_one, chi2_one, normal), (H_two, g_two, chi2_two, _) = parts
    n = len(together[1].R_left_board)
    pairs = np.array(both)
    tied, own = (
        (H_one[pairs], g_one[pairs]),
        (H_two[pairs] + H_two[n:][: len(pairs)], g_two[pairs] + g_two[n:][: len(pairs)]),
    )
    is_apart = np.array([v in apart for v in both])
    now = [np.where(is_apart.reshape(-1, *[1] * (one.ndim - 1)), two, one) for one, two in zip(tied, own, strict=True)]
    rest = np.setdiff1d(np.arange(len(H_one)), pairs)  # views of one camera
    H_rest, g_rest = normal.prior + H_one[rest].sum(0), normal.prior_gradient + g_one[rest].sum(0)
    scale = 1.0 / np.sqrt(np.maximum(np.diag(now[0].sum(0) + H_rest), 1e-300))
    cost = np.zeros(len(both))
    for k, v in enumerate(both):
        others = np.delete(np.arange(len(both)), k)
        H, g = now[0][others].sum(0) + H_rest, now[1][others].sum(0) + g_rest
        gains = []
        for H_pair, g_pair in ((tied[0][k], tied[1][k]), (own[0][k], own[1][k])):
            matrix, gradient = (H + H_pair) * scale[:, None] * scale, (g + g_pair) * scale
            if not (np.isfinite(matrix).all() and np.linalg.eigvalsh(matrix)[0] > 1e-15):
                break
            gains.append(float(gradient @ np.linalg.solve(matrix, gradient)))
        if len(gains) == 2:
            cost[k] = max(chi2_one[v] - chi2_two[v] - chi2_two[n + k] - gains[0] + gains[1], 0.0)
    return cost


def _misfit(observations: Observations, model: StereoModel, n: int) -> tuple[Array, Array]:
    """Sum of squared distances [px^2] and number of points, per place (n,)."""
    residuals = observations.pixels - predict_pixels(model, observations)
    square = np.nan_to_num(np.sum(residuals**2, axis=-1), nan=1e12)
    squares, counts = (np.bincount(observations.view, what, minlength=n) for what in (square, np.ones_like(square)))
    return np.asarray(squares, np.float64), np.asarray(counts, np.float64)


@dataclass(frozen=True)
class PairMotion:
    """How far the board moved between the two exposures of a pair: root median square over the pairs."""

    distance: float  # [m]
    pixels: float  # [px] in the right image
    scatter: float  # [px] of the corners within an image, about a pose of its own
    at_rest: float  # [px] what this scatter alone would give for `pixels`
    likely: float  # [px] the same by all pairs together: cameras that few views leave open have taken up a part of it

    @property
    def is_seen(self) -> bool:
        """True if the usual pair is far beyond what corners that scatter so would show of a board at rest."""
        return self.pixels > self._enough

    @property
    def is_likely(self) -> bool:
        """True if it is by all pairs together, where the usual one shows more than nothing: few pairs hide it."""
        return self.is_seen or (self.likely > self._enough and self.pixels > self.at_rest)

    def as_random(self, points: Array) -> BoardMotion:
        """As a random motion of boards with these points (n, 3) [m], roughly: what is begun with."""
        reach = float(np.sqrt(np.mean(np.sum((points - points.mean(0)) ** 2, axis=1))))
        return BoardMotion(self.distance / reach, self.distance)

    @property
    def _enough(self) -> float:
        return MOVED * max(self.scatter, self.at_rest)


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
    likely = likely_motion(refinement)
    if likely is None:
        return None
    return PairMotion(float(np.median(distances)), float(np.median(shifts)), scatter, at_rest, likely.pixels)
