"""From poses to velocities and accelerations, with their covariance.

Position is differentiated in R^3. Rotation is differentiated on its own manifold: relative to the pose of the frame in
question, M_k = R_k R_i^T, the vector s_k = vee((M_k - M_k^T) / 2) is the rotation vector to second order, linear in
R_k and regular at every angle; at frame i its first two derivatives are the angular velocity and the angular
acceleration in world axes. Euler rates follow from the angular velocity, not from differences of Euler angles.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import pairwise

import numpy as np

from calibration.kit.brief import Brief
from calibration.kit.types import Array, Indices, Mask, checked
from disctrack import frames
from disctrack.analyse.smoothing import HALF_WINDOW_LENGTHS, SEGMENT, fit_process, moving_weights
from disctrack.disc import Disc
from disctrack.errors import AnalysisError
from disctrack.trajectory import FrameStatus, Trajectory, part

K = np.array([0.0, 0.0, 1.0])
VECTORS = ("position", "rotation", "velocity", "omega", "acceleration", "alpha")
STATE = tuple(f"{vector}_{axis}" for vector in VECTORS for axis in "xyz")
N_STATE = len(STATE)  # 18
# POSE_COMPONENTS by groups, which differ in spectrum and noise
CHANNELS = {"horizontal position": [0, 1], "height": [2], "tilt": [3, 4], "turn about the vertical": [5]}
MIN_FRAMES = 12  # a line and a curvature per channel, and enough degrees of freedom to estimate the noise
# Of the longer side of the image: systematic errors are as smooth as half a cell of the splines that correct the lens
SYSTEMATIC_LENGTH = 0.1
KNOWN_FRACTION = 0.25  # of the prior variance of the first derivative: above, the samples do not determine it


@dataclass(frozen=True, repr=False)
class MotionState(Brief):
    """Motion of the disc at n instants, world axes."""

    position: Array  # (n, 3) centre [m]
    R_world_body: Array  # (n, 3, 3)
    velocity: Array  # (n, 3) of the centre [m/s]
    omega_world: Array  # (n, 3) [rad/s]
    acceleration: Array  # (n, 3) [m/s^2]
    alpha_world: Array  # (n, 3) d omega / dt [rad/s^2]

    @property
    def sine(self) -> Array:
        """(n,) sin theta."""
        return np.hypot(self.R_world_body[:, 0, 2], self.R_world_body[:, 1, 2])

    def axes(self) -> tuple[Array, Array, Array]:
        """e1, e2, e3 in world axes, (n, 3) each; e1 and e2 are NaN at theta = 0."""
        e3 = self.R_world_body[..., 2]
        s, c = self.sine, e3[:, 2]
        psi = np.where(s > 0, np.arctan2(e3[:, 0], -e3[:, 1]), np.nan)
        e1, e2, _ = frames.nodal_axes_world(psi, np.arctan2(s, c))
        return e1, e2, e3

    def displaced(self, step: Array) -> "MotionState":
        """The state after a small change (18,) in the order of STATE."""
        shift, turn, *changes = step.reshape(6, 3)
        rates = (self.velocity, self.omega_world, self.acceleration, self.alpha_world)
        changed = (rate + change for rate, change in zip(rates, changes, strict=True))
        return MotionState(self.position + shift, frames.rotation_from_vector(turn) @ self.R_world_body, *changed)


@dataclass(frozen=True, repr=False)
class MeasuredMotion(MotionState):
    """Pose and its first two derivatives in every frame; NaN if the samples do not determine them."""

    time: Array  # (n,) [s]
    covariance: Array  # (n, 18, 18) in the order of STATE, from the noise of the poses; rotation as in frames.py
    calibration_sensitivity: Array  # (n, 18, 30) d STATE / d RIG_PARAMETERS, common to all frames
    measured: Mask  # (n,) False if the frame was bridged
    euler: Array  # (n, 3) psi, theta, phi [rad], unwrapped
    length: Array  # (n, 4) length scale l of the process per group [s]
    noise_scale: Array  # (4,) estimated over stated variance of the noise, per group
    disc: Disc
    gravity: float  # [m/s^2]
    rig_covariance: Array  # (30, 30)
    systematic_covariance: Array  # (n, 6, 6) of the pose: correlated errors that are neither noise nor of the rig
    systematic_pace: float  # [1/s] rate of their change: speed of the dots in the image over SYSTEMATIC_LENGTH

    def __len__(self) -> int:
        return len(self.time)

    @property
    def tilt_sigma(self) -> Array:
        """(n,) [rad] noise of the rotation about an axis, mean of the three."""
        return np.sqrt(np.trace(self.covariance[:, 3:6, 3:6], axis1=1, axis2=2) / 3)

    @property
    def known(self) -> Mask:
        """(n,) True if the motion is determined."""
        return np.asarray(np.isfinite(self.omega_world).all(axis=1))

    def shared_covariance(self, rows: Indices) -> Array:
        """(f, 18, 18) covariance of STATE by the rig, common to all frames, and by other systematic errors."""
        S = self.calibration_sensitivity[rows]
        return np.asarray(S @ self.rig_covariance @ S.swapaxes(1, 2) + self.systematic_at(rows))

    def systematic_at(self, rows: Indices) -> Array:
        """(f, 18, 18) covariance of STATE by systematic errors, stationary with a squared-exponential covariance.

        With their pace w: S of the pose, w^2 S of its rate, 3 w^4 S of its second derivative, -w^2 S between both.
        """
        S, w2 = self.systematic_covariance[rows], self.systematic_pace**2
        C = np.zeros((len(rows), N_STATE, N_STATE))
        for first, second, factor in ((0, 0, 1.0), (6, 6, w2), (12, 12, 3 * w2**2), (0, 12, -w2), (12, 0, -w2)):
            C[:, first : first + 6, second : second + 6] = factor * S
        turned = np.broadcast_to(np.eye(N_STATE), C.shape).copy()
        _rates_of_turned_frame(turned, self.omega_world[rows], self.alpha_world[rows])
        return np.asarray(turned @ C @ turned.swapaxes(1, 2))


@checked
def differentiate(trajectory: Trajectory, breaks: Sequence[float] = ()) -> MeasuredMotion:
    """Velocities and accelerations of a measured trajectory.

    breaks : instants [s] at which the acceleration jumps (end of slip, impact); both sides are differentiated
    separately, with the larger sigmas of ends. A break with fewer than MIN_FRAMES poses on a side is ignored.
    Raises AnalysisError if too few frames have a pose, or time does not increase.

        >>> motion = differentiate("clip/results/trajectory.h5")
        >>> motion.velocity.shape
        (300, 3)
    """
    time = np.asarray(trajectory.time, float)
    good = trajectory.measured & np.isfinite(trajectory.pose_covariance).all(axis=(1, 2))
    _require_samples(time, good)
    pieces = _between(breaks, time, good)
    found = (_differentiated(part(trajectory, rows), good[rows]) for rows in pieces)
    *of_frames, scales = zip(*found, strict=True)
    state, R, euler, covariance, sensitivity, length = map(np.concatenate, of_frames)
    return MeasuredMotion(
        position=state[:, 0, :3],
        R_world_body=R,
        velocity=state[:, 1, :3],
        omega_world=state[:, 1, 3:],
        acceleration=state[:, 2, :3],
        alpha_world=state[:, 2, 3:],
        time=time,
        covariance=covariance,
        calibration_sensitivity=sensitivity,
        measured=good,
        euler=euler,
        length=length,
        noise_scale=np.average(scales, axis=0, weights=[(rows.stop - rows.start) / len(time) for rows in pieces]),
        disc=trajectory.disc,
        gravity=trajectory.gravity,
        rig_covariance=trajectory.rig.covariance,
        systematic_covariance=_filled(trajectory.systematic_covariance, good, 0.0),
        systematic_pace=_pace(trajectory),
    )


def _between(breaks: Sequence[float], time: Array, good: Mask) -> list[slice]:
    """The rows between the breaks that have enough poses on both sides."""
    starts = [0]
    for row in np.searchsorted(time, sorted(breaks)):
        if min(good[starts[-1] : row].sum(), good[row:].sum()) >= MIN_FRAMES:
            starts.append(int(row))
    return [slice(*ends) for ends in pairwise([*starts, len(time)])]


def _differentiated(trajectory: Trajectory, good: Mask) -> tuple[Array, ...]:
    """Without breaks: state (n, 3 orders, 6), R, Euler angles, covariance, sensitivity, length, noise scale.

    good : (n,) frames with a pose
    """
    samples = _Samples(trajectory, good)
    segments, centres = _segments(samples)
    groups = ([(t, d[channels], v[channels]) for t, d, v in segments] for channels in CHANNELS.values())
    processes = (fit_process(group, centres, len(good)) for group in groups)
    length, amplitude2, noise_scale = map(np.array, zip(*processes, strict=True))  # (4, n), (4, n), (4,)
    scale = np.sqrt(np.repeat(noise_scale, [len(channels) for channels in CHANNELS.values()]))
    samples.covariance *= np.outer(scale, scale)
    # in parts, to limit the memory for the windows
    parts = np.split(np.arange(len(good)), range(SEGMENT, len(good), SEGMENT))
    found = (_smoothed(samples, length, amplitude2, rows) for rows in parts)
    state, R, covariance, sensitivity = map(np.concatenate, zip(*found, strict=True))
    per_order = samples.interval ** -np.arange(3.0)
    state *= per_order[:, None]
    scale = np.repeat(per_order, 6)
    covariance *= np.outer(scale, scale)
    sensitivity *= scale[:, None]
    _rates_of_turned_frame(sensitivity, state[:, 1, 3:], state[:, 2, 3:])
    euler = _euler_near(R, trajectory.q[:, 3:])
    return state, R, euler, covariance, sensitivity, length.T * samples.interval, noise_scale


def _filled(matrices: Array, good: Mask, otherwise: float) -> Array:
    """(n, k, l) with missing matrices replaced by those of the nearest good frame, or by a number if there is none."""
    known = np.flatnonzero(good & np.isfinite(matrices).all(axis=(1, 2)))
    if not known.size:
        return np.full_like(matrices, otherwise)
    nearest = np.rint(np.interp(np.arange(len(good)), known, np.arange(len(known))))
    return np.asarray(matrices[known[nearest.astype(int)]])


def _pace(trajectory: Trajectory) -> float:
    """[1/s] rate of change of errors that depend on the position in the image: rms of all dots and frames."""
    with np.errstate(invalid="ignore"):
        step = np.diff(trajectory.markers_px, axis=0) / np.diff(trajectory.time)[:, None, None, None]
    if not np.isfinite(step).any():
        return 0.0
    length = SYSTEMATIC_LENGTH * max(max(camera.image_size) for camera in trajectory.rig.cameras)
    return float(np.sqrt(2 * np.nanmean(step**2))) / length


class _Samples:
    """Poses to be differentiated; time in frame intervals."""

    def __init__(self, trajectory: Trajectory, good: Mask) -> None:
        """Good : (n,) frames with a pose; in gaps, rotations of the nearest frame are placeholders without weight."""
        time = np.asarray(trajectory.time, float)
        self.interval = float(np.median(np.diff(time)))  # [s]
        self.ticks = (time - time[0]) / self.interval
        self.good = good
        self.position = np.where(good[:, None], trajectory.q[:, :3], 0.0)
        self.R = _filled(frames.rotation_from_quaternion(trajectory.quaternion), good, np.nan)
        self.covariance = np.where(good[:, None, None], trajectory.pose_covariance, 0.0)
        # a pose from one camera depends differently on the rig; that jump must not be differentiated
        by_both = good & (trajectory.frame_status == FrameStatus.MEASURED)
        self.sensitivity = _filled(trajectory.calibration_sensitivity, by_both, np.nan)


def _require_samples(time: Array, good: Mask) -> None:
    if good.sum() < MIN_FRAMES:
        raise AnalysisError(
            f"only {int(good.sum())} of {len(good)} frames have a pose, but at least {MIN_FRAMES} are needed to tell "
            "motion from noise: track more frames, or look at frame_status for why the poses are missing."
        )
    backwards = np.flatnonzero(~(np.diff(time) > 0))
    if backwards.size:
        raise AnalysisError(
            f"time does not increase from frame {backwards[0]} to {backwards[0] + 1} "
            f"({time[backwards[0]]} s to {time[backwards[0] + 1]} s): sort the frames, or correct the frame rate."
        )


def _segments(samples: _Samples) -> tuple[list[tuple[Array, Array, Array]], Array]:
    """Overlapping segments (times, data, variance), and their centres."""
    n = len(samples.ticks)
    starts = np.arange(0, max(1, n - SEGMENT // 2), SEGMENT // 2)
    segments, centres = [], []
    for start in starts:
        stop = n if start == starts[-1] else start + SEGMENT
        used = start + np.flatnonzero(samples.good[start:stop])
        if len(used) < MIN_FRAMES:
            continue
        s, gain = _sine_vectors(samples.R[used], samples.R[used[len(used) // 2]])
        data = np.concatenate([samples.position[used], s], axis=1).T
        noise = gain @ samples.covariance[used] @ gain.swapaxes(1, 2)
        segments.append((samples.ticks[used] - samples.ticks[used[0]], data, np.diagonal(noise, axis1=1, axis2=2).T))
        centres.append((start + stop) / 2)
    if not segments:
        raise AnalysisError(
            f"nowhere do {MIN_FRAMES} of {SEGMENT} neighbouring frames have a pose: the motion between them is not "
            "known. Track the recording again with better exposure, or look at frame_status for the reasons."
        )
    return segments, np.array(centres)


def _sine_vectors(R: Array, R_reference: Array) -> tuple[Array, Array]:
    """Antisymmetric part of M = R R_reference^T as a vector (..., 3), sin(angle) times the axis; and its gain.

    A rotation error e (R' = exp(e) R) enters as (tr(M) I - M) e / 2; the gain (..., 6, 6) has this block for the
    rotation and the identity for the position.
    """
    M = R @ np.swapaxes(R_reference, -1, -2)
    s = 0.5 * np.stack([M[..., 2, 1] - M[..., 1, 2], M[..., 0, 2] - M[..., 2, 0], M[..., 1, 0] - M[..., 0, 1]], -1)
    gain = np.zeros((*M.shape[:-2], 6, 6))
    gain[..., [0, 1, 2], [0, 1, 2]] = 1.0
    gain[..., 3:, 3:] = 0.5 * (np.trace(M, axis1=-2, axis2=-1)[..., None, None] * np.eye(3) - M)
    return s, gain


def _smoothed(samples: _Samples, length: Array, amplitude2: Array, rows: Indices) -> tuple[Array, Array, Array, Array]:
    """Some frames: state (k, 3 orders, 6), R (k, 3, 3), covariance (k, 18, 18), sensitivity (k, 18, 30), per interval.

    From weights (k, 6, 3, w) of the samples in their windows; the remaining prior covariance (k, 6, 3, 3) is added. NaN
    in a gap if this exceeds KNOWN_FRACTION of the prior variance of the slope.
    length, amplitude2 : (4, n) of the groups' processes
    """
    k, half = len(rows), int(np.ceil(HALF_WINDOW_LENGTHS * length.max()))
    weights, prior = np.zeros((k, 6, 3, 2 * half + 1)), np.zeros((k, 6, 3, 3))
    unknown = np.zeros(k, bool)
    variance = np.where(samples.good[:, None], np.diagonal(samples.covariance, axis1=1, axis2=2), np.inf)
    for channels, own, A2 in zip(CHANNELS.values(), length, amplitude2, strict=True):
        W, P = moving_weights(samples.ticks, variance[:, channels].mean(axis=1), own, A2, half, rows)
        weights[:, channels], prior[:, channels] = W[:, None], P[:, None]
        open_fraction = P[:, 1, 1] * own[rows] ** 2 / A2[rows]
        unknown |= ~np.isfinite(open_fraction) | (~samples.good[rows] & (open_fraction > KNOWN_FRACTION))
    window = np.clip(rows[:, None] + np.arange(-half, half + 1), 0, len(samples.ticks) - 1)
    R = samples.R[rows]
    for _ in range(2):  # the second time relative to the smoothed pose, at which s is the rotation vector
        s, _ = _sine_vectors(samples.R[window], R[:, None])
        R = frames.rotation_from_vector(np.einsum("kcw,kwc->kc", weights[:, 3:, 0], s)) @ R
    s, gain = _sine_vectors(samples.R[window], R[:, None])
    noise_window = gain @ samples.covariance[window] @ gain.swapaxes(-1, -2)
    data = np.concatenate([samples.position[window], s], axis=-1)
    state = np.einsum("kcow,kwc->koc", weights, data)
    covariance = np.empty((k, 3, 6, 3, 6))  # order and channel, as STATE
    for c in range(6):
        for d in range(c, 6):
            block = (weights[:, c] * noise_window[..., c, d][:, None]) @ weights[:, d].swapaxes(1, 2)
            covariance[:, :, c, :, d] = block
            covariance[:, :, d, :, c] = block.swapaxes(1, 2)
        covariance[:, :, c, :, c] += prior[:, c]
    sensitivity = np.stack([weights[:, c] @ samples.sensitivity[window, c] for c in range(6)], axis=2)
    found = state, R, covariance.reshape(-1, 18, 18), sensitivity.reshape(k, 18, -1)
    for values in found:
        values[unknown] = np.nan
    return found


def _rates_of_turned_frame(sensitivity: Array, omega_world: Array, alpha_world: Array) -> None:
    """Complete d omega and d alpha, in place, for a rotation error delta(t) of the frame: R' = exp(delta) R.

    omega' = omega + delta' + delta x omega,  alpha' = alpha + delta'' + delta' x omega + delta x alpha.
    """
    turn, rate = sensitivity[:, 3:6].copy(), sensitivity[:, 9:12].copy()
    omega, alpha = frames.skew(omega_world), frames.skew(alpha_world)
    sensitivity[:, 9:12] -= omega @ turn
    sensitivity[:, 15:18] -= omega @ rate + alpha @ turn


def _euler_near(R: Array, reference: Array) -> Array:
    """Unwrapped psi, theta, phi (n, 3) on the branch of the first measured reference angles."""
    euler = frames.unwrap_euler(frames.euler_from_rotation(R))
    both = np.flatnonzero(np.isfinite(euler).all(axis=1) & np.isfinite(reference).all(axis=1))
    if both.size:
        turns = np.round((reference[both[0]] - euler[both[0]]) / (2 * np.pi))
        euler = euler + 2 * np.pi * np.array([turns[0], 0.0, turns[2]])
    return euler
