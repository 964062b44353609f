"""Report of a batch: links to the single reports, comparison of the recordings, and their problems."""

from collections.abc import Iterator, Sequence
from pathlib import Path
from urllib.parse import quote

from disctrack.batch.columns import FALSE_DISCOVERY, FITTED, Fitted, Row, copies, repeats_of
from disctrack.batch.records import FAILED, MEASURED, NOT_MEASURED, SKIPPED
from disctrack.findings import Finding, Kind, Severity, of_kind
from disctrack.frames import CAMERAS
from disctrack.numbers import measured, probability, rounded
from disctrack.report.blocks import Listing, Markup, Report, Section

SAID = {SKIPPED: "measured before"}  # words for a status whose name only suits the running batch


def report_of(
    rows: Sequence[Row], others: Sequence[Finding] = (), together: str = "", files: Sequence[Path] = ()
) -> Report:
    """Report of all recordings of a batch.

    others : findings that do not belong to a single recording
    together : page of the diagnosis of all, relative to that of the batch; "" if there is none
    """
    header = ("recording", "", "status", "pairs", *(f.label for f in FITTED), "rms (px)", "χ²", "diagnosis")
    classes = [row["status"].split()[0] for row in rows]
    data = '<p>All columns: <a href="summary.csv">summary.csv</a>, <a href="summary.json">summary.json</a>.</p>'
    link = f'<p><a href="{together}">What the model lacks, all recordings together</a></p>'
    same = [f"{names}: the same images, one recording for any mean" for names in copies(rows)]
    what = (
        "Values with one standard deviation; a dash where the recording does not determine a number. k_m from the dots "
        "is the only loss of a rolling model fitted to all images; in a diagnosis other losses enter beside it, and so "
        "its k_m differs."
    )
    table = Listing(header, [_cells(row) for row in rows], classes=classes)
    return Report(
        "Batch of recordings",
        _verdict(rows),
        findings=[*_noticed(rows), *of_kind(Kind.OTHER, Severity.WARNING, same), *others],
        blocks=[
            Section("Results", [what, table, Markup(data)]),
            Section("All recordings together", [Markup(link)] if together else ()),
            Section("Repeats", _repeats(rows)),
        ],
        files=files,
    )


def counts(rows: Sequence[Row]) -> dict[str, int]:
    """Number of recordings of each status."""
    return {one: sum(row["status"] == one for row in rows) for one in (MEASURED, SKIPPED, FAILED, NOT_MEASURED)}


def _verdict(rows: Sequence[Row]) -> str:
    total = ", ".join(f"{n} {SAID.get(status, status)}" for status, n in counts(rows).items() if n)
    pairs = sum(row["pairs_measured"] or 0 for row in rows)
    said = f"{_counted(len(rows), 'recording')}: {total}; {_counted(pairs, 'pair')} with a pose."
    diagnosed = [row for row in rows if row["diagnosis"]]
    if not diagnosed:
        return said
    missing = [row for row in diagnosed if row["diagnosis"] != "nothing missing"]
    sure = sum((row["diagnosis_false_discovery"] or 0.0) < FALSE_DISCOVERY for row in missing)
    return (
        f"{said} Something is missing in {len(missing)} of {_counted(len(diagnosed), 'diagnosed recording')}; {sure} "
        f"of these stand at a rate of false discoveries of {FALSE_DISCOVERY:.0%} over the batch."
    )


def _noticed(rows: Sequence[Row]) -> Iterator[Finding]:
    """Reasons of recordings with missing or incomplete results."""
    for row in (row for row in rows if row["reason"]):
        severity = max(Severity.WARNING, Severity[(row["severity"] or "note").upper()])
        severity = Severity.REFUSAL if row["status"] in (FAILED, NOT_MEASURED) else severity
        text = f"{row['recording']} ({row['status']}): {row['reason']}"
        yield Finding(Kind(row["finding"]), severity, text)


def _repeats(rows: Sequence[Row]) -> list[str | Listing]:
    repeats = repeats_of(rows)
    if not repeats:
        return []
    said = (
        "Mean and standard deviation over the recordings of one disc on one surface, from one case as declared. "
        "χ² is their squared spread over the stated variances, per degree of freedom: far above 1, with a small "
        "probability p, they disagree by more than the measurement explains."
    )
    fitted = {f.column: f for f in FITTED}
    cells = [
        (
            row["repeats"],
            fitted[row["quantity"]].label,
            str(row["n"]),
            measured(*(fitted[row["quantity"]].scale * row[key] for key in ("mean", "standard_deviation"))),
            rounded(row["reduced_chi_square"]),
            probability(row["p_value"]),
        )
        for row in repeats
    ]
    header = ("recordings", "", "n", "mean ± standard deviation", "χ²", "p")
    files = '<p>With weighted means: <a href="repeats.csv">repeats.csv</a>.</p>'
    return [said, Listing(header, cells), Markup(files)]


def _counted(n: int, what: str) -> str:
    return f"{n} {what}" if n == 1 else f"{n} {what}s"


def _cells(row: Row) -> list[str]:
    rms = [row[f"reprojection_rms_{camera}_px"] for camera in CAMERAS]
    pages = ("report", "report"), ("diagnosis_report", "diagnosis")
    links = [f'<a href="{quote(row[key])}">{name}</a>' for key, name in pages if row[key]]
    share = row["diagnosis_false_discovery"]
    chance = share is not None and share >= FALSE_DISCOVERY and row["diagnosis"] != "nothing missing"
    return [
        row["recording"],
        Markup(" ".join(links)),
        SAID.get(str(row["status"]), str(row["status"])),
        "" if row["pairs"] is None else f"{row['pairs_measured']} / {row['pairs']}",
        *(_with_sigma(row, fitted) for fitted in FITTED),
        "–" if None in rms else rounded(max(rms)),
        rounded(row["reduced_chi_square"]) or "–",
        f"{row['diagnosis'] or ''}{f' (of as improbable ones {share:.0%} are chance)' if chance else ''}",
    ]


def _with_sigma(row: Row, fitted: Fitted) -> str:
    """A fitted number with its sigma, and the reduced chi-square of its model if it has one."""
    value, sigma = row[fitted.column], row[fitted.sigma]
    if value is None or sigma is None:
        return "–"
    misfit = row[fitted.misfit] if fitted.misfit else None
    return measured(fitted.scale * value, fitted.scale * sigma) + (f" (model: χ² {rounded(misfit)})" if misfit else "")
