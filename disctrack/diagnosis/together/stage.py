"""The stage of the joint diagnosis: trajectory files in; one page, one diagnosis.json and one sentence out."""

import os
from collections.abc import Callable, Sequence
from dataclasses import replace
from pathlib import Path

from disctrack.diagnosis.model_file import PAPER
from disctrack.diagnosis.recorded import Recorded, read_recorded
from disctrack.diagnosis.together.output import as_json, figures, report_of
from disctrack.diagnosis.together.recordings import diagnose_together
from disctrack.errors import AnalysisError, TrajectoryFileError
from disctrack.files.json_text import json_file
from disctrack.files.whole import keep, refuse_existing, refuse_input, write_whole
from disctrack.report.blocks import Report
from disctrack.report.html import write_page
from disctrack.trajectory.file import read_provenance
from disctrack.trajectory.reuse import content_of, hash_of, remember, reusable

FOLDER = "together_diagnosis"


def run_together(
    paths: Sequence[Path],
    output: Path | None = None,
    *,
    model: str = PAPER,
    overwrite: bool = False,
    reuse: bool = False,
    settle: bool = False,
    processes: int = 1,
    progress: Callable[[str], None] = lambda text: None,
) -> Report:
    """Diagnose trajectory files together; write diagnosis.json and diagnosis.html with figures.

    output : folder; by default `together_diagnosis` in the deepest common folder of all files
    settle : also compute which further recordings would answer the open questions
    Files that cannot be read are left out, and reported.
    reuse : an earlier result that is complete and of the same files, model and version
    returns : its report, with the page; `data["unusable"]` are recordings that could not be read or fitted
    Raises TrajectoryFileError if there is no such file, AnalysisError, SceneError, ModelError, OutputError.
    """
    paths = [Path(p) for p in paths]
    for p in paths:
        keep(p)
    whole = [p.resolve() for p in paths]
    if twice := sorted(str(p) for p, q in zip(paths, whole, strict=True) if whole.count(q) > 1):
        raise AnalysisError(f"{twice[0]}: given more than once. Each recording counts once: name each file once.")
    common = Path(os.path.commonpath([p.parent for p in whole]))  # the deepest common folder
    folder = Path(output) if output is not None else common / FOLDER
    report, html = folder / "diagnosis.json", folder / "diagnosis.html"
    progress("reading")
    read, unread = _read(paths)
    if not read:
        raise AnalysisError("; ".join(f"{path}: {reason}" for path, reason in unread.items()))
    contents = [read_provenance(p).fingerprint for p in read]
    origin = hash_of({"model": content_of(model), "plan": settle, "files": contents, "unread": unread})
    if reuse and (earlier := reusable(folder, origin)) is not None:
        return earlier
    refuse_existing(report, overwrite)
    refuse_input(report)
    names = [r.name for r in read.values()]
    recordings = [  # of the same name are named by their files
        replace(r, name=p.resolve().relative_to(common).as_posix()) if names.count(r.name) > 1 else r
        for p, r in read.items()
    ]
    result = diagnose_together(recordings, model, processes=processes, progress=progress, settle=settle, unread=unread)
    document = {"files": [str(p) for p in paths], **as_json(result)}
    summary = replace(report_of(result, figures(result), (html, report)), data=document)
    files = write_page(html, summary, ["png"])
    write_whole(report, json_file(document))
    remember(folder, origin, summary, (report, html, *files))
    return summary


def _read(paths: Sequence[Path]) -> tuple[dict[Path, Recorded], dict[str, str]]:
    """Recordings by file, and why others cannot be read: one broken file does not stop the diagnosis of the rest."""
    read, unread = dict[Path, Recorded](), dict[str, str]()
    for path in paths:
        try:
            read[path] = read_recorded(path)
        except TrajectoryFileError as error:
            if not path.is_file():  # mistyped
                raise
            unread[str(path)] = str(error).removeprefix(f"{path}: ")
    return read, unread
