"""Levenberg-Marquardt for many small problems at once; it has never heard of discs."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from calibration.arrays import Array, Mask

State = tuple[Array, ...]  # arrays with the problems on the first axis
MAX_DAMPING = 1e10


@dataclass(frozen=True)
class BatchFit:
    """Minima of n independent least-squares problems with p parameters each."""

    state: State
    cost: Array  # (n,) sum of squared whitened residuals at the minimum
    normal_matrix: Array  # (n, p, p) J^T J at the minimum
    converged: Mask  # (n,)
    n_iterations: int


def levenberg_marquardt(
    evaluate: Callable[[State], tuple[Array, Array]],
    retract: Callable[[State, Array], State],
    start: State,
    tolerance: float = 1e-3,
    max_iterations: int = 60,
) -> BatchFit:
    """Minimise |r|^2 for n problems side by side (Marquardt 1963, with Nielsen-like damping per problem).

    evaluate(state) -> whitened residuals (n, k) and Jacobian (n, k, p), zeros for missing data.
    retract(state, step (n, p)) -> state moved by the steps, also on curved spaces.
    A problem has converged when its Gauss-Newton step is shorter than `tolerance` standard deviations of its own
    parameters, sqrt(step^T J^T J step); so no unit of any parameter needs to be known here.
    """
    state = start
    residuals, jacobian = evaluate(state)
    n, p = jacobian.shape[0], jacobian.shape[2]
    cost = np.sum(residuals**2, axis=1)
    gradient, normal = _normal_equations(residuals, jacobian)
    damping = np.full(n, 1e-8)
    converged = np.zeros(n, bool)
    identity = np.eye(p, dtype=bool)
    n_iterations = 0
    while n_iterations < max_iterations:
        n_iterations += 1
        diagonal = np.where(identity, normal, 0.0)
        # a parameter that no datum sees stays where it is
        unseen = identity & (np.abs(normal) <= 1e-300)
        step = np.linalg.solve(normal + damping[:, None, None] * diagonal + unseen, gradient[..., None])[..., 0]
        step[converged] = 0.0
        trial = retract(state, step)
        trial_residuals, trial_jacobian = evaluate(trial)
        trial_cost = np.sum(trial_residuals**2, axis=1)
        length2 = np.einsum("ni,nij,nj->n", step, normal, step)
        small = (length2 < tolerance**2) & (damping < 1e-2)
        better = (trial_cost < cost) | (small & (trial_cost <= cost * (1 + 1e-9) + 1e-12))
        better &= ~converged & np.isfinite(trial_cost)
        state = tuple(np.where(_broad(better, new), new, old) for new, old in zip(trial, state, strict=True))
        residuals = np.where(better[:, None], trial_residuals, residuals)
        jacobian = np.where(better[:, None, None], trial_jacobian, jacobian)
        cost = np.where(better, trial_cost, cost)
        gradient, normal = _normal_equations(residuals, jacobian)
        converged |= small
        damping = np.where(better, np.maximum(damping * 0.1, 1e-10), np.maximum(damping * 30.0, 1e-4))
        if np.all(converged | (damping > MAX_DAMPING)):
            break
    return BatchFit(state, cost, normal, converged, n_iterations)


def step_to_minimum(residuals: Array, jacobian: Array) -> Array:
    """Gauss-Newton steps (n, p) for residuals (n, k) and Jacobians (n, k, p); none where a parameter is not seen.

    A trace of damping stands in for the pseudo-inverse where data leave a combination open; that costs ten times more.
    """
    gradient, normal = _normal_equations(residuals, jacobian)
    diagonal = np.einsum("nii->ni", normal)  # a view
    diagonal *= 1 + 1e-10
    diagonal += diagonal < 1e-300
    return np.asarray(np.linalg.solve(normal, gradient[..., None])[..., 0], float)


def _normal_equations(residuals: Array, jacobian: Array) -> tuple[Array, Array]:
    """J^T r with the sign of a descent step, and J^T J (r = observed - model, J = d model / d parameters)."""
    transposed = np.swapaxes(jacobian, 1, 2)
    return (transposed @ residuals[..., None])[..., 0], transposed @ jacobian


def _broad(mask: Mask, like: NDArray[Any]) -> Mask:
    return mask.reshape(-1, *([1] * (like.ndim - 1)))


def chance_beyond(chi_square: ArrayLike, freedom: ArrayLike) -> Array:
    """Probability that chi-square of so many degrees of freedom (whole numbers) is larger; NaN stays.

    The finite sums of Abramowitz & Stegun 26.4.4 and 26.4.5; scipy.special would take a third of a second to import.
    """
    half, freedom = 0.5 * np.clip(chi_square, 1e-300, 1e12), np.asarray(freedom)  # finite, and so is the logarithm
    odd, log = freedom % 2 == 1, np.log(half)
    tail = np.where(odd, np.vectorize(math.erfc, [float])(np.sqrt(half)), 0.0)
    for k in range(int(freedom.max(initial=0)) // 2):
        power, scale = np.where(odd, k + 0.5, k), np.where(odd, math.lgamma(k + 1.5), math.lgamma(k + 1.0))
        tail = tail + np.where(2 * k + 2 <= freedom, np.exp(power * log - half - scale), 0.0)
    return tail
