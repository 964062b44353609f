"""Published exponents as a system that the engine of `disctrack.diagnosis` can diagnose.

A row is one exponent of one trial, cleared of what the exponents before it in the same trial predict (Cholesky), so
that all rows are independent with variance one. One more row per surface is the time that the last stage lasts: the
paper's k_m is that with which its simulation collapses at the measured instant, which is all that k_m can say once
another law acts beside it. The tables' own t_f count from the blow that starts the disc, through seconds of slip; a
rolling disc has nothing to say to them.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from calibration.kit.arrays import Array
from disctrack.analyse.published import SURFACES, published_table
from disctrack.diagnosis.motion import SLIP, motion_candidates
from disctrack.disc import MA_2014
from disctrack.discrepancy.held_out import TRAIN_FRACTION
from disctrack.discrepancy.system import Candidate, Quantity, System, Values
from disctrack.errors import AnalysisError
from disctrack.examples.exponent_model import READING, LastStage, Setup
from disctrack.rolling import CATALOGUE, Model, effects

ORDER = (1, 2, 0)  # of the table's columns: n_theta, n_psidot, n_energy; the energy last, as it depends on the spin
DURATION_SIGMA = 0.03  # of ln duration: simulation and measurement of figures 17 and 18 end within 50 ms of 1.5 s
SPIN = "state.omega3"  # at the start of the last stage; each series has its own
SPIN_AT_REST = 0.97  # [rad/s] omega_3 at 8 deg when the centre stays at rest, h psidot sin(theta) / r
SPIN_SIGMA = 2.0  # [rad/s]: the centre then runs on a circle of 1 mm
K_M = {"steel": 0.381e-7, "glass": 0.28e-7}  # [m s^2] section 5c
LONGEST = {"steel": 0.5, "glass": 0.3}  # [s] section 4a: time left where the fits of tables 2 and 3 begin
LAST_STAGE = 1.5  # [s] simulated in section 5c
STEP = 0.1  # of a quantity's scale, for differences: the simulation is smooth to 1e-8
_SHARED = ("air", "body")  # modules of effects that do not depend on the surface


@dataclass(frozen=True)
class Series:
    """Trials on one surface."""

    setup: Setup
    exponents: Array  # (n, 3) n_theta, n_psidot, n_energy
    covariance: Array  # (3, 3) of one trial's
    ln_duration: float  # of the last stage, at the start nutation of the setup

    @property
    def mean(self) -> Array:
        """(3,) over the trials."""
        return np.asarray(self.exponents.mean(axis=0), float)


def sample_covariance(exponents: Array) -> Array:
    """Covariance (k, k) of one trial, widened so that its inverse is unbiased (Hartlap, Simon & Schneider 2007).

    With the sample covariance as it is, chi-square of n = 8 trials of three numbers would be 7/3 of what it should be.
    Raises AnalysisError for fewer than k + 3 trials.
    """
    n, k = exponents.shape
    if n < k + 3:
        raise AnalysisError(f"{n} trials of {k} numbers: their covariance needs {k + 3} trials or more")
    return np.asarray(np.cov(exponents.T) * (n - 1) / (n - k - 2), float)


def setup_of(surface: str) -> Setup:
    """The paper's trials on "steel" or "glass"; simulated from the nutation that (5.11) has 1.5 s before the end."""
    disc, k_m, g = MA_2014, K_M[surface], 9.81
    start = (k_m * LAST_STAGE) ** (2 / 3) * 4 * g / disc.radius ** (5 / 3)
    return Setup(surface, k_m, LONGEST[surface], start=float(start), disc=disc, gravity=g)


def series_of(setup: Setup, exponents: Array) -> Series:
    """Trials with their own covariance; the duration is that of the paper's model."""
    stage = LastStage(setup, {"km.k_m": setup.k_m}, SPIN_AT_REST)
    return Series(setup, exponents, sample_covariance(exponents), float(np.log(stage.duration)))


def published_series() -> tuple[Series, ...]:
    """Tables 2 and 3."""
    return tuple(series_of(setup_of(s), published_table(s).exponents[:, ORDER]) for s in SURFACES)


def at(name: str, surface: str) -> str:
    """Name of a quantity that each surface has for itself."""
    return f"{name}@{surface}"


def _per_surface(quantity: Quantity, surfaces: Sequence[str]) -> tuple[Quantity, ...]:
    return tuple(replace(quantity, name=at(quantity.name, s)) for s in surfaces)


def exponent_candidates(surfaces: Sequence[str], names: Sequence[str] | None = None) -> tuple[Candidate, ...]:
    """Everything in the catalogue of motions, laws of the contact per surface; and what the reading may do wrong."""
    found = []
    for c in motion_candidates(Model(MA_2014, effects=(effects.effect_class("km").absent(),))):
        shared = CATALOGUE[c.effect].__module__.rpartition(".")[2] in _SHARED and not c.threshold
        quantities = c.quantities if shared else tuple(q for own in c.quantities for q in _per_surface(own, surfaces))
        found.append(replace(c, quantities=quantities))
    for quantity, (title, source) in READING.items():
        name = quantity.owner
        found.append(Candidate(name, name, "measurement", title, source, (quantity,)))
        if len(surfaces) > 1:
            each, title = _per_surface(quantity, surfaces), f"{title}, each surface its own"
            found.append(Candidate(f"{name}_each", name, "measurement", title, source, each))
    return tuple(c for c in found if names is None or c.name in names)


class ExponentSystem(System):
    """Several series of trials with their model, for the engine."""

    def __init__(self, series: Sequence[Series], candidates: Sequence[str] | None = None) -> None:
        """Candidates : names of those to look at; all if not given."""
        self.series = tuple(series)
        self.surfaces = tuple(dict.fromkeys(s.setup.surface for s in series))
        self.candidates = exponent_candidates(self.surfaces, candidates)  # what the model or the reading may lack
        self._stages: dict[tuple[object, ...], LastStage] = {}
        # of each series its trials, three rows each, and at last the duration; of the trials the first part is fitted
        counts = [len(s.exponents) for s in series]
        shares = [np.repeat(np.append((np.arange(n) + 0.5) / n, 0.0), [3] * n + [1]) for n in counts]
        self.training = np.concatenate(shares) < TRAIN_FRACTION
        self.time, self.weights = np.arange(len(self.training), dtype=float), np.ones(len(self.training))
        self.base = tuple(
            q
            for s in self.series
            for q in (
                Quantity(at("km.k_m", s.setup.surface), "m s^2", 1e-3 * s.setup.k_m, lower=0.0, typical=s.setup.k_m),
                Quantity(at(SPIN, s.setup.surface), "rad/s", 0.01, SPIN_AT_REST, prior_sigma=SPIN_SIGMA),
            )
        )

    @property
    def start(self) -> dict[str, float]:
        """Values from which the base fit begins."""
        return {q.name: q.null for q in self.base} | {at("km.k_m", s.setup.surface): s.setup.k_m for s in self.series}

    def starts(self, candidate: Candidate, values: Values, least: float = 0.0) -> Sequence[tuple[float, ...]]:
        """Slip: friction coefficients that rolling would just exceed on every surface."""
        return [(1 / mu,) * len(candidate.quantities) for mu in (0.05, 0.02)]

    def outcomes(self, index: int, values: Values) -> Array:
        """(4,) predicted means of one series: n_theta, n_psidot, n_energy, ln duration."""
        own = self.seen_by(index, values)
        return self._stage(index, own).outcomes({q.name: own[q.name] for q in READING if q.name in own})

    def linearise(self, values: Values, names: Sequence[str]) -> tuple[Array, Array]:
        """Whitened residual (n, 1) and derivative (n, 1, k) by central differences, one-sided at bounds."""
        known = {q.name: q for q in (*self.base, *(q for c in self.candidates for q in c.quantities))}
        residual = self._residual(values)
        derivative = np.zeros((len(residual), len(names)))
        for k, name in enumerate(names):
            q, value = known[name], values.get(name, 0.0)
            # central differences away from bounds: with large residuals their gradient decides about convergence
            up, down = min(value + STEP * q.scale, q.upper), max(value - STEP * q.scale, q.lower)
            change = self._residual({**values, name: down}) - self._residual({**values, name: up})
            derivative[:, k] = change / (up - down)
        return residual[:, None], derivative[:, None]

    def _residual(self, values: Values) -> Array:
        """(n,) observed minus predicted, whitened."""
        parts = []
        for i, s in enumerate(self.series):
            predicted, whiten = self.outcomes(i, values), np.linalg.inv(np.linalg.cholesky(s.covariance))
            parts += [((s.exponents - predicted[:3]) @ whiten.T).ravel()]
            parts += [np.array([s.ln_duration - predicted[3]]) / DURATION_SIGMA]
        return np.concatenate(parts)

    def seen_by(self, index: int, values: Values) -> dict[str, float]:
        """Values that one series sees, without the surface in their names; what both have adds up."""
        own: dict[str, float] = {}
        for name, value in values.items():
            plain, _, surface = name.partition("@")
            if surface in ("", self.series[index].setup.surface):
                own[plain] = own.get(plain, 0.0) + value
        return own

    def _stage(self, index: int, seen: Values) -> LastStage:
        own = dict(seen)
        spin = own.pop(SPIN, SPIN_AT_REST)
        inverse = own.pop(SLIP, 0.0)
        reading = {q.name for q in READING}
        laws = {name: value for name, value in own.items() if name not in reading and (value or name == "km.k_m")}
        if inverse > 0:
            laws["slip.mu"] = 1 / inverse
        key = (index, spin, *sorted(laws.items()))
        if key not in self._stages:
            self._stages[key] = LastStage(self.series[index].setup, laws, spin)
        return self._stages[key]
