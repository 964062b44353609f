"""Joint diagnosis of recordings of the rolling disc, and which further one would answer their open questions."""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace

import numpy as np

from calibration.kit.types import Array
from disctrack.diagnosis.disc_system import DiscSystem
from disctrack.diagnosis.large_faults import large_faults
from disctrack.diagnosis.model_file import PAPER, declared_model
from disctrack.diagnosis.plan import Plan, Planner, Question, open_questions, plan
from disctrack.diagnosis.recorded import Recorded, wrong_declarations
from disctrack.diagnosis.systematic import MAX_FRAMES, Systematic, find_systematic, noise_over_stated, with_noise
from disctrack.discrepancy.fit import Fit, fit
from disctrack.discrepancy.joint.crew import Crew
from disctrack.discrepancy.joint.sharing import Member, Reduced, Reduction
from disctrack.discrepancy.joint.together import TogetherDiagnosis, answer_together
from disctrack.discrepancy.noise import inflation
from disctrack.discrepancy.system import Quantity, Values
from disctrack.errors import AnalysisError
from disctrack.files.json_text import json_text
from disctrack.findings import Kind
from disctrack.track.side_by_side import evenly
from disctrack.trajectory import Trajectory

Item = tuple[Recorded, Mapping[str, str], str]  # recording, its labels, the model


def diagnose_together(
    recordings: Sequence[Recorded],
    model: str = PAPER,
    processes: int = 1,
    progress: Callable[[str], None] = lambda text: None,
    settle: bool = False,
    unread: Mapping[str, str] | None = None,
) -> TogetherDiagnosis:
    """Which effect is missing from the model of all recordings together?

    model : as for `diagnose`
    unread : further recordings that are reported as left out, with the reasons
    processes : that share the recordings; the answer does not depend on their number
    settle : also compute which further recording would answer the open questions
    Raises AnalysisError if fewer than two recordings can be used.
    """
    items = [(recorded, label, model) for recorded, label in zip(recordings, labels_of(recordings), strict=True)]
    described = [(recorded.name, label) for recorded, label, _ in items]
    progress(f"{len(items)} recordings, each alone")
    with Crew(DiscMember, items, processes) as crew:
        answer = answer_together(crew, described, in_common, progress, unread or {})
        return replace(answer, plan=_plan(answer, crew)) if settle else answer


def _plan(answer: TogetherDiagnosis, crew: Crew) -> Plan | None:
    """Further recordings, with disc, surface and cameras of the longest one."""
    system, diagnosis = answer.system, answer.diagnosis
    sharing, after = system.sharing, diagnosis.after
    longest = int(np.argmax(system.weights))
    local = {c.name: c for c in sharing.members[longest].candidates}
    asked = open_questions(diagnosis, [b for b in answer.bounds if b.candidate.name in local])
    known = (question for question in asked if {c.name for c in question} <= local.keys())
    questions = [tuple(local[c.name] for c in question) for question in known]
    if not questions:
        return None
    found, tested = [f.candidate.name for f in diagnosis.found], [c.name for question in questions for c in question]
    planner = Planner(sharing.members, longest, found, tested)
    crew.call("share", [(planner.sharing.own(i, member.base),) for i, member in enumerate(sharing.members)])
    values = [sharing.local_values(i, after.values) for i in range(len(sharing.members))]
    problems = crew.call("reduce", [(at, planner.names(i)) for i, at in enumerate(values)])
    (further,) = crew.call("planned", [(planner, questions, problems, values[longest])], [longest])
    return further if isinstance(further, Plan) else None


def labels_of(recordings: Sequence[Recorded]) -> list[dict[str, str]]:
    """Names of disc, surface, rig and air of every recording, different where these differ."""
    keys = [json_text(r.trajectory.rig) for r in recordings]
    rigs = {key: i + 1 for i, key in enumerate(dict.fromkeys(keys))}
    found = []
    for r, key in zip(recordings, keys, strict=True):
        disc = r.trajectory.disc
        sizes = f"{2e3 * disc.radius:g} x {2e3 * disc.half_thickness:g} mm, {1e3 * disc.mass:g} g"
        labels = {"disc": r.disc or sizes, "surface": r.surface, "rig": f"rig {rigs[key]}"}
        found.append(labels | {"air": f"{_density(r.trajectory):g} kg/m^3"})
    return found


def _density(trajectory: Trajectory) -> float:
    """Density of the air [kg/m^3], rounded: smaller differences are not significant."""
    return float(f"{trajectory.air_density:.3g}")


class DiscMember:
    """One recording of the disc: prepared, fitted alone, then reduced to its information on the shared quantities."""

    def __init__(self, item: Item) -> None:
        """Raises AnalysisError if it cannot be fitted with the others, or is declared wrongly."""
        recorded, self.labels, model = item
        self.name, as_tracked = recorded.name, recorded.trajectory
        # a wrong weight would not show in laws that are proportional to the load
        wrong = [f for f in as_tracked.findings if f.kind == Kind.DENSITY] or wrong_declarations(as_tracked.findings)
        if wrong:
            raise AnalysisError("; ".join(f.sentence for f in wrong))
        trajectory = with_noise(as_tracked, noise_over_stated(as_tracked))  # which sets the weight of the recording
        declared, faults = declared_model(trajectory, model)
        self.system = DiscSystem(trajectory, declared, known=faults)
        self.systematic = find_systematic(self.system)
        if (large := large_faults(as_tracked, self.system, self.systematic)) is not None:
            names = " or ".join(name for guess in large[1] for name in guess)
            raise AnalysisError(f"its dots show a large fault of the measurement ({names}): diagnose it alone")

    def summary(self) -> tuple[Mapping[str, str], Systematic, list[Array]]:
        """Labels, systematic errors, and positions of the dots in each camera [px], for `in_common`."""
        rows = evenly(np.arange(len(self.system.time)), MAX_FRAMES)
        used, places = self.system.used[rows], self.system.observed[rows]
        return self.labels, self.systematic, [places[:, c][used[:, c]] for c in range(2)]

    def with_common(self, systematic: Systematic) -> Member:
        """The member, fitted alone with systematic errors that it shares with others. Raises AnalysisError."""
        self.system = system = self.system.again(systematic=systematic)
        system.remembers = 1  # there may be a hundred recordings
        self.base = fit(system, system.base, system.start())
        if not self.base.converged:
            raise AnalysisError(
                f"the rolling model cannot be fitted to it alone (chi-square {self.base.reduced_chi_square:.3g})"
            )
        disc, n_data = system.disc, int(np.sum(system.weights))
        covariates = {"mass": disc.mass, "radius": disc.radius, "thickness": 2 * disc.half_thickness}
        covariates["density of the air"] = _density(system.trajectory)
        return Member(self.name, system.base, system.candidates, self.base.values, n_data, self.labels, covariates)

    def share(self, own: Sequence[Quantity]) -> None:
        """Declare which quantities of the base are its own; all others are shared."""
        self._reduction = Reduction(self.system, own, self.base.values)

    def reduce(self, values: Values, names: Sequence[str]) -> Reduced | None:
        """Its information on shared quantities."""
        return self._reduction.reduce({**self.system.known, **values}, names)

    def alone(self, values: Values, names: Sequence[str]) -> tuple[Fit, Fit]:
        """The recording fitted alone with these quantities of its candidates, starting at the shared solution.

        In the second fit the standard deviations allow for the autocorrelation of the residuals.
        """
        system = self.system
        known = {q.name: q for c in system.candidates for q in c.quantities}
        extra = [known[n] for n in names if n in known]
        found = fit(system, (*system.base, *extra), self._everything(values))
        growth = inflation(system, found)
        return found, replace(found, covariance=found.covariance * np.outer(growth, growth))

    def planned(
        self, planner: Planner, questions: Sequence[Question], problems: Sequence[Reduced], values: Values
    ) -> Plan:
        """Further recordings like this one.   problems : of all, for `know`.   values : of its shared quantities"""
        planner.know(problems)
        return plan(planner, questions, self.system, self._everything(values))

    def _everything(self, shared: Values) -> dict[str, float]:
        return {**self.base.values, **self._reduction.own_values, **self.system.known, **shared}


def in_common(members: Sequence[tuple[Mapping[str, str], Systematic, list[Array]]]) -> list[Systematic]:
    """Systematic errors that recordings of one rig, or of one disc, share: the largest one found in any of them.

    A short recording may not determine an error that it has.
    """
    common: list[Systematic] = []
    for labels, mine, _ in members:
        rigs = [(s, p) for of, s, p in members if of["rig"] == labels["rig"]]
        lens = max((s for s, _ in rigs), key=lambda s: s.lens_px)
        dots = max((s for s, _ in rigs), key=lambda s: s.dot_px)
        places = tuple(np.concatenate([p[c] for _, p in rigs]) for c in range(2))
        print_m = max(s.print_m for of, s, _ in members if of["disc"] == labels["disc"])
        of_rig = replace(mine, lens_px=lens.lens_px, lens_length_px=lens.lens_length_px, lens_places=places)
        common.append(replace(of_rig, dot_px=dots.dot_px, dot_length_px=dots.dot_length_px, print_m=print_m))
    return common
