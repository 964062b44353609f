"""What was measured in one recording, with sigmas, in SI units: the numbers of its row in the summary.

NaN where a number is not known; a record has it as None.
"""

import numpy as np

from calibration.kit.arrays import Array
from disctrack.analyse.analysis import Analysis
from disctrack.analyse.power_laws import PowerLaws
from disctrack.batch.columns import UNITS, Row
from disctrack.diagnosis import DiscSystem
from disctrack.diagnosis.model_file import declared_model
from disctrack.discrepancy.fit import fit
from disctrack.errors import AnalysisError
from disctrack.frames import CAMERAS, COORDINATES
from disctrack.trajectory import Trajectory

_K_M = "km.k_m"


def tracked_numbers(trajectory: Trajectory) -> Row:
    """Pairs, misfit in the images and median sigmas."""
    looked_for = trajectory.looked_for
    numbers: Row = {
        "pairs": int(looked_for.sum()),
        "pairs_measured": int(trajectory.measured.sum()),
        "duration_s": np.ptp(trajectory.time[looked_for]) if looked_for.any() else None,
        "reduced_chi_square": _median(trajectory.reduced_chi_square),
    }
    for camera, rms in zip(CAMERAS, trajectory.reprojection_rms_px.T, strict=True):
        seen = rms[np.isfinite(rms)]
        numbers[f"reprojection_rms_{camera}_px"] = np.sqrt(np.mean(seen**2)) if seen.size else None
    for ending, sigma in (("", trajectory.coordinate_sigma), ("_calibration", trajectory.calibration_sigma)):
        for name, unit, of_frames in zip(COORDINATES, UNITS, sigma.T, strict=True):
            numbers[f"{name}_sigma{ending}_{unit}"] = _median(of_frames)
    return numbers


def analysed_numbers(analysis: Analysis) -> Row:
    """Exponents, instant of collapse and energy; `exponents_undetermined` says why there are none."""
    energy, laws = analysis.energy, analysis.laws if analysis.laws.determined else PowerLaws()
    numbers: Row = {
        "t_f_s": laws.t_f,
        "t_f_sigma_s": laws.t_f_sigma,
        "exponents_undetermined": analysis.laws.reason,
        "energy_loss_J": energy.loss,
        "energy_loss_sigma_J": np.hypot(energy.loss_sigma, energy.loss_sigma_calibration),
    }
    for name in ("n_energy", "n_theta", "n_psidot"):
        numbers |= {name: getattr(laws, name).value, f"{name}_sigma": getattr(laws, name).sigma}
    return numbers


def friction_numbers(trajectory: Trajectory) -> Row:
    """The paper's k_m [m s^2] fitted to the dots of all frames, with the reduced chi-square of that model.

    Where that is far from 1, the model lacks something and k_m takes a part of it: sigma is then larger by its root,
    and no more than a hint. `k_m_undetermined` says why there is no k_m.
    """
    try:
        declared = declared_model(trajectory)
        system = DiscSystem(trajectory, declared.model, candidates=(), known=declared.faults)
        found = fit(system, system.base, system.start())
    except AnalysisError as error:
        return {"k_m_undetermined": str(error)}
    if not found.converged:
        return {"k_m_undetermined": "the rolling model with this loss does not fit the motion"}
    return {
        "k_m_m_s2": found.values[_K_M],
        "k_m_sigma_m_s2": found.sigma(_K_M) * np.sqrt(max(found.reduced_chi_square, 1.0)),
        "k_m_reduced_chi_square": found.reduced_chi_square,
        "k_m_undetermined": "",
    }


def diagnosed_numbers(document: Row) -> Row:
    """Verdict of a diagnosis.json, and the probability of such a gain by chance."""
    return {
        "diagnosis": str(document.get("verdict", "")),
        "diagnosis_sentence": str(document.get("sentence", "")),
        "diagnosis_p_value": (document.get("chance") or {}).get("p_value"),
    }


def _median(values: Array) -> float | None:
    known = values[np.isfinite(values)]
    return float(np.median(known)) if known.size else None
