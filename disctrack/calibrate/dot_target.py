"""A flat target of round dots on a lattice, three of them with a hole, as programs for image correlation use.

The dots are found as blobs and numbered from the three marked ones. Which places of the lattice carry a dot need not be
known: those that enough views show make the target.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import cv2
import numpy as np
from numpy.typing import NDArray

from calibration.board.chessboard import BoardNotFound, grey_values
from calibration.board.corner_fit import CornerView
from calibration.board.target import DotTarget
from calibration.kit.arrays import Array, Image
from disctrack.calibrate.circles import Circles, locate_circles, whole_grey_values

MAX_OFF_LATTICE = 0.2  # pitches: a blob further from the lattice is not one of its dots
MIN_SHARE = 0.5  # of all images: a dot seen in fewer does not determine its own place
LEAST_DOTS = 12  # of one image


@dataclass(frozen=True)
class DotView:
    """Numbered dots of one image."""

    image_size: tuple[int, int]  # width, height [px]
    lattice: NDArray[np.intp]  # (n, 2) whole steps along x and y
    circles: Circles
    notes: tuple[str, ...]


def find_dots(image: NDArray, target: DotTarget) -> DotView | BoardNotFound:
    """Locate and number the dots of the target in one image; without it, what is missing."""
    grey, notes = grey_values(image)
    pixels = whole_grey_values(grey)
    blobs, marked = _blobs(pixels)
    if len(marked) != 3:
        return BoardNotFound(f"{len(marked)} dots with a hole found, expected the 3 that mark origin, x and y axis")
    lattice, rough = _numbered(blobs, marked, target)
    if len(lattice) < LEAST_DOTS:
        return BoardNotFound(f"only {len(lattice)} dots lie on one lattice: is the target flat and wholly lit?")
    circles = locate_circles(pixels, lattice.astype(float), rough)
    if not circles.good.any():
        return BoardNotFound(
            f"{len(lattice)} dots lie on one lattice, but none looks like a printed circle under perspective: is the "
            f"image sharp, and are {target.marked[0]} and {target.marked[1]} the steps between the marked dots?"
        )
    return DotView((pixels.shape[1], pixels.shape[0]), lattice, circles, notes)


def on_common_lattice(
    views: Sequence[DotView | BoardNotFound], target: DotTarget
) -> tuple[DotTarget, list[CornerView | BoardNotFound]]:
    """The target with the dots that enough of the images show, and the images' dots in its order."""
    found = [view for view in views if isinstance(view, DotView)]
    if not found:
        return target, [view for view in views if isinstance(view, BoardNotFound)]
    numbers, counts = np.unique(np.concatenate([v.lattice[v.circles.good] for v in found]), axis=0, return_counts=True)
    places = [(int(i), int(j)) for i, j in numbers[counts >= MIN_SHARE * len(found)]]
    place = {ij: k for k, ij in enumerate(places)}
    return replace(target, lattice=tuple(places)), [
        view if isinstance(view, BoardNotFound) else _in_order(view, place) for view in views
    ]


def _in_order(view: DotView, place: dict[tuple[int, int], int]) -> CornerView:
    n, circles = len(place), view.circles
    index = np.array([place.get((i, j), -1) for i, j in view.lattice.tolist()])
    use = circles.good & (index >= 0)
    to = index[use]
    columns = {name: np.full(n, np.nan) for name in ("chi_square", "contrast", "blur")}
    centres = circles.centres
    points, covariance = np.full((n, 2), np.nan), np.full((n, 2, 2), np.nan)
    points[to], covariance[to] = centres.pixels[use], centres.covariance_px2[use]
    columns["chi_square"][to], columns["blur"][to] = centres.misfit[use], centres.blur_px[use]
    columns["contrast"][to] = (centres.contrast * centres.level)[use]
    accepted = np.zeros(n, bool)
    accepted[to] = True
    return CornerView(
        image_size=view.image_size,
        points=points,
        covariance=covariance,
        accepted=accepted,
        reasons=("",) * n,
        spacing=circles.spacing,
        noise=(circles.noise.read, circles.noise.gain),
        notes=view.notes,
        **columns,
    )


def _blobs(image: Image) -> tuple[Array, NDArray[np.intp]]:
    """Centroids (k, 2) of dark round blobs off the border, and which of them have a light hole."""
    grey = cv2.GaussianBlur(np.asarray(image, np.float32), (0, 0), 2.0)
    block = 2 * (max(grey.shape) // 16) + 1
    mean = cv2.blur(grey, (block, block), borderType=cv2.BORDER_REPLICATE)
    mask = (grey < 0.75 * mean).astype(np.uint8)
    contours, hierarchy = cv2.findContours(mask, cv2.RETR_CCOMP, cv2.CHAIN_APPROX_NONE)
    found: list[tuple[float, float]] = []
    holed: list[int] = []
    areas = np.array([cv2.contourArea(c) for c in contours])
    outer = [i for i in range(len(contours)) if hierarchy[0][i][3] < 0 and areas[i] > 100]
    typical = float(np.median(areas[outer])) if outer else 0.0
    for i in outer:
        x, y, w, h = cv2.boundingRect(contours[i])
        inside = x > 2 and y > 2 and x + w < grey.shape[1] - 2 and y + h < grey.shape[0] - 2
        if not inside or not 0.5 * typical < areas[i] < 2 * typical or areas[i] < 0.65 * w * h:
            continue
        moments = cv2.moments(contours[i])
        child = hierarchy[0][i][2]
        if child >= 0 and areas[child] > 0.01 * areas[i]:
            holed.append(len(found))
        found.append((moments["m10"] / moments["m00"], moments["m01"] / moments["m00"]))
    return np.array(found, float).reshape(-1, 2), np.array(holed, dtype=np.intp)


def _numbered(blobs: Array, marked: NDArray[np.intp], target: DotTarget) -> tuple[NDArray[np.intp], Array]:
    """Lattice numbers (n, 2) and centroids (n, 2) of the blobs on the lattice that the marked dots span."""
    best: tuple[NDArray[np.intp], Array] = (np.zeros((0, 2), np.intp), np.zeros((0, 2)))
    for a, b, c in ((0, 1, 2), (1, 2, 0), (2, 0, 1), (0, 2, 1), (1, 0, 2), (2, 1, 0)):
        origin = blobs[marked[a]]
        x, y = (blobs[marked[b]] - origin) / target.marked[0], (blobs[marked[c]] - origin) / target.marked[1]
        if x[0] * y[1] - x[1] * y[0] > 0:  # seen from the printed side y turns left from x, image rows grow downwards
            continue
        M = np.column_stack([x, y])
        if abs(np.linalg.det(M)) < 1:
            continue
        numbers = np.linalg.solve(M, (blobs - origin).T).T
        on = np.abs(numbers - np.rint(numbers)).max(-1) < MAX_OFF_LATTICE
        for _ in range(3):  # perspective bends the affine lattice: follow it outwards
            if on.sum() < 6:
                break
            H, _ = cv2.findHomography(np.rint(numbers[on]), blobs[on])
            if H is None:
                break
            back = np.column_stack([blobs, np.ones(len(blobs))]) @ np.linalg.inv(H).T
            numbers = back[:, :2] / back[:, 2:]
            on = np.abs(numbers - np.rint(numbers)).max(-1) < MAX_OFF_LATTICE
        lattice = np.rint(numbers[on]).astype(np.intp)
        if len(lattice) > len(best[0]) and len(np.unique(lattice, axis=0)) == len(lattice):
            best = (lattice, blobs[on])
    return best
