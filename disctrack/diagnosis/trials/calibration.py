"""Are the stated probabilities true? Recordings in which nothing is hidden, and how often something is seen in them.

    python -m disctrack.diagnosis.trials.calibration --recordings 1000
    python -m disctrack.diagnosis.trials.calibration --recordings 100 --whole

Every recording has a motion, noise and an error of calibration of its own. Without --whole the model is fitted, and all
that can raise an alarm is asked: the best effect of the catalogue, whose probability should be uniform, and the tests
of what is left, whose probabilities are bounds (Bonferroni's). With --whole the diagnosis runs to its end, as for a
user; claims are fewer than stated, as an effect must also foretell the frames that were not fitted.
"""

import argparse
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from scipy import stats

from disctrack.diagnosis.disc_system import DiscSystem
from disctrack.diagnosis.left_over import left_over
from disctrack.diagnosis.model_file import declared_model
from disctrack.diagnosis.stage import diagnose_trajectory
from disctrack.diagnosis.systematic import DOT_SIGMA
from disctrack.diagnosis.trials.hidden_effects import Planted
from disctrack.diagnosis.trials.imperfect import Laboratory
from disctrack.diagnosis.trials.rates import draw, trajectory_of
from disctrack.diagnosis.trials.recordings import Unseen
from disctrack.discrepancy.chance import chance
from disctrack.discrepancy.fit import fit
from disctrack.discrepancy.score import Linearisation, score_all
from disctrack.discrepancy.search import Settings, noise_variance
from disctrack.files.json_text import json_file
from disctrack.files.whole import write_whole
from disctrack.trajectory import Trajectory

LEVELS = (0.5, 0.2, 0.05, 0.01, 0.005)
RATE = 400.0  # [Hz] 160 to 360 frames
SURE = 0.95


@dataclass(frozen=True)
class Alarm:
    """How often a probability was below a level."""

    level: float
    seen: int
    of: int

    @property
    def interval(self) -> tuple[float, float]:
        """Of the true rate (Clopper and Pearson 1934)."""
        tail = 0.5 * (1 - SURE)
        low = float(stats.beta.ppf(tail, self.seen, self.of - self.seen + 1)) if self.seen else 0.0
        high = float(stats.beta.ppf(1 - tail, self.seen + 1, self.of - self.seen)) if self.seen < self.of else 1.0
        return low, high

    @property
    def as_stated(self) -> bool:
        """Does the interval hold the level?"""
        low, high = self.interval
        return low <= self.level <= high


def quiet(seed: int, rate: float = RATE) -> Trajectory:
    """A recording in which nothing is hidden; dots have the small biases that every diagnosis allows for."""
    nothing = Planted({}, unseen=Unseen(laboratory=Laboratory(print_m=DOT_SIGMA)))
    return trajectory_of(draw(seed, nothing, rate), nothing)


def probabilities(trajectory: Trajectory) -> dict[str, float]:
    """P values of all that can raise an alarm: the catalogue, and the tests of what is left."""
    system = DiscSystem(trajectory, declared_model(trajectory).model)
    base = fit(system, system.base, system.start())
    noise = noise_variance(system, base)
    linear = Linearisation(system, base, system.candidates)
    found = {"an effect of the catalogue": chance(linear, score_all(linear, system.candidates), noise).p_value}
    left = left_over(system, base, noise)
    if left is not None:
        found |= {"memory in the poses": left.pose_p_value, "memory elsewhere": left.other_p_value}
    return found


def alarms(p_values: Sequence[float], levels: Sequence[float] = LEVELS) -> list[Alarm]:
    """Of many p values at each level."""
    p = np.asarray(p_values)
    return [Alarm(level, int(np.sum(p < level)), len(p)) for level in levels]


def table(collected: Mapping[str, Sequence[float]]) -> str:
    """For people: rates with their intervals."""
    rows = []
    for name, p in collected.items():
        rows.append(f"{name}: {len(p)} recordings")
        for a in alarms(p):
            low, high = a.interval
            mark = "" if a.as_stated else ("  fewer than stated" if high < a.level else "  MORE THAN STATED")
            rows.append(f"    p < {a.level:<6g} {a.seen:5d} = {a.seen / a.of:.4f} ({low:.4f} to {high:.4f}){mark}")
    return "\n".join(rows)


def _whole(seeds: Sequence[int], rate: float) -> str:
    claims, learned, not_white = 0, 0, 0
    for seed in seeds:
        result = diagnose_trajectory(quiet(seed, rate), separate=False)
        d = result.diagnosis
        claims += bool(d.found)
        learned += result.learned is not None
        not_white += d.verdict == "unexplained"
        if d.verdict != "nothing missing":
            print(f"    seed {seed}: {result.sentence}", flush=True)
    settings = Settings()
    rows = [
        (f"an effect claimed (stated: at most {settings.false_alarm:g})", claims, settings.false_alarm),
        ("a law outside the catalogue", learned, settings.false_alarm),
        ("unexplained", not_white, settings.false_alarm),
    ]
    said = []
    for words, seen, level in rows:
        low, high = Alarm(level, seen, len(seeds)).interval
        said.append(f"{words}: {seen} of {len(seeds)} ({low:.4f} to {high:.4f})")
    return "\n".join(said)


def main() -> None:
    """Print how often what was stated is so."""
    parser = argparse.ArgumentParser(prog="python -m disctrack.diagnosis.trials.calibration", description=__doc__)
    parser.add_argument("--recordings", type=int, default=200, help="in which nothing is hidden (%(default)s)")
    parser.add_argument("--first-seed", type=int, default=1, help="the others count up from it")
    parser.add_argument("--frame-rate", type=float, default=RATE, help="in Hz (%(default)s)")
    parser.add_argument("--whole", action="store_true", help="run the diagnosis to its end")
    parser.add_argument("-o", "--output", type=Path, help="JSON file with all p values")
    a = parser.parse_args()
    seeds = range(a.first_seed, a.first_seed + a.recordings)
    if a.whole:
        print(_whole(seeds, a.frame_rate))
        return
    collected: dict[str, list[float]] = {}
    for number, seed in enumerate(seeds, 1):
        for name, p in probabilities(quiet(seed, a.frame_rate)).items():
            collected.setdefault(name, []).append(p)
        if number % 20 == 0 and a.output:
            write_whole(a.output, json_file(collected))
    print(table(collected))
    if a.output:
        write_whole(a.output, json_file(collected))


if __name__ == "__main__":
    main()
