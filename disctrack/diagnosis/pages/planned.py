"""What would settle it, in words: recordings that would answer what one leaves open."""

from typing import Any

import numpy as np

from disctrack.diagnosis.plan import ENOUGH, Plan, Question
from disctrack.discrepancy.significance import TWO_SIDED
from disctrack.discrepancy.words import quantity_text
from disctrack.report.parts import bullets, details, paragraph, table

SAID = (
    "Computed from the fitted model: each recording is simulated with the same cameras and noise, and put beside "
    "what there is; laws, cameras and dots are shared, the initial state is its own. Another disc has a k_m of its "
    "own, laws in question keep their coefficient; air drag goes with the density as its law says. More dots and a "
    "third view count as numbers of the same kind."
)


def question_text(q: Question) -> str:
    """What is open."""
    if q.rival is not None:
        return f"{q.effect.name} or {q.rival.name}"
    return f"size of {q.effect.name}"


def _answer(q: Question, value: float) -> str:
    if q.rival is not None:
        return f"{value:.3g} sigmas"
    size = q.effect.quantities[0]
    return f"sigma {quantity_text(value, 0.0, size.unit)}" if np.isfinite(value) else "unseen"


def lines(plan: Plan) -> list[str]:
    """For the terminal: of every question, what this recording says, and the one that would say most."""
    said = []
    for i, q in enumerate(plan.questions):
        best = plan.best(i)
        text = f"{question_text(q)}: now {_answer(q, plan.now[i])}"
        if best is not None:
            text += f"; {best.proposal.text}: {_answer(q, best.answers[i])}"
            if q.rival is not None and best.answers[i] < ENOUGH:
                text += " (not enough: no recording looked at tells them apart)"
        said.append(f"{'plan':<13} {text}")
    return said


def html(plan: Plan | None) -> list[str]:
    """For the page."""
    if plan is None or not plan.questions:
        return []
    best = {id(plan.best(i)) for i in range(len(plan.questions))}
    different = {r.answers: r for r in reversed(plan.rows)}.values()  # a disc at rest is filmed to no purpose
    rows = [(id(r) in best, (r.proposal.text, f"{r.duration:.2g}", *map(_cell, r.answers))) for r in different]
    header = ("one more recording", "lasts [s]", *map(_heading, plan.questions))
    now = ("none: what there is", "", *map(_cell, plan.now))
    first = table("", header, [now, *(cells for is_best, cells in rows if is_best)])
    others = table("", header, [cells for is_best, cells in rows[::-1] if not is_best])
    said = [_sentence(plan, i) for i in range(len(plan.questions))]
    return [bullets(said), paragraph(SAID), first, details("All other recordings that were looked at", [others])]


def _heading(q: Question) -> str:
    if q.rival is not None:
        return f"{question_text(q)} [sigmas]"
    unit = q.effect.quantities[0].unit
    return f"sigma of {q.effect.name}" + (f" [{unit}]" if unit != "1" else "")


def _cell(value: float) -> str:
    return f"{value:.2g}" if np.isfinite(value) else "unseen"


def _sentence(plan: Plan, i: int) -> str:
    q, best = plan.questions[i], plan.best(i)
    if best is None:
        return f"For {question_text(q)} no recording looked at can be made."
    if q.rival is None:
        unit = q.effect.quantities[0].unit
        limit, now = (_limit(x, unit) for x in (best.answers[i], plan.now[i]))
        return f"The {question_text(q)} is known to {now} (95 %), and would be to {limit}: {best.proposal.text}."
    if best.answers[i] < ENOUGH:
        return f"No recording looked at tells {q.effect.name} from {q.rival.name}."
    return f"To tell {q.effect.name} from {q.rival.name}: {best.proposal.text} ({best.answers[i]:.3g} sigmas)."


def _limit(sigma: float, unit: str) -> str:
    return quantity_text(float(f"{TWO_SIDED * sigma:.2g}"), 0.0, unit) if np.isfinite(sigma) else "nothing"


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
