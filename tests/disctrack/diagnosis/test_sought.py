"""An angle of the rim and a frequency of the table are looked for before anything is fitted from there."""

import numpy as np
import pytest

from disctrack.diagnosis import DiscSystem
from disctrack.diagnosis.model_file import PAPER, declared_model
from disctrack.discrepancy.fit import fit
from tests.oracles.measured_disc import measured


def fitted(name, effects, n=150):
    trajectory = measured(effects, seed=3, n=n, theta_deg=12.0, declared_rate=500.0)
    system = DiscSystem(trajectory, declared_model(trajectory, PAPER).model)
    base = fit(system, system.base, system.start())
    return system, next(c for c in system.candidates if c.name == name), base.values


def starts(name, effects, n=150):
    system, candidate, values = fitted(name, effects, n)
    return system.starts(candidate, values)


@pytest.mark.statistical
@pytest.mark.parametrize("angle", [0.4, 3.9])
def test_the_angle_of_a_flat_is_found_to_half_its_width(angle):
    found = starts("rim_flat", {"rim_flat.depth": 1e-4, "rim_flat.angle": angle})
    off = (found[0][0] - angle + np.pi) % (2 * np.pi) - np.pi
    assert abs(off) < 0.075
    assert found[0][1] == 0.15  # the width begins at what is usual


@pytest.mark.statistical
@pytest.mark.parametrize("frequency", [63.7, 140.0])
def test_the_frequency_of_a_shaken_table_is_found_to_half_a_turn_over_the_recording(frequency):
    """Of the two halves into which noise splits the peak at 63.7 Hz neither is near enough."""
    found = starts("table_shaken", {"table_shaken.u_sin_z": 2e-6, "table_shaken.frequency": frequency})
    assert abs(found[0][0] - frequency) < 0.5 / 0.3


def test_an_exponent_is_not_looked_for():
    assert starts("rolling_power", {}, 60) == []
