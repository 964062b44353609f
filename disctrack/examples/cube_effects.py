"""What a tossed cube may lack, and what each effect leaves in its flight and where it rests, to first order."""

from collections.abc import Callable, Iterable, Sequence

import numpy as np

from calibration.kit.arrays import Array
from disctrack.discrepancy.system import Candidate, Quantity
from disctrack.examples._command import GRAVITY
from disctrack.examples.cube_data import HALF_WIDTH, Flight, Toss

REST = 8  # last samples of a toss
AT_REST = (0.03, np.cos(np.radians(1.5)))  # [half widths] about the resting height, and cosine of a face's tilt
UP = np.array([0.0, 0.0, 1.0])
LEVEL = ("along", "across")  # the flight
_M, _S = "motion", "measurement"
EFFECTS = {  # kind, title, unit, and a size that would surprise nobody
    "gravity": (_M, "another gravity", "m/s^2", 0.01),
    "frame_rate": (_S, "frame rate wrong", "1", 1e-3),
    "length_scale": (_S, "scale of the lengths wrong", "1", 0.02),
    "tilt": (_S, "vertical wrong, the same way in the axes of the file for all tosses", "rad", 0.01),
    "toss_tilt": (_S, "vertical wrong, the same way in the axes of every toss", "rad", 0.01),
    "linear_drag": (_M, "drag in proportion to the speed", "1/s", 0.03),
    "quadratic_drag": (_M, "drag in proportion to the square of the speed", "1/m", 0.02),
    "side_force": (_M, "force across the horizontal velocity, to its left", "1/s", 0.01),
    "magnus": (_M, "lift of the spinning cube (Magnus)", "1", 0.004),
    "frame_rotation": (_S, "world axes turn about the vertical", "rad/s", 1e-3),
    "centre_of_mass": (_M, "centre of mass not in the centre of the tags", "m", 2e-3),
    "principal_moments": (_M, "moments of inertia not those of a uniform cube", "1", 0.05),
    "products_of_inertia": (_M, "products of inertia", "1", 0.05),
    "rotational_drag": (_M, "drag of the rotation", "1/s", 0.01),
    "side_torque": (_M, "torque that turns the angular velocity about the vertical", "1/s", 0.01),
    "twist": (_S, "measured place and attitude turn about the vertical with height", "rad/m", 0.01),
    "perspective": (_S, "scale of the lengths changes with place", "1/m", 5e-3),
    "face_bias": (_S, "error of place that depends on which faces look up", "m", 5e-4),
    "clock_offset": (_S, "positions later than attitudes", "s", 1e-3),
    "smoothing": (_S, "exposure, or smoothing of the positions", "s^2", 1e-5),
    "table_height": (_S, "table not at height zero, or another half width of the cube", "m", 1e-3),
    "tag_axes": (_S, "axes of the tags turned against those of the cube", "rad", 5e-3),
    "table_tilt": (_S, "table leans against the vertical", "rad", 1e-2),
}


def candidates(names: Iterable[str]) -> tuple[Candidate, ...]:
    """Effects with those of these quantities that are theirs."""
    own: dict[str, list[Quantity]] = {effect: [] for effect in EFFECTS}
    for name in names:
        effect = name.partition(".")[0]
        _, _, unit, typical = EFFECTS[effect]
        lower = 0.0 if effect.endswith("_drag") else -np.inf
        own[effect].append(Quantity(name, unit, 0.1 * typical, lower=lower, typical=typical))
    return tuple(
        Candidate(effect, effect, kind, title, "", tuple(own[effect])) for effect, (kind, title, *_) in EFFECTS.items()
    )


def flown(f: Flight) -> dict[str, Array]:
    """Change of position [m] and turn in axes of the body [rad] (n, 6) of a flight, by a unit of each quantity."""
    push, twist, speed = _pushed(f), _twisted(f), np.linalg.norm(f.velocity, axis=1)[:, None]
    axes = dict(zip((*LEVEL, "up"), (f.along, f.across, UP), strict=True))
    of_body = np.swapaxes(f.rotation, 0, 2)  # (3, 3, n) body axis, component, sample
    found = {
        "gravity.change": push(-UP),
        "frame_rate.change": push(2 * GRAVITY * UP),  # true time is shorter if the true rate is higher
        "length_scale.change": push(-GRAVITY * UP),
        "tilt.beta_x": push(GRAVITY * np.eye(3)[0]),
        "tilt.beta_y": push(GRAVITY * np.eye(3)[1]),
        "linear_drag.k": push(-f.velocity),
        "quadratic_drag.k": push(-f.velocity * speed),
        "side_force.c": push(np.cross(UP, f.velocity)),
        "magnus.c": push(np.cross(f.omega, f.velocity)),
        # the room turns by Omega t: place and attitude turn along, and so does the angular velocity
        "frame_rotation.rate": _turned(f, f.time),
        "rotational_drag.k": twist(-f.omega),
        "side_torque.c": twist(np.cross(UP, f.omega)),
        "twist.a": _turned(f, f.path[:, 2]),
        "clock_offset.delay": _moved(f, f.velocity),
        "smoothing.T2": _moved(f, -UP * GRAVITY / 24),
    }
    found |= {f"toss_tilt.{a}": push(GRAVITY * axes[a]) for a in LEVEL}
    found |= {f"perspective.{a}": _moved(f, f.path * (f.path @ axis)[:, None]) for a, axis in axes.items()}
    for i in range(3):
        # the tags' centre is seen, which stands off by minus the offset of the centre of mass
        found[f"centre_of_mass.c_{i + 1}"] = _moved(f, -of_body[i].T)
        for a, axis in axes.items():
            found[f"face_bias.{a}_{i + 1}"] = _moved(f, axis * np.abs(of_body[i, 2])[:, None])
    for i, j in ((0, 0), (1, 1), (0, 1), (0, 2), (1, 2)):  # J = J_0 (1 + E): omega' = -omega x (E omega), axes of body
        E, omega, effect = (
            np.zeros((3, 3)),
            _in_body(f, f.omega),
            "principal_moments" if i == j else "products_of_inertia",
        )
        E[i, j] = E[j, i] = 1.0
        change = np.einsum("nij,nj->ni", f.turning, -np.cross(omega, omega @ E))
        found[f"{effect}.e_{i + 1}{j + 1}"] = twist(change)
    return found


def rested(toss: Toss, f: Flight) -> tuple[Array, dict[str, Sequence[float]]] | None:
    """Of a toss that ends on a face, height over the declared half width [m] and the face's normal along and across.

    (3,), and their change by a unit of each quantity; None of another toss.
    """
    axes, last = np.stack([f.along, f.across]), slice(-REST, None)
    z, up = toss.position[last, 2] / HALF_WIDTH, toss.rotation[last, 2, :]
    face = int(np.abs(up).mean(axis=0).argmax())
    flat = np.abs(up[:, face]).min() > AT_REST[1] and np.ptp(z) < AT_REST[0]
    if not (flat and abs(z.mean() - 1) < 3 * AT_REST[0]):
        return None
    normal = (toss.rotation[last, :, face] * np.sign(up[:, face])[:, None]).mean(axis=0)
    place = toss.position[last].mean(axis=0)
    point = np.array([*(axes @ place), HALF_WIDTH])  # where it would be if the declared half width were right
    # by a turn of the tags' axes against the cube's, about each body axis
    by_axes = axes @ toss.rotation[-1] @ np.cross(np.eye(3), np.eye(3)[face] * np.sign(up[-1, face])).T
    leans = {a: (point[i], -1.0 * (i == 0), -1.0 * (i == 1)) for i, a in enumerate(LEVEL)}
    found: dict[str, Sequence[float]] = {"length_scale.change": (HALF_WIDTH, 0.0, 0.0)}
    found["table_height.z"] = (1.0, 0.0, 0.0)
    for i, a in enumerate((*LEVEL, "up")):
        found[f"perspective.{a}"] = (point[2] * point[i], 0.0, 0.0)
        found[f"tag_axes.turn_{i + 1}"] = (0.0, *by_axes[:, i])
    found |= {f"{effect}.{a}": lean for effect in ("toss_tilt", "table_tilt") for a, lean in leans.items()}
    return np.array([place[2] - HALF_WIDTH, *(axes @ normal)]), found


def _integrated(f: Flight, rate: Array) -> Array:
    """Integral (n, 3) from the first sample; trapezoids."""
    dt, rate = float(f.time[1] - f.time[0]), np.broadcast_to(rate, f.position.shape)
    return np.concatenate([np.zeros((1, 3)), np.cumsum(0.5 * dt * (rate[1:] + rate[:-1]), axis=0)])


def _moved(f: Flight, position: Array | float, turn: Array | float = 0.0) -> Array:
    still = np.zeros(f.position.shape)
    return np.concatenate([still + position, still + turn], axis=1)


def _pushed(f: Flight) -> Callable[[Array], Array]:
    """By an acceleration (3,) or (n, 3)."""
    return lambda acceleration: _moved(f, _integrated(f, _integrated(f, acceleration)))


def _twisted(f: Flight) -> Callable[[Array], Array]:
    """By an angular acceleration in axes of the world. R = R_smooth exp(eta): eta' = R_smooth^T (change of omega)."""
    return lambda acceleration: _moved(f, 0.0, _integrated(f, _in_body(f, _integrated(f, acceleration))))


def _turned(f: Flight, angle: Array) -> Array:
    """About the vertical, place and attitude; angle (n,)."""
    return _moved(f, np.cross(UP, f.path) * angle[:, None], _in_body(f, UP * angle[:, None]))


def _in_body(f: Flight, vectors: Array) -> Array:
    return np.einsum("nji,nj->ni", f.turning, np.broadcast_to(vectors, f.position.shape))
