"""Balls dropped from a height and filmed from the side, as a system that `disctrack.diagnosis` can diagnose.

Data: de Silva, Higdon, Brunton & Kutz 2020, Frontiers in Artificial Intelligence 3:25; 11 balls, two drops each. Base
model: a point falls with the declared gravity, from a height and at a velocity of its own in each drop.
"""

from __future__ import annotations

import csv
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from calibration.arrays import Array, Mask
from disctrack.diagnosis.engine.noise_with_memory import SampleStretch, SmoothNoise, estimate
from disctrack.diagnosis.engine.system import Candidate, Quantity, Values
from disctrack.errors import AnalysisError

GRAVITY = 9.81  # [m/s^2] as declared
AIR_DENSITY = 1.2  # [kg/m^3] at 20 degC
OUNCE = 0.028349523125  # [kg]
MIDDLE = 30.0  # [m] of the heights seen; about it, perspective bends the scale
ACCELERATION_DEGREE = 4  # of the polynomial in time that all drops of a ball share: any drag, to 1 mm
STEP = 1.0 / 15.0  # [s] of the integration: Runge-Kutta errs by less than 1e-6 m over a fall
_FORCES = ("gravity.change", "constant_drag.c", "linear_drag.k", "quadratic_drag.k")
_IMAGE = ("height_scale.change", "frame_rate.change", "perspective.bend")
SPHERE = "sphere_drag.Cd"
_COMMON = ("gravity.change", *_IMAGE)
_OF_DROP = ("state.height", "state.velocity")
_STEPS = {
    "state.height": 1e-3, "state.velocity": 1e-3, "gravity.change": 1e-3, "constant_drag.c": 1e-3,
    "linear_drag.k": 1e-4, "quadratic_drag.k": 1e-4, "height_scale.change": 1e-5, "frame_rate.change": 1e-4,
    "perspective.bend": 1e-5,
}  # fmt: skip


@dataclass(frozen=True)
class Ball:
    """What is known of a ball; NaN where nothing is."""

    name: str
    mass: float  # [kg]
    radius: float  # [m]

    @property
    def quadratic_per_cd(self) -> float:
        """Deceleration over v^2 for a drag coefficient of one: rho A / (2 m) [1/m]."""
        return AIR_DENSITY * np.pi * self.radius**2 / (2 * self.mass)


@dataclass(frozen=True)
class Drop:
    """Height of one ball over time."""

    ball: Ball
    number: int
    time: Array  # (n,) [s]
    height: Array  # (n,) [m]

    @property
    def name(self) -> str:
        """Ball and number."""
        return f"{self.ball.name},{self.number}"


def read_drops(folder: Path) -> tuple[Drop, ...]:
    """All drops of `ball_drops.csv`, with mass and radius from `balls.txt`. Raises AnalysisError."""
    path, table = Path(folder) / "ball_drops.csv", Path(folder) / "balls.txt"
    for file in (path, table):
        if not file.is_file():
            raise AnalysisError(f"{file}: not there. Name the folder that holds ball_drops.csv and balls.txt.")
    sizes = _sizes(table)
    rows: dict[tuple[str, int], list[tuple[float, float]]] = {}
    with path.open(newline="") as stream:
        for line, row in enumerate(csv.DictReader(stream), start=2):
            try:
                key = (row["ball"], int(row["drop"]))
                sample = (float(row["t_s"]), float(row["height_m"]))
            except (KeyError, TypeError, ValueError) as error:
                raise AnalysisError(f"{path}, line {line}: expected ball,drop,t_s,height_m; found {row}.") from error
            rows.setdefault(key, []).append(sample)
    drops = []
    balls = {name: Ball(name, *sizes.get(_key(name), (np.nan, np.nan))) for name, _ in rows}
    for (name, number), samples in rows.items():
        time, height = np.array(samples, float).T
        if len(time) < 8 or not np.all(np.diff(time) > 0):
            raise AnalysisError(f"{path}: drop {number} of {name}: needs 8 heights or more at increasing times.")
        drops.append(Drop(balls[name], number, time, height))
    return tuple(drops)


def _key(name: str) -> str:
    return (
        name.lower().replace(" ", "").replace("whiffle", "wiffle").replace("ball", "").replace("basket", "basketball")
    )


def _sizes(path: Path) -> dict[str, tuple[float, float]]:
    """(mass [kg], radius [m]) by ball, from ounces and circumference in cm."""

    def number(text: str) -> float:
        try:
            return float(text)
        except ValueError:
            return np.nan

    words = [line.split() for line in path.read_text().splitlines()[1:] if line.strip()]
    return {_key(w[0]): (OUNCE * number(w[1]), 0.01 * number(w[2]) / (2 * np.pi)) for w in words}


class BallDrops:
    """Heights of some drops. Samples are heights, drop after drop, with a row without data between two drops.

    The errors of one drop have a memory (`height_noise`): rows are whitened with their covariance.
    """

    def __init__(self, drops: Sequence[Drop], noise: SmoothNoise) -> None:
        """Drops : of one ball or of several."""
        self.drops, self.noise = tuple(drops), noise
        self._whitening = [noise.whitening(d.time) for d in drops]
        self.balls = tuple({d.ball.name: d.ball for d in drops}.values())
        lengths = [len(d.time) for d in drops]
        starts = np.cumsum([0] + [n + 1 for n in lengths])
        self.rows = [slice(int(a), int(a) + n) for a, n in zip(starts, lengths, strict=False)]
        self.weights = np.zeros(int(starts[-1]))
        self.time = np.zeros(int(starts[-1]))
        self.observed = np.zeros(int(starts[-1]))
        self.number = np.zeros(int(starts[-1]), int)
        for rows, drop in zip(self.rows, drops, strict=True):
            self.weights[rows] = 1.0
            self.time[rows] = drop.time
            self.observed[rows] = drop.height
            self.number[rows] = drop.number
        first = [(d.height[0], d.name) for d in drops]
        self.base = tuple(
            q
            for h, name in first
            for q in (
                Quantity(f"state.height[{name}]", "m", 0.01, null=float(h), meaning="at the first sample"),
                Quantity(f"state.velocity[{name}]", "m/s", 0.01, meaning="at the first sample, upwards"),
            )
        )
        self.candidates = candidates(self.balls)

    def start(self) -> dict[str, float]:
        """Heights and velocities at rest at the first sample; every prediction is nearly linear in them."""
        return {q.name: q.null for q in self.base}

    def own(self, drop: int) -> tuple[Quantity, ...]:
        """Start and velocity of one drop."""
        return self.base[2 * drop : 2 * drop + 2]

    def starts(self, candidate: Candidate, values: Values) -> Sequence[tuple[float, ...]]:
        """No candidate has a threshold."""
        return ()

    def training_rows(self, seen: float = 1.2) -> Mask:
        """(n,) True for all of the first drops, and for the first `seen` seconds of the second ones."""
        return (self.number == 1) | ((self.number > 1) & (self.time <= seen))

    def linearise(self, values: Values, names: Sequence[str]) -> tuple[Array, Array]:
        """Whitened heights (n, 1), observed minus predicted, and the prediction's derivative (n, 1, k)."""
        heights, by_kind = self._heights(values)
        residual = np.zeros((len(self.time), 1))
        derivative = np.zeros((len(self.time), 1, len(names)))
        column = {name: i for i, name in enumerate(names)}
        for i, (rows, drop) in enumerate(zip(self.rows, self.drops, strict=True)):
            mine = np.zeros((len(drop.time), len(names) + 1))
            for kind, moved in by_kind.items():
                name = self._name(kind, drop)
                if name in column:
                    mine[:, column[name]] = moved[i]
            if SPHERE in column and np.isfinite(drop.ball.mass):
                mine[:, column[SPHERE]] = by_kind["quadratic_drag.k"][i] * drop.ball.quadratic_per_cd
            mine[:, -1] = drop.height - heights[i]
            whitened = self._whitening[i] @ mine
            residual[rows, 0], derivative[rows, 0] = whitened[:, -1], whitened[:, :-1]
        return residual, derivative

    def predicted(self, values: Values) -> list[Array]:
        """Heights [m] of every drop at its instants."""
        return self._heights(values)[0]

    @staticmethod
    def _name(kind: str, drop: Drop) -> str:
        if kind in _COMMON:
            return kind
        return f"{kind}[{drop.name if kind in _OF_DROP else drop.ball.name}]"

    def _heights(self, values: Values) -> tuple[list[Array], dict[str, list[Array]]]:
        """Prediction, and its derivatives by kind of quantity, drop by drop: central differences of one batch."""
        kinds = tuple(_STEPS)
        base = np.array([[values.get(self._name(k, d), 0.0) for d in self.drops] for k in kinds])
        cd = values.get(SPHERE, 0.0)
        per_cd = np.array([d.ball.quadratic_per_cd if np.isfinite(d.ball.mass) else 0.0 for d in self.drops])
        base[kinds.index("quadratic_drag.k")] += cd * per_cd
        variants = [base]
        for i, step in enumerate(_STEPS.values()):
            for sign in (1.0, -1.0):
                changed = base.copy()
                changed[i] += sign * step
                variants.append(changed)
        everything = np.stack(variants, axis=1)  # (kinds, variants, drops)
        with np.errstate(over="ignore", invalid="ignore"):  # a trial step may go where nothing falls like that
            seen = self._seen(dict(zip(kinds, everything, strict=True)))
            by_kind = {
                k: [(h[1 + 2 * i] - h[2 + 2 * i]) / (2 * step) for h in seen]
                for i, (k, step) in enumerate(_STEPS.items())
            }
        return [h[0] for h in seen], by_kind

    def _seen(self, p: Mapping[str, Array]) -> list[Array]:
        """Heights (variants, n) of every drop as the camera sees them."""
        end = max(float(d.time[-1] - d.time[0]) for d in self.drops)
        grid, height, velocity = fall(p, 1.2 * end)
        found = []
        for i, drop in enumerate(self.drops):
            elapsed = (drop.time - drop.time[0]) / (1.0 + p["frame_rate.change"][:, i, None])
            h = _hermite(grid, height[:, :, i], velocity[:, :, i], elapsed)
            h = h + p["height_scale.change"][:, i, None] * (h - MIDDLE)
            found.append(h + p["perspective.bend"][:, i, None] * (h - MIDDLE) ** 2)
        return found


def fall(p: Mapping[str, Array], duration: float) -> tuple[Array, Array, Array]:
    """Grid (m,) [s], heights and velocities (m, ...) of h'' = -g - (c + k_1 |v| + k_2 v^2) sign(v), Runge-Kutta.

    The constant part takes its sign from a fall: in the first tenth of a second, in which a hand may throw the ball
    upwards, it would switch, which no height of this accuracy shows.
    """
    change, constant, linear, quadratic = (p[k] for k in _FORCES)

    def acceleration(v: Array) -> Array:
        return np.asarray(constant - GRAVITY - change - (linear + quadratic * np.abs(v)) * v, float)

    m = int(np.ceil(duration / STEP)) + 2
    h, v = np.array(p["state.height"], float), np.array(p["state.velocity"], float)
    heights, velocities = [h], [v]
    for _ in range(m - 1):
        a1 = acceleration(v)
        a2 = acceleration(v + STEP / 2 * a1)
        a3 = acceleration(v + STEP / 2 * a2)
        a4 = acceleration(v + STEP * a3)
        h = h + STEP * v + STEP**2 / 6 * (a1 + a2 + a3)
        v = v + STEP / 6 * (a1 + 2 * a2 + 2 * a3 + a4)
        heights.append(h)
        velocities.append(v)
    return STEP * np.arange(m, dtype=float), np.array(heights, float), np.array(velocities, float)


def _hermite(grid: Array, height: Array, velocity: Array, time: Array) -> Array:
    """Cubic through heights and velocities (m, variants), at times (variants, n)."""
    index = np.clip((time / STEP).astype(int), 0, len(grid) - 2)
    which = np.arange(len(time))[:, None]
    u = time / STEP - index
    h0, h1 = height[index, which], height[index + 1, which]
    v0, v1 = STEP * velocity[index, which], STEP * velocity[index + 1, which]
    return np.asarray(
        h0 * (1 + 2 * u) * (1 - u) ** 2 + v0 * u * (1 - u) ** 2 + h1 * u**2 * (3 - 2 * u) + v1 * u**2 * (u - 1), float
    )


def height_noise(drops: Sequence[Drop]) -> SmoothNoise:
    """Noise of a height [m] and [s], from what drops of one ball do not have in common.

    All drops of a ball share an acceleration that is a polynomial in time; start and velocity are each drop's own. What
    is left (grain of the pixels, a hand that throws, wind, a scale that differs from take to take) is no law of the
    ball. One drop alone shows less of it.
    """
    takes: dict[str, list[Drop]] = {}
    for drop in drops:
        takes.setdefault(drop.ball.name, []).append(drop)
    return estimate([_shared_acceleration(group) for group in takes.values()], SmoothNoise(0.05, 0.15, 0.5))


def _shared_acceleration(drops: Sequence[Drop]) -> SampleStretch:
    time = np.concatenate([d.time - d.time[0] for d in drops])
    part = np.concatenate([np.full(len(d.time), i) for i, d in enumerate(drops)])
    own = (part[:, None] == np.arange(len(drops))).astype(float)
    u = time[:, None] / time.max()
    basis = np.concatenate([own, own * u, *(u**k for k in range(2, ACCELERATION_DEGREE + 3))], axis=1)
    return SampleStretch(time, np.concatenate([d.height for d in drops])[:, None], basis, part)


def candidates(balls: Sequence[Ball]) -> tuple[Candidate, ...]:
    """What a fall with gravity alone may lack.

    Drag has a number of its own for every ball; gravity and the camera are the same for all.
    """

    def each(name: str, unit: str, scale: float, typical: float, meaning: str) -> tuple[Quantity, ...]:
        return tuple(
            Quantity(f"{name}[{b.name}]", unit, scale, lower=0.0, typical=typical, meaning=meaning) for b in balls
        )

    def common(name: str, unit: str, scale: float, typical: float, meaning: str) -> tuple[Quantity]:
        return (Quantity(name, unit, scale, typical=typical, meaning=meaning),)

    motion, seen = "motion", "measurement"
    source = "de Silva et al. 2020"
    found = [
        Candidate("constant_drag", "constant_drag", motion, "deceleration that does not depend on speed", source,
                  each("constant_drag.c", "m/s^2", 0.01, 1.0, "against the fall")),
        Candidate("linear_drag", "linear_drag", motion, "drag in proportion to the speed", source,
                  each("linear_drag.k", "1/s", 1e-3, 0.1, "deceleration over speed")),
        Candidate("quadratic_drag", "quadratic_drag", motion, "drag in proportion to the square of the speed", source,
                  each("quadratic_drag.k", "1/m", 1e-4, 0.01, "deceleration over speed squared")),
        Candidate("gravity", "gravity", motion, "another gravity", "",
                  common("gravity.change", "m/s^2", 0.01, 0.01, "added to the declared one")),
        Candidate("height_scale", "height_scale", seen, "scale of the heights wrong", "",
                  common("height_scale.change", "1", 1e-4, 0.02, "relative")),
        Candidate("frame_rate", "frame_rate", seen, "frame rate wrong", "",
                  common("frame_rate.change", "1", 1e-4, 1e-3, "true over declared, minus 1")),
        Candidate("perspective", "perspective", seen, "scale of the heights changes with height", "",
                  common("perspective.bend", "1/m", 1e-5, 1e-3, "error over (height - 30 m) squared")),
    ]  # fmt: skip
    if len(balls) > 1 and any(np.isfinite(b.mass) for b in balls):
        # one number for all of known size and mass: what a law of nature would be
        cd = Quantity(SPHERE, "1", 1e-2, lower=0.0, typical=0.5, meaning="drag coefficient of all balls")
        found.append(Candidate("sphere_drag", "sphere_drag", motion, "quadratic drag, one coefficient for all balls",
                               "Newton; Cd about 0.5 for a smooth sphere at these speeds", (cd,)))  # fmt: skip
    return tuple(found)
