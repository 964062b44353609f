"""Where a fit begins: in short stretches with a start each, joined two by two as far as the model follows the motion.

Over many turns of an oscillation chi-square has many minima; over a fifth of one it has one, and all stretches together
tell what the whole tells. A fit that begins there and is led to longer and longer stretches (multiple shooting, Bock
1981) stays in it, for as long as the model can follow at all.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np
from scipy import signal
from scipy.optimize import least_squares

from calibration.kit.arrays import Array
from disctrack.discrepancy.elimination import prior_rows
from disctrack.discrepancy.equations.declared import Samples
from disctrack.discrepancy.equations.formulas import Formulas
from disctrack.discrepancy.equations.system import MOST_STATES, EquationSystem, cut
from disctrack.discrepancy.fit import TRIAL, fit
from disctrack.discrepancy.search import AGREES
from disctrack.discrepancy.system import Quantity, System, Values

FEWEST, SHORT = 10, 0.2  # samples, and share of a turn, of a short stretch: over it a step by any law is nearly linear
LOST = 0.3  # rms of the residual over that of the signal, from which on the model no longer follows the motion
LOOSE = 0.6  # the same where it is not followed in short stretches: most of it is still that of the model
_WINDOWS = (8, 12, 18, 27, 40, 60, 90, 135, 200)  # samples of the local polynomial
_ATTEMPTS = 100  # steps within regions of trust
_NOWHERE = 1e8  # residual of what has no value
_INSTANTS = 24  # at which the sizes of the states are looked at


def local_polynomial(s: Samples, channel: int, first: int) -> tuple[float, float] | None:
    """Value and slope of a channel at sample `first`, from a cubic over as many samples as it fits."""
    rows = first + np.flatnonzero(np.isfinite(s.data[first:, channel]))
    best = None
    for m in _WINDOWS:
        if m > len(rows):
            break
        some = rows[:m]
        x, y, sigma = s.time[some] - s.time[first], s.data[some, channel], s.sigma[some, channel]
        scale = x[-1] or 1.0
        basis = (x[:, None] / scale) ** np.arange(4)
        coefficients = np.linalg.lstsq(basis / sigma[:, None], y / sigma, rcond=None)[0]
        if best is not None and np.sum(((y - basis @ coefficients) / sigma) ** 2) > 2.0 * (m - 4) + 6:
            break
        best = (float(coefficients[0]), float(coefficients[1] / scale))
    return best


def states_from_data(formulas: Formulas, s: Samples, p: Array, first: int, begin: Array) -> Array:
    """States (n,) in which the sensors show what the data show at sample `first`, and change as they do.

    What neither tells stays near `begin`.
    """
    w = len(formulas.channels)
    local = [local_polynomial(s, c, first) for c in range(w)]
    value_size = np.array([(np.std(x[np.isfinite(x)]) if np.isfinite(x).any() else 0.0) or 1.0 for x in s.data.T])
    slope_size = value_size / max(turn(s), 1e-300) * 2 * np.pi

    def misfit(y: Array, slopes: float) -> Array:
        t, y = np.array([s.time[first]]), y[None]
        h, H_y, _ = formulas.sensors_at(s, p, t, y)
        f = formulas.rates_at(s, p, t, y)[0]
        with np.errstate(all="ignore"):  # a guess may lie where a logarithm or a root has no value
            slope = H_y[0] @ f[0]
        parts = [1e-4 * (y[0] - begin) / np.maximum(np.abs(begin), 1.0)]
        for c, known in enumerate(local):
            if known is not None:
                parts.append(np.array([h[0, c] - known[0]]) / value_size[c])
                parts.append(slopes * np.array([slope[c] - known[1]]) / slope_size[c])
        return np.nan_to_num(np.concatenate(parts), nan=1e6, posinf=1e6, neginf=-1e6)

    # first what is shown: slopes have other solutions besides, and are those of parameters not yet fitted
    for slopes in (0.0, 0.1):
        scale = np.maximum(np.abs(begin), 1e-3)
        begin = np.asarray(least_squares(misfit, begin, method="lm", x_scale=scale, args=(slopes,)).x, float)
    return begin


def turn(s: Samples) -> float:
    """Time [s] of one turn of the strongest oscillation in the data, at most half the run."""
    duration = float(s.time[-1] - s.time[0])
    grid = np.linspace(s.time[0], s.time[-1], int(min(len(s.time), 20_000)))
    best, found = 0.0, duration / 2
    for c in range(s.data.shape[1]):
        present = np.isfinite(s.data[:, c])
        if present.sum() < 8:
            continue
        x = np.interp(grid, s.time[present], s.data[present, c])
        frequency, power = signal.periodogram(x, (len(grid) - 1) / duration, detrend="linear", scaling="spectrum")
        share = power / max(float(np.nanmean(s.sigma[:, c]) ** 2), 1e-300)
        i = int(np.argmax(share[1:])) + 1
        if share[i] > best:
            best, found = float(share[i]), min(duration / 2, 1.0 / float(frequency[i]))
    return found


def ample(system: EquationSystem) -> list[Samples]:
    """Stretches of half as many samples as the longest, or more: a few before a gap tell no turn."""
    most = max(len(s.time) for s in system.stretches)
    return [s for s in system.stretches if 2 * len(s.time) >= most]


def guessed(system: EquationSystem) -> tuple[dict[str, float], Array]:
    """Initial states of every stretch by the names of their quantities, and the sizes (n,) of the states."""
    f = system.formulas
    names = f.equations.states
    values: dict[str, float] = {}
    seen = []
    for s in system.stretches:
        p = system.numbers({}, s)
        begin = system.start_of({}, s)
        usable = np.flatnonzero(np.isfinite(s.data).any(axis=1))
        given = np.array([name in s.start or name in s.known for name in names])
        first = begin if given.all() else np.where(given, begin, states_from_data(f, s, p, int(usable[0]), begin))
        seen.append(first)
        values |= {f"state.{name}[{s.name}]": float(v) for name, v in zip(names, first, strict=True)}
        count = max(2, _INSTANTS // len(system.stretches)) if len(system.stretches) < _INSTANTS else 0
        for row in usable[np.linspace(0, max(len(usable) - 9, 0), count).astype(int)]:
            seen.append(states_from_data(f, s, p, int(row), first))
    sizes = np.quantile(np.abs(seen), 0.9, axis=0)
    floor = 1e-6 * max(float(sizes.max()), 1e-12)
    return values, np.asarray(np.maximum(sizes, floor), float)


def sizes_alike(system: EquationSystem, values: Mapping[str, float]) -> dict[str, float]:
    """Of every number that shows, the size at which it does as much as an equation, or a tenth of a sensor, in all."""
    f = system.formulas
    n_fitted = len(f.fitted)
    own, acting = np.zeros(len(f.states)), np.zeros((len(f.states), n_fitted))
    shown, seen = np.zeros(len(f.channels)), np.zeros((len(f.channels), n_fitted))
    for s in system.stretches:
        rates, by_number, h, H_p = system.along(values, s)
        own += np.sum(rates**2, axis=0)
        acting += np.sum(by_number[..., :n_fitted] ** 2, axis=0)
        shown += np.sum((h - h.mean(axis=0)) ** 2, axis=0)
        seen += np.sum(H_p[..., :n_fitted] ** 2, axis=0)
    with np.errstate(divide="ignore", invalid="ignore"):
        sizes = np.concatenate([np.sqrt(own[:, None] / acting), 0.1 * np.sqrt(shown[:, None] / seen)])
    usable = np.where(np.isfinite(sizes) & (sizes > 0), sizes, np.inf).min(axis=0)
    return {name: float(size) for name, size in zip(f.fitted, usable, strict=True) if np.isfinite(size)}


@dataclass(frozen=True)
class Start:
    """Values from which Gauss-Newton converges, as far as the model follows the motion."""

    system: EquationSystem  # in stretches over which it does so safely
    values: dict[str, float]
    followed: float  # [s] of the longest stretch over which it does
    whole: bool = False  # does it follow all runs to their end?


def lasting(system: EquationSystem) -> float:
    """Duration [s] of the longest stretch."""
    return max(float(s.time[-1] - s.time[0]) for s in system.stretches)


def misfit(system: EquationSystem, values: dict[str, float]) -> float:
    """Largest over the channels: rms of the residual over that of the signal, all stretches together."""
    return float(np.max(misfits(system, values)))


def misfits(system: EquationSystem, values: dict[str, float]) -> Array:
    """Of each channel (w,): rms of the residual over that of the signal, all stretches together.

    What the noise may make of a residual is taken off: before a motion sets in, there is nothing but noise to follow.
    """
    square, size = np.zeros(len(system.formulas.channels)), np.zeros(len(system.formulas.channels))
    for s, found in zip(system.stretches, system.predictions(values), strict=True):
        if found is None:
            return np.full_like(size, np.inf)
        noise = np.where(np.isfinite(s.data), s.sigma**2, 0.0).sum(axis=0)
        present = np.maximum(np.isfinite(s.data).sum(axis=0), 1)
        square += np.maximum(np.nansum((s.data - found.seen) ** 2, axis=0) - AGREES * noise, 0.0)
        size += np.nansum((s.data - np.nansum(s.data, axis=0) / present) ** 2, axis=0) + noise
    return np.asarray(np.sqrt(square / np.maximum(size, 1e-300)), float)


def cut_short(system: EquationSystem, share: float = SHORT) -> list[EquationSystem]:
    """The stretches cut into shares of a turn, and these joined two by two until they are whole again.

    No more than MOST_STATES tell: those that begin where longer ones do.
    """
    most, long = MOST_STATES / len(system.formulas.states), ample(system)
    spacing = min(float(np.median(np.diff(s.time))) for s in long)
    duration = max(share * min(turn(s) for s in long), FEWEST * spacing)
    levels: list[list[Samples]] = []
    while not levels or len(levels[-1]) > len(system.stretches):
        levels.append([part for s in system.stretches for part in cut(s, duration)])
        duration *= 2
    begun = {part.name for part in next(parts for parts in levels if len(parts) <= max(most, len(levels[-1])))}
    some = ([part for part in parts if part.name in begun] for parts in levels[:-1])
    return [*(replace(system, stretches=parts) for parts in some), system]


def led(system: EquationSystem, values: Values) -> Start:
    """Fit to short stretches that are joined two by two to the whole, or until the model loses the motion."""
    for share in (SHORT, SHORT / 4):  # what turns and drifts, or is chaotic, may be followed for less
        found = _led(cut_short(system, share), values)
        if found.followed > 0.0:
            return found
    # short stretches do not tell a state that no sensor shows, as a known start of the whole may
    at_once = trusted(system, [near_declared(q) for q in system.base], guessed(system)[0] | dict(values))
    # one of several sensors may show little but what is missing
    followed = lasting(system) if np.median(misfits(system, at_once)) <= LOOSE else 0.0
    return Start(system, at_once, followed, followed > 0.0)


def _led(systems: Sequence[EquationSystem], values: Values) -> Start:
    now = dict(values) | guessed(systems[0])[0]
    now |= fit(systems[0], [q for q in systems[0].base if q.is_initial], now, TRIAL).values
    reached: list[tuple[EquationSystem, dict[str, float]]] = []
    for part in systems:
        trial = now | fit(part, [near_declared(q) for q in part.base], now, TRIAL).values
        if not misfit(part, trial) <= LOST:
            break
        now = trial  # a longer stretch begins where the first of those does that it is made of
        reached.append((part, now))
    if not reached:
        return Start(systems[0], trial, 0.0)
    whole = len(reached) == len(systems)
    # near the end of what it can follow chi-square is full of minima: half of that is safe
    chosen, values = reached[-1 if whole else max(len(reached) - 2, 0)]
    return Start(chosen, values, lasting(reached[-1][0]), whole)


def near_declared(q: Quantity) -> Quantity:
    """Of a parameter that the data may not tell, one that stays near; of a term's number zero is the absence."""
    return q if q.declared is None else replace(q, prior_sigma=min(q.prior_sigma, max(abs(q.null), q.scale)))


def trusted(system: System, quantities: Sequence[Quantity], declared: Mapping[str, float]) -> dict[str, float]:
    """Quantities fitted within a region of trust that grows and shrinks with its success.

    Gauss-Newton's halved steps end where a parameter far off (a gain of the wrong sign) has to pass through values with
    which nothing moves.
    """
    names = [q.name for q in quantities]
    null = np.array([q.null for q in quantities])
    lower, upper = (np.array([getattr(q, side) for q in quantities]) for side in ("lower", "upper"))
    size = np.maximum(np.abs(null), [q.scale for q in quantities])
    start = np.clip([declared.get(name, q.null) for name, q in zip(names, quantities, strict=True)], lower, upper)

    def at(x: Array) -> dict[str, float]:
        return dict(declared) | dict(zip(names, x.tolist(), strict=True))

    def residual(x: Array) -> Array:
        rows = np.concatenate([system.linearise(at(x), [])[0].ravel(), prior_rows(quantities, at(x))[0]])
        return np.nan_to_num(rows, nan=_NOWHERE, posinf=_NOWHERE, neginf=-_NOWHERE)

    def jacobian(x: Array) -> Array:
        derivative = system.linearise(at(x), names)[1].reshape(-1, len(names))
        return -np.nan_to_num(np.vstack([derivative, prior_rows(quantities, at(x))[1]]))

    if not all(np.isfinite(part).all() for part in system.linearise(at(start), names)):
        return dict(declared)
    limits = lower, upper
    return at(least_squares(residual, start, jacobian, limits, x_scale=size, max_nfev=_ATTEMPTS).x)
