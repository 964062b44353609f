"""What no catalogue names, from the independent simulation: never noise, and described where a law can be had."""

from dataclasses import replace

import numpy as np
import pytest
from numpy.testing import assert_allclose

from disctrack.diagnosis import diagnose
from disctrack.diagnosis.law_library import families
from disctrack.discrepancy.search import CLASS_GAIN
from disctrack.frames import nodal_axes_world
from disctrack.rolling import Model, State, simulate
from disctrack.rolling.effects.learned import effect_from_formulas
from tests.oracles import newton_euler
from tests.oracles.measured_disc import K_M, assert_sized, measured
from tests.oracles.unknown_laws import DISC, PLACE, UNKNOWN, Unknown, motion, recording


def contour_friction_below(mu: float, theta_deg: float):
    """Dry contour friction that sets in at a nutation."""
    edge = np.sin(np.radians(theta_deg))

    def law(disc, now):
        share = 0.5 * (1 - np.tanh((now.sine - edge) / (0.05 * edge)))
        return newton_euler.ZERO, mu * disc.r * np.sign(now.phidot) / now.sine * share * now.m0, newton_euler.ZERO

    return law


@pytest.mark.slow
def test_a_law_below_a_nutation_is_told_with_the_nutation():
    result = diagnose(recording(Unknown(contour_friction_below(1e-3, 2.5), 4.0, 0.3, 1.6)).trajectory)
    assert result.diagnosis.verdict == "unexplained"
    assert result.holds
    assert result.holds["first"] is not None
    # the friction sets in over 5 % of the nutation, and must grow beyond the noise
    assert 2.2 < result.holds["first"]["theta_deg"] < 2.8
    assert any("holds until" in note for note in result.notes)
    assert result.learned is not None
    edges = [v for k, v in result.diagnosis.after.values.items() if ".edge_" in k]
    # the gate opens over 5 % of the nutation: half of that
    assert min(abs(np.degrees(np.arcsin(edge)) - 2.5) for edge in edges) < 0.06


@pytest.mark.slow
def test_a_dent_that_hits_once_a_turn_is_found_with_its_place_and_its_blow():
    """A lever arm of 0.3 mm while a spot of the rim, 0.15 rad wide, is at the contact."""

    def law(disc, now, size=3e-4, width=0.15):
        phi = now.phi - 1.0
        bump = size * np.exp((np.cos(phi) - 1) / width**2) * np.sign(now.phidot)
        return newton_euler.ZERO, bump * now.m0, newton_euler.ZERO

    result = diagnose(recording(Unknown(law, 14.0, 1.0, 0.9)).trajectory)
    assert result.learned is not None
    fit = result.diagnosis.after
    assert result.after.reduced_chi_square < 1.05
    assert_sized(fit, {"learned.angle_0": 1.0}, 3)
    assert abs(-fit.values["learned.c_0"] - 3e-4 * 0.15) < 3 * fit.sigma("learned.c_0") + 0.01 * 4.5e-5


@pytest.mark.slow
def test_a_blow_is_an_impulse_at_an_instant():
    """1.7 mN s within 12 ms, as a soft hammer gives them; frames begin 2 ms after the motion."""
    impulse = np.array([1.5e-3, -0.8e-3, 0.0])

    def law(disc, now):
        phase = (disc.t - 0.31) / 0.012
        return (
            newton_euler.ZERO,
            newton_euler.ZERO,
            impulse * np.pi / 0.024 * np.cos(np.pi * phase) * (abs(phase) < 0.5),
        )

    result = diagnose(recording(Unknown(law)).trajectory)
    assert result.learned is not None
    blow = {"learned.impulse_x_0": impulse[0], "learned.impulse_y_0": impulse[1]}
    assert_sized(result.diagnosis.after, blow, 3, 0.05e-3)
    assert_sized(result.diagnosis.after, {"learned.instant_0": 0.308}, 3, 1e-3)
    assert len(result.learned.candidate.quantities) <= 5
    assert len(result.verdict_text) < 400


@pytest.mark.slow
def test_a_force_that_grows_with_time_is_found_with_its_size_and_its_direction():
    """Known effects and a force that turns with the face come near it, and leave a memory of p = 1e-80."""
    growing = np.array([1.2e-3, -3.8e-3])  # [N/s]
    result = diagnose(recording("growing_force").trajectory)
    assert result.learned is not None
    assert result.after.reduced_chi_square < 1.05
    half = 0.5 * (result.system.time[-1] - result.system.time[0])
    # the middle's force has the numbers c_0_0 and c_0_1
    assert_sized(result.diagnosis.after, {f"learned.c_0_{2 + i}": half * growing[i] for i in (0, 1)}, 3)


@pytest.mark.slow
def test_a_law_takes_the_place_of_those_that_stand_in_for_it_and_of_no_other():
    """A spring that grows with the distance, 40 N/m^2: as a linear one with an inertia and a yielding table, at noise.

    Pivoting friction beside it is truly there, and stays.
    """
    alone = diagnose(recording("quadratic_spring").trajectory)
    assert alone.diagnosis.found == ()
    x, y = "(x * cos(psi) + y * sin(psi))", "(y * cos(psi) - x * sin(psi))"
    forces = {"X_n": f"-k * {x} * sqrt(x * x + y * y)", "X_m": f"-k * {y} * sqrt(x * x + y * y)"}
    hidden, planted = effect_from_formulas("hidden_square", forces), {"hidden_square.k": 40.0, "kz.k_z": 6e-5}
    made = measured(planted, laws=[hidden], seed=5, n=250, declared_rate=500.0, theta_deg=11.0)
    beside = diagnose(made)
    assert [found.candidate.name for found in beside.diagnosis.found] == ["kz"]
    for result in (alone, beside):
        assert result.learned is not None
        assert result.learned.law.title == "a force towards a point that grows as the distance squared"
        (strength,) = result.learned.law.candidate.names
        assert_sized(result.diagnosis.after, {strength: 40.0}, 3, 0.2)
    assert_sized(beside.diagnosis.after, {"kz.k_z": 6e-5}, 3, 2e-6)
    assert "Missing in the model: pivoting friction" in beside.sentence


@pytest.mark.slow
def test_a_thread_that_twists_is_no_shaken_table():
    """Seven numbers, a frequency among them, leave noise of a moment that grows with the turn: a law leaves less."""
    made = recording("twisted_thread")
    result = diagnose(made.trajectory)
    assert result.diagnosis.found == ()
    assert result.learned is not None
    shaken = [e.length for e in result.diagnosis.ranked if "table_shaken" in e.effects]
    assert min(shaken) > result.diagnosis.ranked[0].length + CLASS_GAIN
    pull, true = pulls(made, result)
    assert (np.abs(pull) < 3).all()
    assert np.sqrt(np.mean(result.learned.course.sigma[:, 2] ** 2)) < np.sqrt(np.mean(true[:, 2] ** 2))


@pytest.mark.slow
@pytest.mark.parametrize(
    ("name", "effect", "sizes"),
    [
        # friction by Stribeck's law is not quite linear: 2 % of the coefficient
        ("stribeck_slip", "creep", {"c": (7.0e-4, 0.02 * 7.0e-4)}),
        # what follows its force within 1 to 3 ms, at 70 rad/s: no series in that time
        ("viscous_contact", "creep", {"c": (1.0 / 30.0, None)}),
        # by 40 um over 0.7 s, with the square of time from 2 ms before the first frame on
        ("table_sinks", "table_settles", {"v_z": (-0.004 * 40e-6 / 0.7**2, None), "a_z": (-2 * 40e-6 / 0.7**2, None)}),
        # a height that falls by 3 um; its turns, which grow with it, are taken for a clock's
        pytest.param(
            "wear",
            "table_settles",
            {"v_z": (-np.inf, np.inf)},
            marks=pytest.mark.xfail(
                strict=True, reason="no effect is a radius that shrinks; a drift of the clock joins"
            ),
        ),
    ],
)
def test_an_effect_of_the_catalogue_is_named_and_sized(name, effect, sizes):
    """To three of its sigmas, or as stated; an infinite size is one of a known sign."""
    result = diagnose(recording(name).trajectory)
    assert [found.candidate.name for found in result.diagnosis.found] == [effect]
    fit = result.diagnosis.after
    for part, (true, within) in sizes.items():
        value, sigma = fit.values[f"{effect}.{part}"], fit.sigma(f"{effect}.{part}")
        if np.isinf(true):
            assert np.sign(value) == np.sign(true)
            continue
        assert result.diagnosis.verdict == "found"
        assert abs(value - true) < (within or 3 * sigma)
        assert name != "viscous_contact" or 3 * sigma < 1e-2 * true


def pulls(made, result):
    """(k, 3) errors of the laws' course in its sigmas."""
    course = result.learned.course
    true = np.stack([np.interp(course.time, made.time, made.moment[:, i]) for i in range(3)], axis=1)
    return (course.values - true) / course.sigma, true


@pytest.mark.slow
def test_one_friction_in_another_s_place_competes_with_laws():
    """A drag along one direction: creep leaves noise of it, and a law of the same length leaves less; both are told."""
    made = recording("drag_one_way")
    result = diagnose(made.trajectory)
    assert result.learned is not None
    left = {e.effects: e.fit.reduced_chi_square for e in result.diagnosis.ranked}
    assert left["creep",] < 1.01 * left[result.learned.law.title,]
    assert np.mean(np.abs(pulls(made, result)[0]) < 3) > 0.85


@pytest.mark.slow
def test_a_law_that_ends_at_the_bound_of_its_shape_has_a_course():
    """A step of the table is wider than any hill of the library: its derivatives are taken inwards."""
    result = diagnose(recording("seam").trajectory)
    assert result.diagnosis.verdict == "unexplained"
    assert result.learned is None or np.isfinite(result.learned.course.sigma).all()


@pytest.mark.slow
@pytest.mark.parametrize(
    ("name", "beside"),
    [("loose_ball", "rolling_classical"), ("pad", "table_shaken"), ("eddy_half", "table_shaken")],
)
def test_a_known_effect_that_stands_in_with_a_law_is_not_claimed(name, beside):
    """A ball in oil, a table that gives way, a brake over half of it: sums that come near to these are no finding."""
    made = recording(name, 1)
    result = diagnose(made.trajectory)
    assert not result.diagnosis.found
    assert any(f"[{beside}] helps the law" in note for note in result.notes)  # it does, by far more than noise
    assert np.mean(np.abs(pulls(made, result)[0]) < 3) > 0.95


@pytest.mark.statistical
@pytest.mark.parametrize(
    ("name", "kind", "shape", "amount"),
    [  # shapes as in UNKNOWN, of 20, 6 and 30 um
        ("groove", "ridge", {"direction": 0.6, "edge": 0.05, "length": 3e-3}, -20e-6 * 3e-3),
        ("seam", "step", {"direction": 0.9, "edge": 0.045, "length": 4e-3}, 6e-6),
        ("bump", "hill", {"x0": float(PLACE[0]), "y0": float(PLACE[1]), "length": 8e-3}, 30e-6 * 8e-3**2),
    ],
)
def test_an_uneven_table_moves_the_disc_as_the_work_of_the_load_does(name, kind, shape, amount):
    """The oracle lets the load pay for what the contact climbs, for every direction of the angular velocity."""
    unknown = replace(UNKNOWN[name], duration=0.2)
    times, q, speed, _ = motion(unknown)
    family = next(f for f in families(q, times, 500.0, DISC) if f.kind == kind)
    formulas = replace(family, shape=shape).formulas()[0]
    law = effect_from_formulas("uneven", {k: f"c * ({f})" for k, f in formulas.items()})
    theta, psidot, phidot = q[0, 4], speed[0, 3], speed[0, 5]
    start = State(*q[0, :2], *q[0, 3:], speed[0, 4], psidot * np.sin(theta), psidot * np.cos(theta) + phidot)
    flat = Model(DISC).with_values({"km.k_m": K_M})
    found, without = (simulate(m, start, times=times).q for m in (flat.with_effects(law(c=amount)), flat))
    moved = np.abs(q - without).max(axis=0)
    assert moved[2] > 1e-7
    # as much as the two integrations, of 1e-10, differ where nothing acts
    assert_allclose(found, q, atol=1e-3 * moved.min())


def test_uneven_tables_are_looked_for_where_the_disc_touches():
    """A disc of half the size: hills of the library lie on the path of its lowest point, and cover it."""
    small = replace(DISC, radius=0.5 * DISC.radius, half_thickness=0.5 * DISC.half_thickness)
    q = np.tile([0.02, -0.01, 0.0, 0.0, 0.3, 0.0], (200, 1))
    q[:, 3] = np.linspace(0, 6, 200)
    lowest = q[:, :2] + small.arm_to_contact(*nodal_axes_world(q[:, 3], q[:, 4])[1:])[:, :2]
    hills = (f.shape for f in families(q, np.arange(200) / 500.0, 500.0, small) if f.kind == "hill")
    places = np.array(sorted({(s["x0"], s["y0"]) for s in hills}))
    apart = np.linalg.norm(places[:, None] - lowest, axis=2)
    half_diagonal = 0.006 / np.sqrt(2)  # of the squares of the grid
    assert apart.min(axis=0).max() <= half_diagonal
    assert apart.min(axis=1).max() <= half_diagonal


@pytest.mark.slow
def test_a_groove_is_no_tilted_table():
    """The tilt leaves 1.03 of the noise, with p = 0.02; a law by the place leaves noise, and is named in its stead."""
    result = diagnose(recording("groove").trajectory)
    assert result.learned.law.title == "a ridge or groove of the table"
    assert not result.diagnosis.found
    assert result.after.reduced_chi_square < 1.0
    truth = {"learned.c_0": -6e-8, "learned.direction_0": 0.6, "learned.edge_0": 0.05}
    assert_sized(result.diagnosis.after, truth, 4)
    assert any("table_tilt" in note for note in result.notes)
