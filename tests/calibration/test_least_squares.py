"""Shared and own numbers against one dense problem in all of them, by SciPy and by NumPy."""

from dataclasses import replace

import numpy as np
import pytest
from numpy.testing import assert_allclose
from scipy.optimize import least_squares

from calibration.kit.least_squares import (
    covariance_within,
    eliminate,
    minimise,
    normal_of_rows,
    scaled_solve,
    solve_bounded,
    triangle,
)

BLOCKS, SAMPLES, SIGMA = 12, 15, 0.02
TIME = np.linspace(0.0, 2.0, SAMPLES)


def decays(rng):
    """Decays with one rate and one floor for all, every curve with an amplitude of its own: (blocks, samples)."""
    amplitude = rng.uniform(0.5, 2.0, BLOCKS)
    return amplitude[:, None] * np.exp(-1.3 * TIME) + 0.2 + SIGMA * rng.normal(size=(BLOCKS, SAMPLES))


class Decays:
    """The model as data: (rate, floor), amplitudes. `wrong` spoils the derivative by the rate."""

    def __init__(self, data, prior=None, huber=np.inf, wrong=1.0):
        self.data, self.prior, self.huber, self.wrong = data, prior, huber, wrong
        self.start = np.array([0.5, 0.0]), np.ones(BLOCKS)

    def residuals(self, shared, own):
        return (self.data - own[:, None] * np.exp(-shared[0] * TIME) - shared[1]) / SIGMA

    def linearise(self, model):
        (rate, _), own = model
        r, fall = self.residuals(*model), np.exp(-rate * TIME)
        by_rate = -self.wrong * own[:, None] * TIME * fall
        rows = np.stack([np.broadcast_to(fall, r.shape), by_rate, np.ones_like(r), r * SIGMA], axis=-1) / SIGMA
        within = np.minimum(np.abs(r), self.huber)
        normal = normal_of_rows(rows * np.sqrt(within / np.maximum(np.abs(r), 1e-300))[..., None], 1)
        normal = replace(normal, costs=np.sum(within * (2 * np.abs(r) - within), axis=1))
        if self.prior is not None:
            row = np.array([0.0, 1.0, self.prior[0] - model[0][1]]) / self.prior[1]
            normal = replace(normal, prior=np.outer(row, row))
        return normal

    def fitted(self, **options):
        return minimise(self.linearise, lambda m, s, p: (m[0] + s, m[1] + p[:, 0]), self.start, **options)

    def dense(self):
        """SciPy's minimum of the same loss in all numbers, and its Jacobian there."""

        def losses(x):
            r = np.abs(self.residuals(x[:2], x[2:])).ravel()
            within = np.minimum(r, self.huber)
            extra = [] if self.prior is None else [(x[1] - self.prior[0]) / self.prior[1]]
            return np.concatenate([np.sqrt(within * (2 * r - within)), extra])

        return least_squares(losses, np.concatenate(self.start), xtol=1e-14, ftol=1e-14, gtol=1e-14)


@pytest.mark.parametrize("prior", [None, (0.3, 0.01)])
def test_minimum_and_covariances_are_those_of_one_dense_problem(rng, prior):
    problem = Decays(decays(rng), prior)
    found, dense = problem.fitted(tolerance=1e-14), problem.dense()
    assert found.converged
    assert_allclose(found.normal.cost, 2 * dense.cost, rtol=1e-10)
    assert_allclose(np.concatenate(found.model), dense.x, atol=1e-6 * SIGMA)
    C = np.linalg.inv(dense.jac.T @ dense.jac)
    shared, own, cross = found.normal.covariances()
    assert_allclose(shared, C[:2, :2], rtol=1e-5)
    assert_allclose(own[:, 0, 0], np.diag(C)[2:], rtol=1e-5)
    assert_allclose(cross[..., 0], C[:2, 2:].T, rtol=1e-4, atol=1e-6 * np.abs(C).max())
    assert_allclose(np.linalg.inv(found.normal.eliminated()[:-1, :-1]), shared, rtol=1e-9)


def test_a_robust_loss_has_the_minimum_that_scipy_finds(rng):
    data = decays(rng)
    data[rng.integers(0, BLOCKS, 8), rng.integers(0, SAMPLES, 8)] += 1.0
    problem = Decays(data, huber=2.0)
    found, plain = problem.fitted(iterations=200), Decays(data).fitted()
    dense = least_squares(
        lambda x: problem.residuals(x[:2], x[2:]).ravel(), np.concatenate(problem.start), loss="huber", f_scale=2.0,
        xtol=1e-14, ftol=1e-14, gtol=1e-14,
    )  # fmt: skip
    assert found.converged
    assert_allclose(np.concatenate(found.model), dense.x, atol=1e-3 * SIGMA)
    assert abs(found.model[0][0] - 1.3) < 0.1 * abs(plain.model[0][0] - 1.3)


def test_a_wrong_derivative_is_noticed(rng):
    """The control: the gain that a step promises is not what it brings, and the minimum is not found."""
    data = decays(rng)
    right, wrong = (Decays(data, wrong=factor) for factor in (1.0, -1.0))
    for problem, honest in ((right, True), (wrong, False)):
        at = (np.array([1.25, 0.19]), right.fitted().model[1])
        normal = problem.linearise(at)
        shared, own = normal.step()
        small = 1e-4
        there = problem.linearise((at[0] + small * shared, at[1] + small * own[:, 0]))
        assert (abs((normal.cost - there.cost) / (2 * small * normal.gain(shared, own)) - 1) < 1e-2) == honest
    failed = wrong.fitted()
    assert not failed.converged or failed.normal.cost > 1.1 * right.fitted().normal.cost


def test_a_start_without_prediction_is_told():
    found = minimise(lambda m: replace(normal_of_rows(np.zeros((1, 1, 3)), 1), costs=np.array([np.inf])), None, 0.0)
    assert (found.iterations, found.converged) == (0, False)


def test_a_block_without_data_keeps_its_numbers_and_moves_no_other(rng):
    data = decays(rng)
    data[3] = np.nan
    problem = Decays(np.nan_to_num(data))
    whole = problem.linearise(problem.start)
    seen = np.delete(np.arange(BLOCKS), 3)
    names = ("products", "costs")
    parts = {name: getattr(whole, name).copy() for name in names}
    others = replace(whole, **{name: part[seen] for name, part in parts.items()})
    for part in parts.values():
        part[3] = 0.0
    empty = replace(others, **parts)
    (shared, own), (expected, own_expected) = empty.step(0.1), others.step(0.1)
    assert_allclose(shared, expected, rtol=1e-12)
    assert_allclose(own[seen], own_expected, rtol=1e-12)
    assert own[3, 0] == 0.0
    assert_allclose(empty.covariances()[0], others.covariances()[0], rtol=1e-12)


def test_shared_numbers_that_cannot_be_parted_are_an_error_of_the_normal_equations(rng):
    rows = rng.normal(size=(5, 8, 4))
    rows[..., 2] = 0.0
    with pytest.raises(np.linalg.LinAlgError):
        normal_of_rows(rows, 1).step()
    assert_allclose(scaled_solve(np.diag([1e-12, 1e12]), np.array([1e-12, 1e12])), 1.0)


def test_what_each_block_left_out_would_change_is_what_fits_without_it_show(rng):
    rows = rng.normal(size=(40, 9, 5))
    normal = normal_of_rows(rows, 2)
    minimum = normal.step()[0]
    rows[..., -1] -= rows[..., 2:4] @ minimum  # at the minimum
    normal = normal_of_rows(rows, 2)
    shift, expected, inverse, _ = normal.shifts(2)
    scale = 1 / np.sqrt(np.diag(normal.eliminated())[:-1])
    for i in (0, 7):
        without = normal_of_rows(np.delete(rows, i, axis=0), 2).step()[0]
        assert_allclose(without, -shift[i] * scale, atol=0.2 * np.abs(shift[i] * scale).max())  # to first order
    assert 0.5 < normal.disagreement(2) < 1.6  # noise: 80 numbers
    assert np.trace(expected) > 0
    assert inverse.shape == (2, 2)
    rows[: len(rows) // 2, :, -1] += 3 * rows[: len(rows) // 2, :, 2]  # half of the blocks want another number
    assert normal_of_rows(rows, 2).disagreement(2) > 3


@pytest.mark.parametrize("m", [3, 6, 400])
def test_rows_left_by_a_block_say_what_the_whole_says(rng, m):
    rows = rng.normal(size=(m, 8)) * 10.0 ** rng.uniform(-4, 4, 8)
    own, left = eliminate(rows, 3)
    assert len(left) <= 8
    A, C, b = rows[:, :3], rows[:, 3:-1], rows[:, -1]
    for x in rng.normal(size=(3, 4)) / np.linalg.norm(C, axis=0):
        best = np.linalg.lstsq(A, b - C @ x)[0]
        found = own.step + own.by_shared @ x
        if m > 3:
            assert_allclose(np.sum((left[:, -1] - left[:, :-1] @ x) ** 2), np.sum((b - C @ x - A @ best) ** 2))
        assert_allclose(A @ found, A @ best, rtol=1e-6, atol=1e-9 * np.abs(b).max())
    assert_allclose(own.root @ own.root.T, np.linalg.inv(A.T @ A), rtol=1e-6)


def test_an_open_direction_has_no_step_no_variance_and_is_told(rng):
    rows = rng.normal(size=(30, 6))
    rows[:, 1] = 2 * rows[:, 0]
    own, left = eliminate(rows, 3)
    assert own.open.shape == (3, 1)
    assert_allclose(rows[:, :3] @ own.open, 0.0, atol=1e-12)
    alone, expected = eliminate(rows[:, [0, 2, 3, 4, 5]], 2)
    assert_allclose(triangle(left).T @ triangle(left), triangle(expected).T @ triangle(expected), rtol=1e-9, atol=1e-9)
    assert_allclose(own.gain, alone.gain)
    nothing, left = eliminate(np.column_stack([np.zeros(30), rows]), 1)
    assert (nothing.root.size, nothing.step[0], nothing.gain) == (0, 0.0, 0.0)
    assert_allclose(left.T @ left, rows.T @ rows, atol=1e-9)


def test_bounded_solutions_are_those_of_scipy_and_a_number_at_a_bound_is_uncertain_inside(rng):
    A, b = rng.normal(size=(40, 3)), rng.normal(size=40)
    C = np.linalg.inv(A.T @ A)
    free = C @ A.T @ b
    bound = free[0] + np.sqrt(C[0, 0])  # by one sigma better than the data want
    lower, upper = np.array([bound, -np.inf, -np.inf]), np.full(3, np.inf)
    R = triangle(np.column_stack([A, b]))
    x = solve_bounded(R[:, -1], R[:, :-1], lower, upper)
    start = [bound + 1.0, 0.0, 0.0]
    dense = least_squares(lambda x: b - A @ x, start, bounds=(lower, upper), xtol=1e-15, ftol=1e-15, gtol=1e-15)
    assert_allclose(x, dense.x, atol=1e-6)
    assert x[0] == bound
    # against numbers drawn from the likelihood, of which those inside the bound are kept
    drawn = rng.multivariate_normal(free, C, 100_000)
    drawn = drawn[drawn[:, 0] > bound]
    second = (drawn - x).T @ (drawn - x) / len(drawn)
    assert_allclose(covariance_within(A, b - A @ x, x, lower, upper), second, rtol=0.05, atol=0.03 * C.max())
    assert not np.allclose(C, second, rtol=0.05)  # as if there were no bound
