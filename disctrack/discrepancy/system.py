"""What can be diagnosed: anything with parameters, effects that it may lack, and a prediction with derivatives.

The engine (fit, score, held_out, search) knows no more of the world than this module; what the numbers mean is the
business of an adapter (`disctrack.diagnosis`, `examples`).
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from copy import copy
from dataclasses import dataclass
from typing import Protocol

import numpy as np

from calibration.kit.arrays import Array, Mask

Values = Mapping[str, float]


@dataclass(frozen=True)
class Quantity:
    """One number that a fit may move."""

    name: str
    unit: str
    scale: float  # a sensible step
    null: float = 0.0  # its value while the effect is absent
    lower: float = -np.inf
    upper: float = np.inf
    prior_sigma: float = np.inf  # about `null`; infinite: nothing is known beforehand
    meaning: str = ""
    typical: float = np.inf  # size that would surprise nobody; decides between explanations that fit alike
    linear: bool = False  # the prediction is linear in it with a derivative that is the same everywhere
    belongs_to: tuple[str, ...] = ()  # what must be the same in two recordings for them to share it; (): never shared
    declared: float | None = None  # beforehand, if only roughly: where a fit that was led far off may begin anew
    reciprocal: str = ""  # name of 1 / value, where people know the number by that
    # of one block of rows alone, without bounds: the column in which `linearise` gives the derivatives by all such
    # numbers, each in the rows of its own block
    slot: str = ""
    block: int = 0  # number of that block

    @property
    def owner(self) -> str:
        """The effect, law or part of the apparatus whose number this is: what stands before the first dot."""
        return self.name.partition(".")[0]

    @property
    def part(self) -> str:
        """Which of its owner's numbers this is."""
        return self.name.partition(".")[2]

    @property
    def is_initial(self) -> bool:
        """Does it belong to the state at the first instant, which matters to nobody else?"""
        return self.owner == "state"


@dataclass(frozen=True)
class Candidate:
    """An effect that the model may lack, with the numbers that would be fitted."""

    name: str  # unique
    effect: str  # name in the catalogue of effects; several candidates may be parts of one
    kind: str  # "motion" or "measurement"
    title: str
    source: str
    quantities: tuple[Quantity, ...]
    start: tuple[float, ...] = ()  # where a refit begins, if not at null
    shape: tuple[Quantity, ...] = ()  # of its law (an exponent, a scale): held at null until the effect is found
    sought: bool = False  # the first of its shape may lie anywhere: the system gives starts, the search leaves it out
    threshold: bool = False  # acts only beyond some value: at null it has no derivative, and the system gives starts

    @property
    def names(self) -> tuple[str, ...]:
        """Names of its quantities."""
        return tuple(q.name for q in self.quantities)


class System(Protocol):
    """Data, model, and the effects it may lack. Samples are rows in time; a row has one or more whitened numbers."""

    @property
    def time(self) -> Array:
        """(n,) instant of each sample [s], not decreasing."""

    @property
    def base(self) -> tuple[Quantity, ...]:
        """Quantities that every fit moves: initial conditions, declared laws, nuisances with priors."""

    @property
    def candidates(self) -> tuple[Candidate, ...]:
        """Effects that the model may lack."""

    def linearise(self, values: Values, names: Sequence[str]) -> tuple[Array, Array]:
        """Whitened residual (n, w), data minus prediction, zeros for missing data; its model's derivative (n, w, k).

        The derivative is that of the prediction: the residual after a step d is residual - derivative @ d. Not finite
        where there is no prediction.
        """

    @property
    def weights(self) -> Array:
        """(n,) how many numbers of each row are data."""

    def starts(self, candidate: Candidate, values: Values, least: float = 0.0) -> Sequence[tuple[float, ...]]:
        """Values from which refits of a candidate with a threshold begin, given a fit without it.

        Of any other: of its shape, where the system knows where to look; none, where the shape's range is tried.
        least : gain to first order, below which a shape that has to be looked for is worth no refit
        """


class GivenUp(Exception):
    """A hypothesis would take too long to follow: the one who put it forward goes on without it."""


class TrialGivenUp(GivenUp):
    """One of many hypotheses would take too long: the others are still to be tried."""


def hurried(system: System, share: float = 1.0) -> System:
    """The system as one trial among many sees it: raises TrialGivenUp where following it takes too long.

    share : of the time that a whole fit may take
    """
    of = getattr(system, "hurried", None)
    return system if of is None else of(share)


def several_minima(system: System) -> bool:
    """May fits of the same quantities end in different minima? Not where the system does not say so."""
    return bool(getattr(system, "several_minima", False))


def beginnings(system: System) -> Sequence[System]:
    """Parts of the system from its first sample on, shorter ones first; none where it does not give any."""
    return tuple(getattr(system, "beginnings", ()))


def blocks(system: System) -> Sequence[slice]:
    """Rows that may have quantities of their own (`engine.own`); none where the system does not say so."""
    return tuple(getattr(system, "blocks", ()))


def undo_each_other(system: System, candidates: Sequence[Candidate], values: Values, before: Values) -> bool:
    """Do some of these effects undo each other, or what the model has? Not where the system does not say so.

    values, before : as fitted with and without them
    """
    of = getattr(system, "undo_each_other", None)
    return of is not None and bool(of(candidates, values, before))


class Wrapped:
    """A system as another sees it: all as it is, but for what a subclass changes."""

    def __init__(self, system: System) -> None:
        self._system = system

    def over(self, system: System) -> Wrapped:
        """The same view of another system."""
        view = copy(self)
        view._system = system
        return view

    @property
    def time(self) -> Array:
        """(n,) instants of all samples [s]."""
        return self._system.time

    @property
    def base(self) -> tuple[Quantity, ...]:
        """As the system's."""
        return self._system.base

    @property
    def candidates(self) -> tuple[Candidate, ...]:
        """As the system's."""
        return self._system.candidates

    @property
    def weights(self) -> Array:
        """As the system's."""
        return self._system.weights

    def starts(self, candidate: Candidate, values: Values, least: float = 0.0) -> Sequence[tuple[float, ...]]:
        """As the system's."""
        return self._system.starts(candidate, values, least)

    @property
    def several_minima(self) -> bool:
        """As the system's: may fits of the same quantities end in different minima?"""
        return several_minima(self._system)

    @property
    def blocks(self) -> Sequence[slice]:
        """As the system's: rows that may have quantities of their own."""
        return blocks(self._system)

    def undo_each_other(self, candidates: Sequence[Candidate], values: Values, before: Values) -> bool:
        """As the system's."""
        return undo_each_other(self._system, candidates, values, before)

    def hurried(self, share: float) -> Wrapped:
        """As the system's."""
        return self.over(hurried(self._system, share))

    def linearise(self, values: Values, names: Sequence[str]) -> tuple[Array, Array]:
        """As the system's."""
        return self._system.linearise(values, names)


class Subset(Wrapped):
    """The first samples of a system, or any others: the rest counts as missing."""

    def __init__(self, system: System, rows: Mask) -> None:
        """Rows (n,) True where the sample belongs to the subset."""
        super().__init__(system)
        self._rows = rows
        self.whole, self.key = system, rows.tobytes()

    @property
    def weights(self) -> Array:
        """(n,) zero outside the subset."""
        return np.where(self._rows, super().weights, 0)

    def linearise(self, values: Values, names: Sequence[str]) -> tuple[Array, Array]:
        """As the whole system's, zeros outside the subset, even where there is no prediction."""
        residual, derivative = super().linearise(values, names)
        outside = ~self._rows
        residual, derivative = residual.copy(), derivative.copy()
        residual[outside], derivative[outside] = 0.0, 0.0
        return residual, derivative
