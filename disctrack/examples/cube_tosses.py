"""Tosses of a cube (Pfrommer, Halm & Posa 2020): what do gravity and torque-free rotation lack between the contacts?

    python -m disctrack.examples.cube_tosses FOLDER [-o DIR]

FOLDER holds `cube_tosses.npz`. Two thirds of the tosses are fitted, every third judges; copies of a toss are taken out
(the published tosses are turned about the vertical, each by an angle of its own, and some stand there twice). Free
flight sees gravity, frame rate and scale of the lengths as one number; cubes at rest tell them apart.

Base model: the centre of the tags is the centre of mass and falls with the declared gravity; a uniform cube turns at a
constant angular velocity. Place, velocity, attitude and angular velocity are each flight's own. Every effect is small;
its residual is reckoned to first order along the smooth motion of the flight (`cube_effects`).
"""

from collections.abc import Sequence
from itertools import groupby
from pathlib import Path

import numpy as np

from calibration.kit.arrays import Array, Mask
from disctrack.discrepancy.noise import SampleStretch, SmoothNoise, estimate
from disctrack.discrepancy.score import INVISIBLE
from disctrack.discrepancy.search import Diagnosis, Settings, explain
from disctrack.discrepancy.system import System, Values
from disctrack.discrepancy.words import effect_text
from disctrack.examples._command import GRAVITY, Outcome, command, report_of
from disctrack.examples.cube_data import FRAME_RATE, HALF_WIDTH, Flight, flights, read_tosses, without_copies
from disctrack.examples.cube_effects import CANDIDATES, COLUMN, QUANTITIES, at_rest, flown
from disctrack.numbers import rounded
from disctrack.report.blocks import Listing, Section

HELD_OUT = 3  # every third toss
FIRST_NOISE = {  # channels whose noise is alike, and where the search for it begins
    "horizontal": (slice(0, 2), SmoothNoise(2e-5, 5e-5, 0.03)),
    "vertical": (slice(2, 3), SmoothNoise(2e-5, 3e-5, 0.03)),
    "turn": (slice(3, 6), SmoothNoise(2e-4, 3e-4, 0.03)),
}
# The covariance of the noise is that of the data already. Eight effects at most.
SETTINGS = Settings(noise=1.0, unexplained_share=0.2, max_effects=8)


class CubeTosses(System):
    """All that flights tell beside what their own motion absorbs, and cubes at rest: one number of variance one a row.

    seen : (n,) measured minus base model
    effects : (n, k) its change by QUANTITIES, in all of which it is linear
    """

    candidates = CANDIDATES
    base = ()

    def __init__(self, flights: Sequence[Flight]) -> None:
        """Measure the noise, and whiten."""
        self.flights, self._flown, self._at_rest = flights, [flown(f) for f in flights], at_rest(flights)
        self.noise = {name: noise for name, (_, noise) in FIRST_NOISE.items()}
        for _ in range(2):
            self._whiten()
            self.noise = self._measured_noise()
        self._whiten()

    def linearise(self, values: Values, names: Sequence[str]) -> tuple[Array, Array]:
        """Residual (n, 1) and the prediction's derivative (n, 1, k)."""
        left = self.seen - self.effects @ _amounts(values)
        return left[:, None], self.effects[:, None, [COLUMN[n] for n in names]]

    def residuals(self, values: Values) -> list[Array]:
        """Measured minus predicted (n, 6) [m], [rad] of every flight, its own motion by least squares."""
        found = []
        for rows in self._flown:
            effects, seen, own = np.split(rows.reshape(-1, rows.shape[-1]), [len(COLUMN), len(COLUMN) + 1], axis=1)
            left = seen[:, 0] - effects @ _amounts(values)
            found.append((left - own @ np.linalg.lstsq(own, left, rcond=None)[0]).reshape(-1, 6))
        return found

    def _whiten(self) -> None:
        parts, training = [], []
        for f, rows, rest in zip(self.flights, self._flown, self._at_rest, strict=True):
            white = rows.copy()
            for name, (channels, _) in FIRST_NOISE.items():
                white[:, channels] = np.tensordot(self.noise[name].whitening(f.time), rows[:, channels], axes=1)
            effects, own = np.split(white.reshape(-1, rows.shape[-1]), [len(COLUMN) + 1], axis=1)
            beside_own = np.linalg.qr(own, mode="complete")[0][:, own.shape[1] :].T @ effects
            # of an effect that the flight's own motion absorbs, rounding is left
            beside_own[:, np.linalg.norm(beside_own, axis=0) < INVISIBLE * np.linalg.norm(effects, axis=0)] = 0.0
            parts += [beside_own, rest]
            training += [not _kept_back(f)] * (len(beside_own) + len(rest))
        everything = np.concatenate(parts)
        self.effects, self.seen = everything[:, :-1], everything[:, -1]
        self.training: Mask = np.array(training)  # (n,) False for every third toss
        self.weights = np.ones(len(everything))
        self.time = np.arange(len(everything), dtype=float)  # only an order: tosses have no common clock

    def _measured_noise(self) -> dict[str, SmoothNoise]:
        """Noise of each group of channels, from what is left when all candidates together have taken their share."""
        # some make up for each other: of all amounts that do as well, those that would surprise least
        size = np.array([q.typical for q in QUANTITIES])
        amounts = size * np.linalg.lstsq(self.effects * size, self.seen, rcond=1e-9)[0]
        left = self.residuals(dict(zip(COLUMN, amounts.tolist(), strict=True)))
        return {name: _noise(left, channels, start) for name, (channels, start) in FIRST_NOISE.items()}


def _amounts(values: Values) -> Array:
    return np.array([values.get(name, 0.0) for name in COLUMN])


def _kept_back(flight: Flight) -> bool:
    return flight.toss.number % HELD_OUT == HELD_OUT - 1


def _noise(left: Sequence[Array], channels: slice, start: SmoothNoise) -> SmoothNoise:
    """Noise of channels of all flights; those of one length share instants: their samples stand side by side."""
    stretches = []
    for n, alike in groupby(sorted(left, key=len), key=len):
        time = np.arange(n) / FRAME_RATE
        values = np.concatenate([flight[:, channels] for flight in alike], axis=1)
        stretches.append(SampleStretch(time, values, time[:, None] ** np.arange(2)))
    return estimate(stretches, start)


def diagnosed(system: CubeTosses) -> Diagnosis:
    """What the base model lacks."""
    return explain(system, {}, SETTINGS, system.training)


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
        f"{len(system.flights)} flights, each with its cube at rest; {left_out} tosses are left out (too short, or not "
        f"smooth), and {copies} copies of others, turned about the vertical."
    )
    blocks = [Section("Every third toss, held out", [Listing(("", "before", "after", "white noise"), rows, caption)])]
    model = f"g = {GRAVITY} m/s^2, uniform cube, {FRAME_RATE:g} Hz, half width {HALF_WIDTH} m"
    return report_of(d, model, said, blocks, [{"rms": before}, {"rms": after}]), {}


if __name__ == "__main__":
    command(example, "cube_tosses.npz")
