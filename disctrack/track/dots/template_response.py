"""What a dot's template takes for a shift of the dot: the answer of its least squares to a change of the image.

The template (`dots`) fits centre and slope of the light to a band of pixels about the edge. A change of the image that
it has no name for goes, in part, into the centre: by how much depends on the size and shape of the dot's image, its
blur, contrast and noise, and is tabulated here. Odd changes only: size, blur and grey values take up the even ones.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
import scipy

from calibration.kit.arrays import Array
from disctrack.track.dots.template import TYPICAL_BLUR_PX, NoiseModel

ACROSS, AROUND = 60, 32  # nodes of an edge
SIZES, SHAPES = 5, np.geomspace(0.2, 1.0, 13)  # of dots (short over long axis) between which the pull is interpolated


class Edge(NamedTuple):
    """How the edges of dots look in a camera; as they usually do, where nothing was measured."""

    blur_px: float = TYPICAL_BLUR_PX  # sigma
    level: float = 200.0  # grey value of the paper
    contrast: float = 0.85  # of the dots with it
    noise: NoiseModel = NoiseModel(1.0, 0.02)


def pulls(radius: float, affine: Array, edge: Edge) -> Array:
    """(n, m, 2, 5) shifts by changes of the image, along its long and its short axis, of dots of this radius [m].

    affine (n, m, 2, 2) [px/m] from their plane to the image; NaN where it is. What `_response` tells is linear in the
    dots' size and in the logarithm of their shape.
    """
    long, short = half_axes(affine)
    size, shape = radius * np.sqrt(long * short), short / long
    known = np.isfinite(size)
    if not known.any():
        return np.full((*size.shape, 2, 5), np.nan)
    sizes = np.linspace(size[known].min(), size[known].max() * (1 + 1e-9), SIZES)
    table = scipy.interpolate.RegularGridInterpolator(
        (sizes, np.log(SHAPES)), _response(sizes, edge), bounds_error=False, fill_value=None
    )
    size, shape = np.where(known, size, sizes[0]), np.clip(np.where(known, shape, 1.0), SHAPES[0], SHAPES[-1])
    return np.where(known[..., None, None], table(np.stack([size, np.log(shape)], axis=-1)), np.nan)


def turned_to_axes(affine: Array) -> Array:
    """(..., 2, 2) rotations of the image into the long and the short axis of the images of a circle by these maps."""
    xx, yy, xy = _second_moments(affine)
    turn = 0.5 * np.arctan2(2 * xy, xx - yy)
    c, s = np.cos(turn), np.sin(turn)
    return np.stack([np.stack([c, s], axis=-1), np.stack([-s, c], axis=-1)], axis=-2)


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


def _second_moments(affine: Array) -> tuple[Array, Array, Array]:
    """xx, yy and xy of the images of a unit circle by maps (..., 2, 2)."""
    xx, yy = (affine[..., i, 0] ** 2 + affine[..., i, 1] ** 2 for i in range(2))
    return xx, yy, (affine[..., 0, :] * affine[..., 1, :]).sum(axis=-1)


def half_axes(affine: Array) -> tuple[Array, Array]:
    """The long and the short one of the images of a unit circle by maps (..., 2, 2)."""
    xx, yy, xy = _second_moments(affine)
    long = np.sqrt(0.5 * (xx + yy) + np.hypot(0.5 * (xx - yy), xy))
    return long, np.abs(affine[..., 0, 0] * affine[..., 1, 1] - affine[..., 0, 1] * affine[..., 1, 0]) / long


def plane_to_image(J: Array, R: Array) -> Array:
    """(n, 2, m, 2, 2) [px/m] disc's plane -> image: a step in the plane moves a dot as it moves the disc."""
    return np.asarray(J[..., :3] @ R[:, None, None, :, :2])
