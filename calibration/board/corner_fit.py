"""The corners of one view, fitted to the grey values of their own two edges (`_corner_kernel`) and tested.

Windows reach almost to the neighbouring edges whatever the size and slant of the squares. The noise of the image is
measured inside the squares, so that every corner has a variance and a chi-square of its own.

Where the image of a corner is not that of two crossing edges, OpenCV's saddle point stands in. Compression, sharpening,
half-tone print and dirt leave a corner where it was, but not its edges. How far such a corner may be trusted is read
from the view itself: the image of a flat grid is a smooth function of its two indices, and what the corners scatter
about it is their error.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import cv2
import numpy as np
import scipy
from numpy.typing import NDArray

from calibration.board._corner_kernel import N_CORNER, fit_corners
from calibration.board.target import LEAST_POINTS
from calibration.kit.arrays import Array, Mask

LEAST_SIGMA = 0.05  # px, of a corner that no model fits
MAX_WINDOW = 0.85  # of a square: the next edge, blurred, must stay outside
MIN_WINDOW = 0.3
FIRST_REACH = 85.0  # px, of the first fit's window: what it is to tell, blur and noise and places, it tells as well
EDGE_MARGIN = 3.0  # in sigmas of the blur, between the window and the next edge
MAX_CHI_SQUARE = 25.0  # edge pixels, reduced: beyond, it is not the image of two crossing edges
BAD_WINDOW = 3.0  # whole window, reduced, against the view's median: beyond, a smaller window is tried
ROUGHER = 0.7  # scatter of saddle points about a smooth grid over that of the fits: below, the fits are not trusted
MAX_DISPLACEMENT = 0.2  # of a square, from the corner's neighbours: beyond, another feature was fitted
WINDOW = 0.35  # of a square: half width of the window of the saddle point


def prepare() -> None:
    """Compile the fit of corners, or load it: some seconds once per installation, then nothing."""
    fit_corners(np.zeros((8, 8)), np.zeros((0, 14)), np.zeros((0, N_CORNER)), np.zeros((0, 4)), np.zeros(2), 1, 1e-2)


@dataclass(frozen=True)
class CornerView:
    """Inner corners of one view, in the order of `Board.points`."""

    image_size: tuple[int, int]  # width, height [px]
    points: Array  # (n, 2) [px]
    covariance: Array  # (n, 2, 2) [px^2] from the image's own noise, enlarged where the edges fit badly
    accepted: Mask  # (n,)
    reasons: tuple[str, ...]  # (n,) why a corner was rejected; "" where it holds, or was not in view
    notes: tuple[str, ...] = ()

    def reordered(self, order: NDArray[np.intp]) -> CornerView:
        """The same view with corner order[i] in place i: for boards whose colouring allows several orders."""
        arrays = {name: getattr(self, name)[order] for name in ("points", "covariance", "accepted")}
        return replace(self, reasons=tuple(self.reasons[i] for i in order), **arrays)


def fit_view(
    grey: Array,
    rough: Array,
    inner_corners: tuple[int, int],
    seen: Mask | None = None,
    plain: float = 1.0,
) -> CornerView:
    """Fit every corner twice: first to learn blur, noise, bends of the lines and changes of contrast, then with them.

    rough : (n, 2) [px] of all corners; where one is not `seen` (n,), the place where the others put it
    plain : how far, in squares, the light squares are plain on either side of an edge: markers leave a margin
    """
    noise, blur, known = np.array([1.0, 0.0]), 1.0, np.zeros((len(rough), 4))
    seen = np.ones(len(rough), bool) if seen is None else seen
    axes = local_axes(rough, seen, inner_corners)
    starts = _starts(grey, rough, axes, blur, 0.7 * min(plain, 0.57))
    for iterations, tolerance, most in ((12, 1e-2, FIRST_REACH), (30, 1e-5, np.inf)):
        windows = _windows(starts[:, :2], axes, blur, grey.shape, -plain * np.sign(starts[:, 6]), most)
        fit: _Fit = fit_corners(grey, windows, starts, known, noise, iterations, tolerance)
        found, _, sums, converged = fit
        ok = converged & seen
        ok &= _displacement(found[:, :2], ok, axes, inner_corners) < MAX_DISPLACEMENT
        if not ok.any():
            break
        noise, blur = _measured_noise(sums[ok]), float(np.median(found[ok, 4]))
        starts = np.where(ok[:, None], found, starts)
        points = np.where(ok[:, None], found[:, :2], rough)
        axes = local_axes(points, ok, inner_corners)
        bends = _line_curvature(points, ok, found[:, 2:4], inner_corners)
        known = np.concatenate([bends, _contrast_gradient(points, ok, found[:, 5:7])], axis=1)
    _mend_with_smaller_windows(grey, fit, windows, starts, known, noise)
    return _judged(grey, fit, axes, rough, inner_corners, seen, plain)


_Fit = tuple[Array, Array, Array, Mask]  # what the kernel returns for the corners of a view


def _chi_square(fit: _Fit) -> Array:
    """Reduced chi-square over the whole window (n,); inf where there was no fit."""
    _, _, sums, converged = fit
    with np.errstate(invalid="ignore", divide="ignore"):
        value = sums[:, 0] / np.maximum(sums[:, 1] - N_CORNER, 1.0)
    return np.where(converged & np.isfinite(value), value, np.inf)


def _mend_with_smaller_windows(
    grey: Array, fit: _Fit, windows: Array, starts: Array, known: Array, noise: Array
) -> None:
    """Fit again, in place, nearer to the corner where something else reaches into the window: a dirty square."""
    for factor in (0.6, 0.35):
        chi_square = _chi_square(fit)
        bad = np.flatnonzero(chi_square > BAD_WINDOW * max(float(np.median(chi_square)), 1.0))
        if not len(bad):
            break
        smaller = windows[bad].copy()
        smaller[:, 10:12] *= factor
        again = fit_corners(grey, smaller, starts[bad], known[bad], noise, 30, 1e-5)
        better = _chi_square(again) < 0.5 * chi_square[bad]
        for old, new in zip(fit, again, strict=True):
            old[bad[better]] = new[better]


def _windows(points: Array, axes: Array, blur: float, shape: tuple[int, ...], plain: Array, most: float) -> Array:
    """Window of every corner as the kernel wants it (n, 14); plain (n,) with the sign of the light quadrants.

    most : [px] half width across an edge, at most
    """
    A = np.swapaxes(axes, 1, 2)  # columns are the images of i and j
    inverse = np.linalg.inv(A)
    area = np.abs(np.linalg.det(A))
    lengths = np.linalg.norm(axes, axis=-1)
    between = area[:, None] / lengths[:, ::-1]  # distance of neighbouring parallel edges, across them [px]
    half = np.clip(1.0 - (EDGE_MARGIN * blur + 0.7) / between, MIN_WINDOW, MAX_WINDOW)
    half = np.minimum(half, most / between)
    reach = np.abs(A * half[:, None, :]).sum(-1)
    low, high = np.ceil(points - reach), np.floor(points + reach)
    size = np.array([shape[1], shape[0]])
    low, high = np.clip(low, 0, size - 1), np.clip(high, -1, size - 1)
    step = 0.5 * between.min(axis=1)
    box = [low[:, 0], high[:, 0], low[:, 1], high[:, 1], points, inverse.reshape(-1, 4), half, step]
    near = (EDGE_MARGIN * blur + 0.7) / between.min(axis=1)  # the marker's edge, blurred, stays outside
    clear = np.where(np.abs(plain) < 1, np.maximum(np.abs(plain) - near, 0.5 * np.abs(plain)), 1.0)
    return np.column_stack([*box, clear * np.sign(plain)])


def _starts(grey: Array, points: Array, axes: Array, blur: float, aside: float) -> Array:
    """Start values (n, 9): levels from the four squares round the corner, so many squares aside of both edges."""
    levels = squares_round(grey, points, axes, aside)
    same, other = np.where(np.isnan(levels), levels[..., ::-1], levels).mean(-1).T
    starts = np.zeros((len(points), N_CORNER))
    starts[:, :2] = points
    starts[:, 2:4] = np.arctan2(axes[..., 1], axes[..., 0])
    starts[:, 4] = blur
    starts[:, 5] = 0.5 * (same + other)
    # sign(u) sign(v): where alpha and beta are both positive, u = across i has the sign of the area, v the opposite
    starts[:, 6] = -0.5 * (same - other)
    return starts


def _displacement(found: Array, seen: Mask, axes: Array, inner_corners: tuple[int, int]) -> Array:
    """(n,) Distance of every corner from where the others put it, in squares."""
    places, _ = smooth_grid(found, inner_corners, seen)
    return np.asarray(np.linalg.norm(found - places, axis=-1) / np.linalg.norm(axes, axis=-1).max(-1), np.float64)


def _measured_noise(sums: Array) -> Array:
    """Noise (a, b), variance = a + b grey, from the residuals inside dark and light squares.

    The median over the corners, so that a square with dirt or writing does not count as noise.
    """
    floor, levels = 1.0 / 12.0, []  # quantisation to whole grey values
    for r2, grey, n in ((2, 3, 4), (5, 6, 7)):
        use = sums[sums[:, n] >= 20]
        levels += [np.median(use[:, [r2, grey]] / use[:, n : n + 1], axis=0)] if len(use) else []
    if not levels:
        return np.array([1.0, 0.0])
    square, grey = np.transpose(levels)
    terms = np.stack([np.ones_like(grey), grey], axis=1)[:, : len(levels)]  # one level tells no slope
    beyond = np.append(scipy.optimize.nnls(terms, np.maximum(square - floor, 0.0))[0], 0.0)
    return np.array([floor + beyond[0], beyond[1]])


def _line_curvature(points: Array, ok: Mask, angles: Array, inner_corners: tuple[int, int]) -> Array:
    """Bend of the board's lines at every corner (n, 2) [1/px], half the second derivative across each edge.

    A parabola along each row and column of corners: lens distortion bends a line by far less than a corner's own
    window could tell.
    """
    columns, rows = inner_corners
    index = np.arange(columns * rows).reshape(rows, columns)
    curvature = np.zeros((len(points), 2))
    for axis, lines in ((0, index), (1, index.T)):
        for line in lines:
            use = line[ok[line]]
            if len(use) < 4:
                continue
            direction = points[use[-1]] - points[use[0]]
            direction = direction / np.linalg.norm(direction)
            d = points[use] - points[use].mean(0)
            bend = np.polyfit(d @ direction, d @ np.array([-direction[1], direction[0]]), 2)[0]
            # an edge angle may point either way along its line, the kernel's normal follows it
            edge = np.stack([np.cos(angles[line, axis]), np.sin(angles[line, axis])], axis=-1)
            curvature[line, axis] = bend * np.sign(edge @ direction)
    return curvature


def _contrast_gradient(points: Array, ok: Mask, levels: Array) -> Array:
    """Relative gradient (n, 2) [1/px] of the contrast, over the light's, at every corner, by a polynomial over all.

    levels : (n, 2) mean grey and half contrast. Of light that falls off their ratio is the same everywhere.
    """
    use = ok & (levels[:, 0] > 0) & (levels[:, 1] != 0)
    ratio = np.zeros(len(points))
    ratio[use] = np.log(np.abs(levels[use, 1] / levels[use, 0]))
    degree = degree_for(int(use.sum()), 4)
    if not degree:
        return np.zeros((len(points), 2))
    centre, scale = points[use].mean(0), np.ptp(points[use], axis=0).max() / 2
    x, y = ((points - centre) / scale).T
    powers = [(i, k - i) for k in range(degree + 1) for i in range(k + 1)]
    A = np.stack([x**i * y**j for i, j in powers], axis=1)
    for _ in range(3):  # dirt and shadows in single squares are no gradient
        c = np.linalg.lstsq(A[use], ratio[use], rcond=None)[0]
        left = np.abs(ratio - A @ c)
        use &= left <= 4.0 * 1.4826 * np.median(left[use]) + 1e-12
    along_x = np.stack([i * x ** max(i - 1, 0) * y**j for i, j in powers], axis=1) @ c
    along_y = np.stack([j * x**i * y ** max(j - 1, 0) for i, j in powers], axis=1) @ c
    return np.stack([along_x, along_y], axis=1) / scale


def _judged(
    grey: Array, fit: _Fit, axes: Array, rough: Array, counts: tuple[int, int], seen: Mask, plain: float
) -> CornerView:
    """Test every corner; where the fine model does not hold, the saddle point stands in with its own covariance."""
    found, by_noise, sums, ended = fit
    spacing = float(np.median(np.linalg.norm(axes, axis=-1)))
    edge_pixels = sums[:, 1] - sums[:, 4] - sums[:, 7]
    with np.errstate(invalid="ignore", divide="ignore"):
        chi_square = sums[:, 8] / np.maximum(edge_pixels, 1.0)
    converged = ended & np.isfinite(by_noise).all((1, 2)) & seen
    spread = float(np.median(chi_square[converged])) if converged.any() else 1.0
    chi_limit = MAX_CHI_SQUARE * max(spread, 1.0)  # compressed images have correlated noise: judge against the view
    displaced = _displacement(found[:, :2], converged, axes, counts)
    fine = converged & (displaced < MAX_DISPLACEMENT) & (chi_square < chi_limit)
    covariance = by_noise * np.maximum(chi_square, 1.0)[:, None, None]
    saddles = saddle_points(grey, np.where(fine[:, None], found[:, :2], rough), spacing * min(plain / WINDOW, 1.0))
    expected, sigma = smooth_grid(np.where(fine[:, None], found[:, :2], saddles), counts, seen)
    by_saddles, sigma_saddle = smooth_grid(saddles, counts, seen)
    if sigma_saddle < ROUGHER * sigma and fine.any():  # the saddle points lie smoother than the fine fits do
        fine = np.zeros_like(fine)
        expected, sigma = by_saddles, sigma_saddle
    # edges that fit badly on both sides alike leave the corner where it is: no more error than the grid's scatter shows
    stated = float(np.sqrt(np.median(np.trace(covariance[fine], axis1=1, axis2=2)) / 2)) if fine.any() else sigma
    covariance = np.maximum(min(sigma / stated, 1.0) ** 2, 1 / np.maximum(chi_square, 1.0))[:, None, None] * covariance
    sigma_saddle = max(sigma_saddle, LEAST_SIGMA)
    off = np.linalg.norm(saddles - expected, axis=-1)
    stands = ~fine & seen & (off < min(MAX_DISPLACEMENT * spacing, 4 * sigma_saddle))
    reasons = [
        f"{px:.1f} px from where the other corners put it (they scatter by {sigma_saddle:.2f} px)" if lost else ""
        for px, lost in zip(off, ~fine & ~stands & seen, strict=True)
    ]
    return CornerView(
        image_size=(grey.shape[1], grey.shape[0]),
        points=np.where(fine[:, None], found[:, :2], saddles),
        covariance=np.where(fine[:, None, None], covariance, sigma_saddle**2 * np.eye(2)),
        accepted=fine | stands,
        reasons=tuple(reasons),
    )


def saddle_points(grey: Array, points: Array, spacing: float) -> Array:
    """Saddle points (n, 2) [px] next to the given ones, by the directions of the grey values' gradients.

    A point outside the image stays where it is.
    """
    half = int(np.clip(round(WINDOW * spacing), 2, 15))
    image = grey.astype(np.float32)
    found = np.array(points, np.float32)
    inside = ((found >= 0) & (found < np.array(grey.shape[::-1], np.float32))).all(axis=1)
    if inside.any():
        start = np.ascontiguousarray(found[inside]).reshape(-1, 1, 2)
        found[inside] = cv2.cornerSubPix(image, start, (half, half), (-1, -1), (3, 60, 1e-4)).reshape(-1, 2)
    return found.astype(float)


def local_axes(points: Array, ok: Mask, inner_corners: tuple[int, int]) -> Array:
    """Image of one step along i and along j at every corner, (n, 2 axes, 2) [px], from the view's homography."""
    board, use = _indices(inner_corners), ok if ok.sum() >= LEAST_POINTS else np.ones(len(points), bool)
    H = np.asarray(cv2.findHomography(board[use], points[use])[0], float)
    image = np.column_stack([board, np.ones(len(board))]) @ H.T
    places, depth = image[:, :2] / image[:, 2:], image[:, 2:]
    return np.stack([(H[:2, axis] - places * H[2, axis]) / depth for axis in (0, 1)], axis=1)


def squares_round(grey: Array, points: Array, axes: Array, aside: float) -> Array:
    """(n, 2, 2) grey values of two opposite squares round points (n, 2), and of the two others; NaN out of view.

    aside : how far from both edges, in squares; axes (n, 2, 2) of a square
    """
    signs = np.array([[1.0, 1.0], [-1.0, -1.0], [1.0, -1.0], [-1.0, 1.0]])
    return grey_at(grey, points[:, None] + aside * signs @ axes).reshape(-1, 2, 2)


def grey_at(image: NDArray, places: Array) -> Array:
    """Grey values (...), means of an image's channels, of the pixels at places (..., 2); NaN out of view."""
    inside = np.all((places >= 0) & (places <= np.array(image.shape[1::-1]) - 1), axis=-1)
    x, y = np.moveaxis(np.rint(np.where(inside[..., None], places, 0.0)).astype(int), -1, 0)
    return np.where(inside, image[y, x].reshape(*x.shape, -1).mean(axis=-1), np.nan)


def _indices(inner_corners: tuple[int, int]) -> Array:
    columns, rows = inner_corners
    j, i = np.divmod(np.arange(columns * rows), columns)
    return np.stack([i, j], axis=-1).astype(float)


def degree_for(n: int, most: int) -> int:
    """Of a polynomial in two coordinates by n corners: three for each of its coefficients."""
    return max(d for d in range(most + 1) if 3 * (d + 1) * (d + 2) <= 2 * n or d == 0)


def smooth_grid(points: Array, inner_corners: tuple[int, int], seen: Mask) -> tuple[Array, float]:
    """Where the other corners put each corner (n, 2) [px], and the sigma per axis of the corners' scatter about it.

    A homography and, for the lens, a low polynomial of the two indices; few bad corners do not move them, and those
    not `seen` (n,) do not count, unless too few are.
    """
    columns, rows = inner_corners
    seen = seen if seen.sum() >= LEAST_POINTS else np.ones(len(points), bool)
    board = _indices(inner_corners)
    H = np.asarray(cv2.findHomography(board[seen], points[seen], cv2.LMEDS)[0], float)
    plane = np.asarray(cv2.perspectiveTransform(board[None], H)[0], float)
    degree = max(degree_for(int(seen.sum()), 3), 1)
    u, v = 2 * board[:, 0] / (columns - 1) - 1, 2 * board[:, 1] / (rows - 1) - 1
    A = np.stack([u**a * v**b for a in range(degree + 1) for b in range(degree + 1 - a)], axis=-1)
    target = points - plane
    weight = seen.astype(float)
    scale = np.inf
    for _ in range(10):
        root = np.sqrt(weight)[:, None]
        coefficients = np.linalg.lstsq(A * root, target * root, rcond=None)[0]
        distance = np.linalg.norm(target - A @ coefficients, axis=-1)
        scale = float(np.median(distance[seen])) / 1.1774 + 1e-9  # median of a Rayleigh distribution
        weight = np.clip(1 - (distance / (4.7 * scale)) ** 2, 1e-6, None) ** 2 * seen
    n = int(seen.sum())
    return plane + A @ coefficients, scale * float(np.sqrt(n / max(n - A.shape[1], 1)))
