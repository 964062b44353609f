"""Corrections of the dots' positions for the motion during an exposure, and for glare.

**Exposure**, whose time is estimated if it is not declared. Over an exposure T a dot is blurred by motion, and the
fitted centre differs from that at mid exposure by T^2 / 24 times (second order of the path; the first vanishes)

    c'' + p,    p bilinear in c' and A' A^-1,

c the image of the dot's centre, A (2, 2) the affine map from the disc's plane to the image there, primes rates. The
first term is the mean of the path: while the disc rolls, it lowers theta by sin(theta) (psidot T)^2 / 24 = g T^2 /
(6 r), independent of theta (steady precession, psidot^2 sin(theta) = 4 g / r), 0.6 mdeg at 0.5 ms and r = 37.5 mm.
The second term comes from an outline that changes while the dot moves, so that one side is blurred more than the other:
the image I(d) of the edge, d the signed distance, changes by T^2 / 24 (I' d_tt + I'' v_n^2) with d_tt = -n.a -
kappa v_t^2 + 2 v_t dv_n/ds. The template absorbs part of this as a shift: mostly of I'', as the gradient of light on
the paper absorbs the halo of the blurred side (`template.biases`). A dot seen obliquely is an ellipse, whose ends are
more curved and have less weight than its sides: at 70 deg from the normal, the bias of a circle of the same area would
be twice too large.

Motion blur determines T: an edge with normal n whose image moves by v T during the exposure has the additional variance
(v.n)^2 T^2 / 12 (uniform distribution), averaged over the dot's edge. The speed of a dot depends on its position
relative to the point of contact; the optical blur depends on the dot and its distance. So a linear fit separates the
two. Variance of the path and shift of its mean are both proportional to T^2, whatever the light does during the
exposure.

**Glare.** A gradient of the illumination multiplies paper and ink alike, and is a parameter of the template. Added
light changes the ink more, relative to its grey value: the contrast c depends on the position in the image, and inside
the dot

    I = L (1 - c S)  has  d I / dx = dL/dx (1 - c S) - L dc/dx S.

The template absorbs part of the last term as a shift (`template.biases`): glare with 0.1 grey values per px moves a dot
of 17 px by some 0.004 px, in all frames alike. It is estimated from the contrasts of all frames, fitted by a constant
per dot (ink and paper differ), a constant per frame (lamps flicker, and illumination depends on the attitude), and a
polynomial of the position in the image, whose gradient is used.
"""

from collections.abc import Callable
from itertools import product

import numpy as np
from numpy.polynomial.polynomial import polyder, polyval2d

from calibration.kit.types import Array, Indices, Mask
from disctrack.analyse.quantities import SIGMAS
from disctrack.findings import Finding, Kind, Severity
from disctrack.frames import CAMERAS
from disctrack.track.dots.template import AROUND, Edge, axes_of, biases
from disctrack.track.side_by_side import MIN_FRAMES, SHARED_FRAMES, SURE, evenly, parts

PARTS = 10  # stretches of the recording for the jackknife, as residuals are autocorrelated
APPROXIMATE = 0.1  # relative error of T^2, as a single blur represents an edge that is blurred unevenly
DEGREE = 4  # of the polynomial: glare as wide as the disc's path
# Prior standard deviations of one term of the polynomial over the dots' path, in units of that of the contrast. The one
# of highest evidence is used, so that neither noise nor large terms that cancel shift the dots
PRIORS = (0.01, 0.03, 0.1, 0.3, 1.0)
LIKELIER = 6.0  # least log evidence (natural) for a gradient against none


def shift_by_exposure(
    pixels: Array, affine: Array, time: Array, exposure: Array, radius: float, edges: tuple[Edge, ...]
) -> Array:
    """(n, 2, m, 2) [px] shifts of the dots from their positions at mid exposure; zero if not known.

    pixels (n, 2, m, 2) of dots of this radius [m], affine (n, 2, m, 2, 2) [px/m] from the disc's plane to the image,
    NaN if there is no pose; time (n,) [s]; exposure (2,) of the left and the right camera [s]; edges: of the dots in
    each camera. Rates are differences of three successive poses: they increase the noise by 0.1 at most (T as long as
    the frame interval), and err by (psidot / frame_rate)^2 / 12 of the shift.
    """
    found = each = _second_order(pixels, affine, time, radius, edges)
    for away in (-1, 1):  # next to a gap: the value of the neighbour
        found = np.where(np.isfinite(found), found, np.roll(each, away, axis=0))
    return np.nan_to_num(exposure[:, None, None] ** 2 / 24 * found)


def exposure_by_smear(pixels: Array, affine: Array, time: Array, blur_px: Array) -> Array:
    """(2, 2) T^2 of the left and the right camera [s^2] from the motion blur of the edges, and its sigmas.

    Arguments as for `shift_by_exposure`; blur_px (n, 2, m) sigma of an edge. NaN, sigma infinite, if not determined.
    The model of the squared blur is a constant for every dot; terms in the size (second order), in the position in the
    image and in the obliquity (first order: blurs of curved edges err by some 1e-4 px, which would hide a twentieth of
    200 us); and T^2 times the motion blur of an exposure of one second. Sigmas are those of a jackknife over stretches
    of the recording, as residuals of the lens are autocorrelated.
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
    """The exposure to correct for: as declared; else one of both cameras from motion blur, if significant; else none.

    found : (2, 2) as from `exposure_by_smear`; longest : [s] the frame interval, which no exposure exceeds.
    """
    smears = ", ".join(filter(None, map(_in_words, CAMERAS, *found)))
    if declared is None:
        seconds = _common(found, longest)
        note = f"exposure by the smear of the moving dots: {smears}; poses are of the middle of {1e6 * seconds:.0f} µs"
        return (seconds, seconds), (Finding(Kind.EXPOSURE, Severity.NOTE, note),) if seconds else ()
    expected = np.array(declared) ** 2
    value, sigma = found
    doubt = np.hypot(sigma, APPROXIMATE * np.fmax(np.abs(value), expected))
    if not (np.abs(value - expected) > SIGMAS * doubt).any():
        return declared, ()
    said = " and ".join(f"{1e6 * T:g}" for T in declared)
    text = (
        f"exposure_us is declared (or in the cameras' headers) as {said} µs, the smear of the moving dots shows "
        f"{smears}. The declared one is used: poses are off by up to g T^2 / (6 r) in theta if it is wrong"
    )
    return declared, (Finding(Kind.EXPOSURE, Severity.WARNING, text, explains=(Kind.TABLE_DISAGREES,)),)


def _common(found: Array, longest: float) -> float:
    """Common exposure [s] of both cameras; 0 if it is not significant, or if the cameras differ."""
    value, sigma = found
    known = np.isfinite(sigma)
    if not known.any():
        return 0.0
    weight = sigma[known] ** -2
    mean = float(weight @ value[known] / weight.sum())
    significant = SURE * weight.sum() ** -0.5 < mean < longest**2 * (1 + SURE * APPROXIMATE)
    doubt = np.hypot(np.hypot(*sigma), APPROXIMATE * mean)
    differ = known.all() and abs(value[1] - value[0]) > SURE * doubt
    return min(float(np.sqrt(mean)), longest) if significant and not differ else 0.0


def _in_words(camera: str, squared: float, sigma: float) -> str:
    if not np.isfinite(sigma):
        return ""
    if squared > SURE * sigma:
        return f"{camera} {1e6 * np.sqrt(squared):.0f} ± {5e5 * sigma / np.sqrt(squared):.0f} µs"
    return f"{camera} below {1e6 * np.sqrt(max(squared, 0.0) + SURE * sigma):.0f} µs"


def _second_order(pixels: Array, affine: Array, time: Array, radius: float, edges: tuple[Edge, ...]) -> Array:
    """(n, 2, m, 2) [px/s^2] c'' + p of the module's first equation; NaN at the ends and next to gaps."""
    velocity, acceleration = _rate(pixels, time), np.full_like(pixels, np.nan)
    since = np.diff(time)[:, None, None, None]
    slope = np.diff(pixels, axis=0) / since
    acceleration[1:-1] = 2 * (slope[1:] - slope[:-1]) / (since[1:] + since[:-1])
    known = np.isfinite(affine).all(axis=(-2, -1), keepdims=True)
    growth = _rate(affine, time) @ np.linalg.inv(np.where(known, affine, np.eye(2)))  # NaN without a pose
    for (camera, edge), rows in product(enumerate(edges), parts(len(time))):
        of = affine[rows, camera], growth[rows, camera], velocity[rows, camera]
        acceleration[rows, camera] += _bilinear(radius, *of, edge)
    return acceleration


def _bilinear(radius: float, affine: Array, growth: Array, velocity: Array, edge: Edge) -> Array:
    """(n, m, 2) [px/s^2] the term p for dots of this radius [m] in one camera.

    affine (n, m, 2, 2) [px/m]; growth (n, m, 2, 2) [1/s] A' A^-1; velocity (n, m, 2) [px/s].
    """
    bias, axes = biases(radius, affine, edge)
    v, G = (axes @ velocity[..., None])[..., 0], axes @ growth @ np.swapaxes(axes, -1, -2)
    # the products of `_response`: for the long axis, and for the short one
    rates = v[..., [[0, 0, 1, 1], [1, 1, 0, 0]]] * G[..., [[0, 1, 0, 1], [1, 0, 1, 0]], [[0, 1, 1, 0], [1, 0, 0, 1]]]
    along = np.sum(bias[..., 1:] * rates, axis=-1)
    return np.asarray((along[..., None, :] @ axes)[..., 0, :])


def _rate(values: Array, time: Array) -> Array:
    """Central differences of `values` (n, ...) at `time` (n,) [s]; NaN at the ends and next to gaps."""
    rate = np.full_like(values, np.nan)
    rate[1:-1] = (values[2:] - values[:-2]) / (time[2:] - time[:-2]).reshape(-1, *[1] * (values.ndim - 1))
    return rate


def _smear(velocity: Array, affine: Array) -> Array:
    """(n, 2, m) [px^2/s^2] variance that an exposure of 1 s adds to the blur, averaged along the edge.

    velocity (n, 2, m, 2) [px/s]; affine (n, 2, m, 2, 2) [px/m] from the disc's plane to the image.
    """
    angle = 2 * np.pi * np.arange(AROUND) / AROUND
    tangent = affine @ np.stack([-np.sin(angle), np.cos(angle)])  # (n, 2, m, xy, AROUND)
    length = np.hypot(tangent[..., 0, :], tangent[..., 1, :])
    v = velocity[..., None]
    outwards = (v[..., 0, :] * tangent[..., 1, :] - v[..., 1, :] * tangent[..., 0, :]) / length
    return np.asarray((length * outwards**2).sum(axis=-1) / length.sum(axis=-1) / 12)


def _slope(rows: Array) -> tuple[float, float]:
    """Slope, with sigma, of the last column of rows (n, m, k) over the one before, with constants for m dots.

    The other columns are fitted, too.
    """
    use = np.isfinite(rows).all(axis=-1)
    use &= use.sum(axis=0) >= MIN_FRAMES
    rows[~use] = 0.0
    scale = np.abs(rows[..., :-1]).max(axis=(0, 1), initial=0.0)
    if not scale[-1] > 0:  # nothing moves
        return np.nan, np.inf
    rows[..., :-1] /= np.where(scale > 0.0, scale, 1.0)

    def fitted(use: Mask) -> tuple[Array, Array]:
        """Slopes, and absolute residuals (n, m); infinite for rows not used."""
        centred = _without_means(rows, use, axis=0)
        products = centred.reshape(-1, rows.shape[-1]).T @ centred.reshape(-1, rows.shape[-1])
        # columns that are collinear to 1e-6 of the largest are not separated
        slopes = np.linalg.pinv(products[:-1, :-1], rcond=1e-12, hermitian=True) @ products[:-1, -1]
        return slopes, np.where(use, np.abs(centred[..., -1] - centred[..., :-1] @ slopes), np.inf)

    for _ in range(4):
        used, (slopes, away) = use, fitted(use)
        use = away <= 4.0 * 1.4826 * np.median(away[used])
    # jackknife: a slope that rests on a single part gets a large sigma
    part = np.arange(len(rows))[:, None] * PARTS // len(rows)
    without = np.array([fitted(used & (part != k))[0][-1] for k in range(PARTS)])
    sigma = np.sqrt((PARTS - 1) * np.var(without))
    return float(slopes[-1] / scale[-1]), float(sigma / scale[-1])


def shift_by_glare(pixels: Array, affine: Array, contrast: Array, radius: float, edges: tuple[Edge, ...]) -> Array:
    """(n, 2, m, 2) [px] shifts of the fitted centres by glare; zero if not known.

    Arguments as for `shift_by_exposure`; contrast (n, 2, m) of each dot with its paper, NaN if it was not seen.
    """
    shift, chosen = np.zeros_like(pixels), evenly(_apart(pixels), SHARED_FRAMES)
    for camera, edge in enumerate(edges):
        gradient = _gradient(pixels[chosen, camera], contrast[chosen, camera])
        if gradient is not None:
            bias, axes = biases(radius, affine[:, camera], edge)
            along = bias[..., 0] * (axes @ gradient(pixels[:, camera])[..., None])[..., 0]
            shift[:, camera] = np.nan_to_num((along[..., None, :] @ axes)[..., 0, :])
    return shift


def _apart(pixels: Array) -> Indices:
    """Frames between which the dots move by a pixel: errors at rest repeat in all frames."""
    known = np.flatnonzero(np.isfinite(pixels).all(axis=(1, 2, 3)))
    places = pixels[known]
    steps = np.linalg.norm(np.diff(places, axis=0, prepend=places[:1]), axis=-1).mean(axis=(1, 2))
    return known[np.unique(np.floor(np.cumsum(steps)), return_index=True)[1]]


def _gradient(places: Array, contrast: Array) -> Callable[[Array], Array] | None:
    """Function for the gradient (..., 2) [1/px] of the contrast at positions (..., 2) [px].

    places (n, m, 2) [px] and contrasts (n, m) of m dots; a constant per dot and per frame is fitted, too. None if the
    data are too few, or the gradient is not significant.
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
        constants = centred[:, len(powers) : -1]  # of the dots
        rest = centred - constants @ np.linalg.lstsq(constants, centred, rcond=None)[0]
        coefficients, log_evidence = _most_likely(rest[:, : len(powers)], rest[:, -1])
        away = np.full(contrast.shape, np.inf)
        away[use] = np.abs(rest[:, -1] - rest[:, : len(powers)] @ coefficients)
        use = away <= 4.0 * 1.4826 * np.median(away[use]) + 1e-9
    if log_evidence < LIKELIER:
        return None
    table = np.zeros((DEGREE + 1, DEGREE + 1))
    table[tuple(np.transpose(powers))] = coefficients

    def gradient(places: Array) -> Array:
        x, y = np.moveaxis((places - middle) / scale, -1, 0)
        return np.stack([polyval2d(x, y, polyder(table, axis=axis)) for axis in (0, 1)], axis=-1) / scale

    return gradient


def _most_likely(A: Array, b: Array) -> tuple[Array, float]:
    """Coefficients of A x = b with the prior of highest evidence, and its log evidence relative to x = 0."""
    normal, rhs = A.T @ A, A.T @ b
    best = np.linalg.pinv(normal, rcond=1e-9, hermitian=True) @ rhs
    noise = max(float(b @ b - rhs @ best) / max(len(b) - 2 * A.shape[1], 1), 1e-14)
    found, highest = np.zeros(A.shape[1]), -np.inf
    for prior in np.array(PRIORS) * np.sqrt(np.mean(b**2)):
        matrix = np.eye(A.shape[1]) + prior**2 / noise * normal
        coefficients = prior**2 / noise * np.linalg.solve(matrix, rhs)
        log_evidence = 0.5 * (float(rhs @ coefficients) / noise - float(np.linalg.slogdet(matrix)[1]))
        if log_evidence > highest:
            found, highest = coefficients, log_evidence
    return found, highest


def _without_means(rows: Array, use: Mask, axis: int) -> Array:
    """Rows (n, m, k) minus their means over the frames (axis 0) or dots (1) used (n, m); zero for the others."""
    weight = use[..., None].astype(float)
    mean = (rows * weight).sum(axis=axis, keepdims=True) / np.maximum(weight.sum(axis=axis, keepdims=True), 1.0)
    return np.where(use[..., None], rows - mean, 0.0)
