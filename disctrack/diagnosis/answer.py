"""What the diagnosis of a trajectory of the disc holds."""

from dataclasses import dataclass

from calibration.kit.brief import Brief
from disctrack.diagnosis.disc_system import DiscSystem
from disctrack.diagnosis.errors import Errors
from disctrack.diagnosis.form_misfit import LawCourse
from disctrack.diagnosis.left_over import LeftOver
from disctrack.diagnosis.pages.words import sentence
from disctrack.diagnosis.plan import Plan
from disctrack.diagnosis.regimes import Regimes
from disctrack.discrepancy.fit import Fit
from disctrack.discrepancy.held_out import HeldOut
from disctrack.discrepancy.laws import LearnedLaw
from disctrack.discrepancy.search import Diagnosis


@dataclass(frozen=True)
class Learned:
    """A law outside the catalogue, fitted like an effect."""

    law: LearnedLaw
    fit: Fit
    held_out: HeldOut
    gain: float  # decrease of chi-square in units of the noise found
    held_out_gain: float
    power: float  # mean over the recording [W]; negative where it takes energy from the disc
    course: LawCourse | None = None  # of the moment about the contact, with what the law's form may be off by


@dataclass(frozen=True, repr=False)
class DiscDiagnosis(Brief):
    """Diagnosis of one trajectory of the disc."""

    system: DiscSystem
    diagnosis: Diagnosis
    model: str
    before: Errors | None  # None where the base fit did not converge
    after: Errors | None
    energy: dict[str, float]  # [J]
    learned: Learned | None = None
    plan: Plan | None = None  # recordings that would settle what is open, where it was asked for
    notes: tuple[str, ...] = ()  # on the frames that were diagnosed, and those that were not
    regimes: Regimes | None = None  # where a model that fails holds
    left: LeftOver | None = None  # tests of the residual; None where too few rows are complete

    def facts(self) -> dict[str, str]:
        """What a glance should tell (`Brief`)."""
        told = {"verdict": self.diagnosis.verdict, "says": self.sentence}
        chi = [fit.reduced_chi_square for fit in (self.diagnosis.before, self.after_fit)]
        return told | {"reduced chi-square": f"{chi[0]:.4g} before, {chi[1]:.4g} after"}

    @property
    def sentence(self) -> str:
        """The answer in one or a few sentences."""
        return sentence(self)

    @property
    def has_more(self) -> bool:
        """Is the model after larger than that before?"""
        return bool(self.diagnosis.found) or self.learned is not None

    @property
    def after_fit(self) -> Fit:
        """Fit of the enlarged model."""
        return self.learned.fit if self.learned else self.diagnosis.after

    @property
    def after_held_out(self) -> HeldOut | None:
        """Its free run."""
        return self.learned.held_out if self.learned else self.diagnosis.held_out_after
