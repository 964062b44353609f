"""Balls dropped from a height (de Silva et al. 2020): gravity alone lacks drag. Is its law identifiable?

    python -m disctrack.examples.ball_drop FOLDER [-o DIR]

FOLDER holds `ball_drops.csv` (ball, drop, t_s, height_m). Every ball was dropped twice: laws are fitted to drop 1 and
to the first 1.2 s of drop 2, and tested on the rest; for all balls together, and for each alone. Differences between
the two drops of a ball are autocorrelated noise.
Data: Frontiers in Artificial Intelligence 3:25; 11 balls.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from itertools import groupby
from pathlib import Path

import numpy as np

from calibration.kit.types import Array
from disctrack.discrepancy.equations import Answer, Equations, Parameter, Run, SmoothNoise, Term, diagnose
from disctrack.discrepancy.noise import SampleStretch, estimate
from disctrack.discrepancy.search import CLASS_GAIN, Settings
from disctrack.examples._command import GRAVITY, Outcome, command
from disctrack.numbers import rounded, score
from disctrack.report.blocks import Listing, Report, Section

ACCELERATION_DEGREE = 4  # of the polynomial in time for the acceleration of all drops of a ball: any drag, to 1 mm
SEEN = 1.2  # [s] of a second drop that are fitted; the rest is predicted, as in the published comparison
FALL = Equations(
    {"h": "v", "v": "-g"}, constants={"g": GRAVITY}, units={"h": "m", "v": "m/s"}, name=f"free fall at {GRAVITY} m/s^2"
)
DRAG = {  # by name: force per mass, with one coefficient per ball; the constant one has the sign for a falling ball
    "constant_drag": ("k", Parameter(0.0, "m/s^2", lower=0.0, typical=1.0, per="ball")),
    "linear_drag": ("-k*v", Parameter(0.0, "1/s", lower=0.0, typical=0.1, per="ball")),
    "quadratic_drag": ("-k*v*abs(v)", Parameter(0.0, "1/m", lower=0.0, typical=0.01, per="ball")),
}
DRAGS = tuple(Term(name, {"v": force}, parameters={"k": k}) for name, (force, k) in DRAG.items())
OTHERS = (
    Term("gravity", {"v": "-change"}, parameters={"change": Parameter(0.0, "m/s^2", typical=0.01)}),
    Term("height_scale", observed={"h": "change*(h - 30)"}, parameters={"change": Parameter(0.0, typical=0.02)}),
    Term("frame_rate", clock="-t*change/(1 + change)", parameters={"change": Parameter(0.0, typical=1e-3)}),
    Term("perspective", observed={"h": "b*(h - 30)**2"}, parameters={"b": Parameter(0.0, "1/m", typical=1e-3)}),
)


def drop(ball: str, number: int, time: Array, height: Array) -> Run:
    """One drop of a ball: time from zero on [s], height [m]."""
    until = np.inf if number == 1 else SEEN
    return Run(
        time, {"h": height}, name=f"{ball},{number}", groups={"ball": ball, "drop": str(number)}, fit_until=until
    )


def read_drops(folder: Path) -> list[Run]:
    """All drops of `ball_drops.csv`."""
    table = np.genfromtxt(folder / "ball_drops.csv", delimiter=",", names=True, dtype=None, encoding="utf-8")
    drops = []
    for (ball, number), rows in groupby(table, lambda row: (row["ball"], row["drop"])):
        time, height = np.array([(row["t_s"], row["height_m"]) for row in rows]).T
        drops.append(drop(ball, number, time, height))
    return drops


def _by_ball(drops: Sequence[Run]) -> dict[str, list[Run]]:
    """Drops of each ball, which are neighbours in the list."""
    return {ball: list(takes) for ball, takes in groupby(drops, lambda run: run.groups["ball"])}


def height_noise(drops: Sequence[Run]) -> SmoothNoise:
    """Noise of a height [m] and [s], from the differences between the drops of each ball.

    The acceleration of all drops of a ball is one polynomial in time; each drop has an initial height and velocity. The
    residuals (pixel size, release by hand, wind, a scale that differs between recordings) do not depend on the law of
    drag. A single drop shows only a part of them.
    """
    stretches = []
    for takes in _by_ball(drops).values():
        time = np.concatenate([d.time for d in takes])
        part = np.repeat(np.arange(len(takes)), [np.size(d.time) for d in takes])
        own = (part[:, None] == np.arange(len(takes))).astype(float)
        u = time[:, None] / time.max()
        basis = np.concatenate([own, own * u, u ** np.arange(2, ACCELERATION_DEGREE + 3)], axis=1)
        heights = np.concatenate([d.data["h"] for d in takes])
        stretches.append(SampleStretch(time, heights[:, None], basis, part))
    return estimate(stretches, SmoothNoise(0.05, 0.15, 0.5))


def ask(drops: Sequence[Run], noise: SmoothNoise, terms: Sequence[Term], equations: Equations = FALL) -> Answer:
    """Diagnosis of the equations with these drops. The noise is that of all balls."""
    at_noise = 1 + 3 * np.sqrt(2 / sum(np.size(d.time) for d in drops))  # three sigmas of a reduced chi-square
    settings = Settings(noise=1.0, unexplained_share=0.2, at_noise=float(at_noise))
    return diagnose(equations, [replace(d, noise=noise) for d in drops], terms, settings=settings)


@dataclass(frozen=True)
class BallAnswer:
    """All results for a set of drops."""

    noise: SmoothNoise
    together: Answer
    alone: Mapping[str, Answer]
    # laws of drag, alone and with other effects: length minus that of the shortest, which is the first
    forms: Mapping[tuple[str, ...], float]
    errors: Mapping[str, Array]  # by law, and "gravity alone": `errors_on_second_drops`

    @property
    def undecided(self) -> tuple[tuple[str, ...], ...]:
        """Forms that the data do not distinguish from the shortest."""
        return tuple(effects for effects, over in self.forms.items() if over < CLASS_GAIN)

    @property
    def identifiable(self) -> bool:
        """True if all of these have the same law of drag."""
        return len({effects[0] for effects in self.undecided}) == 1


def analyse_drops(drops: Sequence[Run]) -> BallAnswer:
    """Diagnose all balls together and each alone, compare the forms of the law, measure errors on the second drops."""
    noise = height_noise(drops)
    together = ask(drops, noise, (*DRAGS, *OTHERS))
    alone = {ball: ask(takes, noise, (*DRAGS, *OTHERS)) for ball, takes in _by_ball(drops).items()}
    laws = {
        name: replace(FALL, rates={"h": "v", "v": f"-g + {force}"}, parameters={"k": k}, name=name)
        for name, (force, k) in DRAG.items()
    }
    lengths = {
        (name, *explanation.effects): explanation.length
        for name, law in laws.items()
        for explanation in ask(drops, noise, OTHERS[-1:], law).diagnosis.ranked
    }
    shortest = min(lengths.values())
    forms = {effects: lengths[effects] - shortest for effects in sorted(lengths, key=lengths.__getitem__)}
    errors = {name: errors_on_second_drops(drops, law) for name, law in ({"gravity alone": FALL} | laws).items()}
    return BallAnswer(noise, together, alone, forms, errors)


def errors_on_second_drops(drops: Sequence[Run], equations: Equations) -> Array:
    """(2,) medians over the balls of the rms [m] on drop 2, by least squares with a law fitted to drop 1.

    The initial state is fitted to the whole drop; or to its first SEEN seconds, with the error of the rest.
    """
    first, second = ([replace(d, sigma=1.0, fit_until=None) for d in drops if d.groups["drop"] == k] for k in "12")
    answer = diagnose(equations, first, (), settings=Settings(noise=1.0))
    errors = []
    for run in second:
        left = np.asarray(run.data["h"]) - answer.forecast(run, window=np.inf, by="before")["h"]
        errors.append((np.sqrt(np.mean(left**2)), answer.score(run, window=SEEN, by="before")["h"].rms))
    return np.median(errors, axis=0)


def sentence(answer: BallAnswer) -> str:
    """The answer in plain words."""
    if not answer.together.found:
        return f"Nothing is claimed to be missing besides gravity: {answer.together.diagnosis.reason}."
    null = [name for name, a in answer.alone.items() if a.verdict == "nothing missing"]
    text = f"Drag is missing (not seen, for these drops, on {', '.join(null) or 'none'})"
    forms = " and ".join(" + ".join(effects) for effects in answer.undecided)
    if answer.identifiable:
        return f"{text}; its form is that of {forms}."
    return f"{text}, but its form is not identifiable: {forms} describe the drops equally well."


def report(answer: BallAnswer) -> Report:
    """Before and after, for people."""
    n = answer.noise
    errors = [(name, *(rounded(x) for x in both)) for name, both in answer.errors.items()]
    forms = [(" + ".join(effects), score(over)) for effects, over in answer.forms.items()]
    alone = [(name, a.verdict, ", ".join(a.found)) for name, a in answer.alone.items()]
    return Report(
        "Falling balls: what does gravity alone lack?",
        sentence(answer),
        f"noise of a height: {n.white:.3f} m white, {n.smooth:.3f} m with a correlation time of {n.memory:.2f} s",
        blocks=[
            Section(
                "Median of the balls' rms on the second drop (m)",
                [Listing(("law fitted to the first", "whole", f"after {SEEN} s"), errors)],
            ),
            Section("All balls together", [Listing(("effects", "longer by"), forms)]),
            Section("Each ball alone", [Listing(("ball", "verdict", "missing"), alone)]),
        ],
        data=answer.together.document()
        | {"identifiable": answer.identifiable, "cannot_be_told_apart": answer.undecided},
    )


def example(folder: Path) -> Outcome:
    """What does gravity alone lack for falling balls, and is its law identifiable?"""
    answer = analyse_drops(read_drops(folder))
    return report(answer), {"all balls": answer.together}


if __name__ == "__main__":
    command(example, "ball_drops.csv")
