"""Stereo calibration from a flat target of round dots on a lattice, three of them with a hole: origin, x and y axis.

The dots are found as blobs and numbered from the three marked ones, their centres located by the circle template, and
fed to the same refinement as the corners of a chessboard. Printed targets are off by tens of micrometres, so the
target's own points are normally freed (`board="free"`).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from calibration.arrays import Array
from calibration.errors import CalibrationError
from calibration.refinement import Refinement, refine_stereo
from calibration.start import start_stereo
from calibration.stereo_model import Observations, Terms
from disctrack.track.dots import Image, NoiseModel, locate_on_plane
from disctrack.trajectory import MarkerStatus

MAX_OFF_LATTICE = 0.2  # pitches: a blob further from the lattice is not one of its dots
MIN_SHARE = 0.5  # of all images: a dot seen in fewer does not determine its own place
ROUGH_SIGMA_PX = 0.1  # of a blob's centroid, for the start only


@dataclass(frozen=True)
class DotTarget:
    """Dots on a square lattice; the marked dots lie at (0, 0), (x_mark, 0) and (0, y_mark)."""

    pitch: float  # [m]
    diameter: float  # of a dot [m]
    x_mark: int  # pitches from the origin to the marked dot on the x axis
    y_mark: int  # the same on the y axis


@dataclass(frozen=True)
class DotView:
    """Numbered dots of one image."""

    lattice: NDArray[np.intp]  # (n, 2) whole pitches along x and y
    pixels: Array  # (n, 2)
    covariance: Array  # (n, 2, 2) [px^2]


def find_dots(image: Image, target: DotTarget) -> DotView:
    """Locate and number the dots of the target in one image. Raises CalibrationError that says what is missing."""
    blobs, marked = _blobs(image)
    if len(marked) != 3:
        raise CalibrationError(f"{len(marked)} dots with a hole found, expected the 3 that mark origin, x and y axis")
    lattice, rough = _numbered(blobs, marked, target)
    H, _ = cv2.findHomography(lattice.astype(float), rough)
    if H is None or len(lattice) < 12:
        raise CalibrationError(f"only {len(lattice)} dots lie on one lattice: is the target flat and wholly lit?")
    maps = _local_homographies(np.asarray(H, float), lattice.astype(float), rough)
    radius = 0.5 * target.diameter / target.pitch
    noise = _flat_noise(image, rough, 0.5 * radius * _scale(maps[0], lattice[0].astype(float)))
    found = locate_on_plane(image, maps, lattice.astype(float), radius, noise=noise)
    good = (found.status == MarkerStatus.MEASURED) & np.isfinite(found.pixels).all(-1)
    if not good.any():
        raise CalibrationError(
            f"{len(lattice)} dots lie on one lattice, but none looks like a printed circle of "
            f"{target.diameter * 1e3:g} mm at a pitch of {target.pitch * 1e3:g} mm: are diameter "
            "and pitch right, and the image sharp?"
        )
    return DotView(lattice[good], found.pixels[good], found.covariance_px2[good])


def calibrate_dots(
    left_images: Sequence[Image], right_images: Sequence[Image], target: DotTarget, terms: Terms | None = None
) -> Refinement:
    """Stereo calibration from image pairs of a dot target; the points' order is that of `lattice_points`.

    terms : default k1 k2 and a free target. Raises CalibrationError.
    """
    if len(left_images) != len(right_images):
        raise CalibrationError(f"{len(left_images)} left and {len(right_images)} right images: views are pairs")
    views = [[find_dots(image, target) for image in side] for side in (left_images, right_images)]
    return refine_dots(views, target, [images[0].shape[::-1] for images in (left_images, right_images)], terms)


def refine_dots(
    views: Sequence[Sequence[DotView]],
    target: DotTarget,
    image_sizes: Sequence[tuple[int, int]],
    terms: Terms | None = None,
) -> Refinement:
    """The refinement of dots that were found before; views (2 cameras)(n_views)."""
    lattice = lattice_points(views)
    number = {tuple(ij): k for k, ij in enumerate(lattice.tolist())}
    rows = []
    for camera, side in enumerate(views):
        for v, view in enumerate(side):
            index = np.array([number.get(tuple(ij), -1) for ij in view.lattice.tolist()])
            use = index >= 0
            n = int(use.sum())
            rows.append((np.full(n, v), np.full(n, camera), index[use], view.pixels[use], view.covariance[use]))
    view_index, camera_index, point, pixels, covariance = (np.concatenate(column) for column in zip(*rows, strict=True))
    observations = Observations(view_index, camera_index, point, pixels, covariance)
    nominal = np.column_stack([lattice * target.pitch, np.zeros(len(lattice))])
    sizes = (tuple(image_sizes[0]), tuple(image_sizes[1]))
    start, _ = start_stereo(observations, nominal, sizes, len(views[0]))  # type: ignore[arg-type]
    return refine_stereo(observations, start, nominal, terms or Terms("k1 k2", "free"))


def lattice_points(views: Sequence[Sequence[DotView]]) -> NDArray[np.intp]:
    """(n, 2) lattice numbers of the dots that enough images show, sorted."""
    every = np.concatenate([view.lattice for side in views for view in side])
    numbers, counts = np.unique(every, axis=0, return_counts=True)
    points: NDArray[np.intp] = numbers[counts >= MIN_SHARE * sum(len(side) for side in views)]
    return points


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
        x, y = (blobs[marked[b]] - origin) / target.x_mark, (blobs[marked[c]] - origin) / target.y_mark
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


def _local_homographies(H: Array, lattice: Array, rough: Array) -> Array:
    """(n, 3, 3): the common homography shifted so that each dot's rough centre is met (distortion moves it)."""
    at = np.column_stack([lattice, np.ones(len(lattice))]) @ H.T
    shift = rough - at[:, :2] / at[:, 2:]
    T = np.tile(np.eye(3), (len(lattice), 1, 1))
    T[:, :2, 2] = shift
    return T @ H


def _scale(H: Array, at: Array) -> float:
    """Pixels per lattice unit of a homography near a point."""
    ends = np.array([[*at, 1.0], [at[0] + 1, at[1], 1.0]]) @ H.T
    return float(np.linalg.norm(np.diff(ends[:, :2] / ends[:, 2:], axis=0)))


def _flat_noise(image: Image, centres: Array, half_px: float) -> NoiseModel:
    """Noise inside the dots and halfway to their neighbours, from differences of neighbouring pixels.

    Differences are free of the light's gradient. Ink that is clipped to black has no noise: the paper tells.
    """
    distance = np.linalg.norm(centres[:, None] - centres, axis=-1) + np.where(np.eye(len(centres)), np.inf, 0.0)
    between = 0.5 * (centres + centres[distance.argmin(axis=1)])
    gap = 0.25 * float(np.median(distance.min(axis=1))) - 0.5 * half_px
    ink, ink_level = _scatter(image, centres, max(int(0.5 * half_px), 3))
    paper, paper_level = _scatter(image, between, max(int(gap), 1))
    floor = max(ink, 1 / 12)
    return NoiseModel(floor, max(0.02, (paper - floor) / max(paper_level, ink_level, 1.0)))


def _scatter(image: Image, places: Array, half: int) -> tuple[float, float]:
    """Variance and level of the grey values in squares round the places: medians over the places."""
    parts = []
    for x, y in np.rint(places).astype(int):
        patch = image[max(y - half, 0) : y + half + 1, max(x - half, 0) : x + half + 1].astype(float)
        if patch.shape == (2 * half + 1, 2 * half + 1):
            parts.append((0.5 * np.mean(np.diff(patch, axis=1) ** 2), patch.mean()))
    variance, level = np.median(parts, axis=0) if parts else (1.0, 0.0)
    return float(variance), float(level)
