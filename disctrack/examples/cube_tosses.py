"""Tosses of a cube (Pfrommer, Halm & Posa 2020): what do gravity and torque-free rotation lack between the contacts?

    python -m disctrack.examples.cube_tosses FOLDER [-o DIR]

FOLDER holds `cube_tosses.npz`. Two thirds of the tosses are fitted, every third judges; copies of a toss are taken out
(the published tosses are turned about the vertical, each by an angle of its own, and some stand there twice). Free
flight sees gravity, frame rate and scale of the lengths as one number; cubes at rest tell them apart.

Base model: the centre of the tags is the centre of mass and falls with the declared gravity; a uniform cube turns at a
constant angular velocity. Place, velocity, attitude and angular velocity are each flight's own. Every effect is small;
its residual is reckoned to first order along the smooth motion of the flight (`cube_effects`).
"""

from collections import defaultdict
from collections.abc import Sequence
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
from disctrack.examples._command import GRAVITY, Outcome, command, report_of
from disctrack.examples.cube_data import (
    FRAME_RATE,
    HALF_WIDTH,
    Flight,
    flights,
    integrated,
    read_tosses,
    without_copies,
)
from disctrack.examples.cube_effects import CANDIDATES, flown, rested
from disctrack.numbers import rounded
from disctrack.report.blocks import Listing, Section

HELD_OUT = 3  # every third toss
EFFECTS = tuple(q for c in CANDIDATES for q in c.quantities)
OWN = tuple(f"state.{what}_{axis}" for what in ("place", "velocity", "turn", "rate") for axis in "123")
COLUMN = {name: i for i, name in enumerate((*(q.name for q in EFFECTS), *OWN))}
FIRST_NOISE = {  # channels whose noise is alike, and where the search for it begins
    "horizontal": (slice(0, 2), SmoothNoise(2e-5, 5e-5, 0.03)),
    "vertical": (slice(2, 3), SmoothNoise(2e-5, 3e-5, 0.03)),
    "turn": (slice(3, 6), SmoothNoise(2e-4, 3e-4, 0.03)),
}
# The covariance of the noise is that of the data already. Eight effects at most.
SETTINGS = Settings(noise=1.0, unexplained_share=0.2, max_effects=8)


class CubeTosses(System):
    """A toss is a block of rows: poses in free flight, place and turn (6,) each, and at last the cube at rest.

    Of that, height and normal (3,); a row without data where it does not rest on a face.
    """

    candidates = CANDIDATES

    def __init__(self, flights: Sequence[Flight]) -> None:
        """Measure the noise, and whiten."""
        self.flights, rows = flights, [_rows(f) for f in flights]
        self._raw = np.concatenate(rows)
        ends = np.cumsum([0, *map(len, rows)])
        self.blocks = [slice(a, b) for a, b in pairwise(ends.tolist())]
        self._block = np.repeat(np.arange(len(rows)), np.diff(ends))
        self._last = ends[1:] - 1
        self.weights = np.any(self._raw != 0, axis=-1).sum(axis=1)
        self.n_at_rest = int(np.sum(self.weights[self._last] > 0))
        self.time = np.arange(len(self.weights), dtype=float)  # only an order: tosses have no common clock
        self.base = tuple(
            Quantity(f"{name}[{f.toss.number}]", "", 1e-3, slot=name, block=i)
            for i, f in enumerate(self.flights)
            for name in OWN
        )
        self.noise = {name: noise for name, (_, noise) in FIRST_NOISE.items()}
        for _ in range(2):
            self._white = self._whitened()
            self.noise = self._measured_noise()
        self._white = self._whitened()

    def training_rows(self) -> Mask:
        """(n,) False for every third toss."""
        return np.repeat([not _kept_back(f) for f in self.flights], np.bincount(self._block))

    def linearise(self, values: Values, names: Sequence[str]) -> tuple[Array, Array]:
        """Whitened residual (n, 6), and the prediction's derivative (n, 6, k): linear in every quantity."""
        return self._left(self._white, values), self._white[..., [COLUMN[n] for n in names]]

    def residuals(self, values: Values) -> list[Array]:
        """Measured minus predicted (n, 6) [m], [rad] of every flight, its own start and rates by least squares."""
        left = self._left(self._raw, fit(self, self.base, values).values)
        return [left[rows][:-1] for rows in self.blocks]

    def _left(self, rows: Array, values: Values) -> Array:
        effects, by_own, left = np.split(rows, [len(EFFECTS), len(COLUMN)], axis=-1)
        own = np.array([values.get(q.name, 0.0) for q in self.base]).reshape(-1, len(OWN))
        left = left[..., 0] - effects @ np.array([values.get(q.name, 0.0) for q in EFFECTS])
        return np.asarray(left - np.einsum("nwi,ni->nw", by_own, own[self._block]), float)

    def _whitened(self) -> Array:
        white = self._raw.copy()
        for flight, block in zip(self.flights, self.blocks, strict=True):
            flying = slice(block.start, block.stop - 1)
            for name, (channels, _) in FIRST_NOISE.items():
                W = self.noise[name].whitening(flight.time)
                white[flying, channels] = np.tensordot(W, white[flying, channels], axes=1)
        # how much resting cubes differ once all candidates have taken their share is the noise
        for c in range(3):
            effects, seen = white[self._last, c, : len(EFFECTS)], white[self._last, c, -1]
            amounts, _, rank, _ = np.linalg.lstsq(effects, seen, rcond=1e-10)
            white[self._last, c] /= np.sqrt(np.sum((seen - effects @ amounts) ** 2) / (self.n_at_rest - rank))
        return white

    def _measured_noise(self) -> dict[str, SmoothNoise]:
        """Noise of each group of channels, from what is left when all candidates together have taken their share."""
        linear = Linearisation(self, fit(self, self.base, {}), self.candidates)
        # some make up for each other: of all amounts that do as well, those that would surprise least
        size = np.array([q.typical for q in EFFECTS])
        columns = linear.columns([q.name for q in EFFECTS]) * size
        amounts = size * np.linalg.lstsq(columns, linear.right, rcond=1e-9)[0]
        left = self.residuals({q.name: float(x) for q, x in zip(EFFECTS, amounts, strict=True)})
        return {name: _noise(left, channels, start) for name, (channels, start) in FIRST_NOISE.items()}


def _kept_back(flight: Flight) -> bool:
    return flight.toss.number % HELD_OUT == HELD_OUT - 1


def _rows(f: Flight) -> Array:
    """(n + 1, 6, k + 13) by effects, by what is the flight's own, and measured minus base model [m], [rad]."""
    n = len(f.time)
    rows = np.zeros((n + 1, 6, len(COLUMN) + 1))
    effects, own, seen = np.split(rows, [len(EFFECTS), len(COLUMN)], axis=-1)
    for name, column in flown(f).items():
        effects[:n, :, COLUMN[name]] = column
    own[:n, :3, :3], own[:n, :3, 3:6] = np.eye(3), f.time[:, None, None] * np.eye(3)
    own[:n, 3:, 6:9], own[:n, 3:, 9:] = np.eye(3), integrated(np.swapaxes(f.turning, 1, 2))
    seen[:n, :3, 0], seen[:n, 3:, 0] = f.position, f.turn
    seen[:n, 2, 0] += GRAVITY * f.time**2 / 2
    if (cube := rested(f)) is not None:
        seen[n, :3, 0], by_effects = cube
        for name, change in by_effects.items():
            effects[n, :3, COLUMN[name]] = change
    return rows


def _noise(left: Sequence[Array], channels: slice, start: SmoothNoise) -> SmoothNoise:
    """Noise of channels of all flights; those of one length share instants: their samples stand side by side."""
    by_length = defaultdict[int, list[Array]](list)
    for flight in left:
        by_length[len(flight)].append(flight[:, channels])
    stretches = []
    for n, alike in by_length.items():
        time = np.arange(n) / FRAME_RATE
        stretches.append(SampleStretch(time, np.concatenate(alike, axis=1), time[:, None] ** np.arange(2)))
    return estimate(stretches, start)


def diagnosed(system: CubeTosses) -> Diagnosis:
    """What the base model lacks."""
    return explain(system, {}, SETTINGS, system.training_rows())


def rms_of(system: CubeTosses, values: Values) -> dict[str, float]:
    """Rms of measured minus predicted of the held-out flights, per group of channels [m], [rad]."""
    residuals = zip(system.flights, system.residuals(values), strict=True)
    left = [x for flight, x in residuals if _kept_back(flight)]
    freedom = sum(len(x) - 2 for x in left)
    square = np.sum(np.concatenate(left) ** 2, axis=0) / freedom
    return {name: float(np.sqrt(np.mean(square[channels]))) for name, (channels, _) in FIRST_NOISE.items()}


def errors(system: CubeTosses, d: Diagnosis) -> tuple[dict[str, float], dict[str, float]]:
    """`rms_of` the base model, and of what was found with values fitted to the other flights."""
    held = d.held_out_after
    return rms_of(system, {}), rms_of(system, held.train.values if held else {})


def example(folder: Path) -> Outcome:
    """What do gravity and torque-free rotation lack for a tossed cube?"""
    published = read_tosses(folder)
    tosses = without_copies(published)
    system = CubeTosses(flights(tosses))
    d = diagnosed(system)
    before, after = errors(system, d)
    effects = "; ".join(effect_text(f, d) for f in d.found)
    said = f"Missing: {effects}." if effects else "No effect is claimed to be missing."
    said += f" Something else is missing: {d.reason}." if d.verdict == "unexplained" else ""
    rows = []
    for group, noise in system.noise.items():
        size, unit = (float(np.degrees(1e3)), "mdeg") if group == "turn" else (1e6, "um")
        numbers = (before[group], after[group], noise.white)
        rows.append((f"rms {group} ({unit})", *(rounded(size * x) for x in numbers)))
    copies, left_out = len(published) - len(tosses), len(tosses) - len(system.flights)
    caption = (
        f"{len(system.flights)} flights, {system.n_at_rest} cubes at rest; {left_out} tosses are left out (too short, "
        f"or not smooth), and {copies} copies of others, turned about the vertical."
    )
    blocks = [Section("Every third toss, held out", [Listing(("", "before", "after", "white noise"), rows, caption)])]
    model = f"g = {GRAVITY} m/s^2, uniform cube, {FRAME_RATE:g} Hz, half width {HALF_WIDTH} m"
    return report_of(d, model, said, blocks, [{"rms": before}, {"rms": after}]), {}


if __name__ == "__main__":
    command(example, "cube_tosses.npz")
