"""Tosses of a cube (Pfrommer, Halm & Posa 2020): what do gravity and torque-free rotation lack between the contacts?

    python -m disctrack.examples.cube_tosses FOLDER [-o DIR]

FOLDER holds `cube_tosses.npz`. Two thirds of the tosses are fitted, every third judges; copies of a toss are taken out
(the published tosses are turned about the vertical, each by an angle of its own, and some stand there twice). Free
flight sees gravity, frame rate and scale of the lengths as one number; cubes at rest tell them apart.
"""

import sys
from functools import partial
from pathlib import Path

import numpy as np

from disctrack.discrepancy.document import document, tables
from disctrack.discrepancy.search import Diagnosis, Settings, explain
from disctrack.discrepancy.system import Values
from disctrack.discrepancy.words import effect_text
from disctrack.examples._command import Outcome, command
from disctrack.examples.cube_data import FRAME_RATE, HALF_WIDTH, read_tosses
from disctrack.examples.cube_effects import GRAVITY
from disctrack.examples.cube_system import GROUPS, HELD_OUT, CubeTosses
from disctrack.report.blocks import Report
from disctrack.report.terminal import full

# The covariance of the noise is that of the data already. Eight effects at most.
SETTINGS = Settings(noise=1.0, unexplained_share=0.2, max_effects=8)


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


def sentence(d: Diagnosis) -> str:
    """The answer in plain words."""
    effects = "; ".join(effect_text(f, d) for f in d.found)
    text = f"Missing: {effects}" if effects else "No effect is claimed to be missing"
    return f"{text}. Something else is missing: {d.reason}." if d.verdict == "unexplained" else f"{text}."


def report(system: CubeTosses, d: Diagnosis) -> str:
    """Before and after, for people."""
    before, after = errors(system, d)
    lines = [
        f"{len(system.flights)} flights ({system.n_left_out} tosses left out: too short, or not smooth; "
        f"{system.n_copies} copies of others turned about the vertical), {len(system.cubes)} cubes at rest; "
        "every third toss held out.",
        sentence(d),
        "",
        f"{'held-out tosses':<30}{'before':>12}{'after':>12}{'white noise':>12}",
    ]
    for group, noise in system.noise.items():
        size, unit = (float(np.degrees(1e3)), "mdeg") if group == "turn" else (1e6, "um")
        numbers = (before[group], after[group], noise.white)
        lines.append(f"{f'rms {group} [{unit}]':<30}" + "".join(f"{size * x:12.1f}" for x in numbers))
    return "\n".join([*lines, *full(Report("", "", blocks=tables(d)))])


def example(folder: Path) -> Outcome:
    """What do gravity and torque-free rotation lack for a tossed cube?"""
    system = CubeTosses(read_tosses(folder))
    d = diagnosed(system)
    model = f"g = {GRAVITY} m/s^2, uniform cube, {FRAME_RATE:g} Hz, half width {HALF_WIDTH} m"
    found = document(d, model, sentence(d), *({"rms": side} for side in errors(system, d)))
    return Outcome(report(system, d), found | {"noise": {k: vars(v) for k, v in system.noise.items()}})


main = partial(command, "cube_tosses", "cube_tosses.npz", example)


if __name__ == "__main__":
    sys.exit(main())
