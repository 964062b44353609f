"""Least squares with shared parameters and parameters of single blocks of data (here called own).

    chi-square(s, p_1, ..., p_n) = sum_b |r_b - C_b s - P_b p_b|^2 + priors

The own parameters p_b are eliminated block by block (Schur complement; Triggs et al. 2000, Bundle Adjustment: A Modern
Synthesis, section 6), so that the cost is linear in the number of blocks, not cubic. There are two ways:

- `Normal`: the normal equations of thousands of small blocks at once, and Levenberg-Marquardt on them (`minimise`).
- `eliminate`: QR of the rows of one block; does not square the condition number, and finds undetermined directions.

Residuals are observed minus predicted, in standard deviations; derivatives are those of the prediction. Robust weights
are applied by the caller: rows times the square root of the weight, and the loss itself as the cost.
"""

from collections.abc import Callable
from dataclasses import dataclass
from typing import Generic, TypeVar

import numpy as np
import scipy

from calibration.kit.types import Array

# Rounding error of chi-square, a thousandth of a sigma: it is a sum of squared differences of pixel coordinates that
# are a million times as large.
ROUNDED_AWAY = 1e-6
UNDETERMINED = 1e-12  # singular value over the largest, below which a direction is undetermined
NEAR = 1e-3  # sigmas from a bound, within which a parameter is at the bound


@dataclass(frozen=True)
class Normal:
    """Normal equations of one linearisation: k own parameters of each of n blocks, and s shared ones.

    They are products of whitened rows [own | shared | residual], which contain information, gradient and chi-square.
    An own parameter on which no data of its block depend is fixed, with a variance of 1.
    """

    products: Array  # (n, k + s + 1, k + s + 1) of each block's data
    k: int
    costs: Array  # (n,) chi-square, or a robust loss; inf without a prediction
    prior: Array  # (s + 1, s + 1) [shared | residual] of the prior, with its loss in the place of chi-square

    @property
    def cost(self) -> float:
        """Sum over all blocks and the prior; inf if a prediction failed."""
        return float(self.costs.sum() + self.prior[-1, -1])

    def own_held(self, damping: float = 0.0) -> Array:
        """(n, k, k) information of the own parameters, with a one on the diagonal for those without data."""
        own = self.products[:, : self.k, : self.k]
        diagonal = np.einsum("nii->ni", own)
        return np.asarray(own + (damping * diagonal + (diagonal == 0.0))[..., None] * np.eye(self.k), float)

    def carried(self, damping: float = 0.0) -> Array:
        """(n, k, s + 1) response of the own parameters to the shared ones, and their step at fixed shared ones."""
        return np.asarray(np.linalg.solve(self.own_held(damping), self.products[:, : self.k, self.k :]), float)

    def eliminated(self, damping: float = 0.0, carried: Array | None = None) -> Array:
        """(s + 1, s + 1) products of [shared | residual] with the prior, with the own parameters eliminated."""
        carried, k = self.carried(damping) if carried is None else carried, self.k
        total = self.products[:, k:, k:].sum(0) + self.prior
        total[:-1, :-1] += damping * np.diag(np.diag(total)[:-1])
        width = len(total)
        return total - self.products[:, :k, k:].reshape(-1, width).T @ carried.reshape(-1, width)

    def step(self, damping: float = 0.0) -> tuple[Array, Array]:
        """Damped step of the shared parameters (s,) and of the own ones (n, k)."""
        carried = self.carried(damping)
        square = self.eliminated(damping, carried)
        step = scaled_solve(square[:-1, :-1], square[:-1, -1])
        return step, carried[..., -1] - carried[..., :-1] @ step

    def gain(self, shared: Array, own: Array) -> float:
        """Predicted decrease of the cost by an undamped step."""
        gradient = self.products[:, self.k : -1, -1].sum(0) + self.prior[:-1, -1]
        return float(shared @ gradient + np.sum(own * self.products[:, : self.k, -1]))

    def covariances(self) -> tuple[Array, Array, Array]:
        """Covariances of the shared parameters (s, s), of each block's own (n, k, k), and between both (n, s, k)."""
        carried = self.carried()
        information = self.eliminated(carried=carried)[:-1, :-1]
        shared = scaled_solve(information, np.eye(len(information)))
        cross = -shared @ np.swapaxes(carried[..., :-1], 1, 2)
        return shared, np.linalg.inv(self.own_held()) - carried[..., :-1] @ cross, cross

    def shifts(self, first: int, common: Array | None = None) -> tuple[Array, Array, Array, Array]:
        """Shifts of the `first` shared parameters if each block is left out in turn, in units of a `scale`.

        To first order the shift is H^-1 g_b with g_b the block's gradient at the common minimum; noise alone gives
        E[g_b g_b^T] = H_b - H_b H^-1 H_b. The prior is not a block, but part of H.

        common : (n, s, s) covariance of contributions to the blocks' gradients other than the noise of the data
        returns : shifts (n, first), the sum of the expected g_b g_b^T (s, s), H^-1 (s, first), and the scale (s,)
        """
        k = self.k
        squares = self.products[:, k:, k:] - np.swapaxes(self.products[:, :k, k:], 1, 2) @ self.carried()
        information, gradient = squares[:, :-1, :-1], squares[:, :-1, -1]
        total = information.sum(0) + self.prior[:-1, :-1]
        scale = 1.0 / np.sqrt(np.diag(total))  # the parameters' units differ by 10^6
        information, gradient = information * scale[:, None] * scale, gradient * scale
        inverse = np.linalg.inv(total * scale[:, None] * scale)
        expected = (information - information @ inverse @ information).sum(0)
        covariance: Array = inverse[:, :first]
        if common is not None:
            common = common * scale[:, None] * scale
            total, part = common.sum(0), information @ inverse
            left = common - part @ common - np.swapaxes(part @ common, 1, 2)
            expected = expected + (left + part @ total @ np.swapaxes(part, 1, 2)).sum(0)
        return gradient @ covariance, expected, covariance, scale

    def disagreement(self, first: int) -> float:
        """Variance of the `first` shared parameters from the scatter of blocks, over that predicted by noise."""
        shift, spread, covariance, _ = self.shifts(first)
        metric = np.linalg.inv(covariance[:first])  # the others are nuisance parameters
        seen = float(np.einsum("ni,ij,nj->", shift, metric, shift))
        expected = float(np.sum(metric * (covariance.T @ spread @ covariance)))
        return seen / expected if expected > 0 else float("nan")


def normal_of_rows(rows: Array, k: int) -> Normal:
    """Normal equations of rows (n, m, k + s + 1): [own | shared | residual], padded with zeros."""
    products = np.swapaxes(rows, 1, 2) @ rows
    return Normal(products, k, products[:, -1, -1], np.zeros(2 * (rows.shape[-1] - k,)))


def scaled_solve(A: Array, b: Array) -> Array:
    """Solve A x = b after scaling A to a unit diagonal, as units differ by 10^6. LinAlgError if singular."""
    scale = 1.0 / np.sqrt(np.maximum(np.diag(A), 1e-300))
    columns = scale if b.ndim == 1 else scale[:, None]
    return np.linalg.solve(A * scale[:, None] * scale, b * columns) * columns


def solve_each(A: Array, b: Array) -> Array:
    """Argmin |A x - b| for each of many small systems (n, m, k) and (n, m, j): x (n, k, j)."""
    transposed = np.swapaxes(A, -1, -2)
    return np.asarray(np.linalg.solve(transposed @ A, transposed @ b), float)


Model = TypeVar("Model")


@dataclass(frozen=True)
class Minimum(Generic[Model]):
    """Result of Levenberg-Marquardt."""

    model: Model
    normal: Normal
    iterations: int  # 0 if the start has no prediction
    converged: bool


def minimise(
    linearise: Callable[[Model], Normal],
    stepped: Callable[[Model, Array, Array], Model],
    start: Model,
    iterations: int = 60,
    tolerance: float = 1e-10,
    damping: float = 1e-3,
    rough: bool = False,
) -> Minimum[Model]:
    """Levenberg-Marquardt; converged if the predicted gain of a full step is below tolerance x cost.

    The predicted gain g^T H^-1 g does not depend on units, and vanishes with the gradient.

    stepped : the model after a step of the shared parameters (s,) and of the own ones (n, k)
    rough : a last step below the tolerance is taken without evaluation, and `normal` is that before it; for callers
        that need the model alone
    """
    model, normal = start, linearise(start)
    to_gain = np.inf  # predicted at the last step with little damping
    if not np.isfinite(normal.cost):
        return Minimum(model, normal, 0, False)
    for iteration in range(1, iterations + 1):
        shared, own = normal.step(damping)
        gain = normal.gain(shared, own)
        to_gain = gain if damping < 1e-2 else to_gain
        trial = stepped(model, shared, own)
        small = gain <= tolerance * max(normal.cost, 1.0)
        if rough and small and damping < 1e-4:
            return Minimum(trial, normal, iteration, True)
        trial_normal = linearise(trial)
        if trial_normal.cost <= normal.cost * (1 + 1e-14):
            model, normal, damping = trial, trial_normal, max(damping * 0.1, 1e-12)
            if damping < 1e-4 and small:
                return Minimum(model, normal, iteration, True)
        else:
            if small:
                return Minimum(model, normal, iteration, damping < 1e-2 or to_gain <= ROUNDED_AWAY)
            damping *= 10.0
            if damping > 1e10:
                break
    return Minimum(model, normal, iterations, to_gain <= ROUNDED_AWAY)


def triangle(matrix: Array) -> Array:
    """R of the QR decomposition of a tall matrix (m, k), in blocks of rows that fit in the processor's cache.

    Its diagonal is made positive: otherwise the signs are arbitrary, and with them noise that is drawn for the rows.
    """
    m, k = matrix.shape
    piece = 8 * max(k, 1)
    whole = m // piece
    if whole < 2:
        R = np.linalg.qr(matrix, mode="r")
        return np.asarray(np.where(np.diag(R) < 0, -1.0, 1.0)[:, None] * R, float)
    parts = np.asarray(np.linalg.qr(matrix[: whole * piece].reshape(whole, piece, k), mode="r")).reshape(-1, k)
    return triangle(np.vstack([parts, matrix[whole * piece :]]))


@dataclass(frozen=True)
class OwnNumbers:
    """The own parameters (k) of one block, given the shared ones (s)."""

    root: Array  # (k, r): root @ root.T is their covariance at given shared ones
    open: Array  # (k, k - r) undetermined directions, along which no step is made
    by_shared: Array  # (k, s) derivative of their best values by the shared ones
    step: Array  # (k,) to their best values ...
    gain: float  # ... and the decrease of chi-square by it


def eliminate(rows: Array, k: int) -> tuple[OwnNumbers, Array]:
    """Own parameters of a block of rows (m, k + s + 1), [own | shared | residual], and the reduced rows.

    The reduced rows [shared | residual], at most k + s + 1, have the own parameters eliminated.
    """
    R = triangle(rows)
    head = R[:k, :k]
    length = np.linalg.norm(head, axis=0)
    length = np.where(length > 0, length, 1.0)
    U, singular, V = np.linalg.svd(head / length)
    r = int(np.sum(singular > UNDETERMINED * max(singular.max(initial=0.0), 1e-100)))
    taken = U.T @ R[: len(U), k:]
    directions = V.T / length[:, None]
    root, along = directions[:, :r] / singular[:r], taken[:r, -1]
    own = OwnNumbers(root, directions[:, r:], -root @ taken[:r, :-1], root @ along, float(along @ along))
    return own, np.concatenate([taken[r:], R[len(U) :, k:]])


def solve_bounded(right: Array, matrix: Array, lower: Array, upper: Array) -> Array:
    """Argmin |right - matrix x| with lower <= x <= upper; the shortest x if directions are undetermined."""
    length = np.linalg.norm(matrix, axis=0)
    if length.size == 0:
        return np.zeros(0)
    scale = 1.0 / np.where(length > 0, length, 1.0)
    scaled = matrix * scale
    x = np.asarray(np.linalg.lstsq(scaled, right, rcond=UNDETERMINED)[0] * scale, float)
    if bool(np.all((x >= lower) & (x <= upper))):
        return x
    with np.errstate(invalid="ignore", over="ignore"):  # far from a solution products of large numbers overflow
        bounds = (lower / scale, upper / scale)
        inside = scipy.optimize.lsq_linear(scaled, right, bounds, tol=1e-12)
        found = np.asarray(inside.x * scale, float)
    if not np.isfinite(found).all():
        return np.clip(x, lower, upper)
    return np.where(inside.active_mask < 0, lower, np.where(inside.active_mask > 0, upper, found))


def covariance_within(matrix: Array, right: Array, x: Array, lower: Array, upper: Array) -> Array:
    """Covariance of parameters about x, some of which are at a bound; zero rows for undetermined ones.

    A parameter at a bound is still uncertain: its variance is the second moment about the bound of the normal
    distribution truncated there, which also adds to the variance of correlated parameters.
    """
    k = len(x)
    covariance = np.zeros((k, k))
    if len(matrix) == 0 or k == 0:
        return covariance
    free = _covariance(matrix)
    sigma = np.sqrt(np.maximum(np.diag(free), 0.0))
    outwards = np.where(x - lower <= NEAR * sigma, -1.0, np.where(upper - x <= NEAR * sigma, 1.0, 0.0))
    held = np.flatnonzero(outwards)
    if held.size == 0:
        return free
    others = np.flatnonzero(outwards == 0)
    covariance[np.ix_(others, others)] = _covariance(matrix[:, others])
    held = held[sigma[held] > 0]
    beyond = outwards[held] * (free @ (matrix.T @ right))[held] / sigma[held]
    share = np.array([_within_bound(float(t)) for t in beyond])
    across = np.eye(k)[:, held]
    correlation = free[np.ix_(held, held)] / np.outer(sigma[held], sigma[held])
    across[others] = free[np.ix_(others, held)] / sigma[held] @ np.linalg.pinv(correlation, rcond=1e-10) / sigma[held]
    inside = correlation * np.outer(share * sigma[held], share * sigma[held])
    return np.asarray(covariance + across @ inside @ across.T, float)


def _within_bound(beyond: float) -> float:
    """Rms distance from a bound of a truncated normal variable, whose mean is `beyond` sigmas outside the bound."""
    t = max(beyond, 0.0)
    if t > 8.0:  # the exponential tail
        return float(np.sqrt(2.0) / t)
    hazard = np.exp(-0.5 * t * t) / np.sqrt(2 * np.pi) / scipy.special.ndtr(-t)
    return float(np.sqrt(max(1.0 + t * t - t * hazard, 0.0)))


def _covariance(matrix: Array) -> Array:
    """Inverse of the normal matrix of rows (m, k); undetermined directions get zero variance."""
    known = eliminate(np.column_stack([matrix, np.zeros(len(matrix))]), matrix.shape[1])[0]
    return np.asarray(known.root @ known.root.T, float)
