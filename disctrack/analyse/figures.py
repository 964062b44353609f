"""Figures of an analysis, as figures 4 to 16 of the paper."""

from collections.abc import Iterator

import numpy as np

from calibration.kit.types import Array
from disctrack.analyse.analysis import Analysis
from disctrack.analyse.power_laws import MODEL_EXPONENTS
from disctrack.disc import MA_2014
from disctrack.numbers import measured
from disctrack.report.blocks import Drawn
from disctrack.report.figures import Curve, chart
from disctrack.report.palette import AMBER, BLUE, GREEN, INK, MUTED, RED

TIME, X, Y = "time (s)", "x (mm)", "y (mm)"
SQUARE = (5.4, 4.8)  # [in] of figures in a plane


def all_figures(analysis: Analysis) -> tuple[Drawn, ...]:
    """Every figure for which this recording has data."""
    drawn = [*path_of_centre(analysis)]
    if np.isfinite(analysis.series("psidot").value).sum() > 1:  # else the direction of the tilt is unknown throughout
        drawn += [path_of_contact(analysis), *rates(analysis), *contact(analysis), *energy(analysis)]
    drawn += [*nutation_count(analysis), *contact_locus(analysis), *power_laws(analysis)]
    return tuple(sorted(drawn, key=lambda figure: figure.name))


def _series(analysis: Analysis, name: str, colour: str, label: str = "", scale: float = 1.0) -> Curve:
    """A derived quantity over time with a band from noise and calibration."""
    series = analysis.series(name)
    sigma = np.hypot(series.sigma, series.sigma_calibration)
    return Curve(analysis.motion.time, scale * series.value, colour, label, sigma=scale * sigma)


def _level(time: Array, value: float, colour: str = MUTED, label: str = "", style: str = "-") -> Curve:
    """A constant level for comparison."""
    return Curve(time[[0, -1]], np.full(2, value), colour, label, style)


def path_of_centre(analysis: Analysis) -> Iterator[Drawn]:
    """Paper's figures 4 and 5: nutation, and the centre from above."""
    motion, x = analysis.motion, 1e3 * analysis.motion.position
    known = np.flatnonzero(motion.known)
    theta = np.degrees(motion.euler[:, 1])
    sigma = np.degrees(motion.tilt_sigma)
    figure = chart(TIME, ("nutation θ (deg)", [Curve(motion.time, theta, BLUE)]))
    figure.axes[0].set_ylim(0, 1.25 * float(np.nanmax(theta)))
    caption = (
        f"From {theta[known[0]]:.3f} to {theta[known[-1]]:.3f} deg; the noise is {1e3 * np.nanmedian(sigma):.2f} mdeg "
        "after smoothing, thinner than the line."
    )
    yield Drawn("04_nutation_angle", "Nutation angle", caption, figure)
    first, last = known[:1], known[-1:]
    path = Curve(x[:, 0], x[:, 1], RED)
    start = Curve(x[first, 0], x[first, 1], GREEN, "start", "o")
    end = Curve(x[last, 0], x[last, 1], INK, "end", "s")
    figure = chart(X, (Y, [path, start, end]), size=SQUARE, equal=True)
    yield Drawn("05_centre_path", "Path of the centre", "Centre of mass seen from above, in the table's axes.", figure)


def path_of_contact(analysis: Analysis) -> Drawn:
    """Paper's figure 6: the first 0.65 s of centre and contact, from above."""
    motion = analysis.motion
    contact = 1e3 * np.column_stack([analysis.series(name).value for name in ("contact_x", "contact_y")])
    known = np.flatnonzero(np.isfinite(contact[:, 0]))
    part = known[motion.time[known] <= motion.time[known[0]] + 0.65]
    path = Curve(contact[part, 0], contact[part, 1], BLUE, "contact point", ":")
    centre = Curve(1e3 * motion.position[part, 0], 1e3 * motion.position[part, 1], RED, "centre")
    figure = chart(X, (Y, [path, centre]), size=SQUARE, equal=True)
    caption = f"Seen from above, {motion.time[part[0]]:.3f} to {motion.time[part[-1]]:.3f} s."
    return Drawn("06_centre_and_contact", "Centre and contact point", caption, figure)


def nutation_count(analysis: Analysis) -> Iterator[Drawn]:
    """Paper's figure 7."""
    count = analysis.nutation_count
    if len(count.count) < 4:
        return
    offset = float(np.mean(count.count - count.slope * count.turns))
    ends = count.turns[[0, -1]]
    maxima = Curve(count.turns, count.count, BLUE, "maxima of θ", "o")
    line = Curve(ends, offset + count.slope * ends, RED, f"slope {count.slope:.4f}")
    low, high = sorted(count.expected)
    caption = (
        f"Maxima of θ against turns of precession: slope {measured(count.slope, count.sigma)}. Small "
        f"oscillations of this disc give {low:.4f} to {high:.4f} over this range of θ, a thin disc at small θ "
        f"{np.sqrt(0.6):.4f}; the paper counted 0.7915."
    )
    figure = chart("turns of precession", ("nutation oscillations", [maxima, line]), size=SQUARE)
    yield Drawn("07_nutation_count", "Nutation against precession", caption, figure)


def contact(analysis: Analysis) -> Iterator[Drawn]:
    """Paper's figure 8, slip, with a confidence interval of the onset instead of a threshold; forces of the table."""
    time, onset = analysis.motion.time, analysis.onset
    n, m = analysis.series("slip_n"), analysis.series("slip_m")
    sigma = np.sqrt(n.sigma**2 + m.sigma**2 + n.sigma_calibration**2 + m.sigma_calibration**2)
    speed = Curve(time, 1e3 * np.hypot(n.value, m.value), BLUE, "speed of the material point")
    figure = chart(TIME, ("slip (mm/s)", [speed, Curve(time, 3e3 * sigma, RED, "3 σ of it", "--")]))
    (axes,) = figure.axes
    axes.set_yscale("log")
    if onset.high > onset.low:
        axes.axvspan(onset.low, onset.high, color=AMBER, alpha=0.35, label="onset of rolling, 95 %")
        axes.legend(frameon=False, fontsize=9, loc="upper right")
    path = measured(onset.slip_distance, onset.slip_distance_sigma, "m")
    caption = (
        f"Speed of the material point at the contact. The disc {onset.verdict} (probability of rolling at the end: "
        f"{onset.probability:.3f}){f'; path of slip {path}' if onset.slip_distance > 0 else ''}."
    )
    yield Drawn("08_slip", "Slip at the contact", caption, figure)
    forces = (("force_z", INK, "vertical"), ("force_n", BLUE, "along n0"), ("force_m", RED, "along m0"))
    needed = _series(analysis, "friction_needed", BLUE)
    rows = ("force (N)", [_series(analysis, *force) for force in forces]), ("friction needed", [needed])
    figure = chart(TIME, *rows, size=(7.2, 5.0), heights=(3, 2))
    figure.axes[1].set_ylim(bottom=0)
    caption = (
        "Force of the table on the disc along n0, m0 and k from Newton's law, and the friction coefficient that it "
        f"needs: at most {np.nanmax(needed.y):.3f}, {np.nanmedian(needed.y):.3f} in the median."
    )
    yield Drawn("08b_contact_forces", "Contact forces", caption, figure)


def contact_locus(analysis: Analysis) -> Iterator[Drawn]:
    """Paper's figure 9."""
    circle, time = analysis.circle, analysis.motion.time
    if not np.isfinite(circle.radius):
        return
    start, end = circle.interval
    part = (time >= start) & (time <= end)
    x, y = (1e3 * analysis.series(name).value[part] for name in ("contact_x", "contact_y"))
    angle = np.linspace(0, 2 * np.pi, 361)
    around = 1e3 * (circle.centre + circle.radius * np.column_stack([np.cos(angle), np.sin(angle)]))
    fitted = Curve(around[:, 0], around[:, 1], RED, f"radius {1e3 * circle.radius:.4f} mm")
    figure = chart(X, (Y, [Curve(x, y, BLUE, "contact", "."), fitted]), size=SQUARE, equal=True)
    same_disc = np.isclose(analysis.trajectory.disc.radius, MA_2014.radius)
    caption = (
        f"Contact point from {start:.3f} to {end:.3f} s with the fitted circle: radius "
        f"{measured(circle.radius, circle.sigma, 'm')} (scatter) ± {measured(circle.sigma_calibration, unit='m')} "
        f"(calibration). With the centre at rest it would be r cos θ - h sin θ = {1e3 * circle.expected:.4f} mm on "
        f"average; the locus departs from the circle by {1e3 * circle.rms:.3f} mm rms."
        + (" Ma et al. (2014) found 37.286 mm with a disc of this radius." if same_disc else "")
    )
    yield Drawn("09_contact_locus", "Locus of the contact", caption, figure)


def rates(analysis: Analysis) -> Iterator[Drawn]:
    """Paper's figures 10 to 12: precession, rates about the axis and the vertical, and the adiabatic condition."""
    time, sigma = analysis.motion.time, analysis.series("psidot").sigma
    figure = chart(TIME, ("precession rate (rad/s)", [_series(analysis, "psidot", BLUE)]))
    caption = (
        f"From the angular velocity, band ± 3 σ. σ grows as 1 / sin θ: from {np.nanmin(sigma):.3f} to "
        f"{np.nanmax(sigma):.3f} rad/s."
    )
    yield Drawn("10_precession_rate", "Precession rate", caption, figure)
    names = ("omega_3", "ω along e3 (rad/s)"), ("omega_z", "ω along k (rad/s)")
    rows = [(label, [_series(analysis, name, BLUE), _level(time, 0.0)]) for name, label in names]
    caption = "Angular velocity along the disc's axis (above) and along the vertical (below), band ± 3 σ."
    figure = chart(TIME, *rows, size=(7.2, 4.4))
    yield Drawn("11_axial_rates", "Rotation about the axis and the vertical", caption, figure)
    level = _level(time, 4 * analysis.motion.gravity / analysis.motion.disc.radius, RED, "4 g / r", "--")
    figure = chart(TIME, ("ψ̇² sin θ (1/s²)", [_series(analysis, "precession_level", BLUE, "ψ̇² sin θ"), level]))
    found = analysis.energy
    caption = (
        "Adiabatic check: averaged over the turns of precession, ψ̇² sin θ is "
        f"{measured(found.level_ratio, found.level_ratio_sigma)} times 4 g / r. It is 1 for a thin disc at small θ; "
        f"steady precession of this disc has {found.level_ratio_steady:.4f} at the median θ."
    )
    yield Drawn("12_adiabatic_level", "Adiabatic condition", caption, figure)


def energy(analysis: Analysis) -> Iterator[Drawn]:
    """Paper's figure 13; parts of the energy, and the power."""
    time = analysis.motion.time
    level = Curve(time, 1e3 * analysis.series("adiabatic").value, RED, "3/2 m g r sin θ", "--")
    total = _series(analysis, "total", BLUE, "mechanical energy", 1e3)
    figure = chart(TIME, ("energy (mJ)", [total, level]))
    figure.axes[0].set_ylim(bottom=0)
    yield Drawn("13_energy", "Energy", "Mechanical energy, zero at rest (z = h).", figure)
    parts = (
        ("translation", AMBER, "translation"),
        ("rotation_1", GREEN, "rotation about e₁"),
        ("rotation_2", BLUE, "rotation about e₂"),
        ("rotation_3", MUTED, "rotation about e₃"),
        ("potential", RED, "potential"),
    )
    above = [Curve(time, 1e3 * analysis.series(name).value, colour, label) for name, colour, label in parts]
    below = [_series(analysis, "power", BLUE, scale=1e3), _level(time, 0.0)]
    figure = chart(TIME, ("energy (mJ)", above), ("dE/dt (mW)", below), size=(7.2, 5.0), heights=(3, 2))
    caption = "Parts of the energy (above), and the rate of change of their sum (below, band ± 3 σ)."
    yield Drawn("13b_energy_parts", "Parts of the energy and power", caption, figure)


def power_laws(analysis: Analysis) -> Iterator[Drawn]:
    """Paper's figures 14 to 16: energy, nutation, precession rate over the time to collapse, with model slopes."""
    laws = analysis.laws
    to_collapse, ends = laws.t_f - analysis.motion.time, np.log(np.array(laws.window))
    total, theta, psidot = analysis.series("total").value, analysis.motion.euler[:, 1], analysis.series("psidot").value
    drawn = (
        ("14_energy_law", "the energy", total, laws.n_energy, 1.0, "ln E, E in J"),
        ("15_nutation_law", "the nutation", theta, laws.n_theta, 1.0, "ln θ, θ in rad"),
        ("16_precession_law", "the precession rate", psidot, laws.n_psidot, -0.5, "ln ψ̇, rad/s"),
    )  # fmt: skip
    for name, title, value, exponent, of_theta, label in drawn:
        with np.errstate(invalid="ignore"):
            shown = (to_collapse > 0) & (value > 0)
        if not np.isfinite(exponent.value) or shown.sum() < 2:
            continue
        ln_time, ln_value = np.log(to_collapse[shown]), np.log(value[shown])
        fitted = (ends.min() <= ln_time) & (ln_time <= ends.max())
        line = np.mean((ln_value - exponent.value * ln_time)[fitted]) + exponent.value * ends
        said = f"fit, {measured(exponent.value, exponent.half)} (95 %)"
        curves = [Curve(ln_time, ln_value, BLUE, "measured", "."), Curve(ends, line, RED, said)]
        for (_, n), style in zip(MODEL_EXPONENTS, (":", "--", "-.", "-"), strict=True):
            slope = of_theta * n
            below = line.mean() - 0.35 * np.sign(of_theta)
            curves.append(Curve(ends, below + slope * (ends - ends.mean()), MUTED, f"{slope:.3f}", style))
        figure = chart("ln (t_f - t), t in s", (label, curves), size=SQUARE)
        figure.axes[0].invert_xaxis()
        caption = f"Grey: {'; '.join(name for name, _ in MODEL_EXPONENTS)}."
        yield Drawn(name, f"Power law of {title}", caption, figure)
