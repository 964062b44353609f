"""From the contact: the onset of rolling, and the circle of the contact locus."""

from dataclasses import dataclass
from typing import Annotated

import numpy as np

from calibration.kit.types import Array
from disctrack.analyse.quantities import SIGMAS, Propagated, from_to

SLIP, CONTACT = from_to("slip_n", "slip_m"), from_to("contact_x", "contact_y")

# Errors of radius, thickness and table of 1e-4 each, at 1 to 5 m/s of the edge, appear as a slip of some tenths of a
# millimetre per second: smaller slip counts as rolling.
SLIP_TOLERANCE = 0.5e-3  # [m/s]
# Noise of a smoothed velocity decorrelates after about 0.6 l (half a period of the smoother's cut-off).
INDEPENDENT_AFTER_LENGTHS = 0.6


@dataclass(frozen=True)
class RollingOnset:
    """Onset of rolling without slip, from a posterior over the frames."""

    # [s] median; the first frame if no slip is significant; NaN if the disc does not roll
    time: Annotated[float, "rolling_onset_s"]
    low: Annotated[float, "rolling_onset_low_s"]  # [s] 2.5 % point
    high: Annotated[float, "rolling_onset_high_s"]  # [s] 97.5 % point
    probability: Annotated[float, "rolling_probability"]  # of pure rolling at the end of the recording
    # [m] path of slip before the onset (of the whole recording if the disc never rolls)
    slip_distance: Annotated[float, "slip_distance_m"]
    slip_distance_sigma: Annotated[float, "slip_distance_sigma_m"]  # [m]
    n_late_slips: int  # frames after the onset whose slip exceeds 5 sigma
    verdict: Annotated[str, "rolling_verdict"]


@dataclass(frozen=True)
class Circle:
    """Circle fitted to the contact locus in the plane of the table."""

    centre: Annotated[Array, "locus_circle_centre_m"]  # (2,) [m]; NaN if the arc does not determine it
    radius: Annotated[float, "locus_circle_radius_m"]  # [m]
    # [m] of the radius, from noise and the deviation of the locus from a circle
    sigma: Annotated[float, "locus_circle_radius_sigma_m"]
    sigma_calibration: Annotated[float, "locus_circle_radius_sigma_calibration_m"]  # [m]
    rms: float  # [m] of the distances from the circle
    # [m] mean of r cos theta - h sin theta, the radius if the centre is at rest
    expected: Annotated[float, "locus_circle_expected_radius_m"]
    interval: Annotated[tuple[float, float], "locus_circle_interval_s"]  # [s] first and last instant


def rolling_onset(found: Propagated, until: float = np.inf) -> RollingOnset:
    """Change from slip to rolling: posterior over the first rolling frame, flat prior, slip of unknown size before it.

    Before the onset each slip component has variance s^2 + noise, s unknown between 4 SLIP_TOLERANCE and 10 m/s; after
    it, SLIP_TOLERANCE^2 + noise. Noise of neighbouring frames is correlated: likelihoods are weighted accordingly.
    until : end of the rolling motion [s]; later frames, of a disc that is braked or at rest, are not used
    """
    motion = found.motion
    frames = np.flatnonzero(np.isfinite(found.value[:, SLIP]).all(axis=1) & (motion.time <= until))
    if frames.size < 2:
        why = "not determined: the contact velocity is not known in any two frames"
        return RollingOnset(*(float("nan"),) * 6, n_late_slips=0, verdict=why)
    v = found.value[frames, SLIP]
    C = found.covariance(frames, SLIP) + found.covariance(frames, SLIP, shared=True)
    interval = float(np.median(np.diff(motion.time)))
    share = np.minimum(1.0, interval / (INDEPENDENT_AFTER_LENGTHS * motion.length.min(axis=1)[frames]))
    sizes = np.geomspace(4 * SLIP_TOLERANCE, 10.0, 60)
    slipping = np.stack([_log_normal(v, C, s) * share for s in sizes])
    rolling = _log_normal(v, C, SLIP_TOLERANCE) * share
    before = np.concatenate([np.zeros((len(sizes), 1)), np.cumsum(slipping, axis=1)], axis=1)
    after = np.concatenate([np.cumsum(rolling[::-1])[::-1], [0.0]])
    log_joint = before + after  # (sizes, frames + 1): rolling from frame k on; the last entry is "never"
    peak = log_joint.max()
    posterior = np.exp(log_joint - peak).mean(axis=0)
    posterior /= posterior.sum()
    probability = float(1.0 - posterior[-1])
    index = np.minimum(np.searchsorted(np.cumsum(posterior), [0.025, 0.5, 0.975]), len(frames))
    first = int(index[1]) if index[0] else 0
    times = np.append(motion.time[frames], np.nan)
    low, median, high = times[[index[0], first, index[2]]] if probability >= 0.5 else np.full(3, np.nan)
    distance, distance_sigma = _slip_distance(motion.time[frames[:first]], v[:first], C[:first], share[:first])
    squared = np.sum(v * np.linalg.solve(C + SLIP_TOLERANCE**2 * np.eye(2), v[..., None])[..., 0], axis=1)
    late = int(np.sum(squared[first:] > SIGMAS**2))
    if probability < 0.5:
        verdict = "slips to the end of the recording; no pure rolling was reached"
    elif not first:
        verdict = f"rolls without slip from the first frame on (95 %: at the latest from {high:.4f} s)"
    else:
        verdict = f"rolls without slip from {median:.4f} s on (95 %: {low:.4f} to {high:.4f} s)"
    return RollingOnset(float(median), float(low), float(high), probability, distance, distance_sigma, late, verdict)


def _log_normal(v: Array, C: Array, extra: float) -> Array:
    """Logarithm of the density of v (n, 2) with covariance C + extra^2 I."""
    a, b, d = C[:, 0, 0] + extra**2, C[:, 0, 1], C[:, 1, 1] + extra**2
    det = a * d - b * b
    misfit = (d * v[:, 0] ** 2 - 2 * b * v[:, 0] * v[:, 1] + a * v[:, 1] ** 2) / det
    return -0.5 * (misfit + np.log(det))


def _slip_distance(time: Array, v: Array, C: Array, share: Array) -> tuple[float, float]:
    """Integral of |v| and its sigma, 0 for fewer than two frames; the variance of noise is subtracted from |v|^2."""
    noise2 = np.trace(C, axis1=1, axis2=2)
    speed = np.sqrt(np.maximum(np.sum(v * v, axis=1) - noise2, 0.0))
    step = np.diff(time)
    weight = 0.5 * (np.append(step, 0.0) + np.append(0.0, step))  # trapezoidal rule
    variance = np.sum(weight**2 * noise2 / 2 / share)
    return float(np.sum(speed * weight)), float(np.sqrt(variance))


def locus_circle(found: Propagated, duration: float, until: float = np.inf) -> Circle:
    """Circle through the contact points of the last `duration` seconds before `until`, least squares of distances.

    The sigma is from the scatter about the circle with one independent point per half turn; for arcs below a quarter
    turn the radius is NaN.
    """
    motion = found.motion
    known = np.flatnonzero(np.isfinite(found.value[:, CONTACT]).all(axis=1) & (motion.time <= until))
    frames = known[motion.time[known] >= motion.time[known[-1]] - duration] if known.size else known
    arc = float(np.ptp(motion.euler[frames, 0])) if frames.size else 0.0
    if arc < np.pi / 2 or frames.size < 8:
        return Circle(np.full(2, np.nan), *(float("nan"),) * 5, (float("nan"), float("nan")))
    points = found.value[frames, CONTACT]
    centre = points.mean(axis=0)
    for _ in range(30):  # Gauss-Newton, to round-off
        offset = points - centre
        distance = np.linalg.norm(offset, axis=1)
        J = np.column_stack([offset / distance[:, None], np.ones(len(frames))])
        by_distance = np.linalg.solve(J.T @ J, J.T)
        *step, radius = by_distance @ distance
        centre = centre + np.array(step)
    gain = by_distance[2]
    rms = float(np.sqrt(np.mean((distance - radius) ** 2)))
    independent = min(len(frames), max(4.0, arc / np.pi))
    noise = found.covariance(frames, CONTACT).sum(axis=(1, 2)).mean() / 2
    variance = gain @ gain * len(frames) / independent * max(rms**2, float(noise))
    sensitivity = found.jacobian[frames, CONTACT] @ motion.calibration_sensitivity[frames]
    per_rig = gain @ np.einsum("ni,nir->nr", J[:, :2], sensitivity)
    theta = motion.euler[frames, 1]
    expected = motion.disc.radius * np.cos(theta) - motion.disc.half_thickness * np.sin(theta)
    return Circle(
        centre=centre,
        radius=float(radius),
        sigma=float(np.sqrt(variance)),
        sigma_calibration=float(np.sqrt(max(0.0, per_rig @ motion.rig_covariance @ per_rig))),
        rms=rms,
        expected=float(np.mean(expected)),
        interval=(float(motion.time[frames[0]]), float(motion.time[frames[-1]])),
    )
