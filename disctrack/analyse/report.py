"""The report of an analysis."""

from collections.abc import Sequence
from pathlib import Path

import numpy as np

from disctrack.analyse.analysis import Analysis
from disctrack.analyse.power_laws import MODEL_EXPONENTS, Exponent, PowerLaws
from disctrack.findings import carried
from disctrack.numbers import Measured, measured, unit_text
from disctrack.report.blocks import Cell, Drawn, Facts, Figures, Listing, Report, Section
from disctrack.trajectory import FrameStatus
from disctrack.trajectory.file import Provenance

# Below, sin and cos of the nutation equal their leading terms to 2e-4, so that the asymptotic exponents hold.
ASYMPTOTIC_BELOW = np.radians(1.0)


def report_of(
    analysis: Analysis, provenance: Provenance, drawn: Sequence[Drawn], page: Path, trajectory_file: Path
) -> Report:
    """All results of an analysis, and the findings of the measurement."""

    def section(title: str, numbers: tuple[str, ...], *blocks: Listing | str) -> Section:
        return Section(title, [*blocks, Figures([d for d in drawn if d.name.startswith(numbers)])])

    trajectory, laws, energy = analysis.trajectory, analysis.laws, analysis.energy
    t_f = Measured(laws.t_f, laws.t_f_sigma)
    lost = Measured(energy.loss, np.hypot(energy.loss_sigma, energy.loss_sigma_calibration), "J")
    return Report(
        f"{provenance.recording}: from the trajectory to the physics",
        f"The disc {analysis.onset.verdict}. {_exponents_text(laws)}",
        _accuracy(analysis),
        [*carried(trajectory.findings), *analysis.findings],
        facts=[
            ("energy lost (± 1 σ)", lost),
            ("collapse t_f (s, ± 1 σ)", t_f if laws.determined else "not in reach"),
            ("exponent of θ (95 %)", _at_95(laws.n_theta)),
        ],
        blocks=[
            Facts([*(trajectory.facts() | trajectory.disc.facts()).items()]),
            Section("Quality of the measurement", [_status_table(analysis)]),
            section("Motion", ("04", "05", "06", "07", "10", "11")),
            section("Contact", ("08", "09")),
            section("Energy", ("12", "13")),
            section("Scaling laws of the last stage", ("14", "15", "16"), *_exponents(analysis)),
            Section("Method", [_method(analysis, provenance)]),
        ],
        files=(page, trajectory_file),
        then=f"disctrack diagnose {trajectory_file}",
        data={"frames": len(trajectory), "frames_with_a_pose": int(trajectory.measured.sum())},
    )


def _exponents_text(laws: PowerLaws) -> str:
    if not laws.determined:
        return f"No exponents: {laws.reason}."
    named = (("θ", laws.n_theta), ("ψ̇", laws.n_psidot), ("energy", laws.n_energy))
    return f"Exponents (95 %): {', '.join(f'{name} {_at_95(exponent)}' for name, exponent in named)}."


def _accuracy(analysis: Analysis) -> str:
    """Accuracy of the velocities, and of the lab frame."""
    sigma = np.sqrt(np.diagonal(analysis.motion.covariance, axis1=1, axis2=2))
    velocity = measured(float(np.nanmedian(sigma[:, 6:9])), unit="m/s")
    turn = measured(float(np.nanmedian(sigma[:, 9:12])), unit="rad/s")
    return f"σ of velocity {velocity} and {turn} (noise, median); of the lab frame {_lab_frame(analysis)}"


def _lab_frame(analysis: Analysis) -> str:
    """Uncertainty of the lab frame from the calibration, for the worst axis."""
    covariance = analysis.trajectory.calibration_covariance[analysis.trajectory.measured]
    sigma = np.sqrt(np.median(np.diagonal(covariance, axis1=1, axis2=2), axis=0))
    if not np.any(sigma > 0):
        return "not known (the rig carries no covariance)"
    turn = 1e3 * float(np.degrees(sigma[3:].max()))
    return f"{measured(float(sigma[:3].max()), unit='m')}, {measured(turn)} mdeg (calibration, worst axis)"


def _status_table(analysis: Analysis) -> Listing:
    status = analysis.trajectory.frame_status
    rows = [(str(int(np.sum(status == state))), state.sentence) for state in FrameStatus if np.any(status == state)]
    return Listing(("frames", "status"), rows, "Frame status.")


def _at_95(exponent: Exponent) -> Cell:
    """The exponent with half of its confidence interval: 4.3 sigmas for two degrees of freedom."""
    if not np.isfinite(exponent.value):
        return "not determined"
    return measured(exponent.value, exponent.half)


def _exponents(analysis: Analysis) -> list[Listing | str]:
    laws = analysis.laws
    if not laws.determined:
        return [f"No exponents are given: {laws.reason}."]
    first, last = laws.window
    to_collapse = laws.t_f - analysis.motion.time
    theta = analysis.motion.euler[analysis.motion.known & (last <= to_collapse) & (to_collapse <= first), 1]
    asymptotic = bool(theta.size and theta.max() <= ASYMPTOTIC_BELOW)
    named = ("energy", laws.n_energy, 1.0), ("nutation", laws.n_theta, 1.0), ("precession rate", laws.n_psidot, -0.5)
    rows = [
        (name, _at_95(e), str(e), *(_agreement(e, k * n, asymptotic) for _, n in MODEL_EXPONENTS))
        for name, e, k in named
    ]
    said = (
        f"Window: from {first:.3f} s to {last:.3f} s before t_f = {measured(laws.t_f, laws.t_f_sigma)} s (1 σ; "
        f"{laws.n_periods:.1f} nutation periods). 5 ms in t_f would move the exponent of θ by "
        f"{5e-3 * laws.n_theta_per_t_f:.3f}. The 95 % intervals are Student's t with few degrees of freedom, and so "
        "wider than two standard deviations. They are for a power law over this window; the dependence on the window "
        "shows deviations from a power law. The exponents of the models hold in the limit of zero nutation; above "
        f"{np.degrees(ASYMPTOTIC_BELOW):.0f} degree the same law has another slope: there only agreement is marked."
    )
    header = ("exponent of", "95 %", "1 σ", *(name.split(",")[0] for name, _ in MODEL_EXPONENTS))
    return [
        said,
        Listing(header, rows, "Exponents in (t_f - t) and the models that they agree with."),
        _windows_table(analysis.laws_by_window),
    ]


def _agreement(exponent: Exponent, model: float, asymptotic: bool) -> str:
    """Exponent of a model and whether the confidence interval contains it; above ASYMPTOTIC_BELOW never "no"."""
    if exponent.agrees_with(model):
        return f"{model:.3f} yes"
    return f"{model:.3f} no" if asymptotic else f"{model:.3f} as θ → 0"


def _windows_table(fits: Sequence[PowerLaws]) -> Listing:
    rows = [
        (
            f"{fit.window[0]:.3f} to {fit.window[1]:.3f}",
            *map(str, (fit.n_energy, fit.n_theta, fit.n_psidot)),
            measured(fit.t_f, fit.t_f_sigma),
        )
        for fit in fits
        if fit.determined
    ]
    caption = "As the paper's tables 2 and 3, this recording, for several windows (value ± 1 σ)."
    different = list(dict.fromkeys(rows))  # windows longer than the recording give equal rows
    return Listing(("t_f - t (s)", "n_E", "n_θ", "n_ψ̇", "t_f (s)"), different, caption)


def _method(analysis: Analysis, provenance: Provenance) -> Listing:
    motion = analysis.motion
    lengths = ", ".join(f"{1e3 * v:.1f}" for v in np.median(motion.length, axis=0))
    scales = ", ".join(f"{np.sqrt(v):.2f}" for v in motion.noise_scale)
    rows = [
        ("velocities and accelerations", "Gaussian-process regression in moving windows, from the rotation itself"),
        ("length of the process (ms): horizontal, height, tilt, turn", lengths),
        ("scatter found over stated: horizontal, height, tilt, turn", scales),
        ("energy datum", "zero at rest, z = h"),
        (f"gravity ({unit_text('m s-2')})", f"{motion.gravity:g}"),
        ("software", f"disctrack {provenance.version}"),
        ("inputs, SHA-256", "; ".join(f"{name} {value[:16]}…" for name, value in sorted(provenance.inputs.items()))),
    ]
    return Listing(("what", "how"), rows, "Method and provenance.")
