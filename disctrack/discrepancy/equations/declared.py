"""Declarations of the user: equations of motion, candidate terms, and runs of an experiment."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np
from numpy.typing import ArrayLike
from scipy.interpolate import CubicSpline

from calibration.kit.types import Array
from disctrack.discrepancy.equations.expressions import Formula, check_known, check_name
from disctrack.discrepancy.noise import SmoothNoise
from disctrack.errors import AnalysisError, told_as


@dataclass(frozen=True)
class Parameter:
    """A parameter of the model; in SI or any consistent units."""

    value: float  # initial guess of the fit; of a term: its value while the effect is absent
    unit: str = "1"
    sigma: float = np.inf  # standard deviation of a normal prior; infinite: no prior
    lower: float = -np.inf
    upper: float = np.inf
    per: str = ""  # "run": each run has a value of its own; a key of the runs' `groups`: each group has
    typical: float | None = None  # of a term: its typical size; None: a tenth of the rms of its equation
    shape: bool = False  # of a term: a shape parameter (an exponent, a scale), held at `value` until the term is found
    along: str = ""  # of a shape: a formula whose values along the motion are initial guesses (a limit, a speed)
    meaning: str = ""

    def __post_init__(self) -> None:
        if not np.isfinite(self.value) or not self.lower <= self.value <= self.upper or not self.sigma > 0:
            raise AnalysisError(
                f"a parameter needs a finite value within its bounds and a positive sigma; found value {self.value}, "
                f"bounds {self.lower} to {self.upper}, sigma {self.sigma}."
            )


@dataclass(frozen=True)
class Term:
    """A candidate term: something that the equations, or the models of the sensors, may lack.

    Its formulas are added to the declared ones; the values of its parameters (0 by default) are those of its absence.
    A parameter k may be written own_k in its formulas; then a plain k is the parameter of the equations.
    """

    name: str
    rates: Mapping[str, Formula] = field(default_factory=dict)  # by state: added to its equation
    observed: Mapping[str, Formula] = field(default_factory=dict)  # by channel: added to what the sensor shows
    clock: Formula = 0.0  # added to the recorded time of a sample, a formula in t
    lag: Mapping[str, Formula] = field(default_factory=dict)  # by channel: lag of the sensor [s]
    # by a name used in the rates: an input, and its delay [s]
    delayed: Mapping[str, tuple[str, Formula]] = field(default_factory=dict)
    parameters: Mapping[str, float | Parameter] = field(default_factory=dict)
    title: str = ""
    source: str = ""


@dataclass(frozen=True)
class Equations:
    """First-order differential equations, their parameters, and the models of the sensors.

    rates : by state, its time derivative; with `mass`, the right-hand side of M(y) dy/dt = rates
    parameters : value, or Parameter; all are fitted
    constants : are not fitted; a run may have its own
    inputs : measured signals that drive the motion; `u_rate` is the derivative of `u`
    observed : by channel of the data, what its sensor shows; by default the state of the same name
    mass : entries of M by pairs of states (symmetric; by default 1 on the diagonal and else 0)
    """

    rates: Mapping[str, Formula]
    parameters: Mapping[str, float | Parameter] = field(default_factory=dict)
    constants: Mapping[str, float] = field(default_factory=dict)
    inputs: Sequence[str] = ()
    observed: Mapping[str, Formula] | None = None
    mass: Mapping[tuple[str, str], Formula] = field(default_factory=dict)
    units: Mapping[str, str] = field(default_factory=dict)  # of states and channels
    name: str = "the declared equations"

    def __post_init__(self) -> None:
        groups = {
            "state": self.rates, "parameter": self.parameters, "constant": self.constants, "input": self.inputs,
        }  # fmt: skip
        seen: dict[str, str] = {}
        for what, names in groups.items():
            for name in names:
                check_name(name, what)
                if name in seen:
                    raise AnalysisError(f"{name!r} is declared twice, as {seen[name]} and as {what}.")
                seen[name] = what
        if not self.rates:
            raise AnalysisError("equations need at least one state: rates={'x': '-k*x'}.")
        for pair in self.mass:
            for name in pair:
                check_known(name, self.rates, f"mass {pair}")

    @property
    def states(self) -> tuple[str, ...]:
        """Names of the states, in the order of their equations."""
        return tuple(self.rates)

    def channels(self, run: "Run") -> Mapping[str, Formula]:
        """What is observed, by channel."""
        states = {name: name for name in run.data if name in self.rates}
        return states if self.observed is None else self.observed


@dataclass(frozen=True)
class Run:
    """Samples of one motion.

    time : (n,) [s], increasing, not necessarily even
    data : (n,) by channel; NaN where a sample is missing
    sigma : standard deviation of the noise by channel, a number or (n,); None, or a channel that is not named:
            estimated from differences of the data
    inputs : (m,) by input, without gaps
    input_time : (m,) [s] instants of the inputs, on the clock of `time` and from its first sample to its last; None:
            those of the samples
    constants : those that differ from the declared ones in this run
    start : initial guess of the states at the first sample, in place of an estimate from the data
    known : states at the first sample that are known: value, or (value, sigma)
    hold : interpolation of the inputs: "smooth" (cubic), "linear", or "hold" (zero-order hold)
    groups : what the run belongs to, by kind of group: {"ball": "golf"}; each ball has its own `Parameter(per="ball")`
    noise : autocorrelated noise of every channel, in place of sigma
    fit_until : [s] since the first sample; later samples are held out (by default those after 0.65 of the run). 0: all
            of them are held out, and only what no initial state can explain is judged
    at_rest : True where nothing moved before the first sample: then a sensor with a lag shows its first value
    """

    time: ArrayLike
    data: Mapping[str, ArrayLike]
    sigma: Mapping[str, ArrayLike] | float | None = None
    inputs: Mapping[str, ArrayLike] = field(default_factory=dict)
    constants: Mapping[str, float] = field(default_factory=dict)
    start: Mapping[str, float] = field(default_factory=dict)
    known: Mapping[str, float | tuple[float, float]] = field(default_factory=dict)
    name: str = ""
    hold: str = "smooth"
    groups: Mapping[str, str] = field(default_factory=dict)
    noise: SmoothNoise | None = None
    fit_until: float | None = None
    at_rest: bool = False
    input_time: ArrayLike | None = None

    def thinned(self, every: int) -> "Run":
        """One sample in `every`, with the inputs averaged over a quarter of the time between two of these.

        Without averaging, the input would be aliased.
        """
        time = np.asarray(self.time if self.input_time is None else self.input_time, float)
        own = len(time) / len(np.asarray(self.time))
        first = np.arange(0, len(time), max(1, int(own * every / 4)))

        def averaged(values: ArrayLike) -> Array:
            return np.asarray(np.add.reduceat(np.asarray(values, float), first) / np.diff([*first, len(time)]), float)

        def rows(values: ArrayLike) -> Array:
            return np.asarray(values, float)[::every]

        inputs, at = {u: averaged(values) for u, values in self.inputs.items()}, time[first]
        if self.hold != "hold":  # a mean belongs to the middle
            at = averaged(time)
            at[[0, -1]] = time[[0, -1]]
        sigma = self.sigma
        if isinstance(sigma, Mapping):
            sigma = {k: rows(v) if np.ndim(v) else v for k, v in sigma.items()}
        return replace(
            self, time=rows(self.time), data={k: rows(v) for k, v in self.data.items()}, sigma=sigma, inputs=inputs,
            input_time=at if inputs else None,
        )  # fmt: skip


@dataclass(frozen=True)
class Samples:
    """A checked run, or a stretch of one, as plain arrays."""

    run: str
    stretch: int  # index of its first sample in the run
    time: Array  # (n,) [s] since the run's first sample
    data: Array  # (n, w) NaN where missing
    sigma: Array  # (n, w)
    knots: Array  # (m,) [s] of the inputs
    pieces: Array  # (c, 5, m - 1) cubics, highest power first, and a further slope (of a step)
    constants: Mapping[str, float]
    known: Mapping[str, tuple[float, float]]  # states at the first sample, with sigmas; infinite: initial guesses
    groups: Mapping[str, str]  # by kind, "run" among them
    noise: SmoothNoise | None = None
    fit_until: float | None = None
    at_rest: bool = False  # before the first sample

    @property
    def name(self) -> str:
        """Run, and the number of its first sample if that is not 1; whatever its length."""
        return self.run if self.stretch == 0 else f"{self.run}#{self.stretch + 1}"

    def part(self, first: int, last: int) -> "Samples":
        """Samples first <= i < last as a stretch with an initial state of its own."""
        rows = slice(first, last)
        own = first == 0
        return replace(
            self, stretch=self.stretch + first, time=self.time[rows], data=self.data[rows], sigma=self.sigma[rows],
            known=self.known if own else {}, at_rest=self.at_rest and own,
        )  # fmt: skip


def checked(equations: Equations, runs: Sequence[Run]) -> list[Samples]:
    """Runs as plain arrays. Raises AnalysisError with the run, what was found and what was expected."""
    if not runs:
        raise AnalysisError("no run was given: Run(time, {'x': values}).")
    names = [run.name or f"run{i + 1}" for i, run in enumerate(runs)]
    if len(set(names)) < len(names):
        raise AnalysisError(f"runs need names of their own; found {', '.join(names)}.")
    channels = tuple(equations.channels(runs[0]))
    if not channels:
        raise AnalysisError(
            f"no channel of run {names[0]} ({', '.join(runs[0].data) or 'none'}) is a state "
            f"({', '.join(equations.states)}): say what is observed with observed={{'channel': 'formula'}}."
        )
    return [_checked_run(equations, run, name, channels) for run, name in zip(runs, names, strict=True)]


def _checked_run(equations: Equations, run: Run, name: str, channels: Sequence[str]) -> Samples:
    time = _column(run.time, f"run {name}, time")
    n = len(time)
    if n < 8 or not np.isfinite(time).all() or not np.all(np.diff(time) > 0):
        bad = int(np.argmin(np.diff(time))) + 1 if n > 1 and np.isfinite(time).all() else 0
        raise AnalysisError(
            f"run {name}: needs 8 samples or more at finite, increasing times; found {n}"
            + (f", and time[{bad}] = {time[bad]:g} after {time[bad - 1]:g}." if bad else ".")
        )
    if run.fit_until and np.sum(time - time[0] <= run.fit_until) < 8:
        raise AnalysisError(
            f"run {name}: fewer than 8 samples until fit_until = {run.fit_until:g} s; a fit needs them."
        )
    if not any(c in run.data for c in channels):
        raise AnalysisError(f"run {name}: no data for {', '.join(channels)}; there is {', '.join(run.data)}.")
    given: Any = {} if run.sigma is None else run.sigma
    if run.noise is not None:
        given = float(np.hypot(run.noise.white, run.noise.smooth))
    given = given if isinstance(given, Mapping) else dict.fromkeys(channels, given)
    wanted = {"start": equations.states, "known": equations.states, "constants": equations.constants}
    for what, known in (*wanted.items(), ("inputs", equations.inputs), ("sigma", channels)):
        for key in given if what == "sigma" else getattr(run, what):
            check_known(key, known, f"run {name}, {what}")
    data, sigma = np.full((2, n, len(channels)), np.nan)  # of sigma: to be found
    for i, c in enumerate(channels):
        if c in run.data:
            data[:, i] = _column(run.data[c], f"run {name}, {c}", n)
        if c in given:
            sigma[:, i] = given[c]
    if np.isinf(data).any():
        raise AnalysisError(f"run {name}: infinite values in the data; write NaN where a sample is missing.")
    if np.isfinite(data).any(axis=1).sum() < 8:
        raise AnalysisError(f"run {name}: fewer than 8 samples have data.")
    if np.any(sigma <= 0):
        raise AnalysisError(f"run {name}, sigma: must be positive.")
    known_states = {k: (float(v), np.inf) for k, v in run.start.items()}
    known_states |= {k: (v[0], v[1]) if isinstance(v, tuple) else (float(v), 0.0) for k, v in run.known.items()}
    knots, pieces = _inputs(equations, run, name, time)
    return Samples(
        name, 0, time - time[0], data, sigma, knots, pieces, dict(run.constants), known_states,
        {**run.groups, "run": name}, run.noise, run.fit_until, run.at_rest,
    )  # fmt: skip


def _inputs(equations: Equations, run: Run, name: str, time: Array) -> tuple[Array, Array]:
    if not equations.inputs:
        return np.zeros(0), np.zeros((0, 5, 0))
    begin, end = time[0], time[-1]
    if run.input_time is not None:
        time = _column(run.input_time, f"run {name}, input_time")
        spacing = float(np.max(np.diff(time), initial=0.0))
        if len(time) < 4 or not np.all(np.diff(time) > 0) or time[0] > begin or time[-1] < end - spacing:
            raise AnalysisError(
                f"run {name}, input_time: needs 4 increasing instants or more, from the first sample ({begin:g} s) to "
                f"the last ({end:g} s); found {len(time)}"
                + (f" from {time[0]:g} to {time[-1]:g} s." if len(time) else ".")
            )
    time = time - begin
    for u in equations.inputs:
        if u not in run.inputs:
            raise AnalysisError(f"run {name}: the input {u!r} is missing. Give it with inputs={{{u!r}: values}}.")
    values = np.array([_column(run.inputs[u], f"run {name}, input {u}", len(time)) for u in equations.inputs])
    if not np.isfinite(values).all():
        raise AnalysisError(f"run {name}: an input must be known at every sample; fill the gaps first.")
    pieces = np.zeros((len(values), 5, len(time) - 1))
    if run.hold == "smooth":
        pieces[:, :4] = CubicSpline(time, values, axis=1).c.transpose(2, 0, 1)
        return time, pieces
    if run.hold not in ("linear", "hold"):
        raise AnalysisError(f"run {name}: hold = {run.hold!r}; expected 'smooth', 'linear' or 'hold'.")
    pieces[:, 3] = values[:, :-1]
    if run.hold == "linear":
        pieces[:, 2] = np.diff(values, axis=1) / np.diff(time)
        return time, pieces
    changes = np.flatnonzero(np.any(np.diff(pieces[:, 3], axis=1) != 0, axis=0)) + 1
    # the derivative of a step is spread over the interval that it starts
    pieces[:, 4, changes] = (np.diff(pieces[:, 3], axis=1) / np.diff(time)[1:])[:, changes - 1]
    kept = np.unique(np.concatenate([[0], changes, changes + 1]))
    kept = kept[kept < len(time) - 1]
    return np.concatenate([time[kept], time[-1:]]), np.ascontiguousarray(pieces[:, :, kept])


def _column(values: ArrayLike, what: str, n: int | None = None) -> Array:
    """Numbers (n,). Raises AnalysisError."""
    with told_as(AnalysisError, f"{what}: not numbers", TypeError, ValueError):
        found = np.asarray(values, float)
    if found.ndim != 1:
        raise AnalysisError(f"{what}: expected one number per sample, found an array of shape {found.shape}.")
    if n is not None and len(found) != n:
        raise AnalysisError(f"{what}: {len(found)} values for {n} instants.")
    return found
