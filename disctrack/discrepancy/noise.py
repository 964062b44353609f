"""Noise model: variance, common errors of a row, and autocorrelation.

Variance: from differences in time, which pass white noise and suppress the slow residuals of a missing effect. Common
errors: shaken cameras, jitter of clocks and exchanged frames look like changes of the pose, from which effects are
inferred; directions in which rows scatter more than independent noise are weighted by their variance. Autocorrelation:
the variance of an estimate is the long-run variance of its influence function (Newey and West 1987, with the bandwidth
of Andrews 1991 for Bartlett's weights); or the data are whitened, by an autoregression or by a smooth covariance.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray
from scipy.linalg import null_space, solve_toeplitz, solve_triangular
from scipy.optimize import minimize
from scipy.signal import lfilter
from scipy.stats import norm

from calibration.kit.types import Array, Indices, Mask
from disctrack.discrepancy.elimination import Own, is_linear, projection
from disctrack.discrepancy.fit import Fit
from disctrack.discrepancy.significance import SURE
from disctrack.discrepancy.system import System, Transformed

if TYPE_CHECKING:
    from disctrack.discrepancy.equations.declared import Samples

MARGIN = 1.5  # over the largest eigenvalue of independent noise (Marchenko and Pastur's edge)
OUTLIER = 8.0  # standard deviations
THIRD = 2.31  # samples per independent one among third differences: 1 + 2 (15^2 + 6^2 + 1) / 20^2


def third_differences(system: System, numbers: Array) -> tuple[Array, Indices]:
    """Third differences in time of (n, w) wherever four samples are consecutive, (k, w), and their rows (k,).

    They pass white noise (variance 20) and suppress what changes slowly from sample to sample.
    """
    present = system.weights > 0
    rows = np.flatnonzero(present[3:] & present[2:-1] & present[1:-2] & present[:-3])
    return np.diff(numbers, 3, axis=0)[rows], rows


def noise_variance(system: System, fit_: Fit) -> float:
    """Variance of the noise over that stated, from third differences of the residuals; 1 for too few samples."""
    difference, rows = third_differences(system, system.linearise(fit_.values, [])[0])
    if len(rows) < 20:
        return 1.0
    return float(np.sum(difference**2) / 20.0 / np.sum(system.weights[rows]))


def common_modes(system: System, fit: Fit) -> tuple[Array, Array] | None:
    """Directions (n, w, b) of common errors in each row, and their variances (b,); None where there are none.

    Principal axes of the possible directions; no variance is smaller than that of independent noise.
    """
    residual, _ = system.linearise(fit.values, [])
    single, rows = third_differences(system, residual)
    full = system.weights[rows] >= residual.shape[1]  # missing numbers are zeros, not noise
    k, width = single[full].shape
    if width < 2 or k < 4 * width:
        return None
    along = system.together(fit.values, width)
    inside, _ = third_differences(system, (np.swapaxes(along, 1, 2) @ residual[..., None])[..., 0])
    single, inside, b = single[full], inside[full], along.shape[-1]
    variances, vectors = np.linalg.eigh(inside.T @ inside / (20.0 * k))
    others = (np.sum(single**2) - np.sum(inside**2)) / (20.0 * k * (width - b)) if b < width else np.median(variances)
    if not variances[-1] > MARGIN * (1.0 + np.sqrt(b * THIRD / k)) ** 2 * others:
        return None
    return along @ vectors, np.maximum(variances / others, 1.0)


def whitened(system: System, fit: Fit) -> System | None:
    """The system whitened in the directions of its common errors; None if it has none."""
    if (modes := common_modes(system, fit)) is None:
        return None
    vectors, variances = modes
    less = (vectors * (1.0 - 1.0 / np.sqrt(variances))) @ np.swapaxes(vectors, 1, 2)
    return Transformed(system, lambda both: both - less @ both)


SHORTEST = 40  # samples, below which autocorrelation is not estimated


def inflation(system: System, fit: Fit) -> Array:
    """(k,) inflation of the standard deviation of each fitted quantity by autocorrelation; 1 where none is significant.

    Linear quantities with priors keep theirs; that of a block's own quantity follows from the block's residuals.
    """
    factors = np.ones(len(fit.quantities))
    moved = [i for i, q in enumerate(fit.quantities) if not (is_linear(q) or q.slot)]
    here = [fit.shared.index(fit.names[i]) for i in moved]
    covariance = fit.covariance[np.ix_(here, here)]
    rows = np.flatnonzero(system.weights > 0)
    if len(rows) < SHORTEST or not moved or not covariance.any():
        return factors
    own = Own(system, fit.quantities)
    residual, derivative = system.linearise(fit.values, [*own.slots, *(fit.names[i] for i in moved)])
    power = float(np.sum(residual[rows] ** 2) / max(np.sum(system.weights[rows]), 1.0))
    shares = autocorrelation(residual[rows])
    place = {q.name: i for i, q in enumerate(fit.quantities)}
    for block, head in zip(own.blocks, fit.heads, strict=bool(fit.heads)):
        mine = block.rows[system.weights[block.rows] > 0]
        if len(mine) >= SHORTEST:
            by_own = derivative[mine][..., block.columns] @ head.root @ head.root.T
            factors[[place[q.name] for q in block.quantities]] = _inflation(residual[mine], by_own, power, shares)
    derivative = own.cleared(derivative, fit.heads) if fit.heads else derivative
    common = projection(system, fit.quantities, fit.values)
    cleared = common.cleared(derivative.reshape(residual.size, -1))[: residual.size].reshape(derivative.shape)
    factors[moved] = _inflation(residual[rows], cleared[rows] @ covariance, power, shares)
    return factors


def _inflation(residual: Array, by_number: Array, power: float, shares: Sequence[float]) -> Array:
    """(k,) inflation of estimates with influence `by_number` (n, w, k) of the residuals (n, w) of variance `power`."""
    influence = np.einsum("nw,nwk->nk", residual, by_number)
    alone = np.einsum("nwk,nwk->k", by_number, by_number)
    in_common, factors = alone.copy(), np.ones(len(alone))
    for lag, share in enumerate(shares[: len(residual) - 1], start=1):
        in_common += 2 * share * np.einsum("nwk,nwk->k", by_number[lag:], by_number[:-lag])
    for i, (x, one, together) in enumerate(zip(influence.T, alone, in_common, strict=True)):
        if power * one > 0:
            variance, spread = long_run_variance(x)
            ratio = variance * len(x) / (power * one)
            factors[i] = np.sqrt(max(ratio if ratio > 1.0 + SURE * spread else 1.0, together / one))
    return factors


def autocorrelation(residual: Array) -> list[float]:
    """Of the columns of (n, w), averaged, at lags 1, 2, ... up to the first one that is not significant.

    The average of all columns is far more precise than the one series of a quantity's influence. A sensor's pattern of
    gains and offsets is such a correlation: images of a dot within two pixels have nearly the same error.
    """
    found: list[float] = []
    power = float(np.sum(residual**2)) / max(int(np.count_nonzero(residual)), 1)
    for lag in range(1, len(residual) // 4):
        products = residual[lag:] * residual[:-lag]  # zero for missing data
        count = max(int(np.count_nonzero(products)), 1)
        share = float(np.sum(products)) / count / power if power > 0 else 0.0
        if share < SURE / np.sqrt(count):
            break
        found.append(share)
    return found


def long_run_variance(x: Array) -> tuple[float, float]:
    """Variance of a sum of autocorrelated x (n,) over n; and the relative standard deviation of that estimate."""
    n = len(x)
    power = float(x @ x)
    if power == 0:
        return 0.0, 0.0
    rho = float(np.clip((x[1:] @ x[:-1]) / power, -0.97, 0.97))
    alpha = 4 * rho**2 / ((1 - rho) ** 2 * (1 + rho) ** 2)
    width = int(np.clip(np.ceil(1.1447 * (alpha * n) ** (1 / 3)), 1, n // 4))
    total = power + sum(2 * (1 - lag / width) * float(x[lag:] @ x[:-lag]) for lag in range(1, width))
    return total / n, float(np.sqrt(4 * width / (3 * n)))


def with_autocorrelation(system: System, fit: Fit) -> Fit:
    """The fit with standard deviations scaled by size and autocorrelation of the residuals; correlations stay."""
    factors = inflation(system, fit) * np.sqrt(max(1.0, fit.reduced_chi_square))
    shared = factors[[not q.slot for q in fit.quantities]]
    size = dict(zip(fit.names, factors, strict=True))
    own = {name: (size[name] * root, by_shared) for name, (root, by_shared) in fit.own.items()}
    return replace(fit, covariance=fit.covariance * np.outer(shared, shared), own=own)


@dataclass(frozen=True)
class SmoothNoise:
    """Covariance white^2 delta + smooth^2 exp(-(t - t')^2 / (2 memory^2))."""

    white: float
    smooth: float
    memory: float  # in the units of time

    def covariance(self, time: Array) -> Array:
        """(n, n) of one stretch of samples; different stretches are independent."""
        apart = (time[:, None] - time[None, :]) / self.memory
        # a share of 1e-9 keeps the Cholesky factor regular where the white part is very small
        floor = (self.white**2 + 1e-9 * self.smooth**2) * np.eye(len(time))
        return np.asarray(self.smooth**2 * np.exp(-0.5 * apart**2) + floor, float)

    def whitening(self, time: Array) -> Array:
        """W (n, n), lower triangular, with W covariance W^T = 1: the normalised innovations of the samples."""
        root = np.linalg.cholesky(self.covariance(time))
        return np.asarray(solve_triangular(root, np.eye(len(time)), lower=True), float)


@dataclass(frozen=True)
class SampleStretch:
    """Samples with correlated errors, and a basis of what a model may absorb of them."""

    time: Array  # (n,)
    values: Array  # (n, c) channels with the same statistics
    basis: Array  # (n, k)
    part: NDArray[np.int64] | None = None  # (n,) samples of different parts have independent errors


def estimate(stretches: Sequence[SampleStretch], start: SmoothNoise) -> SmoothNoise:
    """Restricted maximum likelihood: of all stretches, orthogonalised to their bases.

    The correlation time is at most a fifth of the longest stretch: slower errors look like the motion itself.
    """
    cleared = [null_space(s.basis.T).T for s in stretches]  # rows orthogonal to the basis
    longest = 0.2 * max(float(np.ptp(s.time)) for s in stretches)
    bounds = [(np.log(1e-3 * x), np.log(1e3 * x)) for x in (start.white, start.smooth)]
    bounds.append((np.log(0.01 * longest), np.log(longest)))

    def cost(x: Array) -> float:
        noise = SmoothNoise(*np.exp(x).tolist())
        return -sum(_log_likelihood(s, Q, noise) for s, Q in zip(stretches, cleared, strict=True))

    x = np.log([start.white, start.smooth, min(start.memory, 0.9 * longest)])
    options = {"xatol": 0.02, "fatol": 0.1, "maxiter": 160}
    found = minimize(cost, x, method="Nelder-Mead", bounds=bounds, options=options)
    return SmoothNoise(*np.exp(found.x).tolist())


def _log_likelihood(s: SampleStretch, Q: Array, noise: SmoothNoise) -> float:
    K = noise.covariance(s.time)
    if s.part is not None:
        K = np.where(s.part[:, None] == s.part[None, :], K, 0.0)
    root = np.linalg.cholesky(Q @ K @ Q.T)
    white = solve_triangular(root, Q @ s.values, lower=True)
    return -0.5 * float(np.sum(white**2)) - s.values.shape[1] * float(np.sum(np.log(np.diag(root))))


def outlier_limit(sizes: Array) -> float:
    """Size above which a residual is an outlier, by the median of all sizes, which has none; NaN without sizes."""
    return OUTLIER * float(np.nanmedian(sizes) / norm.ppf(0.75)) if np.isfinite(sizes).any() else np.nan


_ORDERS = range(2, 7)  # of differences: higher ones suppress more of the motion
MAX_MEMORY = 24  # largest order of an autoregression


def with_noise(samples: "Sequence[Samples]") -> "list[Samples]":
    """Runs with sigmas: where none is given, estimated from differences of the channel's data in all runs."""
    estimated = np.full(samples[0].data.shape[1], np.nan)
    for c in range(len(estimated)):
        open_ = [s for s in samples if np.isnan(s.sigma[:, c]).any()]
        values = [s.data[:, c] for s in open_]
        if open_:
            estimated[c] = max(noise_sigma(values, [s.time for s in open_]), quantisation(values) / np.sqrt(12.0))
    return [replace(s, sigma=np.where(np.isnan(s.sigma), estimated, s.sigma)) for s in samples]


def noise_sigma(values: Sequence[Array], times: Sequence[Array] | None = None) -> float:
    """Standard deviation of white noise on smooth signals, from divided differences in time.

    times : of the values, if these are not evenly spaced
    """
    times = times or [np.arange(len(v), dtype=float) for v in values]
    seen = [(t[p], v[p]) for t, v in zip(times, values, strict=True) for p in [np.isfinite(v)]]
    of_order = (np.concatenate([_divided(t, v, order) for t, v in seen]) for order in _ORDERS)
    differences = [d for d in of_order if len(d)]
    estimates = [float(np.sqrt(np.mean(d**2))) for d in differences]
    # the lowest order that is not larger than the next one by more than its scatter: higher orders scatter more
    triples = zip(estimates, estimates[1:], differences, strict=False)
    near = (a for a, b, d in triples if a <= b * (1 + 2 / np.sqrt(len(d))))
    best = next(near, estimates[-1] if estimates else 0.0)
    size = max((float(np.max(np.abs(v))) for _, v in seen if len(v)), default=1.0)
    return max(best, 1e-9 * size, 1e-300)


def _divided(time: Array, values: Array, order: int) -> Array:
    """Divided differences, normalised to the noise of one value."""
    if len(time) <= order:
        return np.zeros(0)
    t, y = (np.lib.stride_tricks.sliding_window_view(x, order + 1) for x in (time, values))
    apart = (t[:, :, None] - t[:, None, :]) / (t[:, -1:, None] - t[:, :1, None]) + np.eye(order + 1)
    weight = 1.0 / np.prod(apart, axis=2)
    return np.asarray(np.sum(weight * y, axis=1) / np.linalg.norm(weight, axis=1), float)


def quantisation(values: Sequence[Array]) -> float:
    """Resolution of an encoder or a converter, of which all values are multiples; 0 where there is none."""
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


def prewhitened(system: System, rows: Sequence[slice], coefficients: Array, present: Mask) -> System:
    """The system prewhitened: of every sample, the prediction from the samples before it is subtracted.

    rows : of each stretch
    coefficients : (w, order) of the autoregression of each channel's residuals
    present : (n, w) True where there are data
    """

    def innovations(both: Array) -> Array:
        out = both.copy()
        for part in rows:
            for c, own in enumerate(coefficients):
                out[part, c] = lfilter([1.0, *-own], [1.0], both[part, c], axis=0) * present[part, c, None]
        return out

    return Transformed(system, innovations)


def autoregression(residual: Array, present: Mask, rows: Sequence[slice]) -> tuple[Array, float]:
    """Coefficients (w, order) of an autoregression of residuals (n, w), and its innovation variance over theirs.

    Yule-Walker equations; the order by BIC. Missing samples count as zeros.
    """
    n = int(present.sum(axis=0).max())
    top = int(min(MAX_MEMORY, max(1, n // 40)))
    found, ratio = np.zeros((residual.shape[1], top)), 0.0
    for c, x in enumerate(residual.T):
        lags = [sum(float(x[r][lag:] @ x[r][: max(len(x[r]) - lag, 0)]) for r in rows) for lag in range(top + 1)]
        if not lags[0] > 0:
            continue
        covariance, best, share = np.array(lags), 0.0, 1.0
        for order in range(1, top + 1):
            a = solve_toeplitz(covariance[:order], covariance[1 : order + 1])
            left = max(1.0 - float(a @ covariance[1 : order + 1]) / covariance[0], 1e-300)
            criterion = n * np.log(left) + order * np.log(n)
            if criterion < best - 1e-9:
                best, share = criterion, left
                found[c, :order] = a
        ratio = max(ratio, share)
    return found, ratio


def correlation_lag(residual: Array, rows: Sequence[slice]) -> float:
    """Lag (samples) at which the autocorrelation of residuals (n, w), over all channels and stretches, falls to 1/e."""
    longest = max(r.stop - r.start for r in rows)
    spectra = [np.abs(np.fft.rfft(residual[r], 2 * longest, axis=0)) ** 2 for r in rows]
    power = np.fft.irfft(np.sum(spectra, axis=0), axis=0).sum(axis=1)[:longest]
    below = np.flatnonzero(power < power[0] / np.e)
    return float(below[0]) if below.size else float(longest)
