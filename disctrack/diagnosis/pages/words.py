"""The diagnosis of a disc in plain words."""

from __future__ import annotations

from typing import TYPE_CHECKING

from disctrack.diagnosis.law_library import locked
from disctrack.diagnosis.left_over import LEVEL, LeftOver
from disctrack.discrepancy.words import effect_text
from disctrack.report.numbers import Measured, probability, rounded

if TYPE_CHECKING:
    from disctrack.diagnosis.answer import DiscDiagnosis
    from disctrack.diagnosis.systematic import Systematic
    from disctrack.discrepancy.fit import Fit
    from disctrack.discrepancy.laws import LearnedLaw


def law_text(law: LearnedLaw, fit: Fit) -> str:
    """A learned law with its numbers."""
    numbers = ", ".join(
        f"{q.part} = {Measured(fit.values[q.name], fit.sigma(q.name))}" for q in law.candidate.quantities
    )
    formulas = "; ".join(f"{component} = {formula}" for component, formula in law.formulas.items())
    return f"{law.title}: {formulas} with {numbers} (SI)" + (", locked to the disc's angles" if locked(law) else "")


def sentence(result: DiscDiagnosis) -> str:
    """The answer in one or a few sentences."""
    return " ".join([verdict_text(result), *filter(None, [accuracy_text(result)]), *remarks(result)])


def verdict_text(result: DiscDiagnosis) -> str:
    """What is missing, the motion first."""
    diagnosis, effects = (
        result.diagnosis,
        "; and ".join(effect_text(f, result.diagnosis) for f in result.diagnosis.found),
    )
    if result.after is None:
        return f"No answer: {diagnosis.reason}."
    if result.learned is not None:
        first = f"Missing in the model: {effects}. " if effects else ""
        law = law_text(result.learned.law, result.learned.fit)
        return f"{first}A law is missing that the catalogue does not name; described by {law}."
    if diagnosis.verdict == "nothing missing":
        return f"Nothing is missing{' in the motion' if remarks(result) else ''}."
    if diagnosis.verdict == "found":
        if any(f.candidate.kind == "motion" for f in diagnosis.found):
            return f"Missing in the model: {effects}."
        rivals = any(r.candidate.kind == "motion" for f in diagnosis.found for r in f.cannot_be_told_from)
        is_need = "need be" if rivals else "is"
        return f"Nothing {is_need} missing in the motion; wrong in the measurement: {effects}."
    if effects:
        return f"Something is missing that the catalogue does not name; the nearest description is {effects}."
    return "Something is missing that no effect of the catalogue describes."


def accuracy_text(result: DiscDiagnosis) -> str:
    """What the model leaves unexplained, in the units of an experimenter; empty where there is no answer."""
    after, before = result.after, result.diagnosis.before.reduced_chi_square
    if after is None:
        return ""
    white = result.left is None or result.left.white
    noise = " noise of" if white and result.diagnosis.verdict != "unexplained" and result.learned is None else ""
    chi, fell = after.reduced_chi_square, ""
    if before > chi + 1e-9:
        fell = f"; chi-square per degree of freedom fell from {rounded(before, 4)} to {rounded(chi, 4)}"
    return (
        f"Residuals:{noise} {rounded(after.rms_position_um)} µm and {rounded(after.rms_theta_mdeg)} mdeg a frame "
        f"({rounded(after.rms_px)} px rms, {chi:.3f} of the expected variance{fell})."
    )


def remarks(result: DiscDiagnosis) -> list[str]:
    """What the residuals say of the measurement, and where they are no noise."""
    if result.after is None:
        return []
    left = result.left
    errors = systematic_text(result.system.systematic)
    return [text for text in (errors, "" if left is None or left.white else _not_noise(left)) if text]


def systematic_text(systematic: Systematic) -> str:
    """The measurement's systematic errors, as far as the dots show them; empty where they show none."""
    parts = []
    if systematic.lens_px:
        parts.append(f"{systematic.lens_px:.2g} px in the cameras' fields, over {systematic.lens_length_px:.0f} px")
    if systematic.dot_px:
        parts.append(f"{systematic.dot_px:.2g} px of single dots")
    if systematic.print_m:
        parts.append(f"{1e6 * systematic.print_m:.2g} µm in the dots' places on the face")
    if not parts:
        return ""
    total = f" of {systematic.rms_px:.2g} px" if systematic.rms_px else ""
    return f"The measurement has systematic errors{total} ({', '.join(parts)}), which all sigmas contain."


def _not_noise(left: LeftOver) -> str:
    where = "in the poses" if left.of_the_motion else "in all numbers of the dots alike"
    if left.other_p_value >= LEVEL and not left.of_the_motion:
        where = "in the poses, though no larger than the intrinsic scatter allows"
    p = min(left.pose_p_value, left.other_p_value)
    return (
        f"The residuals are not noise: autocorrelated (p {probability(p)}, corrected for {left.n_tests} tests), "
        f"{where}: {left.pose_chi_square:.3f} of the noise in the poses, {left.other_chi_square:.3f} elsewhere."
    )
