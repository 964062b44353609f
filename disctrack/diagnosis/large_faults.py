"""Faults of the measurement too large for a linear search from zero: a knocked camera, a delay of frames, a wrong rate.

Two cameras that disagree about a rigid pattern determine how far one of them turned, moved or lags before any model of
the motion is used: the fault is fitted to the dots with a free pose in each frame. The dots do not show which of the
two cameras it was, so that every fault that reconciles them becomes an initial guess of the search, which compares them
by the evidence of the motion. A wrong frame rate shows in the rate of precession, which gravity determines.
"""

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
from scipy.interpolate import CubicSpline
from scipy.optimize import least_squares

from calibration.kit.types import Array
from disctrack.diagnosis.disc_system import DiscSystem
from disctrack.diagnosis.motion import measurement_candidates
from disctrack.diagnosis.systematic import Systematic, find_systematic, with_noise_of_frames
from disctrack.discrepancy.search import Former
from disctrack.discrepancy.system import Values
from disctrack.errors import AnalysisError
from disctrack.faults.catalogue import scene_faults
from disctrack.faults.dots import cameras_with, centres_with
from disctrack.frames import CAMERAS, euler_from_rotation, rotation_from_euler, unwrap_euler
from disctrack.track.pose import DotsInFrames, fit_poses
from disctrack.trajectory import Trajectory

LARGE_PX = 1.0  # rms in the dots, from which a fault is estimated without the linear approximation
WORSE = 4.0  # times the chi-square of the best single fault, from which another is no initial guess
SINGLE = (("time_offset",), *((f"{camera}_{change}",) for change in ("turned", "shifted") for camera in CAMERAS))
DOUBLE = (
    *((f"{camera}_turned", f"{camera}_shifted") for camera in CAMERAS),
    *(("time_offset", f"{camera}_turned") for camera in CAMERAS),
)


def poses_with(trajectory: Trajectory, values: Values) -> Trajectory:
    """The trajectory with poses fitted as if these faults were true, and the residuals of the dots about them.

    The images of the dots and the rig stay as measured and as calibrated.
    """
    faults = scene_faults(trajectory.disc, values)
    pixels = trajectory.markers_px.copy()
    if faults.right_delay_s:  # dots of the right camera at the left one's instants
        for dot in range(pixels.shape[2]):
            seen = np.asarray(np.isfinite(pixels[:, 1, dot]).all(axis=1))
            moved = np.full_like(pixels[:, 1, dot], np.nan)
            if seen.sum() >= 8:
                course = CubicSpline(trajectory.time[seen], pixels[seen, 1, dot])
                moved[seen] = course(trajectory.time[seen] - faults.right_delay_s, extrapolate=False)
            pixels[:, 1, dot] = moved
    rig, disc = cameras_with(faults, trajectory.rig), trajectory.disc
    disc = replace(disc, marker_centres_body=centres_with(faults, disc))
    poses = rotation_from_euler(*trajectory.q[:, 3:].T), trajectory.q[:, :3]
    dots = DotsInFrames(rig, disc, pixels, trajectory.markers_covariance_px2, *poses)
    fits = fit_poses(dots, reject_outliers=False, with_sensitivity=False)
    angles = np.full((len(trajectory), 3), np.nan)
    angles[fits.converged] = unwrap_euler(euler_from_rotation(fits.R_world_body[fits.converged]))
    q = np.column_stack([fits.t_world_body, angles])
    return replace(
        trajectory,
        q=q,
        pose_covariance=fits.covariance,
        markers_residual_px=fits.residuals_px,
        reduced_chi_square=fits.reduced_chi_square,
    )


def large_faults(as_tracked: Trajectory, system: DiscSystem, first: Systematic) -> tuple[DiscSystem, Former] | None:
    """The recording with the poses of the likeliest large faults, and initial guesses by all that come near to them.

    None if no fault is large.

    system : of what was tracked, with its noise so far.   first : `find_systematic` of it
    """
    known, former = system.known, dict[frozenset[str], dict[str, float]]()
    likeliest, found = system, first
    for faults in (SINGLE, DOUBLE):
        if max(found.faults_px, found.lens_px, found.dot_px) < LARGE_PX:
            break
        former.clear()
        estimates = [(*_static_estimate(system.trajectory, names, known), names) for names in faults]
        estimates.sort(key=lambda estimate: estimate[0])
        plausible = [(values, names) for left, values, names in estimates if left < WORSE * estimates[0][0]]
        for values, names in reversed(plausible):
            seen = with_noise_of_frames(poses_with(as_tracked, values))
            try:
                likeliest = DiscSystem(seen, system.model, known=values)
            except AnalysisError:  # with these faults the poses are no motion
                continue
            former[frozenset(names)] = likeliest.start()
        found = find_systematic(likeliest)
    return (likeliest.again(systematic=found), former) if former else None


def _static_estimate(trajectory: Trajectory, names: Sequence[str], known: Values) -> tuple[float, dict[str, float]]:
    """Chi-square of the dots about free poses, minimised over the amounts of these faults; and the amounts."""
    quantities = [q for c in measurement_candidates(trajectory.disc, names) for q in c.quantities]
    sigma = np.sqrt(0.5 * np.trace(trajectory.markers_covariance_px2, axis1=-2, axis2=-1))[..., None]

    def amounts(steps: Array) -> dict[str, float]:
        moved = zip(quantities, steps.tolist(), strict=True)
        return {**known, **{q.name: known.get(q.name, 0.0) + q.scale * x for q, x in moved}}

    def whitened(steps: Array) -> Array:
        return np.asarray(poses_with(trajectory, amounts(steps)).markers_residual_px / sigma, float)

    def residual(steps: Array) -> Array:
        found = whitened(steps)[seen]
        return np.where(np.isfinite(found), found, begun)  # a dot that loses its pose does not count as explained

    def derivative(steps: Array) -> Array:
        return np.stack([(residual(steps + one) - residual(steps - one)) / 2 for one in np.eye(len(steps))], axis=1)

    zero = np.zeros(len(quantities))
    seen = np.isfinite(whole := whitened(zero))
    begun = whole[seen]
    found = least_squares(residual, zero, derivative, xtol=1e-3)
    return 2 * found.cost, amounts(found.x)
