"""Images that do not show the disc as declared: exchanged, mirrored or turned, do they?

Tried only where the dots make no sense as declared: each way in which a camera's setup or an export program may have
arranged the images is undone, and the disc searched for anew.
"""

from collections.abc import Callable, Iterator
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from calibration.cameras.camera import StereoRig
from disctrack.disc import Disc, has_mirror_axis
from disctrack.findings import NONSENSE, Finding, Kind, Remedy, Severity
from disctrack.frames import CAMERAS
from disctrack.track.dots.acquisition import acquire

Turn = Callable[[NDArray], NDArray]
MIRRORED: dict[str, Turn] = {
    "mirrored left to right": lambda image: image[:, ::-1],
    "mirrored top to bottom": lambda image: image[::-1],
    "turned by 180 deg": lambda image: image[::-1, ::-1],
}


def arrangement_found(pair: NDArray, rig: StereoRig, disc: Disc) -> Iterator[Finding]:
    """What was done to the images, where undoing it shows the disc.

    pair : (2, height, width). All but one of the dots must be found in both cameras, and more than as declared.
    """
    enough = max(acquire(pair[0], pair[1], rig, disc).n_explained + 1, 2 * disc.n_markers - 2)
    ways = list(_ways(pair, disc))
    dots = [acquire(left, right, rig, layout).n_explained for _, left, right, layout in ways]
    best = dots.index(max(dots))
    if dots[best] >= enough:
        kind = Kind.MIRRORED if best else Kind.EXCHANGED
        remedy = Remedy("[cameras] left, right", action="store them as the views are" if best else "exchange the two")
        yield Finding(kind, Severity.DOUBT, ways[best][0], remedies=(remedy,), explains=NONSENSE)


def _ways(pair: NDArray, disc: Disc) -> Iterator[tuple[str, NDArray, NDArray, Disc]]:
    """What may have been done, and the images with that undone."""
    left, right = pair
    yield "the left and right images are exchanged", right, left, disc
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
