"""Sensor model: fixed pattern, photon noise, read noise, hot pixels, quantisation."""

from collections.abc import Callable

import numpy as np

from calibration.kit.arrays import Array32, Image
from disctrack.synthetic.description import ImperfectionSettings, SensorSettings


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
