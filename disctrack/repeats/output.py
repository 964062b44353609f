"""A comparison on paper: one page, its fragment for another page, figures, tables as CSV and JSON."""

import csv
import io
from collections.abc import Iterable, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import numpy as np

from disctrack.files.json_text import json_file, plain
from disctrack.files.whole import write_whole
from disctrack.pages.figures import draw, gallery
from disctrack.pages.html import bullets, page, paragraph, section, table, warning
from disctrack.repeats.averages import Average
from disctrack.repeats.compare import Comparison, ExponentTable, RepeatGroup
from disctrack.repeats.figures import FITTED_SCALES, fitted_figure, group_figures, slug, with_sigma
from disctrack.repeats.runs import FITTED, INDEX, QUANTITIES, AnalysedRun, FittedNumber
from disctrack.repeats.spread import Spread

MOST_ROWS = 2000  # of a table of spread: a person plots it, the figures have every frame


@dataclass(frozen=True)
class Written:
    """What `write` left behind."""

    page: Path  # repeats.html, complete in itself
    fragment: str  # the body of it, for another page that has the same style
    files: tuple[Path, ...]


def write(comparison: Comparison, folder: Path) -> Written:
    """Write repeats.html, figures (PNG and PDF), tables (CSV) and repeats.json. Raises OutputError."""
    folder = Path(folder)
    by_group = [group_figures(group, number) for number, group in enumerate(comparison.groups, 1)]
    fitted = [fitted_figure(table, number) for number, table in enumerate(comparison.tables, 1)]
    drawn = [*(figure for figures in by_group for figure in figures), *(figure for figure in fitted if figure)]
    files, pictures = draw(folder, drawn)
    parts = [_table_section(t, f, pictures) for t, f in zip(comparison.tables, fitted, strict=True)]
    parts += [_group_section(g, f, pictures) for g, f in zip(comparison.groups, by_group, strict=True)]
    fragment = "\n".join([*parts, _left_out(comparison)])
    written = folder / "repeats.html"
    tables = {
        "runs.csv": _csv(_runs_table(comparison)),
        "averages.csv": _csv(_averages_table(comparison)),
        "repeats.json": json_file(as_json(comparison)),
    }
    for number, group in enumerate(comparison.groups, 1):
        if group.spread is not None:
            tables[f"spread_{number:02d}_{slug(group.name)}.csv"] = _csv(_spread_table(group.spread))
    for name, content in tables.items():
        write_whole(folder / name, content)
        files.append(folder / name)
    lead = paragraph(_lead(comparison), "lead")
    write_whole(written, page("Repeats compared", [lead, fragment]).encode())
    return Written(written, fragment, (written, *files))


def _lead(comparison: Comparison) -> str:
    n, several = sum(len(g.runs) for g in comparison.groups), sum(len(g.runs) > 1 for g in comparison.groups)
    groups = len(comparison.groups)
    return (
        f"{n} recordings in {groups} group{'s' * (groups != 1)}, {several} with repeats; "
        f"{len(comparison.left_out)} files could not be compared."
    )


def _table_section(found: ExponentTable, figure: Any, pictures: dict[str, str]) -> str:
    """As the paper's tables 2 and 3, with sigmas."""
    rows = [
        (group, str(trial), run.name, *(_cell(name, run.fitted[name]) for name in FITTED))
        for group, trial, run in found.rows
    ]
    for label, cell in (
        ("mean ± standard error of the scatter", lambda n, a: _two(n, a.mean, a.standard_error)),
        ("weighted mean ± σ", lambda n, a: _two(n, a.weighted, a.sigma)),
        ("χ² / degrees of freedom", lambda n, a: f"{a.chi_square:.3g} / {a.degrees_of_freedom}" if a.n > 1 else ""),
        ("Birge ratio", lambda n, a: f"{a.birge_ratio:.2f}" if a.n > 1 else ""),
    ):
        cells = [cell(n, found.averages[n]) if n in found.averages else "-" for n in FITTED]
        rows.append((label, "", "", *cells))
    sources = sorted({run.k_m_source for _, _, run in found.rows})
    k_m = f"k_m {_K_M_SOURCES[sources[0]]} (10⁻⁸ m s²)"  # one kind of number in one column
    header = ("case", "trial", "recording", "n_E", "n_θ", "n_ψ̇", "t_f (s)", k_m)
    caption = "As tables 2 and 3 of Ma et al. 2014 (value ± σ of one run). t_f is on each recording's own clock."
    verdicts = bullets(f"{name}: {a.verdict}" for name, a in found.averages.items() if a.n > 1)
    said = paragraph(f"k_m: {_k_m_words(sources)}")
    picture = gallery([figure], pictures) if figure else ""
    return section(found.title, [table(caption, header, rows), verdicts, said, picture])


_K_M_SOURCES = {"diagnosis": "of the diagnosis", "energy": "from the energy"}


def _k_m_words(sources: Sequence[str]) -> str:
    if sources == ["diagnosis"]:
        return "of the model that the diagnosis of each run ended with."
    return (
        "the coefficient of M_m = -k_m F_z ψ̇ |ψ̇| that accounts for the whole loss of energy; other losses are in it. "
        "Its σ does not contain the calibration, which runs filmed by one rig share."
    )


def _cell(name: str, item: FittedNumber) -> str:
    return _two(name, item.value, item.sigma)


def _two(name: str, value: float, sigma: float) -> str:
    scale = FITTED_SCALES.get(name, 1.0)
    return with_sigma(scale * value, scale * sigma)


def _group_section(group: RepeatGroup, figures: Sequence[Any], pictures: dict[str, str]) -> str:
    title = f"{group.name}: {len(group.runs)} run{'s' * (len(group.runs) > 1)}"
    parts: list[str] = [warning("Mind", group.remarks)]
    if group.spread is not None:
        parts += [_clock_table(group, group.spread), _parts_table(group.spread), gallery(figures, pictures)]
    elif len(group.runs) == 1:
        parts.append(paragraph("No repeat of this one."))
    return section(title, parts)


def _clock_table(group: RepeatGroup, found: Spread) -> str:
    rows = []
    for i, run in enumerate(group.runs):
        offsets = [f"{QUANTITIES[INDEX[n]].scale * found.offset[i, INDEX[n]]:+.3f}" for n in ("x", "y", "psi", "phi")]
        zero = f"{group.alignment.shift[i]:.5f} ± {group.alignment.sigma[i]:.5f}"
        rows.append((run.name, zero, group.alignment.method[i], *offsets))
    header = ("recording", "time zero (s)", "by", "x (mm)", "y (mm)", "ψ (deg)", "φ (deg)")
    caption = f"On one clock, zero at {group.alignment.zero}; offsets from the mean of the runs."
    return table(caption, header, rows)


def _parts_table(found: Spread) -> str:
    rows = [
        (
            f"{q.symbol} ({q.unit})",
            *(f"{q.scale * v:.3g}" for v in (part.spread, part.noise, part.clock, part.physics)),
            part.verdict,
        )
        for q, part in zip(QUANTITIES, found.parts, strict=True)
    ]
    header = ("coordinate", "spread", "measurement", "clock", "the motion's own", "verdict")
    return table("Standard deviation over the runs, rms over the time that they share.", header, rows)


def _left_out(comparison: Comparison) -> str:
    rows = [(str(item.path), item.reason) for item in comparison.left_out]
    return section("Not compared", [table("Files and reasons.", ("file", "reason"), rows)]) if rows else ""


def as_json(comparison: Comparison) -> dict[str, Any]:
    """The comparison without its curves, of JSON's types; null where there is no number. SI and radians."""
    return plain(
        {
            "groups": [
                {
                    "name": group.name,
                    "runs": [_run_json(run) for run in group.runs],
                    "time_zero": group.alignment.zero,
                    "time_zero_s": group.alignment.shift.tolist(),
                    "time_zero_sigma_s": group.alignment.sigma.tolist(),
                    "aligned_by": list(group.alignment.method),
                    "averages": {name: _average_json(a) for name, a in group.averages.items()},
                    "spread": _spread_json(group.spread),
                    "remarks": list(group.remarks),
                }
                for group in comparison.groups
            ],
            "tables": [
                {
                    "title": table.title,
                    "runs": [str(run.path) for _, _, run in table.rows],
                    "averages": {name: _average_json(a) for name, a in table.averages.items()},
                }
                for table in comparison.tables
            ],
            "left_out": [{"path": str(item.path), "reason": item.reason} for item in comparison.left_out],
        }
    )


def _run_json(run: AnalysedRun) -> dict[str, Any]:
    fitted = {name: asdict(item) for name, item in run.fitted.items()}
    return {"path": str(run.path), "name": run.name, "case": run.case, "surface": run.surface, "fitted": fitted,
            "k_m_source": run.k_m_source}  # fmt: skip


def _average_json(item: Average) -> dict[str, Any]:
    value, sigma = item.best
    return {"value": value, "value_sigma": sigma, **asdict(item), "sigma": item.sigma, "agree": item.agree,
            "verdict": item.verdict}  # fmt: skip


def _spread_json(found: Spread | None) -> dict[str, Any] | None:
    if found is None:
        return None
    return {
        "offsets": {q.name: found.offset[:, i].tolist() for i, q in enumerate(QUANTITIES) if q.own_origin},
        "rms": {p.name: {**asdict(p), "physics": p.physics, "verdict": p.verdict} for p in found.parts},
        "standing_out": list(found.standing_out),
    }


def _runs_table(comparison: Comparison) -> Iterable[Sequence[Any]]:
    yield ["table", "case", "trial", "recording", "surface", *(c for n in FITTED for c in (n, f"{n}_sigma")),
           "k_m_sigma_calibration", "k_m_source", "outlier_in", "file"]  # fmt: skip
    for number, found in enumerate(comparison.tables, 1):
        for i, (group, trial, run) in enumerate(found.rows):
            numbers = [v for n in FITTED for v in (run.fitted[n].value, run.fitted[n].sigma)]
            away = " ".join(name for name, a in found.averages.items() if i in a.outliers)
            yield [number, group, trial, run.name, run.surface, *numbers, run.fitted["k_m"].sigma_calibration,
                   run.k_m_source, away, str(run.path)]  # fmt: skip


def _averages_table(comparison: Comparison) -> Iterable[Sequence[Any]]:
    fields = ("n", "mean", "standard_error", "weighted", "sigma", "sigma_internal", "sigma_external", "chi_square",
              "degrees_of_freedom", "p_value", "birge_ratio", "agree")  # fmt: skip
    yield ["over", "quantity", "value", "value_sigma", *fields]
    sets = [(t.title, t.averages) for t in comparison.tables]
    sets += [(group.name, group.averages) for group in comparison.groups if len(group.runs) > 1]
    for name, averages in sets:
        for quantity, item in averages.items():
            yield [name, quantity, *item.best, *(getattr(item, field) for field in fields)]


def _spread_table(found: Spread) -> Iterable[Sequence[Any]]:
    units = {"mm": "m", "deg": "rad", "rad/s": "rad_per_s", "mJ": "J"}
    kinds = ("mean", "std", "noise", "clock")
    yield ["time_s", "runs", *(f"{q.name}_{kind}_{units[q.unit]}" for q in QUANTITIES for kind in kinds)]
    rows = np.flatnonzero(found.count > 1)
    for k in rows[:: max(1, -(-len(rows) // MOST_ROWS))]:
        yield [
            found.time[k],
            found.count[k],
            *(getattr(found, kind)[k, i] for i in range(len(QUANTITIES)) for kind in kinds),
        ]


def _csv(rows: Iterable[Sequence[Any]]) -> bytes:
    text = io.StringIO()
    writer = csv.writer(text)
    for row in rows:
        writer.writerow([_csv_cell(cell) for cell in row])
    return text.getvalue().encode()


def _csv_cell(cell: Any) -> Any:
    if isinstance(cell, float | np.floating):
        return f"{cell:.9g}" if np.isfinite(cell) else ""
    return cell
