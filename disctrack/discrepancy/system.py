"""What can be diagnosed: anything with parameters, effects that it may lack, and a prediction with derivatives.

The engine (fit, score, held_out, search) knows no more of the world than this module; what the numbers mean is the
business of an adapter (`disctrack.diagnosis`, `examples`).
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass

import numpy as np

from calibration.kit.arrays import Array, Mask

Values = Mapping[str, float]
USED_UP = "the search ended when its work was used up: not all that may be missing was tried"
Transform = Callable[[Array], Array]  # of residual and derivative side by side (n, w, 1 + k), into as many numbers


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
    def stem(self) -> str:
        """Its name without that of the run or group whose own it is."""
        return self.name.partition("[")[0]

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


class GivenUp(Exception):
    """One of many hypotheses would take too long: the one who put it forward goes on without it."""


class Budget:
    """Work that an answer may take, in units of the system's; of all systems that share it.

    Work, and not seconds, so that an answer does not depend on the machine. When it is used up no further hypothesis
    is put forward, and the answer is the best of those that were. A trial among many is given up half way.
    """

    def __init__(self, work: float = np.inf) -> None:
        """Without an end, if not given."""
        self._left = self._whole = float(work)
        self.trial_left = np.inf  # steps until the trial is given up

    def open(self, kept: float = 0.0) -> bool:
        """May a hypothesis be put forward, while this share of the whole is kept for others?"""
        return np.isinf(self._whole) or self._left > kept * self._whole

    def work(self, done: float) -> None:
        """Count."""
        self._left -= done

    def step(self, steps: float) -> None:
        """Count steps that a trial may have too many of. Raises GivenUp."""
        self.trial_left = max(self.trial_left - steps, 0.0)
        if self.trial_left == 0.0:
            raise GivenUp

    @contextmanager
    def trial(self, steps: float) -> Iterator[None]:
        """Within, one trial among many, that may take so many steps; a trial within another no more than that has."""
        outer, inner = self.trial_left, min(self.trial_left, steps)
        self.trial_left = inner
        try:
            yield
        finally:
            self.trial_left = outer if np.isinf(outer) else outer - (inner - self.trial_left)


class System:
    """Data, model, and the effects it may lack. Samples are rows in time; a row has one or more whitened numbers.

    A system of one's own sets the first four and says how it predicts; the rest it changes where it knows better.
    """

    time: Array  # (n,) instant of each sample [s], not decreasing
    weights: Array  # (n,) how many numbers of each row are data
    base: tuple[Quantity, ...]  # that every fit moves: initial conditions, declared laws, nuisances with priors
    candidates: tuple[Candidate, ...]  # effects that the model may lack
    budget: Budget = Budget()
    trial_steps: float = np.inf  # that one hypothesis among many may take
    several_minima: bool = False  # may fits of the same quantities end in different minima?
    frees_shapes: bool = False  # are numbers of laws' shapes tried free where no law as it is written down will do?
    blocks: Sequence[slice] = ()  # rows that may have quantities of their own (`discrepancy.elimination`)

    def linearise(self, values: Values, names: Sequence[str]) -> tuple[Array, Array]:
        """Whitened residual (n, w), data minus prediction, zeros for missing data; its model's derivative (n, w, k).

        The derivative is that of the prediction: the residual after a step d is residual - derivative @ d. Not finite
        where there is no prediction.
        """
        raise NotImplementedError

    def starts(self, candidate: Candidate, values: Values, least: float = 0.0) -> Sequence[tuple[float, ...]]:
        """Where a refit of a candidate with a threshold begins (at one place, or nowhere), given a fit without it.

        Of any other: of its shape, where the system knows where to look; none, where the shape's range is tried.
        least : gain to first order, below which a shape that has to be looked for is worth no refit
        """
        return ()

    def together(self, values: Values, width: int) -> Array:
        """(n, w, b) orthonormal directions of each row in which its numbers may err as a whole: all, if not known."""
        return np.tile(np.eye(width), (len(self.weights), 1, 1))

    def beginnings(self) -> Sequence[System]:
        """Parts of the system from its first sample on, shorter ones first."""
        return ()

    @property
    def known_as(self) -> tuple[System, bytes]:
        """A system, and which of its rows this is: what is computed once for all that are the same."""
        return self, b""

    def over(self, system: System) -> System:
        """Another system, whose rows pass what those of this one do."""
        return system


class Transformed(System):
    """A system whose rows pass a linear map: some of them alone, or all with their noise made white."""

    def __init__(self, system: System, transform: Transform, kept: Mask | None = None) -> None:
        """Kept : (n,) True in rows that count; all that do in the system, if not given."""
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
    """The system with these rows (n,) alone: the rest counts as missing, even where there is no prediction."""
    return Transformed(system, lambda both: np.where(rows[:, None, None], both, 0.0), rows)
