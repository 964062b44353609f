"""Declared equations and terms, differentiated and compiled: rates, sensors and clock as functions of parameters."""

import math
from collections.abc import Iterable, Mapping, Sequence
from functools import cached_property, lru_cache
from typing import Any

import numpy as np
import sympy
from numba.core.types import CompileResultWAP

from calibration.kit.compiled import compiled, function_of, njit
from calibration.kit.types import Array
from disctrack.discrepancy.equations import _ode_kernel as kernel
from disctrack.discrepancy.equations.declared import Equations, Parameter, Samples, Term
from disctrack.discrepancy.equations.expressions import Formula, check_known, check_name, parsed, smooth, source_of
from disctrack.errors import AnalysisError

OWN = "own_"  # prefix of a term's parameters in its formulas, where the equations use the same name


_t = sympy.Symbol("t", real=True)


class Formulas:
    """Symbolic equations with all terms added; compiled at first use.

    Numbers come in one array p: parameters of the model, of the terms, constants, widths of jumps.
    """

    def __init__(self, equations: Equations, terms: Sequence[Term], channels: Mapping[str, Formula]) -> None:
        """Read and check every formula. Raises AnalysisError."""
        self.equations, self.terms, self.channels = equations, tuple(terms), channels
        states, inputs = _symbols(equations.rates), _symbols(equations.inputs)
        input_rates = _symbols(f"{name}_rate" for name in equations.inputs)
        self.constants, own = _symbols(equations.constants), _symbols(equations.parameters)
        self.states, self.inputs = tuple(states.values()), tuple(inputs.values())
        self.input_rates = tuple(input_rates.values())
        # parameters, by name of the quantity: symbol, declaration, and the term to which it belongs
        self.fitted, self.owner = dict(own), dict.fromkeys(own, "")
        self.declared = {name: _parameter(p) for name, p in equations.parameters.items()}
        still = {"t": _t, **input_rates, **self.constants, **own}
        self._numbers = {**self.constants, **own}  # symbols that do not depend on time
        self._still, self._words = still, {**still, **states, **inputs}
        # as declared: without terms, and not divided by the masses
        self.forces = tuple(parsed(f, self._words, f"equation of {name}") for name, f in equations.rates.items())
        masses = {pair: parsed(f, self._words, f"mass {pair}") for pair, f in equations.mass.items()}
        self.masses = tuple(masses.values())
        self._rates = dict(zip(states, self.forces, strict=True))
        self._seen = {c: parsed(f, self._words, f"observed {c}") for c, f in channels.items()}
        # a term of a sensor may use the channel's name for its declared formula, unless a state has that name
        self._shown = {symbol: self._seen[c] for c, symbol in _symbols(channels).items() if c not in self._words}
        # by channel: true minus recorded instant, in t and parameters
        self._late = dict.fromkeys(channels, sympy.Integer(0))
        self.along: dict[str, sympy.Expr] = {}  # by name of a shape: formula of its initial guesses along the motion
        # the delayed inputs, which follow the others: index of the input, and delay [s]
        self.late_inputs: list[tuple[int, sympy.Expr]] = []
        for number, term in enumerate(terms, start=1):
            if term.name in {t.name for t in terms[: number - 1]} or "[" in term.name or "." in term.name:
                raise AnalysisError(f"term {term.name!r}: needs a name of its own, without '.' and '['.")
            self._add(term, f"term{number}_")
        self.late = tuple(self._late.values())
        self.is_late = any(e != 0 for e in self.late)  # does a term change the instants of the samples?
        self.widths: dict[sympy.Expr, sympy.Symbol] = {}  # of jumps, by their argument
        moving = set(self.states)
        rates = [smooth(e, self.widths, moving) for e in self._rates.values()]
        self.rates = tuple(_solved(list(states), masses, rates))
        self.observed = tuple(smooth(e, self.widths, moving) for e in self._seen.values())
        # symbols of all entries of p, by name
        self.numbers = self.fitted | self.constants | {s.name: s for s in self.widths.values()}

    def _add(self, term: Term, prefix: str) -> None:
        """Add a term's formulas to rates, sensors and clocks; symbols of its parameters have the prefix."""
        here, mine = f"term {term.name}", {name: _symbol(f"{prefix}{name}") for name in term.parameters}
        for name, p in term.parameters.items():
            check_name(name, f"parameter of term {term.name}")
            quantity = f"{term.name}.{name}"
            self.fitted[quantity], self.declared[quantity] = mine[name], _parameter(p)
            self.owner[quantity] = term.name
            if isinstance(p, Parameter) and p.along:
                self.along[quantity] = parsed(p.along, self._words, f"{here}, {name} along")
        marked = {f"{OWN}{name}": s for name, s in mine.items()}
        written = [*term.rates.values(), *term.observed.values(), *term.lag.values(), term.clock]
        # where a term marks its own parameters, other names are those of the equations
        mine = marked if any(OWN in str(f) for f in written) else mine | marked
        before: dict[str, sympy.Symbol] = {}
        for name, (u, f) in term.delayed.items():
            check_name(name, f"late input of term {term.name}")
            check_known(u, self.equations.inputs, f"{here}, delayed {name}")
            delay = parsed(f, {**self._numbers, **mine}, f"{here}, delay of {u}")
            self.late_inputs.append((list(self.equations.inputs).index(u), delay))
            symbol = _symbol(f"{prefix}late_{name}")
            self.inputs += (symbol,)
            self.input_rates += (_symbol(f"{prefix}late_{name}_rate"),)
            before |= {name: symbol, f"{OWN}{name}": symbol}
        for name, f in term.rates.items():
            check_known(name, self._rates, f"{here}, rates")
            self._rates[name] += parsed(f, {**self._words, **mine, **before}, f"{here}, rate of {name}")
        for name, f in term.observed.items():
            check_known(name, self._seen, f"{here}, observed")
            names = {**{s.name: s for s in self._shown}, **self._words, **mine}
            self._seen[name] += parsed(f, names, f"{here}, observed {name}").xreplace(self._shown)
        clock = parsed(term.clock, {**self._still, **mine}, f"{here}, clock")
        for c in self._late:
            self._late[c] += clock
        for name, f in term.lag.items():
            check_known(name, self._late, f"{here}, lag")
            self._late[name] -= parsed(f, {**self._still, **mine}, f"{here}, lag of {name}")

    @cached_property
    def rhs(self) -> Any:
        """Compiled rates with derivatives (`_ode_kernel.RHS`)."""
        return self._compiled("rates_", self.rates)

    @cached_property
    def _observe(self) -> Any:
        return self._compiled("sensors_", self.observed)

    def rates_at(self, s: Samples, p: Array, times: Array, states: Array) -> tuple[Array, Array, Array]:
        """Rates (m, n) at instants (m,) in states (m, n), and their derivatives (m, n, n), (m, n, n_p)."""
        return self._evaluated(self.rhs, len(self.states), s, p, times, states)

    def sensors_at(self, s: Samples, p: Array, times: Array, states: Array) -> tuple[Array, Array, Array]:
        """Sensor values (m, w) at instants (m,) in states (m, n), and their derivatives (m, w, n), (m, w, n_p)."""
        return self._evaluated(self._observe, len(self.channels), s, p, times, states)

    def _evaluated(
        self, function: Any, width: int, s: Samples, p: Array, times: Array, states: Array
    ) -> tuple[Array, Array, Array]:
        (m, n), (knots, pieces) = states.shape, self.driven(s.knots, s.pieces, p)
        values, by_state, by_number = np.zeros((m, width)), np.zeros((m, width, n)), np.zeros((m, width, len(p)))
        states = np.ascontiguousarray(states)
        kernel.evaluate(function, times, states, p, knots, pieces, values, by_state, by_number)
        return values, by_state, by_number

    def _compiled(self, name: str, formulas: Sequence[sympy.Expr]) -> Any:
        by_state = [[e.diff(y) for y in self.states] for e in formulas]
        by_number = [[self._by_number(e, s) for s in self.fitted.values()] for e in formulas]
        arrays = {"y_": self.states, "p_": [*self.numbers.values()], "u_": self.inputs, "u_rates_": self.input_rates}
        outputs = {"f_": formulas, "J_": by_state, "P_": by_number}
        return _compiled_source(source_of(name, arrays, outputs), name)

    def _by_number(self, formula: sympy.Expr, number: sympy.Symbol) -> sympy.Expr:
        """Derivative of a formula by a parameter, which may also be the delay of an input."""
        found = formula.diff(number)
        first = len(self.inputs) - len(self.late_inputs)
        for u, rate, (_, late) in zip(self.inputs[first:], self.input_rates[first:], self.late_inputs, strict=True):
            found -= formula.diff(u) * rate * late.diff(number)
        return found

    def driven(self, knots: Array, pieces: Array, p: Array) -> tuple[Array, Array]:
        """Inputs of a run (`declared.Samples`) followed by the delayed ones, for parameters p."""
        if not self.late_inputs:
            return knots, pieces
        return _with_late(knots, pieces, [which for which, _ in self.late_inputs], np.array(self._how_late(p), float))

    @cached_property
    def _how_late(self) -> Any:
        return sympy.lambdify(([*self.numbers.values()],), [late for _, late in self.late_inputs], "numpy")

    @cached_property
    def lateness(self) -> Any:
        """(t (m,), p) -> true minus recorded instant (w, m) and its derivatives (w, n_fitted, m); NumPy."""
        fitted = list(self.fitted.values())
        flat = [*self.late, *(e.diff(s) for e in self.late for s in fitted)]
        function = sympy.lambdify((_t, [*self.numbers.values()]), flat, "numpy")

        def evaluate(time: Array, p: Array) -> tuple[Array, Array]:
            w, values = len(self.late), np.array([np.broadcast_to(x, time.shape) for x in function(time, p)], float)
            return values[:w], values[w:].reshape(w, len(fitted), len(time))

        return evaluate

    def along_motion(
        self, expressions: Iterable[sympy.Expr], t: Array, states: Array, p: Array, u: Sequence[Array]
    ) -> list[Array]:
        """Values (m,) of each expression at instants t (m,), in states (m, n), with inputs u."""
        arguments = _t, self.states, [*self.numbers.values()], self.inputs
        function = sympy.lambdify(arguments, list(expressions), "numpy")
        with np.errstate(all="ignore"):
            return [np.broadcast_to(x, t.shape) for x in function(t, list(states.T), p, u)]

    def defaults(self) -> dict[str, float]:
        """Declared values of all entries of p; the widths of jumps are 1 until they are known."""
        found = {name: p.value for name, p in self.declared.items()} | dict(self.equations.constants)
        return found | {s.name: 1.0 for s in self.widths.values()}


def _symbol(name: str) -> sympy.Symbol:
    return sympy.Symbol(name, real=True)


def _symbols(names: Iterable[str]) -> dict[str, sympy.Symbol]:
    return {name: _symbol(name) for name in names}


def _with_late(knots: Array, pieces: Array, which: list[int], late: Array) -> tuple[Array, Array]:
    """Inputs followed by delayed copies of some of them, on common knots.

    knots (m,), pieces (c, 5, m - 1) : as `declared.Samples` has them
    which : index of the input that each late one is;  late : (len(which),) [s]
    Before its first sample an input is what it is there, and after its last one what it is then.
    """
    both = np.concatenate([pieces, pieces[which]])
    if not np.any(late):
        return knots, both
    shared = np.unique(np.concatenate([knots, *(knots + s for s in late)]))
    # knots that differ by rounding errors are one: an integration step could not fit between them
    shared = shared[np.concatenate([[True], np.diff(shared) > 1e-9 * np.median(np.diff(knots))])]
    shared = shared[(shared >= knots[0]) & (shared <= knots[-1])]
    found = np.zeros((len(both), 5, len(shared) - 1))
    middle = (shared[1:] + shared[:-1]) / 2
    for c, s in enumerate(np.concatenate([np.zeros(len(pieces)), late])):
        piece = np.searchsorted(knots[1:-1], middle - s, side="right")
        a, b, d, e, step = both[c][:, piece]
        x = np.clip(shared[:-1] - s, knots[0], knots[-1]) - knots[piece]
        found[c] = a, 3 * a * x + b, (3 * a * x + 2 * b) * x + d, ((a * x + b) * x + d) * x + e, step
        found[c][[0, 1, 2, 4]] *= (middle - s > knots[0]) & (middle - s < knots[-1])
    return shared, found


def _solved(
    states: list[str], masses: Mapping[tuple[str, str], sympy.Expr], forces: list[sympy.Expr]
) -> list[sympy.Expr]:
    """M^-1 forces, where masses are declared."""
    M = sympy.eye(len(states))
    for (a, b), mass in masses.items():
        i, j = states.index(a), states.index(b)
        M[i, j] = M[j, i] = mass
    return list(M.LUsolve(sympy.Matrix(forces))) if masses else forces


def _parameter(given: float | Parameter) -> Parameter:
    return given if isinstance(given, Parameter) else Parameter(float(given))


@lru_cache(maxsize=64)
def _compiled_source(source: str, name: str) -> Any:
    """Compiled once for the same equations, however many runs there are."""
    kernel.prepare()
    scope: dict[str, object] = {k: getattr(math, k) for k in dir(math) if not k.startswith("_")}
    found = compiled(njit, kernel.RHS, function_of(source, name, scope), nogil=True)
    # its address is looked up once: at every call, that would take as long as the integration of a short stretch
    return CompileResultWAP(found.get_compile_result(kernel.RHS))
