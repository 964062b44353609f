"""Balls dropped from a height (de Silva et al. 2020): gravity alone lacks drag. Can its law be told?

    python -m disctrack.examples.ball_drop FOLDER [-o DIR]

FOLDER holds `ball_drops.csv` (ball, drop, t_s, height_m). Every ball was dropped twice: laws are fitted to drop 1 and
to the first 1.2 s of drop 2, and judged on the rest. All balls together, and each alone; what two drops of one ball do
not have in common is noise with a memory.
Data: Frontiers in Artificial Intelligence 3:25; 11 balls.
"""

import csv
import sys
from collections import defaultdict
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path

import numpy as np

from calibration.kit.arrays import Array
from disctrack.discrepancy.equations import Answer, Equations, Parameter, Run, SmoothNoise, Term, diagnose
from disctrack.discrepancy.noise import SampleStretch, estimate
from disctrack.discrepancy.search import CLASS_GAIN, Settings
from disctrack.discrepancy.significance import price_of_a_number
from disctrack.errors import AnalysisError
from disctrack.examples._command import GRAVITY, Outcome, command, needed
from disctrack.numbers import rounded, score
from disctrack.report.blocks import Listing, Report, Section

ACCELERATION_DEGREE = 4  # of the polynomial in time that all drops of a ball share: any drag, to 1 mm
SEEN = 1.2  # [s] of a second drop from which the rest is predicted, as in the published comparison
FALL = Equations(
    {"h": "v", "v": "-g"},
    constants={"g": GRAVITY},
    units={"h": "m", "v": "m/s"},
    name=f"free fall, g = {GRAVITY} m/s^2",
)
DRAG = {  # by name: force per mass with a number of its own for every ball; the constant one takes its sign from a fall
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
    """One drop of a ball: time [s], height [m]."""
    return Run(time, {"h": height}, name=f"{ball},{number}", groups={"ball": ball})


def read_drops(folder: Path) -> tuple[Run, ...]:
    """All drops of `ball_drops.csv`. Raises AnalysisError."""
    path, rows = needed(folder, "ball_drops.csv"), defaultdict[tuple[str, int], list[tuple[float, float]]](list)
    with path.open(newline="") as stream:
        for line, row in enumerate(csv.DictReader(stream), start=2):
            try:
                rows[row["ball"], int(row["drop"])].append((float(row["t_s"]), float(row["height_m"])))
            except (KeyError, TypeError, ValueError) as error:
                raise AnalysisError(f"{path}, line {line}: expected ball,drop,t_s,height_m; found {row}.") from error
    return tuple(drop(ball, number, *np.array(samples, float).T) for (ball, number), samples in rows.items())


def _by_ball(drops: Sequence[Run]) -> dict[str, list[Run]]:
    found = defaultdict[str, list[Run]](list)
    for run in drops:
        found[run.groups["ball"]].append(run)
    return dict(found)


def height_noise(drops: Sequence[Run]) -> SmoothNoise:
    """Noise of a height [m] and [s], from what drops of one ball do not have in common.

    All drops of a ball share an acceleration that is a polynomial in time; start and velocity are each drop's own. What
    is left (grain of the pixels, a hand that throws, wind, a scale that differs from take to take) is no law of the
    ball. One drop alone shows less of it.
    """
    stretches = []
    for takes in _by_ball(drops).values():
        clocks = [np.asarray(d.time) - np.asarray(d.time)[0] for d in takes]
        time, part = np.concatenate(clocks), np.repeat(np.arange(len(takes)), [len(t) for t in clocks])
        own = (part[:, None] == np.arange(len(takes))).astype(float)
        u = time[:, None] / time.max()
        basis = np.concatenate([own, own * u, *(u**k for k in range(2, ACCELERATION_DEGREE + 3))], axis=1)
        heights = np.concatenate([np.asarray(d.data["h"]) for d in takes])
        stretches.append(SampleStretch(time, heights[:, None], basis, part))
    return estimate(stretches, SmoothNoise(0.05, 0.15, 0.5))


def ask(drops: Sequence[Run], noise: SmoothNoise, terms: Sequence[Term], equations: Equations = FALL) -> Answer:
    """What the equations lack for these drops. The noise is that of all balls, and takes of one may differ."""
    until = [np.inf if d.name.endswith(",1") else SEEN - np.asarray(d.time)[0] for d in drops]
    runs = [replace(d, noise=noise, fit_until=t) for d, t in zip(drops, until, strict=True)]
    at_noise = 1 + 3 * np.sqrt(2 / sum(len(np.asarray(d.time)) for d in drops))  # three sigmas of a reduced chi-square
    settings = Settings(noise=1.0, unexplained_share=0.2, at_noise=float(at_noise))
    return diagnose(equations, runs, terms, settings=settings)


@dataclass(frozen=True)
class BallAnswer:
    """Everything asked of a set of drops."""

    noise: SmoothNoise
    together: Answer
    alone: Mapping[str, Answer]
    by_law: Mapping[str, Answer]  # what a fall with that law of drag lacks
    # by law, and "gravity alone": rms [m] on the second drop of every ball of a law fitted to the first, with a start
    # that is fitted to "whole" of it, or to its first SEEN seconds and the error taken after them, "forecast"
    errors: Mapping[str, Mapping[str, dict[str, float]]]

    @property
    def forms(self) -> dict[tuple[str, ...], float]:
        """Laws, alone and with what they lack: Bayesian criterion over that of the best one, best first."""
        found = {}
        for law, answer in self.by_law.items():
            d, price = answer.diagnosis, price_of_a_number(answer.system.weights)
            for effects, fitted in (((law,), d.before), ((law, *answer.found), d.after)):
                found[effects] = fitted.cost + len(fitted.shared) * price
        return {effects: found[effects] - min(found.values()) for effects in sorted(found, key=lambda e: found[e])}

    @property
    def undecided(self) -> tuple[tuple[str, ...], ...]:
        """Forms that the data do not tell from the best one."""
        return tuple(effects for effects, over in self.forms.items() if over < CLASS_GAIN)

    @property
    def identifiable(self) -> bool:
        """True if all that remain in question share one law of drag."""
        return len({effects[0] for effects in self.undecided}) == 1


def analyse_drops(drops: Sequence[Run]) -> BallAnswer:
    """Diagnose all balls together and each alone, compare the forms of the law, measure errors on the second drops."""
    noise = height_noise(drops)
    alone = {ball: ask(takes, noise, (*DRAGS, *OTHERS)) for ball, takes in _by_ball(drops).items()}
    by_law = {name: ask(drops, noise, OTHERS[-1:], with_drag(name)) for name in DRAG}
    errors = {"gravity alone": errors_of(drops, FALL), **{name: errors_of(drops, with_drag(name)) for name in DRAG}}
    return BallAnswer(noise, ask(drops, noise, (*DRAGS, *OTHERS)), alone, by_law, errors)


def with_drag(name: str) -> Equations:
    """A fall with one of the laws declared."""
    force, k = DRAG[name]
    return replace(FALL, rates={"h": "v", "v": f"-g + {force}"}, parameters={"k": k}, name=name)


def errors_of(drops: Sequence[Run], equations: Equations) -> dict[str, dict[str, float]]:
    """Least squares without a model of the noise: a law fitted to drops 1, errors on drops 2 of the same balls."""
    first, second = ([replace(d, sigma=1.0) for d in drops if d.name.endswith(f",{k}")] for k in (1, 2))
    answer = diagnose(equations, first, (), settings=Settings(noise=1.0))
    found: dict[str, dict[str, float]] = {"whole": {}, "forecast": {}}
    for run in (d for d in second if d.groups["ball"] in _by_ball(first)):
        ball, time, height = run.groups["ball"], np.asarray(run.time), np.asarray(run.data["h"])
        whole, ahead = (height - answer.forecast(run, window=w, by="before")["h"] for w in (np.inf, SEEN - time[0]))
        found["whole"][ball] = float(np.sqrt(np.mean(whole**2)))
        found["forecast"][ball] = float(np.sqrt(np.mean(ahead[time - time[0] > SEEN] ** 2)))
    return found


def _words(effects: Sequence[str]) -> str:
    return " + ".join(e.replace("_drag", " drag") for e in effects)


def sentence(answer: BallAnswer) -> str:
    """The answer in plain words."""
    if not answer.together.found:
        return f"Nothing is claimed to be missing besides gravity: {answer.together.diagnosis.reason}."
    null = [name for name, a in answer.alone.items() if a.verdict == "nothing missing"]
    text = f"Drag is missing (not seen, for these drops, on {', '.join(null) or 'none'})"
    if answer.identifiable:
        return f"{text}; its form is that of {_words(answer.undecided[0])}."
    alternatives = " and ".join(_words(effects) for effects in answer.undecided)
    return f"{text}, but its form is not identifiable: {alternatives} describe the drops equally well."


def report(answer: BallAnswer) -> Report:
    """Before and after, for people."""
    n, errors = answer.noise, []
    for name, e in answer.errors.items():
        medians = [float(np.median(list(x.values()))) if x else np.nan for x in e.values()]
        errors.append((_words([name]), *(rounded(x) for x in medians)))
    forms = [(_words(effects), score(over)) for effects, over in answer.forms.items()]
    alone = [(name, a.verdict, ", ".join(a.found)) for name, a in answer.alone.items()]
    return Report(
        "Falling balls: what does gravity alone lack?",
        sentence(answer),
        f"noise of a height: {n.white:.3f} m white and {n.smooth:.3f} m with a memory of {n.memory:.2f} s",
        blocks=[
            Section(
                "Median of the balls' rms on the second drop (m)",
                [Listing(("law fitted to the first", "whole", f"after {SEEN} s"), errors)],
            ),
            Section("All balls together", [Listing(("effects", "criterion"), forms)]),
            Section("Each ball alone", [Listing(("ball", "verdict", "missing"), alone)]),
        ],
        data={
            **answer.together.document(),
            "identifiable": answer.identifiable,
            "cannot_be_told_apart": answer.undecided,
        },
    )


def example(folder: Path) -> Outcome:
    """What does gravity alone lack for falling balls, and is its law identifiable?"""
    answer = analyse_drops(read_drops(folder))
    return report(answer), {"all balls": answer.together}


main = partial(command, "ball_drop", "ball_drops.csv", example)


if __name__ == "__main__":
    sys.exit(main())
