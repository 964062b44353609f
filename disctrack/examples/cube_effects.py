"""What the flight of a tossed cube may lack, and the residual that each effect leaves in it, to first order."""

from __future__ import annotations

from collections.abc import Callable, Sequence

import numpy as np

from calibration.arrays import Array
from disctrack.diagnosis.engine.system import Candidate, Quantity
from disctrack.examples.cube_data import HALF_WIDTH, Flight, Resting

GRAVITY = 9.81  # [m/s^2] as declared
UP = np.array([0.0, 0.0, 1.0])
_AXES = ("along", "across", "up")
_FACES = tuple((a, b) for a in range(3) for b in range(3))


def twice_integrated(flight: Flight, acceleration: Array) -> Array:
    """Displacement (n, 3) by an acceleration (n, 3), from rest at the first sample; trapezoids."""
    return once_integrated(flight, once_integrated(flight, acceleration))


def once_integrated(flight: Flight, rate: Array) -> Array:
    """Integral (n, 3) from the first sample."""
    dt = float(flight.time[1] - flight.time[0])
    steps = 0.5 * dt * (rate[1:] + rate[:-1])
    return np.concatenate([np.zeros((1, 3)), np.cumsum(steps, axis=0)])


def turned(flight: Flight, torque_world: Array) -> Array:
    """Turn (n, 3) in axes of the body by an angular acceleration (n, 3) in axes of the world.

    R = R_smooth exp(eta): eta' = R_smooth^T (change of the angular velocity).
    """
    change = once_integrated(flight, torque_world)
    return once_integrated(flight, np.einsum("nji,nj->ni", flight.turning, change))


def columns(flight: Flight, names: Sequence[str]) -> Array:
    """(n, 6, k) change of position [m] and turn [rad] by a unit of each named quantity."""
    found = np.zeros((len(flight.time), 6, len(names)))
    for i, name in enumerate(names):
        effect, _, part = name.partition(".")
        position, turn = _EFFECTS[effect](flight, part)
        if position is not None:
            found[:, :3, i] = position
        if turn is not None:
            found[:, 3:, i] = turn
    return found


def resting_columns(cubes: Sequence[Resting], names: Sequence[str]) -> Array:
    """(m, 4, k) change of the height [m], normal (along, across) and spin [rad/s] of a cube that rests on the table."""
    found = np.zeros((len(cubes), 4, len(names)))
    points = np.array([c.point for c in cubes]).reshape(-1, 3)
    for i, name in enumerate(names):
        effect, _, part = name.partition(".")
        if effect == "length_scale":
            found[:, 0, i] = HALF_WIDTH
        elif effect in ("table_height", "half_width"):
            found[:, 0, i] = 1.0
        elif effect in ("toss_tilt", "table_tilt"):
            which = _AXES.index(part)
            found[:, 0, i] = points[:, which]
            found[:, 1 + which, i] = -1.0
        elif effect == "tag_axes":
            found[:, 1:3, i] = [c.by_axes[:, int(part[-1]) - 1] for c in cubes]
        elif effect == "frame_rotation":
            found[:, 3, i] = 1.0
        elif effect == "perspective":
            found[:, 0, i] = points[:, 2] * points[:, _AXES.index(part)]
    return found


_Moved = tuple[Array | None, Array | None]


def _gravity(f: Flight, part: str) -> _Moved:
    return -UP * (f.time**2 / 2)[:, None], None


def _frame_rate(f: Flight, part: str) -> _Moved:
    return UP * (GRAVITY * f.time**2)[:, None], None  # true time is shorter if the true rate is higher


def _length_scale(f: Flight, part: str) -> _Moved:
    return -UP * (GRAVITY * f.time**2 / 2)[:, None], None


def _tilt(f: Flight, part: str) -> _Moved:
    return np.eye(3)["xy".index(part[-1])] * (GRAVITY * f.time**2 / 2)[:, None], None


def _toss_tilt(f: Flight, part: str) -> _Moved:
    return _axes(f)[_AXES.index(part)] * (GRAVITY * f.time**2 / 2)[:, None], None


def _axes(f: Flight) -> Array:
    return np.stack([f.along, f.across, UP])


def _linear_drag(f: Flight, part: str) -> _Moved:
    return twice_integrated(f, -f.velocity), None


def _quadratic_drag(f: Flight, part: str) -> _Moved:
    return twice_integrated(f, -f.velocity * np.linalg.norm(f.velocity, axis=1)[:, None]), None


def _side_force(f: Flight, part: str) -> _Moved:
    return twice_integrated(f, np.cross(UP, f.velocity)), None


def _magnus(f: Flight, part: str) -> _Moved:
    return twice_integrated(f, np.cross(f.omega, f.velocity)), None


def _frame_rotation(f: Flight, part: str) -> _Moved:
    # the room turns about the vertical by Omega t: place and attitude turn along, and so does the angular velocity
    place = np.cross(UP, f.path) * f.time[:, None]
    return place, np.einsum("nji,nj->ni", f.turning, UP * f.time[:, None])


def _centre_of_mass(f: Flight, part: str) -> _Moved:
    # the tags' centre is seen, which stands off by minus the offset of the centre of mass
    return -f.rotation[:, :, int(part[-1]) - 1], None


def _face_bias(f: Flight, part: str) -> _Moved:
    a, b = _FACES[int(part)]
    return _axes(f)[a] * np.abs(f.rotation[:, 2, b])[:, None], None


def _perspective(f: Flight, part: str) -> _Moved:
    return f.path * (f.path @ _axes(f)[_AXES.index(part)])[:, None], None


def _twist(f: Flight, part: str) -> _Moved:
    height = f.path[:, 2:]
    return np.cross(UP, f.path) * height, np.einsum("nji,nj->ni", f.turning, UP * height)


def _rotational_drag(f: Flight, part: str) -> _Moved:
    return None, turned(f, np.broadcast_to(-f.omega, f.position.shape))


def _inertia(f: Flight, part: str) -> _Moved:
    # J = J_0 (1 + E): omega' = -omega x (E omega) in axes of the body
    a, b = int(part[-2]) - 1, int(part[-1]) - 1
    E = np.zeros((3, 3))
    E[a, b] = E[b, a] = 1.0
    omega = np.einsum("nji,j->ni", f.turning, f.omega)
    torque = -np.cross(omega, omega @ E)
    return None, turned(f, np.einsum("nij,nj->ni", f.turning, torque))


def _side_torque(f: Flight, part: str) -> _Moved:
    return None, turned(f, np.broadcast_to(np.cross(UP, f.omega), f.position.shape))


def _clock_offset(f: Flight, part: str) -> _Moved:
    return f.velocity, None  # positions later than attitudes


def _smoothing(f: Flight, part: str) -> _Moved:
    return np.broadcast_to(-UP * GRAVITY / 24, f.position.shape), None


def _nothing(f: Flight, part: str) -> _Moved:
    return None, None


_EFFECTS: dict[str, Callable[[Flight, str], _Moved]] = {
    "gravity": _gravity,
    "frame_rate": _frame_rate,
    "length_scale": _length_scale,
    "tilt": _tilt,
    "toss_tilt": _toss_tilt,
    "linear_drag": _linear_drag,
    "quadratic_drag": _quadratic_drag,
    "side_force": _side_force,
    "magnus": _magnus,
    "frame_rotation": _frame_rotation,
    "centre_of_mass": _centre_of_mass,
    "face_bias": _face_bias,
    "perspective": _perspective,
    "twist": _twist,
    "rotational_drag": _rotational_drag,
    "principal_moments": _inertia,
    "products_of_inertia": _inertia,
    "side_torque": _side_torque,
    "clock_offset": _clock_offset,
    "smoothing": _smoothing,
    "table_height": _nothing,
    "half_width": _nothing,
    "table_tilt": _nothing,
    "tag_axes": _nothing,
}


def _q(name: str, unit: str, scale: float, typical: float, meaning: str, lower: float = -np.inf) -> Quantity:
    return Quantity(name, unit, scale, typical=typical, meaning=meaning, lower=lower)


def _candidates() -> tuple[Candidate, ...]:
    m, s = "motion", "measurement"
    return (
        Candidate("gravity", "gravity", m, "another gravity", "",
                  (_q("gravity.change", "m/s^2", 0.01, 0.01, "added to the declared one"),)),
        Candidate("frame_rate", "frame_rate", s, "frame rate wrong", "",
                  (_q("frame_rate.change", "1", 1e-3, 1e-3, "true over declared, minus 1"),)),
        Candidate("length_scale", "length_scale", s, "scale of the lengths wrong", "",
                  (_q("length_scale.change", "1", 1e-3, 0.02, "measured over true, minus 1"),)),
        Candidate("tilt", "tilt", s, "vertical wrong, the same way in the axes of the file for all tosses", "",
                  tuple(_q(f"tilt.beta_{a}", "rad", 1e-3, 0.01, f"gravity leans towards {a}") for a in "xy")),
        Candidate("toss_tilt", "toss_tilt", s, "vertical wrong, the same way in the axes of every toss", "",
                  tuple(_q(f"toss_tilt.{a}", "rad", 1e-3, 0.01, f"gravity leans {a} the flight")
                        for a in _AXES[:2])),
        Candidate("linear_drag", "linear_drag", m, "drag in proportion to the speed", "",
                  (_q("linear_drag.k", "1/s", 1e-2, 0.03, "deceleration over speed", 0.0),)),
        Candidate("quadratic_drag", "quadratic_drag", m, "drag in proportion to the square of the speed", "",
                  (_q("quadratic_drag.k", "1/m", 1e-2, 0.02, "deceleration over speed squared", 0.0),)),
        Candidate("side_force", "side_force", m, "force across the horizontal velocity, to its left", "",
                  (_q("side_force.c", "1/s", 1e-2, 0.01, "acceleration over speed"),)),
        Candidate("magnus", "magnus", m, "lift of the spinning cube (Magnus)", "",
                  (_q("magnus.c", "1", 1e-3, 0.004, "acceleration over omega x v"),)),
        Candidate("frame_rotation", "frame_rotation", s, "world axes turn about the vertical", "",
                  (_q("frame_rotation.rate", "rad/s", 1e-3, 1e-3, "of what is measured"),)),
        Candidate("centre_of_mass", "centre_of_mass", m, "centre of mass not in the centre of the tags", "",
                  tuple(_q(f"centre_of_mass.c_{i}", "m", 1e-3, 2e-3, f"along body axis {i}") for i in (1, 2, 3))),
        Candidate("principal_moments", "principal_moments", m, "moments of inertia not those of a uniform cube", "",
                  tuple(_q(f"principal_moments.e_{i}{i}", "1", 1e-2, 0.05, f"J_{i} over J_3, minus 1")
                        for i in (1, 2))),
        Candidate("products_of_inertia", "products_of_inertia", m, "products of inertia", "",
                  tuple(_q(f"products_of_inertia.e_{ij}", "1", 1e-2, 0.05, f"J_{ij} over J") for ij in (12, 13, 23))),
        Candidate("rotational_drag", "rotational_drag", m, "drag of the rotation", "",
                  (_q("rotational_drag.k", "1/s", 1e-2, 0.01, "deceleration over angular velocity", 0.0),)),
        Candidate("side_torque", "side_torque", m, "torque that turns the angular velocity about the vertical", "",
                  (_q("side_torque.c", "1/s", 1e-2, 0.01, "rate of turning"),)),
        Candidate("twist", "twist", s, "measured place and attitude turn about the vertical with height", "",
                  (_q("twist.a", "rad/m", 1e-2, 0.01, "angle over height"),)),
        Candidate("perspective", "perspective", s, "scale of the lengths changes with place", "",
                  tuple(_q(f"perspective.{a}", "1/m", 1e-3, 5e-3, f"of the scale, {a}") for a in _AXES)),
        Candidate("face_bias", "face_bias", s, "error of place that depends on which faces look up", "",
                  tuple(_q(f"face_bias.{i}", "m", 1e-4, 5e-4, f"of {_AXES[a]} by body axis {b + 1}")
                        for i, (a, b) in enumerate(_FACES))),
        Candidate("clock_offset", "clock_offset", s, "positions later than attitudes", "",
                  (_q("clock_offset.delay", "s", 1e-4, 1e-3, "of the positions"),)),
        Candidate("smoothing", "smoothing", s, "exposure, or smoothing of the positions", "",
                  (_q("smoothing.T2", "s^2", 1e-6, 1e-5, "square of its duration"),)),
        Candidate("table_height", "table_height", s, "table not at height zero", "",
                  (_q("table_height.z", "m", 1e-4, 1e-3, "height of the table"),)),
        Candidate("half_width", "half_width", s, "half width of the cube wrong", "",
                  (_q("half_width.change", "m", 1e-4, 5e-4, "true minus declared"),)),
        Candidate("tag_axes", "tag_axes", s, "axes of the tags turned against those of the cube", "",
                  tuple(_q(f"tag_axes.turn_{i}", "rad", 1e-4, 5e-3, f"about body axis {i}") for i in (1, 2, 3))),
        Candidate("table_tilt", "table_tilt", s, "table leans against the vertical", "",
                  tuple(_q(f"table_tilt.{a}", "rad", 1e-4, 1e-2, f"rises {a} the flight") for a in _AXES[:2])),
    )  # fmt: skip


CANDIDATES = _candidates()
