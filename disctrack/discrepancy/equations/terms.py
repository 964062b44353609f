"""Common candidate terms; users may declare others as `Term`.

Amounts are accelerations (or generalised forces, where a mass matrix is declared) in the units of the equation to which
a term is added. `v` is a velocity, `x` its coordinate; both may be formulas. The parameters of a term are written
own_..., so that formulas given as arguments refer to the parameters of the equations.
"""

import re
from collections.abc import Collection, Iterator, Mapping, Sequence
from dataclasses import replace
from itertools import chain, combinations, combinations_with_replacement

import numpy as np

from disctrack.discrepancy.equations.declared import Equations, Parameter, Term
from disctrack.discrepancy.equations.formulas import Formulas

_ANY, _POSITIVE = Parameter(0.0), Parameter(0.0, lower=0.0)
_SHARE = Parameter(0.0, lower=0.0, upper=1.0)
VELOCITIES = ("m/s", "cm/s", "mm/s", "km/h", "rad/s", "deg/s")  # units


def _on(v: str, formula: str, name: str, title: str, source: str = "", **parameters: Parameter) -> Term:
    return Term(name, {v: formula}, parameters=parameters, title=title, source=source)


def _shown(channel: str, formula: str, name: str, title: str, **parameters: Parameter) -> Term:
    return Term(name, observed={channel: formula}, parameters=parameters, title=title)


def _vector(v: str | Sequence[str]) -> dict[str, tuple[str, str]]:
    """Direction and size of a velocity, or of the vector of several, as formulas for the equation of each."""
    if isinstance(v, str):
        return {v: (f"sign({v})", f"abs({v})")}
    size = f"sqrt({' + '.join(f'({u})**2' for u in v)})"
    return {u: (f"({u})/{size}", size) for u in v}


def coulomb(v: str | Sequence[str], load: str = "1", name: str = "") -> Term:
    """Dry friction against the motion: of constant size, or in proportion to a load (a formula).

    v : several are components of one velocity, as of a puck on a table
    """
    rates = {u: f"-own_c*abs({load})*{direction}" for u, (direction, _) in _vector(v).items()}
    label, by = f"coulomb_{'_'.join(rates)}", "" if load == "1" else f", by the load {load}"
    title = f"dry friction on {' and '.join(rates)}{by}"
    return Term(name or label, rates, parameters={"c": _POSITIVE}, title=title, source="Coulomb 1785")


def stribeck(v: str, name: str = "") -> Term:
    """Dry friction that is larger at rest and in slow motion, below a speed that is fitted."""
    speed = Parameter(1.0, lower=1e-12, shape=True, along=f"abs({v})")
    formula, title = f"-own_c*exp(-(({v})/own_speed)**2)*sign({v})", f"more friction on {v} in slow motion"
    return _on(v, formula, name or f"stribeck_{v}", title, "Stribeck 1902", c=_POSITIVE, speed=speed)


def viscous(v: str, name: str = "") -> Term:
    """Friction in proportion to the velocity."""
    return _on(v, f"-own_c*({v})", name or f"viscous_{v}", f"viscous friction on {v}", "Stokes 1851", c=_ANY)


def deflected(v: str, x: str, name: str = "") -> Term:
    """Viscous friction proportional to the squared deflection; with a negative viscous one it sustains a cycle."""
    title = f"viscous friction on {v} by the square of {x}"
    return _on(v, f"-own_c*({x})**2*({v})", name or f"deflected_{v}", title, "van der Pol 1926", c=_ANY)


def quadratic(v: str | Sequence[str], name: str = "") -> Term:
    """Drag in proportion to the square of the velocity.   v : several are components of one, as of a thrown ball"""
    rates = {u: f"-own_c*{size}*({u})" for u, (_, size) in _vector(v).items()}
    label, title = f"quadratic_{'_'.join(rates)}", f"quadratic drag on {' and '.join(rates)}"
    return Term(name or label, rates, parameters={"c": _POSITIVE}, title=title, source="Newton 1687")


def across(v: str, w: str, name: str = "") -> Term:
    """A force across the velocity with components v and w: Coriolis's, of a magnetic field, of a ball's spin."""
    rates, title = {v: f"own_a*({w})", w: f"-own_a*({v})"}, f"force across the velocity {v} and {w}"
    return Term(name or f"across_{v}_{w}", rates, parameters={"a": _ANY}, title=title, source="Coriolis 1835")


def power_law(v: str, exponent: float = 1.5, name: str = "") -> Term:
    """Drag in proportion to a power of the speed; the exponent is fitted once the drag is found."""
    p, title = Parameter(exponent, lower=0.3, upper=3.0, shape=True), f"drag on {v} with a power of its own"
    return _on(v, f"-own_c*sign({v})*abs({v})**own_p", name or f"power_{v}", title, c=_POSITIVE, p=p)


def constant(v: str, name: str = "") -> Term:
    """A force that is always there: a tilt, a spring's rest length, gravity."""
    return _on(v, "own_a", name or f"constant_{v}", f"constant force on {v}", a=_ANY)


def spring(v: str, x: str, name: str = "") -> Term:
    """Linear spring on a coordinate."""
    return _on(v, f"-own_k*({x})", name or f"spring_{x}", f"linear spring on {x}", k=_ANY)


def coupling(v: str, x: str, w: str, y: str, name: str = "") -> Term:
    """In proportion to x - y: a spring between coordinates, an exchange between levels; v and w are what it changes.

    What it gives to one and takes from the other differs if their masses or capacities do.
    """
    linear = exchange(v, w, f"({x}) - ({y})", name or f"coupling_{x}_{y}")
    return replace(linear, title=f"linear coupling of {x} and {y}")


def exchange(v: str, w: str, formula: str, name: str = "") -> Term:
    """By a formula, what one equation loses and another gains: a reaction, an infection, prey that is eaten."""
    rates, title = {v: f"-own_a*({formula})", w: f"own_b*({formula})"}, f"exchange of {v} and {w} by {formula}"
    return Term(name or f"exchange_{v}_{w}", rates, parameters={"a": _ANY, "b": _ANY}, title=title)


def asymmetric_spring(v: str, x: str, name: str = "") -> Term:
    """Spring that is stiffer on one side: force in proportion to x^2."""
    return _on(v, f"-own_k*({x})**2", name or f"asymmetric_spring_{x}", f"spring on {x} stiffer on one side", k=_ANY)


def cubic_spring(v: str, x: str, name: str = "") -> Term:
    """Spring that stiffens (or softens) with the deflection: force in proportion to x^3."""
    return _on(v, f"-own_k*({x})**3", name or f"cubic_spring_{x}", f"cubic spring on {x}", "Duffing 1918", k=_ANY)


def end_stop(v: str, x: str, side: int = 1, name: str = "") -> Term:
    """A spring that acts beyond a fitted place: a stop, a bumper.   side : -1 for a lower limit of x"""
    place, below = Parameter(0.0, shape=True, along=x), "" if side > 0 else "below_"
    formula, title = f"-{side}*own_k*Max({side}*(({x}) - own_place), 0)", f"stop {'below' if below else 'on'} {x}"
    return _on(v, formula, name or f"stop_{below}{x}", title, k=_POSITIVE, place=place)


def backlash(v: str, x: str, stiffness: str, onto: Mapping[str, str] | None = None, name: str = "") -> Term:
    """Play of a spring or coupling that is declared without: within half the play to either side it does nothing.

    x : its deflection, a coordinate or a difference ("x - y"), zero in the middle of the play
    stiffness : its factor in the equation of v, which has -stiffness*x
    onto : by other velocities that it acts on, its factor there: {"w": "-k/m"} where their equation has +k/m*x
    """
    idle = f"Min(abs({x}), own_play/2)*sign({x})"
    rates = {u: f"({factor})*{idle}" for u, factor in {v: stiffness, **(onto or {})}.items()}
    label = "".join(c if c.isalnum() else "_" for c in x.replace(" ", ""))
    return Term(name or f"backlash_{label}", rates, parameters={"play": _POSITIVE}, title=f"play in {x}")


def overflow(equations: Equations, level: str, into: str = "", name: str = "") -> Term:
    """Above a fitted level, a share of the inflow runs over (1: the level cannot rise), into another state.

    level : a state; its declared equation is what flows in. What runs over is a flow in the unit of that equation.
    """
    over = f"Max({equations.rates[level]}, 0)*Heaviside({level} - own_top)"
    rates, parameters = {level: f"-own_share*{over}"}, {"share": _SHARE, "top": Parameter(0.0, shape=True, along=level)}
    if into:
        rates[into], parameters["caught"] = f"own_caught*{over}", _POSITIVE
    return Term(name or f"overflow_{level}", rates, parameters=parameters, title=f"{level} runs over")


def force(v: str, formula: str, name: str, title: str = "") -> Term:
    """Any formula of states, inputs and t, with an amount of its own."""
    return _on(v, f"own_amount*({formula})", name, title or f"{formula} on {v}", amount=_ANY)


def periodic_force(v: str, frequency_hz: float, name: str = "") -> Term:
    """A force that oscillates at a known frequency: a motor, the mains, a shaking table."""
    w, title = 2 * np.pi * frequency_hz, f"force on {v} at {frequency_hz:g} Hz"
    return _on(v, f"own_a*cos({w!r}*t) + own_b*sin({w!r}*t)", name or f"periodic_{v}", title, a=_ANY, b=_ANY)


def products(v: str, of: Sequence[str], degree: int = 3) -> tuple[Term, ...]:
    """Every product of these states (inputs, formulas) up to a degree, each a term of its own on the equation of v."""
    found = []
    for factors in chain.from_iterable(combinations_with_replacement(of, d + 1) for d in range(degree)):
        label = "_".join("".join(c if c.isalnum() else "" for c in f) for f in factors)
        title = f"{' '.join(factors)} in the equation of {v}"
        found.append(force(v, "*".join(f"({f})" for f in factors), f"{v}_gets_{label}", title))
    return tuple(found)


def sensor_scale(channel: str, shown: str = "", name: str = "") -> Term:
    """The sensor shows too much or too little by a constant factor. `shown`: its formula, if a state has its name."""
    s = Parameter(0.0, typical=0.01)
    return _shown(channel, f"own_s*({shown or channel})", name or f"scale_{channel}", f"scale of {channel} wrong", s=s)


def sensor_offset(channel: str, name: str = "") -> Term:
    """The sensor's zero is wrong."""
    return _shown(channel, "own_b", name or f"offset_{channel}", f"zero of {channel} wrong", b=_ANY)


def sensor_drift(channel: str, name: str = "") -> Term:
    """The sensor's zero moves in proportion to time."""
    return _shown(channel, "own_b*t", name or f"drift_{channel}", f"zero of {channel} drifts", b=_ANY)


def sensor_curvature(channel: str, shown: str = "", name: str = "") -> Term:
    """The sensor's scale changes over its range: an error in proportion to the square."""
    formula, title = f"own_q*({shown or channel})**2", f"{channel} shown on a bent scale"
    return _shown(channel, formula, name or f"curvature_{channel}", title, q=_ANY)


def sensor_limit(channel: str, shown: str = "", side: int = 1, name: str = "") -> Term:
    """Above a fitted value the sensor saturates (share 1).

    shown : its formula, if a state has its name;  side : -1 for a lower limit
    """
    shown, below = shown or channel, "" if side > 0 else "_below"
    formula = f"-{side}*own_share*Max({side}*(({shown}) - own_top), 0)"
    top, title = Parameter(0.0, shape=True, along=shown), f"{channel} is limited{below.replace('_', ' ')} by its sensor"
    return _shown(channel, formula, name or f"limit{below}_{channel}", title, share=_SHARE, top=top)


def sensor_lag(channel: str, name: str = "") -> Term:
    """The sensor has a lag; identifiable only with another sensor or a measured input."""
    tau = {"tau": Parameter(0.0, unit="s")}
    return Term(name or f"lag_{channel}", lag={channel: "own_tau"}, parameters=tau, title=f"{channel} late")


def clock_rate(name: str = "clock_rate") -> Term:
    """The recorded time runs slow or fast."""
    r = {"r": Parameter(0.0, typical=1e-3)}
    return Term(name, clock="own_r*t", parameters=r, title="rate of the clock wrong")


def input_scale(v: str, u: str, gain: str, name: str = "") -> Term:
    """The measured input acts more or less than declared; `gain` is its factor in the equation of v."""
    s, title = Parameter(0.0, typical=0.01), f"gain of the input {u} wrong"
    return _on(v, f"own_s*({gain})*{u}", name or f"gain_{u}", title, s=s)


def dead_zone(v: str, u: str, gain: str, name: str = "") -> Term:
    """The measured input moves nothing while it is small; `gain` is its factor in the equation of v."""
    formula, title = f"-({gain})*Min(abs({u}), own_width)*sign({u})", f"dead zone of the input {u}"
    return _on(v, formula, name or f"dead_zone_{u}", title, width=_POSITIVE)


def saturation(v: str, u: str, gain: str, name: str = "") -> Term:
    """Beyond a fitted limit the input saturates (share 1); `gain` is its factor in the equation of v."""
    formula, title = f"-own_share*({gain})*sign({u})*Max(abs({u}) - own_limit, 0)", f"the input {u} saturates"
    limit = Parameter(0.0, lower=0.0, shape=True, along=f"abs({u})")
    return _on(v, formula, name or f"saturation_{u}", title, share=_SHARE, limit=limit)


def input_delay(v: str, u: str, gain: str, name: str = "", onto: Mapping[str, str] | None = None) -> Term:
    """The measured input acts with a delay; `gain` is its factor in the equation of v.   onto : in others, by state"""
    rates = {w: f"({factor})*(own_late - {u})" for w, factor in {v: gain, **(onto or {})}.items()}
    tau, late = {"tau": Parameter(0.0, unit="s")}, {"late": (u, "own_tau")}
    return Term(name or f"delay_{u}", rates, delayed=late, parameters=tau, title=f"input {u} acts late")


def usual(equations: Equations, differing: Collection[str] = ()) -> tuple[Term, ...]:
    """Default terms, by the structure of the equations; and common errors of sensors.

    A coordinate is a state whose declared rate is another state: rates={"x": "v", "v": ...}; that one is a velocity, as
    is a state in the unit of one: friction and springs act on it. Any other state is a level (of a tank, a charge, a
    temperature): it leaks, is fed, runs over into the first of the states that it drives. Two or three in one unit may
    be a point's, or coupled.
    differing : constants that are not the same in all runs: terms that go with them, as another force of the equation
        does (over a mass), are further ones
    """
    found: list[Term] = []
    written = {y: str(f).strip() for y, f in equations.rates.items()}
    pairs = {x: v for x, v in written.items() if v in written}
    velocities = {*pairs.values(), *(y for y in written if equations.units.get(y) in VELOCITIES)}
    for y in written:
        if y in pairs:
            continue
        found += [constant(y), viscous(y)]
        if y in velocities:
            found += [coulomb(y), quadratic(y)]
            continue
        fed = next((z for z, f in written.items() if z not in (y, *pairs) and re.search(rf"\b{y}\b", f)), "")
        powers = asymmetric_spring(y, y, f"square_{y}"), cubic_spring(y, y, f"cube_{y}")
        found += [replace(p, title=f"loss of {y} by its {p.name.partition('_')[0]}") for p in powers]
        found.append(overflow(equations, y, fed))
        found += [exchange(y, fed, f"{y}**2", f"square_{y}_into_{fed}")] if fed else []
    groups: dict[tuple[bool, str], list[str]] = {}  # coordinates, or levels, in the same unit
    for x in (x for x in written if x not in velocities):
        groups.setdefault((x in pairs, equations.units.get(x, "1")), []).append(x)
    for (move, _), several in groups.items():
        if not 1 < len(several) <= 3:  # a point has three coordinates, and of more levels the pairs are too many
            continue
        if move:
            own = [pairs[x] for x in several]
            found += [quadratic(own), coulomb(own)]
            found += [t for v, w in combinations(own, 2) for t in (across(v, w), coupling(v, v, w, w))]
        else:
            found += [exchange(x, y, f"{x}*{y}") for x, y in combinations(several, 2)]
        found += [coupling(pairs.get(x, x), x, pairs.get(y, y), y) for x, y in combinations(several, 2)]
    for x, v in pairs.items():
        found += [spring(v, x), asymmetric_spring(v, x), cubic_spring(v, x), deflected(v, x)]
        found += [end_stop(v, x), end_stop(v, x, -1)]
    declared = Formulas(equations, (), {})
    found += [*_with_factors(found, declared, differing)]
    for u in declared.inputs:
        slopes = {v: force.diff(u) for v, force in zip(written, declared.forces, strict=True)}
        gains = {v: str(slope) for v, slope in slopes.items() if slope != 0 and u not in slope.free_symbols}
        if gains:
            (v, gain), *others = gains.items()
            found.append(input_delay(v, u.name, gain, onto=dict(others)))
    observed = equations.observed if equations.observed is not None else {}
    for channel, formula in observed.items():
        found += [sensor_offset(channel), sensor_drift(channel), sensor_curvature(channel, str(formula))]
        # a share of a limit looks like drag in a fall
        if str(formula).strip() in {*written} - {*pairs, *velocities}:
            found.append(sensor_limit(channel, str(formula)))
        if equations.inputs or len(observed) > 1:
            found.append(sensor_lag(channel))
    return (*found, clock_rate())


def _with_factors(terms: Sequence[Term], declared: Formulas, differing: Collection[str]) -> Iterator[Term]:
    """Terms of one equation times what its declared parts have as a factor of such constants: one over a mass."""
    own = {symbol for name, symbol in declared.constants.items() if name in differing}
    for v, force in zip(declared.equations.rates, declared.forces, strict=True):
        parts = force.expand().as_ordered_terms() if own else []
        factors = [part.as_independent(*own, as_Add=False)[1] for part in parts]
        for factor in dict.fromkeys(f for f in factors if f.free_symbols and f.free_symbols <= own):
            label, by = re.sub(r"\W+", "_", str(factor)), f"in proportion to {factor}"
            for term in (term for term in terms if term.rates.keys() == {v}):
                rates = {v: f"({factor})*({term.rates[v]})"}
                yield replace(term, name=f"{term.name}_by_{label}", rates=rates, title=f"{term.title}, {by}")
