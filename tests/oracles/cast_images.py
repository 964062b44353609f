"""Images of the laboratory of points, by ray casting that has no part in the product's renderer.

Each camera's rays, SUB x SUB a pixel, are cast backwards on to the table, the board and the disc; what they meet is
blurred there and gathered to pixels. The lenses have no residual field.
"""

import re

import cv2
import numpy as np

from disctrack.disc import MA_2014
from tests.oracles import newton_euler
from tests.oracles.point_laboratory import board_pose, cameras_of, pose_of

SUB = 4  # rays per pixel and axis
BLUR = 0.62  # [px] of the lens
TABLE, RIM, PAPER, INK, BLACK, WHITE = 85, 58, 190, 25, 20, 200  # grey values


def rays_of(camera):
    """(2, size SUB, size SUB): x and y where z is 1."""
    fine = (np.arange(camera.size * SUB) + 0.5) / SUB - 0.5
    distorted = (np.stack(np.meshgrid(fine, fine)) - camera.middle[:, None, None]) / camera.focal
    ray = distorted
    for _ in range(12):
        r2 = np.sum(ray * ray, axis=0)
        ray = distorted / (1 + r2 * (camera.k1 + r2 * camera.k2))
    return ray


def on_plane(camera, rays, R, t, height):
    """Where rays meet z = height of a body at R, t: x and y there."""
    x, y, z = (R.T @ camera.R.T @ np.stack([*rays, np.ones_like(rays[0])]).reshape(3, -1)).reshape(3, *rays[0].shape)
    place = R.T @ (camera.place - t)
    along = (height - place[2]) / z
    return place[0] + along * x, place[1] + along * y


def within(distance):
    """Share of each sub-pixel that lies where a distance is negative."""
    return np.clip(0.5 - distance / np.hypot(*np.gradient(distance)), 0, 1)


def exposed(fine, rng):
    """Grey values (uint8) of pixels, from those of sub-pixels: blur, and a sensor's noise."""
    soft = cv2.GaussianBlur(fine, (0, 0), BLUR * SUB, borderType=cv2.BORDER_REPLICATE)
    grey = soft.reshape(len(soft) // SUB, SUB, -1, SUB).mean((1, 3))
    noisy = grey + rng.normal(size=grey.shape) * np.sqrt(0.64 + grey / 50)
    return np.clip(np.rint(noisy), 0, 255).astype(np.uint8)


def board_image(camera, rays, plan, R, t, rng):
    """One view of the board; R, t of its printed face, with the origin at the first corner."""
    x, y = (v / plan.square for v in on_plane(camera, rays, R, t, 0.0))

    def side(cell):  # +1 and -1 in turn
        return (1 - 2 * within(np.abs(cell - 2 * np.rint(0.5 * cell)) - 0.5 + 1e-12)) * -1

    last = np.array(plan.inner_corners) - 1
    beyond = np.maximum(np.maximum(-1 - x, x - last[0] - 1), np.maximum(-1 - y, y - last[1] - 1))
    black = (0.5 + 0.5 * side(x - 0.5) * side(y - 0.5)) * within(beyond)
    return exposed(TABLE + within(beyond - 1) * (WHITE + (BLACK - WHITE) * black - TABLE), rng)


def disc_image(camera, rays, R, t, rng):
    """One image of the disc of Ma et al. at R, t."""
    grey, h = np.full(rays[0].shape, float(TABLE)), MA_2014.half_thickness
    for height in np.linspace(-h, h, 9):
        x, y = on_plane(camera, rays, R, t, height)
        grey += within(np.hypot(x, y) - MA_2014.radius) * (RIM - grey)
    grey += within(np.hypot(x, y) - MA_2014.radius + 1.5e-3) * (PAPER - grey)
    nearest = np.min([np.hypot(x - a, y - b) for a, b, _ in MA_2014.marker_centres_body], axis=0)
    return exposed(grey + within(nearest - 0.5 * MA_2014.marker_diameter) * (INK - grey), rng)


def write(folder, plan, declared):
    """A recording's folder; returns the true poses R (n, 3, 3), t (n, 3), and the cameras.

    declared : recording.toml of another recording of this disc, but for its squares and what is known of tolerances
    """
    rng = np.random.default_rng([plan.seed, 7])
    cameras, target = cameras_of(plan, rng)
    duration = plan.n_frames / plan.frame_rate
    spline = newton_euler.filmed_motion(plan.disc, 12.0, 1.5, duration, plan.frame_rate, psi=2.6)
    R, t = pose_of(spline(np.arange(plan.n_frames) / plan.frame_rate))
    boards = [board_pose(view, plan, target, rng) for view in range(plan.n_views)]
    for name, camera in zip(("left", "right"), cameras, strict=True):
        rays = rays_of(camera)
        views = [board_image(camera, rays, plan, *pose, rng) for pose in boards]
        frames = [disc_image(camera, rays, *pose, rng) for pose in zip(R, t, strict=True)]
        for kind, images in ((f"calibration/{name}", views), (name, frames)):
            (folder / kind).mkdir(parents=True)
            for i, image in enumerate(images):
                cv2.imwrite(str(folder / kind / f"{i:04d}.png"), image)
    text = re.sub(".*_tolerance_mm = .*\n", "", declared)
    (folder / "recording.toml").write_text(re.sub("square_mm = .*", f"square_mm = {1e3 * plan.square}", text))
    return R, t, cameras
