"""A recording as read from its trajectory file, with the positions of the dots that a diagnosis assumes.

The tracking refines the positions of the dots on the face. Small errors of all dots are the scatter of a printer. A few
displaced dots among correct ones are a fault, which the diagnosis has to find: their declared positions are restored.
An error larger than that of any printer is a wrong declaration, which the tracking has reported, and for which the
images are not linear in the position: there the refined positions stay.
"""

from collections.abc import Iterable, Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from disctrack.discrepancy.significance import SURE
from disctrack.findings import Finding, Kind, doubts
from disctrack.trajectory import Trajectory
from disctrack.trajectory.file import read_details, read_provenance, read_trajectory

MIN_MISPRINT_UM, MOST_MISPRINT_UM = 4.0, 300.0  # scatter by the shapes of dots; and the largest error of a printer


@dataclass(frozen=True)
class Recorded:
    """A measured trajectory with the declared names."""

    name: str
    trajectory: Trajectory
    surface: str = ""
    disc: str = ""  # to distinguish discs of the same sizes and mass


def read_recorded(path: Path) -> Recorded:
    """From a trajectory file. Raises TrajectoryFileError."""
    provenance = read_provenance(path)
    declared = provenance.settings.get("recording", {})
    trajectory = with_declared_dots(read_trajectory(path), read_details(path))
    surface, disc = declared.get("surface", ""), declared.get("disc", {}).get("name", "")
    return Recorded(provenance.recording, trajectory, str(surface), str(disc))


def with_declared_dots(trajectory: Trajectory, details: Mapping[str, Any]) -> Trajectory:
    """The trajectory with the declared positions of the dots, if at most a third of them are misprinted.

    details : of the tracking, with the displacements that it found
    """
    shift = np.asarray(details.get("marker_shift_um", ()), float)
    sigma = np.asarray(details.get("marker_shift_sigma_um", ()), float)
    if shift.ndim != 2 or shift.shape != sigma.shape or not np.isfinite(shift).all():
        return trajectory
    length = np.linalg.norm(shift, axis=1)
    off = (length > MIN_MISPRINT_UM) & (length > SURE * np.linalg.norm(sigma, axis=1))
    if not off.any() or 3 * off.sum() > len(shift) or length.max() >= MOST_MISPRINT_UM:
        return trajectory
    places = trajectory.disc.marker_centres_body.copy()
    places[:, :2] -= 1e-6 * shift
    return replace(trajectory, disc=replace(trajectory.disc, marker_centres_body=places))


def wrong_declarations(findings: Iterable[Finding]) -> tuple[Finding, ...]:
    """Findings of wrong declarations, which would be mistaken for missing effects; but not of displaced dots."""
    return tuple(f for f in doubts(findings) if f.kind != Kind.DOTS_MISPLACED and any(r.key for r in f.remedies))
