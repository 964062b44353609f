"""The report of an analysis: one HTML file that needs nothing else, and its figures as PNG and PDF."""

from __future__ import annotations

import base64
import io
from collections.abc import Iterable, Sequence
from html import escape
from pathlib import Path

import numpy as np
from matplotlib import rc_context
from matplotlib.backends.backend_agg import FigureCanvasAgg
from numpy.typing import NDArray

from disctrack.analyse.analysis import Analysis
from disctrack.analyse.figures import Drawn, all_figures
from disctrack.analyse.power_laws import MODEL_EXPONENTS, Exponent, PowerLaws
from disctrack.analyse.propagation import Series
from disctrack.files.trajectory_file import Provenance
from disctrack.files.whole import whole_file, write_whole
from disctrack.published import SURFACES, agreement, published_table
from disctrack.trajectory import FrameStatus

Array = NDArray[np.float64]

PNG_DPI = 150
GOAL_POSITION, GOAL_ROTATION = 2e-6, np.radians(3e-3)  # [m], [rad] error of the lab frame, calibration included
SECTIONS = (
    ("Quality of the measurement", ("03",)),
    ("Motion", ("04", "05", "06", "07", "10", "11")),
    ("Contact", ("08", "09")),
    ("Energy", ("12", "13")),
    ("Scaling laws of the last stage", ("14", "15", "16")),
)


def write_report(folder: Path, analysis: Analysis, provenance: Provenance) -> tuple[Path, tuple[Path, ...]]:
    """Write report.html and figures/*.png, *.pdf; returns the report and the figures. Raises OutputError."""
    figures = all_figures(analysis)
    written, pictures = draw(folder, figures)
    path = folder / "report.html"
    write_whole(path, html_report(analysis, provenance, figures, pictures).encode())
    return path, tuple(written)


def draw(folder: Path, figures: Sequence[Drawn]) -> tuple[list[Path], dict[str, str]]:
    """Write figures/*.png, *.pdf; returns them, and a data URI per figure's name for a page. Raises OutputError."""
    written: list[Path] = []
    pictures: dict[str, str] = {}
    with rc_context({"font.size": 10, "svg.fonttype": "path", "svg.hashsalt": "disctrack", "mathtext.fontset": "cm"}):
        for drawn in figures:
            FigureCanvasAgg(drawn.figure)
            drawn.figure.draw_without_rendering()
            drawn.figure.set_layout_engine("none")  # laid out once, for all formats
            written += _save(folder / "figures", drawn)
            pictures[drawn.name] = _inline(drawn)
    return written, pictures


def _save(folder: Path, drawn: Drawn) -> list[Path]:
    paths = []
    for kind in ("png", "pdf"):
        path = folder / f"{drawn.name}.{kind}"
        with whole_file(path) as part:
            drawn.figure.savefig(
                part, format=kind, dpi=PNG_DPI, metadata={"CreationDate": None} if kind == "pdf" else None
            )
        paths.append(path)
    return paths


def _inline(drawn: Drawn) -> str:
    """The figure as a data URI: vector graphics, or a bitmap where thousands of points would make those larger."""
    buffer = io.BytesIO()
    drawn.figure.savefig(buffer, format="svg", metadata={"Date": None})
    kind, content = "svg+xml", buffer.getvalue()
    if len(content) > 400_000:
        buffer = io.BytesIO()
        drawn.figure.savefig(buffer, format="png", dpi=PNG_DPI)
        kind, content = "png", buffer.getvalue()
    return f"data:image/{kind};base64,{base64.b64encode(content).decode()}"


def html_report(analysis: Analysis, provenance: Provenance, figures: Sequence[Drawn], pictures: dict[str, str]) -> str:
    """The whole page; `pictures` holds a data URI per figure name."""
    parts = [_head(provenance), _summary(analysis, provenance), _warnings(analysis.warnings)]
    for title, numbers in SECTIONS:
        mine = [drawn for drawn in figures if drawn.name.startswith(numbers)]
        tables = _tables(title, analysis)
        if mine or tables:
            parts.append(f"<section><h2>{escape(title)}</h2>{tables}{gallery(mine, pictures)}</section>")
    parts.append(_method(analysis, provenance))
    return "\n".join(parts) + "\n</main></body></html>\n"


def _head(provenance: Provenance) -> str:
    title = escape(f"{provenance.recording}: from the trajectory to the physics")
    return (
        f'<!DOCTYPE html><html lang="en"><head><meta charset="utf-8"><title>{title}</title>'
        f'<meta name="viewport" content="width=device-width, initial-scale=1"><style>{STYLE}</style></head>'
        f"<body><main><h1>{title}</h1>"
    )


def _summary(analysis: Analysis, provenance: Provenance) -> str:
    trajectory, motion, laws = analysis.trajectory, analysis.motion, analysis.scaling.laws
    theta = np.degrees(motion.euler[motion.known, 1])
    disc = trajectory.disc
    said = (
        f"A disc of radius {1e3 * disc.radius:g} mm, thickness {2e3 * disc.half_thickness:g} mm and mass "
        f"{1e3 * disc.mass:g} g was filmed by two cameras at {trajectory.frame_rate:g} pairs per second. "
        f"{int(trajectory.measured.sum())} of {len(trajectory)} frames ({np.ptp(trajectory.time):.3f} s) have a pose. "
        + (f"The nutation goes from {theta[0]:.2f} to {theta[-1]:.2f} degrees." if theta.size else "")
    )
    tiles = [
        ("rolls without slip", _onset_tile(analysis)),
        ("energy lost", f"{1e3 * analysis.energy.loss:.4f} mJ" if np.isfinite(analysis.energy.loss) else "not known"),
        ("collapse t_f", f"{laws.t_f:.4f} ± {laws.t_f_sigma:.4f} s" if laws.determined else "not in reach"),
        ("exponent of θ", _plus_minus(laws.n_theta) if laws.determined else "not determined"),
    ]
    boxes = "".join(f"<div class=tile><b>{escape(value)}</b><span>{escape(name)}</span></div>" for name, value in tiles)
    return (
        f"<p class=lead>{escape(said)}</p><div class=tiles>{boxes}</div><p>{escape(_calibration_verdict(analysis))}</p>"
    )


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


def _warnings(warnings: Iterable[str]) -> str:
    items = "".join(f"<li>{escape(text)}</li>" for text in warnings)
    return f"<div class=warn><b>Before you use the numbers</b><ul>{items}</ul></div>" if items else ""


def gallery(figures: Sequence[Drawn], pictures: dict[str, str]) -> str:
    """Figures with their captions; `pictures` holds a data URI per figure's name."""
    items = "".join(
        f'<figure><img src="{pictures[drawn.name]}" alt="{escape(drawn.title)}">'
        f"<figcaption><b>{escape(drawn.title)}.</b> {escape(drawn.caption)}</figcaption></figure>"
        for drawn in figures
    )
    return f"<div class=gallery>{items}</div>" if items else ""


def _tables(section: str, analysis: Analysis) -> str:
    if section == "Quality of the measurement":
        return _status_table(analysis)
    if section == "Motion":
        return _instants_table(analysis)
    if section == "Scaling laws of the last stage":
        return _exponents_table(analysis) + _windows_table(analysis.scaling.by_window) + _published_tables()
    return ""


def html_table(caption: str, header: Sequence[str], rows: Iterable[Sequence[str]]) -> str:
    """A table with caption; cells are text."""
    head = "".join(f"<th>{escape(cell)}</th>" for cell in header)
    body = "".join("<tr>" + "".join(f"<td>{escape(cell)}</td>" for cell in row) + "</tr>" for row in rows)
    return (
        f"<div class=scroll><table><caption>{escape(caption)}</caption><thead><tr>{head}</tr></thead>"
        f"<tbody>{body}</tbody></table></div>"
    )


def _status_table(analysis: Analysis) -> str:
    status = analysis.trajectory.frame_status
    rows = [(str(int(np.sum(status == state))), state.sentence) for state in FrameStatus if np.any(status == state)]
    return html_table("Frames by what became of them.", ("frames", "outcome"), rows)


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
    return html_table(
        "Some quantities at three instants: value ± σ from noise ± σ from calibration.",
        ("quantity", "unit", *times),
        rows,
    )


# unit in the file: (unit on the page, factor)
_UNITS = {"rad s-1": ("rad/s", 1.0), "m s-1": ("mm/s", 1e3), "J": ("mJ", 1e3), "W": ("mW", 1e3), "1": ("", 1.0)}


def _on_page(unit: str) -> tuple[str, float]:
    return _UNITS.get(unit, (unit, 1.0))


def _measured(series: Series, frame: int) -> str:
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
        return f"<p>No exponents are given: {escape(laws.reason)}.</p>"
    rows = []
    for name, exponent, of_theta in (
        ("energy", laws.n_energy, 1.0),
        ("nutation", laws.n_theta, 1.0),
        ("precession rate", laws.n_psidot, -0.5),
    ):
        agree = [
            f"{of_theta * n:.3f} {'yes' if exponent.agrees_with(of_theta * n) else 'no'}" for _, n in MODEL_EXPONENTS
        ]
        rows.append((name, _plus_minus(exponent), f"{exponent.low:.4f} to {exponent.high:.4f}", *agree))
    first, last = laws.window
    said = (
        f"Window: from {first:.3f} s to {last:.3f} s before t_f = {laws.t_f:.5f} ± {laws.t_f_sigma:.5f} s "
        f"({laws.n_periods:.1f} nutation periods). 5 ms in t_f would move the exponent of θ by "
        f"{5e-3 * laws.n_theta_per_t_f:.3f}. The confidence is that of a power law over this window; how far the law "
        "itself bends shows in the dependence on the window."
    )
    header = ("exponent of", "value", "95 % confidence", *(name.split(",")[0] for name, _ in MODEL_EXPONENTS))
    return f"<p>{escape(said)}</p>" + html_table(
        "Exponents in (t_f - t) and the models that they agree with.", header, rows
    )


def _windows_table(fits: Sequence[PowerLaws]) -> str:
    rows = []
    for fit in fits:
        if fit.determined:
            exponents = (fit.n_energy, fit.n_theta, fit.n_psidot)
            t_f = f"{fit.t_f:.5f} ± {fit.t_f_sigma:.5f}"
            rows.append((f"{fit.window[0]:.3f} to {fit.window[1]:.3f}", *(_plus_minus(e) for e in exponents), t_f))
    if not rows:
        return ""
    return html_table(
        "As the paper's tables 2 and 3, this recording, for several windows (value ± σ).",
        ("t_f - t (s)", "n_E", "n_θ", "n_ψ̇", "t_f (s)"),
        dict.fromkeys(rows),  # windows longer than the recording repeat each other
    )


def _published_tables() -> str:
    parts = []
    for surface in SURFACES:
        table = published_table(surface)
        rows = [
            (case, str(trial), *(f"{e:.4f}" for e in exponents), f"{t_f:.3f}")
            for case, trial, exponents, t_f in zip(table.cases, table.trials, table.exponents, table.t_f, strict=True)
        ]
        rows.append(("mean, recomputed", "", *(f"{e:.4f}" for e in table.average), ""))
        rows.append(("mean, as printed", "", *(f"{e:.4f}" for e in table.printed_average), ""))
        sentences = "; ".join(a.sentence for a in agreement(table))
        parts.append(
            f"<details><summary>Published exponents on {surface}</summary>"
            + html_table(f"Ma et al. 2014, disc on {surface}.", ("case", "trial", "n_E", "n_θ", "n_ψ̇", "t_f (s)"), rows)
            + f"<p>{escape(sentences)}.</p></details>"
        )
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
    return (
        "<section><h2>How the numbers were made</h2>"
        + html_table("Method and provenance.", ("what", "how"), rows)
        + "</section>"
    )


STYLE = """
:root{color:#1d2733;background:#f5f7f9;font:16px/1.55 system-ui,-apple-system,"Segoe UI",Roboto,sans-serif}
body{margin:0}main{max-width:1180px;margin:0 auto;padding:2rem 1.5rem 4rem}
h1{font-size:1.7rem;line-height:1.25;margin:.2rem 0 1rem}
h2{font-size:1.25rem;margin:0 0 .8rem}
section{background:#fff;border:1px solid #dfe5ea;border-radius:10px;padding:1.3rem 1.5rem;margin:1.4rem 0}
.lead{font-size:1.05rem;max-width:60rem}
.tiles{display:grid;grid-template-columns:repeat(auto-fit,minmax(210px,1fr));gap:.9rem;margin:1.2rem 0}
.tile{background:#fff;border:1px solid #dfe5ea;border-radius:10px;padding:.8rem 1rem}
.tile b{display:block;font-size:1.15rem}.tile span{color:#5c6a77;font-size:.88rem}
.warn{background:#fff6e5;border:1px solid #e6c27a;border-radius:10px;padding:.9rem 1.2rem;margin:1.2rem 0}
.warn ul{margin:.4rem 0 0;padding-left:1.2rem}
.gallery{columns:2 420px;column-gap:1.6rem}
figure{margin:0 0 1.3rem;break-inside:avoid}
figure img{width:100%;height:auto;display:block}
figcaption{color:#3c4a57;font-size:.88rem;line-height:1.45;margin-top:.35rem}
.scroll{overflow-x:auto}table{border-collapse:collapse;font-size:.88rem;margin:.6rem 0 1rem}
caption{text-align:left;color:#5c6a77;padding-bottom:.35rem}
th,td{text-align:left;padding:.28rem .9rem .28rem 0;border-bottom:1px solid #e8edf1;font-variant-numeric:tabular-nums;
white-space:nowrap}
th{color:#5c6a77;font-weight:600}details{margin:.6rem 0}summary{cursor:pointer;color:#1f6f8b}
@media print{section{break-inside:avoid;border:0}:root{background:#fff}}
"""
