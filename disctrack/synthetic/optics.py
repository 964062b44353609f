"""Lens, light and sensor.

Rays through the corners of the pixels, blur of the cells, texture of the table, lamp; then fixed pattern, photon noise,
read noise, hot pixels and quantisation.
"""

from collections.abc import Callable
from functools import lru_cache

import numpy as np
from scipy.special import erf

from calibration.cameras.camera import Camera, normalise
from calibration.kit.compiled import njit
from calibration.kit.types import Array, Array32, Image
from disctrack.errors import SceneError
from disctrack.synthetic._raster_kernel import between
from disctrack.synthetic.cameras import View
from disctrack.synthetic.description import ImperfectionSettings, Scene, SensorSettings

_TEXTURE_SIZE = 1024  # texels per side
_TEXEL = 0.25e-3  # [m]; the texture repeats after 256 mm
_N_WAVES = 5
_PERIODS = 0.4, 1.4  # range of the number of periods of a wave along the longer side of the image


@lru_cache(maxsize=8)
def corner_rays(camera: Camera, pad: int, field_px: float = 0.0, key: tuple[int, ...] = ()) -> Array:
    """Directions (x/z, y/z) through the pixels' corners: (height + 2 pad + 1, width + 2 pad + 1, 2).

    Corner [pad, pad] is the pixel position (-1/2, -1/2). Within a pixel directions are interpolated between its four
    corners: for |k1| = 0.2 and f = 1700 px the error is below 1e-4 px. Raises SceneError if the distortion is not
    invertible within the image.
    field_px : rms per axis of a smooth displacement of the image points, drawn from the key
    """
    width, height = (n + 2 * pad + 1 for n in camera.image_size)
    pixels = np.asarray(np.stack(np.meshgrid(np.arange(width), np.arange(height)), axis=-1) - pad - 0.5, float)
    if field_px:
        pixels -= smooth_field(np.random.default_rng(key), camera.image_size, field_px)(pixels)
    rays = normalise(pixels, camera)
    if not np.isfinite(rays).all():
        raise SceneError(f"lens distortion {camera.distortion} folds inside the picture; choose smaller coefficients")
    return rays


def smooth_field(rng: np.random.Generator, image_size: tuple[int, int], rms_px: float) -> Callable[[Array], Array]:
    """Function of pixels (..., 2) that returns displacements (..., 2), a sum of waves with this rms per axis."""
    size = np.array(image_size, float)
    turns = 2 * np.pi * rng.uniform(*_PERIODS, (_N_WAVES, 1)) / size.max()
    angles = rng.uniform(0, 2 * np.pi, _N_WAVES)
    waves = turns * np.stack([np.cos(angles), np.sin(angles)], axis=-1)
    phases = rng.uniform(0, 2 * np.pi, (2, _N_WAVES))

    def raw(pixels: Array) -> Array:
        return np.asarray(np.sin((pixels @ waves.T)[..., None, :] + phases).sum(-1))

    inside = raw(np.stack(np.meshgrid(*(np.linspace(0, n - 1, 33) for n in size)), axis=-1))
    return lambda pixels: rms_px * (raw(pixels) - inside.mean((0, 1))) / inside.std((0, 1))


def table_points(view: View, pad: int) -> Array:
    """Intersections of the rays through the corners of the pixels with the plane z = 0: (..., 2) world x, y [m]."""
    rays = corner_rays(view.camera, pad)
    directions = np.concatenate([rays, np.ones((*rays.shape[:-1], 1))], axis=-1) @ view.R_camera_world
    with np.errstate(divide="ignore", invalid="ignore"):
        distance = -view.centre[2] / directions[..., 2]
    points = view.centre[:2] + distance[..., None] * directions[..., :2]
    return np.where((distance > 0)[..., None], points, 10.0)  # a distant point for rays above the horizon


def blur_weights(sigma: float, s: int) -> Array32:
    """Weights of the cells around a pixel: Gaussian point spread function (sigma [px]) convolved with a square pixel.

    (2 reach s + s,) for pixels -reach ... reach: the convolution at the centres of the cells, normalised. Light at
    distance u from the centre of a cell is deposited as 1 there and +-u / 2 in its neighbours (`_raster_kernel`). That
    has the second moment -u^2 about its true position, -1 / (12 s^2) px^2 on average, which is compensated in sigma^2.
    """
    reach = blur_reach(sigma)
    widened = np.sqrt(sigma**2 + 1 / (12 * s**2))
    offset = (np.arange((2 * reach + 1) * s) + 0.5) / s - reach - 0.5
    scale = 1 / (widened * np.sqrt(2))
    weights = erf((offset + 0.5) * scale) - erf((offset - 0.5) * scale)
    return (weights / weights.sum()).astype(np.float32)


def blur_reach(sigma: float) -> int:
    """Radius of the truncated point spread function [px]: 4.5 sigma."""
    return int(np.ceil(4.5 * sigma + 0.5))


def blur_to_pixels(cells: Array32, weights: Array32, s: int) -> Array32:
    """Pixels (rows - 2 reach, columns - 2 reach) from the cells of (rows, columns) pixels."""
    for _ in range(2):  # separable: along the columns, then along the rows
        cells = (np.lib.stride_tricks.sliding_window_view(cells, len(weights), axis=0)[::s] @ weights).T
    return cells


@lru_cache(maxsize=4)
def _texture(seed: int, streaks: float, blotches: float, direction_deg: float) -> Array:
    """Periodic brushed surface, zero mean: noise smoothed by 6 mm along the brush, 0.25 mm across, and spots."""
    rng = np.random.default_rng([seed, 77])
    fx, fy = np.meshgrid(*(2 * [np.fft.fftfreq(_TEXTURE_SIZE, _TEXEL)]), indexing="xy")
    c, s = np.cos(np.radians(direction_deg)), np.sin(np.radians(direction_deg))
    along, across = c * fx + s * fy, -s * fx + c * fy
    result = np.zeros((_TEXTURE_SIZE, _TEXTURE_SIZE))
    for size, length, width in ((streaks, 6e-3, 0.25e-3), (blotches, 3e-3, 1.2e-3)):
        gain = np.exp(-2 * np.pi**2 * ((along * length) ** 2 + (across * width) ** 2))
        layer = np.fft.ifft2(np.fft.fft2(rng.standard_normal(result.shape)) * gain).real
        result += size * (layer - layer.mean()) / layer.std()
    return np.pad(result, ((0, 1), (0, 1)), mode="wrap")[..., None]


def table_cells(view: View, pad: int, s: int, scene: Scene) -> Array32:
    """Grey values of the empty table in all cells of the padded image: (rows * s, columns * s)."""
    look = scene.appearance
    points = table_points(view, pad)
    texture = _texture(scene.seed, look.table_streaks, look.table_blotches, look.streak_direction_deg)
    return _textured_cells(points, s, look.table, texture)


@njit(cache=True, nogil=True)
def _textured_cells(points: Array, s: int, grey: float, texture: Array) -> Array32:
    """Texture at the centres of the cells, bilinear between corners of pixels and between texels; takes 0.1 s."""
    n = texture.shape[0] - 1
    cells = np.empty((s * (points.shape[0] - 1), s * (points.shape[1] - 1)), dtype=np.float32)
    for row in range(cells.shape[0]):
        for column in range(cells.shape[1]):
            p, q = (row % s + 0.5) / s, (column % s + 0.5) / s
            x = between(points, row // s, column // s, p, q, 0) / _TEXEL
            y = between(points, row // s, column // s, p, q, 1) / _TEXEL
            k, m = int(np.floor(x)), int(np.floor(y))
            cells[row, column] = max(grey + between(texture, m % n, k % n, y - m, x - k, 0), 0.0)
    return cells


def illumination(view: View, camera: str, scene: Scene) -> tuple[Array32, Array32]:
    """Factor (lamp and vignetting) and addend (glare) of each pixel, (height, width)."""
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
    """Illumination of a flat face relative to a horizontal one: diffuse light plus Lambert's cosine law."""
    direction = np.array(scene.light.direction) / np.linalg.norm(scene.light.direction)
    cosine = max(float(normal_world @ direction), 0.0) / direction[2]
    return 1 - scene.light.directed + scene.light.directed * cosine


def sensor_pattern(
    settings: ImperfectionSettings, image_size: tuple[int, int], key: list[int]
) -> Callable[[Array32], Array32]:
    """Fixed pattern of one camera: a function of grey values (height, width) that returns those before noise."""
    if not (settings.pixel_gain or settings.column_offset_dn or settings.response_curve):
        return lambda grey: grey
    rng = np.random.default_rng(key)
    gain = 1 + settings.pixel_gain * rng.standard_normal(image_size[::-1], dtype=np.float32)
    offset = settings.column_offset_dn * rng.standard_normal(image_size[0], dtype=np.float32)
    curvature = np.float32(255.0 * 4.0 * settings.response_curve)

    def with_pattern(grey: Array32) -> Array32:
        part = grey / np.float32(255.0)
        return np.asarray((grey + curvature * part * (1 - part)) * gain + offset, np.float32)

    return with_pattern


def digitise(grey: Array32, settings: SensorSettings, bit_depth: int, rng: np.random.Generator | None) -> Image:
    """Digital image from expected 8-bit grey values (..., height, width).

    The number of electrons is Poisson with mean gain * grey, read noise is Gaussian. The sum is scaled to the bit
    depth, rounded and clipped. Without `rng` the image is only quantised.
    """
    if rng is not None:
        gain = np.float32(settings.gain_e_per_dn)
        if gain > 0:
            electrons = rng.poisson(np.maximum(grey, 0.0) * gain)  # valid up to 1e18, above the limits of a scene
            grey = electrons.astype(np.float32) / gain
        grey = grey + np.float32(settings.read_noise_dn) * rng.standard_normal(grey.shape, dtype=np.float32)
    top = 2**bit_depth - 1
    levels = np.rint((grey + np.float32(settings.black_level_dn)) * np.float32(top / 255.0))
    return np.clip(levels, 0, top).astype(np.uint8 if bit_depth == 8 else np.uint16)


def hot_pixels(settings: SensorSettings, image_size: tuple[int, int], rng: np.random.Generator) -> Array32:
    """Excess grey (height, width) of the hot pixels of the sensor, equal in all frames."""
    excess = np.zeros((image_size[1], image_size[0]), np.float32)
    where = rng.choice(excess.size, settings.hot_pixels, replace=False)
    excess.flat[where] = rng.exponential(settings.hot_pixel_dn, settings.hot_pixels)
    return excess
