"""`disctrack diagnose`: which effect does the model lack?"""

import argparse
import contextlib
import sys
from pathlib import Path

from disctrack import rolling
from disctrack.commands import INCOMPLETE
from disctrack.commands import _outputs as outputs
from disctrack.diagnosis import run_diagnose
from disctrack.diagnosis.recorded import wrong_declarations
from disctrack.diagnosis.together.stage import run_together
from disctrack.errors import TrajectoryFileError
from disctrack.findings import carried
from disctrack.progress import compiling, steps
from disctrack.recording.readers.blocks import default_threads
from disctrack.report.blocks import Report
from disctrack.trajectory.file import read_findings, trajectory_in
from disctrack.trajectory.reuse import content_of, origin_of, reusable


def run(arguments: argparse.Namespace) -> int:
    """Diagnose; returns the exit code."""
    paths = [trajectory_in(path) for path in arguments.trajectory]
    if len(paths) > 1:
        return _together(paths, arguments)
    path = paths[0]
    folder = arguments.output or path.parent / f"{path.stem}_diagnosis"
    outputs.warn_if_stale(path)
    known = reusable(folder, origin_of(path, {"model": content_of(arguments.model), "plan": arguments.plan}))
    more = arguments.figures and not (folder / "figures").is_dir()
    if known is not None and not (arguments.overwrite or more):
        return outputs.finish(known, arguments, folder, reused=True)
    findings = carried(read_findings(path))
    if wrong_declarations(findings) and not arguments.anyway:
        said = "Not diagnosed: a number is declared wrong, and a missing effect would be read into it."
        then = f"mend it and run again; or `disctrack diagnose {outputs.relative(path)} --anyway`"
        return outputs.finish(Report("", said, findings=findings, then=then), arguments, folder)
    with compiling("the simulation of motions", 30):
        rolling.prepare()
    again = arguments.overwrite or known is not None
    with steps("diagnose"):
        outcome = run_diagnose(
            path, folder, model=arguments.model, overwrite=again, settle=arguments.plan, figures=arguments.figures
        )
    outputs.link_pages_of(path)
    return outputs.finish(outcome.summary, arguments, folder)


def _together(paths: list[Path], arguments: argparse.Namespace) -> int:
    """Diagnose several files jointly."""
    for path in paths:
        with contextlib.suppress(TrajectoryFileError):  # reported below
            outputs.warn_if_stale(path)
    with compiling("the simulation of motions", 30):
        rolling.prepare()
    with steps(f"diagnose {len(paths)} recordings together") as step:
        report = run_together(
            paths,
            arguments.output,
            model=arguments.model,
            overwrite=arguments.overwrite,
            reuse=not arguments.overwrite,
            settle=arguments.plan,
            processes=arguments.jobs or default_threads(),
            progress=step,
        )
    code = outputs.finish(report, arguments, report.files[0].parent)
    if unusable := len(report.data["unusable"]):
        print(f"disctrack: {unusable} recording{'s' * (unusable > 1)} could not be used (see above).", file=sys.stderr)
    return INCOMPLETE if unusable else code
