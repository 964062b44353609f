"""Scaling laws of the last stage: theta, psidot and energy as powers of the time to collapse.

theta(t) = C (t_f - t)^n_theta exp(oscillation), similarly psidot and the energy. The instant t_f of collapse is fitted,
common to theta and psidot: a change of 5 ms moves n_theta by 0.026. The nutation oscillation, 5 to 40 % of theta, is
modelled by harmonics of a phase proportional to the precession angle. Otherwise it would bias the exponents, depending
on its phase at both ends of the window.
"""

from dataclasses import dataclass, replace
from typing import Annotated

import numpy as np
from numpy.polynomial import Polynomial
from scipy.optimize import least_squares
from scipy.signal import find_peaks
from scipy.special import stdtrit

from calibration.kit.brief import Brief
from calibration.kit.types import Array, Indices
from disctrack.analyse.derivatives import MIN_FRAMES
from disctrack.disc import Disc, nutation_frequency, precession_rate
from disctrack.errors import ModelError
from disctrack.numbers import Measured

# (name, n_theta): in slow steady precession the dissipated power is proportional to theta^a, n_theta = 1 / (1 - a),
# n_E = n_theta, n_psidot = -n_theta / 2
MODEL_EXPONENTS = (
    ("Moffatt 2000, shear of the air layer", 1 / 3),
    ("Bildsten 2002, boundary layer of the air", 4 / 9),
    ("Leine 2009, viscous friction along the contour", 1 / 2),
    ("Ma et al. 2014, rolling moment with psidot squared", 2 / 3),
)
WINDOW = 0.5  # [s] before t_f, as in table 2 of the paper
MIN_PERIODS = 5  # of nutation, in a window
RATIO_RANGE = (0.72, 0.95)  # nutation over precession frequency: thin disc 0.7746, 3 mm at 60 degrees 0.89
HARMONICS = ((1, 3), (2, 2))  # (harmonic, terms of its amplitude in a polynomial of the phase)
BRAKE_DROP = 0.05  # relative decrease of psidot below its peak that indicates braking at the very end
BRAKE_MARGIN = 0.01  # [s] excluded before that peak


NAN = float("nan")


@dataclass(frozen=True)
class Exponent(Measured):
    """One fitted exponent."""

    value: float = NAN
    half: float = NAN  # of the 95 % confidence interval

    @property
    def low(self) -> float:
        """Lower end of the confidence interval."""
        return self.value - self.half

    @property
    def high(self) -> float:
        """Upper end of the confidence interval."""
        return self.value + self.half

    def agrees_with(self, other: float) -> bool:
        """True if `other` is inside the confidence interval."""
        return self.low <= other <= self.high


@dataclass(frozen=True, repr=False)
class PowerLaws(Brief):
    """Exponents over one window; NaN with a reason if the data do not determine them."""

    reason: Annotated[str, "reason_undetermined"] = ""  # empty if determined
    # [s] longest and shortest time to collapse, t_f - t
    window: Annotated[tuple[float, float], "window_s"] = (NAN, NAN)
    n_periods: float = NAN  # of nutation in the window
    t_f: Annotated[float, "t_f_s"] = NAN  # [s]
    t_f_sigma: Annotated[float, "t_f_sigma_s"] = NAN  # [s]
    n_theta: Exponent = Exponent()
    n_psidot: Exponent = Exponent()
    n_energy: Exponent = Exponent()
    n_theta_per_t_f: float = NAN  # [1/s] d n_theta / d t_f

    @property
    def determined(self) -> bool:
        """True if the exponents are numbers."""
        return not self.reason


@dataclass(frozen=True)
class NutationCount:
    """Nutation oscillations counted against turns of precession."""

    turns: Array  # (n,) precession turns since the start, at the maxima of theta
    count: Array  # (n,) 0, 1, 2, ...
    slope: Annotated[float, "nutation_over_precession_counted"]  # NaN with fewer than 4 maxima
    sigma: Annotated[float, "nutation_over_precession_counted_sigma"]
    # for small oscillations at the first and the last nutation of this disc
    expected: Annotated[tuple[float, float], "nutation_over_precession_expected"]


def fit_power_laws(
    time: Array, psi: Array, theta: Array, psidot: Array, energy: Array, window: float = WINDOW
) -> PowerLaws:
    """Exponents over the last `window` seconds before t_f.

    time [s], psi [rad] unwrapped, theta [rad], psidot [rad/s], energy [J] : (n,), NaN where unknown
    The exponent of the energy is fitted with t_f of theta and psidot, whose error is propagated: a spin energy that
    remains at the end would bias t_f. Confidence intervals are from the scatter of whole nutation periods
    (cluster-robust covariance), so that neighbouring frames do not count as independent.
    """
    usable = np.isfinite(psi) & (theta > 0) & (psidot > 0)
    end = power_law_end(time, psi, psidot)
    usable &= time <= end
    if usable.sum() < MIN_FRAMES:
        return PowerLaws(
            f"fewer than {MIN_FRAMES} frames with a nutation and a positive precession rate before the brake at the end"
        )
    with np.errstate(invalid="ignore", divide="ignore"):
        data = np.log(np.stack([theta, psidot, np.where(energy > 0, energy, np.nan)]))
    fit = _fitted(time[usable], psi[usable], data[:2, usable])
    for _ in range(4):
        chosen = usable & (fit.t_f - time <= window)
        if chosen.sum() < MIN_FRAMES:
            missing = fit.t_f - end
            how_far = f"about {missing:.2g} s" if missing < 5 * np.ptp(time) else "long"
            return PowerLaws(
                f"the recording ends {how_far} before collapse, outside the window of the last {window:g} s: record "
                "closer to the end, or ask for a longer window"
            )
        before, fit = fit.t_f, _fitted(time[chosen], psi[chosen], data[:2, chosen], fit)
        if abs(fit.t_f - before) < 1e-5:
            break
    return _judged(fit, data[2:, chosen])


def power_law_end(time: Array, psi: Array, psidot: Array) -> float:
    """Last instant [s] of the law: the end of the recording, or shortly before psidot collapses; inf if it is unknown.

    At the very end a paper patch or the flat face touches the table and brakes the precession within 20 ms. The
    criterion is psidot averaged over a turn, so that the nutation does not count as braking.
    """
    known = np.flatnonzero(np.isfinite(psidot) & np.isfinite(psi))
    if not known.size:
        return np.inf
    turned = np.maximum.accumulate(psi[known])  # the angle of a stopped disc only fluctuates
    before = np.interp(turned - 2 * np.pi, turned, time[known], left=np.nan)
    mean = 2 * np.pi / (time[known] - before)  # over the turn that ends here
    if np.isfinite(mean).any():
        peak = int(np.nanargmax(mean))
        if mean[-1] < (1 - BRAKE_DROP) * mean[peak]:
            return float(time[known[peak]] - BRAKE_MARGIN)
    return float(time[known[-1]])


@dataclass(frozen=True)
class _Fit:
    """Variable projection: nonlinear parameters t_f and nutation ratio, all others linear."""

    time: Array
    psi: Array  # without the oscillation by nutation
    data: Array  # (2, n) ln theta, ln psidot
    t_f: float
    ratio: float
    scale: Array  # (2, 1) rms residual of each, for its weight

    @property
    def phase(self) -> Array:
        """Phase of the nutation (n,) [rad]."""
        return self.ratio * self.psi

    @property
    def period(self) -> Indices:
        """Number of the nutation period (n,)."""
        return np.floor((self.phase - self.phase[0]) / (2 * np.pi)).astype(int)

    def design(self) -> Array:
        """Columns (n, p): 1, ln(t_f - t), harmonics of the phase with amplitudes that drift."""
        drift = 2 * (self.psi - self.psi.mean()) / max(float(np.ptp(self.psi)), 1e-9)
        columns = [np.ones_like(self.time), np.log(self.t_f - self.time)]
        for harmonic, terms in HARMONICS:
            for power in range(terms):
                columns += [drift**power * np.cos(harmonic * self.phase), drift**power * np.sin(harmonic * self.phase)]
        return np.stack(columns, axis=1)

    def linear(self, data: Array) -> tuple[Array, Array]:
        """Linear parameters (p, k) for data (k, n), and residuals (k, n)."""
        A = self.design()
        found = np.asarray(np.linalg.lstsq(A, data.T, rcond=None)[0], float)
        return found, data - (A @ found).T

    def residual(self) -> Array:
        """Weighted (2 n,)."""
        return np.asarray(self.linear(self.data)[1] / self.scale).ravel()

    def refined(self) -> "_Fit":
        """The fit with optimal t_f and ratio, and weights from its residuals."""
        end = self.time[-1]
        to_collapse = max(self.t_f - end, 1e-4)

        def at(x: Array) -> "_Fit":
            return replace(self, t_f=float(end + to_collapse * np.exp(x[0])), ratio=float(x[1]))

        bounds = [-4.0, RATIO_RANGE[0]], [4.0, RATIO_RANGE[1]]
        found = least_squares(lambda x: at(x).residual(), [0.0, self.ratio], bounds=bounds, x_scale=[0.1, 0.01])
        fit = at(found.x)
        rms = np.sqrt(np.mean(fit.linear(fit.data)[1] ** 2, axis=1, keepdims=True))
        return replace(fit, scale=np.maximum(rms, 1e-12))


def _fitted(time: Array, psi: Array, data: Array, near: _Fit | None = None) -> _Fit:
    """The fit to ln theta and ln psidot (2, n); near : a fit to other frames, as initial guess."""
    span = np.ptp(time)
    # psi oscillates with the nutation; in the phase, this would correlate the harmonics with the trend. A polynomial of
    # this degree follows any power law over the window to 1e-3 rad, but no oscillation of MIN_PERIODS
    ln_time = np.log(time[-1] - time + 0.05 * span)
    psi = Polynomial.fit(ln_time, psi, 5)(ln_time)

    def best(tried: list[_Fit]) -> _Fit:
        return min(tried, key=lambda fit: float(np.sum(fit.residual() ** 2)))

    if near is None:
        ends = time[-1] + span * np.geomspace(2e-3, 3.0, 30)
        near = best([_Fit(time, psi, data, float(t_f), 0.785, np.ones((2, 1))) for t_f in ends])
    ratios = np.arange(*RATIO_RANGE, 0.7 / max(float(np.ptp(psi)), 1.0))
    fit = best([_Fit(time, psi, data, near.t_f, float(ratio), near.scale) for ratio in ratios])
    for _ in range(3):
        fit = fit.refined()
    return fit


def _judged(fit: _Fit, ln_energy: Array) -> PowerLaws:
    """Exponents with confidence intervals, or the reason why they are not determined. ln_energy : (1, n)"""
    longest, shortest = float(fit.t_f - fit.time[0]), float(fit.t_f - fit.time[-1])
    periods = float(np.ptp(fit.phase)) / (2 * np.pi)
    linear, sigma, t_f_sigma = _linear_with_sigma(fit)
    laws = PowerLaws("", (longest, shortest), periods, fit.t_f, t_f_sigma)
    if periods < MIN_PERIODS:
        return replace(laws, reason=f"only {periods:.1f} nutation periods in the window, {MIN_PERIODS} are needed")
    quantile = float(stdtrit(max(2.0, fit.period.max() + 1 - 4.0), 0.975))

    def exponent(value: float, sigma: float) -> Exponent:
        return Exponent(float(value), float(sigma), half=float(quantile * sigma))

    of_energy = Exponent()
    if np.isfinite(ln_energy).all():
        found, residual = fit.linear(ln_energy)
        variance = _clustered(fit.design()[None], residual, fit.period)[1, 1]
        of_energy = exponent(found[1, 0], np.sqrt(variance + (_per_t_f(fit, ln_energy) * t_f_sigma) ** 2))
    n_theta, n_psidot = map(exponent, linear[1], sigma[:, 1])
    per_t_f = _per_t_f(fit, fit.data[:1])
    return replace(laws, n_theta=n_theta, n_psidot=n_psidot, n_energy=of_energy, n_theta_per_t_f=per_t_f)


def _linear_with_sigma(fit: _Fit) -> tuple[Array, Array, float]:
    """Linear parameters (p, 2) of theta and psidot with their cluster-robust sigmas (2, p), and that of t_f."""
    A, (linear, residual) = fit.design(), fit.linear(fit.data)
    n, p = A.shape
    J = np.zeros((2, n, 2 * p + 2))
    for j in range(2):
        J[j, :, j * p : (j + 1) * p] = A / fit.scale[j]
    for column, name in enumerate(("t_f", "ratio")):
        up, down = (replace(fit, **{name: getattr(fit, name) + d}).design() for d in (1e-6, -1e-6))
        J[:, :, 2 * p + column] = (((up - down) / 2e-6) @ linear).T / fit.scale
    sigma = np.sqrt(np.diagonal(_clustered(J, residual / fit.scale, fit.period)))
    return linear, sigma[: 2 * p].reshape(2, p), float(sigma[2 * p])


def _clustered(J: Array, residual: Array, cluster: Indices) -> Array:
    """Covariance of the parameters from residuals that are correlated within clusters; J (k, n, p), residual (k, n).

    Linearised jackknife over the clusters: without cluster g the parameters change by
    (J^T J)^-1 J_g^T (I - H_g)^-1 r_g, with H_g = J_g (J^T J)^-1 J_g^T. The factor (I - H_g)^-1 corrects the residuals,
    which are too small if many parameters are fitted to few periods.
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


def _per_t_f(fit: _Fit, data: Array) -> float:
    """Derivative of the exponent of data (1, n) with respect to t_f [1/s]."""
    step = 1e-3 * (fit.t_f - fit.time[-1])
    up, down = (replace(fit, t_f=fit.t_f + d).linear(data)[0][1, 0] for d in (step, -step))
    return float((up - down) / (2 * step))


def count_nutation(psi: Array, theta: Array, theta_sigma: Array, disc: Disc) -> NutationCount:
    """Maxima of theta counted against turns of precession (paper's figure 7), with the slope of a straight line.

    Maxima have a prominence of more than 6 sigma. The sigma of the slope is from the scatter about the line.
    """
    known = np.flatnonzero(np.isfinite(theta) & np.isfinite(psi))
    if known.size < 8:
        return NutationCount(np.zeros(0), np.zeros(0), NAN, NAN, (NAN, NAN))
    height = theta[known]
    peaks = find_peaks(height, prominence=6 * float(np.median(theta_sigma[known])))[0]
    turns = (psi[known] - psi[known[0]]) / (2 * np.pi)
    at = np.array([_parabola_top(turns[i - 1 : i + 2], height[i - 1 : i + 2]) for i in peaks])
    count = np.arange(len(at), dtype=float)
    expected = nutation_ratio(height[0], disc), nutation_ratio(height[-1], disc)
    slope, sigma = NAN, NAN
    if len(at) >= 4:
        (slope, _), covariance = np.polyfit(at, count, 1, cov=True)
        sigma = np.sqrt(covariance[0, 0])
    return NutationCount(at, count, float(slope), float(sigma), expected)


def _parabola_top(x: Array, y: Array) -> float:
    """Abscissa of the top of the parabola through three points."""
    a, b, _ = np.polyfit(x - x[1], y, 2)
    return float(x[1] - b / (2 * a)) if a < 0 else float(x[1])


def nutation_ratio(theta: float, disc: Disc) -> float:
    """Frequency of small nutations over that of the precession, about steady precession with the centre at rest.

    sqrt(3/5) for a thin disc at small theta, eq. (2.15); independent of gravity. NaN if there is no such precession.
    """
    try:
        return nutation_frequency(theta, disc) / precession_rate(theta, disc)[0]
    except ModelError:
        return NAN
