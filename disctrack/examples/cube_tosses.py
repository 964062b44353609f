"""Tosses of a cube (Pfrommer, Halm & Posa 2020): what do gravity and torque-free rotation lack between the contacts?

    python -m disctrack.examples.cube_tosses FOLDER [-o DIR]

FOLDER holds `cube_tosses.npz`. Two thirds of the tosses are fitted, every third judges; copies of a toss are taken out
(the published tosses are turned about the vertical, each by an angle of its own, and some stand there twice). Free
flight sees gravity, frame rate and scale of the lengths as one number; cubes at rest tell them apart.

Base model: the centre of the tags is the centre of mass and falls with the declared gravity; a uniform cube turns at a
constant angular velocity. Place, velocity, attitude and angular velocity are each flight's own. Every effect is small;
its residual is reckoned to first order along the smooth motion of the flight (`cube_effects`).
"""

import sys
from collections.abc import Iterable, Mapping, Sequence
from functools import partial
from itertools import pairwise
from pathlib import Path

import numpy as np

from calibration.kit.arrays import Array, Mask
from disctrack.discrepancy.fit import fit
from disctrack.discrepancy.noise import SampleStretch, SmoothNoise, estimate
from disctrack.discrepancy.score import Linearisation
from disctrack.discrepancy.search import Diagnosis, Settings, explain
from disctrack.discrepancy.system import Quantity, System, Values
from disctrack.discrepancy.words import effect_text
from disctrack.errors import AnalysisError
from disctrack.examples._command import GRAVITY, Outcome, command, report_of
from disctrack.examples.cube_data import (
    FRAME_RATE,
    HALF_WIDTH,
    Flight,
    Toss,
    flights,
    read_tosses,
    without_copies,
)
from disctrack.examples.cube_effects import candidates, flown, rested
from disctrack.numbers import rounded
from disctrack.report.blocks import Listing, Section

GROUPS = {"horizontal": (0, 1), "vertical": (2,), "turn": (3, 4, 5)}  # channels whose noise is alike: x, y, z, turns
HELD_OUT = 3  # every third toss
OWN = tuple(f"state.{what}_{axis}" for what in ("place", "velocity", "turn", "rate") for axis in "123")
FIRST_NOISE = {
    "horizontal": SmoothNoise(2e-5, 5e-5, 0.03),
    "vertical": SmoothNoise(2e-5, 3e-5, 0.03),
    "turn": SmoothNoise(2e-4, 3e-4, 0.03),
}
# The covariance of the noise is that of the data already. Eight effects at most.
SETTINGS = Settings(noise=1.0, unexplained_share=0.2, max_effects=8)


class CubeTosses(System):
    """Poses in free flight, place and turn (6,) a row, then cubes at rest, height and normal (3,) in one row a toss."""

    def __init__(self, tosses: Sequence[Toss]) -> None:
        """Find the flights, measure their noise, whiten. Raises AnalysisError."""
        tosses, self.n_copies = without_copies(tosses)
        self.flights, self.n_left_out = flights(tosses)
        if len(self.flights) < 2 * HELD_OUT:
            raise AnalysisError(f"{len(self.flights)} free flights in {len(tosses)} tosses: 6 are needed at least.")
        of_number = {f.number: f for f in self.flights}
        cubes = [(t, rested(t, of_number[t.number])) for t in tosses if t.number in of_number]
        at_rest = [(t.number, *found) for t, found in cubes if found is not None]
        made = [flown(f) for f in self.flights]
        everything: list[Mapping[str, Iterable[float]]] = [*made, *(of for _, _, of in at_rest)]
        self.names = tuple(dict.fromkeys(name for of in everything for name in of))
        self.candidates = candidates(self.names)
        self.base = tuple(
            Quantity(f"{name}[{f.number}]", "", 1e-3, slot=name, block=i)
            for i, f in enumerate(self.flights)
            for name in OWN
        )
        flying = [_flight_rows(f, of, self.names) for f, of in zip(self.flights, made, strict=True)]
        still = _resting_rows([x for _, x, _ in at_rest], [of for _, _, of in at_rest], self.names)
        self.n_at_rest = len(at_rest)
        self._raw = np.concatenate([*flying, still])
        ends = np.cumsum([len(rows) for rows in flying]).tolist()
        self.blocks = [slice(a, b) for a, b in pairwise([0, *ends])]
        self._block = np.concatenate(
            [np.full(len(rows), i) for i, rows in enumerate(flying)] + [np.zeros(len(still), int)]
        )
        numbers = [np.full(len(rows), f.number) for f, rows in zip(self.flights, flying, strict=True)]
        self.toss = np.concatenate([*numbers, np.array([number for number, _, _ in at_rest[: len(still)]], int)])
        self.weights = np.concatenate([np.full(ends[-1], 6.0), np.sum(np.any(still != 0, axis=-1), axis=1)])
        self.time = np.arange(len(self.weights), dtype=float)  # only an order: tosses have no common clock
        self.noise = dict(FIRST_NOISE)
        for _ in range(2):
            self._white = self._whitened()
            self.noise = self._measured_noise()
        self._white = self._whitened()

    def training_rows(self) -> Mask:
        """(n,) False for every third toss."""
        return np.asarray(self.toss % HELD_OUT != HELD_OUT - 1, bool)

    def linearise(self, values: Values, names: Sequence[str]) -> tuple[Array, Array]:
        """Whitened residual (n, 6), and the prediction's derivative (n, 6, k): linear in every quantity."""
        index = {name: i for i, name in enumerate((*self.names, *OWN))}
        return self._left(self._white, values), self._white[..., [index[n] for n in names]]

    def residuals(self, values: Values) -> list[Array]:
        """Measured minus predicted (n, 6) [m], [rad] of every flight, its own start and rates by least squares."""
        left = self._left(self._raw, fit(self, self.base, values).values)
        return [left[rows] for rows in self.blocks]

    def _left(self, rows: Array, values: Values) -> Array:
        own = np.array([values.get(q.name, 0.0) for q in self.base]).reshape(-1, len(OWN))
        effects, by_own, left = np.split(rows, [len(self.names), rows.shape[-1] - 1], axis=-1)
        left = left[..., 0] - effects @ np.array([values.get(n, 0.0) for n in self.names])
        return np.asarray(left - np.einsum("nwi,ni->nw", by_own, own[self._block]), float)

    def _whitened(self) -> Array:
        white = self._raw.copy()
        for flight, rows in zip(self.flights, self.blocks, strict=True):
            for name, channels in GROUPS.items():
                W = self.noise[name].whitening(flight.time)
                for c in channels:
                    white[rows, c] = W @ white[rows, c]
        return white

    def _measured_noise(self) -> dict[str, SmoothNoise]:
        """Noise of each group of channels, from what is left when all candidates together have taken their share."""
        alone = fit(self, self.base, {})
        _, amounts = Linearisation(self, alone, self.candidates).gain_of(self.names)
        left = self.residuals(dict(zip(self.names, amounts.tolist(), strict=True)))
        return {name: estimate(_by_length(self.flights, left, c), self.noise[name]) for name, c in GROUPS.items()}


def _side_by_side(made: Mapping[str, Iterable[float]], names: Sequence[str], nothing: Array) -> Array:
    return np.stack([np.asarray(made.get(name, nothing), float) for name in names], axis=-1)


def _flight_rows(flight: Flight, made: Mapping[str, Array], names: Sequence[str]) -> Array:
    """(n, 6, k + 13) by effects, by what is the flight's own, and measured minus base model [m], [rad]."""
    falling = np.zeros_like(flight.position)
    falling[:, 2] = -GRAVITY * flight.time**2 / 2
    step, dt = np.swapaxes(flight.turning, 1, 2), flight.time[1] - flight.time[0]
    own = np.zeros((len(step), 6, len(OWN)))
    own[:, :3, :3], own[:, :3, 3:6] = np.eye(3), flight.time[:, None, None] * np.eye(3)
    own[:, 3:, 6:9], own[1:, 3:, 9:] = np.eye(3), np.cumsum(0.5 * (step[1:] + step[:-1]) * dt, axis=0)
    left = np.concatenate([flight.position - falling, flight.turn], axis=1)
    return np.concatenate([_side_by_side(made, names, np.zeros(left.shape)), own, left[..., None]], axis=-1)


def _resting_rows(left: Sequence[Array], made: Sequence[Mapping[str, Iterable[float]]], names: Sequence[str]) -> Array:
    """The same (m, 6, k + 13) whitened, three of the six used: height, normal (two).

    How much resting cubes differ once all candidates have taken their share is the noise.
    """
    found = np.zeros((len(left), 6, len(names) + len(OWN) + 1))
    if len(left) < 4 * HELD_OUT:
        return found[:0]
    effects = np.array([_side_by_side(of, names, np.zeros(3)) for of in made])
    for i, seen in enumerate(np.array(left).T):
        A = effects[:, i][:, np.any(effects[:, i] != 0, axis=0)]
        rest = seen - A @ np.linalg.lstsq(A, seen, rcond=1e-10)[0]
        sigma = np.sqrt(np.sum(rest**2) / (len(left) - A.shape[1]))
        found[:, i, : len(names)], found[:, i, -1] = effects[:, i] / sigma, seen / sigma
    return found


def _by_length(flown: Sequence[Flight], left: Sequence[Array], channels: Sequence[int]) -> list[SampleStretch]:
    """Flights of one length share instants, so that their samples stand side by side."""
    found = []
    for n in sorted({len(x) for x in left}):
        alike = [(f.time, x[:, list(channels)]) for f, x in zip(flown, left, strict=True) if len(x) == n]
        time = alike[0][0]
        values = np.concatenate([x for _, x in alike], axis=1)
        found.append(SampleStretch(time, values, np.column_stack([np.ones(n), time])))
    return found


def diagnosed(system: CubeTosses) -> Diagnosis:
    """What the base model lacks."""
    return explain(system, {}, SETTINGS, system.training_rows())


def rms_of(system: CubeTosses, values: Values) -> dict[str, float]:
    """Rms of measured minus predicted of the held-out flights, per group of channels [m], [rad]."""
    residuals = zip(system.flights, system.residuals(values), strict=True)
    left = [x for flight, x in residuals if flight.number % HELD_OUT == HELD_OUT - 1]
    freedom = sum(len(x) - 2 for x in left)
    square = np.sum([np.sum(x**2, axis=0) for x in left], axis=0) / freedom
    return {name: float(np.sqrt(np.mean(square[list(channels)]))) for name, channels in GROUPS.items()}


def errors(system: CubeTosses, d: Diagnosis) -> tuple[dict[str, float], dict[str, float]]:
    """`rms_of` the base model, and of what was found with values fitted to the other flights."""
    held = d.held_out_after
    return rms_of(system, {}), rms_of(system, held.train.values if held else {})


def example(folder: Path) -> Outcome:
    """What do gravity and torque-free rotation lack for a tossed cube?"""
    system = CubeTosses(read_tosses(folder))
    d = diagnosed(system)
    before, after = errors(system, d)
    effects = "; ".join(effect_text(f, d) for f in d.found)
    said = f"Missing: {effects}" if effects else "No effect is claimed to be missing"
    said = f"{said}. Something else is missing: {d.reason}." if d.verdict == "unexplained" else f"{said}."
    rows = []
    for group, noise in system.noise.items():
        size, unit = (float(np.degrees(1e3)), "mdeg") if group == "turn" else (1e6, "um")
        numbers = (before[group], after[group], noise.white)
        rows.append((f"rms {group} ({unit})", *(rounded(size * x) for x in numbers)))
    tosses = (
        f"{len(system.flights)} flights ({system.n_left_out} tosses left out: too short, or not smooth; "
        f"{system.n_copies} copies of others turned about the vertical), {system.n_at_rest} cubes at rest."
    )
    blocks = [Section("Every third toss, held out", [Listing(("", "before", "after", "white noise"), rows, tosses)])]
    model = f"g = {GRAVITY} m/s^2, uniform cube, {FRAME_RATE:g} Hz, half width {HALF_WIDTH} m"
    return report_of(d, model, said, blocks, [{"rms": before}, {"rms": after}]), {}


main = partial(command, "cube_tosses", "cube_tosses.npz", example)


if __name__ == "__main__":
    sys.exit(main())
