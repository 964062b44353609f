"""Equations and runs as a system that `diagnosis.engine` can diagnose."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from itertools import combinations, pairwise
from typing import Any

import numpy as np
from numpy.typing import NDArray

from calibration.kit.arrays import Array, Mask
from disctrack.discrepancy.equations import _ode_kernel as kernel
from disctrack.discrepancy.equations import _stiff_kernel
from disctrack.discrepancy.equations.declared import Parameter, Samples, Term
from disctrack.discrepancy.equations.formulas import Formulas
from disctrack.discrepancy.system import Candidate, Quantity, System, Values
from disctrack.errors import AnalysisError

TOLERANCE = 1e-10  # of a step, relative to the size of a state
LEAST_STEPS, STEPS_PER_SAMPLE, MAX_STEPS = 20_000, 50, 400_000  # after which a motion is given up
LOOK_AFTER = 0.1  # of these steps it is looked at, and given up if it ran away: it is then ...
RAN_AWAY = 1e6  # ... times larger than all its states are
UNDONE = 0.1  # share of the least term's power that a sum of terms keeps, below which they undo each other ...
LARGE = 5.0  # ... where each is so many times larger than all that moves the motion
TURNED = 2.0  # times larger that terms make a number whose sign is not the declared one, beyond which they bend it ...
TENTH = 0.1  # ... where its part is so much of all that moves the motion
MOST_STATES = 80  # initial states that are fitted along where others would tell no more that is new
EACH = "*"  # in the place of a stretch: each has a number of its own
FIRST_SHARE = 0.65  # of every stretch: what is fitted to it is judged on the rest


@dataclass(frozen=True)
class Prediction:
    """Motion and sensors over one stretch."""

    states: Array  # (n, n_states) at the true instants of the first channel
    seen: Array  # (n, w)
    derivative: Array  # (n, w, k)


class EquationSystem(System):
    """Samples of all stretches, one after the other, with a row without data between two of them."""

    several_minima = frees_shapes = True  # what users declare may bend anyhow

    def __init__(
        self, formulas: Formulas, stretches: Sequence[Samples], sizes: Array, widths: Mapping[str, float],
        promoted: Sequence[str] = (), held: Sequence[str] = (), typical: Mapping[str, float] | None = None,
        aims: Mapping[str, float] | None = None,
    ) -> None:  # fmt: skip
        """Make a system of stretches whose noise is known.

        sizes : (n,) of the states
        widths : of jumps
        promoted : terms that every fit has
        held : parameters that no fit moves
        typical : sizes of the terms' numbers that would surprise nobody
        aims : where the fit of a term begins that has a number tried along the motion
        """
        self.formulas, self.stretches = formulas, tuple(stretches)
        self.sizes, self.widths = np.asarray(sizes, float), dict(widths)
        self.promoted, self.held = tuple(promoted), tuple(held)
        self.typical, self.aims = dict(typical or {}), dict(aims or {})
        lengths = [len(s.time) for s in self.stretches]
        first = np.cumsum([0] + [n + 1 for n in lengths])
        self.rows = [slice(int(a), int(a) + n) for a, n in zip(first, lengths, strict=False)]
        self.blocks = self.rows
        n, w = int(first[-1]), len(formulas.channels)
        self.time, self.weights, self.training = np.zeros(n), np.zeros(n), np.zeros(n, bool)
        for rows, s in zip(self.rows, self.stretches, strict=True):
            elapsed = s.time - s.time[0]
            self.time[rows], self.time[rows.stop] = elapsed, elapsed[-1]
            self.weights[rows] = np.isfinite(s.data).sum(axis=1)
            self.training[rows] = fitted_rows(s)
        self._w = w
        self._defaults = formulas.defaults() | self.widths | self._limits()
        self._per = {name: p.per for name, (_, p) in formulas.fitted.items() if p.per}
        self.base = tuple(self._base())
        self.candidates = tuple(self._candidate(t) for t in formulas.terms if t.name not in self.promoted)

    def with_(self, **changes: object) -> EquationSystem:
        """The same with other stretches, promoted terms, ..."""
        given = {
            "formulas": self.formulas, "stretches": self.stretches, "sizes": self.sizes, "widths": self.widths,
            "promoted": self.promoted, "held": self.held, "typical": self.typical, "aims": self.aims,
        } | changes  # fmt: skip
        return EquationSystem(**given)  # type: ignore[arg-type]

    def _base(self) -> list[Quantity]:
        found = []
        several = len(self.stretches) > 1
        for i, s in enumerate(self.stretches):
            for name, size in zip(self.formulas.equations.states, self.sizes, strict=True):
                value, sigma = s.known.get(name, (s.start.get(name, 0.0), np.inf))
                if sigma > 0:
                    unit = self.formulas.equations.units.get(name, "1")
                    q = Quantity(f"state.{name}[{s.name}]", unit, 1e-3 * size, value, prior_sigma=sigma,
                                 meaning="at the first sample")  # fmt: skip
                    found.append(replace(q, slot=f"state.{name}[{EACH}]", block=i) if several else q)
        for name, (_, p) in self.formulas.fitted.items():
            term = name.partition(".")[0] if "." in name else ""
            if name in self.held or (p.shape and name not in self.aims) or (term and term not in self.promoted):
                continue
            found += self._with_slots(name, self._quantities(name, p)) if several else self._quantities(name, p)
        return found

    def _with_slots(self, name: str, quantities: Sequence[Quantity]) -> list[Quantity]:
        """With a slot where a number without bounds belongs to one stretch alone."""
        stretches: dict[str, list[int]] = {}
        for i, s in enumerate(self.stretches):
            stretches.setdefault(self._name(name, s), []).append(i)
        return [
            replace(q, slot=f"{name}[{EACH}]", block=stretches[q.name][0])
            if name in self._per and len(stretches[q.name]) == 1 and np.isinf([q.lower, q.upper]).all()
            else q
            for q in quantities
        ]

    def _quantities(self, name: str, p: Parameter) -> list[Quantity]:
        scale = 1e-3 * abs(p.value) or 1e-3 * self.typical.get(name, 1.0)
        typical = p.typical or self.typical.get(name, np.inf)
        names = list(dict.fromkeys(self._name(name, s) for s in self.stretches))
        declared = None if "." in name else p.value
        null = self._limits().get(name, p.value)
        return [
            Quantity(n, p.unit, scale, null, p.lower, p.upper, p.sigma, p.meaning, typical, declared=declared)
            for n in names
        ]

    def _name(self, name: str, s: Samples) -> str:
        """Of the quantity that a number is in a stretch. Raises AnalysisError where its run is in no such group."""
        if name not in self._per:
            return name
        kind = self._per[name]
        if kind not in s.groups:
            raise AnalysisError(f"run {s.run} needs groups={{{kind!r}: ...}}: {name} is declared for each {kind}.")
        return f"{name}[{s.groups[kind]}]"

    def _candidate(self, term: Term) -> Candidate:
        own = {n: p for n, (_, p) in self.formulas.fitted.items() if n.startswith(f"{term.name}.")}
        aimed = [n for n in own if n in self.aims]
        amounts = tuple(q for n, p in own.items() if not p.shape or n in aimed for q in self._quantities(n, p))
        shape = tuple(q for n, p in own.items() if p.shape and n not in aimed for q in self._quantities(n, p))
        kind = "measurement" if term.is_measurement else "motion"
        start = tuple(self.aims.get(q.name.partition("[")[0], q.null) for q in amounts) if aimed else ()
        return Candidate(term.name, term.name, kind, term.title or term.name, term.source, amounts, start, shape)

    def _limits(self) -> dict[str, float]:
        """Where the numbers lie that were tried along the motion: without their term's amount they move nothing."""
        return {n: v for n, v in self.aims.items() if n in self.formulas.along}

    def undo_each_other(self, candidates: Sequence[Candidate], values: Values, before: Values) -> bool:
        """Are there terms far larger than all that moves the motion, of which next to nothing is left together?

        Or terms that turn the sign of a declared number? Enough terms of opposite signs make any law, as polynomials
        do, over the motions that they were fitted to: such a sum describes them and says nothing of what acts.
        values, before : as fitted with and without the terms. One term alone is believed.
        """
        named = [c for c in candidates if c.kind != "measurement"]
        if len(candidates) < 2:
            return False
        n = range(len(named))
        sums = [own for k in n for own in combinations(n, k + 1)]
        declared = {q.name: q.declared for q in self.base if q.declared}
        turned = {k: 0.0 for k, d in declared.items() if values[k] * d < min(0.0, TURNED * before[k] * d)}
        absent = [{q.name: q.null for q in c.quantities} for c in named]
        all_of_it, of_turned = np.zeros((2, len(self.sizes)))
        powers = np.zeros((len(sums), len(self.sizes)))
        for s in self.stretches:
            found = self._predict(values, s, [])
            if found is None:
                return False
            rates, *without = (
                self._rates(s, self.numbers(dict(values) | changed, s), s.time, found.states)[0]
                for changed in ({}, turned, *absent)
            )
            acting = [rates - r for r in without]
            all_of_it = all_of_it + np.sum(rates**2, axis=0)
            of_turned = of_turned + np.sum(acting[0] ** 2, axis=0)
            for power, own in zip(powers, sums, strict=True):
                power += np.sum(sum(acting[i + 1] for i in own) ** 2, axis=0)
        if np.any(of_turned > TENTH**2 * all_of_it):
            return True
        if len(named) < 2:
            return False
        least = np.array([powers[[sums.index((i,)) for i in own]].min(axis=0) for own in sums])
        several = np.array([len(own) > 1 for own in sums])
        return bool(np.any((powers < UNDONE * least) & (least > LARGE**2 * all_of_it) & several[:, None]))

    def linearise(self, values: Values, names: Sequence[str]) -> tuple[Array, Array]:
        """Whitened residual (n, w), data minus prediction, and the prediction's derivative (n, w, k)."""
        residual = np.zeros((len(self.time), self._w))
        derivative = np.zeros((len(self.time), self._w, len(names)))
        for rows, s in zip(self.rows, self.stretches, strict=True):
            mine = [(i, own) for i, name in enumerate(names) if (own := self._own(name, s)) is not None]
            found = self._predict(values, s, [own for _, own in mine])
            if found is None:
                return np.full_like(residual, np.nan), np.full_like(derivative, np.nan)
            columns = [i for i, _ in mine]
            present = np.isfinite(s.data)
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

    def predictions(self, values: Values) -> list[Prediction | None]:
        """What every stretch should show; None where the motion cannot be followed to its end."""
        return [self._predict(values, s, []) for s in self.stretches]

    def predict(self, values: Values, s: Samples, names: Sequence[str]) -> Prediction | None:
        """As `predictions`, of one stretch with its derivatives by quantities that it has (`names_of`)."""
        own = [self._own(name, s) for name in names]
        return self._predict(values, s, [number for number in own if number is not None])

    def names_of(self, s: Samples) -> set[str]:
        """Quantities that move a stretch."""
        states = (f"state.{name}[{s.name}]" for name in self.formulas.equations.states)
        return {*states, *(self._name(name, s) for name in self.formulas.fitted)}

    def _own(self, name: str, s: Samples) -> int | None:
        """Which number of a stretch a quantity is: its place in p, or -1 - i for the i-th state at the start."""
        stem, bracket, rest = name.partition("[")
        where = rest.rstrip("]")
        if stem.startswith("state."):
            if where not in (s.name, EACH):
                return None
            return -1 - self.formulas.equations.states.index(stem.removeprefix("state."))
        if bracket and where != EACH and self._name(stem, s) != name:
            return None
        return self.formulas.names.index(stem)

    def numbers(self, values: Values, s: Samples) -> Array:
        """(n_p,) all numbers of a stretch."""
        known = self._defaults | dict(s.constants)
        return np.array([values.get(self._name(n, s), values.get(n, v)) for n, v in known.items()], float)

    def start_of(self, values: Values, s: Samples) -> Array:
        """(n,) states at the first sample."""
        fallback = {k: v for k, (v, _) in s.known.items()}
        return np.array(
            [
                values.get(f"state.{n}[{s.name}]", fallback.get(n, s.start.get(n, 0.0)))
                for n in self.formulas.equations.states
            ],
            float,
        )

    def _predict(self, values: Values, s: Samples, own: Sequence[int]) -> Prediction | None:
        f = self.formulas
        n, k, m = len(f.states), len(own), len(s.time)
        p = self.numbers(values, s)
        z0 = np.zeros(n * (1 + k))
        z0[:n] = self.start_of(values, s)
        for c, which in enumerate(own):
            if which < 0:
                z0[n * (1 + c) + (-1 - which)] = 1.0
        columns = np.array([max(which, -1) for which in own], np.int64)
        by_number, group_of, times = self._instants(s, p)
        knots, pieces = f.driven(s.knots, s.pieces, p)
        out = followed(f.rhs, z0, p, columns, (s.time[0], max(float(times.max()), s.time[0] + 1e-9)), knots, pieces,
                       self.sizes, times)  # fmt: skip
        if out is None:
            return None
        seen, derivative = np.zeros((m, self._w)), np.zeros((m, self._w, k))
        h, H_y, H_p = np.zeros((m, self._w)), np.zeros((m, self._w, n)), np.zeros((m, self._w, len(p)))
        for g in range(len(times)):
            states = np.ascontiguousarray(out[g, :, :n])
            kernel.observe_all(f.observe, times[g], states, p, knots, pieces, h, H_y, H_p)
            channels = [c for c in range(self._w) if group_of[c] == g]
            seen[:, channels] = h[:, channels]
            if k == 0:
                continue
            moved = out[g, :, n:].reshape(m, k, n)
            for c in channels:
                derivative[:, c] = np.einsum("mn,mkn->mk", H_y[:, c], moved)
                for j, which in enumerate(own):
                    if which >= 0:
                        derivative[:, c, j] += H_p[:, c, which]
            if f.is_late:
                slope = np.einsum("mwn,mn->mw", H_y, self._rates(s, p, times[g], states)[0])
                for j, which in enumerate(own):
                    if 0 <= which < by_number.shape[1]:
                        with np.errstate(invalid="ignore"):  # a motion that ran away has no slope
                            derivative[:, channels, j] += slope[:, channels] * by_number[channels, which].T
        return Prediction(out[0, :, :n], seen, derivative)

    def _instants(self, s: Samples, p: Array) -> tuple[Array, list[int], Array]:
        """Derivatives (w, n_fitted, m) of the lateness, each channel's group of instants, and the groups (g, m)."""
        if not self.formulas.is_late:
            return np.zeros((self._w, 0, 0)), [0] * self._w, s.time[None].copy()
        late, by_number = self.formulas.lateness(s.time, p)
        if s.at_rest:  # what was shown before the motion began is what is shown as it begins
            before = s.time + late <= s.time[0]
            late = np.where(before, s.time[0] - s.time, late)
            by_number = np.where(before[:, None], 0.0, by_number)
        groups: list[int] = []
        group_of = []
        for c in range(self._w):
            same = next((g for g, first in enumerate(groups) if np.array_equal(late[c], late[first])), None)
            if same is None:
                groups.append(c)
                same = len(groups) - 1
            group_of.append(same)
        return by_number, group_of, np.ascontiguousarray(s.time + late[groups])

    def inputs_of(self, s: Samples, times: Array | None = None) -> list[Array]:
        """Every input (m,) at instants of a stretch (at its samples, if not said); late ones as if they were not."""
        times = s.time if times is None else times
        if not len(s.pieces):
            return []
        piece = np.clip(np.searchsorted(s.knots, times, side="right") - 1, 0, len(s.knots) - 2)
        x = times - s.knots[piece]
        found = [((a * x + b) * x + c) * x + d for a, b, c, d, _ in s.pieces[:, :, piece]]
        return [*found, *(found[which] for which, _ in self.formulas.late_inputs)]

    def along(self, values: Values, s: Samples) -> tuple[Array, Array, Array, Array]:
        """Rates (m, n), their derivatives (m, n, n_p), sensors (m, w), theirs (m, w, n_p) along a stretch's motion."""
        p, m = self.numbers(values, s), len(s.time)
        found = self._predict(values, s, [])
        states = np.zeros((m, len(self.formulas.states))) if found is None else found.states
        rates, by_number = self._rates(s, p, s.time, states)
        h, H_y, H_p = np.zeros((m, self._w)), np.zeros((m, self._w, states.shape[1])), np.zeros((m, self._w, len(p)))
        states = np.ascontiguousarray(states)
        knots, pieces = self.formulas.driven(s.knots, s.pieces, p)
        kernel.observe_all(self.formulas.observe, s.time, states, p, knots, pieces, h, H_y, H_p)
        return rates, by_number, h, H_p

    def _rates(self, s: Samples, p: Array, times: Array, states: Array) -> tuple[Array, Array]:
        """Rates (m, n) and their derivatives (m, n, n_p) along a motion."""
        rates, by_number = np.zeros(states.shape), np.zeros((*states.shape, len(p)))
        knots, pieces = self.formulas.driven(s.knots, s.pieces, p)
        kernel.rates_all(self.formulas.rhs, times, np.ascontiguousarray(states), p, knots, pieces, rates, by_number)
        return rates, by_number


def followed(
    rhs: Any, z: Array, p: Array, columns: NDArray[np.int64], span: tuple[float, float], knots: Array, pieces: Array,
    sizes: Array, times: Array,
) -> Array | None:  # fmt: skip
    """Motion with its sensitivities (groups, m, len(z)) at times (groups, m); None where it has no end.

    By an explicit method, and by an implicit one for as long as the equations are stiff: a friction that holds.
    """
    n, k = len(sizes), len(columns)
    out = np.empty((*times.shape, len(z)))
    at, largest, pointer = np.array([*span, 0.0]), np.zeros(k), np.zeros(len(times), np.int64)
    left = min(max(LEAST_STEPS, STEPS_PER_SAMPLE * times.shape[1]), MAX_STEPS)
    portion = int(LOOK_AFTER * left)
    with np.errstate(all="ignore"):
        while True:
            done, steps = kernel.integrate(
                rhs, z, p, columns, at, n, knots, pieces, sizes, TOLERANCE, min(portion, left), largest, pointer,
                times, out,
            )  # fmt: skip
            if done == kernel.TOO_MANY_STEPS and steps > 0 and left > portion:
                if np.abs(z[:n]).max() > RAN_AWAY * sizes.max():
                    return None
                left -= portion
                continue
            left -= steps
            if done == kernel.STIFF_CHANGES:
                _stiff_kernel.prepare()
                done, steps = _stiff_kernel.integrate(
                    rhs, z, p, columns, at, n, knots, pieces, sizes, left, pointer, times, out
                )
                left -= steps
            if done != kernel.STIFF_CHANGES:
                return out if done == kernel.DONE else None


def fitted_rows(s: Samples) -> Mask:
    """(n,) True for the samples to which a fit is made that the others judge."""
    if s.fit_until is not None:
        return np.asarray(s.time <= (s.fit_until or -np.inf), bool)
    return np.asarray(s.time - s.time[0] <= FIRST_SHARE * (s.time[-1] - s.time[0]), bool)


def cut(samples: Sequence[Samples], duration: float) -> list[Samples]:
    """Every run in stretches no longer than `duration` [s], of equal lengths."""
    found = []
    for s in samples:
        count = max(1, int(np.ceil((s.time[-1] - s.time[0]) / duration * (1 - 1e-9))))
        edges = np.searchsorted(s.time, s.time[0] + (s.time[-1] - s.time[0]) * np.arange(count + 1) / count)
        edges[-1] = len(s.time)
        found += [s.part(int(a), int(b), i) for i, (a, b) in enumerate(pairwise(edges)) if b - a >= 4]
    return found


def spread(samples: Sequence[Samples], n_states: int, at_least: int = 1) -> list[Samples]:
    """As many stretches as have MOST_STATES initial states together, evenly from first to last; or at least so many."""
    most = max(at_least, MOST_STATES // n_states)
    return [samples[i] for i in np.unique(np.linspace(0, len(samples) - 1, min(most, len(samples))).astype(int))]


def first_part(samples: Sequence[Samples], duration: float) -> list[Samples]:
    """Every stretch, no further than `duration` [s] from its start, but 8 samples at least."""
    found = []
    for s in samples:
        n = max(8, int(np.searchsorted(s.time, s.time[0] + duration, side="right")))
        found.append(replace(s, time=s.time[:n], data=s.data[:n], sigma=s.sigma[:n]))
    return found
