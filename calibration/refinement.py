"""One least-squares refinement of both cameras, their mutual pose, all board poses and, if wanted, the board itself.

Parameters fall into shared ones (intrinsics, stereo pose, board shape) and six per view that only their own view sees,
so the normal equations are solved through the Schur complement of the views' 6 x 6 blocks.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from calibration.camera import N_INTRINSIC, Array, Camera, project_with_jacobians, rotation_from_vector
from calibration.errors import CalibrationError

DISTORTION_MODELS: dict[str, tuple[str, ...]] = {
    "none": (),
    "k1": ("k1",),
    "k1 k2": ("k1", "k2"),
    "k1 k2 p1 p2": ("k1", "k2", "p1", "p2"),
    "k1 k2 k3": ("k1", "k2", "k3"),
    "k1 k2 p1 p2 k3": ("k1", "k2", "p1", "p2", "k3"),
}
BOARD_MODELS = ("flat", "warped", "free")
N_STEREO = 2 * N_INTRINSIC + 6  # left and right intrinsics, rotation and translation of the pair


@dataclass(frozen=True)
class Observations:
    """Image points of target points, flat over everything that was seen."""

    view: NDArray[np.intp]  # (m,) 0..n_views-1
    camera: NDArray[np.intp]  # (m,) 0 left, 1 right
    point: NDArray[np.intp]  # (m,) index into the target's points
    pixels: Array  # (m, 2) [px]
    covariance: Array  # (m, 2, 2) [px^2]

    def __post_init__(self) -> None:
        m = len(self.view)
        shapes = (self.camera.shape, self.point.shape, self.pixels.shape, self.covariance.shape)
        if shapes != ((m,), (m,), (m, 2), (m, 2, 2)):
            raise ValueError(f"shapes of observations do not match: {m} views, then {shapes}")
        if not (np.isfinite(self.pixels).all() and np.isfinite(self.covariance).all()):
            raise ValueError("observations must be finite: leave out what was not seen")

    def __len__(self) -> int:
        return len(self.view)

    def __getitem__(self, keep: NDArray) -> Observations:
        names = ("view", "camera", "point", "pixels", "covariance")
        return Observations(*(getattr(self, name)[keep] for name in names))


@dataclass(frozen=True)
class StereoModel:
    """Everything that predicts where the target's points appear."""

    cameras: tuple[Camera, Camera]
    R_right_left: Array  # (3, 3)
    t_right_left: Array  # (3,) [m]
    R_left_board: Array  # (n_views, 3, 3)
    t_left_board: Array  # (n_views, 3) [m]
    points: Array  # (n, 3) target points in board axes [m], as refined


@dataclass(frozen=True)
class Terms:
    """What the refinement may change."""

    distortion: str = "k1 k2 p1 p2 k3"  # key of DISTORTION_MODELS, the same for both cameras
    board: str = "flat"  # one of BOARD_MODELS
    equal_aspect: bool = False  # fx = fy in each camera
    fixed_intrinsics: bool = False

    def __post_init__(self) -> None:
        if self.distortion not in DISTORTION_MODELS:
            raise CalibrationError(
                f"distortion {self.distortion!r} is unknown; choose of {', '.join(DISTORTION_MODELS)}"
            )
        if self.board not in BOARD_MODELS:
            raise CalibrationError(f"board model {self.board!r} is unknown; choose of {', '.join(BOARD_MODELS)}")

    def stereo_basis(self) -> Array:
        """(24, n_free) columns span the free directions of intrinsics and stereo pose."""
        names = ("fx", "fy", "cx", "cy", "k1", "k2", "p1", "p2", "k3")
        free = () if self.fixed_intrinsics else ("fx", "fy", "cx", "cy", *DISTORTION_MODELS[self.distortion])
        columns = []
        for camera in range(2):
            for i, name in enumerate(names):
                if name not in free or (self.equal_aspect and name == "fy"):
                    continue
                column = np.zeros(N_STEREO)
                column[camera * N_INTRINSIC + i] = 1.0
                if self.equal_aspect and name == "fx":
                    column[camera * N_INTRINSIC + 1] = 1.0
                columns.append(column)
        columns.extend(np.eye(N_STEREO)[2 * N_INTRINSIC :])
        return np.array(columns).T


def board_basis(nominal: Array, board: str) -> Array:
    """(n, 3, n_shape): displacement of the target's points [m] per unit of each shape parameter [m].

    flat: none. warped: out of the plane as x^2, x y, y^2 over the half size. free: every coordinate of every point.
    Shift, turn and scale of the target as a whole are taken out: no image can tell them from a changed pose and
    baseline, so the mean plane and the mean size stay those declared.
    """
    n = len(nominal)
    if board == "flat":
        return np.zeros((n, 3, 0))
    d = nominal - nominal.mean(0)
    size = np.abs(d).max()
    rows = [np.broadcast_to(axis * size, d.shape) for axis in np.eye(3)]
    rows += [np.cross(axis, d) for axis in np.eye(3)] + [d]
    gauge = np.stack([row.reshape(-1) for row in rows], axis=-1)
    q, _ = np.linalg.qr(gauge, mode="complete")
    if board == "free":
        return q[:, 7:].reshape(n, 3, 3 * n - 7)
    x, y = (d / np.abs(d).max(0).clip(1e-12))[:, :2].T
    warp = np.zeros((n, 3, 3))
    warp[:, 2] = np.stack([x * x, x * y, y * y], axis=-1)
    flat = warp.reshape(3 * n, 3)
    return (flat - q[:, :7] @ (q[:, :7].T @ flat)).reshape(n, 3, 3)


def predict(model: StereoModel, observations: Observations) -> tuple[Array, Array, Array, Array]:
    """Pixels (m, 2) and derivatives: d/d stereo (m, 2, 24), d/d view pose (m, 2, 6), d/d target point (m, 2, 3)."""
    m = len(observations)
    R, t = model.R_left_board[observations.view], model.t_left_board[observations.view]
    arm = np.einsum("mij,mj->mi", R, model.points[observations.point])
    points_left = arm + t
    pixels, d_left = np.empty((m, 2)), np.empty((m, 2, 3))
    d_stereo = np.zeros((m, 2, N_STEREO))
    for index, camera in enumerate(model.cameras):
        seen = observations.camera == index
        if index == 0:
            pixels[seen], d_left[seen], d_stereo[seen, :, :N_INTRINSIC] = project_with_jacobians(
                points_left[seen], camera
            )
            continue
        turned = points_left[seen] @ model.R_right_left.T
        pixels[seen], d_right, d_k = project_with_jacobians(turned + model.t_right_left, camera)
        d_stereo[seen, :, N_INTRINSIC : 2 * N_INTRINSIC] = d_k
        d_stereo[seen, :, 2 * N_INTRINSIC : 2 * N_INTRINSIC + 3] = np.cross(turned[:, None], d_right)
        d_stereo[seen, :, 2 * N_INTRINSIC + 3 :] = d_right
        d_left[seen] = d_right @ model.R_right_left
    d_pose = np.concatenate([np.cross(arm[:, None], d_left), d_left], axis=-1)
    return pixels, d_stereo, d_pose, d_left @ R


def moved(model: StereoModel, stereo: Array, poses: Array, displacement: Array) -> StereoModel:
    """The model after a step: stereo (24,), poses (n_views, 6) rotation vectors and shifts, displacement (n, 3)."""
    turns = np.stack([rotation_from_vector(v) for v in poses[:, :3]])
    return StereoModel(
        cameras=(
            Camera.from_parameters(model.cameras[0].parameters + stereo[:9], model.cameras[0].image_size),
            Camera.from_parameters(model.cameras[1].parameters + stereo[9:18], model.cameras[1].image_size),
        ),
        R_right_left=rotation_from_vector(stereo[18:21]) @ model.R_right_left,
        t_right_left=model.t_right_left + stereo[21:24],
        R_left_board=turns @ model.R_left_board,
        t_left_board=model.t_left_board + poses[:, 3:],
        points=model.points + displacement,
    )


@dataclass(frozen=True)
class Normal:
    """Normal equations of one linearisation: shared parameters first, the views' poses kept apart."""

    shared: Array  # (n_views, s, s) each view's part
    gradient: Array  # (n_views, s)
    cross: Array  # (n_views, s, 6)
    pose: Array  # (n_views, 6, 6)
    pose_gradient: Array  # (n_views, 6)
    cost: float  # chi-square, or Huber's sum when robust
    residuals: Array  # (m, 2) observed - predicted [px]

    def solve(self, damping: float) -> tuple[Array, Array]:
        """Damped step of the shared parameters (s,) and of the poses (n_views, 6)."""
        pose = self.pose * (1 + damping * np.eye(6))
        carried, own = self._eliminated(pose)
        total = self.shared.sum(0)
        schur = total + damping * np.diag(np.diag(total)) - np.einsum("vsi,vit->st", self.cross, carried)
        step = _scaled_solve(schur, (self.gradient - np.einsum("vsi,vi->vs", self.cross, own)).sum(0))
        return step, own - carried @ step

    def _eliminated(self, pose: Array) -> tuple[Array, Array]:
        carried = np.linalg.solve(pose, np.swapaxes(self.cross, 1, 2))  # (v, 6, s)
        own: Array = np.asarray(np.linalg.solve(pose, self.pose_gradient[..., None])[..., 0], np.float64)
        return np.asarray(carried, np.float64), own

    def view_information(self) -> tuple[Array, Array]:
        """What each view, its pose eliminated, tells of the shared parameters: (v, s, s) and gradient (v, s)."""
        carried, own = self._eliminated(self.pose)
        return self.shared - self.cross @ carried, self.gradient - np.einsum("vsi,vi->vs", self.cross, own)

    def covariances(self) -> tuple[Array, Array, Array]:
        """Of the shared parameters (s, s), of each pose (v, 6, 6), and between shared and pose (v, s, 6)."""
        carried, _ = self._eliminated(self.pose)
        information = self.shared.sum(0) - np.einsum("vsi,vit->st", self.cross, carried)
        shared = _scaled_solve(information, np.eye(len(information)))
        cross = -shared @ np.swapaxes(carried, 1, 2)
        return shared, np.linalg.inv(self.pose) - carried @ cross, cross


def _scaled_solve(A: Array, b: Array) -> Array:
    """Solve A x = b after scaling A to a unit diagonal: the parameters' units differ by 10^6."""
    scale = 1.0 / np.sqrt(np.maximum(np.diag(A), 1e-300))
    columns = scale if b.ndim == 1 else scale[:, None]
    try:
        return np.linalg.solve(A * scale[:, None] * scale, b * columns) * columns
    except np.linalg.LinAlgError as error:
        raise CalibrationError(
            "the views do not determine all parameters: add views with the board tilted in several directions"
        ) from error


@dataclass(frozen=True)
class Problem:
    """What a refinement needs besides a start."""

    observations: Observations  # sorted by view
    weights: Array  # (m, 2, 2) inverse covariance [1/px^2]
    stereo_basis: Array  # (24, s1) free directions of intrinsics and stereo pose
    shape_basis: Array  # (n, 3, s2) free directions of the target's points
    n_views: int
    huber: float = np.inf  # residuals beyond this many sigmas count linearly

    def linearise(self, model: StereoModel) -> Normal:
        """Normal equations at the model."""
        o = self.observations
        pixels, d_stereo, d_pose, d_point = predict(model, o)
        residuals = o.pixels - pixels
        m, s1, s2 = len(o), self.stereo_basis.shape[1], self.shape_basis.shape[-1]
        s = s1 + s2
        block = np.empty((m, 2, s + 7))  # derivatives by shared parameters and pose, then the residual
        block[..., :s1] = (d_stereo.reshape(2 * m, N_STEREO) @ self.stereo_basis).reshape(m, 2, s1)
        if s2:
            block[..., s1:s] = d_point @ self.shape_basis[o.point]
        block[..., s : s + 6] = d_pose
        block[..., s + 6] = residuals
        mahalanobis = np.sqrt(_quadratic(self.weights, residuals))
        cost, factor = _huber(mahalanobis, self.huber)
        block = _whitened(block, self.weights * factor[:, None, None]).reshape(2 * m, s + 7)
        V = self.n_views
        squares = np.zeros((V, s + 7, s + 7))
        bounds = 2 * np.searchsorted(o.view, np.arange(V + 1))
        for v in range(V):
            rows = block[bounds[v] : bounds[v + 1]]
            squares[v] = rows.T @ rows
        pose = squares[:, s : s + 6, s : s + 6]
        pose[bounds[1:] == bounds[:-1]] = np.eye(6)
        return Normal(
            shared=squares[:, :s, :s],
            gradient=squares[:, :s, s + 6],
            cross=squares[:, :s, s : s + 6],
            pose=pose,
            pose_gradient=squares[:, s : s + 6, s + 6],
            cost=cost,
            residuals=residuals,
        )

    def stepped(self, model: StereoModel, shared: Array, poses: Array) -> StereoModel:
        """The model after a step."""
        s1 = self.stereo_basis.shape[1]
        return moved(model, self.stereo_basis @ shared[:s1], poses, self.shape_basis @ shared[s1:])


def _whitened(block: Array, weights: Array) -> Array:
    """L^T block for weights = L L^T; block (m, 2, k), weights (m, 2, 2)."""
    a = np.sqrt(weights[:, 0, 0])
    b = weights[:, 0, 1] / np.where(a > 0, a, 1.0)
    c = np.sqrt(np.maximum(weights[:, 1, 1] - b * b, 0.0))
    return np.stack([a[:, None] * block[:, 0] + b[:, None] * block[:, 1], c[:, None] * block[:, 1]], axis=1)


def _quadratic(matrix: Array, vector: Array) -> Array:
    """v^T M v of (m, 2, 2) and (m, 2)."""
    x, y = vector[:, 0], vector[:, 1]
    value: Array = matrix[:, 0, 0] * x * x + 2 * matrix[:, 0, 1] * x * y + matrix[:, 1, 1] * y * y
    return value


def inverse_covariance(covariance: Array, extra: float) -> Array:
    """Inverse of covariance (m, 2, 2) + extra [px^2] in both axes."""
    a, b, c = covariance[:, 0, 0] + extra, covariance[:, 0, 1], covariance[:, 1, 1] + extra
    inverse = np.stack([np.stack([c, -b], axis=-1), np.stack([-b, a], axis=-1)], axis=-2)
    result: Array = inverse / (a * c - b * b)[:, None, None]
    return result


def _huber(mahalanobis: Array, limit: float) -> tuple[float, Array]:
    """Huber's sum (chi-square below the limit) and the factor on each weight; inf where a prediction failed."""
    if not np.isfinite(mahalanobis).all():
        return np.inf, np.zeros_like(mahalanobis)
    beyond = mahalanobis > limit
    if not beyond.any():
        return float(np.sum(mahalanobis**2)), np.ones_like(mahalanobis)
    cost = np.where(
        beyond, 2 * np.where(beyond, limit, 0) * mahalanobis - np.where(beyond, limit, 0) ** 2, mahalanobis**2
    )
    return float(np.sum(cost)), np.where(beyond, limit / np.maximum(mahalanobis, 1e-300), 1.0)


@dataclass(frozen=True)
class Minimum:
    """Where Levenberg-Marquardt ended."""

    model: StereoModel
    normal: Normal
    iterations: int
    converged: bool


def minimise(
    problem: Problem, start: StereoModel, iterations: int = 60, tolerance: float = 1e-10, damping: float = 1e-3
) -> Minimum:
    """Levenberg-Marquardt; converged when the cost to be gained by a full step is below tolerance x cost.

    The predicted gain g^T H^-1 g is free of the parameters' units, and a vanishing gradient is what it says.
    """
    model, normal = start, problem.linearise(start)
    if not np.isfinite(normal.cost):
        raise CalibrationError(
            "the start of the refinement puts the board behind a camera: check the order of the views"
        )
    for iteration in range(1, iterations + 1):
        shared, poses = normal.solve(damping)
        gain = float(shared @ normal.gradient.sum(0) + np.sum(poses * normal.pose_gradient))
        trial = problem.stepped(model, shared, poses)
        trial_normal = problem.linearise(trial)
        if trial_normal.cost <= normal.cost * (1 + 1e-14):
            model, normal, damping = trial, trial_normal, max(damping * 0.1, 1e-12)
            if damping < 1e-4 and gain <= tolerance * max(normal.cost, 1.0):
                return Minimum(model, normal, iteration, True)
        else:
            if gain <= tolerance * max(normal.cost, 1.0):
                return Minimum(model, normal, iteration, damping < 1e-2)
            damping *= 10.0
            if damping > 1e10:
                break
    return Minimum(model, normal, iterations, False)


# ---------------------------------------------------------------------------------------------------------------------


@dataclass(frozen=True)
class Refinement:
    """Result of `refine_stereo`."""

    model: StereoModel
    terms: Terms
    observations: Observations  # all that were given
    kept: NDArray[np.bool_]  # (m,)
    residuals: Array  # (m, 2) observed - predicted [px], of the rejected ones too
    unexplained_sigma: float  # [px per axis] added to the corners' own noise so that the residuals are explained
    chi_square: float  # reduced, with the points' own covariances alone
    normal: Normal  # at the minimum, of the kept observations
    problem: Problem
    iterations: int
    converged: bool

    @property
    def degrees_of_freedom(self) -> int:
        """Kept coordinates minus parameters."""
        return _degrees_of_freedom(self.problem, int(self.kept.sum()))

    def rms(self, select: NDArray[np.bool_] | None = None) -> float:
        """Root mean square distance [px] of the kept observations, or of some of them."""
        use = self.kept if select is None else self.kept & select
        return float(np.sqrt(np.mean(np.sum(self.residuals[use] ** 2, axis=-1)))) if use.any() else float("nan")


def _degrees_of_freedom(problem: Problem, n_kept: int) -> int:
    seen = len(np.unique(problem.observations.view))
    return 2 * n_kept - problem.stereo_basis.shape[1] - problem.shape_basis.shape[-1] - 6 * seen


def refine_stereo(
    observations: Observations,
    start: StereoModel,
    nominal: Array,
    terms: Terms | None = None,
    reject_beyond: float = 5.5,
    begin: Refinement | None = None,
) -> Refinement:
    """Refine everything `terms` frees, from image points of any flat target.

    observations : image points with covariances, of any target with known points: corners of squares or dots
    start : cameras, stereo pose and board poses to a few percent and degrees, see `calibration.start`
    nominal : (n, 3) [m] the target's points as declared
    reject_beyond : sigmas, after the noise that the residuals themselves show: of 10^4 good points none lies beyond
    begin : an earlier refinement of the same observations with other terms: spares the robust start

    Raises CalibrationError if the views cannot determine the parameters.
    """
    terms = terms or Terms()
    observations = observations[np.argsort(observations.view, kind="stable")]
    n_views = len(start.R_left_board)
    stereo_basis, shape_basis = terms.stereo_basis(), board_basis(nominal, terms.board)
    kept = np.ones(len(observations), bool)
    model, total = restricted(start if begin is None else begin.model, nominal, terms), 0
    if begin is None:
        model, extra = _robust_start(observations, model, stereo_basis, shape_basis, n_views)
    else:
        kept, extra = begin.kept, begin.unexplained_sigma**2
    for _ in range(8):
        used = observations[kept]
        problem = Problem(used, inverse_covariance(used.covariance, extra), stereo_basis, shape_basis, n_views)
        if _degrees_of_freedom(problem, len(used)) <= 0:
            raise CalibrationError(
                f"{len(used)} points in {len(np.unique(used.view))} views are fewer than the parameters to be found: "
                "take more views, or fewer free terms"
            )
        minimum = minimise(problem, model, damping=1e-6)
        model, total = minimum.model, total + minimum.iterations
        residuals = observations.pixels - predict(model, observations)[0]
        dof = _degrees_of_freedom(problem, len(used))
        new_extra = _extra_variance(residuals[kept], used.covariance, dof)
        distance = _mahalanobis2(residuals, observations.covariance, new_extra)
        new_kept = distance < reject_beyond**2
        settled = abs(new_extra - extra) <= 1e-3 * extra + 1e-10 and (new_kept == kept).all()
        kept, extra = new_kept, new_extra
        if settled:
            break
    own = _mahalanobis2(residuals[kept], observations.covariance[kept], 0.0)
    return Refinement(
        model=model,
        terms=terms,
        observations=observations,
        kept=kept,
        residuals=residuals,
        unexplained_sigma=float(np.sqrt(extra)),
        chi_square=float(own.sum() / dof),
        normal=minimum.normal,
        problem=problem,
        iterations=total,
        converged=minimum.converged,
    )


def restricted(model: StereoModel, nominal: Array, terms: Terms) -> StereoModel:
    """The model with the terms that are not free put to zero: distortion, deviation of the board, fx - fy."""
    if terms.board != "free":
        basis = board_basis(nominal, terms.board).reshape(nominal.size, -1)
        deviation = (model.points - nominal).reshape(-1)
        coefficients = np.linalg.lstsq(basis, deviation, rcond=None)[0] if basis.shape[1] else np.zeros(0)
        model = replace(model, points=nominal + (basis @ coefficients).reshape(nominal.shape))
    if terms.fixed_intrinsics:
        return model
    free = DISTORTION_MODELS[terms.distortion]
    names = ("k1", "k2", "p1", "p2", "k3")
    cameras = []
    for camera in model.cameras:
        k1, k2, p1, p2, k3 = (
            value if name in free else 0.0 for name, value in zip(names, camera.distortion, strict=True)
        )
        mean = 0.5 * (camera.fx + camera.fy)
        fx, fy = (mean, mean) if terms.equal_aspect else (camera.fx, camera.fy)
        cameras.append(replace(camera, fx=fx, fy=fy, distortion=(k1, k2, p1, p2, k3)))
    return replace(model, cameras=(cameras[0], cameras[1]))


def _robust_start(
    observations: Observations, model: StereoModel, stereo_basis: Array, shape_basis: Array, n_views: int
) -> tuple[StereoModel, float]:
    """Huber's fit with the noise set by the median residual, and the extra variance [px^2] it shows."""
    flat = shape_basis[..., :0]
    extra = 0.0
    for basis in (flat, shape_basis) if shape_basis.shape[-1] else (flat,):
        for _ in range(2):
            residuals = observations.pixels - predict(model, observations)[0]
            extra = _median_variance(residuals)
            weights = inverse_covariance(observations.covariance, extra)
            problem = Problem(observations, weights, stereo_basis, basis, n_views, huber=2.0)
            model = minimise(problem, model, iterations=30, tolerance=1e-5).model
    residuals = observations.pixels - predict(model, observations)[0]
    return model, _median_variance(residuals)


def _median_variance(residuals: Array) -> float:
    """Variance per axis that puts the median of squared 2-D residuals where a Gaussian has it, 2 ln 2 sigma^2."""
    return float(np.median(np.sum(residuals**2, axis=-1)) / (2 * np.log(2))) + 1e-12


def _mahalanobis2(residuals: Array, covariance: Array, extra: float) -> Array:
    return _quadratic(inverse_covariance(covariance, extra), residuals)


def _extra_variance(residuals: Array, covariance: Array, dof: int) -> float:
    """Variance per axis [px^2] which, added to the points' own, makes chi-square equal to the degrees of freedom."""

    def excess(extra: float) -> float:
        return float(_mahalanobis2(residuals, covariance, extra).sum()) - dof

    if excess(0.0) <= 0:
        return 0.0
    low, high = 0.0, float(np.sum(residuals**2)) / dof + 1e-12
    for _ in range(40):
        middle = 0.5 * (low + high)
        low, high = (middle, high) if excess(middle) > 0 else (low, middle)
    return 0.5 * (low + high)
