"""What a tossed cube may lack, and what each effect leaves in its flight and where it rests, to first order."""

from collections.abc import Mapping, Sequence

import numpy as np
from numpy.typing import ArrayLike

from calibration.kit.arrays import Array
from disctrack.examples._command import GRAVITY, effect
from disctrack.examples.cube_data import HALF_WIDTH, UP, Flight, integrated

REST = 8  # last samples of a toss
LEVEL = ("along", "across")  # the flight
AXES = (*LEVEL, "up")

_M, _S = "motion", "measurement"
CANDIDATES = (
    effect("gravity", _M, "another gravity", "m/s^2", 0.01, "change"),
    effect("frame_rate", _S, "frame rate wrong", "1", 1e-3, "change"),
    effect("length_scale", _S, "scale of the lengths wrong", "1", 0.02, "change"),
    effect("tilt", _S, "vertical wrong, the same way in the axes of the file for all tosses", "rad", 0.01, "beta_x",
           "beta_y"),
    effect("toss_tilt", _S, "vertical wrong, the same way in the axes of every toss", "rad", 0.01, *LEVEL),
    effect("linear_drag", _M, "drag in proportion to the speed", "1/s", 0.03, "k",
           bounds=(0.0, np.inf)),
    effect("quadratic_drag", _M, "drag in proportion to the square of the speed", "1/m", 0.02, "k",
           bounds=(0.0, np.inf)),
    effect("side_force", _M, "force across the horizontal velocity, to its left", "1/s", 0.01, "c"),
    effect("magnus", _M, "lift of the spinning cube (Magnus)", "1", 0.004, "c"),
    effect("frame_rotation", _S, "world axes turn about the vertical", "rad/s", 1e-3, "rate"),
    effect("centre_of_mass", _M, "centre of mass not in the centre of the tags", "m", 2e-3, "c_1", "c_2", "c_3"),
    effect("principal_moments", _M, "moments of inertia not those of a uniform cube", "1", 0.05, "e_11", "e_22"),
    effect("products_of_inertia", _M, "products of inertia", "1", 0.05, "e_12", "e_13", "e_23"),
    effect("rotational_drag", _M, "drag of the rotation", "1/s", 0.01, "k", bounds=(0.0, np.inf)),
    effect("side_torque", _M, "torque that turns the angular velocity about the vertical", "1/s", 0.01, "c"),
    effect("twist", _S, "measured place and attitude turn about the vertical with height", "rad/m", 0.01, "a"),
    effect("perspective", _S, "scale of the lengths changes with place", "1/m", 5e-3, *AXES),
    effect("face_bias", _S, "error of place that depends on which faces look up", "m", 5e-4,
           *(f"{a}_{i}" for i in "123" for a in AXES)),
    effect("clock_offset", _S, "positions later than attitudes", "s", 1e-3, "delay"),
    effect("smoothing", _S, "exposure, or smoothing of the positions", "s^2", 1e-5, "T2"),
    effect("table_height", _S, "table not at height zero, or another half width of the cube", "m", 1e-3, "z"),
    effect("tag_axes", _S, "axes of the tags turned against those of the cube", "rad", 5e-3,
           "turn_1", "turn_2", "turn_3"),
    effect("table_tilt", _S, "table leans against the vertical", "rad", 1e-2, *LEVEL),
)  # fmt: skip

QUANTITIES = tuple(q for c in CANDIDATES for q in c.quantities)
COLUMN = {q.name: i for i, q in enumerate(QUANTITIES)}


def _columns(seen: Array, changes: Mapping[str, ArrayLike]) -> Array:
    """(..., k + 1) changes of what is seen (...) by QUANTITIES, zero where none is named, and that itself."""
    return np.stack([*(np.broadcast_to(changes.get(name, 0.0), seen.shape) for name in COLUMN), seen], axis=-1)


def flown(f: Flight) -> Array:
    """(n, 6, k + 1 + 12) by QUANTITIES, measured minus base model [m], [rad], and by what is the flight's own.

    That is place, velocity, attitude and angular velocity, three numbers each.
    """
    fallen = f.position + GRAVITY / 2 * f.time[:, None] ** 2 * UP
    seen = np.concatenate([fallen, f.turn], axis=1)
    own = np.zeros((*seen.shape, 12))
    own[:, :3, :3], own[:, :3, 3:6] = np.eye(3), f.time[:, None, None] * np.eye(3)
    own[:, 3:, 6:9], own[:, 3:, 9:] = np.eye(3), integrated(np.swapaxes(f.turning, 1, 2))
    return np.concatenate([_columns(seen, _flown(f)), own], axis=-1)


def at_rest(flights: Sequence[Flight]) -> Array:
    """(m, 3, k + 1) of every toss the cube at rest, by QUANTITIES and as measured.

    How much resting cubes differ once all candidates have taken their share is the noise.
    """
    rows = np.array([_columns(*_rested(f)) for f in flights])
    for c in range(3):
        effects, seen = rows[:, c, :-1], rows[:, c, -1]
        amounts, _, rank, _ = np.linalg.lstsq(effects, seen, rcond=1e-10)
        rows[:, c] /= np.sqrt(np.sum((seen - effects @ amounts) ** 2) / (len(seen) - rank))
    return rows


def _flown(f: Flight) -> dict[str, Array]:
    """Change of position [m] and turn in axes of the body [rad] (n, 6) of a flight, by a unit of each quantity."""

    def moved(position: Array | float, turn: Array | float = 0.0) -> Array:
        still = np.zeros(f.path.shape)
        return np.concatenate([still + position, still + turn], axis=1)

    def pushed(acceleration: Array) -> Array:
        return moved(integrated(integrated(np.broadcast_to(acceleration, f.path.shape))))

    def twisted(acceleration: Array) -> Array:
        """By an angular acceleration, world axes. R = R_smooth exp(eta): eta' = R_smooth^T (change of omega)."""
        change = integrated(np.broadcast_to(acceleration, f.path.shape))
        return moved(0.0, integrated(f.in_body(change)))

    def turned(angle: Array) -> Array:
        """About the vertical, place and attitude."""
        return moved(np.cross(UP, f.path) * angle[:, None], f.in_body(UP * angle[:, None]))

    speed, omega = np.linalg.norm(f.velocity, axis=1)[:, None], f.in_body(f.omega)
    of_body = np.swapaxes(f.rotation, 0, 2)  # (3, 3, n) body axis, component, sample
    found = {
        "gravity.change": pushed(-UP),
        "frame_rate.change": pushed(2 * GRAVITY * UP),  # true time is shorter if the true rate is higher
        "length_scale.change": pushed(-GRAVITY * UP),
        "linear_drag.k": pushed(-f.velocity),
        "quadratic_drag.k": pushed(-f.velocity * speed),
        "side_force.c": pushed(np.cross(UP, f.velocity)),
        "magnus.c": pushed(np.cross(f.omega, f.velocity)),
        # the room turns by Omega t: place and attitude turn along, and so does the angular velocity
        "frame_rotation.rate": turned(f.time),
        "rotational_drag.k": twisted(-f.omega),
        "side_torque.c": twisted(np.cross(UP, f.omega)),
        "twist.a": turned(f.path[:, 2]),
        "clock_offset.delay": moved(f.velocity),
        "smoothing.T2": moved(-UP * GRAVITY / 24),
    }
    found |= {f"tilt.beta_{x}": pushed(GRAVITY * axis) for x, axis in zip("xy", np.eye(3), strict=False)}
    found |= {f"toss_tilt.{a}": pushed(GRAVITY * axis) for a, axis in zip(LEVEL, f.axes, strict=False)}
    for a, axis in zip(AXES, f.axes, strict=True):
        found[f"perspective.{a}"] = moved(f.path * (f.path @ axis)[:, None])
        for i in range(3):
            found[f"face_bias.{a}_{i + 1}"] = moved(axis * np.abs(of_body[i, 2])[:, None])
    for i in range(3):
        # the tags' centre is seen, which stands off by minus the offset of the centre of mass
        found[f"centre_of_mass.c_{i + 1}"] = moved(-of_body[i].T)
    for i, j in ((0, 0), (1, 1), (0, 1), (0, 2), (1, 2)):  # J = J_0 (1 + E): omega' = -omega x (E omega), axes of body
        E = np.zeros((3, 3))
        E[i, j] = E[j, i] = 1.0
        moments = "principal_moments" if i == j else "products_of_inertia"
        change = np.einsum("nij,nj->ni", f.turning, -np.cross(omega, omega @ E))
        found[f"{moments}.e_{i + 1}{j + 1}"] = twisted(change)
    return found


def _rested(f: Flight) -> tuple[Array, dict[str, Sequence[float]]]:
    """Where a toss ends, on a face: height over the declared half width [m] and the face's normal along and across.

    (3,), and their change by a unit of each quantity.
    """
    position, rotation, level = f.toss.position[-REST:], f.toss.rotation[-REST:], f.axes[:2]
    place, up = position.mean(axis=0), rotation[-1, 2]
    face = int(np.abs(up).argmax())
    outward = np.eye(3)[face] * np.sign(up[face])
    point = [*(level @ place).tolist(), HALF_WIDTH]  # where it would be if the declared half width were right
    # by a turn of the tags' axes against the cube's, about each body axis
    by_axes = level @ rotation[-1] @ np.cross(np.eye(3), outward).T
    found: dict[str, Sequence[float]] = {"length_scale.change": (HALF_WIDTH, 0, 0), "table_height.z": (1, 0, 0)}
    for i, a in enumerate(AXES):
        found[f"perspective.{a}"] = (HALF_WIDTH * point[i], 0, 0)
        found[f"tag_axes.turn_{i + 1}"] = (0, *by_axes[:, i])
    for i, a in enumerate(LEVEL):
        found[f"toss_tilt.{a}"] = found[f"table_tilt.{a}"] = (point[i], *-np.eye(2)[i])
    return np.array([place[2] - HALF_WIDTH, *(level @ (rotation.mean(axis=0) @ outward))]), found
