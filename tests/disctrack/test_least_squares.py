"""Levenberg-Marquardt on textbook problems, many at once, against SciPy."""

import numpy as np
from numpy.testing import assert_allclose
from scipy.optimize import least_squares
from scipy.special import chdtrc, chdtri

from disctrack.track.judging import _OF_SIX
from disctrack.track.least_squares import chance_beyond, levenberg_marquardt


def rosenbrock(state):
    x, y = state[0][:, 0], state[0][:, 1]
    residual = -np.stack([10 * (y - x**2), 1 - x], axis=1)
    jacobian = np.zeros((len(x), 2, 2))
    jacobian[:, 0, 0], jacobian[:, 0, 1] = -20 * x, 10
    jacobian[:, 1, 0] = -1
    return residual, jacobian


def shift(state, step):
    return (state[0] + step,)


def test_rosenbrocks_valley_from_many_starts(rng):
    start = rng.uniform(-2, 2, (200, 2))
    fit = levenberg_marquardt(rosenbrock, shift, (start,), tolerance=1e-8, max_iterations=200)
    assert fit.converged.all()
    assert_allclose(fit.state[0], 1.0, atol=1e-7)


def test_exponential_decays_agree_with_scipy(rng):
    t = np.linspace(0, 3, 40)
    truth = rng.uniform([1, 0.5], [3, 2], (30, 2))
    data = truth[:, :1] * np.exp(-truth[:, 1:] * t) + 0.01 * rng.normal(size=(30, 40))

    def evaluate(state):
        a, k = state[0][:, :1], state[0][:, 1:]
        model = a * np.exp(-k * t)
        return (data - model) / 0.01, np.stack([np.exp(-k * t), -t * model], axis=-1) / 0.01

    fit = levenberg_marquardt(evaluate, shift, (np.ones((30, 2)),), tolerance=1e-6)
    for i in range(30):
        reference = least_squares(lambda p, i=i: (p[0] * np.exp(-p[1] * t) - data[i]) / 0.01, [1, 1], xtol=1e-14)
        # stopped within 1e-6 sigma of the minimum; a sigma is about 3e-3
        assert_allclose(fit.state[0][i], reference.x, atol=1e-7)
        assert_allclose(fit.normal_matrix[i], reference.jac.T @ reference.jac, rtol=1e-4)


def test_a_parameter_without_data_stays_put():
    def evaluate(state):
        residual = (2.0 - state[0][:, :1]).repeat(2, axis=1)
        jacobian = np.zeros((len(residual), 2, 2))
        jacobian[:, :, 0] = 1
        return residual, jacobian

    fit = levenberg_marquardt(evaluate, shift, (np.array([[0.0, 5.0]]),))
    assert_allclose(fit.state[0], [[2.0, 5.0]], atol=1e-12)


def test_a_problem_without_a_minimum_is_not_called_converged():
    def evaluate(state):
        x = state[0]
        return -np.exp(-x), -np.exp(-x)[..., None]  # falls for ever

    fit = levenberg_marquardt(evaluate, shift, (np.zeros((1, 1)),), tolerance=1e-9, max_iterations=10)
    assert not fit.converged[0]


def test_the_tail_of_chi_square_agrees_with_scipy(rng):
    freedom = rng.integers(1, 400, 2000)
    square = freedom * rng.uniform(0, 3, 2000)
    assert_allclose(chance_beyond(square, freedom), chdtrc(freedom, square), rtol=1e-11, atol=1e-300)
    assert_allclose(chance_beyond([0.0, 3.0, np.inf, np.nan], [4, 1, 6, 18]), [1.0, chdtrc(1, 3.0), 0.0, np.nan])
    assert not np.allclose(chance_beyond(square, freedom + 1), chdtrc(freedom, square))  # one too many shows
    for chance, limit in _OF_SIX.items():
        assert_allclose(chdtri(6, chance), limit, rtol=1e-12)
