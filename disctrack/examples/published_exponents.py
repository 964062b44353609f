"""What is missing in the published exponents of Ma et al. (2014)? Tables 2 and 3 under the engine of diagnosis.

    python -m disctrack.examples.published_exponents -o DIR     # DIR/published_exponents.json and .png

The tables give the exponents of nutation, precession rate and energy in t_f - t for nine trials on steel and eight on
glass. On glass they contradict the paper's 2/3 and -1/3. The engine fits the paper's model to all of them, looks
through the catalogue of motions and through what the reading may do wrong, and says which effects would remove the
contradiction, which of them these tables cannot tell apart, and which trials would.
"""

from __future__ import annotations

import argparse
import json
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from disctrack.diagnosis import Diagnosis, Settings, diagnose
from disctrack.diagnosis.fit import Fit, fit
from disctrack.diagnosis.words import quantity_text
from disctrack.examples.exponent_analysis import (
    PLANS,
    THIN_DISC,
    Explanation,
    Misfit,
    Plan,
    Scatter,
    early_stop,
    explanation,
    misfit,
    misfits,
    pairs,
    scatter,
    separation,
)
from disctrack.examples.exponent_system import BRAKING, STATED_T_F, ExponentSystem, at, published_series

SETTINGS = Settings(noise=1.0, shortlist=12, max_effects=2)  # the trials' own scatter is the noise
ALWAYS = ("t_f", "t_f_each", "air_bildsten", "air_moffatt", "contour_viscous")  # asked for, found or not
COMPARED = ("t_f_each", "air_bildsten", "air_moffatt", "contour_viscous")


@dataclass(frozen=True)
class Fixed:
    """An explanation without any free coefficient: the size is known from elsewhere."""

    name: str
    values: dict[str, float]
    gain: float  # decrease of chi-square against the base model
    misfits: tuple[Misfit, ...]


@dataclass(frozen=True)
class Answer:
    """All findings."""

    thin: tuple[Misfit, ...]  # against 2/3, -1/3, 2/3
    before: tuple[Misfit, ...]  # against the simulated paper's model
    base: Fit
    diagnosis: Diagnosis
    explanations: tuple[Explanation, ...]
    fixed: tuple[Fixed, ...]
    scatter: tuple[Scatter, ...]
    stop: tuple[float, ...]  # [s] before collapse at which the disc reaches its paper, per surface
    separations: dict[str, dict[tuple[str, str], float]]  # [sigma] by plan and pair


def examine(system: ExponentSystem, plans: Sequence[Plan] = PLANS) -> Answer:
    """Diagnosis of the trials, and everything that is said beside it; the system's candidates contain ALWAYS."""
    thin = tuple(misfit(s.setup.surface, s.exponents, THIN_DISC) for s in system.series)
    diagnosis = diagnose(system, system.start, SETTINGS)
    base = diagnosis.before
    found = [f.candidate.name for f in diagnosis.found]
    rivals = [r.candidate.name for f in diagnosis.found for r in f.cannot_be_told_from]
    names = dict.fromkeys([*found, *rivals, *ALWAYS])
    explanations = {name: explanation(system, base, name) for name in names}
    own = [{"km.k_m": s.setup.k_m} for s in system.series]
    stop = tuple(early_stop(s.setup, v) for s, v in zip(system.series, own, strict=True))
    separations = {
        plan.name: {
            pair: separation(system, explanations[pair[0]], explanations[pair[1]], plan) for pair in pairs(COMPARED)
        }
        for plan in plans
    }
    return Answer(
        thin,
        misfits(system, base.values),
        base,
        diagnosis,
        tuple(explanations.values()),
        fixed_explanations(system, base, stop),
        tuple(scatter(s, v) for s, v in zip(system.series, own, strict=True)),
        stop,
        separations,
    )


def fixed_explanations(system: ExponentSystem, base: Fit, stop: Sequence[float]) -> tuple[Fixed, ...]:
    """Sizes that theory or the paper's own words give, with nothing to fit but k_m and the spin."""
    rest = {at("t_f.bias", s): BRAKING - touch for s, touch in zip(system.surfaces, stop, strict=True)}
    touch = {at("t_f.bias", s): -touch for s, touch in zip(system.surfaces, stop, strict=True)}
    questions = {
        "t_f called where the disc reaches its paper (0.5 deg)": touch,
        f"t_f called where it has come to rest on it, {1e3 * BRAKING:.0f} ms later": rest,
        "Bildsten's boundary layer at its nominal size (beta = 1)": {"air_bildsten.beta": 1.0},
        "Moffatt's layer at its nominal size (f = 1)": {"air_moffatt.f": 1.0},
    }
    answers = []
    for name, values in questions.items():
        found = fit(system, system.base, base.values | values)
        answers.append(Fixed(name, values, base.cost - found.cost, misfits(system, found.values)))
    return tuple(answers)


def report(answer: Answer) -> str:
    """The findings for people."""
    d = answer.diagnosis
    lines = ["Published exponents of Ma et al. (2014), tables 2 and 3: mean and its standard error", ""]
    lines += _misfit_table("against 2/3, -1/3, 2/3 (thin disc, slow precession)", answer.thin)
    lines += _misfit_table("against the simulated rolling model with k_m alone", answer.before)
    lines += ["Scatter between trials:"]
    for s in answer.scatter:
        lines.append(
            f"  {s.surface}: {100 * s.share:.0f} % of it lies where an error of t_f moves the exponents, which takes "
            f"{1e3 * s.t_f_sigma:.1f} ms rms (stated: {1e3 * STATED_T_F:.1f} ms); "
            f"the phase of a 30 % nutation gives {s.nutation[0]:.3f}, {s.nutation[1]:.3f}, {s.nutation[2]:.3f}"
        )
    lines += ["", f"Search over {len(d.tried)} effects: {d.verdict}; {d.reason}"]
    for f in d.found:
        others = ", ".join(r.candidate.name for r in f.cannot_be_told_from)
        lines.append(f"  {f.candidate.name} (chi-square falls by {f.gain:.1f}, noise reaches {f.threshold:.1f})")
        lines.append(f"  these tables cannot tell it from: {others or 'nothing else'}")
    lines += [
        "",
        "Explanations, refitted with k_m and spin; joint deviation left; gain in 2 ln(probability) of data left out:",
    ]
    splits = list(answer.explanations[0].held_out_gain)
    surfaces = [m.surface for m in answer.before]
    head = f"  {'effect':17}{'chi2 gain':>10}" + "".join(f"{s:>9}" for s in surfaces)
    lines.append(head + "".join(f"{s:>15}" for s in splits) + "  size")
    for e in answer.explanations:
        sizes = ", ".join(
            f"{q.name.partition('.')[2]} = {quantity_text(e.fit.values[q.name], e.fit.sigma(q.name), q.unit)}"
            for q in e.candidate.quantities
        )
        left = "".join(f"{m.joint_sigmas:7.1f} s" for m in e.misfits)
        gains = "".join(f"{g:15.1f}" for g in e.held_out_gain.values())
        lines.append(f"  {e.candidate.name:17}{e.gain:10.1f}{left}{gains}  {sizes}")
    lines += ["", "Sizes known beforehand, nothing fitted but k_m and spin:"]
    for x in answer.fixed:
        left = ", ".join(f"{m.surface} {m.joint_sigmas:.1f} s" for m in x.misfits)
        sizes = ", ".join(f"{name} = {value:.3g}" for name, value in x.values.items())
        lines.append(f"  {x.name}: chi-square falls by {x.gain:.1f}; left {left}  ({sizes})")
    lines += [
        "",
        "What would decide: standard deviations between explanations, published and as many new trials together",
    ]
    all_pairs = list(next(iter(answer.separations.values())))
    for i, (a, b) in enumerate(all_pairs):
        lines.append(f"  ({i + 1}) {a} or {b}")
    lines.append(f"  {'':33}" + "".join(f"{f'({i + 1})':>7}" for i in range(len(all_pairs))))
    for plan, by_pair in answer.separations.items():
        lines.append(f"  {plan:33}" + "".join(f"{by_pair[p]:7.1f}" for p in all_pairs))
    return "\n".join(lines) + "\n"


def _misfit_table(title: str, found: Sequence[Misfit]) -> list[str]:
    lines = [f"{title}:"]
    for m in found:
        parts = [
            f"{name} {mean:.4f} +- {sigma:.4f} - {predicted:.4f}: t = {t:.1f} ({s:.1f} s)"
            for name, mean, sigma, predicted, t, s in zip(
                ("n_theta", "n_psidot", "n_E"), m.mean, m.sigma, m.predicted, m.t, m.sigmas, strict=True
            )
        ]
        lines.append(f"  {m.surface}: " + "; ".join(parts) + f"; together {m.joint_sigmas:.1f} s (p = {m.p_value:.2g})")
    return [*lines, ""]


def document(answer: Answer) -> dict[str, Any]:
    """The findings for programs, in the words of `diagnosis.json`."""
    d = answer.diagnosis
    return {
        "source": "Ma, Liu, Zhao & Zhang 2014, tables 2 and 3",
        "verdict": d.verdict,
        "reason": d.reason,
        "effects": [
            {
                "name": f.candidate.name,
                "class": [r.candidate.name for r in f.cannot_be_told_from],
                "gain": f.gain,
                "threshold": f.threshold,
                "held_out_gain": f.held_out_gain,
            }
            for f in d.found
        ],
        "thin_disc": [_misfit_record(m) for m in answer.thin],
        "before": {"chi_square": answer.base.chi_square, "misfits": [_misfit_record(m) for m in answer.before]},
        "explanations": [
            {
                "name": e.candidate.name,
                "gain": e.gain,
                "parameters": [
                    {"name": q.name, "value": e.fit.values[q.name], "sigma": e.fit.sigma(q.name), "unit": q.unit}
                    for q in e.fit.quantities
                ],
                "held_out_gain": e.held_out_gain,
                "after": [_misfit_record(m) for m in e.misfits],
            }
            for e in answer.explanations
        ],
        "fixed": [
            {"name": x.name, "values": x.values, "gain": x.gain, "after": [_misfit_record(m) for m in x.misfits]}
            for x in answer.fixed
        ],
        "scatter": [{"surface": s.surface, "share_t_f": s.share, "t_f_sigma_s": s.t_f_sigma} for s in answer.scatter],
        "reaches_paper_before_collapse_s": list(answer.stop),
        "separations_sigma": {
            plan: [{"pair": list(pair), "sigma": value} for pair, value in by_pair.items()]
            for plan, by_pair in answer.separations.items()
        },
        "tried": [
            {"name": t.candidate.name, "kind": t.candidate.kind, "score": t.score, "gain": t.gain, "why": t.reason}
            for t in d.tried
        ],
    }


def _misfit_record(m: Misfit) -> dict[str, Any]:
    names = ("n_theta", "n_psidot", "n_energy")
    return {
        "surface": m.surface,
        "mean": dict(zip(names, m.mean.tolist(), strict=True)),
        "sigma": dict(zip(names, m.sigma.tolist(), strict=True)),
        "predicted": dict(zip(names, m.predicted.tolist(), strict=True)),
        "t": dict(zip(names, m.t.tolist(), strict=True)),
        "p_value": m.p_value,
        "joint_sigmas": m.joint_sigmas,
    }


def main(arguments: Sequence[str] | None = None) -> int:
    """Run the example; returns the exit code."""
    parser = argparse.ArgumentParser(prog="python -m disctrack.examples.published_exponents", description=__doc__)
    parser.add_argument("-o", "--output", type=Path, default=Path(), metavar="DIR", help="where to write (here)")
    options = parser.parse_args(arguments)
    system = ExponentSystem(published_series())
    answer = examine(system)
    options.output.mkdir(parents=True, exist_ok=True)
    text = json.dumps(document(answer), indent=1, default=float)
    (options.output / "published_exponents.json").write_text(text + "\n", encoding="utf-8")
    from disctrack.examples.exponent_figure import draw

    draw(system, answer.explanations, answer.base.values, options.output / "published_exponents.png")
    print(report(answer), end="")
    return 0


if __name__ == "__main__":
    raise SystemExit(main())
