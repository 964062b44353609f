"""What stands in where the image of a corner is not that of two crossing edges: OpenCV's saddle point, and its scatter.

Compression, sharpening, half-tone print and dirt leave a corner where it was, but not its edges. How far such a corner
may be trusted is read from the view itself: the image of a flat grid is a smooth function of its two indices, and what
the corners scatter about it is their error.
"""

import cv2
import numpy as np

from calibration.board.target import LEAST_POINTS
from calibration.kit.arrays import Array, Mask

WINDOW = 0.35  # of a square: half width of the window of the saddle point
MANY_PIXELS = 4e6


def saddle_points(grey: Array, points: Array, spacing: float) -> Array:
    """Saddle points (n, 2) [px] next to the given ones, by the directions of the grey values' gradients.

    A point outside the image stays where it is.
    """
    half = int(np.clip(round(WINDOW * spacing), 2, 15))
    every = 1 + int(np.sqrt(grey.size / MANY_PIXELS))  # of large images some rows and columns tell the range
    low, high = np.percentile(grey[::every, ::every], [0.5, 99.5])
    image = np.clip((grey - low) * (255.0 / max(high - low, 1e-12)), 0, 255).astype(np.float32)
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
    H, _ = cv2.findHomography(board[seen], points[seen], cv2.LMEDS)
    if H is None:
        H, _ = cv2.findHomography(board[seen], points[seen])
    image = np.column_stack([board, np.ones(len(board))]) @ np.asarray(H, float).T
    plane = image[:, :2] / image[:, 2:]
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
