"""A camera that was moved while the views were taken: the pairs before and after tell of two places of the cameras.

Every pair tells by itself how the cameras stand to each other: from where either of them has the board. Boards that
moved between the exposures, lenses beyond their model and noise scatter these; a camera that was pushed or turned makes
a step of them, in the order in which the views were taken. Distances are measured in pixels, as a pair's images would
see them, so that what a pair tells badly (a shift along the axis) counts as little as it is known.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import pairwise

import numpy as np

from calibration.cameras.camera import CAMERA_NAMES, Camera, project
from calibration.fit.pairing import Pairs, apart, places_of, rotation_vectors, told_by
from calibration.fit.start import start_camera
from calibration.fit.stereo_model import Observations
from calibration.kit.arrays import Array

# Times as far apart as pairs of one side. None of 400 synthetic sets of boards that moved reaches 2; of 31 photographed
# ones two have 8.8 and 4.5, where OpenCV's rig of one side misses the other's pairs as well, and the next one 2.2.
STEP = 4.0
LEAST_SIDE = 3  # pairs on either side of a step: fewer are not a place of the cameras, but boards that moved
ASTRAY = 0.1  # share of the pairs that may lie nearer to the other side's place
ZOOM = 0.01  # of the focal length: below, a part of the views may tell as much otherwise
BY_ZOOM = 1.3  # times less squared misfit by two focal lengths; one and the same lens has 1.05


@dataclass(frozen=True)
class CameraMoved:
    """The stretches of pairs between such steps."""

    stretches: tuple[tuple[int, ...], ...]  # the views of the pairs; one more than steps
    # of each step: turn [rad], shift [m], and [px] between pairs on either side of it and between those of one side, in
    # the right image: root mean square of the usual two
    steps: tuple[tuple[float, float, float, float], ...]
    kept: int  # the stretch that tells how the cameras stand

    @property
    def others(self) -> tuple[int, ...]:
        """The views of the other stretches."""
        return tuple(v for k, stretch in enumerate(self.stretches) if k != self.kept for v in stretch)

    def told(self, names: Sequence[tuple[str, str]], table_view: int | None) -> str:
        """In words, for whoever took the views."""
        steps = "; ".join(
            f"from {names[view][0]} and {names[view][1]} on the cameras stand otherwise to each other than before, by "
            f"{np.degrees(turn):.2g} deg and {1e3 * shift:.2g} mm ({pixels:.2g} px, where the pairs on either side "
            f"agree to {scatter:.2g} px)"
            for (view, *_), (turn, shift, pixels, scatter) in zip(self.stretches[1:], self.steps, strict=True)
        )
        kept = self.stretches[self.kept]
        which = "most pairs" if table_view is None else "the view on the table"
        return (
            f"{steps}: a camera was moved or turned while the views were taken. How they stand to each other is taken "
            f"from the {len(kept)} pairs {names[kept[0]][0]} to {names[kept[-1]][0]}, those with {which}; the images "
            "of the others serve each its own camera. If the motion was recorded with the cameras as they stood at "
            "other views, calibrate from these alone, or take new ones"
        )


def zoomed(
    observations: Observations, moved: CameraMoved, cameras: tuple[Camera, Camera], nominal: Array
) -> dict[int, str]:
    """Cameras whose focal length is another one in the other stretches, and what is to be said of their images there.

    A camera with other focal lengths in both parts, alone and roughly, must fit clearly better than one for all views.
    """
    found = {}
    other = np.isin(observations.view, moved.others)
    paired = np.isin(observations.view, [v for stretch in moved.stretches for v in stretch])
    for index, camera in enumerate(cameras):
        focal, square = [], []
        for part in (paired, paired & ~other, paired & other):
            rough, poses = start_camera(observations[part], index, nominal, camera.image_size)
            mine = observations[part & (observations.camera == index) & np.isin(observations.view, list(poses))]
            R, t = (np.stack([poses[v][i] for v in mine.view]) for i in (0, 1))
            off = mine.pixels - project(np.einsum("nij,nj->ni", R, nominal[mine.point]) + t, rough)
            focal.append(rough.fx)
            square.append(float(np.sum(off**2)))
        change = focal[2] / focal[1] - 1.0
        if abs(change) > ZOOM and square[0] > BY_ZOOM * (square[1] + square[2]):
            found[index] = (
                f"the {CAMERA_NAMES[index]} camera was zoomed or focused anew while the views were taken: its "
                f"focal length is {focal[1]:.0f} px in the {len(moved.stretches[moved.kept])} views that are used, "
                f"{focal[2]:.0f} px here. If the motion was recorded so, calibrate from these views alone"
            )
    return found


def camera_moved(observations: Observations, pairs: Pairs, table_view: int | None) -> CameraMoved | None:
    """Find the steps; None where there are none, or too few pairs.

    table_view : its stretch tells how the cameras stand; None: the one with the most pairs does
    """
    model = pairs.model
    sides, R_pair, t_pair = [], model.R_right_left, model.t_right_left
    views = np.array([*pairs.left_poses], int)
    if len(views) < 2 * LEAST_SIDE:
        return None
    in_right = {v: (R_pair @ R, R_pair @ t + t_pair) for v, (R, t) in pairs.right_poses.items()}
    for index, poses in enumerate((pairs.left_poses, in_right)):
        mine = observations[observations.camera == index]
        points = {v: model.points[mine.point[mine.view == v]] for v in views}
        sides.append(places_of({v: poses[v] for v in views}, points, model.points, model.cameras[index]))
    tells = np.all([np.isfinite(side.covariance).all(axis=(1, 2)) for side in sides], axis=0)
    views, (left, right) = views[tells], (side[tells] for side in sides)
    R, t = told_by(left, right)
    between = apart(left, right, R, t)
    cuts = _cuts(0.5 * (between + between.T))
    if not cuts:
        return None
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
    return CameraMoved(tuple(tuple(views[s].tolist()) for s in stretches), tuple(steps), kept)


def _cuts(between: Array) -> list[tuple[int, float, float]]:
    """Where n pairs part, in order: the clearest step, then those on either side of it; as in `CameraMoved.steps`.

    between : (n, n) [px] by which what the pairs tell of the cameras differs
    """
    n, place = len(between), np.arange(len(between))
    if n < 2 * LEAST_SIDE:
        return []

    def to_sides(cut: int) -> tuple[Array, Array]:
        """Median distances (n,) of each pair to those of its own side, and to those of the other."""
        same = (place[:, None] < cut) == (place < cut)
        own, other = (np.where(which, between, np.nan) for which in (same & (place[:, None] != place), ~same))
        return np.nanmedian(own, axis=1), np.nanmedian(other, axis=1)

    at = min(range(LEAST_SIDE, n - LEAST_SIDE + 1), key=lambda cut: float(to_sides(cut)[0].sum()))
    own, other = to_sides(at)
    pixels, scatter = float(np.median(other)), float(max(np.median(own[:at]), np.median(own[at:])))
    if not pixels > STEP * scatter or np.mean(own > other) > ASTRAY:
        return []
    after = [(at + cut, other, own) for cut, other, own in _cuts(between[at:, at:])]
    return [*_cuts(between[:at, :at]), (at, pixels, scatter), *after]
