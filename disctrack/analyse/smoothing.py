"""Value, first and second derivative of a sampled curve by Gaussian-process regression in moving windows.

The curve is a stationary Gaussian process with covariance A^2 exp(-tau^2 / 2 l^2) on top of an unknown straight line
(Rasmussen & Williams 2006, sections 2.2, 2.7, 9.4). Its spectrum falls so steeply that the estimator is a low-pass
filter with a sharp cut-off: at the signal-to-noise ratios of a tracked disc (1e3 to 1e4) the predicted variance is
that of the transmitted noise, and the bias is far below it. Length l and amplitude A vary with time: they are estimated
by restricted maximum likelihood in overlapping segments. The scale of the noise is common to all segments.

On simulated motion this is more accurate than local polynomials, which have one window for slow and fast motion, and
than a state-space smoother with an integrated Wiener process, whose spectrum falls too slowly.
"""

from collections.abc import Sequence
from functools import lru_cache

import numpy as np

from calibration.kit.types import Array, Indices

LENGTHS = 2.0 * 1.15 ** np.arange(20)  # l in frame intervals: 2 (content up to the Nyquist rate) to 28
RATIOS = 10.0 ** np.arange(0.0, 10.1, 0.5)  # (A / sigma)^2
SEGMENT = 96  # frames in which l and A are constant; with 48 or 64 the variance is too small by a factor 2
MAX_SLOPE = 0.25  # of l over time
HALF_WINDOW_LENGTHS = 3.0  # half width of a window in l; 4 reduces the scatter by 3 % at twice the time
MIN_WINDOW_SAMPLES = 4  # a line, a curvature, and one degree of freedom
NOISE_SCALES = 2.0 ** np.arange(-3.0, 3.01, 0.05)  # estimated over stated variance


def kernel(lag: Array, length: float) -> Array:
    """Covariance exp(-lag^2 / 2 l^2) of the process with unit amplitude."""
    return np.exp(-0.5 * (lag / length) ** 2)


def fit_process(segments: Sequence[tuple[Array, Array, Array]], centres: Array, n: int) -> tuple[Array, Array, float]:
    """For a group of channels: length (n,) in intervals, A^2 (n,), and the estimated over the stated variance.

    segments : per segment: sample times (m,) in intervals, data (c, m), stated variances (c, m); m may differ
    centres : (n_segments,) sample index at the centre of each segment
    n : number of samples of the result; between two centres the logarithms are interpolated
    """
    best, where = np.empty((2, len(segments), len(NOISE_SCALES)))
    for i, (t, data, variance) in enumerate(segments):  # 0.4 MB each: only the maxima are kept
        likelihood = _segment_likelihood(_modes(_on_grid(t).tobytes()), data, variance).reshape(len(NOISE_SCALES), -1)
        best[i], where[i] = likelihood.max(axis=1), likelihood.argmax(axis=1)
    scale_index = int(np.argmax(best.sum(axis=0)))
    length_index, ratio_index = np.divmod(where[:, scale_index].astype(int), len(RATIOS))
    variance = np.array([np.mean(v) for _, _, v in segments]) * NOISE_SCALES[scale_index]
    amplitude2 = RATIOS[ratio_index] * variance
    sample = np.arange(n)
    between = np.interp(sample, centres, length_index.astype(float))
    length = np.exp(np.interp(between, np.arange(len(LENGTHS)), np.log(LENGTHS)))
    # The motion of a disc is a sum of near-sinusoids, smoother than samples of the process: the likelihood prefers an l
    # slightly too long. With the next shorter one, the predicted variance of accelerations agrees with their errors.
    allowed = np.searchsorted(LENGTHS, np.sqrt(1.15) * _sloped(length), side="right") - 1  # nearest of the grid
    amplitude2 = np.exp(np.interp(sample, centres, np.log(amplitude2)))
    return LENGTHS[np.maximum(allowed - 1, 0)], amplitude2, float(NOISE_SCALES[scale_index])


def _sloped(length: Array) -> Array:
    """Lengths (n,) limited to a slope of MAX_SLOPE: a long window must not reach into motion that needs a short one."""
    ramp = MAX_SLOPE * np.arange(len(length))
    ahead = np.minimum.accumulate(length - ramp) + ramp
    behind = np.minimum.accumulate((length + ramp)[::-1])[::-1] - ramp
    return np.minimum(ahead, behind)


def _on_grid(lag: Array) -> Array:
    """Times of a uniform recording as integers without round-off, so that equal windows compare equal."""
    whole = np.round(lag)
    return np.where(np.abs(lag - whole) < 1e-6, whole, lag)


@lru_cache(maxsize=64)
def _modes(times_as_bytes: bytes) -> list[tuple[Array, Array]]:
    """Per length, eigenvalues (m - 2,) and vectors (m, m - 2) of the kernel in the complement of straight lines."""
    times = np.frombuffer(times_as_bytes)
    basis = np.stack([np.ones_like(times), times - times.mean()], axis=1)
    complement = np.linalg.qr(basis, mode="complete")[0][:, 2:]
    lag = times[:, None] - times
    result = []
    for length in LENGTHS:
        values, vectors = np.linalg.eigh(complement.T @ kernel(lag, float(length)) @ complement)
        result.append((np.maximum(values, 0.0), complement @ vectors))
    return result


def _segment_likelihood(modes: list[tuple[Array, Array]], data: Array, variance: Array) -> Array:
    """Restricted log-likelihood (scales, lengths, ratios), summed over the channels.

    In eigenvectors of the kernel, A and the noise scale need one division each.
    """
    sigma2 = variance.mean(axis=1)
    total = np.zeros((len(NOISE_SCALES), len(LENGTHS), len(RATIOS)))
    for i, (values, vectors) in enumerate(modes):
        dof = len(values)
        c2 = (data @ vectors) ** 2 / sigma2[:, None]  # (channels, dof)
        spectrum = RATIOS[:, None] * values + 1.0  # (ratios, dof)
        misfit = (c2[:, None, :] / spectrum).sum(axis=(0, 2))
        log_determinant = len(data) * np.log(spectrum).sum(axis=1)
        total[:, i] = -0.5 * (
            misfit / NOISE_SCALES[:, None] + log_determinant + dof * len(data) * np.log(NOISE_SCALES[:, None])
        )
    return total


def window_weights(lag: Array, noise_ratio: Array, length: float) -> tuple[Array, Array]:
    """Weights that turn the samples of a window into value, first and second derivative at lag 0.

    lag : (u, w) times of the samples relative to the point, in intervals
    noise_ratio : (u, w) noise variance over A^2; infinite where there is no sample
    returns : weights (u, 3, w) per interval^order; prior (u, 3, 3), the covariance in units of A^2 that
        remains without noise: in gaps and at the ends the samples do not determine the curve
    """
    seen = np.isfinite(noise_ratio)
    mask = seen.astype(float)
    k, l2, a = kernel(lag, length), length**2, 1 / length**2
    # covariance of value, slope and curvature at lag 0 with the values at `lag` (u, 3, w), and among each other (3, 3)
    cross = np.stack([k, lag / l2 * k, (lag**2 / l2 - 1) / l2 * k], axis=1) * mask[:, None, :]
    own = np.array([[1.0, 0.0, -a], [0.0, a, 0.0], [-a, 0.0, 3 * a * a]])
    distinct = lag[:1] if (lag == lag[0]).all() else lag  # with uniform frames all windows are equal
    K = kernel(distinct[:, :, None] - distinct[:, None, :], length) * mask[:, :, None] * mask[:, None, :]
    diagonal = np.arange(lag.shape[1])
    sigma = K.copy()
    sigma[:, diagonal, diagonal] += np.where(seen, noise_ratio, 1.0)
    basis = np.stack([np.ones_like(lag), lag / length], axis=1) * mask[:, None, :]  # (u, 2, w)
    solved = np.linalg.solve(sigma, np.concatenate([cross, basis], axis=1).swapaxes(1, 2)).swapaxes(1, 2)
    from_process, from_basis = solved[:, :3], solved[:, 3:]
    gram = from_basis @ basis.swapaxes(1, 2)
    target = np.zeros((3, 2))  # value and slope of (1, lag / l) at the point, and no curvature
    target[0, 0], target[1, 1] = 1.0, 1.0 / length
    missing = target - from_process @ basis.swapaxes(1, 2)
    weights = from_process + missing @ np.linalg.solve(gram, from_basis)
    mixed = weights @ cross.swapaxes(1, 2)
    prior = weights @ K @ weights.swapaxes(1, 2) - mixed - mixed.swapaxes(1, 2) + own
    return weights, prior


def moving_weights(
    times: Array, variance: Array, length: Array, amplitude2: Array, half_window: int, points: Indices
) -> tuple[Array, Array]:
    """Weights (k, 3, 2 half_window + 1) and remaining prior covariance (k, 3, 3) for some samples.

    times : (n,) in sample intervals; variance : (n,) of the noise, infinite where there is no sample
    length, amplitude2 : (n,) as of `fit_process`
    points : (k,) indices of these samples
    Derivatives are per interval. The ends are windows whose outer samples are missing. Windows with the same length,
    ratio and pattern of noise share one solution; for this, noise is classified in factors of two (weights may be
    slightly off the optimum, their covariance is exact). A window with fewer than MIN_WINDOW_SAMPLES samples has
    no weight and an infinite prior covariance.
    """
    n, w = len(times), half_window
    index = points[:, None] + np.arange(-w, w + 1)
    inside = (index >= 0) & (index < n)
    clipped = np.clip(index, 0, n - 1)
    lag = _on_grid(np.where(inside, times[clipped] - times[points, None], np.arange(-w, w + 1, dtype=float)))
    typical = float(np.median(variance[np.isfinite(variance)]))
    with np.errstate(divide="ignore"):
        noise_class = np.round(np.log2(variance / typical))
    patterns = np.where(inside, noise_class[clipped], np.inf)
    ratio = np.round(2 * np.log10(amplitude2[points] / typical)) / 2
    weights, prior = np.zeros((len(points), 3, 2 * w + 1)), np.full((len(points), 3, 3), np.inf)
    lengths = length[points]
    for of_rows in np.unique(lengths):
        reach = min(w, int(np.ceil(HALF_WINDOW_LENGTHS * of_rows)))
        columns = slice(w - reach, w + reach + 1)
        enough = np.isfinite(patterns[:, columns]).sum(axis=1) >= MIN_WINDOW_SAMPLES
        rows = np.flatnonzero((lengths == of_rows) & enough)
        if rows.size == 0:
            continue
        keys = np.concatenate([ratio[rows, None], patterns[rows, columns], lag[rows, columns]], axis=1)
        unique, inverse = np.unique(keys, axis=0, return_inverse=True)
        patterns_of, lags = np.split(unique[:, 1:], 2, axis=1)
        W, P = window_weights(lags, 2.0**patterns_of / 10.0 ** unique[:, :1], float(of_rows))
        weights[rows, :, columns], prior[rows] = W[inverse.ravel()], P[inverse.ravel()]
    return weights, prior * amplitude2[points, None, None]
