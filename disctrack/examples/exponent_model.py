"""What an experimenter would read off the rolling model: exponents of the last stage, obtained as Ma et al. (2014) did.

The motion is simulated from a nutation of some degrees down to collapse. Nutation, precession rate and energy are
taken every millisecond while the time left, t_f - t, lies in the paper's window; straight lines through their
logarithms against ln(t_f - t) have the exponents for slopes. The paper does not remove the nutation oscillation. Its
phase differs from trial to trial, so that it enters the mean of a series to second order in its amplitude only: by less
than 0.005 at 30 % of the nutation, by less than 0.002 at 15 %. It is therefore left out unless asked for.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from functools import cached_property

import numpy as np
from scipy.interpolate import CubicSpline
from scipy.optimize import minimize_scalar

from calibration.arrays import Array
from disctrack.disc import MA_2014, Disc
from disctrack.rolling import EndReason, Model, simulate, steady_precession

FRAME = 1e-3  # [s] between pairs of the paper's cameras
SAMPLING = 2e-3  # [s] of the simulation; a cubic spline then follows the last nutations read to 1e-4
SHORTEST = float(np.exp(-3))  # [s] time left where the curves of the paper's figures 14 to 16 end
RTOL = 1e-7  # collapse then comes out to 1e-10 s
END_SHARE = 1e-3  # of the start nutation, where the simulation ends: 0.05 ms before collapse with the paper's k_m
N_PHASES = 8  # of the nutation oscillation, where there is one
MAX_DURATION = 8.0  # [s]; a motion that has not ended by then is no answer
OUTCOMES = ("n_theta", "n_psidot", "n_energy", "ln_duration")


@dataclass(frozen=True)
class Setup:
    """One series of trials: what rolls where, and which part of the record is fitted."""

    surface: str
    k_m: float  # [m s^2] of the paper's model
    longest: float  # [s] longest time left in the fit
    shortest: float = SHORTEST  # [s]
    start: float = np.radians(8.0)  # [rad] nutation at which the simulation begins
    disc: Disc = MA_2014
    gravity: float = 9.81
    share: float = 0.0  # amplitude of the nutation oscillation over the nutation, at the start
    label: str = ""  # distinguishes several series on one surface
    fits_t_f: bool = False  # along with the exponents, rather than taking it from the images
    factors: Mapping[str, float] = field(default_factory=dict)  # on parameters of effects: thinner air, for one

    @property
    def phases(self) -> Array:
        """Phases of the oscillation at the start, evenly spaced; one where there is no oscillation."""
        n = N_PHASES if self.share else 1
        return 2 * np.pi * np.arange(n) / n


@dataclass(frozen=True)
class Reading:
    """What the experimenter does to the motion, and may do wrong; the defaults are right."""

    t_f_bias: float = 0.0  # [s] instant called t_f minus that of collapse
    cut_shift: float = 0.0  # [s] shortest time left minus `Setup.shortest`
    theta_zero: float = 0.0  # [rad] added to every nutation
    height_zero: float = 0.0  # [m] added to every height
    attitude_variance: float = 0.0  # [rad^2] noise of the attitude per axis and frame
    smoothing_square: float = 0.0  # [s^2] square of the span of a moving average over all quantities


class LastStage:
    """Motions of one setup, one for each phase of the nutation oscillation."""

    def __init__(self, setup: Setup, values: Mapping[str, float], omega3: float = 0.0) -> None:
        """Simulate. values : parameters of effects by "effect.parameter"; omega3 [rad/s] at the start."""
        self.setup = setup
        scaled = {name: value * setup.factors.get(name, 1.0) for name, value in values.items()}
        model = Model(setup.disc, setup.gravity).with_values(scaled)
        self.collapse: list[float] = []  # [s] from the start; NaN where a motion does not end by collapse
        self.curves: list[CubicSpline] = []  # ln theta, ln psidot, energy against time
        for phase in setup.phases:
            state = steady_precession(
                setup.start,
                setup.disc,
                setup.gravity,
                omega3=omega3,
                nutation_amplitude=setup.share * setup.start,
                nutation_phase=float(phase),
            )
            motion = simulate(
                model, state, MAX_DURATION, rate=1 / SAMPLING, theta_end=END_SHARE * setup.start, rtol=RTOL
            )
            curves = _observed(motion.q, motion.qdot, setup)
            # a strong moment can stop the precession in the very last milliseconds; what is read lies before
            n = int(np.argmin(np.append(np.isfinite(curves).all(axis=1), False)))
            last = motion.time[:n] > motion.end_time - 1.5 * setup.longest
            long_enough = motion.end_time > setup.longest + SAMPLING and last.sum() > 3
            ended = motion.end is EndReason.NUTATION and long_enough
            self.collapse.append(motion.end_time if ended else np.nan)
            if ended:
                self.curves.append(CubicSpline(motion.time[:n][last], curves[:n][last], axis=0))

    @cached_property
    def duration(self) -> float:
        """Mean time [s] from the start to collapse; NaN where one of the motions does not collapse."""
        return float(np.mean(self.collapse))

    def outcomes(self, reading: Reading | None = None) -> Array:
        """(4,) OUTCOMES, means over the phases; NaN where there is no collapse."""
        return np.asarray(self.by_phase(reading).mean(axis=0), float)

    def by_phase(self, reading: Reading | None = None) -> Array:
        """(n_phases, 4) OUTCOMES of each motion."""
        if not np.isfinite(self.duration):
            return np.full((len(self.collapse), len(OUTCOMES)), np.nan)
        reading = reading or Reading()
        rows = []
        for t_f, curve in zip(self.collapse, self.curves, strict=True):
            if self.setup.fits_t_f:
                reading = replace(reading, t_f_bias=self._fitted_bias(curve, t_f, reading))
            left, theta, psidot, energy = self._read(curve, t_f, reading)
            rows.append([*(slope(left, v) for v in (theta, psidot, energy)), np.log(t_f)])
        return np.array(rows)

    def _fitted_bias(self, curve: CubicSpline, t_f: float, reading: Reading) -> float:
        """Error of t_f [s] when it is chosen so that the logarithms of nutation and precession rate are straight."""

        def bend(bias: float) -> float:
            left, theta, psidot, _ = self._read(curve, t_f, replace(reading, t_f_bias=bias))
            x = np.vander(np.log(left), 2)
            y = np.log(np.stack([theta, psidot], axis=1))
            return float(np.sum((y - x @ np.linalg.lstsq(x, y, rcond=None)[0]) ** 2))

        furthest = 0.9 * self.setup.shortest
        return float(minimize_scalar(bend, bounds=(-furthest, furthest), method="bounded", options={"xatol": 1e-8}).x)

    def _read(self, curve: CubicSpline, t_f: float, reading: Reading) -> tuple[Array, Array, Array, Array]:
        """Time left as the experimenter has it, nutation, precession rate, energy, (n,) each."""
        setup, disc = self.setup, self.setup.disc
        # a fixed number of instants, so that nothing jumps when a quantity of the fit moves
        n = round((setup.longest - setup.shortest) / FRAME) + 1
        left = np.linspace(setup.longest, setup.shortest + reading.cut_shift, n)
        time = t_f + reading.t_f_bias - left
        half = np.sqrt(max(reading.smoothing_square, 0.0) / 12)  # two points stand for the mean to third order
        if time[-1] + half > curve.x[-1] or left[-1] <= 0:
            return (left, *np.full((3, n), np.nan))
        ln_theta, ln_psidot, energy = (0.5 * (curve(time - half) + curve(time + half))).T
        theta, psidot = np.exp(ln_theta) + reading.theta_zero, np.exp(ln_psidot)
        rate_variance = reading.attitude_variance / (2 * FRAME**2)  # of central differences
        psidot = psidot * np.exp(-0.5 * rate_variance / (psidot * np.sin(theta)) ** 2)  # mean of the noisy logarithm
        energy = energy + 0.5 * (2 * disc.moment_diametral + disc.moment_axial) * rate_variance
        energy = energy + disc.mass * setup.gravity * reading.height_zero
        return left, theta, psidot, energy


def slope(left: Array, values: Array) -> float:
    """Slope of ln values (n,) over ln left (n,) by ordinary least squares; NaN for values that have no logarithm."""
    if not (np.isfinite(values).all() and (values > 0).all()):
        return float("nan")
    x = np.log(left)
    x = x - x.mean()
    return float(x @ np.log(values) / (x @ x))


def _observed(q: Array, qdot: Array, setup: Setup) -> Array:
    """(n, 3) ln theta, ln psidot and the energy (2.10) [J] with the declared disc, zero at rest."""
    disc = setup.disc
    theta, (psidot, thetadot, phidot) = q[:, 4], qdot[:, 3:].T
    spin = psidot * np.cos(theta) + phidot
    energy = 0.5 * disc.mass * np.sum(qdot[:, :3] ** 2, axis=1)
    energy += 0.5 * disc.moment_diametral * (thetadot**2 + (psidot * np.sin(theta)) ** 2)
    energy += 0.5 * disc.moment_axial * spin**2 + disc.mass * setup.gravity * (q[:, 2] - disc.half_thickness)
    with np.errstate(invalid="ignore", divide="ignore"):
        return np.column_stack([np.log(theta), np.log(psidot), energy])
