"""Questions to the published exponents: how large is the contradiction, who removes it, what would decide."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray
from scipy import stats

from disctrack.diagnosis.fit import Fit, fit
from disctrack.diagnosis.held_out import HeldOut, held_out, training_rows
from disctrack.diagnosis.system import Candidate, Values
from disctrack.disc import Disc
from disctrack.examples.exponent_model import LastStage, Reading, Setup
from disctrack.examples.exponent_system import ExponentSystem, Series, exponent_candidates
from disctrack.published import PREDICTED

Array = NDArray[np.float64]

THIN_DISC = np.array([PREDICTED[1], PREDICTED[2], PREDICTED[0]])  # n_theta, n_psidot, n_energy
ALUMINIUM_OVER_STEEL = 2.70 / 7.85  # density
LOW_PRESSURE = 0.1  # of the atmosphere


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


def splits(system: ExponentSystem) -> dict[str, NDArray[np.bool_]]:
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


@dataclass(frozen=True)
class Plan:
    """Trials that could be made, or read again."""

    name: str
    longest: float | None = None  # [s] time left where the fit begins
    shortest: float | None = None  # [s] and ends
    density: float = 1.0  # of the disc, relative
    thickness: float = 1.0  # relative
    pressure: float = 1.0  # of the air, relative

    def setup(self, published: Setup) -> Setup:
        """The published trials, changed."""
        disc: Disc = replace(
            published.disc,
            mass=published.disc.mass * self.density * self.thickness,
            half_thickness=published.disc.half_thickness * self.thickness,
            marker_centres_body=published.disc.marker_centres_body * [1, 1, self.thickness],
        )
        air = {  # boundary layers go with sqrt(density), the viscous layer does not know the pressure
            "air_bildsten.beta": np.sqrt(self.pressure),
            "air_quadratic.a": self.pressure,
        }
        longest = self.longest or published.longest
        start = published.start * max(1.0, 1.3 * longest / 1.5) ** (2 / 3)
        return replace(
            published,
            label=" " + self.name,
            longest=longest,
            shortest=self.shortest or published.shortest,
            start=start,
            disc=disc,
            factors=air,
        )


PLANS = (
    Plan("the same trials again"),
    Plan("time left 0.05 to 1.5 s", longest=1.5),
    Plan("time left 0.2 to 1.5 s", longest=1.5, shortest=0.2),
    Plan("air at a tenth of the pressure", pressure=LOW_PRESSURE),
    Plan("disc of aluminium", density=ALUMINIUM_OVER_STEEL),
    Plan("disc twice as thick", thickness=2.0),
)


def separation(system: ExponentSystem, true: Explanation, rival: Explanation, plan: Plan) -> float:
    """Standard deviations by which the rival fails when the other is true and the plan's trials are added.

    As many trials per surface as published, with the same scatter. The rival is refitted to the published and the
    new trials together, all quantities free; the spin of the new trials is unknown beforehand.
    """
    first = [_expected(system, i, true.fit.values, s.setup, s) for i, s in enumerate(system.series)]
    planned = [replace(s, setup=plan.setup(s.setup)) for s in system.series]
    names = [true.candidate.name, rival.candidate.name]
    empty = ExponentSystem([*system.series, *planned], names)
    n = len(first)
    second = [_expected(empty, n + i, true.fit.values, s.setup, s) for i, s in enumerate(planned)]
    joint = ExponentSystem([*first, *second], [rival.candidate.name])
    wrong = fit(joint, (*joint.base, *rival.candidate.quantities), rival.fit.values)
    right = prior_penalty(joint, true.fit.values)
    return float(np.sqrt(max(wrong.cost - right, 0.0))) if wrong.converged else float("nan")


def _expected(system: ExponentSystem, index: int, values: Values, setup: Setup, like: Series) -> Series:
    """A series whose trials all are what the model with these values foretells."""
    outcome = system.outcomes(index, values)
    return Series(setup, np.tile(outcome[:3], (len(like.exponents), 1)), like.covariance, float(outcome[3]))


def prior_penalty(system: ExponentSystem, values: Values) -> float:
    """Chi-square of the priors at these values; a quantity that they lack stands at its null."""
    pulls = [(values.get(q.name, q.null) - q.null) / q.prior_sigma for q in system.base if np.isfinite(q.prior_sigma)]
    return float(np.sum(np.square(pulls)))


def pairs(names: Sequence[str]) -> list[tuple[str, str]]:
    """Every explanation against every other, once."""
    return [(a, b) for i, a in enumerate(names) for b in names[i + 1 :]]


def early_stop(setup: Setup, values: Mapping[str, float], theta: float = np.radians(0.5)) -> float:
    """Time [s] before collapse at which the nutation falls to theta, where the disc comes to lie on its paper."""
    stage = LastStage(setup, values)
    t_f, curve = stage.collapse[0], stage.curves[0]
    time = np.linspace(t_f - setup.longest, t_f - 1e-3, 4000)
    return float(t_f - time[np.argmax(np.exp(curve(time)[:, 0]) < theta)])


def all_names(surfaces: Sequence[str]) -> tuple[str, ...]:
    """Names of all candidates."""
    return tuple(c.name for c in exponent_candidates(surfaces))
