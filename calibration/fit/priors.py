"""What is known of cameras and boards before any view was taken; it decides where few views leave something open.

Sensors are etched to better than 1e-5, so pixels are square unless somebody has resized the images, and the lens stands
over the middle of the sensor to a few percent unless somebody has cropped them; no radial term moves the image's corner
by much more than a tenth of its distance from the middle. These priors have Cauchy's tails, which let go of what the
views contradict. Focal lengths, tangential terms and the board's shape have normal ones: with tails of its own a board
that is 4 % longer along one side and pixels that are 4 % wider explain three views a little better than a bent sheet.

The sizes are those of photographed lenses and boards where views determine them (29 to 59 numbers each): k1, k2, k3 at
the corner 0.065, 0.073, 0.073 rms, 0.24 at most; tangential 0.0027; the middle 1.4 % of the diagonal; bends, stretch
and shear of boards 0.3 % rms, 1.3 % at most. With ten good views little of this is felt.
"""

from dataclasses import dataclass

import numpy as np

from calibration.cameras.camera import N_INTRINSIC
from calibration.fit.stereo_model import N_STEREO, StereoModel, board_basis
from calibration.kit.arrays import Array

FOCAL = 0.7  # of the logarithm of the focal length over the image's longer side: 28 to 90 deg across, as lenses are
ASPECT = 1e-3  # of fx / fy against 1
CENTRE = 0.02  # of the principal point against the middle of the image, in its diagonals
RADIAL = 0.1  # of what one radial term does at the image's corner, in its distance from the middle
TANGENTIAL = 0.003  # the same of a tangential term
BEND = 1e-2  # of what each smooth term of a board's bend does at its rim, in half the board's size
STRETCH = 5e-3  # relative: longer along one side than along the other, or sheared
MISPRINT = 1e-3  # of a point in the board's plane beyond that, in half the board's size
RIPPLE = 3e-3  # the same out of the plane


@dataclass(frozen=True)
class BoardPrior:
    """Of a target's shape: normal about the declared points, along the directions in which they may move."""

    nominal: Array  # (n, 3) [m]
    to_shape: Array  # (s2, 3 n) parameters of the shape from displacements of the points
    information: Array  # (s2, s2)

    def normal(self, points: Array) -> tuple[Array, float]:
        """Gradient (s2,) towards the prior at points (n, 3) [m], and its part of chi-square."""
        shape = self.to_shape @ (points - self.nominal).reshape(-1)
        pull = self.information @ shape
        return -pull, float(shape @ pull)


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
    board: BoardPrior | None = None  # where the target's shape is refined

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


def priors_of(model: StereoModel, nominal: Array, shape_basis: Array) -> Prior:
    """Of the two cameras, which are needed to some percent for the scale of the terms, and of the board.

    nominal : (n, 3) [m] the target's points as declared; shape_basis : (n, 3, s2) directions in which they may move
    """
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
    return Prior(rows, at, (left, right), tuple(heavy), board=board_prior(nominal, shape_basis))


def board_prior(nominal: Array, shape_basis: Array) -> BoardPrior | None:
    """Of the target's shape along `shape_basis` (n, 3, s2); None if it has none. The smooth part and the rest apart."""
    if not shape_basis.shape[-1]:
        return None
    basis, smooth = (b.reshape(nominal.size, -1) for b in (shape_basis, board_basis(nominal, "warped")))
    size = float(np.abs(nominal - nominal.mean(0)).max())
    along = np.linalg.pinv(smooth) @ basis
    rest = (basis - smooth @ along) / (size * np.tile([MISPRINT, MISPRINT, RIPPLE], len(nominal)))[:, None]
    along = along / (size * np.array([BEND, BEND, BEND, STRETCH, STRETCH]))[:, None]
    return BoardPrior(nominal, np.asarray(np.linalg.pinv(basis)), along.T @ along + rest.T @ rest)
