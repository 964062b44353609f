"""The diagnosis of one trajectory of the disc, and its sentences."""

from collections.abc import Mapping
from dataclasses import dataclass, field

from calibration.kit.brief import Brief
from disctrack.diagnosis.disc_system import DiscSystem
from disctrack.diagnosis.errors import LEVEL, Errors, ResidualTests, ValidRange
from disctrack.diagnosis.law_library import LearnedLaw, locked
from disctrack.diagnosis.missing_force import Course
from disctrack.diagnosis.plan import Plan
from disctrack.diagnosis.systematic import Systematic
from disctrack.discrepancy.document import effect_text
from disctrack.discrepancy.fit import Fit
from disctrack.discrepancy.search import Diagnosis, Found
from disctrack.numbers import Measured, probability, rounded

FEW = 3  # numbers of a law that a sentence holds; the page has them all


@dataclass(frozen=True)
class Learned(Found):
    """A law outside the catalogue, fitted like an effect."""

    law: LearnedLaw
    power: float  # mean over the recording [W]; negative where it takes energy from the disc
    course: Course | None  # moment of all laws about the contact, with the uncertainty of the law's form
    misfit: float  # rms of the discrepancy of the form over that of the law

    def text(self, fit: Fit) -> str:
        """The law with its coefficients if they are few; else, or if they are not significant, its time course."""
        if self.course is not None and not self.law.is_significant(fit):
            return (
                f"its form is not determined here: it is {self.course.text} (nearest of the library: {self.law.title})"
            )
        angles = ", locked to the disc's angles" if locked(self.law) else ""
        named = all(family.names for family in self.law.families)
        if len(self.numbers(fit)) > FEW and not named:
            return f"{self.law.title}{angles}{f': {self.course.text}' if self.course else ''}"
        formulas = "" if named else "; ".join(f"{c} = {formula}" for c, formula in self.law.formulas.items())
        numbers = ", ".join(f"{name} = {value}" for name, value in self.numbers(fit))
        return f"{self.law.title}: {formulas}{'' if named else ' with '}{numbers} (SI){angles}"

    def numbers(self, fit: Fit) -> list[tuple[str, Measured]]:
        """Its coefficients and shape parameters."""
        return [(q.part, Measured(fit.values[q.name], fit.sigma(q.name))) for q in self.candidate.quantities]


@dataclass(frozen=True, repr=False)
class DiscDiagnosis(Brief):
    """Diagnosis of one trajectory of the disc."""

    system: DiscSystem
    diagnosis: Diagnosis
    model: str
    before: Errors | None = None  # None where the base fit did not converge
    after: Errors | None = None
    energy: Mapping[str, float] = field(default_factory=dict)  # [J]
    learned: Learned | None = None
    notes: tuple[str, ...] = ()  # on frames that were left out, and on doubts
    holds: Mapping[str, ValidRange | None] = field(default_factory=dict)  # of a model that fails elsewhere
    tests: ResidualTests = field(default_factory=ResidualTests)
    plan: Plan | None = None  # recordings that would answer the open questions, if requested

    def facts(self) -> dict[str, str]:
        """The main facts (`Brief`)."""
        d = self.diagnosis
        chi_square = f"{d.before.reduced_chi_square:.4g} before, {d.after.reduced_chi_square:.4g} after"
        return {"verdict": d.verdict, "says": self.sentence, "reduced chi-square": chi_square}

    @property
    def has_more(self) -> bool:
        """Has the model after more terms than that before?"""
        return bool(self.diagnosis.found) or self.learned is not None

    @property
    def sentence(self) -> str:
        """The answer in one or a few sentences."""
        return " ".join(filter(None, (self.verdict_text, self.accuracy_text, *self.remarks)))

    @property
    def verdict_text(self) -> str:
        """What is missing, the motion first."""
        diagnosis = self.diagnosis
        effects = "; and ".join(effect_text(f, diagnosis) for f in diagnosis.found)
        if self.after is None:
            return f"No answer: {diagnosis.reason}."
        if self.learned is not None:
            first = f"Missing in the model: {effects}. " if effects else ""
            law = self.learned.text(diagnosis.after)
            described = "described by " if self.learned.law.is_significant(diagnosis.after) else ""
            return f"{first}A law is missing that the catalogue does not name; {described}{law}."
        if diagnosis.verdict == "nothing missing":
            return f"Nothing is missing{' in the motion' if self.remarks else ''}."
        if diagnosis.verdict == "found":
            if any(f.candidate.kind == "motion" for f in diagnosis.found):
                return f"Missing in the model: {effects}."
            others = any(r.candidate.kind == "motion" for f in diagnosis.found for r in f.cannot_be_told_from)
            is_need = "need be" if others else "is"
            return f"Nothing {is_need} missing in the motion; wrong in the measurement: {effects}."
        return unnamed(effects)

    @property
    def accuracy_text(self) -> str:
        """Size of the residuals; empty where there is no answer."""
        after, before = self.after, self.diagnosis.before.reduced_chi_square
        if after is None:
            return ""
        is_noise = self.tests.white and self.diagnosis.verdict != "unexplained" and self.learned is None
        noise = " noise of" if is_noise else ""
        chi, fell = after.reduced_chi_square, ""
        if before > chi + 1e-9:
            fell = f"; chi-square per degree of freedom fell from {rounded(before, 4)} to {rounded(chi, 4)}"
        return (
            f"Residuals:{noise} {rounded(after.rms_position_um)} µm and {rounded(after.rms_theta_mdeg)} mdeg a frame "
            f"({rounded(after.rms_px)} px rms, {chi:.3f} of the expected variance{fell})."
        )

    @property
    def remarks(self) -> list[str]:
        """Systematic errors of the measurement, and whether the residuals are noise."""
        if self.after is None:
            return []
        found = [_errors_of_dots(self.system.systematic)] if self.system.systematic.present else []
        return found if self.tests.white else [*found, _not_noise(self.tests)]


def unnamed(effects: str) -> str:
    """The verdict if the model fails; `effects` are the nearest description, if there is one."""
    if effects:
        return f"Something is missing that the catalogue does not name; the nearest description is {effects}."
    return "Something is missing that no effect of the catalogue describes."


def _errors_of_dots(systematic: Systematic) -> str:
    """Systematic errors of the measurement, as estimated from the dots."""
    parts = []
    if systematic.lens_px:
        parts.append(f"{systematic.lens_px:.2g} px in the cameras' fields, over {systematic.lens_length_px:.0f} px")
    if systematic.dot_px:
        parts.append(f"{systematic.dot_px:.2g} px of single dots")
    if systematic.print_m:
        parts.append(f"{1e6 * systematic.print_m:.2g} µm in the dots' places on the face")
    total = f" of {systematic.rms_px:.2g} px" if systematic.rms_px else ""
    return f"The measurement has systematic errors{total} ({', '.join(parts)}), which all sigmas contain."


def _not_noise(tests: ResidualTests) -> str:
    where = "in the poses" if tests.of_the_motion else "in all components of the dots alike"
    if tests.other_p_value >= LEVEL and not tests.of_the_motion:
        where = "in the poses, though no larger than the intrinsic scatter allows"
    p = min(tests.pose_p_value, tests.other_p_value)
    return (
        f"The residuals are not noise: autocorrelated (p {probability(p)}, corrected for {tests.n_tests} tests), "
        f"{where}: {tests.pose_chi_square:.3f} of the noise in the poses, {tests.other_chi_square:.3f} elsewhere."
    )
