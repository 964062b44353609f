"""Tosses of a cube (Pfrommer, Halm & Posa 2020): what do gravity and torque-free rotation lack between the contacts?

    python -m disctrack.examples.cube_tosses FOLDER [-o DIR]

FOLDER holds `cube_tosses.npz`. Two thirds of the tosses are fitted, every third judges; copies of a toss are taken out
(the published tosses are turned about the vertical, each by an angle of its own, and some stand there twice). Free
flight sees gravity, frame rate and scale of the lengths as one number; cubes at rest tell them apart.
"""

import sys
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path

import numpy as np
from matplotlib.figure import Figure

from disctrack.discrepancy.document import document, table
from disctrack.discrepancy.search import Diagnosis, Settings, explain
from disctrack.discrepancy.system import Values
from disctrack.discrepancy.words import effect_text
from disctrack.examples._command import Outcome, command
from disctrack.examples.cube_data import FRAME_RATE, HALF_WIDTH, Toss, read_tosses
from disctrack.examples.cube_effects import GRAVITY
from disctrack.examples.cube_system import GROUPS, HELD_OUT, CubeTosses
from disctrack.report.figures import panels
from disctrack.report.palette import BLUE, RED

# The covariance of the noise is that of the data already. Eight effects at most.
SETTINGS = Settings(noise=1.0, unexplained_share=0.2, max_effects=8)
SEEN = 0.6  # share of a held-out flight from which the rest is forecast


@dataclass(frozen=True)
class Errors:
    """Of held-out tosses, with values fitted to the others."""

    rms: dict[str, float]  # per group of channels [m], [rad]
    forecast_end: dict[str, float]  # rms at the last sample of a flight, from its first SEEN


@dataclass(frozen=True)
class CubeAnswer:
    """Everything asked of the tosses."""

    system: CubeTosses
    diagnosis: Diagnosis
    before: Errors
    after: Errors


def analyse_tosses(tosses: Sequence[Toss]) -> CubeAnswer:
    """Diagnose, and measure errors on held-out tosses. Raises AnalysisError."""
    system = CubeTosses(tosses)
    diagnosis = explain(system, {}, SETTINGS, system.training_rows())
    held = diagnosis.held_out_after
    return CubeAnswer(system, diagnosis, errors_of(system, {}), errors_of(system, held.train.values if held else {}))


def errors_of(system: CubeTosses, values: Values) -> Errors:
    """Errors of the held-out flights with the given values."""
    test = [f.number % HELD_OUT == HELD_OUT - 1 for f in system.flights]
    left = [x for x, t in zip(system.residuals(values), test, strict=True) if t]
    ends = np.array([x[-1] for x, t in zip(system.residuals(values, SEEN), test, strict=True) if t])
    freedom = sum(len(x) - 2 for x in left)
    rms, end = {}, {}
    for name, channels in GROUPS.items():
        c = list(channels)
        rms[name] = float(np.sqrt(sum(float(np.sum(x[:, c] ** 2)) for x in left) / (freedom * len(c))))
        end[name] = float(np.sqrt(np.mean(ends[:, c] ** 2)))
    return Errors(rms, end)


def sentence(answer: CubeAnswer) -> str:
    """The answer in plain words."""
    d = answer.diagnosis
    effects = "; ".join(effect_text(f, d) for f in d.found)
    text = f"Missing: {effects}" if effects else "No effect is claimed to be missing"
    return f"{text}. Something else is missing: {d.reason}." if d.verdict == "unexplained" else f"{text}."


def _unit(group: str) -> tuple[float, str]:
    return (float(np.degrees(1e3)), "mdeg") if group == "turn" else (1e6, "um")


def _for_people(values: Mapping[str, float]) -> dict[str, float]:
    return {f"{k}_{_unit(k)[1]}": _unit(k)[0] * v for k, v in values.items()}


def report(answer: CubeAnswer) -> str:
    """Before and after, for people."""
    system = answer.system
    lines = [
        f"{len(system.flights)} flights ({system.n_left_out} tosses left out: too short, or not smooth; "
        f"{system.n_copies} copies of others turned about the vertical), {len(system.cubes)} cubes at rest; "
        "every third toss held out.",
        sentence(answer),
        "",
        f"{'held-out tosses':<30}{'before':>12}{'after':>12}{'white noise':>12}",
    ]
    for group, noise in system.noise.items():
        size, unit = _unit(group)
        rms, end = ([size * getattr(e, k)[group] for e in (answer.before, answer.after)] for k in vars(answer.before))
        lines.append(f"{f'rms {group} [{unit}]':<30}{rms[0]:12.1f}{rms[1]:12.1f}{size * noise.white:12.1f}")
        lines.append(f"{'  forecast of the last sample':<30}{end[0]:12.1f}{end[1]:12.1f}")
    return "\n".join([*lines, *table(answer.diagnosis)])


def figure(answer: CubeAnswer) -> Figure:
    """Mean residual of held-out flights against the time from their middles, before and after."""
    picture, grid = panels(9, 4, 1, 2)
    held = answer.diagnosis.held_out_after
    flights = answer.system.flights
    test = [i for i, f in enumerate(flights) if f.number % HELD_OUT == HELD_OUT - 1]
    t = np.round(np.concatenate([flights[i].time for i in test]) * FRAME_RATE).astype(int)
    for axes, name in zip(grid, ("vertical", "across the flight"), strict=True):
        axes.set(title=f"held-out flights, {name}", xlabel="time from the middle [ms]", ylabel="mean residual [um]")
        for values, colour, label in (({}, RED, "before"), (held.train.values if held else {}, BLUE, "after")):
            left = answer.system.residuals(values)
            y = np.concatenate(
                [left[i][:, 2] if name == "vertical" else left[i][:, :3] @ flights[i].across for i in test]
            )
            many = [b for b in np.unique(t) if np.sum(t == b) >= 10]
            mean, error = np.array([(y[t == b].mean(), y[t == b].std() / np.sqrt(np.sum(t == b))) for b in many]).T
            axes.errorbar(1e3 * np.array(many) / FRAME_RATE, 1e6 * mean, 1e6 * error, fmt="o-", ms=3, color=colour,
                          label=label)  # fmt: skip
        axes.legend(frameon=False)
    return picture


def example(folder: Path) -> Outcome:
    """What do gravity and torque-free rotation lack for a tossed cube?"""
    answer = analyse_tosses(read_tosses(folder))
    model = f"g = {GRAVITY} m/s^2, uniform cube, {FRAME_RATE:g} Hz, half width {HALF_WIDTH} m"
    sides = [{k: _for_people(v) for k, v in vars(errors).items()} for errors in (answer.before, answer.after)]
    found = document(answer.diagnosis, model, sentence(answer), *sides)
    return Outcome(
        report(answer), found | {"noise": {k: vars(v) for k, v in answer.system.noise.items()}}, figure(answer)
    )


main = partial(command, "cube_tosses", "cube_tosses.npz", example)


if __name__ == "__main__":
    sys.exit(main())
