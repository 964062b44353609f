"""One line per recording with an effect outside the catalogue: time, answer, honesty, and the law against the truth.

    python -m tests.oracles.unknown_table [NAME ...] [--seeds 1 2]

Errors of the moment about the contact are in uN m along n0, m0, k, over the size of the truth; pulls are the law's
course minus the truth in its sigmas, at some ninety instants and along three axes.
"""

from __future__ import annotations

import argparse
import time

import numpy as np

from disctrack import diagnose
from disctrack.diagnosis.errors import residual_tests, simulated
from disctrack.frames import nodal_axes_world
from tests.oracles.unknown_laws import UNKNOWN, Recording, recording

VERTICAL = np.array([0.0, 0.0, 1.0])


def required_moment(disc, motion) -> np.ndarray:
    """Moment (n, 3) about the contact that a motion needs, whatever supplies it, in (n0, m0, k) [N m].

    From the balances of momentum and of angular momentum of a homogeneous disc with a sharp edge on a level table.
    """
    e1, e2, e3 = nodal_axes_world(motion.q[:, 3], motion.q[:, 4])
    force = disc.mass * (motion.acceleration_world + 9.81 * VERTICAL)

    def momentum(turning):
        along = np.sum(turning * e3, axis=-1, keepdims=True)
        return disc.moment_diametral * turning + (disc.moment_axial - disc.moment_diametral) * along * e3

    rate = momentum(motion.angular_acceleration_world) + np.cross(motion.omega_world, momentum(motion.omega_world))
    moment = rate - np.cross(disc.arm_to_contact(e2, e3), force)
    to_contact = np.stack([e1, np.cross(VERTICAL, e1), np.broadcast_to(VERTICAL, e1.shape)], axis=-2)
    return np.einsum("nij,nj->ni", to_contact, moment)


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
    motion = simulated(result.system, result.diagnosis.after.values)
    truth = of(motion.time)
    errors = rms(required_moment(result.system.disc, motion) - truth)
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
