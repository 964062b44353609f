"""Tosses of a cube (Pfrommer, Halm & Posa 2020): what do gravity and torque-free rotation lack between the contacts?

    python -m disctrack.examples.cube_tosses FOLDER [-o DIR]

FOLDER holds `cube_tosses.npz`. Two thirds of the tosses are fitted, every third is held out; copies of a toss are
removed (the published tosses are rotated about the vertical by different angles, and some are included twice). Free
flight determines one combination of gravity, frame rate and scale of the lengths; cubes at rest determine the scale.

Base model: the centre of the tags is the centre of mass and falls with the declared gravity; a uniform cube turns at a
constant angular velocity. Each flight has its own position, velocity, attitude and angular velocity. Effects are small;
they are linearised about the smooth motion of the flight.

Data: Pfrommer, Halm & Posa, "ContactNets", CoRL 2020: 570 tosses of a cube onto a table, poses from tags on its faces
at 148 Hz. Lengths of the file are half widths of the cube; here they are metres, by the declared half width.
"""

from collections.abc import Iterator, Mapping, Sequence
from itertools import groupby, islice, pairwise
from pathlib import Path
from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike
from scipy.integrate import cumulative_trapezoid
from scipy.spatial.transform import Rotation

from calibration.kit.types import Array, Mask
from disctrack.analyse.derivatives import K as UP
from disctrack.discrepancy.document import effect_text
from disctrack.discrepancy.noise import SampleStretch, SmoothNoise, estimate
from disctrack.discrepancy.score import INVISIBLE
from disctrack.discrepancy.search import Diagnosis, Settings, explain
from disctrack.discrepancy.system import System, Values
from disctrack.examples._command import GRAVITY, Outcome, command, effect, report_of
from disctrack.numbers import rounded
from disctrack.report.blocks import Listing, Section

HALF_WIDTH = 0.0524  # [m] as declared
FRAME_RATE = 148.0  # [Hz]
CLEARANCE = 0.12  # [half widths] of the lowest corner in free flight: several times the clearance during contacts
SHORTEST = 9  # samples of a flight
RELEASE = 5.0  # [sigma] largest deviation of the first sample; beyond, the cube is still in the hand


class Toss(NamedTuple):
    """Poses of one toss."""

    number: int
    position: Array  # (n, 3) [m]
    rotation: Array  # (n, 3, 3) body to world

    @property
    def clearance(self) -> Array:
        """(n,) height of the lowest corner in half widths; the centre is 1 above it on a face, sqrt(3) on a corner."""
        return np.asarray(self.position[:, 2] / HALF_WIDTH - np.abs(self.rotation[:, 2, :]).sum(axis=1), float)


class Flight(NamedTuple):
    """The part of a toss in free flight, with the smooth motion about which effects are linearised."""

    toss: Toss
    time: Array  # (n,) from the middle [s]
    position: Array  # (n, 3) [m]
    rotation: Array  # (n, 3, 3)
    path: Array  # (n, 3) parabola through the positions
    velocity: Array  # (n, 3) its slope
    omega: Array  # (3,) constant angular velocity in world axes that fits best [rad/s]
    turning: Array  # (n, 3, 3) rotation at that velocity
    turn: Array  # (n, 3) from there to the measured attitude, rotation vector in axes of the body [rad]

    @property
    def off(self) -> Array:
        """(n, 6) deviations from the smooth motion [m]; of the attitude, as displacements of the middle of a face."""
        return np.concatenate([self.position - self.path, HALF_WIDTH * self.turn], axis=1)

    @property
    def axes(self) -> Array:
        """(3, 3) horizontal direction of the flight, the one across it to its left, and up."""
        level = self.velocity.mean(axis=0) * (1 - UP)
        along = level / np.linalg.norm(level)
        return np.array([along, np.cross(UP, along), UP])

    def in_body(self, vectors: Array) -> Array:
        """(n, 3) of vectors (3,) or (n, 3) in world axes."""
        return np.einsum("nji,nj->ni", self.turning, np.broadcast_to(vectors, self.path.shape))


def integrated(rate: Array) -> Array:
    """Integral (n, ...) of a rate (n, ...) from the first sample on."""
    return np.asarray(cumulative_trapezoid(rate, dx=1 / FRAME_RATE, axis=0, initial=0), float)


def read_tosses(folder: Path) -> tuple[Toss, ...]:
    """All tosses of `cube_tosses.npz`."""
    with np.load(folder / "cube_tosses.npz") as file:
        state, spans = np.asarray(file["state"], float), pairwise(file["offset"].tolist())
    position, rotation = HALF_WIDTH * state[:, :3], Rotation.from_quat(state[:, 3:7], scalar_first=True).as_matrix()
    return tuple(Toss(i, position[a:b], rotation[a:b]) for i, (a, b) in enumerate(spans))


def without_copies(tosses: Sequence[Toss]) -> tuple[Toss, ...]:
    """Tosses without copies, which are other tosses rotated about the vertical.

    Copies have the same heights to the last digit. They would spoil the test on held-out tosses.
    """
    heights = [np.round(toss.position[:8, 2] / HALF_WIDTH, 6) for toss in tosses]
    return tuple(tosses[i] for i in np.sort(np.unique(heights, axis=0, return_index=True)[1]))


def flights(tosses: Sequence[Toss]) -> tuple[Flight, ...]:
    """The first flight of every toss, without those that are too short or not smooth.

    A flight begins with the first sample that agrees with the smooth motion of the others (before, the cube is still in
    the hand; the very first sample is not used) and ends when a corner is as low as CLEARANCE.
    """
    ends = [int(np.argmin(np.append(toss.clearance > CLEARANCE, False))) for toss in tosses]
    whole = [smooth_flight(t, 1, n) for t, n in zip(tosses, ends, strict=True) if n - 1 >= SHORTEST]
    sigma = 1.4826 * float(np.median([np.median(np.abs(f.off)[2:-2]) for f in whole]))
    found = list[Flight]()
    for toss, end in zip(tosses, ends, strict=True):
        flown = (smooth_flight(toss, first, end) for first in range(1, end - SHORTEST + 1))
        found += islice((f for f in flown if np.abs(f.off[0]).max() <= RELEASE * sigma), 1)
    return tuple(found)


def smooth_flight(toss: Toss, first: int, end: int) -> Flight:
    """Samples `first` to `end` of a toss with their parabola and constant angular velocity, both by least squares."""
    position, rotation = toss.position[first:end], toss.rotation[first:end]
    n = len(position)
    time = np.asarray((np.arange(n) - (n - 1) / 2) / FRAME_RATE, float)
    powers = np.asarray(time[:, None] ** np.arange(3), float)
    parabola = np.linalg.lstsq(powers, position, rcond=None)[0]
    velocity = parabola[1] + 2 * time[:, None] * parabola[2]
    measured = Rotation.from_matrix(rotation)
    middle = measured[n // 2]
    omega = (measured[-1] * measured[0].inv()).as_rotvec() * FRAME_RATE / (n - 1)
    for _ in range(6):  # Gauss-Newton; the second step already changes less than the noise
        turning = Rotation.from_rotvec(time[:, None] * omega) * middle
        left = (measured * turning.inv()).as_rotvec()
        shift, rate = np.linalg.lstsq(powers[:, :2], left, rcond=None)[0]
        middle, omega = Rotation.from_rotvec(shift) * middle, omega + rate
    turning = Rotation.from_rotvec(time[:, None] * omega) * middle
    turn, smooth = (turning.inv() * measured).as_rotvec(), np.asarray(turning.as_matrix(), float)
    return Flight(toss, time, position, rotation, powers @ parabola, velocity, omega, smooth, turn)


REST = 8  # last samples of a toss
LEVEL = ("along", "across")  # the flight
AXES = (*LEVEL, "up")

_M, _S = "motion", "measurement"
CANDIDATES = (
    effect("gravity", _M, "another gravity", "m/s^2", 0.01, "change"),
    effect("frame_rate", _S, "frame rate wrong", "1", 1e-3, "change"),
    effect("length_scale", _S, "scale of the lengths wrong", "1", 0.02, "change"),
    effect("tilt", _S, "vertical wrong, the same way in the axes of the file", "rad", 0.01, "beta_x", "beta_y"),
    effect("toss_tilt", _S, "vertical wrong, the same way in the axes of every toss", "rad", 0.01, *LEVEL),
    effect("linear_drag", _M, "drag in proportion to the speed", "1/s", 0.03, "k", lower=0.0),
    effect("quadratic_drag", _M, "drag in proportion to the square of the speed", "1/m", 0.02, "k", lower=0.0),
    effect("side_force", _M, "force across the horizontal velocity, to its left", "1/s", 0.01, "c"),
    effect("magnus", _M, "lift of the spinning cube (Magnus)", "1", 0.004, "c"),
    effect("frame_rotation", _S, "world axes turn about the vertical", "rad/s", 1e-3, "rate"),
    effect("centre_of_mass", _M, "centre of mass not in the centre of the tags", "m", 2e-3, "c_1", "c_2", "c_3"),
    effect("principal_moments", _M, "moments of inertia not those of a uniform cube", "1", 0.05, "e_11", "e_22"),
    effect("products_of_inertia", _M, "products of inertia", "1", 0.05, "e_12", "e_13", "e_23"),
    effect("rotational_drag", _M, "drag of the rotation", "1/s", 0.01, "k", lower=0.0),
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
    """(..., k + 1) derivatives of observations (...) by QUANTITIES, zero if not named, and the observations."""
    return np.stack([*(np.broadcast_to(changes.get(name, 0.0), seen.shape) for name in COLUMN), seen], axis=-1)


def flown(f: Flight) -> Array:
    """(n, 6, k + 1 + 12): derivatives by QUANTITIES, measured minus base model, derivatives by own motion.

    The own motion of a flight: position, velocity, attitude and angular velocity, three numbers each.
    """
    seen = f.off
    seen[:, :3] = f.position + GRAVITY / 2 * f.time[:, None] ** 2 * UP
    own = np.zeros((*seen.shape, 12))
    own[:, :3, :3], own[:, :3, 3:6] = np.eye(3), f.time[:, None, None] * np.eye(3)
    own[:, 3:, 6:9], own[:, 3:, 9:] = np.eye(3), integrated(np.swapaxes(f.turning, 1, 2))
    return np.concatenate([_columns(seen, _flown(f)), own], axis=-1)


def at_rest(flights: Sequence[Flight]) -> Array:
    """(m, 3, k + 1) of the cube at rest after each toss: derivatives by QUANTITIES, and the measured values.

    The noise is the scatter of the residuals of a fit of all candidates.
    """
    rows = np.array([_columns(*_rested(f)) for f in flights])
    for c in range(3):
        effects, seen = rows[:, c, :-1], rows[:, c, -1]
        amounts, _, rank, _ = np.linalg.lstsq(effects, seen, rcond=1e-10)
        rows[:, c] /= np.sqrt(np.sum((seen - effects @ amounts) ** 2) / (len(seen) - rank))
    return rows


def _flown(f: Flight) -> dict[str, Array]:
    """Derivatives (n, 6) of a flight by each quantity: of position, and of rotation in body axes at a face's middle."""

    def moved(position: Array | float, turn: Array | float = 0.0) -> Array:
        still = np.zeros(f.path.shape)
        return np.concatenate([still + position, still + HALF_WIDTH * turn], axis=1)

    def pushed(acceleration: Array) -> Array:
        return moved(integrated(integrated(np.broadcast_to(acceleration, f.path.shape))))

    def twisted(acceleration: Array) -> Array:
        """Effect of an angular acceleration, world axes. R = R_smooth exp(eta), eta' = R_smooth^T (change of omega)."""
        change = integrated(np.broadcast_to(acceleration, f.path.shape))
        return moved(0.0, integrated(f.in_body(change)))

    def turned(angle: Array) -> Array:
        """Position and attitude rotated about the vertical."""
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
        # the world axes turn by Omega t, and with them position, attitude and angular velocity
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
        # the centre of the tags is observed; from the centre of mass it is displaced by minus the offset
        found[f"centre_of_mass.c_{i + 1}"] = moved(-of_body[i].T)
    for i, j in ((0, 0), (1, 1), (0, 1), (0, 2), (1, 2)):  # J = J_0 (1 + E): omega' = -omega x (E omega), axes of body
        E = np.zeros((3, 3))
        E[i, j] = E[j, i] = 1.0
        moments = "principal_moments" if i == j else "products_of_inertia"
        change = np.einsum("nij,nj->ni", f.turning, -np.cross(omega, omega @ E))
        found[f"{moments}.e_{i + 1}{j + 1}"] = twisted(change)
    return found


def _rested(f: Flight) -> tuple[Array, dict[str, Sequence[float]]]:
    """Cube at rest on a face: height minus the declared half width [m], and the face's normal along and across.

    (3,), and their derivatives by each quantity.
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


GROUPS = {"horizontal": slice(0, 2), "vertical": slice(2, 3), "turn": slice(3, 6)}  # channels with equal noise
FIRST_NOISE = SmoothNoise(2e-5, 3e-5, 0.03)  # initial guess
# The data are whitened already. Eight effects at most.
SETTINGS = Settings(noise=1.0, unexplained_share=0.2, max_effects=8)


class CubeTosses(System):
    """Flights, orthogonal to their own motion, and cubes at rest, as rows of one number with variance one.

    seen : (n,) measured minus base model
    effects : (n, k) its change by QUANTITIES, in all of which it is linear
    """

    candidates = CANDIDATES
    base = ()

    def __init__(self, flights: Sequence[Flight]) -> None:
        """Estimate the noise, and whiten the data with it."""
        self.flights, self._flown, self._at_rest = flights, [flown(f) for f in flights], at_rest(flights)
        self.noise = dict.fromkeys(GROUPS, FIRST_NOISE)
        for _ in range(2):
            self._whiten()
            self.noise = self._measured_noise()
        self._whiten()

    def linearise(self, values: Values, names: Sequence[str]) -> tuple[Array, Array]:
        """Residual (n, 1) and the prediction's derivative (n, 1, k)."""
        left = self.seen - self.effects @ _amounts(values)
        return left[:, None], self.effects[:, None, [COLUMN[n] for n in names]]

    def residuals(self, values: Values) -> Iterator[Array]:
        """Residuals (n, 6) [m] of every flight, with its own motion by least squares."""
        for rows in self._flown:
            effects, seen, own = np.split(rows.reshape(-1, rows.shape[-1]), [len(COLUMN), len(COLUMN) + 1], axis=1)
            left = seen[:, 0] - effects @ _amounts(values)
            yield (left - own @ np.linalg.lstsq(own, left, rcond=None)[0]).reshape(-1, 6)

    def _whiten(self) -> None:
        parts, training = [], []
        for f, rows, rest in zip(self.flights, self._flown, self._at_rest, strict=True):
            white = rows.copy()
            for name, channels in GROUPS.items():
                white[:, channels] = np.tensordot(self.noise[name].whitening(f.time), rows[:, channels], axes=1)
            effects, own = np.split(white.reshape(-1, rows.shape[-1]), [len(COLUMN) + 1], axis=1)
            beside_own = np.linalg.qr(own, mode="complete")[0][:, own.shape[1] :].T @ effects
            # rounding errors of an effect that the flight's own motion absorbs
            beside_own[:, np.linalg.norm(beside_own, axis=0) < INVISIBLE * np.linalg.norm(effects, axis=0)] = 0.0
            parts += [beside_own, rest]
            training += [not _kept_back(f)] * (len(beside_own) + len(rest))
        everything = np.concatenate(parts)
        self.effects, self.seen = everything[:, :-1], everything[:, -1]
        self.training: Mask = np.array(training)  # (n,) False for every third toss
        self.weights = np.ones(len(everything))
        self.time = np.arange(len(everything), dtype=float)  # an order only: tosses have no common clock

    def _measured_noise(self) -> dict[str, SmoothNoise]:
        """Noise of each group of channels, from the residuals of a fit of all candidates together."""
        # some compensate each other: the solution that is smallest in units of the usual sizes
        size = np.array([q.typical for q in QUANTITIES])
        amounts = size * np.linalg.lstsq(self.effects * size, self.seen, rcond=1e-9)[0]
        left = sorted(self.residuals(dict(zip(COLUMN, amounts.tolist(), strict=True))), key=len)
        # flights of equal length share their instants: (n, flights, 6)
        alike = [np.stack([*some], axis=1) for _, some in groupby(left, key=len)]
        return {name: _noise([some[..., channels] for some in alike]) for name, channels in GROUPS.items()}


def _amounts(values: Values) -> Array:
    return np.array([values.get(name, 0.0) for name in COLUMN])


def _kept_back(flight: Flight) -> bool:
    """Every third toss."""
    return flight.toss.number % 3 == 2


def _noise(left: Sequence[Array]) -> SmoothNoise:
    """Noise of residuals, each (n, flights, channels)."""
    times = [np.arange(len(some)) / FRAME_RATE for some in left]
    samples = [(time, some.reshape(len(time), -1)) for time, some in zip(times, left, strict=True)]
    return estimate([SampleStretch(*one, one[0][:, None] ** np.arange(2)) for one in samples], FIRST_NOISE)


def diagnosed(system: CubeTosses) -> Diagnosis:
    """Effects that the base model lacks."""
    return explain(system, {}, SETTINGS, system.training)


def errors(system: CubeTosses, d: Diagnosis) -> Iterator[dict[str, float]]:
    """Rms residuals [m] of the held-out flights per group of channels: of the base model, and with the effects found.

    Their values are fitted to the other flights.
    """
    for values in ({}, d.held_out_after.train.values if d.held_out_after else {}):
        residuals = zip(system.flights, system.residuals(values), strict=True)
        left = [x for flight, x in residuals if _kept_back(flight)]
        square = np.sum(np.concatenate(left) ** 2, axis=0) / sum(len(x) - 2 for x in left)
        yield {name: float(np.sqrt(np.mean(square[channels]))) for name, channels in GROUPS.items()}


def example(folder: Path) -> Outcome:
    """What do gravity and torque-free rotation lack for a tossed cube?"""
    published = read_tosses(folder)
    tosses = without_copies(published)
    system = CubeTosses(flights(tosses))
    d = diagnosed(system)
    before, after = errors(system, d)
    effects = "; ".join(effect_text(f, d) for f in d.found)
    said = f"Missing: {effects}." if effects else "No effect is claimed to be missing."
    said += f" Something else is missing: {d.reason}." if d.verdict == "unexplained" else ""
    numbers = {group: (before[group], after[group], noise.white) for group, noise in system.noise.items()}
    rows = [(f"rms {group} (um)", *(rounded(1e6 * x) for x in some)) for group, some in numbers.items()]
    copies, left_out = len(published) - len(tosses), len(tosses) - len(system.flights)
    caption = (
        f"{len(system.flights)} flights, each with its cube at rest; without {left_out} tosses that are too short or "
        f"not smooth, and {copies} copies of others, rotated about the vertical. Turns are shifts of a face's middle."
    )
    blocks = [Section("Every third toss, held out", [Listing(("", "before", "after", "white noise"), rows, caption)])]
    model = f"g = {GRAVITY} m/s^2, uniform cube, {FRAME_RATE:g} Hz, half width {HALF_WIDTH} m"
    return report_of(d, model, said, blocks, [{"rms": before}, {"rms": after}]), {}


if __name__ == "__main__":
    command(example, "cube_tosses.npz")
