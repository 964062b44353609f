"""A diagnosis as JSON, and as a group of the trajectory file."""

from __future__ import annotations

from dataclasses import asdict
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from calibration.kit.arrays import Array
from disctrack.diagnosis.errors import Ahead, Errors
from disctrack.diagnosis.law_library import locked
from disctrack.diagnosis.plan import Plan
from disctrack.diagnosis.supplement import Supplement
from disctrack.discrepancy.document import declared_json, document, effect_json
from disctrack.discrepancy.fit import Fit
from disctrack.files.json_text import json_text, plain
from disctrack.files.labelled_arrays import Variable
from disctrack.frames import COORDINATES, POSE_COMPONENTS
from disctrack.trajectory.file import write_group

if TYPE_CHECKING:
    from disctrack.diagnosis.answer import DiscDiagnosis, Learned

GROUP = "diagnosis"


def _errors(errors: Errors | None, ahead: list[Ahead]) -> dict[str, Any]:
    if errors is None:
        return {}
    found = asdict(errors)
    tests, ratio = found.pop("whiteness"), found.pop("ratio_to_floor")
    p_value = tests.pop("p_value")
    by_component = {name: dict(zip(POSE_COMPONENTS, plain(values), strict=True)) for name, values in tests.items()}
    return found | {
        "held_out": {"ratio_to_noise_floor": ratio, "free_run": ahead},
        "whiteness": {"p_value": p_value, **by_component},
    }


def _learned(learned: Learned, fit: Fit) -> dict[str, Any]:
    law, course = learned.law, {}
    if (known := learned.course) is not None:
        course = {"time_s": known.time, "N_m": known.values, "sigma_N_m": known.sigma, "misfit_of_form": learned.misfit}
    return effect_json(learned, fit) | {
        "kind": "learned",
        "formulas": law.formulas,
        "meaning": law.title,
        "alike": list(law.alike),
        "phase_locked": locked(law),
        "mean_power_W": learned.power,
        "moment_about_contact": course,
    }


def as_json(result: DiscDiagnosis, more: Supplement | None = None) -> dict[str, Any]:
    """All of a diagnosis in JSON's types; the keys are those of diagnosis.json."""
    d, frame, rows = result.diagnosis, result.system.trajectory.frame, result.system.rows
    ahead = ([run[side] for run in more.ahead] if more else [] for side in range(2))
    before, after = (_errors(e, runs) for e, runs in zip((result.before, result.after), ahead, strict=True))
    before["parameters"], after["parameters"] = declared_json(d.before), declared_json(d.after)
    found = document(d, result.model, result.sentence, before, after)
    found["effects"] += [_learned(result.learned, d.after)] if result.learned else []
    found |= {
        "notes": list(result.notes),
        "frames": [int(frame[rows.start]), int(frame[rows.stop - 1])],
        "chance": vars(d.chance) if d.chance else {},
        "holds": result.holds,
        "energy_J": result.energy,
        "energy_before_J": more.energy_before if more else {},
        "plan": plan_json(result.plan),
    }
    return dict(plain(found))


def plan_json(plan: Plan | None) -> dict[str, Any] | None:
    """Further recordings that would answer the open questions."""
    if plan is None:
        return None
    return {
        "questions": [
            {"effect": effect.name, "alternative": other[0].name if other else None, "now": x}
            for (effect, *other), x in zip(plan.questions, plan.now, strict=True)
        ],
        "recordings": [
            {**vars(r.proposal), "text": r.proposal.text, "lasts_s": r.duration, "answers": list(r.answers)}
            for r in plan.rows
        ],
        "meaning": "answers: sigmas between effect and alternative; without one the standard deviation of the size",
    }


def write_diagnosis(path: Path, result: DiscDiagnosis, more: Supplement | None, document: dict[str, Any]) -> None:
    """Add the group `diagnosis` to the trajectory file: residuals before and after, and the answer as JSON."""
    system, n = result.system, len(result.system.trajectory)
    variables, axes = dict[str, Variable](), {"coordinate": _axis("coordinate", COORDINATES, "coordinate")}
    axes["contact_axis"] = _axis("contact_axis", ("n0", "m0", "k"), "axis of the contact frame")
    for name, fit in (("before", result.diagnosis.before), ("after", result.diagnosis.after)):
        residual, predicted = np.full((2, n, 6), np.nan)
        if result.before is not None:
            whitened = system.pose_residual(fit.values)
            residual[system.rows] = np.where((system.weights >= 6)[:, None], whitened, np.nan)
            predicted[system.rows] = system.poses(fit.values)
        what = f"whitened pose residual {name} the missing effects were added; variance 1 if only noise is left"
        variables[f"residual_{name}"] = Variable(residual, ("time", "pose_component"), "1", what)
        what = f"x, y, z, psi, theta, phi of the model {name}"
        variables[f"q_{name}"] = Variable(predicted, ("time", "coordinate"), "m and rad", what)
    if more is not None and more.force is not None:
        force, sigma = np.full((2, n, 3), np.nan)
        force[system.rows], sigma[system.rows] = more.force.values, more.force.sigma
        what = "mass times measured acceleration, minus the force of the model before"
        variables |= _with_sigma("missing_force", force, sigma, "time", "N", what)
    if more is not None and (missing := more.moment) is not None:
        axes["probe_time"] = Variable(missing.time, ("probe_time",), "s", "middle of a probe of the moment")
        what = "contact moment that the model before fails to supply"
        variables |= _with_sigma("missing_moment", missing.values, missing.sigma, "probe_time", "N m", what)
    effects = {effect["name"]: effect for effect in document["effects"]}
    attributes = {**document, "effects": effects, "diagnosis": json_text(document)}
    write_group(path, GROUP, variables, axes=axes, attributes=attributes)


def _axis(name: str, labels: tuple[str, ...], what: str) -> Variable:
    return Variable(np.array(labels), (name,), "1", what)


def _with_sigma(name: str, values: Array, sigma: Array, over: str, unit: str, what: str) -> dict[str, Variable]:
    dims = (over, "contact_axis")
    of_sigma = Variable(sigma, dims, unit, f"standard deviation: {what}")
    return {name: Variable(values, dims, unit, what), f"{name}_sigma": of_sigma}
