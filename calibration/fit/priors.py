"""Priors of cameras and boards, which matter if few views leave parameters undetermined.

Sensors are accurate to better than 1e-5, so pixels are square unless images were resized. The lens is centred on the
sensor to a few percent unless images were cropped. A radial term moves the image's corner by about a tenth of its
distance from the middle at most. These priors are Cauchy distributions, whose tails let the views contradict them.
Focal lengths, tangential terms and the board's shape have normal priors: with tails for the board as well, a board 4 %
longer along one side with pixels 4 % wider would explain three views slightly better than a bent board.

The widths are those found for lenses and boards in photographs that determine them (29 to 59 values each): k1, k2, k3
at the corner 0.065, 0.073, 0.073 rms, 0.24 at most; tangential 0.0027; principal point 1.4 % of the diagonal; bends,
stretch and shear of boards 0.3 % rms, 1.3 % at most. With ten good views the priors have little effect.
"""

from dataclasses import dataclass

import numpy as np
import scipy

from calibration.cameras.camera import N_INTRINSIC, OF_CAMERAS
from calibration.fit.stereo_model import N_STEREO, StereoModel, board_basis
from calibration.kit.arrays import Array

# Standard deviations, or widths of Cauchy distributions.
FOCAL = 0.7  # of the logarithm of the focal length over the image's longer side: fields of view of 28 to 90 deg
ASPECT = 1e-3  # of fx / fy - 1
CENTRE = 0.02  # of the principal point minus the middle of the image, in image diagonals
RADIAL = 0.1  # of the displacement of the image's corner by one radial term, over its distance from the middle
TANGENTIAL = 0.003  # the same for a tangential term
BEND = 1e-2  # of the height at the board's rim for each smooth bending term, in half the board's size
STRETCH = 5e-3  # relative, of the difference of lengths along the two sides, and of shear
MISPRINT = 1e-3  # of other displacements of a point in the board's plane, in half the board's size
RIPPLE = 3e-3  # the same out of the plane


@dataclass(frozen=True)
class Prior:
    """Deviations `rows @ parameters - at`, in sigmas, of the intrinsics of each camera of a `StereoModel`.

    Focal lengths are added by their logarithms. The target's shape is normal about the declared points.
    """

    rows: Array  # (2, 8, 9)
    at: Array  # (2, 8)
    # Of the target: its declared points (n, 3) [m]; the matrix from displacements of these to the refined parameters of
    # the shape (s2, 3 n); and the information matrix of these parameters (s2, s2)
    board: tuple[Array, Array, Array]
    # Corners are weighted by their noise. If the scatter of the views exceeds that (4 to 70 times in variance for
    # photographs), the prior is multiplied by the same factor.
    weight: float = 1.0

    def normal(self, model: StereoModel, stereo_basis: Array) -> Array:
        """(s + 1, s + 1) `Normal.prior`: information at the model, gradient towards the prior, and its loss.

        stereo_basis : (24, s1) free directions of intrinsics and stereo pose
        """
        information, gradient, cost = np.zeros((N_STEREO, N_STEREO)), np.zeros(N_STEREO), 0.0
        for camera, own, rows, at in zip(model.rig.cameras, OF_CAMERAS, self.rows, self.at, strict=True):
            f, focal = 0.5 * (camera.fx + camera.fy), np.zeros(N_INTRINSIC)
            focal[:2] = 0.5 / (f * FOCAL)
            J = np.vstack([rows, focal])
            z = np.append(rows @ camera.parameters - at, np.log(max(f, 1e-300) / max(camera.image_size)) / FOCAL)
            weight, cost = np.ones(len(z)), cost + float(z @ z)
            for group in (slice(0, 1), slice(1, 3), slice(3, 6)):  # each a Cauchy distribution, the others normal
                square = float(z[group] @ z[group])
                weight[group] = 1.0 / (1.0 + square)
                cost += float(np.log1p(square)) - square
            information[own, own], gradient[own] = J.T @ (weight[:, None] * J), -J.T @ (weight * z)
        information, gradient = stereo_basis.T @ information @ stereo_basis, stereo_basis.T @ gradient
        nominal, to_shape, of_shape = self.board
        shape = to_shape @ (model.points - nominal).reshape(-1)
        pull = of_shape @ shape
        information = scipy.linalg.block_diag(information, of_shape)
        towards, cost = np.concatenate([gradient, -pull])[:, None], cost + float(shape @ pull)
        return self.weight * np.block([[information, towards], [towards.T, np.array([[cost]])]])


def priors_of(model: StereoModel, nominal: Array, shape_basis: Array) -> Prior:
    """Prior of the two cameras and of the board; the cameras of the model set the scale of the terms.

    nominal : (n, 3) [m] the declared points of the target; shape_basis : (n, 3, s2) directions in which they may move
    """
    rows, at = np.zeros((2, 8, N_INTRINSIC)), np.zeros((2, 8))
    for camera, own, middle in zip(model.rig.cameras, rows, at, strict=True):
        f, size = 0.5 * (camera.fx + camera.fy), np.array(camera.image_size, float)
        diagonal = float(np.hypot(*size))
        corner = 0.5 * diagonal / f
        own[0, :2] = np.array([1.0, -1.0]) / (f * ASPECT)
        own[[1, 2], [2, 3]] = 1.0 / (CENTRE * diagonal)
        middle[1:3] = 0.5 * (size - 1) / (CENTRE * diagonal)
        own[[3, 4, 5], [4, 5, 8]] = np.array([corner**2, corner**4, corner**6]) / RADIAL  # k1, k2, k3
        own[[6, 7], [6, 7]] = 3 * corner / TANGENTIAL
    return Prior(rows, at, board_prior(nominal, shape_basis))


def board_prior(nominal: Array, shape_basis: Array) -> tuple[Array, Array, Array]:
    """`Prior.board` for a shape along `shape_basis` (n, 3, s2); the smooth part and the rest are independent."""
    basis, smooth = (b.reshape(nominal.size, -1) for b in (shape_basis, board_basis(nominal, "warped")))
    size = float(np.abs(nominal - nominal.mean(0)).max())
    along = np.linalg.pinv(smooth) @ basis
    rest = (basis - smooth @ along) / (size * np.tile([MISPRINT, MISPRINT, RIPPLE], len(nominal)))[:, None]
    along = along / (size * np.array([BEND, BEND, BEND, STRETCH, STRETCH]))[:, None]
    return nominal, np.asarray(np.linalg.pinv(basis)), along.T @ along + rest.T @ rest
