"""What is missing in the published exponents of Ma et al. (2014)? Tables 2 and 3 under the engine of diagnosis.

    python -m disctrack.examples.published_exponents [-o DIR]

The tables give the exponents of nutation, precession rate and energy in t_f - t for nine trials on steel and eight on
glass. On glass they contradict the paper's 2/3 and -1/3. The engine fits the paper's model to all of them, looks
through the catalogue of motions and through what the reading may do wrong, and says which effects would remove the
contradiction, which of them these tables cannot tell apart, and which trials would.
"""

from __future__ import annotations

import sys
from collections.abc import Sequence

from disctrack.diagnosis import Settings, diagnose
from disctrack.diagnosis.engine.fit import Fit
from disctrack.examples._command import Outcome, command
from disctrack.examples.exponent_analysis import (
    THIN_DISC,
    Explanation,
    Fixed,
    early_stop,
    explanation,
    fixed,
    misfit,
    misfits,
    power_shares,
    scatter,
)
from disctrack.examples.exponent_figure import draw
from disctrack.examples.exponent_plans import PLANS, Plan, pairs, planned_series, separation
from disctrack.examples.exponent_report import Answer, document, report
from disctrack.examples.exponent_system import BRAKING, ExponentSystem, at, published_series

SETTINGS = Settings(noise=1.0, shortlist=12, max_effects=2)  # the trials' own scatter is the noise
COMPARED = ("air_bildsten", "air_moffatt", "contour_viscous", "t_f_each")  # the more adaptable, the later
ASKED = ("t_f", *COMPARED)  # looked at, found or not


def examine(system: ExponentSystem, plans: Sequence[Plan] = PLANS) -> Answer:
    """Diagnosis of the trials, and everything that is said beside it; ASKED must be among the system's candidates."""
    diagnosis = diagnose(system, system.start, SETTINGS)
    base = diagnosis.before
    found = [f.candidate.name for f in diagnosis.found]
    rivals = [r.candidate.name for f in diagnosis.found for r in f.cannot_be_told_from]
    explanations = {n: explanation(system, base, n) for n in dict.fromkeys([*found, *rivals, *ASKED])}
    own = [{"km.k_m": s.setup.k_m} for s in system.series]
    stop = tuple(early_stop(s.setup, v) for s, v in zip(system.series, own, strict=True))
    return Answer(
        thin=tuple(misfit(s.setup.surface, s.exponents, THIN_DISC) for s in system.series),
        before=misfits(system, base.values),
        diagnosis=diagnosis,
        explanations=explanations,
        shares={n: power_shares(system, e) for n, e in explanations.items()},
        fixed=known_sizes(system, base, stop),
        scatter=tuple(scatter(s, v) for s, v in zip(system.series, own, strict=True)),
        stop=stop,
        separations=separations(system, base, explanations, plans) if plans else {},
    )


def known_sizes(system: ExponentSystem, base: Fit, stop: Sequence[float]) -> tuple[Fixed, ...]:
    """Sizes that theory or the paper's own words give. stop [s] : `early_stop` of each surface."""
    touch = {at("t_f.bias", s): -before for s, before in zip(system.surfaces, stop, strict=True)}
    rest = {name: BRAKING + value for name, value in touch.items()}
    nominal = {"air_bildsten.beta": 1.0}
    return (
        fixed(system, base, "t_f where the disc reaches its paper, 0.5 deg", touch),
        fixed(system, base, f"t_f where it has come to rest on it, {1e3 * BRAKING:.0f} ms later", rest),
        fixed(system, base, "Moffatt's layer as calculated", {"air_moffatt.f": 1.0}),
        fixed(system, base, "Bildsten's boundary layers with a factor of one", nominal),
        fixed(system, base, "the same with t_f fitted", nominal, "t_f_each"),
        # the paper does not say where its fits end; the curves of its figures do so 0.05 s before t_f
        fixed(system, base, "fits that end 0.02 s later, with t_f fitted", {"cut.shift": -0.02}, "t_f"),
        fixed(system, base, "fits that end 0.05 s earlier, with t_f fitted", {"cut.shift": 0.05}, "t_f"),
    )


def separations(
    system: ExponentSystem, base: Fit, explanations: dict[str, Explanation], plans: Sequence[Plan]
) -> dict[str, dict[tuple[str, str], float]]:
    """Sigmas between the explanations COMPARED, by plan and pair."""
    found = {}
    for plan in plans:
        planned = planned_series(system, base.values, plan)
        asked = pairs(COMPARED)
        found[plan.name] = {(a, b): separation(system, explanations[a], explanations[b], planned) for a, b in asked}
    return found


def diagnose_exponents() -> Outcome:
    """Diagnose the published exponents of Ma et al. (2014)."""
    system = ExponentSystem(published_series())
    answer = examine(system)
    return Outcome(report(answer), document(answer), draw(system, answer))


def main(words: Sequence[str] | None = None) -> int:
    """Command line; returns the exit code."""
    return command("published_exponents", None, diagnose_exponents, words)


if __name__ == "__main__":
    sys.exit(main())
