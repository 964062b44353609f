"""Tosses of a cube as published, and the stretches of them in which nothing touches it.

Data: Pfrommer, Halm & Posa, "ContactNets", CoRL 2020: 570 tosses of a cube onto a table, poses from tags on its faces
at 148 Hz. Lengths of the file are half widths of the cube; here they are metres, by the declared half width.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import pairwise
from pathlib import Path

import numpy as np
from scipy.integrate import cumulative_trapezoid
from scipy.spatial.transform import Rotation

from calibration.kit.arrays import Array

HALF_WIDTH = 0.0524  # [m] as declared
FRAME_RATE = 148.0  # [Hz]
CLEARANCE = 0.12  # [half widths] of the lowest corner, from which on nothing touches: several times what contacts show
SHORTEST = 9  # samples of a flight
RELEASE = 5.0  # sigmas by which a first sample may stand off the smooth motion before it counts as still in the hand
GLITCH = 20.0  # sigmas off the smooth motion that no effect explains: a hand, or a tag mistaken
MAX_RELEASE = 6  # samples
UP = np.array([0.0, 0.0, 1.0])


@dataclass(frozen=True)
class Toss:
    """Poses of one toss."""

    number: int
    position: Array  # (n, 3) [m]
    rotation: Array  # (n, 3, 3) body to world

    @property
    def clearance(self) -> Array:
        """(n,) height of the lowest corner in half widths; the centre is 1 above it on a face, sqrt(3) on a corner."""
        return np.asarray(self.position[:, 2] / HALF_WIDTH - np.abs(self.rotation[:, 2, :]).sum(axis=1), float)


@dataclass(frozen=True)
class Flight:
    """A stretch of a toss in free flight, with the smooth motion about which effects are reckoned."""

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
        """(n, 6) distances from the smooth motion [m], turns as they move the middle of a face."""
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
    """Tosses without those that are others turned about the vertical.

    Such copies have the same heights to the last digit; in a comparison with held-out tosses they would be cheats.
    """
    first: dict[bytes, Toss] = {}
    for toss in tosses:
        first.setdefault(np.round(toss.position[:8, 2] / HALF_WIDTH, 6).tobytes(), toss)
    return tuple(first.values())


def flights(tosses: Sequence[Toss]) -> tuple[Flight, ...]:
    """The first flight of every toss, but for those that are too short, or not smooth.

    A flight begins with the first sample that keeps to the smooth motion of the others (before, a hand still holds the
    cube; the very first sample is never taken) and lasts until a corner comes as low as CLEARANCE.
    """
    ends = [int(np.argmin(np.append(toss.clearance > CLEARANCE, False))) for toss in tosses]
    whole = [smooth_flight(t, 1, n) for t, n in zip(tosses, ends, strict=True) if n - 1 >= SHORTEST]
    sigma = 1.4826 * float(np.median([np.median(np.abs(f.off)[2:-2]) for f in whole]))
    found = []
    for toss, end in zip(tosses, ends, strict=True):
        for first in range(1, min(MAX_RELEASE, end - SHORTEST) + 1):
            flight = smooth_flight(toss, first, end)
            off = np.abs(flight.off).max(axis=1) / sigma
            if off[0] <= RELEASE and off.max() <= GLITCH:
                found.append(flight)
                break
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
