"""What is known of a camera before any view was taken; it decides where few views leave something open.

Sensors are etched to better than 1e-5, so pixels are square unless somebody has resized the images, and the lens stands
over the middle of the sensor to a few percent unless somebody has cropped them; a radial term alone does not turn an
image inside out unless the lens is a very wide one. These priors have Cauchy's tails, which let go of what the views
contradict. Focal lengths and tangential terms have normal ones. With ten good views nothing of this is felt: they know
the parameters ten to a thousand times better.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from calibration.arrays import Array
from calibration.camera import N_INTRINSIC
from calibration.stereo_model import N_STEREO, StereoModel

FOCAL = 0.7  # of the logarithm of the focal length over the image's longer side: 28 to 90 deg across, as lenses are
ASPECT = 1e-3  # of fx / fy against 1
CENTRE = 0.03  # of the principal point against the middle of the image, in its diagonals
RADIAL = 1.0  # of what one radial term does at the image's corner, in its distance from the middle
TANGENTIAL = 0.01  # the same of a tangential term


@dataclass(frozen=True)
class Prior:
    """Deviations `rows @ parameters - at`, in sigmas, of the parameters that a `StereoModel` has before its poses.

    Focal lengths come beside them, by their logarithms.
    """

    rows: Array  # (k, 24)
    at: Array  # (k,)
    sides: tuple[float, float]  # [px] of the two images, the longer ones
    heavy: tuple[slice, ...]  # rows that share one Cauchy distribution; the others are normal
    # Beside corners that are weighted by their noise, where views disagree by this much more (4 to 70 times in variance
    # on photographs), a prior counts that many times.
    weight: float = 1.0

    def normal(self, model: StereoModel) -> tuple[Array, Array, float]:
        """Information (24, 24) at the model, gradient (24,) towards the prior, and its part of chi-square."""
        parameters = np.concatenate([*(camera.parameters for camera in model.cameras), np.zeros(6)])
        rows, z = np.zeros((2, N_STEREO)), np.zeros(2)
        for index, (camera, side) in enumerate(zip(model.cameras, self.sides, strict=True)):
            f = 0.5 * (camera.fx + camera.fy)
            rows[index, N_INTRINSIC * index : N_INTRINSIC * index + 2] = 0.5 / (f * FOCAL)
            z[index] = np.log(max(f, 1e-300) / side) / FOCAL
        rows, z = np.concatenate([self.rows, rows]), np.concatenate([self.rows @ parameters - self.at, z])
        weight, cost = np.ones(len(z)), float(z @ z)
        for group in self.heavy:
            square = float(z[group] @ z[group])
            weight[group] = 1.0 / (1.0 + square)
            cost += float(np.log1p(square)) - square
        weighted = self.weight * weight[:, None] * rows
        return rows.T @ weighted, -weighted.T @ z, self.weight * cost


def camera_priors(model: StereoModel) -> Prior:
    """Of the two cameras, which are needed to some percent for the scale of the terms."""
    rows, at, heavy = np.zeros((16, N_STEREO)), np.zeros(16), []
    for index, camera in enumerate(model.cameras):
        first, column = 8 * index, N_INTRINSIC * index
        f = 0.5 * (camera.fx + camera.fy)
        size = np.array(camera.image_size, float)
        diagonal = float(np.hypot(*size))
        corner = 0.5 * diagonal / f
        rows[first, column : column + 2] = np.array([1.0, -1.0]) / (f * ASPECT)
        rows[first + 1 : first + 3, column + 2 : column + 4] = np.eye(2) / (CENTRE * diagonal)
        at[first + 1 : first + 3] = 0.5 * (size - 1) / (CENTRE * diagonal)
        radial, tangential = np.array([corner**2, corner**4, corner**6]) / RADIAL, 3 * corner / TANGENTIAL
        for place, term in enumerate((4, 5, 8)):  # k1, k2, k3
            rows[first + 3 + place, column + term] = radial[place]
        rows[first + 6 : first + 8, column + 6 : column + 8] = tangential * np.eye(2)
        heavy += [slice(first, first + 1), slice(first + 1, first + 3), slice(first + 3, first + 6)]
    left, right = (float(max(camera.image_size)) for camera in model.cameras)
    return Prior(rows, at, (left, right), tuple(heavy))
