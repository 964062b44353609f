"""Which recordings repeat one another, on one clock, with their spread and their averages."""

from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from disctrack.errors import DiscTrackError
from disctrack.repeats.alignment import Alignment, Curves, align
from disctrack.repeats.averages import Average, average
from disctrack.repeats.runs import FITTED, INDEX, AnalysedRun, read_run
from disctrack.repeats.spread import Spread, spread

SAME_SIZE = 1e-6  # relative: discs are declared, not measured
SAME_PLACE = 2e-3  # [m] by which a camera may seem to have moved between two calibrations
SAME_HEADING = 3e-3  # [rad] likewise
SAME_START = 0.5  # of the shorter run's range of ln E that another must pass through, too, where no case is declared


@dataclass(frozen=True)
class LeftOut:
    """A file that is not compared."""

    path: Path
    reason: str


@dataclass(frozen=True)
class RepeatGroup:
    """Runs of one disc on one surface, from one start, filmed by one rig."""

    name: str
    runs: tuple[AnalysedRun, ...]
    alignment: Alignment
    spread: Spread | None  # None for a single run
    averages: dict[str, Average]  # of FITTED
    remarks: tuple[str, ...]  # what to know before the averages are used


@dataclass(frozen=True)
class ExponentTable:
    """All runs of one disc on one surface, in the form of the paper's tables 2 and 3."""

    title: str
    rows: tuple[tuple[str, int, AnalysedRun], ...]  # group, trial in it, run
    averages: dict[str, Average]


@dataclass(frozen=True)
class Comparison:
    """Repeats among some recordings."""

    groups: tuple[RepeatGroup, ...]
    tables: tuple[ExponentTable, ...]
    left_out: tuple[LeftOut, ...]


def compare(paths: Iterable[Path]) -> Comparison:
    """Group, align and average analysed trajectory files. Files that cannot be compared are listed with the reason."""
    runs, left_out = _read(list(paths))
    groups = [_group(f"group {number}", members) for number, members in enumerate(_alike(runs, _same_experiment), 1)]
    groups = [_named(group, groups) for group in groups]
    return Comparison(tuple(groups), tuple(_tables(groups)), tuple(left_out))


def _read(paths: Sequence[Path]) -> tuple[list[AnalysedRun], list[LeftOut]]:
    runs: list[AnalysedRun] = []
    left_out: list[LeftOut] = []
    for path in paths:
        try:
            run = read_run(Path(path))
        except DiscTrackError as error:
            left_out.append(LeftOut(Path(path), str(error).removeprefix(f"{path}: ")))
            continue
        twin = next((other for other in runs if other.fingerprint == run.fingerprint), None)
        if twin is not None:
            left_out.append(LeftOut(Path(path), f"the same recording as {twin.path}"))
        else:
            runs.append(run)
    if len({run.k_m_source for run in runs}) > 1:  # one kind of number in one column
        runs = [run if run.k_m_source == "energy" else read_run(run.path, k_m_from_energy=True) for run in runs]
    return runs, left_out


def _alike(runs: Sequence[AnalysedRun], same: Callable[[AnalysedRun, AnalysedRun], bool]) -> list[list[AnalysedRun]]:
    """Runs that are linked by a chain of likeness, in the order given."""
    groups: list[list[AnalysedRun]] = []
    for run in runs:
        linked = [group for group in groups if any(same(run, other) for other in group)]
        merged = [member for group in linked for member in group] + [run]
        groups = [group for group in groups if group not in linked] + [merged]
    order = {id(run): i for i, run in enumerate(runs)}
    return sorted((sorted(group, key=lambda r: order[id(r)]) for group in groups), key=lambda g: order[id(g[0])])


def _same_disc_and_surface(a: AnalysedRun, b: AnalysedRun) -> bool:
    mine, other = ((run.disc.radius, run.disc.half_thickness, run.disc.mass) for run in (a, b))
    return a.surface == b.surface and bool(np.allclose(mine, other, rtol=SAME_SIZE, atol=0))


def _same_experiment(a: AnalysedRun, b: AnalysedRun) -> bool:
    return _same_disc_and_surface(a, b) and _same_rig(a, b) and _same_start(a, b)


def _same_rig(a: AnalysedRun, b: AnalysedRun) -> bool:
    """Every camera stands where it stood, to what two calibrations tell."""
    for (R, t), (S, u) in zip(a.rig.camera_poses(), b.rig.camera_poses(), strict=True):
        turn = np.arccos(np.clip((np.trace(R @ S.T) - 1) / 2, -1, 1))
        if np.linalg.norm(R.T @ t - S.T @ u) > SAME_PLACE or turn > SAME_HEADING:
            return False
    return True


def _same_start(a: AnalysedRun, b: AnalysedRun) -> bool:
    """By the declared case; without one, the same sense of precession and largely the same energies."""
    if a.case or b.case:
        return a.case == b.case
    ranges, senses = [], []
    for run in (a, b):
        good = run.known()
        energy = run.value[good, INDEX["energy"]]
        energy = energy[energy > 0]
        if energy.size < 2:
            return False
        ranges.append(np.log([energy.min(), energy.max()]))
        senses.append(np.sign(np.median(run.value[good, INDEX["psidot"]])))
    low, high = max(r[0] for r in ranges), min(r[1] for r in ranges)
    return bool(senses[0] == senses[1] and high - low >= SAME_START * min(np.ptp(r) for r in ranges))


def _group(name: str, runs: list[AnalysedRun]) -> RepeatGroup:
    curves = [Curves(run) for run in runs]
    alignment = align(runs, curves)
    found = spread(curves, alignment) if len(runs) > 1 else None
    averages = {
        item: average([run.fitted[item].value for run in runs], [run.fitted[item].sigma for run in runs])
        for item in FITTED
        if item != "t_f"  # each camera's own clock: an average would mean nothing
    }
    return RepeatGroup(name, tuple(runs), alignment, found, averages, tuple(_remarks(runs, found, averages)))


def _named(group: RepeatGroup, groups: Sequence[RepeatGroup]) -> RepeatGroup:
    """The group under the case that its runs declare, with the surface where that is needed to tell it."""
    run = group.runs[0]
    if not run.case:
        return group
    twins = [other for other in groups if other.runs[0].case == run.case]
    name = run.case if len(twins) == 1 else f"{run.case}, {run.surface or group.name}"
    return RepeatGroup(name, group.runs, group.alignment, group.spread, group.averages, group.remarks)


def _remarks(runs: Sequence[AnalysedRun], found: Spread | None, averages: dict[str, Average]) -> list[str]:
    remarks = []
    for i, run in enumerate(runs):
        reasons = [f"{item} = {run.fitted[item].value:.4g}" for item, a in averages.items() if i in a.outliers]
        if found is not None and found.standing_out[i]:
            reasons.append(found.standing_out[i])
        if reasons:
            remarks.append(f"{run.name} stands apart from the other runs: {'; '.join(reasons)}")
        remarks += [f"{run.name}: {note}" for note in run.notes]
    remarks += [f"{item}: {a.verdict}" for item, a in averages.items() if a.n > 1 and not a.agree]
    if len(runs) > 1 and found is None:
        remarks.append("no two runs overlap in time once they are aligned: there is no spread to give")
    return remarks


def _tables(groups: Sequence[RepeatGroup]) -> list[ExponentTable]:
    home = {id(run): (group.name, trial) for group in groups for trial, run in enumerate(group.runs, 1)}
    tables = []
    for runs in _alike([run for group in groups for run in group.runs], _same_disc_and_surface):
        disc = runs[0].disc
        surface = f" on {runs[0].surface}" if runs[0].surface else ""
        title = f"Disc of radius {1e3 * disc.radius:g} mm, thickness {2e3 * disc.half_thickness:g} mm{surface}"
        averages = {
            item: average([run.fitted[item].value for run in runs], [run.fitted[item].sigma for run in runs])
            for item in FITTED
            if item != "t_f"
        }
        tables.append(ExponentTable(title, tuple((*home[id(run)], run) for run in runs), averages))
    return tables
