"""Where the dots are taken to be: as declared, if one or two of them are misprinted, so that the diagnosis names them.

The tracking measures with the places that it found for the dots. When all dots are off by a little, as printed dots
are, nothing is to be said about them. One dot that is off while the others are where they should be is a fault, and
has to come out as one. Farther off than any printer puts it, it was declared wrongly: the tracking has said so, and how
the dots move with a place is no longer linear.
"""

from collections.abc import Mapping
from dataclasses import replace
from typing import Any

import numpy as np

from disctrack.trajectory import Trajectory

MIN_MISPRINT_UM = 4.0  # what the shapes of two dots may well differ by
MOST_MISPRINT_UM = 300.0
MIN_SIGMAS = 5.0


def misprinted(findings: Mapping[str, Any]) -> tuple[int, ...]:
    """Numbers of the dots that the tracking found displaced alone, while most others stayed; empty otherwise."""
    shift = np.asarray(findings.get("marker_shift_um", ()), float)
    sigma = np.asarray(findings.get("marker_shift_sigma_um", ()), float)
    if shift.ndim != 2 or shift.shape != sigma.shape or not np.isfinite(shift).all():
        return ()
    length = np.linalg.norm(shift, axis=1)
    off = np.flatnonzero((length > MIN_MISPRINT_UM) & (length > MIN_SIGMAS * np.linalg.norm(sigma, axis=1)))
    alone = 3 * off.size <= len(shift) and length.max() < MOST_MISPRINT_UM
    return tuple(int(i) for i in off) if alone else ()


def with_declared_dots(trajectory: Trajectory, findings: Mapping[str, Any]) -> Trajectory:
    """The trajectory with the dots where they were declared, if only a third of them at most are misprinted."""
    if not misprinted(findings):
        return trajectory
    places = trajectory.disc.marker_centres_body.copy()
    places[:, :2] -= 1e-6 * np.asarray(findings["marker_shift_um"], float)
    return replace(trajectory, disc=replace(trajectory.disc, marker_centres_body=places))
