"""Fit and test of the corners of one view; each is fitted to the grey values around its two edges (`_corner_kernel`).

Windows extend almost to the neighbouring edges, for any size and slant of the squares. The image noise is measured
inside the squares, which gives every corner a variance and a chi-square.

If the image of a corner is not that of two crossing edges, OpenCV's saddle point replaces the fit. Compression,
sharpening, half-tone print and dirt change the edges, but not the position of the corner. The uncertainty of such
corners is estimated from the view: the image of a flat grid is a smooth function of its two indices, and the scatter of
the corners about it is their error.
"""

from dataclasses import dataclass, replace

import cv2
import numpy as np
import scipy

from calibration.board._corner_kernel import N_CORNER, fit_corners
from calibration.board.target import LEAST_POINTS, grid_of
from calibration.kit.types import AnyArray, Array, Indices, Mask

LEAST_SIGMA = 0.05  # px, least standard deviation of a corner that no model fits
MAX_WINDOW = 0.85  # of a square: excludes the blurred neighbouring edge
MIN_WINDOW = 0.3
FIRST_REACH = 85.0  # px, largest window of the first fit: sufficient for blur, noise and positions
EDGE_MARGIN = 3.0  # sigmas of the blur between the window and the next edge
MAX_CHI_SQUARE = 25.0  # reduced, of the edge pixels; above, the image is not that of two crossing edges
BAD_WINDOW = 3.0  # reduced chi-square of a window over the view's median, above which a smaller window is tried
ROUGHER = 0.7  # scatter of saddle points about a smooth grid over that of the fits, below which fits are rejected
MAX_DISPLACEMENT = 0.2  # of a square, from the position predicted by neighbours; above, another feature was fitted
WINDOW = 0.35  # of a square: half width of the window of the saddle point


def prepare() -> None:
    """Compile the fit of corners, some seconds once per installation, or load it."""
    fit_corners(np.zeros((8, 8)), np.zeros((0, 14)), np.zeros((0, N_CORNER)), np.zeros((0, 4)), np.zeros(2), 1, 1e-2)


@dataclass(frozen=True)
class CornerView:
    """Inner corners of one view, in the order of `Board.points`."""

    image_size: tuple[int, int]  # width, height [px]
    points: Array  # (n, 2) [px]
    covariance: Array  # (n, 2, 2) [px^2] from the image noise, enlarged if the edges fit badly
    accepted: Mask  # (n,)
    reasons: tuple[str, ...]  # (n,) why a corner was rejected; "" if it is accepted or out of view
    notes: tuple[str, ...] = ()

    def reordered(self, order: Indices) -> "CornerView":
        """The same view with corner order[i] at index i, for boards whose colouring allows several orders."""
        arrays = {name: getattr(self, name)[order] for name in ("points", "covariance", "accepted")}
        return replace(self, reasons=tuple(self.reasons[i] for i in order), **arrays)


def fit_view(grey: Array, rough: Array, inner_corners: tuple[int, int], seen: Mask, plain: float = 1.0) -> CornerView:
    """Fit every corner twice: first to estimate blur, noise, curvature and contrast gradients, then with these.

    rough : (n, 2) [px] of all corners; those that are not `seen` (n,) are interpolated from the others
    plain : width in squares of the light squares' plain margin, between an edge and a marker
    """
    noise, blur, known = np.array([1.0, 0.0]), 1.0, np.zeros((len(rough), 4))
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
    _mend_by_smaller_windows(grey, fit, windows, starts, known, noise)
    return _judged(grey, fit, axes, rough, inner_corners, seen, plain)


_Fit = tuple[Array, Array, Array, Mask]  # what the kernel returns for the corners of a view


def _chi_square(fit: _Fit) -> Array:
    """Reduced chi-square over the whole window (n,); inf without a fit."""
    _, _, sums, converged = fit
    value = sums[:, 0] / np.maximum(sums[:, 1] - N_CORNER, 1.0)
    return np.where(converged & np.isfinite(value), value, np.inf)


def _mend_by_smaller_windows(grey: Array, fit: _Fit, windows: Array, starts: Array, known: Array, noise: Array) -> None:
    """Repeat fits, in place, with smaller windows if something else lies in the window, such as a dirty square."""
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
    """Window (n, 14) of every corner for the kernel; plain (n,) with the sign of the light quadrants.

    most : [px] largest half width across an edge
    """
    A = np.swapaxes(axes, 1, 2)  # columns are the images of i and j
    area, lengths = np.abs(np.linalg.det(A)), np.linalg.norm(axes, axis=-1)
    between = area[:, None] / lengths[:, ::-1]  # distance of neighbouring parallel edges, across them [px]
    blurred = (EDGE_MARGIN * blur + 0.7) / between
    half = np.minimum(np.clip(1.0 - blurred, MIN_WINDOW, MAX_WINDOW), most / between)
    reach, last = np.abs(A * half[:, None, :]).sum(-1), np.array(shape[::-1]) - 1
    low, high = np.clip(np.ceil(points - reach), 0, last), np.clip(np.floor(points + reach), -1, last)
    sides = np.stack([low, high], axis=-1).reshape(-1, 4)
    # excludes the blurred edge of the marker
    clear = np.where(np.abs(plain) < 1, np.maximum(np.abs(plain) - blurred.max(1), 0.5 * np.abs(plain)), 1.0)
    largest_step = 0.5 * between.min(axis=1)
    inverse = np.linalg.inv(A).reshape(-1, 4)
    return np.column_stack([sides, points, inverse, half, largest_step, clear * np.sign(plain)])


def _starts(grey: Array, points: Array, axes: Array, blur: float, aside: float) -> Array:
    """Initial guesses (n, 9); grey levels from the four squares at the corner, `aside` squares from both edges."""
    levels = squares_round(grey, points, axes, aside)
    same, other = np.where(np.isnan(levels), levels[..., ::-1], levels).mean(-1).T
    angles, zero = np.arctan2(axes[..., 1], axes[..., 0]), np.zeros_like(same)
    # sign(u) sign(v): where alpha and beta are both positive, u = across i has the sign of the area, v the opposite
    mean, half_contrast = 0.5 * (same + other), -0.5 * (same - other)
    return np.column_stack([points, angles, zero + blur, mean, half_contrast, zero, zero])


def _displacement(found: Array, seen: Mask, axes: Array, inner_corners: tuple[int, int]) -> Array:
    """(n,) Distance of every corner from the position predicted by the others, in squares."""
    places, _ = smooth_grid(found, inner_corners, seen)
    return np.asarray(np.linalg.norm(found - places, axis=-1) / np.linalg.norm(axes, axis=-1).max(-1), np.float64)


def _measured_noise(sums: Array) -> Array:
    """Noise (a, b), variance = a + b grey, from the residuals inside dark and light squares.

    Medians over the corners: squares with dirt or writing have no effect.
    """
    floor, levels = 1.0 / 12.0, []  # quantisation to whole grey values
    for r2, grey, n in ((2, 3, 4), (5, 6, 7)):
        use = sums[sums[:, n] >= 20]
        levels += [np.median(use[:, [r2, grey]] / use[:, n : n + 1], axis=0)] if len(use) else []
    if not levels:
        return np.array([1.0, 0.0])
    square, grey = np.transpose(levels)
    terms = np.stack([np.ones_like(grey), grey], axis=1)[:, : len(levels)]  # a slope needs two levels
    beyond = np.append(scipy.optimize.nnls(terms, np.maximum(square - floor, 0.0))[0], 0.0)
    return np.array([floor + beyond[0], beyond[1]])


def _line_curvature(points: Array, ok: Mask, angles: Array, inner_corners: tuple[int, int]) -> Array:
    """Curvature of the board's lines at every corner (n, 2) [1/px]: half the second derivative across each edge.

    From parabolas through rows and columns of corners: the window of one corner does not determine it.
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
            # the direction of an edge angle along its line is arbitrary, and determines the kernel's normal
            edge = np.stack([np.cos(angles[line, axis]), np.sin(angles[line, axis])], axis=-1)
            curvature[line, axis] = bend * np.sign(edge @ direction)
    return curvature


def _contrast_gradient(points: Array, ok: Mask, levels: Array) -> Array:
    """Relative gradient (n, 2) [1/px] of contrast over illumination at every corner, from a polynomial over all.

    levels : (n, 2) mean grey and half contrast; their ratio is constant if only the illumination varies
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
    for _ in range(3):  # rejects dirt and shadows in single squares
        c = np.linalg.lstsq(A[use], ratio[use], rcond=None)[0]
        left = np.abs(ratio - A @ c)
        use &= left <= 4.0 * 1.4826 * np.median(left[use]) + 1e-12
    along_x = np.stack([i * x ** max(i - 1, 0) * y**j for i, j in powers], axis=1) @ c
    along_y = np.stack([j * x**i * y ** max(j - 1, 0) for i, j in powers], axis=1) @ c
    return np.stack([along_x, along_y], axis=1) / scale


def _judged(
    grey: Array, fit: _Fit, axes: Array, rough: Array, counts: tuple[int, int], seen: Mask, plain: float
) -> CornerView:
    """Test every corner; if the edge model fails, the saddle point replaces it, with its own covariance."""
    found, by_noise, sums, ended = fit
    spacing = float(np.median(np.linalg.norm(axes, axis=-1)))
    edge_pixels = sums[:, 1] - sums[:, 4] - sums[:, 7]
    chi_square = sums[:, 8] / np.maximum(edge_pixels, 1.0)
    converged = ended & np.isfinite(by_noise).all((1, 2)) & seen
    spread = float(np.median(chi_square[converged])) if converged.any() else 1.0
    chi_limit = MAX_CHI_SQUARE * max(spread, 1.0)  # compressed images have correlated noise: relative to the view
    displaced = _displacement(found[:, :2], converged, axes, counts)
    fine = converged & (displaced < MAX_DISPLACEMENT) & (chi_square < chi_limit)
    covariance = by_noise * np.maximum(chi_square, 1.0)[:, None, None]
    saddles = saddle_points(grey, np.where(fine[:, None], found[:, :2], rough), spacing * min(plain / WINDOW, 1.0))
    expected, sigma = smooth_grid(np.where(fine[:, None], found[:, :2], saddles), counts, seen)
    by_saddles, sigma_saddle = smooth_grid(saddles, counts, seen)
    if sigma_saddle < ROUGHER * sigma and fine.any():  # the saddle points scatter less than the fits
        fine = np.zeros_like(fine)
        expected, sigma = by_saddles, sigma_saddle
    # a misfit that is equal on both sides of an edge does not move the corner: the error is the scatter about the grid
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
    """Saddle points (n, 2) [px] next to the given ones, from the directions of the grey values' gradients.

    Points outside the image are unchanged.
    """
    half = int(np.clip(round(WINDOW * spacing), 2, 15))
    image = grey.astype(np.float32)
    found = np.array(points, np.float32)
    inside = ((found >= 0) & (found < np.array(grey.shape[::-1], np.float32))).all(axis=1)
    if inside.any():
        found[inside] = cv2.cornerSubPix(image, found[inside], (half, half), (-1, -1), (3, 60, 1e-4))
    return found.astype(float)


def local_axes(points: Array, ok: Mask, inner_corners: tuple[int, int]) -> Array:
    """Image of one step along i and along j at every corner, (n, 2 axes, 2) [px], from the view's homography."""
    board, use = grid_of(inner_corners)[:, :2], ok if ok.sum() >= LEAST_POINTS else np.ones(len(points), bool)
    H = np.asarray(cv2.findHomography(board[use], points[use])[0], float)
    image = np.column_stack([board, np.ones(len(board))]) @ H.T
    places, depth = image[:, :2] / image[:, 2:], image[:, 2:]
    return np.stack([(H[:2, axis] - places * H[2, axis]) / depth for axis in (0, 1)], axis=1)


def squares_round(grey: Array, points: Array, axes: Array, aside: float) -> Array:
    """(n, 2, 2) grey values of two opposite squares at points (n, 2), and of the two others; NaN out of view.

    aside : distance from both edges in squares; axes : (n, 2, 2) of a square
    """
    signs = np.array([[1.0, 1.0], [-1.0, -1.0], [1.0, -1.0], [-1.0, 1.0]])
    return grey_at(grey, points[:, None] + aside * signs @ axes).reshape(-1, 2, 2)


def grey_at(image: AnyArray, places: Array) -> Array:
    """Grey values (...), averaged over the channels, of the pixels at places (..., 2); NaN out of view."""
    inside = np.all((places >= 0) & (places <= np.array(image.shape[1::-1]) - 1), axis=-1)
    x, y = np.moveaxis(np.rint(np.where(inside[..., None], places, 0.0)).astype(int), -1, 0)
    return np.where(inside, image[y, x].reshape(*x.shape, -1).mean(axis=-1), np.nan)


def degree_for(n: int, most: int) -> int:
    """Degree of a polynomial in two coordinates that n corners determine, with three corners per coefficient."""
    return max(d for d in range(most + 1) if 3 * (d + 1) * (d + 2) <= 2 * n or d == 0)


def smooth_grid(points: Array, inner_corners: tuple[int, int], seen: Mask) -> tuple[Array, float]:
    """Smooth grid through the corners (n, 2) [px], and the sigma per axis of the corners' scatter about it.

    Robust fit of a homography and, for the lens, a low polynomial of the two indices; corners that are not `seen` (n,)
    are used only if the others are too few.
    """
    columns, rows = inner_corners
    seen = seen if seen.sum() >= LEAST_POINTS else np.ones(len(points), bool)
    board = grid_of(inner_corners)[:, :2]
    H = np.asarray(cv2.findHomography(board[seen], points[seen], cv2.LMEDS)[0], float)
    plane = np.asarray(cv2.perspectiveTransform(board[None], H)[0], float)
    degree = max(degree_for(int(seen.sum()), 3), 1)
    u, v = 2 * board[:, 0] / (columns - 1) - 1, 2 * board[:, 1] / (rows - 1) - 1
    A = np.stack([u**a * v**b for a in range(degree + 1) for b in range(degree + 1 - a)], axis=-1)
    target = points - plane
    weight = seen.astype(float)
    for _ in range(10):
        root = np.sqrt(weight)[:, None]
        coefficients = np.linalg.lstsq(A * root, target * root, rcond=None)[0]
        distance = np.linalg.norm(target - A @ coefficients, axis=-1)
        scale = float(np.median(distance[seen])) / 1.1774 + 1e-9  # median of a Rayleigh distribution
        weight = np.clip(1 - (distance / (4.7 * scale)) ** 2, 1e-6, None) ** 2 * seen
    n = int(seen.sum())
    return plane + A @ coefficients, scale * float(np.sqrt(n / max(n - A.shape[1], 1)))
