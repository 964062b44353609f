"""Uncertainty of a law whose form was selected from a library: model discrepancy of its moment over time.

The standard deviations of a fit assume that the form of the law is exact. The true law may have another form, about
which the data say little. So the moment about the contact is modelled as that of the law plus a discrepancy (Kennedy
and O'Hagan 2001).

- If the form is nearly right, the discrepancy is a Gaussian process with the correlation length of a probe.
- If the form is wrong, it is a sum of processes along each axis: this one, and slow ones multiplied by the harmonics of
  the precession, as of moments that depend on position and direction. Each has its own amplitude, so that a component
  that the recording does not determine may be as large as the law. Features shorter than a probe, as an edge or a blow,
  may be anywhere within it.

Amplitudes are relative to the rms of the law; their posterior follows from the residual. The form is wrong with
certainty if the residual is not noise or the data need a sum of several laws; otherwise with the posterior probability
of the laws of other kinds that describe the data too. The part of the discrepancy that the coefficients of the law can
describe is excluded, so that they stay identifiable (Plumlee 2017).
"""

from collections.abc import Collection, Sequence
from dataclasses import replace
from itertools import pairwise

import numpy as np
from scipy.interpolate import CubicSpline
from scipy.linalg import solve_triangular

from calibration.kit.least_squares import triangle
from calibration.kit.types import Array
from disctrack.diagnosis.disc_system import DiscSystem
from disctrack.diagnosis.law_library import LearnedLaw
from disctrack.diagnosis.missing_force import WIDTH, Course, Probed, probe
from disctrack.diagnosis.motion import THETA_END, state_of
from disctrack.discrepancy.fit import Fit
from disctrack.discrepancy.score import DEPENDENT, cleared, span
from disctrack.discrepancy.significance import evidence
from disctrack.discrepancy.system import Values
from disctrack.rolling import Motion, simulate
from disctrack.rolling.model import body_constants
from disctrack.rolling.motion import effect_wrench

SIZES = np.logspace(-3, 0, 25)  # amplitudes of a process over the law's rms, equally probable a priori
HARMONICS = 2  # of the precession, with which slow processes are multiplied
SLOW = 1.0 / 3.0  # correlation length of a slow process over the length of the recording
LEAST_WRONG = 0.05  # probability that the form is wrong if no other describes the data
SWEEPS = 4  # of coordinate ascent over the amplitudes
STEP = 1e-4  # relative, for numerical derivatives
WITHIN = 8  # instants per probe at which laws are evaluated


def moment_about_contact(
    system: DiscSystem, values: Values, motion: Motion, only: Collection[str] | None = None
) -> Array:
    """(n, 3) of the effects at `values` on a given motion [N m]; a force X at the centre counts as -r_OA x X.

    The lever arm is that of a sharp edge on a flat table. A tilt counts as the force by which gravity differs from the
    declared one.
    only : the effects of these names
    """
    model = system.model_with(values)
    r, h = system.disc.radius, system.disc.half_thickness
    s, c = np.sin(motion.q[:, 4]), np.cos(motion.q[:, 4])
    arm = np.stack([0.0 * s, h * s - r * c, -r * s - h * c], axis=1)
    total = np.zeros((len(motion), 3))
    for effect in model.effects:
        if effect.law is not None and (only is None or effect.name in only):
            moment, force = effect_wrench(effect, motion.instants, motion.contact_force[:, 2])
            total += moment - np.cross(arm, force)
    if only is None:
        body = body_constants(model, THETA_END)
        pull = system.disc.mass * np.array([body["g_x"], body["g_y"], body["g_z"] + model.gravity])
        cp, sp = np.cos(motion.q[:, 3]), np.sin(motion.q[:, 3])
        along = [pull[0] * cp + pull[1] * sp, pull[1] * cp - pull[0] * sp, np.full(len(motion), pull[2])]
        total -= np.cross(arm, np.stack(along, axis=1))
    return total


def with_form(
    system: DiscSystem, fitted: Fit, law: LearnedLaw, noise: float, correlated: bool, companions: Collection[str]
) -> tuple[Fit, Fit, Course | None, float]:
    """The fit with covariances averaged over right and wrong form, and with that of a wrong form; and the laws' moment.

    The moment is that of all laws of the fitted model about the contact, forces at the centre included, with its
    uncertainty including the discrepancy. Last, the rms of the discrepancy over that of the law. If the disc slips
    there is no moment.

    system : its model contains the law.   noise : variance of the noise of the residual over that stated
    correlated : the residual is not white noise
    companions : known effects found together with the law, which may compensate for its form: part of the discrepancy
    """
    blocks = probe(system, fitted)
    if blocks is None:
        return fitted, fitted, None, 0.0
    n, k = blocks.n_fitted, len(blocks.time)
    R = np.vstack([blocks.data / np.sqrt(noise), blocks.prior])
    motion = _motion(system, fitted.values, blocks.time)
    course = moment_about_contact(system, fitted.values, motion)[1:]
    own = moment_about_contact(system, fitted.values, motion, {law.candidate.effect, *companions})[1:]
    by_number = _by_number(system, fitted, motion, course)
    lasts = SLOW * float(system.time[-1] - system.time[0])
    parts = _parts(blocks, motion, lasts, float(np.sqrt(np.mean(np.sum(own**2, axis=1)))))
    wrong = 1.0 if correlated else probability_of_wrong_form(law, companions)
    own_directions, fitted_columns = span(by_number), span(R[:, :n])
    right = cleared(R[:, -1], fitted_columns)
    variance = np.sum((by_number @ fitted.covariance) * by_number, axis=1)
    mixed, another, misfit = fitted.covariance.copy(), fitted.covariance, 0.0
    for probability, some in ((1.0 - wrong, [np.concatenate(parts[:: HARMONICS + 2], axis=1)]), (wrong, parts)):
        S = cleared(np.concatenate(some, axis=1), own_directions)
        B = R[:, n:-1] @ S / (WIDTH * np.sqrt(2 * np.pi))  # neighbouring probes add up to this
        taken = absorbed(R[:, :n], B)
        second, size = _second_moment(cleared(B, fitted_columns), right, [part.shape[1] for part in some])
        moved = S - by_number @ taken
        variance += probability * np.sum((moved @ second) * moved, axis=1)
        another = fitted.covariance + taken @ second @ taken.T  # in the end that of all parts
        mixed += probability * (another - fitted.covariance)
        misfit += probability * size**2
    variance = np.maximum(variance, 0.0).reshape(3, k).T + _among_others(system, law, motion, course)
    variance += wrong * _within_probes(system, fitted, blocks, course)
    found = Course(blocks.time, course, np.sqrt(variance))
    return replace(fitted, covariance=mixed), replace(fitted, covariance=another), found, float(np.sqrt(misfit))


def absorbed(columns: Array, misfit: Array) -> Array:
    """(n, k) least-squares coefficients of columns (m, n) for each column of the misfit (m, k)."""
    length = np.linalg.norm(columns, axis=0)
    length = np.where(length > 0, length, 1.0)
    return np.asarray(np.linalg.lstsq(columns / length, misfit, rcond=DEPENDENT)[0] / length[:, None], float)


def probability_of_wrong_form(law: LearnedLaw, companions: Collection[str] = ()) -> float:
    """Probability that the true law is not in the library, given that the residual is noise.

    A sum of several families, or of one with known effects, approximates a law that is not in the library.
    """
    if len(law.families) + len(companions) > 1:
        return 1.0
    own = _kinds(law)
    others = sum(odds for other, odds in law.others if not other.families or not _kinds(other) <= own)
    return max(LEAST_WRONG, others / (1.0 + others))


def _kinds(law: LearnedLaw) -> set[tuple[str, ...]]:
    """The kind of each family, and the components of moment and force on which it acts."""
    return {(f.kind, *sorted({component for parts in f.terms for component in parts})) for f in law.families}


def _by_number(system: DiscSystem, fitted: Fit, motion: Motion, course: Array) -> Array:
    """Derivative (3 k, n) of the moment of all laws, `course` (k, 3), by the fitted quantities, on a given motion."""
    values, by_number = fitted.values, np.zeros((course.size, len(fitted.names)))
    for i, name in enumerate(fitted.names):
        if system.model.has_name(name) and fitted.sigma(name) > 0:
            step = STEP * max(abs(values[name]), fitted.sigma(name))
            step = step if values[name] + step <= fitted.quantities[i].upper else -step
            moved = moment_about_contact(system, {**values, name: values[name] + step}, motion)[1:]
            by_number[:, i] = ((moved - course) / step).T.ravel()
    return by_number


def _among_others(system: DiscSystem, law: LearnedLaw, motion: Motion, course: Array) -> Array:
    """Variance (k, 3) of the moment over the laws that describe the data too, weighted by their odds."""
    total, spread = 1.0, np.zeros_like(course)
    for other, odds in law.others:
        moment = moment_about_contact(system.knowing(other), other.values, motion)[1:]
        total, spread = total + odds, spread + odds * (moment - course) ** 2
    return np.asarray(spread / total, float)


def _within_probes(system: DiscSystem, fitted: Fit, blocks: Probed, course: Array) -> Array:
    """Mean square (k, 3), over the time of each probe, of the laws minus a spline through their values at the probes.

    The motion depends on the integral of features shorter than a probe (an edge, a blow), not on their position.
    """
    parts = (np.arange(WITHIN) + 0.5) / WITHIN - 0.5
    fine = blocks.time[:, None] + blocks.spacing * parts
    motion = _motion(system, fitted.values, fine.ravel())
    moment = moment_about_contact(system, fitted.values, motion)[1:].reshape(*fine.shape, 3)
    return np.asarray(np.mean((moment - CubicSpline(blocks.time, course)(fine)) ** 2, axis=1), float)


def _motion(system: DiscSystem, values: Values, time: Array) -> Motion:
    """The fitted motion from the first frame on, at these later times."""
    times = np.concatenate([[float(system.instants(values)[0])], time])
    return simulate(system.model_with(values), state_of(values), times=times)


def _parts(blocks: Probed, motion: Motion, lasts: float, size: float) -> list[Array]:
    """Square roots (3 k, m) of the processes' covariances, axis by axis, with the rms of the law, `size`.

    lasts : correlation length of slow processes [s]
    """
    distance = blocks.time[:, None] - blocks.time
    short = np.linalg.cholesky(np.exp(-0.5 * (distance / blocks.spacing) ** 2) + 1e-6 * np.eye(len(distance)))
    variance, modes = np.linalg.eigh(np.exp(-0.5 * (distance / lasts) ** 2))
    slow = modes[:, variance > 1e-3 * variance[-1]] * np.sqrt(variance[variance > 1e-3 * variance[-1]])
    psi, roots = motion.q[1:, 3], [short, slow]
    for n in range(1, HARMONICS + 1):
        roots.append(np.column_stack([np.cos(n * psi)[:, None] * slow, np.sin(n * psi)[:, None] * slow]))
    return [size * np.kron(np.eye(3)[:, [axis]], root) for axis in range(3) for root in roots]


def _second_moment(B: Array, right: Array, parts: Sequence[int], sizes: Array = SIZES) -> tuple[Array, float]:
    """Second moment E[u u'] of right = B u + noise, and the rms of u, whose parts are u_i = f_i v_i with v_i ~ N(0, 1).

    parts : number of columns of each. The posterior of f_i over `sizes` is computed with the other parts at their rms.
    """
    edges = np.concatenate([[0], np.cumsum(parts)])
    own = [slice(a, b) for a, b in pairwise(edges)]
    f2 = np.full(len(parts), sizes[0] ** 2)
    R = triangle(np.column_stack([B, right]))
    B, right = R[:, :-1], R[:, -1]
    for _ in range(SWEEPS):
        for i, columns in enumerate(own):
            others = np.eye(len(B))
            for j, theirs in enumerate(own):
                if j != i:
                    others += f2[j] * B[:, theirs] @ B[:, theirs].T
            L = np.linalg.cholesky(others)
            left, shown, _ = np.linalg.svd(solve_triangular(L, B[:, columns], lower=True), full_matrices=False)
            projected = left.T @ solve_triangular(L, right, lower=True)
            density = -0.5 * evidence(shown, projected, sizes)
            weight = np.exp(density - density.max())
            f2[i] = float(weight @ sizes**2 / weight.sum())
    size = np.repeat(np.sqrt(f2), parts)
    scaled = B * size
    covariance = np.linalg.inv(np.eye(len(size)) + scaled.T @ scaled)
    mean = covariance @ (scaled.T @ right)
    second = size[:, None] * (covariance + np.outer(mean, mean)) * size
    return second, float(np.sqrt(np.sum(f2)))
