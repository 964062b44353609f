"""`disctrack validate`: poses and diagnosis put to the test on recordings with known truth."""

import argparse
import shlex
import sys
import time
from collections.abc import Callable, Iterator, Sequence

from disctrack.commands import DONE, FAILED
from disctrack.files.whole import make_folder
from disctrack.validate import accuracy, diagnoses
from disctrack.validate.rendered import ideal_case, imperfect_case, render_and_measure, scene_of
from disctrack.validate.tables import Case, Outcome, Validation, measure_all, write_into, write_validation

FIRST_SEED = {"poses": 2014, "diagnosis": 1}
# static poses, frames of either stretch of rolling, all recordings together; a recording has at least FEWEST of each
FULL, QUICK, FEWEST = (96, 90, 90), (40, 24, 24), 12


def run(arguments: argparse.Namespace) -> int:
    """Validate, write, print the verdict; exit code 1 if a check failed."""
    make_folder(arguments.output)  # a place that cannot be written to should be known before the work
    validation = _validation(arguments)
    print(validation.headline if validation.name == "validation" else validation.markdown())
    files = write_validation(arguments.output, validation)
    if arguments.write is not None:
        write_into(arguments.write, validation, shlex.join(["disctrack", *sys.argv[1:]]))
        files.append(arguments.write)
    print(f"Written: {', '.join(map(str, files))}")
    for line in validation.complaints:
        print(f"disctrack: validation: {line}", file=sys.stderr)
    return FAILED if validation.complaints else DONE


def _validation(a: argparse.Namespace) -> Validation:
    first = FIRST_SEED["poses" if a.diagnosis is None else "diagnosis"] if a.seed is None else a.seed
    if a.diagnosis is not None:
        seeds = range(first, first + a.seeds)
        hidden = list(diagnoses.hidden_cases(a.diagnosis, seeds, a.pairs, a.frame_rate))
        return diagnoses.diagnosis_validation(_outcomes(diagnoses.hide, hidden, a))
    recordings = a.imperfect or a.recordings or (1 if a.quick else 3)
    scenes = [scene_of(first + k, a.quick) for k in range(recordings)]
    if a.imperfect:
        cases = [imperfect_case(scene, 60 if a.quick else 200) for scene in scenes]
        return accuracy.imperfect_validation(_outcomes(render_and_measure, cases, a))
    share = [max(FEWEST, -(-total // recordings)) for total in (QUICK if a.quick else FULL)]
    cases = [ideal_case(scene, *share) for scene in scenes]
    return accuracy.accuracy_validation(_outcomes(render_and_measure, cases, a))


def _outcomes(measure: Callable[[Case], Outcome], cases: Sequence[Case], a: argparse.Namespace) -> list[Outcome]:
    began = time.perf_counter()

    def told() -> Iterator[Outcome]:
        for k, outcome in enumerate(measure_all(measure, cases, a.jobs), 1):
            if not a.quiet:
                said = f"{time.perf_counter() - began:6.0f} s  {k} of {len(cases)} recordings"
                print(said, file=sys.stderr, flush=True)
            yield outcome

    return list(told())
