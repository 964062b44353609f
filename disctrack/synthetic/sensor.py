"""From light to the numbers in a file: fixed pattern, photons, read noise, hot pixels, quantisation."""

from collections.abc import Callable

import numpy as np

from calibration.kit.arrays import Array32, Image
from disctrack.synthetic.description import ImperfectionSettings, SensorSettings


def sensor_pattern(
    settings: ImperfectionSettings, image_size: tuple[int, int], key: list[int]
) -> Callable[[Array32], Array32]:
    """Grey values (height, width) as the sensor of one camera has them, the same in every frame, before its noise."""
    if not (settings.pixel_gain or settings.column_offset_dn or settings.response_curve):
        return lambda grey: grey
    rng = np.random.default_rng(key)
    gain = 1 + settings.pixel_gain * rng.standard_normal(image_size[::-1], dtype=np.float32)
    offset = settings.column_offset_dn * rng.standard_normal(image_size[0], dtype=np.float32)
    bend = np.float32(255.0 * 4.0 * settings.response_curve)

    def seen(grey: Array32) -> Array32:
        part = grey / np.float32(255.0)
        return np.asarray((grey + bend * part * (1 - part)) * gain + offset, np.float32)

    return seen


def digitise(grey: Array32, settings: SensorSettings, bit_depth: int, rng: np.random.Generator | None) -> Image:
    """Image as the camera writes it, from the expected 8-bit grey values (..., height, width).

    Electrons are Poisson with mean gain * grey, read noise is Gaussian, the sum is scaled to the bit depth, rounded and
    clipped. Without `rng` the image is quantised only.
    """
    if rng is not None:
        gain = np.float32(settings.gain_e_per_dn)
        if gain > 0:
            electrons = rng.poisson(np.maximum(grey, 0.0) * gain)  # it takes 1e18, more than a scene's limits allow
            grey = electrons.astype(np.float32) / gain
        grey = grey + np.float32(settings.read_noise_dn) * rng.standard_normal(grey.shape, dtype=np.float32)
    top = 2**bit_depth - 1
    levels = np.rint((grey + np.float32(settings.black_level_dn)) * np.float32(top / 255.0))
    return np.clip(levels, 0, top).astype(np.uint8 if bit_depth == 8 else np.uint16)


def hot_pixels(settings: SensorSettings, image_size: tuple[int, int], rng: np.random.Generator) -> Array32:
    """Excess grey of the sensor's hot pixels (height, width), the same in every frame."""
    excess = np.zeros((image_size[1], image_size[0]), np.float32)
    where = rng.choice(excess.size, settings.hot_pixels, replace=False)
    excess.flat[where] = rng.exponential(settings.hot_pixel_dn, settings.hot_pixels)
    return excess
