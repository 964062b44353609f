"""What was measured in one recording, with sigmas, in SI units: the numbers of its row in the summary."""

import numpy as np

from calibration.kit.arrays import Array
from disctrack.analyse.analysis import Analysis
from disctrack.batch.columns import UNITS, Row
from disctrack.diagnosis import DiscSystem
from disctrack.diagnosis.model_file import declared_model
from disctrack.discrepancy.fit import fit
from disctrack.errors import AnalysisError
from disctrack.frames import CAMERAS, COORDINATES
from disctrack.trajectory import FrameStatus, Trajectory

_K_M = "km.k_m"


def tracked_numbers(trajectory: Trajectory) -> Row:
    """Pairs, misfit in the images and median sigmas; None where unknown."""
    rms = trajectory.reprojection_rms_px
    left_out = (FrameStatus.NOT_PROCESSED, FrameStatus.STILL)
    processed = ~np.isin(trajectory.frame_status, left_out)
    numbers: Row = {
        "pairs": int(processed.sum()),
        "pairs_measured": int(trajectory.measured.sum()),
        "duration_s": _number(np.ptp(trajectory.time[processed])) if processed.any() else None,
    }
    for i, camera in enumerate(CAMERAS):
        seen = rms[np.isfinite(rms[:, i]), i]
        numbers[f"reprojection_rms_{camera}_px"] = _number(np.sqrt(np.mean(seen**2))) if seen.size else None
    numbers["reduced_chi_square"] = _median(trajectory.reduced_chi_square)
    for ending, sigma in (("", trajectory.coordinate_sigma), ("_calibration", trajectory.calibration_sigma)):
        for i, (name, unit) in enumerate(zip(COORDINATES, UNITS, strict=True)):
            numbers[f"{name}_sigma{ending}_{unit}"] = _median(sigma[:, i])
    return numbers


def analysed_numbers(analysis: Analysis) -> Row:
    """Exponents, instant of collapse and energy; `exponents_undetermined` says why there are none."""
    laws, energy = analysis.laws, analysis.energy
    numbers: Row = {}
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


def friction_numbers(trajectory: Trajectory) -> Row:
    """The paper's k_m [m s^2] fitted to the dots of all frames, with the reduced chi-square of that model.

    Where that is far from 1, the model lacks something and k_m takes a part of it: sigma is then larger by its root,
    and no more than a hint. `k_m_undetermined` says why there is no k_m.
    """
    nothing: Row = {"k_m_m_s2": None, "k_m_sigma_m_s2": None, "k_m_reduced_chi_square": None}
    try:
        declared = declared_model(trajectory)
        system = DiscSystem(trajectory, declared.model, candidates=(), known=declared.faults)
        found = fit(system, system.base, system.start())
    except AnalysisError as error:
        return nothing | {"k_m_undetermined": str(error)}
    if not found.converged:
        return nothing | {"k_m_undetermined": "the rolling model with this loss does not fit the motion"}
    misfit = np.sqrt(max(found.reduced_chi_square, 1.0))
    return {
        "k_m_m_s2": _number(found.values[_K_M]),
        "k_m_sigma_m_s2": _number(found.sigma(_K_M) * misfit),
        "k_m_reduced_chi_square": _number(found.reduced_chi_square),
        "k_m_undetermined": "",
    }


def diagnosed_numbers(document: Row) -> Row:
    """Verdict of a diagnosis.json, and the probability of such a gain by chance."""
    return {
        "diagnosis": str(document.get("verdict", "")),
        "diagnosis_sentence": str(document.get("sentence", "")),
        "diagnosis_p_value": (document.get("chance") or {}).get("p_value"),
    }


def _number(value: float) -> float | None:
    return float(value) if np.isfinite(value) else None


def _median(values: Array) -> float | None:
    known = values[np.isfinite(values)]
    return _number(np.median(known)) if known.size else None
