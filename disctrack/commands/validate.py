"""`disctrack validate`: tests of poses and diagnosis on recordings with known truth."""

import argparse
import shlex
import sys
import tempfile
from pathlib import Path

from disctrack.commands import DONE, FAILED
from disctrack.files.whole import make_folder
from disctrack.validate.accuracy import accuracy_validation, imperfect_validation
from disctrack.validate.hidden import Verdict, diagnosis_validation, hidden_cases
from disctrack.validate.planted_faults import fault_cases, faults_validation, plant_and_run, untouched
from disctrack.validate.rendered import render_and_measure, rendered_cases
from disctrack.validate.tables import Validation, measure_all, write_validation


def run(arguments: argparse.Namespace) -> int:
    """Validate, write, print the verdict; exit code 1 if a check failed."""
    make_folder(arguments.output)  # fails early if it is not writable
    validation = _validation(arguments)
    print(validation.headline if validation.name == "validation" else validation.markdown())
    command = shlex.join(["disctrack", *sys.argv[1:]])
    files = write_validation(arguments.output, validation, command, arguments.write)
    print(f"Written: {', '.join(map(str, files))}")
    for line in validation.complaints:
        print(f"disctrack: validation: {line}", file=sys.stderr)
    return FAILED if validation.complaints else DONE


def _validation(a: argparse.Namespace) -> Validation:
    if a.diagnosis is not None:
        first = 1 if a.seed is None else a.seed
        hidden = hidden_cases(a.diagnosis, range(first, first + a.seeds), a.pairs, a.frame_rate)
        return diagnosis_validation(measure_all(Verdict, hidden, a.jobs, a.quiet))
    if a.faults is not None:
        with tempfile.TemporaryDirectory(prefix="disctrack-validate-") as folder:
            grounds = list(untouched(Path(folder), a.faults))
            return faults_validation(measure_all(plant_and_run, fault_cases(grounds), a.jobs, a.quiet))
    cases = rendered_cases(a.imperfect or a.recordings, 2014 if a.seed is None else a.seed, a.quick, a.imperfect > 0)
    sum_up = imperfect_validation if a.imperfect else accuracy_validation
    return sum_up(measure_all(render_and_measure, cases, a.jobs, a.quiet))
