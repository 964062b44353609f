"""What a tossed cube may lack, and what each effect leaves in its flight and where it rests, to first order."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np

from calibration.kit.arrays import Array
from disctrack.discrepancy.system import Candidate, Quantity
from disctrack.examples.cube_data import HALF_WIDTH, Flight, Resting

GRAVITY = 9.81  # [m/s^2] as declared
UP = np.array([0.0, 0.0, 1.0])
_AXES = ("along", "across", "up")
_FACES = tuple((a, b) for a in range(3) for b in range(3))


@dataclass(frozen=True)
class CubeEffect:
    """A candidate, and what a unit of one of its quantities (by its name's last part) changes."""

    candidate: Candidate
    flown: Callable[[Flight, str], Array]  # (n, 6) position [m] and turn in axes of the body [rad]
    rested: Callable[[Resting, str], Sequence[float]]  # height [m], normal along and across, spin [rad/s]


def columns(flight: Flight, names: Sequence[str]) -> Array:
    """(n, 6, k) change of position [m] and turn [rad] by a unit of each named quantity."""
    return np.stack([_BY_NAME[effect].flown(flight, part) for effect, _, part in _split(names)], axis=-1)


def resting_columns(cubes: Sequence[Resting], names: Sequence[str]) -> Array:
    """(m, 4, k) change of what is seen of cubes that rest on the table."""
    changes = [[_BY_NAME[effect].rested(c, part) for c in cubes] for effect, _, part in _split(names)]
    return np.moveaxis(np.array(changes, float).reshape(len(names), len(cubes), 4), 0, -1)


def _split(names: Sequence[str]) -> list[tuple[str, str, str]]:
    return [name.partition(".") for name in names]


def _integrated(flight: Flight, rate: Array) -> Array:
    """Integral (n, 3) from the first sample; trapezoids."""
    dt = float(flight.time[1] - flight.time[0])
    steps = 0.5 * dt * (rate[1:] + rate[:-1])
    return np.concatenate([np.zeros((1, 3)), np.cumsum(steps, axis=0)])


def _moved(f: Flight, position: Array | None = None, turn: Array | None = None) -> Array:
    still = np.zeros(f.position.shape)
    return np.concatenate([still if part is None else still + part for part in (position, turn)], axis=1)


def _pushed(flight: Flight, acceleration: Array) -> Array:
    return _moved(flight, _integrated(flight, _integrated(flight, acceleration)))


def _twisted(flight: Flight, acceleration: Array) -> Array:
    """By an angular acceleration in axes of the world. R = R_smooth exp(eta): eta' = R_smooth^T (change of omega)."""
    change = _integrated(flight, np.broadcast_to(acceleration, flight.position.shape))
    return _moved(flight, turn=_integrated(flight, _in_body(flight, change)))


def _in_body(flight: Flight, vectors: Array) -> Array:
    return np.einsum("nji,nj->ni", flight.turning, np.broadcast_to(vectors, flight.position.shape))


def _fallen(flight: Flight, direction: Array) -> Array:
    return _moved(flight, direction * (GRAVITY * flight.time**2 / 2)[:, None])


def _axes(f: Flight) -> dict[str, Array]:
    return dict(zip(_AXES, (f.along, f.across, UP), strict=True))


def _inertia(f: Flight, part: str) -> Array:
    # J = J_0 (1 + E): omega' = -omega x (E omega) in axes of the body
    a, b = int(part[-2]) - 1, int(part[-1]) - 1
    E = np.zeros((3, 3))
    E[a, b] = E[b, a] = 1.0
    omega = _in_body(f, f.omega)
    return _twisted(f, np.einsum("nij,nj->ni", f.turning, -np.cross(omega, omega @ E)))


def _face_bias(f: Flight, part: str) -> Array:
    a, b = _FACES[int(part)]
    return _moved(f, _axes(f)[_AXES[a]] * np.abs(f.rotation[:, 2, b])[:, None])


def _leans(c: Resting, part: str) -> tuple[float, ...]:
    return c.point[_AXES.index(part)], -1.0 * (part == "along"), -1.0 * (part == "across"), 0.0


def _effect(
    name: str, kind: str, title: str, size: tuple[str, float, float], parts: dict[str, str],
    flown: Callable[[Flight, str], Array] = lambda f, part: _moved(f),
    rested: Callable[[Resting, str], Sequence[float]] = lambda c, part: (0.0, 0.0, 0.0, 0.0),
    lower: float = -np.inf,
) -> CubeEffect:  # fmt: skip
    """An effect; size : unit, step and typical size; parts : meaning of its quantities by their names' last part."""
    unit, step, typical = size
    own = tuple(
        Quantity(f"{name}.{part}", unit, step, typical=typical, meaning=meaning, lower=lower)
        for part, meaning in parts.items()
    )
    return CubeEffect(Candidate(name, name, kind, title, "", own), flown, rested)


_M, _S = "motion", "measurement"
_EFFECTS = (
    _effect("gravity", _M, "another gravity", ("m/s^2", 0.01, 0.01), {"change": "added to the declared one"},
            lambda f, part: _fallen(f, -UP / GRAVITY)),
    _effect("frame_rate", _S, "frame rate wrong", ("1", 1e-3, 1e-3), {"change": "true over declared, minus 1"},
            lambda f, part: _fallen(f, 2 * UP)),  # true time is shorter if the true rate is higher
    _effect("length_scale", _S, "scale of the lengths wrong", ("1", 1e-3, 0.02),
            {"change": "measured over true, minus 1"}, lambda f, part: _fallen(f, -UP),
            lambda c, part: (HALF_WIDTH, 0.0, 0.0, 0.0)),
    _effect("tilt", _S, "vertical wrong, the same way in the axes of the file for all tosses", ("rad", 1e-3, 0.01),
            {f"beta_{a}": f"gravity leans towards {a}" for a in "xy"},
            lambda f, part: _fallen(f, np.eye(3)["xy".index(part[-1])])),
    _effect("toss_tilt", _S, "vertical wrong, the same way in the axes of every toss", ("rad", 1e-3, 0.01),
            {a: f"gravity leans {a} the flight" for a in _AXES[:2]}, lambda f, part: _fallen(f, _axes(f)[part]),
            _leans),
    _effect("linear_drag", _M, "drag in proportion to the speed", ("1/s", 1e-2, 0.03), {"k": "deceleration over speed"},
            lambda f, part: _pushed(f, -f.velocity), lower=0.0),
    _effect("quadratic_drag", _M, "drag in proportion to the square of the speed", ("1/m", 1e-2, 0.02),
            {"k": "deceleration over speed squared"},
            lambda f, part: _pushed(f, -f.velocity * np.linalg.norm(f.velocity, axis=1)[:, None]), lower=0.0),
    _effect("side_force", _M, "force across the horizontal velocity, to its left", ("1/s", 1e-2, 0.01),
            {"c": "acceleration over speed"}, lambda f, part: _pushed(f, np.cross(UP, f.velocity))),
    _effect("magnus", _M, "lift of the spinning cube (Magnus)", ("1", 1e-3, 0.004),
            {"c": "acceleration over omega x v"}, lambda f, part: _pushed(f, np.cross(f.omega, f.velocity))),
    # the room turns about the vertical by Omega t: place and attitude turn along, and so does the angular velocity
    _effect("frame_rotation", _S, "world axes turn about the vertical", ("rad/s", 1e-3, 1e-3),
            {"rate": "of what is measured"},
            lambda f, part: _moved(f, np.cross(UP, f.path) * f.time[:, None], _in_body(f, UP * f.time[:, None])),
            lambda c, part: (0.0, 0.0, 0.0, 1.0)),
    # the tags' centre is seen, which stands off by minus the offset of the centre of mass
    _effect("centre_of_mass", _M, "centre of mass not in the centre of the tags", ("m", 1e-3, 2e-3),
            {f"c_{i}": f"along body axis {i}" for i in (1, 2, 3)},
            lambda f, part: _moved(f, -f.rotation[:, :, int(part[-1]) - 1])),
    _effect("principal_moments", _M, "moments of inertia not those of a uniform cube", ("1", 1e-2, 0.05),
            {f"e_{i}{i}": f"J_{i} over J_3, minus 1" for i in (1, 2)}, _inertia),
    _effect("products_of_inertia", _M, "products of inertia", ("1", 1e-2, 0.05),
            {f"e_{ij}": f"J_{ij} over J" for ij in (12, 13, 23)}, _inertia),
    _effect("rotational_drag", _M, "drag of the rotation", ("1/s", 1e-2, 0.01),
            {"k": "deceleration over angular velocity"}, lambda f, part: _twisted(f, -f.omega), lower=0.0),
    _effect("side_torque", _M, "torque that turns the angular velocity about the vertical", ("1/s", 1e-2, 0.01),
            {"c": "rate of turning"}, lambda f, part: _twisted(f, np.cross(UP, f.omega))),
    _effect("twist", _S, "measured place and attitude turn about the vertical with height", ("rad/m", 1e-2, 0.01),
            {"a": "angle over height"},
            lambda f, part: _moved(f, np.cross(UP, f.path) * f.path[:, 2:], _in_body(f, UP * f.path[:, 2:]))),
    _effect("perspective", _S, "scale of the lengths changes with place", ("1/m", 1e-3, 5e-3),
            {a: f"of the scale, {a}" for a in _AXES},
            lambda f, part: _moved(f, f.path * (f.path @ _axes(f)[part])[:, None]),
            lambda c, part: (c.point[2] * c.point[_AXES.index(part)], 0.0, 0.0, 0.0)),
    _effect("face_bias", _S, "error of place that depends on which faces look up", ("m", 1e-4, 5e-4),
            {f"{i}": f"of {_AXES[a]} by body axis {b + 1}" for i, (a, b) in enumerate(_FACES)}, _face_bias),
    _effect("clock_offset", _S, "positions later than attitudes", ("s", 1e-4, 1e-3), {"delay": "of the positions"},
            lambda f, part: _moved(f, f.velocity)),
    _effect("smoothing", _S, "exposure, or smoothing of the positions", ("s^2", 1e-6, 1e-5),
            {"T2": "square of its duration"},
            lambda f, part: _moved(f, -UP * GRAVITY / 24)),
    _effect("table_height", _S, "table not at height zero", ("m", 1e-4, 1e-3), {"z": "height of the table"},
            rested=lambda c, part: (1.0, 0.0, 0.0, 0.0)),
    _effect("half_width", _S, "half width of the cube wrong", ("m", 1e-4, 5e-4), {"change": "true minus declared"},
            rested=lambda c, part: (1.0, 0.0, 0.0, 0.0)),
    _effect("tag_axes", _S, "axes of the tags turned against those of the cube", ("rad", 1e-4, 5e-3),
            {f"turn_{i}": f"about body axis {i}" for i in (1, 2, 3)},
            rested=lambda c, part: (0.0, *c.by_axes[:, int(part[-1]) - 1], 0.0)),
    _effect("table_tilt", _S, "table leans against the vertical", ("rad", 1e-4, 1e-2),
            {a: f"rises {a} the flight" for a in _AXES[:2]}, rested=_leans),
)  # fmt: skip
CANDIDATES = tuple(effect.candidate for effect in _EFFECTS)
_BY_NAME = {effect.candidate.name: effect for effect in _EFFECTS}
