"""What the diagnosis of a trajectory of the disc holds, and says in plain words."""

from collections.abc import Mapping
from dataclasses import dataclass, field

from calibration.kit.brief import Brief
from disctrack.diagnosis.disc_system import DiscSystem
from disctrack.diagnosis.errors import LEVEL, Errors, LeftOver, Span
from disctrack.diagnosis.law_library import LearnedLaw, locked
from disctrack.diagnosis.missing_force import Course
from disctrack.diagnosis.plan import Plan
from disctrack.diagnosis.systematic import Systematic
from disctrack.discrepancy.document import effect_text
from disctrack.discrepancy.fit import Fit
from disctrack.discrepancy.search import Diagnosis, Found
from disctrack.numbers import Measured, probability, rounded


@dataclass(frozen=True)
class Learned(Found):
    """A law outside the catalogue, fitted like an effect."""

    law: LearnedLaw
    power: float  # mean over the recording [W]; negative where it takes energy from the disc
    course: Course | None  # of the moment about the contact of all laws, with what the law's form may be off by
    misfit: float  # rms of that over the law's own, as the residual has it

    def text(self, fit: Fit) -> str:
        """The law with its numbers; where these do not stand out, its course alone is known."""
        if self.course is not None and not self.law.stands_out(fit):
            return (
                f"its form is not determined here: it is {self.course.text} (nearest of the library: {self.law.title})"
            )
        quantities = self.candidate.quantities
        numbers = ", ".join(f"{q.part} = {Measured(fit.values[q.name], fit.sigma(q.name))}" for q in quantities)
        named = all(family.names for family in self.law.families)
        formulas = "" if named else "; ".join(f"{c} = {formula}" for c, formula in self.law.formulas.items())
        angles = ", locked to the disc's angles" if locked(self.law) else ""
        return f"{self.law.title}: {formulas}{'' if named else ' with '}{numbers} (SI){angles}"


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
    notes: tuple[str, ...] = ()  # on the frames that were diagnosed, and those that were not
    holds: Mapping[str, Span | None] = field(default_factory=dict)  # where a model that fails does (`errors.regimes`)
    left: LeftOver | None = None  # tests of the residual; None where too few rows are complete
    plan: Plan | None = None  # recordings that would settle what is open, where it was asked for

    def facts(self) -> dict[str, str]:
        """What a glance should tell (`Brief`)."""
        told = {"verdict": self.diagnosis.verdict, "says": self.sentence}
        d = self.diagnosis
        chi = [fit.reduced_chi_square for fit in (d.before, d.after)]
        return told | {"reduced chi-square": f"{chi[0]:.4g} before, {chi[1]:.4g} after"}

    @property
    def has_more(self) -> bool:
        """Is the model after larger than that before?"""
        return bool(self.diagnosis.found) or self.learned is not None

    @property
    def sentence(self) -> str:
        """The answer in one or a few sentences."""
        return " ".join(text for text in (self.verdict_text, self.accuracy_text, *self.remarks) if text)

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
            told = "described by " if self.learned.law.stands_out(diagnosis.after) else ""
            return f"{first}A law is missing that the catalogue does not name; {told}{law}."
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
        """What the model leaves unexplained, in the units of an experimenter; empty where there is no answer."""
        after, before = self.after, self.diagnosis.before.reduced_chi_square
        if after is None:
            return ""
        white = self.left is None or self.left.white
        noise = " noise of" if white and self.diagnosis.verdict != "unexplained" and self.learned is None else ""
        chi, fell = after.reduced_chi_square, ""
        if before > chi + 1e-9:
            fell = f"; chi-square per degree of freedom fell from {rounded(before, 4)} to {rounded(chi, 4)}"
        return (
            f"Residuals:{noise} {rounded(after.rms_position_um)} µm and {rounded(after.rms_theta_mdeg)} mdeg a frame "
            f"({rounded(after.rms_px)} px rms, {chi:.3f} of the expected variance{fell})."
        )

    @property
    def remarks(self) -> list[str]:
        """What the residuals say of the measurement, and where they are no noise."""
        if self.after is None:
            return []
        found = [_errors_of_dots(self.system.systematic)] if self.system.systematic.present else []
        return found if self.left is None or self.left.white else [*found, _not_noise(self.left)]


def unnamed(effects: str) -> str:
    """What is said where the model fails, and `effects` are the nearest description, if there is one."""
    if effects:
        return f"Something is missing that the catalogue does not name; the nearest description is {effects}."
    return "Something is missing that no effect of the catalogue describes."


def _errors_of_dots(systematic: Systematic) -> str:
    """The measurement's systematic errors, as far as the dots show them."""
    parts = []
    if systematic.lens_px:
        parts.append(f"{systematic.lens_px:.2g} px in the cameras' fields, over {systematic.lens_length_px:.0f} px")
    if systematic.dot_px:
        parts.append(f"{systematic.dot_px:.2g} px of single dots")
    if systematic.print_m:
        parts.append(f"{1e6 * systematic.print_m:.2g} µm in the dots' places on the face")
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
