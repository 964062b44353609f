"""Tosses of a cube (Pfrommer, Halm & Posa 2020): what do gravity and torque-free rotation lack between the contacts?

    python -m disctrack.examples.cube_tosses FOLDER [-o DIR]

FOLDER holds `cube_tosses.npz`. Two thirds of the tosses are fitted, every third judges; copies of a toss are taken out
(the published tosses are turned about the vertical, each by an angle of its own, and some stand there twice). Free
flight sees gravity, frame rate and scale of the lengths as one number; cubes at rest tell them apart.
"""

from __future__ import annotations

import sys
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib.figure import Figure

from calibration.arrays import Array
from disctrack.diagnosis import Diagnosis, Settings, diagnose
from disctrack.diagnosis.engine.fit import Fit, fit
from disctrack.diagnosis.engine.held_out import held_out
from disctrack.diagnosis.engine.search import CLASS_GAIN
from disctrack.diagnosis.engine.system import Subset, Values
from disctrack.diagnosis.pages.general import document, fit_errors, memory, portmanteau
from disctrack.diagnosis.pages.words import quantity_text
from disctrack.examples._command import Outcome, command
from disctrack.examples.cube_checks import checks
from disctrack.examples.cube_data import (
    FRAME_RATE,
    HALF_WIDTH,
    Toss,
    read_tosses,
)
from disctrack.examples.cube_effects import GRAVITY
from disctrack.examples.cube_system import CHANNELS, GROUPS, HELD_OUT, CubeTosses, white_chi_square
from disctrack.pages.figures import dress
from disctrack.pages.palette import BLUE, MUTED, RED

# The covariance of the noise is that of the data already. Eight effects at most.
SETTINGS = Settings(noise=1.0, unexplained_share=0.2, max_effects=8)
LAGS = 5  # samples, of the portmanteau test
SEEN = 0.6  # share of a held-out flight from which the rest is forecast
# What else might be meant by an effect that was found, to be tried in its place.
IN_PLACE = {
    "length_scale": (
        ("gravity",),
        ("gravity", "half_width"),
        ("frame_rate", "half_width"),
        ("gravity", "table_height"),
    ),
    "toss_tilt": (("side_force",), ("frame_rotation",), ("tilt",)),
    "perspective": (("linear_drag",), ("quadratic_drag",)),
    "centre_of_mass": (("face_bias",),),
}
ONE_NUMBER = ("gravity", "frame_rate", "length_scale")  # to free flight


@dataclass(frozen=True)
class Errors:
    """Of held-out tosses, with values fitted to the others."""

    rms: dict[str, float]  # per group of channels [m], [rad]
    forecast_end: dict[str, float]  # rms at the last sample of a flight, from its first SEEN


@dataclass(frozen=True)
class Alternative:
    """Other effects fitted in place of one that was found."""

    effect: str
    instead: tuple[str, ...]
    criterion: float  # chi-square plus the Bayesian criterion's price, minus that of what was found
    held_out: float  # 2 ln p of held-out tosses, minus that of what was found

    @property
    def equal(self) -> bool:
        """True where the data do not tell them apart."""
        return self.criterion < CLASS_GAIN and self.held_out > -CLASS_GAIN


@dataclass(frozen=True)
class CubeAnswer:
    """Everything asked of the tosses."""

    system: CubeTosses
    diagnosis: Diagnosis
    before: Errors
    after: Errors
    without: dict[str, Errors]  # with one effect taken out again, the rest refitted
    pull: dict[str, float]  # largest difference of its values, fitted tosses against held-out ones, in sigmas
    alternatives: tuple[Alternative, ...]
    left_over_white: dict[str, dict[str, float]]  # before and after: mean square over the white noise alone
    checks: dict[str, tuple[float, float]]  # other numbers of the same tosses, with standard errors


def analyse_tosses(tosses: Sequence[Toss]) -> CubeAnswer:
    """Diagnose, and measure errors on held-out tosses. Raises AnalysisError."""
    system = CubeTosses(tosses)
    rows = system.training_rows()
    diagnosis = diagnose(system, {}, SETTINGS, rows)
    found = [f.candidate for f in diagnosis.found]
    training = Subset(system, rows)
    trained: Values = {}
    if diagnosis.held_out_after is not None:
        trained = diagnosis.held_out_after.train.values
    without = {}
    for candidate in found:
        rest = tuple(dict.fromkeys(q for c in found if c is not candidate for q in c.quantities))
        without[candidate.name] = errors_of(system, fit(training, rest, {}).values)
    held = fit(Subset(system, ~rows), tuple(dict.fromkeys(q for c in found for q in c.quantities)), {})
    pull = {c.name: max(_pull(diagnosis, held, q.name) for q in c.quantities) for c in found}
    others = alternatives(system, diagnosis)
    also = checks(tosses, system.flights)
    over_white = {
        "before": white_chi_square(system, diagnosis.before.values),
        "after": white_chi_square(system, diagnosis.after.values),
    }
    return CubeAnswer(
        system, diagnosis, errors_of(system, {}), errors_of(system, trained), without, pull, others, over_white, also
    )


def _pull(diagnosis: Diagnosis, held: Fit, name: str) -> float:
    assert diagnosis.held_out_after is not None
    fitted = diagnosis.held_out_after.train
    sigma = np.hypot(fitted.sigma(name), held.sigma(name))
    return abs(fitted.values[name] - held.values[name]) / sigma if sigma > 0 else 0.0


def alternatives(system: CubeTosses, diagnosis: Diagnosis) -> tuple[Alternative, ...]:
    """IN_PLACE, for the effects that were found; the rest of them is refitted along."""
    if diagnosis.held_out_after is None:
        return ()
    catalogue = {c.name: c for c in system.candidates}
    found = [f.candidate for f in diagnosis.found]
    price = float(np.log(np.sum(system.weights)))
    answers = []
    for candidate in found:
        for instead in IN_PLACE.get(candidate.name, ()):
            rest = [c for c in found if c is not candidate and c.name not in instead]
            quantities = tuple(q for c in (*rest, *(catalogue[n] for n in instead)) for q in c.quantities)
            other = fit(system, quantities, {})
            more = len(quantities) - len(diagnosis.after.quantities)
            held = held_out(system, quantities, {}, system.training_rows())
            gain = 2 * (held.log_density - diagnosis.held_out_after.log_density)
            criterion = other.cost - diagnosis.after.cost + price * more
            answers.append(Alternative(candidate.name, instead, float(criterion), float(gain)))
    return tuple(answers)


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
    effects = []
    for f in d.found:
        amounts = ", ".join(
            f"{q.name.partition('.')[2]} = {quantity_text(d.after.values[q.name], d.after.sigma(q.name), q.unit)}"
            for q in f.candidate.quantities
        )
        effects.append(f"{f.candidate.title} ({amounts})")
    text = "Missing: " + "; ".join(effects) if effects else "No effect is claimed to be missing"
    if d.verdict == "unexplained":
        return f"{text}. Something else is missing: {d.reason}."
    left = ", ".join(
        f"{_people(k, n.smooth):.0f} {'mdeg' if k == 'turn' else 'um'} ({k}) for {1e3 * n.memory:.0f} ms"
        for k, n in answer.system.noise.items()
    )
    return f"{text}. What remains, beside white noise, are errors of the poses that last some samples: {left}."


def _units(values: Mapping[str, float]) -> dict[str, float]:
    return {f"{k}_{'mdeg' if k == 'turn' else 'um'}": _people(k, v) for k, v in values.items()}


def _people(group: str, value: float) -> float:
    return float(1e3 * np.degrees(value)) if group == "turn" else 1e6 * value


def as_document(answer: CubeAnswer) -> dict[str, Any]:
    """Keys of diagnosis.json; besides, noise, errors in people's units, and independent checks."""
    d, system = answer.diagnosis, answer.system
    sides = {}
    for side, f, held, errors in (
        ("before", d.before, d.held_out_before, answer.before),
        ("after", d.after, d.held_out_after, answer.after),
    ):
        statistic = portmanteau(system, f, LAGS)
        common = fit_errors(f, held)
        common["held_out"] |= {"rms": _units(errors.rms), "forecast_end": _units(errors.forecast_end)}
        sides[side] = common | {
            "over_white_noise": answer.left_over_white[side],
            "whiteness": {
                "portmanteau": dict(zip(CHANNELS, statistic.tolist(), strict=True)),
                "degrees_of_freedom": LAGS,
                "autocorrelation": dict(zip(CHANNELS, memory(system, f, 1)[0].tolist(), strict=True)),
            },
        }
    model = f"g = {GRAVITY} m/s^2, uniform cube, {FRAME_RATE:g} Hz, half width {HALF_WIDTH} m"
    return document(d, model, sentence(answer), sides["before"], sides["after"]) | {
        "one_number_to_free_flight": list(ONE_NUMBER),
        "noise": {k: vars(v) for k, v in system.noise.items()},
        "without": {
            k: {"rms": _units(e.rms), "forecast_end": _units(e.forecast_end)} for k, e in answer.without.items()
        },
        "alternatives": [vars(a) | {"equal": a.equal} for a in answer.alternatives],
        "pull_of_held_out_values": answer.pull,
        "checks": {k: list(v) for k, v in answer.checks.items()},
        "flights": len(system.flights),
        "left_out": system.n_left_out,
        "copies": system.n_copies,
        "resting": len(system.cubes),
    }


def table(answer: CubeAnswer) -> str:
    """Before and after, for people."""
    d, system = answer.diagnosis, answer.system
    lines = [
        f"{len(system.flights)} flights ({system.n_left_out} tosses left out: too short, or not smooth; "
        f"{system.n_copies} copies of others turned about the vertical), {len(system.cubes)} cubes at rest; "
        "every third toss held out.",
        f"verdict: {d.verdict}; {d.reason}",
        "",
        f"{'held-out tosses':<34}{'before':>10}{'after':>10}{'white noise':>13}",
    ]
    for group, unit in (("horizontal", "um"), ("vertical", "um"), ("turn", "mdeg")):
        white = _people(group, system.noise[group].white)
        pairs = [(f"rms {group} [{unit}]", answer.before.rms, answer.after.rms, f"{white:13.1f}")]
        pairs.append(
            (f"  forecast of the last sample [{unit}]", answer.before.forecast_end, answer.after.forecast_end, "")
        )
        lines += [f"{t:<34}{_people(group, b[group]):10.1f}{_people(group, a[group]):10.1f}{w}" for t, b, a, w in pairs]
    ratios = [fit_errors(d.before, d.held_out_before), fit_errors(d.after, d.held_out_after)]
    chi = [r["reduced_chi_square"] for r in ratios]
    free = [r["held_out"]["ratio_to_noise_floor"] or np.nan for r in ratios]
    lines += [f"{'reduced chi-square, all tosses':<34}{chi[0]:10.2f}{chi[1]:10.2f}"]
    lines += [f"{'error over its floor, held out':<34}{free[0]:10.2f}{free[1]:10.2f}"]
    lag_one = [float(np.abs(memory(system, f, 1)[0]).max()) for f in (d.before, d.after)]
    lines += [f"{'largest autocorrelation, one sample':<35}{lag_one[0]:9.2f}{lag_one[1]:10.2f}", ""]
    lines.append(
        f"{'effect':<20}{'value':<62}{'chi-square':>10}{'held out':>10}{'pull':>6}  rms without it (um, um, mdeg)"
    )
    for f in d.found:
        values = "  ".join(
            f"{q.name.partition('.')[2]} {quantity_text(d.after.values[q.name], d.after.sigma(q.name), q.unit)}"
            for q in f.candidate.quantities
        )
        rms = ", ".join(f"{_people(k, v):.1f}" for k, v in answer.without[f.candidate.name].rms.items())
        rivals = ", ".join(r.candidate.name for r in f.cannot_be_told_from)
        worth = f"{f.gain:10.0f}{f.held_out_gain:10.0f}{answer.pull[f.candidate.name]:6.1f}"
        lines.append(f"{f.candidate.name:<20}{values:<62}{worth}  ({rms}){' or ' * bool(rivals)}{rivals}")
    lines += [
        "",
        "Not taken: " + "; ".join(f"{t.candidate.name} ({t.reason})" for t in d.tried if t.reason != "chosen"),
    ]
    lines += ["", "In place of an effect (criterion above, held-out 2 ln p below what was chosen):"]
    lines += [
        f"  {a.effect}: {' + '.join(a.instead)} {a.criterion:+.0f}, {a.held_out:+.0f}"
        + (" (not told apart)" if a.equal else "")
        for a in answer.alternatives
    ]
    lines += ["", "One number to free flight: " + ", ".join(ONE_NUMBER) + "; the height at rest separates the last."]
    for group, n in system.noise.items():
        lines.append(
            f"Noise, {group}: {_people(group, n.white):.1f} white, {_people(group, n.smooth):.1f} with a memory of "
            f"{1e3 * n.memory:.0f} ms; left over white alone {answer.left_over_white['before'][group]:.1f} -> "
            f"{answer.left_over_white['after'][group]:.2f}"
        )
    lines += [f"Check: {name}: {value:.4f} +- {sigma:.4f}" for name, (value, sigma) in answer.checks.items()]
    return "\n".join(lines)


def _mean_course(
    left: Sequence[Array], times: Sequence[Array], directions: Sequence[Array]
) -> tuple[Array, Array, Array]:
    """Mean of a component over flights against the time from their middles, and its standard error."""
    t = np.concatenate(times)
    y = np.concatenate([x[:, :3] @ e for x, e in zip(left, directions, strict=True)])
    bins = np.round(t * FRAME_RATE).astype(int)
    kept = [b for b in np.unique(bins) if np.sum(bins == b) >= 30]
    mean = np.array([y[bins == b].mean() for b in kept])
    error = np.array([y[bins == b].std() / np.sqrt(np.sum(bins == b)) for b in kept])
    return np.array(kept) / FRAME_RATE, mean, error


def figure(answer: CubeAnswer) -> Figure:
    """Mean residuals of held-out flights, the faces at rest, and what each effect removes."""
    system, d = answer.system, answer.diagnosis
    picture = Figure(figsize=(11, 7.5), layout="constrained")
    (up, across), (rest, bars) = picture.subplots(2, 2)
    for axes in (up, across, rest, bars):
        dress(axes)
    test = [i for i, f in enumerate(system.flights) if f.number % HELD_OUT == HELD_OUT - 1]
    times = [system.flights[i].time for i in test]
    trained = d.held_out_after.train.values if d.held_out_after is not None else {}
    for values, colour, label in (({}, RED, "before"), (trained, BLUE, "after")):
        left = system.residuals(values)
        for axes, name in ((up, "vertical"), (across, "across the flight")):
            e = [np.array([0.0, 0.0, 1.0]) if name == "vertical" else system.flights[i].across for i in test]
            t, mean, error = _mean_course([left[i] for i in test], times, e)
            axes.errorbar(1e3 * t, 1e6 * mean, 1e6 * error, fmt="o-", ms=3, lw=1, color=colour, label=label)
            axes.set(title=f"held-out flights, {name}", xlabel="time from the middle [ms]", ylabel="mean residual [um]")
    up.legend(frameon=False, fontsize=9)
    normals = 1e3 * np.array([c.normal for c in system.cubes]).reshape(-1, 2)
    rest.plot(*normals.T, ".", ms=3, color=MUTED)
    for x, y, colour, label in ((0.0, 0.0, RED, "declared vertical"), (*_lean(d.after.values), BLUE, "as diagnosed")):
        rest.plot(x, y, "+", ms=16, mew=2, color=colour, label=label)
    rest.set(title="faces at rest", xlabel="normal along the flight [mrad]", ylabel="across [mrad]")
    rest.margins(0.15)
    rest.set_aspect("equal", adjustable="datalim")
    rest.legend(frameon=False, fontsize=9)
    names = [f.candidate.name for f in d.found]
    bars.barh(names, [max(f.held_out_gain, 1.0) for f in d.found], color=BLUE)
    bars.invert_yaxis()
    bars.set(xscale="log", xlabel="gain on held-out tosses, 2 ln p", title="what each effect is worth")
    return picture


def _lean(values: Values) -> tuple[float, float]:
    """Normal of a resting face along and across [mrad]."""
    along, across = (
        -1e3 * sum(values.get(f"{effect}.{axis}", 0.0) for effect in ("toss_tilt", "table_tilt"))
        for axis in ("along", "across")
    )
    return along, across


def example(folder: Path) -> Outcome:
    """What do gravity and torque-free rotation lack for a tossed cube?"""
    answer = analyse_tosses(read_tosses(folder))
    return Outcome(table(answer), as_document(answer), figure(answer))


def main(words: Sequence[str] | None = None) -> int:
    """Run the example; returns the exit code."""
    return command("cube_tosses", "cube_tosses.npz", example, words)


if __name__ == "__main__":
    sys.exit(main())
