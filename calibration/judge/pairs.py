"""What each pair of images says of a board's motion between its two exposures, and which hypothesis of it holds.

With a place of the board in each of its images a pair says, to first order, that the board moved by m (a turn, and a
shift of its middle), with covariance C by the corners; less W s of it where the shared parameters take a step s. Every
hypothesis of a pair is one of m, and compared by its likelihood with everything shared free to follow:

- the images show one place, m = 0, or they do not, and m tells nothing: what chi-square the former costs, by pair;
- all boards moved at random, m ~ N(0, S): the sizes in S are those of restricted maximum likelihood (Patterson and
  Thompson 1971). The estimate with m = 0 stays where no pair shows a motion for itself: where a few views tell, it is
  the steadier one, and by pairs that were synchronised the better one; its covariance contains S, as that of any
  estimate whose weights are not those of the errors. What lies in one image as a whole for another reason, errors that
  neighbouring corners share or a lens beyond its polynomial, is in S likewise.

A camera that was moved while the views were taken makes a step of what the pairs tell, in the order in which they were
taken, where all else scatters it. Distances are measured in pixels, as a pair's images would see them, so that what a
pair tells badly (a shift along the axis) counts as little as it is known.
"""

from collections.abc import Collection
from dataclasses import dataclass, replace
from itertools import pairwise

import numpy as np
from numpy.typing import NDArray

from calibration.board.target import LEAST_POINTS
from calibration.cameras.camera import CAMERA_NAMES
from calibration.fit.board_motion import LEAST, BoardMotion, motions
from calibration.fit.normal_equations import Problem
from calibration.fit.pairing import MIN_VIEWS, TOO_FAR, Names, Pairs, apart, places_of, rotation_vectors, told_by
from calibration.fit.refinement import Refinement, fit_poses
from calibration.fit.start import start_camera
from calibration.fit.stereo_model import Observations, StereoModel, predict, predict_pixels
from calibration.kit.arrays import Array, Mask
from calibration.kit.least_squares import scaled_solve

MOVED = 2.0  # times what corners' scatter makes of a board at rest, and times that scatter, that motion is named
LEAST_PAIRS = 6  # fewer cannot judge one another: one tells how the cameras stand, and a median is of the others
# Times as far apart as pairs of one side. None of 400 synthetic sets of boards that moved reaches 2; of 31 photographed
# ones two have 8.8 and 4.5, where OpenCV's rig of one side misses the other's pairs as well, and the next one 2.2.
STEP = 4.0
BY_ZOOM = 1.3  # times less squared misfit by two focal lengths; one and the same lens has 1.05


@dataclass(frozen=True)
class PairMotions:
    """The motions (m, C, W) of n pairs, each by its own two images."""

    views: NDArray[np.intp]  # (n,)
    motion: Array  # (n, 6) turn [rad] and shift of the middle [m] in the left camera's axes
    covariance: Array  # (n, 6, 6) by the corners
    by_shared: Array  # (n, 6, s) what a step of the shared parameters takes from it
    alone: tuple[Array, Array]  # normal matrix (s, s) and gradient (s,) of the shared by all images, and by the prior
    square_px: Array  # (n, 6, 6): m^T square_px m is a motion's mean square displacement [px^2] in the right image
    noise: float  # variance about places of the images' own, in units of the corners'
    scatter: float  # [px] the same, rms
    problem: Problem
    distance: float  # [m] of the boards

    @property
    def pixels(self) -> Array:
        """(n,) [px] rms displacement by the motions."""
        return np.sqrt(np.einsum("ni,nij,nj->n", self.motion, self.square_px, self.motion))

    def shared(self, covariance: Array, pairs: Mask, first: int | None = None) -> tuple[Array, Array]:
        """Normal matrix and gradient of the `first` shared parameters where these motions are 0 +- `covariance`."""
        W, m = self.by_shared[pairs, :, :first], self.motion[pairs]
        known = np.swapaxes(np.linalg.solve(covariance[pairs], W), 1, 2)
        information, gradient = self.alone[0][:first, :first], self.alone[1][:first]
        return information + (known @ W).sum(0), gradient + (known @ m[..., None])[..., 0].sum(0)

    def cost_of_rest(self, tied: Mask) -> Array:
        """Chi-square (n,) that one place of the board costs each pair, where those `tied` (n,) have one each.

        Each pair is compared with what the others say; 0 where they leave open what it says.
        """
        information, gradient = self.shared(self.covariance, tied)
        inverse = scaled_solve(information, np.eye(len(information)))
        left = self.motion - self.by_shared @ (inverse @ gradient)
        L = np.linalg.inv(np.linalg.cholesky(self.covariance))
        W = L @ self.by_shared
        sign = np.where(tied, -1.0, 1.0)[:, None, None]  # what the others say, without the pair's own part
        values, vectors = np.linalg.eigh(np.eye(6) + sign * (W @ inverse @ np.swapaxes(W, 1, 2)))
        white = np.einsum("nji,njk,nk->ni", vectors, L, left)
        return np.asarray(np.sum(np.where(values > 1e-6, white**2 / np.maximum(values, 1e-6), 0.0), axis=1))

    def likely_size(self) -> BoardMotion:
        """The most likely size of random motions; about a minimum with one place of the board for both images.

        With P the inverse covariance of the motions where everything shared is free, a variance is right where the
        squares of P m that belong to it are in sum the trace of P, and grows or falls by their ratio.
        """
        s1 = self.problem.stereo_basis.shape[1]  # the board's shape is held: it is known better than motions move it
        W, everyone = self.by_shared[..., :s1], np.ones(len(self.views), bool)
        at_noise = replace(self, alone=(self.alone[0] / self.noise, self.alone[1] / self.noise))
        least = np.square([LEAST, LEAST * self.distance])
        variances = 1e6 * least
        for _ in range(100):  # what tends to zero gets there by a part each time
            V = self.noise * self.covariance + np.diag(np.repeat(variances, 3))
            information, gradient = at_noise.shared(V, everyone, s1)
            inverse, known = scaled_solve(information, np.eye(s1)), np.linalg.inv(V)
            P = known - known @ W @ inverse @ np.swapaxes(known @ W, 1, 2)
            Pm = (known @ (self.motion - W @ (inverse @ gradient))[..., None])[..., 0]
            squares, traces = (np.sum(of.reshape(-1, 2, 3), axis=(0, 2)) for of in (Pm**2, np.einsum("nii->ni", P)))
            variances = np.maximum(variances * squares / traces, least)
        return BoardMotion(*np.sqrt(variances).tolist())

    def gradients(self, size: BoardMotion) -> Array:
        """(n_views, s, s) covariance of what motions of this size add to each view's gradient by the shared numbers."""
        into = np.zeros((self.problem.n_views, *2 * self.by_shared.shape[-1:]))
        known = np.linalg.solve(self.covariance, self.by_shared)
        into[self.views] = np.swapaxes(known, 1, 2) @ (known / size.weights[:, None])
        return into


def pair_motions(problem: Problem, model: StereoModel) -> PairMotions:
    """Of the views that are not apart, by images that have points enough, about a minimum."""
    free, o = replace(problem, motion=None, apart=np.ones_like(problem.apart)), problem.observations
    normal = free.linearise(model)
    carried, step = normal.carried()
    m, J = motions(model)
    seen = [np.bincount(o.view[o.camera == c], minlength=problem.n_views) for c in (0, 1)]
    pairs = np.flatnonzero((np.minimum(*seen) >= LEAST_POINTS) & ~problem.apart)
    images = len(np.unique(2 * o.view + o.camera))
    freedom = max(2 * len(o) - 6 * images, 1)
    about = free.stepped(model, np.zeros(len(normal.prior)), step)
    right = o[o.camera == 1]
    d_pose, squares = predict(about, right)[2], np.zeros((problem.n_views, 6, 6))
    np.add.at(squares, right.view, np.swapaxes(d_pose, 1, 2) @ d_pose)
    J = J[pairs]
    back = np.linalg.inv(J[:, :, 6:])
    squares = squares[pairs] / seen[1][pairs, None, None]
    return PairMotions(
        views=pairs,
        motion=m[pairs] + (J @ step[pairs, :, None])[..., 0],
        covariance=J @ np.linalg.solve(normal.own_held()[pairs], np.swapaxes(J, 1, 2)),
        by_shared=J @ carried[pairs],
        alone=normal.eliminated(),
        square_px=np.swapaxes(back, 1, 2) @ squares @ back,
        noise=max(float(normal.costs.sum() - np.sum(normal.own_gradient * step)), 1e-12) / freedom,
        scatter=float(np.sqrt(2 * np.sum((o.pixels - predict_pixels(about, o)) ** 2) / freedom)),
        problem=problem,
        distance=float(np.median(np.linalg.norm(model.t_left_board[pairs, 0], axis=1))) if len(pairs) else np.nan,
    )


def gradients_by_motion(refinement: Refinement) -> Array | None:
    """(n_views, s, s) `gradients` of motions of the likely size; None where the fit has motions, or nothing tells."""
    found = pair_motions(refinement.problem, refinement.model)
    known = refinement.problem.motion is not None or len(found.views) < MIN_VIEWS
    return None if known else found.gradients(found.likely_size())


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


def motion_between_exposures(refinement: Refinement) -> PairMotion | None:
    """What the pairs say of the board's motion between their exposures; None with fewer than three of them."""
    found = pair_motions(refinement.problem, refinement.model)
    if len(found.views) < MIN_VIEWS:
        return None
    noise = float(np.median(np.einsum("nij,nji->n", found.square_px, found.covariance)))
    size = found.likely_size()
    return PairMotion(
        distance=float(np.median(np.linalg.norm(found.motion[:, 3:], axis=1))),
        pixels=float(np.median(found.pixels)),
        scatter=found.scatter,
        at_rest=float(np.sqrt(noise * found.noise)),
        likely=float(np.sqrt(np.mean(np.einsum("nii,i->n", found.square_px, 1.0 / size.weights)))),
        size=size,
    )


def judge_pairs(
    observations: Observations, fit: Refinement, elsewhere: Collection[int], table_view: int | None
) -> Pairs:
    """Compare one place of the board for both images of a pair with a place for each; and `moved_cameras`.

    One place has six parameters less. What chi-square it costs tells how far the board moved: some of it in every pair,
    as boards bend and lenses are not as modelled. A pair is apart where it costs TOO_FAR (in amplitude) more than the
    median pair; so never more than half of them are. The median of fewer than LEAST_PAIRS tells nothing, and none of so
    few is set apart, nor one that alone tells how the cameras stand.

    observations : with the views' numbers; fit : of the same, some pairs perhaps apart
    elsewhere : views at which the cameras stood otherwise to each other: no measure of what is usual
    """
    o, sigma = observations[np.argsort(observations.view, kind="stable")], max(fit.unexplained_sigma, 1e-3)
    problem = replace(fit.problem.seeing(o, sigma**2), motion=None, huber=3.0)
    none, every = np.zeros_like(problem.apart), np.ones_like(problem.apart)
    alone = fit_poses(replace(problem, apart=every), fit.model)
    pairs = pair_motions(replace(problem, apart=none), alone)
    square = np.nan_to_num(np.sum((o.pixels - predict_pixels(alone, o)) ** 2, axis=-1), nan=1e12)
    images, image = np.unique(2 * o.view + o.camera, return_inverse=True)
    rms = np.sqrt(np.bincount(image, square) / np.bincount(image))
    typical = float(np.median(rms))
    bad, found = {}, {}
    for i in np.flatnonzero(rms > TOO_FAR * typical) if len(rms) >= LEAST_PAIRS else ():
        misfit = f"RMS {rms[i]:.3f} px by itself, the median image has {typical:.3f} px"
        bad[divmod(int(images[i]), 2)] = f"{misfit}: blurred, or the board was found wrongly"
    whole = ~np.isin(pairs.views, [view for view, _ in bad])
    if len(pairs.views) >= LEAST_PAIRS:
        cost = pairs.cost_of_rest(~problem.apart[pairs.views])
        usual = max(float(np.median(cost[~np.isin(pairs.views, list(elsewhere))])), 6.0)
        for k in np.flatnonzero(whole & (cost > TOO_FAR**2 * usual)):
            found[int(pairs.views[k])] = f"{pairs.pixels[k]:.2g} px apart, where corners scatter by {typical:.2g} px"
    R, t = fit.model.R_left_board.copy(), fit.model.t_left_board.copy()
    R[pairs.views], t[pairs.views] = alone.R_left_board[pairs.views], alone.t_left_board[pairs.views]
    model = replace(fit.model, R_left_board=R, t_left_board=t)
    return moved_cameras(observations, Pairs(model, pairs.views[whole], found, bad), table_view)


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


def moved_cameras(observations: Observations, pairs: Pairs, table_view: int | None) -> Pairs:
    """The pairs with the stretches between which a camera was moved; too few pairs have none.

    table_view : its stretch tells how the cameras stand; None: the one with the most pairs does
    """
    model, views, sides = pairs.model, pairs.views, []
    R_pair = model.rig.R_right_left
    if len(views) < 2 * MIN_VIEWS:
        return pairs
    for index, (R, t) in enumerate(model.rig.camera_poses()):
        mine = observations[observations.camera == index]
        poses = zip(R @ model.R_left_board[views, index], model.t_left_board[views, index] @ R.T + t, strict=True)
        sides.append(
            places_of(dict(zip(views.tolist(), poses, strict=True)), mine, model.points, model.rig.cameras[index])
        )
    tells = np.all([np.isfinite(side.covariance).all(axis=(1, 2)) for side in sides], axis=0)
    views, (left, right) = views[tells], (side[tells] for side in sides)
    R, t = told_by(left, right)
    between = apart(left, right, R, t)
    cuts = _cuts(0.5 * (between + between.T))
    stretches = np.split(np.arange(len(views)), [at for at, _, _ in cuts])
    steps = []
    for (_, pixels, scatter), (before, after) in zip(cuts, pairwise(stretches), strict=True):
        # in plain units: boards that moved scatter a turn and a shift that nearly cancel in the image
        turn = np.median(rotation_vectors(R[after] @ R_pair.T), axis=0)
        turn -= np.median(rotation_vectors(R[before] @ R_pair.T), axis=0)
        shift = np.median(t[after], axis=0) - np.median(t[before], axis=0)
        steps.append((float(np.linalg.norm(turn)), float(np.linalg.norm(shift)), pixels, scatter))
    kept = int(np.argmax([len(stretch) for stretch in stretches]))
    if table_view is not None:
        kept = int(np.searchsorted([views[at] for at, _, _ in cuts], table_view, "right"))
    return replace(pairs, stretches=tuple(tuple(views[s].tolist()) for s in stretches), steps=tuple(steps), kept=kept)


def _cuts(between: Array) -> list[tuple[int, float, float]]:
    """Where n pairs part, in order: the clearest step, then those on either side of it; as in `Pairs.steps`.

    between : (n, n) [px] by which what the pairs tell of the cameras differs
    """
    n, place = len(between), np.arange(len(between))
    if n < 2 * MIN_VIEWS:  # fewer on a side are not a place of the cameras, but boards that moved
        return []

    def to_sides(cut: int) -> tuple[Array, Array]:
        """Median distances (n,) of each pair to those of its own side, and to those of the other."""
        same = (place[:, None] < cut) == (place < cut)
        own, other = (np.where(which, between, np.nan) for which in (same & (place[:, None] != place), ~same))
        return np.nanmedian(own, axis=1), np.nanmedian(other, axis=1)

    at = min(range(MIN_VIEWS, n - MIN_VIEWS + 1), key=lambda cut: float(to_sides(cut)[0].sum()))
    own, other = to_sides(at)
    pixels, scatter = float(np.median(other)), float(max(np.median(own[:at]), np.median(own[at:])))
    if not pixels > STEP * scatter:
        return []
    after = [(at + cut, other, own) for cut, other, own in _cuts(between[at:, at:])]
    return [*_cuts(between[:at, :at]), (at, pixels, scatter), *after]
