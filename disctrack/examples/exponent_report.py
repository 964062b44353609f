"""The diagnosis of the published exponents in words, and for programs."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

from disctrack.diagnosis import Diagnosis
from disctrack.diagnosis.engine.fit import Fit
from disctrack.diagnosis.pages.general import document as diagnosis_document
from disctrack.diagnosis.pages.general import fit_errors
from disctrack.diagnosis.pages.words import quantity_text
from disctrack.examples.exponent_analysis import Explanation, Fixed, Misfit, Scatter
from disctrack.examples.exponent_system import STATED_T_F

NAMES = ("n_theta", "n_psidot", "n_energy")


@dataclass(frozen=True)
class Answer:
    """All findings."""

    thin: tuple[Misfit, ...]  # against 2/3, -1/3, 2/3
    before: tuple[Misfit, ...]  # against the simulated paper's model
    diagnosis: Diagnosis
    explanations: dict[str, Explanation]
    shares: dict[str, tuple[float, ...]]  # of the power lost at 2 deg, per surface; 0 for errors of reading
    fixed: tuple[Fixed, ...]
    scatter: tuple[Scatter, ...]
    stop: tuple[float, ...]  # [s] before collapse at which the disc reaches its paper, per surface
    separations: dict[str, dict[tuple[str, str], float]]  # [sigma] by plan and pair

    @property
    def base(self) -> Fit:
        """The paper's model, k_m and spin fitted."""
        return self.diagnosis.before

    @property
    def undecided(self) -> tuple[str, ...]:
        """What was found, and what these tables cannot tell from it."""
        found = self.diagnosis.found
        return tuple(
            dict.fromkeys(
                [*(f.candidate.name for f in found), *(r.candidate.name for f in found for r in f.cannot_be_told_from)]
            )
        )


def sentence(answer: Answer) -> str:
    """The answer in plain words."""
    if not answer.undecided:
        return f"Nothing is claimed: {answer.diagnosis.reason}."
    gains = [answer.explanations[n].gain for n in answer.undecided]
    worst = max(answer.thin, key=lambda m: m.joint_sigmas)
    after = max(m.joint_sigmas for n in answer.undecided for m in answer.explanations[n].misfits)
    what = "it" if len(gains) == 1 else "each of them alone"
    text = (
        f"The trials on {worst.surface} lie {worst.joint_sigmas:.1f} sigma from 2/3, -1/3, 2/3; {what} "
        f"({', '.join(answer.undecided)}) brings every surface within {after:.1f} sigma, and chi-square down by "
        f"{min(gains):.0f} to {max(gains):.0f}"
    )
    return text + (": not identifiable from these tables." if len(gains) > 1 else ".")


def report(answer: Answer) -> str:
    """The findings for people."""
    blocks = [
        ["Exponents of Ma et al. (2014), tables 2 and 3", sentence(answer)],
        _misfit_block("Mean of the trials against 2/3, -1/3, 2/3 (thin disc, slow precession)", answer.thin),
        _misfit_block("Mean of the trials against the simulated rolling disc with k_m alone", answer.before),
        _scatter_block(answer.scatter),
        _search_block(answer),
        _fixed_block(answer),
        _separation_block(answer),
    ]
    return "\n\n".join("\n".join(block) for block in blocks)


def _misfit_block(title: str, found: Sequence[Misfit]) -> list[str]:
    lines = [f"{title}:"]
    for m in found:
        rows = zip(NAMES, m.mean, m.sigma, m.predicted, m.t, m.sigmas, strict=True)
        for i, (name, mean, sigma, predicted, t, s) in enumerate(rows):
            joint = f"   together {m.joint_sigmas:.1f} sigma (p = {m.p_value:.2g})" if i == 2 else ""
            lines.append(
                f"  {m.surface:6}{name:9}{mean:8.4f} +- {sigma:.4f}   model {predicted:8.4f}   t = {t:5.1f}, "
                f"as probable as {s:4.1f} sigma{joint}"
            )
    return lines


def _scatter_block(found: Sequence[Scatter]) -> list[str]:
    lines = ["Scatter between the trials:"]
    for s in found:
        nutation = ", ".join(f"{x:.3f}" for x in s.nutation)
        lines.append(
            f"  {s.surface:6}{100 * s.share:.0f} % of it lies where an error of t_f moves the exponents; that takes "
            f"{1e3 * s.t_f_sigma:.1f} ms rms per trial (stated: {1e3 * STATED_T_F:.1f} ms). "
            f"The phase of a 30 % nutation makes {nutation}"
        )
    return lines


def _search_block(answer: Answer) -> list[str]:
    d = answer.diagnosis
    lines = [f"Search over {len(d.tried)} effects: {d.verdict}; {d.reason}"]
    lines += ["  (below 1, as the covariance of so few trials is widened to make the chi-square of their mean right)"]
    for f in d.found:
        others = ", ".join(r.candidate.name for r in f.cannot_be_told_from)
        lines.append(f"  {f.candidate.name}: chi-square falls by {f.gain:.1f}, by noise alone to {f.threshold:.1f}")
        lines.append(f"  not to be told from it by these tables: {others or 'nothing'}")
    explanations = answer.explanations.values()
    surfaces = [m.surface for m in answer.before]
    lines += [
        "",
        "Refitted: what is left (sigma of n_theta, n_psidot, n_E; together), share of the power lost at 2 deg, size:",
    ]
    for e in explanations:
        sizes = ", ".join(
            f"{q.name.partition('.')[2]} = {quantity_text(e.fit.values[q.name], e.fit.sigma(q.name), q.unit)}"
            for q in e.candidate.quantities
        )
        left = "".join(
            f"   {m.surface} {m.sigmas[0]:4.1f} {m.sigmas[1]:4.1f} {m.sigmas[2]:4.1f}; {m.joint_sigmas:.1f}"
            for m in e.misfits
        )
        share = answer.shares[e.candidate.name]
        power = "   " + ", ".join(f"{100 * x:.0f} %" for x in share) if any(share) else ""
        lines.append(f"  {e.candidate.name:16}{e.gain:6.1f}{left}{power}   {sizes}")
    splits = list(next(iter(explanations)).held_out_gain)
    lines += [
        "",
        "Fitted to the rest, gain in 2 ln(probability density) of what was held out (a size per surface foretells",
    ]
    lines += ["a surface that is held out only by leaving it open):"]
    lines.append(f"  {'':16}" + "".join(f"{'all on ' + s if s in surfaces else s:>15}" for s in splits))
    for e in explanations:
        lines.append(f"  {e.candidate.name:16}" + "".join(f"{g:15.1f}" for g in e.held_out_gain.values()))
    return lines


def _fixed_block(answer: Answer) -> list[str]:
    lines = ["Sizes known beforehand:"]
    for x in answer.fixed:
        left = ", ".join(f"{m.surface} {m.joint_sigmas:.1f}" for m in x.misfits)
        known = ", ".join(f"{n.partition('.')[2] if n.startswith('t_f') else n} = {v:.3g}" for n, v in x.values.items())
        units = {q.name: q.unit for q in x.fit.quantities}
        fitted = "".join(
            f"; fitted {n.partition('.')[2]} = {quantity_text(x.fit.values[n], x.fit.sigma(n), units[n])}"
            for n in x.fitted
        )
        fall = f"falls by {x.gain:.1f}" if x.gain >= 0 else f"rises by {-x.gain:.1f}"
        lines.append(f"  {x.name} ({known}{fitted}): chi-square {fall}; left {left} sigma")
    return lines


def _separation_block(answer: Answer) -> list[str]:
    if not answer.separations:
        return ["What would decide: not asked."]
    pairs = list(next(iter(answer.separations.values())))
    lines = ["What would decide: sigma between explanations, from the published trials and as many new ones:"]
    lines += [f"  ({i + 1}) {a} true, {b} fitted" for i, (a, b) in enumerate(pairs)]
    lines.append(f"  {'':46}" + "".join(f"{f'({i + 1})':>7}" for i in range(len(pairs))))
    for plan, by_pair in answer.separations.items():
        lines.append(f"  {plan:46}" + "".join(f"{by_pair[p]:7.1f}" for p in pairs))
    return lines


def document(answer: Answer) -> dict[str, Any]:
    """The findings for programs; keys as in the diagnosis.json of a recording, and what only these tables have."""
    d = answer.diagnosis
    model = "rolling disc with k_m, straight lines through the logarithms in the paper's windows"
    before = fit_errors(d.before, d.held_out_before) | {"exponents": [_misfit_json(m) for m in answer.before]}
    after = fit_errors(d.after, d.held_out_after)
    if answer.undecided:
        after["exponents"] = [_misfit_json(m) for m in answer.explanations[answer.undecided[0]].misfits]
    return diagnosis_document(d, model, sentence(answer), before, after) | {
        "source": "Ma, Liu, Zhao and Zhang 2014, Proc. R. Soc. A 470:20140191, tables 2 and 3",
        "cannot_be_told_apart": list(answer.undecided),
        "against_thin_disc": [_misfit_json(m) for m in answer.thin],
        "explanations": [
            {
                "name": e.candidate.name,
                "gain": e.gain,
                "parameters": _numbers(e.fit),
                "share_of_power_at_2_deg": list(answer.shares[e.candidate.name]),
                "held_out_gain": e.held_out_gain,
                "exponents": [_misfit_json(m) for m in e.misfits],
            }
            for e in answer.explanations.values()
        ],
        "known_sizes": [
            {
                "name": x.name,
                "values": x.values,
                "fitted": _numbers(x.fit),
                "gain": x.gain,
                "exponents": [_misfit_json(m) for m in x.misfits],
            }
            for x in answer.fixed
        ],
        "scatter": [{"surface": s.surface, "share_t_f": s.share, "t_f_sigma_s": s.t_f_sigma} for s in answer.scatter],
        "reaches_paper_before_collapse_s": list(answer.stop),
        "separations_sigma": {
            plan: [{"true": a, "fitted": b, "sigma": value} for (a, b), value in by_pair.items()]
            for plan, by_pair in answer.separations.items()
        },
    }


def _numbers(fit: Fit) -> dict[str, dict[str, Any]]:
    return {q.name: {"value": fit.values[q.name], "sigma": fit.sigma(q.name), "unit": q.unit} for q in fit.quantities}


def _misfit_json(m: Misfit) -> dict[str, Any]:
    columns = {"mean": m.mean, "sigma": m.sigma, "predicted": m.predicted, "t": m.t, "as_normal_sigmas": m.sigmas}
    numbers = {key: dict(zip(NAMES, map(float, values), strict=True)) for key, values in columns.items()}
    return {"surface": m.surface, **numbers, "p_value": m.p_value, "joint_sigmas": m.joint_sigmas}
