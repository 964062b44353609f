"""What is missing in the published exponents of Ma et al. (2014)? A diagnosis of tables 2 and 3.

    python -m disctrack.examples.published_exponents [-o DIR]

The tables give the exponents of nutation, precession rate and energy in t_f - t for nine trials on steel and eight on
glass. On glass they contradict the paper's 2/3 and -1/3. The diagnosis fits the paper's model to all of them, tries
the effects of the catalogue and errors of the evaluation, and reports which would remove the contradiction, and which
of these are indistinguishable with these tables.

The exponents of the rolling model are obtained as by Ma et al. The motion is simulated from a nutation of some degrees
to collapse. Nutation, precession rate and energy are sampled every millisecond while the time left, t_f - t, is in the
paper's window; the exponents are the slopes of straight lines through their logarithms against ln(t_f - t). The paper
does not remove the nutation oscillation. Its phase differs between trials, so that its effect on the mean of a series
is of second order; it is neglected.

A row is one trial, whitened by the Cholesky factor of its covariance. One more row per surface is the duration of the
last stage: with the paper's k_m, its simulation collapses at the measured instant. If another law acts, this is the
only information in k_m. The t_f of the tables are counted from the impact that starts the disc, and include seconds of
slip; they are not used.
"""

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cache
from pathlib import Path

import numpy as np
from scipy import stats
from scipy.interpolate import CubicSpline

from calibration.kit.types import Array
from disctrack.diagnosis.motion import motion_candidates
from disctrack.disc import MA_2014, Disc
from disctrack.discrepancy.fit import Fit
from disctrack.discrepancy.held_out import TRAIN_FRACTION
from disctrack.discrepancy.search import Diagnosis, Settings, explain
from disctrack.discrepancy.system import Candidate, Quantity, System, Values
from disctrack.examples._command import GRAVITY, Outcome, command, effect, report_of
from disctrack.numbers import measured, score
from disctrack.report.blocks import Listing, Section
from disctrack.rolling import CATALOGUE, EndReason, Model, Motion, simulate, steady_precession

EXPONENTS = ("n_energy", "n_theta", "n_psidot")
THIN_DISC = np.array([2 / 3, 2 / 3, -1 / 3])  # a rolling moment proportional to psidot^2, slow precession
SETTINGS = Settings(noise=1.0, shortlist=12, max_effects=2)  # the trials' own scatter is the noise
DURATION_SIGMA = 0.03  # of ln duration: simulation and measurement of figures 17 and 18 end within 50 ms of 1.5 s
SPIN = "state.omega3"  # at the start of the last stage; each series has its own
SPIN_AT_REST = 0.97  # [rad/s] omega_3 at 8 deg with the centre at rest, h psidot sin(theta) / r
SPIN_SIGMA = 2.0  # [rad/s]: the centre then moves on a circle of 1 mm
# k_m [m s^2], section 5c; and time left [s] where the fits of tables 2 and 3 begin, section 4a
TRIALS = {"steel": (0.381e-7, 0.5), "glass": (0.28e-7, 0.3)}
LAST_STAGE = 1.5  # [s] simulated in section 5c
STEP = 0.1  # of a quantity's scale, for differences: the simulation is smooth to 1e-8
FRAME = 1e-3  # [s] between pairs of the paper's cameras
SHORTEST = float(np.exp(-3))  # [s] time left where the curves of the paper's figures 14 to 16 end
END_SHARE = 1e-3  # of the start nutation, where the simulation ends: 0.05 ms before collapse with the paper's k_m
MAX_DURATION = 8.0  # [s] of a simulation that has not reached the end


@dataclass(frozen=True, eq=False)
class Series:
    """Trials on one surface: disc, model, window of the fit, and results."""

    surface: str
    k_m: float  # [m s^2] of the paper's model
    longest: float  # [s] longest time left in the fit
    start: float  # [rad] nutation at which the simulation begins
    disc: Disc = MA_2014
    exponents: Array = field(default_factory=lambda: np.zeros((0, 3)))  # (n, 3) of energy, nutation and precession rate
    ln_duration: float = np.nan  # of the last stage, from that nutation on


# Errors of the measurement and the evaluation
READING = (
    effect("t_f", "measurement", "the instant called t_f is not that of collapse", "s", 0.01, "bias",
           lower=-0.045, upper=0.045, source="section 4a"),
    effect("cut", "measurement", "the fits end at another time left than the curves of figures 14 to 16", "s", 0.02,
           "shift", lower=-0.04, upper=0.1, source="figures 14 to 16"),
    effect("theta_zero", "measurement", "zero of the nutation (plane of the table)", "rad", np.radians(0.05), "shift",
           source="section 3b: accuracy 0.05 deg"),
    effect("height_zero", "measurement", "zero of the height (plane of the table)", "m", 2e-5, "shift",
           source="section 3b: accuracy 5 um"),
    effect("attitude_noise", "measurement", "noise of the attitude, which central differences turn into bias",
           "rad^2", np.radians(0.05) ** 2, "variance", lower=0.0, source="section 3b"),
    effect("smoothing", "measurement", "moving average over the record, by the square of its span", "s^2", 0.01**2,
           "square", lower=0.0, upper=0.06**2, source="section 3b: 'a differential method'"),
)  # fmt: skip
NO_ERRORS = {q.name: 0.0 for c in READING for q in c.quantities}


class LastStage:
    """The motion of one series from its start nutation to collapse."""

    def __init__(self, series: Series, values: Iterable[tuple[str, float]], omega3: float = 0.0) -> None:
        """Simulate. values : parameters of effects by "effect.parameter"; omega3 [rad/s] at the start."""
        self.series = series
        model = Model(series.disc, GRAVITY).with_values(dict(values))
        state = steady_precession(series.start, series.disc, GRAVITY, omega3=omega3)
        motion = simulate(model, state, MAX_DURATION, rate=1 / FRAME, theta_end=END_SHARE * series.start)
        curves = _observed(motion, series.disc)
        # a strong moment can stop the precession in the last milliseconds, after the window
        n = int(np.argmin(np.append(np.isfinite(curves).all(axis=1), False)))
        ended = motion.end is EndReason.NUTATION and n > 1
        self.duration = motion.end_time if ended else float("nan")  # [s] from the start to collapse
        # ln theta, ln psidot, energy against time
        self.curve = CubicSpline(motion.time[:n], curves[:n], axis=0, extrapolate=False) if ended else None

    def outcomes(self, reading: Mapping[str, float] = NO_ERRORS) -> Array:
        """(4,) Exponents with errors of the evaluation, and ln duration; NaN without a collapse."""
        if self.curve is None:
            return np.full(4, np.nan)
        wrong, disc = {**NO_ERRORS, **reading}, self.series.disc
        # a fixed number of instants, so that the result is a continuous function of all quantities
        n = round((self.series.longest - SHORTEST) / FRAME) + 1
        left = np.linspace(self.series.longest, SHORTEST + wrong["cut.shift"], n)
        time = self.duration + wrong["t_f.bias"] - left
        half = np.sqrt(wrong["smoothing.square"] / 12)  # the mean of two points is correct to third order
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
    m, J1, J3 = disc.mass, disc.moment_diametral, disc.moment_axial
    energy = 0.5 * (m * np.sum(motion.qdot[:, :3] ** 2, axis=1) + motion.state[:, 5:] ** 2 @ [J1, J1, J3])
    energy += m * GRAVITY * (motion.q[:, 2] - disc.half_thickness)
    with np.errstate(invalid="ignore", divide="ignore"):
        return np.column_stack([np.log(motion.q[:, 4]), np.log(motion.qdot[:, 3]), energy])


def exponents_on(surface: str) -> Array:
    """(n, 3) of the trials of table 2 (steel) or 3 (glass), in the order of EXPONENTS."""
    file = Path(__file__).with_name("ma2014_exponents.csv")
    rows = np.genfromtxt(file, delimiter=",", names=True, dtype=None, encoding="utf-8", skip_header=2)
    trials = rows[(rows["surface"] == surface) & (rows["case"] != "average")]  # that is a printed one
    return np.stack([trials[name] for name in EXPONENTS], axis=-1)


def sample_covariance(exponents: Array) -> Array:
    """Covariance (k, k) of one trial, scaled so that its inverse is unbiased (Hartlap, Simon & Schneider 2007).

    With the sample covariance, chi-square of n = 8 trials of three numbers would be too large by a factor of 7/3.
    """
    n, k = exponents.shape
    return np.asarray(np.cov(exponents.T) * (n - 1) / (n - k - 2), float)


def published_series() -> tuple[Series, ...]:
    """Tables 2 and 3, with the duration of the paper's model from the nutation that (5.11) has 1.5 s before the end."""
    found = []
    for surface, (k_m, longest) in TRIALS.items():
        start = (k_m * LAST_STAGE) ** (2 / 3) * 4 * GRAVITY / MA_2014.radius ** (5 / 3)
        series = Series(surface, k_m, longest, float(start), exponents=exponents_on(surface))
        stage = LastStage(series, [("km.k_m", k_m)], SPIN_AT_REST)
        found.append(replace(series, ln_duration=float(np.log(stage.duration))))
    return tuple(found)


def exponent_candidates(surfaces: Sequence[str]) -> tuple[Candidate, ...]:
    """Effects of the catalogue for rolling discs, laws of the contact per surface; errors of the evaluation."""

    def on_each(c: Candidate, suffix: str = "", words: str = "") -> Candidate:
        quantities = tuple(replace(q, name=f"{q.name}@{s}") for q in c.quantities for s in surfaces)
        return replace(c, name=c.name + suffix, title=c.title + words, quantities=quantities)

    def is_shared(c: Candidate) -> bool:
        return all(q.belongs_to and "surface" not in q.belongs_to for q in c.quantities)

    laws = motion_candidates(Model(MA_2014, effects=(CATALOGUE["km"].absent(),)))
    of_motion = [c if is_shared(c) else on_each(c) for c in laws if not c.threshold]
    each = [on_each(c, "_each", ", each surface its own") for c in READING]
    return (*of_motion, *READING, *each)


class ExponentSystem(System):
    """Several series of trials with their model."""

    def __init__(self, series: Sequence[Series]) -> None:
        """Rows: for each series its trials, the first part of which is fitted, then the duration."""
        self.series = tuple(series)
        self.candidates = exponent_candidates([s.surface for s in series])
        self._last_stage = cache(LastStage)
        self.weights = np.concatenate([[3.0] * len(s.exponents) + [1.0] for s in series])
        shares = [np.append((np.arange(len(s.exponents)) + 0.5) / len(s.exponents), 0.0) for s in series]
        self.training = np.concatenate(shares) < TRAIN_FRACTION
        self.time = np.arange(len(self.weights), dtype=float)
        self.base = (
            *(Quantity(f"km.k_m@{s.surface}", "m s^2", 1e-3 * s.k_m, s.k_m, 0.0, typical=s.k_m) for s in series),
            *(Quantity(f"{SPIN}@{s.surface}", "rad/s", 0.01, SPIN_AT_REST, prior_sigma=SPIN_SIGMA) for s in series),
        )

    def linearise(self, values: Values, names: Sequence[str]) -> tuple[Array, Array]:
        """Whitened residual (n, 3) and derivative (n, 3, k) by central differences, one-sided at bounds."""
        known = {q.name: q for q in (*self.base, *(q for c in self.candidates for q in c.quantities))}
        residual = self._residual(values)
        derivative = np.zeros((*residual.shape, len(names)))
        for k, name in enumerate(names):
            q, value = known[name], values.get(name, 0.0)
            # central differences away from bounds: with large residuals their gradient decides about convergence
            up, down = min(value + STEP * q.scale, q.upper), max(value - STEP * q.scale, q.lower)
            change = self._residual({**values, name: down}) - self._residual({**values, name: up})
            derivative[..., k] = change / (up - down)
        return residual, derivative

    def _residual(self, values: Values) -> Array:
        """(n, 3) observed minus predicted, whitened."""
        rows = []
        for i, s in enumerate(self.series):
            *exponents, ln_duration = self.outcomes(i, values)
            root = np.linalg.cholesky(sample_covariance(s.exponents))
            rows += [*np.linalg.solve(root, (s.exponents - exponents).T).T]
            rows += [np.array([(s.ln_duration - ln_duration) / DURATION_SIGMA, 0.0, 0.0])]
        return np.array(rows)

    def outcomes(self, index: int, values: Values) -> Array:
        """(4,) predicted means of one series: EXPONENTS, ln duration.

        Base quantities that are not among the values are at their null. Values of one quantity with and without the
        surface in their names are added.
        """
        series, own = self.series[index], dict[str, float]()
        for name, value in ({q.name: q.null for q in self.base} | dict(values)).items():
            plain, _, surface = name.partition("@")
            if surface in ("", series.surface):
                own[plain] = own.get(plain, 0.0) + value
        spin = own.pop(SPIN)
        reading = {name: own.pop(name) for name in NO_ERRORS if name in own}
        laws = {name: value for name, value in own.items() if value or name == "km.k_m"}
        return self._last_stage(series, tuple(sorted(laws.items())), spin).outcomes(reading)


def sigmas_off(exponents: Array, predicted: Array) -> float:
    """Deviation of the mean of trials (n, k) from a prediction (k,) without error, by Hotelling's T-squared.

    In sigmas of a normal variable with the same probability.
    """
    n, k = exponents.shape
    difference = exponents.mean(axis=0) - predicted
    t_squared = n * difference @ np.linalg.solve(np.cov(exponents.T), difference)
    p = stats.f.sf(t_squared * (n - k) / (k * (n - 1)), k, n - k)
    return float(stats.norm.isf(p / 2))


def left_by(system: ExponentSystem, fit: Fit) -> list[float]:
    """Deviation of the trials on each surface from the prediction of a fit, in sigmas."""
    return [sigmas_off(s.exponents, system.outcomes(i, fit.values)[:3]) for i, s in enumerate(system.series)]


def in_question(d: Diagnosis) -> dict[str, Fit]:
    """Fits to all trials of the effect found and its indistinguishable alternatives, by name."""
    alternatives = {r.candidate.name: r.fit for f in d.found for r in f.cannot_be_told_from}
    return {f.candidate.name: d.after for f in d.found} | alternatives


def sentence(system: ExponentSystem, d: Diagnosis) -> str:
    """The answer in plain words."""
    fits = in_question(d)
    if not fits:
        return f"Nothing is claimed: {d.reason}."
    gains = [d.before.cost - f.cost for f in fits.values()]
    before, surface = max((sigmas_off(s.exponents, THIN_DISC), s.surface) for s in system.series)
    after = max(max(left_by(system, f)) for f in fits.values())
    text = (
        f"The trials on {surface} lie {before:.1f} sigma from 2/3, 2/3, -1/3; each alone of {', '.join(fits)} brings "
        f"every surface within {after:.1f} sigma, and chi-square down by {min(gains):.0f} to {max(gains):.0f}"
    )
    return text + (": not identifiable from these tables." if len(gains) > 1 else ".")


def refitted(system: ExponentSystem, d: Diagnosis) -> Section:
    """Deviations of the trials' means from the predictions of a thin disc, and of each effect in question."""
    thin = [sigmas_off(s.exponents, THIN_DISC) for s in system.series]
    off = [("thin disc", "", *(f"{x:.1f}" for x in thin), "")]
    for name, f in in_question(d).items():
        own = [q for q in f.quantities if q not in d.before.quantities]
        sizes = ", ".join(f"{q.name} = {measured(f.values[q.name], f.sigma(q.name), q.unit)}" for q in own)
        off.append((name, score(d.before.cost - f.cost), *(f"{x:.1f}" for x in left_by(system, f)), sizes))
    surfaces = (f"sigmas of {s.surface}" for s in system.series)
    return Section("Refitted", [Listing(("effect", "chi-square falls by", *surfaces, "size"), off)])


def example() -> Outcome:
    """Diagnose the published exponents of Ma et al. (2014)."""
    system = ExponentSystem(published_series())
    d = explain(system, {}, SETTINGS, system.training)
    model = "rolling disc with k_m, straight lines through the logarithms in the paper's windows"
    report = report_of(d, model, sentence(system, d), [refitted(system, d)])
    source = "Ma, Liu, Zhao and Zhang 2014, Proc. R. Soc. A 470:20140191, tables 2 and 3"
    return replace(report, data={**report.data, "source": source, "cannot_be_told_apart": list(in_question(d))}), {}


if __name__ == "__main__":
    command(example)
