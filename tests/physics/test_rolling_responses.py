"""First-order responses by the fundamental matrix are the derivatives that the integrator carries along itself."""

import numpy as np
import pytest

from disctrack.rolling import Model, sensitivities, steady_precession
from disctrack.rolling.effects import effect_from_formulas
from disctrack.rolling.responses import COMPONENTS, responses
from disctrack.synthetic.description import Scene

DISC = Scene().declared_disc
THETA_END = np.radians(0.05)


@pytest.fixture(scope="module")
def rolling():
    model = Model(DISC).with_values({"km.k_m": 0.381e-7})
    return model, steady_precession(np.radians(10.0), DISC, omega3=1.0, nutation_amplitude=0.01)


def test_a_pulse_of_any_component_moves_the_disc_as_its_sensitivity_says(rolling):
    model, state = rolling
    times = np.linspace(0.0, 0.5, 1001)
    found = responses(model, state, times, THETA_END)
    course = np.exp(-0.5 * ((times - 0.2) / 0.02) ** 2)
    wrenches = course[:, None, None] * np.eye(len(COMPONENTS))
    by_start = sensitivities(model, state, times, (), None, THETA_END).dq
    moved = by_start @ found.of(wrenches)
    probe = effect_from_formulas("pulse", {c: f"of_{c} * exp(-((time - 0.2) / 0.02)**2 / 2)" for c in COMPONENTS})
    names = [f"pulse.of_{c}" for c in COMPONENTS]
    probed = model.knowing(probe).with_values(dict.fromkeys(names, 0.0))
    carried = sensitivities(probed, state, times, names, (), THETA_END).dq
    # the integral is of fourth order in 0.5 ms over 20 ms: 4e-7; the derivatives hold to 1e-9
    assert np.abs(moved - carried).max(axis=0) == pytest.approx(0.0, abs=1e-6 * np.abs(carried).max())
    for component in range(len(COMPONENTS)):
        scale = np.abs(carried[..., component]).max(axis=0)
        assert (np.abs(moved - carried)[..., component].max(axis=0) < 1e-6 * scale).all()


def test_where_the_motion_ends_there_are_no_responses(rolling):
    model, state = rolling
    braked = model.with_values({"km.k_m": 1e-5})
    assert responses(braked, state, np.linspace(0.0, 3.0, 301), THETA_END) is None
