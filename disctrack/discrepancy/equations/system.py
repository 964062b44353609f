"""Equations and runs as a system that `discrepancy.search` can diagnose."""

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from itertools import accumulate, pairwise

import numpy as np
from scipy.interpolate import PPoly

from calibration.kit.types import Array, Mask
from disctrack.discrepancy.equations import _ode_kernel as kernel
from disctrack.discrepancy.equations.declared import Samples, Term
from disctrack.discrepancy.equations.formulas import Formulas
from disctrack.discrepancy.held_out import TRAIN_FRACTION
from disctrack.discrepancy.system import Budget, Candidate, Quantity, System, Values
from disctrack.errors import AnalysisError

TOLERANCE = 1e-10  # of a step, relative to the size of a state
FAINTEST = 1e-9  # share of its size by which a quantity of its usual size moves the motion: less is a rounding error
MAX_STEPS = 400_000  # limit of an integration ...
HARDER = 10  # ... and over the steps of the motion before a fit's step: a motion so much harder is rejected
MOST_WORK = 2e8  # of an answer: steps of the integrator times states and sensitivities, some 1 us each ...
OF_ONE = 0.1  # ... and share of it for one trial
MOST_STATES = 80  # initial states that are fitted together: further stretches add little
EACH = "*"  # in place of a stretch's name, where each has a quantity of its own


@dataclass(frozen=True)
class Prediction:
    """Predicted motion and sensor values over one stretch."""

    states: Array  # (n, n_states) at the true instants of the first channel
    seen: Array  # (n, w) sensor values
    derivative: Array  # (n, w, k)


@dataclass(eq=False, repr=False)
class EquationSystem(System):
    """Samples of all stretches with known noise; a row without data separates consecutive stretches."""

    formulas: Formulas
    stretches: Sequence[Samples]
    sizes: Array  # (n,) of the states
    widths: dict[str, float]  # of jumps
    promoted: Sequence[str] = ()  # terms that belong to the base model
    held: Sequence[str] = ()  # parameters that are not fitted
    typical: Mapping[str, float] = field(default_factory=dict)  # typical sizes of the terms' parameters
    guesses: Mapping[str, float] = field(default_factory=dict)  # initial guesses of shapes, fitted at once
    budget: Budget = field(default_factory=lambda: Budget(MOST_WORK))  # shared by all systems of one diagnosis
    trial_work = OF_ONE * MOST_WORK
    several_minima = frees_shapes = True  # users may declare any equations

    def __post_init__(self) -> None:
        first = [0, *accumulate(len(s.time) + 1 for s in self.stretches)]
        self.blocks = [slice(a, b - 1) for a, b in pairwise(first)]
        n, self._w = first[-1], len(self.formulas.channels)
        self.time, self.training, self.present = np.zeros(n), np.zeros(n, bool), np.zeros((n, self._w), bool)
        for rows, s in zip(self.blocks, self.stretches, strict=True):
            elapsed = s.time - s.time[0]
            self.time[rows], self.time[rows.stop] = elapsed, elapsed[-1]
            self.present[rows] = np.isfinite(s.data)
            self.training[rows] = fitted_rows(s)
        self.weights = self.present.sum(axis=1).astype(float)
        self._places: dict[str, dict[str, int]] = {}
        self._steps: dict[str, int] = {}  # by stretch: of the last integration with derivatives
        self._defaults = self.formulas.defaults() | self.widths | dict(self.guesses)
        self._declared = self.formulas.declared | {
            name: replace(self.formulas.declared[name], value=value, shape=False)
            for name, value in self.guesses.items()
        }
        self._typical = np.array([self.typical.get(name, 1.0) for name in self._defaults])
        self._per = {name: p.per for name, p in self._declared.items() if p.per}
        self.base = tuple(self._base())
        self.candidates = tuple(self._candidate(t) for t in self.formulas.terms if t.name not in self.promoted)

    def _base(self) -> Iterator[Quantity]:
        several = len(self.stretches) > 1
        for i, s in enumerate(self.stretches):
            for name, size in zip(self.formulas.equations.states, self.sizes, strict=True):
                value, sigma = s.known.get(name, (0.0, np.inf))
                if sigma > 0:
                    unit = self.formulas.equations.units.get(name, "1")
                    q = Quantity(f"state.{name}[{s.name}]", unit, 1e-3 * size, value, prior_sigma=sigma,
                                 meaning="at the first sample")  # fmt: skip
                    yield replace(q, slot=f"state.{name}[{EACH}]", block=i) if several else q
        for name, p in self._declared.items():
            term = self.formulas.owner[name]
            if not (name in self.held or p.shape or (term and term not in self.promoted)):
                yield from self._with_slots(name, self._quantities(name)) if several else self._quantities(name)

    def _with_slots(self, name: str, quantities: Sequence[Quantity]) -> list[Quantity]:
        """With a slot for every quantity without bounds that belongs to a single stretch."""
        of_stretches = [self._name(name, s) for s in self.stretches]
        return [
            replace(q, slot=f"{name}[{EACH}]", block=of_stretches.index(q.name))
            if name in self._per and of_stretches.count(q.name) == 1 and np.isinf([q.lower, q.upper]).all()
            else q
            for q in quantities
        ]

    def _quantities(self, name: str) -> list[Quantity]:
        p = self._declared[name]
        scale = 1e-3 * abs(p.value) or 1e-3 * self.typical.get(name, 1.0)
        typical = p.typical or self.typical.get(name, np.inf)
        declared = None if self.formulas.owner[name] else p.value
        return [
            Quantity(n, p.unit, scale, p.value, p.lower, p.upper, p.sigma, p.meaning, typical, declared=declared)
            for n in dict.fromkeys(self._name(name, s) for s in self.stretches)
        ]

    def _name(self, name: str, s: Samples) -> str:
        """Name of a parameter's quantity in a stretch. Raises AnalysisError where its run has no such group."""
        if name not in self._per:
            return name
        kind = self._per[name]
        if kind not in s.groups:
            raise AnalysisError(f"run {s.run} needs groups={{{kind!r}: ...}}: {name} is declared for each {kind}.")
        return f"{name}[{s.groups[kind]}]"

    def _candidate(self, term: Term) -> Candidate:
        own = {name: p for name, p in self._declared.items() if self.formulas.owner[name] == term.name}
        amounts, shape = (
            tuple(q for name, p in own.items() if p.shape == of_shape for q in self._quantities(name))
            for of_shape in (False, True)
        )
        kind = "motion" if term.rates else "measurement"
        return Candidate(term.name, term.name, kind, term.title or term.name, term.source, amounts, shape=shape)

    def linearise(self, values: Values, names: Sequence[str]) -> tuple[Array, Array]:
        """See System."""
        residual = np.zeros((len(self.time), self._w))
        derivative = np.zeros((len(self.time), self._w, len(names)))
        for rows, s in zip(self.blocks, self.stretches, strict=True):
            own = self.names_of(s)
            columns = [i for i, name in enumerate(names) if name in own]
            found = self.predict(values, s, names)
            if found is None:
                return np.full_like(residual, np.nan), np.full_like(derivative, np.nan)
            present = self.present[rows]
            if s.noise is not None:
                for c in range(self._w):
                    here = np.flatnonzero(present[:, c])
                    W, at = s.noise.whitening(s.time[here]), rows.start + here
                    residual[at, c] = W @ (s.data - found.seen)[here, c]
                    derivative[at[:, None], c, columns] = W @ found.derivative[here, c]
                continue
            residual[rows] = np.where(present, (s.data - found.seen) / s.sigma, 0.0)
            weight = np.where(present, 1.0 / s.sigma, 0.0)[..., None]
            derivative[rows.start : rows.stop, :, columns] = found.derivative * weight
        return residual, derivative

    def predictions(self, values: Values) -> list[tuple[Samples, Prediction | None]]:
        """All stretches with their predictions; None where the motion cannot be integrated to the end."""
        return [(s, self.predict(values, s)) for s in self.stretches]

    def names_of(self, s: Samples) -> dict[str, int]:
        """Quantities of a stretch: the index of each in p, or -1 - i for the i-th initial state."""
        if s.name not in self._places:
            states, numbers = self.formulas.equations.states, self.formulas.numbers
            found = {f"state.{n}[{where}]": -1 - i for i, n in enumerate(states) for where in (s.name, EACH)}
            own = {name: i for i, n in enumerate(numbers) for name in (self._name(n, s), f"{n}[{EACH}]")}
            self._places[s.name] = found | own
        return self._places[s.name]

    def numbers(self, values: Values, s: Samples) -> Array:
        """(n_p,) all parameters and constants of a stretch."""
        known = self._defaults | dict(s.constants)
        return np.array([values.get(self._name(n, s), values.get(n, v)) for n, v in known.items()], float)

    def start_of(self, values: Values, s: Samples) -> Array:
        """(n,) states at the first sample."""
        states = self.formulas.equations.states
        return np.array([values.get(f"state.{n}[{s.name}]", s.known.get(n, (0.0,))[0]) for n in states], float)

    def predict(self, values: Values, s: Samples, names: Sequence[str] = ()) -> Prediction | None:
        """Prediction of a stretch, with derivatives by those of the quantities that it has (`names_of`).

        None where the motion cannot be integrated to the end.
        """
        known = self.names_of(s) if names else {}
        own = np.array([known[name] for name in names if name in known], np.int64)
        f = self.formulas
        n, k = len(f.states), len(own)
        p = self.numbers(values, s)
        z0 = np.zeros((1 + k, n))
        z0[0] = self.start_of(values, s)
        initial, fitted = np.flatnonzero(own < 0), own >= 0
        z0[1 + initial, -1 - own[initial]] = 1.0
        late, by_number = self._lateness(s, p)
        times, which_time = np.unique(s.time + late, return_inverse=True)
        at = which_time.reshape(late.shape).T, np.arange(self._w)  # sensors with a lag show earlier instants
        span = s.time[0], max(float(times[-1]), s.time[0] + 1e-9)
        most = MAX_STEPS if names else min(MAX_STEPS, HARDER * self._steps.get(s.name, MAX_STEPS))
        scale = np.ones(k)
        scale[initial] = self.sizes[-1 - own[initial]]
        scale[fitted] = np.maximum(np.abs(p), self._typical)[own[fitted]]
        out = np.empty((len(times), z0.size))
        with np.errstate(all="ignore"):
            steps = kernel.integrate(
                f.rhs, z0.ravel(), p, np.maximum(own, -1), np.array(span), n, *f.driven(s.knots, s.pieces, p),
                self.sizes, FAINTEST / scale, TOLERANCE, most, times, out,
            )  # fmt: skip
        self._steps |= {s.name: steps} if names and steps > 0 else {}
        self.budget.work(abs(steps) * z0.size)
        if steps <= 0:
            return None
        states, moved = out[:, :n], out[:, n:].reshape(len(times), k, n)
        seen, by_state, by_own = f.sensors_at(s, p, times, states)
        derivative = np.einsum("mwn,mkn->mwk", by_state, moved)
        derivative[..., fitted] += by_own[..., own[fitted]]
        derivative = derivative[at]
        if k and f.is_late:
            with np.errstate(invalid="ignore"):  # a diverging motion has no slope
                slope = np.einsum("mwn,mn->mw", by_state, f.rates_at(s, p, times, states)[0])[at]
                fitted &= own < by_number.shape[1]
                derivative[..., fitted] += slope[..., None] * by_number[:, own[fitted]].transpose(2, 0, 1)
        return Prediction(states[at[0][:, 0]], seen[at], derivative)

    def _lateness(self, s: Samples, p: Array) -> tuple[Array, Array]:
        """True minus recorded instants of the samples (w, m), and their derivatives (w, n_fitted, m)."""
        if not self.formulas.is_late:
            return np.zeros((self._w, len(s.time))), np.zeros((self._w, 0, len(s.time)))
        late, by_number = self.formulas.lateness(s.time, p)
        if s.at_rest:  # before the first sample the sensor showed the initial state
            before = s.time + late <= s.time[0]
            late = np.where(before, s.time[0] - s.time, late)
            by_number = np.where(before[:, None], 0.0, by_number)
        return late, by_number

    def inputs_of(self, s: Samples, times: Array | None = None) -> list[Array]:
        """Every input (m,) at instants of a stretch (by default its samples); delayed ones without their delay."""
        if not len(s.pieces):
            return []
        found = list(PPoly(s.pieces[:, :4].transpose(1, 2, 0), s.knots)(s.time if times is None else times).T)
        return [*found, *(found[which] for which, _ in self.formulas.late_inputs)]


def fitted_rows(s: Samples) -> Mask:
    """(n,) True for training samples; the others are held out."""
    if s.fit_until is not None:
        return np.asarray(s.time <= (s.fit_until or -np.inf), bool)
    return np.asarray(s.time - s.time[0] <= TRAIN_FRACTION * (s.time[-1] - s.time[0]), bool)


def cut(s: Samples, duration: float) -> list[Samples]:
    """A stretch in parts of this duration [s] that start with data; parts of twice the duration share their starts."""
    present = np.flatnonzero(np.isfinite(s.data).any(axis=1))
    new = np.flatnonzero(np.diff(np.floor((s.time[present] - s.time[0]) / duration))) + 1
    return [s.part(a, b) for a, b in pairwise([0, *present[new].tolist(), len(s.time)])]
