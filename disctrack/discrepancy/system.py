"""Interface of what can be diagnosed: parameters, candidate effects, and a prediction with its derivatives.

The engine (fit, score, held_out, search) depends on this interface alone; adapters give the numbers their meaning
(`disctrack.diagnosis`, `examples`).
"""

from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass

import numpy as np

from calibration.kit.types import Array, Mask

Values = Mapping[str, float]
USED_UP = "the search ended when its work was used up: not all that may be missing was tried"
Transform = Callable[[Array], Array]  # linear map of the rows of [residual | derivative] (n, w, 1 + k)


@dataclass(frozen=True)
class Quantity:
    """One parameter of a fit."""

    name: str
    unit: str
    scale: float  # a sensible step
    null: float = 0.0  # its value while the effect is absent
    lower: float = -np.inf
    upper: float = np.inf
    prior_sigma: float = np.inf  # of a normal prior about `null`; infinite: no prior
    meaning: str = ""
    typical: float = np.inf  # scale of the heavy-tailed prior that decides between explanations that fit equally well
    linear: bool = False  # the prediction is linear in it, with a derivative that is the same everywhere
    belongs_to: tuple[str, ...] = ()  # what must be the same in two recordings for them to share it; (): never shared
    declared: float | None = None  # rough value known beforehand: where a fit that went far off may be started again
    reciprocal: str = ""  # name of 1 / value, where that is the usual quantity
    # of a parameter that moves one block of rows alone, and has no bounds: the column in which `linearise` gives the
    # derivatives by all such parameters, each in the rows of its own block
    slot: str = ""
    block: int = 0  # number of that block

    @property
    def owner(self) -> str:
        """The effect, law or part of the apparatus to which it belongs: the name up to the first dot."""
        return self.name.partition(".")[0]

    @property
    def part(self) -> str:
        """Which of its owner's parameters it is: the name after the first dot."""
        return self.name.partition(".")[2]

    @property
    def stem(self) -> str:
        """Its name without the run or group to which it belongs."""
        return self.name.partition("[")[0]

    @property
    def is_initial(self) -> bool:
        """Is it a component of the initial state?"""
        return self.owner == "state"


@dataclass(frozen=True)
class Candidate:
    """An effect that the model may lack, with the parameters that would be fitted."""

    name: str  # unique
    effect: str  # name in the catalogue of effects; several candidates may be parts of one
    kind: str  # "motion" or "measurement"
    title: str
    source: str
    quantities: tuple[Quantity, ...]
    shape: tuple[Quantity, ...] = ()  # shape parameters (an exponent, a scale): held at null until the effect is found
    sought: bool = False  # its first shape parameter may lie anywhere: refitted from the starts of the system only
    threshold: bool = False  # acts beyond a threshold: no derivative at null; refitted from the starts of the system

    @property
    def names(self) -> tuple[str, ...]:
        """Names of its parameters."""
        return tuple(q.name for q in self.quantities)


class GivenUp(Exception):
    """The fit of one hypothesis among many takes too much work; it is skipped."""


class Budget:
    """Limit of the computational work, in the system's own units; systems may share it.

    Work instead of time, so that an answer does not depend on the machine. When it is used up no further hypothesis is
    tested, and the answer is the best of those that were. A single trial that takes too much is abandoned.
    """

    def __init__(self, work: float = np.inf) -> None:
        """Unlimited by default."""
        self._left = self._whole = float(work)
        self.trial_left = np.inf  # work until the trial is abandoned

    def open(self, kept: float = 0.0) -> bool:
        """May another hypothesis be tested, if the share `kept` of the budget is reserved for others?"""
        return np.isinf(self._whole) or self._left > kept * self._whole

    def work(self, done: float) -> None:
        """Count work. Raises GivenUp when that of a trial is used up."""
        self._left -= done
        self.trial_left = max(self.trial_left - done, 0.0)
        if self.trial_left == 0.0:
            raise GivenUp

    @contextmanager
    def trial(self, work: float) -> Iterator[None]:
        """Context of one trial that may take so much work; a nested trial is limited by the outer one, too."""
        outer, inner = self.trial_left, min(self.trial_left, work)
        self.trial_left = inner
        try:
            yield
        finally:
            self.trial_left = outer if np.isinf(outer) else outer - (inner - self.trial_left)


class System:
    """Data, model, and candidate effects. A row is a sample in time, and holds one or more whitened residuals.

    A subclass sets the first four attributes and implements `linearise`; the rest has defaults.
    """

    time: Array  # (n,) instant of each sample [s], not decreasing
    weights: Array  # (n,) number of data in each row
    base: tuple[Quantity, ...]  # parameters of every fit: initial conditions, declared laws, nuisances with priors
    candidates: tuple[Candidate, ...]  # effects that the model may lack
    budget: Budget = Budget()
    trial_work: float = np.inf  # limit of one trial
    several_minima: bool = False  # may fits of the same parameters end in different local minima?
    frees_shapes: bool = False  # are shape parameters fitted where no law in its standard shape fits?
    blocks: Sequence[slice] = ()  # rows that may have parameters of their own (`discrepancy.elimination`)

    def linearise(self, values: Values, names: Sequence[str]) -> tuple[Array, Array]:
        """Whitened residuals (n, w), data minus prediction; and the derivative (n, w, k) of the prediction.

        The residual after a step d is residual - derivative @ d. Missing data are zeros; not finite where there is no
        prediction.
        """
        raise NotImplementedError

    def starts(self, candidate: Candidate, values: Values, least: float = 0.0) -> Sequence[tuple[float, ...]]:
        """Initial guesses of a candidate with a threshold (one or none), given the values of a fit without it.

        Of any other candidate: initial guesses of its shape; none where a grid over the shape's range is tried.
        least : first-order gain, below which a shape is not worth a refit
        """
        return ()

    def together(self, values: Values, width: int) -> Array:
        """(n, w, b) orthonormal directions in which the residuals of a row may have common errors; all by default."""
        return np.tile(np.eye(width), (len(self.weights), 1, 1))

    def beginnings(self) -> "Iterable[System]":
        """The system restricted to longer and longer first parts of the data."""
        return ()

    @property
    def known_as(self) -> "tuple[System, bytes]":
        """Key of cached results: the underlying system, and which of its rows these are."""
        return self, b""

    def over(self, system: "System") -> "System":
        """Another system with the transformation of this one applied to its rows."""
        return system


class Transformed(System):
    """A system with a linear map applied to its rows: a subset of them, or whitened ones."""

    def __init__(self, system: System, transform: Transform, kept: Mask | None = None) -> None:
        """Kept : (n,) True in rows that are kept; all by default."""
        for name in System.__annotations__:
            setattr(self, name, getattr(system, name))
        if kept is not None:
            self.weights = np.where(kept, system.weights, 0)
        self._system, self._transform, self._kept = system, transform, kept

    @property
    def known_as(self) -> tuple[System, bytes]:
        """See System."""
        return (self, b"") if self._kept is None else (self._system, self._kept.tobytes())

    def over(self, system: System) -> System:
        """See System."""
        return Transformed(system, self._transform, self._kept)

    def starts(self, candidate: Candidate, values: Values, least: float = 0.0) -> Sequence[tuple[float, ...]]:
        """See System."""
        return self._system.starts(candidate, values, least)

    def linearise(self, values: Values, names: Sequence[str]) -> tuple[Array, Array]:
        """See System."""
        residual, derivative = self._system.linearise(values, names)
        both = self._transform(np.concatenate([residual[..., None], derivative], axis=-1))
        return both[..., 0], both[..., 1:]


def subset(system: System, rows: Mask) -> Transformed:
    """The system restricted to these rows (n,): the others count as missing, even where there is no prediction."""
    return Transformed(system, lambda both: np.where(rows[:, None, None], both, 0.0), rows)
