"""How well is a law known whose form was picked from a library? Its course over time, and what its form may be off by.

A fit takes the form for exact: its sigmas are those of the coefficients. The true law has another form, of which the
data show little. So the moment about the contact is taken for the law's plus a misfit: a normal process with a
correlation as long as a probe, of a size in proportion to the law's own. The size's probability follows from the
residual (Kennedy and O'Hagan 2001: a discrepancy beside the parameters), and all numbers are averaged over it.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from calibration.arrays import Array
from disctrack.diagnosis.disc.learned_law import WIDTH, LearnedLaw, probe
from disctrack.diagnosis.disc.motion import state_of
from disctrack.diagnosis.disc.system import DiscSystem
from disctrack.diagnosis.engine.fit import Fit, triangle
from disctrack.diagnosis.engine.system import Values
from disctrack.rolling import Motion, simulate
from disctrack.rolling.evaluate import effect_wrench, kinematics

SIZES = np.logspace(-3, 0, 25)  # of the misfit over the law's rms: before the data, each as probable
STEP = 1e-4  # of a number, for the derivative of the course
UNSEEN = 1e-10  # share of a column's length below which the data do not show it


@dataclass(frozen=True)
class LawCourse:
    """Moment about the contact of all laws of the fitted model, forces at the centre included; along n0, m0, k."""

    time: Array  # (k,) [s]
    moment: Array  # (k, 3) [N m]
    sigma: Array  # (k, 3) with what the law's form may be off by
    misfit: float  # rms of that over the law's own, as the residual has it


def moment_about_contact(system: DiscSystem, values: Values, motion: Motion, only: str | None = None) -> Array:
    """(n, 3) of the effects at `values` on a given motion [N m]; a force X at the centre counts as -r_OA x X.

    A sharp edge on a flat table, as the arm goes.   only : the effect of this name
    """
    model = system.model_with(values)
    k = kinematics(motion.q, motion.qdot, system.disc, model.gravity, motion.time, model.air_density)
    r, h = system.disc.radius, system.disc.half_thickness
    s, c = np.sin(motion.q[:, 4]), np.cos(motion.q[:, 4])
    arm = np.stack([0.0 * s, h * s - r * c, -r * s - h * c], axis=1)
    total = np.zeros((len(motion), 3))
    for effect in model.effects:
        if effect.law is not None and only in (None, effect.name):
            moment, force = effect_wrench(effect, k, motion.contact_force[:, 2])
            total += moment - np.cross(arm, force)
    return total


def with_form(system: DiscSystem, fitted: Fit, law: LearnedLaw, noise: float) -> tuple[Fit, LawCourse | None]:
    """The fit with sigmas that know of the form's misfit, and the law's course; the fit alone where the disc slips.

    system : knows the law.   noise : variance of the residual's noise over that stated
    """
    blocks = probe(system, fitted)
    if blocks is None:
        return fitted, None
    n, k = blocks.n_fitted, len(blocks.time)
    R = triangle(np.vstack([*(part / np.sqrt(noise) for part in blocks.triangles), blocks.prior]))
    course, own, by_number = _courses(system, fitted, law, blocks.time)
    distance = (blocks.time[:, None] - blocks.time) / blocks.spacing
    root = np.linalg.cholesky(np.exp(-0.5 * distance**2) + 1e-6 * np.eye(k))
    S = np.kron(np.eye(3), float(np.sqrt(np.mean(np.sum(own**2, axis=1)))) * root)  # axis by axis, as the probes are
    B = R[:, n:-1] @ S / (WIDTH * np.sqrt(2 * np.pi))  # neighbouring probes add up to this
    U, inverse = _solver(R[:, :n])
    taken = inverse @ (U.T @ B)  # by which the fitted numbers give way to a misfit
    right = R[:, -1] - U @ (U.T @ R[:, -1])
    second, misfit = _second_moment(B - U @ (U.T @ B), right)
    moved = S - by_number @ taken
    variance = np.sum((by_number @ fitted.covariance) * by_number, axis=1) + np.sum((moved @ second) * moved, axis=1)
    variance = np.maximum(variance, 0.0).reshape(3, k).T + _among_rivals(system, fitted, law, course, blocks.time)
    sigma = np.sqrt(variance)
    wider = replace(fitted, covariance=fitted.covariance + taken @ second @ taken.T)
    return wider, LawCourse(blocks.time, course, sigma, misfit)


def _courses(system: DiscSystem, fitted: Fit, law: LearnedLaw, time: Array) -> tuple[Array, Array, Array]:
    """All laws' moment (k, 3) and the law's own, and the former's derivative (3 k, n) by the fitted numbers."""
    values = fitted.values
    motion = _motion(system, values, time)
    course = moment_about_contact(system, values, motion)
    by_number = np.zeros((3 * len(time), len(fitted.names)))
    for i, name in enumerate(fitted.names):
        if system.model.has_name(name) and fitted.sigma(name) > 0:
            step = STEP * max(abs(values[name]), fitted.sigma(name))
            moved = moment_about_contact(system, {**values, name: values[name] + step}, motion)
            by_number[:, i] = ((moved - course) / step)[1:].T.ravel()
    own = moment_about_contact(system, values, motion, law.candidate.effect)
    return course[1:], own[1:], by_number


def _among_rivals(system: DiscSystem, fitted: Fit, law: LearnedLaw, course: Array, time: Array) -> Array:
    """Variance (k, 3) of the course over the laws that describe the data too, each with its odds."""
    motion, total, spread = _motion(system, fitted.values, time), 1.0, np.zeros_like(course)
    for rival, odds in law.rivals:
        moment = moment_about_contact(system.knowing(rival.effect), rival.values, motion)[1:]
        total, spread = total + odds, spread + odds * (moment - course) ** 2
    return np.asarray(spread / total, float)


def _motion(system: DiscSystem, values: Values, time: Array) -> Motion:
    """From the first frame on, at these times after it."""
    times = np.concatenate([[float(system.instants(values)[0])], time])
    return simulate(system.model_with(values), state_of(values), times=times)


def _solver(A: Array) -> tuple[Array, Array]:
    """Orthonormal columns U that span those of A (m, n), and the matrix from U' right to the least-squares solution."""
    length = np.linalg.norm(A, axis=0)
    length = np.where(length > 0, length, 1.0)
    U, singular, V = np.linalg.svd(A / length, full_matrices=False)
    seen = singular > UNSEEN * singular[0]
    return U[:, seen], (V[seen] / singular[seen, None]).T / length[:, None]


def _second_moment(B: Array, right: Array) -> tuple[Array, float]:
    """E[u u'] of right = B f u + noise, u normal of size 1, averaged over f in SIZES, times f^2; and the rms of f."""
    left, shown, W = np.linalg.svd(B, full_matrices=False)
    projected = left.T @ right
    power = (SIZES[:, None] * shown) ** 2
    density = -0.5 * np.sum(np.log1p(power) - projected**2 * power / (1 + power), axis=1)
    weight = np.exp(density - density.max())
    weight /= weight.sum()
    second = np.zeros((B.shape[1], B.shape[1]))
    for w, f, p in zip(weight, SIZES, power, strict=True):
        mean = W.T @ (np.sqrt(p) / (1 + p) * projected)
        second += w * f**2 * (np.eye(len(second)) - (W.T * (p / (1 + p))) @ W + np.outer(mean, mean))
    return second, float(np.sqrt(weight @ SIZES**2))
