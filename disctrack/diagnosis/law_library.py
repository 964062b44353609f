"""Library of laws outside the catalogue: moments and forces as functions of position, rates, attitude and time.

The terms of a family have one physical meaning; each term sets components of the wrench by formulas in the names of
records.KINEMATICS, and has a coefficient. Numbers in braces are shape parameters of a law (the position of an edge, a
frequency): a grid of them is searched, and the best is the initial guess of a fit of shape and coefficients.
"""

from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from itertools import chain, product
from typing import Any

import numpy as np

from calibration.kit.types import Array
from disctrack.disc import Disc
from disctrack.discrepancy.fit import Fit
from disctrack.discrepancy.significance import SURE, as_sigmas, wald
from disctrack.discrepancy.system import Candidate, Values

HIGHEST_HARMONIC = 4  # of the angles
DRIFT_DEGREE = 4  # of the polynomials in time
FASTEST_HUM = 150.0  # [Hz]
MOMENTS = ("n", "m", "z")

Parts = Mapping[str, str]  # component of the force -> formula


@dataclass(frozen=True)
class Family:
    """Terms with one physical meaning, each with a coefficient."""

    title: str
    terms: tuple[Parts, ...]
    shape: Mapping[str, float] = field(default_factory=dict)  # numbers in braces, fitted along with the coefficients
    kind: str = "moment"  # families of one kind are variations of one another
    names: tuple[str, ...] = ()  # of the coefficients, if they are physical quantities

    @property
    def n_numbers(self) -> int:
        """Number of parameters."""
        return len(self.terms) + len(self.shape)

    def formulas(self) -> tuple[Parts, ...]:
        """The terms with the values of the shape parameters."""
        numbers = {k: f"({v!r})" for k, v in self.shape.items()}
        return tuple({c: f.format(**numbers) for c, f in parts.items()} for parts in self.terms)


@dataclass(frozen=True)
class LearnedLaw:
    """A sum of families that describes the missing moment or force."""

    candidate: Candidate
    effect: Any  # as which the model of the system contains it
    families: tuple[Family, ...]
    amounts: tuple[tuple[str, ...], ...] = ()  # names of the coefficients of each family ...
    shapes: tuple[tuple[str, ...], ...] = ()  # ... and of its shape parameters
    values: Values = field(default_factory=dict)  # of all quantities of its fit
    alike: tuple[str, ...] = ()  # indistinguishable laws of similar length
    others: "tuple[tuple[LearnedLaw, float], ...]" = ()  # all laws that fit as well, with their odds
    looked: float = 0.0  # chi-square that each family pays for multiple comparisons

    @property
    def title(self) -> str:
        """The law in words."""
        return "; and ".join(family.title for family in self.families)

    def is_significant(self, fitted: Fit) -> bool:
        """Are the coefficients of each family different from zero, given the covariances of the fit?"""
        return all(differ_from_zero(*fitted.amounts(names)) for names in self.amounts)

    @property
    def formulas(self) -> dict[str, str]:
        """Component of the force -> formula."""
        return dict(self.effect.formulas or {})


def differ_from_zero(amounts: Array, covariance: Array) -> bool:
    """Are amounts (k,) with this covariance (k, k) jointly significant?"""
    return as_sigmas(wald(amounts, covariance), len(amounts)) > SURE


# Functions of the state: (words, formula).
SCALARS = (
    ("constant", "1.0"),
    ("sign omega_z", "sign(omega_z, 0.1)"),
    *((x, x) for x in ("omega_z", "thetadot", "psidot")),
    *((f"{x} |{x}|", f"{x} * magnitude({x})") for x in ("omega_z", "thetadot", "psidot")),
    *((f"{x}^3", f"{x} * {x} * {x}") for x in ("omega_z", "thetadot", "psidot")),
    ("psidot sin theta", "omega2"),
    ("phidot sin theta", "phidot * sin_theta"),
    ("omega_3", "omega3"),
    ("sin theta", "sin_theta"),
    ("1 / sin theta", "1.0 / sin_theta"),
    ("1 / sin^2 theta", "1.0 / (sin_theta * sin_theta)"),
    ("time", "time"),
)

_SPEED = "sqrt(v_n * v_n + v_m * v_m + 1e-12)"
_X, _Y = "(x * cos(psi) + y * sin(psi))", "(y * cos(psi) - x * sin(psi))"  # the position along n0 and m0
# position of the contact on the table: O minus (r cos theta - h sin theta) m0
_ARM = "(radius * cos_theta - half_thickness * sin_theta)"
_CONTACT_X, _CONTACT_Y = f"(x + {_ARM} * sin(psi))", f"(y - {_ARM} * cos(psi))"
_ALONG = f"({_CONTACT_X} * cos({{direction}}) + {_CONTACT_Y} * sin({{direction}}))"


# of the coefficients of a kind, if they are physical quantities
HALF = " of half a wave"
NAMES = {"blow": ("impulse_x", "impulse_y", "impulse_z"), "blow M": ("impulse_n", "impulse_m", "impulse_k")}

Shape = Mapping[str, float]
# title, kind, terms; grid of the shape parameters
Row = tuple[str, str, tuple[Parts, ...]] | tuple[str, str, tuple[Parts, ...], Iterable[Shape]]

# lower and upper bound of each shape parameter, and its scale
SHAPES = {
    "rate": (0.0, np.inf, 0.1),
    "edge": (-np.inf, np.inf, 1e-4),
    "softness": (5e-4, 0.1, 1e-4),
    "instant": (-np.inf, np.inf, 1e-3),
    "lasting": (5e-4, 0.1, 1e-4),
    "angle": (-np.inf, np.inf, 0.01),
    "direction": (-np.inf, np.inf, 0.01),
    "width": (0.04, 2.0, 0.01),
    "length": (1e-3, 0.05, 1e-4),
    "x0": (-np.inf, np.inf, 1e-4),
    "y0": (-np.inf, np.inf, 1e-4),
}
LOCKED = {"angle", "magnet", "bump phi", "bump psi"}  # kinds of families


def locked(law: LearnedLaw) -> bool:
    """Is it a function of an angle of the body or of the table?"""
    return any(family.kind in LOCKED for family in law.families)


def along_x(formula: str = "1.0") -> Parts:
    """A force along i of the world."""
    return {"X_n": f"({formula}) * cos(psi)", "X_m": f"-({formula}) * sin(psi)"}


def along_y(formula: str = "1.0") -> Parts:
    """A force along j of the world."""
    return {"X_n": f"({formula}) * sin(psi)", "X_m": f"({formula}) * cos(psi)"}


def _sum(*parts: Parts) -> Parts:
    """Sum of forces with one coefficient."""
    return {c: " + ".join(p[c] for p in parts) for c in parts[0]}


def _push(formula: str) -> tuple[Parts, ...]:
    """A force in any direction."""
    return along_x(formula), along_y(formula), {"X_z": formula}


def _moment(formula: str) -> tuple[Parts, ...]:
    """A moment about any axis."""
    return tuple({f"M_{axis}": formula} for axis in MOMENTS)


def _of_velocity(factor: str) -> Parts:
    """A force opposite to the velocity of the centre."""
    return {c: f"-v_{c[-1]}{factor}" for c in ("X_n", "X_m")}


def families(q: Array, time: Array, frame_rate: float, disc: Disc) -> Iterator[Family]:
    """The library for a motion q (N, 6) of a disc at the instants (N,) [s]."""
    path = _path_of_contact(q, disc)
    rows = (
        _by_rates(), _angular(), _places(), _drags(), _magnets(), _drifts(time), _below_a_nutation(q), _instants(time),
        _parts_of_the_table(q, path), _uneven(path), _bumps(), _hums(time, frame_rate),
    )  # fmt: skip
    for title, kind, terms, *shapes in chain(*rows):
        for shape in shapes[0] if shapes else ({},):
            yield Family(title, terms, shape, kind, NAMES.get(kind.removesuffix(HALF), ()))


def _by_rates() -> Iterator[Row]:
    for (words, formula), axis in product(SCALARS, MOMENTS):
        yield f"a moment M_{axis} by {words}", "moment", ({f"M_{axis}": formula},)
    for (words, formula), (c, kind) in product(SCALARS, (("X_z", "lift"), ("X_n", "force"), ("X_m", "force"))):
        yield f"a force {c} by {words}", kind, ({c: formula},)


def _path_of_contact(q: Array, disc: Disc) -> Array:
    """Positions (N, 2) [m] of the contact on the table: the values of _CONTACT_X and _CONTACT_Y."""
    psi, theta = q[:, 3], q[:, 4]
    arm = disc.radius * np.cos(theta) - disc.half_thickness * np.sin(theta)
    return q[:, :2] + arm[:, None] * np.stack([np.sin(psi), -np.cos(psi)], axis=1)


def _angular() -> Iterator[Row]:
    factors = {
        "": "", ", times sin theta": " * sin_theta", ", times 1 / sin theta": " * 1.0 / sin_theta",
        ", times time": " * time",
    }  # fmt: skip
    for angle, highest in (("psi", HIGHEST_HARMONIC), ("phi", HIGHEST_HARMONIC), ("(psi + phi)", 1)):
        for axis, n, words in product(MOMENTS, range(1, highest + 1), factors):
            pair = tuple({f"M_{axis}": f"{f}({n}.0 * {angle}){factors[words]}"} for f in ("cos", "sin"))
            yield f"a moment M_{axis} by the angle {n if n > 1 else ''}{angle}{words}", "angle", pair


def _places() -> Iterator[Row]:
    """Forces by the position of the centre. The constant ones are a tilt, and shift the point of equilibrium."""

    def towards(factor: str = "") -> Parts:
        return {"X_n": f"-{_X}{factor}", "X_m": f"-{_Y}{factor}"}

    constant, distance = (along_x(), along_y()), "sqrt(x * x + y * y + 1e-6)"
    stiffness = (along_x("-x"), along_y("-y"), _sum(along_x("-y"), along_y("-x")))
    to_a_point = "a force towards a point"
    yield f"{to_a_point}, in proportion to the distance", "place", (towards(), *constant)
    yield f"{to_a_point} that grows as the distance cubed", "place", (towards(" * (x * x + y * y)"), *constant)
    yield f"{to_a_point} that grows as the distance squared", "place", (towards(f" * {distance}"), *constant)
    yield "a force of constant size towards the origin", "place", (towards(f" / {distance}"), *constant)
    yield "a force by a stiffness that differs with the direction", "place", (*stiffness, *constant)
    turning = tuple(along(g) for along in (along_x, along_y) for g in ("cos(psi + phi)", "sin(psi + phi)"))
    yield "a force that turns with the face", "force", turning


def _drags() -> Iterator[Row]:
    """Forces by the velocity of the centre."""
    v_x, v_y = "(v_n * cos(psi) - v_m * sin(psi))", "(v_n * sin(psi) + v_m * cos(psi))"
    along = (along_x(f"-{v_x}"), along_y(f"-{v_y}"), _sum(along_x(f"-{v_y}"), along_y(f"-{v_x}")))
    round_a_point = (_of_velocity(""), _sum(along_x("-y"), along_y("x")), along_x(), along_y())
    yield "a drag that grows as the speed squared", "moment", (_of_velocity(f" * {_SPEED}"),)
    yield "a drag of constant size", "drag", (_of_velocity(f" / {_SPEED}"),)
    yield "a drag that differs with the direction", "drag", along
    yield "a drag in air that turns about a point", "drag", round_a_point
    yield "a force across the velocity, by omega_z", "drag", ({"X_n": "-v_m * omega_z", "X_m": "v_n * omega_z"},)
    yield "a force across the velocity", "drag", ({"X_n": "-v_m", "X_m": "v_n"},)


def _magnets() -> Iterator[Row]:
    """A magnetic moment of the disc in a field of the room: m x B, with m in body axes and B in world axes."""
    first = ("cos(phi)", "sin(phi) * cos_theta", "sin(phi) * sin_theta")  # body axis 1 along n0, m0, k
    second = ("-sin(phi)", "cos(phi) * cos_theta", "cos(phi) * sin_theta")
    third = ("0.0", "-sin_theta", "cos_theta")
    level = ("cos(psi)", "-sin(psi)", "0.0"), ("sin(psi)", "cos(psi)", "0.0")
    upright = (("0.0", "0.0", "1.0"),)

    def cross(a: Sequence[str], b: Sequence[str]) -> Parts:
        pairs = ((1, 2), (2, 0), (0, 1))
        product = [f"({a[i]}) * ({b[j]}) - ({a[j]}) * ({b[i]})" for i, j in pairs]
        return {f"M_{axis}": p for axis, p in zip(MOMENTS, product, strict=True)}

    for where, axes in (("in the face", (first, second)), ("along the axis", (third,))):
        for direction, fields in (("horizontal", level), ("vertical", upright)):
            terms = tuple(cross(a, b) for a in axes for b in fields)
            yield f"a magnet {where}, in a {direction} field", "magnet", terms


def _drifts(time: Array) -> Iterator[Row]:
    """Polynomials in time: a draught, a table that settles, a magnet that is moved away; friction of a worn surface.

    Friction with a relaxation time is no function of the instantaneous rates; over time it changes as its mean does.
    """
    middle, half = 0.5 * float(time[0] + time[-1]), 0.5 * float(time[-1] - time[0])
    u = f"((time - {middle!r}) / {half!r})"
    powers = [" * ".join([u] * n) or "1.0" for n in range(DRIFT_DEGREE + 1)]
    for n in range(1, DRIFT_DEGREE + 1):
        changes, here = f"that changes with time, degree {n}", powers[: n + 1]
        yield f"a level force {changes}", "drift", tuple(along(f) for f in here for along in (along_x, along_y))
        yield f"a vertical force {changes}", "drift Z", tuple({"X_z": f} for f in here)
        for axis in ("m", "z"):
            yield f"a moment M_{axis} by the load {changes}", "drift M", tuple({f"load_{axis}": f} for f in here)


def _below_a_nutation(q: Array) -> Iterator[Row]:
    # a step with exponential tails: tails that fall as a power act everywhere, and bias the edge
    step = "1.0 / (1.0 + exp((sin_theta - {edge}) / {softness}))"
    edges = np.quantile(np.sin(q[:, 4]), np.linspace(0.05, 0.95, 13)).tolist()
    shapes = [{"edge": edge, "softness": max(0.03 * edge, 1e-3)} for edge in edges]
    for axis, (words, law) in product(MOMENTS, (("", "1.0"), (" over sin theta", "1.0 / sin_theta"))):
        terms = ({f"load_{axis}": f"{step} * {law}"},)
        yield f"a moment M_{axis} by the load{words} that acts below a nutation", "below a nutation", terms, shapes


def _instants(time: Array) -> Iterator[Row]:
    """Forces that begin at an instant, and blows, whose coefficients are the impulse.

    A blow is a Gaussian, or a half sine as of a soft hammer (IEC 60068-2-27): real ones lie between these.
    """
    after = "(0.5 + 0.5 * sign(time - {instant}, {lasting}))"
    bell = "exp(-0.5 * ((time - {instant}) / {lasting}) ** 2) / (2.5066283 * {lasting})"
    phase = "((time - {instant}) / (4.0 * {lasting}))"
    within = f"(0.5 + 0.5 * sign(0.25 - {phase} * {phase}, 1e-3))"
    half_wave = f"{within} * cos(3.14159265 * {phase}) * 0.39269908 / {{lasting}}"
    few, many = (np.interp(np.linspace(0.03, 0.97, n), (0, 1), time[[0, -1]]).tolist() for n in (32, 64))
    begins = [{"instant": instant, "lasting": 0.002} for instant in few]
    yield "a force from an instant on", "from then on", _push(after), begins
    for axis in MOMENTS:
        yield f"a moment M_{axis} by the load from an instant on", "from then on", ({f"load_{axis}": after},), begins
    blows = [{"instant": instant, "lasting": 0.008} for instant in many]
    for words, blow in (("", bell), (HALF, half_wave)):
        yield f"a blow{words}: a force during milliseconds", f"blow{words}", _push(blow), blows
        yield f"a blow{words}: a moment during milliseconds", f"blow M{words}", _moment(blow), blows


def _edges(places: Array, shares: Array) -> list[Shape]:
    """Straight edges: directions, and distances by quantiles of the positions (N, 2)."""
    found = list[Shape]()
    for angle in np.arange(0, 2 * np.pi, np.pi / 6).tolist():
        along = places @ np.array([np.cos(angle), np.sin(angle)])
        found += [{"direction": angle, "edge": edge} for edge in np.quantile(along, shares).tolist()]
    return found


def _parts_of_the_table(q: Array, path: Array) -> Iterator[Row]:
    """Laws that act beyond a straight edge, by the position of the contact or of the centre."""
    step = f"(0.5 + 0.5 * sign({_ALONG} - {{edge}}, 1e-3))"
    of_contact = _edges(path, np.array([0.2, 0.4, 0.6, 0.8]))
    for axis, law in (("m", "1.0"), ("z", "sign(omega_z, 0.1)"), ("m", "1.0 / sin_theta")):
        title = f"a moment M_{axis} by the load on a part of the table"
        yield title, "part of the table", ({f"load_{axis}": f"{step} * {law}"},), of_contact
    beyond = "(0.5 + 0.5 * sign(x * cos({direction}) + y * sin({direction}) - {edge}, 3e-4))"
    of_centre = _edges(q[:, :2], np.linspace(0.1, 0.9, 9))
    yield "a drag on a part of the table", "drag on a part", (_of_velocity(f" * {beyond}"),), of_centre


def _uneven(path: Array) -> Iterator[Row]:
    """A table that is not flat: ridges, grooves and steps, hills and dips.

    The contact moves by r phidot along n0 only, so that a height H of the table acts as M_m = -F_z r H' / sin theta
    with its slope H' along n0. The coefficient is the area or volume of the profile, or the height of the step, which
    hardly depends on the width.
    """
    off = f"(({_ALONG} - {{edge}}) / {{length}})"
    slope = "radius / sin_theta * cos(psi - {direction})"
    ridge = f"2.0 * {slope} * {off} * exp(-{off} * {off}) / ({{length}} * {{length}})"
    step = f"-{slope} * exp(-{off} * {off}) / (1.7724539 * {{length}})"
    lines = list[Shape]()
    for direction in np.arange(0, np.pi, np.pi / 12).tolist():
        across = path @ np.array([np.cos(direction), np.sin(direction)])
        edges = np.arange(across.min(), across.max(), 0.004).tolist()
        lines += [{"direction": direction, "edge": e, "length": length} for e in edges for length in (0.003, 0.008)]
    yield "a ridge or groove of the table", "ridge", ({"load_m": ridge},), lines
    yield "a step of the table", "step", ({"load_m": step},), lines
    from_x, from_y = f"({_CONTACT_X} - {{x0}})", f"({_CONTACT_Y} - {{y0}})"
    away2 = f"({from_x} * {from_x} + {from_y} * {from_y}) / ({{length}} * {{length}})"
    along_n0 = f"({_X} - {{x0}} * cos(psi) - {{y0}} * sin(psi))"
    over = "({length} * {length} * {length} * {length})"
    hill = f"2.0 * radius / sin_theta * {along_n0} * exp(-{away2}) / {over}"
    places = (np.unique(np.round(path / 0.006), axis=0) * 0.006).tolist()
    tops = [{"x0": x0, "y0": y0, "length": length} for x0, y0 in places for length in (0.005, 0.012)]
    yield "a hill or dip of the table", "hill", ({"load_m": hill},), tops
    for words, component, factor in (("the load", "load_m", "1.0"), ("psidot", "M_m", "psidot")):
        sticky = {component: f"{factor} * exp(-{away2})"}
        yield f"a moment M_m by {words} at a place of the table", f"place, {words}", (sticky,), tops


def _bumps() -> Iterator[Row]:
    """Dents of the rim, once per spin, and of the table, once per precession: braking, or up and down again."""
    wide = {width: np.arange(0, 2 * np.pi, max(width, 0.15)).tolist() for width in (0.08, 0.2, 0.5)}
    shapes = [{"angle": angle, "width": width} for width, angles in wide.items() for angle in angles]
    for angle, where in (("phi", "a spot of the rim"), ("psi", "a direction of the table")):
        # over its width: the integral hardly depends on the width
        bell = f"exp((cos({angle} - {{angle}}) - 1.0) / ({{width}} * {{width}})) / {{width}}"
        slope = f"sin({angle} - {{angle}}) / ({{width}} * {{width}}) * {bell}"
        for axis, words, law in (("m", "", bell), ("n", "", bell), ("m", ", up and down,", slope)):
            title = f"a moment M_{axis} by the load{words} when {where} touches"
            yield title, f"bump {angle}", ({f"load_{axis}": law},), shapes


def _hums(time: Array, frame_rate: float) -> Iterator[Row]:
    """Oscillations of a given frequency: a table that vibrates, an alternating field."""
    span, waves = float(time[-1] - time[0]), ("cos({rate} * time)", "sin({rate} * time)")
    frequencies = np.arange(2.0 / span, min(FASTEST_HUM, 0.45 * frame_rate), 0.6 / span)
    shapes = [{"rate": rate} for rate in (2 * np.pi * frequencies).tolist()]
    for axis in MOMENTS:
        yield f"a moment M_{axis} that swings", "hum M", tuple({f"M_{axis}": w} for w in waves), shapes
    level, upright = tuple(along(w) for along in (along_x, along_y) for w in waves), tuple({"X_z": w} for w in waves)
    yield "a vertical force that swings, as of a table that vibrates", "hum Z", upright, shapes
    yield "a force that swings, as of a table that vibrates", "hum X", (*level, *upright), shapes
