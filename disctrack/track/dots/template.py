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

A change of the image that the template has no name for goes, in part, into the centre: by how much depends on the size
and shape of the dot's image, its blur, contrast and noise, and is tabulated here (`pulls`). Odd changes only: size,
blur and grey values take up the even ones.
"""

import math
from typing import NamedTuple

import numpy as np
import scipy
from numpy.typing import NDArray

from calibration.kit.arrays import Array, Image, robust_sigma
from calibration.kit.grey_levels import full_scale, level_step
from disctrack.disc import Disc
from disctrack.trajectory import MarkerStatus

TYPICAL_BLUR_PX = 0.8  # start value where nothing is known yet
LESS_THAN_FLAT = 0.9  # share of the noise of flat parts, from which on down what fits leave is believed instead
ACROSS, AROUND = 60, 32  # nodes of an edge
SIZES, SHAPES = 5, np.geomspace(0.2, 1.0, 13)  # of dots (short over long axis) between which the pull is interpolated


class NoiseModel(NamedTuple):
    """Variance of a pixel of mean grey value I: read + gain * I (photon transfer); grey values as in the file."""

    read: float
    gain: float
    step: float = 1.0  # between neighbouring grey values: 16 where 12 bits fill the upper end of 16

    def variance(self, grey: Array) -> Array:
        """Variance [grey^2] at mean grey values of any shape; never below that of rounding, step^2 / 12."""
        return np.maximum(self.read + self.gain * np.asarray(grey, float), self.step**2 / 12.0)


class Edge(NamedTuple):
    """How the edges of dots look in a camera; as they usually do, where nothing was measured."""

    blur_px: float = TYPICAL_BLUR_PX  # sigma
    level: float = 200.0  # grey value of the paper
    contrast: float = 0.85  # of the dots with it
    noise: NoiseModel = NoiseModel(1.0, 0.02)


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


def pulls(radius: float, affine: Array, edge: Edge) -> tuple[Array, Array]:
    """Shifts (n, m, 2, 5) by changes of the image, along its long and its short axis, and rotations into these.

    affine (n, m, 2, 2) [px/m] from the plane of dots of this radius [m] to the image; NaN where it is. What `_response`
    tells is linear in the dots' size and in the logarithm of their shape.
    """
    long, short, axes = axes_of(affine)
    size, shape = radius * np.sqrt(long * short), short / long
    known = np.isfinite(size)
    if not known.any():
        return np.full((*size.shape, 2, 5), np.nan), axes
    sizes = np.linspace(size[known].min(), size[known].max() * (1 + 1e-9), SIZES)
    table = scipy.interpolate.RegularGridInterpolator(
        (sizes, np.log(SHAPES)), _response(sizes, edge), bounds_error=False, fill_value=None
    )
    size, shape = np.where(known, size, sizes[0]), np.clip(np.where(known, shape, 1.0), SHAPES[0], SHAPES[-1])
    return np.where(known[..., None, None], table(np.stack([size, np.log(shape)], axis=-1)), np.nan), axes


def _response(sizes: Array, edge: Edge) -> Array:
    """(sizes, SHAPES, 2, 5) what the template takes for a shift, along the long axis and the short one.

    By a contrast that grows by 1 per px along the axis, see `dot_shifts`: shifts in px^2. By an exposure, over T^2 / 24
    and products of velocity v and growth G: shifts along axis 1 go by v1 G11, v1 G22, v2 G12, v2 G21; along axis 2 by
    v2 G22, v2 G11, v1 G21, v1 G12: the others vanish by symmetry. Of d_tt and v_n^2 the parts by v and G u together are
    2 t.v d(n.Gu)/ds, where the terms of the bend cancel, and 2 n.v n.Gu.

    sizes : [px] root of the half axes' product. Least squares over the template's band of pixels, weighted by their
    noise, of centre and slope of the light together; what else is fitted (size, blur, grey values) is even about the
    centre.
    """
    sigma, level, contrast, noise = edge
    d = np.linspace(-3.0 * sigma - 2.0, 3.0 * sigma + 1.0, ACROSS)  # [px] as `_kernels` selects its pixels
    seen = 0.5 * np.array([math.erfc(x) for x in d / (np.sqrt(2.0) * sigma)])  # share of the dot
    grey = 1.0 - contrast * seen
    first = contrast * np.exp(-0.5 * (d / sigma) ** 2) / (np.sqrt(2.0 * np.pi) * sigma)  # derivative by d
    second = -d / sigma**2 * first
    angle = 2 * np.pi * (np.arange(AROUND)[:, None] + 0.5) / AROUND
    cos, sin = np.cos(angle), np.sin(angle)
    a, b = (sizes[:, None, None, None] * SHAPES[:, None, None] ** power for power in (-0.5, 0.5))
    speed = np.hypot(b * cos, a * sin)  # (sizes, SHAPES, AROUND, 1) of the outline with the angle
    n, t = np.stack([b * cos, a * sin]) / speed, np.stack([-a * sin, b * cos]) / speed  # outward, and along the edge
    u, bend = np.stack(np.broadcast_arrays(a * cos, b * sin)), a * b / speed**3
    weight = np.clip(1 + bend * d, 0.0, None) * speed / noise.variance(level * grey)
    found = []
    for v, other in ((0, 1), (1, 0)):
        place = u[v] + n[v] * d
        design = np.stack([-first * n[v], place * grey])
        data = [-place * seen]
        for k, i, j in ((v, v, v), (v, other, other), (other, v, other), (other, other, v)):
            along = bend * t[i] * u[j] + n[i] * t[j]
            data.append(2 * first * t[k] * along + 2 * second * n[k] * n[i] * u[j])
        products, rhs = (np.einsum("ixyad,jxyad->xyij", design * weight, of) for of in (design, np.stack(data)))
        found.append(np.linalg.solve(products, rhs)[..., 0, :])
    return np.stack(found, axis=2)


def axes_of(affine: Array) -> tuple[Array, Array, Array]:
    """Long and short half axes of the images of a unit circle by maps (..., 2, 2), and rotations into them."""
    xx, yy = np.moveaxis(np.sum(affine**2, axis=-1), -1, 0)
    xy = np.sum(affine[..., 0, :] * affine[..., 1, :], axis=-1)
    long = np.sqrt(0.5 * (xx + yy) + np.hypot(0.5 * (xx - yy), xy))
    area = np.abs(affine[..., 0, 0] * affine[..., 1, 1] - affine[..., 0, 1] * affine[..., 1, 0])
    turn = 0.5 * np.arctan2(2 * xy, xx - yy)
    c, s = np.cos(turn), np.sin(turn)
    return long, area / long, np.stack([c, s, -s, c], axis=-1).reshape(affine.shape)
