"""What a dot's template takes for a shift of the dot: the answer of its least squares to a change of the image.

The template (`dots`) fits centre and slope of the light to a band of pixels about the edge. A change of the image that
it has no name for goes, in part, into the centre: by how much depends on the size and shape of the dot's image, its
blur, contrast and noise, and is tabulated here. Odd changes only: size, blur and grey values take up the even ones.
"""

from __future__ import annotations

import math
from collections.abc import Callable
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


def pulls(radius: float, affine: Array, edge: Edge, changes: Changes) -> Array:
    """(n, m, 2 k) shifts by k changes of the image, along its long and its short axis, of dots of this radius [m].

    affine (n, m, 2, 2) [px/m] from their plane to the image; NaN where it is. What `_response` tells is linear in the
    dots' size and in the logarithm of their shape.
    """
    long, short = half_axes(affine)
    size, shape = radius * np.sqrt(long * short), short / long
    known = np.isfinite(size)
    if not known.any():
        return np.full((*size.shape, 1), np.nan)
    sizes = np.linspace(size[known].min(), size[known].max() * (1 + 1e-9), SIZES)
    table = scipy.interpolate.RegularGridInterpolator(
        (sizes, np.log(SHAPES)), _response(sizes, edge, changes), bounds_error=False, fill_value=None
    )
    size, shape = np.where(known, size, sizes[0]), np.clip(np.where(known, shape, 1.0), SHAPES[0], SHAPES[-1])
    return np.where(known[..., None], table(np.stack([size, np.log(shape)], axis=-1)), np.nan)


def turned_to_axes(affine: Array) -> Array:
    """(..., 2, 2) rotations of the image into the long and the short axis of the images of a circle by these maps."""
    xx, yy, xy = _second_moments(affine)
    turn = 0.5 * np.arctan2(2 * xy, xx - yy)
    c, s = np.cos(turn), np.sin(turn)
    return np.stack([np.stack([c, s], axis=-1), np.stack([-s, c], axis=-1)], axis=-2)


class _Band(NamedTuple):
    """The template's pixels about an edge, by the distance d from it and the angle round the dot."""

    d: Array  # (ACROSS,) [px]
    seen: Array  # (ACROSS,) share of the dot
    first: Array  # (ACROSS,) derivative of the grey values over the paper's by d
    second: Array
    n: tuple[Array, Array]  # (sizes, SHAPES, AROUND) outward normal, along the long and the short axis
    u: tuple[Array, Array]  # [px] place of the edge
    bend: Array  # [1/px]


Changes = Callable[[_Band, int], Array]  # of an image, odd along axis 0 or 1: (k, sizes, SHAPES, AROUND, ACROSS)


def _response(sizes: Array, edge: Edge, changes: Changes) -> Array:
    """(sizes, SHAPES, 2 k) what the template takes for a shift, along the long axis (k numbers) and the short one.

    sizes : [px] root of the half axes' product. Least squares over the template's band of pixels, weighted by their
    noise, of centre and slope of the light together; what else is fitted (size, blur, grey values) is even about the
    centre.
    """
    sigma, level, contrast, noise = edge
    d = np.linspace(-3.0 * sigma - 2.0, 3.0 * sigma + 1.0, ACROSS)  # as `_kernels` selects its pixels
    seen = 0.5 * np.array([math.erfc(x) for x in d / (np.sqrt(2.0) * sigma)])
    grey = 1.0 - contrast * seen
    first = contrast * np.exp(-0.5 * (d / sigma) ** 2) / (np.sqrt(2.0 * np.pi) * sigma)
    angle = 2 * np.pi * (np.arange(AROUND) + 0.5) / AROUND
    cos, sin = np.cos(angle), np.sin(angle)
    a, b = (sizes[:, None, None] * SHAPES[:, None] ** power for power in (-0.5, 0.5))  # (sizes, shapes, angles)
    speed = np.hypot(b * cos, a * sin)  # of the outline with the angle
    normal, edge_at, bend = (b * cos / speed, a * sin / speed), (a * cos, b * sin), a * b / speed**3
    band = _Band(d, seen, first, -d / sigma**2 * first, normal, edge_at, bend)
    weight = np.clip(1 + bend[..., None] * d, 0.0, None) * speed[..., None] / noise.variance(level * grey)
    found = []
    for axis in range(2):
        place = band.u[axis][..., None] + band.n[axis][..., None] * d
        design = np.stack([-first * band.n[axis][..., None], place * grey])
        weighted = (design * weight).reshape(2, *a.shape[:2], -1)
        flat = design.reshape(2, *a.shape[:2], -1)
        data = changes(band, axis)
        products = np.einsum("ixyk,jxyk->xyij", weighted, flat)
        rhs = np.einsum("ixyk,jxyk->xyij", weighted, data.reshape(len(data), *a.shape[:2], -1))
        found.append(np.linalg.solve(products, rhs)[..., 0, :])
    return np.concatenate(found, axis=-1)


def contrast_graded(band: _Band, axis: int) -> Array:
    """By a contrast that grows by 1 per px along the axis, see `dot_shifts`: shifts in px^2."""
    place = band.u[axis][..., None] + band.n[axis][..., None] * band.d
    return np.asarray(-place * band.seen)[None]


def edge_smeared(band: _Band, axis: int) -> Array:
    """By an exposure, over T^2 / 24 and products of velocity v and growth G, see `dot_shifts`.

    Shifts along axis 1 go by v1 G11, v1 G22, v2 G12, v2 G21; along axis 2 by v2 G11, v2 G22, v1 G12, v1 G21: the others
    vanish by symmetry. Of d_tt and v_n^2 the parts by v and G u together are 2 t.v d(n.Gu)/ds, where the terms of the
    bend cancel, and 2 n.v n.Gu.
    """
    n, u, bend, changes = np.stack(band.n), np.stack(band.u), band.bend, []
    t = np.stack([-n[1], n[0]])
    for v, (i, j) in ((axis, (0, 0)), (axis, (1, 1)), (1 - axis, (0, 1)), (1 - axis, (1, 0))):
        along = bend * t[i] * u[j] + n[i] * t[j]
        changes.append(2 * band.first * (t[v] * along)[..., None] + 2 * band.second * (n[v] * n[i] * u[j])[..., None])
    return np.stack(changes)


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
