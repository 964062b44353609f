"""Which images of the two cameras show the board in one place: as stored, turned, mirrored, in another order, late.

Each image alone, by a rough camera, has the board at a place, and a pair of them tells how the cameras stand. Right
pairs tell of one place of the cameras, wrong ones of as many as there are; so every hypothesis of which image belongs
to which is as likely as the places that its pairs tell of lie together. Distances are in pixels, by the covariance of
the two places of the board: what a pair tells badly (a shift along the axis) counts as little as it is known. As some
boards were moved, errors have long tails: a pair's evidence is minus the logarithm of its squared distance.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace

import numpy as np
import scipy
from numpy.typing import NDArray

from calibration.board.chessboard import BoardNotFound, CornerView
from calibration.cameras.camera import CAMERA_NAMES, Camera, by_turning, project_with_jacobians
from calibration.fit.stereo_model import Observations, StereoModel
from calibration.kit.arrays import Array, Mask, evenly
from calibration.kit.errors import CalibrationError

FLOOR = 1e-3  # of the image's longer side: rough cameras put boards no better; views that differ by less are one
NEARER = 3.0  # times that the pairs of another hypothesis lie together better than those stored, to be believed
BY_CHANCE = 2.0  # times that pairs lie together better than images of other pairs do: less is no agreement
# Times the usual distance: of another place. Of Gaussian motions (F of 6 and 24 degrees of freedom) one in 10^9 is as
# far; the motions of hand-held boards have longer tails.
TOO_FAR = 5.0
MOST_LATE = 8  # views by which the two cameras may differ
MIN_VIEWS = 3  # Zhang: fewer do not determine a camera, and so many pairs agree by chance
GOOD_VIEWS = 8  # fewer judge neither lenses nor one another
MOST_TRIED = 30  # pairs whose place is tried for all, views that OpenCV is given: time grows with the cube of them
Pose = tuple[Array, Array]  # rotation (3, 3) and translation (3,) of the board in a camera's axes
Names = Sequence[tuple[str, str]]
Views = tuple[list[CornerView | BoardNotFound], list[CornerView | BoardNotFound]]


@dataclass(frozen=True)
class BoardPlaces:
    """Where one camera alone has the board in n images, and how well it knows."""

    R: Array  # (n, 3, 3) board to camera
    middle: Array  # (n, 3) [m] of the board
    covariance: Array  # (n, 6, 6) of a turn and a shift of the middle, times the points, by a pixel of scatter

    def __getitem__(self, index: NDArray) -> BoardPlaces:
        return BoardPlaces(self.R[index], self.middle[index], self.covariance[index])

    def turned(self, turn: Array, mirror: bool = False) -> BoardPlaces:
        """With the board turned about its middle (3, 3), and the camera's x reversed."""
        F = np.diag([-1.0 if mirror else 1.0, 1.0, 1.0])
        B = _both(-F if mirror else F, F)  # a turn is an axial vector
        return BoardPlaces(F @ self.R @ turn, self.middle @ F, B @ self.covariance @ B.T)


def count_once(views: Views, names: Names, table_view: int | None) -> None:
    """Leave out, in place, views that show the board where another one does: they say no more of cameras than that one.

    Copies of a file, and frames of a video in which the board rests, are such. Raises CalibrationError where one
    camera's images show the board in one place and the other's do not.
    """
    same = [_same_place(side) for side in views]
    found = np.array([[isinstance(view, CornerView) for view in side] for side in views])
    first: list[int] = []
    for v in sorted(np.flatnonzero(found.any(axis=0)).tolist(), key=lambda v: v != table_view):
        u = next((u for u in first if same[0][v, u] and same[1][v, u]), None)
        if u is None:
            first.append(v)
            continue
        for side, name in zip(views, names[u], strict=True):
            side[v] = BoardNotFound(f"shows the board where {name} does, and counts once")
    both = np.array([v for v in first if found[:, v].all()], int)
    for camera, name in enumerate(CAMERA_NAMES):
        alike = same[camera][np.ix_(both, both)]
        which = both[alike[alike.sum(axis=1).argmax()]] if len(both) else both
        if len(which) > MIN_VIEWS and 2 * len(which) >= len(both):
            raise CalibrationError(
                f"{len(which)} {name} images show the board in one place, {names[which[0]][camera]} to "
                f"{names[which[-1]][camera]}, where the {CAMERA_NAMES[1 - camera]} ones show it in as many: are they "
                "copies of one? Every pair must be two images of one moment"
            )


def _same_place(side: Sequence[CornerView | BoardNotFound]) -> Mask:
    """(n, n) whether two images of a camera show the board in one place; or both do not show it."""
    found = np.array([isinstance(view, CornerView) for view in side], bool)
    same = ~found[:, None] & ~found
    views = [view for view in side if isinstance(view, CornerView)]
    points = np.array([np.where(view.accepted[:, None], view.points, np.nan) for view in views])
    for v, seen, view in zip(np.flatnonzero(found), points, views, strict=True):
        square = np.sum((points - seen) ** 2, axis=2)
        limit = (FLOOR * max(view.image_size)) ** 2
        same[v, found] = np.nansum(square, axis=1) < limit * np.isfinite(square).sum(axis=1)
    return same


def places_of(poses: Mapping[int, Pose], seen_by: Observations, points: Array, camera: Camera) -> BoardPlaces:
    """Of images whose poses are known. seen_by : the camera;  points : (n, 3) [m] of the target"""
    middle = points.mean(0)
    found: list[tuple[Array, Array, Array]] = []
    for view, (R, t) in poses.items():
        seen, at = points[seen_by.point[seen_by.view == view]] @ R.T + t, R @ middle + t
        d_point = project_with_jacobians(seen, camera)[1]
        J = np.concatenate([by_turning(d_point, seen - at), d_point], axis=-1).reshape(-1, 6)
        information = J.T @ J / len(seen)
        information += 1e-9 * np.diag(np.diag(information))  # of points on a line, one turn is not seen at all
        found.append((R, at, np.linalg.inv(information)))
    return BoardPlaces(*(np.stack(part) for part in zip(*found, strict=True)))


def apart(left: BoardPlaces, right: BoardPlaces, R_pair: Array, t_pair: Array) -> Array:
    """(m, n) [px] by which n pairs are off m places of the right camera against the left: (m, 3, 3) and (m, 3) [m]."""
    back = np.swapaxes(R_pair, 1, 2)[:, None]
    turn = rotation_vectors(back @ right.R @ np.swapaxes(left.R, 1, 2))
    shift = (back @ (right.middle - t_pair[:, None])[..., None])[..., 0] - left.middle
    B = _both(back, back)
    step = np.concatenate([turn, shift], axis=-1)
    known = np.linalg.solve(left.covariance + B @ right.covariance @ np.swapaxes(B, 2, 3), step[..., None])[..., 0]
    return np.asarray(np.sqrt(np.maximum(np.sum(step * known, axis=-1), 0.0)), np.float64)


def told_by(left: BoardPlaces, right: BoardPlaces) -> tuple[Array, Array]:
    """How the cameras stand by each pair alone: R_right_left (n, 3, 3) and t_right_left (n, 3) [m]."""
    R = right.R @ np.swapaxes(left.R, 1, 2)
    return R, right.middle - np.einsum("nij,nj->ni", R, left.middle)


Paired = tuple[list[int], BoardPlaces, list[BoardPlaces]]  # left views, and where each camera has the board in pairs


@dataclass(frozen=True)
class Pairs:
    """Which pairs show the board in one place, as cameras see it that have a place of it for each image."""

    model: StereoModel  # its boards where each image alone has them
    views: NDArray[np.intp]  # of which both images tell that
    odd: dict[int, str] = field(default_factory=dict)  # view -> why its two images are not taken for one place
    bad_images: dict[tuple[int, int], str] = field(default_factory=dict)  # (view, camera) -> why not even alone
    # Where a camera was moved between the views: the stretches of pairs before and after such steps, and of each step
    # turn [rad], shift [m], and [px] between pairs on either side of it and between those of one side, in the right
    # image: root mean square of the usual two
    stretches: tuple[tuple[int, ...], ...] = ()
    steps: tuple[tuple[float, float, float, float], ...] = ()
    kept: int = 0  # the stretch that tells how the cameras stand

    @property
    def others(self) -> tuple[int, ...]:
        """The views of the other stretches."""
        return tuple(v for k, stretch in enumerate(self.stretches) if k != self.kept for v in stretch)

    @property
    def apart(self) -> set[int]:
        """Views whose two images are used each for its own camera."""
        return {*self.odd, *self.others}

    def joined(self, observations: Observations) -> StereoModel:
        """The model with one place for both images but of those apart: by the image that shows more of the board."""
        R, t = self.model.R_left_board.copy(), self.model.t_left_board.copy()
        image = 2 * observations.view + observations.camera
        both = np.setdiff1d(np.arange(len(R)), [*self.apart])
        fuller = np.bincount(image, minlength=2 * len(R)).reshape(-1, 2).argmax(axis=1)[both]
        R[both], t[both] = (of[both, fuller][:, None] for of in (R, t))
        return replace(self.model, R_left_board=R, t_left_board=t)


@dataclass(frozen=True)
class Pairing:
    """The likeliest place of the right camera against the left one, and the pairs by it."""

    R_right_left: Array  # (3, 3)
    t_right_left: Array  # (3,) [m]
    order: NDArray[np.intp]  # (n,) number of the board's turn in the right image of each pair
    distance: Array  # (n,) [px]
    evidence: float  # mean over the pairs, in units of the logarithm of a squared distance
    floor: float  # [px]

    @property
    def usual(self) -> float:
        """[px] Distance of pairs that agree: the best half of them."""
        return max(float(np.quantile(self.distance, 0.25)), self.floor)

    @property
    def agrees(self) -> Mask:
        """(n,) pairs that tell of this place."""
        return self.distance < TOO_FAR * self.usual

    def is_likelier(self, stored: Pairing) -> bool:
        """True if it is to be believed against the pairs as they are stored."""
        beyond = stored.evidence + 2.0 * np.log(NEARER)
        return self.evidence > beyond and 2 * int(self.agrees.sum()) > len(self.distance)


def likeliest(left: BoardPlaces, turns_of_right: Sequence[BoardPlaces], floor: float) -> Pairing:
    """The place of the cameras that pairs tell of; turns_of_right : with the board in each of its attitudes."""
    n = len(left.R)
    tried = np.array(evenly(n, MOST_TRIED))
    told = [told_by(left[tried], right[tried]) for right in turns_of_right]
    R, t = (np.concatenate(part) for part in zip(*told, strict=True))
    distance = np.stack([apart(left, right, R, t) for right in turns_of_right])  # (orders, candidates, n)
    nearest = distance.min(axis=0)
    own = np.tile(tried, len(told))
    likelihood = -np.log(floor**2 + nearest**2)
    likelihood[np.arange(len(own)), own] = 0.0  # each lies at the place that it tells of
    best = int(np.argmax(likelihood.sum(axis=1)))
    order, near = distance[:, best].argmin(axis=0), nearest[best]
    found = Pairing(R[best], t[best], order, near, float(likelihood[best].sum() / max(n - 1, 1)), floor)
    shifts = np.stack([told_by(left, right)[1] for right in turns_of_right])[order, np.arange(n)]
    return replace(found, t_right_left=np.median(shifts[found.agrees], axis=0))


def board_turns(n: int) -> list[Array]:
    """(3, 3) each: the n turns of a grid of points in its plane that map it onto itself, in the order of `orders`."""
    quarter = np.array([[0.0, -1.0, 0.0], [1.0, 0.0, 0.0], [0.0, 0.0, 1.0]])
    return [np.linalg.matrix_power(quarter, k * 4 // n) for k in range(n)]


def paired(
    sides: tuple[BoardPlaces, BoardPlaces],
    views: tuple[Sequence[int], Sequence[int]],
    nominal: Array,
    n_orders: int,
    floor: float,
    names: Names,
) -> tuple[Pairing, tuple[str, ...]]:
    """The pairs as they are stored, and what is to be said of them. Raises CalibrationError where they are no pairs.

    sides : where each camera alone has the board; views : the numbers of these images, ascending
    names : (left, right) of all views; n_orders : of the target's points that look the same
    """
    (left, right), is_square = sides, np.allclose(*np.ptp(nominal, axis=0)[:2])
    as_seen = [right.turned(turn) for turn in board_turns(n_orders)]
    mirrored = [right.turned(turn @ np.diag([-1.0, 1.0, 1.0]), True) for turn in board_turns(4 if is_square else 2)]
    place = [{view: i for i, view in enumerate(side)} for side in views]

    def pairs_of(right_of: NDArray, among: Sequence[int] = views[0], turns: Sequence[BoardPlaces] = as_seen) -> Paired:
        both = [v for v in among if right_of[v] in place[1]]
        b = np.array([place[1][right_of[v]] for v in both], int)
        return both, left[np.array([place[0][v] for v in both], int)], [one[b] for one in turns]

    number = np.arange(len(names))
    both, of_left, of_right = pairs_of(number)
    n = len(both)
    if not n:
        raise CalibrationError("no view shows the target to both cameras: the pair cannot be calibrated")
    stored = likeliest(of_left, of_right, floor)
    if n < MIN_VIEWS or (stored.agrees.all() and stored.usual < TOO_FAR * floor):
        return stored, ()
    shifts = [k for k in range(-MOST_LATE, MOST_LATE + 1) if abs(k) < n - MIN_VIEWS]
    orders = [(f"{abs(k)} {'late' if k > 0 else 'early'}", number + k) for k in shifts if k]
    orders += [("in reversed order", number[::-1] + k) for k in shifts]
    tried = [("", number, pairs_of(number, turns=mirrored)), *((how, by, pairs_of(by)) for how, by in orders)]
    others = [(how, by, which, likeliest(a, b, floor)) for how, by, (which, a, b) in tried if len(which) > MIN_VIEWS]
    if others:
        how, by, which, found = max(others, key=lambda one: one[-1].evidence)
        if found.is_likelier(stored):
            raise CalibrationError(_told(how, found, stored, [(names[v][0], names[by[v]][1]) for v in which]))
    _require_agreement(stored, [found.evidence for how, _, _, found in others if how])
    notes = _late(pairs_of, [v for v, fits in zip(both, stored.agrees, strict=True) if not fits], stored, names)
    if notes and 2 * stored.agrees.sum() <= n:
        raise CalibrationError(f"{'; '.join(notes)}. As stored {stored.agrees.sum()} of {n} pairs are right")
    return stored, notes


def _told(how: str, found: Pairing, stored: Pairing, names: Names) -> str:
    """Why pairs of these names are believed against those stored, and what to do.

    how : the right views come; "": as stored, with the images of one camera mirrored
    """
    if not how:
        return (
            f"the images of one of the two cameras are mirrored: if they are, {found.agrees.sum()} of {len(names)} "
            f"pairs agree on one place of the cameras, as stored {stored.agrees.sum()}. Switch the mirroring off "
            "where that camera's images are exported, or flip all of them, those of the motion too; so, too, if "
            "it looks through a mirror"
        )
    shown = names[int(np.argmin(found.distance))]
    return (
        f"the left and the right views are no pairs as they are stored: the right ones come {how}. So paired, "
        f"they agree on one place of the cameras to {np.median(found.distance):.2g} px, as stored to "
        f"{np.median(stored.distance):.2g} px: {shown[0]} shows the board where {shown[1]} does. A frame was lost, or "
        "one camera began earlier: name or move the files so that pairs have one number"
    )


def _require_agreement(stored: Pairing, others: Sequence[float]) -> None:
    """Raise CalibrationError where pairs lie together no better than those of other orders, with this evidence, do."""
    n = len(stored.distance)
    if n < GOOD_VIEWS or not others or stored.usual < TOO_FAR * stored.floor:
        return
    if stored.evidence <= float(np.median(others)) + 2.0 * np.log(BY_CHANCE):
        raise CalibrationError(
            f"the {n} pairs agree on no common place of the cameras: they differ by {stored.usual:.2g} px and more, as "
            f"images do that are no pairs. Other orders, up to {MOST_LATE} views late or early, and mirrored images "
            "do not fit either: left and right image of each number must show the board in one place"
        )


def _late(
    pairs_of: Callable[[NDArray, Sequence[int]], Paired], odd: Sequence[int], found: Pairing, names: Names
) -> tuple[str, ...]:
    """A warning about pairs, of those that do not fit, that would with a later or an earlier right view."""
    rest, told = list(odd), []
    for k in sorted(range(-MOST_LATE, MOST_LATE + 1), key=abs)[1:]:
        both, left, turns = pairs_of(np.arange(len(names)) + k, rest)
        off = np.min([apart(left, right, found.R_right_left[None], found.t_right_left[None])[0] for right in turns], 0)
        which = [v for v, distance in zip(both, off, strict=True) if distance < TOO_FAR * found.usual]
        rest = [v for v in rest if v not in which]
        if len(which) >= MIN_VIEWS:
            told.append(
                f"{names[which[0]][0]} to {names[which[-1]][0]}: {len(which)} pairs agree with the others if the right "
                f"view {abs(k)} {'later' if k > 0 else 'earlier'} is taken ({names[which[0] + k][1]} in place of "
                f"{names[which[0]][1]}): a frame was lost there. Name or move the files so that pairs have one number"
            )
    return tuple(told)


def _both(turn: Array, shift: Array) -> Array:
    """(..., 6, 6) of rotations (..., 3, 3) of a turn and of a shift."""
    B = np.zeros((*turn.shape[:-2], 6, 6))
    B[..., :3, :3], B[..., 3:, 3:] = turn, shift
    return B


def rotation_vectors(R: Array) -> Array:
    """Rotation vectors (..., 3) [rad] of rotations (..., 3, 3); of half turns, some vector as long as pi."""
    turns = scipy.spatial.transform.Rotation.from_matrix(R.reshape(-1, 3, 3))
    return np.asarray(turns.as_rotvec(), np.float64).reshape(R.shape[:-1])
