"""Spread of aligned runs as a function of time, and what of it the measurement does not explain."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy import stats

from calibration.kit.arrays import Array, Mask
from disctrack.repeats.alignment import Alignment, Curves
from disctrack.repeats.averages import CONSISTENT, improbable
from disctrack.repeats.runs import INDEX, QUANTITIES

TURNED = 0.3  # [rad] psi offsets beyond this: the runs started turned about the vertical, and so are their paths
MATCHED = ("theta", "psidot", "energy")  # in which a run can stand out


@dataclass(frozen=True)
class Spread:
    """Standard deviation over the runs; k instants of the common clock, n runs, 8 QUANTITIES in SI."""

    time: Array  # (k,) [s]
    count: NDArray[np.int64]  # (k,) runs that are there
    common: Mask  # (k,) where all are; where any two are, if all never are together
    value: Array  # (n, k, 8) each run on the common clock, its offset taken off; NaN where it is not
    mean: Array  # (k, 8)
    std: Array  # (k, 8) over the runs, n - 1 in the denominator; NaN where fewer than two are
    noise: Array  # (k, 8) rms over the runs of the measurement's sigma
    clock: Array  # (k, 8) what the shifts' sigma makes of it
    offset: Array  # (n, 8) taken off from quantities with an origin of their own, relative to the mean; else 0
    turned: bool  # True where x, y were turned by the offset of psi before they were compared
    parts: tuple[Part, ...]  # per quantity
    standing_out: tuple[str, ...]  # per run: the quantities in which it lies away from all others, in words; or ""


@dataclass(frozen=True)
class Part:
    """Spread of one quantity, root mean square over the time that all runs have in common; SI."""

    name: str
    spread: float
    noise: float
    clock: float
    p_value: float  # of such a spread from noise and clock alone

    @property
    def physics(self) -> float:
        """What noise and clock do not explain; 0 where they explain all."""
        return float(np.sqrt(max(0.0, self.spread**2 - self.noise**2 - self.clock**2)))

    @property
    def verdict(self) -> str:
        """In words."""
        if not np.isfinite(self.spread):
            return "not known"
        if not self.p_value < CONSISTENT:
            return "the measurement explains it"
        share = self.physics**2 / self.spread**2
        return f"{100 * share:.3g} % of its square is the motion's own"


def spread(curves: Sequence[Curves], alignment: Alignment) -> Spread | None:
    """Spread of two or more runs; None where no two of them overlap in time."""
    interval = min(c.interval for c in curves)
    begins = np.array([c.start for c in curves]) - alignment.shift
    ends = np.array([c.end for c in curves]) - alignment.shift
    time = interval * np.arange(np.ceil(begins.min() / interval), np.floor(ends.max() / interval) + 1)
    own = [time + s for s in alignment.shift]
    value = np.stack([c.value(t) for c, t in zip(curves, own, strict=True)])
    there = np.isfinite(value).all(axis=2)
    count = there.sum(axis=0)
    common = count == (len(curves) if (count == len(curves)).sum() > 1 else 2)
    if common.sum() < 2:
        return None
    sigma = np.stack([c.sigma(t) for c, t in zip(curves, own, strict=True)])
    slope = np.stack([c.value(t, 1) for c, t in zip(curves, own, strict=True)])
    value, offset, turned = _without_offsets(value, common)
    mean = _mean(value, count)
    deviation = value - mean
    std = np.where(
        (count > 1)[:, None], np.sqrt(np.nansum(deviation**2, axis=0) / np.maximum(count - 1, 1)[:, None]), np.nan
    )
    noise = np.sqrt(_mean(sigma**2, count))
    drift = _mean(slope, count)
    free = np.array([q.own_origin for q in QUANTITIES])
    drift = drift - np.where(free, np.nanmean(drift[common], axis=0), 0.0)
    clock = np.abs(drift) * float(np.sqrt(np.mean(alignment.sigma**2)))
    parts = tuple(
        _part(q.name, deviation[:, common, i], std[common, i], noise[common, i], clock[common, i])
        for i, q in enumerate(QUANTITIES)
    )
    return Spread(
        time,
        count,
        common,
        value,
        mean,
        std,
        noise,
        clock,
        offset,
        turned,
        parts,
        _standing_out(value[:, common], parts),
    )


def _mean(values: Array, count: NDArray[np.int64]) -> Array:
    with np.errstate(invalid="ignore", divide="ignore"):
        return np.asarray(np.nansum(values, axis=0) / np.where(count > 0, count, np.nan)[:, None])


def _without_offsets(value: Array, common: Mask) -> tuple[Array, Array, bool]:
    """Values without each run's constant offset where a quantity has an origin of its own, and these offsets."""
    value = value.copy()
    offset = np.zeros((len(value), len(QUANTITIES)))
    there = np.isfinite(value[:, common]).all(axis=2)
    shared = common.copy()
    shared[common] = there.any(axis=0)

    def level(i: int) -> Array:
        return np.asarray(np.nanmean(value[:, shared, i] - np.nanmean(value[:, shared, i], axis=0), axis=1))

    for name in ("psi", "phi"):
        i = INDEX[name]
        free = level(i)
        value[:, :, i] -= free[:, None]
        middle = np.angle(np.mean(np.exp(1j * free)))
        offset[:, i] = np.angle(np.exp(1j * (free - middle)))
    turned = bool(np.abs(offset[:, INDEX["psi"]]).max() > TURNED)
    x, y = INDEX["x"], INDEX["y"]
    if turned:
        middle = np.nanmean(value[:, common][:, :, [x, y]], axis=1)
        c, s = np.cos(-offset[:, INDEX["psi"]]), np.sin(-offset[:, INDEX["psi"]])
        arm = value[:, :, [x, y]] - middle[:, None]
        value[:, :, x] = middle[:, None, 0] + c[:, None] * arm[..., 0] - s[:, None] * arm[..., 1]
        value[:, :, y] = middle[:, None, 1] + s[:, None] * arm[..., 0] + c[:, None] * arm[..., 1]
    for i in (x, y):
        offset[:, i] = level(i)
        value[:, :, i] -= offset[:, i, None]
    return value, offset, turned


def _part(name: str, deviation: Array, std: Array, noise: Array, clock: Array) -> Part:
    spread, sigma, from_clock = (float(np.sqrt(np.nanmean(a**2))) for a in (std, noise, clock))
    expected = sigma**2 + from_clock**2
    dof = (len(deviation) - 1) * independent_samples(deviation)
    p = float(stats.chi2.sf(dof * spread**2 / expected, dof)) if expected > 0 else float("nan")
    return Part(name, spread, sigma, from_clock, p)


def independent_samples(deviation: Array) -> float:
    """Number of independent instants in deviations (n, k): k over their summed autocorrelation to its first zero."""
    d = np.where(np.isfinite(deviation), deviation, 0.0)
    k = d.shape[1]
    transform = np.fft.rfft(d, 2 * k, axis=1)
    correlation = np.fft.irfft(np.abs(transform) ** 2, axis=1)[:, :k].sum(axis=0)
    if correlation[0] <= 0:
        return 1.0
    correlation /= correlation[0]
    below = np.flatnonzero(correlation <= 0)
    reach = int(below[0]) if below.size else k
    return float(max(1.0, k / (1.0 + 2.0 * correlation[1:reach].sum())))


def _standing_out(value: Array, parts: Sequence[Part]) -> tuple[str, ...]:
    """Per run, what sets it apart from all others; values (n, k, 8) over the common time."""
    n = len(value)
    found: list[list[str]] = [[] for _ in range(n)]
    for name in MATCHED if n > 2 else ():
        v, part = value[:, :, INDEX[name]], parts[INDEX[name]]
        measured = part.noise**2 + part.clock**2
        for i in range(n):
            others = np.delete(v, i, axis=0)
            away = float(np.nanmean((v[i] - others.mean(axis=0)) ** 2))
            own = float(np.nanmean(others.var(axis=0, ddof=1)))
            t = np.sqrt(away / (max(own, measured) * (1 + 1 / (n - 1))))
            if improbable(float(t), n, own < 2 * measured):
                found[i].append(f"{QUANTITIES[INDEX[name]].symbol} ({t:.1f} times the spread of the others)")
    return tuple(", ".join(words) for words in found)
