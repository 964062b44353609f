"""Terms that equations often lack, ready to be offered; any other is a `Term` of the user's own.

Amounts are accelerations (or generalised forces, where a mass matrix is declared) in the units of the equation to which
a term is added. `v` is a velocity, `x` its coordinate; both may be formulas. A term's own numbers are written own_...,
so that formulas which are handed in mean the equations' numbers of the same name.
"""

import re
from collections.abc import Mapping, Sequence
from itertools import combinations_with_replacement

import numpy as np

from disctrack.discrepancy.equations.declared import Equations, Parameter, Term


def coulomb(v: str, load: str = "1", name: str = "") -> Term:
    """Dry friction against the motion: of constant size, or in proportion to a load (a formula)."""
    by = "" if load == "1" else f", by the load {load}"
    return Term(name or f"coulomb_{v}", {v: f"-own_c*abs({load})*sign({v})"},
                parameters={"c": Parameter(0.0, lower=0.0)},
                title=f"dry friction on {v}{by}", source="Coulomb 1785")  # fmt: skip


def stribeck(v: str, name: str = "") -> Term:
    """Dry friction that is larger at rest and in slow motion, up to a speed that is looked for."""
    speed = Parameter(1.0, lower=1e-12, shape=True, along=f"abs({v})")
    return Term(name or f"stribeck_{v}", {v: f"-own_c*exp(-(({v})/own_speed)**2)*sign({v})"},
                parameters={"c": Parameter(0.0, lower=0.0), "speed": speed},
                title=f"more friction on {v} in slow motion", source="Stribeck 1902")  # fmt: skip


def viscous(v: str, name: str = "") -> Term:
    """Friction in proportion to the velocity."""
    return Term(name or f"viscous_{v}", {v: f"-own_c*({v})"}, parameters={"c": Parameter(0.0)},
                title=f"viscous friction on {v}", source="Stokes 1851")  # fmt: skip


def quadratic(v: str, name: str = "") -> Term:
    """Drag in proportion to the square of the velocity."""
    return Term(name or f"quadratic_{v}", {v: f"-own_c*abs({v})*({v})"}, parameters={"c": Parameter(0.0, lower=0.0)},
                title=f"quadratic drag on {v}", source="Newton 1687")  # fmt: skip


def power_law(v: str, exponent: float = 1.5, name: str = "") -> Term:
    """Drag in proportion to a power of the speed; the exponent is fitted once the drag is found."""
    return Term(name or f"power_{v}", {v: f"-own_c*sign({v})*abs({v})**own_p"},
                parameters={"c": Parameter(0.0, lower=0.0), "p": Parameter(exponent, lower=0.3, upper=3.0, shape=True)},
                title=f"drag on {v} with a power of its own", source="")  # fmt: skip


def constant(v: str, name: str = "") -> Term:
    """A force that is always there: a tilt, a spring's rest length, gravity."""
    return Term(name or f"constant_{v}", {v: "own_a"}, parameters={"a": Parameter(0.0)}, title=f"constant force on {v}")


def spring(v: str, x: str, name: str = "") -> Term:
    """Linear spring on a coordinate."""
    return Term(
        name or f"spring_{x}", {v: f"-own_k*({x})"}, parameters={"k": Parameter(0.0)}, title=f"linear spring on {x}"
    )


def asymmetric_spring(v: str, x: str, name: str = "") -> Term:
    """Spring that is stiffer on one side: force in proportion to x^2."""
    return Term(name or f"asymmetric_spring_{x}", {v: f"-own_k*({x})**2"}, parameters={"k": Parameter(0.0)},
                title=f"spring on {x} stiffer on one side")  # fmt: skip


def cubic_spring(v: str, x: str, name: str = "") -> Term:
    """Spring that stiffens (or softens) with the deflection: force in proportion to x^3."""
    return Term(name or f"cubic_spring_{x}", {v: f"-own_k*({x})**3"}, parameters={"k": Parameter(0.0)},
                title=f"cubic spring on {x}", source="Duffing 1918")  # fmt: skip


def end_stop(v: str, x: str, side: int = 1, name: str = "") -> Term:
    """A spring that is met beyond a place that is looked for: a stop, a bumper.   side : -1 where x cannot go lower"""
    place = Parameter(0.0, shape=True, along=x)
    beyond = f"{side}*own_k*Max({side}*(({x}) - own_place), 0)"
    return Term(name or f"stop_{x}", {v: f"-({beyond})"}, parameters={"k": Parameter(0.0, lower=0.0), "place": place},
                title=f"stop on {x}")  # fmt: skip


def backlash(v: str, x: str, stiffness: str, onto: Mapping[str, str] | None = None, name: str = "") -> Term:
    """Play of a spring or coupling that is declared without: within half the play to either side it does nothing.

    x : its deflection, a coordinate or a difference ("x - y"), nought in the middle of the play
    stiffness : its factor in the equation of v, which has -stiffness*x
    onto : by other velocities that it acts on, its factor there: {"w": "-k/m"} where their equation has +k/m*x
    """
    idle = f"Min(abs({x}), own_play/2)*sign({x})"
    rates = {u: f"({factor})*{idle}" for u, factor in {v: stiffness, **(onto or {})}.items()}
    label = "".join(c if c.isalnum() else "_" for c in x.replace(" ", ""))
    return Term(name or f"backlash_{label}", rates, parameters={"play": Parameter(0.0, lower=0.0)},
                title=f"play in {x}")  # fmt: skip


def overflow(equations: Equations, level: str, into: str = "", name: str = "") -> Term:
    """Above a level that is looked for, a share of what flows in runs over (1: the level cannot rise), into another.

    level : a state; its declared equation is what flows in. What runs over is a flow in the unit of that equation.
    """
    over = f"own_share*Max({equations.rates[level]}, 0)*Heaviside({level} - own_top)"
    parameters = {
        "share": Parameter(0.0, lower=0.0, upper=1.0),
        "top": Parameter(0.0, shape=True, along=level),
    }
    rates = {level: f"-{over}"}
    if into:
        rates[into] = f"own_caught*Max({equations.rates[level]}, 0)*Heaviside({level} - own_top)"
        parameters["caught"] = Parameter(0.0, lower=0.0)
    return Term(name or f"overflow_{level}", rates, parameters=parameters, title=f"{level} runs over")


def force(v: str, formula: str, name: str, title: str = "") -> Term:
    """Any formula of states, inputs and t, with an amount of its own."""
    return Term(
        name, {v: f"own_amount*({formula})"}, parameters={"amount": Parameter(0.0)}, title=title or f"{formula} on {v}"
    )


def periodic_force(v: str, frequency_hz: float, name: str = "") -> Term:
    """A force that oscillates at a known frequency: a motor, the mains, a shaking table."""
    w = 2 * np.pi * frequency_hz
    return Term(name or f"periodic_{v}", {v: f"own_a*cos({w!r}*t) + own_b*sin({w!r}*t)"},
                parameters={"a": Parameter(0.0), "b": Parameter(0.0)},
                title=f"force on {v} at {frequency_hz:g} Hz")  # fmt: skip


def products(v: str, of: Sequence[str], degree: int = 3) -> tuple[Term, ...]:
    """Every product of these states (inputs, formulas) up to a degree, each a term of its own on the equation of v."""
    found = []
    for d in range(1, degree + 1):
        for factors in combinations_with_replacement(of, d):
            label = "_".join("".join(c if c.isalnum() else "" for c in f) for f in factors)
            found.append(force(v, "*".join(f"({f})" for f in factors), f"{v}_gets_{label}",
                               f"{' '.join(factors)} in the equation of {v}"))  # fmt: skip
    return tuple(found)


def sensor_scale(channel: str, shown: str = "", name: str = "") -> Term:
    """The sensor shows too much or too little by a constant factor. `shown`: its formula, if a state has its name."""
    return Term(name or f"scale_{channel}", observed={channel: f"own_s*({shown or channel})"},
                parameters={"s": Parameter(0.0, typical=0.01)}, title=f"scale of {channel} wrong")  # fmt: skip


def sensor_offset(channel: str, name: str = "") -> Term:
    """The sensor's zero is wrong."""
    return Term(name or f"offset_{channel}", observed={channel: "own_b"}, parameters={"b": Parameter(0.0)},
                title=f"zero of {channel} wrong")  # fmt: skip


def sensor_drift(channel: str, name: str = "") -> Term:
    """The sensor's zero moves in proportion to time."""
    return Term(name or f"drift_{channel}", observed={channel: "own_b*t"}, parameters={"b": Parameter(0.0)},
                title=f"zero of {channel} drifts")  # fmt: skip


def sensor_curvature(channel: str, shown: str = "", name: str = "") -> Term:
    """The sensor's scale changes over its range: an error in proportion to the square."""
    return Term(name or f"curvature_{channel}", observed={channel: f"own_q*({shown or channel})**2"},
                parameters={"q": Parameter(0.0)}, title=f"{channel} shown on a bent scale")  # fmt: skip


def sensor_lag(channel: str, name: str = "") -> Term:
    """The sensor shows what was a little earlier; seen only beside another sensor or a measured input."""
    return Term(name or f"lag_{channel}", lag={channel: "own_tau"}, parameters={"tau": Parameter(0.0, unit="s")},
                title=f"{channel} late")  # fmt: skip


def clock_rate(name: str = "clock_rate") -> Term:
    """The time written beside the samples runs slow or fast."""
    return Term(name, clock="own_r*t", parameters={"r": Parameter(0.0, typical=1e-3)}, title="rate of the clock wrong")


def input_scale(v: str, u: str, gain: str, name: str = "") -> Term:
    """The measured input acts more or less than declared; `gain` is its factor in the equation of v."""
    return Term(name or f"gain_{u}", {v: f"own_s*({gain})*{u}"}, parameters={"s": Parameter(0.0, typical=0.01)},
                title=f"gain of the input {u} wrong")  # fmt: skip


def dead_zone(v: str, u: str, gain: str, name: str = "") -> Term:
    """The measured input moves nothing while it is small; `gain` is its factor in the equation of v."""
    return Term(name or f"dead_zone_{u}", {v: f"-({gain})*Min(abs({u}), own_width)*sign({u})"},
                parameters={"width": Parameter(0.0, lower=0.0)}, title=f"dead zone of the input {u}")  # fmt: skip


def saturation(v: str, u: str, gain: str, name: str = "") -> Term:
    """Beyond a limit that is looked for the input acts no more (share 1); `gain` is its factor in the equation of v."""
    return Term(name or f"saturation_{u}", {v: f"-own_share*({gain})*sign({u})*Max(abs({u}) - own_limit, 0)"},
                parameters={"share": Parameter(0.0, lower=0.0, upper=1.0),
                            "limit": Parameter(0.0, lower=0.0, shape=True, along=f"abs({u})")},
                title=f"the input {u} saturates")  # fmt: skip


def input_delay(v: str, u: str, gain: str, name: str = "") -> Term:
    """The measured input acts late; `gain` is its factor in the equation of v."""
    return Term(name or f"delay_{u}", {v: f"({gain})*(own_late - {u})"}, delayed={"late": (u, "own_tau")},
                parameters={"tau": Parameter(0.0, unit="s")}, title=f"input {u} acts late")  # fmt: skip


def sensor_limit(channel: str, shown: str = "", name: str = "") -> Term:
    """Above a value that is looked for the sensor shows no more (share 1). `shown`: its formula, as for its scale."""
    shown = shown or channel
    return Term(name or f"limit_{channel}", observed={channel: f"-own_share*Max(({shown}) - own_top, 0)"},
                parameters={"share": Parameter(0.0, lower=0.0, upper=1.0),
                            "top": Parameter(0.0, shape=True, along=shown)},
                title=f"{channel} is limited by its sensor")  # fmt: skip


def usual(equations: Equations) -> tuple[Term, ...]:
    """What is offered where the user offers nothing, by the structure of the equations; and what sensors do.

    A coordinate is a state whose declared rate is another state: rates={"x": "v", "v": ...}; that one is a velocity, on
    which friction and springs act. Any other state is a level (of a tank, a charge, a temperature): it leaks, is fed,
    runs over into the first of the states that it drives.
    """
    found: list[Term] = []
    written = {y: str(f).strip() for y, f in equations.rates.items()}
    pairs = {x: v for x, v in written.items() if v in written}
    for y in written:
        if y in pairs:
            continue
        found += [constant(y), viscous(y)]
        if y in pairs.values():
            found += [coulomb(y), quadratic(y)]
            continue
        fed = next((z for z, f in written.items() if z not in (y, *pairs) and re.search(rf"\b{y}\b", f)), "")
        found += [asymmetric_spring(y, y, f"square_{y}"), cubic_spring(y, y, f"cube_{y}"), overflow(equations, y, fed)]
    for x, v in pairs.items():
        found += [spring(v, x), asymmetric_spring(v, x), cubic_spring(v, x)]
    observed = equations.observed if equations.observed is not None else {}
    for channel, formula in observed.items():
        found += [sensor_offset(channel), sensor_drift(channel), sensor_curvature(channel, str(formula))]
        if str(formula).strip() in {*written} - {
            *pairs,
            *pairs.values(),
        }:  # a share of a limit looks like drag in a fall
            found.append(sensor_limit(channel, str(formula)))
        if equations.inputs or len(observed) > 1:
            found.append(sensor_lag(channel))
    found.append(clock_rate())
    return tuple(found)
