"""A law for what no catalogue names: the missing moment as a function of time, and as few terms that describe it.

The motion's first-order response to any moment and force (rolling.responses) turns every law of a library into a
predicted residual. The law that gains most is fitted in full beside its nearest rivals, and the next is looked for in
what it leaves, while each pays for its numbers and for having been looked for among so many. What survives is an effect
by formula like any other.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass, field, replace
from itertools import islice
from typing import Any

import numpy as np
from numpy.typing import NDArray

from calibration.kit.arrays import Array
from calibration.kit.least_squares import triangle
from disctrack.diagnosis.disc_system import THETA_END, DiscSystem
from disctrack.diagnosis.errors import simulated
from disctrack.diagnosis.law_library import Family, families
from disctrack.diagnosis.left_over import left_over
from disctrack.diagnosis.motion import STATE_SCALES, state_of
from disctrack.discrepancy.fit import Fit, fit, prior_rows
from disctrack.discrepancy.nuisances import is_linear, projection
from disctrack.discrepancy.shape import profiled
from disctrack.discrepancy.significance import as_sigmas, price_of_a_number
from disctrack.discrepancy.system import Candidate, Quantity, System, Values
from disctrack.rolling import Model, simulate
from disctrack.rolling.effects import Effect, EffectParameter, effect_from_formulas
from disctrack.rolling.evaluate import effect_wrench, kinematics
from disctrack.rolling.responses import COMPONENTS, Responses, responses

AXES = ("n", "m", "z")
PROBES_PER_TURN = 7  # of the fastest angle, so that a moment locked to it is resolved
MAX_PROBES = 90
WIDTH = 0.7  # of a probe over the distance to the next: their sum is flat to 1e-4
PARTS = 10  # of the recording, half of which are drawn for each resample
RESAMPLES = 40
MAX_TERMS = 3
REFITTED = 5  # families that are fitted in full in each round ...
OF_ONE_KIND = 2  # ... of them of one kind
LONGER = 2  # of other kinds, that come nearest to the data in more numbers, beside known effects that describe them
MAX_ITERATIONS = 15  # of a law that describes the data; others wander
COMES_NEAR = 1.5  # chi-square per degree of freedom, from which on a fit that did not arrive is worth another start
WIDTHS = ("width", "softness", "length")  # shapes of a law that go with its amount
IDLE = 1e-12  # share of an amount's variance that is none
MIN_SIGMAS = 3.0  # of a coefficient after the refit; what helped to first order may not help the motion
EXACT = 0.02  # of chi-square: what a first-order gain may err by where the motion is far from the data
UNLIKELY = 1e-3  # odds below which a law does not count
ALIKE = 10.0  # chi-square with its price, by which two laws differ that both describe the residual
NEARLY = 20.0  # chi-square by which a refit may be better than the first order ...
COARSE = 0.1  # ... and share of what is missing, by which one may be that moves a shape off the library's grid
INSTANTS_PER_SECOND = 1000.0  # of the responses: Simpson's rule errs by 0.4 % of a hum of 150 Hz
INVISIBLE = 1e-8  # share of a column's power left after clearing, below which the data do not show it
CHUNK = 240  # columns of the library that are held at a time
_OF_PLACE = (
    "place",
    "part of the table",
    "ridge",
    "step",
    "hill",
    "drag on a part",
)  # angles tell where the contact is
_LOCKED = ("psi)", "phi)", "psi +", "psi -", "phi -")


@dataclass(frozen=True)
class MissingMoment:
    """Moment that the model fails to supply, smoothed over the distance of the probes."""

    time: Array  # (k,) middles of the probes [s]
    moment: Array  # (k, 3) M_n, M_m, M_z [N m]
    sigma: Array  # (k, 3)
    scale: float  # [N m] that its second differences were taken to have before the data


@dataclass(frozen=True)
class LearnedLaw:
    """Families of terms that describe what is missing."""

    candidate: Candidate  # of the effect by formula
    effect: type[Effect]
    families: tuple[Family, ...]
    values: Values = field(default_factory=dict)  # of everything, where its fit ended
    share: tuple[float, ...] = ()  # of the resamples in which each family gains more than its price
    alike: tuple[str, ...] = ()  # other laws that describe the data as well
    rivals: tuple[tuple[LearnedLaw, float], ...] = ()  # laws that fit as well, however long, with their likelihood
    looked: float = 0.0  # chi-square that each family pays for having been looked for among so many

    @property
    def formulas(self) -> dict[str, str]:
        """Component of the wrench -> formula."""
        return dict(self.effect.formulas or {})

    @property
    def title(self) -> str:
        """What the law means, in words."""
        return "; and ".join(family.title for family in self.families)

    @property
    def locked(self) -> bool:
        """To an angle of the body or of the table?"""
        parts = [f for family in self.families if family.kind not in _OF_PLACE for p in family.terms for f in p.items()]
        return any(c[0] in "Ml" and mark in f for c, f in parts for mark in _LOCKED)


@dataclass(frozen=True)
class _Blocks:
    """Compressed rows of each part of the recording; columns: fitted quantities, probes (axis by axis), residual."""

    triangles: tuple[Array, ...]
    prior: Array  # rows of the priors, same columns
    n_fitted: int
    time: Array  # (k,) of the probes
    spacing: float


def missing_moment(blocks: _Blocks, scale: float | None = None) -> MissingMoment:
    """Moment over time with the size and smoothness that make the data most probable (empirical Bayes).

    scale : [N m] of its second differences, in place of the most probable one
    """
    R = triangle(np.vstack([*blocks.triangles, blocks.prior]))
    k = len(blocks.time)
    right, fitted, probes = R[:, -1], R[:, : blocks.n_fitted], R[:, blocks.n_fitted : -1]
    Q = np.linalg.qr(_unit(fitted))[0]
    right, probes = right - Q @ (Q.T @ right), probes - Q @ (Q.T @ probes)
    smooth = np.eye(k) * 1e-4 + np.diff(np.eye(k), 2, axis=0).T @ np.diff(np.eye(k), 2, axis=0)
    precision = np.kron(np.eye(3), smooth)
    root = np.linalg.cholesky(np.linalg.inv(precision))
    U, singular, V = np.linalg.svd(probes @ root, full_matrices=False)
    projected = (U.T @ right) ** 2
    sizes = np.logspace(-9, -1, 65)  # [N m] prior standard deviation of the second difference
    density = [-0.5 * np.sum(projected / (1 + (a * singular) ** 2) + np.log1p((a * singular) ** 2)) for a in sizes]
    a = float(sizes[int(np.argmax(density))]) if scale is None else scale
    gain = a**2 * singular / (1 + (a * singular) ** 2)
    amplitude = root @ (V.T @ (gain * (U.T @ right)))
    posterior = root @ V.T
    variance = np.sum((root @ root.T * a**2) * np.eye(3 * k), axis=1) - np.sum(
        posterior**2 * (a**4 * singular**2 / (1 + (a * singular) ** 2)), axis=1
    )
    factor = WIDTH * np.sqrt(2 * np.pi)  # neighbouring probes add up to this
    shape = (3, k)
    return MissingMoment(
        blocks.time,
        factor * amplitude.reshape(shape).T,
        factor * np.sqrt(np.maximum(variance, 0.0)).reshape(shape).T,
        a,
    )


def _unit(columns: Array) -> Array:
    length = np.linalg.norm(columns, axis=0)
    return columns / np.where(length > 0, length, 1.0)


def responding(system: DiscSystem, fit_: Fit) -> tuple[Responses, NDArray[np.intp]] | None:
    """Responses along the fitted motion, and which of their instants are the frames'; None where it does not roll."""
    instants = system.instants(fit_.values)
    per_frame = int(np.ceil(INSTANTS_PER_SECOND * float(np.median(np.diff(instants)))))
    n = len(instants)
    fine = np.interp(np.arange(per_frame * (n - 1) + 1) / per_frame, np.arange(n), instants)
    found = responses(system.model_with(fit_.values), state_of(fit_.values), fine, THETA_END)
    return None if found is None else (found, np.arange(n) * per_frame)


def probe(system: DiscSystem, fit_: Fit, other: Values | None = None) -> _Blocks | None:
    """Responses of the dots to short moments along n0, m0, k, compressed part by part; None where the disc slips.

    other : values whose prediction takes the place of the data, so that its moment is read in the same way
    """
    along = responding(system, fit_)
    if along is None:
        return None
    motion, frames = along
    span = float(motion.time[-1] - motion.time[0])
    turns = max(float(np.abs(motion.q[-1, i] - motion.q[0, i])) / (2 * np.pi) for i in (3, 5))
    k = int(np.clip(np.ceil(PROBES_PER_TURN * turns), 20, MAX_PROBES))
    middles = motion.time[0] + span * (np.arange(k) + 0.5) / k
    residual, derivative = system.linearise(fit_.values, fit_.names)
    right, matrix = prior_rows(fit_.quantities, fit_.values)
    if other is not None:
        residual = residual - system.linearise(other, [])[0]
        right = right - prior_rows(fit_.quantities, {**fit_.values, **other})[0]  # numbers strained before may relax
    bells = np.exp(-0.5 * ((motion.time[:, None] - middles) / (WIDTH * span / k)) ** 2)
    courses = np.zeros((len(bells), len(COMPONENTS), len(AXES), k))
    for i in range(len(AXES)):
        courses[:, i, i] = bells
    moved = motion.of(courses.reshape(len(bells), len(COMPONENTS), -1))[frames]
    by_start = derivative[..., [fit_.names.index(f"state.{name}") for name in STATE_SCALES]]
    everything = np.concatenate([derivative, by_start @ moved, residual[..., None]], axis=-1)
    parts = np.array_split(np.arange(len(residual)), PARTS)
    triangles = tuple(triangle(everything[rows].reshape(-1, everything.shape[-1])) for rows in parts)
    prior = np.concatenate([matrix, np.zeros((len(matrix), 3 * k)), right[:, None]], axis=1)
    return _Blocks(triangles, prior, len(fit_.names), middles, span / k)


@dataclass(frozen=True)
class GainOfFamily:
    """What a family gains to first order."""

    family: Family
    gain: float  # decrease of chi-square
    values: Array  # coefficients of its terms


class _Scan:
    """Gains of families at one fit. All that is asked of a frame's dots is compressed to the eight numbers of a state.

    A column of the least-squares problem is D g: D (n, w, 8) by the initial state, g (n, 8) the response. Inner
    products of columns, cleared of what the fitted quantities W absorb, are sums over g' (D' D) g less those of W' D g.

    beside : quantities to be fitted beside a law, if not those of the fit. What the others do is given back to the
    residual to first order: so a law is looked for in their place, along a motion that follows the data.
    """

    def __init__(self, system: DiscSystem, fit_: Fit, beside: Sequence[Quantity] | None = None) -> None:
        along = responding(system, fit_)
        assert along is not None
        self.motion, self._frames = along
        fitted = fit_.quantities if beside is None else tuple(beside)
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
        Q = np.linalg.qr(_unit(stacked[:, :-1]))[0]
        left = stacked[:, -1] - Q @ (Q.T @ stacked[:, -1])
        basis = Q[: residual.size]
        if common.names:
            basis = np.column_stack([common.rows, basis])
        n, w = residual.shape
        D = derivative[..., [[q.name for q in moved].index(f"state.{name}") for name in STATE_SCALES]]
        self._normal = np.swapaxes(D, 1, 2) @ D
        self._absorbed = np.swapaxes(basis.reshape(n, w, -1), 1, 2) @ D
        self._right = np.einsum("nw,nwk->nk", left[: residual.size].reshape(n, w), D)
        self.chi_square = float(left @ left)
        model, m = system.model, self.motion
        k = kinematics(m.q, m.qdot, system.disc, model.gravity, m.time, model.air_density)
        space: dict[str, Any] = {name: np.asarray(k[name]) for name in k.dtype.names or ()}
        space |= {f: getattr(np, f) for f in ("cos", "sin", "exp", "sqrt", "log")}
        space |= {"magnitude": np.abs, "sign": lambda x, width: x / np.sqrt(x * x + width * width)}
        self._space, self._courses = space, dict[str, Array]()
        # what a law adds to the load changes its own moment in second order
        followed = simulate(system.model_with(fit_.values), state_of(fit_.values), times=self.motion.time)
        self._load = followed.contact_force[:, 2]

    def _course(self, formula: str) -> Array:
        if formula not in self._courses:
            values = eval(formula, {"__builtins__": {}}, self._space)  # formulas of the library only
            self._courses[formula] = np.broadcast_to(np.asarray(values, float), self.motion.time.shape)
        return self._courses[formula]

    def proposals(self, library: Iterable[Family]) -> list[GainOfFamily]:
        """The families with their gains."""
        found: list[GainOfFamily] = []
        waiting = iter(library)
        while True:
            chunk, n = list[Family](), 0
            while n < CHUNK and (more := list(islice(waiting, 1))):
                chunk += more
                n += len(more[0].terms)
            if not chunk:
                return found
            found += self._gains(chunk, n)

    def _gains(self, chunk: Sequence[Family], n: int) -> list[GainOfFamily]:
        courses = np.zeros((len(self.motion.time), len(COMPONENTS), n))
        self._courses.clear()
        terms = [parts for family in chunk for parts in family.formulas()]
        for column, parts in enumerate(terms):
            for component, formula in parts.items():
                kind, _, axis = component.partition("_")
                factor = self._load if kind == "load" else 1.0
                course = factor * self._course(formula)
                courses[:, COMPONENTS.index(f"M_{axis}" if kind == "load" else component), column] += course
        g = self.motion.of(courses)[self._frames]
        seen = self._normal @ g
        taken = np.tensordot(self._absorbed, g, axes=([0, 2], [0, 1]))
        right = np.tensordot(self._right, g, axes=([0, 1], [0, 1]))
        found, first = [], 0
        for family in chunk:
            own = slice(first, first + len(family.terms))
            first = own.stop
            before = np.einsum("nkp,nkq->pq", g[..., own], seen[..., own])
            gram = before - taken[:, own].T @ taken[:, own]
            found.append(_proposal(family, gram, np.diag(before), right[own]))
        return found


def _proposal(family: Family, gram: Array, before: Array, right: Array) -> GainOfFamily:
    """Gain and values from the normal equations of one family; directions that nothing shows count for nothing."""
    length = np.sqrt(np.maximum(before, 1e-300))
    eigenvalues, vectors = np.linalg.eigh(gram / np.outer(length, length))
    seen = eigenvalues > INVISIBLE
    along = vectors[:, seen].T @ (right / length)
    values = vectors[:, seen] @ (along / eigenvalues[seen]) / length
    return GainOfFamily(family, float(np.sum(along**2 / eigenvalues[seen])), values)


def learn(
    system: DiscSystem,
    base: Fit,
    noise: float,
    along: Fit | None = None,
    rival: float = np.inf,
    competes: bool = False,
) -> LearnedLaw | None:
    """The law of few terms that describes what is missing; None if none survives, or where the disc slips.

    The law is called "learned", or "learned_2" and so on where the model has learned laws already.
    noise : variance of the residual's noise over that stated
    along : fit of other effects that follows the data more closely than the base does: the law is looked for along its
    motion, in the place of what it has beyond the base
    rival : chi-square over the noise that another explanation leaves; then only a law of a single term is sought, and
    only one that may, to first order, come as near to the data
    competes : with laws beside known effects: terms are added as long as each gains more than its price, and not only
    until noise is left
    """
    name = _free_name(system.model)
    price = price_of_a_number(system.weights)
    rate = float(1.0 / np.median(np.diff(system.time)))
    law: LearnedLaw | None = None
    current, length, alike = base, base.cost / noise, tuple[str, ...]()
    if along is not None and responding(system, along) is None:
        along = None
    rivals = tuple[tuple[LearnedLaw, float], ...]()
    at_noise = noise * (1.0 + 4.0 * float(np.sqrt(2.0 / np.sum(system.weights))))
    looked = 0.0
    most_terms = 1 if np.isfinite(rival) else MAX_TERMS
    while law is None or len(law.families) < most_terms:
        known = system if law is None else system.knowing(law.effect)
        if law is not None and current.reduced_chi_square <= at_noise and not competes:
            remains = left_over(known, current, noise)
            if remains is None or not remains.of_the_motion:
                break
        if responding(known, current) is None:
            break
        scan = _Scan(known, current) if law is not None or along is None else _Scan(known, along, base.quantities)
        library = list(families(scan.motion.q, scan.motion.time, rate, system.disc))
        looked = 2.0 * float(np.log(len(library)))
        worth = [p for p in scan.proposals(library) if p.gain / noise > price * p.family.n_numbers + looked]
        if np.isfinite(rival):
            beyond = COARSE * max(scan.chi_square / noise - rival, 0.0)
            to_beat = {True: rival + NEARLY + beyond, False: rival + NEARLY}  # with a shape that a refit moves
            left = [(scan.chi_square - p.gain) / noise for p in worth]
            worth = [p for p, it in zip(worth, left, strict=True) if it < to_beat[bool(p.family.shape)]]
        begin = current if law is not None or along is None else _with_base_only(base, along)
        # to first order gains are exact to how near the two descriptions are, where there is another
        inexact = scan.chi_square if law is not None or along is None else along.cost
        chosen = _various(worth, scan.chi_square, inexact, noise, price)
        if np.isfinite(rival):
            # what fits as well in more numbers is not named, but counts in what is known of the force
            kinds = {p.family.kind for p in chosen}
            longer = sorted((p for p in worth if p.family.kind not in kinds), key=lambda p: -p.gain)
            chosen += longer[:LONGER]
        trials = [_refitted(system, base, law, begin, p, name) for p in chosen]
        lengths = [t.cost / noise + price * _numbers(one) + looked * len(one.families) for one, t in trials]
        if not trials or min(lengths) >= length:
            break
        best = int(np.argmin(lengths))
        near = [one.title for (one, _), other in zip(trials, lengths, strict=True) if other - lengths[best] < ALIKE]
        alike = tuple(title for title in dict.fromkeys(near) if title != trials[best][0].title)
        # how short a law is decides which is named; what the recording determines is what all that fit it agree in
        least = trials[best][1].cost
        odds = [float(np.exp(-0.5 * max(t.cost - least, 0.0) / noise)) if t.converged else 0.0 for _, t in trials]
        others = [i for i in range(len(trials)) if i != best and odds[i] > UNLIKELY]
        rivals = tuple((trials[i][0], odds[i]) for i in others)
        (law, current), length = trials[best], lengths[best]
    if law is None:
        return None
    law = replace(law, alike=alike, rivals=rivals, looked=looked, share=_stability(system, law, current, noise))
    return without_idle_terms(law, current)


def shortest_to_first_order(system: DiscSystem, base: Fit, along: Fit, noise: float) -> float:
    """Chi-square with all prices of the law without a shape that comes nearest; infinite where the disc slips.

    along : fit of known effects, in the place of which the law stands beside the base's
    """
    if responding(system, along) is None:
        return np.inf
    scan = _Scan(system, along, base.quantities)
    rate = float(1.0 / np.median(np.diff(system.time)))
    library = list(families(scan.motion.q, scan.motion.time, rate, system.disc))
    price, looked = price_of_a_number(system.weights), 2.0 * float(np.log(len(library)))
    proposals = scan.proposals(family for family in library if not family.shape)
    nearest = min((scan.chi_square - p.gain) / noise + price * p.family.n_numbers for p in proposals)
    return nearest + looked + price * sum(not np.isfinite(q.prior_sigma) for q in base.quantities)


def _with_base_only(base: Fit, along: Fit) -> Fit:
    """The base fit, to start where the other one ended, without the effects that it has beyond the base."""
    beyond = {q.name: q.null for q in along.quantities if q.name not in base.names}
    return replace(base, values=base.values | along.values | beyond)


def _numbers(law: LearnedLaw) -> int:
    return sum(family.n_numbers for family in law.families)


def _various(
    proposals: Sequence[GainOfFamily], chi_square: float, inexact: float, noise: float, price: float
) -> list[GainOfFamily]:
    """The best ones, not more than some of a kind: to first order many of a kind are alike.

    inexact : chi-square of the motion along which they were looked for
    """

    def rank(p: GainOfFamily) -> tuple[float, float]:
        left = (chi_square - p.gain) / noise
        return price * p.family.n_numbers + max(left, EXACT * inexact / noise), left

    ranked = sorted(proposals, key=rank)
    found, kinds = list[GainOfFamily](), list[str]()
    for p in ranked:
        if kinds.count(p.family.kind) < OF_ONE_KIND:
            found.append(p)
            kinds.append(p.family.kind)
        if len(found) == REFITTED:
            break
    return found


def _refitted(
    system: DiscSystem, base: Fit, law: LearnedLaw | None, current: Fit, new: GainOfFamily, name: str
) -> tuple[LearnedLaw, Fit]:
    """The law enlarged by a family, fitted to the data."""
    before = law.families if law else ()
    values = [current.values[n] for n in law.candidate.names] if law else []
    enlarged = _law((*before, new.family), np.array([*values, *new.values, *new.family.shape.values()]), name)
    start = replace(enlarged, values=current.values)
    known = system.knowing(enlarged.effect)
    fitted = with_law(known, base, start)
    if not fitted.converged and (widths := _widths(enlarged)):
        fitted = min(fitted, _one_by_one(known, base, start, widths), key=lambda f: (not f.converged, f.cost))
    reached = replace(enlarged.candidate, start=tuple(fitted.values[n] for n in enlarged.candidate.names))
    return replace(enlarged, candidate=reached, values=fitted.values), fitted


def _widths(law: LearnedLaw) -> list[Quantity]:
    return [q for q in law.candidate.quantities if q.part.partition("_")[0] in WIDTHS]


def _one_by_one(system: System, base: Fit, law: LearnedLaw, widths: Sequence[Quantity]) -> Fit:
    """The law's fit with its widths found along their profiles: in a short time a blow's width hardly shows."""
    values = dict(base.values) | dict(law.values) | dict(zip(law.candidate.names, law.candidate.start, strict=True))
    others = [q for q in law.candidate.quantities if q not in widths]
    fitted = fit(system, (*base.quantities, *others), values, MAX_ITERATIONS, may_crawl=False)
    for q in widths:
        fitted = profiled(system, fitted, q, 0.3 * fitted.values[q.name])
    return fitted


def with_law(system: System, base: Fit, law: LearnedLaw) -> Fit:
    """The base model's fit with the law's numbers fitted along."""
    start = dict(base.values) | dict(law.values) | dict(zip(law.candidate.names, law.candidate.start, strict=True))
    return fit(system, (*base.quantities, *law.candidate.quantities), start, MAX_ITERATIONS, may_crawl=False)


def in_two_steps(system: System, base: Fit, law: LearnedLaw) -> Fit:
    """The law's fit; where that comes near and does not arrive, from where its amounts alone lead.

    Far from the law's motion, edges make kinks on the way to it.
    """
    fitted = with_law(system, base, law)
    if fitted.converged or not fitted.reduced_chi_square < COMES_NEAR:
        return fitted
    start = dict(base.values) | dict(law.values) | dict(zip(law.candidate.names, law.candidate.start, strict=True))
    amounts = [q for q in law.candidate.quantities if not _is_shape(q)]
    held = fit(system, (*base.quantities, *amounts), start, MAX_ITERATIONS, may_crawl=False)
    reached = replace(law.candidate, start=tuple(held.values[n] for n in law.candidate.names))
    again = with_law(system, base, replace(law, candidate=reached, values=held.values))
    return min(fitted, again, key=lambda f: (not f.converged, f.cost))


def _free_name(model: Model) -> str:
    names = ("learned", *(f"learned_{i}" for i in range(2, len(model.effects) + 2)))
    return next(name for name in names if model.effect(name) is None)


def _stability(system: DiscSystem, law: LearnedLaw, fitted: Fit, noise: float) -> tuple[float, ...]:
    """How often each family gains more than its price in a random half of the recording's parts."""
    known = system.knowing(law.effect)
    residual, derivative = known.linearise(fitted.values, fitted.names)
    if not (np.isfinite(residual).all() and np.isfinite(derivative).all()):
        return tuple(0.0 for _ in law.families)
    # the data as the law's numbers at zero would leave them, to first order
    missing = [q.name for q in law.candidate.quantities if not _is_shape(q)]
    index = [fitted.names.index(name) for name in missing]
    residual = residual + derivative[..., index] @ np.array([fitted.values[name] for name in missing])
    stacked = np.concatenate([derivative, residual[..., None]], axis=-1)
    right, matrix = prior_rows(fitted.quantities, fitted.values)
    prior = np.column_stack([matrix, right])
    parts = [
        triangle(stacked[r].reshape(-1, stacked.shape[-1])) for r in np.array_split(np.arange(len(stacked)), PARTS)
    ]
    rng = np.random.default_rng(PARTS)
    price = price_of_a_number(system.weights)
    counts = np.zeros(len(law.families))
    for _ in range(RESAMPLES):
        drawn = rng.permutation(PARTS)[: PARTS // 2]
        R = triangle(np.vstack([*(parts[i] for i in drawn), prior]))
        for i, family in enumerate(law.families):
            own = [fitted.names.index(n) for n in law.candidate.names if _family_of(n) == i]
            others = [j for j in range(len(fitted.names)) if j not in own]
            left = [_left(R, columns) for columns in (others, [*others, *own])]
            counts[i] += (left[0] - left[1]) / noise > price * family.n_numbers
    return tuple((counts / RESAMPLES).tolist())


def _left(R: Array, columns: Sequence[int]) -> float:
    A = _unit(R[:, list(columns)])
    x = np.linalg.lstsq(A, R[:, -1], rcond=1e-10)[0]
    return float(np.sum((R[:, -1] - A @ x) ** 2))


_SHAPES = {  # smallest and largest value, and a sensible step
    "rate": (0.0, np.inf, 0.1),
    "edge": (-np.inf, np.inf, 1e-4),
    "softness": (5e-4, 0.1, 1e-4),
    "instant": (-np.inf, np.inf, 1e-3),
    "angle": (-np.inf, np.inf, 0.01),
    "direction": (-np.inf, np.inf, 0.01),
    "width": (0.04, 2.0, 0.01),
    "length": (1e-3, 0.05, 1e-4),
    "x0": (-np.inf, np.inf, 1e-4),
    "y0": (-np.inf, np.inf, 1e-4),
}


def _family_of(name: str) -> int:
    """Which family a number of the law belongs to: "learned.c_0_1" and "learned.edge_0" to number 0."""
    return int(name.partition(".")[2].split("_")[1])


def _is_shape(q: Quantity) -> bool:
    return q.part.partition("_")[0] in _SHAPES


def _law(chosen: Sequence[Family], values: Array, name: str) -> LearnedLaw:
    """The effect by formula of these families; values (k,): family by family, coefficients and then shapes."""
    formulas = dict[str, str]()
    quantities, parameters = list[Quantity](), list[EffectParameter]()
    start = iter(np.asarray(values, float).tolist())
    for i, family in enumerate(chosen):
        inside = {shape: f"{shape}_{i}" for shape in family.shape}
        for j, parts in enumerate(family.terms):
            number = f"c_{i}" if len(family.terms) == 1 else f"c_{i}_{j}"
            value = next(start)
            quantities.append(
                Quantity(f"{name}.{number}", "SI", 0.01 * abs(value) or 1e-9, meaning=f"{family.title}, term {j + 1}")
            )
            parameters.append(EffectParameter(number, "SI", value, family.title))
            for component, formula in parts.items():
                piece = f"{number} * ({formula.format(**inside)})"
                formulas[component] = f"{formulas[component]} + {piece}" if component in formulas else piece
        for shape, own in inside.items():
            value, (lower, upper, step) = next(start), _SHAPES[shape]
            value = float(np.clip(value, lower, upper))
            text = f"{shape} of {family.title}"
            quantities.append(Quantity(f"{name}.{own}", "SI", step, value, lower, upper, meaning=text))
            parameters.append(EffectParameter(own, "SI", value, text, value, lower, upper, is_shape=True))
    title = "; ".join(f"{k} = {v}" for k, v in formulas.items())
    source = "regression on the residual of this recording"
    effect = effect_from_formulas(name, formulas, tuple(parameters), title=title, source=source)
    begin = tuple(float(v) for v in values)
    candidate = Candidate(name, name, "motion", effect.title, effect.source, tuple(quantities), begin)
    return LearnedLaw(candidate, effect, tuple(chosen))


def without_idle_terms(law: LearnedLaw, fitted: Fit) -> LearnedLaw:
    """The law without the terms that the fit to the data itself finds to be zero, if it has others; else the same.

    Terms that go together may each be open where their family is not: it is judged as a whole, and so are they.
    """
    kept, values, share = list[Family](), list[float](), list[float]()
    names = iter(law.candidate.quantities)
    for number, family in enumerate(law.families):
        own = [next(names) for _ in range(family.n_numbers)]
        amounts = own[: len(family.terms)]
        busy = _busy(fitted, [q.name for q in amounts])
        if not busy:
            continue
        share += law.share[number : number + 1]
        title = family.title if 0 in busy else f"{family.title}, without its first term"  # which it has its name from
        kept.append(replace(family, title=title, terms=tuple(family.terms[i] for i in busy)))
        values += busy.values()
        values += [fitted.values[q.name] for q in own[len(family.terms) :]]
    if not kept or len(values) == len(law.candidate.quantities):
        return law
    shorter = _law(kept, np.array(values), law.candidate.name)
    return replace(
        shorter, values=fitted.values, share=tuple(share), alike=law.alike, rivals=law.rivals, looked=law.looked
    )


def _busy(fitted: Fit, names: Sequence[str]) -> dict[int, float]:
    """Those of the amounts that the data need, with their values while the others are zero; none if all are idle.

    One after the other goes, each judged with those before it out: of two that move together one may do for both.
    """
    index = [fitted.names.index(n) for n in names]
    amounts = np.array([fitted.values[n] for n in names])
    size = np.sqrt(np.diag(fitted.covariance)[index])
    if not (size > 0).all():
        return {i: float(v) for i, v in enumerate(amounts) if abs(v) > MIN_SIGMAS * size[i]}
    correlation = fitted.covariance[np.ix_(index, index)] / np.outer(size, size)
    left = amounts / size
    if as_sigmas(float(left @ np.linalg.pinv(correlation, hermitian=True) @ left), len(names)) <= MIN_SIGMAS:
        return {}
    there = list(range(len(names)))
    while len(there) > 1:
        sigmas = np.abs(left[there]) / np.sqrt(np.maximum(np.diag(correlation)[there], IDLE))
        least = there[int(np.argmin(sigmas))]
        if sigmas.min() > MIN_SIGMAS:
            break
        along = correlation[:, least] / max(correlation[least, least], IDLE)
        left = left - along * left[least]
        correlation = correlation - np.outer(along, correlation[least])
        there.remove(least)
    return {i: float(left[i] * size[i]) for i in there}


def learned_moment(system: DiscSystem, fit: Fit, law: LearnedLaw) -> Array:
    """(n, 3) contact moment of the law in the fitted motion [N m]."""
    motion = simulated(system, fit.values)
    k = kinematics(motion.q, motion.qdot, system.disc, system.model.gravity, motion.time, system.model.air_density)
    effect = motion.model.effect(law.candidate.effect)
    if effect is None:
        return np.zeros((len(motion), 3))
    return effect_wrench(effect, k, motion.contact_force[:, 2])[0]
