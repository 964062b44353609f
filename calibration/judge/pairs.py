"""What each pair of images says, with a place of the board in each: how the cameras stand, and how the board moved.

Pairs that say otherwise of the cameras than the others are told by one matrix, the distances (`pairing.apart`) between
what any two say. A pair far from most others is none; a camera that was moved while the views were taken makes a step,
in the order in which they were taken, where all else scatters. Distances are in pixels, as a pair's images would see
them, so that what a pair tells badly (a shift along the axis) counts as little as it is known.

All boards may have moved at random between the two exposures. To first order a pair says that its board moved by m (a
turn, and a shift of its middle), with covariance C by the corners; less W s of it where the shared parameters take a
step s. If m ~ N(0, S), the sizes in S are those of restricted maximum likelihood (Patterson and Thompson 1971). The
estimate with m = 0 stays where no pair shows a motion for itself: where a few views tell, it is the steadier one, and
by pairs that were synchronised the better one; its covariance contains S, as that of any estimate whose weights are not
those of the errors. What lies in one image as a whole for another reason, errors that neighbouring corners share or a
lens beyond its polynomial, is in S likewise.
"""

from dataclasses import dataclass, replace
from itertools import pairwise

import numpy as np

from calibration.board.target import LEAST_POINTS
from calibration.cameras.camera import CAMERA_NAMES
from calibration.fit.board_motion import LEAST, BoardMotion, motions
from calibration.fit.pairing import MIN_VIEWS, TOO_FAR, Names, Pairs, apart, poses_of, relative_poses, rotation_vectors
from calibration.fit.refinement import Refinement, fit_poses
from calibration.fit.start import start_camera
from calibration.fit.stereo_model import Observations, predict, predict_pixels
from calibration.kit.arrays import Array
from calibration.kit.least_squares import scaled_solve

MOVED = 2.0  # times what corners' scatter makes of a board at rest, and times that scatter, that motion is named
# Times as far apart as pairs of one side. None of 400 synthetic sets of boards that moved reaches 2; of 31 photographed
# ones two have 8.8 and 4.5, where OpenCV's rig of one side misses the other's pairs as well, and the next one 2.2.
STEP = 4.0
BY_ZOOM = 1.3  # times less squared misfit by two focal lengths; one and the same lens has 1.05


@dataclass(frozen=True)
class PairMotion:
    """How far the board moved between the two exposures of a pair: root median square over the pairs."""

    distance: float  # [m]
    pixels: float  # [px] in the right image
    scatter: float  # [px] of the corners within an image, about a pose of its own
    at_rest: float  # [px] what this scatter alone would give for `pixels`
    likely: float  # [px] rms of the likely size: cameras that few views leave open have taken up a part of `pixels`
    size: BoardMotion  # that is the most likely one by all pairs together

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


def motion_between_exposures(refinement: Refinement) -> tuple[PairMotion, Array] | None:
    """What the pairs say of the board's motion between their exposures; None with fewer than three of them.

    Of the views that are not apart, by images that have points enough, about a minimum.
    returns also : (n_views, s, s) covariance of what motions of the likely size add to each view's gradient by the
        shared numbers
    """
    problem, model = refinement.problem, refinement.model
    o, n_views = problem.observations, problem.n_views
    seen = [np.bincount(o.view[o.camera == c], minlength=n_views) for c in (0, 1)]
    pairs = np.flatnonzero((np.minimum(*seen) >= LEAST_POINTS) & ~problem.apart)
    if len(pairs) < MIN_VIEWS:
        return None
    free = replace(problem, motion=None, apart=np.ones_like(problem.apart))
    normal = free.linearise(model)
    carried = normal.carried()
    m, J = (of[pairs] for of in motions(model))
    told = J @ carried[pairs]  # (n, 6, s + 1) [W | m]
    told[..., -1] += m
    m, W = told[..., -1], told[..., :-1]
    C = J @ np.linalg.solve(normal.own_held()[pairs], np.swapaxes(J, 1, 2))
    freedom = max(2 * len(o) - 6 * len(np.unique(2 * o.view + o.camera)), 1)
    square, s = normal.eliminated(carried=carried), W.shape[-1]
    noise = max(float(normal.costs.sum()) - normal.gain(np.zeros(s), carried[..., -1]), 1e-12) / freedom
    about = free.stepped(model, np.zeros(s), carried[..., -1])
    right = o[o.camera == 1]
    d_pose, squares = predict(about, right)[2], np.zeros((n_views, 6, 6))
    np.add.at(squares, right.view, np.swapaxes(d_pose, 1, 2) @ d_pose)
    back = np.linalg.inv(J[:, :, 6:])
    # m^T square_px m is a motion's mean square displacement [px^2] in the right image
    square_px = np.swapaxes(back, 1, 2) @ (squares[pairs] / seen[1][pairs, None, None]) @ back
    taken = np.r_[: problem.stereo_basis.shape[1], s]  # of a board as it is: known better than motions move it
    distance = float(np.median(np.linalg.norm(model.t_left_board[pairs, 0], axis=1)))
    size = _likely_size(told[..., taken], noise * C, square[np.ix_(taken, taken)] / noise, distance)
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


def _likely_size(told: Array, C: Array, alone: Array, distance: float) -> BoardMotion:
    """The most likely size of random motions; about a minimum with one place of the board for both images.

    With P the inverse covariance of the motions where everything shared is free, a variance is right where the
    squares of P m that belong to it are in sum the trace of P, and grows or falls by their ratio.

    told : (n, 6, s + 1) [W | m]; alone : (s + 1, s + 1) products of [shared | residual] by all images, and by the prior
    """
    least = np.square([LEAST, LEAST * distance])
    variances = 1e6 * least
    for _ in range(100):  # what tends to zero gets there by a part each time
        known = np.linalg.inv(C + np.diag(np.repeat(variances, 3)))
        into = np.swapaxes(known @ told, 1, 2)
        square = alone + (into @ told).sum(0)
        inverse = scaled_solve(square[:-1, :-1], np.eye(len(square) - 1))
        P = known - np.swapaxes(into[:, :-1], 1, 2) @ inverse @ into[:, :-1]
        Pm = np.append(-inverse @ square[:-1, -1], 1.0) @ into
        squares, traces = (np.sum(of.reshape(-1, 2, 3), axis=(0, 2)) for of in (Pm**2, np.einsum("nii->ni", P)))
        variances = np.maximum(variances * squares / traces, least)
    return BoardMotion(*np.sqrt(variances).tolist())


def judge_pairs(observations: Observations, fit: Refinement, table_view: int | None) -> Pairs:
    """Images that do not even fit alone, and of the others what pairs say: `compared`, by the cameras of a fit.

    observations : with the views' numbers; fit : of the same, some pairs perhaps apart
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
    bad = {
        divmod(int(i), 2): f"RMS {own:.3f} px by itself, the median image has {typical:.3f} px: blurred, or the board "
        "was found wrongly"
        for i, own in zip(images[is_bad], rms[is_bad], strict=True)
    }
    views = np.flatnonzero(np.bincount(images[~is_bad & (count >= LEAST_POINTS)] // 2) == len(CAMERA_NAMES))
    return compared(observations, Pairs(alone, views, bad_images=bad), table_view)


def moved_told(pairs: Pairs, names: Names, table_view: int | None) -> str:
    """That a camera was moved, in words, for whoever took the views."""
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
    """Cameras whose focal length is another one in the other stretches, and what is to be said of their images there.

    A camera with other focal lengths in both parts, alone and roughly, must fit clearly better than one for all views.
    """
    found = {}
    other = np.isin(observations.view, pairs.others)
    paired = np.isin(observations.view, [v for stretch in pairs.stretches for v in stretch])
    for index, camera in enumerate(pairs.model.rig.cameras):
        parts = (paired, paired & ~other, paired & other)
        rough = [start_camera(observations[part], index, nominal, camera.image_size) for part in parts]
        focal, square = [one.fx for one, *_ in rough], [misfit for *_, misfit in rough]
        if square[0] > BY_ZOOM * (square[1] + square[2]):
            found[index] = (
                f"the {CAMERA_NAMES[index]} camera was zoomed or focused anew while the views were taken: its "
                f"focal length is {focal[1]:.0f} px in the {len(pairs.stretches[pairs.kept])} views that are used, "
                f"{focal[2]:.0f} px here. If the motion was recorded so, calibrate from these views alone"
            )
    return found


def compared(observations: Observations, pairs: Pairs, table_view: int | None, floor: float = 0.0) -> Pairs:
    """The pairs by how each says that the cameras stand: in which stretches, and which say otherwise than most of one.

    Some of it is in every pair, as boards bend and lenses are not as modelled. A pair is odd where it is TOO_FAR times
    as far from the others as the median pair of its stretch; so never more than half of them are. Too few pairs tell
    nothing of one another, nor of a camera that was moved.

    table_view : its stretch tells how the cameras stand; None: the one with the most pairs does
    floor : of the image's longer side: pairs that differ by less agree, whatever the others do
    """
    model, views, sides = pairs.model, pairs.views, []
    R_pair = model.rig.R_right_left
    if len(views) < 2 * MIN_VIEWS:  # one tells how the cameras stand, and a median is of the others
        return pairs
    for index, (R, t) in enumerate(model.rig.camera_poses()):
        mine = observations[observations.camera == index]
        poses = zip(R @ model.R_left_board[views, index], model.t_left_board[views, index] @ R.T + t, strict=True)
        sides.append(
            poses_of(dict(zip(views.tolist(), poses, strict=True)), mine, model.points, model.rig.cameras[index])
        )
    tells = np.all([np.isfinite(side.covariance).all(axis=(1, 2)) for side in sides], axis=0)
    views, (left, right) = views[tells], (side[tells] for side in sides)
    R, t = relative_poses(left, right)
    between = apart(left, right, R, t)
    between = 0.5 * (between + between.T)
    np.fill_diagonal(between, np.nan)
    cuts = _cuts(between)
    stretches = np.split(np.arange(len(views)), [at for at, _, _ in cuts])
    odd, steps = {}, []
    for stretch in stretches:
        off = np.nanmedian(between[np.ix_(stretch, stretch)], axis=1)
        usual = max(float(np.median(off)), floor * max(model.rig.left.image_size))
        for k in np.flatnonzero(off > TOO_FAR * usual):
            odd[int(views[stretch[k]])] = f"{off[k]:.2g} px apart, where the others agree to {usual:.2g} px"
    for (_, pixels, scatter), (before, after) in zip(cuts, pairwise(stretches), strict=True):
        # in plain units: boards that moved scatter a turn and a shift that nearly cancel in the image
        turn = np.median(rotation_vectors(R[after] @ R_pair.T), axis=0)
        turn -= np.median(rotation_vectors(R[before] @ R_pair.T), axis=0)
        shift = np.median(t[after], axis=0) - np.median(t[before], axis=0)
        steps.append((float(np.linalg.norm(turn)), float(np.linalg.norm(shift)), pixels, scatter))
    kept = int(np.argmax([len(stretch) for stretch in stretches]))
    if table_view is not None:
        kept = int(np.searchsorted([views[at] for at, _, _ in cuts], table_view, "right"))
    told = tuple(tuple(views[stretch].tolist()) for stretch in stretches)
    return replace(pairs, odd=odd, stretches=told, steps=tuple(steps), kept=kept)


def _cuts(between: Array) -> list[tuple[int, float, float]]:
    """Where n pairs part, in order: the clearest step, then those on either side of it; as in `Pairs.steps`.

    between : (n, n) [px] by which what the pairs tell of the cameras differs; NaN on the diagonal
    """
    n, place = len(between), np.arange(len(between))
    if n < 2 * MIN_VIEWS:  # fewer on a side are not a place of the cameras, but boards that moved
        return []

    def to_sides(cut: int) -> tuple[Array, Array]:
        """Median distances (n,) of each pair to those of its own side, and to those of the other."""
        same = (place[:, None] < cut) == (place < cut)
        own, other = (np.nanmedian(np.where(which, between, np.nan), axis=1) for which in (same, ~same))
        return own, other

    at = min(range(MIN_VIEWS, n - MIN_VIEWS + 1), key=lambda cut: float(to_sides(cut)[0].sum()))
    own, other = to_sides(at)
    pixels, scatter = float(np.median(other)), float(max(np.median(own[:at]), np.median(own[at:])))
    if not pixels > STEP * scatter:
        return []
    after = [(at + cut, other, own) for cut, other, own in _cuts(between[at:, at:])]
    return [*_cuts(between[:at, :at]), (at, pixels, scatter), *after]
