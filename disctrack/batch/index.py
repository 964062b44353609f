"""The page that links the single reports and compares the recordings."""

from __future__ import annotations

from collections.abc import Sequence
from html import escape
from pathlib import Path
from typing import Any
from urllib.parse import quote

from disctrack.batch.columns import LACKS_SOMETHING
from disctrack.batch.reasons import reason_of
from disctrack.files.whole import write_whole

Row = dict[str, Any]


def write_index(path: Path, rows: Sequence[Row], compare: bool) -> str:
    """Write the page; with the comparison of repeats, if that is wanted, into `repeats` beside it.

    returns : why there is no comparison although it was wanted; empty otherwise
    Raises OutputError.
    """
    fragment, problem = _comparison(path.parent, rows) if compare else ("", "")
    write_whole(path, page(rows, fragment).encode())
    return problem


def _comparison(folder: Path, rows: Sequence[Row]) -> tuple[str, str]:
    """The repeats as a part of the page, and what went wrong."""
    trajectories = [folder / row["trajectory"] for row in rows if row["report"]]
    if len(trajectories) < 2:
        return "", ""
    from disctrack import repeats  # draws figures: only where they are wanted
    from disctrack.analyse.report import STYLE

    try:
        written = repeats.write(repeats.compare(trajectories), folder / "repeats")
    except Exception as error:  # the single results are worth more than their comparison
        return "", f"the repeats could not be compared: {reason_of(error)}"
    return f"<style>{STYLE}</style>{written.fragment}", ""


def page(rows: Sequence[Row], fragment: str = "") -> str:
    """HTML that needs no other file but the reports that it links. fragment : HTML to end with"""
    done = [row for row in rows if row["pairs_measured"] is not None]
    pairs = sum(row["pairs_measured"] for row in done)
    said = (
        f"{len(rows)} recordings, {len(done)} of them measured, {pairs} pairs with a pose. Values with one standard "
        "deviation; a dash where the recording does not determine a number."
    )
    return (
        '<!DOCTYPE html><html lang="en"><head><meta charset="utf-8"><title>Batch of recordings</title>'
        f'<meta name="viewport" content="width=device-width, initial-scale=1"><style>{_STYLE}</style></head>'
        f"<body><main><h1>Batch of recordings</h1><p>{escape(said)}</p>{_problems(rows)}{_table(rows)}"
        '<p>All columns: <a href="summary.csv">summary.csv</a>, <a href="summary.json">summary.json</a>.</p>'
        f"{fragment}</main></body></html>\n"
    )


def _problems(rows: Sequence[Row]) -> str:
    items = "".join(
        f"<li><b>{escape(row['recording'])}</b> ({escape(row['status'])}): {escape(row['reason'])}</li>"
        for row in rows
        if row["reason"]
    )
    return f"<div class=warn><b>Not as it should be</b><ul>{items}</ul></div>" if items else ""


def _table(rows: Sequence[Row]) -> str:
    header = ("recording", "status", "pairs", "k_m (10⁻⁸ m s²)", "n_E", "n_θ", "n_ψ̇", "t_f (s)", "rms (px)", "χ²", "")
    head = "".join(f"<th>{escape(cell)}</th>" for cell in header)
    body = "".join(f"<tr class={row['status'].split()[0]}>{_cells(row)}</tr>" for row in rows)
    return f'<div class="scroll card"><table><thead><tr>{head}</tr></thead><tbody>{body}</tbody></table></div>'


def _cells(row: Row) -> str:
    rms = [row[f"reprojection_rms_{camera}_px"] for camera in ("left", "right")]
    pairs = "" if row["pairs"] is None else f"{row['pairs_measured']} / {row['pairs']}"
    cells = [
        escape(row["recording"]),
        escape(row["status"]),
        pairs,
        _friction(row),
        *(_plus_minus(row[n], row[f"{n}_sigma"]) for n in ("n_energy", "n_theta", "n_psidot")),
        _plus_minus(row["t_f_s"], row["t_f_sigma_s"], digits=5),
        "–" if None in rms else f"{max(rms):.4f}",
        "–" if row["reduced_chi_square"] is None else f"{row['reduced_chi_square']:.2f}",
        " ".join(_link(row[key], text) for key, text in (("report", "report"), ("diagnosis_report", "diagnosis"))),
    ]
    return "".join(f"<td>{cell}</td>" for cell in cells)


def _friction(row: Row) -> str:
    """With the chi-square of its model where that says that the number is not the whole story."""
    shown, misfit = _plus_minus(row["k_m_m_s2"], row["k_m_sigma_m_s2"], 1e8), row["k_m_reduced_chi_square"]
    return shown if misfit is None or misfit <= LACKS_SOMETHING else f"{shown} (model: χ² {misfit:.3g})"


def _plus_minus(value: float | None, sigma: float | None, factor: float = 1.0, digits: int = 4) -> str:
    if value is None or sigma is None:
        return "–"
    return f"{factor * value:.{digits}f} ± {factor * sigma:.{digits}f}"


def _link(target: str | None, text: str) -> str:
    return f'<a href="{quote(target)}">{escape(text)}</a>' if target else ""


_STYLE = """
:root{color:#1d2733;background:#f5f7f9;font:16px/1.55 system-ui,-apple-system,"Segoe UI",Roboto,sans-serif}
body{margin:0}main{max-width:1400px;margin:0 auto;padding:2rem 1.5rem 4rem}
h1{font-size:1.7rem;margin:.2rem 0 1rem}h2{font-size:1.25rem;margin:1.6rem 0 .6rem}
.warn{background:#fff6e5;border:1px solid #e6c27a;border-radius:10px;padding:.9rem 1.2rem;margin:1.2rem 0}
.warn ul{margin:.4rem 0 0;padding-left:1.2rem;overflow-wrap:anywhere}
.scroll{overflow-x:auto}.card{background:#fff;border:1px solid #dfe5ea;border-radius:10px;padding:.6rem 1rem}
table{border-collapse:collapse;font-size:.82rem}
th,td{text-align:left;padding:.3rem .7rem .3rem 0;border-bottom:1px solid #e8edf1;white-space:nowrap;
font-variant-numeric:tabular-nums}
th{color:#5c6a77;font-weight:600}a{color:#1f6f8b}tr.failed td,tr.not td{color:#a3462f}
figure{margin:1rem 0}figure img{max-width:100%}figcaption{color:#3c4a57;font-size:.88rem}
"""
