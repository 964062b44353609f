"""Inverse dynamics: the forces and moments that a motion needs are those that made it."""

import numpy as np
import pytest
from numpy.testing import assert_allclose

from disctrack import rolling
from disctrack.disc import MA_2014
from disctrack.rolling import CATALOGUE, Model, steady_precession
from disctrack.rolling.evaluate import effect_wrench, kinematics
from tests.oracles.required_wrench import required_wrench

STATE = steady_precession(np.radians(18), MA_2014, omega3=1.5, nutation_amplitude=np.radians(2))


@pytest.mark.parametrize(
    "effects",
    [
        {"km": {}, "kz": {}},
        {"km": {}, "table_tilt": {"tilt_x": 0.01}, "drag_linear": {"c": 0.1}},
        {
            "km": {},
            "centre_of_mass": {"c_1": 1e-3, "c_2": 5e-4, "c_3": -3e-4},
            "inertia_product": {"J_13": 1e-6},
            "edge_radius": {"rho": 5e-4},
            "drag_linear": {"c": 0.1},
        },
    ],
)
def test_required_wrench_is_the_one_that_acted(effects):
    model = Model(MA_2014, effects=tuple(CATALOGUE[n](**v) for n, v in effects.items()))
    motion = rolling.simulate(model, STATE, 0.3)
    force, moment = required_wrench(
        model, motion.q, motion.qdot, motion.acceleration_world, motion.angular_acceleration_world
    )
    assert_allclose(force, motion.contact_force, atol=1e-11)  # N; rounding of terms of 1 N
    assert_allclose(moment, motion.contact_moment, atol=1e-12)  # N m; rounding of terms of 0.1 N m


def test_moment_that_a_model_lacks_is_that_of_the_missing_effect():
    full = Model(MA_2014, effects=(CATALOGUE["km"](), CATALOGUE["kz"](k_z=6e-5)))
    motion = rolling.simulate(full, STATE, 0.3)
    force, moment = required_wrench(
        Model(MA_2014), motion.q, motion.qdot, motion.acceleration_world, motion.angular_acceleration_world
    )
    k = kinematics(motion.q, motion.qdot, MA_2014)
    supplied, _ = effect_wrench(CATALOGUE["km"](), k, force[:, 2])
    lacking, _ = effect_wrench(CATALOGUE["kz"](k_z=6e-5), k, force[:, 2])
    assert np.abs(lacking).max() > 1e-4
    assert_allclose(moment - supplied, lacking, atol=1e-12)
