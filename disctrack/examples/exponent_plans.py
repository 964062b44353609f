"""Which trials would decide between explanations of the exponents? Computed for trials that were not made yet."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from calibration.arrays import Array
from disctrack.analyse.power_laws import fit_power_laws
from disctrack.diagnosis.engine.fit import compress, fit, prior_rows, solve_bounded
from disctrack.diagnosis.engine.system import Quantity, Values
from disctrack.disc import Disc
from disctrack.examples.exponent_analysis import Explanation
from disctrack.examples.exponent_model import FRAME, Setup
from disctrack.examples.exponent_system import SPIN, ExponentSystem, Series, sample_covariance
from disctrack.rolling import CATALOGUE, Model, simulate, steady_precession

ALUMINIUM_OVER_STEEL = 2.70 / 7.85  # density
LOW_PRESSURE = 0.1  # of the atmosphere
THETA_REST = np.radians(0.5)  # where the disc comes to lie on its paper
OSCILLATION = 0.15  # amplitude of the nutation over the nutation, in records that are read again
STEPS = 3  # of a refit, then to first order: where nothing fits, the last steps gain little and take long
COPIES = 16  # of a record with noise
MODEL_ERROR = 0.002  # of a trial's exponents: what leaving out its nutation oscillation costs the prediction


@dataclass(frozen=True)
class Plan:
    """Trials that could be made, or read again."""

    name: str
    longest: float | None = None  # [s] time left where the fit begins
    shortest: float | None = None  # [s] and ends
    density: float = 1.0  # of the disc, relative
    thickness: float = 1.0  # relative
    pressure: float = 1.0  # of the air, relative
    noise: float | None = None  # [rad] of the attitude per axis and frame, where t_f is fitted from the records

    def setup(self, published: Setup) -> Setup:
        """The published trials, changed."""
        disc: Disc = replace(
            published.disc,
            mass=published.disc.mass * self.density * self.thickness,
            half_thickness=published.disc.half_thickness * self.thickness,
            marker_centres_body=published.disc.marker_centres_body * [1, 1, self.thickness],
        )
        laws = {e: e.density_power for e in CATALOGUE.values() if e.density_power}
        air = {f"{e.name}.{e.parameters[0].name}": self.pressure**power for e, power in laws.items()}
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
            fits_t_f=self.noise is not None,
        )


PLANS = (
    Plan("the same trials again"),
    Plan("t_f fitted to the records, 0.05 deg of noise", noise=float(np.radians(0.05))),  # the paper's accuracy
    Plan("time left 0.05 to 1.5 s", longest=1.5),
    Plan("time left 0.2 to 1.5 s", longest=1.5, shortest=0.2),
    Plan("air at a tenth of the pressure", pressure=LOW_PRESSURE),
    Plan("disc of aluminium", density=ALUMINIUM_OVER_STEEL),
    Plan("disc twice as thick", thickness=2.0),
)


def planned_series(system: ExponentSystem, base: Values, plan: Plan) -> tuple[Series, ...]:
    """The plan's trials on each surface, as many as published, without their outcome.

    They scatter as the published ones do; where t_f is fitted, as such readings of simulated records (`base`: values
    of the paper's model) scatter.
    """
    planned = []
    for i, s in enumerate(system.series):
        setup, covariance = plan.setup(s.setup), s.covariance
        if plan.noise is not None:
            own = system.seen_by(i, base)
            laws = {n: v for n, v in own.items() if n.partition(".")[0] in CATALOGUE}
            covariance = reading_covariance(setup, laws, own[SPIN], plan.noise)
        planned.append(replace(s, setup=setup, covariance=covariance))
    return tuple(planned)


def separation(system: ExponentSystem, true: Explanation, rival: Explanation, planned: Sequence[Series]) -> float:
    """Standard deviations by which the rival fails when the other is true and the planned trials are added.

    The rival is refitted to the published and the new trials together, all quantities free; the spin of the new trials
    is unknown beforehand.
    """
    both = [*system.series, *planned]
    model = ExponentSystem(both, [true.candidate.name, rival.candidate.name])
    joint = ExponentSystem(
        [_expected(model, i, true.fit.values, s) for i, s in enumerate(both)], [rival.candidate.name]
    )
    quantities = (*joint.base, *rival.candidate.quantities)
    wrong = fit(joint, quantities, rival.fit.values, max_iterations=STEPS)
    cost = wrong.cost if wrong.converged else _first_order_cost(joint, quantities, wrong.values)
    return float(np.sqrt(max(cost - prior_penalty(joint, true.fit.values), 0.0)))


def _first_order_cost(system: ExponentSystem, quantities: Sequence[Quantity], values: Values) -> float:
    """Chi-square, priors included, that one more step would reach if the model were linear."""
    residual, derivative = system.linearise(values, [q.name for q in quantities])
    right, matrix = compress(residual, derivative)
    prior, prior_matrix = prior_rows(quantities, values)
    right, matrix = np.concatenate([right, prior]), np.vstack([matrix, prior_matrix])
    x = np.array([values[q.name] for q in quantities])
    lower, upper = np.array([q.lower for q in quantities]) - x, np.array([q.upper for q in quantities]) - x
    return float(np.sum((right - matrix @ solve_bounded(right, matrix, lower, upper)) ** 2))


def _expected(system: ExponentSystem, index: int, values: Values, like: Series) -> Series:
    """A series whose trials all are what the model with these values foretells."""
    outcome = system.outcomes(index, values)
    exponents = np.tile(outcome[:3], (len(like.exponents), 1))
    return replace(like, exponents=exponents, ln_duration=float(outcome[3]))


def prior_penalty(system: ExponentSystem, values: Values) -> float:
    """Chi-square of the priors at these values; a quantity that they lack stands at its null."""
    pulls = [(values.get(q.name, q.null) - q.null) / q.prior_sigma for q in system.base if np.isfinite(q.prior_sigma)]
    return float(np.sum(np.square(pulls)))


def pairs(names: Sequence[str]) -> list[tuple[str, str]]:
    """Every explanation against every other, once."""
    return [(a, b) for i, a in enumerate(names) for b in names[i + 1 :]]


def reading_covariance(setup: Setup, values: Values, spin: float, noise: float) -> Array:
    """Covariance (3, 3) of the exponents of one trial whose t_f is fitted too, as `disctrack analyse` does.

    values : laws of the motion.   noise [rad] : of the attitude per axis and frame
    From COPIES simulated records down to where the disc lies on its paper, each with its own phase of the nutation.
    """
    rng = np.random.default_rng(0)
    model = Model(setup.disc, setup.gravity).with_values(dict(values))
    found = []
    for phase in 2 * np.pi * np.arange(COPIES) / COPIES:
        state = steady_precession(
            setup.start,
            setup.disc,
            setup.gravity,
            omega3=spin,
            nutation_amplitude=OSCILLATION * setup.start,
            nutation_phase=float(phase),
        )
        motion = simulate(model, state, 5.0, rate=1 / FRAME, theta_end=float(THETA_REST), rtol=1e-9)
        theta = motion.q[:, 4]
        rate_noise = noise / (np.sqrt(2) * FRAME) / np.sin(theta)  # of central differences of psi
        psidot = motion.qdot[:, 3] + rate_noise * rng.normal(size=len(theta))
        theta = theta + noise * rng.normal(size=len(theta))
        laws = fit_power_laws(motion.time, motion.q[:, 3], theta, psidot, motion.energy, window=setup.longest)
        if laws.determined:
            found.append([laws.n_theta.value, laws.n_psidot.value, laws.n_energy.value])
    return sample_covariance(np.array(found).reshape(-1, 3)) + MODEL_ERROR**2 * np.eye(3)
