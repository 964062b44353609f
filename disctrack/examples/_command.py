"""What all examples share: their command line, their files, and how errors end."""

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
# What an example has to say: a report, whose document is diagnosis.json, and answers, each on a page of its own in a
# folder of that name
Outcome = tuple[Report, Mapping[str, Answer]]


def effect(
    name: str, kind: str, title: str, unit: str, typical: float, *parts: str,
    bounds: tuple[float, float] = (-np.inf, np.inf), source: str = "",
) -> Candidate:  # fmt: skip
    """An effect that a system of one's own may lack: its numbers `parts` are zero where it is absent.

    kind : "motion" or "measurement"
    typical : size that would surprise nobody
    """
    one = Quantity(name, unit, 0.1 * typical, 0.0, *bounds, typical=typical)
    return Candidate(name, name, kind, title, source, tuple(replace(one, name=f"{name}.{part}") for part in parts))


def report_of(
    d: Diagnosis, model: str, sentence: str, own: Sequence[Section], sides: Sequence[Mapping[str, object]] = ()
) -> Report:
    """Of a system of one's own: its blocks before those that every diagnosis has.

    sides : errors before and after in its own units
    """
    data = document(d, model, sentence, *sides)
    return Report(f"{model}: what is missing?", sentence, blocks=[*own, *tables(d)], data=data)


def command(example: Callable[..., Outcome], data: str = "", words: Sequence[str] | None = None) -> None:
    """Run one example: print its report, write diagnosis.json and pages where asked for; an error ends the program.

    data : what the example reads from the folder that it is given; none, if its data come with the sources
    words : of the command line, if not those of the program
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
