"""From a trajectory file to the physics: adds motion, contact, energy and scaling laws, and writes a report."""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import get_type_hints

import numpy as np

from calibration.kit.brief import Brief
from calibration.kit.threads import one_blas_thread
from calibration.kit.types import Seconds, checked
from disctrack.analyse.analysis import CIRCLE_DURATION, WINDOWS, Analysis, analyse
from disctrack.analyse.derivatives import CHANNELS, N_STATE, STATE, MeasuredMotion
from disctrack.analyse.power_laws import WINDOW
from disctrack.analyse.quantities import QUANTITIES, DerivedSeries, Propagated
from disctrack.analyse.report import report_of
from disctrack.errors import AnalysisError, told_as
from disctrack.files.labelled_arrays import Variable
from disctrack.files.whole import keep, refuse_existing
from disctrack.frames import euler_jacobian
from disctrack.report.blocks import Report
from disctrack.report.html import write_page
from disctrack.trajectory import among
from disctrack.trajectory.file import Group, read_group, read_provenance, read_trajectory, trajectory_in, write_groups
from disctrack.trajectory.reuse import origin_of, remember


@dataclass(frozen=True, repr=False)
class AnalyseOutcome(Brief):
    """Results of `run_analyse`."""

    analysis: Analysis
    file: Path  # the trajectory, with the new groups
    report: Path  # report.html
    figures: tuple[Path, ...]
    summary: Report

    def facts(self) -> dict[str, str]:
        """Short summary (`Brief`)."""
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

    output : folder for the report; by default `<name>_analysis` next to the file
    figures : also write every figure of the report as PNG and PDF
    Raises TrajectoryFileError, AnalysisError, OutputError (also if a report exists and not `overwrite`).

        >>> outcome = run_analyse("clip/results/trajectory.h5", overwrite=True)
        >>> outcome.report.name
        'report.html'
    """
    from disctrack.analyse.figures import all_figures  # matplotlib is needed here only

    path = trajectory_in(Path(path))
    keep(path)
    folder = Path(output) if output is not None else path.parent / f"{path.stem}_analysis"
    refuse_existing(folder / "report.html", overwrite)
    trajectory, provenance = read_trajectory(path), read_provenance(path)
    with told_as(AnalysisError, str(path), AnalysisError):
        analysis = analyse(trajectory, window, circle_duration)
    write_analysis(path, analysis)
    page = folder / "report.html"
    summary = report_of(analysis, provenance, all_figures(analysis), page, path)
    written = write_page(page, summary, ("png", "pdf") if figures else ())
    remember(folder, origin_of(path, {"window": window, "circle": circle_duration}), summary, (page, *written))
    return AnalyseOutcome(analysis, path, page, tuple(written), summary)


def write_analysis(path: Path, analysis: Analysis) -> None:
    """Add the groups motion, contact, energy and scaling to the trajectory file, replacing older ones.

    Frames outside the tracked part are NaN.
    """
    file_time = read_group(path, "/", ("time",))[0]["time"]
    n, first = len(file_time), int(np.searchsorted(file_time, analysis.motion.time[0] - 1e-9))
    attributes: dict[str, dict[str, object]] = {
        "motion": {
            "method": "Gaussian-process regression in moving windows, squared-exponential covariance on a straight "
            "line; length and amplitude by restricted maximum likelihood",
            "groups": ", ".join(CHANNELS),
            "median_length_s": np.median(analysis.motion.length, axis=0),
            "noise_scale": analysis.motion.noise_scale,
            "warnings": "\n".join(finding.text for finding in analysis.findings),
        },
        "contact": _attributes(analysis.onset) | _attributes(analysis.circle),
        "energy": _attributes(analysis.energy),
    }
    groups: dict[str, Group] = {}
    for group, rows in QUANTITIES.items():
        variables = _series_variables([analysis.series(name) for name, *_ in rows])
        if group == "motion":
            variables |= _motion_variables(analysis.motion)
        whole = {name: replace(s, data=among(n, first, np.asarray(s.data))) for name, s in variables.items()}
        groups[group] = whole, attributes[group]
    groups["scaling"] = _scaling_group(analysis)
    axes = {"scaling_window": Variable(WINDOWS, ("scaling_window",), "s", "longest time before t_f in the fit")}
    what = "position, rotation vector, velocity, angular velocity, acceleration, angular acceleration; world axes"
    axes |= {name: Variable(np.array(STATE), (name,), "1", what) for name in ("state", "state_2")}
    write_groups(path, groups, axes=axes)


def _attributes(result: object) -> dict[str, object]:
    """Fields of a result that are annotated with their name in the file, by that name."""
    hints = get_type_hints(type(result), include_extras=True).items()
    return {hint.__metadata__[0]: getattr(result, name) for name, hint in hints if hasattr(hint, "__metadata__")}


def _series_variables(series: Sequence[DerivedSeries]) -> dict[str, Variable]:
    kinds = (
        ("value", "", ""),
        ("sigma", "_sigma", "standard deviation, noise of the poses: "),
        ("sigma_calibration", "_sigma_calibration", "standard deviation, calibration: "),
    )
    return {
        s.name + ending: Variable(getattr(s, kind), ("time",), s.unit, what + s.long_name)
        for s in series
        for kind, ending, what in kinds
    }


def _motion_variables(motion: MeasuredMotion) -> dict[str, Variable]:
    vectors = (
        ("position", motion.position, "m", "smoothed position of the centre"),
        ("velocity", motion.velocity, "m s-1", "velocity of the centre"),
        ("omega", motion.omega_world, "rad s-1", "angular velocity, world axes"),
        ("acceleration", motion.acceleration, "m s-2", "acceleration of the centre"),
        ("alpha", motion.alpha_world, "rad s-2", "angular acceleration, world axes"),
    )
    names = [(f"{name}_{axis}", unit, f"{text}, {axis}") for name, _, unit, text in vectors for axis in "xyz"]
    names += [(name, "rad", f"smoothed {name}, unwrapped") for name in ("psi", "theta", "phi")]
    values = np.column_stack([*(values for _, values, *_ in vectors), motion.euler])
    jacobian = np.zeros((len(motion), len(names), N_STATE))
    jacobian[:, range(15), [0, 1, 2, *range(6, 18)]] = 1.0
    jacobian[:, 15:, 3:6] = euler_jacobian(motion.euler[:, 0], motion.euler[:, 1])
    what, bridged = "covariance, noise of the poses", (~motion.measured & motion.known).astype(np.uint8)
    return {
        **_series_variables(Propagated(values, jacobian, motion).series(names)),
        "covariance": Variable(motion.covariance, ("time", "state", "state_2"), "products of m, rad, s", what),
        "bridged": Variable(bridged, ("time",), "1", "1 where the frame has no pose of its own"),
    }


def _scaling_group(analysis: Analysis) -> Group:
    laws, fits = analysis.laws, analysis.laws_by_window
    attributes = _attributes(laws) | _attributes(analysis.nutation_count)
    axes, t_f, t_f_sigma = ("scaling_window",), [fit.t_f for fit in fits], [fit.t_f_sigma for fit in fits]
    variables = {
        "t_f": Variable(t_f, axes, "s", "instant of collapse fitted in the window"),
        "t_f_sigma": Variable(t_f_sigma, axes, "s", "standard deviation of t_f"),
    }
    for name, text in (("n_theta", "nutation"), ("n_psidot", "precession rate"), ("n_energy", "energy")):
        exponent = getattr(laws, name)
        attributes |= {name: exponent.value, f"{name}_sigma": exponent.sigma}
        attributes[f"{name}_confidence_95"] = np.array([exponent.low, exponent.high])
        for part in ("value", "sigma", "low", "high"):
            values = [getattr(getattr(fit, name), part) for fit in fits]
            key = name if part == "value" else f"{name}_{part}"
            variables[key] = Variable(values, axes, "1", f"exponent of the {text} in t_f - t, {part}")
    return variables, attributes
