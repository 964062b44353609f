"""The true rig of a scene and the poses of its chessboard, drawn from the seed."""

from typing import NamedTuple

import numpy as np

from calibration.cameras.camera import Camera, StereoRig, placed, project
from calibration.kit.types import Array
from disctrack.errors import SceneError
from disctrack.frames import rotation_from_vector
from disctrack.synthetic.description import Scene


class View(NamedTuple):
    """One camera and its pose: x_camera = R_camera_world x_world + t_camera_world."""

    camera: Camera
    R_camera_world: Array  # (3, 3)
    t_camera_world: Array  # (3,) [m]

    @property
    def centre(self) -> Array:
        """(3,) centre of projection in the world [m]."""
        return -self.R_camera_world.T @ self.t_camera_world


def views_of(rig: StereoRig) -> list[View]:
    """The cameras of a rig with their poses."""
    return [View(camera, *pose) for camera, pose in zip(rig.cameras, rig.camera_poses(), strict=True)]


def image_of(points_world: Array, view: View) -> Array:
    """Pixels (..., 2) of points (..., 3) [m]; for bounding boxes and truth only."""
    return project(points_world @ view.R_camera_world.T + view.t_camera_world, view.camera)


def all_inside(points_world: Array, rig: StereoRig, border_px: float) -> bool:
    """Do all points (n, 3) [m] lie within both images, farther than this from their borders?"""
    pixels, size = rig.project(points_world), np.array([camera.image_size for camera in rig.cameras])[:, None]
    return bool(np.all((pixels > border_px) & (pixels < size - 1 - border_px)))


def rig_of(scene: Scene) -> StereoRig:
    """The rig during its calibration, with the table as world."""
    rng = np.random.default_rng([scene.seed, 1])
    return StereoRig(**placed([_camera(scene, index, rng) for index in (0, 1)]), world_is_table=True)


def _camera(scene: Scene, index: int, rng: np.random.Generator) -> View:
    """One camera that looks at the target, with the pose and lens of the settings plus the seeded scatter."""
    s, scatter = scene.rig, scene.rig.variation * rng.standard_normal(16)
    target = np.array(s.target_mm) * 1e-3 + 2e-3 * scatter[0:3]
    distance = s.distance_mm[index] * 1e-3 + 0.01 * scatter[3]
    placed = (s.off_vertical_deg[index], s.azimuth_deg[index], s.roll_deg[index])
    off_vertical, azimuth, roll = np.radians(placed + np.array([2.0, 2.0, 1.0]) * scatter[4:7])
    away = np.array(
        [np.sin(off_vertical) * np.cos(azimuth), np.sin(off_vertical) * np.sin(azimuth), np.cos(off_vertical)]
    )
    right = np.array([-np.sin(azimuth), np.cos(azimuth), 0.0])  # image x: horizontal, camera z looks along -away
    upright = np.stack([right, np.cross(-away, right), -away])
    R = rotation_from_vector(np.array([0.0, 0.0, roll])) @ upright
    focal = s.distance_mm[index] / s.mm_per_px * (1 + 0.005 * scatter[7])
    middle = (np.array(scene.cameras.image_size) - 1) / 2 + 4 * scatter[9:11]
    lens = np.array([s.k1[index], s.k2[index], s.p1[index], s.p2[index], s.k3[index]])
    lens += np.array([0.01, 0.03, 2e-4, 2e-4, 0.0]) * scatter[11:16]
    parameters = np.array([focal, focal * (1 + 5e-4 * scatter[8]), *middle, *lens])
    camera = Camera.from_parameters(parameters, scene.cameras.image_size)
    return View(camera, R, -R @ (target + distance * away))


def board_poses(scene: Scene, rig: StereoRig) -> tuple[Array, Array]:
    """R_world_board (n, 3, 3) and t_world_board (n, 3) [m] of the calibration views; view 0 lies flat on the table.

    The others are drawn at random until all squares lie inside both images and both cameras are within 65 degrees of
    the board's normal. Raises SceneError if too few are found.
    """
    board, rng = scene.board, np.random.default_rng([scene.seed, 2])
    middle = (np.array([*board.inner_corners, 1.0]) - 1) / 2 * board.square_mm * 1e-3
    R, t = [np.eye(3)], [np.array([0.0, 0.0, board.thickness_mm * 1e-3])]
    if not _in_view(R[0], t[0], rig, scene):
        raise SceneError("board: lying flat on the table it is not inside both images; move the target or the cameras")
    target = np.array([*scene.rig.target_mm[:2], 0.0]) * 1e-3
    for _ in range(2000 * board.n_views):
        if len(R) == board.n_views:
            return np.stack(R), np.stack(t)
        direction = rng.uniform(0, 2 * np.pi)
        tilt = np.radians(board.max_tilt_deg) * np.sqrt(rng.uniform(0.05, 1.0))
        turn = np.radians(rng.uniform(-board.max_turn_deg, board.max_turn_deg))
        tilted = rotation_from_vector(tilt * np.array([np.cos(direction), np.sin(direction), 0.0]))
        R_try = tilted @ rotation_from_vector(np.array([0.0, 0.0, turn]))
        shift = np.array([*rng.uniform(-board.shift_mm, board.shift_mm, 2), rng.uniform(*board.height_mm)]) * 1e-3
        t_try = target + shift - R_try @ middle
        if _in_view(R_try, t_try, rig, scene):
            R.append(R_try)
            t.append(t_try)
    raise SceneError(
        f"board: only {len(R)} of {board.n_views} views found with all squares in both images; lower board.shift_mm, "
        "board.max_tilt_deg or the number of views"
    )


def _in_view(R_world_board: Array, t_world_board: Array, rig: StereoRig, scene: Scene) -> bool:
    board = scene.board
    corners = np.array([[x, y, 0.0] for x in (-1, board.inner_corners[0]) for y in (-1, board.inner_corners[1])])
    points = corners * board.square_mm * 1e-3 @ R_world_board.T + t_world_board
    eyes = np.array([view.centre for view in views_of(rig)]) - points.mean(axis=0)
    facing = eyes @ R_world_board[:, 2] >= np.cos(np.radians(65)) * np.linalg.norm(eyes, axis=1)
    return all_inside(points, rig, 8) and bool(facing.all())
