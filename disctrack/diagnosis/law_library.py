"""Laws that no catalogue names, as they are asked of a residual: moments and forces by position, rate, attitude, time.

A family of terms shares what it means; each term sets components of the wrench by formulas in the names of
records.KINEMATICS and gets a coefficient of its own. Numbers in braces are the shape of a law (where a gate stands, how
fast something hums): a grid of them is looked over, and the best is fitted along with the coefficients.
"""

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field

import numpy as np

from calibration.kit.arrays import Array
from disctrack.disc import Disc

Parts = Mapping[str, str]  # component of the wrench -> formula

HIGHEST_HARMONIC = 4  # of the angles
DRIFT_DEGREE = 4  # of the polynomials in time
FASTEST_HUM = 150.0  # [Hz]
MOMENTS = ("n", "m", "z")

# Of the motion's own numbers: (words, formula).
SCALARS = (
    ("constant", "1.0"),
    ("sign omega_z", "sign(omega_z, 0.1)"),
    ("omega_z", "omega_z"),
    ("omega_z |omega_z|", "omega_z * magnitude(omega_z)"),
    ("omega_z^3", "omega_z * omega_z * omega_z"),
    ("thetadot", "thetadot"),
    ("thetadot |thetadot|", "thetadot * magnitude(thetadot)"),
    ("psidot", "psidot"),
    ("psidot |psidot|", "psidot * magnitude(psidot)"),
    ("psidot^3", "psidot * psidot * psidot"),
    ("psidot sin theta", "omega2"),
    ("phidot sin theta", "phidot * sin_theta"),
    ("omega_3", "omega3"),
    ("sin theta", "sin_theta"),
    ("1 / sin theta", "1.0 / sin_theta"),
    ("1 / sin^2 theta", "1.0 / (sin_theta * sin_theta)"),
    ("time", "time"),
)
FOR_FORCES = 14  # of them, that are tried for forces, too
_SPEED = "sqrt(v_n * v_n + v_m * v_m + 1e-12)"
_X, _Y = "(x * cos(psi) + y * sin(psi))", "(y * cos(psi) - x * sin(psi))"  # the place along n0 and m0
# the contact's place on the table: O minus (r cos theta - h sin theta) m0
_ARM = "(radius * cos_theta - half_thickness * sin_theta)"
_CONTACT_X, _CONTACT_Y = f"(x + {_ARM} * sin(psi))", f"(y - {_ARM} * cos(psi))"


@dataclass(frozen=True)
class Family:
    """Terms that belong together."""

    title: str
    terms: tuple[Parts, ...]
    shape: Mapping[str, float] = field(default_factory=dict)  # numbers in braces
    kind: str = "moment"  # families of one kind are variations of one idea

    @property
    def n_numbers(self) -> int:
        """Numbers that a fit would move."""
        return len(self.terms) + len(self.shape)

    def formulas(self) -> tuple[Parts, ...]:
        """The terms with the shape's numbers in place."""
        numbers = {k: f"({v!r})" for k, v in self.shape.items()}
        return tuple({c: f.format(**numbers) for c, f in parts.items()} for parts in self.terms)


def along_x(formula: str = "1.0") -> Parts:
    """A force along i of the world."""
    return {"X_n": f"({formula}) * cos(psi)", "X_m": f"-({formula}) * sin(psi)"}


def along_y(formula: str = "1.0") -> Parts:
    """A force along j of the world."""
    return {"X_n": f"({formula}) * sin(psi)", "X_m": f"({formula}) * cos(psi)"}


def families(q: Array, time: Array, frame_rate: float, disc: Disc) -> Iterator[Family]:
    """The library for a motion q (N, 6) of a disc at the instants (N,) [s]."""
    path = _path_of_contact(q, disc)
    for axis in MOMENTS:
        for words, formula in SCALARS:
            yield Family(f"a moment M_{axis} by {words}", ({f"M_{axis}": formula},))
        yield from _angular(axis)
    yield from _places()
    yield from _magnets()
    for words, formula in SCALARS[:FOR_FORCES]:
        yield Family(f"a force X_z by {words}", ({"X_z": formula},), kind="lift")
    yield from _drifts(time)
    yield from _gates(q, time, path)
    yield from _bumps()
    yield from _uneven(q, path)
    yield from _hums(time, frame_rate)


def _path_of_contact(q: Array, disc: Disc) -> Array:
    """Places (N, 2) [m] where the disc touches the table: the numbers of _CONTACT_X and _CONTACT_Y."""
    psi, theta = q[:, 3], q[:, 4]
    arm = disc.radius * np.cos(theta) - disc.half_thickness * np.sin(theta)
    return q[:, :2] + arm[:, None] * np.stack([np.sin(psi), -np.cos(psi)], axis=1)


def _angular(axis: str) -> Iterator[Family]:
    for angle in ("psi", "phi", "(psi + phi)"):
        for n in range(1, HIGHEST_HARMONIC + 1 if angle != "(psi + phi)" else 2):
            pair = tuple({f"M_{axis}": f"{f}({n}.0 * {angle})"} for f in ("cos", "sin"))
            title = f"a moment M_{axis} by the angle {n if n > 1 else ''}{angle}"
            yield Family(title, pair, kind="angle")
            for words, factor in (("sin theta", "sin_theta"), ("1 / sin theta", "1.0 / sin_theta"), ("time", "time")):
                grown = tuple({c: f"{f} * {factor}" for c, f in parts.items()} for parts in pair)
                yield Family(f"{title}, times {words}", grown, kind="angle")


def _places() -> Iterator[Family]:
    """Forces by the place and the velocity of the centre. A constant one is a tilt, and moves the point of rest."""
    towards = {"X_n": f"-{_X}", "X_m": f"-{_Y}"}
    constant = (along_x(), along_y())
    yield Family("a force towards a point, in proportion to the distance", (towards, *constant), kind="place")
    cubic = {c: f"{f} * (x * x + y * y)" for c, f in towards.items()}
    yield Family("a force towards a point that grows as the distance cubed", (cubic, *constant), kind="place")
    stiffness = (along_x("-x"), along_y("-y"), {c: f"{along_x('-y')[c]} + {along_y('-x')[c]}" for c in ("X_n", "X_m")})
    yield Family("a force by a stiffness that differs with the direction", (*stiffness, *constant), kind="place")
    distance = "sqrt(x * x + y * y + 1e-6)"
    square = {c: f"{f} * {distance}" for c, f in towards.items()}
    yield Family("a force towards a point that grows as the distance squared", (square, *constant), kind="place")
    thread = {c: f"{f} / {distance}" for c, f in towards.items()}
    yield Family("a force of constant size towards the origin", (thread, *constant), kind="place")
    yield Family("a drag that grows as the speed squared", ({c: f"-v_{c[-1]} * {_SPEED}" for c in ("X_n", "X_m")},))
    yield Family("a drag of constant size", ({c: f"-v_{c[-1]} / {_SPEED}" for c in ("X_n", "X_m")},), kind="drag")
    yield Family("a drag that differs with the direction", (*_by_velocity(),), kind="drag")
    round_it = (along_x("-y"), along_y("x"))
    turning_air = {c: f"{round_it[0][c]} + {round_it[1][c]}" for c in ("X_n", "X_m")}
    drag = {c: f"-v_{c[-1]}" for c in ("X_n", "X_m")}
    yield Family("a drag in air that turns about a point", (drag, turning_air, *constant), kind="drag")
    lateral = {"X_n": "-v_m * omega_z", "X_m": "v_n * omega_z"}
    yield Family("a force across the velocity, by omega_z", (lateral,), kind="drag")
    across = {"X_n": "-v_m", "X_m": "v_n"}
    yield Family("a force across the velocity", (across,), kind="drag")
    for n in ("X_n", "X_m"):
        for words, formula in SCALARS[:FOR_FORCES]:
            yield Family(f"a force {n} by {words}", ({n: formula},), kind="force")
    body = ("cos(psi + phi)", "sin(psi + phi)")
    turning = tuple(f(g) for f in (along_x, along_y) for g in body)
    yield Family("a force that turns with the face", turning, kind="force")


def _by_velocity() -> Iterator[Parts]:
    """Forces by a symmetric matrix times the velocity, in axes of the world."""
    v_x, v_y = "(v_n * cos(psi) - v_m * sin(psi))", "(v_n * sin(psi) + v_m * cos(psi))"
    yield along_x(f"-{v_x}")
    yield along_y(f"-{v_y}")
    across = along_x(f"-{v_y}"), along_y(f"-{v_x}")
    yield {c: f"{across[0][c]} + {across[1][c]}" for c in ("X_n", "X_m")}


def _drifts(time: Array) -> Iterator[Family]:
    """What changes slowly: a draught, a table that settles, a magnet that is moved away; friction, as surfaces do.

    Friction that lags behind the motion follows no rate of the instant, and changes with time as its mean does.
    """
    middle, half = 0.5 * float(time[0] + time[-1]), 0.5 * float(time[-1] - time[0])
    u = f"((time - {middle!r}) / {half!r})"
    powers = [" * ".join([u] * n) or "1.0" for n in range(DRIFT_DEGREE + 1)]
    for n in range(1, DRIFT_DEGREE + 1):
        level = tuple(along(f) for f in powers[: n + 1] for along in (along_x, along_y))
        yield Family(f"a level force that changes with time, degree {n}", level, kind="drift")
        upright = tuple({"X_z": f} for f in powers[: n + 1])
        yield Family(f"a vertical force that changes with time, degree {n}", upright, kind="drift Z")
        for axis in ("m", "z"):
            friction = tuple({f"load_{axis}": f} for f in powers[: n + 1])
            yield Family(f"a moment M_{axis} by the load that changes with time, degree {n}", friction, kind="drift M")


def _magnets() -> Iterator[Family]:
    """A magnetic moment of the disc in a field of the room: m x B, with m in body axes and B in world axes."""
    first = ("cos(phi)", "sin(phi) * cos_theta", "sin(phi) * sin_theta")  # body axis 1 along n0, m0, k
    second = ("-sin(phi)", "cos(phi) * cos_theta", "cos(phi) * sin_theta")
    third = ("0.0", "-sin_theta", "cos_theta")
    along_i, along_j, along_k = ("cos(psi)", "-sin(psi)", "0.0"), ("sin(psi)", "cos(psi)", "0.0"), ("0.0", "0.0", "1.0")

    def cross(a: Sequence[str], b: Sequence[str]) -> Parts:
        pairs = ((1, 2), (2, 0), (0, 1))
        product = [f"({a[i]}) * ({b[j]}) - ({a[j]}) * ({b[i]})" for i, j in pairs]
        return {f"M_{axis}": p for axis, p in zip(MOMENTS, product, strict=True)}

    in_plane = tuple(cross(a, b) for a in (first, second) for b in (along_i, along_j))
    yield Family("a magnet in the face, in a horizontal field", in_plane, kind="magnet")
    yield Family("a magnet in the face, in a vertical field", (cross(first, along_k), cross(second, along_k)),
                 kind="magnet")  # fmt: skip
    yield Family("a magnet along the axis, in a horizontal field", (cross(third, along_i), cross(third, along_j)),
                 kind="magnet")  # fmt: skip
    yield Family("a magnet along the axis, in a vertical field", (cross(third, along_k),), kind="magnet")


def _gates(q: Array, time: Array, path: Array) -> Iterator[Family]:
    """What begins at a nutation, at an instant or at a place."""
    s = np.sin(q[:, 4])
    for share in np.linspace(0.05, 0.95, 13):
        edge = float(np.quantile(s, share))
        shape = {"edge": edge, "softness": max(0.03 * edge, 1e-3)}
        # its tails end within some widths: one that falls as a power acts everywhere, and moves the edge
        step = "1.0 / (1.0 + exp((sin_theta - {edge}) / {softness}))"
        for axis in MOMENTS:
            for words, law in (("", "1.0"), (" over sin theta", "1.0 / sin_theta")):
                title = f"a moment M_{axis} by the load{words} that acts below a nutation"
                yield Family(title, ({f"load_{axis}": f"{step} * {law}"},), shape, "below a nutation")
    span = float(time[-1] - time[0])
    for share in np.linspace(0.03, 0.97, 32):
        at = float(time[0] + share * span)
        after = "(0.5 + 0.5 * sign(time - {instant}, 0.002))"
        pulse = "exp(-0.5 * ((time - {instant}) / 0.01) ** 2)"
        for axis in MOMENTS:
            yield Family(
                f"a moment M_{axis} from an instant on", ({f"M_{axis}": after},), {"instant": at}, "from then on"
            )
        for words, law, kind in (("from an instant on", after, "from then on"), ("during 20 ms", pulse, "pulse")):
            push = (along_x(law), along_y(law), {"X_z": law})
            yield Family(f"a force {words}", push, {"instant": at}, kind)
        yield Family("a moment during 20 ms", tuple({f"M_{a}": pulse} for a in MOMENTS), {"instant": at}, "pulse")
    for angle in np.arange(0, 2 * np.pi, np.pi / 6):
        along = path @ np.array([np.cos(angle), np.sin(angle)])
        place = f"({_CONTACT_X} * cos({{direction}}) + {_CONTACT_Y} * sin({{direction}}))"
        for share in (0.2, 0.4, 0.6, 0.8):
            edge = float(np.quantile(along, share))
            step = f"(0.5 + 0.5 * sign({place} - {{edge}}, 1e-3))"
            shape = {"direction": float(angle), "edge": edge}
            for axis, law in (("m", "1.0"), ("z", "sign(omega_z, 0.1)"), ("m", "1.0 / sin_theta")):
                title = f"a moment M_{axis} by the load on a part of the table"
                yield Family(title, ({f"load_{axis}": f"{step} * {law}"},), shape, "part of the table")


def _uneven(q: Array, path: Array) -> Iterator[Family]:
    """A table that is not flat: ridges, grooves and steps, hills and dips, and a drag over a part of it, by where.

    The place of touch moves by r phidot along n0 only, so that a height H of the table acts as M_m = -F_z r H' / sin
    theta, H' its slope along n0. The number is the profile's area or volume, or the step's height: it hardly depends
    on the width.
    """
    along = f"({_CONTACT_X} * cos({{direction}}) + {_CONTACT_Y} * sin({{direction}}))"
    off = f"(({along} - {{edge}}) / {{length}})"
    ridge = (
        f"2.0 * radius / sin_theta * cos(psi - {{direction}}) * {off} * exp(-{off} * {off}) / ({{length}} * {{length}})"
    )
    step = f"-radius / sin_theta * cos(psi - {{direction}}) * exp(-{off} * {off}) / (1.7724539 * {{length}})"
    for direction in np.arange(0, np.pi, np.pi / 12):
        across = path @ np.array([np.cos(direction), np.sin(direction)])
        for edge in np.arange(across.min(), across.max(), 0.004):
            for length in (0.003, 0.008):
                shape = {"direction": float(direction), "edge": float(edge), "length": length}
                yield Family("a ridge or groove of the table", ({"load_m": ridge},), shape, "ridge")
                yield Family("a step of the table", ({"load_m": step},), shape, "step")
    from_x, from_y = f"({_CONTACT_X} - {{x0}})", f"({_CONTACT_Y} - {{y0}})"
    away2 = f"({from_x} * {from_x} + {from_y} * {from_y}) / ({{length}} * {{length}})"
    along_n0 = f"({_X} - {{x0}} * cos(psi) - {{y0}} * sin(psi))"
    hill = (
        f"2.0 * radius / sin_theta * {along_n0} * exp(-{away2}) / ({{length}} * {{length}} * {{length}} * {{length}})"
    )
    for x0, y0 in np.unique(np.round(path / 0.006), axis=0) * 0.006:
        for length in (0.005, 0.012):
            shape = {"x0": float(x0), "y0": float(y0), "length": length}
            yield Family("a hill or dip of the table", ({"load_m": hill},), shape, "hill")
    beyond = "(0.5 + 0.5 * sign(x * cos({direction}) + y * sin({direction}) - {edge}, 3e-4))"
    drag = {c: f"-v_{c[-1]} * {beyond}" for c in ("X_n", "X_m")}
    for direction in np.arange(0, 2 * np.pi, np.pi / 6):
        across = q[:, :2] @ np.array([np.cos(direction), np.sin(direction)])
        for share in np.linspace(0.1, 0.9, 9):
            shape = {"direction": float(direction), "edge": float(np.quantile(across, share))}
            yield Family("a drag on a part of the table", (drag,), shape, "drag on a part")


def _bumps() -> Iterator[Family]:
    """Dents of the rim, once a turn of the disc, and of the table, once a precession: braking, or up and down again."""
    for angle, words in (("phi", "a spot of the rim"), ("psi", "a direction of the table")):
        for width in (0.08, 0.2, 0.5):
            for at in np.arange(0, 2 * np.pi, max(width, 0.15)):
                # over its width: what a dent does in all hardly depends on how wide it is
                bell = f"exp((cos({angle} - {{angle}}) - 1.0) / ({{width}} * {{width}})) / {{width}}"
                shape = {"angle": float(at), "width": width}
                for axis in ("m", "n"):
                    title = f"a moment M_{axis} by the load when {words} touches"
                    yield Family(title, ({f"load_{axis}": bell},), shape, f"bump {angle}")
                slope = f"sin({angle} - {{angle}}) / ({{width}} * {{width}}) * {bell}"
                yield Family(
                    f"a moment M_m by the load, up and down, when {words} touches",
                    ({"load_m": slope},),
                    shape,
                    f"bump {angle}",
                )


def _hums(time: Array, frame_rate: float) -> Iterator[Family]:
    """What swings with a frequency of its own: a table that vibrates, a field that alternates."""
    span = float(time[-1] - time[0])
    fastest = min(FASTEST_HUM, 0.45 * frame_rate)
    for f in np.arange(2.0 / span, fastest, 0.6 / span):
        waves, shape = ("cos({rate} * time)", "sin({rate} * time)"), {"rate": float(2 * np.pi * f)}
        for axis in MOMENTS:
            yield Family(f"a moment M_{axis} that swings", tuple({f"M_{axis}": w} for w in waves), shape, "hum M")
        level = tuple(along(w) for along in (along_x, along_y) for w in waves)
        upright = tuple({"X_z": w} for w in waves)
        yield Family("a vertical force that swings, as of a table that vibrates", upright, shape, "hum Z")
        yield Family("a force that swings, as of a table that vibrates", (*level, *upright), shape, "hum X")
