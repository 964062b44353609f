"""Columns of the summary, and mean and spread of the fitted numbers over recordings that repeat one experiment.

As tables 2 and 3 of Ma et al. (2014); in addition, the spread is compared with the uncertainty of the measurement.
"""

from collections.abc import Sequence
from typing import Any, NamedTuple

import numpy as np
from scipy.special import gammaincc

from disctrack.frames import CAMERAS, COORDINATES
from disctrack.recording.declaration import Recording

Row = dict[str, Any]  # column -> value in JSON types, None if not known

UNITS = dict(zip(COORDINATES, ("m",) * 3 + ("rad",) * 3, strict=True))  # by coordinate

PATHS = ("trajectory", "report", "diagnosis_report")  # columns with paths of files among a recording's results

FALSE_DISCOVERY = 0.05  # accepted rate of false discoveries among the recordings with a missing effect

# Columns of the summary in order, and their meanings.
COLUMNS: dict[str, str] = {
    "recording": "folder below the batch's, with slashes",
    "name": "as recording.toml says",
    "repeats": "common to recordings that repeat one experiment: case, surface and disc as declared",
    "status": "measured, skipped (done already), failed, or not measured",
    "reason": "why it failed, or which of its results are missing or doubtful",
    "severity": "of the gravest finding: note, warning, or doubt (numbers may be wrong beyond their sigmas)",
    "finding": "its kind",
    "pairs": "image pairs to be measured, without the rest before and after the motion",
    "pairs_measured": "pairs with a pose",
    "duration_s": "from the first of these pairs to the last",
    "k_m_m_s2": "lever arm of the rolling friction per squared precession rate, fitted to the dots [m s^2]",
    "k_m_sigma_m_s2": "its standard deviation, multiplied by the root of the next column if that exceeds 1",
    "k_m_reduced_chi_square": "of that fit; far from 1, an effect is missing in the model and k_m is biased by it",
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
    **{f"{n}_sigma_{u}": "noise of one frame, median" for n, u in UNITS.items()},
    **{f"{n}_sigma_calibration_{u}": "from the rig, common to all frames" for n, u in UNITS.items()},
    "diagnosis": "verdict, if a diagnosis was requested",
    "diagnosis_sentence": "",
    "diagnosis_p_value": "probability that noise alone produces so large a decrease of chi-square",
    "diagnosis_false_discovery": "rate of false discoveries among the recordings with this or a smaller p value",
    "seconds": "duration of the measurement",
    "processor_seconds": "processor time of the measurement, all threads",
    "folder": "of the recording; this and the following paths are relative to the summary's folder",
    "trajectory": "",
    "report": "",
    "diagnosis_report": "",
    "rig": "",
    "input_sha256": "of the images, the rig and their names in the result file",
    "fingerprint": "of inputs, settings and version",
    "version": "of the disctrack that measured it",
}


class Fitted(NamedTuple):
    """A number that a recording determines, and its form on the page."""

    column: str
    sigma: str  # column of its standard deviation
    label: str
    scale: float = 1.0  # on the page
    misfit: str = ""  # column of the reduced chi-square of its model
    repeated: bool = True  # is expected to be equal in recordings of one experiment


# t_f is not compared: it depends on the instant at which the cameras were started.
FITTED = (
    Fitted("k_m_m_s2", "k_m_sigma_m_s2", "k_m from the dots (10⁻⁸ m s²)", 1e8, "k_m_reduced_chi_square"),
    Fitted("n_energy", "n_energy_sigma", "n_E"),
    Fitted("n_theta", "n_theta_sigma", "n_θ"),
    Fitted("n_psidot", "n_psidot_sigma", "n_ψ̇"),
    Fitted("t_f_s", "t_f_sigma_s", "t_f (s)", repeated=False),
)


def copies(rows: Sequence[Row]) -> list[str]:
    """Names "a, b" of recordings with the same images and rig: in means, one recording counts as several."""
    alike: dict[str, list[str]] = {}
    for row in rows:
        if row["input_sha256"]:
            alike.setdefault(row["input_sha256"], []).append(row["recording"])
    return [", ".join(names) for names in alike.values() if len(names) > 1]


# Columns of the statistics of one number over one group, and their meanings.
REPEATS: dict[str, str] = {
    "repeats": "common to the recordings: case, surface and disc as declared",
    "quantity": "a column of the recordings",
    "n": "recordings that determine it; recordings of the same images count once",
    "mean": "unweighted",
    "standard_deviation": "over the recordings, n - 1 in the denominator",
    "weighted_mean": "weights 1 / sigma^2",
    "weighted_mean_sigma": "from the stated sigmas",
    "reduced_chi_square": "squared spread over stated variance, n - 1 degrees of freedom; far above 1, they disagree",
    "p_value": "probability of a larger chi-square if all measure the same number with their stated sigmas",
}


def group_of(recording: Recording) -> str:
    """Case and surface if declared, and the disc: recordings that agree in these repeat one experiment."""
    declared, disc = recording.declared, recording.disc
    sizes = f"disc of {1e3 * disc.radius:g} x {2e3 * disc.half_thickness:g} mm, {1e3 * disc.mass:g} g"
    labels = (declared.get("case"), declared.get("surface"), declared.get("disc", {}).get("name"), sizes)
    return ", ".join(str(label) for label in labels if label)


def repeats_of(rows: Sequence[Row]) -> list[Row]:
    """Rows of REPEATS, one for each number that two or more recordings of a group determine."""
    # the first of each input
    different = {row["input_sha256"]: row for row in reversed(rows) if row["repeats"]}.values()
    found = []
    for group in sorted({row["repeats"] for row in different}):
        members = [row for row in different if row["repeats"] == group]
        for fitted in (fitted for fitted in FITTED if fitted.repeated):
            known = [row for row in members if row[fitted.column] is not None and row[fitted.sigma]]
            found += [_spread(group, fitted, known)] if len(known) > 1 else []
    return found


def _spread(group: str, fitted: Fitted, known: Sequence[Row]) -> Row:
    value, sigma = (np.array([row[name] for row in known], float) for name in (fitted.column, fitted.sigma))
    n, weight = len(known), sigma**-2
    mean = np.sum(weight * value) / weight.sum()
    chi_square = np.sum(weight * (value - mean) ** 2)
    return {
        "repeats": group,
        "quantity": fitted.column,
        "n": n,
        "mean": float(value.mean()),
        "standard_deviation": float(value.std(ddof=1)),
        "weighted_mean": float(mean),
        "weighted_mean_sigma": float(weight.sum() ** -0.5),
        "reduced_chi_square": float(chi_square / (n - 1)),
        "p_value": float(gammaincc((n - 1) / 2, chi_square / 2)),
    }
