"""What no laboratory is without: lenses beyond their polynomial, uneven sensors, boards that are not flat."""

from typing import NamedTuple

import numpy as np

from calibration.cameras.camera import Camera
from calibration.kit.arrays import Array, Array32
from disctrack.synthetic.description import BoardSettings, ImperfectionSettings
from disctrack.synthetic.rays import bent_rays

N_WAVES = 5
PERIODS = 0.4, 1.4  # of the waves that make up a lens field, along the image's longer side


class Pattern(NamedTuple):
    """What a sensor adds to the light, the same in every frame."""

    gain: Array32  # (height, width)
    offset: Array32  # (width,) [grey]
    curve: float

    def seen(self, grey: Array32) -> Array32:
        """Array32 values (height, width) as the sensor has them, before its noise."""
        part = grey / np.float32(255.0)
        curved = grey + np.float32(255.0 * 4.0 * self.curve) * part * (1 - part)
        return np.asarray(curved * self.gain + self.offset, np.float32)


def sensor_pattern(settings: ImperfectionSettings, image_size: tuple[int, int], key: list[int]) -> Pattern | None:
    """Pattern of one camera; None for a sensor without any."""
    if not (settings.pixel_gain or settings.column_offset_dn or settings.response_curve):
        return None
    rng = np.random.default_rng(key)
    gain = 1 + settings.pixel_gain * rng.standard_normal(image_size[::-1], dtype=np.float32)
    offset = settings.column_offset_dn * rng.standard_normal(image_size[0], dtype=np.float32)
    return Pattern(gain.astype(np.float32), offset.astype(np.float32), settings.response_curve)


def lens_rays(rays: Array, pad: int, camera: Camera, settings: ImperfectionSettings, key: list[int]) -> Array:
    """Rays through the pixels' corners of a lens with its smooth field."""
    if not settings.lens_field_px:
        return rays
    rng = np.random.default_rng(key)
    size = np.array(camera.image_size, float)
    turns = 2 * np.pi * rng.uniform(*PERIODS, (N_WAVES, 1)) / size.max()
    angles = rng.uniform(0, 2 * np.pi, N_WAVES)
    waves = turns * np.stack([np.cos(angles), np.sin(angles)], axis=-1)
    phases = rng.uniform(0, 2 * np.pi, (2, N_WAVES))

    def raw(pixels: Array) -> Array:
        return np.asarray(np.sin((pixels @ waves.T)[..., None, :] + phases).sum(-1))

    inside = raw(np.stack(np.meshgrid(*(np.linspace(0, n - 1, 33) for n in size)), axis=-1))
    mean, rms = inside.mean((0, 1)), inside.std((0, 1))
    return bent_rays(rays, pad, lambda pixels: settings.lens_field_px * (raw(pixels) - mean) / rms)


def bent_board(settings: ImperfectionSettings, board: BoardSettings) -> Array:
    """Bow, middle, half length and stretch of the board, in squares (`board_raster`)."""
    columns = board.inner_corners[0]
    return np.array(
        [settings.board_bow_mm / board.square_mm, 0.5 * (columns - 1), 0.5 * (columns + 1), settings.board_stretch]
    )
