"""A law for what no catalogue names: the missing moment as a function of time, and as few terms that describe it.

The motion's responses to short moments (probes) resolve the residual into a moment over time. Every term of a library
is a course of that moment, so that its predicted residual is a sum of probes; terms are taken in by the gain of
chi-square and kept if they are also chosen when parts of the recording are left out. What survives becomes an effect
by formula and is fitted like any other.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from calibration.arrays import Array
from disctrack.diagnosis.disc.system import DiscSystem
from disctrack.diagnosis.engine.fit import Fit, prior_rows, triangle
from disctrack.diagnosis.engine.system import Candidate, Quantity, Values
from disctrack.rolling import Model
from disctrack.rolling.effects import Effect, effect_from_formulas
from disctrack.rolling.evaluate import effect_wrench, kinematics

AXES = ("n", "m", "z")
PROBES_PER_TURN = 7  # of the fastest angle, so that a moment locked to it is resolved
MAX_PROBES = 90
WIDTH = 0.7  # of a probe over the distance to the next: their sum is flat to 1e-4
PARTS = 10  # of the recording, half of which are drawn for each resample
RESAMPLES = 40
KEPT_SHARE = 0.6  # of the resamples in which a term must be chosen
MAX_TERMS = 3
MIN_SIGMAS = 3.0  # of a coefficient after the refit; what helped the smoothed moment may not help the motion
# Names of records.KINEMATICS in formulas; a term locked to an angle has it as an argument.
LIBRARY = {
    "constant": "1.0",
    "sign omega_z": "sign(omega_z, 0.1)",
    "omega_z": "omega_z",
    "omega_z |omega_z|": "omega_z * magnitude(omega_z)",
    "omega_z^3": "omega_z * omega_z * omega_z",
    "thetadot": "thetadot",
    "thetadot |thetadot|": "thetadot * magnitude(thetadot)",
    "psidot": "psidot",
    "psidot |psidot|": "psidot * magnitude(psidot)",
    "psidot^3": "psidot * psidot * psidot",
    "phidot sin theta": "phidot * sin_theta",
    "omega_3": "omega3",
    "sin theta": "sin_theta",
    "1 / sin theta": "1.0 / sin_theta",
    "cos psi": "cos(psi)",
    "sin psi": "sin(psi)",
    "cos 2 psi": "cos(2.0 * psi)",
    "sin 2 psi": "sin(2.0 * psi)",
    "cos phi": "cos(phi)",
    "sin phi": "sin(phi)",
    "cos 2 phi": "cos(2.0 * phi)",
    "sin 2 phi": "sin(2.0 * phi)",
    "cos (psi + phi)": "cos(psi + phi)",
    "sin (psi + phi)": "sin(psi + phi)",
    "time": "time",
}
_LOCKED = ("psi)", "phi)")


@dataclass(frozen=True)
class MissingMoment:
    """Moment that the model fails to supply, smoothed over the distance of the probes."""

    time: Array  # (k,) middles of the probes [s]
    moment: Array  # (k, 3) M_n, M_m, M_z [N m]
    sigma: Array  # (k, 3)
    scale: float  # [N m] that its second differences were taken to have before the data


@dataclass(frozen=True)
class LearnedLaw:
    """Terms that describe the missing moment."""

    candidate: Candidate  # of the effect by formula
    effect: type[Effect]
    terms: tuple[tuple[str, str], ...]  # (axis, function)
    share: tuple[float, ...]  # of the resamples that chose each term
    locked: bool  # to an angle of the body or of the table
    laws: dict[str, str]  # function of each term -> formula

    @property
    def formulas(self) -> dict[str, str]:
        """Component of the wrench -> formula."""
        return dict(self.effect.formulas or {})


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


def probe(system: DiscSystem, fit: Fit, other: Values | None = None) -> _Blocks:
    """Responses of the dots to short moments along n0, m0, k, compressed part by part.

    other : values whose prediction takes the place of the data, so that its moment is read in the same way
    """
    q = system.poses(fit.values)
    span = float(system.time[-1] - system.time[0])
    turns = max(float(np.abs(q[-1, i] - q[0, i])) / (2 * np.pi) for i in (3, 5))
    k = int(np.clip(np.ceil(PROBES_PER_TURN * turns), 20, MAX_PROBES))
    middles = system.time[0] + span * (np.arange(k) + 0.5) / k
    names = [f"wrench_probe.M_{axis}" for axis in AXES]
    residual, derivative = system.linearise(fit.values, fit.names)
    right, matrix = prior_rows(fit.quantities, fit.values)
    if other is not None:
        residual, right = residual - system.linearise(other, [])[0], np.zeros_like(right)
    columns = np.zeros((*residual.shape, 3, k))
    for i, middle in enumerate(middles):
        values = fit.values | {"wrench_probe.t_0": float(middle), "wrench_probe.width": WIDTH * span / k}
        columns[..., i] = system.linearise(values, names)[1]
    width = residual.shape[1]
    everything = np.concatenate(
        [derivative, columns.reshape(len(residual), width, 3 * k), residual[..., None]], axis=-1
    )
    parts = np.array_split(np.arange(len(residual)), PARTS)
    triangles = tuple(triangle(everything[rows].reshape(-1, everything.shape[-1])) for rows in parts)
    prior = np.concatenate([matrix, np.zeros((len(matrix), 3 * k)), right[:, None]], axis=1)
    return _Blocks(triangles, prior, len(fit.names), middles, span / k)


def _harmonics(moment: MissingMoment, blocks: _Blocks) -> dict[str, str]:
    """Functions of time alone at the strongest line of each component of the moment: a hum locked to nothing.

    The line of the smoothed moment is the start; the rate that gains most chi-square nearby is taken.
    """
    k = len(moment.time)
    spectrum = np.abs(np.fft.rfft(moment.moment * np.hanning(k)[:, None], 8 * k, axis=0))
    lines = 2 * np.pi * np.fft.rfftfreq(8 * k, float(moment.time[1] - moment.time[0]))
    slowest = 4 * np.pi / float(moment.time[-1] - moment.time[0])
    spectrum[lines < slowest] = 0.0
    R = triangle(np.vstack([*blocks.triangles, blocks.prior]))
    Q = np.linalg.qr(_unit(R[:, : blocks.n_fitted]))[0]
    cleared = R[:, blocks.n_fitted :] - Q @ (Q.T @ R[:, blocks.n_fitted :])
    found: dict[str, str] = {}
    for axis, peak in enumerate(spectrum.argmax(axis=0)):
        probes = cleared[:, axis * k : (axis + 1) * k]
        near = lines[peak] + slowest * np.linspace(-0.5, 0.5, 41)
        gains = []
        for rate in near:
            waves = np.stack([np.cos(rate * moment.time), np.sin(rate * moment.time)], axis=-1)
            U = np.linalg.qr(_unit(probes @ waves))[0]
            gains.append(np.sum((U.T @ cleared[:, -1]) ** 2))
        rate_text = f"{near[int(np.argmax(gains))]:.5g}"
        found |= {f"{f} {rate_text} t": f"{f}({rate_text} * time)" for f in ("cos", "sin")}
    return found


def courses(system: DiscSystem, fit: Fit, time: Array, laws: Mapping[str, str]) -> dict[str, Array]:
    """Each function of the library along the fitted motion, at the given instants (k,)."""
    from disctrack.diagnosis.disc.errors import simulated

    motion = simulated(system, fit.values)
    k = kinematics(motion.q, motion.qdot, system.disc, system.model.gravity, motion.time)
    space: dict[str, Any] = {name: np.asarray(k[name]) for name in k.dtype.names or ()}
    space |= {"cos": np.cos, "sin": np.sin, "magnitude": np.abs, "sign": lambda x, w: x / np.sqrt(x * x + w * w)}
    found: dict[str, Array] = {}
    for name, formula in laws.items():
        values = eval(formula, {"__builtins__": {}}, space)  # formulas of this module only
        found[name] = np.interp(time, motion.time, np.broadcast_to(values, motion.time.shape))
    return found


def learn(system: DiscSystem, fit: Fit, noise: float) -> tuple[MissingMoment, LearnedLaw | None]:
    """The missing moment, and the law of few terms that describes it; None if no term survives.

    The law is called "learned", or "learned_2" and so on where the model has learned laws already.
    noise : variance of the residual's noise over that stated
    """
    blocks = probe(system, fit)
    moment = missing_moment(blocks)
    laws = LIBRARY | _harmonics(moment, blocks)
    library = courses(system, fit, blocks.time, laws)
    terms = [(axis, term) for axis in AXES for term in library]
    k = len(blocks.time)
    mixing = np.zeros((3 * k, len(terms)))
    for column, (axis, term) in enumerate(terms):
        first = AXES.index(axis) * k
        mixing[first : first + k, column] = library[term] / (WIDTH * np.sqrt(2 * np.pi))
    reduced = [_with_terms(T, blocks.n_fitted, mixing) for T in (*blocks.triangles, blocks.prior)]
    chosen = _forward(np.vstack(reduced), blocks.n_fitted, noise)
    if not chosen:
        return moment, None
    share = _stability(reduced, blocks.n_fitted, noise, chosen)
    kept = [(t, s) for t, s in zip(chosen, share, strict=True) if s >= KEPT_SHARE]
    if not kept:
        return moment, None
    scale = _values(np.vstack(reduced), blocks.n_fitted, [t for t, _ in kept])
    return moment, _law([terms[t] for t, _ in kept], [s for _, s in kept], scale, _free_name(system.model), laws)


def _free_name(model: Model) -> str:
    names = ("learned", *(f"learned_{i}" for i in range(2, len(model.effects) + 2)))
    return next(name for name in names if model.effect(name) is None)


def _with_terms(T: Array, n_fitted: int, mixing: Array) -> Array:
    return np.column_stack([T[:, :n_fitted], T[:, n_fitted:-1] @ mixing, T[:, -1]])


def _forward(rows: Array, n_fitted: int, noise: float) -> list[int]:
    """Indices of the terms taken in one after the other while each pays the price of having been looked for."""
    R = triangle(rows)
    Q = np.linalg.qr(_unit(R[:, :n_fitted]))[0]
    cleared = R[:, n_fitted:] - Q @ (Q.T @ R[:, n_fitted:])
    before = np.linalg.norm(R[:, n_fitted:-1], axis=0)
    right, columns = cleared[:, -1], cleared[:, :-1]
    n_terms = columns.shape[1]
    price = 2 * np.log(n_terms) + np.log(max(len(rows), 2)) + 6
    chosen: list[int] = []
    for _ in range(MAX_TERMS):
        length = np.linalg.norm(columns, axis=0)
        usable = length > 1e-4 * np.maximum(before, 1e-300)
        gains = np.where(usable, (columns.T @ right) / np.where(usable, length, 1.0), 0.0) ** 2 / noise
        best = int(np.argmax(gains))
        # what a further term adds must also be worth the words: a hundredth of what the residual holds
        if gains[best] < max(price, 0.01 * float(right @ right) / noise if chosen else price):
            break
        chosen.append(best)
        direction = columns[:, best] / length[best]
        right = right - direction * (direction @ right)
        columns = columns - np.outer(direction, direction @ columns)
    return chosen


def _stability(reduced: Sequence[Array], n_fitted: int, noise: float, chosen: Sequence[int]) -> list[float]:
    """How often each term is chosen from a random half of the recording's parts."""
    rng = np.random.default_rng(PARTS)
    *parts, prior = reduced
    counts = np.zeros(len(chosen))
    for _ in range(RESAMPLES):
        drawn = rng.permutation(len(parts))[: max(len(parts) // 2, 1)]
        again = _forward(np.vstack([*(parts[i] for i in drawn), prior]), n_fitted, noise)
        counts += [term in again for term in chosen]
    return (counts / RESAMPLES).tolist()


def _values(rows: Array, n_fitted: int, terms: Sequence[int]) -> Array:
    R = triangle(rows)
    matrix = R[:, [*range(n_fitted), *(n_fitted + t for t in terms)]]
    length = np.where(np.linalg.norm(matrix, axis=0) > 0, np.linalg.norm(matrix, axis=0), 1.0)
    return np.asarray((np.linalg.lstsq(matrix / length, R[:, -1], rcond=1e-12)[0] / length)[n_fitted:], float)


def _law(
    terms: Sequence[tuple[str, str]], share: Sequence[float], scale: Array, name: str, laws: Mapping[str, str]
) -> LearnedLaw:
    formulas: dict[str, str] = {}
    for i, (axis, term) in enumerate(terms):
        piece = f"c_{i} * ({laws[term]})"
        formulas[f"M_{axis}"] = f"{formulas[f'M_{axis}']} + {piece}" if f"M_{axis}" in formulas else piece
    effect = effect_from_formulas(name, formulas, source="regression on the residual of this recording")
    quantities = tuple(
        Quantity(f"{name}.c_{i}", "SI", 0.01 * abs(float(v)) or 1e-9, meaning=f"M_{axis} by {term}")
        for i, ((axis, term), v) in enumerate(zip(terms, scale, strict=True))
    )
    candidate = Candidate(name, name, "motion", effect.title, effect.source, quantities, tuple(float(v) for v in scale))
    locked = any(mark in laws[term] for _, term in terms for mark in _LOCKED)
    return LearnedLaw(candidate, effect, tuple(terms), tuple(share), locked, {term: laws[term] for _, term in terms})


def without_idle_terms(law: LearnedLaw, fitted: Fit) -> LearnedLaw:
    """The law without the terms that the fit to the data itself finds to be zero, if it has others; else the same."""
    names = law.candidate.names
    kept = [i for i, n in enumerate(names) if abs(fitted.values[n]) > MIN_SIGMAS * fitted.sigma(n)]
    if not kept or len(kept) == len(names):
        return law
    scale = np.array([fitted.values[names[i]] for i in kept])
    return _law([law.terms[i] for i in kept], [law.share[i] for i in kept], scale, law.candidate.name, law.laws)


def learned_moment(system: DiscSystem, fit: Fit, law: LearnedLaw) -> Array:
    """(n, 3) contact moment of the law in the fitted motion [N m]."""
    from disctrack.diagnosis.disc.errors import simulated

    motion = simulated(system, fit.values)
    k = kinematics(motion.q, motion.qdot, system.disc, system.model.gravity, motion.time)
    effect = motion.model.effect(law.candidate.effect)
    if effect is None:
        return np.zeros((len(motion), 3))
    return effect_wrench(effect, k, motion.contact_force[:, 2])[0]
