"""Sigmas that know of a law's form being another than the truth's, and slip that is not followed for ever."""

from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest
from numpy.testing import assert_allclose

from disctrack.diagnosis import form_misfit
from disctrack.rolling import Model, sensitivities, simulate, steady_precession
from disctrack.rolling.model import body_constants
from disctrack.synthetic.description import Scene

DISC = Scene().declared_disc


def test_numbers_beside_a_misfit_scatter_as_generalised_least_squares_has_it(rng):
    """Right = A p + f B u + noise: about the plain estimate, GLS' covariance and the square of what it moves by."""
    A, B, right = rng.standard_normal((40, 3)), rng.standard_normal((40, 6)), rng.standard_normal(40)
    taken, beside = form_misfit.absorbed(A, np.column_stack([B, right])), np.eye(40) - A @ np.linalg.pinv(A)
    second, misfit = form_misfit._second_moment(beside @ B, beside @ right, [6], np.array([0.7]))
    taken = taken[:, :6]
    found = np.linalg.inv(A.T @ A) + taken @ second @ taken.T
    weight = np.linalg.inv(np.eye(40) + 0.49 * B @ B.T)
    covariance = np.linalg.inv(A.T @ weight @ A)
    moved = covariance @ A.T @ weight @ right - np.linalg.lstsq(A, right, rcond=None)[0]
    assert_allclose(found, covariance + np.outer(moved, moved), rtol=1e-9)
    assert misfit == pytest.approx(0.7)


def test_what_the_recording_does_not_show_of_a_misfit_is_as_large_as_before_the_data(rng):
    """Of three parts one is seen and absent, one is seen and there, one leaves no trace: each has a size of its own."""
    B = 1e3 * rng.standard_normal((400, 60))
    B[:, 40:] = 0.0
    right = rng.standard_normal(400) + 0.1 * B[:, 20:40] @ rng.standard_normal(20)
    second, _ = form_misfit._second_moment(B, right, [20, 20, 20])
    sizes = [float(np.sqrt(np.mean(np.diag(second)[20 * i : 20 * i + 20]))) for i in range(3)]
    assert sizes[0] < 0.003
    assert sizes[1] == pytest.approx(0.1, rel=0.4)
    assert sizes[2] == pytest.approx(float(np.sqrt(np.mean(form_misfit.SIZES**2))), rel=1e-6)


def moments_on_one_motion(*models):
    """(n, 3) about the contact by each of the models, on the motion of the first."""
    motion = simulate(models[0], steady_precession(np.radians(14.0), DISC), times=np.linspace(0.0, 0.1, 10))
    systems = (SimpleNamespace(disc=DISC, model_with=lambda _, m=model: m) for model in models)
    return [form_misfit.moment_about_contact(system, {}, motion) for system in systems]


def test_the_moment_of_a_law_of_the_air_is_that_of_the_air_of_the_recording():
    """In a third of the air, a third of the moment on the same motion."""
    thick = Model(DISC, air_density=1.2).with_values({"air_quadratic.a": 0.5})
    moments = moments_on_one_motion(thick, replace(thick, air_density=0.4))
    assert np.abs(moments[0]).max() > 1e-8
    assert_allclose(moments[1], moments[0] / 3, rtol=1e-12)


def test_a_tilted_table_counts_as_the_force_along_it():
    """The same moment as a level force m g tilt at the centre, on the same motion."""
    tilted = Model(DISC).with_values({"table_tilt.tilt_x": 1e-3, "table_tilt.tilt_y": -4e-4})
    body = body_constants(tilted, 0.01)
    force = {"spring.F_x": DISC.mass * body["g_x"], "spring.F_y": DISC.mass * body["g_y"]}
    moments = moments_on_one_motion(tilted, Model(DISC).with_values({"spring.k": 0.0} | force))
    assert np.abs(moments[1]).max() > 1e-6
    assert_allclose(moments[0][:, 2], moments[1][:, 2], rtol=1e-9)
    by_weight = 0.5 * (1e-3**2 + 4e-4**2) * DISC.mass * 9.81 * DISC.radius  # 1 - cos(tilt) of it is missing
    assert_allclose(moments[0], moments[1], atol=1.01 * by_weight)


def test_slip_that_takes_too_long_is_not_followed():
    """A friction just below what rolling needs: thousands of steps for a tenth of a second, and no derivative."""
    start = steady_precession(np.radians(14.0), DISC, omega3=1.0, nutation_amplitude=np.radians(0.5))
    model, times = Model(DISC).with_values({"slip.mu": 0.06}), np.linspace(0.0, 0.3, 30)
    whole = sensitivities(model, start, times, components=["theta"])
    assert np.isfinite(whole.dq).all()
    assert whole.slip_steps > 1000
    cut = sensitivities(model, start, times, components=["theta"], max_steps=whole.slip_steps // 4)
    assert not np.isfinite(cut.dq).all()
    assert cut.slip_steps <= whole.slip_steps // 4


def test_a_sum_or_a_law_with_alternatives_of_another_form_is_taken_for_another_s():
    """One law that nothing else comes near to has its form nearly for certain; two that are needed have it not."""

    def law(*families, others=()):
        return SimpleNamespace(
            families=[SimpleNamespace(kind=k, terms=[{c: "1.0"}]) for k, c in families], others=others
        )

    alone, other, other_axis = law(("angle", "M_n")), law(("hum", "X_n")), law(("angle", "M_z"))
    assert form_misfit.form_is_another(alone) == form_misfit.SELDOM
    assert form_misfit.form_is_another(law(("angle", "M_n"), ("hum", "X_n"))) == 1.0
    assert form_misfit.form_is_another(alone, {"kz"}) == 1.0
    for one in (other, other_axis, law(("angle", "M_n"), ("hum", "X_n")), law()):  # the last: known effects alone
        assert form_misfit.form_is_another(law(("angle", "M_n"), others=[(one, 1.0)])) == pytest.approx(0.5)
    same = [(law(("angle", "M_n")), 1.0)]  # a variation of the same idea, whose course is in the sigma anyway
    assert form_misfit.form_is_another(law(("angle", "M_n"), others=same)) == form_misfit.SELDOM
