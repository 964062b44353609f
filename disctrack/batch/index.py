"""The page that links the single reports and compares the recordings."""

from collections.abc import Sequence
from urllib.parse import quote

from disctrack.batch.columns import FALSE_DISCOVERY, LACKS_SOMETHING, Row, copies
from disctrack.batch.records import SKIPPED
from disctrack.findings import Kind, Severity, of_kind
from disctrack.report.blocks import Listing, Markup, Report, Section, Text
from disctrack.report.html import page
from disctrack.report.numbers import measured, rounded

SAID = {SKIPPED: "measured before"}  # on a page, which is read long after the batch that found it done
_FITTED = {
    "k_m_m_s2": "k_m from the dots (10⁻⁸ m s²)",
    "n_energy": "n_E",
    "n_theta": "n_θ",
    "n_psidot": "n_ψ̇",
}


def index_page(rows: Sequence[Row], repeats: Sequence[Row] = (), together: str = "") -> str:
    """HTML that needs no other file but the reports that it links.

    repeats : as `repeats_of` gives them; together : page of the diagnosis of all, where there is one
    """
    problems = [f"{r['recording']} ({r['status']}): {r['reason']}" for r in rows if r["reason"]]
    problems += [f"{names}: the same images, one recording for any mean" for names in copies(rows)]
    header = ("recording", "", "status", "pairs", *_FITTED.values(), "t_f (s)", "rms (px)", "χ²")
    classes = [row["status"].split()[0] for row in rows]
    files = '<p>All columns: <a href="summary.csv">summary.csv</a>, <a href="summary.json">summary.json</a>.</p>'
    link = f'<p><a href="{together}">What the model lacks, all recordings together</a></p>'
    return page(
        Report(
            "Batch of recordings",
            _said(rows),
            findings=of_kind(Kind.OTHER, Severity.WARNING, problems),
            blocks=[
                Section("Results", [Listing(header, [_cells(row) for row in rows], classes=classes), _html(files)]),
                Section("All recordings together", [_html(link)] if together else ()),
                Section("Repeats", _repeats(repeats) if repeats else ()),
            ],
        ),
        {},
    )


def _html(content: str) -> Text:
    return Text(Markup(content))


def _said(rows: Sequence[Row]) -> str:
    done = [row for row in rows if row["pairs_measured"] is not None]
    pairs = sum(row["pairs_measured"] for row in done)
    said = (
        f"{_counted(len(rows), 'recording')}, {len(done)} of them measured, {_counted(pairs, 'pair')} with a pose. "
        "Values with one standard deviation; a dash where the recording does not determine a number. k_m from the "
        "dots is the only loss of a rolling model fitted to all images; in a diagnosis other losses enter beside it, "
        "and so its k_m differs."
    )
    diagnosed = [row for row in rows if row["diagnosis"]]
    if not diagnosed:
        return said
    missing = [row for row in diagnosed if row["diagnosis"] != "nothing missing"]
    sure = sum((row["diagnosis_false_discovery"] or 0.0) < FALSE_DISCOVERY for row in missing)
    return (
        f"{said} Something is missing in {len(missing)} of {_counted(len(diagnosed), 'diagnosed recording')}; {sure} "
        f"of these stand at a rate of false discoveries of {FALSE_DISCOVERY:.0%} over the batch."
    )


def _repeats(repeats: Sequence[Row]) -> list[Text | Listing]:
    said = (
        "Mean and standard deviation over the recordings of one disc on one surface, from one case as declared. "
        "χ² is their squared spread over the stated variances, per degree of freedom: far above 1, with a small "
        "probability p, they disagree by more than the measurement explains."
    )
    cells = [
        (
            row["repeats"],
            _FITTED[row["quantity"]],
            str(row["n"]),
            measured(*(_scale(row["quantity"]) * row[key] for key in ("mean", "standard_deviation"))),
            rounded(row["reduced_chi_square"]),
            rounded(row["p_value"], 2),
        )
        for row in repeats
    ]
    header = ("recordings", "", "n", "mean ± standard deviation", "χ²", "p")
    files = '<p>With weighted means: <a href="repeats.csv">repeats.csv</a>.</p>'
    return [Text(said), Listing(header, cells), _html(files)]


def _scale(quantity: str) -> float:
    return 1e8 if quantity == "k_m_m_s2" else 1.0


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
        SAID.get(str(row["status"]), str(row["status"])),
        pairs,
        _friction(row),
        *(_plus_minus(row[n], row[f"{n}_sigma"]) for n in ("n_energy", "n_theta", "n_psidot")),
        _plus_minus(row["t_f_s"], row["t_f_sigma_s"]),
        "–" if None in rms else rounded(max(rms)),
        "–" if row["reduced_chi_square"] is None else f"{row['reduced_chi_square']:.2f}",
    ]


def _friction(row: Row) -> str:
    """With the chi-square of its model where that says that the number is not the whole story."""
    shown, misfit = _plus_minus(row["k_m_m_s2"], row["k_m_sigma_m_s2"], 1e8), row["k_m_reduced_chi_square"]
    return shown if misfit is None or misfit <= LACKS_SOMETHING else f"{shown} (model: χ² {rounded(misfit)})"


def _plus_minus(value: float | None, sigma: float | None, factor: float = 1.0) -> str:
    return "–" if value is None or sigma is None else measured(factor * value, factor * sigma)


def _link(target: str | None, name: str) -> str:
    return f'<a href="{quote(target)}">{name}</a>' if target else ""
