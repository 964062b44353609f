"""Laws by the place on the table: the library's against the oracle's, and a groove that a tilt could stand in for."""

from dataclasses import replace

import numpy as np
import pytest
from numpy.testing import assert_allclose

from disctrack.diagnosis import diagnose
from disctrack.diagnosis.law_library import families
from disctrack.frames import nodal_axes_world
from disctrack.rolling import Model, State, simulate
from disctrack.rolling.effects import effect_from_formulas
from tests.oracles.measured_disc import K_M, assert_sized
from tests.oracles.unknown_laws import DISC, PLACE, UNKNOWN, motion, recording


@pytest.mark.statistical
@pytest.mark.parametrize(
    ("name", "kind", "shape", "amount"),
    [  # shapes as in UNKNOWN, of 20, 6 and 30 um
        ("groove", "ridge", {"direction": 0.6, "edge": 0.05, "length": 3e-3}, -20e-6 * 3e-3),
        ("seam", "step", {"direction": 0.9, "edge": 0.045, "length": 4e-3}, 6e-6),
        ("bump", "hill", {"x0": float(PLACE[0]), "y0": float(PLACE[1]), "length": 8e-3}, 30e-6 * 8e-3**2),
    ],
)
def test_an_uneven_table_moves_the_disc_as_the_work_of_the_load_does(name, kind, shape, amount):
    """The oracle lets the load pay for what the contact climbs, for every direction of the angular velocity."""
    unknown = replace(UNKNOWN[name], duration=0.2)
    times, q, speed, _ = motion(unknown)
    family = next(f for f in families(q, times, 500.0, DISC) if f.kind == kind)
    formulas = replace(family, shape=shape).formulas()[0]
    law = effect_from_formulas("uneven", {k: f"c * ({f})" for k, f in formulas.items()})
    theta, psidot, phidot = q[0, 4], speed[0, 3], speed[0, 5]
    start = State(*q[0, :2], *q[0, 3:], speed[0, 4], psidot * np.sin(theta), psidot * np.cos(theta) + phidot)
    flat = Model(DISC).with_values({"km.k_m": K_M})
    found, without = (simulate(m, start, times=times).q for m in (flat.with_effects(law(c=amount)), flat))
    moved = np.abs(q - without).max(axis=0)
    assert moved[2] > 1e-7
    # as much as the two integrations, of 1e-10, differ where nothing acts
    assert_allclose(found, q, atol=1e-3 * moved.min())


def test_uneven_tables_are_looked_for_where_the_disc_touches():
    """A disc of half the size: hills of the library lie on the path of its lowest point, and cover it."""
    small = replace(DISC, radius=0.5 * DISC.radius, half_thickness=0.5 * DISC.half_thickness)
    q = np.tile([0.02, -0.01, 0.0, 0.0, 0.3, 0.0], (200, 1))
    q[:, 3] = np.linspace(0, 6, 200)
    lowest = q[:, :2] + small.arm_to_contact(*nodal_axes_world(q[:, 3], q[:, 4])[1:])[:, :2]
    hills = (f.shape for f in families(q, np.arange(200) / 500.0, 500.0, small) if f.kind == "hill")
    places = np.array(sorted({(s["x0"], s["y0"]) for s in hills}))
    apart = np.linalg.norm(places[:, None] - lowest, axis=2)
    half_diagonal = 0.006 / np.sqrt(2)  # of the squares of the grid
    assert apart.min(axis=0).max() <= half_diagonal
    assert apart.min(axis=1).max() <= half_diagonal


@pytest.mark.slow
def test_a_groove_is_no_tilted_table():
    """The tilt leaves 1.03 of the noise, with p = 0.02; a law by the place leaves noise, and is named in its stead."""
    result = diagnose(recording("groove").trajectory)
    assert result.learned.law.title == "a ridge or groove of the table"
    assert not result.diagnosis.found
    assert result.after.reduced_chi_square < 1.0
    truth = {"learned.c_0": -6e-8, "learned.direction_0": 0.6, "learned.edge_0": 0.05}
    assert_sized(result.diagnosis.after, truth, 4)
    assert any("table_tilt" in note for note in result.notes)
