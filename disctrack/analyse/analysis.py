"""From a trajectory to the physics: motion, contact, energy and scaling laws."""

from collections.abc import Iterator, Mapping
from dataclasses import dataclass

import numpy as np

from calibration.kit.brief import Brief
from disctrack.analyse.contact import Circle, RollingOnset, locus_circle, rolling_onset
from disctrack.analyse.derivatives import CHANNELS, MeasuredMotion, differentiate
from disctrack.analyse.power_laws import WINDOW, NutationCount, PowerLaws, count_nutation, fit_power_laws, power_law_end
from disctrack.analyse.quantities import ALL, COLUMN, TOTAL, DerivedSeries, Energy, energy_of, propagate
from disctrack.errors import AnalysisError
from disctrack.findings import Finding, Kind, Severity, of_kind
from disctrack.numbers import measured
from disctrack.trajectory import Trajectory, part

WINDOWS = np.array([0.2, 0.3, 0.4, 0.5, 0.75, 1.0, 1.5, 2.0, 3.0])  # [s] before t_f, to vary the fit
CIRCLE_DURATION = 0.6  # [s], as in figure 9 of the paper
EXPECTED_NOISE_SCALE = (0.7, 1.5)  # estimated over stated variance of the poses; outside, the report warns


@dataclass(frozen=True, repr=False)
class Analysis(Brief):
    """All results of the analysis of one trajectory.

    >>> analysis = run_analyse("clip/results/trajectory.h5", overwrite=True).analysis
    >>> bool(analysis.energy.loss > 0)
    True
    """

    trajectory: Trajectory
    motion: MeasuredMotion
    derived: Mapping[str, DerivedSeries]  # by name, all of QUANTITIES
    onset: RollingOnset
    circle: Circle
    energy: Energy
    laws: PowerLaws  # of the last stage
    laws_by_window: tuple[PowerLaws, ...]  # one per entry of WINDOWS
    nutation_count: NutationCount
    findings: tuple[Finding, ...]  # of the analysis only

    def facts(self) -> dict[str, str]:
        """Short summary (`Brief`)."""
        facts = {
            "frames": f"{int(self.motion.known.sum())} of {len(self.motion)}",
            "contact": self.onset.verdict,
            "energy lost": measured(self.energy.loss, self.energy.loss_sigma, "J"),
        }
        laws = self.laws
        if laws.determined:
            facts |= {"t_f": measured(laws.t_f, laws.t_f_sigma, "s"), "n_theta": str(laws.n_theta)}
        return facts

    def series(self, name: str) -> DerivedSeries:
        """The derived quantity of this name."""
        return self.derived[name]


def analyse(trajectory: Trajectory, window: float = WINDOW, circle_duration: float = CIRCLE_DURATION) -> Analysis:
    """Motion, contact, energy and scaling laws of a trajectory.

    window, circle_duration : [s] before t_f for the exponents, before the end for the circle
    If only a part of the trajectory was tracked, the result has the length of that part.
    Raises AnalysisError if the trajectory has no table frame, or too few poses.
    """
    if not trajectory.rig.world_is_table:
        raise AnalysisError(
            "the trajectory is in the axes of the left camera, not of the table, so that neither heights nor the "
            "vertical are known. Name the view whose board lies on the table ([table] in recording.toml), calibrate "
            "and track again."
        )
    tracked = np.flatnonzero(trajectory.looked_for)
    if tracked.size not in (0, len(trajectory)):
        trajectory = part(trajectory, slice(int(tracked[0]), int(tracked[-1]) + 1))
    motion = differentiate(trajectory)
    found = propagate(motion)
    psidot = found.value[:, COLUMN["psidot"]]
    sense = float(np.sign(np.nansum(psidot))) or 1.0  # of the precession
    until = power_law_end(motion.time, sense * motion.euler[:, 0], sense * psidot)
    onset = rolling_onset(found, until)
    if onset.low > motion.time[motion.known][0]:  # the acceleration jumps when slip ends
        del motion, found  # to save memory
        motion = differentiate(trajectory, breaks=(onset.time,))
        found = propagate(motion)
    psi, psidot = sense * motion.euler[:, 0], sense * found.value[:, COLUMN["psidot"]]
    data = (motion.time, psi, motion.euler[:, 1], psidot, found.value[:, TOTAL])
    laws = fit_power_laws(*data, window=window)
    return Analysis(
        trajectory=trajectory,
        motion=motion,
        derived={item.name: item for item in found.series(ALL)},
        onset=onset,
        circle=locus_circle(found, circle_duration, until),
        energy=energy_of(found),
        laws=laws,
        laws_by_window=tuple(fit_power_laws(*data, window=float(w)) for w in WINDOWS),
        nutation_count=count_nutation(psi, motion.euler[:, 1], motion.tilt_sigma, motion.disc),
        findings=of_kind(Kind.ANALYSIS, Severity.WARNING, _findings(trajectory, motion, onset)),
    )


def _findings(trajectory: Trajectory, motion: MeasuredMotion, onset: RollingOnset) -> Iterator[str]:
    """Warnings of the analysis, in addition to the findings of the tracking."""
    frames = trajectory.looked_for
    n, missing, unknown = (int(rows.sum()) for rows in (frames, frames & ~motion.measured, frames & ~motion.known))
    if missing:
        yield (
            f"{missing} of {n} frames have no pose of their own; {missing - unknown} were bridged from their "
            f"neighbours (their sigmas are larger), {unknown} stay unknown"
        )
    for name, scale in zip(CHANNELS, motion.noise_scale, strict=True):
        if not EXPECTED_NOISE_SCALE[0] <= scale <= EXPECTED_NOISE_SCALE[1]:
            yield (
                f"the scatter of the {name} is {np.sqrt(scale):.2f} times what the tracker states; the sigmas here "
                "follow the scatter"
            )
    if onset.low > motion.time[motion.known][0]:
        yield (
            f"where slip ends, at {onset.time:.4f} s, the acceleration jumps: the motion before and after was "
            "differentiated apart, so that sigmas are larger near that instant"
        )
    if onset.n_late_slips and onset.probability >= 0.5:
        yield (
            f"after the onset of rolling, {onset.n_late_slips} frames still show slip beyond five sigmas: stick and "
            "slip, or impacts"
        )
