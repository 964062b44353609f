"""Which ray reaches which point of the sensor: the renderer's own inverse of Brown's distortion.

Nothing here is shared with `calibration.cameras.camera` but the numbers in its containers, so that a mistake there
shows up as a disagreement between rendered images and projected points.
"""

from collections.abc import Callable
from functools import lru_cache

import numpy as np

from calibration.cameras.camera import Camera
from calibration.kit.arrays import Array
from calibration.kit.compiled import njit
from disctrack.errors import SceneError
from disctrack.synthetic.cameras import View


@njit(cache=True, nogil=True)
def _undistort(xd: float, yd: float, k1: float, k2: float, p1: float, p2: float, k3: float) -> tuple[float, float]:
    """Fixed-point iteration x = (xd - tangential(x)) / radial(x) to round-off; NaN where it does not settle."""
    x, y = xd, yd
    for _ in range(200):
        s = x * x + y * y
        radial = 1.0 + s * (k1 + s * (k2 + s * k3))
        xn = (xd - 2.0 * p1 * x * y - p2 * (s + 2.0 * x * x)) / radial
        yn = (yd - 2.0 * p2 * x * y - p1 * (s + 2.0 * y * y)) / radial
        change = abs(xn - x) + abs(yn - y)
        x, y = xn, yn
        if change < 1e-15:
            return x, y
    if change < 1e-11:
        return x, y
    return np.nan, np.nan


@njit(cache=True, nogil=True)
def _corner_rays(width: int, height: int, pad: int, intrinsics: Array) -> Array:
    fx, fy, cx, cy, k1, k2, p1, p2, k3 = intrinsics
    rays = np.empty((height + 2 * pad + 1, width + 2 * pad + 1, 2))
    for row in range(rays.shape[0]):
        for column in range(rays.shape[1]):
            u, v = column - pad - 0.5, row - pad - 0.5
            x, y = _undistort((u - cx) / fx, (v - cy) / fy, k1, k2, p1, p2, k3)
            rays[row, column, 0] = x
            rays[row, column, 1] = y
    return rays


@lru_cache(maxsize=8)
def corner_rays(camera: Camera, pad: int) -> Array:
    """Directions (x/z, y/z) through the pixels' corners: (height + 2 pad + 1, width + 2 pad + 1, 2), read-only.

    Corner [pad, pad] is the pixel position (-1/2, -1/2). Within a pixel directions are interpolated between its four
    corners: for |k1| = 0.2 and f = 1700 px the error is below 1e-4 px. Raises SceneError where the distortion folds
    inside the picture.
    """
    rays = _corner_rays(*camera.image_size, pad, camera.parameters)
    if not np.isfinite(rays).all():
        raise SceneError(f"lens distortion {camera.distortion} folds inside the picture; choose smaller coefficients")
    rays.flags.writeable = False
    return rays


def bent_rays(rays: Array, pad: int, field: Callable[[Array], Array]) -> Array:
    """Rays of `corner_rays` where image points lie off by field(pixels (..., 2)), some hundredths of a pixel."""
    rows, columns = np.mgrid[: rays.shape[0], : rays.shape[1]]
    off = field(np.stack([columns, rows], axis=-1) - pad - 0.5)
    by_row, by_column = np.gradient(rays, axis=(0, 1))
    bent = np.asarray(rays - by_column * off[..., :1] - by_row * off[..., 1:])
    bent.flags.writeable = False  # as those that they are made of: what draws is compiled for such
    return bent


def table_points(view: View, pad: int) -> Array:
    """Where the rays through the pixels' corners meet the plane z = 0: (..., 2) x, y [m] in the world."""
    rays = corner_rays(view.camera, pad)
    directions = np.concatenate([rays, np.ones((*rays.shape[:-1], 1))], axis=-1) @ view.R_camera_world
    centre = -view.R_camera_world.T @ view.t_camera_world
    with np.errstate(divide="ignore", invalid="ignore"):
        distance = -centre[2] / directions[..., 2]
    points = centre[:2] + distance[..., None] * directions[..., :2]
    return np.where((distance > 0)[..., None], points, 10.0)  # above the horizon: far away
