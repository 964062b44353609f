"""Faults of the measurement too large for a search that begins at null: cameras knocked by degrees, frames out of step.

Two cameras that disagree about a rigid pattern tell by how much one of them turned, moved or lags before anything is
known of the motion: poses and fault are found in turn, from the dots alone. Which of the two cameras it was, the motion
on its table decides. A clock that is wrong by a good part shows in the precession, which gravity sets.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from scipy.interpolate import CubicSpline
from scipy.optimize import least_squares

from calibration.kit.arrays import Array
from disctrack.diagnosis.disc_system import DiscSystem
from disctrack.diagnosis.motion import measurement_candidates
from disctrack.diagnosis.systematic import Systematic, find_systematic, with_noise_of_frames
from disctrack.discrepancy.fit import Fit, fit
from disctrack.discrepancy.search import Diagnosis, Found, Settings, beside, explain
from disctrack.discrepancy.system import Candidate, Values
from disctrack.errors import AnalysisError
from disctrack.faults.catalogue import scene_faults
from disctrack.faults.dots import cameras_with, centres_with
from disctrack.frames import CAMERAS, euler_from_rotation, rotation_from_euler, unwrap_euler
from disctrack.rolling import Model
from disctrack.track.pose import DotsInFrames, fit_poses
from disctrack.trajectory import Trajectory

LARGE_PX = 1.0  # rms in the dots, from which a fault is sought without the linear approximation
WORSE = 4.0  # times the misfit of the best explanation, from which another is not pursued
ENOUGH = 1.5  # reduced chi-square, up to which no second fault is looked for
SINGLE = (("time_offset",), *((f"{camera}_{family}",) for family in ("turned", "shifted") for camera in CAMERAS))
DOUBLE = (
    *((f"{camera}_turned", f"{camera}_shifted") for camera in CAMERAS),
    *(("time_offset", f"{camera}_turned") for camera in CAMERAS),
)
STEADY = (0.8, 1.25)  # of psidot^2 sin(theta) / (4 g / r) that nutation and spin of a rolling disc leave it within


@dataclass(frozen=True)
class Assumed:
    """A recording with large faults as they were found: the system that has them among what every fit moves."""

    system: DiscSystem
    base: Fit
    candidates: tuple[Candidate, ...]
    gain: float  # decrease of chi-square of the dots about free poses; infinite where the motion told

    @property
    def price(self) -> float:
        """Cost of the fit, and of the numbers that it moves (Bayesian information criterion)."""
        return self.base.cost + self.base.n_free * float(np.log(max(self.base.n_data, 2)))


def poses_with(trajectory: Trajectory, values: Values) -> Trajectory:
    """The trajectory with poses, and what they leave of the dots, as they are if these faults are true.

    Dots and rig stay as measured and as calibrated.
    """
    faults = scene_faults(trajectory.disc, values)
    pixels = trajectory.markers_px.copy()
    for dot in (
        range(pixels.shape[2]) if faults.right_delay_s else ()
    ):  # those of the right camera at the left one's instants
        seen = np.asarray(np.isfinite(pixels[:, 1, dot]).all(axis=1))
        moved = np.full_like(pixels[:, 1, dot], np.nan)
        if seen.sum() >= 8:
            course = CubicSpline(trajectory.time[seen], pixels[seen, 1, dot])
            moved[seen] = course(trajectory.time[seen] - faults.right_delay_s, extrapolate=False)
        pixels[:, 1, dot] = moved
    dots = DotsInFrames(
        cameras_with(faults, trajectory.rig),
        replace(trajectory.disc, marker_centres_body=centres_with(faults, trajectory.disc)),
        pixels,
        trajectory.markers_covariance_px2,
        rotation_from_euler(*trajectory.q[:, 3:].T),
        trajectory.q[:, :3],
    )
    fits = fit_poses(dots, reject_outliers=False, with_sensitivity=False)
    angles = np.full((len(trajectory), 3), np.nan)
    angles[fits.converged] = unwrap_euler(euler_from_rotation(fits.R_world_body[fits.converged]))
    return replace(
        trajectory,
        q=np.column_stack([fits.t_world_body, angles]),
        pose_covariance=fits.covariance,
        markers_residual_px=fits.residuals_px,
        reduced_chi_square=fits.reduced_chi_square,
    )


def find_large(as_tracked: Trajectory, system: DiscSystem, first: Systematic) -> Assumed | None:
    """Faults that the dots alone show to be large, with the camera that the motion speaks for; None if there are none.

    system : of what was tracked, with the noise that it shows so far.   first : what `find_systematic` finds in it
    """
    known = system.known
    _, columns = system.about_poses(known).linearise(known, list(first.amounts))
    moved = columns @ np.array(list(first.amounts.values()))
    moved_px = float(np.sqrt(np.sum(moved**2) / np.sum(system.weights))) / system.per_px
    if max(moved_px, first.lens_px, first.dot_px) < LARGE_PX:
        return None
    best: Assumed | None = None
    for hypotheses in (SINGLE, DOUBLE):
        seen = [_found_statically(system.trajectory, names, known) for names in hypotheses]
        least = min(left for left, *_ in seen)
        for names, (left, values, gain) in zip(hypotheses, seen, strict=True):
            found = _assumed(as_tracked, system.model, names, values, gain) if left < WORSE * least else None
            if found is not None and (best is None or found.price < best.price):
                best = found
        if best is not None and best.base.reduced_chi_square < ENOUGH:
            break
    return best


def _found_statically(
    trajectory: Trajectory, names: Sequence[str], known: Values
) -> tuple[float, dict[str, float], float]:
    """Amounts of these faults with which free poses leave least of the dots.

    returns : chi-square of the dots about those poses, the amounts, decrease of chi-square
    """
    quantities = [q for c in measurement_candidates(trajectory.disc, names) for q in c.quantities]
    sigma = np.sqrt(0.5 * np.trace(trajectory.markers_covariance_px2, axis1=-2, axis2=-1))[..., None]

    def amounts(steps: Array) -> dict[str, float]:
        moved = {q.name: known.get(q.name, 0.0) + q.scale * x for q, x in zip(quantities, steps.tolist(), strict=True)}
        return {**known, **moved}

    def seen(steps: Array) -> Array:
        return np.asarray(poses_with(trajectory, amounts(steps)).markers_residual_px / sigma, float)

    def left(steps: Array) -> Array:
        found = seen(steps)[there]
        return np.where(np.isfinite(found), found, before)  # dots that lose their pose do not count as explained

    def by_steps(steps: Array) -> Array:
        return np.stack([(left(steps + one) - left(steps - one)) / 2 for one in np.eye(len(steps))], axis=1)

    nothing = np.zeros(len(quantities))
    there = np.isfinite(begun := seen(nothing))
    before = begun[there]
    found = least_squares(left, nothing, by_steps, xtol=1e-3)
    return 2 * found.cost, amounts(found.x), float(before @ before) - 2 * found.cost


def _assumed(trajectory: Trajectory, model: Model, names: Sequence[str], known: Values, gain: float) -> Assumed | None:
    """The motion fitted with these faults among what moves; None where that fails."""
    candidates = measurement_candidates(trajectory.disc, names)
    seen = with_noise_of_frames(poses_with(trajectory, known))
    try:
        plain = DiscSystem(seen, model, known=known)
    except AnalysisError:
        return None
    system = plain.again(systematic=find_systematic(plain, known, names), freed=candidates)
    base = fit(system, system.base, system.start())
    return Assumed(system, base, candidates, gain) if np.isfinite(base.cost) else None


def find_clock(system: DiscSystem) -> Assumed | None:
    """The same with the frame rate that the precession asks for; None where it is the declared one."""
    q = system.trajectory.q[system.rows]
    good = np.isfinite(q).all(axis=1)
    psidot = np.gradient(q[good, 3], system.time[good])
    # over what it is in the steady rolling of a thin disc
    speed = np.median(psidot**2 * np.sin(q[good, 4])) * system.disc.radius / (4 * system.model.gravity)
    if STEADY[0] < speed < STEADY[1]:
        return None
    candidates = measurement_candidates(system.disc, ["frame_rate"])
    (q_rate,) = candidates[0].quantities
    change = float(np.clip(1.0 / np.sqrt(speed) - 1.0, q_rate.lower, q_rate.upper))
    freed = system.again(freed=candidates, known={**system.known, q_rate.name: change})
    base = fit(freed, freed.base, freed.start())
    return Assumed(freed, base, candidates, np.inf) if base.converged else None


def diagnose_with_large(assumed: Assumed, settings: Settings) -> Diagnosis:
    """The diagnosis with the large faults among what was found, and a remark for people."""
    diagnosis = explain(assumed.system, assumed.base.values, settings)
    found = [Found(c, assumed.gain, assumed.gain, 0.0, ()) for c in assumed.candidates]
    said = " and ".join(c.title for c in assumed.candidates)
    how = "the precession, which gravity sets" if np.isinf(assumed.gain) else "the dots alone"
    note = f"{said}: so much that it was found from {how}, and before and after are both with it"
    diagnosis = beside(diagnosis, found, ", from the dots about free poses")
    return replace(diagnosis, remarks=(note, *diagnosis.remarks))
