"""What the instrument makes of imperfect laboratories: errors, stated sigmas, verdicts, as one table.

python -m tests.oracles.imperfect_table FOLDER ...            (rendered by tests.oracles.imperfect_laboratory)
python -m tests.oracles.imperfect_table --points 101-120 [--effects none kz ...] [--frames 300]
"""

import argparse
import time
from contextlib import redirect_stdout
from dataclasses import dataclass
from io import StringIO
from pathlib import Path

import numpy as np

from disctrack.cli import main as disctrack_cli
from disctrack.diagnosis import diagnose
from disctrack.diagnosis.recorded import with_declared_dots
from disctrack.trajectory.file import read_details, read_trajectory
from tests.oracles import imperfect_laboratory as laboratory
from tests.oracles import newton_euler, point_laboratory

# What the diagnosis calls the effects that the laboratory plants, and their true sizes.
PLANTED = {
    "none": {},
    "tilt": {"table_tilt.tilt_x": float(np.sin(np.radians(0.1))), "table_tilt.tilt_y": 0.0},
    "kz": {"kz.k_z": 30e-6},
    "com": {"centre_of_mass.c_1": 50e-6, "centre_of_mass.c_2": 0.0},
    "rolling": {"rolling_classical.delta": 30e-6},
    "drag": {"drag_rotation.c": 2.5e-6},
}


@dataclass(frozen=True)
class Row:
    """One recording."""

    name: str
    effect: str
    error: np.ndarray  # (6,) mean over the frames [m, rad]
    stated: np.ndarray  # (6,) root mean square of the stated sigmas
    ratio: np.ndarray  # (6,) mean squared error over variance
    verdict: str
    claims: dict  # {quantity: (value, sigma)} of the motion that were named
    faults: tuple  # of the measurement that were named
    sentence: str
    seconds: float  # of processor time for the diagnosis

    @property
    def false_claims(self):
        """Effects of the motion that are not there."""
        true = {name.partition(".")[0] for name in PLANTED[self.effect]}
        return sorted({name.partition(".")[0] for name in self.claims} - true)

    @property
    def deviations(self):
        """{quantity: (found - planted) / sigma}; empty where the effect was not named."""
        truth = PLANTED[self.effect]
        if not set(truth) <= set(self.claims):
            return {}
        return {name: (self.claims[name][0] - value) / self.claims[name][1] for name, value in truth.items()}

    @property
    def right(self):
        """Is what was planted named within three sigma, and nothing else said of the motion?"""
        named = bool(self.deviations) and max(map(abs, self.deviations.values())) < 3
        return self.verdict != "unexplained" and not self.false_claims and (named or self.effect == "none")

    def __str__(self):
        def numbers(values, scale, digits=1):
            return " ".join(f"{value * scale:.{digits}f}" for value in values)

        claims = ", ".join(f"{name} {value:.4g} +- {sigma:.2g}" for name, (value, sigma) in self.claims.items())
        off = ", ".join(f"{value:+.1f}" for value in self.deviations.values())
        return (
            f"{self.name} | {self.effect} | {numbers(self.error[:3], 1e6)} | {numbers(self.stated[:3], 1e6)} | "
            f"{numbers(np.degrees(self.error[3:]), 1e3)} | {numbers(np.degrees(self.stated[3:]), 1e3)} | "
            f"{numbers(self.ratio, 1, 2)} | {self.verdict} | {claims or '-'}{f' ({off} sigma)' if off else ''} | "
            f"{', '.join(self.faults) or '-'} | {'right' if self.right else 'WRONG'} | {self.seconds:.0f}"
        )


HEAD = (
    "recording | planted | error x y z [um] | stated | error of rotation [mdeg] | stated | squared ratio | verdict | "
    "said of the motion | of the measurement | | s of diagnosis"
)


def truth_of(folder):
    """What is planted, and the poses R (n, 3, 3), t (n, 3) of a rendered recording."""
    truth = np.load(folder / "truth.npz")
    q = truth["q"]
    R = np.stack([newton_euler.matrix_of(newton_euler.quaternion_from_angles(*angles)) for angles in q[:, 3:]])
    return str(truth["effect"]), R, q[:, :3]


def row_of(name, effect, trajectory, findings, R, t):
    """Errors of a trajectory, and its diagnosis."""
    error, variance = point_laboratory.errors_and_variances(trajectory, R, t)
    began = time.process_time()
    result = diagnose(with_declared_dots(trajectory, findings))
    seconds = time.process_time() - began
    claims, faults, fit = {}, [], result.diagnosis.after
    if result.learned is not None:
        claims[f"{result.learned.law.candidate.name}.law"] = (np.nan, np.nan)
    for found in result.diagnosis.found:
        if found.candidate.kind == "motion":
            claims |= {q.name: (fit.values[q.name], fit.sigma(q.name)) for q in found.candidate.quantities}
        else:
            faults.append(found.candidate.name)
    return Row(
        name,
        effect,
        error.mean(0),
        np.sqrt(variance.mean(0)),
        np.mean(error**2 / variance, 0),
        result.diagnosis.verdict,
        claims,
        tuple(faults),
        result.sentence,
        seconds,
    )


def rendered(folder):
    """Row of a rendered recording; `disctrack run` is called where its results are not there yet."""
    out = folder / "results"
    if not (out / "trajectory.h5").exists():
        with redirect_stdout(StringIO()):
            assert disctrack_cli(["run", str(folder), "-o", str(out), "--no-figures", "--no-video"]) == 0
    effect, R, t = truth_of(folder)
    file = out / "trajectory.h5"
    return row_of(folder.name, effect, read_trajectory(file), read_details(file), R, t)


def by_points(seed, effect, frames=300, frame_rate=500.0):
    """Row of a recording made of points."""
    plan = laboratory.Plan(seed, frames, frame_rate=frame_rate, effect=effect)
    tracking, R, t = point_laboratory.recorded(plan)
    shift = tracking.as_built
    findings = {
        "marker_shift_um": 1e6 * shift.marker_shift[:, :2],
        "marker_shift_sigma_um": 1e6 * shift.marker_shift_sigma,
    }
    return row_of(f"points {seed}", effect, tracking.trajectory, findings, R, t)


def main():
    """Command line."""
    parser = argparse.ArgumentParser(description="What the instrument makes of imperfect laboratories.")
    parser.add_argument("folders", nargs="*", type=Path)
    parser.add_argument("--points", default="", help="seeds of recordings by points, as 101-120")
    parser.add_argument("--effects", nargs="*", choices=sorted(PLANTED), default=["none"], help="in turn")
    parser.add_argument("--frames", type=int, default=300)
    parser.add_argument("--sentences", action="store_true", help="also what the diagnosis says")
    asked = parser.parse_args()
    first, _, last = asked.points.partition("-")
    seeds = range(int(first), int(last or first) + 1) if first else ()
    print(HEAD)
    rows = []
    jobs = [lambda folder=folder: rendered(folder) for folder in asked.folders]
    for i, seed in enumerate(seeds):
        effect = asked.effects[i % len(asked.effects)]
        jobs.append(lambda seed=seed, effect=effect: by_points(seed, effect, asked.frames))
    for job in jobs:
        rows.append(job())
        print(rows[-1], flush=True)
        if asked.sentences:
            print("   ", rows[-1].sentence)
    ratio = np.mean([row.ratio for row in rows], axis=0)
    print(f"mean squared ratio {np.round(ratio, 2)}; right: {sum(row.right for row in rows)} of {len(rows)}")


if __name__ == "__main__":
    main()
