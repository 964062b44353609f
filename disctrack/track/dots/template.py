"""The circle template: the centre of a round dot in an image, to a hundredth of a pixel and without bias.

Model of the grey values around one dot, fitted by weighted least squares in a band around its edge:

    I(u) = (L + g . (u - u0)) (1 - c S(d(u) / sigma + kappa sigma / 2))

L, g light and its gradient, c contrast (negative for a light dot on dark), S(z) = erfc(z / sqrt 2) / 2 the edge of a
step blurred by optics, pixel and motion (sigma), d the signed distance in pixels from the edge, kappa the edge's
curvature (blur shifts a curved edge inwards by kappa sigma^2 / 2). d comes from the exact map of every pixel onto the
plane of the dots (distortion and perspective), in which the dot is a circle of radius R about its centre: so the result
is the image of the dot's centre. The centre of the ellipse differs from it by 0.02-0.13 px here.
Free per dot: centre (2), R, sigma, L, g (2), c. R and sigma do not couple with the centre (even against odd), so a dot
printed too large, or motion blur, costs no accuracy.

A change of the image that is not in the model biases the centre. The bias depends on the size and shape of the dot's
image, its blur, contrast and noise, and is tabulated here (`biases`). Only odd changes matter: size, blur and grey
values absorb the even ones.
"""

import math
from typing import NamedTuple

import numpy as np
import scipy

from calibration.kit.grey_levels import level_step
from calibration.kit.types import AnyArray, Array, Codes, Image, robust_sigma
from disctrack.disc import Disc
from disctrack.trajectory import MarkerStatus

ACROSS, AROUND = 60, 32  # nodes across and along an edge
SIZES, SHAPES = 5, np.geomspace(0.2, 1.0, 13)  # grid of the table of biases; a shape is short over long axis


class NoiseModel(NamedTuple):
    """Variance of a pixel of mean grey value I: read + gain * I (photon transfer); grey values as in the file."""

    read: float
    gain: float
    step: float = 1.0  # between neighbouring grey values: 16 if 12 bits are stored in the upper end of 16

    def variance(self, grey: Array) -> Array:
        """Variance [grey^2] at mean grey values of any shape; never below that of rounding, step^2 / 12."""
        return np.maximum(self.read + self.gain * np.asarray(grey, float), self.step**2 / 12.0)


class Edge(NamedTuple):
    """Blur, grey values and noise at the edges of dots in a camera; the defaults are typical values."""

    blur_px: float = 0.8  # sigma
    level: float = 200.0  # grey value of the paper
    contrast: float = 0.85  # of the dots with the paper
    noise: NoiseModel = NoiseModel(1.0, 0.02)
    saturation: int | None = None  # grey value at which the brighter side is clipped; None: it is not


def rough_noise(image: Image) -> NoiseModel:
    """Noise independent of the grey value, from second differences of pixels, most of which lie in flat regions."""
    sigma = robust_sigma(np.diff(np.asarray(image, np.float32), 2)) / np.sqrt(6.0)
    return NoiseModel(sigma**2, 0.0, float(level_step(image)))


def residual_noise(assumed: NoiseModel, results: AnyArray) -> NoiseModel:
    """Noise model from the residuals on the dark and on the light side of the dots' edges; includes any misfit.

    results (k,) of fits with the `assumed` noise. Half of the pixels of each side lie within the blurred edge, so a
    noise far from the assumed one needs two iterations.
    """
    grey = results["level"] * np.stack([1.0 - results["contrast"], np.ones(len(results))])
    residual = assumed.variance(grey) * np.stack([results["inside"], results["outside"]])
    mean, variance = np.median(grey, axis=1), np.median(residual, axis=1)
    gain, read = np.polyfit(mean, variance, 1)
    if gain < 0:  # noise that does not grow with light is modelled as constant
        gain, read = 0.0, variance.mean()
    # a negative intercept is due to a clipped black level; `variance` has a floor
    return NoiseModel(float(read), float(gain), assumed.step)


def face_of(disc: Disc) -> tuple[Array, float, float]:
    """Centres (m, 3) and radius of the dots, and the radius of the uniform background around the disc's axis [m].

    The paper ends, or the bevel begins, a few per cent inside the disc's radius; dots printed farther out extend the
    limit.
    """
    centres = np.ascontiguousarray(disc.marker_centres_body)
    outermost = float(np.hypot(*centres[:, :2].T).max()) + 0.5 * disc.marker_diameter
    rim = max(0.95 * disc.radius, min(outermost + 0.15 * disc.marker_diameter, disc.radius))
    return centres, 0.5 * disc.marker_diameter, rim


def dot_centres(results: AnyArray, status: Codes) -> tuple[AnyArray, Array, Array]:
    """Results (..., m) of DOT from the kernels, NaN unless their status (..., m) is MEASURED, and the dots' centres.

    Centres are pixels (..., m, 2) with covariance (..., m, 2, 2) [px^2].
    """
    known = results.copy()
    known[status != MarkerStatus.MEASURED] = np.nan
    pixels = np.stack([known["u"], known["v"]], axis=-1)
    covariance = np.stack([known[name] for name in ("var_u", "cov_uv", "cov_uv", "var_v")], axis=-1)
    # excess scatter of grey values over the noise model (print, speckle, compression) increases that of the centre
    covariance *= np.maximum(known["chi_square"], 1.0)[..., None]
    return known, pixels, covariance.reshape(*status.shape, 2, 2)


def biases(radius: float, affine: Array, edge: Edge) -> tuple[Array, Array]:
    """Biases (n, m, 2, 5) of centres by changes of the image, along its long and short axes, and rotations into these.

    affine (n, m, 2, 2) [px/m] from the plane of dots of this radius [m] to the image; NaN gives NaN. `_response` is
    interpolated linearly in the dots' size and in the logarithm of their shape.
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
    """(sizes, SHAPES, 2, 5) shifts of the fitted centre along the long axis and the short one.

    The first is by a contrast that grows by 1 per px along the axis, see `dot_shifts`: shifts in px^2. The others are
    by an exposure, over T^2 / 24 and products of velocity v and growth G: along axis 1 by v1 G11, v1 G22, v2 G12,
    v2 G21; along axis 2 by v2 G22, v2 G11, v1 G21, v1 G12. All others vanish by symmetry. The terms of d_tt and v_n^2
    with both v and G u are 2 t.v d(n.Gu)/ds, in which the terms with the curvature cancel, and 2 n.v n.Gu.

    sizes : [px] root of the half axes' product. Linear least squares for centre and slope of the light together, over
    the template's band of pixels, weighted by their noise. The other parameters (size, blur, grey values) are even
    about the centre, and do not couple.
    """
    sigma, level, contrast, noise, _ = edge
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
    """Long and short half axes of the image of a unit circle under maps (..., 2, 2), and rotations into these axes."""
    xx, yy = np.moveaxis(np.sum(affine**2, axis=-1), -1, 0)
    xy = np.sum(affine[..., 0, :] * affine[..., 1, :], axis=-1)
    long = np.sqrt(0.5 * (xx + yy) + np.hypot(0.5 * (xx - yy), xy))
    area = np.abs(affine[..., 0, 0] * affine[..., 1, 1] - affine[..., 0, 1] * affine[..., 1, 0])
    turn = 0.5 * np.arctan2(2 * xy, xx - yy)
    c, s = np.cos(turn), np.sin(turn)
    return long, area / long, np.stack([c, s, -s, c], axis=-1).reshape(affine.shape)
