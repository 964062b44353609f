"""The circle template: where the centre of a round dot lies in an image, to a hundredth of a pixel and without bias.

Model of the grey values round one dot, fitted by weighted least squares in a band about its edge:

    I(u) = (L + g . (u - u0)) (1 - c S(d(u) / sigma + kappa sigma / 2))

L, g light and its gradient, c contrast (negative for a light dot on dark), S(z) = erfc(z / sqrt 2) / 2 the edge of a
step blurred by optics, pixel and motion (sigma), d the signed distance in pixels from the edge, kappa the edge's
curvature (a blurred curved edge seems shifted inwards by kappa sigma^2 / 2). d comes from the exact map of every pixel
onto the plane of the dots (distortion and perspective), where the dot is a circle of radius R about its centre: so the
result is the image of the dot's own centre. The centre of the ellipse differs from it by 0.02-0.13 px here.
Free per dot: centre (2), R, sigma, L, g (2), c. R and sigma do not couple with the centre (even against odd), so a dot
printed too large, or motion blur, costs no accuracy.
"""

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from calibration.kit.arrays import Array, Image, robust_sigma
from calibration.kit.grey_levels import full_scale, level_step
from disctrack.disc import Disc
from disctrack.trajectory import MarkerStatus

TYPICAL_BLUR_PX = 0.8  # start value where nothing is known yet
LESS_THAN_FLAT = 0.9  # share of the noise of flat parts, from which on down what fits leave is believed instead


class NoiseModel(NamedTuple):
    """Variance of a pixel of mean grey value I: read + gain * I (photon transfer); grey values as in the file."""

    read: float
    gain: float
    step: float = 1.0  # between neighbouring grey values: 16 where 12 bits fill the upper end of 16

    def variance(self, grey: Array) -> Array:
        """Variance [grey^2] at mean grey values of any shape; never below that of rounding, step^2 / 12."""
        return np.maximum(self.read + self.gain * np.asarray(grey, float), self.step**2 / 12.0)


def typical_noise(image: Image) -> NoiseModel:
    """Noise of an ordinary camera (50 electrons per grey value of 8 bits), where nothing was measured."""
    grey = full_scale(image) / 255.0
    return NoiseModel(grey**2, 0.02 * grey, float(level_step(image)))


def face_of(disc: Disc) -> tuple[Array, float, float]:
    """The dots' centres (m, 3) and radius, and the radius within which the face is one even background for them [m].

    Paper ends, and edges are bevelled, a few per cent inside the disc's radius; a dot printed farther out than that
    moves the limit with it.
    """
    centres = np.ascontiguousarray(disc.marker_centres_body)
    outermost = float(np.hypot(*centres[:, :2].T).max()) + 0.5 * disc.marker_diameter
    rim = max(0.95 * disc.radius, min(outermost + 0.15 * disc.marker_diameter, disc.radius))
    return centres, 0.5 * disc.marker_diameter, rim


def dot_centres(results: NDArray, status: NDArray[np.uint8]) -> tuple[NDArray, Array, Array]:
    """The kernels' table of results (..., m) of DOT, NaN unless their status (..., m) is MEASURED; the dots' centres.

    These are pixels (..., m, 2) and their covariance (..., m, 2, 2) [px^2].
    """
    known = results.copy()
    known[status != MarkerStatus.MEASURED] = np.nan
    pixels = np.stack([known["u"], known["v"]], axis=-1)
    covariance = np.stack([known[name] for name in ("var_u", "cov_uv", "cov_uv", "var_v")], axis=-1)
    # grey values that scatter more than the noise model says (print, speckle, compression) scatter the centre too
    covariance *= np.maximum(known["chi_square"], 1.0)[..., None]
    return known, pixels, covariance.reshape(*status.shape, 2, 2)


def measure_noise(
    images: list[Image], pixels: Array, affine: Array, disc: Disc, blur_px: float = TYPICAL_BLUR_PX
) -> NoiseModel:
    """Photon transfer from the dots themselves: variance against mean in the flat parts inside and beside each dot.

    images (n) of one camera; pixels (n, m, 2) of the dots' centres in them, NaN where a dot is not seen; affine
    (n, m, 2, 2) [px/m] from the disc's plane to the image there. In each flat part a plane is fitted and the mean
    square about it taken, so light gradients do not count as noise; parts struck by a hot pixel or a print fault are
    dropped (beyond 4 median absolute deviations of their class).
    """
    means, variances, weights = [], [], []
    radius = 0.5 * disc.marker_diameter
    flat = max(4.0 * blur_px, 2.5)  # [px] from the edge: beyond, the blur's tail is below 1e-4 of the contrast
    for image, centres, maps in zip(images, pixels, affine, strict=True):
        for (x, y), to_image in zip(centres, maps, strict=True):
            reach = radius * np.linalg.norm(to_image, 2) + flat + 5.0
            if not (reach <= x < image.shape[1] - reach and reach <= y < image.shape[0] - reach):
                continue
            window = slice(int(y - reach), int(y + reach) + 2), slice(int(x - reach), int(x + reach) + 2)
            v, u = np.mgrid[window]
            rho = np.hypot(*np.einsum("ij,jvu->ivu", np.linalg.inv(to_image), np.stack([u - x, v - y])))
            step = np.hypot(*np.gradient(rho))  # [m] per pixel
            distance = (rho - radius) / step
            for part in (distance < -flat, (distance > flat) & (distance < flat + 4.5)):
                v, u = np.nonzero(part)
                if len(v) < 20:
                    continue
                A = np.column_stack([np.ones(len(v)), u - u.mean(), v - v.mean()])
                grey = image[window][part].astype(float)
                residual = grey - A @ np.linalg.lstsq(A, grey, rcond=None)[0]
                means.append(grey.mean())
                variances.append(residual @ residual / (len(v) - 3))
                weights.append(len(v) - 3)
    if len(means) < 4:
        return typical_noise(images[0])
    return photon_transfer(np.array(means), np.array(variances), np.array(weights), float(level_step(images[0])))


def photon_transfer(mean: Array, variance: Array, freedom: Array, step: float) -> NoiseModel:
    """The law read + gain * I of variances (k,) with so many degrees of freedom at mean grey values (k,)."""
    bright = mean > 0.5 * (mean.min() + mean.max())
    keep = np.ones(len(mean), bool)
    for group in (bright, ~bright):
        if group.any():
            middle = np.median(variance[group])
            spread = robust_sigma(variance[group]) + 1e-9 * step**2
            keep[group] = np.abs(variance[group] - middle) < 4 * spread
    A = np.column_stack([np.ones(keep.sum()), mean[keep]])
    # a variance with f degrees of freedom scatters by sqrt(2 / f) of itself
    w = np.sqrt(freedom[keep] / 2) / np.maximum(variance[keep], 1e-3 * step**2)
    read, gain = np.linalg.lstsq(A * w[:, None], variance[keep] * w, rcond=None)[0]
    if gain < 0:  # noise that does not grow with light: a constant says all
        return NoiseModel(float(np.average(variance[keep], weights=freedom[keep])), 0.0, step)
    # a negative intercept is a clipped black level: keep the law above it, `variance` holds the floor
    return NoiseModel(float(read), float(gain), step)


def no_more_than_left(flat: NoiseModel, assumed: NoiseModel, results: NDArray) -> NoiseModel:
    """The law found in flat parts, unless dots leave less than it says: then there were no flat parts.

    Dots that are small beside their blur, or beside one another, have none. results (k,) of fits that took the
    noise as `assumed`; what they leave is noise and misfit, and so never less than the noise.
    """
    middle = results["level"] * (1.0 - 0.5 * results["contrast"])
    left = float(np.median(results["chi_square"] * assumed.variance(middle) / flat.variance(middle)))
    if left > LESS_THAN_FLAT:  # within the scatter of both
        return flat
    return flat._replace(read=flat.read * left, gain=flat.gain * left)
