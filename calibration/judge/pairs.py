"""Relative pose of the cameras and motion of the board from each pair of images, with separate poses of the board.

Pairs that disagree with the others are found from one matrix, the distances (`pairing.apart`) between the relative
poses of any two pairs. A pair far from most others is no pair; a camera that was moved between views makes a step in
the sequence of views, everything else makes scatter. Distances are in pixels, weighted by the covariance of each pair:
poorly determined directions (a shift along the axis) have little weight.

All boards may have moved at random between the two exposures. To first order, the motion of a pair's board (a rotation,
and a shift of its middle) is m - W s with covariance C from the corners, where s is a step of the shared parameters. If
m ~ N(0, S), the sizes in S are estimated by restricted maximum likelihood (Patterson and Thompson 1971). The estimate
with m = 0 is kept if single pairs show no significant motion: it is more stable with few views, and better for
synchronised pairs. Its covariance contains S, as its weights are not those of the errors. S also contains other errors
common to an image, such as correlated errors of neighbouring corners, or distortion beyond the polynomial.
"""

from dataclasses import dataclass, replace

import numpy as np

from calibration.board.target import LEAST_POINTS
from calibration.cameras.camera import CAMERA_NAMES, vector_from_rotation
from calibration.fit.board_motion import LEAST, BoardMotion, motions
from calibration.fit.pairing import MIN_VIEWS, NEARER, TOO_FAR, TWICE, Names, Pairs, apart, poses_of, relative_poses
from calibration.fit.refinement import Refinement, fit_poses
from calibration.fit.start import CLEARLY, start_camera
from calibration.fit.stereo_model import N_STEREO, Observations, predict, predict_pixels
from calibration.kit.least_squares import scaled_solve
from calibration.kit.types import Array


@dataclass(frozen=True)
class PairMotion:
    """Motion of the board between the two exposures of a pair: root median square over the pairs."""

    distance: float  # [m]
    pixels: float  # [px] in the right image
    scatter: float  # [px] of the corners of an image about its own pose
    at_rest: float  # [px] value of `pixels` expected from this scatter alone
    likely: float  # [px] rms of `size`; with few views, part of the motion in `pixels` is absorbed by the cameras
    size: BoardMotion  # most likely size given all pairs

    @property
    def is_seen(self) -> bool:
        """True if the median pair moves significantly more than the scatter of corners explains."""
        return self.pixels > self._enough

    @property
    def is_likely(self) -> bool:
        """True if the median pair, or all pairs together, move significantly; few pairs may hide it in the median."""
        return self.is_seen or (self.likely > self._enough and self.pixels > self.at_rest)

    def as_random(self, points: Array) -> BoardMotion:
        """Initial guess of the random motion of boards with these points (n, 3) [m]."""
        reach = float(np.sqrt(np.mean(np.sum((points - points.mean(0)) ** 2, axis=1))))
        return BoardMotion(self.distance / reach, self.distance)

    @property
    def _enough(self) -> float:
        return TWICE * max(self.scatter, self.at_rest)


def motion_between_exposures(refinement: Refinement) -> tuple[PairMotion | None, Array | None]:
    """Motion of the board between the exposures of the pairs; (None, None) with fewer than three pairs.

    From the pairs with enough points in both images, linearised at the minimum.
    returns also : (n_views, s, s) covariance that motions of the likely size add to each view's gradient with respect
        to the shared parameters
    """
    problem, model = refinement.problem, refinement.model
    o, n_views = problem.observations, problem.n_views
    seen = [np.bincount(o.view[o.camera == c], minlength=n_views) for c in (0, 1)]
    pairs = np.flatnonzero((np.minimum(*seen) >= LEAST_POINTS) & ~problem.apart)
    if len(pairs) < MIN_VIEWS:
        return None, None
    free = replace(problem, motion=None, apart=np.ones_like(problem.apart))
    normal = free.linearise(model)
    carried = normal.carried()
    m, J = (of[pairs] for of in motions(model))
    rows = J @ carried[pairs]  # (n, 6, s + 1) [W | m]
    rows[..., -1] += m
    m, W = rows[..., -1], rows[..., :-1]
    C = J @ np.linalg.solve(normal.own_held()[pairs], np.swapaxes(J, 1, 2))
    freedom = max(2 * len(o) - 6 * len(np.unique(2 * o.view + o.camera)), 1)
    square, s = normal.eliminated(carried=carried), W.shape[-1]
    noise = max(float(normal.costs.sum()) - normal.gain(np.zeros(s), carried[..., -1]), 1e-12) / freedom
    about = free.stepped(model, np.zeros(s), carried[..., -1])
    right = o[o.camera == 1]
    d_pose, squares = predict(about, right)[2], np.zeros((n_views, 6, 6))
    np.add.at(squares, right.view, np.swapaxes(d_pose, 1, 2) @ d_pose)
    back = np.linalg.inv(J[:, :, 6:])
    # m^T square_px m is the mean square displacement [px^2] in the right image by a motion m
    square_px = np.swapaxes(back, 1, 2) @ (squares[pairs] / seen[1][pairs, None, None]) @ back
    taken = np.r_[:N_STEREO, s]  # with fixed board shape, whose uncertainty is small
    distance = float(np.median(np.linalg.norm(model.t_left_board[pairs, 0], axis=1)))
    size = _likely_size(rows[..., taken], noise * C, square[np.ix_(taken, taken)] / noise, distance)
    gradients, known = np.zeros((n_views, s, s)), np.linalg.solve(C, W)
    gradients[pairs] = np.swapaxes(known, 1, 2) @ (known / size.weights[:, None])
    found = PairMotion(
        distance=float(np.median(np.linalg.norm(m[:, 3:], axis=1))),
        pixels=float(np.median(np.sqrt(np.einsum("ni,nij,nj->n", m, square_px, m)))),
        scatter=float(np.sqrt(2 * np.sum((o.pixels - predict_pixels(about, o)) ** 2) / freedom)),
        at_rest=float(np.sqrt(np.median(np.einsum("nij,nji->n", square_px, C)) * noise)),
        likely=float(np.sqrt(np.mean(np.einsum("nii,i->n", square_px, 1.0 / size.weights)))),
        size=size,
    )
    return found, gradients


def _likely_size(rows: Array, C: Array, alone: Array, distance: float) -> BoardMotion:
    """The most likely size of random motions, linearised at a minimum with one pose of the board for both images.

    With P the inverse covariance of the motions with all shared parameters free, a variance is the most likely one if
    the sum of its squares of P m is its part of the trace of P. The fixed point multiplies it by their ratio.

    rows : (n, 6, s + 1) [W | m]; alone : (s + 1, s + 1) products of [shared | residual] of all images, and the prior
    """
    least = np.square([LEAST, LEAST * distance])
    variances = 1e6 * least
    for _ in range(100):  # a variance that tends to zero decreases slowly
        known = np.linalg.inv(C + np.diag(np.repeat(variances, 3)))
        into = np.swapaxes(known @ rows, 1, 2)
        square = alone + (into @ rows).sum(0)
        inverse = scaled_solve(square[:-1, :-1], np.eye(len(square) - 1))
        P = known - np.swapaxes(into[:, :-1], 1, 2) @ inverse @ into[:, :-1]
        Pm = np.append(-inverse @ square[:-1, -1], 1.0) @ into
        squares, traces = (np.sum(of.reshape(-1, 2, 3), axis=(0, 2)) for of in (Pm**2, np.einsum("nii->ni", P)))
        variances = np.maximum(variances * squares / traces, least)
    return BoardMotion(*np.sqrt(variances).tolist())


def judge_pairs(observations: Observations, fit: Refinement, table_view: int | None) -> Pairs:
    """Images that do not fit even alone, and a comparison of the other pairs (`compared`) with the fitted cameras.

    observations : with the views' numbers; fit : of the same, possibly with pairs apart
    """
    o, sigma = observations[np.argsort(observations.view, kind="stable")], max(fit.unexplained_sigma, 1e-3)
    problem = replace(fit.problem.seeing(o, sigma**2), motion=None, apart=np.ones_like(fit.problem.apart))
    alone = fit_poses(problem, fit.model)
    square = np.nan_to_num(np.sum((o.pixels - predict_pixels(alone, o)) ** 2, axis=-1), nan=1e12)
    images, image = np.unique(2 * o.view + o.camera, return_inverse=True)
    count = np.bincount(image)
    rms = np.sqrt(np.bincount(image, square) / count)
    typical = float(np.median(rms))
    is_bad = (rms > TOO_FAR * typical) & (len(rms) >= 2 * MIN_VIEWS)
    why = f"the median image has {typical:.3f} px: blurred, or the board was found wrongly"
    found = zip(images[is_bad].tolist(), rms[is_bad], strict=True)
    bad = {divmod(one, 2): f"RMS {own:.3f} px by itself, {why}" for one, own in found}
    views = np.flatnonzero(np.bincount(images[~is_bad & (count >= LEAST_POINTS)] // 2) == len(CAMERA_NAMES))
    return compared(observations, Pairs(alone, views, bad_images=bad), table_view)


def camera_moved(pairs: Pairs, names: Names, table_view: int | None) -> str:
    """A warning that a camera was moved between views."""
    steps = "; ".join(
        f"from {names[view][0]} and {names[view][1]} on the cameras stand otherwise to each other than before, by "
        f"{np.degrees(turn):.2g} deg and {1e3 * shift:.2g} mm ({pixels:.2g} px, where the pairs on either side agree "
        f"to {scatter:.2g} px)"
        for (view, *_), (turn, shift, pixels, scatter) in zip(pairs.stretches[1:], pairs.steps, strict=True)
    )
    kept = pairs.stretches[pairs.kept]
    which = "most pairs" if table_view is None else "the view on the table"
    return (
        f"{steps}: a camera was moved or turned while the views were taken. How they stand to each other is taken from "
        f"the {len(kept)} pairs {names[kept[0]][0]} to {names[kept[-1]][0]}, those with {which}; the images of the "
        "others serve each its own camera. If the motion was recorded with the cameras as they stood at other views, "
        "calibrate from these alone, or take new ones"
    )


def zoomed(observations: Observations, pairs: Pairs, nominal: Array) -> dict[int, str]:
    """Cameras whose focal length changed in the other stretches, with the reason to reject their images there.

    For each camera alone, a rough fit with two focal lengths must be clearly better than one for all views.
    """
    found = {}
    other = np.isin(observations.view, pairs.others)
    paired = np.isin(observations.view, [v for stretch in pairs.stretches for v in stretch])
    for index, camera in enumerate(pairs.model.rig.cameras):
        parts = (paired, paired & ~other, paired & other)
        rough = [start_camera(observations[part], index, nominal, camera.image_size) for part in parts]
        focal, square = [one.fx for one, *_ in rough], [misfit for *_, misfit in rough]
        if square[1] + square[2] < CLEARLY**2 * square[0]:
            found[index] = (
                f"the {CAMERA_NAMES[index]} camera was zoomed or focused anew while the views were taken: its "
                f"focal length is {focal[1]:.0f} px in the {len(pairs.stretches[pairs.kept])} views that are used, "
                f"{focal[2]:.0f} px here. If the motion was recorded so, calibrate from these views alone"
            )
    return found


def compared(observations: Observations, pairs: Pairs, table_view: int | None, floor: float = 0.0) -> Pairs:
    """The pairs compared by their relative poses of the cameras: stretches between steps, and outliers in each stretch.

    All pairs differ a little, as boards bend and lenses differ from the model. A pair is odd if its distance from the
    others is TOO_FAR times that of the median pair of its stretch, so at most half of the pairs are odd. Too few pairs
    are returned unchanged.

    table_view : its stretch determines the stereo pose; None: the stretch with the most pairs
    floor : distance, over the image's longer side, below which pairs agree in any case
    """
    model, views, sides = pairs.model, pairs.views, []
    if len(views) < 2 * MIN_VIEWS:  # a median distance needs several other pairs
        return pairs
    for index, (R, t) in enumerate(model.rig.camera_poses()):
        mine = observations[observations.camera == index]
        poses = zip(R @ model.R_left_board[views, index], model.t_left_board[views, index] @ R.T + t, strict=True)
        numbered = zip(views.tolist(), poses, strict=True)
        sides.append(poses_of(numbered, mine, model.points, model.rig.cameras[index]))
    known = np.all([np.isfinite(side.covariance).all(axis=(1, 2)) for side in sides], axis=0)
    views, (left, right) = views[known], (side[known] for side in sides)
    R, t = relative_poses(left, right)
    between = apart(left, right, R, t)
    between = 0.5 * (between + between.T)
    np.fill_diagonal(between, np.nan)
    cuts = _cuts(between)
    stretches = np.split(np.arange(len(views)), [at for at, _, _ in cuts])
    odd = {}
    for stretch in stretches:
        off = np.nanmedian(between[np.ix_(stretch, stretch)], axis=1)
        usual = max(float(np.median(off)), floor * max(model.rig.left.image_size))
        for k in np.flatnonzero(off > TOO_FAR * usual):
            odd[int(views[stretch[k]])] = f"{off[k]:.2g} px apart, where the others agree to {usual:.2g} px"
    # plain units: random motions contain rotations and shifts that nearly cancel in the image
    places = np.stack([vector_from_rotation(R @ model.rig.R_right_left.T), t], axis=1)  # (n, 2, 3)
    moves = np.diff([np.median(places[stretch], axis=0) for stretch in stretches], axis=0)
    sizes = np.linalg.norm(moves, axis=2).tolist()
    steps = [(turn, shift, pixels, scatter) for (turn, shift), (_, pixels, scatter) in zip(sizes, cuts, strict=True)]
    kept = int(np.argmax([len(stretch) for stretch in stretches]))
    if table_view is not None:
        kept = int(np.searchsorted([views[at] for at, _, _ in cuts], table_view, "right"))
    of_views = tuple(tuple(views[stretch].tolist()) for stretch in stretches)
    return replace(pairs, odd=odd, stretches=of_views, steps=tuple(steps), kept=kept)


def _cuts(between: Array) -> list[tuple[int, float, float]]:
    """Steps in the sequence of n pairs, in order: the most significant one, then those on either side of it.

    Each has the index of its first pair, and the two distances [px] of `Pairs.steps`.
    between : (n, n) [px] distances between the relative poses of two pairs; NaN on the diagonal
    """
    n, place = len(between), np.arange(len(between))
    if n < 2 * MIN_VIEWS:  # fewer on a side may be boards that moved, not a camera
        return []

    def to_sides(cut: int) -> tuple[Array, Array]:
        """Median distances (n,) of each pair from those on its side, and from those on the other."""
        same = (place[:, None] < cut) == (place < cut)
        own, other = (np.nanmedian(np.where(which, between, np.nan), axis=1) for which in (same, ~same))
        return own, other

    at = min(range(MIN_VIEWS, n - MIN_VIEWS + 1), key=lambda cut: float(to_sides(cut)[0].sum()))
    own, other = to_sides(at)
    pixels, scatter = float(np.median(other)), float(max(np.median(own[:at]), np.median(own[at:])))
    if not pixels > NEARER * scatter:
        return []
    after = [(at + cut, other, own) for cut, other, own in _cuts(between[at:, at:])]
    return [*_cuts(between[:at, :at]), (at, pixels, scatter), *after]
