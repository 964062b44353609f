"""Power of the diagnosis: how often it finds hidden effects, their smallest size, and the rate of false positives.

The diagnosis gets the measured trajectory with hidden effects (`hidden`), without any information about them.
"""

from collections.abc import Sequence
from time import perf_counter

import numpy as np
from scipy import stats

from disctrack.diagnosis import DiscDiagnosis, diagnose
from disctrack.discrepancy.fit import Fit, fit
from disctrack.discrepancy.search import Settings, threshold
from disctrack.discrepancy.significance import wald
from disctrack.validate.hidden import HiddenCase, Values, recorded
from disctrack.validate.tables import Validation, table

ENOUGH = 3.0  # [sigma] largest error of a coefficient that counts as correct
HELD_OUT = 1.2  # largest prediction error over the noise floor
LEVELS = (0.5, 0.2, 0.05, 0.01, 0.005)


class Verdict:
    """Outcome of one case."""

    def __init__(self, case: HiddenCase) -> None:
        """Plant the effects, diagnose, and compare the truth of each effect with the claims."""
        truths, planted, trajectory = recorded(case)
        began = perf_counter()
        result = diagnose(trajectory)
        self.seconds = perf_counter() - began
        d, nan = result.diagnosis, float("nan")
        pulls = [_pull_of(result, truth) for truth in truths]
        left = [(e.reduced_chi_square, e.ratio_to_floor) for e in (result.before, result.after) if e] or [(nan, nan)]
        # before and after: reduced chi-square, and prediction error over the noise floor
        self.chi_square, self.free_run = zip(left[0], left[-1], strict=True)
        self.case, self.n, self.verdict = case, len(trajectory), d.verdict
        # every effect claimed, followed by its indistinguishable alternatives in brackets
        self.found = tuple(
            _with_class(f.candidate.name, [r.candidate.name for r in f.cannot_be_told_from]) for f in d.found
        )
        self.named = None not in pulls  # every hidden effect is claimed, or an alternative of a claim
        # largest error of a coefficient in its sigmas; NaN if none is named
        self.pull = max((p for p in pulls if p is not None), default=nan)
        self.extra = max(len(d.found) - len(truths), 0)  # number of claims in excess of hidden effects
        self.gain = (d.before.cost - d.after.cost) / d.noise  # decrease of chi-square by all effects claimed
        # probability that noise alone produces the improvement of the best effect; NaN: not known
        self.p_value = d.chance.p_value if d.chance else nan
        # expected significance of the weakest hidden effect in sigmas, with all others fitted (NaN: not known), and
        # that required for a claim
        self.stands_out, self.needed = _expected_significance(result, truths, planted)

    @property
    def can_be_told(self) -> bool:
        """Does the recording determine every hidden effect together with the others?

        A less significant effect than a claim requires has an upper bound only.
        """
        return not self.stands_out < self.needed

    @property
    def at_noise(self) -> bool:
        """Are the residuals of the fit and of the free run noise?"""
        return self.chi_square[1] <= Settings.at_noise and self.free_run[1] <= HELD_OUT

    @property
    def within(self) -> bool:
        """Are the coefficients right within three sigma?"""
        return self.named and abs(self.pull) <= ENOUGH

    @property
    def found_from(self) -> float:
        """Size of a single effect with just the required expected significance: it is found in half of the cases."""
        size, *others = self.case.hidden.values()
        return size * self.needed / self.stands_out if self.case.has_effects and not others else float("nan")


def _with_class(name: str, others: Sequence[str]) -> str:
    return f"{name} ({', '.join(others)})" if others else name


def _expected_significance(result: DiscDiagnosis, truths: Sequence[Values], planted: Values) -> tuple[float, float]:
    """Significance of the weakest planted effect in the joint model, and that required for a claim, in sigmas.

    From the Fisher information at the truth: the decrease of chi-square is a' C^-1 a for amounts a with covariance C,
    with all other quantities fitted. NaN if the joint fit does not converge, or the catalogue lacks an effect.
    """
    system, d = result.system, result.diagnosis
    meant = [next((c for c in system.candidates if set(truth) <= set(c.names)), None) for truth in truths]
    own = [c for c in meant if c is not None]
    if not truths or not d.before.converged or len(own) < len(truths):
        return np.nan, np.nan
    quantities = {q.name: q for q in system.base} | {q.name: q for c in own for q in c.quantities}
    joint = fit(system, tuple(quantities.values()), d.before.values | planted)
    if not joint.converged:
        return np.nan, np.nan
    found = []
    for truth, candidate in zip(truths, own, strict=True):
        index = [joint.names.index(n) for n in candidate.names]
        amount = np.array([truth.get(q.name, q.null) - q.null for q in candidate.quantities])
        sigmas = np.sqrt(wald(amount, joint.covariance[np.ix_(index, index)]) / d.noise)
        needed = np.sqrt(threshold(system, d.settings, len(index)))
        found.append((float(sigmas), float(needed)))
    return min(found, key=lambda one: one[0] / one[1])


def _pull_of(result: DiscDiagnosis, truth: Values) -> float | None:
    """Largest pull of the true values if the effect, or one indistinguishable from it, is claimed; otherwise None."""
    d = result.diagnosis
    claims = [_pull(d.after, truth) for f in d.found if set(truth) <= set(f.candidate.names)]
    others = [a for f in d.found for a in f.cannot_be_told_from if set(truth) <= set(a.candidate.names)]
    # if it is an alternative of several claims, the one with the smallest pull is correct
    return min(claims or [_pull(other.fit, truth) for other in others], default=None)


def _pull(fit: Fit, truth: Values) -> float:
    return max(abs(fit.values[k] - v) / max(fit.sigma(k), 1e-300) for k, v in truth.items())


def what_was_wrong(v: Verdict) -> str:
    """One line about a case with a wrong result; empty if the result is right."""
    right = v.within and v.at_noise if v.case.has_effects else v.verdict == "nothing missing"
    if right and not v.extra:
        return ""
    return (
        f"{' + '.join(v.case.hidden)}, seed {v.case.seed}: {v.verdict}; {'; '.join(v.found) or '-'}; "
        f"pull {v.pull:.1f}, chi2 {v.chi_square[0]:.3f} -> {v.chi_square[1]:.3f}, free run {v.free_run[0]:.2f} -> "
        f"{v.free_run[1]:.2f}, stands out by {v.stands_out:.1f} sigma of {v.needed:.1f}"
    )


def diagnosis_validation(verdicts: Sequence[Verdict]) -> Validation:
    """Rates of named hidden effects with correct sizes, and of claims in recordings without hidden effects."""
    hidden = [v for v in verdicts if v.case.has_effects]
    controls = [v for v in verdicts if not v.case.has_effects]
    known = [v for v in hidden if v.can_be_told]
    claimed = [v for v in controls if v.verdict != "nothing missing"]
    headline = []
    if hidden:
        headline.append(
            f"Named {sum(v.named for v in hidden)} of {len(hidden)}; {sum(v.named for v in known)} of {len(known)} "
            f"that their recordings determine; something claimed besides in {sum(v.extra > 0 for v in hidden)}."
        )
    if controls:
        headline.append(
            f"Something claimed in {len(claimed)} of {len(controls)} recordings in which nothing is hidden."
        )
    tables = [_rates_table(verdicts)]
    if controls:
        tables.append(_levels_table([v.p_value for v in controls]))
    wrong = tuple(filter(None, map(what_was_wrong, verdicts)))
    return Validation("diagnosis", " ".join(headline), tuple(tables), verdicts, remarks=wrong)


def _rates_table(verdicts: Sequence[Verdict]) -> str:
    groups: dict[tuple[tuple[str, float], ...], list[Verdict]] = {}
    for v in verdicts:
        groups.setdefault(tuple(v.case.hidden.items()), []).append(v)
    rows = []
    for hidden, group in groups.items():
        counts = ([v.can_be_told, v.named, v.within, v.at_noise, v.extra > 0] for v in group)
        shares = [f"{sum(column)}/{len(group)}" for column in zip(*counts, strict=True)]
        medians = np.median([(v.stands_out, v.found_from, v.seconds) for v in group], axis=0)
        names, sizes = zip(*hidden, strict=True)
        rows.append([" + ".join(names), " + ".join(f"{s:.3g}" for s in sizes), *shares, *medians])
    head = ["hidden", "size", "distinguishable", "named", "within 3 sigma", "noise left", "claim too many",
            "stands out by, sigma", "found from", "time, s"]  # fmt: skip
    return table("What was hidden, and what became of it", head, rows, "Sizes in SI units; the last three are medians.")


def _levels_table(p_values: Sequence[float]) -> str:
    """Calibration of the p-values without hidden effects, with exact intervals (Clopper and Pearson 1934)."""
    p = np.asarray(p_values)[np.isfinite(p_values)]
    rows = []
    for level in LEVELS if len(p) else ():
        seen = stats.binomtest(int(np.sum(p < level)), len(p))
        interval = seen.proportion_ci(0.95, "exact")
        rows.append([f"{level:g}", f"{seen.k} of {len(p)}", f"{interval.low:.4f} to {interval.high:.4f}"])
    head = ["stated probability below", "recordings in which nothing is hidden", "95 % interval of the rate"]
    return table("Stated probabilities of chance", head, rows)
