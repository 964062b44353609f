"""Power of the diagnosis: how often it finds hidden effects, their smallest size, and the rate of false positives.

The diagnosis gets a measured trajectory with hidden effects, without any information about them.

Every case has a random motion, a rig with its own calibration error, and noise of the dots (`points`). An effect has
the name, quantities and units of the diagnosis' candidate. Its size is one that a careful experimenter would overlook.
Directions and signs are random, except for the signs of passive effects.
"""

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from functools import cache
from time import perf_counter

import numpy as np
from numpy.random import Generator
from scipy import stats

from disctrack.diagnosis import DiscDiagnosis, diagnose
from disctrack.diagnosis.motion import candidate_of_fault, motion_candidates
from disctrack.diagnosis.systematic import DOT_SIGMA
from disctrack.discrepancy.fit import Fit, fit
from disctrack.discrepancy.search import Settings, threshold
from disctrack.discrepancy.significance import wald
from disctrack.discrepancy.system import Candidate
from disctrack.errors import DiscTrackError
from disctrack.faults.catalogue import FAULTS, each_of
from disctrack.rolling import Model
from disctrack.synthetic.description import Scene
from disctrack.trajectory import Trajectory
from disctrack.validate.points import LABORATORY, RATE, drawn, measured
from disctrack.validate.tables import Validation, grouped, table

# [SI] sizes that a careful experimenter would overlook, if they differ from `Quantity.typical` more than twofold
OVERLOOKED = {
    "table_tilt": np.radians(0.35),
    "kz": 6e-5,
    "creep": 2e-6,
    "table_shaken": 2e-6,
    "frame_rate": 0.012,
    "rolling_classical": 2e-4,
    "drag_rotation": 2.5e-6,
    "air_bildsten": 0.3,
    "km_e2": 0.381e-8,
    "rolling_power": 1e-5,
    "contour_dry": 1e-4,
    "gravity": 0.05,
    "time_offset": 1e-4,
    "focal": 1e-3,
    "pattern_rotation": 1e-3,
    "pattern_scale": 1e-3,
    "ellipse_centre": 1.0,
}
CONTROLS = {"nothing": 1.0, "prints": DOT_SIGMA, "laboratory": 1.0}  # cases in which nothing should be claimed
NOT_HIDDEN = ("km", "slip", "surface_moves", "table_settles", "clock_drift")  # km is in every model
INVISIBLE = ("pattern_rotation",)  # not determined by recordings of one disc: nothing should be claimed
FIRST_ALONE = ("spring", "table_curved")  # only the first quantity of the candidate is planted
ENOUGH = 3.0  # [sigma] largest error of a coefficient that counts as correct
HELD_OUT = 1.2  # largest prediction error over the noise floor
# Attributes of verdicts by the heads of columns: rates, and medians
RATES = {"distinguishable": "can_be_told", "named": "named", "within 3 sigma": "within", "noise left": "at_noise"}
RATES |= {"claim too many": "extra"}
MEDIANS = {"stands out by, sigma": "stands_out", "found from": "found_from", "time, s": "seconds"}
LEVELS = (0.5, 0.2, 0.05, 0.01, 0.005)
Values = dict[str, float]  # by name of a quantity


@dataclass(frozen=True)
class HiddenCase:
    """Hidden effects with sizes in the recording of a seed; in controls nothing should be claimed."""

    hidden: Mapping[str, float]
    seed: int
    rate: float = RATE


@cache
def candidates() -> Mapping[str, Sequence[Candidate]]:
    """Candidates of the diagnosis that can be hidden, by name; one per camera or dot if they have their own."""
    disc = Scene().declared_disc
    of_motion = {candidate.name: [candidate] for candidate in motion_candidates(Model(disc))}
    of_faults = {fault.name: [*map(candidate_of_fault, each_of(fault, disc.n_markers))] for fault in FAULTS}
    return {name: alike for name, alike in (of_motion | of_faults).items() if name not in NOT_HIDDEN}


def sizes() -> dict[str, float]:
    """Size of every effect that can be hidden."""
    return {name: alike[0].quantities[0].typical for name, alike in candidates().items()} | OVERLOOKED


def plant(name: str, size: float, rng: Generator) -> tuple[Values, Values]:
    """An effect of this size [SI] with random sign or direction, if applicable of a random camera or dot.

    returns : true values of the diagnosis' quantities, and all planted values: "effect.parameter" of the motion,
        "fault.part" of the measurement
    """
    alike = candidates()[name]
    candidate = alike[int(rng.integers(len(alike)))]
    quantities = candidate.quantities[:1] if name in FIRST_ALONE else candidate.quantities
    direction = rng.standard_normal(len(quantities))
    direction = np.abs(direction) if quantities[0].lower == 0 else direction  # of a passive effect
    numbers = size * direction / np.linalg.norm(direction)
    truth = {q.name: float(number) for q, number in zip(quantities, numbers, strict=True)}
    shape = {"rim_flat.angle": rng.uniform(0, 2 * np.pi)} if name == "rim_flat" else {}
    return truth, truth | shape


def recorded(case: HiddenCase) -> tuple[list[Values], Values, Trajectory]:
    """True values of the quantities of each planted effect, all planted values, and the recording."""
    rng = np.random.default_rng([case.seed, 32])
    parts = [plant(name, size, rng) for name, size in case.hidden.items() if name not in CONTROLS]
    planted = {name: value for _, values in parts for name, value in values.items()}
    scene = drawn(case.seed, planted, case.rate).changed(**LABORATORY if "laboratory" in case.hidden else {})
    scene = scene.changed(faults={"misprint_sigma_mm": 1e3 * case.hidden["prints"]} if "prints" in case.hidden else {})
    return [truth for truth, _ in parts], planted, measured(scene)


def hidden_cases(names: Sequence[str], seeds: Sequence[int], pairs: int = 0, rate: float = RATE) -> list[HiddenCase]:
    """Each effect ("NAME" or "NAME=SIZE"; by default all) with each seed; or random pairs, each with its own seed."""
    hidden = [_sized(name) for name in names] or [*sizes().items()]
    if not pairs:
        return [HiddenCase({name: size}, seed, rate) for name, size in hidden for seed in seeds]
    visible = [(name, size) for name, size in hidden if name not in INVISIBLE]
    rng = np.random.default_rng([seeds[0], 33])
    drawn_pairs = [rng.choice(len(visible), 2, replace=False) for _ in range(pairs)]
    return [HiddenCase(dict(visible[k] for k in two), seeds[0] + i, rate) for i, two in enumerate(drawn_pairs)]


def _sized(text: str) -> tuple[str, float]:
    """Name and size of an effect "NAME" or "NAME=SIZE"."""
    name, _, size = text.partition("=")
    known = sizes() | CONTROLS
    if name not in known:
        raise DiscTrackError(f"there is no effect '{name}' to hide; there are {', '.join(known)}")
    try:
        return name, float(size or known[name])
    except ValueError:
        unit = "m" if name in CONTROLS else candidates()[name][0].quantities[0].unit
        raise DiscTrackError(f"{text}: expected EFFECT=SIZE with the size in {unit}") from None


class Verdict:
    """Outcome of one case."""

    def __init__(self, case: HiddenCase) -> None:
        """Plant the effects, diagnose, and compare the truth of each effect with the claims."""
        truths, planted, trajectory = recorded(case)
        began = perf_counter()
        result = diagnose(trajectory)
        self.seconds = perf_counter() - began
        d, nan = result.diagnosis, float("nan")
        # every effect claimed, with its indistinguishable alternatives
        claims = [[(f.candidate, d.after), *((a.candidate, a.fit) for a in f.cannot_be_told_from)] for f in d.found]
        self.found = [" or ".join(candidate.name for candidate, _ in claim) for claim in claims]
        pulls = [_pull(claims, truth) for truth in truths]
        left = [(e.reduced_chi_square, e.ratio_to_floor) for e in (result.before, result.after) if e] or [(nan, nan)]
        # before and after: reduced chi-square, and prediction error over the noise floor
        self.chi_square, self.free_run = zip(left[0], left[-1], strict=True)
        self.case, self.verdict, self.is_control = case, d.verdict, not truths
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
        # a less significant effect than a claim requires has an upper bound only
        self.can_be_told = not self.stands_out < self.needed
        self.at_noise = self.chi_square[1] <= Settings.at_noise and self.free_run[1] <= HELD_OUT
        self.within = self.named and abs(self.pull) <= ENOUGH  # are the coefficients right?
        # size of a single effect with just the required significance: it is found in half of the cases
        size, *others = case.hidden.values()
        self.found_from = nan if others else size * self.needed / self.stands_out


def _expected_significance(result: DiscDiagnosis, truths: Sequence[Values], planted: Values) -> tuple[float, float]:
    """Significance of the weakest planted effect in the joint model, and that required for a claim, in sigmas.

    From the Fisher information at the truth: the decrease of chi-square is a' C^-1 a for amounts a with covariance C,
    with all other quantities fitted; C contains the tolerances of amounts that the base model allows for. NaN without a
    prediction, or if the catalogue lacks an effect.
    """
    system, d = result.system, result.diagnosis
    own = [candidate for truth in truths for candidate in system.candidates if set(truth) <= set(candidate.names)]
    if not truths or not d.before.converged or len(own) < len(truths):
        return np.nan, np.nan
    quantities = {q.name: q for q in (*system.base, *(q for candidate in own for q in candidate.quantities))}
    joint = fit(system, tuple(quantities.values()), d.before.values | planted)
    if not np.isfinite(joint.cost):
        return np.nan, np.nan
    found, tolerance = [], {q.name: q.prior_sigma for q in system.base if np.isfinite(q.prior_sigma)}
    for truth, candidate in zip(truths, own, strict=True):
        allowed = np.diag([tolerance.get(name, 0.0) ** 2 for name in candidate.names])
        amount = np.array([truth.get(q.name, q.null) - q.null for q in candidate.quantities])
        sigmas = np.sqrt(wald(amount, d.noise * joint.amounts(candidate.names)[1] + allowed))
        found.append((float(sigmas), float(np.sqrt(threshold(system, d.settings, len(amount))))))
    return min(found, key=lambda one: one[0] / one[1])


def _pull(claims: Iterable[Iterable[tuple[Candidate, Fit]]], truth: Values) -> float | None:
    """Largest pull of the true values if the effect, or one indistinguishable from it, is claimed; otherwise None."""
    fits = [fit for claim in claims for candidate, fit in claim if set(truth) <= set(candidate.names)]
    pulls = [max(abs(f.values[k] - v) / max(f.sigma(k), 1e-300) for k, v in truth.items()) for f in fits]
    return min(pulls, default=None)  # if it is an alternative of several claims, the one with the smallest is correct


def what_was_wrong(v: Verdict) -> str:
    """One line about a case with a wrong result; empty if the result is right."""
    right = v.verdict == "nothing missing" if v.is_control else v.within and v.at_noise
    if right and not v.extra:
        return ""
    return (
        f"{' + '.join(v.case.hidden)}, seed {v.case.seed}: {v.verdict}; {'; '.join(v.found) or '-'}; "
        f"pull {v.pull:.1f}, chi2 {v.chi_square[0]:.3f} -> {v.chi_square[1]:.3f}, free run {v.free_run[0]:.2f} -> "
        f"{v.free_run[1]:.2f}, stands out by {v.stands_out:.1f} sigma of {v.needed:.1f}"
    )


def diagnosis_validation(verdicts: Sequence[Verdict]) -> Validation:
    """Rates of named hidden effects with correct sizes, and of claims in recordings without hidden effects."""
    hidden, controls = ([v for v in verdicts if v.is_control == kind] for kind in (False, True))
    headline, tables = [], []
    if hidden:
        known = [v.named for v in hidden if v.can_be_told]
        headline.append(
            f"Named {sum(v.named for v in hidden)} of {len(hidden)}; {sum(known)} of {len(known)} that their "
            f"recordings determine; something claimed besides in {sum(v.extra > 0 for v in hidden)}."
        )
        tables.append(_rates(hidden))
    if controls:
        claimed = sum(v.verdict != "nothing missing" for v in controls)
        headline.append(f"Something claimed in {claimed} of {len(controls)} recordings in which nothing is hidden.")
    if p_values := [v.p_value for v in controls if np.isfinite(v.p_value)]:
        tables.append(_levels(p_values))
    wrong = [*filter(None, map(what_was_wrong, verdicts))]
    return Validation("diagnosis", " ".join(headline), tables, verdicts, remarks=wrong)


def _rates(verdicts: Sequence[Verdict]) -> str:
    rows = {}
    for hidden, group in grouped(verdicts, lambda v: tuple(v.case.hidden.items())).items():
        rates = {head: f"{sum(getattr(v, of) > 0 for v in group)}/{len(group)}" for head, of in RATES.items()}
        medians = {head: float(np.median([getattr(v, of) for v in group])) for head, of in MEDIANS.items()}
        rows[" + ".join(f"{name} = {size:.3g}" for name, size in hidden)] = rates | medians
    note = "Sizes in SI units; the last three are medians."
    return table("What was hidden, and what became of it", "hidden", rows, note)


def _levels(p: Sequence[float]) -> str:
    """Calibration of the p-values without hidden effects, with exact intervals (Clopper and Pearson 1934)."""
    rows = {}
    for level in LEVELS:
        seen = stats.binomtest(sum(x < level for x in p), len(p))
        interval = seen.proportion_ci(0.95, "exact")
        rows[f"{level:g}"] = {
            "recordings in which nothing is hidden": f"{seen.k} of {len(p)}",
            "95 % interval of the rate": f"{interval.low:.4f} to {interval.high:.4f}",
        }
    return table("Stated probabilities of chance", "stated probability below", rows)
