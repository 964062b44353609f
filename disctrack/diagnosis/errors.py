"""How far a fitted model is from the measurement, in the units of an experimenter."""

from dataclasses import dataclass

import numpy as np
from scipy.integrate import trapezoid

from disctrack.diagnosis.disc_system import DiscSystem
from disctrack.diagnosis.motion import state_of
from disctrack.discrepancy.fit import Fit
from disctrack.discrepancy.held_out import HeldOut
from disctrack.discrepancy.significance import Whiteness, whiteness
from disctrack.discrepancy.system import Values
from disctrack.frames import euler_jacobian, nodal_axes_world
from disctrack.rolling import Motion, simulate
from disctrack.rolling.evaluate import effect_power, kinematics

HORIZONS = (0.1, 0.3, 0.5)  # [s] after the last frame that the fit has seen
HALF_WINDOW = 0.01  # [s] over which the error at a horizon is averaged: some frames, a fraction of a turn


@dataclass(frozen=True)
class Ahead:
    """Error of a free run at one instant ahead, and what the noise of the measurement alone would give."""

    horizon_s: float
    theta_deg: float
    psi_deg: float
    position_mm: float
    noise_theta_deg: float
    noise_psi_deg: float
    noise_position_mm: float


@dataclass(frozen=True)
class Errors:
    """Errors of one model against one measurement."""

    reduced_chi_square: float  # of the dots in all images
    reduced_chi_square_pose: float  # of the six numbers per frame that a pose can take
    rms_px: float  # per image coordinate
    rms_position_um: float  # rms of measured minus fitted position, per axis
    rms_theta_mdeg: float  # rms of measured minus fitted nutation angle
    ahead: tuple[Ahead, ...]
    ratio_to_floor: float  # free run: rms of the residual over what noise and the fit's own uncertainty allow
    whiteness: Whiteness


def errors(system: DiscSystem, fit_: Fit, held: HeldOut) -> Errors:
    """All errors of a fit, and of the free run after the shorter fit."""
    pixels = system.observed - system.pixels(fit_.values, with_nuisances=True)
    rms = float(np.sqrt(np.mean(pixels[system.used] ** 2)))
    pose = system.pose_residual(fit_.values)
    present = system.weights >= 6
    delta, _ = system.pose_difference(fit_.values)
    tilt = np.sum(nodal_axes_world(*system.poses(fit_.values)[:, 3:5].T)[0] * delta[:, 3:], axis=1)
    # of the fitted quantities, those without a prior take their share of the pose's numbers
    freedom = 6 * present.sum() - sum(not np.isfinite(q.prior_sigma) for q in fit_.quantities)
    return Errors(
        reduced_chi_square=fit_.reduced_chi_square,
        reduced_chi_square_pose=float(np.sum(pose[present] ** 2) / max(freedom, 1)),
        rms_px=rms,
        rms_position_um=float(1e6 * np.sqrt(np.mean(delta[present, :3] ** 2))),
        rms_theta_mdeg=float(1e3 * np.degrees(np.sqrt(np.mean(tilt[present] ** 2)))),
        ahead=free_run(system, held),
        ratio_to_floor=held.ratio_to_floor,
        whiteness=whiteness(pose[present], _rate(system), frequencies(system, fit_.values)),
    )


def _rate(system: DiscSystem) -> float:
    return float(1.0 / np.median(np.diff(system.time)))


def frequencies(system: DiscSystem, values: Values) -> dict[str, float]:
    """Frequencies [Hz] at which effects show: mean precession, nutation, spin of the body about the vertical."""
    q = system.poses(values)
    span = system.time[-1] - system.time[0]
    precession = abs(q[-1, 3] - q[0, 3]) / span / (2 * np.pi)
    spin = abs(q[-1, 5] - q[0, 5]) / span / (2 * np.pi)
    turn = abs(q[-1, 3] + q[-1, 5] - q[0, 3] - q[0, 5]) / span / (2 * np.pi)
    # between the thin disc's 0.775 and 0.84 at 40 degrees (corrected equations of Ma et al. 2014)
    found = {"precession": precession, "spin": spin, "turn of the face": turn, "nutation": 0.79 * precession}
    return found | {"twice the precession": 2 * precession, "half the frame rate": 0.5 * _rate(system)}


def free_run(system: DiscSystem, held: HeldOut, horizons: tuple[float, ...] = HORIZONS) -> tuple[Ahead, ...]:
    """Errors of the free run at the horizons that the recording reaches."""
    values = held.train.values
    delta, sigma = system.pose_difference(values)
    q = system.poses(values)
    last = system.time[~held.test_rows & (system.weights > 0)].max()
    e1 = nodal_axes_world(q[:, 3], q[:, 4])[0]
    to_psi = euler_jacobian(q[:, 3], q[:, 4])[:, 0]
    theta, psi = np.sum(e1 * delta[:, 3:], axis=1), np.sum(to_psi * delta[:, 3:], axis=1)
    theta_noise = np.sqrt(np.sum((e1 * sigma[:, 3:]) ** 2, axis=1))
    psi_noise = np.sqrt(np.sum((to_psi * sigma[:, 3:]) ** 2, axis=1))
    found = []
    for horizon in horizons:
        near = np.abs(system.time - last - horizon) <= HALF_WINDOW
        near &= held.test_rows & (system.weights >= 6)
        if not near.any() or system.time[-1] < last + horizon:
            continue
        rms = lambda x, near=near: float(np.sqrt(np.mean(np.sum(np.atleast_2d(x.T).T[near] ** 2, axis=1))))  # noqa: E731
        found.append(
            Ahead(
                horizon,
                float(np.degrees(rms(theta))),
                float(np.degrees(rms(psi))),
                1e3 * rms(delta[:, :3]),
                float(np.degrees(rms(theta_noise))),
                float(np.degrees(rms(psi_noise))),
                1e3 * rms(sigma[:, :3]),
            )
        )
    return tuple(found)


def simulated(system: DiscSystem, values: Values) -> Motion:
    """The fitted motion with forces, moments and energies, at the instants of the frames."""
    return simulate(system.model_with(values), state_of(values), times=system.instants(values))


def energy_balance(system: DiscSystem, values: Values) -> dict[str, float]:
    """Energy lost in the recording [J], and the work of each effect, in the fitted motion."""
    motion = simulated(system, values)
    k = kinematics(motion.q, motion.qdot, system.disc, system.model.gravity, motion.time, system.model.air_density)
    balance = {"lost": float(motion.energy[0] - motion.energy[-1])}
    for effect in motion.model.effects:
        if effect.law is not None:
            power = effect_power(effect, k, motion.contact_force[:, 2])
            balance[f"by {effect.name}"] = float(-trapezoid(power, motion.time))
    if np.any(motion.slip_velocity):
        power = np.sum(motion.contact_force[:, :2] * motion.slip_velocity, axis=1)
        balance["by slip"] = float(-trapezoid(power, motion.time))
    return balance
