"""The disc on its edge, hit by a ball: momentum of the impact, and what follows."""

import numpy as np
import pytest
from numpy.testing import assert_allclose

from disctrack import rolling
from disctrack.disc import MA_2014
from disctrack.rolling import CATALOGUE, EndReason, Model, ModelError, Regime, struck_disc

TABLE_1 = [(0.020, 0.0105), (0.010, 0.0175), (0.020, 0.0175), (0.020, 0.0225)]


@pytest.mark.parametrize(("a", "b"), TABLE_1)
@pytest.mark.parametrize("friction", [0.0, 0.2])
def test_impact_balances_momentum_and_the_edge_does_not_go_down(a, b, friction):
    P, psi = 0.05, 0.6
    state = struck_disc(MA_2014, a, b, P, friction=friction, psi=psi)
    m, r, h = MA_2014.mass, MA_2014.radius, MA_2014.half_thickness
    e1, e2, e3 = (
        np.array([np.cos(psi), np.sin(psi), 0]),
        np.array([0, 0, 1.0]),
        np.array([np.sin(psi), -np.cos(psi), 0]),
    )
    motion = rolling.simulate(Model(MA_2014, effects=(CATALOGUE["slip"](mu=0.2),)), state, times=[0.0, 1e-6])
    v, omega = motion.qdot[0, :3], motion.omega_world[0]
    from_table = m * v + P * e3
    moment = MA_2014.moment_diametral * (omega @ e1 * e1 + omega @ e2 * e2) + MA_2014.moment_axial * omega @ e3 * e3
    from_ball = np.cross(a * e1 + b * e2 + h * e3, -P * e3)
    arm = -r * e2 - h * e3
    assert_allclose(moment, from_ball + np.cross(arm, from_table), atol=1e-12)
    edge = v + np.cross(omega, arm)
    assert edge[2] >= -1e-12
    assert from_table[2] >= 0
    tangential = from_table - from_table[2] * e2
    assert_allclose(np.linalg.norm(tangential), friction * from_table[2], atol=1e-10)
    if friction:
        assert tangential @ edge < 0


def test_struck_disc_slips_first_and_rolls_later_while_energy_falls():
    model = Model(MA_2014, effects=(CATALOGUE["km"](), CATALOGUE["slip"](mu=0.1)))
    state = struck_disc(MA_2014, 0.020, 0.0105, 0.05, friction=0.1, x=0.03)
    motion = rolling.simulate(model, state, 3.0)
    assert motion.regime[0] == Regime.SLIPPING
    assert motion.regime[-1] == Regime.ROLLING
    assert motion.end is EndReason.TIME
    assert (np.diff(motion.energy) < 1e-12).all()
    assert motion.q[0, 4] == np.pi / 2
    assert motion.q[-1, 4] < np.radians(50)


def test_an_impulse_that_does_not_tip_the_disc_is_refused():
    with pytest.raises(ModelError, match="hit it higher"):
        struck_disc(MA_2014, 0.0, -0.02, 0.05)
    with pytest.raises(ModelError, match="outside the face"):
        struck_disc(MA_2014, 0.03, 0.03, 0.05)
    with pytest.raises(ModelError, match=r"friction of -0\.2"):
        struck_disc(MA_2014, 0.0, 0.02, 0.05, friction=-0.2)
