"""Rates, contact, forces and energy of a motion, each with two uncertainties.

A is the lowest point of the lower edge, r_OA = -r e2 - h e3. Components are along n0 = e1, m0 = k x n0 and k.
Departures from the equations as printed in Ma et al. 2014: the first line of (2.3) is the n0 component and its second
the m0 component (the labels are exchanged), and its third line has r thetadot cos theta, because z = r sin theta + h
cos theta; (2.10) has its datum at rest, m g (z - h) instead of m g z, as a power law in the time to collapse requires.

Noise is independent between frames and averages out. The error of the calibration is common to all frames, and other
systematic errors (`MeasuredMotion.systematic_at`) change slowly with the motion: they do not average out. Every derived
quantity has both uncertainties separately.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Annotated

import numpy as np

from calibration.kit.brief import Brief
from calibration.kit.types import Array, Indices
from disctrack.analyse.derivatives import K, MeasuredMotion, MotionState
from disctrack.disc import Disc, precession_rate
from disctrack.errors import ModelError

# Steps of central differences in the order of STATE: far above round-off, far below the scale of the curvature of the
# derived quantities (sin theta of a disc at rest on its patch is 1e-2). These are at most quadratic in the rates.
STEPS = np.repeat([1e-6, 1e-6, 1e-4, 1e-3, 1e-2, 1.0], 3)
SIGMAS = 5.0  # standard deviations from zero of a significant number; with a smaller theta, e1 is undetermined
# By group of the file: name, unit, meaning; in the order of `quantities`
QUANTITIES = {
    "motion": (
        ("psidot", "rad s-1", "precession rate"),
        ("thetadot", "rad s-1", "nutation rate"),
        ("phidot", "rad s-1", "spin rate relative to the nodal frame"),
        ("omega_1", "rad s-1", "angular velocity along e1, horizontal"),
        ("omega_2", "rad s-1", "angular velocity along e2, from the contact through the centre"),
        ("omega_3", "rad s-1", "angular velocity along e3, the axis of the disc"),
        ("omega_z", "rad s-1", "angular velocity along the vertical"),
    ),
    "contact": (
        ("contact_x", "m", "contact point, x"),
        ("contact_y", "m", "contact point, y"),
        ("contact_z", "m", "lowest point of the edge above the table"),
        ("slip_n", "m s-1", "velocity of the material point at the contact along n0 = e1"),
        ("slip_m", "m s-1", "velocity of the material point at the contact along m0 = k x n0"),
        ("slip_z", "m s-1", "velocity of the material point at the contact, upwards"),
        ("locus_n", "m s-1", "velocity of the point of touch along n0"),
        ("locus_m", "m s-1", "velocity of the point of touch along m0"),
        ("force_n", "N", "contact force along n0"),
        ("force_m", "N", "contact force along m0"),
        ("force_z", "N", "normal contact force"),
        ("friction_needed", "1", "horizontal over normal contact force"),
    ),
    "energy": (
        ("translation", "J", "kinetic energy of the centre"),
        ("rotation_1", "J", "kinetic energy of the rotation about e1"),
        ("rotation_2", "J", "kinetic energy of the rotation about e2"),
        ("rotation_3", "J", "kinetic energy of the rotation about e3"),
        ("potential", "J", "potential energy, zero at rest (z = h)"),
        ("total", "J", "mechanical energy, zero at rest"),
        ("power", "W", "rate of change of the mechanical energy"),
        ("adiabatic", "J", "3/2 m g r sin theta, the energy of slow steady precession of a thin disc"),
        ("precession_level", "s-2", "psidot^2 sin theta; 4 g / r in slow steady precession of a thin disc"),
    ),
}
ALL = tuple(row for rows in QUANTITIES.values() for row in rows)
COLUMN = {name: i for i, (name, *_) in enumerate(ALL)}


def from_to(first: str, last: str) -> slice:
    """Columns of neighbouring quantities."""
    return slice(COLUMN[first], COLUMN[last] + 1)


def quantities(state: MotionState, disc: Disc, gravity: float) -> Array:
    """All of QUANTITIES (n, 28); Euler rates are from omega.

    slip : of the material point at the contact, v_O + omega x r_OA, eq. (2.3); locus : of the moving point of touch,
    v_O + Omega_R x r_OA, where Omega_R = thetadot e1 + psidot k is the angular velocity of the nodal frame
    force : of the table, from Newton's law without other forces, eq. (2.6)
    """
    m, J1, J3, s = disc.mass, disc.moment_diametral, disc.moment_axial, state.sine
    n0, e2, e3 = state.axes()
    r_OA, m0 = disc.arm_to_contact(e2, e3), np.cross(K, n0)
    omega = [np.sum(state.omega_world * e, axis=1) for e in (n0, e2, e3)]
    thetadot = omega[0]
    with np.errstate(divide="ignore", invalid="ignore"):
        psidot = omega[1] / s
    rates = psidot, thetadot, omega[2] - psidot * e3[:, 2], *omega, state.omega_world[:, 2]
    slip = state.velocity + np.cross(state.omega_world, r_OA)
    locus = state.velocity + np.cross(thetadot[:, None] * n0 + psidot[:, None] * K, r_OA)
    force = m * (state.acceleration + gravity * K)
    (slip_n, slip_m), (locus_n, locus_m), (force_n, force_m) = (
        [np.sum(vector * axis, axis=1) for axis in (n0, m0)] for vector in (slip, locus, force)
    )
    needed = np.where(force[:, 2] > 0, np.hypot(force_n, force_m) / np.abs(force[:, 2]), np.nan)
    contact = *(state.position + r_OA).T, slip_n, slip_m, slip[:, 2], locus_n, locus_m, *(force_n, force_m, force[:, 2])
    translation = 0.5 * m * np.sum(state.velocity**2, axis=1)
    rotation = [0.5 * J * w**2 for J, w in zip((J1, J1, J3), omega, strict=True)]
    potential = m * gravity * (state.position[:, 2] - disc.half_thickness)
    # omega . d(J omega)/dt = omega . J alpha, since omega . (omega x J omega) = 0
    power = m * np.sum(state.velocity * (state.acceleration + gravity * K), axis=1)
    power = power + np.sum(state.omega_world * disc.times_inertia(state.alpha_world, e3), axis=1)
    total = translation + rotation[0] + rotation[1] + rotation[2] + potential
    adiabatic, level = 1.5 * m * gravity * disc.radius * s, psidot**2 * s
    energy = translation, *rotation, potential, total, power, adiabatic, level
    return np.column_stack([*rates, *contact, needed, *energy])


@dataclass(frozen=True, repr=False)
class DerivedSeries(Brief):
    """One derived quantity over the recording."""

    name: str
    unit: str
    long_name: str
    value: Array  # (n,)
    sigma: Array  # (n,) from the noise of the poses
    sigma_calibration: Array  # (n,) from the rig, common to all frames, and other systematic errors


@dataclass(frozen=True)
class Propagated:
    """Values with their covariance from noise and calibration.

    Only the derivatives are stored; covariances, several times as large, are computed on demand.
    """

    value: Array  # (n, k)
    jacobian: Array  # (n, k, 18) d value / d STATE
    motion: MeasuredMotion

    def covariance(self, frames: Indices, columns: slice = slice(None), shared: bool = False) -> Array:
        """(f, c, c) of some values in some frames by noise, or, if `shared`, by the rig and other systematic errors."""
        motion, J = self.motion, self.jacobian[frames][:, columns]
        C = motion.shared_covariance(frames) if shared else motion.covariance[frames]
        return np.asarray(J @ C @ J.swapaxes(1, 2))

    def series(self, names: Sequence[tuple[str, str, str]]) -> tuple[DerivedSeries, ...]:
        """The columns as series; names are (name, unit, long_name)."""
        motion, J = self.motion, self.jacobian
        both = motion.covariance, motion.shared_covariance(np.arange(len(motion)))
        sigma, common = (np.sqrt(np.maximum(np.sum(J @ C * J, axis=-1), 0.0)) for C in both)
        columns = zip(self.value.T, sigma.T, common.T, strict=True)
        return tuple(DerivedSeries(*name, *column) for name, column in zip(names, columns, strict=True))


def propagate(motion: MeasuredMotion) -> Propagated:
    """All of QUANTITIES (n, 28), with first-order propagation of noise and calibration.

    NaN if the motion is unknown, or theta is below SIGMAS of its standard deviation, so that e1 is undetermined.
    """
    resolved, columns = motion.sine > SIGMAS * motion.tilt_sigma, []
    for step in np.diag(STEPS):
        up, down = (quantities(motion.displaced(sign * step), motion.disc, motion.gravity) for sign in (1, -1))
        columns.append((up - down) / (2 * step.sum()))
    jacobian = np.stack(columns, axis=-1)  # (n, k, 18)
    value = np.where(resolved[:, None], quantities(motion, motion.disc, motion.gravity), np.nan)
    jacobian[~np.isfinite(value)] = np.nan
    return Propagated(value, jacobian, motion)


TOTAL, LEVEL = COLUMN["total"], COLUMN["precession_level"]


@dataclass(frozen=True, repr=False)
class Energy(Brief):
    """Energy of a recording."""

    loss: Annotated[float, "loss_J"]  # [J] from the first to the last known frame, positive for a loss
    loss_sigma: Annotated[float, "loss_sigma_J"]  # [J] noise
    # [J]; most of the calibration's error is common to both ends and cancels
    loss_sigma_calibration: Annotated[float, "loss_sigma_calibration_J"]
    # psidot^2 sin theta over 4 g / r, mean over the turns of precession
    level_ratio: Annotated[float, "precession_level_over_4g_r"]
    level_ratio_sigma: Annotated[float, "precession_level_over_4g_r_sigma"]  # from the scatter of its means per turn
    # of steady precession of this disc with its centre at rest, at the median theta
    level_ratio_steady: Annotated[float, "precession_level_over_4g_r_steady"]


def energy_of(found: Propagated) -> Energy:
    """Loss over the recording with both uncertainties, and the adiabatic level."""
    motion, known = found.motion, np.isfinite(found.value[:, LEVEL])
    try:
        typical = float(np.median(motion.euler[known, 1])) if known.any() else float("nan")
        steady = precession_rate(typical, motion.disc, motion.gravity)[0] ** 2 * np.sin(typical)
    except ModelError:  # no steady precession of a nearly upright disc with its centre at rest
        steady = float("nan")
    over = 4 * motion.gravity / motion.disc.radius
    ratios = _level_ratio(motion, found.value[:, LEVEL] / over)
    return Energy(*_loss(found), *ratios, float(steady / over))


def _loss(found: Propagated) -> tuple[float, float, float]:
    """Energy lost between the first and the last known frame, with its two sigmas [J]."""
    known, column = np.flatnonzero(np.isfinite(found.value[:, TOTAL])), slice(TOTAL, TOTAL + 1)
    if known.size < 2:
        return (float("nan"),) * 3
    ends, motion = known[[0, -1]], found.motion
    J = found.jacobian[ends, TOTAL]
    before, after = np.einsum("ns,nsr->nr", J, motion.calibration_sensitivity[ends])
    common = (after - before) @ motion.rig_covariance @ (after - before)
    common += np.einsum("ns,nst,nt->", J, motion.systematic_at(ends), J)
    noise = found.covariance(ends, column).sum()
    first, last = found.value[ends, TOTAL]
    return float(first - last), float(np.sqrt(noise)), float(np.sqrt(max(0.0, common)))


def _level_ratio(motion: MeasuredMotion, ratio: Array) -> tuple[float, float]:
    """Mean of a ratio (n,) with equal weights of the turns of precession, and its standard error from their means."""
    known = np.flatnonzero(np.isfinite(ratio))
    if known.size < 2:
        return float("nan"), float("nan")
    ratio = ratio[known]
    turns = np.floor((motion.euler[known, 0] - motion.euler[known[0], 0]) / (2 * np.pi)).astype(int)
    means = np.array([ratio[turns == turn].mean() for turn in np.unique(turns)])
    if len(means) < 2:
        return float(ratio.mean()), float(ratio.std())
    return float(means.mean()), float(means.std(ddof=1) / np.sqrt(len(means)))
