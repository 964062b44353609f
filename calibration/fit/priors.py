"""Priors of cameras and boards, which matter if few views leave parameters undetermined.

Sensors are accurate to better than 1e-5, so pixels are square unless images were resized. The lens is centred on the
sensor to a few percent unless images were cropped. A radial term moves the image's corner by about a tenth of its
distance from the middle at most. These priors are Cauchy distributions, whose tails let the views contradict them.
Focal lengths, tangential terms and the board's shape have normal priors: with tails for the board as well, a board 4 %
longer along one side with pixels 4 % wider would explain three views slightly better than a bent board.

The widths are those found for lenses and boards in photographs that determine them (29 to 59 values each): k1, k2, k3
at the corner 0.065, 0.073, 0.073 rms, 0.24 at most; tangential 0.0027; principal point 1.4 % of the diagonal; bends,
stretch and shear of boards 0.3 % rms, 1.3 % at most. With ten good views the priors have little effect.

Some boards are printed to a micrometre, some are paper on card. So the board's shape is always free, and how far boards
of its kind depart from the declared one is left open: the standard deviations of bends, of stretch and shear, and of
misprints may each have any value up to the largest one, with equal probability. The shape has the mean and the
covariance of all of these, weighted by their likelihood in the views. The most likely standard deviation alone would
not do: estimated from two or three numbers it vanishes by chance, and the sigmas of three to five views are too small.
"""

from dataclasses import dataclass, replace

import numpy as np
import scipy

from calibration.cameras.camera import N_INTRINSIC, OF_CAMERAS
from calibration.fit.stereo_model import N_STEREO, StereoModel
from calibration.kit.least_squares import Normal, scaled_solve
from calibration.kit.types import Array

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

PARTS = slice(0, 3), slice(3, 5), slice(5, None)  # of a board's shape: bends; stretch and shear; misprints
VARIANCES = np.linspace(1e-5, 1.0, 11) ** 2  # of a part, over the largest one; the first is that of an exact board


def board_basis(nominal: Array) -> Array:
    """(n, 3, 3 n - 7): displacement of the target's points [m] per largest standard deviation of each shape parameter.

    The first three are out of the plane as x^2, x y, y^2 over the half size; then, in the plane, stretch of one side
    against the other, and shear, as of a print stretched by the paper feed; the others are all that remains.
    Shift, rotation and scale of the whole target are excluded: they are equivalent to another pose and baseline. So the
    mean plane is the declared one, and errors of the two sides are equal and opposite, the most likely size if both
    were made equally well.
    """
    d = nominal - nominal.mean(0)
    size, spread = np.abs(d).max(), np.sum(d**2, axis=0)[:2]
    x, y = (d / np.abs(d).max(0).clip(1e-12))[:, :2].T
    up = np.array([0.0, 0.0, BEND * size])
    gauge = [np.broadcast_to(axis * size, d.shape) for axis in np.eye(3)]
    gauge += [np.cross(axis, d) for axis in np.eye(3)] + [d * [*spread[::-1] / spread.sum(), 0.0]]
    smooth = [height[:, None] * up for height in (x * x, x * y, y * y)]
    smooth += [STRETCH * d * [0.5, -0.5, 0.0], STRETCH * d[:, [1, 0, 2]] * [0.5, 0.5, 0.0]]
    q, r = np.linalg.qr(np.stack([*gauge, *smooth], axis=-1).reshape(nominal.size, -1), mode="complete")
    own, rest = slice(len(gauge), r.shape[1]), q[:, r.shape[1] :]
    width = size * np.tile([MISPRINT, MISPRINT, RIPPLE], len(nominal))[:, None]
    white = np.linalg.cholesky(rest.T @ (rest / width**2))
    shapes = np.concatenate([q[:, own] @ r[own, own], np.linalg.solve(white, rest.T).T], axis=1)
    return np.asarray(shapes.reshape(*nominal.shape, -1), float)


@dataclass(frozen=True)
class Prior:
    """Deviations `rows @ parameters - at`, in sigmas, of the intrinsics of each camera of a `StereoModel`.

    Focal lengths are added by their logarithms. The target's shape has a normal prior of its own.
    """

    rows: Array  # (2, 8, 9)
    at: Array  # (2, 8)
    nominal: Array  # (n, 3) [m] the declared points of the target
    to_shape: Array  # (s2, 3 n) matrix from displacements of these to the parameters of the shape, see `board_basis`
    known: Array  # (s2, s2) information about these parameters before the views
    towards: Array  # (s2,) the same times their expectation
    # Corners are weighted by their stated noise. If the scatter of the views exceeds it (4 to 70 times in variance for
    # photographs), or if it is overstated, the prior is multiplied by the same factor.
    weight: float = 1.0

    def shape(self, model: StereoModel) -> Array:
        """(s2,) shape of the model's target."""
        return np.asarray(self.to_shape @ (model.points - self.nominal).reshape(-1), np.float64)

    def normal(self, model: StereoModel) -> Array:
        """(s + 1, s + 1) `Normal.prior`: information at the model, gradient towards the prior, and its loss."""
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
        shape = self.shape(model)
        pull = self.towards - self.known @ shape
        information = scipy.linalg.block_diag(information, self.known)
        towards, cost = np.concatenate([gradient, pull])[:, None], cost - float(shape @ (self.towards + pull))
        return self.weight * np.block([[information, towards], [towards.T, np.array([[cost]])]])

    def learnt(self, normal: Normal, model: StereoModel, weight: float) -> tuple["Prior", float]:
        """The prior that gives the shape its mean and covariance over all variances; how many numbers views determine.

        normal : linearised at the model, with this prior; weight : of the new prior

        Let H be the information of the views about a part, all others eliminated and divided by the weight, and y = H
        times its most likely values. Along an eigenvector of H with the eigenvalue h, a variance v gives the mean
        y v / (1 + h v), the variance v / (1 + h v), and twice the logarithm of the likelihood, y^2 v / (1 + h v) -
        log(1 + h v) (MacKay 1992, Neural Computation 4, 415). A normal prior has the mean and the covariance of their
        mixture (expectation propagation, Minka 2001), but no direction has a covariance larger than without a prior.
        """
        shape, square, determined = self.shape(model), normal.eliminated(), 0.0
        known, towards, index = np.zeros_like(self.known), np.zeros_like(shape), np.arange(len(square))
        for part in PARTS:
            own = index[-1 - len(shape) : -1][part]
            others, to = np.setdiff1d(index[:-1], own), np.append(own, index[-1])
            gone = scaled_solve(square[np.ix_(others, others)], square[np.ix_(others, to)])
            left = square[np.ix_(own, to)] - square[np.ix_(own, others)] @ gone
            H = left[:, :-1] - self.weight * self.known[part, part]
            y = left[:, :-1] @ shape[part] + left[:, -1] - self.weight * self.towards[part]
            h, vectors = np.linalg.eigh(H / weight)
            h, y = np.maximum(h, 0.0), vectors.T @ y / weight
            open = 1.0 / (1.0 + VARIANCES[:, None] * h)  # the prior's share of the information, for each variance
            variances = VARIANCES[:, None] * open
            likelihood = 0.5 * np.sum(y**2 * variances + np.log(open), axis=1)
            p = np.exp(likelihood - scipy.special.logsumexp(likelihood))
            within, mean = p @ variances, p @ variances * y
            # inverse of the covariance, within + between, minus h; without differences of large numbers
            between = np.sqrt(p)[:, None] * (variances * y - mean) / within
            spread = np.eye(len(p)) + between * within @ between.T
            values, axes = np.linalg.eigh(np.diag(p @ open / within) - between.T @ np.linalg.solve(spread, between))
            information = axes * np.maximum(values, 0.0) @ axes.T
            known[part, part] = vectors @ information @ vectors.T
            towards[part] = vectors @ (information @ mean - (p @ open) * y)
            determined += float(h @ within)
        return replace(self, known=known, towards=towards, weight=weight), determined


def priors_of(model: StereoModel, nominal: Array, shape_basis: Array) -> Prior:
    """Prior of the two cameras and of the board; the cameras of the model set the scale of the terms.

    nominal : (n, 3) [m] the declared points of the target; shape_basis : its `board_basis`
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
    basis, n = shape_basis.reshape(nominal.size, -1), shape_basis.shape[-1]
    return Prior(rows, at, nominal, scaled_solve(basis.T @ basis, basis.T), known=np.eye(n), towards=np.zeros(n))
