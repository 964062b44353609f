"""From a trajectory file to the physics: motion, contact, energy and scaling laws, into the file and into a report."""

from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from calibration.kit.brief import Brief
from calibration.kit.threads import one_blas_thread
from disctrack.analyse.analysis import CIRCLE_DURATION, WINDOWS, Analysis, Scaling, analyse
from disctrack.analyse.derivatives import GROUP_NAMES, STATE
from disctrack.analyse.power_laws import WINDOW
from disctrack.analyse.propagation import DerivedSeries, shared_sigma
from disctrack.analyse.report import report_of
from disctrack.arguments import Seconds, checked
from disctrack.errors import AnalysisError
from disctrack.files.inputs import keep
from disctrack.files.labelled_arrays import Variable
from disctrack.findings import doubts
from disctrack.frames import euler_jacobian
from disctrack.report.blocks import Report
from disctrack.report.html import write_page
from disctrack.trajectory.file import Group, read_provenance, read_setup, read_trajectory, trajectory_in, write_groups
from disctrack.trajectory.reuse import refuse_other


@dataclass(frozen=True, repr=False)
class AnalyseOutcome(Brief):
    """What `run_analyse` did."""

    analysis: Analysis
    file: Path  # the trajectory, with the new groups
    report: Path  # report.html
    figures: tuple[Path, ...]
    summary: Report

    def facts(self) -> dict[str, str]:
        """What a glance should tell (`Brief`)."""
        return {**self.analysis.facts(), "report": str(self.report)}


@one_blas_thread
@checked
def run_analyse(
    path: str | Path,
    output: str | Path | None = None,
    window: Seconds = WINDOW,
    circle_duration: Seconds = CIRCLE_DURATION,
    overwrite: bool = False,
    figures: bool = False,
) -> AnalyseOutcome:
    """Analyse the trajectory file, add the groups to it, write report.html.

    output : folder for the report; without it, `<name>_analysis` beside the file
    figures : also write every figure of the report as PNG and PDF
    Raises TrajectoryFileError, AnalysisError, OutputError (also when there is a report and not `overwrite`).
    """
    from disctrack.analyse.figures import all_figures  # matplotlib is wanted here only

    path = trajectory_in(Path(path))
    keep(path)
    folder = Path(output) if output is not None else path.parent / f"{path.stem}_analysis"
    refuse_other(folder / "report.html", overwrite)
    trajectory, provenance = read_trajectory(path), read_provenance(path)
    try:
        analysis = analyse(trajectory, window, circle_duration)
    except AnalysisError as error:
        raise AnalysisError(f"{path}: {error}") from error
    write_analysis(path, analysis)
    page = folder / "report.html"
    summary = report_of(analysis, provenance, doubts(trajectory.findings), all_figures(analysis), (page, path))
    written = write_page(page, summary, ("png", "pdf") if figures else ())
    return AnalyseOutcome(analysis, path, page, tuple(written), summary)


def write_analysis(path: Path, analysis: Analysis) -> None:
    """Add the groups motion, contact, energy and scaling to the trajectory file, replacing older ones.

    Frames outside the part that was tracked are NaN.
    """
    file_time = read_setup(path).time
    first = int(np.searchsorted(file_time, analysis.motion.time[0] - 1e-9))

    def whole(variables: dict[str, Variable]) -> dict[str, Variable]:
        return {name: _at_full_length(item, len(file_time), first) for name, item in variables.items()}

    onset, circle, energy = analysis.contact.onset, analysis.contact.circle, analysis.energy
    groups = {
        "motion": Group(whole(_motion_variables(analysis)), _motion_attributes(analysis)),
        "contact": Group(
            whole(_series_variables(analysis.contact.series)),
            {
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
        ),
        "energy": Group(
            whole(_series_variables(energy.series)),
            {
                "loss_J": energy.loss,
                "loss_sigma_J": energy.loss_sigma,
                "loss_sigma_calibration_J": energy.loss_sigma_calibration,
                "precession_level_over_4g_r": energy.level_ratio,
                "precession_level_over_4g_r_sigma": energy.level_ratio_sigma,
                "precession_level_over_4g_r_steady": energy.level_ratio_steady,
            },
        ),
        "scaling": _scaling_group(analysis.scaling),
    }
    axis = Variable(WINDOWS, ("scaling_window",), "s", "longest time before t_f in the fit")
    write_groups(path, groups, axes={**_state_axes(), "scaling_window": axis})


def _at_full_length(item: Variable, n: int, first: int) -> Variable:
    """A variable of frames first.. as one of all n frames of the file."""
    data = np.asarray(item.data)
    if item.dims[0] != "time" or len(data) == n:
        return item
    out = np.full((n, *data.shape[1:]), np.nan if data.dtype.kind == "f" else 0, data.dtype)
    out[first : first + len(data)] = data
    return replace(item, data=out)


def _series_variables(series: tuple[DerivedSeries, ...]) -> dict[str, Variable]:
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
    common = shared_sigma(motion, np.broadcast_to(np.eye(len(STATE)), motion.covariance.shape))
    for name, values, unit, text, first in vectors:
        for i, axis in enumerate("xyz"):
            item = DerivedSeries(
                f"{name}_{axis}", unit, f"{text}, {axis}", values[:, i], sigma[:, first + i], common[:, first + i]
            )
            variables |= _series_variables((item,))
    J = euler_jacobian(motion.euler[:, 0], motion.euler[:, 1])
    angle_variance = np.einsum("nij,njk,nik->ni", J, motion.covariance[:, 3:6, 3:6], J)
    by_state = np.zeros((len(motion), 3, len(STATE)))
    by_state[:, :, 3:6] = J
    shared = shared_sigma(motion, by_state)
    for i, name in enumerate(("psi", "theta", "phi")):
        noise = np.sqrt(np.maximum(angle_variance[:, i], 0.0))
        item = DerivedSeries(name, "rad", f"smoothed {name}, unwrapped", motion.euler[:, i], noise, shared[:, i])
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


def _scaling_group(scaling: Scaling) -> Group:
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
    return Group(variables, attributes)
