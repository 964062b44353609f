"""A diagnosis in plain words."""

from __future__ import annotations

import numpy as np

from disctrack.diagnosis.disc.errors import Errors
from disctrack.diagnosis.disc.learned_law import LearnedLaw
from disctrack.diagnosis.disc.motion import SLIP
from disctrack.diagnosis.engine.fit import Fit
from disctrack.diagnosis.engine.search import Diagnosis, Found
from disctrack.diagnosis.engine.system import Quantity

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
    if digits > 9 or abs(value) >= 1e6:
        return f"({value:.5g} +- {sigma:.2g}){unit}"
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
    text = f"{found.candidate.title} [{found.candidate.name}]: {sizes}"
    if found.cannot_be_told_from:
        rivals = ", ".join(r.candidate.name for r in found.cannot_be_told_from)
        text += f"; this recording cannot tell it from {rivals}"
    return text


def law_text(law: LearnedLaw, fit: Fit) -> str:
    """A learned law with its numbers."""
    numbers = ", ".join(
        f"{q.name.partition('.')[2]} = {fit.values[q.name]:.4g} +- {fit.sigma(q.name):.2g}"
        for q in law.candidate.quantities
    )
    formulas = "; ".join(f"{component} = {formula}" for component, formula in law.formulas.items())
    return f"{formulas} with {numbers} (SI)" + (", locked to the disc's angles" if law.locked else "")


def sentence(diagnosis: Diagnosis, fit: Fit, after: Errors | None, law: LearnedLaw | None) -> str:
    """The answer in one or a few sentences; `fit` is that of the enlarged model."""
    if after is None:
        return f"No answer: {diagnosis.reason}."
    level = (
        f"{after.position_um:.2g} um and {after.theta_mdeg:.2g} mdeg a frame ({after.rms_px:.4f} px rms, "
        f"{after.reduced_chi_square:.3f} of the expected variance)"
    )
    if law is not None:
        first = "".join(f"Missing in the model: {effect_text(f, diagnosis)}. " for f in diagnosis.found)
        described = f"{law_text(law, fit)} describes it and leaves {level}"
        return f"{first}A moment is missing that the catalogue does not name: {described}."
    if diagnosis.verdict == "nothing missing":
        return f"Nothing is missing at the level of {level}."
    effects = "; and ".join(effect_text(f, diagnosis) for f in diagnosis.found)
    it = "it" if len(diagnosis.found) == 1 else "them"
    if diagnosis.verdict == "found":
        fall = f"{diagnosis.before.reduced_chi_square:.4g} to {after.reduced_chi_square:.4g}"
        return (
            f"Missing in the model: {effects}. With {it} chi-square per degree of freedom falls from {fall}, and what "
            f"is left is noise: {level}."
        )
    if effects:
        nearest = f"the nearest description is {effects}, which leaves {level}"
        return f"Something is missing that the catalogue does not name; {nearest}."
    return f"Something is missing that no effect of the catalogue describes: {level} are left."
