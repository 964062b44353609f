"""The stage: trajectory files in; one page, one diagnosis.json and one sentence out."""

import os
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

from disctrack.diagnosis.model_file import PAPER
from disctrack.diagnosis.together.discs import DiscsTogether, diagnose_together
from disctrack.diagnosis.together.recordings import Recorded, read_recorded
from disctrack.errors import AnalysisError, TrajectoryFileError
from disctrack.files.inputs import keep, refuse_input
from disctrack.files.json_text import json_file
from disctrack.files.whole import write_whole
from disctrack.report.blocks import Report
from disctrack.report.html import write_page
from disctrack.trajectory.file import read_setup
from disctrack.trajectory.reuse import hash_of, refuse_other, remember, reusable

FOLDER = "together_diagnosis"


@dataclass(frozen=True)
class TogetherOutcome:
    """What `run_together` did."""

    result: DiscsTogether | None  # None where an earlier result of the same files was complete
    files: tuple[Path, ...]
    summary: Report
    unusable: tuple[str, ...] = ()  # recordings that could not be read, or not be fitted with the others


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
) -> TogetherOutcome:
    """Diagnose trajectory files together; write diagnosis.json and diagnosis.html with figures.

    output : folder; without it `together_diagnosis` in the deepest folder that holds all files
    settle : also compute which further recordings would settle what is left open
    Files that cannot be read are left out, and told of.
    reuse : an earlier result that is complete and of the same files, model and version
    Raises TrajectoryFileError where there is no such file, AnalysisError, SceneError, ModelError, OutputError.
    """
    from disctrack.diagnosis.together.output import as_json, figures, report_of

    paths = [Path(p) for p in paths]
    for p in paths:
        keep(p)
    twice = sorted({str(p) for p in paths if sum(p.resolve() == q.resolve() for q in paths) > 1})
    if twice:
        raise AnalysisError(f"{twice[0]}: given more than once. A recording speaks once: name each file once.")
    folder = Path(output) if output is not None else common_folder(paths) / FOLDER
    report = folder / "diagnosis.json"
    known = Path(model).read_text(encoding="utf-8") if Path(model).is_file() else model
    progress("reading")
    read, unread = _read(paths)
    if not read:
        raise AnalysisError("; ".join(f"{path}: {reason}" for path, reason in unread.items()))
    made_from = {"model": known, "plan": settle, "files": [read_setup(p).fingerprint for p in read], "unread": unread}
    origin = hash_of(made_from)
    known_report = reusable(folder, origin) if reuse else None
    if known_report is not None:
        return TogetherOutcome(None, (report, folder / "diagnosis.html"), known_report, known_report.data["unusable"])
    refuse_other(report, overwrite)
    refuse_input(report)
    recordings = _told_apart(list(read.values()), list(read))
    result = diagnose_together(recordings, model, processes=processes, progress=progress, settle=settle, unread=unread)
    html = folder / "diagnosis.html"
    document = {"files": [str(p) for p in paths], **as_json(result)}
    whole = replace(report_of(result, figures(result), (html, report)), data=document)
    files = write_page(html, whole, ["png"])
    write_whole(report, json_file(document))
    remember(folder, origin, whole, (report, html, *files))
    return TogetherOutcome(result, (report, html, *files), whole, result.unusable)


def _read(paths: Sequence[Path]) -> tuple[dict[Path, Recorded], dict[str, str]]:
    """Recordings by their files, and why others cannot be read: one spoilt file is no reason to lose the rest."""
    read, unread = dict[Path, Recorded](), dict[str, str]()
    for path in paths:
        try:
            read[path] = read_recorded(path)
        except TrajectoryFileError as error:
            if not path.is_file():  # mistyped
                raise
            unread[str(path)] = str(error).removeprefix(f"{path}: ")
    return read, unread


def common_folder(paths: Sequence[Path]) -> Path:
    """The deepest folder that holds all files."""
    return Path(os.path.commonpath([p.resolve().parent for p in paths]))


def _told_apart(recordings: Sequence[Recorded], paths: Sequence[Path]) -> list[Recorded]:
    """Recordings of one name are called after their files."""
    names = [r.name for r in recordings]
    base = common_folder(paths)
    return [
        replace(r, name=p.resolve().relative_to(base).as_posix()) if names.count(r.name) > 1 else r
        for r, p in zip(recordings, paths, strict=True)
    ]
