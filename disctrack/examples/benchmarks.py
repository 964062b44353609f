"""Public benchmarks of system identification with their official splits: what is missing, how good are predictions?

    python -m disctrack.examples.benchmarks FOLDER [-o DIR]

FOLDER holds files as published (nonlinearbenchmark.org), those of at least one of them: `DATA_EMPS.mat` and
`DATA_EMPS_PULSES.mat`, a positioning system whose friction is withheld; `dataBenchmark.mat` or `.csv`, two tanks in
series, which may overflow; `DATAUNIF.mat`, electric drives coupled by a belt; `SNLS80mV.mat`, the circuit called
Silverbox. Textbook equations are fitted to the part for estimation; the test part is predicted by a free run from an
initial state fitted to the official window, and its error compared with the best published one.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from time import process_time

import numpy as np
from numpy.typing import ArrayLike
from scipy.io import loadmat

from calibration.kit.types import Array
from disctrack.discrepancy.equations import Answer, Equations, Parameter, Run, Term, diagnose, terms
from disctrack.errors import AnalysisError
from disctrack.examples._command import Outcome, command
from disctrack.numbers import rounded
from disctrack.report.blocks import Listing, Report

Columns = dict[str, Array]
Records = dict[str, tuple[ArrayLike, Array, Array]]  # by name, time [s], input, output


@dataclass(frozen=True)
class Benchmark:
    """One system, with the function that reads records of one input and one output from its files."""

    name: str
    files: tuple[str, ...]  # without .mat or .csv
    equations: Equations
    offered: Sequence[Term] | None
    records: Callable[..., list[Records]]  # of the columns of each file: for estimation and for the test
    window: float  # [s] of a test, to which the initial state is fitted
    unit: str
    scale: float  # units per unit of the data
    published: float  # best error [unit]
    run: Callable[..., Run] = Run  # of a record
    every: int = 1  # every n-th sample is fitted


def columns(path: Path) -> Columns:
    """Columns of a file by name, each (n,)."""
    if path.suffix.lower() == ".csv":
        table = np.genfromtxt(path, delimiter=",", names=True, deletechars='"')
        return {name: table[name] for name in table.dtype.names or ()}
    return {name: np.ravel(values) for name, values in loadmat(path).items() if not name.startswith("_")}


def _positions(*files: Columns) -> list[Records]:
    return [{"": (d["t"] - d["t"][0], d["gtau"] * d["vir"], d["qm"])} for d in files]


def _levels(d: Columns) -> list[Records]:
    return [{"": (4.0 * np.arange(len(d["uEst"])), d[f"u{side}"], d[f"y{side}"])} for side in ("Est", "Val")]


def _speeds(d: Columns) -> list[Records]:
    names, time = (("u11", "z11"), ("u12", "z12")), 0.02 * np.arange(400)
    sides = {"estimation": slice(400), "test": slice(400, None)}
    return [
        {f"{z} {side}": (time[: len(d[z][part])], d[u][part], d[z][part]) for u, z in names}
        for side, part in sides.items()
    ]


def _voltages(d: Columns) -> list[Records]:
    multisine = slice(40_650, 127_400)
    u, y = d["V1"][multisine], d["V2"][multisine]
    part = int(0.75 * len(u))  # for estimation, of which 3000 samples suffice
    return [{"": (np.arange(len(y[rows])) / 610.35, u[rows], y[rows])} for rows in (slice(3000), slice(part, None))]


BENCHMARKS = (
    Benchmark(
        "EMPS", ("DATA_EMPS", "DATA_EMPS_PULSES"),
        Equations({"q": "v", "v": "(F - Fv*v)/M"}, {"M": 90.0, "Fv": 220.0}, inputs=["F"], units={"q": "m"}),
        [terms.coulomb("v"), terms.constant("v"), terms.quadratic("v"), terms.spring("v", "q")],
        _positions, 0.02, "mm", 1e3, 2.64, partial(Run, hold="hold", known={"v": (0.0, 1e-3)}), 20,
    ),
    Benchmark(
        "cascaded tanks", ("dataBenchmark",),
        Equations(
            {"h1": "k4*u - k1*sqrt(Max(h1, 0.001))", "h2": "k2*sqrt(Max(h1, 0.001)) - k3*sqrt(Max(h2, 0.001))"},
            {name: Parameter(0.05, lower=0.0) for name in ("k1", "k2", "k3", "k4")}, inputs=["u"],
            observed={"y": "h2"}, units={"y": "V"},
        ),
        None, _levels, 16.0, "V", 1.0, 0.191, partial(Run, start={"h1": 4.0}),
    ),
    Benchmark(
        "coupled drives", ("DATAUNIF",),
        Equations(
            {"d": "(gain*u - d)/lag", "p": "r", "r": "omega**2*(d - p) - c*r"},
            {"gain": 2.0, "lag": Parameter(0.3, lower=0.01), "omega": 14.0, "c": 5.0}, inputs=["u"],
            observed={"speed": "abs(p)"},
        ),
        None, _speeds, 0.06, "ticks/s", 1.0, 0.12, partial(Run, hold="hold"),
    ),
    Benchmark(
        "Silverbox", ("SNLS80mV",),
        Equations(
            {"y": "v", "v": "g*u - k*y - c*v"}, {"g": 1.8e5, "k": 1.9e5, "c": 40.0}, inputs=["u"], units={"y": "V"}
        ),
        [terms.cubic_spring("v", "y"), terms.asymmetric_spring("v", "y"), terms.constant("v"), terms.quadratic("v")],
        _voltages, 0.08, "mV", 1e3, 0.301,
    ),
)  # fmt: skip


def present(folder: Path, benchmark: Benchmark) -> list[Path]:
    """Files of a benchmark in the folder, in upper or lower case; empty if one is missing."""
    there = {p.stem.lower(): p for p in sorted(folder.iterdir()) if p.suffix.lower() in (".mat", ".csv")}
    found = [there[name.lower()] for name in benchmark.files if name.lower() in there]
    return found if len(found) == len(benchmark.files) else []


def measured(b: Benchmark, paths: Sequence[Path]) -> tuple[Answer, dict[str, float]]:
    """The answer, and error [unit] and share within the 95 % band of its tests, with the processor time [s]."""
    began = process_time()
    (u, *_), (y, *_) = b.equations.inputs, b.equations.observed or b.equations.rates
    train, test = (
        [b.run(time, {y: seen}, inputs={u: given}, name=name) for name, (time, given, seen) in records.items()]
        for records in b.records(*map(columns, paths))
    )
    answer = diagnose(b.equations, [run.thinned(b.every) if b.every > 1 else run for run in train], b.offered)
    scores = [score for run in test for score in answer.score(run, window=b.window).values()]
    error, covered = b.scale * float(np.mean([s.rms for s in scores])), float(np.mean([s.covered for s in scores]))
    return answer, {"error": error, "published": b.published, "covered": covered, "s": process_time() - began}


def example(folder: Path) -> Outcome:
    """What do textbook equations of public benchmarks lack, and how well do they predict the official test parts?"""
    rows, answers, data = [], dict[str, Answer](), dict[str, object]()
    for b in BENCHMARKS:
        if paths := present(folder, b):
            answer, n = measured(b, paths)
            errors = (f"{rounded(n[side])} {b.unit}" for side in ("error", "published"))
            missing = ", ".join(answer.found) or answer.verdict
            rows.append((b.name, *errors, f"{n['covered']:.0%}", f"{n['s']:.0f} s", missing))
            answers[b.name], data[b.name] = answer, answer.document() | {"test": n}
    if not answers:
        wanted = "; ".join(" and ".join(b.files) for b in BENCHMARKS)
        raise AnalysisError(f"{folder}: no benchmark found; expected the files of at least one: {wanted}.")
    header = ("", "error of the test", "best published", "within 95 % band", "processor", "missing")
    said = "The test parts are predicted by free runs from initial states fitted to their first samples."
    return Report("Public benchmarks", said, blocks=[Listing(header, rows)], data=data), answers


if __name__ == "__main__":
    command(example, "the files of at least one benchmark")
