"""How much noise, blur, motion, uneven light or hiding the measurement bears before the paper's claim fails.

A few poses with nutation between 3 and 30 degrees are rendered at one level after the other: first a coarse ladder
from mild to hopeless, then bisection (in the logarithm) between the last level at which the claim held and the first at
which it did not. The rig is the one calibrated under good conditions: only the filming is disturbed.
"""

from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from calibration.cameras.camera import StereoRig
from calibration.kit.arrays import Array, Mask
from disctrack.disc import Disc, precession_rate
from disctrack.errors import TrackingError
from disctrack.synthetic import render_disc
from disctrack.synthetic.description import GlareSettings, Occluder, Scene
from disctrack.validate.comparison import compare
from disctrack.validate.poses import cameras_in_sight
from disctrack.validate.trial import every, locate

CLAIM_POSITION = 5e-6  # [m] and
CLAIM_ROTATION = np.radians(0.05)  # Ma et al. 2014, end of section 3
LOST_ALLOWED = 0.1  # part of the poses that may be without an answer
THETA_DEG = (3.0, 30.0)


@dataclass(frozen=True)
class Level:
    """Errors at one level of a disturbance; root mean squares per axis over the poses that were found."""

    level: float
    position: float  # [m]
    rotation: float  # [rad]
    lost: float  # part of the poses without an answer, or with one that is another pose altogether
    holds: bool


@dataclass(frozen=True)
class Stress:
    """What one disturbance did."""

    name: str
    unit: str
    levels: tuple[Level, ...]  # by increasing level
    fails_between: tuple[float, float]  # last level at which the claim held, first at which not; inf: it never failed

    @property
    def broken(self) -> str:
        """What failed first."""
        first = next((level for level in self.levels if not level.holds), None)
        if first is None:
            return "nothing"
        causes = [
            ("position", first.position > CLAIM_POSITION),
            ("rotation", first.rotation > CLAIM_ROTATION),
            ("poses lost", first.lost > LOST_ALLOWED),
        ]
        return ", ".join(name for name, failed in causes if failed)


@dataclass(frozen=True)
class Disturbance:
    """A way to make the images worse: level -> scene, with the rates and the visible dots it implies."""

    name: str
    unit: str
    ladder: tuple[float, ...]
    scene: Callable[[Scene, float], Scene]
    moving: bool = False
    hidden: bool = False  # the level is a number of dots that have come off


def _noise(scene: Scene, level: float) -> Scene:
    return replace(scene, sensor=replace(scene.sensor, read_noise_dn=level))


def _blur(scene: Scene, level: float) -> Scene:
    return replace(scene, optics=replace(scene.optics, blur_px=(level, level)))


def _exposure(scene: Scene, level: float) -> Scene:
    return replace(scene, cameras=replace(scene.cameras, exposure_s=level * 1e-3))


def _gradient(scene: Scene, level: float) -> Scene:
    return replace(scene, light=replace(scene.light, gradient_per_m=(0.8 * level, 0.6 * level)))


def _glare(scene: Scene, level: float) -> Scene:
    width, height = scene.cameras.image_size
    spots = tuple(GlareSettings(name, (0.5 * width, 0.5 * height), 0.1 * width, level) for name in ("left", "right"))
    return replace(scene, light=replace(scene.light, glare=spots))


def _rod(scene: Scene, level: float) -> Scene:
    width, height = scene.cameras.image_size
    rods = tuple(
        Occluder(name, (0.5 * width, 0.5 * height), angle, max(level, 1e-3))
        for name, angle in (("left", 20.0), ("right", 110.0))
    )
    return replace(scene, faults=replace(scene.faults, occluders=rods))


def _same(scene: Scene, level: float) -> Scene:
    return scene


DISTURBANCES = (
    Disturbance("noise of a pixel", "grey values", (2.0, 6.0, 16.0, 40.0), _noise),
    Disturbance("blur (sigma)", "px", (1.2, 2.0, 3.2, 6.0), _blur),
    Disturbance("motion blur: exposure while rolling", "ms", (0.5, 1.5, 4.0, 12.0), _exposure, moving=True),
    Disturbance("light gradient", "of the light per m", (2.0, 6.0, 12.0, 24.0), _gradient),
    Disturbance("glare: spot of 0.1 image widths", "grey values at its middle", (20.0, 60.0, 120.0, 230.0), _glare),
    Disturbance("dots that have come off", "of 6, the innermost stays", (1.0, 2.0, 3.0, 4.0), _same, hidden=True),
    Disturbance("a rod before each camera: its width", "px", (10.0, 30.0, 80.0, 160.0), _rod),
)  # fmt: skip


def stress_poses(n: int, rig: StereoRig, scene: Scene, rng: np.random.Generator) -> Array:
    """(n, 6) poses seen by both cameras, even in log(theta) over THETA_DEG, near the middle of the field."""
    disc, found = scene.declared_disc, []
    thetas = np.radians(np.geomspace(*THETA_DEG, n))
    for theta in thetas:
        for _ in range(200):
            x, y = np.array(scene.rig.target_mm[:2]) * 1e-3 + rng.uniform(-8e-3, 8e-3, 2)
            q = np.array([x, y, disc.resting_height(theta), rng.uniform(-np.pi, np.pi), theta, rng.uniform(0, 6)])
            if cameras_in_sight(q[None], rig, disc)[0] == 2:
                break
        found.append(q)
    return np.array(found)


def rolling_rates(q: Array, disc: Disc, gravity: float) -> Array:
    """(n, 6) rates of regular precession with the centre at rest: psidot, phidot = omega3 - psidot cos(theta)."""
    rates = np.zeros_like(q)
    for row, theta in zip(rates, q[:, 4], strict=True):
        psidot, omega3 = precession_rate(float(theta), disc, gravity)
        row[3], row[5] = psidot, omega3 - psidot * np.cos(theta)
    return rates


def apply_stress(
    disturbance: Disturbance, scene: Scene, true: StereoRig, own: StereoRig, q: Array, *, bisections: int
) -> Stress:
    """Raise one disturbance until the claim fails. true, own: the cameras as they are, and as calibrated."""
    disc = scene.declared_disc
    rates = rolling_rates(q, disc, scene.gravity_m_s2) if disturbance.moving else None

    def at(level: float) -> Level:
        # the same noise and the same dots at every level, so that the curves are smooth
        rng = np.random.default_rng([scene.seed, 10])
        visible = None
        if disturbance.hidden:
            visible = ~np.repeat(_dots_off(disc, len(q), int(level), rng)[:, None], 2, axis=1)
        images = render_disc(q, true, disc, disturbance.scene(scene, level), rng, qdot=rates, visible=visible)
        return judge(level, images, own, disc, scene, q)

    levels = {}
    for level in disturbance.ladder:
        levels[level] = at(level)
        if not levels[level].holds:
            break
    for _ in range(0 if disturbance.hidden else bisections):
        low, high = bracket(list(levels.values()))
        if not np.isfinite(high) or low == 0:
            low = min(levels) / 3 if low == 0 else low
        if not np.isfinite(high):
            break
        middle = float(np.sqrt(low * high))
        levels[middle] = at(middle)
    ordered = tuple(levels[level] for level in sorted(levels))
    return Stress(disturbance.name, disturbance.unit, ordered, bracket(list(ordered)))


def _dots_off(disc: Disc, n: int, count: int, rng: np.random.Generator) -> Mask:
    """(n, m) which dots have come off, at random, but for the innermost: without it the others repeat every 60 deg."""
    keeps = int(np.argmin(np.linalg.norm(disc.marker_centres_body[:, :2], axis=1)))
    others = np.delete(np.arange(disc.n_markers), keeps)
    order = rng.permuted(np.tile(others, (n, 1)), axis=1)
    off = np.zeros((n, disc.n_markers), bool)
    np.put_along_axis(off, order[:, :count], True, axis=1)
    return off


def bracket(levels: list[Level]) -> tuple[float, float]:
    """(last level at which the claim held, first at which it failed); 0 and inf where there is none."""
    failed = min((level.level for level in levels if not level.holds), default=float("inf"))
    return max((level.level for level in levels if level.holds and level.level < failed), default=0.0), failed


def judge(level: float, images: NDArray, rig: StereoRig, disc: Disc, scene: Scene, q: Array) -> Level:
    """Measure images of the poses q through `rig` and hold the errors against the claim."""
    try:
        tracking = locate(images, rig, disc, scene.cameras.frame_rate_hz, apart=True)
    except TrackingError:
        return Level(level, float("nan"), float("nan"), 1.0, False)
    comparison = compare(every(tracking.trajectory, 2), q)
    ok = comparison.usable
    lost = float(1 - ok.mean())
    if not ok.any():
        return Level(level, float("nan"), float("nan"), lost, False)
    position = float(np.sqrt(np.mean(comparison.error[ok, :3] ** 2)))
    rotation = float(np.sqrt(np.mean(comparison.error[ok, 3:] ** 2)))
    holds = position <= CLAIM_POSITION and rotation <= CLAIM_ROTATION and lost <= LOST_ALLOWED
    return Level(level, position, rotation, lost, holds)
