"""Which images of the two cameras are pairs: as stored, with the board turned, mirrored, in another order, delayed.

Each image alone, with a rough camera, gives a pose of the board, and two images give the relative pose of the cameras.
Correct pairs agree on one relative pose, wrong pairs do not; the likelihood of a hypothesis about which images belong
together is the agreement of its pairs. Distances are in pixels, weighted by the covariance of the two poses of the
board: poorly determined directions (a shift along the axis) have little weight. As some boards were moved, errors have
long tails: the log likelihood of a pair is minus the logarithm of its squared distance.
"""

from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass, field, replace

import numpy as np

from calibration.board.chessboard import BoardNotFound, CornerView, Located
from calibration.cameras.camera import CAMERA_NAMES, Camera, by_turning, project_with_jacobians, vector_from_rotation
from calibration.fit.stereo_model import Observations, StereoModel
from calibration.kit.errors import CalibrationError
from calibration.kit.types import AnyArray, Array, Indices, Mask, evenly

FLOOR = 1e-3  # of the image's longer side: accuracy of poses by rough cameras; views that differ by less are identical
# Ratio of distances, one hypothesis over another, above which the other one is believed: another order of the images
# over that stored; one place of the cameras over two. The latter is below 2 in 400 synthetic sets with random motion.
# Of 31 photographed sets, two have 8.8 and 4.5, and OpenCV confirms the steps; the next one has 2.2.
NEARER = 3.0
TWICE = 2.0  # times what is expected by chance, up to which a motion, a disagreement or an agreement is not significant
# Outliers, in usual distances. Of Gaussian motions (F of 6 and 24 degrees of freedom) one in 10^9 is as far; the
# motions of hand-held boards have longer tails.
TOO_FAR = 5.0
MOST_LATE = 8  # largest delay between the two cameras, in views
MIN_VIEWS = 3  # Zhang: fewer do not determine a camera; as few pairs may agree by chance
GOOD_VIEWS = 8  # fewer are not enough to test lenses, or views against each other
MOST_TRIED = 30  # pairs whose relative pose is tried, views used by OpenCV: its time grows with their third power
Pose = tuple[Array, Array]  # rotation (3, 3) and translation (3,) of the board in a camera's axes
Names = Sequence[tuple[str, str]]
Views = tuple[list[Located], list[Located]]


@dataclass(frozen=True)
class BoardPoses:
    """Poses of the board in n images of one camera, from that camera alone."""

    views: Indices  # (n,) ascending numbers of the images
    R: Array  # (n, 3, 3) board to camera
    middle: Array  # (n, 3) [m] of the board
    covariance: Array  # (n, 6, 6) of rotation and shift of the middle, for 1 px of noise, times the number of points

    def __getitem__(self, index: AnyArray) -> "BoardPoses":
        return BoardPoses(self.views[index], self.R[index], self.middle[index], self.covariance[index])

    def of(self, views: AnyArray) -> "BoardPoses":
        """Those of images with these numbers."""
        return self[np.searchsorted(self.views, views)]

    def turned(self, turn: Array, mirror: bool = False) -> "BoardPoses":
        """With the board rotated (3, 3) about its middle, and, if `mirror`, the camera's x reversed."""
        F = np.diag([-1.0 if mirror else 1.0, 1.0, 1.0])
        B = _both(-F if mirror else F, F)  # a rotation is an axial vector
        return BoardPoses(self.views, F @ self.R @ turn, self.middle @ F, B @ self.covariance @ B.T)


def count_once(views: Views, names: Names, table_view: int | None) -> None:
    """Leave out, in place, views that repeat another view, such as copies of a file or a video of a board at rest.

    Raises CalibrationError if images of one camera repeat each other while the other's do not.
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


def _same_place(side: Sequence[Located]) -> Mask:
    """(n, n) whether two images of a camera show the board in the same place, or neither shows it."""
    found = np.array([isinstance(view, CornerView) for view in side], bool)
    same = ~found[:, None] & ~found
    views = [view for view in side if isinstance(view, CornerView)]
    points = np.array([np.where(view.accepted[:, None], view.points, np.nan) for view in views])
    for v, seen, view in zip(np.flatnonzero(found), points, views, strict=True):
        square = np.sum((points - seen) ** 2, axis=2)
        limit = (FLOOR * max(view.image_size)) ** 2
        same[v, found] = np.nansum(square, axis=1) < limit * np.isfinite(square).sum(axis=1)
    return same


def poses_of(poses: Iterable[tuple[int, Pose]], seen_by: Observations, points: Array, camera: Camera) -> BoardPoses:
    """Poses in images of these numbers, with covariances.

    seen_by : observations of the camera;  points : (n, 3) [m] of the target
    """
    middle = points.mean(0)
    found: list[tuple[int, Array, Array, Array]] = []
    for view, (R, t) in poses:
        seen, at = points[seen_by.point[seen_by.view == view]] @ R.T + t, R @ middle + t
        d_point = project_with_jacobians(seen, camera)[1]
        J = np.concatenate([by_turning(d_point, seen - at), d_point], axis=-1).reshape(-1, 6)
        information = J.T @ J / len(seen)
        information += 1e-9 * np.diag(np.diag(information))  # points on a line leave one rotation undetermined
        found.append((view, R, at, np.linalg.inv(information)))
    return BoardPoses(*(np.stack(part) for part in zip(*found, strict=True)))


def apart(left: BoardPoses, right: BoardPoses, R_pair: Array, t_pair: Array) -> Array:
    """(m, n) [px] distances of n pairs from m relative poses of the right camera: (m, 3, 3) and (m, 3) [m]."""
    back = np.swapaxes(R_pair, 1, 2)[:, None]
    turn = vector_from_rotation(back @ right.R @ np.swapaxes(left.R, 1, 2))
    shift = (back @ (right.middle - t_pair[:, None])[..., None])[..., 0] - left.middle
    B = _both(back, back)
    step = np.concatenate([turn, shift], axis=-1)
    known = np.linalg.solve(left.covariance + B @ right.covariance @ np.swapaxes(B, 2, 3), step[..., None])[..., 0]
    return np.asarray(np.sqrt(np.maximum(np.sum(step * known, axis=-1), 0.0)), np.float64)


def relative_poses(left: BoardPoses, right: BoardPoses) -> tuple[Array, Array]:
    """Relative pose of the cameras from each pair alone: R_right_left (n, 3, 3) and t_right_left (n, 3) [m]."""
    R = right.R @ np.swapaxes(left.R, 1, 2)
    return R, right.middle - np.einsum("nij,nj->ni", R, left.middle)


Paired = tuple[BoardPoses, list[BoardPoses]]  # of pairs: in the left images, and in the right ones for each symmetry


@dataclass(frozen=True)
class Pairs:
    """Which views are pairs: their two images, each with its own pose of the board, agree with the other pairs."""

    model: StereoModel  # with a pose of the board for each image alone
    views: Indices  # with such poses in both images
    odd: dict[int, str] = field(default_factory=dict)  # view -> why its two images are no pair
    bad_images: dict[tuple[int, int], str] = field(default_factory=dict)  # (view, camera) -> why it is not used at all
    # If a camera was moved between views: the stretches of pairs before and after each step; and for each step its
    # rotation [rad], shift [m], and the typical distance [px] in the right image between pairs on opposite sides, and
    # between pairs on one side
    stretches: tuple[tuple[int, ...], ...] = ()
    steps: tuple[tuple[float, float, float, float], ...] = ()
    kept: int = 0  # the stretch that determines the stereo pose

    @property
    def others(self) -> tuple[int, ...]:
        """The views of the other stretches."""
        return tuple(v for k, stretch in enumerate(self.stretches) if k != self.kept for v in stretch)

    @property
    def apart(self) -> set[int]:
        """Views whose images are used separately, each for its own camera."""
        return {*self.odd, *self.others}

    def joined(self, observations: Observations) -> StereoModel:
        """The model with one pose per pair, from the image that shows more of the board; views apart keep two."""
        R, t = self.model.R_left_board.copy(), self.model.t_left_board.copy()
        image = 2 * observations.view + observations.camera
        both = np.setdiff1d(np.arange(len(R)), [*self.apart])
        fuller = np.bincount(image, minlength=2 * len(R)).reshape(-1, 2).argmax(axis=1)[both]
        R[both], t[both] = (of[both, fuller][:, None] for of in (R, t))
        return replace(self.model, R_left_board=R, t_left_board=t)


@dataclass(frozen=True)
class Pairing:
    """The most likely relative pose of the cameras, and the pairs' agreement with it."""

    R_right_left: Array  # (3, 3)
    t_right_left: Array  # (3,) [m]
    order: Indices  # (n,) index of the board's symmetry in the right image of each pair
    distance: Array  # (n,) [px]
    evidence: float  # mean log likelihood of the pairs
    floor: float  # [px]

    @property
    def usual(self) -> float:
        """[px] Typical distance of pairs that agree: the median of the better half."""
        return max(float(np.quantile(self.distance, 0.25)), self.floor)

    @property
    def agrees(self) -> Mask:
        """(n,) pairs that agree with this relative pose."""
        return self.distance < TOO_FAR * self.usual


def most_likely(left: BoardPoses, turns_of_right: Sequence[BoardPoses], floor: float) -> Pairing:
    """The most likely relative pose of the cameras; turns_of_right : with the board in each of its symmetries."""
    n = len(left.R)
    tried = np.array(evenly(n, MOST_TRIED))
    poses = [relative_poses(left[tried], right[tried]) for right in turns_of_right]
    R, t = (np.concatenate(part) for part in zip(*poses, strict=True))
    distance = np.stack([apart(left, right, R, t) for right in turns_of_right])  # (orders, candidates, n)
    nearest = distance.min(axis=0)
    own = np.tile(tried, len(poses))
    likelihood = -np.log(floor**2 + nearest**2)
    likelihood[np.arange(len(own)), own] = 0.0  # a pair agrees with its own relative pose exactly
    best = int(np.argmax(likelihood.sum(axis=1)))
    order, near = distance[:, best].argmin(axis=0), nearest[best]
    found = Pairing(R[best], t[best], order, near, float(likelihood[best].sum() / max(n - 1, 1)), floor)
    shifts = np.stack([relative_poses(left, right)[1] for right in turns_of_right])[order, np.arange(n)]
    return replace(found, t_right_left=np.median(shifts[found.agrees], axis=0))


def board_turns(n: int) -> list[Array]:
    """The n symmetries of a grid of points as rotations (3, 3) in its plane, in the order of `orders`."""
    quarter = np.array([[0.0, -1.0, 0.0], [1.0, 0.0, 0.0], [0.0, 0.0, 1.0]])
    return [np.linalg.matrix_power(quarter, k * 4 // n) for k in range(n)]


def paired(
    sides: tuple[BoardPoses, BoardPoses], nominal: Array, n_orders: int, floor: float, names: Names
) -> tuple[Pairing, list[str]]:
    """The pairs as stored, and warnings about them. Raises CalibrationError if they are no pairs.

    sides : poses of the board in the images of each camera
    names : (left, right) of all views; n_orders : number of symmetries of the target
    """
    (left, right), is_square = sides, np.allclose(*np.ptp(nominal, axis=0)[:2])
    as_seen = [right.turned(turn) for turn in board_turns(n_orders)]
    mirrored = [right.turned(turn @ np.diag([-1.0, 1.0, 1.0]), True) for turn in board_turns(4 if is_square else 2)]

    def pairs_of(right_of: AnyArray, among: AnyArray = left.views, turns: Sequence[BoardPoses] = as_seen) -> Paired:
        both = among[np.isin(right_of[among], right.views)]
        return left.of(both), [one.of(right_of[both]) for one in turns]

    number = np.arange(len(names))
    of_left, of_right = pairs_of(number)
    n = len(of_left.views)
    if not n:
        raise CalibrationError("no view shows the target to both cameras: the pair cannot be calibrated")
    stored = most_likely(of_left, of_right, floor)
    if n < MIN_VIEWS or (stored.agrees.all() and stored.usual < TOO_FAR * floor):
        return stored, []
    shifts = [k for k in range(-MOST_LATE, MOST_LATE + 1) if abs(k) < n - MIN_VIEWS]
    orders = [(f"{abs(k)} {'late' if k > 0 else 'early'}", number + k) for k in shifts if k]
    orders += [("in reversed order", number[::-1] + k) for k in shifts]
    tried = [("", number, pairs_of(number, turns=mirrored)), *((how, by, pairs_of(by)) for how, by in orders)]
    others = [(how, by, a.views, most_likely(a, b, floor)) for how, by, (a, b) in tried if len(a.views) > MIN_VIEWS]
    if others:
        how, by, which, found = max(others, key=lambda one: one[-1].evidence)
        likelier = found.evidence > stored.evidence + 2.0 * np.log(NEARER)
        if likelier and 2 * found.agrees.sum() > len(which):
            raise CalibrationError(_reason(how, found, stored, [(names[v][0], names[by[v]][1]) for v in which]))
    _require_agreement(stored, [found.evidence for how, _, _, found in others if how])
    notes = _late(pairs_of, of_left.views[~stored.agrees], stored, names)
    if notes and 2 * stored.agrees.sum() <= n:
        raise CalibrationError(f"{'; '.join(notes)}. As stored {stored.agrees.sum()} of {n} pairs are right")
    return stored, notes


def _reason(how: str, found: Pairing, stored: Pairing, names: Names) -> str:
    """Why pairs of these names are more likely than those stored, and what to do.

    how : delay or order of the right views; "": as stored, with the images of one camera mirrored
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
    """Raise CalibrationError if the pairs agree no better than pairs in other orders; others : their evidence."""
    n = len(stored.distance)
    if n < GOOD_VIEWS or not others or stored.usual < TOO_FAR * stored.floor:
        return
    if stored.evidence <= float(np.median(others)) + 2.0 * np.log(TWICE):
        raise CalibrationError(
            f"the {n} pairs agree on no common place of the cameras: they differ by {stored.usual:.2g} px and more, as "
            f"images do that are no pairs. Other orders, up to {MOST_LATE} views late or early, and mirrored images "
            "do not fit either: left and right image of each number must show the board in one place"
        )


def _late(pairs_of: Callable[[AnyArray, AnyArray], Paired], odd: Indices, found: Pairing, names: Names) -> list[str]:
    """Warnings about pairs among the `odd` that would agree with a later or an earlier right view."""
    rest, notes = odd, []
    for k in sorted(range(-MOST_LATE, MOST_LATE + 1), key=abs)[1:]:
        left, turns = pairs_of(np.arange(len(names)) + k, rest)
        off = np.min([apart(left, right, found.R_right_left[None], found.t_right_left[None])[0] for right in turns], 0)
        which = left.views[off < TOO_FAR * found.usual]
        rest = np.setdiff1d(rest, which)
        if len(which) >= MIN_VIEWS:
            notes.append(
                f"{names[which[0]][0]} to {names[which[-1]][0]}: {len(which)} pairs agree with the others if the right "
                f"view {abs(k)} {'later' if k > 0 else 'earlier'} is taken ({names[which[0] + k][1]} in place of "
                f"{names[which[0]][1]}): a frame was lost there. Name or move the files so that pairs have one number"
            )
    return notes


def _both(turn: Array, shift: Array) -> Array:
    """(..., 6, 6) block diagonal matrix of rotations (..., 3, 3) for a rotation vector and for a shift."""
    B = np.zeros((*turn.shape[:-2], 6, 6))
    B[..., :3, :3], B[..., 3:, 3:] = turn, shift
    return B
