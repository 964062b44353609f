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
from calibration.fit.priors import PARTS, STRETCH
from calibration.fit.refinement import Refinement
from calibration.fit.stereo_model import N_STEREO
from calibration.kit.types import Array

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
    """Deviation of the board from the declared one: as refined, and as its views alone determine it."""

    refined_stretch: float  # relative difference of lengths along i and along j
    stretch: float
    stretch_sigma: float
    refined_lift: float  # [m] height of the mean plane of the printed face above its lowest part, which touches a table
    lift: float
    lift_sigma: float
    misprint: float  # [m] rms per coordinate of the corners in their plane, beyond stretch and shear
    # (3,) [m] point one declared thickness above the world's origin, in the board's axes: below corner 0, which a
    # stretch moves, at the height of the lowest parts of the printed face
    origin: Array


def board_shape(refinement: Refinement, nominal: Array, inflation: float) -> BoardShape:
    """The board's shape, and its smooth part by one step with a prior of the largest size, with its sigma.

    nominal : (n, 3) [m] the declared points of the target, on a grid
    inflation : factor on the covariance that follows from the points' noise
    """
    problem, (bends, _, others) = refinement.problem, PARTS
    prior, basis, smooth = problem.prior, problem.shape_basis, np.arange(others.start)
    known, towards = prior.known.copy(), prior.towards.copy()
    known[np.ix_(smooth, smooth)], towards[smooth] = np.eye(len(smooth)), 0.0
    normal = replace(problem, prior=replace(prior, known=known, towards=towards)).linearise(refinement.model)
    refined = prior.shape(refinement.model)
    found = refined + normal.step()[0][N_STEREO:]
    C = inflation * normal.covariances()[0][N_STEREO:, N_STEREO:]
    heights = _over_the_board(nominal, basis[:, 2, bends])
    refined_stretch, refined_lift = STRETCH * float(refined[3]), -float((heights @ refined[bends]).min())
    x, y, _ = 0.5 * refined_stretch * nominal.mean(0)  # of the middle relative to corner 0
    return BoardShape(
        refined_stretch=refined_stretch,
        stretch=STRETCH * float(found[3]),
        stretch_sigma=STRETCH * float(np.sqrt(C[3, 3])),
        refined_lift=refined_lift,
        lift=-float((heights @ found[bends]).min()),
        lift_sigma=float(np.sqrt(np.mean(np.einsum("ni,ij,nj->n", heights, C[bends, bends], heights)))),
        misprint=float(np.sqrt(np.mean((basis[:, :2, others] @ refined[others]) ** 2))),
        origin=np.array([-x, y, -refined_lift]),
    )


def _over_the_board(nominal: Array, heights: Array) -> Array:
    """Heights (n, k) of smooth shapes at the corners, extrapolated to the outer edge of the outer squares."""
    x, y = (nominal - nominal.mean(0))[:, :2].T

    def terms(x: Array, y: Array) -> Array:
        return np.stack([np.ones_like(x), x, y, x * x, x * y, y * y], axis=-1)

    step = np.array([np.diff(np.unique(np.round(side, 9))).min() for side in (x, y)])
    u, v = (np.linspace(-1.0, 1.0, 21) * (np.abs(side).max() + s) for side, s in zip((x, y), step, strict=True))
    wide = np.stack(np.meshgrid(u, v), axis=-1).reshape(-1, 2)
    return terms(*wide.T) @ np.linalg.lstsq(terms(x, y), heights, rcond=None)[0]


def with_tolerances(
    rig: StereoRig, nominal: Array, board_thickness: float, tolerances: BoardTolerances, shape: BoardShape
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
    stretch = min(np.hypot(shape.stretch - shape.refined_stretch, shape.stretch_sigma), np.sqrt(2.0) * one_side)
    flatness = tolerances.flatness
    if flatness is None:  # a bent print may lie on a flat plate
        flatness = float(np.hypot(shape.lift - 0.5 * shape.refined_lift, shape.lift_sigma))
    thickness = ASSUMED_THICKNESS if tolerances.thickness is None else tolerances.thickness

    found: list[Allowance] = []

    def allow(cause: str, place: Array, turn: Any = 0.0, pair: Any = 0.0) -> None:
        parameters, assumed = np.zeros(N_RIG), {THICKNESS: tolerances.thickness, FLATNESS: tolerances.flatness}
        parameters[WORLD_SHIFT], parameters[WORLD_TURN], parameters[PAIR_SHIFT] = place, turn, pair
        if parameters.any():
            found.append(Allowance(cause, parameters, cause in assumed and assumed[cause] is None))

    R, half, middle = rig.R_left_world, np.abs(d).max(0), nominal.mean(0)
    t_left_board = rig.t_left_world + board_thickness * R[:, 2]
    allow(SIZE, size * t_left_board if rig.world_is_table else np.zeros(3), pair=size * rig.t_right_left)
    if rig.world_is_table:
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
    model, rig = refinement.model, replace(refinement.model.rig, lens_field=refinement.lens_field)
    shared, poses, cross = refinement.normal.covariances()
    view, M = table_view or 0, np.zeros((6, 6))  # d world / d pose of the board; zero without a table
    free = shared[:N_STEREO, :N_STEREO]
    shifted = cross[view, :N_STEREO, :6]  # of the pose at the left camera's exposure
    follows = np.linalg.solve(free, shifted).T  # derivative of the pose by the stereo parameters
    if table_view is not None:
        R, t = model.R_left_board[table_view, 0], model.t_left_board[table_view, 0]
        R_left_world, t_left_world = table_pose(R, t if origin is None else t + R @ origin, board_thickness)
        rig = replace(rig, R_left_world=R_left_world, t_left_world=t_left_world, world_is_table=True)
        # t_world = t - h R k: a rotation v of R shifts it by -v x (h R k) = (h R k) x v
        M = np.eye(6)
        M[3:, :3] = np.cross(board_thickness * R[:, 2], np.eye(3)).T
    by_stereo = np.concatenate([np.eye(N_STEREO), M @ follows])
    covariance = by_stereo @ (inflation * free if stereo is None else stereo) @ by_stereo.T
    covariance[N_STEREO:, N_STEREO:] += inflation * M @ (poses[view, :6, :6] - follows @ shifted) @ M.T
    return replace(rig, covariance=0.5 * (covariance + covariance.T))
