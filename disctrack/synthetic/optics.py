"""Blur of the lens over the cells of the sensor, the table's texture, the lamp and the fall-off to the corners."""

from functools import lru_cache

import numpy as np
from scipy.special import erf

from calibration.kit.arrays import Array, Array32
from calibration.kit.compiled import njit
from disctrack.synthetic.cameras import View
from disctrack.synthetic.description import Scene
from disctrack.synthetic.rays import table_points

_TEXTURE_SIZE = 1024  # texels per side
_TEXEL = 0.25e-3  # [m]; the texture repeats after 256 mm


def blur_weights(sigma: float, s: int) -> Array32:
    """Weights of the cells around a pixel: Gaussian point spread (sigma [px]) seen by a square pixel.

    (2 reach s + s,) for pixels -reach ... reach. The function G * box at the cells' centres, normalised. Light at u
    from a cell's centre is laid down as 1 there and +-u / 2 on its neighbours (`areas.deposit`), which has the second
    moment -u^2 about its true place, -1 / (12 s^2) px^2 on average: that is added to sigma^2.
    """
    reach = blur_reach(sigma)
    widened = np.sqrt(sigma**2 + 1 / (12 * s**2))
    offset = (np.arange((2 * reach + 1) * s) + 0.5) / s - reach - 0.5
    scale = 1 / (widened * np.sqrt(2))
    weights = erf((offset + 0.5) * scale) - erf((offset - 0.5) * scale)
    return (weights / weights.sum()).astype(np.float32)


def blur_reach(sigma: float) -> int:
    """Pixels beyond which the point spread is left out: 4.5 sigma."""
    return int(np.ceil(4.5 * sigma + 0.5))


@njit(cache=True, nogil=True, fastmath=True)
def blur_to_pixels(cells: Array32, weights: Array32, s: int) -> Array32:
    """Pixels (rows - 2 reach, columns - 2 reach) from the cells of (rows, columns) pixels."""
    taps = weights.shape[0]
    height, width = (cells.shape[0] - taps) // s + 1, (cells.shape[1] - taps) // s + 1
    columns = np.zeros((height, cells.shape[1]), dtype=np.float32)
    for y in range(height):
        for k in range(taps):
            w, line = weights[k], cells[y * s + k]
            for x in range(cells.shape[1]):
                columns[y, x] += w * line[x]
    pixels = np.empty((height, width), dtype=np.float32)
    for y in range(height):
        for x in range(width):
            total = np.float32(0.0)
            for k in range(taps):
                total += weights[k] * columns[y, x * s + k]
            pixels[y, x] = total
    return pixels


@lru_cache(maxsize=4)
def _texture(seed: int, streaks: float, blotches: float, direction_deg: float) -> Array:
    """Brushed surface, zero mean, periodic: noise smoothed by 6 mm along the brush, 0.25 mm across, and soft spots."""
    rng = np.random.default_rng([seed, 77])
    fx, fy = np.meshgrid(*(2 * [np.fft.fftfreq(_TEXTURE_SIZE, _TEXEL)]), indexing="xy")
    c, s = np.cos(np.radians(direction_deg)), np.sin(np.radians(direction_deg))
    along, across = c * fx + s * fy, -s * fx + c * fy
    result = np.zeros((_TEXTURE_SIZE, _TEXTURE_SIZE))
    for size, length, width in ((streaks, 6e-3, 0.25e-3), (blotches, 3e-3, 1.2e-3)):
        gain = np.exp(-2 * np.pi**2 * ((along * length) ** 2 + (across * width) ** 2))
        layer = np.fft.ifft2(np.fft.fft2(rng.standard_normal(result.shape)) * gain).real
        result += size * (layer - layer.mean()) / layer.std()
    return result


def table_cells(view: View, pad: int, s: int, scene: Scene) -> Array32:
    """Grey values of the bare table in every cell of the padded image: (rows * s, columns * s)."""
    look = scene.appearance
    points = table_points(view, pad)
    if look.table_streaks == 0 and look.table_blotches == 0:
        return np.full((s * (points.shape[0] - 1), s * (points.shape[1] - 1)), look.table, np.float32)
    texture = _texture(scene.seed, look.table_streaks, look.table_blotches, look.streak_direction_deg)
    return _textured_cells(points, s, look.table, texture)


@njit(cache=True, nogil=True)
def _textured_cells(points: Array, s: int, grey: float, texture: Array) -> Array32:
    """Texture at the cells' centres, bilinear between the pixels' corners on the table and between texels; 0.1 s."""
    n = texture.shape[0]
    cells = np.empty((s * (points.shape[0] - 1), s * (points.shape[1] - 1)), dtype=np.float32)
    for row in range(cells.shape[0]):
        i, p = row // s, (row % s + 0.5) / s
        for column in range(cells.shape[1]):
            j, q = column // s, (column % s + 0.5) / s
            a, b, c, d = (1 - p) * (1 - q), (1 - p) * q, p * (1 - q), p * q
            x = a * points[i, j, 0] + b * points[i, j + 1, 0] + c * points[i + 1, j, 0] + d * points[i + 1, j + 1, 0]
            y = a * points[i, j, 1] + b * points[i, j + 1, 1] + c * points[i + 1, j, 1] + d * points[i + 1, j + 1, 1]
            x, y = x / _TEXEL, y / _TEXEL
            k, m = int(np.floor(x)), int(np.floor(y))
            u, v = x - k, y - m
            k0, k1, m0, m1 = k % n, (k + 1) % n, m % n, (m + 1) % n
            value = (1 - v) * ((1 - u) * texture[m0, k0] + u * texture[m0, k1])
            value += v * ((1 - u) * texture[m1, k0] + u * texture[m1, k1])
            cells[row, column] = max(grey + value, 0.0)
    return cells


def illumination(view: View, camera: str, scene: Scene) -> tuple[Array32, Array32]:
    """Factor and addition (height, width) per pixel: lamp's gradient and vignetting; glare."""
    width, height = view.camera.image_size
    y, x = np.mgrid[0:height, 0:width].astype(float)
    corners = table_points(view, 0)
    ground = 0.25 * (corners[1:, 1:] + corners[:-1, 1:] + corners[1:, :-1] + corners[:-1, :-1])
    target = np.array(scene.rig.target_mm[:2]) * 1e-3
    lamp = 1 + np.clip(ground - target, -1.0, 1.0) @ np.array(scene.light.gradient_per_m)
    middle = np.array([(width - 1) / 2, (height - 1) / 2])
    from_middle = ((x - middle[0]) ** 2 + (y - middle[1]) ** 2) / (middle @ middle)
    glare = np.zeros((height, width))
    for spot in scene.light.glare:
        if spot.camera == camera:
            u, v = spot.centre_px
            glare += spot.grey * np.exp(-((x - u) ** 2 + (y - v) ** 2) / (2 * spot.sigma_px**2))
    factor = np.maximum(lamp, 0.0) * (1 - scene.optics.vignetting * from_middle)
    return factor.astype(np.float32), glare.astype(np.float32)


def face_brightness(normal_world: Array, scene: Scene) -> float:
    """Light on a flat face relative to a horizontal one: diffuse share plus Lambert's cosine."""
    direction = np.array(scene.light.direction) / np.linalg.norm(scene.light.direction)
    cosine = max(float(normal_world @ direction), 0.0) / direction[2]
    return 1 - scene.light.directed + scene.light.directed * cosine
