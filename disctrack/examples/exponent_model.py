"""What an experimenter would read off the rolling model: exponents of the last stage, obtained as Ma et al. (2014) did.

The motion is simulated from a nutation of some degrees down to collapse. Nutation, precession rate and energy are
taken every millisecond while the time left, t_f - t, lies in the paper's window; straight lines through their
logarithms against ln(t_f - t) have the exponents for slopes. The paper does not remove the nutation oscillation; its
phase differs from trial to trial, so that it enters the mean of a series to second order only. It is left out.
"""

from collections.abc import Mapping
from dataclasses import dataclass, field

import numpy as np
from scipy.interpolate import CubicSpline

from calibration.kit.arrays import Array
from disctrack.disc import MA_2014, Disc
from disctrack.examples._command import GRAVITY, effect
from disctrack.rolling import EndReason, Model, Motion, simulate, steady_precession

FRAME = 1e-3  # [s] between pairs of the paper's cameras
SAMPLING = 2e-3  # [s] of the simulation; a cubic spline then follows the last nutations read to 1e-4
SHORTEST = float(np.exp(-3))  # [s] time left where the curves of the paper's figures 14 to 16 end
RTOL = 1e-7  # collapse then comes out to 1e-10 s
END_SHARE = 1e-3  # of the start nutation, where the simulation ends: 0.05 ms before collapse with the paper's k_m
MAX_DURATION = 8.0  # [s]; a motion that has not ended by then is no answer


@dataclass(frozen=True)
class Series:
    """Trials on one surface: what rolls where, which part of the record is fitted, and what was found."""

    surface: str
    k_m: float  # [m s^2] of the paper's model
    longest: float  # [s] longest time left in the fit
    start: float  # [rad] nutation at which the simulation begins
    disc: Disc = MA_2014
    exponents: Array = field(default_factory=lambda: np.zeros((0, 3)))  # (n, 3) of energy, nutation and precession rate
    ln_duration: float = np.nan  # of the last stage, from that nutation on


# What the experimenter may do wrong
READING = (
    effect("t_f", "measurement", "the instant called t_f is not that of collapse", "s", 0.01, "bias",
           bounds=(-0.045, 0.045), source="section 4a"),
    effect("cut", "measurement", "the fits end at another time left than the curves of figures 14 to 16", "s", 0.02,
           "shift", bounds=(-0.04, 0.1), source="figures 14 to 16"),
    effect("theta_zero", "measurement", "zero of the nutation (plane of the table)", "rad", np.radians(0.05), "shift",
           source="section 3b: accuracy 0.05 deg"),
    effect("height_zero", "measurement", "zero of the height (plane of the table)", "m", 2e-5, "shift",
           source="section 3b: accuracy 5 um"),
    effect("attitude_noise", "measurement", "noise of the attitude, which central differences turn into bias",
           "rad^2", np.radians(0.05) ** 2, "variance", bounds=(0.0, np.inf), source="section 3b"),
    effect("smoothing", "measurement", "moving average over the record, by the square of its span", "s^2", 0.01**2,
           "square", bounds=(0.0, 0.06**2), source="section 3b: 'a differential method'"),
)  # fmt: skip
NO_ERRORS = {q.name: 0.0 for c in READING for q in c.quantities}


class LastStage:
    """The motion of one series from its start nutation to collapse."""

    def __init__(self, series: Series, values: Mapping[str, float], omega3: float = 0.0) -> None:
        """Simulate. values : parameters of effects by "effect.parameter"; omega3 [rad/s] at the start."""
        self.series = series
        model = Model(series.disc, GRAVITY).with_values(dict(values))
        state = steady_precession(series.start, series.disc, GRAVITY, omega3=omega3)
        motion = simulate(model, state, MAX_DURATION, rate=1 / SAMPLING, theta_end=END_SHARE * series.start, rtol=RTOL)
        curves = _observed(motion, series.disc)
        # a strong moment can stop the precession in the very last milliseconds; what is read lies before
        n = int(np.argmin(np.append(np.isfinite(curves).all(axis=1), False)))
        ended = motion.end is EndReason.NUTATION and n > 1
        self.duration = motion.end_time if ended else float("nan")  # [s] from the start to collapse
        # ln theta, ln psidot, energy against time
        self.curve = CubicSpline(motion.time[:n], curves[:n], axis=0, extrapolate=False) if ended else None

    def outcomes(self, reading: Mapping[str, float] = NO_ERRORS) -> Array:
        """(4,) The exponents and ln duration as the experimenter has them; NaN where no collapse is seen."""
        if self.curve is None:
            return np.full(4, np.nan)
        wrong, disc = {**NO_ERRORS, **reading}, self.series.disc
        # a fixed number of instants, so that nothing jumps when a quantity of the fit moves
        n = round((self.series.longest - SHORTEST) / FRAME) + 1
        left = np.linspace(self.series.longest, SHORTEST + wrong["cut.shift"], n)
        time = self.duration + wrong["t_f.bias"] - left
        half = np.sqrt(wrong["smoothing.square"] / 12)  # two points stand for the mean to third order
        ln_theta, ln_psidot, energy = (0.5 * (self.curve(time - half) + self.curve(time + half))).T
        theta, psidot = np.exp(ln_theta) + wrong["theta_zero.shift"], np.exp(ln_psidot)
        rate_variance = wrong["attitude_noise.variance"] / (2 * FRAME**2)  # of central differences
        psidot = psidot * np.exp(-0.5 * rate_variance / (psidot * np.sin(theta)) ** 2)  # mean of the noisy logarithm
        energy = energy + 0.5 * (2 * disc.moment_diametral + disc.moment_axial) * rate_variance
        energy = energy + disc.mass * GRAVITY * wrong["height_zero.shift"]
        with np.errstate(invalid="ignore", divide="ignore"):
            slopes, _ = np.polyfit(np.log(left), np.log(np.column_stack([energy, theta, psidot])), 1)
        return np.array([*slopes, np.log(self.duration)])


def _observed(motion: Motion, disc: Disc) -> Array:
    """(n, 3) ln theta, ln psidot and the energy (2.10) [J] with the declared disc, zero at rest."""
    thetadot, omega2, omega3 = motion.state[:, 5:].T
    energy = 0.5 * disc.mass * np.sum(motion.qdot[:, :3] ** 2, axis=1)
    energy += 0.5 * disc.moment_diametral * (thetadot**2 + omega2**2) + 0.5 * disc.moment_axial * omega3**2
    energy += disc.mass * GRAVITY * (motion.q[:, 2] - disc.half_thickness)
    with np.errstate(invalid="ignore", divide="ignore"):
        return np.column_stack([np.log(motion.q[:, 4]), np.log(motion.qdot[:, 3]), energy])
