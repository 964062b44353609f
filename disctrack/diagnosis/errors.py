"""Errors of a fitted model: residuals and their tests, free runs, energy balance, and where the model is valid."""

from collections.abc import Callable, Mapping
from dataclasses import dataclass

import numpy as np
from scipy.integrate import trapezoid

from calibration.kit.types import Indices
from disctrack.diagnosis.disc_system import DiscSystem
from disctrack.diagnosis.motion import state_of
from disctrack.diagnosis.stretch import MIN_FRAMES
from disctrack.discrepancy.fit import Fit, fit
from disctrack.discrepancy.held_out import HeldOut, most_that_hold
from disctrack.discrepancy.significance import Whiteness, whiteness
from disctrack.discrepancy.system import System, Values, subset
from disctrack.rolling import Motion, simulate
from disctrack.rolling.motion import effect_power

HALF_WINDOW = 0.01  # [s] over which the error at a horizon is averaged: some frames, a fraction of a turn
LEVEL = 1e-4  # significance level of the whiteness of a residual, over all its tests
DOUBTFUL = 0.05  # p-value of the residuals of the poses, below which laws outside the catalogue compete
MUCH = 25.0  # variances of the noise, beyond which errors of the measurement hide any effect of the motion
LIKE = 2.0  # times the excess of the components that no pose absorbs, up to which that of the poses is explained by it

Ahead = dict[str, float]  # errors of a free run at some horizon, and those that noise of the measurement alone causes


@dataclass(frozen=True)
class Errors:
    """Errors of one model against one measurement."""

    reduced_chi_square: float  # of the dots in all images
    reduced_chi_square_pose: float  # of the six components per frame that a pose can absorb
    rms_px: float  # per image coordinate
    rms_position_um: float  # rms of measured minus fitted position, per axis
    rms_theta_mdeg: float  # rms of measured minus fitted nutation angle
    ratio_to_floor: float  # free run: rms of the residual over that expected from noise and the fit's uncertainty
    whiteness: Whiteness


def errors(system: DiscSystem, fit_: Fit, held: HeldOut | None) -> Errors:
    """All errors of a fit, and of the free run that follows a fit of the first part."""
    pose = system.pose_residual(fit_.values)
    present = system.weights >= 6
    error = system.coordinate_errors(fit_.values)[0][present]
    # fitted quantities without a prior reduce the degrees of freedom of the poses
    freedom = 6 * present.sum() - fit_.n_free
    return Errors(
        reduced_chi_square=fit_.reduced_chi_square,
        reduced_chi_square_pose=float(np.sum(pose[present] ** 2) / max(freedom, 1)),
        rms_px=float(np.sqrt(np.mean(system.residual_px(fit_.values)[system.used] ** 2))),
        rms_position_um=float(1e6 * np.sqrt(np.mean(error[:, :3] ** 2))),
        rms_theta_mdeg=float(1e3 * np.degrees(np.sqrt(np.mean(error[:, 4] ** 2)))),
        ratio_to_floor=held.ratio_to_floor if held else np.nan,
        whiteness=whiteness(pose[present], system.rate, frequencies(system, fit_.values)),
    )


def frequencies(system: DiscSystem, values: Values) -> dict[str, float]:
    """Frequencies [Hz] of the effects: mean precession, nutation, spin, rotation of the body about the vertical."""
    q = system.poses(values)
    psi, phi = (q[-1, [3, 5]] - q[0, [3, 5]]) / (2 * np.pi * (system.time[-1] - system.time[0]))
    # nutation over precession: between the thin disc's 0.775 and 0.84 at 40 deg (corrected equations of Ma et al. 2014)
    turning = {"precession": psi, "spin": phi, "turn of the face": psi + phi, "nutation": 0.79 * psi}
    turning |= {"twice the precession": 2 * psi, "half the frame rate": 0.5 * system.rate}
    return {name: abs(float(f)) for name, f in turning.items()}


def free_run(system: DiscSystem, held: HeldOut, horizon: float) -> Ahead | None:
    """Errors of the free run at a horizon [s] after the last fitted frame; None beyond the end of the recording."""
    last = system.time[~held.test_rows & (system.weights > 0)].max()
    near = np.abs(system.time - last - horizon) <= HALF_WINDOW
    near &= held.test_rows & (system.weights >= 6)
    if not near.any() or system.time[-1] < last + horizon:
        return None
    found = {"horizon_s": horizon}
    for kind, error in zip(("", "noise_"), system.coordinate_errors(held.train.values), strict=True):
        rms = np.sqrt(np.mean(error[near] ** 2, axis=0))
        found[f"{kind}theta_deg"], found[f"{kind}psi_deg"] = np.degrees(rms[[4, 3]]).tolist()
        found[f"{kind}position_mm"] = 1e3 * float(np.linalg.norm(rms[:3]))
    return found


def simulated(system: DiscSystem, values: Values) -> Motion:
    """The fitted motion with forces, moments and energies, at the instants of the frames."""
    return simulate(system.model_with(values), state_of(values), times=system.instants(values))


def energy_balance(system: DiscSystem, values: Values) -> dict[str, float]:
    """Energy lost during the recording [J], and the part of it by each effect, in the fitted motion."""
    motion = simulated(system, values)
    balance = {"lost": float(motion.energy[0] - motion.energy[-1])}
    for effect in motion.model.effects:
        if effect.law is not None:
            power = effect_power(effect, motion.instants, motion.contact_force[:, 2])
            balance[f"by {effect.name}"] = float(-trapezoid(power, motion.time))
    if np.any(motion.slip_velocity):
        power = np.sum(motion.contact_force[:, :2] * motion.slip_velocity, axis=1)
        balance["by slip"] = float(-trapezoid(power, motion.time))
    return balance


@dataclass(frozen=True)
class ResidualTests:
    """Are the residuals of a fit noise, and if not, are they caused by the motion or by the measurement?

    The dots of a frame have more components than a pose. An effect missing from the motion changes only the six
    components that a pose can absorb; an error of lenses, dots or light changes all. P-values are corrected for the
    number of tests (Bonferroni).
    """

    pose_chi_square: float = 1.0  # per component of the poses, over the noise
    other_chi_square: float = 1.0  # per component that no pose absorbs, over the noise
    pose_p_value: float = 1.0  # of the autocorrelation (Ljung-Box) and of lines in the spectra of the poses' components
    other_p_value: float = 1.0  # of the autocorrelation of the others
    n_tests: int = 0

    @property
    def white(self) -> bool:
        """Are the residuals white noise?"""
        return min(self.pose_p_value, self.other_p_value) >= LEVEL

    @property
    def of_the_motion(self) -> bool:
        """Are the residuals of the poses not noise, and larger than errors of the measurement make them?"""
        return self.pose_p_value < LEVEL and not self.alike

    @property
    def doubtful(self) -> bool:
        """May an effect of the motion be missing, although chi-square is that of noise?

        The residuals of the poses are significant at 5 %, and are not explained by errors of the measurement, which
        would change the components that no pose absorbs by as much.
        """
        return self.pose_p_value < DOUBTFUL and not (self.other_p_value < DOUBTFUL and self.alike)

    @property
    def alike(self) -> bool:
        """Do the components that no pose absorbs exceed the noise as those of the poses do?"""
        return self.pose_chi_square - 1.0 <= LIKE * max(self.other_chi_square - 1.0, 0.0)

    @property
    def of_the_measurement(self) -> bool:
        """Are the residuals larger than noise, but alike in all components, and not so large that they hide effects?"""
        return 0.05 < self.other_chi_square - 1.0 < MUCH and self.alike


def residual_tests(system: DiscSystem, fit_: Fit, noise: float) -> ResidualTests:
    """Tests of the residuals of a fit; the defaults if few rows are complete.   noise : variance over that stated"""
    most = np.max(system.weights)
    full = system.weights >= most
    n = int(full.sum())
    if n < MIN_FRAMES or most < 8:
        return ResidualTests()
    pose, other = (part[full] for part in system.parts_of_residual(fit_.values))
    of_pose, of_other = (whiteness(part, system.rate, {}) for part in (pose, other))
    pose_p_value = min(1.0, 2 * of_pose.p_value, 2 * 6 * float(of_pose.peak_p_value.min()))
    pose_chi_square = float(np.sum(pose**2) / max(6 * n - fit_.n_free, 1) / noise)
    other_chi_square = float(np.sum(other**2) / max((most - 6) * n, 1) / noise)
    return ResidualTests(pose_chi_square, other_chi_square, pose_p_value, of_other.p_value, 12 + other.shape[1])


# frames that the model describes, and the nutation where they end within the recording
ValidRange = Mapping[str, float]


def valid_ranges(system: DiscSystem, judged: System, base: Fit, noise: float) -> dict[str, ValidRange | None]:
    """Longest first part and longest last part that the base model describes to noise; None where it is too short.

    judged : the system whitened by the noise that was found
    """
    frames = np.flatnonzero(system.weights > 0)
    theta = np.degrees(system.trajectory.q[system.rows, 4])

    def holds(rows: Indices) -> bool:
        trial = fit(subset(judged, np.isin(np.arange(len(system.time)), rows)), base.quantities, base.values, 10)
        limit = noise * (1.0 + 4.0 * np.sqrt(2.0 / max(trial.degrees_of_freedom, 1)))  # four sigmas of chi-square
        return bool(trial.converged and trial.reduced_chi_square <= limit)

    def longest(part: Callable[[int], Indices], at: int) -> ValidRange | None:
        least, n = max(len(frames) // 5, MIN_FRAMES), len(frames)
        most = most_that_hold(lambda k: holds(part(k)), least, n, max(n // 64, 1))
        if not most:
            return None
        rows = part(most)
        start, stop = system.time[rows[[0, -1]]].tolist()
        return {"start": start, "stop": stop, "theta_deg": float(theta[rows[at]]), "frames": most}

    return {"first": longest(lambda k: frames[:k], -1), "last": longest(lambda k: frames[-k:], 0)}


def ranges_text(ranges: Mapping[str, ValidRange | None]) -> str:
    """The valid ranges in words."""
    texts = []
    if first := ranges["first"]:
        texts.append(f"holds until {first['stop']:.3f} s (nutation {first['theta_deg']:.2f} deg) and fails after")
    if last := ranges["last"]:
        texts.append(f"holds from {last['start']:.3f} s on (nutation {last['theta_deg']:.2f} deg)")
    if not texts:
        return "The model fails throughout the recording: the missing effect acts all the time"
    return f"The model {'; refitted, it '.join(texts)}"
