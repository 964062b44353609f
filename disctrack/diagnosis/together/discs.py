"""Many recordings of discs, one answer; and which further recording would settle what they leave open."""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from calibration.kit.least_squares import triangle
from disctrack.diagnosis.model_file import PAPER
from disctrack.diagnosis.plan import OPEN, Plan, Question
from disctrack.diagnosis.together.recordings import Item, Recorded, Say, build, in_common, labels_of
from disctrack.discrepancy.joint.crew import Crew
from disctrack.discrepancy.joint.together import TogetherDiagnosis, answer_together
from disctrack.discrepancy.search import Settings


@dataclass(frozen=True)
class DiscsTogether(TogetherDiagnosis):
    """Answer for many recordings of discs."""

    plan: Plan | None = None  # recordings that would settle what is open, where it was requested


def diagnose_together(
    recordings: Sequence[Recorded],
    model: str = PAPER,
    settings: Settings | None = None,
    processes: int = 1,
    progress: Callable[[str], None] = lambda text: None,
    settle: bool = False,
    unread: Mapping[str, str] | None = None,
) -> DiscsTogether:
    """What does the model lack, of all recordings together?

    model : as `diagnose`
    unread : further recordings that are reported as left out, and why
    processes : among which the recordings are dealt out; the answer does not depend on their number
    settle : also compute which further recording would settle what is left open
    Raises AnalysisError where fewer than two recordings can be used.
    """
    labels = labels_of(recordings)
    items = [Item(r, label, model) for r, label in zip(recordings, labels, strict=True)]
    described = [(item.recorded.name, item.labels) for item in items]
    progress(f"{len(items)} recordings, each alone")
    with Crew(build, items, processes) as crew:
        answer = answer_together(crew, described, in_common, settings, progress, unread or {})
        return DiscsTogether(**vars(answer), plan=_plan(answer, crew) if settle else None)


def _plan(answer: TogetherDiagnosis, crew: Crew) -> Plan | None:
    """Recordings beside all these, with disc, surface and cameras of the longest of them."""
    system, diagnosis, bounds = answer.system, answer.diagnosis, answer.bounds
    sharing, after = system.sharing, diagnosis.after
    longest = int(np.argmax(system.weights))
    local = {c.name for c in sharing.members[longest].candidates}
    rivals = [Question(f.candidate, r.candidate) for f in diagnosis.found for r in f.cannot_be_told_from]
    open_sizes = [b for b in bounds if b.upper is not None and b.candidate.kind == "motion"]
    open_sizes.sort(key=lambda b: -float(b.sigma[0]) / b.candidate.quantities[0].typical)
    questions = [*rivals, *(Question(b.candidate) for b in open_sizes)]
    questions = [q for q in questions if {c.name for c in (q.effect, q.rival) if c is not None} <= local][:OPEN]
    if not questions:
        return None
    known = {q.name: q for q in after.quantities}
    tested = [q for x in questions for c in (x.effect, x.rival) if c is not None for q in c.quantities]
    new = {q.name: q for q in tested if q.name not in known}
    everything = {**known, **new}
    names = {there: shared for there, shared in sharing.shared_names(longest).items() if shared in everything}
    others = [n for n in everything if n not in set(names.values())]
    _, derivative = system.linearise({q.name: q.null for q in new.values()} | after.values, [*others, *names.values()])
    rows = derivative.reshape(-1, derivative.shape[-1])
    priors = np.zeros((len(others), rows.shape[1]))
    priors[:, : len(others)] = np.diag([1.0 / everything[n].prior_sigma for n in others])
    R = triangle(np.concatenate([rows, priors]))
    said = Say(tuple(names), R[len(others) :, len(others) :])
    extra = sharing.local_names(longest, [n for f in diagnosis.found for n in f.candidate.names])
    values = sharing.local_values(longest, after.values)
    found = crew.ask(longest, "planned", values, extra, questions, said)
    return found if isinstance(found, Plan) else None
