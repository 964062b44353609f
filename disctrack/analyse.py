"""From a trajectory file to the physics: motion, contact, energy and scaling laws, into the file and into a report."""

from __future__ import annotations

from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from disctrack.contact import Contact, analyse_contact
from disctrack.derivatives import GROUP_NAMES, STATE, Motion, differentiate
from disctrack.energy import Energy, analyse_energy
from disctrack.errors import AnalysisError, OutputError
from disctrack.frames import euler_jacobian
from disctrack.labelled import Variable
from disctrack.propagation import RATES, Series, common_sigma, propagate, rates
from disctrack.scaling import (
    WINDOW,
    Exponent,
    NutationCount,
    PowerLaws,
    count_nutation,
    exponents_by_window,
    fit_power_laws,
    power_law_end,
)
from disctrack.storage import read_provenance, read_setup, read_trajectory, write_group
from disctrack.trajectory import Trajectory

Array = NDArray[np.float64]

WINDOWS = np.array([0.2, 0.3, 0.4, 0.5, 0.75, 1.0, 1.5, 2.0, 3.0])  # [s] before t_f, for the exponents' dependence
CIRCLE_DURATION = 0.6  # [s], as for the paper's figure 9
HEIGHT_TOLERANCE = 2e-6  # [m] by which a table may depart from the board's plane without a remark
EXPECTED_NOISE_SCALE = (0.7, 1.5)  # found over stated variance of the poses: outside, the report says so


@dataclass(frozen=True)
class Scaling:
    """Scaling laws of the last stage."""

    laws: PowerLaws
    by_window: tuple[PowerLaws, ...]  # one per entry of WINDOWS
    count: NutationCount


@dataclass(frozen=True)
class Analysis:
    """Everything that the analysis of one trajectory gives."""

    trajectory: Trajectory
    motion: Motion
    rates: tuple[Series, ...]
    contact: Contact
    energy: Energy
    scaling: Scaling
    warnings: tuple[str, ...]

    def series(self, name: str) -> Series:
        """The derived quantity of this name."""
        for item in (*self.rates, *self.contact.series, *self.energy.series):
            if item.name == name:
                return item
        raise KeyError(name)


@dataclass(frozen=True)
class AnalyseOutcome:
    """What `run_analyse` did."""

    analysis: Analysis
    file: Path  # the trajectory, with the new groups
    report: Path  # report.html
    figures: tuple[Path, ...]

    def lines(self) -> list[str]:
        """What was found, for the command line."""
        analysis = self.analysis
        motion, energy, laws, count = analysis.motion, analysis.energy, analysis.scaling.laws, analysis.scaling.count
        sigma = np.sqrt(np.diagonal(motion.covariance, axis1=1, axis2=2))
        found = [
            f"motion        {int(motion.known.sum())} of {len(motion)} frames; sigma of the velocity "
            f"{1e3 * np.nanmedian(sigma[:, 6:9]):.3f} mm/s, of the angular velocity "
            f"{1e3 * np.nanmedian(sigma[:, 9:12]):.2f} mrad/s (median)",
            f"contact       {analysis.contact.onset.verdict}",
            f"energy        {1e3 * energy.loss:.4f} mJ lost, sigma {1e3 * energy.loss_sigma:.4f} (noise) "
            f"{1e3 * energy.loss_sigma_calibration:.4f} (calibration)",
        ]
        if laws.determined:
            found.append(
                f"exponents     theta {_in_words(laws.n_theta)}  psidot {_in_words(laws.n_psidot)}  energy "
                f"{_in_words(laws.n_energy)}  t_f {laws.t_f:.5f} +- {laws.t_f_sigma:.5f} s"
            )
        if np.isfinite(count.slope):
            found.append(f"nutation      {count.slope:.4f} +- {count.sigma:.4f} oscillations per turn of precession")
        found += [f"note          {text}" for text in analysis.warnings]
        return [*found, f"files         {self.file}", f"              {self.report}"]


def analyse(trajectory: Trajectory, window: float = WINDOW, circle_duration: float = CIRCLE_DURATION) -> Analysis:
    """Motion, contact, energy and scaling laws of a trajectory.

    window, circle_duration : [s] before t_f for the exponents, before the end for the circle
    Of a trajectory of which only a part was tracked, that part is analysed; the result has its length.
    Raises AnalysisError when the trajectory has no table frame, or too few poses.
    """
    if not trajectory.rig.world_is_table:
        raise AnalysisError(
            "the trajectory is in the axes of the left camera, not of the table, so that neither heights nor the "
            "vertical are known. Name the view whose board lies on the table ([table] in recording.toml), calibrate "
            "and track again."
        )
    trajectory = _tracked_part(trajectory)
    motion = differentiate(trajectory)
    until, sense = _end_of_rolling(motion)
    contact = analyse_contact(motion, circle_duration, until)
    if contact.onset.low > motion.time[motion.known][0]:  # the acceleration jumps where slip ends
        onset = contact.onset
        del motion, contact  # the new ones need not stand beside them
        motion = differentiate(trajectory, breaks=(onset.time,))
        contact = replace(analyse_contact(motion, circle_duration, until), onset=onset)
    found = propagate(motion, rates)
    energy = analyse_energy(motion)
    theta_sigma = np.sqrt(np.trace(motion.covariance[:, 3:6, 3:6], axis1=1, axis2=2) / 3)
    psi, psidot = sense * motion.euler[:, 0], sense * found.value[:, 0]
    data = (motion.time, psi, motion.euler[:, 1], psidot, energy.propagated.value[:, 5])
    scaling = Scaling(
        laws=fit_power_laws(*data, window=window),
        by_window=exponents_by_window(*data, WINDOWS),
        count=count_nutation(psi, motion.euler[:, 1], theta_sigma, motion.disc, motion.gravity),
    )
    return Analysis(
        trajectory=trajectory,
        motion=motion,
        rates=found.series(RATES),
        contact=contact,
        energy=energy,
        scaling=scaling,
        warnings=_warnings(trajectory, motion, contact, scaling),
    )


def _tracked_part(trajectory: Trajectory) -> Trajectory:
    """The frames from the first to the last in which a pose was looked for."""
    n, rows = len(trajectory), np.flatnonzero(trajectory.looked_for)
    if rows.size in (0, n):
        return trajectory
    part = slice(int(rows[0]), int(rows[-1]) + 1)
    per_frame: dict[str, Any] = {
        name: value[part] for name, value in vars(trajectory).items() if isinstance(value, np.ndarray)
    }
    return replace(trajectory, **per_frame)


def _end_of_rolling(motion: Motion) -> tuple[float, float]:
    """Instant [s] at which the precession is stopped (or the recording ends), and the sense of the precession."""
    psidot = propagate(motion, rates).value[:, 0]
    known = np.isfinite(psidot)
    if not known.any():
        return np.inf, 1.0
    sense = float(np.sign(np.sum(psidot[known]))) or 1.0
    return power_law_end(motion.time, sense * motion.euler[:, 0], sense * psidot), sense


def run_analyse(
    path: Path,
    output: Path | None = None,
    window: float = WINDOW,
    circle_duration: float = CIRCLE_DURATION,
    overwrite: bool = False,
) -> AnalyseOutcome:
    """Analyse the trajectory file, add the groups to it, write report.html and the figures.

    output : folder for the report; without it, `<name>_analysis` beside the file
    Raises TrajectoryFileError, AnalysisError, OutputError (also when there is a report and not `overwrite`).
    """
    from disctrack.report import write_report  # matplotlib is wanted here only

    path = Path(path)
    folder = Path(output) if output is not None else path.with_name(f"{path.stem}_analysis")
    if (folder / "report.html").exists() and not overwrite:
        raise OutputError(
            f"{folder / 'report.html'}: exists. Choose another folder with -o, or replace with --overwrite."
        )
    trajectory, provenance = read_trajectory(path), read_provenance(path)
    try:
        analysis = analyse(trajectory, window, circle_duration)
    except AnalysisError as error:
        raise AnalysisError(f"{path}: {error}") from error
    write_analysis(path, analysis)
    report, figures = write_report(folder, analysis, provenance)
    return AnalyseOutcome(analysis, path, report, figures)


def _in_words(exponent: Exponent) -> str:
    return f"{exponent.value:.4f} +- {exponent.sigma:.4f}"


def write_analysis(path: Path, analysis: Analysis) -> None:
    """Add the groups motion, contact, energy and scaling to the trajectory file, replacing older ones.

    Frames outside the part that was tracked are NaN.
    """
    file_time = read_setup(path).time
    first = int(np.searchsorted(file_time, analysis.motion.time[0] - 1e-9))

    def whole(variables: dict[str, Variable]) -> dict[str, Variable]:
        return {name: _at_full_length(item, len(file_time), first) for name, item in variables.items()}

    motion = whole(_motion_variables(analysis))
    write_group(path, "motion", motion, axes=_state_axes(), attributes=_motion_attributes(analysis))
    onset, circle = analysis.contact.onset, analysis.contact.circle
    write_group(
        path,
        "contact",
        whole(_series_variables(analysis.contact.series)),
        attributes={
            "rolling_onset_s": onset.time,
            "rolling_onset_low_s": onset.low,
            "rolling_onset_high_s": onset.high,
            "rolling_probability": onset.probability,
            "rolling_verdict": onset.verdict,
            "slip_distance_m": onset.slip_distance,
            "slip_distance_sigma_m": onset.slip_distance_sigma,
            "locus_circle_radius_m": circle.radius,
            "locus_circle_radius_sigma_m": circle.sigma,
            "locus_circle_radius_sigma_calibration_m": circle.sigma_calibration,
            "locus_circle_expected_radius_m": circle.expected,
            "locus_circle_centre_m": circle.centre,
            "locus_circle_interval_s": np.array([circle.start, circle.end]),
        },
    )
    energy = analysis.energy
    write_group(
        path,
        "energy",
        whole(_series_variables(energy.series)),
        attributes={
            "loss_J": energy.loss,
            "loss_sigma_J": energy.loss_sigma,
            "loss_sigma_calibration_J": energy.loss_sigma_calibration,
            "precession_level_over_4g_r": energy.level_ratio,
            "precession_level_over_4g_r_sigma": energy.level_ratio_sigma,
            "precession_level_over_4g_r_steady": energy.level_ratio_steady,
        },
    )
    _write_scaling(path, analysis.scaling)


def _at_full_length(item: Variable, n: int, first: int) -> Variable:
    """A variable of frames first.. as one of all n frames of the file."""
    data = np.asarray(item.data)
    if item.dims[0] != "time" or len(data) == n:
        return item
    out = np.full((n, *data.shape[1:]), np.nan if data.dtype.kind == "f" else 0, data.dtype)
    out[first : first + len(data)] = data
    return replace(item, data=out)


def _series_variables(series: tuple[Series, ...]) -> dict[str, Variable]:
    variables = {}
    for s in series:
        variables[s.name] = Variable(s.value, ("time",), s.unit, s.long_name)
        variables[f"{s.name}_sigma"] = Variable(
            s.sigma, ("time",), s.unit, f"standard deviation, noise of the poses: {s.long_name}"
        )
        variables[f"{s.name}_sigma_calibration"] = Variable(
            s.sigma_calibration, ("time",), s.unit, f"standard deviation, calibration: {s.long_name}"
        )
    return variables


def _state_axes() -> dict[str, Variable]:
    what = "position, rotation vector, velocity, angular velocity, acceleration, angular acceleration; world axes"
    return {name: Variable(np.array(STATE), (name,), "1", what) for name in ("state", "state_2")}


def _motion_variables(analysis: Analysis) -> dict[str, Variable]:
    motion = analysis.motion
    variables = _series_variables(analysis.rates)
    vectors = (
        ("position", motion.position, "m", "smoothed position of the centre", 0),
        ("velocity", motion.velocity, "m s-1", "velocity of the centre", 6),
        ("omega", motion.omega_world, "rad s-1", "angular velocity, world axes", 9),
        ("acceleration", motion.acceleration, "m s-2", "acceleration of the centre", 12),
        ("alpha", motion.alpha_world, "rad s-2", "angular acceleration, world axes", 15),
    )
    sigma = np.sqrt(np.diagonal(motion.covariance, axis1=1, axis2=2))
    S = motion.calibration_sensitivity
    common = common_sigma(S, motion.rig_covariance)
    for name, values, unit, text, first in vectors:
        for i, axis in enumerate("xyz"):
            item = Series(
                f"{name}_{axis}", unit, f"{text}, {axis}", values[:, i], sigma[:, first + i], common[:, first + i]
            )
            variables |= _series_variables((item,))
    J = euler_jacobian(motion.euler[:, 0], motion.euler[:, 1])
    angle_variance = np.einsum("nij,njk,nik->ni", J, motion.covariance[:, 3:6, 3:6], J)
    shared = common_sigma(J @ S[:, 3:6], motion.rig_covariance)
    for i, name in enumerate(("psi", "theta", "phi")):
        noise = np.sqrt(np.maximum(angle_variance[:, i], 0.0))
        item = Series(name, "rad", f"smoothed {name}, unwrapped", motion.euler[:, i], noise, shared[:, i])
        variables |= _series_variables((item,))
    return variables | {
        "covariance": Variable(
            motion.covariance, ("time", "state", "state_2"), "products of m, rad, s", "covariance, noise of the poses"
        ),
        "bridged": Variable(
            (~motion.measured & motion.known).astype(np.uint8),
            ("time",),
            "1",
            "1 where the frame has no pose of its own",
        ),
    }


def _motion_attributes(analysis: Analysis) -> dict[str, object]:
    motion = analysis.motion
    return {
        "method": "Gaussian-process regression in moving windows, squared-exponential covariance on a straight line; "
        "length and amplitude by restricted maximum likelihood",
        "groups": ", ".join(GROUP_NAMES),
        "median_length_s": np.median(motion.length, axis=0),
        "noise_scale": motion.noise_scale,
        "warnings": "\n".join(analysis.warnings),
    }


def _write_scaling(path: Path, scaling: Scaling) -> None:
    fits = scaling.by_window
    dims = ("scaling_window",)
    variables = {}
    for name, text in (("n_theta", "nutation"), ("n_psidot", "precession rate"), ("n_energy", "energy")):
        exponents = [getattr(fit, name) for fit in fits]
        for ending, what in (("value", ""), ("sigma", "_sigma"), ("low", "_low"), ("high", "_high")):
            values = np.array([getattr(e, ending) for e in exponents])
            variables[name + what] = Variable(values, dims, "1", f"exponent of the {text} in t_f - t, {ending}")
    variables["t_f"] = Variable(
        np.array([fit.t_f for fit in fits]), dims, "s", "instant of collapse fitted in the window"
    )
    variables["t_f_sigma"] = Variable(np.array([fit.t_f_sigma for fit in fits]), dims, "s", "standard deviation of t_f")
    laws, count = scaling.laws, scaling.count
    attributes: dict[str, object] = {
        "window_s": np.array(laws.window),
        "t_f_s": laws.t_f,
        "t_f_sigma_s": laws.t_f_sigma,
        "reason_undetermined": laws.reason,
        "nutation_over_precession_counted": count.slope,
        "nutation_over_precession_counted_sigma": count.sigma,
        "nutation_over_precession_expected": np.array(count.expected),
    }
    for name in ("n_theta", "n_psidot", "n_energy"):
        exponent = getattr(laws, name)
        attributes[name] = exponent.value
        attributes[f"{name}_sigma"] = exponent.sigma
        attributes[f"{name}_confidence_95"] = np.array([exponent.low, exponent.high])
    axis = Variable(WINDOWS, ("scaling_window",), "s", "longest time before t_f in the fit")
    write_group(path, "scaling", variables, axes={"scaling_window": axis}, attributes=attributes)


def _warnings(trajectory: Trajectory, motion: Motion, contact: Contact, scaling: Scaling) -> tuple[str, ...]:
    """What an experimenter should know before using the numbers, in plain words."""
    found = []
    asked = trajectory.looked_for
    n, missing, unknown = (int(rows.sum()) for rows in (asked, asked & ~motion.measured, asked & ~motion.known))
    if missing:
        found.append(
            f"{missing} of {n} frames have no pose of their own; {missing - unknown} were bridged from their "
            f"neighbours (their sigmas are larger), {unknown} stay unknown."
        )
    for name, scale in zip(GROUP_NAMES, motion.noise_scale, strict=True):
        if not EXPECTED_NOISE_SCALE[0] <= scale <= EXPECTED_NOISE_SCALE[1]:
            found.append(
                f"The scatter of the {name} is {np.sqrt(scale):.2f} times what the tracker states; the sigmas here "
                "follow the scatter."
            )
    height, common = contact.series[2].value, contact.series[2].sigma_calibration
    offset = float(np.mean(height[np.isfinite(height)])) if np.isfinite(height).any() else 0.0
    allowed = 3 * float(np.nanmax(np.append(common, 0.0))) + HEIGHT_TOLERANCE
    if abs(offset) > allowed:
        found.append(
            f"The lowest point of the edge lies {1e6 * offset:+.1f} um from the table on average, more than the "
            f"calibration explains ({1e6 * allowed:.1f} um): the thickness, the table view or the board's thickness is "
            "off."
        )
    onset = contact.onset
    if not onset.probability >= 0.5:
        found.append(f"The disc {onset.verdict}." if np.isfinite(onset.probability) else f"Rolling: {onset.verdict}.")
    elif onset.low > motion.time[motion.known][0]:
        found.append(
            f"Where slip ends, at {onset.time:.4f} s, the acceleration jumps: the motion before and after was "
            "differentiated apart, so that sigmas are larger near that instant."
        )
    if onset.probability >= 0.5 and onset.n_late_slips:
        found.append(
            f"After the onset of rolling, {onset.n_late_slips} frames still show slip beyond five sigmas: stick and "
            "slip, or impacts."
        )
    if scaling.laws.reason:
        found.append(f"No exponents are given: {scaling.laws.reason}.")
    return tuple(found)
