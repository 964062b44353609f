"""Which further recording would tell apart what this one cannot? Computed for recordings that were not made yet."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace

import numpy as np

from disctrack.diagnosis.disc.stretch import MIN_FRAMES, Stretch
from disctrack.diagnosis.disc.system import DiscSystem
from disctrack.diagnosis.engine.fit import Fit
from disctrack.diagnosis.engine.score import Linearisation, angle
from disctrack.diagnosis.engine.system import Candidate
from disctrack.errors import AnalysisError, DiscTrackError
from disctrack.frames import rotation_from_euler
from disctrack.rolling import State, simulate, steady_precession
from disctrack.trajectory import MarkerStatus

NUTATIONS_DEG = (3.0, 8.0, 15.0, 30.0)
SPINS = (0.5, 5.0)  # omega_3 [rad/s]
DURATIONS = (0.5, 1.0)  # [s]
NUTATION_SHARE = 0.05  # amplitude of the nutation oscillation over the nutation angle


@dataclass(frozen=True)
class Separation:
    """How well a recording would tell an effect from its rival."""

    rival: str
    theta_deg: float  # at the start
    omega3: float  # [rad/s]
    duration: float  # [s]; shorter than asked for where the disc comes to rest
    angle: float  # [rad] between the predicted residuals, cleared of what other quantities absorb
    sigmas: float  # root of the chi-square that the wrong one of the two would leave

    @property
    def text(self) -> str:
        """The recording in words."""
        return (
            f"start at {self.theta_deg:g} deg with omega_3 = {self.omega3:g} rad/s and film {self.duration:.2g} s: "
            f"{self.sigmas:.3g} sigmas apart"
        )


def separations(
    system: DiscSystem, fit: Fit, effect: Candidate, rivals: Sequence[Candidate]
) -> dict[str, Separation | None]:
    """For each rival, of the recordings looked at, the one that would tell it best from the effect at its fitted size.

    None where no such recording can be simulated.
    """
    best: dict[str, Separation | None] = {r.name: None for r in rivals}
    for planned, values, plan in _plans(system, fit, [effect, *rivals]):
        quantities = tuple(q for q in planned.base if q.name in values)
        there = Fit(quantities, values, np.zeros((len(quantities),) * 2), 0.0, 0.0, 1, True, 0)
        linear = Linearisation(planned, there, planned.candidates)
        amount = np.array([fit.values[q.name] - q.null for q in effect.quantities])
        signal = linear.columns(effect.names) @ amount
        strength = float(np.linalg.norm(linear.cleared(signal[:, None])))
        for rival in rivals:
            between = angle(linear, signal, rival.names)
            found = Separation(rival.name, *plan, between, strength * float(np.sin(between)))
            previous = best[rival.name]
            if previous is None or found.sigmas > previous.sigmas:
                best[rival.name] = found
    return best


def _plans(
    system: DiscSystem, fit: Fit, candidates: Sequence[Candidate]
) -> Iterator[tuple[DiscSystem, dict[str, float], tuple[float, float, float]]]:
    """Systems of recordings that could be made, values at which to linearise, and what they are."""
    for theta_deg in NUTATIONS_DEG:
        for omega3 in SPINS:
            for duration in DURATIONS:
                try:
                    start = steady_precession(
                        np.radians(theta_deg),
                        system.disc,
                        system.model.gravity,
                        omega3=omega3,
                        nutation_amplitude=np.radians(NUTATION_SHARE * theta_deg),
                        x=float(np.nanmean(system.trajectory.q[:, 0])),
                        y=float(np.nanmean(system.trajectory.q[:, 1])),
                    )
                    planned = planned_recording(system, fit, start, duration, candidates)
                except DiscTrackError:  # no such precession, or over at once: not a recording to propose
                    continue
                state = dict(zip((q.name for q in planned.base[:8]), start.array.tolist(), strict=True))
                kept = {q.name: 0.0 for q in planned.base if q.name not in state} | {
                    k: v for k, v in fit.values.items() if not k.startswith(("state.", "rig.", "dot_"))
                }
                yield planned, kept | state, (theta_deg, omega3, float(planned.time[-1] - planned.time[0]))


def planned_recording(
    system: DiscSystem, fit: Fit, start: State, duration: float, candidates: Sequence[Candidate]
) -> DiscSystem:
    """The same disc, cameras and noise, another motion; raises DiscTrackError where that motion is too short."""
    old = system.trajectory
    values = {k: v for k, v in fit.values.items() if not k.startswith("state.")}
    motion = simulate(system.model_with(values), start, duration, rate=old.frame_rate)
    n, m = len(motion), system.disc.n_markers
    if n < MIN_FRAMES:
        raise AnalysisError(f"the motion is over after {n} frames")
    R = rotation_from_euler(*motion.q[:, 3:].T)
    pixels = system.rig.project(system.disc.marker_centres_body @ np.swapaxes(R, 1, 2) + motion.q[:, None, :3])
    pixels = np.moveaxis(pixels, -3, 1)
    usual = np.nanmedian(old.markers_covariance_px2.reshape(-1, 2, 2), axis=0)
    inside = np.isfinite(pixels).all(-1)
    trajectory = replace(
        old,
        time=motion.time,
        frame=np.arange(n),
        q=motion.q,
        pose_covariance=np.broadcast_to(np.eye(6), (n, 6, 6)),
        calibration_sensitivity=np.zeros((n, 6, old.calibration_sensitivity.shape[2])),
        quaternion=np.zeros((n, 4)),
        frame_status=np.zeros(n, np.uint8),
        reprojection_rms_px=np.zeros((n, 2)),
        reduced_chi_square=np.ones(n),
        markers_px=pixels,
        markers_covariance_px2=np.broadcast_to(usual, (n, 2, m, 2, 2)),
        markers_residual_px=np.zeros((n, 2, m, 2)),
        marker_status=np.where(inside, MarkerStatus.MEASURED, MarkerStatus.OUTSIDE).astype(np.uint8),
    )
    return DiscSystem(trajectory, system.model, tuple(candidates), stretch=Stretch(slice(0, n)))
