"""Images that do not show the disc as declared: exchanged, mirrored, turned or on another scale, do they?

Tried only where the dots make no sense as declared: each way in which a camera's setup or an export program may have
arranged the images is undone, and the disc searched for anew. A unit mixed up in the declaration is seen, too: one
camera alone numbers the dots on any scale, and then both tell how far they are apart.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from calibration.arrays import Array
from calibration.camera import StereoRig, triangulate
from disctrack.disc import Disc, has_mirror_axis
from disctrack.frames import CAMERAS
from disctrack.track.acquisition import EPIPOLAR_PX, MIN_EXPLAINED, SIDE_TOLERANCE, acquire, dots_of_one_camera

Turn = Callable[[NDArray], NDArray]
MIRRORED: dict[str, Turn] = {
    "mirrored left to right": lambda image: image[:, ::-1],
    "mirrored top to bottom": lambda image: image[::-1],
    "turned by 180 deg": lambda image: image[::-1, ::-1],
}
DOT_DIAMETERS_PX = (6.0, 18.0, 54.0, 162.0)  # the search for blobs takes those of a seventh to twice the diameter
UNITS = {1e3: "mm and m", 1e2: "m and cm", 10.0: "cm and mm", 25.4: "inches and mm", 2.0: "radius and diameter"}


def arrangement_found(pair: NDArray, rig: StereoRig, disc: Disc) -> str:
    """What was done to the images or to their scale, in words, where undoing it shows the disc; "" where nothing does.

    pair : (2, height, width). All but one of the dots must be found in both cameras, and more than as declared.
    """
    enough = max(acquire(pair[0], pair[1], rig, disc).n_explained + 1, 2 * disc.n_markers - 2)
    found = [(acquire(left, right, rig, layout).n_explained, told) for told, left, right, layout in _ways(pair, disc)]
    dots, told = max(found)
    if dots >= enough:
        return told
    scale = _scale(pair, rig, disc)
    return "" if scale is None else _scale_in_words(scale)


def _scale(pair: NDArray, rig: StereoRig, disc: Disc) -> float | None:
    """Size of the disc over the declared one, in the unit that the rig was calibrated in; None where no dots tell."""
    for diameter in DOT_DIAMETERS_PX:
        dots = np.stack([dots_of_one_camera(pair[camera], camera, diameter, rig, disc) for camera in (0, 1)])
        both = np.isfinite(dots).all((0, 2))
        if both.sum() < MIN_EXPLAINED:
            continue
        points = triangulate(dots[:, both], rig)
        one, other = np.triu_indices(both.sum(), 1)
        ratios = _distances(points, one, other) / _distances(disc.marker_centres_body[both], one, other)
        scale = float(np.median(ratios))
        if np.abs(rig.project(points) - dots[:, both]).max() > EPIPOLAR_PX or not scale > 0:
            continue
        if np.abs(ratios / scale - 1).max() < SIDE_TOLERANCE < abs(np.log(scale)):
            return scale
    return None


def _distances(points: Array, one: NDArray[np.intp], other: NDArray[np.intp]) -> Array:
    return np.asarray(np.linalg.norm(points[one] - points[other], axis=-1))


def _scale_in_words(scale: float) -> str:
    units = [words for unit, words in UNITS.items() if abs(abs(np.log(scale)) / np.log(unit) - 1) < 0.02]
    mixed = f" (are {units[0]} mixed up?)" if units else ""
    disc, board = (f"{float(f'{factor:.3g}'):g} times" for factor in (scale, 1 / scale))
    return f"every length of [disc] and [markers] is {disc} the declared one, or [calibration] square_mm {board}{mixed}"


def _ways(pair: NDArray, disc: Disc) -> Iterator[tuple[str, NDArray, NDArray, Disc]]:
    """What may have been done, and the images with that undone."""
    left, right = pair
    yield "left and right are exchanged", right, left, disc
    for what, turn in MIRRORED.items():
        one, other = np.ascontiguousarray(turn(left)), np.ascontiguousarray(turn(right))
        since = "since the chessboard was seen"
        yield f"the images of both cameras are {what} {since}", one, other, disc
        yield f"the {CAMERAS[0]} camera's images are {what} {since}", one, right, disc
        yield f"the {CAMERAS[1]} camera's images are {what} {since}", left, other, disc
    if not has_mirror_axis(disc):
        seen_in_a_mirror = replace(disc, marker_centres_body=disc.marker_centres_body * [1.0, -1.0, 1.0])
        told = (
            "the dots are those of [markers] seen in a mirror: all images are mirrored, or y of centres_mm counts down"
        )
        yield told, left, right, seen_in_a_mirror
