"""What else the published tosses tell of the same quantities: contacts, sliding, and the columns of velocities."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from scipy.spatial.transform import Rotation

from calibration.arrays import Array
from disctrack.examples.cube_data import AT_REST, FRAME_RATE, HALF_WIDTH, SHORTEST, Flight, Toss

Estimate = tuple[float, float]  # value and standard error

GRAVITY = 9.81  # [m/s^2]
SLOWEST = 0.2  # [m/s] of a slide whose direction is well known
_UNKNOWN = (float("nan"), float("nan"))


def checks(tosses: Sequence[Toss], flown: Sequence[Flight]) -> dict[str, Estimate]:
    """All of this module by name; NaN where too little was measured."""
    friction, across = sliding(tosses)
    return {
        "size of the cube over declared, minus 1, from contacts if its edges were sharp": contact_line(tosses),
        "friction coefficient, sliding": friction,
        "acceleration across the velocity over speed, sliding [1/s]": across,
        "delay of the published velocities [frames]": velocity_delay(tosses, flown),
        "misfit of the published angular velocities if in axes of the body [rad/s]": rate_misfit(tosses, flown, True),
        "the same if in axes of the world [rad/s]": rate_misfit(tosses, flown, False),
    }


def contact_line(tosses: Sequence[Toss]) -> Estimate:
    """Slope of (height / half width) against reach, minus 1, while a corner or edge stays on the table.

    A cube of another size or another scale has a slope; so have rounded edges, and these data do not separate them.
    """
    reach, over = [], []
    for toss in tosses:
        gap = toss.position[:, 2] / HALF_WIDTH - toss.reach
        held = (np.abs(np.gradient(gap)) < 0.004) & (np.abs(gap + 0.045) < 0.075) & (toss.reach > 1.02)
        reach.append(toss.reach[held])
        over.append(gap[held])
    x, y = np.concatenate(reach), np.concatenate(over)
    if len(x) < 20 or np.ptp(x) == 0:
        return _UNKNOWN
    return _robust(np.column_stack([x - 1, np.ones(len(x))]), y, np.ones(len(x)), 0.01)


def sliding(tosses: Sequence[Toss]) -> tuple[Estimate, Estimate]:
    """Of cubes that slide on a face: deceleration over g; acceleration to the left over the speed [1/s].

    What turns with the spin (friction under a turning face does) is taken off the second.
    """
    rows = []
    for toss in tosses:
        z = toss.position[:, 2] / HALF_WIDTH
        flat = (np.abs(toss.rotation[:, 2, :]).max(axis=1) > AT_REST[1]) & (np.abs(z - 0.978) < AT_REST[0])
        edges = np.flatnonzero(np.diff(np.concatenate([[False], flat, [False]]).astype(int))).reshape(-1, 2)
        rows += [_slide(toss, int(a) + 1, int(b) - 1) for a, b in edges if b - a >= SHORTEST]
    speed, spin, slowing, across, n = np.array([r for r in rows if r[0] > SLOWEST]).reshape(-1, 5).T
    if len(speed) < 20:
        return _UNKNOWN, _UNKNOWN
    weight = n**2.5  # a second derivative's variance falls with the fifth power
    friction = _robust(np.ones((len(speed), 1)), slowing / GRAVITY, weight, 0.05)
    return friction, _robust(np.column_stack([speed, spin]), across, weight, 0.5)


def _slide(toss: Toss, a: int, b: int) -> tuple[float, float, float, float, float]:
    """Speed, spin, deceleration, acceleration to the left, and number of samples."""
    t = (np.arange(b - a) - (b - a - 1) / 2) / FRAME_RATE
    bend, v, _ = np.polyfit(t, toss.position[a:b, :2], 2)
    turned = Rotation.from_matrix(toss.rotation[a:b] @ toss.rotation[(a + b) // 2].T).as_rotvec()[:, 2]
    speed = float(np.hypot(*v))
    if speed == 0:
        return 0.0, 0.0, 0.0, 0.0, 0.0
    slowing, across = -2 * float(v @ bend) / speed, 2 * float(v[0] * bend[1] - v[1] * bend[0]) / speed
    return speed, float(np.polyfit(t, turned, 1)[0]), slowing, across, float(b - a)


def _robust(A: Array, y: Array, weight: Array, scale: float) -> Estimate:
    """First coefficient of a regression with Cauchy weights beyond `scale`, and its sandwich standard error."""
    W = np.sqrt(weight)
    x: Array = np.zeros(A.shape[1])
    left: Array = y
    for _ in range(20):
        x = np.asarray(np.linalg.lstsq(A * W[:, None], y * W, rcond=None)[0], float)
        left = y - A @ x
        W = np.sqrt(weight / (1 + (left / scale) ** 2))
    inverse = np.linalg.inv((A * W[:, None]).T @ (A * W[:, None]))
    scores = A * (W**2 * left)[:, None]
    spread = inverse @ (scores.T @ scores) @ inverse
    return float(x[0]), float(np.sqrt(spread[0, 0]))


def velocity_delay(tosses: Sequence[Toss], flown: Sequence[Flight]) -> Estimate:
    """How much later the published vertical velocities are than the slope of the heights, in free fall [frames]."""
    by_number = {t.number: t for t in tosses}
    late = []
    for f in flown:
        published = by_number[f.number].velocity[f.first : f.first + len(f.time), 2]
        fall = (f.velocity[-1, 2] - f.velocity[0, 2]) / (f.time[-1] - f.time[0])
        late.append(float(np.mean(f.velocity[:, 2] - published)) / fall * FRAME_RATE)
    if len(late) < 3 or not any(np.any(t.velocity) for t in tosses):
        return _UNKNOWN
    return float(np.median(late)), 1.2533 * float(np.std(late)) / np.sqrt(len(late))


def rate_misfit(tosses: Sequence[Toss], flown: Sequence[Flight], in_body: bool) -> Estimate:
    """Median rms of published minus fitted angular velocity, its columns read in axes of the body or of the world."""
    by_number = {t.number: t for t in tosses}
    misfit = []
    for f in flown:
        published = by_number[f.number].rate[f.first : f.first + len(f.time)]
        fitted = np.einsum("nji,j->ni", f.turning, f.omega) if in_body else f.omega
        misfit.append(float(np.sqrt(np.mean((published - fitted) ** 2))))
    if len(misfit) < 3 or not any(np.any(t.rate) for t in tosses):
        return _UNKNOWN
    return float(np.median(misfit)), 1.2533 * float(np.std(misfit)) / np.sqrt(len(misfit))
