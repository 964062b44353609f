"""When in a recording the model fails: the longest beginning and the longest end that it describes to noise."""

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from disctrack.diagnosis.disc_system import DiscSystem
from disctrack.discrepancy.fit import Fit, fit
from disctrack.discrepancy.system import Subset, System

LEAST = 0.2  # of the frames, and ...
LEAST_FRAMES = 60  # ... that a model must describe before it can be said to hold
STEPS = 6  # of a bisection: to a hundredth of the recording
MAX_ITERATIONS = 10
SURE = 4.0  # standard deviations of chi-square


@dataclass(frozen=True)
class Span:
    """Frames that the model describes, and how the disc stands where that ends."""

    start: float  # [s]
    stop: float
    theta_deg: float  # nutation at the end that lies within the recording
    frames: int


@dataclass(frozen=True)
class Regimes:
    """Where the model holds by itself; None where it does not hold long enough to say so."""

    first: Span | None
    last: Span | None

    @property
    def text(self) -> str:
        """In words."""
        said = []
        if self.first is not None:
            said.append(
                f"holds until {self.first.stop:.3f} s (nutation {self.first.theta_deg:.2f} deg) and fails after"
            )
        if self.last is not None:
            said.append(f"holds from {self.last.start:.3f} s on (nutation {self.last.theta_deg:.2f} deg)")
        if not said:
            return "The model holds in no longer part of the recording: what is missing acts all the time."
        return f"The model {'; and, fitted anew, it '.join(said)}."


def regimes(system: DiscSystem, judged: System, base: Fit, noise: float) -> Regimes:
    """Fits of the base model to ever shorter beginnings and ends. judged : the system with its noise as found."""
    frames = np.flatnonzero(system.weights > 0)
    theta = np.degrees(system.trajectory.q[system.rows, 4])

    def holds(rows: NDArray[np.intp]) -> bool:
        chosen = np.isin(np.arange(len(system.time)), rows)
        trial = fit(Subset(judged, chosen), base.quantities, base.values, MAX_ITERATIONS)
        limit = noise * (1.0 + SURE * np.sqrt(2.0 / max(trial.degrees_of_freedom, 1)))
        return bool(trial.converged and trial.reduced_chi_square <= limit)

    def span(rows: NDArray[np.intp] | None, at: int) -> Span | None:
        if rows is None:
            return None
        return Span(float(system.time[rows[0]]), float(system.time[rows[-1]]), float(theta[rows[at]]), len(rows))

    first = _longest(lambda k: frames[:k], holds, len(frames))
    last = _longest(lambda k: frames[len(frames) - k :], holds, len(frames))
    return Regimes(span(first, -1), span(last, 0))


def _longest(
    part: Callable[[int], NDArray[np.intp]], holds: Callable[[NDArray[np.intp]], bool], n: int
) -> NDArray[np.intp] | None:
    """The longest part that the model describes, by bisection; None if not even the least does."""
    low, high = int(max(LEAST * n, LEAST_FRAMES)), n
    if low >= n or not holds(part(low)):
        return None
    for _ in range(STEPS):
        middle = (low + high) // 2
        if holds(part(middle)):
            low = middle
        else:
            high = middle
    return part(low)
