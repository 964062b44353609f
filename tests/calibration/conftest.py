"""A known stereo pair before a known board: what every synthetic test starts from."""

from dataclasses import dataclass

import numpy as np
import pytest

from calibration import Board, Camera, Observations, StereoModel
from calibration.camera import Array, project, rotation_from_vector


@dataclass(frozen=True)
class Scene:
    """True cameras, board poses, and the corners they give."""

    model: StereoModel
    board: Board

    def pixels(self, camera: int) -> Array:
        """(n_views, n_points, 2) [px] without noise."""
        m = self.model
        points = np.einsum("vij,nj->vni", m.R_left_board, m.points) + m.t_left_board[:, None]
        if camera:
            points = points @ m.R_right_left.T + m.t_right_left
        return project(points, m.cameras[camera])

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


def make_scene(n_views=12, inner_corners=(9, 6), square=8e-3, distortion=True, deviation=None, seed=3) -> Scene:
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
    R_board, t_board = np.empty((n_views, 3, 3)), np.empty((n_views, 3))
    towards = rotation_from_vector(np.array([0.0, 0.4, 0.0])) @ np.diag([1.0, -1.0, -1.0])  # faces between the cameras
    for v in range(n_views):
        axis = rng.normal(size=3)
        turn = rotation_from_vector(axis / np.linalg.norm(axis) * np.radians(rng.uniform(5, 45)))
        R_board[v] = turn @ towards
        t_board[v] = target + rng.uniform(-0.015, 0.015, 3) - R_board[v] @ centre
    points = board.points + (0 if deviation is None else deviation)
    return Scene(StereoModel(cameras, R_pair, t_pair, R_board, t_board, points), board)


@pytest.fixture(scope="session")
def scene_maker():
    return make_scene
