"""An angle of the rim and a frequency of the table are looked for before anything is fitted from there."""

import pytest

from tests.oracles.measured_disc import measured, with_base_fit


def starts(name, effects, n=150):
    trajectory = measured(effects, seed=3, n=n, theta_deg=12.0, declared_rate=500.0)
    system, base = with_base_fit(trajectory)
    return system.starts(next(c for c in system.candidates if c.name == name), base.values)


@pytest.mark.statistical
@pytest.mark.parametrize(
    ("planted", "within"),
    [
        # half the width of a flat
        *(({"rim_flat.depth": 1e-4, "rim_flat.angle": angle}, 0.075) for angle in (0.4, 3.9)),
        # half a turn over the recording: of the two halves into which noise splits the peak at 63.7 Hz neither is near
        *(({"table_shaken.u_sin_z": 2e-6, "table_shaken.frequency": f}, 0.5 / 0.3) for f in (63.7, 140.0)),
    ],
)
def test_an_angle_of_the_rim_and_a_frequency_of_the_table_are_found(planted, within):
    _, (sought, true) = planted.items()
    found = starts(sought.partition(".")[0], planted)
    assert abs(found[0][0] - true) < within
    assert sought != "rim_flat.angle" or found[0][1] == 0.15  # the width begins at what is usual


def test_an_exponent_is_not_looked_for():
    assert starts("rolling_power", {}, 60) == []
