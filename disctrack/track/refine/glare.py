"""Light that is added to an image (glare, a lens that flares), whose gradient shifts the dots' centres; taken off.

Light that falls off over a dot multiplies paper and ink alike, and the template has a slope for it. Light that is added
takes more of the ink's share: the contrast c changes with the place in the image, and inside the dot

    I = L (1 - c S)  has  d I / dx = dL/dx (1 - c S) - L dc/dx S,

whose last term the template takes in part for a shift (`template_pull`): 0.1 grey values per px of glare move a dot of
17 px by some 0.004 px, in all frames alike. The contrasts themselves tell: those of all frames are fitted by a constant
of each dot (ink and paper differ) and one of each frame (lamps flicker, an attitude is better lit than another), and a
polynomial of the place in the image, whose gradient counts.
"""

from collections.abc import Callable

import numpy as np
from numpy.polynomial.polynomial import polyder, polyval2d
from numpy.typing import NDArray

from calibration.cameras.camera import StereoRig
from calibration.kit.arrays import Array, Mask
from disctrack.disc import Disc
from disctrack.track.dots.template_response import Edge, plane_to_image, pulls_by_contrast, turned_to_axes
from disctrack.track.pose import marker_pixels
from disctrack.track.side_by_side import AT_ONCE, MIN_FRAMES, SHARED_FRAMES, evenly

DEGREE = 4  # of the polynomial: glare as wide as the disc's path
POWERS = [(i, k - i) for k in range(1, DEGREE + 1) for i in range(k + 1)]
SAME = 1 / 16  # of a dot's diameter, about a pixel
# Standard deviations of what one term adds to the contrast over the dots' path, in those of the contrast itself: the
# likeliest is the prior, so that noise, and large terms that cancel where the dots are, shift nothing. It must be
# likelier than no gradient by this much
PRIORS = (0.01, 0.03, 0.1, 0.3, 1.0)
LIKELIER = 6.0  # of natural logarithms


def shift_by_glare(R: Array, t: Array, contrast: Array, rig: StereoRig, disc: Disc, edges: tuple[Edge, Edge]) -> Array:
    """(n, 2, m, 2) [px] by which templates find the dots beside their places; zero where not known.

    R (n, 3, 3), t (n, 3) [m]: poses, NaN where there is none; contrast (n, 2, m) of each dot with its paper, NaN where
    it was not seen; edges: of the dots in each camera. One dot tells nothing of the light at another.
    """
    n = len(R)
    shift = np.zeros((n, 2, disc.n_markers, 2))
    apart = _apart(R, t, disc)
    chosen = evenly(apart, SHARED_FRAMES)
    pixels = marker_pixels(R[chosen], t[chosen], rig, disc.marker_centres_body)[0]
    gradients = [_gradient(pixels[:, c], contrast[chosen, c]) for c in (0, 1)]
    for first in range(0, n if any(gradients) else 0, AT_ONCE):
        rows = slice(first, first + AT_ONCE)
        places, J = marker_pixels(R[rows], t[rows], rig, disc.marker_centres_body)
        affine = plane_to_image(J, R[rows])
        for camera, (gradient, edge) in enumerate(zip(gradients, edges, strict=True)):
            if gradient is not None:
                axes = turned_to_axes(affine[:, camera])
                along = (axes @ gradient(places[:, camera])[..., None])[..., 0]
                along *= pulls_by_contrast(0.5 * disc.marker_diameter, affine[:, camera], edge)
                shift[rows, camera] = np.nan_to_num((along[..., None, :] @ axes)[..., 0, :])
    return shift


def _apart(R: Array, t: Array, disc: Disc) -> NDArray[np.intp]:
    """Frames between which the dots went on by SAME of their diameter: what one at rest is off by repeats in all."""
    places = np.einsum("nij,mj->nmi", R, disc.marker_centres_body) + t[:, None]
    places = places[known := np.flatnonzero(np.isfinite(places).all(axis=(1, 2)))]
    steps = np.linalg.norm(np.diff(places, axis=0, prepend=places[:1]), axis=-1).mean(axis=1)
    path = np.floor(np.cumsum(steps) / (SAME * disc.marker_diameter))
    return known[np.unique(path, return_index=True)[1]]


def _gradient(places: Array, contrast: Array) -> Callable[[Array], Array] | None:
    """Of the contrast, (..., 2) [1/px] at places (..., 2) [px], but for constants of dots and frames.

    From places (n, m, 2) [px] and contrasts (n, m) of m dots; None where they are too few, or tell of no gradient.
    """
    known = np.isfinite(contrast) & np.isfinite(places).all(axis=-1)
    if np.sum(known.sum(axis=1) >= 2) < MIN_FRAMES:
        return None
    middle = np.mean(places[known], axis=0)
    scale = float(np.abs(places[known] - middle).max())
    x, y = np.moveaxis((places - middle) / scale, -1, 0)
    terms = np.stack([x**i * y**j for i, j in POWERS], axis=-1)
    dots = np.broadcast_to(np.eye(contrast.shape[1]), (*contrast.shape, contrast.shape[1]))
    rows = np.where(known[..., None], np.concatenate([terms, dots, contrast[..., None]], axis=-1), 0.0)
    use = known
    for _ in range(3):
        centred = _without_frames(rows, use)[use]
        own = centred[:, len(POWERS) : -1]  # of the dots
        left = centred - own @ np.linalg.lstsq(own, centred, rcond=None)[0]
        coefficients, likelier = _likeliest(left[:, : len(POWERS)], left[:, -1])
        away = np.full(contrast.shape, np.inf)
        away[use] = np.abs(left[:, -1] - left[:, : len(POWERS)] @ coefficients)
        use = away <= 4.0 * 1.4826 * np.median(away[use]) + 1e-9
    if likelier < LIKELIER:
        return None
    table = np.zeros((DEGREE + 1, DEGREE + 1))
    table[tuple(np.transpose(POWERS))] = coefficients

    def gradient(places: Array) -> Array:
        x, y = np.moveaxis((places - middle) / scale, -1, 0)
        return np.stack([polyval2d(x, y, polyder(table, axis=axis)) for axis in (0, 1)], axis=-1) / scale

    return gradient


def _likeliest(A: Array, b: Array) -> tuple[Array, float]:
    """Coefficients of b over A's columns under the likeliest of PRIORS, and how much likelier than none it is."""
    normal, rhs = A.T @ A, A.T @ b
    best = np.linalg.pinv(normal, rcond=1e-9, hermitian=True) @ rhs
    noise = max(float(b @ b - rhs @ best) / max(len(b) - 2 * A.shape[1], 1), 1e-14)
    found, likeliest = np.zeros(A.shape[1]), -np.inf
    for prior in np.array(PRIORS) * np.sqrt(np.mean(b**2)):
        matrix = np.eye(A.shape[1]) + prior**2 / noise * normal
        coefficients = prior**2 / noise * np.linalg.solve(matrix, rhs)
        likelier = 0.5 * (float(rhs @ coefficients) / noise - float(np.linalg.slogdet(matrix)[1]))
        if likelier > likeliest:
            found, likeliest = coefficients, likelier
    return found, likeliest


def _without_frames(rows: Array, use: Mask) -> Array:
    """Rows (n, m, k) less their means over the dots of each frame that are used (n, m)."""
    weight = use[..., None].astype(float)
    mean = (rows * weight).sum(axis=1, keepdims=True) / np.maximum(weight.sum(axis=1, keepdims=True), 1.0)
    return np.where(use[..., None], rows - mean, 0.0)
