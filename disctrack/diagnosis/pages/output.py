"""A diagnosis as JSON, as a group of the trajectory file, and as lines for people."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from disctrack.diagnosis.errors import Ahead, Errors
from disctrack.diagnosis.law_library import locked
from disctrack.diagnosis.pages import planned
from disctrack.diagnosis.pages.words import UNFOLLOWED
from disctrack.diagnosis.plan import Proposed
from disctrack.discrepancy.document import (
    declared_json,
    effect_json,
    explanations_json,
    parameters_json,
    tried_json,
)
from disctrack.files.json_text import json_text, plain
from disctrack.files.labelled_arrays import Variable
from disctrack.frames import COORDINATES, POSE_COMPONENTS
from disctrack.trajectory.file import write_group

if TYPE_CHECKING:
    from disctrack.diagnosis.answer import DiscDiagnosis, Learned
    from disctrack.diagnosis.form_misfit import LawCourse
    from disctrack.diagnosis.free_runs import ModelFreeEvidence

GROUP = "diagnosis"


def _separation(separation: Proposed | None) -> dict[str, Any] | None:
    """The recording that would separate two effects; None where none of those looked at can be made."""
    if separation is None:
        return None
    return {
        "theta_deg": separation.proposal.theta_deg,
        "omega3_rad_s": separation.proposal.omega3,
        "duration_s": separation.duration,
        "sigmas": separation.answers[0],
    }


def _errors(errors: Errors | None, longer: tuple[Ahead, ...] = ()) -> dict[str, Any] | None:
    if errors is None:
        return None
    w = errors.whiteness
    return {
        "reduced_chi_square": errors.reduced_chi_square,
        "reduced_chi_square_pose": errors.reduced_chi_square_pose,
        "rms_px": errors.rms_px,
        "rms_position_um": errors.position_um,
        "rms_theta_mdeg": errors.theta_mdeg,
        "held_out": {
            "ratio_to_noise_floor": errors.ratio_to_floor,
            "free_run": [
                {
                    "horizon_s": a.horizon,
                    "theta_deg": a.theta_deg,
                    "psi_deg": a.psi_deg,
                    "position_mm": a.position_mm,
                    "noise_theta_deg": a.noise_theta_deg,
                    "noise_psi_deg": a.noise_psi_deg,
                    "noise_position_mm": a.noise_position_mm,
                }
                for a in (*errors.ahead, *longer)
            ],
        },
        "whiteness": {
            "ljung_box": dict(zip(POSE_COMPONENTS, w.ljung_box.tolist(), strict=True)),
            "p_value": w.p_value,
            "peak_frequency_hz": dict(zip(POSE_COMPONENTS, w.peak_frequency.tolist(), strict=True)),
            "peak_p_value": dict(zip(POSE_COMPONENTS, w.peak_p_value.tolist(), strict=True)),
            "peak_near": dict(zip(POSE_COMPONENTS, w.peak_near, strict=True)),
        },
    }


def _learned(learned: Learned) -> dict[str, Any]:
    law = learned.law
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
        "moment_about_contact": _course(learned.course),
        "parameters": parameters_json(law.candidate.quantities, learned.fit),
        "class": [],
        "score": learned.gain,
        "held_out_gain": learned.held_out_gain,
    }


def _course(course: LawCourse | None) -> dict[str, Any]:
    """The moment of all laws about the contact, with what the learned law's form may be off by."""
    if course is None:
        return {}
    return {
        "time_s": course.time.tolist(),
        "N_m": course.moment.tolist(),
        "sigma_N_m": course.sigma.tolist(),
        "misfit_of_form": course.misfit,
    }


def as_json(result: DiscDiagnosis, beside: ModelFreeEvidence | None = None) -> dict[str, Any]:
    """All of a diagnosis in JSON's types; the keys are those of diagnosis.json."""
    diagnosis = result.diagnosis
    effects = []
    for f in diagnosis.found:
        apart = result.separated_by.get(f.candidate.name, {})
        effects.append(effect_json(f, diagnosis.after, {name: _separation(s) for name, s in apart.items()}))
    rows, longer = result.system.rows, beside.ahead if beside else ()
    document = {
        "verdict": diagnosis.verdict,
        "sentence": result.sentence,
        "reason": diagnosis.reason,
        "model": result.model,
        "notes": list(result.notes),
        "frames": [int(result.system.trajectory.frame[i]) for i in (rows.start, rows.stop - 1)],
        "effects": [*effects, *([_learned(result.learned)] if result.learned else [])],
        "before": (_errors(result.before, tuple(b for b, _ in longer)) or {})
        | {"parameters": declared_json(diagnosis.before)},
        "after": (_errors(result.after, tuple(a for _, a in longer)) or {})
        | {"parameters": declared_json(result.after_fit)},
        "noise_variance_over_stated": diagnosis.noise,
        "chance": vars(diagnosis.chance) if diagnosis.chance else {},
        "holds": {
            name: None if span is None else vars(span)
            for name, span in (("first", result.regimes.first), ("last", result.regimes.last))
        }
        if result.regimes
        else {},
        "energy_J": result.energy,
        "energy_before_J": beside.energy_before if beside else {},
        "explanations": explanations_json(diagnosis),
        "tried": [tried_json(t) for t in diagnosis.tried],
        "plan": planned.as_json(result.plan),
        "settings": vars(diagnosis.settings),
    }
    return dict(plain(document))


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


def lines(result: DiscDiagnosis, beside: ModelFreeEvidence | None = None) -> list[str]:
    """Some lines for the terminal."""
    before, after = result.before, result.after
    found = [f"{'verdict':<13} {result.diagnosis.verdict}", f"{'':<13} {result.sentence}"]
    found += [f"{'note':<13} {text}" for text in result.notes]
    if before is None or after is None:
        return found
    found += [
        f"{'significance':<13} {f.candidate.name}: "
        + (
            f"chi-square rises by {f.gain:.4g} without it (noise alone: {f.threshold:.3g}); gain on held-out data "
            f"{f.held_out_gain:.4g}"
            if np.isfinite(f.gain)
            else UNFOLLOWED
        )
        for f in result.diagnosis.found
    ]
    if (by_chance := result.diagnosis.chance) is not None:
        found.append(
            f"{'chance':<13} noise alone would let some effect gain as much as the best one does with p = "
            f"{by_chance.p_value:.2g} ({by_chance.tests:.0f} independent ones looked at)"
        )
    found.append(
        f"{'chi-square':<13} {before.reduced_chi_square:.4g} -> {after.reduced_chi_square:.4g} per degree of freedom; "
        f"{before.rms_px:.4f} -> {after.rms_px:.4f} px rms"
    )
    found.append(f"{'free run':<13} {before.ratio_to_floor:.4g} -> {after.ratio_to_floor:.4g} times the noise floor")
    for a, b in (*zip(before.ahead, after.ahead, strict=True), *(beside.ahead if beside else ())):
        found.append(
            f"{'':<13} {a.horizon:g} s ahead: theta {a.theta_deg:.3g} -> {b.theta_deg:.3g} deg, psi {a.psi_deg:.3g} -> "
            f"{b.psi_deg:.3g} deg, position {a.position_mm:.3g} -> {b.position_mm:.3g} mm"
        )
    return found if result.plan is None else [*found, *planned.lines(result.plan)]
