"""What is wrong with every laboratory, put onto measured trajectories: lenses, prints and boards that are not ideal.

Nothing here knows how the diagnosis describes such errors. A lens' residual field is a sum of plane waves with random
directions and phases; a gleam moves each dot in its own way; the board that the table was taken from was bowed.
"""

from dataclasses import dataclass

import numpy as np
from numpy.random import Generator

from calibration.kit.arrays import Array

WAVES = 14
WAVELENGTHS = (0.4, 1.5)  # of the image's width


@dataclass(frozen=True)
class Laboratory:
    """Imperfections of a laboratory; all off by default."""

    lens_px: float = 0.0  # rms of each camera's smooth residual field, per coordinate
    gleam_px: float = 0.0  # rms of a field of its own for each dot and camera
    print_m: float = 0.0  # rms of the dots' places, per coordinate
    board_bow_m: float = 0.0  # height of the table in the calibrated axes is off by about this ...
    board_tilt: float = 0.0  # ... and its plane is turned by about this [rad]
    board_scale: float = 0.0  # relative error of the squares


# A lens with 0.02 px, a board bowed by 60 um with squares 0.02 % too long, a printer, a gleam and gradients of light.
ORDINARY = Laboratory(0.02, 0.004, 3e-6, 40e-6, 1.2e-4, 1e-4)


def plane_waves(rng: Generator, places_px: Array, width_px: float, rms_px: float) -> Array:
    """Random smooth vector field (..., 2) [px] at places (..., 2) of an image."""
    found = np.zeros_like(places_px)
    for axis in range(2):
        length = width_px * np.exp(rng.uniform(np.log(WAVELENGTHS[0]), np.log(WAVELENGTHS[1]), WAVES))
        angle, phase = rng.uniform(0, 2 * np.pi, (2, WAVES))
        wave = 2 * np.pi / length[:, None] * np.stack([np.cos(angle), np.sin(angle)], axis=1)
        amplitude = rng.standard_normal(WAVES)
        amplitude *= rms_px * np.sqrt(2.0) / np.linalg.norm(amplitude)
        found[..., axis] = np.cos(places_px @ wave.T + phase) @ amplitude
    return found


def shifted_dots(rng: Generator, pixels: Array, width_px: float, laboratory: Laboratory) -> Array:
    """Centres (n, 2, m, 2) as such a laboratory finds them."""
    found = pixels.copy()
    for camera in range(2):
        found[:, camera] += plane_waves(rng, pixels[:, camera], width_px, laboratory.lens_px)
        for dot in range(pixels.shape[2]):
            found[:, camera, dot] += plane_waves(rng, pixels[:, camera, dot], width_px, laboratory.gleam_px)
    return found
