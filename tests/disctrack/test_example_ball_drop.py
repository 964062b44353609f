"""Falling balls: drag is found, its form is told where the heights are good enough, and only there."""

import json

import numpy as np
import pytest
from numpy.testing import assert_allclose

from disctrack.diagnosis import diagnose
from disctrack.diagnosis.engine.noise_with_memory import SampleStretch, SmoothNoise, estimate
from disctrack.examples.ball_drop import analyse_drops, main, settings_for
from disctrack.examples.ball_system import GRAVITY, STEP, Ball, BallDrops, Drop, fall, read_drops

TIME = np.arange(45) / 15.0
BALLS = (Ball("foam", 0.03, 0.036), Ball("rubber", 0.3, 0.11), Ball("lead", 5.0, 0.05))
NOTHING = {"gravity.change": 0.0, "constant_drag.c": 0.0, "linear_drag.k": 0.0, "quadratic_drag.k": 0.0}


@pytest.fixture(scope="module")
def answer(shared_data):
    folder = shared_data / "ball_drop"
    if not (folder / "ball_drops.csv").is_file():
        pytest.skip(f"{folder} is not there")
    return analyse_drops(read_drops(folder))


def fallen(time, quadratic):
    """Closed form from rest."""
    rate = np.sqrt(GRAVITY * quadratic)
    return -np.log(np.cosh(rate * time)) / quadratic


def drops(rng, sigma, law, smooth=0.0):
    """Two drops of each ball from 45 m, with white noise and with a smooth error."""
    noise = SmoothNoise(sigma, smooth, 0.5).covariance(TIME) if smooth else sigma**2 * np.eye(len(TIME))
    root = np.linalg.cholesky(noise)
    return [
        Drop(ball, number, TIME, 45 + law(ball, TIME) + root @ rng.standard_normal(len(TIME)))
        for ball in BALLS
        for number in (1, 2)
    ]


def test_integrated_fall_is_that_of_the_closed_forms():
    start = {"state.height": np.zeros(1), "state.velocity": np.zeros(1)}
    for law, closed in (
        ({"quadratic_drag.k": 0.05}, lambda t: fallen(t, 0.05)),
        ({"linear_drag.k": 0.5}, lambda t: -GRAVITY / 0.5 * (t + (np.exp(-0.5 * t) - 1) / 0.5)),
        ({"gravity.change": -0.3}, lambda t: -(GRAVITY - 0.3) * t**2 / 2),
    ):
        p = {k: np.array([v]) for k, v in (NOTHING | law).items()} | start
        grid, height, velocity = fall(p, 3.0)
        assert_allclose(height[:, 0], closed(grid), atol=2e-5)  # Runge-Kutta of fourth order at STEP
        assert_allclose(np.gradient(height[:, 0], STEP)[1:-1], velocity[1:-1, 0], atol=2e-2)


def test_noise_with_a_memory_is_measured(rng):
    truth = SmoothNoise(0.05, 0.2, 0.5)
    root = np.linalg.cholesky(truth.covariance(TIME))
    basis = TIME[:, None] ** np.arange(3)
    found = estimate(
        [SampleStretch(TIME, root @ rng.standard_normal((45, 1)), basis) for _ in range(30)], SmoothNoise(0.1, 0.1, 0.3)
    )
    # 30 stretches of 45 samples, each six memories long: 3 % of the white part, about 10 % of the others; three sigmas
    assert found.white == pytest.approx(truth.white, rel=0.1)
    assert found.smooth == pytest.approx(truth.smooth, rel=0.35)
    assert found.memory == pytest.approx(truth.memory, rel=0.3)


def test_quadratic_drag_is_named_and_sized_where_heights_are_good(rng):
    found = analyse_drops(drops(rng, 2e-3, lambda ball, t: fallen(t, 0.5 * ball.quadratic_per_cd)))
    assert found.together.verdict == "found"
    assert [f.candidate.effect for f in found.together.found] in (["quadratic_drag"], ["sphere_drag"])
    assert found.identifiable
    assert found.forms[0].effects[0] == "quadratic_drag"
    plain = next(f.fit for f in found.forms if f.effects == ("quadratic_drag",))
    for ball in BALLS[:2]:
        name = f"quadratic_drag.k[{ball.name}]"
        value, sigma = plain.values[name], plain.sigma(name)
        assert abs(value - 0.5 * ball.quadratic_per_cd) < 4 * sigma
        assert sigma < 0.02 * value


def test_free_fall_lacks_nothing(rng):
    for smooth in (0.0, 0.15):
        found = analyse_drops(drops(rng, 0.05, lambda ball, t: -GRAVITY * t**2 / 2, smooth))
        assert found.together.verdict == "nothing missing"
        assert all(d.verdict == "nothing missing" for d in found.alone.values())


def test_the_drag_of_these_balls_is_certain_and_its_form_is_not_identifiable(answer):
    assert answer.together.verdict == "found"
    assert answer.together.before.reduced_chi_square > 10
    assert answer.together.after.reduced_chi_square < 1.2
    assert not answer.identifiable
    assert {f.effects[0] for f in answer.undecided} == {"linear_drag", "quadratic_drag"}
    worse = {f.effects: f.criterion - answer.forms[0].criterion for f in answer.forms}
    # a constant deceleration is refused, and with an undistorted camera the quadratic law too
    assert worse["constant_drag",] > 100
    assert worse["quadratic_drag",] > 50


def test_errors_on_the_second_drops_are_those_that_others_found(answer):
    """Medians of the published data by least squares, as listed in PROVENANCE.md to 0.01 m."""
    reference = {
        "gravity alone": (1.10, 4.0),
        "constant_drag": (0.22, 0.81),
        "linear_drag": (0.15, 0.87),
        "quadratic_drag": (0.24, 0.86),
    }
    for name, (whole, forecast) in reference.items():
        found = answer.errors[name]
        assert np.median(list(found.whole.values())) == pytest.approx(whole, abs=0.01)
        assert np.median(list(found.forecast.values())) == pytest.approx(forecast, abs=0.03)


def test_heavy_balls_lack_nothing_and_light_ones_lack_drag(answer):
    for name in ("Bowling Ball", "Golf Ball", "Baseball"):
        assert answer.alone[name].verdict == "nothing missing"
    for name in ("Whiffle Ball 1", "Whiffle Ball 2", "Blue Basketball"):
        assert answer.alone[name].verdict == "found"
        assert answer.alone[name].found[0].candidate.name.endswith("_drag")


def test_shuffled_residuals_of_the_balls_give_no_finding(answer, rng):
    system, values = answer.system, answer.together.after.values
    root = [answer.noise.covariance(d.time) for d in answer.drops]
    shuffled = []
    for drop, predicted, covariance in zip(answer.drops, system.predicted(values), root, strict=True):
        L = np.linalg.cholesky(covariance)
        white = np.linalg.solve(L, drop.height - predicted)
        fall_alone = drop.height[0] - GRAVITY * (drop.time - drop.time[0]) ** 2 / 2
        shuffled.append(Drop(drop.ball, drop.number, drop.time, fall_alone + L @ rng.permutation(white)))
    again = BallDrops(shuffled, answer.noise)
    assert not diagnose(again, again.start(), settings_for(again), again.training_rows()).found


def test_command_writes_the_diagnosis_and_a_figure(shared_data, tmp_path, capsys, monkeypatch, answer):
    monkeypatch.setattr("disctrack.examples.ball_drop.analyse_drops", lambda drops: answer)
    words = [str(shared_data / "ball_drop"), "-o", str(tmp_path)]
    assert main(words) == 0
    assert "not identifiable" in capsys.readouterr().out
    found = json.loads((tmp_path / "diagnosis.json").read_text())
    assert {"verdict", "effects", "before", "after", "tried", "identifiable"} <= set(found)
    (effect,) = found["effects"]
    assert effect["class"]
    assert (tmp_path / "ball_drop.png").stat().st_size > 10_000
    assert main(words) == 1  # an earlier result is kept
    assert "exists" in capsys.readouterr().err
    assert main([str(tmp_path)]) == 1
    assert "ball_drops.csv" in capsys.readouterr().err
