"""Questions to the published exponents: how large is the contradiction, and who removes it."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace

import numpy as np
from scipy import stats

from calibration.arrays import Array, Mask
from disctrack.diagnosis.engine.fit import Fit, fit
from disctrack.diagnosis.engine.held_out import HeldOut, held_out, training_rows
from disctrack.diagnosis.engine.system import Candidate, Values
from disctrack.examples.exponent_model import LastStage, Reading, Setup
from disctrack.examples.exponent_system import ExponentSystem, Series
from disctrack.published import PREDICTED
from disctrack.rolling import CATALOGUE, Model, steady_precession
from disctrack.rolling.evaluate import effect_power, kinematics

THIN_DISC = np.array([PREDICTED[1], PREDICTED[2], PREDICTED[0]])  # n_theta, n_psidot, n_energy
SHARE_AT = np.radians(2.0)  # [rad] nutation, in the windows of both surfaces


@dataclass(frozen=True)
class Misfit:
    """Mean exponents of one surface against a prediction without error."""

    surface: str
    predicted: Array  # (3,) n_theta, n_psidot, n_energy
    mean: Array  # (3,)
    sigma: Array  # (3,) of the mean, from the scatter of the trials
    t: Array  # (3,) Student's, trials - 1 degrees of freedom
    p_value: float  # of all three together, Hotelling's T-squared

    @property
    def sigmas(self) -> Array:
        """(3,) deviations as a normal variable of the same probability would have them."""
        n = self.degrees_of_freedom
        return np.sign(self.t) * stats.norm.isf(stats.t.sf(np.abs(self.t), n))

    degrees_of_freedom: int = 0

    @property
    def joint_sigmas(self) -> float:
        """The joint deviation, two-sided, in normal standard deviations."""
        return float(stats.norm.isf(self.p_value / 2))


def misfit(surface: str, exponents: Array, predicted: Array) -> Misfit:
    """Student's t of each exponent and Hotelling's T-squared of all; exponents (n, 3), predicted (3,)."""
    n, k = exponents.shape
    mean, covariance = exponents.mean(axis=0), np.cov(exponents.T) / n
    difference, sigma = mean - predicted, np.sqrt(np.diag(covariance))
    t_squared = float(difference @ np.linalg.solve(covariance, difference))
    p = float(stats.f.sf(t_squared * (n - k) / (k * (n - 1)), k, n - k))
    return Misfit(surface, predicted, mean, sigma, difference / sigma, p, n - 1)


def misfits(system: ExponentSystem, values: Values) -> tuple[Misfit, ...]:
    """Each series against the model with these values."""
    return tuple(
        misfit(s.setup.surface, s.exponents, system.outcomes(i, values)[:3]) for i, s in enumerate(system.series)
    )


@dataclass(frozen=True)
class Explanation:
    """One candidate fitted to all, and how it foretells what it has not seen."""

    candidate: Candidate
    fit: Fit
    gain: float  # decrease of chi-square against the base model
    misfits: tuple[Misfit, ...]
    held_out_gain: dict[str, float]  # increase of 2 log density of the data left out, by split


def splits(system: ExponentSystem) -> dict[str, Mask]:
    """Rows to fit on, by what is then foretold."""
    exponent = system.number < 3
    rows = {"later trials": training_rows(system)}
    for i, surface in enumerate(system.surfaces):
        rows[surface] = ~(exponent & (system.owner == i))
    rows["n_energy"] = system.number != 2
    return rows


def explanation(system: ExponentSystem, base: Fit, name: str) -> Explanation:
    """Refit one candidate together with all that the base fit moves, and judge it on every split."""
    (candidate,) = (c for c in system.candidates if c.name == name)
    found = fit(system, (*system.base, *candidate.quantities), base.values)
    gains = {}
    for split, rows in splits(system).items():
        without = held_out(system, system.base, base.values, rows)
        with_it = held_out(system, found.quantities, found.values, rows)
        gains[split] = 2 * (_density(with_it) - _density(without))
    return Explanation(candidate, found, base.cost - found.cost, misfits(system, found.values), gains)


def _density(held: HeldOut) -> float:
    return held.log_density if held.train.converged else float("nan")


@dataclass(frozen=True)
class Fixed:
    """An explanation whose size is known beforehand, alone or beside quantities that are fitted."""

    name: str
    values: dict[str, float]  # the known sizes
    fitted: tuple[str, ...]  # quantities fitted beside k_m and spin
    fit: Fit
    gain: float  # decrease of chi-square against the base model
    misfits: tuple[Misfit, ...]


def fixed(system: ExponentSystem, base: Fit, name: str, values: Values, free: str = "") -> Fixed:
    """Fit with these sizes held; `free` names a candidate that is fitted as well."""
    extra = tuple(q for c in system.candidates if c.name == free for q in c.quantities)
    found = fit(system, (*system.base, *extra), base.values | dict(values))
    gain = base.cost - found.cost if found.converged else float("nan")
    return Fixed(name, dict(values), tuple(q.name for q in extra), found, gain, misfits(system, found.values))


def power_shares(system: ExponentSystem, explanation: Explanation) -> tuple[float, ...]:
    """Share of the power lost that the effect takes at SHARE_AT, per surface; 0 for what is no law of the motion."""
    shares = []
    for i, s in enumerate(system.series):
        own = system.seen_by(i, explanation.fit.values)
        state = steady_precession(SHARE_AT, s.setup.disc, s.setup.gravity)
        q = np.array([0.0, 0.0, 0.0, 0.0, state.theta, 0.0])
        qdot = np.array([0.0, 0.0, 0.0, state.psidot, 0.0, state.phidot])
        motion = kinematics(q, qdot, s.setup.disc, s.setup.gravity)
        laws = {n: v for n, v in own.items() if n.partition(".")[0] in CATALOGUE}
        power = {
            e.name: float(effect_power(e, motion, s.setup.disc.mass * s.setup.gravity))
            for e in Model(s.setup.disc).with_values(laws).effects
        }
        shares.append(power.get(explanation.candidate.effect, 0.0) / sum(power.values()))
    return tuple(shares)


@dataclass(frozen=True)
class Scatter:
    """How much of the scatter between trials an error of t_f in each of them would be."""

    surface: str
    share: float  # of the variance (sum over the exponents) that lies along the exponents' derivative by t_f
    t_f_sigma: float  # [s] scatter of t_f that this takes
    nutation: Array  # (3,) scatter from the phase of a nutation oscillation of 30 %


def scatter(series: Series, values: Values) -> Scatter:
    """Scatter of the trials of one series against what t_f and the phase of the nutation make of it."""
    stage = LastStage(series.setup, values)
    step = 1e-3
    direction = (stage.outcomes(Reading(t_f_bias=step)) - stage.outcomes(Reading(t_f_bias=-step)))[:3] / (2 * step)
    covariance = np.cov(series.exponents.T)
    along = float(direction @ covariance @ direction / (direction @ direction))
    oscillating = LastStage(replace(series.setup, share=0.3), values).by_phase()[:, :3]
    return Scatter(
        series.setup.surface,
        along / float(np.trace(covariance)),
        float(np.sqrt(along / (direction @ direction))),
        oscillating.std(axis=0, ddof=1),
    )


def early_stop(setup: Setup, values: Mapping[str, float], theta: float = np.radians(0.5)) -> float:
    """Time [s] before collapse at which the nutation falls to theta, where the disc comes to lie on its paper."""
    stage = LastStage(setup, values)
    t_f, curve = stage.collapse[0], stage.curves[0]
    time = np.linspace(t_f - setup.longest, t_f - 1e-3, 4000)
    return float(t_f - time[np.argmax(np.exp(curve(time)[:, 0]) < theta)])
