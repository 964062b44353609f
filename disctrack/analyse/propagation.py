"""Quantities derived from a motion, with two uncertainties that must not be mixed.

Noise differs from frame to frame; the calibration's error is one and the same in all frames, and what else repeats
(`MeasuredMotion.systematic_at`) changes with the motion only. The first averages out, the others do not: every derived
quantity carries the two apart.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from calibration.kit.arrays import Array
from calibration.kit.brief import Outline
from disctrack.analyse.derivatives import N_STATE, MeasuredMotion
from disctrack.frames import nodal_axes_world, rotation_from_vector

# Steps of central differences in the order of STATE: far above round-off, far below the scale on which the derived
# quantities bend (sin theta of a disc at rest on its patch is 1e-2). They are quadratic at most in the rates.
STEPS = np.repeat([1e-6, 1e-6, 1e-4, 1e-3, 1e-2, 1.0], 3)
FRAMES_AT_ONCE = 1024
RESOLVED_TILT_SIGMAS = 5.0  # below this many sigmas of theta, the direction of precession is not determined


@dataclass(frozen=True)
class MotionState:
    """Motion of the disc at n instants, world axes; see MeasuredMotion."""

    position: Array  # (n, 3)
    R_world_body: Array  # (n, 3, 3)
    velocity: Array  # (n, 3)
    omega_world: Array  # (n, 3)
    acceleration: Array  # (n, 3)
    alpha_world: Array  # (n, 3)

    @property
    def sine(self) -> Array:
        """(n,) sin theta."""
        return np.hypot(self.R_world_body[:, 0, 2], self.R_world_body[:, 1, 2])

    def axes(self) -> tuple[Array, Array, Array]:
        """e1, e2, e3 in world axes, (n, 3) each; e1 and e2 are NaN at theta = 0."""
        e3 = self.R_world_body[..., 2]
        s, c = self.sine, e3[:, 2]
        psi = np.where(s > 0, np.arctan2(e3[:, 0], -e3[:, 1]), np.nan)
        e1, e2, _ = nodal_axes_world(psi, np.arctan2(s, c))
        return e1, e2, e3


@dataclass(frozen=True, repr=False)
class DerivedSeries(Outline):
    """One derived quantity over the recording."""

    name: str
    unit: str
    long_name: str
    value: Array  # (n,)
    sigma: Array  # (n,) from the noise of the poses
    sigma_calibration: Array  # (n,) from the rig, common to all frames, and from what else repeats


@dataclass(frozen=True)
class Propagated:
    """Values with the covariance that noise and calibration give them.

    Kept is their derivative; covariances, several times as large, are made for the frames that are asked for.
    """

    value: Array  # (n, k)
    jacobian: Array  # (n, k, 18) d value / d STATE
    motion: MeasuredMotion

    @property
    def covariance(self) -> Array:
        """(n, k, k) noise."""
        return self.covariance_at(np.arange(len(self.value)), slice(None))

    @property
    def rig_covariance(self) -> Array:
        """(30, 30) of RIG_PARAMETERS."""
        return self.motion.rig_covariance

    def covariance_at(self, frames: NDArray[np.int64], columns: slice) -> Array:
        """(f, c, c) noise of some values in some frames."""

        def some(rows: NDArray[np.int64]) -> Array:
            J = self.jacobian[rows][:, columns]
            return np.asarray(J @ self.motion.covariance[rows] @ J.swapaxes(1, 2))

        return _by_parts(some, frames)

    def sensitivity_at(self, frames: NDArray[np.int64], columns: slice) -> Array:
        """(f, c, 30) d value / d RIG_PARAMETERS of some values in some frames."""
        return _by_parts(
            lambda rows: self.jacobian[rows][:, columns] @ self.motion.calibration_sensitivity[rows], frames
        )

    def calibration_covariance_at(self, frames: NDArray[np.int64], columns: slice) -> Array:
        """(f, c, c) from the rig and from what else repeats, of some values in some frames."""

        def some(rows: NDArray[np.int64]) -> Array:
            S = self.sensitivity_at(rows, columns)
            return np.asarray(S @ self.rig_covariance @ S.swapaxes(1, 2)) + self.systematic_covariance_at(rows, columns)

        return _by_parts(some, frames)

    def systematic_covariance_at(self, frames: NDArray[np.int64], columns: slice) -> Array:
        """(f, c, c) from what repeats and is not the rig's, of some values in some frames."""

        def some(rows: NDArray[np.int64]) -> Array:
            J = self.jacobian[rows][:, columns]
            return np.asarray(J @ self.motion.systematic_at(rows) @ J.swapaxes(1, 2))

        return _by_parts(some, frames)

    def series(self, names: Sequence[tuple[str, str, str]]) -> tuple[DerivedSeries, ...]:
        """The columns one by one; names are (name, unit, long_name)."""
        frames, all_columns = np.arange(len(self.value)), slice(None)

        def sigmas(rows: NDArray[np.int64]) -> Array:
            noise = np.diagonal(self.covariance_at(rows, all_columns), axis1=1, axis2=2)
            return np.stack([np.sqrt(noise), shared_sigma(self.motion, self.jacobian[rows], rows)], 1)

        both = _by_parts(sigmas, frames)
        return tuple(
            DerivedSeries(name, unit, text, self.value[:, i], both[:, 0, i], both[:, 1, i])
            for i, (name, unit, text) in enumerate(names)
        )


def shared_sigma(motion: MeasuredMotion, jacobian: Array, frames: NDArray[np.int64] | None = None) -> Array:
    """Standard deviations (f, k) of quantities of derivative (f, k, 18) by STATE, from all that does not average out.

    frames : (f,) that the derivatives belong to; all without
    """
    frames = np.arange(len(motion)) if frames is None else frames

    def some(part: NDArray[np.int64]) -> Array:
        J, rows = jacobian[part], frames[part]
        S = J @ motion.calibration_sensitivity[rows]
        rig = np.sum((S @ motion.rig_covariance) * S, axis=2)
        return np.asarray(np.sqrt(np.maximum(rig + np.sum((J @ motion.systematic_at(rows)) * J, axis=2), 0.0)))

    return _by_parts(some, np.arange(len(frames)))


def _by_parts(function: Callable[[NDArray[np.int64]], Array], frames: NDArray[np.int64]) -> Array:
    """A function of frames, some at a time: what it needs on the way may be larger than its result."""
    parts = [function(frames[i : i + FRAMES_AT_ONCE]) for i in range(0, max(len(frames), 1), FRAMES_AT_ONCE)]
    return np.concatenate(parts)


def state_of(motion: MeasuredMotion) -> MotionState:
    """The motion without its uncertainty."""
    return MotionState(
        motion.position,
        motion.R_world_body,
        motion.velocity,
        motion.omega_world,
        motion.acceleration,
        motion.alpha_world,
    )


def displaced(state: MotionState, step: Array) -> MotionState:
    """The state after a small change (18,) or (n, 18) in the order of derivatives.STATE."""
    d = np.broadcast_to(step, (len(state.position), N_STATE))
    return MotionState(
        state.position + d[:, 0:3],
        rotation_from_vector(d[:, 3:6]) @ state.R_world_body,
        state.velocity + d[:, 6:9],
        state.omega_world + d[:, 9:12],
        state.acceleration + d[:, 12:15],
        state.alpha_world + d[:, 15:18],
    )


def propagate(motion: MeasuredMotion, function: Callable[[MotionState], Array]) -> Propagated:
    """Values (n, k) of a function of the state, with noise and calibration carried through its derivative.

    NaN where the motion is unknown, and where theta is so small against its own sigma that e1 has no direction.
    """
    whole = state_of(motion)

    def some(rows: NDArray[np.int64]) -> Array:
        state = MotionState(*(part[rows] for part in vars(whole).values()))
        jacobian = np.stack(
            [(function(displaced(state, e)) - function(displaced(state, -e))) / (2 * e.sum()) for e in np.diag(STEPS)],
            axis=-1,
        )  # (f, k, 18)
        value = function(state)
        tilt_sigma = np.sqrt(np.trace(motion.covariance[rows, 3:6, 3:6], axis1=1, axis2=2) / 3)
        value = np.where((state.sine > RESOLVED_TILT_SIGMAS * tilt_sigma)[:, None], value, np.nan)
        jacobian[~np.isfinite(value)] = np.nan
        return np.concatenate([value[..., None], jacobian], axis=-1)

    both = _by_parts(some, np.arange(len(motion)))
    return Propagated(both[..., 0], both[..., 1:], motion)


RATES = (
    ("psidot", "rad s-1", "precession rate"),
    ("thetadot", "rad s-1", "nutation rate"),
    ("phidot", "rad s-1", "spin rate relative to the nodal frame"),
    ("omega_1", "rad s-1", "angular velocity along e1, horizontal"),
    ("omega_2", "rad s-1", "angular velocity along e2, from the contact through the centre"),
    ("omega_3", "rad s-1", "angular velocity along e3, the axis of the disc"),
    ("omega_z", "rad s-1", "angular velocity along the vertical"),
)


def rates(state: MotionState) -> Array:
    """Euler rates and components of the angular velocity, (n, 7) in the order of RATES, from omega itself."""
    e1, e2, e3 = state.axes()
    omega_1, omega_2, omega_3 = (np.sum(state.omega_world * e, axis=1) for e in (e1, e2, e3))
    with np.errstate(divide="ignore", invalid="ignore"):
        psidot = omega_2 / state.sine
    phidot = omega_3 - psidot * e3[:, 2]
    return np.stack([psidot, omega_1, phidot, omega_1, omega_2, omega_3, state.omega_world[:, 2]], axis=1)
