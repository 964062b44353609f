"""Dots that are there, and unlike the declared ones: on another scale, of another size, in other places.

One camera alone numbers the dots, on any scale and of any size. What both see of a dot tells where it is in the unit of
the rig, to some 0.2 mm: enough to say which declared number is wrong, and what it should be.
"""

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from calibration.cameras.camera import StereoRig, triangulate
from calibration.kit.arrays import Array, Mask
from disctrack.disc import Disc
from disctrack.findings import NONSENSE, Finding, Kind, Number, Remedy, Severity
from disctrack.track.dots.acquisition import (
    EPIPOLAR_PX,
    MIN_EXPLAINED,
    SIDE_TOLERANCE,
    rigid_motions,
    seen_by_one_camera,
)
from disctrack.track.judge.doubts import misplaced_dots
from disctrack.track.refine.self_calibration import declared_places_kept

DOT_DIAMETERS_PX = (6.0, 18.0, 54.0, 162.0)  # the search for blobs takes those of a seventh to twice the diameter
UNITS = {1e3: "mm and m", 1e2: "m and cm", 10.0: "cm and mm", 25.4: "inches and mm", 2.0: "radius and diameter"}
SIZE_TOLERANCE = 0.15  # blur and threshold make a blob larger or smaller than its dot
MISPLACED = 0.2  # of the distance between two dots: places measured with a ruler, not dots numbered wrongly
MEETING_PX = 1.0  # beyond, cameras or clocks do not fit together, and places seen by both are none
RIM = 64  # points of a dot's outline


@dataclass(frozen=True)
class SeenDots:
    """Dots that both cameras number alike."""

    which: Mask  # (m,) of the declared dots; k of them
    points: Array  # (k, 3) [m] in the rig's world and unit
    areas: Array  # (2, k) [px^2] of their blobs
    scale: float  # their distances over those declared
    misfit_px: float  # largest, of the blobs against one point in space


def unlike_declared(pair: NDArray, rig: StereoRig, disc: Disc) -> tuple[Finding, ...]:
    """Which declared number makes no sense, and what it should be, where that is seen.

    pair : (2, height, width), images of the left and the right camera
    """
    several = list(_seen_dots(pair, rig, disc))
    if not several:
        return ()
    seen = max(several, key=lambda found: found.which.sum())
    if abs(np.log(seen.scale)) > SIDE_TOLERANCE:
        return (_on_another_scale(seen.scale),)
    (R,), (t,) = rigid_motions(disc.marker_centres_body[None, seen.which], seen.points[None])
    # by the middle one of the searches: one for blobs far smaller than the dots finds what is darkest in them
    sizes = [np.median(np.sqrt(found.areas / _areas(found, R, rig, disc))) for found in several]
    diameter = disc.marker_diameter * float(np.median(sizes))
    if abs(np.log(diameter / disc.marker_diameter)) > SIZE_TOLERANCE:
        remedy = Remedy("[markers] diameter_mm", f"{1e3 * diameter:.2g}", f"{1e3 * disc.marker_diameter:g}")
        text = "the dots' images are of another size"
        return (Finding(Kind.DIAMETER, Severity.DOUBT, text, remedies=(remedy,), explains=NONSENSE),)
    if not seen.which.all() or seen.misfit_px > MEETING_PX:
        return ()
    shift = (seen.points - t) @ R - disc.marker_centres_body
    return misplaced_dots(disc, disc.marker_centres_body + declared_places_kept(disc, shift[:, :2]))


def _seen_dots(pair: NDArray, rig: StereoRig, disc: Disc) -> Iterator[SeenDots]:
    """By the searches for blobs of several sizes, as far as they find dots."""
    for diameter in DOT_DIAMETERS_PX:
        blobs = np.stack([seen_by_one_camera(pair[camera], camera, diameter, rig, disc)[0] for camera in (0, 1)])
        which: Mask = np.asarray(np.isfinite(blobs).all((0, 2)))
        if which.sum() < MIN_EXPLAINED:
            continue
        pixels = blobs[:, which, :2]
        points = triangulate(pixels, rig)
        one, other = np.triu_indices(which.sum(), 1)
        ratios = _distances(points, one, other) / _distances(disc.marker_centres_body[which], one, other)
        scale = float(np.median(ratios))
        misfit = float(np.abs(rig.project(points) - pixels).max())
        if misfit < EPIPOLAR_PX and scale > 0 and np.abs(ratios / scale - 1).max() < MISPLACED:
            yield SeenDots(which, points, blobs[:, which, 2], scale, misfit)


def _distances(points: Array, one: NDArray[np.intp], other: NDArray[np.intp]) -> Array:
    return np.asarray(np.linalg.norm(points[one] - points[other], axis=-1))


def _areas(seen: SeenDots, R: Array, rig: StereoRig, disc: Disc) -> Array:
    """(2, k) [px^2] of the images of dots of the declared diameter."""
    angle = np.linspace(0, 2 * np.pi, RIM, endpoint=False)
    rim = 0.5 * disc.marker_diameter * np.stack([np.cos(angle), np.sin(angle), 0 * angle], axis=-1) @ R.T
    x, y = np.moveaxis(rig.project(seen.points[:, None] + rim).swapaxes(0, 1), -1, 0)
    return np.asarray(0.5 * np.abs(np.sum(x * np.roll(y, -1, axis=-1) - y * np.roll(x, -1, axis=-1), axis=-1)))


def _on_another_scale(scale: float) -> Finding:
    mixed = ""
    for unit, words in UNITS.items():
        if abs(abs(np.log(scale)) / np.log(unit) - 1) < 0.02:
            scale, mixed = unit ** np.sign(np.log(scale)), f": are {words} mixed up?"
            break
    disc, board = (f"times {float(f'{factor:.3g}'):g}" for factor in (scale, 1 / scale))
    keys = "[calibration] square_mm", "every length of [disc] and [markers]"
    remedies = Remedy(keys[0], action=board), Remedy(keys[1], action=disc)
    text = f"the dots are {scale:.3g} times as far apart as declared{mixed}"
    found = {"scale": Number(scale)}
    return Finding(Kind.LENGTHS, Severity.DOUBT, text, numbers=found, remedies=remedies, explains=NONSENSE)
