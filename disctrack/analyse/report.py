"""The report of an analysis: one HTML file that needs nothing else, and, if wanted, its figures as PNG and PDF."""

from collections.abc import Sequence
from pathlib import Path

import numpy as np

from disctrack.analyse.analysis import Analysis
from disctrack.analyse.figures import all_figures
from disctrack.analyse.power_laws import MODEL_EXPONENTS, Exponent, PowerLaws
from disctrack.analyse.propagation import DerivedSeries
from disctrack.analyse.published import SURFACES, agreement, published_table
from disctrack.files.whole import write_whole
from disctrack.report.figures import Drawn, draw
from disctrack.report.parts import details, gallery, page, paragraph, section, table, tiles, warning
from disctrack.trajectory import FrameStatus
from disctrack.trajectory.file import Provenance

# Below, sin and cos of the nutation are its first terms to 2e-4, and the exponents of the models are those of the law.
ASYMPTOTIC_BELOW = np.radians(1.0)
GOAL_POSITION, GOAL_ROTATION = 2e-6, np.radians(3e-3)  # [m], [rad] error of the lab frame, calibration included
SECTIONS = (
    ("Quality of the measurement", ("03",)),
    ("Motion", ("04", "05", "06", "07", "10", "11")),
    ("Contact", ("08", "09")),
    ("Energy", ("12", "13")),
    ("Scaling laws of the last stage", ("14", "15", "16")),
)


def write_report(
    folder: Path, analysis: Analysis, provenance: Provenance, files: bool = False
) -> tuple[Path, tuple[Path, ...]]:
    """Write report.html, and figures/*.png, *.pdf if `files`; returns the report and those. Raises OutputError."""
    figures = all_figures(analysis)
    written, pictures = draw(folder, figures, ("png", "pdf") if files else ())
    path = folder / "report.html"
    write_whole(path, html_report(analysis, provenance, figures, pictures).encode())
    return path, tuple(written)


def html_report(analysis: Analysis, provenance: Provenance, figures: Sequence[Drawn], pictures: dict[str, str]) -> str:
    """The whole page; `pictures` holds a data URI per figure name."""
    parts = [*_summary(analysis), warning("Before you use the numbers", analysis.warnings)]
    for title, numbers in SECTIONS:
        mine = [drawn for drawn in figures if drawn.name.startswith(numbers)]
        parts.append(section(title, [_tables(title, analysis), gallery(mine, pictures)]))
    parts.append(_method(analysis, provenance))
    return page(f"{provenance.recording}: from the trajectory to the physics", parts)


def _summary(analysis: Analysis) -> list[str]:
    trajectory, motion, laws = analysis.trajectory, analysis.motion, analysis.scaling.laws
    theta = np.degrees(motion.euler[motion.known, 1])
    disc = trajectory.disc
    said = (
        f"A disc of radius {1e3 * disc.radius:g} mm, thickness {2e3 * disc.half_thickness:g} mm and mass "
        f"{1e3 * disc.mass:g} g was filmed by two cameras at {trajectory.frame_rate:g} pairs per second. "
        f"{int(trajectory.measured.sum())} of {len(trajectory)} frames ({np.ptp(trajectory.time):.3f} s) have a pose. "
        + (f"The nutation goes from {theta[0]:.2f} to {theta[-1]:.2f} degrees." if theta.size else "")
    )
    numbers = [
        ("rolls without slip", _onset_tile(analysis)),
        ("energy lost", f"{1e3 * analysis.energy.loss:.4f} mJ" if np.isfinite(analysis.energy.loss) else "not known"),
        ("collapse t_f", f"{laws.t_f:.4f} ± {laws.t_f_sigma:.4f} s" if laws.determined else "not in reach"),
        ("exponent of θ", _plus_minus(laws.n_theta) if laws.determined else "not determined"),
    ]
    return [paragraph(said, "lead"), tiles(numbers), paragraph(_calibration_verdict(analysis))]


def _onset_tile(analysis: Analysis) -> str:
    onset = analysis.contact.onset
    if not np.isfinite(onset.time):
        return "not reached" if np.isfinite(onset.probability) else "not known"
    if onset.time == analysis.motion.time[analysis.motion.known][0]:
        return "from the start"
    return f"from {onset.time:.4f} s"


def _calibration_verdict(analysis: Analysis) -> str:
    """In one sentence, how well the lab frame is known."""
    covariance = analysis.trajectory.calibration_covariance[analysis.trajectory.measured]
    sigma = np.sqrt(np.median(np.diagonal(covariance, axis1=1, axis2=2), axis=0))
    if not np.any(sigma > 0):
        return "Calibration: the rig carries no covariance, so the error that it puts into the lab frame is not known."
    position, rotation = float(sigma[:3].max()), float(sigma[3:].max())
    verdict = "good" if position <= GOAL_POSITION and rotation <= GOAL_ROTATION else "limits the accuracy"
    return (
        f"Calibration: {verdict}. It leaves {1e6 * position:.2f} µm and {1e3 * np.degrees(rotation):.2f} mdeg "
        "(1 σ, worst axis) in the lab frame, the same in all frames; the noise of single frames comes on top."
    )


def _tables(section: str, analysis: Analysis) -> str:
    if section == "Quality of the measurement":
        return _status_table(analysis)
    if section == "Motion":
        return _instants_table(analysis)
    if section == "Scaling laws of the last stage":
        return _exponents_table(analysis) + _windows_table(analysis.scaling.by_window) + _published_tables()
    return ""


def _status_table(analysis: Analysis) -> str:
    status = analysis.trajectory.frame_status
    rows = [(str(int(np.sum(status == state))), state.sentence) for state in FrameStatus if np.any(status == state)]
    return table("Frames by what became of them.", ("frames", "outcome"), rows)


def _instants_table(analysis: Analysis) -> str:
    known = np.flatnonzero(analysis.motion.known)
    if known.size < 3:
        return ""
    frames = known[[0, len(known) // 2, -1]]
    names = (
        "psidot",
        "thetadot",
        "omega_3",
        "omega_z",
        "slip_n",
        "slip_m",
        "force_z",
        "friction_needed",
        "total",
        "power",
    )
    rows = []
    for name in names:
        series = analysis.series(name)
        cells = (_measured(series, frame) for frame in frames)
        rows.append((series.long_name, _on_page(series.unit)[0], *cells))
    times = [f"at {analysis.motion.time[frame]:.3f} s" for frame in frames]
    return table(
        "Some quantities at three instants: value ± σ from noise ± σ from calibration.",
        ("quantity", "unit", *times),
        rows,
    )


# unit in the file: (unit on the page, factor)
_UNITS = {"rad s-1": ("rad/s", 1.0), "m s-1": ("mm/s", 1e3), "J": ("mJ", 1e3), "W": ("mW", 1e3), "1": ("", 1.0)}


def _on_page(unit: str) -> tuple[str, float]:
    return _UNITS.get(unit, (unit, 1.0))


def _measured(series: DerivedSeries, frame: int) -> str:
    """Value with two digits of its noise, then the noise and the calibration's part."""
    factor = _on_page(series.unit)[1]
    value, sigma, common = (factor * float(a[frame]) for a in (series.value, series.sigma, series.sigma_calibration))
    if not np.isfinite(value):
        return "not known"
    scale = sigma if sigma > 0 else abs(value) * 1e-3
    digits = int(np.clip(1 - np.floor(np.log10(max(scale, 1e-9))), 0, 9))
    shown = f"{value:.{digits}f} ± {sigma:.{digits}f}"
    if not common > 0:
        return shown
    return f"{shown} ± {common:.1g}" if common > 1e-3 * sigma else f"{shown} ± 0"


def _plus_minus(exponent: Exponent) -> str:
    return f"{exponent.value:.4f} ± {exponent.sigma:.4f}" if np.isfinite(exponent.value) else "not determined"


def _exponents_table(analysis: Analysis) -> str:
    laws = analysis.scaling.laws
    if not laws.determined:
        return paragraph(f"No exponents are given: {laws.reason}.")
    theta = _largest_nutation(analysis)
    asymptotic = theta <= ASYMPTOTIC_BELOW
    rows = []
    for name, exponent, of_theta in (
        ("energy", laws.n_energy, 1.0),
        ("nutation", laws.n_theta, 1.0),
        ("precession rate", laws.n_psidot, -0.5),
    ):
        agree = [_agreement(exponent, of_theta * n, asymptotic) for _, n in MODEL_EXPONENTS]
        rows.append((name, _plus_minus(exponent), f"{exponent.low:.4f} to {exponent.high:.4f}", *agree))
    first, last = laws.window
    said = (
        f"Window: from {first:.3f} s to {last:.3f} s before t_f = {laws.t_f:.5f} ± {laws.t_f_sigma:.5f} s "
        f"({laws.n_periods:.1f} nutation periods). 5 ms in t_f would move the exponent of θ by "
        f"{5e-3 * laws.n_theta_per_t_f:.3f}. The confidence is that of a power law over this window; how far the law "
        "itself bends shows in the dependence on the window."
    )
    if not asymptotic:
        said += (
            f" The models' exponents hold for a nutation that goes to zero. Here it reaches {np.degrees(theta):.2f} "
            f"degrees, more than {np.degrees(ASYMPTOTIC_BELOW):.0f}: the same law then has another slope, so that "
            "agreement is marked where it is found and disagreement is not."
        )
    header = ("exponent of", "value", "95 % confidence", *(name.split(",")[0] for name, _ in MODEL_EXPONENTS))
    return paragraph(said) + table("Exponents in (t_f - t) and the models that they agree with.", header, rows)


def _agreement(exponent: Exponent, model: float, asymptotic: bool) -> str:
    """A model's exponent and whether the confidence interval holds it; no "no" where the law bends by itself."""
    if exponent.agrees_with(model):
        return f"{model:.3f} yes"
    return f"{model:.3f} no" if asymptotic else f"{model:.3f} as θ → 0"


def _largest_nutation(analysis: Analysis) -> float:
    """In the window of the exponents [rad]."""
    laws, motion = analysis.scaling.laws, analysis.motion
    left = laws.t_f - motion.time
    inside = motion.known & (left >= min(laws.window)) & (left <= max(laws.window))
    return float(motion.euler[inside, 1].max()) if inside.any() else np.inf


def _windows_table(fits: Sequence[PowerLaws]) -> str:
    rows = []
    for fit in fits:
        if fit.determined:
            exponents = (fit.n_energy, fit.n_theta, fit.n_psidot)
            t_f = f"{fit.t_f:.5f} ± {fit.t_f_sigma:.5f}"
            rows.append((f"{fit.window[0]:.3f} to {fit.window[1]:.3f}", *(_plus_minus(e) for e in exponents), t_f))
    if not rows:
        return ""
    return table(
        "As the paper's tables 2 and 3, this recording, for several windows (value ± σ).",
        ("t_f - t (s)", "n_E", "n_θ", "n_ψ̇", "t_f (s)"),
        dict.fromkeys(rows),  # windows longer than the recording repeat each other
    )


def _published_tables() -> str:
    parts = []
    for surface in SURFACES:
        printed = published_table(surface)
        rows = [
            (case, str(trial), *(f"{e:.4f}" for e in exponents), f"{t_f:.3f}")
            for case, trial, exponents, t_f in zip(
                printed.cases, printed.trials, printed.exponents, printed.t_f, strict=True
            )
        ]
        rows.append(("mean, recomputed", "", *(f"{e:.4f}" for e in printed.average), ""))
        rows.append(("mean, as printed", "", *(f"{e:.4f}" for e in printed.printed_average), ""))
        sentences = "; ".join(a.sentence for a in agreement(printed))
        header = ("case", "trial", "n_E", "n_θ", "n_ψ̇", "t_f (s)")
        shown = table(f"Ma et al. 2014, disc on {surface}.", header, rows)
        parts.append(details(f"Published exponents on {surface}", [shown, paragraph(f"{sentences}.")]))
    return "".join(parts)


def _method(analysis: Analysis, provenance: Provenance) -> str:
    motion = analysis.motion
    lengths = ", ".join(f"{1e3 * v:.1f}" for v in np.median(motion.length, axis=0))
    scales = ", ".join(f"{np.sqrt(v):.2f}" for v in motion.noise_scale)
    rows = [
        ("velocities and accelerations", "Gaussian-process regression in moving windows, from the rotation itself"),
        ("length of the process (ms): horizontal, height, tilt, turn", lengths),
        ("scatter found over stated: horizontal, height, tilt, turn", scales),
        ("energy datum", "zero at rest, z = h"),
        ("gravity (m/s²)", f"{motion.gravity:g}"),
        ("software", f"disctrack {provenance.version}"),
        ("inputs, SHA-256", "; ".join(f"{name} {value[:16]}…" for name, value in sorted(provenance.inputs.items()))),
    ]
    return section("How the numbers were made", [table("Method and provenance.", ("what", "how"), rows)])
