"""One row of the summary per recording: what was measured, with sigmas, in SI units."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np

from disctrack.analyse import Analysis
from disctrack.diagnosis import DiscSystem
from disctrack.diagnosis.enlarged import declared_model
from disctrack.diagnosis.fit import fit
from disctrack.errors import AnalysisError
from disctrack.frames import CAMERAS, COORDINATES
from disctrack.trajectory import FrameStatus, Trajectory

Numbers = dict[str, Any]

_UNITS = ("m",) * 3 + ("rad",) * 3
_K_M = "km.k_m"


def tracked_numbers(trajectory: Trajectory) -> Numbers:
    """Pairs, misfit in the images and median sigmas; None where unknown."""
    rms = trajectory.reprojection_rms_px
    processed = trajectory.frame_status != FrameStatus.NOT_PROCESSED
    numbers: Numbers = {
        "pairs": int(processed.sum()),
        "pairs_measured": int(trajectory.measured.sum()),
        "duration_s": _number(np.ptp(trajectory.time[processed])) if processed.any() else None,
    }
    for i, camera in enumerate(CAMERAS):
        seen = rms[np.isfinite(rms[:, i]), i]
        numbers[f"reprojection_rms_{camera}_px"] = _number(np.sqrt(np.mean(seen**2))) if seen.size else None
    numbers["reduced_chi_square"] = _median(trajectory.reduced_chi_square)
    for ending, sigma in (("", trajectory.coordinate_sigma), ("_calibration", trajectory.calibration_sigma)):
        for i, (name, unit) in enumerate(zip(COORDINATES, _UNITS, strict=True)):
            numbers[f"{name}_sigma{ending}_{unit}"] = _median(sigma[:, i])
    return numbers


def analysed_numbers(analysis: Analysis) -> Numbers:
    """Exponents, instant of collapse and energy; `exponents_undetermined` says why there are none."""
    laws, energy = analysis.scaling.laws, analysis.energy
    numbers: Numbers = {}
    for name in ("n_energy", "n_theta", "n_psidot"):
        exponent = getattr(laws, name)
        numbers[name] = _number(exponent.value) if laws.determined else None
        numbers[f"{name}_sigma"] = _number(exponent.sigma) if laws.determined else None
    return numbers | {
        "t_f_s": _number(laws.t_f) if laws.determined else None,
        "t_f_sigma_s": _number(laws.t_f_sigma) if laws.determined else None,
        "exponents_undetermined": laws.reason,
        "energy_loss_J": _number(energy.loss),
        "energy_loss_sigma_J": _number(np.hypot(energy.loss_sigma, energy.loss_sigma_calibration)),
    }


def friction_numbers(trajectory: Trajectory) -> Numbers:
    """The paper's k_m [m s^2] fitted to the dots of all frames, with the reduced chi-square of that model.

    Where it is far from 1, the model lacks something, and k_m takes a part of that. `k_m_undetermined` says why there
    is none.
    """
    nothing: Numbers = {"k_m_m_s2": None, "k_m_sigma_m_s2": None, "k_m_reduced_chi_square": None}
    try:
        declared = declared_model(trajectory)
        system = DiscSystem(trajectory, declared.model, candidates=())
        found = fit(system, system.base, system.start(declared.faults))
    except AnalysisError as error:
        return nothing | {"k_m_undetermined": str(error)}
    if not found.converged:
        return nothing | {"k_m_undetermined": "the rolling model with this loss does not fit the motion"}
    return {
        "k_m_m_s2": _number(found.values[_K_M]),
        "k_m_sigma_m_s2": _number(found.sigma(_K_M)),
        "k_m_reduced_chi_square": _number(found.reduced_chi_square),
        "k_m_undetermined": "",
    }


def diagnosed_numbers(document: Mapping[str, Any]) -> Numbers:
    """Verdict of a diagnosis.json."""
    return {"diagnosis": str(document.get("verdict", "")), "diagnosis_sentence": str(document.get("sentence", ""))}


def _number(value: Any) -> float | None:
    return float(value) if np.isfinite(value) else None


def _median(values: Any) -> float | None:
    known = np.asarray(values)[np.isfinite(values)]
    return _number(np.median(known)) if known.size else None


# Every column of the summary in order, and what it means.
COLUMNS: dict[str, str] = {
    "recording": "folder below the batch's, with slashes",
    "name": "as recording.toml says",
    "status": "measured, skipped (done already), failed, or not measured",
    "reason": "why it failed, or what is missing although it was measured",
    "pairs": "image pairs that were to be measured",
    "pairs_measured": "pairs with a pose",
    "duration_s": "from the first of them to the last",
    "k_m_m_s2": "lever arm of the rolling friction per squared precession rate, fitted to the dots [m s^2]",
    "k_m_sigma_m_s2": "its standard deviation",
    "k_m_reduced_chi_square": "of that fit; far from 1, the model lacks something",
    "k_m_undetermined": "why there is no k_m",
    "n_energy": "exponent of the energy in t_f - t",
    "n_energy_sigma": "",
    "n_theta": "exponent of the nutation",
    "n_theta_sigma": "",
    "n_psidot": "exponent of the precession rate",
    "n_psidot_sigma": "",
    "t_f_s": "instant of collapse",
    "t_f_sigma_s": "",
    "exponents_undetermined": "why there are no exponents",
    "energy_loss_J": "from the first frame to the last",
    "energy_loss_sigma_J": "noise and calibration",
    **{f"reprojection_rms_{camera}_px": "observed - projected dots" for camera in CAMERAS},
    "reduced_chi_square": "of the poses, median of the frames",
    **{f"{n}_sigma_{u}": "noise of one frame, median" for n, u in zip(COORDINATES, _UNITS, strict=True)},
    **{
        f"{n}_sigma_calibration_{u}": "from the rig, common to all frames"
        for n, u in zip(COORDINATES, _UNITS, strict=True)
    },
    "diagnosis": "verdict, where a diagnosis was asked for",
    "diagnosis_sentence": "",
    "seconds": "that the measurement took",
    "folder": "of the recording; this and the following paths are relative to the summary's folder",
    "trajectory": "",
    "report": "",
    "diagnosis_report": "",
    "rig": "",
    "input_sha256": "of the images, the rig and their names in the result file",
    "fingerprint": "of inputs, settings and version",
    "version": "of disctrack that measured it",
}
