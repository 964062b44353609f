"""Formulas of a user are read, never run; what cannot be a number is said so; what bends too sharply is rounded."""

import numpy as np
import pytest
import sympy

from disctrack.discrepancy.equations import Equations, Run, diagnose
from disctrack.discrepancy.equations.expressions import parsed, smooth
from disctrack.errors import AnalysisError

X, V = sympy.symbols("x v", real=True)
NAMES = {"x": X, "v": V}


@pytest.mark.parametrize(
    ("text", "expected"),
    [
        ("-2*x - 0.5*v**2/3", -2 * X - 0.5 * V**2 / 3),
        ("x - v - 1 + abs(-x)", X - V - 1 + sympy.Abs(X)),
        ("sqrt(x**2 + v**2)**(1/2)", (X**2 + V**2) ** sympy.Rational(1, 4)),
        ("Piecewise((x, (x > 0) & (v <= 1)), (0, True))", sympy.Piecewise((X, (X > 0) & (V <= 1)), (0, True))),
        ("+".join(["x"] * 1500), 1500 * X),
    ],
)
def test_a_formula_means_what_it_says(text, expected):
    assert parsed(text, NAMES, "here") == expected


@pytest.mark.parametrize(
    "text",
    ["__import__('os').system('true')", "x.__class__", "[x for x in (1,)]", "(lambda: x)()", "9**9**9", "x ^ 2", "x +",
     "sin(x)(v)", "sin(x, y=2)", "'x'", "x if v else 1", "9" * 5000, "(" * 500 + "x" + ")" * 500,
     "+".join(["x"] * 5000)],
)  # fmt: skip
def test_what_is_no_formula_is_an_error_in_words(text):
    with pytest.raises(AnalysisError, match="here"):
        parsed(text, NAMES, "here")


def test_an_unknown_name_is_named_with_the_nearest():
    with pytest.raises(AnalysisError, match="'sine' is not known; did you mean 'sin'"):
        parsed("sine(x)", NAMES, "here")


def test_a_speed_has_a_slope_where_nothing_moves():
    widths: dict = {}
    speed = smooth(sympy.sqrt(X**2 + V**2), widths, {X, V})
    (width,) = widths.values()
    assert speed.diff(X).subs({X: 0, V: 0, width: 1e-3}) == 0
    assert float(speed.subs({X: 3, V: 4, width: 1e-3})) == pytest.approx(5, rel=1e-6)
    assert smooth(sympy.sqrt(X**2 + 1), widths, {X, V}) == sympy.sqrt(X**2 + 1)  # the control: it never vanishes


@pytest.mark.statistical
def test_the_drag_of_a_thrown_ball_is_followed_from_rest(rng):
    """Falling from rest: v = sqrt(g / c) tanh(sqrt(g c) t), by hand."""
    g, c, time = 9.81, 0.02, np.linspace(0, 3, 200)
    fallen = np.log(np.cosh(np.sqrt(g * c) * time)) / c
    drag = "sqrt(vx**2 + vy**2 + vz**2)"
    rates = {"x": "vx", "vx": f"-c*vx*{drag}", "y": "vy", "vy": f"-c*vy*{drag}", "z": "vz", "vz": f"g - c*vz*{drag}"}
    data = {"x": 0 * time, "y": 0 * time, "z": fallen}
    run = Run(time, {k: v + 1e-3 * rng.standard_normal(200) for k, v in data.items()})
    answer = diagnose(Equations(rates, {"c": 0.03}, {"g": g}), run, ())
    assert abs(answer.values["c"] - c) < 4 * answer.sigmas["c"]
