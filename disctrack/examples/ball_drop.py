"""Balls dropped from a height (de Silva et al. 2020): gravity alone lacks drag. Can its law be told?

    python -m disctrack.examples.ball_drop FOLDER [-o DIR]

FOLDER holds `ball_drops.csv` (ball, drop, t_s, height_m) and `balls.txt` (weights in ounces, circumferences in cm).
Every ball was dropped twice: laws are fitted to drop 1 and judged on drop 2. All balls together, and each alone, are
given to the engine of `disctrack.diagnosis`; what two drops of one ball do not have in common is noise with a memory.
"""

from __future__ import annotations

import sys
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib.figure import Figure

from disctrack.diagnosis import Diagnosis, Settings, diagnose
from disctrack.diagnosis.engine.fit import Fit, fit
from disctrack.diagnosis.engine.held_out import held_out
from disctrack.diagnosis.engine.noise_with_memory import SmoothNoise
from disctrack.diagnosis.engine.search import CLASS_GAIN
from disctrack.diagnosis.engine.system import Quantity, Subset
from disctrack.diagnosis.pages.general import document, fit_errors
from disctrack.examples._command import Outcome, command
from disctrack.examples.ball_system import GRAVITY, BallDrops, Drop, height_noise, read_drops
from disctrack.pages.figures import dress
from disctrack.pages.palette import AMBER, BLUE, GREEN, MUTED, RED

SEEN = 1.2  # [s] of a second drop from which the rest is foretold, as in the published comparison
FORMS = ("constant_drag", "linear_drag", "quadratic_drag")
CAMERA = "perspective"
_WHITE = SmoothNoise(0.05, 1e-6, 1.0)  # least squares, for comparison with what others did


@dataclass(frozen=True)
class Form:
    """One law for all balls, with or without a camera that bends the scale of heights."""

    effects: tuple[str, ...]
    fit: Fit
    criterion: float  # chi-square plus the Bayesian criterion's price
    log_density: float  # of the second drops after SEEN


@dataclass(frozen=True)
class Errors:
    """Rms [m] on the second drop of every ball of a law fitted to the first."""

    whole: dict[str, float]  # start of the second drop fitted to all of it
    forecast: dict[str, float]  # start fitted to its first SEEN seconds, error after them


@dataclass(frozen=True)
class BallAnswer:
    """Everything asked of a set of drops."""

    drops: tuple[Drop, ...]
    noise: SmoothNoise
    together: Diagnosis
    system: BallDrops
    alone: Mapping[str, Diagnosis]
    forms: tuple[Form, ...]  # best first
    errors: Mapping[str, Errors]  # by form, and "gravity alone"

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
    system = BallDrops(drops, noise)
    together = diagnose(system, system.start(), settings_for(system), system.training_rows(SEEN))
    alone = {}
    for ball in system.balls:
        one = BallDrops([d for d in drops if d.ball.name == ball.name], noise)
        alone[ball.name] = diagnose(one, one.start(), settings_for(one), one.training_rows(SEEN))
    forms = [_form(system, together.before, e) for form in FORMS for e in ((form,), (form, CAMERA))]
    forms.sort(key=lambda f: f.criterion)
    errors = {"gravity alone": errors_of(drops, None)} | {form: errors_of(drops, form) for form in FORMS}
    return BallAnswer(tuple(drops), noise, together, system, alone, tuple(forms), errors)


def settings_for(system: BallDrops) -> Settings:
    """The covariance of the noise is that of the data already; it is that of all balls, and takes of one may differ."""
    at_noise = 1 + 3 * np.sqrt(2 / np.sum(system.weights))  # three sigmas of a reduced chi-square
    return Settings(noise=1.0, unexplained_share=0.2, at_noise=float(at_noise))


def _quantities(system: BallDrops, effects: Sequence[str]) -> tuple[Quantity, ...]:
    return tuple(q for c in system.candidates if c.name in effects for q in c.quantities)


def _form(system: BallDrops, base: Fit, effects: tuple[str, ...]) -> Form:
    new = _quantities(system, effects)
    fitted = fit(system, (*system.base, *new), base.values)
    held = held_out(system, fitted.quantities, fitted.values, system.training_rows(SEEN))
    criterion = fitted.cost + len(new) * np.log(np.sum(system.weights))
    return Form(effects, fitted, float(criterion), held.log_density)


def errors_of(drops: Sequence[Drop], form: str | None) -> Errors:
    """Least squares without a model of the noise: a law fitted to drops 1, errors on drops 2 of the same balls."""
    numbers: dict[str, list[int]] = {}
    for drop in drops:
        numbers.setdefault(drop.ball.name, []).append(drop.number)
    pairs = [d for d in drops if sorted(numbers[d.ball.name]) == [1, 2]]
    if not pairs:
        return Errors({}, {})
    system = BallDrops(pairs, _WHITE)
    law = _quantities(system, [form] if form else [])
    starts = {k: tuple(q for i, d in enumerate(pairs) if d.number == k for q in system.own(i)) for k in (1, 2)}
    values = fit(Subset(system, system.number == 1), (*starts[1], *law), system.start()).values
    second = system.number == 2
    whole = fit(Subset(system, second), starts[2], values).values
    begun = fit(Subset(system, second & (system.time <= SEEN)), starts[2], values).values
    answers = []
    for fitted, since in ((whole, -np.inf), (begun, SEEN)):
        predicted = system.predicted(fitted)
        left = {
            d.ball.name: (d.height - h)[d.time > since] for d, h in zip(pairs, predicted, strict=True) if d.number == 2
        }
        answers.append({name: float(np.sqrt(np.mean(x**2))) for name, x in left.items()})
    return Errors(*answers)


def _median(errors: Mapping[str, float]) -> float:
    return float(np.median(list(errors.values()))) if errors else float("nan")


def drag_coefficients(answer: BallAnswer, form: Form) -> dict[str, tuple[float, float]]:
    """Cd and its sigma of every ball of known size and mass, from a fit with quadratic drag."""
    found = {}
    for ball in answer.system.balls:
        name = f"quadratic_drag.k[{ball.name}]"
        if np.isfinite(ball.mass) and name in form.fit.values:
            per_cd = ball.quadratic_per_cd
            found[ball.name] = (form.fit.values[name] / per_cd, form.fit.sigma(name) / per_cd)
    return found


def _words(effects: Sequence[str]) -> str:
    return " + ".join(e.replace("_drag", " drag") for e in effects)


def sentence(answer: BallAnswer) -> str:
    """The answer in plain words."""
    if not answer.together.found:
        return f"Nothing is claimed to be missing beside gravity: {answer.together.reason}."
    null = [name for name, d in answer.alone.items() if d.verdict == "nothing missing"]
    text = "Drag is missing"
    if null:
        text += f" (not seen, for these drops, on {', '.join(null)})"
    if answer.identifiable:
        return f"{text}; its form is that of {_words(answer.forms[0].effects)}."
    rivals = " and ".join(_words(f.effects) for f in answer.undecided)
    return f"{text}, but its form is not identifiable: {rivals} describe the drops equally well."


def as_document(answer: BallAnswer) -> dict[str, Any]:
    """Keys of diagnosis.json; besides, `forms`, `identifiable`, `errors_m` and every ball's own diagnosis."""
    d = answer.together
    before, after = ("gravity alone", d.found[0].candidate.name if d.found else "gravity alone")
    errors = {
        name: {"whole_drop": e.whole, "forecast": e.forecast, "median": {k: _median(getattr(e, k)) for k in vars(e)}}
        for name, e in answer.errors.items()
    }
    own = {
        key: fit_errors(f, h) | {"rms_m": errors.get(name, {}).get("median")}
        for key, f, h, name in (
            ("before", d.before, d.held_out_before, before),
            ("after", d.after, d.held_out_after, after),
        )
    }
    best = answer.forms[0]
    forms = [
        {
            "effects": list(f.effects),
            "criterion_over_best": f.criterion - best.criterion,
            "reduced_chi_square": f.fit.reduced_chi_square,
            "held_out_log_density": f.log_density,
            "drag_coefficient": drag_coefficients(answer, f),
        }
        for f in answer.forms
    ]
    alone = {name: document(x, f"g = {GRAVITY}", "", fit_errors(x.before, x.held_out_before),
                            fit_errors(x.after, x.held_out_after)) for name, x in answer.alone.items()}  # fmt: skip
    whole = document(d, f"free fall, g = {GRAVITY} m/s^2", sentence(answer), own["before"], own["after"])
    for effect in whole["effects"]:
        known = next((f for f in answer.forms if f.effects == (effect["candidate"],)), best)
        effect["class"] += [
            {"name": " + ".join(f.effects), "delta_chi_square": f.criterion - known.criterion}
            for f in answer.undecided
            if f is not known
        ]
    return whole | {
        "noise": vars(answer.noise),
        "identifiable": answer.identifiable,
        "forms": forms,
        "errors_m": errors,
        "balls": alone,
    }


def table(answer: BallAnswer) -> str:
    """Before and after, for people."""
    n = answer.noise
    lines = [
        sentence(answer),
        f"Noise of a height: {n.white:.3f} m white and {n.smooth:.3f} m with a memory of {n.memory:.2f} s.",
        "",
        f"{'rms on the second drop [m], median of the balls':<52}{'whole':>8}{f'after {SEEN} s':>13}",
    ]
    lines += [
        f"  {_words([name]):<50}{_median(e.whole):8.2f}{_median(e.forecast):13.2f}" for name, e in answer.errors.items()
    ]
    lines += ["", f"{'all balls together':<36}{'chi-square':>11}{'criterion':>11}{'held-out 2 ln p':>17}"]
    best = answer.forms[0]
    chi = answer.together.before
    lines.append(f"  {'gravity alone':<34}{chi.reduced_chi_square:11.2f}")
    lines += [
        f"  {_words(f.effects):<34}{f.fit.reduced_chi_square:11.2f}{f.criterion - best.criterion:+11.1f}"
        f"{2 * (f.log_density - best.log_density):+17.1f}"
        for f in answer.forms
    ]
    lines += [
        "",
        f"{'each ball alone':<22}{'verdict':<17}{'chi-square':<16}{'rms on drop 2 [m]':<20}best, and its class",
    ]
    for name, d in answer.alone.items():
        chi_text = f"{d.before.reduced_chi_square:.1f} -> {d.after.reduced_chi_square:.1f}"
        form = next((f.candidate.name for f in d.found if f.candidate.name in answer.errors), None)
        pair = [answer.errors[key].whole.get(name) for key in ("gravity alone", form) if key]
        rms = " -> ".join(f"{x:.2f}" for x in pair if x is not None)
        effects = "; ".join(
            f"{f.candidate.name} ({', '.join(r.candidate.name for r in f.cannot_be_told_from) or 'alone'})"
            for f in d.found
        )
        lines.append(f"  {name:<20}{d.verdict:<17}{chi_text:<16}{rms:<20}{effects}")
    for fitted in answer.forms:
        cd = drag_coefficients(answer, fitted)
        if cd:
            values = ", ".join(f"{name} {v:.2f}({100 * s:.0f})" for name, (v, s) in cd.items())
            lines += ["", f"Cd from {_words(fitted.effects)}: {values}"]
    return "\n".join(lines)


def figure(answer: BallAnswer) -> Figure:
    """Forecast of the second drops, errors by law, and what the forms leave."""
    picture = Figure(figsize=(11, 7.5), layout="constrained")
    (fall, bars), (left, forms) = picture.subplots(2, 2)
    for axes in (fall, bars, left, forms):
        dress(axes)
    whole = answer.errors["gravity alone"].whole
    shown = max(whole, key=lambda k: whole[k]) if whole else answer.drops[-1].ball.name
    by_form = {f.effects: f.fit.values for f in answer.forms}
    curves = [("gravity alone", answer.together.before.values, RED, "--")]
    curves += [
        (_words(e), by_form[e], c, "-") for e, c in zip(((x,) for x in FORMS), (AMBER, BLUE, GREEN), strict=True)
    ]
    for i, drop in enumerate(answer.drops):
        if drop.ball.name != shown:
            continue
        first = drop.number == 1
        fall.plot(drop.time, drop.height, "o" if first else "s", ms=3, color=MUTED, label=f"drop {drop.number}")
        for label, values, colour, style in curves:
            h = answer.system.predicted(values)[i]
            fall.plot(drop.time, h, style, lw=1.1, color=colour, label=label if first else None)
            if label != "gravity alone":
                left.plot(drop.time, drop.height - h, style, lw=1.0, color=colour, marker="o" if first else "s", ms=2.5,
                          label=label if first else None)  # fmt: skip
    fall.set(title=shown, xlabel="time [s]", ylabel="height [m]")
    left.set(title=f"{shown}: measured minus fitted, both drops", xlabel="time [s]", ylabel="residual [m]")
    for axes in (fall, left):
        axes.legend(frameon=False, fontsize=8)
    names = list(whole)
    colours = dict(zip(answer.errors, (RED, AMBER, BLUE, GREEN), strict=True))
    for shift, (form, e) in enumerate(answer.errors.items()):
        y = np.arange(len(names)) + 0.2 * (shift - 1.5)
        bars.barh(y, [e.forecast[k] for k in names], 0.2, color=colours[form], label=_words([form]))
    bars.set_yticks(range(len(names)), names)
    bars.invert_yaxis()
    bars.set(xscale="log", xlabel=f"rms of the forecast of drop 2 after {SEEN} s [m]", title="law fitted to drop 1")
    bars.legend(frameon=False, fontsize=8)
    best = answer.forms[0].criterion
    forms.barh([_words(f.effects) for f in answer.forms], [f.criterion - best + 1 for f in answer.forms], color=BLUE)
    forms.axvline(CLASS_GAIN + 1, color=RED, lw=1, ls="--")
    forms.invert_yaxis()
    forms.set(xscale="log", xlabel="1 + criterion above the best (dashed: not told apart)", title="all balls together")
    return picture


def example(folder: Path) -> Outcome:
    """What does gravity alone lack for falling balls, and is its law identifiable?"""
    answer = analyse_drops(read_drops(folder))
    return Outcome(table(answer), as_document(answer), figure(answer))


def main(words: Sequence[str] | None = None) -> int:
    """Run the example; returns the exit code."""
    return command("ball_drop", "ball_drops.csv and balls.txt", example, words)


if __name__ == "__main__":
    sys.exit(main())
