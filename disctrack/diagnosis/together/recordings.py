"""Joint diagnosis of recordings of the rolling disc, and which further one would answer their open questions."""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace

import numpy as np

from calibration.kit.arrays import Array
from calibration.kit.threads import one_blas_thread
from disctrack.diagnosis.disc_system import DiscSystem
from disctrack.diagnosis.large_faults import large_faults
from disctrack.diagnosis.model_file import PAPER, declared_model
from disctrack.diagnosis.plan import Plan, open_questions, plan
from disctrack.diagnosis.recorded import Recorded, wrong_declarations
from disctrack.diagnosis.systematic import MAX_FRAMES, Systematic, find_systematic, noise_over_stated, with_noise
from disctrack.discrepancy.fit import fit, no_fit
from disctrack.discrepancy.joint.sharing import Member, Reduction
from disctrack.discrepancy.joint.side_by_side import side_by_side
from disctrack.discrepancy.joint.together import TogetherDiagnosis, answer_together
from disctrack.errors import AnalysisError
from disctrack.files.json_text import json_text
from disctrack.findings import Kind
from disctrack.track.side_by_side import evenly
from disctrack.trajectory import Trajectory


@one_blas_thread
def diagnose_together(
    recordings: Sequence[Recorded],
    model: str = PAPER,
    threads: int = 1,
    progress: Callable[[str], None] = lambda text: None,
    settle: bool = False,
    unread: Mapping[str, str] | None = None,
) -> TogetherDiagnosis:
    """Which effect is missing from the model of all recordings together?

    model : as for `diagnose`
    unread : further recordings that are reported as left out, with the reasons
    threads : that share the recordings; the answer does not depend on their number
    settle : also compute which further recording would answer the open questions
    Raises AnalysisError if fewer than two recordings can be used.
    """
    described = [(r.name, labels) for r, labels in zip(recordings, labels_of(recordings), strict=True)]
    progress(f"{len(recordings)} recordings, each alone")
    found = side_by_side(_prepared, [(r.trajectory, model) for r in recordings], threads)
    good = [i for i, one in enumerate(found) if isinstance(one, DiscSystem)]
    common = in_common([(described[i][1], found[i]) for i in good])
    each = [(*described[i], found[i], systematic) for i, systematic in zip(good, common, strict=True)]
    for i, member in zip(good, side_by_side(_alone, each, threads), strict=True):
        found[i] = member
    for name, reason in (unread or {}).items():
        described.append((name, {}))
        found.append(AnalysisError(reason))
    answer = answer_together(described, found, threads, progress)
    return replace(answer, plan=_plan(answer)) if settle else answer


def _plan(answer: TogetherDiagnosis) -> Plan | None:
    """Further recordings, with disc, surface and cameras of the longest one."""
    system, diagnosis, after = answer.system, answer.diagnosis, answer.diagnosis.after
    longest = int(np.argmax(system.weights))
    local = {c.name for c in system.members[longest].system.candidates}
    questions = open_questions(diagnosis, [b for b in answer.bounds if b.candidate.name in local])
    questions = tuple(question for question in questions if {c.name for c in question} <= local)
    if not questions:
        return None
    tested = [q for question in questions for c in question for q in c.quantities]
    everything = {q.name: q for q in (*tested, *after.quantities)}
    parts = reversed(system.local[longest].items())  # of a sum of shared quantities the first one is kept
    names = {there: shared for shared, there in parts if shared in everything}
    others = [q for n, q in everything.items() if n not in set(names.values())]
    values = {n: q.null for n, q in everything.items()} | after.values
    known = Reduction(system, others, values).reduce(values, tuple(names.values()))
    if known is None:
        return None
    extra, start = [n for f in diagnosis.found for n in f.candidate.names], system.local_start(longest, after.values)
    fitted = no_fit(system.local_quantities(longest, extra), start)
    of_disc = system.members[longest].system
    # an error where no motion can be planned
    (found,) = side_by_side(plan, [(of_disc, fitted, questions, 1.0, (tuple(names), known[1]))])
    return found if isinstance(found, Plan) else None


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


def _prepared(as_tracked: Trajectory, model: str) -> DiscSystem:
    """The system of a recording, with its own systematic errors.

    Raises AnalysisError if it cannot be fitted with the others, or is declared wrongly.
    """
    # a wrong weight would not show in laws that are proportional to the load
    wrong = [f for f in as_tracked.findings if f.kind == Kind.DENSITY] or wrong_declarations(as_tracked.findings)
    if wrong:
        raise AnalysisError("; ".join(f.sentence for f in wrong))
    trajectory = with_noise(as_tracked, noise_over_stated(as_tracked))  # which sets the weight of the recording
    declared, faults = declared_model(trajectory, model)
    system = DiscSystem(trajectory, declared, known=faults)
    systematic = find_systematic(system)
    if (large := large_faults(as_tracked, system, systematic)) is not None:
        names = " or ".join(name for guess in large[1] for name in guess)
        raise AnalysisError(f"its dots show a large fault of the measurement ({names}): diagnose it alone")
    return system.again(systematic=systematic)


def _alone(name: str, labels: Mapping[str, str], system: DiscSystem, systematic: Systematic) -> Member:
    """The recording, fitted alone with systematic errors that it shares with others. Raises AnalysisError."""
    system = system.again(systematic=systematic)
    base = fit(system, system.base, system.start())
    if not base.converged:
        raise AnalysisError(
            f"the rolling model cannot be fitted to it alone (chi-square {base.reduced_chi_square:.3g})"
        )
    disc, air = system.disc, {"density of the air": _density(system.trajectory)}
    sizes = {"mass": disc.mass, "radius": disc.radius, "thickness": 2 * disc.half_thickness}
    return Member(name, system, base.values, labels, air | sizes)


def in_common(members: Sequence[tuple[Mapping[str, str], DiscSystem]]) -> list[Systematic]:
    """Systematic errors that recordings of one rig, or of one disc, share: the largest one found in any of them.

    A short recording may not determine an error that it has.
    """
    common: list[Systematic] = []
    for labels, system in members:
        rigs = [other for of, other in members if of["rig"] == labels["rig"]]
        lens = max((s.systematic for s in rigs), key=lambda s: s.lens_px)
        dots = max((s.systematic for s in rigs), key=lambda s: s.dot_px)
        common.append(
            replace(
                system.systematic,
                lens_px=lens.lens_px,
                lens_length_px=lens.lens_length_px,
                lens_places=tuple(np.concatenate([_places(s, camera) for s in rigs]) for camera in range(2)),
                dot_px=dots.dot_px,
                dot_length_px=dots.dot_length_px,
                print_m=max(s.systematic.print_m for of, s in members if of["disc"] == labels["disc"]),
            )
        )
    return common


def _places(system: DiscSystem, camera: int) -> Array:
    """Positions (k, 2) of the dots in a camera [px]."""
    rows = evenly(np.arange(len(system.time)), MAX_FRAMES)
    return np.asarray(system.observed[rows, camera][system.used[rows, camera]], float)
