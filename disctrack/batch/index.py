"""The page that links the single reports and compares the recordings."""

from collections.abc import Sequence
from pathlib import Path
from typing import Any
from urllib.parse import quote

from disctrack.batch.columns import FALSE_DISCOVERY, LACKS_SOMETHING, copies
from disctrack.batch.reasons import reason_of
from disctrack.batch.records import SKIPPED
from disctrack.batch.together import FOLDER
from disctrack.files.whole import write_whole
from disctrack.pages.html import Markup, page, paragraph, section, table, text, warning

Row = dict[str, Any]
SAID = {SKIPPED: "measured before"}  # on a page, which is read long after the batch that found it done


def write_index(path: Path, rows: Sequence[Row], compare: bool) -> str:
    """Write the page; with the comparison of repeats, if that is wanted, into `repeats` beside it.

    returns : why there is no comparison although it was wanted; empty otherwise
    Raises OutputError.
    """
    fragment, problem = _comparison(path.parent, rows) if compare else ("", "")
    if (path.parent / FOLDER / "diagnosis.html").is_file():
        link = f'<p><a href="{FOLDER}/diagnosis.html">What the model lacks, all recordings together</a></p>'
        fragment = section("All recordings together", [link]) + fragment
    write_whole(path, index_page(rows, fragment).encode())
    return problem


def _comparison(folder: Path, rows: Sequence[Row]) -> tuple[str, str]:
    """The repeats as a part of the page, and what went wrong."""
    trajectories = [folder / row["trajectory"] for row in rows if row["report"]]
    if len(trajectories) < 2:
        return "", ""
    from disctrack import repeats  # draws figures: only where they are wanted

    try:
        written = repeats.write(repeats.compare(trajectories), folder / "repeats")
    except Exception as error:  # the single results are worth more than their comparison
        return "", f"the repeats could not be compared: {reason_of(error)}"
    return written.fragment, ""


def index_page(rows: Sequence[Row], fragment: str = "") -> str:
    """HTML that needs no other file but the reports that it links. fragment : HTML to end with"""
    done = [row for row in rows if row["pairs_measured"] is not None]
    pairs = sum(row["pairs_measured"] for row in done)
    said = (
        f"{_counted(len(rows), 'recording')}, {len(done)} of them measured, {_counted(pairs, 'pair')} with a pose. "
        "Values with one standard deviation; a dash where the recording does not determine a number. k_m from the "
        "dots is the only loss of a rolling model fitted to all images; where repeats are compared, k_m accounts "
        "for the whole loss of energy, or that of the diagnosis: other losses enter these in other ways, and so they "
        "differ."
    )
    files = '<p>All columns: <a href="summary.csv">summary.csv</a>, <a href="summary.json">summary.json</a>.</p>'
    problems = [
        Markup(f"<b>{text(r['recording'])}</b> ({text(r['status'])}): {text(r['reason'])}") for r in rows if r["reason"]
    ]
    problems += [text(f"{names}: the same images, one recording for any mean") for names in copies(rows)]
    diagnosed = [row for row in rows if row["diagnosis"]]
    missing = [row for row in diagnosed if row["diagnosis"] != "nothing missing"]
    if diagnosed:
        sure = sum((row["diagnosis_false_discovery"] or 0.0) < FALSE_DISCOVERY for row in missing)
        said += (
            f" Something is missing in {len(missing)} of {_counted(len(diagnosed), 'diagnosed recording')}; {sure} of "
            f"these stand at a rate of false discoveries of {FALSE_DISCOVERY:.0%} over the batch."
        )
    header = (
        "recording",
        "",
        "status",
        "pairs",
        "k_m from the dots (10⁻⁸ m s²)",
        "n_E",
        "n_θ",
        "n_ψ̇",
        "t_f (s)",
        "rms (px)",
        "χ²",
    )
    results = table("", header, [_cells(row) for row in rows], [row["status"].split()[0] for row in rows])
    return page(
        "Batch of recordings",
        [paragraph(said), warning("Not as it should be", problems), section("Results", [results, files]), fragment],
    )


def _counted(n: int, what: str) -> str:
    return f"{n} {what}" if n == 1 else f"{n} {what}s"


def _cells(row: Row) -> list[str]:
    rms = [row[f"reprojection_rms_{camera}_px"] for camera in ("left", "right")]
    pairs = "" if row["pairs"] is None else f"{row['pairs_measured']} / {row['pairs']}"
    return [
        row["recording"],
        Markup(
            " ".join(_link(row[key], name) for key, name in (("report", "report"), ("diagnosis_report", "diagnosis")))
        ),
        SAID.get(row["status"], row["status"]),
        pairs,
        _friction(row),
        *(_plus_minus(row[n], row[f"{n}_sigma"]) for n in ("n_energy", "n_theta", "n_psidot")),
        _plus_minus(row["t_f_s"], row["t_f_sigma_s"], digits=5),
        "–" if None in rms else f"{max(rms):.4f}",
        "–" if row["reduced_chi_square"] is None else f"{row['reduced_chi_square']:.2f}",
    ]


def _friction(row: Row) -> str:
    """With the chi-square of its model where that says that the number is not the whole story."""
    shown, misfit = _plus_minus(row["k_m_m_s2"], row["k_m_sigma_m_s2"], 1e8), row["k_m_reduced_chi_square"]
    return shown if misfit is None or misfit <= LACKS_SOMETHING else f"{shown} (model: χ² {misfit:.3g})"


def _plus_minus(value: float | None, sigma: float | None, factor: float = 1.0, digits: int = 4) -> str:
    if value is None or sigma is None:
        return "–"
    return f"{factor * value:.{digits}f} ± {factor * sigma:.{digits}f}"


def _link(target: str | None, name: str) -> str:
    return f'<a href="{quote(target)}">{name}</a>' if target else ""
