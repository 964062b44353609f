"""How well is a law known whose form was picked from a library? Its course over time, and what its form may be off by.

A fit takes the form for exact: its sigmas are those of the coefficients. The true law has another form, of which the
data show little. So the moment about the contact is taken for the law's plus a misfit (Kennedy and O'Hagan 2001: a
discrepancy beside the parameters). Where the form is nearly right, it is a normal process with a correlation as long as
a probe. Where it is another's, it is a sum: along each axis such a process, and some that change slowly beside the
precession and its harmonics, as what depends on place and direction does; each of a size of its own, so that what the
recording does not show may be as large as the law. All sizes are in proportion to the law's, and their probabilities
follow from the residual. An edge or a blow shorter than a probe may be anywhere in it. That the form is another's is
certain where the residual is not noise, or where it takes several to describe the data, and else as probable as laws of
other kinds are that describe the data too. What a law's numbers could take up themselves is no misfit (Plumlee 2017).
"""

from collections.abc import Collection, Sequence
from dataclasses import replace
from itertools import pairwise

import numpy as np
from scipy.interpolate import CubicSpline
from scipy.linalg import solve_triangular

from calibration.kit.arrays import Array
from calibration.kit.least_squares import triangle
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

SIZES = np.logspace(-3, 0, 25)  # of a part of the misfit over the law's rms: before the data, each as probable
HARMONICS = 2  # of the precession, beside which a part changes slowly
SLOW = 1.0 / 3.0  # of the recording: correlation of a part that changes slowly
SELDOM = 0.05  # probability that the form is another's, where no other describes the data
SWEEPS = 4  # over the parts, the size of each judged beside the others
STEP = 1e-4  # of a number, for the derivative of the course
WITHIN = 8  # instants of a probe, at which laws are looked at


def moment_about_contact(
    system: DiscSystem, values: Values, motion: Motion, only: Collection[str] | None = None
) -> Array:
    """(n, 3) of the effects at `values` on a given motion [N m]; a force X at the centre counts as -r_OA x X.

    A sharp edge on a flat table, as the arm goes; a tilt counts as the force by which gravity is another than declared.
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
    system: DiscSystem,
    fitted: Fit,
    law: LearnedLaw,
    noise: float,
    remembers: bool = False,
    beside: Collection[str] = (),
) -> tuple[Fit, Fit, Course | None, float]:
    """The fit with sigmas as probable as it is that the form is another's, and with those if it is; the laws' course.

    The course is the moment about the contact of all laws of the fitted model, forces at the centre included, with what
    the law's form may be off by; with it comes the rms of that over the law's own. Where the disc slips there is none.

    system : knows the law.   noise : variance of the residual's noise over that stated
    remembers : what the fit leaves is not noise
    beside : known effects that were found with the law: where they stand in with it, the misfit is of them all
    """
    blocks = probe(system, fitted)
    if blocks is None:
        return fitted, fitted, None, 0.0
    n, k = blocks.n_fitted, len(blocks.time)
    R = np.vstack([blocks.data / np.sqrt(noise), blocks.prior])
    course, own, by_number = _courses(system, fitted, {law.candidate.effect, *beside}, blocks.time)
    parts = _parts(system, fitted, blocks, float(np.sqrt(np.mean(np.sum(own**2, axis=1)))))
    wrong = 1.0 if remembers else form_is_another(law, beside)
    laws = by_number[:, np.any(by_number != 0.0, axis=0)]
    own_directions = span(laws)
    fitted_columns = span(R[:, :n])
    right = cleared(R[:, -1], fitted_columns)
    variance = np.sum((by_number @ fitted.covariance) * by_number, axis=1)
    mixed, another, misfit = fitted.covariance.copy(), fitted.covariance, 0.0
    for probability, some in ((1.0 - wrong, [np.concatenate(parts[:: HARMONICS + 2], axis=1)]), (wrong, parts)):
        S = np.concatenate(some, axis=1)
        S = cleared(S, own_directions)
        B = R[:, n:-1] @ S / (WIDTH * np.sqrt(2 * np.pi))  # neighbouring probes add up to this
        taken = absorbed(R[:, :n], B)
        second, size = _second_moment(cleared(B, fitted_columns), right, [part.shape[1] for part in some])
        moved = S - by_number @ taken
        variance += probability * np.sum((moved @ second) * moved, axis=1)
        another = fitted.covariance + taken @ second @ taken.T  # in the end that of all parts
        mixed += probability * (another - fitted.covariance)
        misfit += probability * size**2
    variance = np.maximum(variance, 0.0).reshape(3, k).T + _among_others(system, fitted, law, course, blocks.time)
    variance += wrong * _within_probes(system, fitted, blocks, course)
    found = Course(blocks.time, course, np.sqrt(variance))
    return replace(fitted, covariance=mixed), replace(fitted, covariance=another), found, float(np.sqrt(misfit))


def absorbed(columns: Array, misfit: Array) -> Array:
    """By how much the numbers of columns (m, n) give way to what others (m, k) do, in least squares: (n, k)."""
    length = np.linalg.norm(columns, axis=0)
    length = np.where(length > 0, length, 1.0)
    return np.asarray(np.linalg.lstsq(columns / length, misfit, rcond=DEPENDENT)[0] / length[:, None], float)


def form_is_another(law: LearnedLaw, beside: Collection[str] = ()) -> float:
    """Probability that the true law has another form than those of the library, where what is left is noise.

    A sum of several, or one with known effects `beside` it, is what a library makes of a law that it does not hold.
    """
    if len(law.families) + len(beside) > 1:
        return 1.0
    own = _kinds(law)
    others = sum(odds for other, odds in law.others if not other.families or not _kinds(other) <= own)
    return max(SELDOM, others / (1.0 + others))


def _kinds(law: LearnedLaw) -> set[tuple[str, ...]]:
    """Of what kind each family is, and on which components of moment and force it acts."""
    return {(f.kind, *sorted({component for parts in f.terms for component in parts})) for f in law.families}


def _courses(system: DiscSystem, fitted: Fit, own: Collection[str], time: Array) -> tuple[Array, Array, Array]:
    """All laws' moment (k, 3), that of the effects `own`, the former's derivative (3 k, n) by the fitted numbers."""
    values = fitted.values
    motion = _motion(system, values, time)
    course = moment_about_contact(system, values, motion)
    by_number = np.zeros((3 * len(time), len(fitted.names)))
    for i, name in enumerate(fitted.names):
        if system.model.has_name(name) and fitted.sigma(name) > 0:
            step = STEP * max(abs(values[name]), fitted.sigma(name))
            step = step if values[name] + step <= fitted.quantities[i].upper else -step
            moved = moment_about_contact(system, {**values, name: values[name] + step}, motion)
            by_number[:, i] = ((moved - course) / step)[1:].T.ravel()
    return course[1:], moment_about_contact(system, values, motion, own)[1:], by_number


def _among_others(system: DiscSystem, fitted: Fit, law: LearnedLaw, course: Array, time: Array) -> Array:
    """Variance (k, 3) of the course over the laws that describe the data too, each with its odds."""
    motion, total, spread = _motion(system, fitted.values, time), 1.0, np.zeros_like(course)
    for other, odds in law.others:
        moment = moment_about_contact(system.knowing(other), other.values, motion)[1:]
        total, spread = total + odds, spread + odds * (moment - course) ** 2
    return np.asarray(spread / total, float)


def _within_probes(system: DiscSystem, fitted: Fit, blocks: Probed, course: Array) -> Array:
    """Mean square (k, 3), over the time of each probe, by which the laws differ from a smooth course through them all.

    What is shorter than a probe (an edge, a blow) moves the disc by its sum alone: another form has it elsewhere there.
    """
    parts = (np.arange(WITHIN) + 0.5) / WITHIN - 0.5
    fine = blocks.time[:, None] + blocks.spacing * parts
    motion = _motion(system, fitted.values, fine.ravel())
    moment = moment_about_contact(system, fitted.values, motion)[1:].reshape(*fine.shape, 3)
    return np.asarray(np.mean((moment - CubicSpline(blocks.time, course)(fine)) ** 2, axis=1), float)


def _motion(system: DiscSystem, values: Values, time: Array) -> Motion:
    """From the first frame on, at these times after it."""
    times = np.concatenate([[float(system.instants(values)[0])], time])
    return simulate(system.model_with(values), state_of(values), times=times)


def _parts(system: DiscSystem, fitted: Fit, blocks: Probed, size: float) -> list[Array]:
    """Roots (3 k, m) of the covariances of the misfit's parts, axis by axis; their rms is that of the law, `size`."""
    time, k = blocks.time, len(blocks.time)
    distance = time[:, None] - time
    short = np.linalg.cholesky(np.exp(-0.5 * (distance / blocks.spacing) ** 2) + 1e-6 * np.eye(k))
    lasts = SLOW * float(system.time[-1] - system.time[0])
    variance, modes = np.linalg.eigh(np.exp(-0.5 * (distance / lasts) ** 2))
    slow = modes[:, variance > 1e-3 * variance[-1]] * np.sqrt(variance[variance > 1e-3 * variance[-1]])
    psi = _motion(system, fitted.values, time).q[1:, 3]
    roots = [short, slow]
    for n in range(1, HARMONICS + 1):
        roots.append(np.column_stack([np.cos(n * psi)[:, None] * slow, np.sin(n * psi)[:, None] * slow]))
    return [size * np.kron(np.eye(3)[:, [axis]], root) for axis in range(3) for root in roots]


def _second_moment(B: Array, right: Array, parts: Sequence[int], sizes: Array = SIZES) -> tuple[Array, float]:
    """E[u u'] of right = B u + noise, and the rms of u; its parts u_i = f_i v_i with normal v_i of size 1.

    parts : how many columns each has. f_i is averaged over `sizes`, the others' at their rms.
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
    precision = np.eye(len(size)) + scaled.T @ scaled
    covariance = np.linalg.inv(precision)
    mean = covariance @ (scaled.T @ right)
    second = size[:, None] * (covariance + np.outer(mean, mean)) * size
    return second, float(np.sqrt(np.sum(f2)))
