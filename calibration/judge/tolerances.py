"""The rig in the lab frame, the table under one view, with its covariance: by the views, and by the board's sizes.

Views of a board show its shape: how much longer it is along one side than along the other, how it is bent, how far
corners are off a regular grid. They do not show its size, nor the face it lies on. Where no tolerance was declared,
what is seen sets the size of what is not: e_x and e_y, by which the two sides are too long, are taken for normal with
one variance v, of which the views tell one number, d = e_x - e_y. So v = d^2 / 2, e_x = -e_y = d / 2, and their mean,
the size of the board, is 0 +- |d| / 2; a board whose sides are equally long to 0.0003 % was made to about that. One
number tells a variance within a factor of ten only; whoever knows better declares a tolerance, which is used as it is.
"""

from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from calibration.cameras.camera import N_RIG, PAIR_SHIFT, WORLD_SHIFT, WORLD_TURN, Allowance, StereoRig
from calibration.fit.refinement import Refinement
from calibration.fit.stereo_model import N_STEREO, board_basis
from calibration.kit.arrays import Array
from calibration.kit.least_squares import scaled_solve

ASSUMED_THICKNESS = 20e-6  # [m] standard deviation, a calliper's
SIZE, FLATNESS, THICKNESS = "the board's size", "the board's flatness", "the board's thickness"


@dataclass(frozen=True)
class BoardTolerances:
    """Standard deviations as declared; None: not declared, so that the views tell, or a default for the thickness."""

    square: float | None = None  # relative, of lengths along one side, in the mean over the board
    flatness: float | None = None  # [m] of the printed face as it lies on the table, against the plane through it
    thickness: float | None = None  # [m]


@dataclass(frozen=True)
class BoardShape:
    """A board against the declared one, as far as its views tell."""

    stretch: float  # relative: lengths along i beyond those along j
    stretch_sigma: float
    lift: float  # [m] of the mean plane of the printed face above where a face as bent would touch a table
    lift_sigma: float
    misprint: float  # [m] rms per coordinate of the corners in their plane, beyond stretch and shear; 0 if not refined
    refined: bool  # the calibration's board has this shape; else it was taken as flat, and this is what that leaves


def board_shape(refinement: Refinement, nominal: Array, inflation: float) -> BoardShape:
    """The smooth part of a board's shape with its sigma, whichever model of the board was refined.

    nominal : (n, 3) [m] the target's points as declared, on a grid
    inflation : factor on the covariance that follows from the points' noise
    """
    n, warp = len(nominal), board_basis(nominal, "warped")
    free, s1 = refinement.terms.board == "free", refinement.problem.stereo_basis.shape[1]
    basis, to_smooth = board_basis(nominal, "free") if free else warp, np.linalg.pinv(warp.reshape(3 * n, -1))
    normal = refinement.problem.with_shape(nominal, basis).linearise(
        refinement.model
    )  # with a step beyond a flat board
    departure = (refinement.model.points - nominal + basis @ normal.step()[0][s1:]).reshape(-1)
    found, onto = to_smooth @ departure, to_smooth @ basis.reshape(3 * n, -1)
    C = onto @ normal.covariances()[0][s1:, s1:] @ onto.T
    C = inflation * C
    left = (departure.reshape(n, 3) - warp @ found)[:, :2]
    size = float(np.abs(nominal - nominal.mean(0)).max())
    heights = _over_the_board(nominal, warp[:, 2, :3])
    return BoardShape(
        stretch=float(found[3]) / size,
        stretch_sigma=float(np.sqrt(C[3, 3])) / size,
        lift=-float((heights @ found[:3]).min()),
        lift_sigma=float(np.sqrt(np.mean(np.einsum("ni,ij,nj->n", heights, C[:3, :3], heights)))),
        misprint=float(np.sqrt(np.mean(left**2))) if free else 0.0,
        refined=refinement.terms.board != "flat",
    )


def shape_left_out(
    refinement: Refinement, nominal: Array, boards: tuple[str, ...], inflation: float
) -> tuple[Array, float]:
    """What a board of more freedom than the refined one's would change: covariance (s1, s1) of the stereo parameters.

    One step of a refinement with each further shape of `boards`, simplest first: a board that is taken for flat and is
    not pulls the cameras by what the step takes back. As much of it counts as is no noise (of chi-square, its expected
    part is taken off). The second item is the largest of these shifts, in the parameters' own sigmas.
    """
    problem, s1 = refinement.problem, refinement.problem.stereo_basis.shape[1]
    sigma = np.sqrt(inflation * np.diag(refinement.normal.covariances()[0])[:s1])
    left_out, largest = np.zeros((s1, s1)), 0.0
    shift, chi_square, n = np.zeros(s1), 0.0, problem.shape_basis.shape[-1]
    for board in boards[boards.index(refinement.terms.board) + 1 :]:
        basis = board_basis(nominal, board)
        normal = problem.with_shape(nominal, basis).linearise(refinement.model)
        step, C = normal.step()[0], inflation * normal.covariances()[0][s1:, s1:]
        gain = float(step[s1:] @ scaled_solve(C, step[s1:])) - chi_square
        further = max(0.0, 1.0 - (basis.shape[-1] - n) / max(gain, 1e-300)) ** 0.5 * (step[:s1] - shift)
        left_out += np.outer(further, further)
        largest = max(largest, float(np.max(np.abs(further) / sigma)))
        shift, chi_square, n = step[:s1], chi_square + gain, basis.shape[-1]
    return left_out, largest


def _over_the_board(nominal: Array, heights: Array) -> Array:
    """Heights (n, k) of smooth shapes at the corners, continued to the outer edge of the squares beyond them."""
    x, y = (nominal - nominal.mean(0))[:, :2].T

    def terms(x: Array, y: Array) -> Array:
        return np.stack([np.ones_like(x), x, y, x * x, x * y, y * y], axis=-1)

    step = np.array([np.diff(np.unique(np.round(side, 9))).min() for side in (x, y)])
    u, v = (np.linspace(-1.0, 1.0, 21) * (np.abs(side).max() + s) for side, s in zip((x, y), step, strict=True))
    wide = np.stack(np.meshgrid(u, v), axis=-1).reshape(-1, 2)
    found: Array = terms(*wide.T) @ np.linalg.lstsq(terms(x, y), heights, rcond=None)[0]
    return found


def on_the_table(nominal: Array, shape: BoardShape) -> Array:
    """(3,) [m] of the world's origin above the table by one declared thickness, in the axes of a board of this shape.

    Below its corner 0, which a stretch has moved, and where its lowest parts are.
    """
    if not shape.refined:
        return np.zeros(3)
    middle = nominal.mean(0)
    x, y = -0.5 * shape.stretch, 0.5 * shape.stretch  # of the middle against its corner 0
    return np.array([x * middle[0], y * middle[1], -shape.lift])


def with_tolerances(
    rig: StereoRig,
    nominal: Array,
    table_view: int | None,
    board_thickness: float,
    tolerances: BoardTolerances,
    shape: BoardShape,
) -> StereoRig:
    """The rig with what the board's sizes may be off by in its covariance, and listed by cause.

    A board that is larger by s makes every length longer: t -> (1 + s) t, cameras and world alike. One that is longer
    along one side than was seen has its corner 0, the world's origin, elsewhere. One that is bent or thicker lifts the
    table, or turns it about the board's middle by flatness / half its side.

    nominal : (n, 3) [m] corners in board axes, whose origin the world has, and whose x and y
    """
    d = (nominal - nominal.mean(0))[:, :2]
    seen = np.hypot(shape.stretch, shape.stretch_sigma)
    one_side = seen / np.sqrt(2.0) if tolerances.square is None else tolerances.square
    size = one_side / np.sqrt(2.0)
    if tolerances.square is None:
        size = float(np.hypot(size, shape.misprint / np.sqrt(np.sum(d**2))))
    of_stretch = shape.stretch_sigma if shape.refined else seen
    stretch = min(of_stretch, np.sqrt(2.0) * one_side)
    flatness = tolerances.flatness
    if flatness is None:  # a bent print may lie on a flat plate
        flatness = float(np.hypot(shape.lift * (0.5 if shape.refined else 1.0), shape.lift_sigma))
    thickness = ASSUMED_THICKNESS if tolerances.thickness is None else tolerances.thickness

    found: list[Allowance] = []

    def allow(cause: str, place: Array, turn: Any = 0.0, pair: Any = 0.0) -> None:
        parameters, assumed = np.zeros(N_RIG), {THICKNESS: tolerances.thickness, FLATNESS: tolerances.flatness}
        parameters[WORLD_SHIFT], parameters[WORLD_TURN], parameters[PAIR_SHIFT] = place, turn, pair
        if parameters.any():
            found.append(Allowance(cause, parameters, cause in assumed and assumed[cause] is None))

    R, half, middle = rig.R_left_world, np.abs(d).max(0), nominal.mean(0)
    if table_view is None:
        allow(SIZE, np.zeros(3), pair=size * rig.t_right_left)
    else:
        allow(SIZE, size * (rig.t_left_world + board_thickness * R[:, 2]), pair=size * rig.t_right_left)
        allow(SIZE, 0.5 * stretch * (middle[0] * R[:, 0] - middle[1] * R[:, 1]))
        allow(THICKNESS, thickness * R[:, 2])
        allow(FLATNESS, flatness * R[:, 2])
        for axis, across in ((0, [0.0, -1.0, 0.0]), (1, [1.0, 0.0, 0.0])):
            # turned about the board's other side, so that z grows along this one; the middle stays where it is
            slope = flatness / half[axis]
            allow(FLATNESS, -slope * middle[axis] * R[:, 2], turn=slope * R @ across)
    D = np.reshape([a.shift for a in found], (-1, N_RIG))
    return replace(rig, covariance=rig.covariance + D.T @ D, allowances=tuple(found))


def table_pose(R_left_board: Array, t_left_board: Array, board_thickness: float) -> tuple[Array, Array]:
    """(R_left_world, t_left_world): origin on the table below corner 0, i and j along the board's sides, k up.

    The printed face lies at z = board_thickness [m] above the table; board and world axes are parallel.
    """
    return R_left_board, t_left_board - board_thickness * R_left_board[:, 2]


def rig_with_covariance(
    refinement: Refinement,
    table_view: int | None,
    board_thickness: float,
    inflation: float,
    stereo: Array | None = None,
    origin: Array | None = None,
) -> StereoRig:
    """The rig at the minimum, its world on the table of one view, with the covariance of all RIG_PARAMETERS.

    inflation : factor on the covariance that follows from the points' noise
    origin : (3,) [m] that lies one thickness above the world's, in board axes; corner 0 without
    stereo : covariance of the free stereo parameters where it is known better, see `assessment.stereo_covariance`
    """
    model, basis = refinement.model, refinement.problem.stereo_basis
    n_free, rig = basis.shape[1], model.rig
    shared, poses, cross = refinement.normal.covariances()
    view, M = table_view or 0, np.zeros((6, 6))  # d world / d pose of the board; without a table nothing is told of it
    free, shifted = shared[:n_free, :n_free], cross[view, :n_free, :6]  # of the pose at the left camera's exposure
    follows = np.linalg.solve(free, shifted).T  # how the pose follows the stereo parameters
    if table_view is not None:
        R, t = model.R_left_board[table_view, 0], model.t_left_board[table_view, 0]
        R_left_world, t_left_world = table_pose(R, t if origin is None else t + R @ origin, board_thickness)
        rig = replace(rig, R_left_world=R_left_world, t_left_world=t_left_world, world_is_table=True)
        # t_world = t - h R k: turning R by v shifts it by -v x (h R k) = (h R k) x v
        M = np.eye(6)
        M[3:, :3] = np.cross(board_thickness * R[:, 2], np.eye(3)).T
    by_stereo = np.concatenate([basis, M @ follows])
    covariance = by_stereo @ (inflation * free if stereo is None else stereo) @ by_stereo.T
    covariance[N_STEREO:, N_STEREO:] += inflation * M @ (poses[view, :6, :6] - follows @ shifted) @ M.T
    return replace(rig, covariance=0.5 * (covariance + covariance.T))
