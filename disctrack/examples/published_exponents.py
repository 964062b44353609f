"""What is missing in the published exponents of Ma et al. (2014)? Tables 2 and 3 under the engine of diagnosis.

    python -m disctrack.examples.published_exponents [-o DIR]

The tables give the exponents of nutation, precession rate and energy in t_f - t for nine trials on steel and eight on
glass. On glass they contradict the paper's 2/3 and -1/3. The engine fits the paper's model to all of them, looks
through the catalogue of motions and through what the reading may do wrong, and says which effects would remove the
contradiction, and which of them these tables cannot tell apart.
"""

import sys
from collections.abc import Sequence
from dataclasses import dataclass
from functools import partial

import numpy as np
from scipy import stats

from calibration.kit.arrays import Array
from disctrack.analyse.published import PREDICTED
from disctrack.discrepancy.document import document, tables
from disctrack.discrepancy.fit import Fit
from disctrack.discrepancy.search import Diagnosis, Settings, explain
from disctrack.examples._command import Outcome, command
from disctrack.examples.exponent_system import ExponentSystem, published_series
from disctrack.numbers import measured
from disctrack.report.blocks import Report
from disctrack.report.terminal import full

SETTINGS = Settings(noise=1.0, shortlist=12, max_effects=2)  # the trials' own scatter is the noise
THIN_DISC = np.array([PREDICTED[1], PREDICTED[2], PREDICTED[0]])  # n_theta, n_psidot, n_energy
NAMES = ("n_theta", "n_psidot", "n_energy")


@dataclass(frozen=True)
class Misfit:
    """Mean exponents of one surface against a prediction without error."""

    surface: str
    mean: Array  # (3,)
    sigma: Array  # (3,) of the mean, from the scatter of the trials
    t: Array  # (3,) Student's
    sigmas: Array  # (3,) deviations as a normal variable of the same probability would have them
    p_value: float  # of all three together, Hotelling's T-squared
    joint_sigmas: float  # the same in normal standard deviations, two-sided


def misfit(surface: str, exponents: Array, predicted: Array) -> Misfit:
    """Student's t of each exponent and Hotelling's T-squared of all; exponents (n, 3), predicted (3,)."""
    n, k = exponents.shape
    mean, covariance = exponents.mean(axis=0), np.cov(exponents.T) / n
    difference, sigma = mean - predicted, np.sqrt(np.diag(covariance))
    t = difference / sigma
    t_squared = float(difference @ np.linalg.solve(covariance, difference))
    p = float(stats.f.sf(t_squared * (n - k) / (k * (n - 1)), k, n - k))
    sigmas = np.sign(t) * stats.norm.isf(stats.t.sf(np.abs(t), n - 1))
    return Misfit(surface, mean, sigma, t, sigmas, p, float(stats.norm.isf(p / 2)))


@dataclass(frozen=True)
class Explanation:
    """An effect fitted to all trials."""

    name: str
    fit: Fit
    sizes: tuple[str, ...]  # its fitted quantities
    gain: float  # decrease of chi-square against the base model
    misfits: tuple[Misfit, ...]


def examine(system: ExponentSystem) -> tuple[Diagnosis, tuple[Explanation, ...]]:
    """Diagnosis of the trials, with what each effect that may be the one leaves of every surface."""
    d = explain(system, system.start, SETTINGS, system.training)
    named = [(f.candidate, d.after) for f in d.found]
    named += [(r.candidate, r.fit) for f in d.found for r in f.cannot_be_told_from]
    return d, tuple(Explanation(c.name, f, c.names, d.before.cost - f.cost, left_by(system, f)) for c, f in named)


def against_thin_disc(system: ExponentSystem) -> tuple[Misfit, ...]:
    """Every surface against 2/3, -1/3, 2/3."""
    return tuple(misfit(s.setup.surface, s.exponents, THIN_DISC) for s in system.series)


def left_by(system: ExponentSystem, fit: Fit) -> tuple[Misfit, ...]:
    """Every surface against the prediction of a fit."""
    return tuple(
        misfit(s.setup.surface, s.exponents, system.outcomes(i, fit.values)[:3]) for i, s in enumerate(system.series)
    )


def sentence(d: Diagnosis, thin: Sequence[Misfit], undecided: Sequence[Explanation]) -> str:
    """The answer in plain words."""
    if not undecided:
        return f"Nothing is claimed: {d.reason}."
    gains = [e.gain for e in undecided]
    worst = max(thin, key=lambda m: m.joint_sigmas)
    after = max(m.joint_sigmas for e in undecided for m in e.misfits)
    what = "it" if len(gains) == 1 else "each of them alone"
    text = (
        f"The trials on {worst.surface} lie {worst.joint_sigmas:.1f} sigma from 2/3, -1/3, 2/3; {what} "
        f"({', '.join(e.name for e in undecided)}) brings every surface within {after:.1f} sigma, and "
        f"chi-square down by {min(gains):.0f} to {max(gains):.0f}"
    )
    return text + (": not identifiable from these tables." if len(gains) > 1 else ".")


def report(d: Diagnosis, thin: Sequence[Misfit], undecided: Sequence[Explanation]) -> str:
    """The findings for people."""
    lines = [sentence(d, thin, undecided), "", "Mean of the trials against 2/3, -1/3, 2/3 (thin disc):"]
    for m in thin:
        for name, mean, sigma, predicted, s in zip(NAMES, m.mean, m.sigma, THIN_DISC, m.sigmas, strict=True):
            lines.append(f"  {m.surface:6}{name:9}{mean:8.4f} +- {sigma:.4f}   {predicted:8.4f}{s:6.1f} sigma")
        lines.append(f"  {m.surface:6}together {m.joint_sigmas:.1f} sigma (p = {m.p_value:.2g})")
    lines += ["", "Refitted: chi-square falls by; sigma left of each surface; size"]
    for e in undecided:
        units = {q.name: q.unit for q in e.fit.quantities}
        sizes = ", ".join(f"{n} = {measured(e.fit.values[n], e.fit.sigma(n), units[n])}" for n in e.sizes)
        left = ", ".join(f"{m.surface} {m.joint_sigmas:.1f}" for m in e.misfits)
        lines.append("; ".join(x for x in (f"  {e.name}: {e.gain:.1f}", left, sizes) if x))
    return "\n".join([*lines, "", *full(Report("", "", blocks=tables(d)))])


def example() -> Outcome:
    """Diagnose the published exponents of Ma et al. (2014)."""
    system = ExponentSystem(published_series())
    (d, undecided), thin = examine(system), against_thin_disc(system)
    model = "rolling disc with k_m, straight lines through the logarithms in the paper's windows"
    found = document(d, model, sentence(d, thin, undecided)) | {
        "source": "Ma, Liu, Zhao and Zhang 2014, Proc. R. Soc. A 470:20140191, tables 2 and 3",
        "cannot_be_told_apart": [e.name for e in undecided],
        "against_thin_disc": [vars(m) for m in thin],
        "explanations": [
            {
                "name": e.name,
                "gain": e.gain,
                "parameters": {n: (e.fit.values[n], e.fit.sigma(n)) for n in e.sizes},
                "exponents": [vars(m) for m in e.misfits],
            }
            for e in undecided
        ],
    }
    return Outcome(report(d, thin, undecided), found)


main = partial(command, "published_exponents", None, example)


if __name__ == "__main__":
    sys.exit(main())
