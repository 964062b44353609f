"""One line per recording with an effect outside the catalogue: time, answer, honesty, and the law against the truth.

    python -m tests.oracles.unknown_table [NAME ...] [--seeds 1 2]

Errors of the moment about the contact are in uN m along n0, m0, k, over the size of the truth; pulls are the law's
course minus the truth in its sigmas, at some ninety instants and along three axes.
"""

import argparse
import time

import numpy as np

from disctrack import diagnose
from disctrack.diagnosis.errors import residual_tests, simulated
from disctrack.diagnosis.form_misfit import moment_about_contact
from tests.oracles.unknown_laws import UNKNOWN, Recording, recording


def line(name: str, seed: int) -> str:
    """Diagnose, and compare with the truth."""
    made, began = recording(name, seed), time.process_time()
    result = diagnose(made.trajectory)
    seconds, law = time.process_time() - began, result.learned
    what = "; ".join([*(f.candidate.name for f in result.diagnosis.found), *([law.law.title] if law else [])])
    row = [f"{name} {seed}", f"{seconds:.1f} s", result.diagnosis.verdict, what[:110]]
    if result.after is not None:
        left = residual_tests(result.system, result.diagnosis.after, result.diagnosis.noise)
        said = result.sentence
        as_noise = ("Residuals: noise" in said or "Nothing is missing" in said) and "not noise" not in said
        doubt = " FALSE NOISE" if as_noise and not left.white else ""
        row.append(f"{result.before.reduced_chi_square:.4g} -> {result.after.reduced_chi_square:.4g}")
        row.append(f"p {min(left.pose_p_value, left.other_p_value):.1g}{doubt}")
        row += against(made, result) if len(made.time) else []
    return f"| {' | '.join(row)} |"


def against(made: Recording, result) -> list[str]:
    """Rms of error and truth of the moment, and the error in sigmas where the law has a course with sigmas."""
    of = lambda at: np.stack([np.interp(at, made.time, made.moment[:, i]) for i in range(3)], axis=1)  # noqa: E731
    rms = lambda x: 1e6 * np.sqrt(np.mean(x**2, axis=0))  # noqa: E731
    values = result.diagnosis.after.values
    motion = simulated(result.system, values)
    truth = of(motion.time)
    errors = rms(moment_about_contact(result.system, values, motion) - truth)
    told = [" ".join(f"{error:.2f}/{size:.0f}" for error, size in zip(errors, rms(truth), strict=True))]
    course = result.learned.course if result.learned else None
    if course is not None:
        pull = np.abs(course.values - of(course.time)) / course.sigma
        within = f"{100 * np.mean(pull < 3.0):.1f} % within 3"
        told.append(f"pull {np.sqrt(np.mean(pull**2)):.2f}, {within}, worst {pull.max():.1f}")
    return told


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("names", nargs="*", default=list(UNKNOWN))
    parser.add_argument("--seeds", nargs="*", type=int, default=[1])
    asked = parser.parse_args()
    for name in asked.names:
        for seed in asked.seeds:
            print(line(name, seed), flush=True)
