"""Tosses of a cube as published, and the stretches of them in which nothing touches it.

Data: Pfrommer, Halm & Posa, "ContactNets", CoRL 2020: 570 tosses of a cube onto a table, poses from tags on its faces
at 148 Hz. Lengths of the file are half widths of the cube; here they are metres, by the declared half width.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import pairwise
from pathlib import Path

import numpy as np
from scipy.spatial.transform import Rotation

from calibration.kit.arrays import Array
from disctrack.errors import AnalysisError
from disctrack.examples._command import needed

HALF_WIDTH = 0.0524  # [m] as declared
FRAME_RATE = 148.0  # [Hz]
CLEARANCE = 0.12  # [half widths] of the lowest corner, from which on nothing touches: several times what contacts show
SHORTEST = 9  # samples of a flight
GLITCH = 6.0  # times the median roughness, beyond which a flight is not one: a hand, or a tag mistaken
RELEASE = 5.0  # sigmas by which a first sample may stand off the smooth motion before it counts as still in the hand
MAX_RELEASE = 6  # samples


@dataclass(frozen=True)
class Toss:
    """Poses of one toss."""

    number: int
    position: Array  # (n, 3) [m]
    rotation: Array  # (n, 3, 3) body to world

    @property
    def reach(self) -> Array:
        """(n,) height of the centre over the lowest corner, in half widths: 1 on a face, sqrt(3) on a corner."""
        return np.asarray(np.abs(self.rotation[:, 2, :]).sum(axis=1), float)


@dataclass(frozen=True)
class Flight:
    """A stretch of a toss in free flight, with the smooth motion about which effects are reckoned."""

    number: int  # of the toss
    time: Array  # (n,) from the middle [s]
    position: Array  # (n, 3) [m]
    rotation: Array  # (n, 3, 3)
    path: Array  # (n, 3) parabola through the positions
    velocity: Array  # (n, 3) its slope
    omega: Array  # (3,) constant angular velocity in world axes that fits best [rad/s]
    turning: Array  # (n, 3, 3) rotation at that velocity
    turn: Array  # (n, 3) from there to the measured attitude, rotation vector in axes of the body [rad]
    along: Array  # (3,) horizontal direction of the flight
    across: Array  # (3,) horizontal, to its left


def read_tosses(folder: Path) -> tuple[Toss, ...]:
    """All tosses of `cube_tosses.npz`. Raises AnalysisError."""
    path = needed(folder, "cube_tosses.npz")
    with np.load(path) as file:
        try:
            state, offset = np.asarray(file["state"], float), np.asarray(file["offset"], int)
            pose, rotation = state[: offset[-1], :3], Rotation.from_quat(state[:, [4, 5, 6, 3]]).as_matrix()
        except (KeyError, IndexError, ValueError) as error:
            raise AnalysisError(f"{path}: expected state (n, 13) and offset (tosses + 1,); {error}.") from error
    spans = pairwise(offset.tolist())
    return tuple(Toss(i, HALF_WIDTH * pose[a:b], rotation[a:b]) for i, (a, b) in enumerate(spans))


def without_copies(tosses: Sequence[Toss]) -> tuple[tuple[Toss, ...], int]:
    """Tosses without those that are others turned about the vertical, and how many they were.

    Such copies have the same heights to the last digit; in a comparison with held-out tosses they would be cheats.
    """
    first: dict[bytes, Toss] = {}
    for toss in tosses:
        first.setdefault(np.round(toss.position[:8, 2] / HALF_WIDTH, 6).tobytes(), toss)
    kept = tuple(first.values())
    return kept, len(tosses) - len(kept)


def flights(tosses: Sequence[Toss]) -> tuple[tuple[Flight, ...], int]:
    """The first flight of every toss, and how many were left out because they are rough or too short.

    A flight begins with the first sample that keeps to the smooth motion of the others (before, a hand still holds the
    cube; the very first sample is never taken) and lasts until a corner comes as low as CLEARANCE. Rough is one whose
    third differences are GLITCH times those of the others: no smooth motion has them.
    """
    ends = [_first_contact(toss) for toss in tosses]
    whole = [smooth_flight(t, 1, n) for t, n in zip(tosses, ends, strict=True) if n - 1 >= SHORTEST]
    if not whole:
        return (), len(tosses)
    sigma = 1.4826 * float(np.median([np.median(np.abs(_off(f)[2:-2])) for f in whole]))
    found = []
    for toss, end in zip(tosses, ends, strict=True):
        tries = (smooth_flight(toss, first, end) for first in range(1, min(MAX_RELEASE, end - SHORTEST) + 1))
        flight = next((f for f in tries if np.abs(_off(f)[0]).max() <= RELEASE * sigma), None)
        if flight is not None:
            found.append(flight)
    rough = np.array([np.sqrt(np.mean(np.diff(_off(f), 3, axis=0) ** 2)) for f in found])
    smooth = tuple(f for f, r in zip(found, rough, strict=True) if r <= GLITCH * np.median(rough))
    return smooth, len(tosses) - len(smooth)


def _first_contact(toss: Toss) -> int:
    clear = toss.position[:, 2] / HALF_WIDTH - toss.reach > CLEARANCE
    return len(clear) if clear.all() else int(np.argmin(clear))


def _off(flight: Flight) -> Array:
    """(n, 6) distances from the smooth motion [m], turns as they move the middle of a face."""
    return np.concatenate([flight.position - flight.path, HALF_WIDTH * flight.turn], axis=1)


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
    turn = (turning.inv() * measured).as_rotvec()
    path = powers @ parabola
    along = np.array([parabola[1, 0], parabola[1, 1], 0.0]) / np.hypot(*parabola[1, :2])
    across = np.cross([0.0, 0.0, 1.0], along)
    smooth = np.asarray(turning.as_matrix(), float)
    return Flight(toss.number, time, position, rotation, path, velocity, omega, smooth, turn, along, across)
