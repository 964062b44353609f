"""Numbers that move together, at a bound or along a valley: errors are as large as the standard deviations say."""

import numpy as np
import pytest

from disctrack.discrepancy.fit import fit
from disctrack.discrepancy.shape import profiled
from disctrack.faults.keys import Faults
from tests.oracles import newton_euler
from tests.oracles.measured_disc import K_M, measured, system_of


def power_friction(k: float, p: float):
    """Rolling friction with an exponent."""
    law = lambda now: -k * abs(now.psidot / 100) ** p * np.sign(now.psidot) * now.m0  # noqa: E731
    return lambda disc, now: (newton_euler.ZERO, law(now), newton_euler.ZERO)


@pytest.mark.slow
@pytest.mark.parametrize(
    ("laws", "delay", "fitted", "shape", "truth"),
    [
        (
            (newton_euler.precession_friction(K_M), newton_euler.pivoting_friction(60e-6)),
            0.0, "kz.k_z", (), {"km.k_m": K_M, "kz.k_z": 60e-6},
        ),
        ((newton_euler.precession_friction(K_M),), 1e-4, "time_offset.delay", (), {"time_offset.delay": 1e-4}),
        (
            (power_friction(603e-6, 1.2),),
            0.0, "rolling_power.k", ("rolling_power.p",),
            {"km.k_m": 0.0, "rolling_power.k": 603e-6, "rolling_power.p": 1.2},
        ),
    ],
    ids=["pivoting", "delay", "exponent"],
)  # fmt: skip
def test_pulls_over_many_recordings_of_one_motion(laws, delay, fitted, shape, truth):
    """Motions by world vectors and quaternions; every recording has its own noise and error of calibration."""
    disc = measured(n=50).disc
    body = newton_euler.Disc(disc.radius, disc.half_thickness, disc.mass, laws=laws)
    omega2 = 1.01 * np.sqrt(4 * 9.81 * np.sin(np.radians(10)) / body.r)
    start = newton_euler.state_from_angles(body, 0.032, 0.02, 0.7, np.radians(10), -0.4, 0.0, omega2, 1.0)
    times = np.arange(0, 0.82, 1 / 4000)
    states = newton_euler.follow(body, start, times, atol=1e-13).y
    motion = newton_euler.course(body, times, states)
    pulls = []
    for seed in range(24):
        faults = Faults(right_delay_s=delay)
        trajectory = measured(seed=seed, n=400, declared_rate=500.0, motion=motion, faults=faults)
        system = system_of(trajectory)
        known = {q.name: q for c in system.candidates for q in (*c.quantities, *c.shape)}
        found = fit(system, (*system.base, known[fitted]), system.start())
        for name in shape:
            found = profiled(system, found, known[name], 0.05)
        pulls.append([(found.values[n] - v) / found.sigma(n) for n, v in truth.items()])
    rms = np.sqrt(np.mean(np.square(pulls), axis=0))
    assert (rms < 1.0 + 3 / np.sqrt(48)).all()
    assert np.abs(pulls).max() < 3.5
