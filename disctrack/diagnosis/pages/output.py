"""A diagnosis as JSON, and as a group of the trajectory file."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from disctrack.diagnosis.errors import Ahead, Errors
from disctrack.diagnosis.law_library import locked
from disctrack.diagnosis.pages import planned
from disctrack.discrepancy.document import declared_json, document, effect_json, parameters_json
from disctrack.files.json_text import json_text, plain
from disctrack.files.labelled_arrays import Variable
from disctrack.frames import COORDINATES, POSE_COMPONENTS
from disctrack.trajectory.file import write_group

if TYPE_CHECKING:
    from disctrack.diagnosis.answer import DiscDiagnosis, Learned
    from disctrack.diagnosis.free_runs import ModelFreeEvidence

GROUP = "diagnosis"


def _errors(errors: Errors | None, longer: tuple[Ahead, ...] = ()) -> dict[str, Any]:
    if errors is None:
        return {}
    w = errors.whiteness
    by_component = ("ljung_box", "peak_frequency", "peak_p_value", "peak_near")
    tests = {name: dict(zip(POSE_COMPONENTS, plain(getattr(w, name)), strict=True)) for name in by_component}
    plainly = ("reduced_chi_square", "reduced_chi_square_pose", "rms_px", "rms_position_um", "rms_theta_mdeg")
    return {name: getattr(errors, name) for name in plainly} | {
        "held_out": {
            "ratio_to_noise_floor": errors.ratio_to_floor,
            "free_run": [vars(ahead) for ahead in (*errors.ahead, *longer)],
        },
        "whiteness": {"p_value": w.p_value, "peak_frequency_hz": tests.pop("peak_frequency"), **tests},
    }


def _learned(learned: Learned) -> dict[str, Any]:
    law, known = learned.law, learned.course
    course = known and {
        "time_s": known.time, "N_m": known.moment, "sigma_N_m": known.sigma, "misfit_of_form": known.misfit,
    }  # fmt: skip
    return {
        "name": law.candidate.effect,
        "candidate": law.candidate.name,
        "kind": "learned",
        "title": law.candidate.title,
        "source": law.candidate.source,
        "formulas": law.formulas,
        "meaning": law.title,
        "alike": list(law.alike),
        "phase_locked": locked(law),
        "mean_power_W": learned.power,
        "moment_about_contact": {} if course is None else course,
        "parameters": parameters_json(law.candidate.quantities, learned.fit),
        "class": [],
        "score": learned.gain,
        "held_out_gain": learned.held_out_gain,
    }


def as_json(result: DiscDiagnosis, beside: ModelFreeEvidence | None = None) -> dict[str, Any]:
    """All of a diagnosis in JSON's types; the keys are those of diagnosis.json."""
    d = result.diagnosis
    effects = [effect_json(f, d.after) for f in d.found]
    rows, longer, holds = result.system.rows, beside.ahead if beside else (), result.regimes
    found = document(d, result.model, result.sentence) | {
        "notes": list(result.notes),
        "frames": [int(result.system.trajectory.frame[i]) for i in (rows.start, rows.stop - 1)],
        "effects": [*effects, *([_learned(result.learned)] if result.learned else [])],
        "before": _errors(result.before, tuple(b for b, _ in longer)) | {"parameters": declared_json(d.before)},
        "after": _errors(result.after, tuple(a for _, a in longer)) | {"parameters": declared_json(result.after_fit)},
        "chance": vars(d.chance) if d.chance else {},
        "holds": {"first": holds.first and vars(holds.first), "last": holds.last and vars(holds.last)} if holds else {},
        "energy_J": result.energy,
        "energy_before_J": beside.energy_before if beside else {},
        "plan": planned.as_json(result.plan),
    }
    return dict(plain(found))


def write_diagnosis(
    path: Path, result: DiscDiagnosis, beside: ModelFreeEvidence | None, document: dict[str, Any]
) -> None:
    """Add the group `diagnosis` to the trajectory file: residuals before and after, and the whole answer as JSON."""
    system = result.system
    n = len(system.trajectory)
    variables = {}
    for name, fit in (("before", result.diagnosis.before), ("after", result.after_fit)):
        residual, predicted = np.full((2, n, 6), np.nan)
        if result.before is not None:
            whitened = system.pose_residual(fit.values)
            residual[system.rows] = np.where((system.weights >= 6)[:, None], whitened, np.nan)
            predicted[system.rows] = system.poses(fit.values)
        what = f"whitened pose residual {name} the missing effects were added; variance 1 if only noise is left"
        variables[f"residual_{name}"] = Variable(residual, ("time", "pose_component"), "1", what)
        what = f"x, y, z, psi, theta, phi of the model {name}"
        variables[f"q_{name}"] = Variable(predicted, ("time", "coordinate"), "m and rad", what)
    axes = {"coordinate": Variable(np.array(COORDINATES), ("coordinate",), "1", "coordinate")}
    axes["contact_axis"] = Variable(np.array(["n0", "m0", "k"]), ("contact_axis",), "1", "axis of the contact frame")
    if beside is not None and beside.measured is not None:
        from disctrack.diagnosis.free_runs import force_of

        force, sigma = np.full((2, n, 3), np.nan)
        force[system.rows] = beside.measured.force - force_of(system, result.diagnosis.before)
        sigma[system.rows] = beside.measured.force_sigma
        what = "mass times measured acceleration, minus the force of the model before"
        variables["missing_force"] = Variable(force, ("time", "contact_axis"), "N", what)
        variables["missing_force_sigma"] = Variable(sigma, ("time", "contact_axis"), "N", f"standard deviation: {what}")
    if beside is not None and beside.moment is not None:
        axes["probe_time"] = Variable(beside.moment.time, ("probe_time",), "s", "middle of a probe of the moment")
        dims = ("probe_time", "contact_axis")
        what = "contact moment that the model before fails to supply"
        variables["missing_moment"] = Variable(beside.moment.moment, dims, "N m", what)
        variables["missing_moment_sigma"] = Variable(beside.moment.sigma, dims, "N m", f"standard deviation: {what}")
    effects = {effect["name"]: effect for effect in document["effects"]}
    attributes = {**document, "effects": effects, "diagnosis": json_text(document)}
    write_group(path, GROUP, variables, axes=axes, attributes=attributes)
