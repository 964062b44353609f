"""A diagnosis in plain words."""

from itertools import takewhile

import numpy as np

from disctrack.diagnosis.disc.errors import Errors
from disctrack.diagnosis.disc.learned_law import LearnedLaw
from disctrack.diagnosis.disc.left_over import LEVEL, LeftOver
from disctrack.diagnosis.disc.motion import SLIP
from disctrack.diagnosis.disc.systematic import Systematic
from disctrack.discrepancy.correlated import Correlated, correlated
from disctrack.discrepancy.fit import Fit
from disctrack.discrepancy.search import Diagnosis, Found
from disctrack.discrepancy.significance import TWO_SIDED
from disctrack.discrepancy.system import Quantity

SHARED = 0.9  # correlation from which on another number, and not noise, keeps one open
UNFOLLOWED = "without it the model follows no part of the recording"  # so that there is no chi-square to compare
_PREFIXES = ((1e-9, "n"), (1e-6, "u"), (1e-3, "m"), (1.0, ""))
_PREFIXED_UNITS = ("m", "s", "rad", "N", "Hz")


def quantity_text(value: float, sigma: float, unit: str) -> str:
    """Value and sigma with as many digits as the sigma deserves: "60.0(2) um" is written 60.0 +- 0.2 um."""
    factor, prefix = 1.0, ""
    if unit in _PREFIXED_UNITS and value:
        for size, name in _PREFIXES:
            factor, prefix = size, name
            if abs(value) < 1000 * size:
                break
    value, sigma = value / factor, sigma / factor
    unit = "" if unit == "1" else f" {prefix}{unit}"
    if not sigma > 0:
        return f"{value:.4g}{unit}"
    digits = int(max(0, 1 - np.floor(np.log10(sigma))))
    if digits > 7 or abs(value) >= 1e6:
        powers = [np.floor(np.log10(number)) for number in (max(abs(value), sigma), sigma)]
        places = int(powers[0] - powers[1]) + 2  # down to sigma's second
        return f"({value:.{places}g} +- {sigma:.2g}){unit}"
    return f"{value:.{digits}f} +- {sigma:.{digits}f}{unit}"


def shown(q: Quantity, fit: Fit) -> tuple[str, float, float]:
    """Name, value and sigma of a fitted quantity as people know it: slip is fitted by 1/mu and shown by mu."""
    name, value, sigma = q.name.partition(".")[2], fit.values[q.name], fit.sigma(q.name)
    if q.name == SLIP and value > 0:
        return "mu", 1.0 / value, sigma / value**2
    return name, value, sigma


def effect_text(found: Found, diagnosis: Diagnosis) -> str:
    """One effect with its size and what it cannot be told from."""
    fit = diagnosis.after
    # a free velocity at the first instant says nothing to people that the remark on slip does not
    amounts = [(*shown(q, fit), q.unit) for q in found.candidate.quantities if not q.name.startswith("state.")]
    sizes = ", ".join(f"{name} = {quantity_text(value, sigma, unit)}" for name, value, sigma, unit in amounts)
    text = f"{found.candidate.title} [{found.candidate.name}]: {sizes}{together_text(found, diagnosis)}"
    text += "".join(f"; {bound}" for bound in bounds(found, fit))
    if found.cannot_be_told_from:
        rivals = ", ".join(r.candidate.name for r in found.cannot_be_told_from)
        text += f"; this recording cannot tell it from {rivals}"
    return text


def bounds(found: Found, fit: Fit) -> list[str]:
    """Numbers of the effect that the data do not tell from nought: how large they may be, and what keeps them open."""
    texts = []
    spread = np.array([fit.sigma(name) for name in fit.names])
    for q in found.candidate.quantities:
        name, value, sigma = shown(q, fit)
        if q.name.startswith("state.") or q.name == SLIP or q.null != 0.0:  # a limit is no size
            continue
        if not sigma > 0 or abs(value) >= TWO_SIDED * sigma:
            continue
        i = fit.names.index(q.name)
        shared = np.abs(fit.covariance_with(q.name)) / np.where(spread > 0, spread, np.inf) / spread[i]
        shared[i] = 0.0
        partner = int(np.argmax(shared))
        why = f"as {fit.names[partner]} moves with it" if shared[partner] > SHARED else "by the noise"
        most = quantity_text(abs(value) + TWO_SIDED * sigma, 0.0, q.unit)
        texts.append(f"{name} is only bounded, |{name}| < {most} (95 %), {why}")
    return texts


def together(found: Found, fit: Fit) -> tuple[Correlated, ...]:
    """Numbers of the effect that move together with each other or with those of a declared law."""
    laws = [q.name for q in fit.quantities if not (np.isfinite(q.prior_sigma) or q.name.startswith("state."))]
    return correlated(fit, [q.name for q in found.candidate.quantities if q.name != SLIP], laws)


def together_text(found: Found, diagnosis: Diagnosis) -> str:
    """What their standard deviations alone do not say; a pair that an earlier effect's text has named is left out."""
    fit = diagnosis.after
    units = {q.name: q.unit for q in fit.quantities}
    earlier = takewhile(lambda effect: effect is not found, diagnosis.found)
    named = {frozenset((pair.first, pair.second)) for effect in earlier for pair in together(effect, fit)}
    text = ""
    for pair in together(found, fit):
        if frozenset((pair.first, pair.second)) in named:
            continue
        factor = f"{'+' if pair.factor >= 0 else '-'} {abs(pair.factor):.4g}"
        known = quantity_text(pair.value, pair.sigma, units[pair.first])
        text += f" (correlation {pair.correlation:.4f}: better known is {pair.first} {factor} {pair.second} = {known})"
    return text


def law_text(law: LearnedLaw, fit: Fit) -> str:
    """A learned law with its numbers."""
    numbers = ", ".join(
        f"{q.name.partition('.')[2]} = {fit.values[q.name]:.4g} +- {fit.sigma(q.name):.2g}"
        for q in law.candidate.quantities
    )
    formulas = "; ".join(f"{component} = {formula}" for component, formula in law.formulas.items())
    return f"{law.title}: {formulas} with {numbers} (SI)" + (", locked to the disc's angles" if law.locked else "")


def systematic_text(systematic: Systematic) -> str:
    """The measurement's systematic errors, as far as the dots show them; empty where they show none."""
    parts = []
    if systematic.lens_px:
        parts.append(f"{systematic.lens_px:.2g} px in the cameras' fields, over {systematic.lens_length_px:.0f} px")
    if systematic.dot_px:
        parts.append(f"{systematic.dot_px:.2g} px of single dots")
    if systematic.print_m:
        parts.append(f"{1e6 * systematic.print_m:.2g} um in the dots' places on the face")
    if not parts:
        return ""
    total = f" of {systematic.rms_px:.2g} px" if systematic.rms_px else ""
    return f"The measurement has systematic errors{total} ({', '.join(parts)}), which all sigmas contain."


def sentence(
    diagnosis: Diagnosis,
    fit: Fit,
    after: Errors | None,
    law: LearnedLaw | None,
    systematic: Systematic | None = None,
    left: LeftOver | None = None,
) -> str:
    """The answer in one or a few sentences, the motion first; `fit` is that of the enlarged model."""
    if after is None:
        return f"No answer: {diagnosis.reason}."
    level = (
        f"{after.position_um:.2g} um and {after.theta_mdeg:.2g} mdeg a frame ({after.rms_px:.4f} px rms, "
        f"{after.reduced_chi_square:.3f} of the expected variance)"
    )
    errors = systematic_text(systematic) if systematic is not None else ""
    white = left is None or left.white
    remark = "" if white or left is None else _not_noise(left)
    ending = " ".join(text for text in ("", errors, remark) if text)
    ending = f" {ending}" if ending else ""
    if law is not None:
        first = "".join(f"Missing in the model: {effect_text(f, diagnosis)}. " for f in diagnosis.found)
        described = f"{law_text(law, fit)} describes it and leaves {level}"
        return f"{first}A law is missing that the catalogue does not name: {described}.{ending}"
    if diagnosis.verdict == "nothing missing":
        in_the_motion = " in the motion" if ending else ""
        return f"Nothing is missing{in_the_motion} at the level of {level}.{ending}"
    effects = "; and ".join(effect_text(f, diagnosis) for f in diagnosis.found)
    it = "it" if len(diagnosis.found) == 1 else "them"
    if diagnosis.verdict == "found":
        fall = f"{diagnosis.before.reduced_chi_square:.4g} to {after.reduced_chi_square:.4g}"
        motion = any(f.candidate.kind == "motion" for f in diagnosis.found)
        rivals = any(r.candidate.kind == "motion" for f in diagnosis.found for r in f.cannot_be_told_from)
        is_need = "need be" if rivals else "is"
        of_the_measurement = f"Nothing {is_need} missing in the motion; wrong in the measurement"
        first = "Missing in the model" if motion else of_the_measurement
        rest = f"what is left is noise: {level}" if white else f"{level} are left"
        fell = diagnosis.before.reduced_chi_square > after.reduced_chi_square + 1e-9
        falls = f"With {it} chi-square per degree of freedom falls from {fall}, and {rest}" if fell else rest
        return f"{first}: {effects}. {falls[:1].upper()}{falls[1:]}.{ending}"
    if effects:
        nearest = f"the nearest description is {effects}, which leaves {level}"
        return f"Something is missing that the catalogue does not name; {nearest}.{ending}"
    return f"Something is missing that no effect of the catalogue describes: {level} are left.{ending}"


def _not_noise(left: LeftOver) -> str:
    """What is left, where it is not noise."""
    where = "in the poses" if left.of_the_motion else "in all numbers of the dots alike"
    if left.other_p_value >= LEVEL and not left.of_the_motion:
        where = "in the poses, though no larger than the noise's own scatter allows"
    p = min(left.pose_p_value, left.other_p_value)
    return (
        f"What is left is not noise: it has a memory (p = {p:.1g}, corrected for {left.n_tests} tests), {where}: "
        f"{left.pose_chi_square:.3f} of the noise in the poses, {left.other_chi_square:.3f} elsewhere."
    )
