"""Runs on one clock: by the instant t_f of collapse where it was fitted, otherwise by the motion itself.

Each camera was started by hand, so time zero means nothing across runs. A run without t_f is shifted to where its
theta(t), psidot(t) and E(t) are likeliest under the mean of the other runs. The misfit that the best shift leaves is
mostly no noise (nutation in another phase, another loss), and neighbouring frames share it: the shift's sigma comes
from the scatter of whole stretches, not from the number of frames.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from scipy.interpolate import CubicSpline

from calibration.kit.arrays import Array, Mask
from disctrack.repeats.runs import INDEX, NUTATION_PER_PRECESSION, AnalysedRun

MATCHED = tuple(INDEX[name] for name in ("theta", "psidot", "energy"))
MIN_OVERLAP = 0.5  # of the shorter run: less could be matched by chance
COARSE_LAGS = 2000
GAP = 5.0  # frame intervals without an answer that are not interpolated across
ROUNDS = 4  # of shifting each run against the mean of the others
MOST_STEP = 20.0  # frame intervals per iteration: a nutation is longer
STRETCHES = (8, 30)  # least and most, for the sigma of a shift


@dataclass(frozen=True)
class Alignment:
    """Instant of each run's own clock that is time zero of the common one."""

    shift: Array  # (n_runs,) [s]
    sigma: Array  # (n_runs,) [s]
    method: tuple[str, ...]  # (n_runs,) "t_f" or "motion"

    @property
    def zero(self) -> str:
        """What time zero of the common clock is."""
        return "the collapse t_f" if "t_f" in self.method else "the mean of the recordings' own zeros"


class Curves:
    """The quantities of one run as functions of its own time."""

    def __init__(self, run: AnalysedRun) -> None:
        good = run.known()
        self.start, self.end = float(run.time[good][0]), float(run.time[good][-1])
        self.interval = float(np.median(np.diff(run.time)))
        self._time, self._sigma = run.time[good], run.sigma[good]
        self._spline = CubicSpline(self._time, run.value[good])

    def _outside(self, time: Array) -> Mask:
        after = np.clip(np.searchsorted(self._time, time), 1, len(self._time) - 1)
        hole = self._time[after] - self._time[after - 1] > GAP * self.interval
        return np.asarray((time < self.start) | (time > self.end) | hole)

    def value(self, time: Array, derivative: int = 0) -> Array:
        """(k, 8) at instants (k,) of the run's own clock; NaN outside the run and in its gaps."""
        out = np.array(self._spline(time, derivative))
        out[self._outside(time)] = np.nan
        return out

    def sigma(self, time: Array) -> Array:
        """(k, 8) noise at these instants."""
        columns = [np.interp(time, self._time, column) for column in self._sigma.T]
        out = np.stack(columns, axis=1)
        out[self._outside(time)] = np.nan
        return out


def align(runs: Sequence[AnalysedRun], curves: Sequence[Curves]) -> Alignment:
    """Put runs on one clock; time zero is the collapse if any run knows it, else the mean of the runs' own zeros."""
    n = len(runs)
    t_f = [run.fitted["t_f"] for run in runs]
    fixed = np.array([item.known for item in t_f])
    shift = np.array([item.value if item.known else np.nan for item in t_f])
    sigma = np.array([item.sigma if item.known else np.nan for item in t_f])
    length = np.array([c.end - c.start for c in curves])
    if not fixed.any():
        longest = int(np.argmax(length))
        shift[longest], sigma[longest] = curves[longest].start, 0.0
    free = np.flatnonzero(~fixed)
    for i in free[np.argsort(-length[free])].tolist():
        if not np.isfinite(shift[i]):
            placed = [k for k in range(n) if np.isfinite(shift[k])]
            shift[i], sigma[i] = _match(curves[i], [curves[k] for k in placed], shift[placed], runs[i], None)
    if len(free) and n > 1:
        for _ in range(ROUNDS):
            for i in free.tolist():
                others = [k for k in range(n) if k != i]
                again = _match(curves[i], [curves[k] for k in others], shift[others], runs[i], shift[i])
                shift[i], sigma[i] = again
    if not fixed.any():
        shift = shift - shift.mean()
    return Alignment(shift, sigma, tuple("t_f" if known else "motion" for known in fixed))


def _mean(curves: Sequence[Curves], shift: Array, time: Array) -> tuple[Array, Array]:
    """Mean (k, 3) of the MATCHED quantities at common time, and its variance from noise; NaN where no run is."""
    values = np.stack([c.value(time + s)[:, MATCHED] for c, s in zip(curves, shift, strict=True)])
    sigmas = np.stack([c.sigma(time + s)[:, MATCHED] for c, s in zip(curves, shift, strict=True)])
    there = np.isfinite(values)
    count = there.sum(axis=0)
    with np.errstate(invalid="ignore", divide="ignore"):
        mean = np.where(there, values, 0.0).sum(axis=0) / count
        variance = np.where(there, sigmas**2, 0.0).sum(axis=0) / count**2
    return mean, np.where(count > 0, variance, np.nan)


def _match(
    mine: Curves, others: Sequence[Curves], shift: Array, run: AnalysedRun, near: float | None
) -> tuple[float, float]:
    """Shift [s] of a run against the mean of others, and its sigma."""
    interval = min(c.interval for c in (mine, *others))
    begin = min(c.start - s for c, s in zip(others, shift, strict=True))
    end = max(c.end - s for c, s in zip(others, shift, strict=True))
    time = np.arange(begin, end, interval)
    mean, variance = _mean(others, shift, time)
    if near is None:
        near = _coarse(mine, time, mean)
    best = near
    for _ in range(12):
        residual, slope, weight = _residual(mine, time, mean, variance, best)
        information = float(np.nansum(weight * slope**2))
        if information == 0.0:  # nothing to match: they share no instant without a gap
            return best, float("inf")
        step = float(np.nansum(weight * slope * residual)) / information
        best += float(np.clip(step, -MOST_STEP * interval, MOST_STEP * interval))
        if abs(step) < 1e-9:
            break
    residual, slope, weight = _residual(mine, time, mean, variance, best)
    return best, _shift_sigma(weight * slope * residual, weight * slope**2, run, time + best)


def _coarse(mine: Curves, time: Array, mean: Array) -> float:
    """Shift of least mean square misfit, each quantity relative to its own range, over all shifts with an overlap."""
    least = MIN_OVERLAP * min(mine.end - mine.start, time[-1] - time[0])
    lags = np.linspace(mine.start - time[-1] + least, mine.end - time[0] - least, COARSE_LAGS)
    every = max(1, len(time) // 1500)
    expected = (mean / np.nanstd(mean, axis=0))[::every]
    own_time = np.arange(mine.start, mine.end, time[1] - time[0])
    own = mine.value(own_time)[:, MATCHED] / np.nanstd(mean, axis=0)
    cost = []
    for lag in lags:
        at = time[::every] + lag
        curve = np.stack([np.interp(at, own_time, column, np.nan, np.nan) for column in own.T], axis=1)
        misfit = curve - expected
        seen = np.isfinite(misfit).all(axis=1)
        enough = seen.sum() * (time[1] - time[0]) * every >= 0.9 * least
        cost.append(float(np.mean(misfit[seen] ** 2)) if enough else np.inf)
    return float(lags[int(np.argmin(cost))])


def _residual(mine: Curves, time: Array, mean: Array, variance: Array, shift: float) -> tuple[Array, Array, Array]:
    """Mean of the others minus this run at a shift, slope and weight, each (k, 3); NaN where one is missing.

    The weight's variance holds, beside the noise, the mean square misfit of the quantity: what separates the runs.
    """
    slope = mine.value(time + shift, 1)[:, MATCHED]
    residual = mean - mine.value(time + shift)[:, MATCHED]
    noise = variance + mine.sigma(time + shift)[:, MATCHED] ** 2
    apart = np.nanmean(residual**2, axis=0)
    return residual, slope, 1.0 / (noise + apart)


def _shift_sigma(score: Array, information: Array, run: AnalysedRun, own_time: Array) -> float:
    """Sigma of the shift from the scatter of the score over stretches of at least a nutation period."""
    there = np.isfinite(score).all(axis=1)
    score, information = score[there].sum(axis=1), information[there].sum(axis=1)
    good = run.known()
    psi = np.interp(own_time[there], run.time[good], run.value[good, INDEX["psi"]])
    periods = NUTATION_PER_PRECESSION * np.ptp(psi) / (2 * np.pi)
    count = int(np.clip(periods, *STRETCHES))
    parts = np.array_split(np.arange(len(score)), count)
    sums = np.array([score[p].sum() for p in parts])
    return float(np.sqrt(count / (count - 1) * np.sum(sums**2)) / information.sum())
