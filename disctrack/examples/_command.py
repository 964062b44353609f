"""Common parts of the examples: command line, output files, errors."""

import argparse
from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np

from disctrack.discrepancy.document import document, tables
from disctrack.discrepancy.equations import Answer
from disctrack.discrepancy.search import Diagnosis
from disctrack.discrepancy.system import Candidate, Quantity
from disctrack.errors import DiscTrackError
from disctrack.files.json_text import json_file
from disctrack.files.whole import refuse_existing, write_whole
from disctrack.report import blocks
from disctrack.report.blocks import Report, Section
from disctrack.report.terminal import full

GRAVITY = 9.81  # [m/s^2] as declared
# Result of an example: a report, whose document is diagnosis.json, and answers by the name of the folder of their page
Outcome = tuple[Report, Mapping[str, Answer]]


def effect(
    name: str, kind: str, title: str, unit: str, typical: float, *parts: str,
    lower: float = -np.inf, upper: float = np.inf, source: str = "",
) -> Candidate:  # fmt: skip
    """Candidate of a system with the quantities `parts`, which are zero if the effect is absent.

    kind : "motion" or "measurement"
    typical : usual size
    """
    one = Quantity(name, unit, 0.1 * typical, 0.0, lower, upper, typical=typical)
    return Candidate(name, name, kind, title, source, tuple(replace(one, name=f"{name}.{part}") for part in parts))


def report_of(
    d: Diagnosis, model: str, sentence: str, own: Sequence[Section], sides: Sequence[Mapping[str, object]] = ()
) -> Report:
    """Report of a diagnosis: its own blocks, then those of every diagnosis.

    sides : errors before and after, in units of the example
    """
    data = document(d, model, sentence, *sides)
    return Report(f"{model}: what is missing?", sentence, blocks=[*own, *tables(d)], data=data)


def command(example: Callable[..., Outcome], data: str = "", words: Sequence[str] | None = None) -> None:
    """Run one example: print its report, with -o write diagnosis.json and pages; an error ends the program.

    data : files that the example reads from the given folder; empty if its data are part of the package
    words : of the command line; by default those of the program
    """
    parser = argparse.ArgumentParser(description=example.__doc__)
    if data:
        parser.add_argument("folder", type=Path, help=f"folder with {data}")
    parser.add_argument("-o", "--output", type=Path, help="folder for diagnosis.json and the pages")
    parser.add_argument("--overwrite", action="store_true", help="replace an earlier result")
    given = parser.parse_args(words)
    try:
        if given.output is not None:
            refuse_existing(given.output / "diagnosis.json", given.overwrite)
        report, answers = example(given.folder) if data else example()
        print("\n".join(full(report)))
        if given.output is not None:
            for where, answer in answers.items():
                answer.write(given.output / where, given.overwrite)
            write_whole(given.output / "diagnosis.json", json_file(blocks.document(report)))
    except (DiscTrackError, OSError) as error:
        parser.exit(1, f"{error}\n")
