"""Linear response of the disc to small moments and forces: the missing moment over time, and the gain of each law.

The impulse response of the motion (Green's function, `rolling.simulate`) converts every law of a library into the
residual that it would cause, and the measured residual into the moment that is missing from the model.
"""

from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from calibration.kit.least_squares import triangle
from calibration.kit.types import Array, Indices
from disctrack.diagnosis.disc_system import DiscSystem
from disctrack.diagnosis.law_library import SHAPES, Family, LearnedLaw, families
from disctrack.diagnosis.motion import STATE_SCALES, THETA_END, state_of
from disctrack.discrepancy.elimination import is_linear, prior_rows, projection
from disctrack.discrepancy.fit import Fit
from disctrack.discrepancy.score import DEPENDENT, cleared, span
from disctrack.discrepancy.significance import SURE, evidence
from disctrack.discrepancy.system import Candidate, Quantity, Values
from disctrack.numbers import rounded
from disctrack.rolling import EffectParameter, Model, Motion
from disctrack.rolling.effects.learned import effect_from_formulas
from disctrack.rolling.records import KINEMATICS
from disctrack.rolling.simulate import COMPONENTS, moved_start, responses

PROBES_PER_TURN = 7  # of the fastest angle, so that a moment locked to it is resolved
MAX_PROBES = 90
WIDTH = 0.7  # standard deviation of a probe over the spacing of the probes: their sum is flat to 1e-4
INSTANTS_PER_SECOND = 1000.0  # of the responses: Simpson's rule errs by 0.4 % at 150 Hz
CHUNK = 120  # families of the library that are evaluated at a time


Response = tuple[Motion, Array, Indices]  # a motion, its Green's function, indices of the frames' instants


@dataclass(frozen=True)
class Course:
    """A moment or a force over time."""

    time: Array  # (k,) [s]
    values: Array  # (k, 3) along n0, m0, k [N m] or [N]
    sigma: Array  # (k, 3)

    @property
    def text(self) -> str:
        """Size of a moment, the instant of its maximum, and the interval in which it is significant."""
        size = np.sum(self.values**2, axis=1)
        rms, largest = np.sqrt(np.mean(self.values**2, axis=0)), self.time[np.argmax(size)]
        known = np.flatnonzero(size > SURE**2 * np.sum(self.sigma**2, axis=1))
        text = (
            f"a moment of {', '.join(rounded(1e6 * x, 2) for x in rms)} µN m rms along n0, m0, k, or an equivalent "
            f"force; it is largest at {largest:.3f} s"
        )
        first, last = self.time[known[[0, -1]]] if known.size else (largest, largest)
        return f"{text} and significant from {first:.3f} to {last:.3f} s" if last > first else text


@dataclass(frozen=True)
class Probed:
    """Compressed least-squares problem; columns: fitted quantities, probes (axis by axis), residual."""

    data: Array  # rows of the data
    prior: Array  # and of the priors
    n_fitted: int
    time: Array  # (k,) of the probes
    spacing: float


def missing_moment(blocks: Probed, scale: float | None = None) -> tuple[Course, float]:
    """The moment that is missing from the model, smooth over the spacing of the probes, and its scale.

    A Gaussian process whose second differences are independent.
    scale : [N m] prior standard deviation of the second differences; by default that of the largest marginal
        likelihood (empirical Bayes)
    """
    R, k = np.vstack([blocks.data, blocks.prior]), len(blocks.time)
    right, fitted, probes = R[:, -1], R[:, : blocks.n_fitted], R[:, blocks.n_fitted : -1]
    basis = span(fitted)
    right, probes = cleared(right, basis), cleared(probes, basis)
    smooth = np.eye(k) * 1e-4 + np.diff(np.eye(k), 2, axis=0).T @ np.diff(np.eye(k), 2, axis=0)
    root = np.linalg.cholesky(np.linalg.inv(np.kron(np.eye(3), smooth)))
    U, shown, V = np.linalg.svd(probes @ root, full_matrices=False)
    sizes = np.logspace(-9, -1, 65)  # [N m] prior standard deviation of the second difference
    a = float(sizes[int(np.argmin(evidence(shown, U.T @ right, sizes)))]) if scale is None else scale
    known = (a * shown) ** 2 / (1 + (a * shown) ** 2)  # share of each combination that the data determine
    along = root @ V.T
    moment = along @ (known * (U.T @ right) / np.where(shown > 0, shown, 1.0))
    variance = a**2 * (np.sum(root**2, axis=1) - np.sum(along**2 * known, axis=1))
    factor = WIDTH * np.sqrt(2 * np.pi)  # neighbouring probes add up to this
    sigma = np.sqrt(np.maximum(variance, 0.0))
    return Course(blocks.time, factor * moment.reshape(3, k).T, factor * sigma.reshape(3, k).T), a


def missing_text(system: DiscSystem, fit_: Fit) -> str:
    """The missing moment in words, and the law that it follows approximately; empty if the disc slips."""
    blocks, along = probe(system, fit_), scan(system, fit_)
    if blocks is None or along is None:
        return ""
    missing, _ = missing_moment(blocks)
    gains = along.gains(family for family in along.library() if not family.shape and family.n_numbers <= 2)
    best = max(gains, key=lambda g: g.gain)
    share = 100 * best.gain / along.chi_square
    return f"missing in the model is {missing.text}; {share:.0f} % of it is described by {best.family.title}"


def response(system: DiscSystem, fit_: Fit) -> Response | None:
    """The fitted motion with its Green's function, and the indices of the frames; None if it does not roll."""
    instants = system.instants(fit_.values)
    per_frame = int(np.ceil(INSTANTS_PER_SECOND * float(np.median(np.diff(instants)))))
    n = len(instants)
    fine = np.interp(np.arange(per_frame * (n - 1) + 1) / per_frame, np.arange(n), instants)
    found = responses(system.model_with(fit_.values), state_of(fit_.values), fine, THETA_END)
    return None if found is None else (*found, np.arange(n) * per_frame)


def probe(system: DiscSystem, fit_: Fit, other: Values | None = None) -> Probed | None:
    """Responses of the dots to short moments along n0, m0, k, as a compressed least-squares problem.

    None if the disc slips.
    other : values whose prediction replaces the data, so that its moment is estimated in the same way
    """
    found = response(system, fit_)
    if found is None:
        return None
    motion, kernel, frames = found
    span = float(motion.time[-1] - motion.time[0])
    turns = max(float(np.abs(motion.q[-1, i] - motion.q[0, i])) / (2 * np.pi) for i in (3, 5))
    k = int(np.clip(np.ceil(PROBES_PER_TURN * turns), 20, MAX_PROBES))
    middles = motion.time[0] + span * (np.arange(k) + 0.5) / k
    residual, derivative = system.linearise(fit_.values, fit_.names)
    right, matrix = prior_rows(fit_.quantities, fit_.values)
    if other is not None:
        residual = residual - system.linearise(other, [])[0]
        right = right - prior_rows(fit_.quantities, {**fit_.values, **other})[0]  # they may return to their priors
    bells = np.exp(-0.5 * ((motion.time[:, None] - middles) / (WIDTH * span / k)) ** 2)
    courses = np.zeros((len(bells), len(COMPONENTS), 3, k))
    for i in range(3):
        courses[:, i, i] = bells
    moved = moved_start(motion.time, kernel, courses.reshape(len(bells), len(COMPONENTS), -1))[frames]
    by_start = derivative[..., [fit_.names.index(f"state.{name}") for name in STATE_SCALES]]
    everything = np.concatenate([derivative, by_start @ moved, residual[..., None]], axis=-1)
    data = triangle(everything.reshape(-1, everything.shape[-1]))
    prior = np.concatenate([matrix, np.zeros((len(matrix), 3 * k)), right[:, None]], axis=1)
    return Probed(data, prior, len(fit_.names), middles, span / k)


@dataclass(frozen=True)
class Gain:
    """Decrease of chi-square by a family to first order."""

    family: Family
    gain: float  # decrease of chi-square
    values: Array  # coefficients of its terms


def proposal(family: Family, gram: Array, before: Array, right: Array) -> Gain:
    """Gain and values from the normal equations of one family; undetermined directions are left out.

    before : (k,) squares of its columns before the fitted quantities were projected out
    """
    size = np.sqrt(np.maximum(before, 1e-300))
    eigenvalues, vectors = np.linalg.eigh(gram / np.outer(size, size))
    seen = eigenvalues > DEPENDENT  # share of the power that is left
    along = vectors[:, seen].T @ (right / size)
    values = vectors[:, seen] @ (along / eigenvalues[seen]) / size
    return Gain(family, float(np.sum(along**2 / eigenvalues[seen])), values)


class DiscScan:
    """Gains of families at one fit, to first order; the dots of a frame are compressed to the eight initial conditions.

    A column of the least-squares problem is D g: D (n, w, 8) the derivative by the initial state, g (n, 8) the response
    as a shift of that state. Inner products of columns orthogonal to those of the fitted quantities, with orthonormal
    basis W, are the sums over frames of g' (D' D) g minus the products of the sums of W' D g.

    base : as for `scan`
    """

    def __init__(self, system: DiscSystem, fit_: Fit, base: Sequence[Quantity] | None, along: Response) -> None:
        self.motion, self._kernel, self._frames = along
        self._rate, self._disc = float(1.0 / np.median(np.diff(system.time))), system.disc
        fitted = fit_.quantities if base is None else tuple(base)
        moved = [q for q in fitted if not is_linear(q)]
        common = projection(system, fitted, fit_.values)
        values = fit_.values | dict(zip(common.names, common.null.tolist(), strict=True))
        names = {q.name for q in fitted}
        replaced = [q for q in fit_.quantities if q.name not in names]
        residual, derivative = system.linearise(values, [q.name for q in (*moved, *replaced)])
        residual = residual + derivative[..., len(moved) :] @ np.array([values[q.name] - q.null for q in replaced])
        derivative = derivative[..., : len(moved)]
        right, matrix = prior_rows(moved, fit_.values)
        stacked = common.cleared(np.column_stack([derivative.reshape(residual.size, -1), residual.reshape(-1)]))
        stacked = np.vstack([stacked, np.column_stack([matrix, right])])
        basis = span(stacked[:, :-1])
        left, basis = cleared(stacked[:, -1], basis), basis[: residual.size]
        if common.names:
            basis = np.column_stack([common.rows, basis])
        n, w = residual.shape
        D = derivative[..., [[q.name for q in moved].index(f"state.{name}") for name in STATE_SCALES]]
        self._normal = np.swapaxes(D, 1, 2) @ D
        self._absorbed = np.swapaxes(basis.reshape(n, w, -1), 1, 2) @ D
        self._right = np.einsum("nw,nwk->nk", left[: residual.size].reshape(n, w), D)
        self.chi_square = float(left @ left)
        space: dict[str, Any] = {name: np.asarray(self.motion.instants[name]) for name in KINEMATICS}
        space |= {f: getattr(np, f) for f in ("cos", "sin", "exp", "sqrt", "log")}
        space |= {"magnitude": np.abs, "sign": lambda x, width: x / np.sqrt(x * x + width * width)}
        self._space, self._courses = space, dict[str, Array]()
        # the change of the load by the law itself is of second order
        self._load = self.motion.contact_force[:, 2]

    def _course(self, formula: str) -> Array:
        if formula not in self._courses:
            values = eval(formula, {"__builtins__": {}}, self._space)  # formulas of the library only
            self._courses[formula] = np.broadcast_to(np.asarray(values, float), self.motion.time.shape)
        return self._courses[formula]

    def library(self) -> list[Family]:
        """The laws that are tried along this motion."""
        return list(families(self.motion.q, self.motion.time, self._rate, self._disc))

    def gains(self, chosen: Iterable[Family]) -> list[Gain]:
        """Gain of each family."""
        everything = list(chosen)
        parts = (everything[first : first + CHUNK] for first in range(0, len(everything), CHUNK))
        return [gain for part in parts for gain in self._gains(part)]

    def _gains(self, chunk: Sequence[Family]) -> list[Gain]:
        terms = [parts for family in chunk for parts in family.formulas()]
        courses = np.zeros((len(self.motion.time), len(COMPONENTS), len(terms)))
        self._courses.clear()
        for column, parts in enumerate(terms):
            for component, formula in parts.items():
                kind, _, axis = component.partition("_")
                factor = self._load if kind == "load" else 1.0
                course = factor * self._course(formula)
                courses[:, COMPONENTS.index(f"M_{axis}" if kind == "load" else component), column] += course
        g = moved_start(self.motion.time, self._kernel, courses)[self._frames]
        seen = self._normal @ g
        taken = np.tensordot(self._absorbed, g, axes=([0, 2], [0, 1]))
        right = np.tensordot(self._right, g, axes=([0, 1], [0, 1]))
        found, first = [], 0
        for family in chunk:
            own = slice(first, first + len(family.terms))
            first = own.stop
            before = np.einsum("nkp,nkq->pq", g[..., own], seen[..., own])
            gram = before - taken[:, own].T @ taken[:, own]
            found.append(proposal(family, gram, np.diag(before), right[own]))
        return found


def scan(system: DiscSystem, fitted: Fit, base: Sequence[Quantity] | None = None) -> DiscScan | None:
    """First-order gains of laws along the fitted motion; None if the disc slips.

    base : quantities fitted together with a law; by default those of the fit. The contribution of all others is added
        to the residual to first order: the law is to replace them, along a motion that follows the data.
    """
    along = response(system, fitted)
    return None if along is None else DiscScan(system, fitted, base, along)


def law_of(model: Model, chosen: Sequence[Family], values: Array) -> LearnedLaw:
    """The sum of these families as an effect; values (k,): of each family the coefficients, then the shape.

    Its name is "learned", or "learned_2" and so on if the model has learned laws already.
    """
    names = ("learned", *(f"learned_{i}" for i in range(2, len(model.effects) + 2)))
    name = next(name for name in names if model.effect(name) is None)
    begin = np.asarray(values, float).tolist()
    formulas, numbers = dict[str, str](), list[EffectParameter]()
    coefficients, shapes = list[tuple[str, ...]](), list[tuple[str, ...]]()
    for i, family in enumerate(chosen):
        many = len(family.terms) > 1
        own = [f"c_{i}_{j}" if many else f"c_{i}" for j in range(len(family.terms))]
        own = [f"{number}_{i}" for number in family.names] or own
        inside = {shape: f"{shape}_{i}" for shape in family.shape}
        for number, parts in zip(own, family.terms, strict=True):
            numbers.append(EffectParameter(number, "SI", begin[len(numbers)], family.title))
            for component, formula in parts.items():
                piece = f"{number} * ({formula.format(**inside)})"
                formulas[component] = f"{formulas[component]} + {piece}" if component in formulas else piece
        for shape, number in inside.items():
            lower, upper, _ = SHAPES[shape]
            value, text = float(np.clip(begin[len(numbers)], lower, upper)), f"{shape} of {family.title}"
            numbers.append(EffectParameter(number, "SI", value, text, value, lower, upper, is_shape=True))
        coefficients.append(tuple(f"{name}.{number}" for number in own))
        shapes.append(tuple(f"{name}.{number}" for number in inside.values()))
    quantities = []
    for p in numbers:
        step = SHAPES[p.name.rpartition("_")[0]][2] if p.is_shape else 0.01 * abs(p.nominal) or 1e-9
        quantities.append(Quantity(f"{name}.{p.name}", "SI", step, p.null, p.lower, p.upper, meaning=p.meaning))
    title, source = "; ".join(f"{k} = {v}" for k, v in formulas.items()), "regression on the residual of this recording"
    effect = effect_from_formulas(name, formulas, tuple(numbers), title=title, source=source)
    candidate = Candidate(name, name, "motion", effect.title, effect.source, tuple(quantities))
    started = dict(zip(candidate.names, begin, strict=True))
    return LearnedLaw(candidate, effect, tuple(chosen), tuple(coefficients), tuple(shapes), started)
