"""Stretches of frames in which the cameras contradict each other, and whether one of them left out images.

A camera that leaves out an image is ahead of the other from there on: its dots lie where they will be one frame later.
To first order they are displaced by their velocity in the image times the delay; what of that a change of the pose
makes up for is no sign of it.
"""

import itertools
from collections.abc import Callable, Iterator
from functools import partial

import numpy as np
from numpy.typing import NDArray

from calibration.cameras.camera import StereoRig
from calibration.kit.arrays import Array, Mask
from calibration.kit.brief import ranges
from disctrack.findings import MISFITS, Finding, Kind, Number, Remedy, Severity, Subject
from disctrack.frames import CAMERAS
from disctrack.track.pose import PoseFits, marker_pixels, whitening

SHORTEST = 4  # frames: a gleam or a hand is told by the frames' own status
THROUGHOUT = 3  # stretches with one and the same delay
EXPLAINED, TOLD = 0.9, 0.5  # of the square of the misfit: by a slip; or by no delay at all, below


def dropped_frames(
    refused: Mask,
    fits: PoseFits,
    markers_px: Array,
    covariance_px2: Array,
    rig: StereoRig,
    centres: Array,
    pairs: range,
) -> tuple[Finding, ...]:
    """Long stretches of frames refused (n,) for their dots; the other arguments as in `fit_poses`."""
    delay_of = partial(delay_of_right, fits, markers_px, covariance_px2, rig, centres)
    slips: list[tuple[list[int], int, list[float]]] = []  # rows of each, the images left out, the delays that say so
    unexplained: list[int] = []
    edges = np.flatnonzero(np.diff(np.r_[False, refused, False].astype(int))).reshape(-1, 2)
    for first, end in edges[edges[:, 1] - edges[:, 0] >= SHORTEST]:
        delay, explained = delay_of(np.arange(first, end))
        ahead = round(delay) if explained > EXPLAINED else 0
        if not ahead:
            unexplained += pairs[first:end]
        elif (
            slips and ahead == slips[-1][1] and _as_late(delay_of, np.arange(slips[-1][0][-1] + 1, first), ahead, fits)
        ):
            slips[-1][0].extend(range(first, end))
            slips[-1][2].append(delay)
        else:
            slips.append((list(range(first, end)), ahead, [delay]))
    gap = 0  # frames
    # images that are left out one after the other add up: where the same number is missing again and again, the frames
    # between, few of them measured by both cameras, only happen to agree
    if len(slips) >= THROUGHOUT and len({ahead for _, ahead, _ in slips}) == 1:
        gap = max(after[0][0] - before[0][-1] for before, after in itertools.pairwise(slips))
        rows, told = [i for part, _, _ in slips for i in part], [delay for _, _, part in slips for delay in part]
        slips = [(rows, slips[0][1], told)]
    said = []
    refused_for = "are refused: the dots of the two cameras contradict each other"
    for k, (rows, ahead, delays) in enumerate(slips):
        camera, other = CAMERAS[::-1] if ahead > 0 else CAMERAS
        always = k == 0 and (
            rows[0] <= gap or (rows[0] >= SHORTEST and _as_late(delay_of, np.arange(rows[0]), ahead, fits))
        )
        frames, n = [pairs[i] for i in rows], abs(ahead)
        text = (
            f"frames {ranges(frames)} {refused_for}, as if the {camera} camera were "
            f"{abs(float(np.mean(delays))):.2f} frames ahead of the {other}: it left out {n} image(s) "
            f"{'before' if always else 'at'} frame {pairs[0] if always else frames[0]}"
        )
        of = Subject("track", camera, ((frames[0], frames[-1]),))
        remedy = Remedy(action=f"number its images from there on higher by {n}")
        said.append(Finding(Kind.DROPPED_FRAMES, Severity.DOUBT, text, of, {"images": Number(n)}, (remedy,), MISFITS))
    if unexplained:
        text = f"frames {ranges(unexplained)} {refused_for}"
        said.append(Finding(Kind.CAMERAS_CONTRADICT, Severity.DOUBT, text))
    return tuple(said)


def _as_late(
    delay_of: Callable[[NDArray[np.intp]], tuple[float, float]], between: NDArray[np.intp], ahead: int, fits: PoseFits
) -> bool:
    """Are the frames between two refused stretches, in which the disc may turn about a camera's line, as late as these?

    So are those that say nothing of it, measured by one camera if at all, but for a few.
    """
    delay, explained = delay_of(between)
    by_both = np.isfinite(fits.residuals_px[between]).all(axis=-1).any(axis=-1).all(axis=-1)
    return round(delay) == ahead if explained > TOLD else bool(by_both.sum() < SHORTEST)


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
        if not np.isfinite(tangent).all():  # a pose that ran away
            continue
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
