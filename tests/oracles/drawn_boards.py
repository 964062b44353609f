"""A known stereo pair before a known board: what every synthetic test starts from."""

from dataclasses import dataclass, replace

import cv2
import numpy as np

from calibration import Board, Camera, CornerView, Observations, StereoModel, StereoRig
from calibration.cameras.camera import project, rotation_from_vector
from calibration.kit.types import Array


@dataclass(frozen=True)
class Scene:
    """True cameras, board poses, and the corners they give."""

    model: StereoModel
    board: Board

    def with_rig(self, **changed) -> "Scene":
        """The same boards before a changed rig."""
        return replace(self, model=replace(self.model, rig=replace(self.model.rig, **changed)))

    def pixels(self, camera: int) -> Array:
        """(n_views, n_points, 2) [px] without noise."""
        m = self.model
        R, t = m.R_left_board[:, camera], m.t_left_board[:, camera]
        points = np.einsum("vij,nj->vni", R, m.points) + t[:, None]
        if camera:
            points = points @ m.rig.R_right_left.T + m.rig.t_right_left
        return project(points, m.rig.cameras[camera])

    def observations(self, sigma: float, rng: np.random.Generator | None = None) -> Observations:
        """All corners with Gaussian noise of unequal size: sigma x 0.5 to 2, correlated between x and y."""
        n_views, n = len(self.model.R_left_board), len(self.model.points)
        view, camera, point = (a.ravel() for a in np.meshgrid(range(n_views), (0, 1), range(n), indexing="ij"))
        pixels = np.stack([self.pixels(0), self.pixels(1)], axis=1).reshape(-1, 2)
        scale = np.random.default_rng(1).uniform(0.5, 2.0, (len(view), 2)) * sigma
        L = np.zeros((len(view), 2, 2))
        L[:, 0, 0], L[:, 1, 1], L[:, 1, 0] = scale[:, 0], scale[:, 1], 0.3 * scale[:, 0]
        if rng is not None:
            pixels = pixels + (L @ rng.normal(size=(len(view), 2, 1)))[..., 0]
        return Observations(view, camera, point, pixels, L @ np.swapaxes(L, 1, 2))


def make_scene(n_views=12, inner_corners=(9, 6), square=8e-3, distortion=True, deviation=None, seed=3) -> "Scene":
    """Two cameras 0.5 m from a board that stands in `n_views` attitudes, tilted up to 45 deg."""
    rng = np.random.default_rng(seed)
    board = Board(inner_corners, square)
    d = ((-0.12, 0.3, 6e-4, -4e-4, 0.0), (-0.1, 0.2, -5e-4, 3e-4, 0.0)) if distortion else ((0.0,) * 5,) * 2
    cameras = (
        Camera(2015.0, 2040.0, 255.0, 258.0, d[0], (512, 512)),
        Camera(2053.0, 2051.0, 258.0, 252.0, d[1], (512, 512)),
    )
    R_pair = rotation_from_vector(np.array([0.05, -0.8, 0.1]))
    target = np.array([0.0, 0.0, 0.5])  # both cameras look here
    t_pair = np.array([0.01, -0.005, 0.51]) - R_pair @ target
    centre = board.points.mean(0)
    R_board, t_board = np.empty((n_views, 2, 3, 3)), np.empty((n_views, 2, 3))
    towards = rotation_from_vector(np.array([0.0, 0.4, 0.0])) @ np.diag([1.0, -1.0, -1.0])  # faces between the cameras
    for v in range(n_views):
        axis = rng.normal(size=3)
        turn = rotation_from_vector(axis / np.linalg.norm(axis) * np.radians(rng.uniform(5, 45)))
        R_board[v] = turn @ towards
        t_board[v] = target + rng.uniform(-0.015, 0.015, 3) - turn @ towards @ centre
    points = board.points + (0 if deviation is None else deviation)
    return Scene(StereoModel(StereoRig(*cameras, R_pair, t_pair), R_board, t_board, points), board)


def corner_view(points, sigma=0.1, image_size=(640, 480)) -> CornerView:
    """What `find_corners` would return of points (n, 2) [px], all of them found and as uncertain."""
    n = len(points)
    covariance = np.tile(sigma**2 * np.eye(2), (n, 1, 1))
    return CornerView(image_size, points, covariance, np.ones(n, bool), ("",) * n)


def squared(error, covariance) -> float:
    """Squared error over its covariance, per number, of numbers in units of their own."""
    sigma = np.sqrt(np.diag(covariance))
    z = error / sigma
    return float(z @ np.linalg.solve(covariance / np.outer(sigma, sigma), z)) / len(z)


PAD = 4  # pixels round an image that are drawn, too


def rays_of(camera, sub):
    """x and y where z is 1, each ((height + 2 PAD) sub, (width + 2 PAD) sub), of sub x sub rays per pixel."""
    x, y = ((np.arange((n + 2 * PAD) * sub) + 0.5) / sub - 0.5 - PAD for n in camera.image_size)
    k1, k2, p1, p2, k3 = camera.distortion
    xd, yd = np.meshgrid((x - camera.cx) / camera.fx, (y - camera.cy) / camera.fy)
    a, b = xd, yd
    for _ in range(6):  # the inverse of weak distortion by repeated substitution
        r2 = a * a + b * b
        f = 1 + r2 * (k1 + r2 * (k2 + r2 * k3))
        a, b = (xd - 2 * p1 * a * b - p2 * (r2 + 2 * a * a)) / f, (yd - p1 * (r2 + 2 * b * b) - 2 * p2 * a * b) / f
    return a, b


def exposed(grey, sub, sigma, rng):
    """Image of what such rays meet (float32): blur of sigma [px], mean over the pixel; with rng noise and rounding."""
    height, width = (n // sub for n in grey.shape)
    soft = cv2.GaussianBlur(grey, (0, 0), sigma * sub).reshape(height, sub, width, sub)
    image = soft.mean((1, 3), dtype=float)[PAD:-PAD, PAD:-PAD]
    if rng is None:
        return image
    noisy = image + rng.normal(size=image.shape) * np.sqrt(0.65 + 0.02 * image)
    return np.clip(np.rint(noisy), 0, 255).astype(np.uint8)


def draw_board(camera, R, t, board, sub=4, sigma=0.6, light=200.0, dark=20.0, table=80.0, rng=None, rim=1.6) -> Array:
    """Image of a chessboard, drawn without any corner model.

    sub x sub rays per pixel, each the mean of its own footprint, optical blur on that grid, mean over the pixel, then
    shot and read noise (variance 0.65 + 0.02 grey) and whole grey values.

    Without rng: exact grey values, float.
    """
    a, b = rays_of(camera, sub)
    normal = R[:, 2]
    depth = (normal @ t) / (a * normal[0] + b * normal[1] + normal[2])
    points = np.stack([a * depth - t[0], b * depth - t[1], depth - t[2]])
    X, Y = np.tensordot(R[:, :2].T, points, axes=1) / board.square
    columns, rows = board.inner_corners
    inside = (np.floor(X) >= -1) & (np.floor(X) < columns) & (np.floor(Y) >= -1) & (np.floor(Y) < rows)
    paper = (-rim - 1 < X) & (columns + rim > X) & (-rim - 1 < Y) & (rows + rim > Y)
    ink = 0.5 * (1 + _stripes(X) * _stripes(Y))  # the square outside corner (0, 0) is dark
    grey = np.where(paper, light + np.where(inside, ink, 0) * (dark - light), table).astype(np.float32)
    return exposed(grey, sub, sigma, rng)


def _stripes(X: Array) -> Array:
    """-1 or 1 in turn with each whole number passed, mixed over the footprint of a ray on the lines."""
    footprint = np.hypot(*np.gradient(X))
    nearest = np.rint(X)
    return np.clip(2 * (X - nearest) / footprint, -1, 1) * np.where(nearest % 2 == 0, 1, -1)
