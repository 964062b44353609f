"""What is in no catalogue is read from the residual: as a moment over time, and as a law."""

from dataclasses import replace

import numpy as np
import pytest

from disctrack.diagnosis import DiscSystem, diagnose_trajectory
from disctrack.diagnosis.disc.law_library import Family
from disctrack.diagnosis.disc.learned_law import _law, learn, learned_moment, missing_moment, probe, without_idle_terms
from disctrack.diagnosis.disc.model_file import declared_model
from disctrack.diagnosis.engine.fit import Fit, fit
from disctrack.diagnosis.pages.output import as_json
from disctrack.rolling.effects import effect_from_formulas
from tests.oracles.measured_disc import measured


def hiding(name: str, component: str, formula: str, size: float, **options):
    """Measured with an effect that no candidate list proposes."""
    return measured({f"{name}.k": size}, laws=[effect_from_formulas(name, {component: formula})], **options)


@pytest.mark.parametrize(
    ("name", "component", "formula", "size", "locked"),
    [
        pytest.param("hidden_cubic", "M_z", "-k * omega_z * omega_z * omega_z", 1e-6, False, marks=pytest.mark.slow),
        pytest.param("hidden_hum", "M_m", "k * sin(50.0 * time)", 2e-5, False, marks=pytest.mark.slow),
        ("hidden_magnet", "M_n", "-k * cos(psi + phi)", 4e-5, True),
    ],
)
def test_an_effect_in_no_catalogue_is_described_by_a_learned_law(name, component, formula, size, locked):
    trajectory = hiding(name, component, formula, size, seed=5, n=450, omega3=2.0)
    result = diagnose_trajectory(trajectory, separate=False)
    assert result.diagnosis.verdict == "unexplained"
    assert result.learned is not None
    assert set(result.learned.law.formulas) == {component}
    assert result.learned.law.locked == locked
    # 10 000 numbers: 1 +- 0.014, and the hum's frequency is known to a tenth of a line only
    assert result.after.reduced_chi_square < 1.05
    assert result.after.ratio_to_floor < 1.2 < result.before.ratio_to_floor
    first = as_json(result)["effects"][0]
    assert first["kind"] == "learned"
    assert first["phase_locked"] == locked


def test_missing_moment_is_the_hidden_one():
    """The true course of the moment lies within the band: pulls of order one, and the band is narrow."""
    trajectory = hiding("hidden_cubic", "M_z", "-k * omega_z * omega_z * omega_z", 1e-6, seed=7, n=400)
    system = DiscSystem(trajectory, declared_model(trajectory).model)
    base = fit(system, system.base, system.start())
    moment = missing_moment(probe(system, base))
    law = learn(system, base, 1.0)
    system = system.knowing(law.effect)
    truth = learned_moment(
        system,
        fit(
            system,
            (*base.quantities, *law.candidate.quantities),
            base.values | dict(zip(law.candidate.names, law.candidate.start, strict=True)),
        ),
        law,
    )
    expected = np.interp(moment.time, system.time, truth[:, 2])
    inner = slice(3, -3)  # at the ends the initial state absorbs a moment
    error = moment.moment[inner, 2] - expected[inner]
    size = np.abs(expected).max()
    # the fitted k_m and initial state take a part of any moment with them: the shape is left, to a tenth
    assert np.sqrt(np.mean((error - error.mean()) ** 2)) < 0.1 * size


def test_in_noise_no_law_is_learned():
    trajectory = measured(seed=8, n=300)
    system = DiscSystem(trajectory, declared_model(trajectory).model)
    base = fit(system, system.base, system.start())
    assert learn(system, base, 1.0) is None


def test_a_term_that_the_refit_finds_to_be_zero_is_dropped():
    pair = Family("twice", ({"M_z": "sin(2.0 * phi)"}, {"M_z": "cos(2.0 * phi)"}))
    law = _law([pair], np.array([-4e-4, 1e-6]), "test_idle")
    first, second = law.candidate.quantities
    covariance = np.diag([6e-6, 7e-6]) ** 2
    fitted = Fit((first, second), {first.name: -3.9e-4, second.name: 4e-7}, covariance, 1.0, 0.0, 100, True, 3)
    shorter = without_idle_terms(law, fitted)
    assert shorter.families[0].terms == ({"M_z": "sin(2.0 * phi)"},)
    assert shorter.formulas == {"M_z": "c_0 * (sin(2.0 * phi))"}
    assert shorter.candidate.start == (-3.9e-4,)
    assert shorter.candidate.name == "test_idle"
    busy = replace(fitted, values={first.name: -3.9e-4, second.name: 4e-5})
    assert without_idle_terms(law, busy) is law
