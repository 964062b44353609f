"""Balls dropped from a height (de Silva et al. 2020): gravity alone lacks drag. Can its law be told?

    python -m disctrack.examples.ball_drop FOLDER [-o DIR]

FOLDER holds `ball_drops.csv` (ball, drop, t_s, height_m) and `balls.txt` (weights in ounces, circumferences in cm).
Every ball was dropped twice: laws are fitted to drop 1 and to the first 1.2 s of drop 2, and judged on the rest. All
balls together, and each alone; what two drops of one ball do not have in common is noise with a memory.
Data: Frontiers in Artificial Intelligence 3:25; 11 balls.
"""

import csv
import sys
from collections import defaultdict
from collections.abc import Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path

import numpy as np

from calibration.kit.arrays import Array
from disctrack.discrepancy.equations import Answer, Equations, Parameter, Run, SmoothNoise, Term, diagnose
from disctrack.discrepancy.equations.system import EquationSystem
from disctrack.discrepancy.fit import Fit, fit
from disctrack.discrepancy.held_out import held_out
from disctrack.discrepancy.noise import SampleStretch, estimate
from disctrack.discrepancy.search import CLASS_GAIN, Settings
from disctrack.discrepancy.significance import price_of_a_number
from disctrack.discrepancy.system import subset
from disctrack.errors import AnalysisError
from disctrack.examples._command import Outcome, command, needed

GRAVITY = 9.81  # [m/s^2] as declared
AIR_DENSITY = 1.2  # [kg/m^3] at 20 degC
OUNCE = 0.028349523125  # [kg]
ACCELERATION_DEGREE = 4  # of the polynomial in time that all drops of a ball share: any drag, to 1 mm
SEEN = 1.2  # [s] of a second drop from which the rest is foretold, as in the published comparison
FALL = Equations(
    {"h": "v", "v": "-g"}, constants={"g": GRAVITY, "per_cd": 0.0}, units={"h": "m", "v": "m/s"},
    name=f"free fall, g = {GRAVITY} m/s^2",
)  # fmt: skip


def _drag(name: str, force: str, unit: str, typical: float, title: str) -> Term:
    """A law with a number of its own for every ball."""
    number = Parameter(0.0, unit, lower=0.0, typical=typical, per="ball")
    return Term(name, {"v": f"k*({force})"}, parameters={"k": number}, title=title, source="de Silva et al. 2020")


DRAG = (  # the constant one takes its sign from a fall
    _drag("constant_drag", "1", "m/s^2", 1.0, "deceleration that does not depend on speed"),
    _drag("linear_drag", "-v", "1/s", 0.1, "drag in proportion to the speed"),
    _drag("quadratic_drag", "-v*abs(v)", "1/m", 0.01, "drag in proportion to the square of the speed"),
)
CAMERA = Term("perspective", observed={"h": "bend*(h - 30)**2"}, title="scale of the heights changes with height",
              parameters={"bend": Parameter(0.0, "1/m", typical=1e-3)})  # fmt: skip
OTHERS = (
    Term("gravity", {"v": "-change"}, parameters={"change": Parameter(0.0, "m/s^2", typical=0.01)}),
    Term("height_scale", observed={"h": "change*(h - 30)"}, parameters={"change": Parameter(0.0, typical=0.02)}),
    Term("frame_rate", clock="-t*change/(1 + change)", parameters={"change": Parameter(0.0, typical=1e-3)}),
    CAMERA,
)
# one number for all of known size and mass: what a law of nature would be
SPHERE = Term("sphere_drag", {"v": "-Cd*per_cd*v*abs(v)"}, title="quadratic drag, one coefficient for all balls",
              parameters={"Cd": Parameter(0.0, lower=0.0, typical=0.5)})  # fmt: skip


@dataclass(frozen=True)
class Drop:
    """Height of one ball over time."""

    ball: str
    number: int
    time: Array  # (n,) [s]
    height: Array  # (n,) [m]
    per_cd: float = 0.0  # rho A / (2 m) [1/m]: deceleration over v^2 for a drag coefficient of one; 0: not known


def read_drops(folder: Path) -> tuple[Drop, ...]:
    """All drops of `ball_drops.csv`, with mass and radius from `balls.txt`. Raises AnalysisError."""
    path, per_cd = needed(folder, "ball_drops.csv"), {}
    for words in map(str.split, needed(folder, "balls.txt").read_text().splitlines()[1:]):
        with suppress(ValueError, IndexError):  # nobody measured it
            mass, radius = OUNCE * float(words[1]), 0.01 * float(words[2]) / (2 * np.pi)
            per_cd[_key(words[0])] = AIR_DENSITY * np.pi * radius**2 / (2 * mass)
    rows = defaultdict[tuple[str, int], list[tuple[float, float]]](list)
    with path.open(newline="") as stream:
        for line, row in enumerate(csv.DictReader(stream), start=2):
            try:
                rows[row["ball"], int(row["drop"])].append((float(row["t_s"]), float(row["height_m"])))
            except (KeyError, TypeError, ValueError) as error:
                raise AnalysisError(f"{path}, line {line}: expected ball,drop,t_s,height_m; found {row}.") from error
    columns = {key: np.array(samples, float).T for key, samples in rows.items()}
    return tuple(Drop(b, n, time, height, per_cd.get(_key(b), 0.0)) for (b, n), (time, height) in columns.items())


def _key(name: str) -> str:
    plain = name.lower().replace(" ", "").replace("whiffle", "wiffle")
    return plain.replace("ball", "").replace("basket", "basketball")


def height_noise(drops: Sequence[Drop]) -> SmoothNoise:
    """Noise of a height [m] and [s], from what drops of one ball do not have in common.

    All drops of a ball share an acceleration that is a polynomial in time; start and velocity are each drop's own. What
    is left (grain of the pixels, a hand that throws, wind, a scale that differs from take to take) is no law of the
    ball. One drop alone shows less of it.
    """
    stretches = []
    for ball in dict.fromkeys(d.ball for d in drops):
        takes = [d for d in drops if d.ball == ball]
        time = np.concatenate([d.time - d.time[0] for d in takes])
        part = np.repeat(np.arange(len(takes)), [len(d.time) for d in takes])
        own = (part[:, None] == np.arange(len(takes))).astype(float)
        u = time[:, None] / time.max()
        basis = np.concatenate([own, own * u, *(u**k for k in range(2, ACCELERATION_DEGREE + 3))], axis=1)
        stretches.append(SampleStretch(time, np.concatenate([d.height for d in takes])[:, None], basis, part))
    return estimate(stretches, SmoothNoise(0.05, 0.15, 0.5))


@dataclass(frozen=True)
class Form:
    """One law for all balls, with or without a camera that bends the scale of heights."""

    effects: tuple[str, ...]
    fit: Fit
    criterion: float  # chi-square plus the Bayesian criterion's price
    log_density: float  # of the second drops after SEEN


@dataclass(frozen=True)
class BallAnswer:
    """Everything asked of a set of drops."""

    noise: SmoothNoise
    together: Answer
    alone: Mapping[str, Answer]
    forms: tuple[Form, ...]  # best first
    # by form, and "gravity alone": rms [m] on the second drop of every ball of a law fitted to the first, with a start
    # that is fitted to "whole" of it, or to its first SEEN seconds and the error taken after them, "forecast"
    errors: Mapping[str, Mapping[str, dict[str, float]]]

    @property
    def undecided(self) -> tuple[Form, ...]:
        """Forms whose criterion is within CLASS_GAIN of the best one's."""
        return tuple(f for f in self.forms if f.criterion < self.forms[0].criterion + CLASS_GAIN)

    @property
    def identifiable(self) -> bool:
        """True if all that remain in question share one law of drag."""
        return len({form.effects[0] for form in self.undecided}) == 1


def analyse_drops(drops: Sequence[Drop]) -> BallAnswer:
    """Diagnose all balls together and each alone, compare the forms of the law, measure errors on the second drops."""
    noise = height_noise(drops)
    known = len({d.ball for d in drops}) > 1 and any(d.per_cd for d in drops)
    together = ask(drops, noise, (*DRAG, *OTHERS, SPHERE) if known else (*DRAG, *OTHERS))
    balls = dict.fromkeys(d.ball for d in drops)
    alone = {ball: ask([d for d in drops if d.ball == ball], noise, (*DRAG, *OTHERS)) for ball in balls}
    camera = ((), (CAMERA.name,))
    forms = [_form(together, (term.name, *more)) for term in DRAG for more in camera]
    errors = {name: errors_of(together, name) for name in ("gravity alone", *(term.name for term in DRAG))}
    return BallAnswer(noise, together, alone, tuple(sorted(forms, key=lambda f: f.criterion)), errors)


def ask(drops: Sequence[Drop], noise: SmoothNoise, terms: Sequence[Term]) -> Answer:
    """What a free fall lacks for these drops. The noise is that of all balls, and takes of one may differ."""
    runs = [
        Run(d.time, {"h": d.height}, noise=noise, name=f"{d.ball},{d.number}", groups={"ball": d.ball},
            constants={"per_cd": d.per_cd}, fit_until=np.inf if d.number == 1 else SEEN - d.time[0])
        for d in drops
    ]  # fmt: skip
    at_noise = 1 + 3 * np.sqrt(2 / sum(len(d.time) for d in drops))  # three sigmas of a reduced chi-square
    settings = Settings(noise=1.0, unexplained_share=0.2, at_noise=float(at_noise))
    return diagnose(FALL, runs, terms, settings=settings)


def _form(answer: Answer, effects: tuple[str, ...]) -> Form:
    system, base = answer.system, answer.diagnosis.before
    new = tuple(q for c in system.candidates if c.name in effects for q in c.quantities)
    fitted = fit(system, (*system.base, *new), base.values)
    held = held_out(system, fitted.quantities, fitted.values, system.training)
    criterion = fitted.cost + len(new) * price_of_a_number(system.weights)
    return Form(effects, fitted, float(criterion), held.log_density)


def errors_of(answer: Answer, form: str) -> dict[str, dict[str, float]]:
    """Least squares without a model of the noise: a law fitted to drops 1, errors on drops 2 of the same balls."""
    plain = [replace(s, noise=None) for s in answer.system.stretches]
    drops = {k: [s for s in plain if s.run.endswith(f",{k}")] for k in (1, 2)}
    balls = [{s.groups["ball"] for s in drops[k]} for k in (1, 2)]
    first, second = (
        answer.system.with_(stretches=[s for s in drops[k] if s.groups["ball"] in balls[0] & balls[1]]) for k in (1, 2)
    )
    law = tuple(q for c in first.candidates if c.name == form for q in c.quantities)
    values = fit(first, (*first.base, *law), answer.diagnosis.before.values).values
    whole = fit(second, second.base, values).values
    begun = fit(subset(second, second.training), second.base, values).values
    return {"whole": _rms(second, whole, -np.inf), "forecast": _rms(second, begun, SEEN)}


def _rms(system: EquationSystem, values: Mapping[str, float], since: float) -> dict[str, float]:
    found = {}
    for s, seen in zip(system.stretches, system.predictions(values), strict=True):
        late = s.time > since
        found[s.groups["ball"]] = float(np.sqrt(np.mean((s.data - seen.seen)[late] ** 2))) if seen else np.nan
    return found


def _words(effects: Sequence[str]) -> str:
    return " + ".join(e.replace("_drag", " drag") for e in effects)


def sentence(answer: BallAnswer) -> str:
    """The answer in plain words."""
    if not answer.together.found:
        return f"Nothing is claimed to be missing beside gravity: {answer.together.diagnosis.reason}."
    null = [name for name, a in answer.alone.items() if a.verdict == "nothing missing"]
    text = f"Drag is missing (not seen, for these drops, on {', '.join(null) or 'none'})"
    if answer.identifiable:
        return f"{text}; its form is that of {_words(answer.forms[0].effects)}."
    rivals = " and ".join(_words(f.effects) for f in answer.undecided)
    return f"{text}, but its form is not identifiable: {rivals} describe the drops equally well."


def report(answer: BallAnswer) -> str:
    """Before and after, for people."""
    n = answer.noise
    lines = [sentence(answer),
             f"Noise of a height: {n.white:.3f} m white and {n.smooth:.3f} m with a memory of {n.memory:.2f} s.", "",
             f"{'rms on the second drop [m], median of the balls':<52}{'whole':>8}{f'after {SEEN} s':>13}"]  # fmt: skip
    for name, e in answer.errors.items():
        whole, forecast = (float(np.median(list(x.values()))) if x else np.nan for x in e.values())
        lines.append(f"  {_words([name]):<50}{whole:8.2f}{forecast:13.2f}")
    lines += ["", f"{'all balls together':<36}{'chi-square':>11}{'criterion':>11}{'held-out 2 ln p':>17}"]
    lines.append(f"  {'gravity alone':<34}{answer.together.diagnosis.before.reduced_chi_square:11.2f}")
    best = answer.forms[0]
    for f in answer.forms:
        over = f.criterion - best.criterion, 2 * (f.log_density - best.log_density)
        lines.append(f"  {_words(f.effects):<34}{f.fit.reduced_chi_square:11.2f}{over[0]:+11.1f}{over[1]:+17.1f}")
    lines += ["", "each ball alone"]
    return "\n".join(
        [*lines, *(f"  {name:<20}{a.verdict:<17}{', '.join(a.found)}" for name, a in answer.alone.items())]
    )


def example(folder: Path) -> Outcome:
    """What does gravity alone lack for falling balls, and is its law identifiable?"""
    answer = analyse_drops(read_drops(folder))
    forms = [{"effects": f.effects, "criterion": f.criterion, "held_out_log_density": f.log_density,
              "reduced_chi_square": f.fit.reduced_chi_square} for f in answer.forms]  # fmt: skip
    found = answer.together.document() | {
        "sentence": sentence(answer),
        "noise": vars(answer.noise),
        "identifiable": answer.identifiable,
        "cannot_be_told_apart": [f.effects for f in answer.undecided],
        "forms": forms,
        "errors_m": answer.errors,
        "balls": {name: a.document() for name, a in answer.alone.items()},
    }
    return Outcome(report(answer), found, {"all balls": answer.together})


main = partial(command, "ball_drop", "ball_drops.csv and balls.txt", example)


if __name__ == "__main__":
    sys.exit(main())
