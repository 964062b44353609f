"""The table from the disc: a rolling rim touches the table along a circle, which determines a plane.

With the plane z = c + a (x - x0) + b (y - y0) in world axes, (x0, y0) the middle of the contacts, and its normal
n = (-a, -b, 1) / |...|, the disc's lowest point A lies above it by n . (A - (x0, y0, c)), where

    A = t - r e2 - h e3 (e2 up the disc's slope against n); to first order gap = z_A - c - a (x_A - x0) - b (y_A - y0).

Height and slopes follow from the gaps of all frames, more accurately than from a board, with its thickness and bow.
Both planes have a covariance (common errors of the cameras count once: the poses' sensitivity to the rig), and are
combined by their weights. Only the world frame is moved; the cameras stay as calibrated relative to each other.

The difference between board and disc also bounds the errors of both, as two errors hardly cancel. So tolerances of the
board, and separately of the disc, that are assumed and not declared are reduced to the observed difference.

If they differ by more than both sigmas allow, usually the board is bent. But the table may have a hollow, which is a
slope along the track; a wrong radius or thickness, a camera that moved, or a sheet of dots off the disc's centre have
the same effect. So the part of the correction beyond the sigmas is added to the sigma of the table, and to that of the
dots' position on the disc (`off_centre`). It is stored, and fits of the motion free the table's plane by this amount.

This is geometry alone. If the table is not level, the world frame is tilted with it against gravity.
"""

from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import scipy

from calibration.cameras.camera import N_RIG, WORLD_SHIFT, WORLD_TURN, Allowance, StereoRig
from calibration.kit.types import Array, Mask, robust_sigma
from disctrack import frames
from disctrack.analyse.declaration import lowest_arm
from disctrack.analyse.derivatives import K
from disctrack.disc import Disc
from disctrack.numbers import measured
from disctrack.track.pose import PoseFits
from disctrack.track.side_by_side import SURE, parts

OF_PATTERN = "where the dots are on the disc"
DISAGREEMENT = "board and disc disagree about the table"
MIN_FRAMES = 30  # fewer poses are too close together: their plane would absorb common errors
# Below, the direction of the contact is noise; above, the disc stands on its rim and may slide or fall.
THETA_RANGE = np.radians(0.7), np.radians(85.0)
MAX_SCATTER = 30e-6  # [m] of the gaps about their plane: beyond, the disc jumps or the poses are wrong
NOISY = 6.0  # the same limit relative to the predicted scatter of the poses; the larger one applies
# Standard deviations [m] of radius and thickness if not declared: 0.02 %, and that of a micrometer gauge
ASSUMED_RADIUS, ASSUMED_THICKNESS = 7.5e-6, 3e-6
STEEP = 0.1  # slope above which the plane is not the table: the board of the declared view lay elsewhere
PLACES = 6.0  # number of independent values of the cameras' smooth errors in a whole turn of the contact


@dataclass(frozen=True)
class TableFromDisc:
    """The plane touched by the rim, in the axes of the board's table, and the correction of the world frame."""

    source: str  # "board", "disc" or "both": what determines the world's table
    plane: Array  # (3,) height in the middle of the contacts [m], slopes along x and y, against the table by the board
    middle: Array  # (2,) [m] of the contacts, x and y
    sigma: Array  # (3,) of the plane by the disc: noise, systematic errors, tolerances of the disc
    board_sigma: Array  # (3,) of the table by the board, from the rig's covariance
    applied: Array  # (3,) by which the world was moved
    beyond: tuple[float, float, float]  # part of this that exceeds both sigmas: at the origin [m], slopes
    probability: float  # of a difference as large if both sigmas are right

    @property
    def sentence(self) -> str:
        """What a summary says."""
        z, *slopes = self.plane
        sigma = np.hypot(self.sigma, self.board_sigma)
        told = (
            f"by the disc's rim the table lies {measured(1e6 * z, 1e6 * sigma[0], 'um')} from the board's, turned by "
            f"{measured(np.degrees(np.hypot(*slopes)) * 1e3, np.degrees(sigma[1:].max()) * 1e3, 'mdeg')}"
        )
        used = {"both": "the two are combined", "board": "the board counts", "disc": "the disc counts"}[self.source]
        return f"{told}; {used} ([table] from)"

    def details(self, theta: Array, disc: Disc) -> dict[str, Any]:
        """Fields as JSON types, with the distance [m] of the dots' centre from the disc's that would be significant.

        theta : (n,) as for `off_centre`. Above this distance board and disc disagree.
        """
        fields = {name: v.tolist() if isinstance(v, np.ndarray) else v for name, v in vars(self).items()}
        lean = SURE * np.hypot(self.sigma, self.board_sigma)[1:].max()
        least = float(disc.radius * lean / np.sin(np.nanmedian(theta)))
        return {**fields, "least_off_centre": least, "told": self.sentence}


def table_from_disc(
    fits: PoseFits, systematic: Array, rig: StereoRig, disc: Disc, source: str = "both", by_pattern: Array | None = None
) -> tuple[PoseFits, Array, StereoRig, TableFromDisc | None]:
    """Poses, their systematic covariance and rig, in a world whose table is that of board, disc or both.

    fits : with the covariances of the frames' noise; systematic (n, 6, 6). The arrays of both are altered and returned
    source : "board", "disc" or "both"; with "board" nothing is moved, and the difference is reported
    by_pattern : (n, 6, k) change of the poses by one sigma of the pattern's position on the disc, which is not in
        `systematic`: a pattern off the centre by d moves the rim up and down by d sin(theta) as the disc turns, which
        looks like a tilted table while phi follows -psi
    None, and nothing changed, if the rig has no table or the disc did not touch one near it.
    """
    by_pattern = np.zeros((len(systematic), 6, 0)) if by_pattern is None else by_pattern
    found = _contacts(fits, systematic, disc, by_pattern) if rig.world_is_table else None
    if found is None or np.abs(found[0][1:]).max() > STEEP:
        return fits, systematic, rig, None
    plane, middle, H, noise, by_disc, by_place = found
    noise = noise + by_place @ by_place.T
    # excess thickness lifts the dots, which are measured, by twice as much as the disc's centre
    of_dots, narrower = np.array([1.0, 2.0]), np.ones(2)
    V, board = noise + (by_disc * of_dots**2) @ by_disc.T, H @ rig.covariance @ H.T
    chance = float(scipy.special.chdtrc(3, np.linalg.solve(board + V, plane) @ plane))
    of_disc, of_board = (np.sqrt(np.diag(C)) for C in (noise + by_disc @ by_disc.T, board))
    if source == "both":
        rig, narrower = _narrowed(rig, by_disc * of_dots, disc, plane, H, noise)
        by_disc = by_disc * narrower
        V, board = noise + (by_disc * of_dots**2) @ by_disc.T, H @ rig.covariance @ H.T
    # a difference above three combined sigmas is attributed to the board: it bends, and lies on dust
    allowed = np.diag(board + V)
    excess = np.where(plane**2 > SURE**2 * allowed, plane**2 - allowed, 0.0)
    more = board + np.diag(excess)
    # weight of the plane by the disc, as these cameras see it: common errors cancel
    gain = more @ np.linalg.inv(more + V) if source == "both" else np.eye(3) * (source == "disc")
    beyond = np.minimum(excess, (gain @ plane) ** 2)
    in_doubt = np.sqrt(beyond) * (source == "both")
    beyond[0] += middle**2 @ beyond[1:]  # at the origin
    height, slope_x, slope_y = np.sqrt(beyond).tolist()
    told = TableFromDisc(source, plane, middle, of_disc, of_board, gain @ plane, (height, slope_x, slope_y), chance)
    # remaining variance of the height by the disc's thickness, and by the part beyond the sigmas
    left = ((1.0 - gain[0, 0]) * narrower[1] * thickness_tolerance(disc) / 2.0) ** 2 + in_doubt[0] ** 2
    e3 = np.nan_to_num(fits.R_world_body[..., 2])
    systematic[:, :3, :3] += left * e3[:, :, None] * e3[:, None, :]
    if source != "board":
        rig = _as_sure_as_both(rig, middle, gain, H, noise, by_disc, by_place, in_doubt)
        fits, rig = _on_plane(fits, systematic, rig, told)
    return fits, systematic, rig, told


def _as_sure_as_both(
    rig: StereoRig, middle: Array, gain: Array, H: Array, noise: Array, by_disc: Array, by_place: Array, in_doubt: Array
) -> StereoRig:
    """The rig with covariance and allowances of a world whose table is moved by gain @ plane.

    in_doubt : (3,) part of the correction of the plane beyond both sigmas
    """
    turn = rig.R_left_world
    M = np.zeros((N_RIG, 3))  # d RIG_PARAMETERS / d plane: the world is moved onto it
    M[WORLD_TURN] = turn @ np.array([[0.0, 0.0, 1.0], [0.0, -1.0, 0.0], [0.0, 0.0, 0.0]])
    M[WORLD_SHIFT] = turn[:, 2:] * np.array([1.0, *-middle])
    moved = M @ gain
    kept = np.eye(N_RIG) - moved @ H
    stated = noise + by_disc @ by_disc.T
    doubted = M * in_doubt
    covariance = kept @ rig.covariance @ kept.T + moved @ stated @ moved.T + doubted @ doubted.T
    allowances = [replace(a, shift=kept @ a.shift) for a in rig.allowances]
    allowances.append(Allowance("the disc's radius", moved @ by_disc[:, 0]))
    allowances.append(Allowance("the disc's thickness", moved @ by_disc[:, 1]))
    allowances += [Allowance(OF_PATTERN, moved @ column) for column in by_place.T if column.any()]
    allowances += [Allowance(DISAGREEMENT, column) for column in doubted.T if column.any()]
    return replace(rig, covariance=0.5 * (covariance + covariance.T), allowances=tuple(allowances))


def off_centre(table: TableFromDisc | None, theta: Array, disc: Disc) -> float:
    """Distance [m] of the dots' centre from the disc's that would explain the tilt of the table beyond the sigmas.

    theta : (n,) nutation [rad]; in a turn, the rim rises by this distance times sin(theta) on one side.
    """
    if table is None or table.source != "both":
        return 0.0
    return float(disc.radius * np.hypot(*table.beyond[1:]) / np.sin(np.nanmedian(theta)))


def radius_tolerance(disc: Disc) -> float:
    """Standard deviation of the disc's radius [m], as declared or assumed."""
    return ASSUMED_RADIUS if disc.radius_tolerance is None else disc.radius_tolerance


def thickness_tolerance(disc: Disc) -> float:
    """Standard deviation of the disc's thickness [m], as declared or assumed."""
    return ASSUMED_THICKNESS if disc.thickness_tolerance is None else disc.thickness_tolerance


def _narrowed(
    rig: StereoRig, by_disc: Array, disc: Disc, plane: Array, H: Array, noise: Array
) -> tuple[StereoRig, Array]:
    """Rig with assumed tolerances reduced to the size of `plane`, and factors (2,) on those assumed for the disc.

    Each tolerance is compared with the height or slope on which it has the most significant effect; none increases.
    """
    shifts = np.array([a.shift for a in rig.allowances]).reshape(-1, N_RIG)
    of_board = np.array([a.assumed for a in rig.allowances], bool)
    of_disc = np.array([disc.radius_tolerance is None, disc.thickness_tolerance is None])
    declared = by_disc[:, ~of_disc]
    known = rig.covariance - (shifts.T * of_board) @ shifts
    told = np.diag(H @ known @ H.T + noise + declared @ declared.T)
    seen = np.maximum(plane**2, told)  # differences below the sigma are not resolved

    def factors(columns: Array, assumed: Mask) -> Array:
        whole = np.maximum(np.sum(columns[:, assumed] ** 2, axis=1), 1e-300)  # (3,)
        most = np.argmax(columns**2 / told[:, None], axis=0)  # component with the most significant effect
        return np.where(assumed, np.sqrt(np.minimum(1.0, seen / whole))[most], 1.0)

    scale = factors(H @ shifts.T, of_board)
    allowances = tuple(replace(a, shift=a.shift * k) for a, k in zip(rig.allowances, scale, strict=True))
    covariance = known + (shifts.T * (of_board * scale**2)) @ shifts
    return replace(rig, covariance=covariance, allowances=allowances), factors(by_disc, of_disc)


def _contacts(fits: PoseFits, systematic: Array, disc: Disc, by_pattern: Array) -> tuple[Array, ...] | None:
    """See `TableFromDisc`: plane, middle, d plane / d RIG_PARAMETERS (3, 30), covariance of the plane by noise, its
    changes by one tolerance of radius and thickness (3, 2), and by the pattern's position (3, k).
    """
    theta = np.arccos(np.clip(fits.R_world_body[:, 2, 2], -1, 1))
    rows = np.flatnonzero(fits.converged & (theta > THETA_RANGE[0]) & (theta < THETA_RANGE[1]))
    if len(rows) < MIN_FRAMES:
        return None
    R, t = fits.R_world_body[rows], fits.t_world_body[rows]
    plane, kept = np.zeros(3), np.ones(len(rows), bool)
    wide = STEEP * np.array([disc.radius, 1.0, 1.0])  # prior sigmas, for short arcs of contacts
    middle = np.median(t + lowest_arm(R[..., 2], K, disc), axis=0)[:2]
    for _ in range(6):
        normal = np.array([-plane[1], -plane[2], 1.0])
        normal /= np.linalg.norm(normal)
        arm = lowest_arm(R[..., 2], normal, disc)
        contact = t + arm
        gap = (contact - [*middle, plane[0]]) @ normal
        A = np.column_stack([np.ones(len(rows)), contact[:, :2] - middle])
        information = A[kept].T @ A[kept] + np.diag((1e-6 / wide) ** 2)  # for gaps with a scatter of a micrometre
        step = np.linalg.solve(information, A[kept].T @ gap[kept])
        plane = plane + step
        left = gap - A @ step
        spread = robust_sigma(left)
        kept = np.abs(left) < 4.0 * spread + 1e-9
    by_pose = np.concatenate([np.broadcast_to(normal, t.shape), np.cross(arm, normal)], axis=1)
    noise, repeats = (
        float(np.median(np.einsum("ni,nij,nj->n", by_pose, C[rows], by_pose))) for C in (fits.covariance, systematic)
    )
    gap_by_place = np.einsum("ni,nik->nk", by_pose, by_pattern[rows])
    told = noise + repeats + float(np.median(np.sum(gap_by_place**2, axis=1)))
    if spread > max(MAX_SCATTER, NOISY * np.sqrt(told)) or kept.sum() < max(MIN_FRAMES, 0.5 * len(rows)):
        return None
    repeats = max(repeats, spread**2 - noise, 0.0)
    inverse = np.linalg.inv(information)
    gain = inverse @ A.T * kept
    azimuth = np.unwrap(np.arctan2(arm[:, 1], arm[:, 0])[kept])
    independent = np.clip(PLACES * np.ptp(azimuth) / (2 * np.pi), 1.0, PLACES)
    gap_by_rig = [np.einsum("ni,nij->nj", by_pose[part], fits.sensitivity[rows[part]]) for part in parts(len(rows))]
    sine = np.sqrt(np.maximum(1.0 - (R[:, :, 2] @ normal) ** 2, 0.0))
    by_disc = gain @ np.stack([sine * radius_tolerance(disc), R[:, 2, 2] * 0.5 * thickness_tolerance(disc)], axis=1)
    covariance = inverse * (noise + repeats * max(kept.sum() / independent, 1.0))
    by_rig = -gain @ np.concatenate(gap_by_rig)
    return plane, middle, by_rig, covariance, by_disc, gain @ gap_by_place


def _on_plane(fits: PoseFits, systematic: Array, rig: StereoRig, table: TableFromDisc) -> tuple[PoseFits, StereoRig]:
    """Poses, covariances and rig in the axes of a world moved onto the table; the origin moves along k only.

    The covariances `systematic`, and those of the poses, are altered.
    """
    height, a, b = table.applied
    Q = frames.rotation_from_vector(np.array([b, -a, 0.0]))  # R_old_new
    shift = np.array([0.0, 0.0, height - table.applied[1:] @ table.middle])
    both = np.kron(np.eye(2), Q.T)
    for rows in parts(len(systematic)):  # in place: these are the largest arrays of a long recording
        fits.sensitivity[rows] = both @ fits.sensitivity[rows]
        for covariance in (fits.covariance, systematic):
            covariance[rows] = both @ covariance[rows] @ both.T
    moved = replace(fits, R_world_body=Q.T @ fits.R_world_body, t_world_body=(fits.t_world_body - shift) @ Q)
    rig = replace(rig, R_left_world=rig.R_left_world @ Q, t_left_world=rig.t_left_world + rig.R_left_world @ shift)
    return moved, rig
