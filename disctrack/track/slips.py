"""Stretches of frames in which the cameras contradict each other, and whether one of them left out images.

A camera that leaves out an image is ahead of the other from there on: its dots lie where they will be one frame later.
To first order they are displaced by their velocity in the image times the delay; what of that a change of the pose
makes up for is no sign of it.
"""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np
from numpy.typing import NDArray

from calibration.arrays import Array, Mask
from calibration.brief import ranges
from calibration.camera import StereoRig
from disctrack.frames import CAMERAS
from disctrack.track.pose import PoseFits, marker_pixels, whitening

SHORTEST = 4  # frames: a gleam or a hand is told by the frames' own status
LEFT_OUT = "it left out"
REFUSED = "are refused: the dots of the two cameras contradict each other"
EXPLAINED = 0.9  # of the square of the misfit


def slips_in_words(
    refused: Mask,
    fits: PoseFits,
    markers_px: Array,
    covariance_px2: Array,
    rig: StereoRig,
    centres: Array,
    pairs: range,
) -> tuple[str, ...]:
    """Sentences on long stretches of frames refused (n,) for their dots; the other arguments as in `fit_poses`."""
    said: list[str] = []
    unexplained: list[int] = []
    edges = np.flatnonzero(np.diff(np.r_[False, refused, False].astype(int))).reshape(-1, 2)
    for first, end in edges[edges[:, 1] - edges[:, 0] >= SHORTEST]:
        delay, explained = delay_of_right(fits, markers_px, covariance_px2, rig, centres, np.arange(first, end))
        ahead = round(abs(delay)) if explained > EXPLAINED else 0
        if not ahead:
            unexplained += pairs[first:end]
            continue
        camera, other = CAMERAS[::-1] if delay > 0 else CAMERAS
        said.append(
            f"frames {pairs[first]}-{pairs[end - 1]} {REFUSED}, as if the {camera} camera were {abs(delay):.2f} frames "
            f"ahead of the {other}: {LEFT_OUT} {ahead} image(s) at frame {pairs[first]}. "
            f"Number its images from there on higher by {ahead}"
        )
    if unexplained:
        said.append(f"frames {ranges(unexplained)} {REFUSED}")
    return tuple(said)


def delay_of_right(
    fits: PoseFits, markers_px: Array, covariance_px2: Array, rig: StereoRig, centres: Array, rows: NDArray[np.intp]
) -> tuple[float, float]:
    """Frame periods by which the right camera is ahead of the left in these frames, and the share of misfit explained.

    (0, 0) where no frame has both its neighbours.
    """
    top = between = bottom = 0.0
    for i in _with_neighbours(fits, rows):
        residual = fits.residuals_px[i]
        velocity = np.zeros_like(residual)
        velocity[1] = 0.5 * (markers_px[i + 1, 1] - markers_px[i - 1, 1])
        seen = np.isfinite(residual).all(-1) & np.isfinite(velocity).all(-1)
        if seen.sum() < 4:
            continue
        _, J = marker_pixels(fits.R_world_body[i : i + 1], fits.t_world_body[i : i + 1], rig, centres)
        W = whitening(covariance_px2[i][seen])
        tangent = (W @ J[0][seen]).reshape(-1, 6)
        r, v = ((W @ part[seen][..., None]).reshape(-1) for part in (residual, velocity))
        r, v = (part - tangent @ np.linalg.lstsq(tangent, part, rcond=None)[0] for part in (r, v))
        top, between, bottom = top + r @ r, between + r @ v, bottom + v @ v
    if top == 0 or bottom == 0:
        return 0.0, 0.0
    return float(between / bottom), float(between**2 / (bottom * top))


def _with_neighbours(fits: PoseFits, rows: NDArray[np.intp]) -> Iterator[int]:
    """Some of the frames that have a pose and a frame on either side."""
    inside = rows[(rows > 0) & (rows < len(fits.converged) - 1)]
    inside = inside[fits.converged[inside]]
    yield from (int(i) for i in inside[np.linspace(0, len(inside) - 1, min(len(inside), 100)).astype(int)])
