"""Figures of an analysis in the manner of the paper's figures 4 to 16, drawn from this recording."""

from collections.abc import Callable, Iterator

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from calibration.kit.arrays import Array
from disctrack.analyse.analysis import Analysis
from disctrack.analyse.power_laws import MODEL_EXPONENTS, Exponent
from disctrack.analyse.propagation import DerivedSeries
from disctrack.disc import MA_2014
from disctrack.report.figures import NO_TITLE, Drawn, dress, panels
from disctrack.report.palette import AMBER, BLUE, GREEN, INK, MUTED, RED

BAND = 3.0  # sigmas shown as a band
INSET_DURATION = 0.3  # [s] last stage, as in the paper's figures 4 and 10
MIN_INSET_SHARE = 2.5  # the inset is drawn when the recording is this many times longer


def all_figures(analysis: Analysis) -> tuple[Drawn, ...]:
    """Every figure that this recording has something to show in."""
    makers: tuple[Callable[[Analysis], Drawn | None], ...] = (
        nutation_angle, centre_path, centre_and_contact_path, nutation_count, slip_speed, contact_locus,
        precession_rate, axial_rates, adiabatic_level, energy_against_adiabatic, energy_parts, contact_forces,
    )  # fmt: skip
    drawn = [make(analysis) for make in makers]
    drawn += [*power_laws(analysis), exponents_against_window(analysis), pose_quality(analysis)]
    return tuple(figure for figure in drawn if figure is not None)


def _axes(width: float = 7.2, height: float = 3.6) -> tuple[Figure, Axes]:
    figure, (axes,) = panels(width, height, margins=NO_TITLE)
    return figure, axes


def _band(axes: Axes, time: Array, series: DerivedSeries, scale: float, colour: str, label: str) -> None:
    """Line with its band of BAND sigmas, noise and calibration together."""
    sigma = np.hypot(series.sigma, series.sigma_calibration)
    low, high = series.value - BAND * sigma, series.value + BAND * sigma
    axes.fill_between(time, scale * low, scale * high, color=colour, alpha=0.25, linewidth=0)
    axes.plot(time, scale * series.value, color=colour, linewidth=1.1, label=label)


def _inset(axes: Axes, time: Array, value: Array, bounds: tuple[float, float, float, float]) -> None:
    known = np.flatnonzero(np.isfinite(value))
    if known.size < 10 or np.ptp(time[known]) < MIN_INSET_SHARE * INSET_DURATION:
        return
    last = known[time[known] >= time[known[-1]] - INSET_DURATION]
    inset = axes.inset_axes(bounds)
    dress(inset)
    inset.plot(time[last], value[last], color=BLUE, linewidth=1.0)
    inset.tick_params(labelsize=7)
    inset.set_title(f"last {INSET_DURATION:g} s", fontsize=8, color=MUTED)


def _nothing(value: Array) -> bool:
    return int(np.isfinite(value).sum()) < 2


def nutation_angle(analysis: Analysis) -> Drawn | None:
    """Paper's figure 4."""
    motion = analysis.motion
    theta = np.degrees(motion.euler[:, 1])
    if _nothing(theta):
        return None
    figure, axes = _axes()
    axes.plot(motion.time, theta, color=BLUE, linewidth=1.1)
    axes.set(xlabel="time (s)", ylabel="nutation θ (deg)")
    top = float(np.nanmax(theta))
    axes.set_ylim(0, 1.25 * top)
    _inset(axes, motion.time, theta, (0.58, 0.56, 0.4, 0.36))
    sigma = np.degrees(np.sqrt(np.trace(motion.covariance[:, 3:6, 3:6], axis1=1, axis2=2) / 3))
    caption = (
        f"From {theta[np.isfinite(theta)][0]:.3f} to {theta[np.isfinite(theta)][-1]:.3f} deg; the noise is "
        f"{1e3 * np.nanmedian(sigma):.2f} mdeg after smoothing, thinner than the line."
    )
    return Drawn("04_nutation_angle", "Nutation angle", caption, figure)


def centre_path(analysis: Analysis) -> Drawn | None:
    """Paper's figure 5."""
    x = 1e3 * analysis.motion.position
    if _nothing(x[:, 0]):
        return None
    figure, axes = _axes(5.4, 4.6)
    axes.plot(x[:, 0], x[:, 1], color=RED, linewidth=1.0)
    _ends(axes, x)
    axes.set(xlabel="x (mm)", ylabel="y (mm)")
    axes.set_aspect("equal", adjustable="datalim")
    return Drawn("05_centre_path", "Path of the centre", "Centre of mass seen from above, in the table's axes.", figure)


def _ends(axes: Axes, x: Array) -> None:
    known = np.flatnonzero(np.isfinite(x[:, 0]))
    axes.plot(*x[known[0], :2], "o", color=GREEN, markersize=6, label="start")
    axes.plot(*x[known[-1], :2], "s", color=INK, markersize=5, label="end")
    axes.legend(frameon=False, fontsize=9)


def centre_and_contact_path(analysis: Analysis) -> Drawn | None:
    """Paper's figure 6."""
    motion = analysis.motion
    contact = 1e3 * np.column_stack([analysis.series(name).value for name in ("contact_x", "contact_y")])
    centre = 1e3 * motion.position
    known = np.flatnonzero(np.isfinite(contact[:, 0]))
    if known.size < 2:
        return None
    part = known[motion.time[known] <= motion.time[known[0]] + 0.65]
    figure, axes = _axes(5.4, 4.8)
    axes.plot(contact[part, 0], contact[part, 1], ":", color=BLUE, linewidth=1.4, label="contact point")
    axes.plot(centre[part, 0], centre[part, 1], color=RED, linewidth=1.2, label="centre")
    theta = motion.euler[part, 1]
    lows = np.flatnonzero((theta[1:-1] < theta[:-2]) & (theta[1:-1] <= theta[2:])) + 1
    if len(lows) <= 12:  # more would hide the path
        for i, low in enumerate(lows):
            axes.annotate(
                f"P{i + 1}", contact[part[low]], fontsize=8, color=INK, xytext=(4, 4), textcoords="offset points"
            )
            axes.plot(*contact[part[low]], ".", color=INK, markersize=6)
    axes.set(xlabel="x (mm)", ylabel="y (mm)")
    axes.set_aspect("equal", adjustable="datalim")
    axes.legend(frameon=False, fontsize=9, loc="upper left", bbox_to_anchor=(0.0, 1.02), ncols=2, borderaxespad=0.0)
    marks = "; P marks the minima of the nutation." if 0 < len(lows) <= 12 else "."
    caption = f"Seen from above, {motion.time[part[0]]:.3f} to {motion.time[part[-1]]:.3f} s{marks}"
    return Drawn("06_centre_and_contact", "Centre and contact point", caption, figure)


def nutation_count(analysis: Analysis) -> Drawn | None:
    """Paper's figure 7."""
    count = analysis.scaling.count
    if len(count.count) < 4:
        return None
    figure, axes = _axes(5.4, 3.8)
    axes.plot(count.turns, count.count, "o", color=BLUE, markersize=4, label="maxima of θ")
    offset = float(np.mean(count.count - count.slope * count.turns))
    ends = np.array([count.turns[0], count.turns[-1]])
    axes.plot(ends, offset + count.slope * ends, color=RED, linewidth=1.2, label=f"slope {count.slope:.4f}")
    axes.set(xlabel="turns of precession", ylabel="nutation oscillations")
    axes.legend(frameon=False, fontsize=9)
    low, high = sorted(count.expected)
    caption = (
        f"Maxima of θ against turns of precession: slope {count.slope:.4f} ± {count.sigma:.4f}. Small "
        f"oscillations of this disc give {low:.4f} to {high:.4f} over this range of θ, a thin disc at small θ "
        f"{count.thin_disc:.4f}; the paper counted 0.7915."
    )
    return Drawn("07_nutation_count", "Nutation against precession", caption, figure)


def slip_speed(analysis: Analysis) -> Drawn | None:
    """Paper's figure 8, with a confidence in place of a threshold by eye."""
    time, onset = analysis.motion.time, analysis.contact.onset
    n, m = analysis.series("slip_n"), analysis.series("slip_m")
    speed = 1e3 * np.hypot(n.value, m.value)
    if _nothing(speed):
        return None
    sigma = np.sqrt(n.sigma**2 + m.sigma**2 + n.sigma_calibration**2 + m.sigma_calibration**2)
    figure, axes = _axes()
    axes.plot(time, speed, color=BLUE, linewidth=0.9, label="speed of the material point")
    axes.plot(time, BAND * 1e3 * sigma, color=RED, linestyle="--", linewidth=1.1, label="3 σ of it")
    if np.isfinite(onset.time) and np.isfinite(onset.high) and onset.high > onset.low:
        axes.axvspan(onset.low, onset.high, color=AMBER, alpha=0.35, label="onset of rolling, 95 %")
    axes.set(xlabel="time (s)", ylabel="slip (mm/s)")
    axes.set_yscale("log")
    axes.legend(frameon=False, fontsize=9, loc="upper right")
    path = f"{1e3 * onset.slip_distance:.4f} ± {1e3 * onset.slip_distance_sigma:.4f} mm"
    caption = (
        f"Speed of the disc's own point at the contact. The disc {onset.verdict} (probability of rolling at the end: "
        f"{onset.probability:.3f}){f'; path of slip {path}' if onset.slip_distance > 0 else ''}."
    )
    return Drawn("08_slip", "Slip at the contact", caption, figure)


def contact_locus(analysis: Analysis) -> Drawn | None:
    """Paper's figure 9."""
    circle, time = analysis.contact.circle, analysis.motion.time
    if not np.isfinite(circle.radius):
        return None
    part = (time >= circle.start) & (time <= circle.end)
    figure, axes = _axes(5.0, 4.8)
    x, y = (1e3 * analysis.series(name).value[part] for name in ("contact_x", "contact_y"))
    axes.plot(x, y, ".", color=BLUE, markersize=3, label="contact")
    angle = np.linspace(0, 2 * np.pi, 361)
    x, y = (1e3 * (c + circle.radius * f(angle)) for c, f in zip(circle.centre, (np.cos, np.sin), strict=True))
    axes.plot(x, y, color=RED, linewidth=0.9, label=f"radius {1e3 * circle.radius:.4f} mm")
    axes.set(xlabel="x (mm)", ylabel="y (mm)")
    axes.set_aspect("equal", adjustable="datalim")
    axes.legend(frameon=False, fontsize=9)
    same_disc = np.isclose(analysis.trajectory.disc.radius, MA_2014.radius)
    caption = (
        f"Contact point from {circle.start:.3f} to {circle.end:.3f} s with the fitted circle: radius "
        f"{1e3 * circle.radius:.4f} ± {1e3 * circle.sigma:.4f} mm (scatter) ± {1e6 * circle.sigma_calibration:.2g} µm "
        f"(calibration). With the centre at rest it would be r cos θ - h sin θ = {1e3 * circle.expected:.4f} mm on "
        f"average; the locus departs from the circle by {1e3 * circle.rms:.3f} mm rms."
        + (" Ma et al. (2014) found 37.286 mm with a disc of this radius." if same_disc else "")
    )
    return Drawn("09_contact_locus", "Locus of the contact", caption, figure)


def precession_rate(analysis: Analysis) -> Drawn | None:
    """Paper's figure 10."""
    series, time = analysis.series("psidot"), analysis.motion.time
    if _nothing(series.value):
        return None
    figure, axes = _axes()
    _band(axes, time, series, 1.0, BLUE, "precession")
    axes.set(xlabel="time (s)", ylabel="precession rate (rad/s)")
    _inset(axes, time, series.value, (0.08, 0.52, 0.42, 0.38))
    caption = (
        f"Read off the angular velocity, band ± 3 σ. σ grows as 1 / sin θ: from "
        f"{np.nanmin(series.sigma):.3f} to {np.nanmax(series.sigma):.3f} rad/s."
    )
    return Drawn("10_precession_rate", "Precession rate", caption, figure)


def axial_rates(analysis: Analysis) -> Drawn | None:
    """Paper's figure 11."""
    time = analysis.motion.time
    w3, wz = analysis.series("omega_3"), analysis.series("omega_z")
    if _nothing(w3.value):
        return None
    figure, (upper, lower) = panels(7.2, 4.4, 2, margins=NO_TITLE, sharex=True)
    for axes, series, name in ((upper, w3, "ω along e3 (rad/s)"), (lower, wz, "ω along k (rad/s)")):
        _band(axes, time, series, 1.0, BLUE, name)
        axes.axhline(0, color=MUTED, linewidth=0.7)
        axes.set_ylabel(name)
    lower.set_xlabel("time (s)")
    caption = "Angular velocity along the disc's axis (above) and along the vertical (below), band ± 3 σ."
    return Drawn("11_axial_rates", "Rotation about the axis and the vertical", caption, figure)


def adiabatic_level(analysis: Analysis) -> Drawn | None:
    """Paper's figure 12."""
    series, motion = analysis.series("precession_level"), analysis.motion
    if _nothing(series.value):
        return None
    figure, axes = _axes()
    _band(axes, motion.time, series, 1.0, BLUE, "ψ̇² sin θ")
    axes.axhline(4 * motion.gravity / motion.disc.radius, color=RED, linewidth=1.2, linestyle="--", label="4 g / r")
    axes.set(xlabel="time (s)", ylabel="ψ̇² sin θ (1/s²)")
    axes.legend(frameon=False, fontsize=9)
    energy = analysis.energy
    caption = (
        f"Adiabatic check: averaged over the turns of precession, ψ̇² sin θ is {energy.level_ratio:.4f} ± "
        f"{energy.level_ratio_sigma:.4f} times 4 g / r. It is 1 for a thin disc at small θ; steady precession "
        f"of this disc has {energy.level_ratio_steady:.4f} at the median θ."
    )
    return Drawn("12_adiabatic_level", "Adiabatic condition", caption, figure)


def energy_against_adiabatic(analysis: Analysis) -> Drawn | None:
    """Paper's figure 13."""
    total, level, time = analysis.series("total"), analysis.series("adiabatic"), analysis.motion.time
    if _nothing(total.value):
        return None
    figure, axes = _axes()
    _band(axes, time, total, 1e3, BLUE, "mechanical energy")
    axes.plot(time, 1e3 * level.value, color=RED, linestyle="--", linewidth=1.1, label="3/2 m g r sin θ")
    axes.set(xlabel="time (s)", ylabel="energy (mJ)")
    axes.set_ylim(bottom=0)
    axes.legend(frameon=False, fontsize=9)
    energy = analysis.energy
    caption = (
        f"Mechanical energy, zero at rest (z = h). Lost in the recording: {1e3 * energy.loss:.4f} ± "
        f"{1e3 * energy.loss_sigma:.4f} (noise) ± {1e3 * energy.loss_sigma_calibration:.4f} (calibration) mJ."
    )
    return Drawn("13_energy", "Energy", caption, figure)


def energy_parts(analysis: Analysis) -> Drawn | None:
    """Where the energy sits, and the power lost."""
    time = analysis.motion.time
    if _nothing(analysis.series("total").value):
        return None
    figure, (upper, lower) = panels(7.2, 5.0, 2, margins=NO_TITLE, sharex=True, height_ratios=(3, 2))
    parts = (
        ("translation", AMBER, "translation"),
        ("rotation_1", GREEN, "rotation about e₁"),
        ("rotation_2", BLUE, "rotation about e₂"),
        ("rotation_3", MUTED, "rotation about e₃"),
        ("potential", RED, "potential"),
    )
    for name, colour, label in parts:
        upper.plot(time, 1e3 * analysis.series(name).value, color=colour, linewidth=1.1, label=label)
    upper.set_ylabel("energy (mJ)")
    upper.legend(frameon=False, fontsize=8, ncols=2)
    _band(lower, time, analysis.series("power"), 1e3, BLUE, "power")
    lower.axhline(0, color=MUTED, linewidth=0.7)
    lower.set(xlabel="time (s)", ylabel="dE/dt (mW)")
    caption = "Where the energy sits (above), and the rate at which the sum changes (below, band ± 3 σ)."
    return Drawn("13b_energy_parts", "Parts of the energy and power", caption, figure)


def contact_forces(analysis: Analysis) -> Drawn | None:
    """Contact force from the accelerations, and the friction coefficient that it needs."""
    time = analysis.motion.time
    if _nothing(analysis.series("force_z").value):
        return None
    figure, (upper, lower) = panels(7.2, 5.0, 2, margins=NO_TITLE, sharex=True, height_ratios=(3, 2))
    for name, colour, label in (
        ("force_z", INK, "vertical"),
        ("force_n", BLUE, "along n0"),
        ("force_m", RED, "along m0"),
    ):
        _band(upper, time, analysis.series(name), 1.0, colour, label)
    upper.set_ylabel("force (N)")
    upper.legend(frameon=False, fontsize=9, ncols=3)
    _band(lower, time, analysis.series("friction_needed"), 1.0, BLUE, "needed")
    lower.set(xlabel="time (s)", ylabel="friction needed")
    lower.set_ylim(bottom=0)
    needed = analysis.series("friction_needed").value
    caption = (
        f"Force of the table on the disc along n0, m0 and k from Newton's law, and the friction coefficient that it "
        f"needs: at most {np.nanmax(needed):.3f}, {np.nanmedian(needed):.3f} in the median."
    )
    return Drawn("08b_contact_forces", "Contact forces", caption, figure)


def _power_law(
    analysis: Analysis, series_value: Array, exponent: Exponent, which: int, of_theta: float, label: str
) -> Figure | None:
    """Ln-ln plot of a quantity against the time left with the fit and the models' slopes."""
    laws, time = analysis.scaling.laws, analysis.motion.time
    left = laws.t_f - time
    with np.errstate(invalid="ignore"):
        shown = (left > 0) & (series_value > 0)
    if not laws.determined or not np.isfinite(exponent.value) or shown.sum() < 2:
        return None
    figure, axes = _axes(5.8, 4.4)
    axes.plot(np.log(left[shown]), np.log(series_value[shown]), ".", color=BLUE, markersize=2.5, label="measured")
    ends = np.log(np.array(laws.window))
    line = np.log(laws.prefactors[which]) + exponent.value * ends
    half = f"{exponent.value:.4f} ± {(exponent.high - exponent.low) / 2:.4f}"
    axes.plot(ends, line, color=RED, linewidth=1.6, label=f"fit, {half} (95 %)")
    shift = line.mean() - 0.35 * np.sign(of_theta)
    for (_, n), style in zip(MODEL_EXPONENTS, ((0, (1, 1)), (0, (4, 2)), (0, (6, 1, 1, 1)), "solid"), strict=True):
        slope = of_theta * n
        axes.plot(
            ends,
            shift + slope * (ends - ends.mean()),
            color=MUTED,
            linestyle=style,
            linewidth=0.9,
            label=f"{slope:.3f}",
        )
    axes.invert_xaxis()
    axes.set(xlabel="ln (t_f - t), t in s", ylabel=label)
    axes.legend(frameon=False, fontsize=8)
    return figure


def power_laws(analysis: Analysis) -> Iterator[Drawn]:
    """Paper's figures 14 to 16: energy, nutation, precession rate."""
    laws = analysis.scaling.laws
    for name, title, value, exponent, which, of_theta, label in (
        ("14_energy_law", "the energy", analysis.series("total").value, laws.n_energy, 2, 1.0, "ln E, E in J"),
        ("15_nutation_law", "the nutation", analysis.motion.euler[:, 1], laws.n_theta, 0, 1.0, "ln θ, θ in rad"),
        (
            "16_precession_law", "the precession rate", analysis.series("psidot").value, laws.n_psidot, 1, -0.5,
            "ln ψ̇, ψ̇ in rad/s",
        ),
    ):  # fmt: skip
        drawn = _power_law(analysis, value, exponent, which, of_theta, label)
        if drawn:
            caption = (
                f"Exponent {exponent.value:.4f} ± {exponent.sigma:.4f} (95 %: {exponent.low:.4f} to "
                f"{exponent.high:.4f}) from {laws.window[0]:.3f} to {laws.window[1]:.3f} s before t_f = {laws.t_f:.5f} "
                f"± {laws.t_f_sigma:.5f} s. Grey: {'; '.join(name for name, _ in MODEL_EXPONENTS)}."
            )
            yield Drawn(name, f"Power law of {title}", caption, drawn)


def exponents_against_window(analysis: Analysis) -> Drawn | None:
    """How the exponents depend on the window."""
    fits = analysis.scaling.by_window
    longest = np.array([fit.window[0] for fit in fits])
    reached = np.append(True, np.diff(longest) > 1e-3)  # windows longer than the recording repeat each other
    good = np.array([fit.determined for fit in fits]) & reached
    if good.sum() < 2:
        return None
    figure, axes = _axes()
    for name, colour, label, sign in (
        ("n_theta", BLUE, "nutation", 1),
        ("n_energy", RED, "energy", 1),
        ("n_psidot", GREEN, "-2 × precession rate", -2),
    ):
        exponents = [getattr(fit, name) for fit in fits]
        value = sign * np.array([e.value for e in exponents])[good]
        half = abs(sign) * np.array([(e.high - e.low) / 2 for e in exponents])[good]
        axes.errorbar(
            longest[good], value, half, fmt="o-", color=colour, markersize=4, capsize=2, linewidth=1, label=label
        )
    axes.axhline(2 / 3, color=MUTED, linewidth=0.9, linestyle="--")
    axes.set(xlabel="window before t_f (s)", ylabel="exponent")
    axes.legend(frameon=False, fontsize=9)
    caption = (
        "The same exponents for windows of several lengths, t_f fitted anew in each; bars are 95 % confidence, dashed "
        "2/3. All three would lie on one line if energy, nutation and precession kept to one law."
    )
    return Drawn("16b_exponents_by_window", "Exponents against the window", caption, figure)


def pose_quality(analysis: Analysis) -> Drawn:
    """Quality per frame: reprojection error and sigma of the measured poses."""
    trajectory = analysis.trajectory
    figure, (upper, middle, lower) = panels(7.2, 5.4, 3, margins=NO_TITLE, sharex=True)
    time = trajectory.time
    for camera, (name, colour) in enumerate((("left", BLUE), ("right", RED))):
        upper.plot(time, trajectory.reprojection_rms_px[:, camera], ".", color=colour, markersize=2, label=name)
    upper.set_ylabel("reprojection\nrms (px)")
    upper.set_ylim(bottom=0)
    upper.legend(frameon=False, fontsize=8, ncols=2, markerscale=4)
    sigma = np.sqrt(np.diagonal(trajectory.pose_covariance, axis1=1, axis2=2))
    for i, (name, colour) in enumerate((("x", BLUE), ("y", RED), ("z", GREEN))):
        middle.plot(time, 1e6 * sigma[:, i], color=colour, linewidth=1, label=name)
        lower.plot(time, 1e3 * np.degrees(sigma[:, 3 + i]), color=colour, linewidth=1, label=f"about {name}")
    middle.set_ylabel("σ of one\npose (µm)")
    lower.set_ylabel("σ of one\npose (mdeg)")
    for axes in (middle, lower):
        axes.set_ylim(bottom=0)
        axes.legend(frameon=False, fontsize=8, ncols=3)
    lower.set_xlabel("time (s)")
    caption = "Before smoothing: misfit of the dots, and the noise of each pose along and about the table's axes."
    return Drawn("03_pose_quality", "Quality per frame", caption, figure)
