"""Recordings that would answer what one leaves open, for the report and for diagnosis.json."""

from typing import Any

import numpy as np

from disctrack.diagnosis.plan import ENOUGH, Plan, Question
from disctrack.discrepancy.significance import TWO_SIDED
from disctrack.report.blocks import Items, Listing, Section, Text
from disctrack.report.numbers import in_unit, measured, rounded

SAID = (
    "Computed from the fitted model: each recording is simulated with the same cameras and noise, and added to "
    "what there is; laws, cameras and dots are shared, the initial state is its own. Another disc has a k_m of its "
    "own, laws in question keep their coefficient; air drag goes with the density as its law says. More dots and a "
    "third view count as numbers of the same kind."
)


def section(plan: Plan | None) -> Section:
    """What is open, the recording that would say most on each question, and all others."""
    title = "Recordings that would settle what is open"
    if plan is None or not plan.questions:
        return Section(title, ())
    best = {id(plan.best(i)) for i in range(len(plan.questions))}
    different = {r.answers: r for r in reversed(plan.rows)}.values()  # a disc at rest is filmed to no purpose
    rows = [(id(r) in best, (r.proposal.text, rounded(r.duration, 2), *map(_cell, r.answers))) for r in different]
    header = ("one more recording", "lasts [s]", *map(_heading, plan.questions))
    now = ("none: what there is", "", *map(_cell, plan.now))
    said = [_sentence(plan, i) for i in range(len(plan.questions))]
    others = [cells for is_best, cells in rows[::-1] if not is_best]
    shown = Listing(header, [now, *(cells for is_best, cells in rows if is_best)])
    return Section(title, [Items(said), Text(SAID), shown, Listing(header, others, folded="All other recordings")])


def _heading(q: Question) -> str:
    if q.rival is not None:
        return f"{q.effect.name} or {q.rival.name} [sigmas]"
    return in_unit(f"σ of {q.effect.name}", q.effect.quantities[0].unit)


def _cell(value: float) -> str:
    return rounded(value, 2) if np.isfinite(value) else "not seen"


def _sentence(plan: Plan, i: int) -> str:
    q, best = plan.questions[i], plan.best(i)
    open_ = f"{q.effect.name} or {q.rival.name}" if q.rival else f"size of {q.effect.name}"
    if best is None:
        return f"For {open_} no recording that was tried can be made."
    if q.rival is None:
        unit = q.effect.quantities[0].unit
        limit, now = (_limit(x, unit) for x in (best.answers[i], plan.now[i]))
        return f"The {open_} is known to {now} (95 %), and would be to {limit}: {best.proposal.text}."
    if best.answers[i] < ENOUGH:
        return f"No recording that was tried separates {q.effect.name} from {q.rival.name}."
    return f"To separate {q.effect.name} from {q.rival.name}: {best.proposal.text} ({rounded(best.answers[i])} sigmas)."


def _limit(sigma: float, unit: str) -> str:
    return measured(TWO_SIDED * sigma, unit=unit) if np.isfinite(sigma) else "nothing"


def as_json(plan: Plan | None) -> dict[str, Any] | None:
    """For diagnosis.json."""
    if plan is None:
        return None
    return {
        "questions": [
            {"effect": q.effect.name, "rival": None if q.rival is None else q.rival.name, "now": x}
            for q, x in zip(plan.questions, plan.now, strict=True)
        ],
        "recordings": [
            {**vars(r.proposal), "text": r.proposal.text, "lasts_s": r.duration, "answers": list(r.answers)}
            for r in plan.rows
        ],
        "meaning": "answers: sigmas between effect and rival; without a rival the standard deviation of the size",
    }
