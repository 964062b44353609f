"""Images of the laboratory of points, by ray casting that has no part in the product's renderer.

Each camera's rays, SUB x SUB a pixel, are cast backwards on to the table, the board and the disc; what they meet is
blurred there and gathered to pixels, as boards are for the tests of the corners. The lenses have no residual field.
"""

import re

import cv2
import numpy as np

from calibration import Board, Camera
from disctrack.disc import MA_2014
from tests.oracles import newton_euler
from tests.oracles.drawn_boards import draw_board, exposed, rays_of
from tests.oracles.point_laboratory import board_pose, cameras_of, pose_of

SUB, BLUR = 4, 0.62  # rays per pixel and axis; of the lens [px]
TABLE, RIM, PAPER, INK, BLACK, WHITE = 85, 58, 190, 25, 20, 200  # grey values


def on_plane(camera, rays, R, t, height):
    """Where rays meet z = height of a body at R, t: x and y there."""
    x, y, z = (R.T @ camera.R.T @ np.stack([*rays, np.ones_like(rays[0])]).reshape(3, -1)).reshape(3, *rays[0].shape)
    place = R.T @ (camera.place - t)
    along = (height - place[2]) / z
    return place[0] + along * x, place[1] + along * y


def within(distance):
    """Share of each sub-pixel that lies where a distance is negative."""
    return np.clip(0.5 - distance / np.hypot(*np.gradient(distance)), 0, 1)


def disc_image(camera, rays, R, t, rng):
    """One image of the disc of Ma et al. at R, t."""
    grey, h = np.full(rays[0].shape, float(TABLE)), MA_2014.half_thickness
    for height in np.linspace(-h, h, 9):
        x, y = on_plane(camera, rays, R, t, height)
        grey += within(np.hypot(x, y) - MA_2014.radius) * (RIM - grey)
    grey += within(np.hypot(x, y) - MA_2014.radius + 1.5e-3) * (PAPER - grey)
    nearest = np.min([np.hypot(x - a, y - b) for a, b, _ in MA_2014.marker_centres_body], axis=0)
    grey += within(nearest - 0.5 * MA_2014.marker_diameter) * (INK - grey)
    return exposed(grey.astype(np.float32), SUB, BLUR, rng)


def write(folder, plan, declared):
    """A recording's folder; returns the true poses R (n, 3, 3), t (n, 3), and the cameras.

    declared : recording.toml of another recording of this disc, but for its squares and what is known of tolerances
    """
    rng = np.random.default_rng([plan.seed, 7])
    cameras, target = cameras_of(plan, rng)
    duration = plan.n_frames / plan.frame_rate
    spline = newton_euler.filmed_motion(plan.disc, 12.0, 1.5, duration, plan.frame_rate, psi=2.6)
    R, t = pose_of(spline(np.arange(plan.n_frames) / plan.frame_rate))
    board = Board(plan.inner_corners, plan.square)
    boards = [board_pose(view, plan, target, rng) for view in range(plan.n_views)]
    for name, camera in zip(("left", "right"), cameras, strict=True):
        lens = (camera.focal, camera.focal, *camera.middle, (camera.k1, camera.k2, 0.0, 0.0, 0.0))
        view = Camera(*lens, (camera.size, camera.size))
        faces = [(camera.R @ R_board, camera.R @ (t_board - camera.place)) for R_board, t_board in boards]
        views = [draw_board(view, *face, board, SUB, BLUR, WHITE, BLACK, TABLE, rng, rim=1.0) for face in faces]
        rays = rays_of(view, SUB)
        frames = [disc_image(camera, rays, *pose, rng) for pose in zip(R, t, strict=True)]
        for kind, images in ((f"calibration/{name}", views), (name, frames)):
            (folder / kind).mkdir(parents=True)
            for i, image in enumerate(images):
                cv2.imwrite(str(folder / kind / f"{i:04d}.png"), image)
    text = re.sub(".*_tolerance_mm = .*\n", "", declared)
    (folder / "recording.toml").write_text(re.sub("square_mm = .*", f"square_mm = {1e3 * plan.square}", text))
    return R, t, cameras
