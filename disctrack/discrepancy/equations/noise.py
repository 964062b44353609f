"""How large the noise of a channel is, from its data or from what a fit leaves; and noise that remembers."""

from collections.abc import Sequence
from dataclasses import replace
from math import comb

import numpy as np

from calibration.kit.arrays import Array, Mask
from disctrack.discrepancy.equations.declared import Samples
from disctrack.discrepancy.system import System, Values, Wrapped

_ORDERS = range(2, 7)  # of differences: the higher, the less of the motion is left in them
ENOUGH_DIFFERENCES = 8  # by which a channel's noise is told
FEWEST_DIFFERENCES = 3  # the same of few or uneven samples
UNEVEN = 3.0  # of the spacings: nine in ten are no longer than so many times the one in ten that is shortest
MAX_MEMORY = 24  # samples over which noise may remember


def with_noise(samples: Sequence[Samples]) -> list[Samples]:
    """Runs whose sigma is known: where none was given, from the fast part of the channel's data in all runs."""
    found = list(samples)
    for c in range(samples[0].data.shape[1]):
        open_ = [i for i, s in enumerate(found) if np.isnan(s.sigma[:, c]).any()]
        if not open_:
            continue
        values = [found[i].data[:, c] for i in open_]
        sigma = max(fast_part(values, [found[i].time for i in open_]), step_of(values) / np.sqrt(12.0))
        for i in open_:
            columns = found[i].sigma.copy()
            columns[:, c] = sigma
            found[i] = replace(found[i], sigma=columns)
    return found


def fast_part(values: Sequence[Array], times: Sequence[Array] | None = None) -> float:
    """Standard deviation of white noise on smooth signals, from differences in time.

    times : of the values; few or unevenly spaced ones are differenced as they lie in time
    """
    estimates, counts = [], []
    present = [np.isfinite(v) for v in values]
    if times is not None and _sparse(times, present):
        differences = [
            [_divided(t[p], v[p], order) for t, v, p in zip(times, values, present, strict=True)] for order in _ORDERS
        ]
        fewest = FEWEST_DIFFERENCES
    else:
        differences = [
            [np.diff(v, order) / np.sqrt(comb(2 * order, order)) for v in values if len(v) > order] for order in _ORDERS
        ]
        fewest = ENOUGH_DIFFERENCES
    for parts in differences:
        all_ = np.concatenate([p[np.isfinite(p)] for p in parts]) if parts else np.zeros(0)
        if len(all_) >= fewest:
            estimates.append(float(np.sqrt(np.mean(all_**2))))
            counts.append(len(all_))
    # the first order in which no more of the motion is left than its own scatter: higher ones scatter more
    best = next(
        (a for a, b, n in zip(estimates, estimates[1:], counts, strict=False) if a <= b * (1 + 2 / np.sqrt(n))),
        estimates[-1] if estimates else 0.0,
    )
    size = max((float(np.nanmax(np.abs(v))) for v in values if np.isfinite(v).any()), default=1.0)
    return max(best, 1e-9 * size, 1e-300)


def _sparse(times: Sequence[Array], present: Sequence[Mask]) -> bool:
    """Are there so few values, or so unevenly spaced ones, that differences from sample to sample mean little?"""
    spacings = [np.diff(t[p]) for t, p in zip(times, present, strict=True) if p.sum() > 1]
    uneven = any(np.quantile(d, 0.9) > UNEVEN * np.quantile(d, 0.1) for d in spacings)
    return uneven or sum(len(d) for d in spacings) < ENOUGH_DIFFERENCES + max(_ORDERS)


def _divided(time: Array, values: Array, order: int) -> Array:
    """Divided differences, as large as the noise of one value."""
    if len(time) <= order:
        return np.zeros(0)
    t, y = (np.lib.stride_tricks.sliding_window_view(x, order + 1) for x in (time, values))
    apart = (t[:, :, None] - t[:, None, :]) / (t[:, -1:, None] - t[:, :1, None]) + np.eye(order + 1)
    weight = 1.0 / np.prod(apart, axis=2)
    return np.asarray(np.sum(weight * y, axis=1) / np.linalg.norm(weight, axis=1), float)


def step_of(values: Sequence[Array]) -> float:
    """Step of an encoder or a converter, of which all values are multiples; 0 where there is none."""
    levels = np.unique(np.concatenate([v[np.isfinite(v)] for v in values]))
    if len(levels) < 3:
        return 0.0
    gaps = np.diff(levels)
    step = float(gaps.min())
    if step <= 1e-12 * float(np.abs(levels).max()):
        return 0.0
    turns = gaps / step
    whole = np.abs(turns - np.round(turns)) < 0.01 * np.maximum(1.0, turns * 0.01)
    many = sum(int(np.isfinite(v).sum()) for v in values)
    # a coarse converter shows each of its levels more than once
    return step if whole.all() and many > 1.2 * len(levels) else 0.0


def rounded(values: Sequence[Array]) -> bool:
    """True where the data stand on an encoder's or a converter's steps."""
    return step_of(values) > 0.0


class Remembering(Wrapped):
    """A system whose noise remembers: every sample minus what those before it foretell of its noise.

    coefficients : (w, order) of the autoregression of each channel's whitened residual; gaps begin anew.
    """

    def __init__(self, system: System, rows: Sequence[slice], coefficients: Array, present: Mask) -> None:
        """Rows of each stretch; present (n, w) where there are data."""
        super().__init__(system)
        self._rows, self._present = tuple(rows), present
        self._coefficients = coefficients

    def linearise(self, values: Values, names: Sequence[str]) -> tuple[Array, Array]:
        """As the system's, filtered in time along every stretch."""
        residual, derivative = super().linearise(values, names)
        both = np.concatenate([residual[..., None], derivative], axis=-1)
        out = both.copy()
        order = self._coefficients.shape[1]
        for rows in self._rows:
            part, new = both[rows], out[rows]
            for lag in range(1, min(order, len(part) - 1) + 1):
                new[lag:] -= self._coefficients[:, lag - 1, None] * part[:-lag]
            new *= self._present[rows][..., None]
        return out[..., 0], out[..., 1:]


def autoregression(residual: Array, present: Mask, rows: Sequence[slice]) -> tuple[Array, float]:
    """Coefficients (w, order) that make a residual (n, w) white, and its variance then over before.

    Yule and Walker's equations; the order is Schwarz's choice. Missing samples count as zeros.
    """
    w = residual.shape[1]
    n = int(present.sum(axis=0).max())
    top = int(min(MAX_MEMORY, max(1, n // 40)))
    found, ratio = np.zeros((w, top)), 0.0
    for c in range(w):
        covariance = np.zeros(top + 1)
        for part in rows:
            x = residual[part, c]
            for lag in range(min(top, len(x) - 1) + 1):
                covariance[lag] += x[lag:] @ x[: len(x) - lag]
        best, variance = np.inf, covariance[0]
        if variance <= 0:
            continue
        # Levinson and Durbin, order by order
        a: Array = np.zeros(0)
        for order in range(top + 1):
            if order > 0:
                k = (
                    (covariance[order] - a @ covariance[order - 1 : 0 : -1][: order - 1]) / variance
                    if order > 1
                    else (covariance[1] / variance)
                )
                a = np.concatenate([a - k * a[::-1], [k]])
                variance *= 1 - k * k
            criterion = n * np.log(max(variance / covariance[0], 1e-300)) + order * np.log(n)
            if criterion < best - 1e-9:
                best = criterion
                found[c] = 0.0
                found[c, :order] = a
                share = variance / covariance[0]
        ratio = max(ratio, share)
    return found, ratio


def persistence(residual: Array, rows: Sequence[slice]) -> float:
    """Samples until the autocorrelation of a residual (n, w) has fallen to 1/e, all channels and stretches together."""
    longest = max(r.stop - r.start for r in rows)
    power = np.zeros(longest)
    for r in rows:
        x = residual[r]
        spectrum = np.abs(np.fft.rfft(x, 2 * len(x), axis=0)) ** 2
        power[: len(x)] += np.fft.irfft(spectrum, axis=0).sum(axis=1)[: len(x)]
    below = np.flatnonzero(power < power[0] / np.e)
    return float(below[0]) if below.size else float(longest)
