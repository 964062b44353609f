"""Where a fit begins: states read off the data, then windows that grow as far as the model follows the motion.

Over many turns of an oscillation chi-square has many minima; over half a turn it has one. A fit that begins there and
is led to longer and longer windows stays in it, for as long as the model can follow at all.
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
from disctrack.discrepancy.equations.system import EquationSystem, first_part, spread
from disctrack.discrepancy.fit import TRIAL, fit
from disctrack.discrepancy.search import AGREES
from disctrack.discrepancy.system import Quantity, System

GROWTH = 1.7  # of the window from fit to fit: a phase that is right over it is right to a radian over the next
LOST = 0.3  # rms of the residual over that of the signal, from which on the model no longer follows the motion
LOOSE = 0.6  # the same where growing windows follow for less than a turn: most of the motion is still that of the model
_LEASH = 0.3  # relative change of a parameter from window to window, of which none is surprised
_FAR = 1.0  # relative change of a parameter from its declared value, which is said to be right to some 30 %
_WINDOWS = (8, 12, 18, 27, 40, 60, 90, 135, 200)  # samples of the local polynomial
_ATTEMPTS = 100  # steps of a fit to all data at once
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
    value_size = np.array([np.nanstd(s.data[:, c]) or 1.0 for c in range(w)])
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
        begin = np.asarray(least_squares(misfit, begin, max_nfev=60, x_scale=scale, args=(slopes,)).x, float)
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

    values: dict[str, float]
    followed: float  # [s] from the start of a stretch
    duration: float  # [s] of the longest stretch

    @property
    def whole(self) -> bool:
        """True where the model follows all stretches to their end."""
        return self.followed >= self.duration * (1 - 1e-9)


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
        square += np.maximum(np.nansum((s.data - found.seen) ** 2, axis=0) - AGREES * noise, 0.0)
        size += np.nansum((s.data - np.nanmean(s.data, axis=0)) ** 2, axis=0) + noise
    return np.asarray(np.sqrt(square / np.maximum(size, 1e-300)), float)


def led(system: EquationSystem, values: dict[str, float]) -> Start:
    """Fit over windows that grow from half a turn to the whole, or until the model loses the motion."""
    duration = max(float(s.time[-1] - s.time[0]) for s in system.stretches)
    window = max(0.5 * min(turn(s) for s in system.stretches), duration / 4000)
    found = _led(system, values, window, duration)
    shortest = 12 * max(float(np.median(np.diff(s.time))) for s in system.stretches)
    while found.followed == 0.0 and window > shortest:
        # what turns and drifts, or is chaotic, has no half turn: begin with less
        window = max(0.25 * window, shortest)
        found = _led(system, values, window, duration)
    return _not_astray(system, values, found)


def _not_astray(system: EquationSystem, declared: dict[str, float], found: Start) -> Start:
    """What growing windows lead to, or what all data at once do where that describes them better.

    The first part of a motion may not tell parameters apart that the whole does (a motor that runs up), and a model
    that lacks something then takes them far away.
    """
    parameters = [q for q in system.base if not q.is_initial]
    shift = [abs(found.values.get(q.name, q.null) - q.null) / max(abs(q.null), q.scale) for q in parameters]
    if found.whole and max(shift, default=0.0) < _FAR:
        return found
    enough = LOST if found.followed >= min(turn(s) for s in system.stretches) else LOOSE
    led_to = misfit(system, found.values)
    if not found.whole and max(shift, default=0.0) >= _FAR:  # what led so far off and then lost the motion is no start
        found = replace(found, values=found.values | {q.name: declared.get(q.name, q.null) for q in parameters})
    tied = [near_declared(q) for q in system.base]
    attempts = [lambda: fit(system, tied, declared, max_iterations=30).values]
    if not system.promoted:  # for one term after the other it would take too long
        attempts.append(lambda: at_once(system, declared))
    for attempt in attempts:
        values = declared | attempt()
        left = misfits(system, values)
        # of several sensors one may show little but what is missing: most of the motion is followed all the same
        mostly = found.followed == 0.0 and len(left) > 2 and np.median(left) < LOST
        if mostly or np.max(left) < min(led_to, enough):
            return Start(values, found.duration, found.duration)
    return found


def near_declared(q: Quantity) -> Quantity:
    """Of a parameter that the data may not tell, one that stays near; of a term's number zero is the absence."""
    return q if q.declared is None else replace(q, prior_sigma=min(q.prior_sigma, max(abs(q.null), q.scale)))


def at_once(system: EquationSystem, declared: Mapping[str, float]) -> dict[str, float]:
    """All quantities fitted to all data (`trusted`). Of many runs some tell what all share, and the others follow."""
    some = replace(system, stretches=spread(system.stretches, len(system.formulas.states)))
    values = trusted(some, some.base, declared)
    if len(some.stretches) < len(system.stretches):
        values |= fit(system, [q for q in system.base if q.slot], values, max_iterations=TRIAL).values
    return values


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
    latest: dict[bytes, tuple[Array, Array]] = {}

    def both(x: Array) -> tuple[Array, Array]:
        if x.tobytes() not in latest:
            values = dict(declared) | dict(zip(names, x.tolist(), strict=True))
            residual, derivative = system.linearise(values, names)
            right, matrix = prior_rows(quantities, values)
            latest.clear()
            latest[x.tobytes()] = (
                np.concatenate([residual.ravel(), right]),
                np.vstack([derivative.reshape(residual.size, -1), matrix]),
            )
        return latest[x.tobytes()]

    if not all(np.isfinite(part).all() for part in both(start)):
        return dict(declared)
    found = least_squares(
        lambda x: np.nan_to_num(both(x)[0], nan=_NOWHERE, posinf=_NOWHERE, neginf=-_NOWHERE), start,
        lambda x: -np.nan_to_num(both(x)[1]), bounds=(lower, upper), x_scale=size, max_nfev=_ATTEMPTS,
    )  # fmt: skip
    return dict(declared) | dict(zip(names, found.x.tolist(), strict=True))


def _led(system: EquationSystem, values: dict[str, float], window: float, duration: float) -> Start:
    values, followed, last = dict(values), 0.0, False
    states = [q for q in system.base if q.is_initial]
    while not last:
        last = window >= duration
        part = replace(system, stretches=first_part(system.stretches, duration if last else window))
        if followed == 0.0:
            values |= fit(part, states, values, max_iterations=TRIAL).values
        tied = [q if q.is_initial else _near_last(q, values) for q in system.base]
        trial = values | fit(part, tied, values, max_iterations=TRIAL).values
        lost = misfit(part, trial)
        if lost > LOST and followed > 0.0:
            break
        values = trial
        if lost <= LOST:
            followed = min(window, duration)
        window *= GROWTH
    return Start(values, followed, duration)


def _near_last(q: Quantity, values: dict[str, float]) -> Quantity:
    """The quantity with a prior about where the last window left it: one that a short window does not tell stays."""
    value = values.get(q.name, q.null)
    return replace(q, null=value, prior_sigma=min(q.prior_sigma, _LEASH * max(abs(q.null), q.scale, abs(value))))
