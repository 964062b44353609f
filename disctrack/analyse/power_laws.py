"""Scaling laws of the last stage: theta, psidot and energy as powers of the time that is left.

theta(t) = C (t_f - t)^n_theta exp(oscillation), psidot and the energy alike. The instant t_f of collapse is a parameter
of the fit, shared by theta and psidot: 5 ms in it move n_theta by 0.026. The nutation, 5 to 40 % of theta, is part of
the model, as harmonics of a phase that follows the precession angle; it would otherwise enter the exponents through
the phases at which the window happens to begin and end.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.polynomial import Polynomial
from numpy.typing import NDArray
from scipy.optimize import least_squares
from scipy.special import stdtrit

from calibration.kit.arrays import Array
from calibration.kit.brief import Outline
from disctrack.disc import Disc, nutation_frequency, precession_rate
from disctrack.errors import ModelError

# (name, n_theta): the power lost goes with theta^a on slow steady precession, n_theta = 1 / (1 - a), n_E = n_theta,
# n_psidot = -n_theta / 2
MODEL_EXPONENTS = (
    ("Moffatt 2000, shear of the air layer", 1 / 3),
    ("Bildsten 2002, boundary layer of the air", 4 / 9),
    ("Leine 2009, viscous friction along the contour", 1 / 2),
    ("Ma et al. 2014, rolling moment with psidot squared", 2 / 3),
)
WINDOW = 0.5  # [s] before t_f, as for the paper's table 2
MIN_PERIODS = 5  # of nutation, in a window
MIN_SPAN = 2.5  # longest over shortest time left: a power law shows only over a ratio
MAX_TF_SIGMA = 0.3  # of t_f, over the shortest time left
RATIO_RANGE = (0.72, 0.95)  # nutation over precession frequency: thin disc 0.7746, 3 mm at 60 degrees 0.89
FAR_RECORDINGS = 5.0  # times its length that a recording's end may lie before collapse for a number to be given
TREND_DEGREE = 5  # follows any power law over the window to 1e-3 rad, and no oscillation of MIN_PERIODS
HARMONICS = ((1, 3), (2, 2))  # (harmonic, terms of its amplitude in a polynomial of the phase)
BRAKE_DROP = 0.05  # relative fall of psidot below its peak that is taken for the brake at the very end
BRAKE_MARGIN = 0.01  # [s] left out before that peak


@dataclass(frozen=True)
class Exponent:
    """One fitted exponent."""

    value: float
    sigma: float
    low: float  # 95 % confidence
    high: float

    def agrees_with(self, other: float) -> bool:
        """True when `other` lies inside the confidence interval."""
        return self.low <= other <= self.high


@dataclass(frozen=True, repr=False)
class PowerLaws(Outline):
    """Exponents over one window; NaN with a reason where the data do not determine them."""

    window: tuple[float, float]  # [s] longest and shortest time left, t_f - t
    n_frames: int
    n_periods: float  # of nutation in the window
    t_f: float  # [s]
    t_f_sigma: float  # [s]
    n_theta: Exponent
    n_psidot: Exponent
    n_energy: Exponent
    n_theta_per_t_f: float  # [1/s] change of n_theta for a given change of t_f
    prefactors: tuple[float, float, float]  # theta [rad], psidot [rad/s], energy [J] at 1 s before t_f, no oscillation
    nutation_ratio: float  # phase of the nutation over that of the precession
    rms: tuple[float, float, float]  # of ln theta, ln psidot, ln E about the model
    reason: str  # empty when determined

    @property
    def determined(self) -> bool:
        """True when the exponents are numbers."""
        return not self.reason


@dataclass(frozen=True)
class NutationCount:
    """Nutation oscillations counted against turns of precession."""

    turns: Array  # (n,) precession turns since the start, at the maxima of theta
    count: Array  # (n,) 0, 1, 2, ...
    slope: float  # NaN with fewer than 4 maxima
    sigma: float
    expected: tuple[float, float]  # of small oscillations at the first and the last nutation of this disc
    thin_disc: float = float(np.sqrt(3 / 5))


def fit_power_laws(
    time: Array, psi: Array, theta: Array, psidot: Array, energy: Array, window: float = WINDOW
) -> PowerLaws:
    """Exponents over the last `window` seconds before t_f.

    time [s], psi [rad] unwrapped, theta [rad], psidot [rad/s], energy [J] : (n,), NaN where unknown
    The energy's exponent is fitted at the t_f of theta and psidot, with that t_f's error carried over: an energy of
    spin that remains at the end would pull at t_f. Confidence intervals come from the scatter of whole nutation
    periods (cluster-robust covariance), so that neighbouring frames do not count as independent.
    """
    usable = np.isfinite(psi) & (theta > 0) & (psidot > 0)
    if usable.sum() < 20:
        return _undetermined("fewer than 20 frames with a nutation and a positive precession rate")
    end = power_law_end(time, psi, psidot)
    usable &= time <= end
    if usable.sum() < 20:
        return _undetermined("fewer than 20 frames before the brake at the end")
    frames = np.flatnonzero(usable)
    fit = _Fit.start(time[frames], psi[frames], np.log(theta[frames]), np.log(psidot[frames]))
    for _ in range(4):
        left = fit.t_f - time
        chosen = usable & (left <= window)
        if chosen.sum() < 20:
            still = fit.t_f - end
            how_far = f"about {still:.2g} s" if still < FAR_RECORDINGS * np.ptp(time) else "long"
            return _undetermined(
                f"the recording ends {how_far} before collapse, outside the window of the last {window:g} s: record "
                "closer to the end, or ask for a longer window"
            )
        again = _Fit.start(time[chosen], psi[chosen], np.log(theta[chosen]), np.log(psidot[chosen]), fit)
        moved, fit = abs(again.t_f - fit.t_f), again
        if moved < 1e-5:
            break
    return _judged(fit, np.log(np.where(energy > 0, energy, np.nan))[chosen])


def exponents_by_window(
    time: Array, psi: Array, theta: Array, psidot: Array, energy: Array, windows: Array
) -> tuple[PowerLaws, ...]:
    """The fit over each of several windows [s], t_f fitted anew in each."""
    return tuple(fit_power_laws(time, psi, theta, psidot, energy, float(w)) for w in windows)


def power_law_end(time: Array, psi: Array, psidot: Array) -> float:
    """Last instant [s] of the law: the end of the recording, or shortly before psidot breaks down.

    At the very end a paper patch or the flat face touches the table and brakes the precession within 20 ms. What counts
    is psidot averaged over a turn, so that the nutation does not look like a brake.
    """
    known = np.flatnonzero(np.isfinite(psidot) & np.isfinite(psi))
    turned = np.maximum.accumulate(psi[known])  # a disc that has stopped jitters
    before = np.interp(turned - 2 * np.pi, turned, time[known], left=np.nan)
    mean = 2 * np.pi / (time[known] - before)  # over the turn that ends here
    if not np.isfinite(mean).any():
        return float(time[known[-1]])
    peak = int(np.nanargmax(mean))
    if mean[-1] < (1 - BRAKE_DROP) * mean[peak]:
        return float(time[known[peak]] - BRAKE_MARGIN)
    return float(time[known[-1]])


def _without_ripple(time: Array, psi: Array) -> Array:
    """Precession angle (n,) as a slow function of the time: polynomial in the logarithm of a time left."""
    left = np.log(time[-1] - time + 0.05 * np.ptp(time))
    return Polynomial.fit(left, psi, TREND_DEGREE)(left)


@dataclass(frozen=True)
class _Fit:
    """Variable projection: t_f and the nutation ratio outside, everything linear inside."""

    time: Array
    psi: Array
    data: Array  # (2, n) ln theta, ln psidot
    t_f: float
    ratio: float
    scale: Array  # (2,) rms of each, its weight

    @classmethod
    def start(cls, time: Array, psi: Array, ln_theta: Array, ln_psidot: Array, near: _Fit | None = None) -> _Fit:
        data = np.stack([ln_theta, ln_psidot])
        # the nutation's own ripple on psi would, in the phase, make the harmonics carry a part of the trend
        psi = _without_ripple(time, psi)
        if near is None:
            span = time[-1] - time[0]
            first = cls(time, psi, data, time[-1] + 0.05 * span, 0.785, np.ones(2))
            near = first._best(time[-1] + span * np.geomspace(2e-3, 3.0, 30), np.array([0.785]))
        fit = cls(time, psi, data, near.t_f, near.ratio, near.scale)
        step = 0.7 / max(float(np.ptp(psi)), 1.0)
        fit = fit._best(np.array([fit.t_f]), np.arange(*RATIO_RANGE, step))
        for _ in range(3):
            fit = fit._refined()
        return fit

    def _best(self, t_f: Array, ratios: Array) -> _Fit:
        tried = [replace(self, t_f=float(a), ratio=float(b)) for a in t_f if a > self.time[-1] for b in ratios]
        return min(tried or [self], key=lambda fit: float(np.sum(fit.residuals() ** 2)))

    def _refined(self) -> _Fit:
        shortest = self.time[-1]
        left = max(self.t_f - shortest, 1e-4)

        def at(x: Array) -> _Fit:
            return replace(self, t_f=float(shortest + left * np.exp(x[0])), ratio=float(x[1]))

        found = least_squares(
            lambda x: at(x).residuals(),
            [0.0, self.ratio],
            bounds=([-4.0, RATIO_RANGE[0]], [4.0, RATIO_RANGE[1]]),
            x_scale=[0.1, 0.01],
        )
        fit = at(found.x)
        misfit = fit.residuals().reshape(2, -1) * fit.scale[:, None]
        return replace(fit, scale=np.maximum(np.sqrt(np.mean(misfit**2, axis=1)), 1e-12))

    @property
    def phase(self) -> Array:
        """Phase of the nutation (n,) [rad]."""
        return self.ratio * self.psi

    def design(self) -> Array:
        """Columns (n, p): 1, ln(t_f - t), harmonics of the phase with amplitudes that drift."""
        drift = 2 * (self.psi - self.psi.mean()) / max(float(np.ptp(self.psi)), 1e-9)
        columns = [np.ones_like(self.time), np.log(self.t_f - self.time)]
        for harmonic, terms in HARMONICS:
            for power in range(terms):
                columns += [drift**power * np.cos(harmonic * self.phase), drift**power * np.sin(harmonic * self.phase)]
        return np.stack(columns, axis=1)

    def coefficients(self, data: Array) -> Array:
        """Linear parameters (p, k) for data (k, n)."""
        return np.asarray(np.linalg.lstsq(self.design(), data.T, rcond=None)[0], float)

    def residuals(self) -> Array:
        """Weighted misfit (2 n,)."""
        A = self.design()
        misfit = self.data - (A @ np.linalg.lstsq(A, self.data.T, rcond=None)[0]).T
        return np.asarray((misfit / self.scale[:, None]).ravel())


def _judged(fit: _Fit, ln_energy: Array) -> PowerLaws:
    """Exponents with their confidence, or why there are none."""
    longest, shortest = fit.t_f - fit.time[0], fit.t_f - fit.time[-1]
    periods = float(np.ptp(fit.phase)) / (2 * np.pi)
    covariance, linear, dof = _covariance(fit)
    p = linear.shape[0]
    sigma = np.sqrt(np.diagonal(covariance))
    t_f_sigma = float(sigma[2 * p])
    base = _undetermined("", (float(longest), float(shortest)), len(fit.time), periods)
    reason = ""
    if periods < MIN_PERIODS:
        reason = f"only {periods:.1f} nutation periods in the window, {MIN_PERIODS} are needed"
    elif longest < MIN_SPAN * shortest:
        reason = (
            f"the window reaches from {longest:.3f} s to {shortest:.3f} s before collapse, less than a factor "
            f"{MIN_SPAN}: record closer to the end"
        )
    elif not t_f_sigma < MAX_TF_SIGMA * shortest:
        reason = (
            f"t_f is known only to {1e3 * t_f_sigma:.1f} ms with {1e3 * shortest:.1f} ms left at the end of the data"
        )
    if reason:
        return replace(base, reason=reason, t_f=fit.t_f, t_f_sigma=t_f_sigma)
    quantile = float(stdtrit(dof, 0.975))
    energy, energy_at_1s, energy_rms = _energy_exponent(fit, ln_energy, t_f_sigma, quantile)
    misfit = fit.residuals().reshape(2, -1) * fit.scale[:, None]
    rms = np.sqrt(np.mean(misfit**2, axis=1))
    return replace(
        base,
        t_f=fit.t_f,
        t_f_sigma=t_f_sigma,
        n_theta=_exponent(linear[1, 0], sigma[1], quantile),
        n_psidot=_exponent(linear[1, 1], sigma[p + 1], quantile),
        n_energy=energy,
        n_theta_per_t_f=_per_t_f(fit, fit.data[:1]),
        prefactors=(float(np.exp(linear[0, 0])), float(np.exp(linear[0, 1])), energy_at_1s),
        nutation_ratio=fit.ratio,
        rms=(float(rms[0]), float(rms[1]), energy_rms),
    )


def _exponent(value: float, sigma: float, quantile: float) -> Exponent:
    return Exponent(float(value), float(sigma), float(value - quantile * sigma), float(value + quantile * sigma))


def _covariance(fit: _Fit) -> tuple[Array, Array, float]:
    """Cluster-robust covariance of (linear theta, linear psidot, t_f, ratio); linear parameters (p, 2); dof."""
    A = fit.design()
    linear = fit.coefficients(fit.data)
    n, p = A.shape
    J = np.zeros((2, n, 2 * p + 2))
    for j in range(2):
        J[j, :, j * p : (j + 1) * p] = A / fit.scale[j]
    for column, (name, step) in enumerate((("t_f", 1e-6), ("ratio", 1e-6))):
        up, down = (replace(fit, **{name: getattr(fit, name) + d}).design() for d in (step, -step))
        J[:, :, 2 * p + column] = (((up - down) / (2 * step)) @ linear).T / fit.scale[:, None]
    residual = fit.residuals().reshape(2, n)
    period = np.floor((fit.phase - fit.phase[0]) / (2 * np.pi)).astype(int)
    return _clustered(J, residual, period), linear, max(2.0, period.max() + 1 - 4.0)


def _clustered(J: Array, residual: Array, cluster: NDArray[np.int64]) -> Array:
    """Covariance of the parameters from residuals that are correlated within clusters; J (k, n, p), residual (k, n).

    Jackknife over the clusters, linearised: leaving out cluster g moves the parameters by
    (J^T J)^-1 J_g^T (I - H_g)^-1 r_g, with H_g = J_g (J^T J)^-1 J_g^T. Without (I - H_g)^-1 a fit of many parameters to
    few periods would look as good as its residuals.
    """
    bread = np.linalg.pinv(np.einsum("knp,knq->pq", J, J), rcond=1e-13)
    numbers = np.unique(cluster)
    moves = []
    for number in numbers:
        J_g = J[:, cluster == number].reshape(-1, J.shape[-1])
        own = np.eye(len(J_g)) - J_g @ bread @ J_g.T
        moves.append(bread @ (J_g.T @ np.linalg.lstsq(own, residual[:, cluster == number].ravel(), rcond=1e-8)[0]))
    moved = np.array(moves)
    return (len(numbers) - 1) / len(numbers) * moved.T @ moved


def _energy_exponent(fit: _Fit, ln_energy: Array, t_f_sigma: float, quantile: float) -> tuple[Exponent, float, float]:
    nan = float("nan")
    if not np.isfinite(ln_energy).all():
        return Exponent(nan, nan, nan, nan), nan, nan
    A = fit.design()
    linear = fit.coefficients(ln_energy[None])[:, 0]
    residual = ln_energy - A @ linear
    period = np.floor((fit.phase - fit.phase[0]) / (2 * np.pi)).astype(int)
    own = _clustered(A[None], residual[None], period)[1, 1]
    sigma = float(np.sqrt(own + (_per_t_f(fit, ln_energy[None]) * t_f_sigma) ** 2))
    rms = float(np.sqrt(np.mean(residual**2)))
    return _exponent(linear[1], sigma, quantile), float(np.exp(linear[0])), rms


def _per_t_f(fit: _Fit, data: Array) -> float:
    """Change of the exponent of data (1, n) with t_f [1/s]."""
    step = 1e-3 * (fit.t_f - fit.time[-1])
    up, down = (replace(fit, t_f=fit.t_f + d).coefficients(data)[1, 0] for d in (step, -step))
    return float((up - down) / (2 * step))


def _undetermined(
    reason: str, window: tuple[float, float] = (np.nan, np.nan), n_frames: int = 0, n_periods: float = np.nan
) -> PowerLaws:
    nan = float("nan")
    none = Exponent(nan, nan, nan, nan)
    return PowerLaws(
        window, n_frames, n_periods, nan, nan, none, none, none, nan, (nan, nan, nan), nan, (nan, nan, nan), reason
    )


def count_nutation(psi: Array, theta: Array, theta_sigma: Array, disc: Disc, gravity: float) -> NutationCount:
    """Maxima of theta counted against turns of precession (paper's figure 7), with the slope of a straight line.

    A maximum counts when it stands more than 6 sigma above its neighbourhood. The line's sigma comes from its scatter.
    """
    known = np.flatnonzero(np.isfinite(theta) & np.isfinite(psi))
    if known.size < 8:
        return NutationCount(np.zeros(0), np.zeros(0), float("nan"), float("nan"), (float("nan"),) * 2)
    height = theta[known]
    peaks = prominent_maxima(height, 6 * float(np.median(theta_sigma[known])))
    turns = (psi[known] - psi[known[0]]) / (2 * np.pi)
    at = np.array([_parabola_top(turns[i - 1 : i + 2], height[i - 1 : i + 2]) for i in peaks])
    count = np.arange(len(at), dtype=float)
    expected = tuple(float(nutation_ratio(t, disc)) for t in (height[0], height[-1]))
    slope, sigma = float("nan"), float("nan")
    if len(at) >= 4:
        A = np.column_stack([at, np.ones_like(at)])
        solution, *_ = np.linalg.lstsq(A, count, rcond=None)
        scatter = np.sum((count - A @ solution) ** 2) / max(1, len(at) - 2)
        slope, sigma = float(solution[0]), float(np.sqrt(scatter * np.linalg.inv(A.T @ A)[0, 0]))
    return NutationCount(at, count, slope, sigma, (expected[0], expected[1]))


def prominent_maxima(height: Array, prominence: float) -> NDArray[np.intp]:
    """Indices of the maxima that stand by `prominence` above the higher of the two lowest points on their sides.

    A side reaches to the next higher point. Of a plateau the middle counts, and the ends of the series do not. As
    `scipy.signal.find_peaks`, which takes a second to import.
    """
    change = np.flatnonzero(np.diff(height))  # the last of each run of equal points
    first, last = np.r_[0, change + 1], np.r_[change, len(height) - 1]
    level = height[first]
    top = np.flatnonzero((level[1:-1] > level[:-2]) & (level[1:-1] > level[2:])) + 1
    found = []
    for i in top:
        before, after = np.flatnonzero(level[:i] > level[i]), np.flatnonzero(level[i:] > level[i])
        left = level[before[-1] if before.size else 0 : i]
        right = level[i + 1 : i + after[0] if after.size else None]
        if level[i] - max(left.min(), right.min()) >= prominence:
            found.append((first[i] + last[i]) // 2)
    return np.array(found, np.intp)


def _parabola_top(x: Array, y: Array) -> float:
    """Abscissa of the top of the parabola through three points."""
    a, b, _ = np.polyfit(x - x[1], y, 2)
    return float(x[1] - b / (2 * a)) if a < 0 else float(x[1])


def nutation_ratio(theta: float, disc: Disc) -> float:
    """Frequency of small nutations over that of the precession, about steady precession with the centre at rest.

    sqrt(3/5) for a thin disc at small theta, eq. (2.15). Gravity sets the rates, not their ratio; NaN where a disc
    cannot precess so.
    """
    try:
        return nutation_frequency(theta, disc) / precession_rate(theta, disc)[0]
    except ModelError:
        return float("nan")
