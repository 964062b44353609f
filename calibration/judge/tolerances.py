"""The rig in the lab frame, on the table under one view, with covariances due to the views and to the board's sizes.

Views of a board determine its shape: the ratio of its sides, its bend, and deviations of corners from a regular grid.
They do not determine its size, nor its underside. Without a declared tolerance, the measured errors set the scale of
the unknown ones: the relative errors e_x and e_y of the two sides are assumed normal with one variance v, of which the
views determine one number, d = e_x - e_y. So v = d^2 / 2, e_x = -e_y = d / 2, and their mean, the error of the board's
size, is 0 +- |d| / 2. A board whose sides agree to 0.0003 % is assumed to be that accurate. One number determines a
variance only within a factor of ten; a declared tolerance is used unchanged.
"""

from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from calibration.cameras.camera import N_RIG, PAIR_SHIFT, WORLD_SHIFT, WORLD_TURN, Allowance, StereoRig
from calibration.fit.refinement import Refinement
from calibration.fit.stereo_model import N_STEREO, board_basis
from calibration.kit.arrays import Array
from calibration.kit.least_squares import scaled_solve

ASSUMED_THICKNESS = 20e-6  # [m] standard deviation of a calliper
SIZE, FLATNESS, THICKNESS = "the board's size", "the board's flatness", "the board's thickness"


@dataclass(frozen=True)
class BoardTolerances:
    """Declared standard deviations; None: estimated from the views, or a default for the thickness."""

    square: float | None = None  # relative, of lengths along one side, averaged over the board
    flatness: float | None = None  # [m] of the printed face on the table, about its mean plane
    thickness: float | None = None  # [m]


@dataclass(frozen=True)
class BoardShape:
    """Deviation of the board from the declared one, as determined by its views."""

    stretch: float  # relative difference of lengths along i and along j
    stretch_sigma: float
    lift: float  # [m] height of the mean plane of the printed face above its lowest part, which touches a table
    lift_sigma: float
    misprint: float  # [m] rms per coordinate of the corners in their plane, beyond stretch and shear; 0 if not refined
    refined: bool  # True if the calibration's board has this shape; else the board was assumed to be flat


def board_shape(refinement: Refinement, nominal: Array, inflation: float) -> BoardShape:
    """The smooth part of the board's shape with its sigma, for any refined model of the board.

    nominal : (n, 3) [m] the declared points of the target, on a grid
    inflation : factor on the covariance that follows from the points' noise
    """
    n, warp = len(nominal), board_basis(nominal, "warped")
    free, s1 = refinement.terms.board == "free", refinement.problem.stereo_basis.shape[1]
    basis, to_smooth = board_basis(nominal, "free") if free else warp, np.linalg.pinv(warp.reshape(3 * n, -1))
    normal = refinement.problem.with_shape(nominal, basis).linearise(refinement.model)  # with a step from a flat board
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
    """Effect of a more general shape of the board than the refined one: covariance (s1, s1) of the stereo parameters.

    From one step of a refinement with each further shape of `boards`, simplest first, which is minus the bias due to
    the simpler shape. The step expected from noise is subtracted (in chi-square). The second item is the largest of
    these shifts, in sigmas of the parameters.
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
    """Heights (n, k) of smooth shapes at the corners, extrapolated to the outer edge of the outer squares."""
    x, y = (nominal - nominal.mean(0))[:, :2].T

    def terms(x: Array, y: Array) -> Array:
        return np.stack([np.ones_like(x), x, y, x * x, x * y, y * y], axis=-1)

    step = np.array([np.diff(np.unique(np.round(side, 9))).min() for side in (x, y)])
    u, v = (np.linspace(-1.0, 1.0, 21) * (np.abs(side).max() + s) for side, s in zip((x, y), step, strict=True))
    wide = np.stack(np.meshgrid(u, v), axis=-1).reshape(-1, 2)
    found: Array = terms(*wide.T) @ np.linalg.lstsq(terms(x, y), heights, rcond=None)[0]
    return found


def on_the_table(nominal: Array, shape: BoardShape) -> Array:
    """(3,) [m] point one declared thickness above the world's origin, in the axes of a board of this shape.

    It is below corner 0, which a stretch moves, at the height of the lowest parts of the printed face.
    """
    if not shape.refined:
        return np.zeros(3)
    middle = nominal.mean(0)
    x, y = -0.5 * shape.stretch, 0.5 * shape.stretch  # of the middle relative to corner 0
    return np.array([x * middle[0], y * middle[1], -shape.lift])


def with_tolerances(
    rig: StereoRig,
    nominal: Array,
    table_view: int | None,
    board_thickness: float,
    tolerances: BoardTolerances,
    shape: BoardShape,
) -> StereoRig:
    """The rig with the tolerances of the board's sizes added to its covariance, and listed by cause.

    A board larger by s scales all lengths: t -> (1 + s) t, for cameras and world. A further stretch of one side moves
    corner 0, the world's origin. A bent or thicker board shifts the table in z, or tilts it about the board's middle by
    flatness / half its side.

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
            # rotation about the board's other side, so that z increases along this one; the middle is fixed
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
    origin : (3,) [m] point one thickness above the world's origin, in board axes; by default corner 0
    stereo : better estimate of the covariance of the free stereo parameters, see `assessment.stereo_covariance`
    """
    model, basis = refinement.model, refinement.problem.stereo_basis
    n_free, rig = basis.shape[1], model.rig
    shared, poses, cross = refinement.normal.covariances()
    view, M = table_view or 0, np.zeros((6, 6))  # d world / d pose of the board; zero without a table
    free, shifted = shared[:n_free, :n_free], cross[view, :n_free, :6]  # of the pose at the left camera's exposure
    follows = np.linalg.solve(free, shifted).T  # derivative of the pose by the stereo parameters
    if table_view is not None:
        R, t = model.R_left_board[table_view, 0], model.t_left_board[table_view, 0]
        R_left_world, t_left_world = table_pose(R, t if origin is None else t + R @ origin, board_thickness)
        rig = replace(rig, R_left_world=R_left_world, t_left_world=t_left_world, world_is_table=True)
        # t_world = t - h R k: a rotation v of R shifts it by -v x (h R k) = (h R k) x v
        M = np.eye(6)
        M[3:, :3] = np.cross(board_thickness * R[:, 2], np.eye(3)).T
    by_stereo = np.concatenate([basis, M @ follows])
    covariance = by_stereo @ (inflation * free if stereo is None else stereo) @ by_stereo.T
    covariance[N_STEREO:, N_STEREO:] += inflation * M @ (poses[view, :6, :6] - follows @ shifted) @ M.T
    return replace(rig, covariance=0.5 * (covariance + covariance.T))
