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
from disctrack.analyse.derivatives import FRAMES_AT_ONCE, N_STATE, MeasuredMotion, MotionState

# Steps of central differences in the order of STATE: far above round-off, far below the scale on which the derived
# quantities bend (sin theta of a disc at rest on its patch is 1e-2). They are quadratic at most in the rates.
STEPS = np.repeat([1e-6, 1e-6, 1e-4, 1e-3, 1e-2, 1.0], 3)
SIGMAS = 5.0  # of its own, below which a number is not told from zero; of theta, the direction of precession neither


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
        return self.covariance_at(np.arange(len(self.value)))

    def covariance_at(self, frames: NDArray[np.int64], columns: slice = slice(None), shared: bool = False) -> Array:
        """(f, c, c) of some values in some frames: noise, or what all share: of the rig, and what else repeats."""
        motion = self.motion

        def some(rows: NDArray[np.int64]) -> Array:
            J = self.jacobian[rows][:, columns]
            if not shared:
                return np.asarray(J @ motion.covariance[rows] @ J.swapaxes(1, 2))
            S = J @ motion.calibration_sensitivity[rows]
            by_rig = S @ motion.rig_covariance @ S.swapaxes(1, 2)
            return np.asarray(by_rig + J @ motion.systematic_at(rows) @ J.swapaxes(1, 2))

        return _by_parts(some, frames)

    def series(self, names: Sequence[tuple[str, str, str]]) -> tuple[DerivedSeries, ...]:
        """The columns one by one; names are (name, unit, long_name)."""

        def variances(rows: NDArray[np.int64]) -> Array:
            both = [self.covariance_at(rows, shared=shared) for shared in (False, True)]
            return np.stack([np.diagonal(C, axis1=1, axis2=2) for C in both], axis=1)

        sigmas = np.sqrt(np.maximum(_by_parts(variances, np.arange(len(self.value))), 0.0))
        return tuple(
            DerivedSeries(*name, self.value[:, i], sigmas[:, 0, i], sigmas[:, 1, i]) for i, name in enumerate(names)
        )


def _by_parts(function: Callable[[NDArray[np.int64]], Array], frames: NDArray[np.int64]) -> Array:
    """A function of frames, some at a time: what it needs on the way may be larger than its result."""
    parts = [function(frames[i : i + FRAMES_AT_ONCE]) for i in range(0, max(len(frames), 1), FRAMES_AT_ONCE)]
    return np.concatenate(parts)


def propagate(motion: MeasuredMotion, function: Callable[[MotionState], Array]) -> Propagated:
    """Values (n, k) of a function of the state, with noise and calibration carried through its derivative.

    NaN where the motion is unknown, and where theta is so small against its own sigma that e1 has no direction.
    """
    resolved = motion.sine > SIGMAS * motion.tilt_sigma

    def some(rows: NDArray[np.int64]) -> Array:
        columns = []
        for step in np.diag(STEPS):
            up, down = (function(motion.displaced(sign * step, rows)) for sign in (1, -1))
            columns.append((up - down) / (2 * step.sum()))
        jacobian = np.stack(columns, axis=-1)  # (f, k, 18)
        value = np.where(resolved[rows, None], function(motion.displaced(np.zeros(N_STATE), rows)), np.nan)
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
