"""One line per recording with an effect outside the catalogue: time, answer, honesty, and the law against the truth.

    python -m tests.oracles.unknown_table [NAME ...] [--seeds 1 2] [-o FILE.json]

Errors of the moment about the contact are in uN m along n0, m0, k, over the size of the truth; pulls are the law's
course minus the truth in its sigmas, at some ninety instants and along three axes.
"""

from __future__ import annotations

import argparse
import json
import time
from pathlib import Path

import numpy as np

from disctrack import Model, diagnose
from disctrack.diagnosis.errors import residual_tests, simulated
from tests.oracles.required_wrench import required_wrench
from tests.oracles.unknown_laws import UNKNOWN, Recording, recording


def fitted_moment(result) -> tuple[np.ndarray, np.ndarray]:
    """(times [s], moment (n, 3) about the contact) that the fitted motion needs, whatever supplies it."""
    motion = simulated(result.system, result.diagnosis.after.values)
    rates = motion.acceleration_world, motion.angular_acceleration_world
    _, moment = required_wrench(Model(result.system.disc), motion.q, motion.qdot, *rates)
    return motion.time, moment


def trial(name: str, seed: int) -> dict:
    """Diagnose, and compare with the truth."""
    made = recording(name, seed)
    began = time.process_time()
    result = diagnose(made.trajectory)
    seconds = time.process_time() - began
    left = residual_tests(result.system, result.diagnosis.after, result.diagnosis.noise) if result.after else None
    said = result.sentence
    as_noise = ("Residuals: noise" in said or "Nothing is missing" in said) and "not noise" not in said
    answer = {
        "name": name,
        "seed": seed,
        "seconds": seconds,
        "verdict": result.diagnosis.verdict,
        "sentence": said,
        "found": [f.candidate.name for f in result.diagnosis.found],
        "law": result.learned.law.title if result.learned else "",
        "notes": list(result.notes),
        "before": result.before.reduced_chi_square if result.before else np.nan,
        "after": result.after.reduced_chi_square if result.after else np.nan,
        "p_white": min(left.pose_p_value, left.other_p_value) if left else np.nan,
        "false_noise": bool(as_noise and left is not None and not left.white),
    }
    return answer | (_against(made, result) if len(made.time) and result.after is not None else {})


def _against(made: Recording, result) -> dict:
    """Rms of truth and error of the moment, and the error in sigmas where the law has a course with sigmas."""
    of = lambda at: np.stack([np.interp(at, made.time, made.moment[:, i]) for i in range(3)], axis=1)  # noqa: E731
    rms = lambda x: np.sqrt(np.mean(x**2, axis=0)).tolist()  # noqa: E731
    at, moment = fitted_moment(result)
    found = {"rms_truth": rms(of(at)), "rms_error": rms(moment - of(at))}
    course = result.learned.course if result.learned else None
    if course is not None:
        pull = (course.values - of(course.time)) / course.sigma
        found |= {"misfit": result.learned.misfit, "pull": float(np.sqrt(np.mean(pull**2)))}
        found |= {"rms_sigma": rms(course.sigma), "within_3": float(np.mean(np.abs(pull) < 3.0))}
        found |= {"worst": float(np.abs(pull).max())}
    return found


def line(a: dict) -> str:
    """Of the table."""
    what = "; ".join([*a["found"], a["law"]]).strip("; ")[:110]
    sizes = zip(a.get("rms_error", ()), a.get("rms_truth", ()), strict=True)
    row = [f"{a['name']} {a['seed']}", f"{a['seconds']:.1f} s", a["verdict"], what]
    row += [f"{a['before']:.4g} -> {a['after']:.4g}", f"p {a['p_white']:.1g}{' FALSE NOISE' * a['false_noise']}"]
    row += [" ".join(f"{1e6 * error:.2f}/{1e6 * truth:.0f}" for error, truth in sizes)]
    if "pull" in a:
        row += [f"pull {a['pull']:.2f}, {100 * a['within_3']:.1f} % within 3, worst {a['worst']:.1f}"]
    return f"| {' | '.join(row)} |"


def main() -> None:
    """Print the table."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("names", nargs="*", default=list(UNKNOWN))
    parser.add_argument("--seeds", nargs="*", type=int, default=[1])
    parser.add_argument("-o", "--output", type=Path)
    a = parser.parse_args()
    done = []
    for name in a.names:
        for seed in a.seeds:
            done.append(trial(name, seed))
            print(line(done[-1]), flush=True)
            if a.output:
                a.output.write_text(json.dumps(done, indent=1))


if __name__ == "__main__":
    main()
