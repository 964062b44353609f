"""Effects to hide in measured trajectories, and recordings with them.

Every case has a random motion, a rig with its own calibration error, and noise of the dots (`points`). An effect has
the name, quantities and units of the diagnosis' candidate. Its size is one that a careful experimenter would overlook.
Directions and signs are random, except for the signs of passive effects.
"""

from collections import defaultdict
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from functools import cache
from re import sub

import numpy as np
from numpy.random import Generator

from disctrack.diagnosis.motion import measurement_candidates, motion_candidates
from disctrack.diagnosis.systematic import DOT_SIGMA
from disctrack.discrepancy.system import Candidate
from disctrack.errors import DiscTrackError
from disctrack.faults.catalogue import scene_faults
from disctrack.rolling import CATALOGUE, Model, simulate
from disctrack.synthetic.description import Scene
from disctrack.synthetic.motion import rolling_start
from disctrack.trajectory import Trajectory
from disctrack.validate.points import ORDINARY, Laboratory, measured

# [SI] sizes that a careful experimenter would overlook, if they differ from `Quantity.typical` more than twofold
OVERLOOKED = {
    "table_tilt": np.radians(0.35),
    "kz": 6e-5,
    "creep": 2e-6,
    "table_shaken": 2e-6,
    "frame_rate": 0.012,
    "rolling_classical": 2e-4,
    "drag_rotation": 2.5e-6,
    "air_bildsten": 0.3,
    "km_e2": 0.381e-8,
    "rolling_power": 1e-5,
    "contour_dry": 1e-4,
    "gravity": 0.05,
    "time_offset": 1e-4,
    "focal": 1e-3,
    "pattern_rotation": 1e-3,
    "pattern_scale": 1e-3,
    "ellipse_centre": 1.0,
}
CONTROLS = {"nothing": 1.0, "prints": DOT_SIGMA, "laboratory": 1.0}  # cases in which nothing should be claimed
NOT_HIDDEN = ("km", "slip", "surface_moves", "table_settles", "clock_drift")  # km is in every model
INVISIBLE = ("pattern_rotation",)  # not determined by recordings of one disc: nothing should be claimed
FIRST_ALONE = ("spring", "table_curved")  # only the first quantity of the candidate is planted
DURATION = (0.4, 0.9)  # [s]
FLATTEST_DEG = 0.9  # smallest nutation of the last frame: below, the disc touches its paper
Values = dict[str, float]  # by name of a quantity


@dataclass(frozen=True)
class HiddenCase:
    """Hidden effects with sizes in the recording of a seed; in controls nothing should be claimed."""

    hidden: Mapping[str, float]
    seed: int
    rate: float = 1000.0  # [Hz]

    @property
    def has_effects(self) -> bool:
        """Is there an effect that the diagnosis should name?"""
        return any(name not in CONTROLS for name in self.hidden)


@cache
def _catalogue() -> Mapping[str, list[Candidate]]:
    """Candidates of the diagnosis by name; one per camera or dot if they have their own."""
    disc, found = Scene().declared_disc, defaultdict[str, list[Candidate]](list)
    for candidate in (*motion_candidates(Model(disc)), *measurement_candidates(disc)):
        found[sub(r"^(left|right)_|_\d$", "", candidate.name)].append(candidate)
    return found


def sizes() -> dict[str, float]:
    """Size of every effect that can be hidden."""
    typical = {name: alike[0].quantities[0].typical for name, alike in _catalogue().items() if name not in NOT_HIDDEN}
    return typical | OVERLOOKED


def alike(name: str) -> Sequence[Candidate]:
    """Candidates of the diagnosis with this name; empty for a control. Raises DiscTrackError."""
    if name not in sizes() | CONTROLS:
        raise DiscTrackError(f"there is no effect '{name}' to hide; there are {', '.join(sizes() | CONTROLS)}")
    return _catalogue().get(name, ())


def plant(name: str, size: float, rng: Generator) -> tuple[Values, Values]:
    """An effect of this size [SI] with random sign or direction, if applicable of a random camera or dot.

    returns : true values of the diagnosis' quantities, and all planted values: "effect.parameter" of the motion,
        "fault.part" of the measurement
    """
    candidates = alike(name)
    if not candidates:
        return {}, {}
    candidate = candidates[int(rng.integers(len(candidates)))]
    quantities = candidate.quantities[:1] if name in FIRST_ALONE else candidate.quantities
    passive = quantities[0].lower == 0
    if len(quantities) > 1 or candidate.kind == "measurement":
        direction = rng.standard_normal(len(quantities))
        numbers = size * direction / np.linalg.norm(direction)
    else:
        numbers = np.array([size if passive else size * rng.choice([-1.0, 1.0])])
    numbers = np.abs(numbers) if passive else numbers
    truth = {q.name: float(number) for q, number in zip(quantities, numbers, strict=True)}
    shape = {"rim_flat.angle": rng.uniform(0, 2 * np.pi)} if name == "rim_flat" else {}
    return truth, truth | shape


def draw(seed: int, planted: Values, rate: float = HiddenCase.rate) -> Scene:
    """A random motion that, with the planted effects, lasts for the whole recording."""
    rng = np.random.default_rng([seed, 31])
    disc = Scene().declared_disc
    scene = Scene(seed=seed, faults=scene_faults(disc, planted, rate))
    of_motion = {name: value for name, value in planted.items() if name.partition(".")[0] in CATALOGUE}
    for _ in range(200):
        theta = float(rng.uniform(3.0, 15.0))  # [deg]
        n = int(rate * rng.uniform(*DURATION))
        nutation = theta * float(rng.uniform(0.02, 0.1))
        omega3 = float(rng.uniform(-2.0, 3.0))  # [rad/s]
        model = Model(disc).with_values({"km.k_m": float(rng.uniform(0.2e-7, 0.5e-7))} | of_motion)
        effects = {effect.name: dict(effect.values) for effect in model.effects}
        rolling = {"theta_deg": theta, "nutation_deg": nutation, "omega3_rad_s": omega3, "effects": effects}
        cameras = {"frame_rate_hz": rate, "n_frames": n}
        scene = scene.changed(cameras=cameras, motion={"kind": "rolling", "rolling": rolling})
        try:
            motion = simulate(model, rolling_start(scene), duration=1.03 * n / rate + 0.01, rate=rate)
        except DiscTrackError:  # no regular precession exists
            continue
        if len(motion) > 1.02 * n and motion.q[-1, 4] > np.radians(FLATTEST_DEG):
            return scene
    raise DiscTrackError(f"no motion of {DURATION[0]} s among those drawn: what is planted stops the disc at once")


def recorded(case: HiddenCase) -> tuple[list[Values], Values, Trajectory]:
    """True values of the quantities of each planted effect, all planted values, and the recording."""
    rng = np.random.default_rng([case.seed, 32])
    parts = [plant(name, size, rng) for name, size in case.hidden.items()]
    planted = {name: value for _, values in parts for name, value in values.items()}
    laboratory = ORDINARY if "laboratory" in case.hidden else Laboratory(print_m=case.hidden.get("prints", 0.0))
    trajectory = measured(draw(case.seed, planted, case.rate), laboratory)
    return [truth for truth, _ in parts if truth], planted, trajectory


def hidden_cases(
    names: Sequence[str], seeds: Sequence[int], pairs: int = 0, rate: float = HiddenCase.rate
) -> Iterator[HiddenCase]:
    """Each effect ("NAME" or "NAME=SIZE"; by default all) with each seed; or random pairs, each with its own seed."""
    hidden = [_sized(name) for name in names] or [*sizes().items()]
    if not pairs:
        yield from (HiddenCase({name: size}, seed, rate) for name, size in hidden for seed in seeds)
        return
    visible = [(name, size) for name, size in hidden if name not in INVISIBLE]
    rng = np.random.default_rng([seeds[0], 33])
    for number in range(pairs):
        two = rng.choice(len(visible), 2, replace=False)
        yield HiddenCase(dict(visible[int(k)] for k in two), seeds[0] + number, rate)


def _sized(text: str) -> tuple[str, float]:
    name, _, size = text.partition("=")
    units = [candidate.quantities[0].unit for candidate in alike(name)]
    try:
        return name, float(size) if size else (sizes() | CONTROLS)[name]
    except ValueError:
        raise DiscTrackError(f"{text}: expected EFFECT=SIZE with the size in {(*units, 'm')[0]}") from None
