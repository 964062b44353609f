"""The diagnosis of a disc in plain words."""

from disctrack.diagnosis.errors import Errors
from disctrack.diagnosis.law_library import locked
from disctrack.diagnosis.left_over import LEVEL, LeftOver
from disctrack.diagnosis.systematic import Systematic
from disctrack.discrepancy.fit import Fit
from disctrack.discrepancy.laws import LearnedLaw
from disctrack.discrepancy.search import Diagnosis
from disctrack.discrepancy.words import effect_text

UNFOLLOWED = "without it the model follows no part of the recording"  # so that there is no chi-square to compare


def law_text(law: LearnedLaw, fit: Fit) -> str:
    """A learned law with its numbers."""
    numbers = ", ".join(
        f"{q.part} = {fit.values[q.name]:.4g} +- {fit.sigma(q.name):.2g}" for q in law.candidate.quantities
    )
    formulas = "; ".join(f"{component} = {formula}" for component, formula in law.formulas.items())
    return f"{law.title}: {formulas} with {numbers} (SI)" + (", locked to the disc's angles" if locked(law) else "")


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
