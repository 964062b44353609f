"""What shifts dots beside their places, taken off: an exposure while the disc moves, light that is added to an image.

**Exposure**, whose time is found where nobody declares it. Over an exposure T a dot is smeared, and its template finds
it beside its place at mid exposure by T^2 / 24 times (second order of the path; the first vanishes)

    c'' + p,    p bilinear in c' and A' A^-1,

c the image of the dot's centre, A (2, 2) the affine map from the disc's plane to the image there, primes rates. The
first term is the mean of the path: while the disc rolls it makes theta read low by sin(theta) (psidot T)^2 / 24 = g T^2
/ (6 r), at every theta alike (steady precession, psidot^2 sin(theta) = 4 g / r), 0.6 mdeg at 0.5 ms and r = 37.5 mm.
The other comes from a dot whose outline changes while it moves, which smears one side more than the other: the image
I(d) of the edge, d the signed distance, changes by T^2 / 24 (I' d_tt + I'' v_n^2) with d_tt = -n.a - kappa v_t^2 + 2
v_t dv_n/ds, and of that the template takes what looks to its normal equations like a shift: mostly I'', as light that
may slope over the paper takes up the halo of the smeared side (`template.pulls`). A dot seen obliquely is an
ellipse, whose ends bend more and count less than its sides: at 70 deg from the normal, what a circle of the same area
would be pulled by is twice too much.

The smear tells T: an edge with normal n whose image moves by v T during the exposure is blurred by (v.n)^2 T^2 / 12
more (variance of a uniform distribution), on the mean over the dot's edge. How fast a dot is changes with its place
about the point of contact, not with the dot or its distance, which the optics' blur depends on: the two are told apart
by a linear fit. Variance of the path and shift of its mean are both in proportion to T^2, whatever light does during
the exposure.

**Glare.** Light that falls off over a dot multiplies paper and ink alike, and the template has a slope for it. Light
that is added takes more of the ink's share: the contrast c changes with the place in the image, and inside the dot

    I = L (1 - c S)  has  d I / dx = dL/dx (1 - c S) - L dc/dx S,

whose last term the template takes in part for a shift (`template.pulls`): 0.1 grey values per px of glare move a dot
of 17 px by some 0.004 px, in all frames alike. The contrasts themselves tell: those of all frames are fitted by a
constant of each dot (ink and paper differ) and one of each frame (lamps flicker, an attitude is better lit than
another), and a polynomial of the place in the image, whose gradient counts.
"""

from collections.abc import Callable
from itertools import product

import numpy as np
from numpy.polynomial.polynomial import polyder, polyval2d
from numpy.typing import NDArray

from calibration.kit.arrays import Array, Mask
from disctrack.analyse.quantities import SIGMAS
from disctrack.findings import Finding, Kind, Severity
from disctrack.frames import CAMERAS
from disctrack.track.dots.template import AROUND, Edge, axes_of, pulls
from disctrack.track.side_by_side import MIN_FRAMES, SHARED_FRAMES, evenly, parts

PARTS = 10  # stretches of the recording, each left out in turn: what the fit leaves has a memory
SURE = 3.0  # sigmas of T^2, or the exposure is taken as short
APPROXIMATE = 0.1  # relative, of T^2: one blur stands for an edge that is smeared more here than there
DEGREE = 4  # of the polynomial: glare as wide as the disc's path
# Standard deviations of what one term adds to the contrast over the dots' path, in those of the contrast itself: the
# likeliest is the prior, so that noise, and large terms that cancel where the dots are, shift nothing. It must be
# likelier than no gradient by this much
PRIORS = (0.01, 0.03, 0.1, 0.3, 1.0)
LIKELIER = 6.0  # of natural logarithms


def shift_by_exposure(
    pixels: Array, affine: Array, time: Array, exposure: Array, radius: float, edges: tuple[Edge, ...]
) -> Array:
    """(n, 2, m, 2) [px] by which the dots of an exposure lie beside their places at mid exposure; zero where not known.

    pixels (n, 2, m, 2) of dots of this radius [m], affine (n, 2, m, 2, 2) [px/m] from the disc's plane to the image,
    NaN where there is no pose; time (n,) [s]; exposure (2,) of the left and the right camera [s]; edges: of the dots in
    each camera. Rates are those of three poses in a row: their noise adds at most 0.1 of itself (T as long as the frame
    interval), what differences leave out is (psidot / frame_rate)^2 / 12 of the shift.
    """
    found = each = _second_order(pixels, affine, time, radius, edges)
    for away in (-1, 1):  # beside a gap: as of a neighbour
        found = np.where(np.isfinite(found), found, np.roll(each, away, axis=0))
    return np.nan_to_num(exposure[:, None, None] ** 2 / 24 * found)


def exposure_by_smear(pixels: Array, affine: Array, time: Array, blur_px: Array) -> Array:
    """(2, 2) T^2 of the left and the right camera [s^2] by the dots' edges, and its sigmas.

    Arguments as of `shift_by_exposure`; blur_px (n, 2, m) sigma of an edge. NaN, sigma infinite, where nothing tells.
    The squared blur is fitted by a constant of every dot, what changes with the distance, as the size does (to second
    order), with the place in the image and with how obliquely a dot is seen (to first: blurs of curved edges are off by
    some 1e-4 px, which would hide a twentieth of 200 us), and T^2 times the smear of one second's exposure. Sigmas are
    those of the jackknife over stretches of the recording, as what a lens adds is not white.
    """
    chosen = evenly(np.arange(len(time)), SHARED_FRAMES)
    smear = _smear(_rate(pixels, time)[chosen], affine[chosen])
    long, short, _ = axes_of(affine[chosen])
    x, y = np.moveaxis(pixels[chosen], -1, 0)
    rows = np.stack([long**-2, 1 / long, x, y, short / long, smear, blur_px[chosen] ** 2], axis=-1)
    return np.transpose([_slope(rows[:, camera]) for camera in (0, 1)])


def exposure_of(
    found: Array, declared: tuple[float, float] | None, longest: float
) -> tuple[tuple[float, float], tuple[Finding, ...]]:
    """The exposure to take off: as declared, else one of both cameras as the smear tells where it is sure, else none.

    found : (2, 2) as `exposure_by_smear` has it; longest : [s] the frame interval, which no exposure exceeds.
    """
    words = [_in_words(*each) for each in zip(CAMERAS, *found, strict=True)]
    told = ", ".join(text for text in words if text)
    if declared is None:
        seconds = _likely(found, longest)
        note = f"exposure by the smear of the moving dots: {told}; poses are of the middle of {1e6 * seconds:.0f} µs"
        return (seconds, seconds), (Finding(Kind.EXPOSURE, Severity.NOTE, note),) if seconds else ()
    expected = np.array(declared) ** 2
    value, sigma = found
    doubt = np.hypot(sigma, APPROXIMATE * np.fmax(np.abs(value), expected))
    if not (np.abs(value - expected) > SIGMAS * doubt).any():
        return declared, ()
    said = " and ".join(f"{1e6 * T:g}" for T in declared)
    text = (
        f"exposure_us is declared (or in the cameras' headers) as {said} µs, the smear of the moving dots shows "
        f"{told}. The declared one is used: poses are off by up to g T^2 / (6 r) in theta if it is wrong"
    )
    return declared, (Finding(Kind.EXPOSURE, Severity.WARNING, text, explains=(Kind.TABLE_DISAGREES,)),)


def _likely(found: Array, longest: float) -> float:
    """One exposure [s] of both cameras; 0 where the smear does not show one, or the cameras tell two."""
    value, sigma = found
    told = np.isfinite(sigma)
    if not told.any():
        return 0.0
    weight = sigma[told] ** -2
    mean = float(weight @ value[told] / weight.sum())
    if not SURE * weight.sum() ** -0.5 < mean < longest**2 * (1 + SURE * APPROXIMATE):
        return 0.0
    doubt = np.hypot(np.hypot(*sigma), APPROXIMATE * mean)
    if told.all() and abs(value[1] - value[0]) > SURE * doubt:
        return 0.0
    return min(float(np.sqrt(mean)), longest)


def _in_words(camera: str, squared: float, sigma: float) -> str:
    if not np.isfinite(sigma):
        return ""
    if squared > SURE * sigma:
        return f"{camera} {1e6 * np.sqrt(squared):.0f} ± {5e5 * sigma / np.sqrt(squared):.0f} µs"
    return f"{camera} below {1e6 * np.sqrt(max(squared, 0.0) + SURE * sigma):.0f} µs"


def _second_order(pixels: Array, affine: Array, time: Array, radius: float, edges: tuple[Edge, ...]) -> Array:
    """(n, 2, m, 2) [px/s^2] the bracket of the module's first equation; NaN at the ends and beside gaps."""
    velocity, acceleration = _rate(pixels, time), np.full_like(pixels, np.nan)
    since = np.diff(time)[:, None, None, None]
    slope = np.diff(pixels, axis=0) / since
    acceleration[1:-1] = 2 * (slope[1:] - slope[:-1]) / (since[1:] + since[:-1])
    known = np.isfinite(affine).all(axis=(-2, -1), keepdims=True)
    growth = _rate(affine, time) @ np.linalg.inv(np.where(known, affine, np.eye(2)))  # NaN without a pose
    for (camera, edge), rows in product(enumerate(edges), parts(len(time))):
        of = affine[rows, camera], growth[rows, camera], velocity[rows, camera]
        acceleration[rows, camera] += _pulled(radius, *of, edge)
    return acceleration


def _pulled(radius: float, affine: Array, growth: Array, velocity: Array, edge: Edge) -> Array:
    """(n, m, 2) [px/s^2] p of dots of this radius [m] in one camera.

    affine (n, m, 2, 2) [px/m]; growth (n, m, 2, 2) [1/s] A' A^-1; velocity (n, m, 2) [px/s].
    """
    pull, axes = pulls(radius, affine, edge)
    v, G = (axes @ velocity[..., None])[..., 0], axes @ growth @ np.swapaxes(axes, -1, -2)
    # the products that `_response` goes by: of the long axis, and of the short one
    rates = v[..., [[0, 0, 1, 1], [1, 1, 0, 0]]] * G[..., [[0, 1, 0, 1], [1, 0, 1, 0]], [[0, 1, 1, 0], [1, 0, 0, 1]]]
    along = np.sum(pull[..., 1:] * rates, axis=-1)
    return np.asarray((along[..., None, :] @ axes)[..., 0, :])


def _rate(values: Array, time: Array) -> Array:
    """Central differences of `values` (n, ...) at `time` (n,) [s]; NaN at the ends and beside gaps."""
    rate = np.full_like(values, np.nan)
    rate[1:-1] = (values[2:] - values[:-2]) / (time[2:] - time[:-2]).reshape(-1, *[1] * (values.ndim - 1))
    return rate


def _smear(velocity: Array, affine: Array) -> Array:
    """(n, 2, m) [px^2/s^2] variance that an exposure of 1 s adds to the edge, on the mean along it.

    velocity (n, 2, m, 2) [px/s]; affine (n, 2, m, 2, 2) [px/m] from the disc's plane to the image.
    """
    angle = 2 * np.pi * np.arange(AROUND) / AROUND
    tangent = affine @ np.stack([-np.sin(angle), np.cos(angle)])  # (n, 2, m, xy, AROUND)
    length = np.hypot(tangent[..., 0, :], tangent[..., 1, :])
    v = velocity[..., None]
    outwards = (v[..., 0, :] * tangent[..., 1, :] - v[..., 1, :] * tangent[..., 0, :]) / length
    return np.asarray((length * outwards**2).sum(axis=-1) / length.sum(axis=-1) / 12)


def _slope(rows: Array) -> tuple[float, float]:
    """Of the last of the rows (n, m, k) over the one before, with its sigma: beside constants of m and other slopes."""
    use = np.isfinite(rows).all(axis=-1)
    use &= use.sum(axis=0) >= MIN_FRAMES
    rows[~use] = 0.0
    scale = np.abs(rows[..., :-1]).max(axis=(0, 1), initial=0.0)
    if not scale[-1] > 0:  # nothing moves
        return np.nan, np.inf
    rows[..., :-1] /= np.where(scale > 0.0, scale, 1.0)

    def fitted(use: Mask) -> tuple[Array, Array]:
        """Slopes, and how far (n, m) the last is from them where it is used."""
        centred = _without_means(rows, use, axis=0)
        products = centred.reshape(-1, rows.shape[-1]).T @ centred.reshape(-1, rows.shape[-1])
        # columns that differ by less than 1e-6 of the largest from a sum of others are not told apart
        slopes = np.linalg.pinv(products[:-1, :-1], rcond=1e-12, hermitian=True) @ products[:-1, -1]
        return slopes, np.where(use, np.abs(centred[..., -1] - centred[..., :-1] @ slopes), np.inf)

    for _ in range(4):
        told, (slopes, away) = use, fitted(use)
        use = away <= 4.0 * 1.4826 * np.median(away[told])
    # without each of the parts: where one alone tells, the others do not agree with it
    part = np.arange(len(rows))[:, None] * PARTS // len(rows)
    without = np.array([fitted(told & (part != k))[0][-1] for k in range(PARTS)])
    sigma = np.sqrt((PARTS - 1) * np.var(without))
    return float(slopes[-1] / scale[-1]), float(sigma / scale[-1])


def shift_by_glare(pixels: Array, affine: Array, contrast: Array, radius: float, edges: tuple[Edge, ...]) -> Array:
    """(n, 2, m, 2) [px] by which templates find the dots beside their places; zero where not known.

    Arguments as of `shift_by_exposure`; contrast (n, 2, m) of each dot with its paper, NaN where it was not seen. One
    dot tells nothing of the light at another.
    """
    shift, chosen = np.zeros_like(pixels), evenly(_apart(pixels), SHARED_FRAMES)
    for camera, edge in enumerate(edges):
        gradient = _gradient(pixels[chosen, camera], contrast[chosen, camera])
        if gradient is not None:
            pull, axes = pulls(radius, affine[:, camera], edge)
            along = pull[..., 0] * (axes @ gradient(pixels[:, camera])[..., None])[..., 0]
            shift[:, camera] = np.nan_to_num((along[..., None, :] @ axes)[..., 0, :])
    return shift


def _apart(pixels: Array) -> NDArray[np.intp]:
    """Frames between which the dots went on by a pixel: what one at rest is off by repeats in all."""
    known = np.flatnonzero(np.isfinite(pixels).all(axis=(1, 2, 3)))
    places = pixels[known]
    steps = np.linalg.norm(np.diff(places, axis=0, prepend=places[:1]), axis=-1).mean(axis=(1, 2))
    return known[np.unique(np.floor(np.cumsum(steps)), return_index=True)[1]]


def _gradient(places: Array, contrast: Array) -> Callable[[Array], Array] | None:
    """Of the contrast, (..., 2) [1/px] at places (..., 2) [px], but for constants of dots and frames.

    From places (n, m, 2) [px] and contrasts (n, m) of m dots; None where they are too few, or tell of no gradient.
    """
    known = np.isfinite(contrast) & np.isfinite(places).all(axis=-1)
    if np.sum(known.sum(axis=1) >= 2) < MIN_FRAMES:
        return None
    middle = np.mean(places[known], axis=0)
    powers = [(i, k - i) for k in range(1, DEGREE + 1) for i in range(k + 1)]
    scale = float(np.abs(places[known] - middle).max())
    x, y = np.moveaxis((places - middle) / scale, -1, 0)
    terms = np.stack([x**i * y**j for i, j in powers], axis=-1)
    dots = np.broadcast_to(np.eye(contrast.shape[1]), (*contrast.shape, contrast.shape[1]))
    rows = np.where(known[..., None], np.concatenate([terms, dots, contrast[..., None]], axis=-1), 0.0)
    use = known
    for _ in range(3):
        centred = _without_means(rows, use, axis=1)[use]
        own = centred[:, len(powers) : -1]  # of the dots
        left = centred - own @ np.linalg.lstsq(own, centred, rcond=None)[0]
        coefficients, likelier = _likeliest(left[:, : len(powers)], left[:, -1])
        away = np.full(contrast.shape, np.inf)
        away[use] = np.abs(left[:, -1] - left[:, : len(powers)] @ coefficients)
        use = away <= 4.0 * 1.4826 * np.median(away[use]) + 1e-9
    if likelier < LIKELIER:
        return None
    table = np.zeros((DEGREE + 1, DEGREE + 1))
    table[tuple(np.transpose(powers))] = coefficients

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


def _without_means(rows: Array, use: Mask, axis: int) -> Array:
    """Rows (n, m, k) less their means over frames (axis 0) or dots (1), of those used (n, m); zero for the others."""
    weight = use[..., None].astype(float)
    mean = (rows * weight).sum(axis=axis, keepdims=True) / np.maximum(weight.sum(axis=axis, keepdims=True), 1.0)
    return np.where(use[..., None], rows - mean, 0.0)
