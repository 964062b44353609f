"""A recording as its trajectory file has it, with its dots where they are taken to be.

The tracking measures with the places that it found for the dots. When all dots are off by a little, as printed dots
are, nothing is to be said about them. One dot that is off while the others are where they should be is a fault, and
has to come out as one. Farther off than any printer puts it, it was declared wrongly: the tracking has said so, and how
the dots move with a place is no longer linear.
"""

from collections.abc import Iterable, Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from disctrack.findings import Finding, Kind, doubts
from disctrack.trajectory import Trajectory
from disctrack.trajectory.file import read_details, read_provenance, read_trajectory

MIN_MISPRINT_UM, MOST_MISPRINT_UM = 4.0, 300.0  # what the shapes of two dots may well differ by; and see above
MIN_SIGMAS = 5.0


@dataclass(frozen=True)
class Recorded:
    """A measured trajectory with what was declared beside it."""

    name: str
    trajectory: Trajectory
    surface: str = ""
    disc: str = ""  # name of the disc, where sizes and mass do not tell it from others


def read_recorded(path: Path) -> Recorded:
    """From a trajectory file. Raises TrajectoryFileError."""
    provenance = read_provenance(path)
    declared = provenance.settings.get("recording", {})
    return Recorded(
        provenance.recording,
        with_declared_dots(read_trajectory(path), read_details(path)),
        str(declared.get("surface", "")),
        str(declared.get("disc", {}).get("name", "")),
    )


def with_declared_dots(trajectory: Trajectory, details: Mapping[str, Any]) -> Trajectory:
    """The trajectory with the dots where they were declared, if only a third of them at most are misprinted.

    details : of the tracking, which found dots displaced
    """
    shift = np.asarray(details.get("marker_shift_um", ()), float)
    sigma = np.asarray(details.get("marker_shift_sigma_um", ()), float)
    if shift.ndim != 2 or shift.shape != sigma.shape or not np.isfinite(shift).all():
        return trajectory
    length = np.linalg.norm(shift, axis=1)
    off = (length > MIN_MISPRINT_UM) & (length > MIN_SIGMAS * np.linalg.norm(sigma, axis=1))
    if not off.any() or 3 * off.sum() > len(shift) or length.max() >= MOST_MISPRINT_UM:
        return trajectory
    places = trajectory.disc.marker_centres_body.copy()
    places[:, :2] -= 1e-6 * shift
    return replace(trajectory, disc=replace(trajectory.disc, marker_centres_body=places))


def wrong_declarations(findings: Iterable[Finding]) -> tuple[Finding, ...]:
    """What is declared wrongly: a missing effect would be read into it. Dots are measured where they are."""
    return tuple(f for f in doubts(findings) if f.kind != Kind.DOTS_MISPLACED and any(r.key for r in f.remedies))
