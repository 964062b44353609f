"""`disctrack diagnose`: which effect does the model lack?"""

import argparse
import contextlib
from pathlib import Path

from disctrack.commands import DONE
from disctrack.commands import _outputs as outputs
from disctrack.diagnosis import run_diagnose
from disctrack.diagnosis.together.stage import run_together
from disctrack.errors import TrajectoryFileError
from disctrack.progress import compiling, stage, steps
from disctrack.recording.readers.blocks import default_threads
from disctrack.rolling import _assembly as assembly
from disctrack.track import run_summary as summary
from disctrack.trajectory.file import trajectory_in
from disctrack.trajectory.reuse import origin_of, remember, reusable


def run(arguments: argparse.Namespace) -> int:
    """Diagnose; returns the exit code."""
    paths = [trajectory_in(path) for path in arguments.trajectory]
    if len(paths) > 1:
        return _together(paths, arguments)
    path = paths[0]
    folder = arguments.output or path.parent / f"{path.stem}_diagnosis"
    outputs.tell_stale(path)
    model = Path(arguments.model)
    told_model = model.read_text(encoding="utf-8") if model.is_file() else arguments.model
    origin = origin_of(path, {"model": told_model} | ({"plan": True} if arguments.plan else {}))
    told = reusable(folder, origin)
    more = arguments.figures and not (folder / "figures").is_dir()
    if told is not None and not (arguments.overwrite or more):
        reused = f"{'reused':<13} {folder}: complete result of the same trajectory, model and version"
        print("\n".join([reused, *told]))
        return DONE
    with compiling("the simulation of motions", 30):
        assembly.prepare()
    with stage("diagnose"):
        outcome = run_diagnose(
            path,
            folder,
            model=arguments.model,
            overwrite=arguments.overwrite or told is not None,
            settle=arguments.plan,
            figures=arguments.figures,
        )
    files = [outputs.relative(file) for file in (path, *outcome.files, *outputs.write_times(folder, "diagnose"))]
    lines = [*outcome.summary, *summary.file_lines(files)]
    remember(folder, origin, lines, outcome.files)
    print("\n".join(lines))
    return DONE


def _together(paths: list[Path], arguments: argparse.Namespace) -> int:
    """One answer for several files."""
    for path in paths:
        with contextlib.suppress(TrajectoryFileError):  # told of below
            outputs.tell_stale(path)
    with compiling("the simulation of motions", 30):
        assembly.prepare()
    with steps(f"diagnose {len(paths)} recordings together") as step:
        outcome = run_together(
            paths,
            arguments.output,
            model=arguments.model,
            overwrite=arguments.overwrite,
            reuse=not arguments.overwrite,
            settle=arguments.plan,
            processes=arguments.jobs or default_threads(),
            progress=step,
        )
    files = [outputs.relative(file) for file in outcome.files]
    print("\n".join([*outcome.summary, *summary.file_lines(files)]))
    unusable = [f"{len(outcome.unusable)} recording(s) could not be used"] if outcome.unusable else []
    return outputs.tell_shortcomings(unusable)
