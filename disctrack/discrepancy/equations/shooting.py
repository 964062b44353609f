"""Initial values of a fit, by multiple shooting (Bock 1981) over longer and longer stretches.

Over many periods of an oscillation chi-square has many local minima; over a fifth of one it has a single one. The data
are cut into such stretches, with an initial state each and common parameters. They are then joined two by two, and each
fit starts from the one before, as far as the model follows the motion.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np
from scipy import signal
from scipy.optimize import least_squares

from calibration.kit.types import Array
from disctrack.discrepancy.elimination import prior_rows
from disctrack.discrepancy.equations.declared import Samples
from disctrack.discrepancy.equations.formulas import Formulas
from disctrack.discrepancy.equations.system import MOST_STATES, EquationSystem, cut
from disctrack.discrepancy.fit import TRIAL, fit
from disctrack.discrepancy.search import AGREES
from disctrack.discrepancy.system import Quantity, System, Values

FEWEST, SHORT = 10, 0.2  # samples, and share of a period, of a short stretch: over it the motion is nearly linear
LOST = 0.3  # rms of the residuals over that of the signal, above which the model does not follow the motion
LOOSE = 0.6  # the same of whole runs where it follows less than a period
_WINDOWS = (8, 12, 18, 27, 40, 60, 90, 135, 200)  # samples of the local polynomial
_ATTEMPTS = 100  # evaluations of a trust-region fit
_INSTANTS = 24  # at which the sizes of the states are estimated


def local_polynomial(s: Samples, channel: int, first: int) -> tuple[float, float]:
    """Value and slope of a channel at sample `first`, from a cubic over the largest window that it fits; or NaN."""
    rows = first + np.flatnonzero(np.isfinite(s.data[first:, channel]))
    best = np.nan, np.nan
    for m in _WINDOWS:
        if m > len(rows):
            break
        some = rows[:m]
        x, y, sigma = s.time[some] - s.time[first], s.data[some, channel], s.sigma[some, channel]
        scale = x[-1] or 1.0
        basis = (x[:, None] / scale) ** np.arange(4)
        coefficients = np.linalg.lstsq(basis / sigma[:, None], y / sigma, rcond=None)[0]
        if m > _WINDOWS[0] and np.sum(((y - basis @ coefficients) / sigma) ** 2) > 2.0 * (m - 4) + 6:
            break
        best = (float(coefficients[0]), float(coefficients[1] / scale))
    return best


def states_from_data(formulas: Formulas, s: Samples, p: Array, first: int, begin: Array) -> Array:
    """States (n,) whose predicted sensor values and slopes agree with the data at sample `first`.

    States that these do not determine stay near `begin`.
    """
    local = np.array([local_polynomial(s, c, first) for c in range(len(formulas.channels))])
    value_size = np.array([(np.std(x[np.isfinite(x)]) if np.isfinite(x).any() else 0.0) or 1.0 for x in s.data.T])
    sizes = np.stack([value_size, value_size / max(period(s), 1e-300) * 2 * np.pi], axis=1)

    def misfit(y: Array, slopes: float) -> Array:
        t, y = np.array([s.time[first]]), y[None]
        h, H_y, _ = formulas.sensors_at(s, p, t, y)
        f = formulas.rates_at(s, p, t, y)[0]
        with np.errstate(all="ignore"):  # a guess may lie outside the domain of a logarithm or a root
            seen = np.stack([h[0], H_y[0] @ f[0]], axis=1)
            away = np.where(np.isnan(local), 0.0, [1.0, slopes] * (seen - local) / sizes)
        near = 1e-4 * (y[0] - begin) / np.maximum(np.abs(begin), 1.0)
        return np.nan_to_num(np.append(near, away), nan=1e6, posinf=1e6, neginf=-1e6)

    # values first: slopes may have several solutions, and depend on parameters that are not yet fitted
    for slopes in (0.0, 0.1):
        scale = np.maximum(np.abs(begin), 1e-3)
        begin = np.asarray(least_squares(misfit, begin, method="lm", x_scale=scale, args=(slopes,)).x, float)
    return begin


def period(s: Samples) -> float:
    """Period [s] of the strongest oscillation in the data, at most half the run."""
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


def longest_stretches(system: EquationSystem) -> list[Samples]:
    """Stretches with at least half as many samples as the longest: a few samples before a gap show no period."""
    most = max(len(s.time) for s in system.stretches)
    return [s for s in system.stretches if 2 * len(s.time) >= most]


def shortest_period(system: EquationSystem) -> float:
    """Of the longest stretches."""
    return min(period(s) for s in longest_stretches(system))


def initial_guess(system: EquationSystem) -> tuple[dict[str, float], Array]:
    """Initial states of every stretch by name, estimated from the data, and the sizes (n,) of the states."""
    f = system.formulas
    names = f.equations.states
    values: dict[str, float] = {}
    seen = []
    for s in system.stretches:
        p = system.numbers({}, s)
        begin = system.start_of({}, s)
        usable = np.flatnonzero(np.isfinite(s.data).any(axis=1))
        given = np.array([name in s.known for name in names])
        first = begin if given.all() else np.where(given, begin, states_from_data(f, s, p, int(usable[0]), begin))
        seen.append(first)
        values |= {f"state.{name}[{s.name}]": float(v) for name, v in zip(names, first, strict=True)}
        count = max(2, _INSTANTS // len(system.stretches)) if len(system.stretches) < _INSTANTS else 0
        rows = usable[np.linspace(0, max(len(usable) - 9, 0), count).astype(int)]
        seen += [states_from_data(f, s, p, int(row), first) for row in rows]
    sizes = np.quantile(np.abs(seen), 0.9, axis=0)
    floor = 1e-6 * max(float(sizes.max()), 1e-12)
    return values, np.asarray(np.maximum(sizes, floor), float)


def scales(system: EquationSystem, values: Mapping[str, float]) -> dict[str, float]:
    """Natural scale of every parameter: where its effect is as large as its equation, or a tenth of a signal (rms)."""
    f = system.formulas
    n_fitted = len(f.fitted)
    size, acting = 0.0, np.zeros((len(f.states) + len(f.channels), n_fitted))
    for s, motion in system.predictions(values):
        p = system.numbers(values, s)
        states = np.zeros((len(s.time), len(f.states))) if motion is None else motion.states
        rates, _, by_number = f.rates_at(s, p, s.time, states)
        shown, _, seen = f.sensors_at(s, p, s.time, states)
        size += np.sum(np.hstack([rates, 0.1 * (shown - shown.mean(axis=0))]) ** 2, axis=0)[:, None]
        acting += np.sum(np.hstack([by_number, seen])[..., :n_fitted] ** 2, axis=0)
    with np.errstate(divide="ignore", invalid="ignore"):
        sizes = np.sqrt(size / acting)
    usable = np.where(np.isfinite(sizes) & (sizes > 0), sizes, np.inf).min(axis=0)
    return {name: float(size) for name, size in zip(f.fitted, usable, strict=True) if np.isfinite(size)}


@dataclass(frozen=True)
class Start:
    """Initial values of a fit, and how far the model follows the motion from there."""

    system: EquationSystem  # in stretches that the model follows
    values: dict[str, float]
    followed: float  # [s] duration of the longest stretch that it follows; 0: none
    whole: bool = False  # does it follow all runs to their end?


def longest_duration(system: EquationSystem) -> float:
    """Duration [s] of the longest stretch."""
    return max(float(s.time[-1] - s.time[0]) for s in system.stretches)


def misfits(system: EquationSystem, values: dict[str, float]) -> Array:
    """Rms of the residuals over that of the signal, of each channel (w,), over all stretches.

    The contribution of the noise is subtracted: before a motion starts, there is nothing but noise.
    """
    square, size = np.zeros(len(system.formulas.channels)), np.zeros(len(system.formulas.channels))
    for s, found in system.predictions(values):
        if found is None:
            return np.full_like(size, np.inf)
        noise = np.where(np.isfinite(s.data), s.sigma**2, 0.0).sum(axis=0)
        present = np.maximum(np.isfinite(s.data).sum(axis=0), 1)
        square += np.maximum(np.nansum((s.data - found.seen) ** 2, axis=0) - AGREES * noise, 0.0)
        size += np.nansum((s.data - np.nansum(s.data, axis=0) / present) ** 2, axis=0) + noise
    return np.asarray(np.sqrt(square / np.maximum(size, 1e-300)), float)


def levels(system: EquationSystem, share: float = SHORT) -> list[EquationSystem]:
    """Levels of multiple shooting: runs in stretches of a share of a period, joined two by two until they are whole.

    At most MOST_STATES initial states are fitted: of the stretches that start where longer ones do.
    """
    most, long = MOST_STATES / len(system.formulas.states), longest_stretches(system)
    spacing = min(float(np.median(np.diff(s.time))) for s in long)
    duration = max(share * shortest_period(system), FEWEST * spacing)
    levels: list[list[Samples]] = []
    while not levels or len(levels[-1]) > len(system.stretches):
        levels.append([part for s in system.stretches for part in cut(s, duration)])
        duration *= 2
    begun = {part.name for part in next(parts for parts in levels if len(parts) <= max(most, len(levels[-1])))}
    some = ([part for part in parts if part.name in begun] for parts in levels[:-1])
    return [*(replace(system, stretches=parts) for parts in some), system]


def fitted_start(system: EquationSystem, values: Values) -> Start:
    """Fit short stretches, and longer and longer ones, until these are whole or the model no longer follows them."""
    usual = levels(system)
    found = fit_over_levels(usual, values)
    if not found.followed:  # the slowest of several oscillations may be the strongest
        finest = levels(system, 0.0)
        if longest_duration(finest[0]) < longest_duration(usual[0]):
            found = fit_over_levels(finest, values)
    followed = longest_duration(found.system) if found.followed else 0.0
    if found.whole or followed > shortest_period(system):
        return found
    # over less than a period the initial states explain nearly any motion, and all of it where some are not observed
    at_once = trust_region(system, [with_weak_prior(q) for q in system.base], initial_guess(system)[0] | dict(values))
    # a median: one of several sensors may show little but the missing effect
    follows = np.median(misfits(system, at_once)) <= LOOSE
    return Start(system, at_once, longest_duration(system), True) if follows else found


def fit_over_levels(systems: Sequence[EquationSystem], values: Values) -> Start:
    """Fit each level from the one before, as far as the model follows the motion."""
    now = dict(values) | initial_guess(systems[0])[0]
    now |= fit(systems[0], [q for q in systems[0].base if q.is_initial], now, TRIAL).values
    reached: list[tuple[EquationSystem, dict[str, float]]] = []
    for part in systems:
        trial = now | fit(part, [with_weak_prior(q) for q in part.base], now, TRIAL).values
        if not np.median(misfits(part, trial)) <= LOST:
            break
        now = trial  # a longer stretch has the initial state of its first part
        reached.append((part, now))
    if not reached:
        return Start(systems[0], trial, 0.0)
    whole = len(reached) == len(systems)
    # near the longest stretch that is followed chi-square has many minima: half of that duration is safe
    chosen, values = reached[-1 if whole else max(len(reached) - 2, 0)]
    return Start(chosen, values, longest_duration(reached[-1][0]), whole)


def with_weak_prior(q: Quantity) -> Quantity:
    """The quantity with a weak prior about its declared value, which the data may not determine."""
    return q if q.declared is None else replace(q, prior_sigma=min(q.prior_sigma, max(abs(q.null), q.scale)))


def trust_region(system: System, quantities: Sequence[Quantity], declared: Mapping[str, float]) -> dict[str, float]:
    """Values of a trust-region fit.

    Gauss-Newton with halved steps may stop where a parameter that is far off (a gain of the wrong sign) has to pass
    through zero, where nothing moves.
    """
    names = [q.name for q in quantities]
    lower, upper = (np.array([getattr(q, side) for q in quantities]) for side in ("lower", "upper"))
    size = np.array([max(abs(q.null), q.scale) for q in quantities])
    start = np.clip([declared.get(name, q.null) for name, q in zip(names, quantities, strict=True)], lower, upper)

    def at(x: Array) -> dict[str, float]:
        return dict(declared) | dict(zip(names, x.tolist(), strict=True))

    def residual(x: Array) -> Array:
        return np.concatenate([system.linearise(at(x), [])[0].ravel(), prior_rows(quantities, at(x))[0]])

    def jacobian(x: Array) -> Array:
        derivative = system.linearise(at(x), names)[1].reshape(-1, len(names))
        return -np.nan_to_num(np.vstack([derivative, prior_rows(quantities, at(x))[1]]))

    if not all(np.isfinite(part).all() for part in system.linearise(at(start), names)):
        return dict(declared)
    return at(least_squares(residual, start, jacobian, (lower, upper), x_scale=size, max_nfev=_ATTEMPTS).x)
