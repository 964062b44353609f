"""Effects to hide, one by one, in measured trajectories: what is planted, and what the diagnosis should then say.

Every size is that of the issue at hand or one that a careful experimenter would still overlook; directions and signs
are drawn, passive effects keep theirs.
"""

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field

import numpy as np
from numpy.random import Generator

from disctrack.diagnosis.trials.recordings import STATION, Unseen
from disctrack.errors import DiscTrackError
from disctrack.rolling import CATALOGUE
from disctrack.synthetic.description import CameraFault, Faults, Triple

N_DOTS = 6


@dataclass(frozen=True)
class Planted:
    """What goes into the data, and the values of the diagnosis' quantities that are true then."""

    truth: Mapping[str, float]
    effects: Mapping[str, float] = field(default_factory=dict)  # of the motion
    faults: Faults = field(default_factory=Faults)
    unseen: Unseen = field(default_factory=Unseen)


@dataclass(frozen=True)
class HiddenEffect:
    """An effect that can be hidden at any size."""

    name: str  # of the candidate that means it
    title: str
    size: float
    unit: str
    plant: Callable[[float, Generator], Planted]
    visible: bool = True  # False: no recording of one disc shows it, and nothing should be said


def _sign(rng: Generator) -> float:
    return float(rng.choice([-1.0, 1.0]))


def _direction(size: float, rng: Generator, n: int) -> tuple[float, ...]:
    v = rng.standard_normal(n)
    return tuple((size * v / np.linalg.norm(v)).tolist())


def _law(name: str, title: str, parameter: str, size: float, unit: str, signed: bool = False) -> HiddenEffect:
    """An effect of the motion with one number; `parameter` by its full name where it is part of another effect."""

    def plant(size: float, rng: Generator) -> Planted:
        key = parameter if "." in parameter else f"{name}.{parameter}"
        values = {key: size * (_sign(rng) if signed else 1.0)}
        return Planted(values, effects=values)

    return HiddenEffect(name, title, size, unit, plant)


def _vector(candidate: str, title: str, keys: tuple[str, ...], size: float, unit: str) -> HiddenEffect:
    """An effect of the motion with a size and a direction."""

    def plant(size: float, rng: Generator) -> Planted:
        values = dict(zip(keys, _direction(size, rng, len(keys)), strict=True))
        return Planted(values, effects=values)

    return HiddenEffect(candidate, title, size, unit, plant)


def _flat(size: float, rng: Generator) -> Planted:
    values = {"rim_flat.depth": size}
    return Planted(values, effects=values | {"rim_flat.angle": rng.uniform(0, 2 * np.pi)})


def _shaken(size: float, rng: Generator) -> Planted:
    """The diagnosis' phase is that at the first frame."""
    cosine, sine = np.array(_direction(size, rng, 6)).reshape(2, 3)
    turn = 2 * np.pi * CATALOGUE["table_shaken"]().values["frequency"] * STATION
    c, s = np.cos(turn), np.sin(turn)
    keys = [f"table_shaken.u_{phase}_{axis}" for phase in ("cos", "sin") for axis in "xyz"]
    truth, effects = (
        dict(zip(keys, np.ravel(u).tolist(), strict=True))
        for u in ((cosine, sine), (c * cosine - s * sine, s * cosine + c * sine))
    )
    return Planted(truth, effects=effects)


def _delay(size: float, rng: Generator) -> Planted:
    value = size * _sign(rng)
    return Planted({"time_offset.delay": value}, faults=Faults(right_delay_s=value))


def _clock(size: float, rng: Generator) -> Planted:
    value = size * _sign(rng)
    return Planted({"frame_rate.change": value}, unseen=Unseen(clock=value))


def _camera(keys: tuple[str, ...], fault: Callable[[tuple[float, ...]], CameraFault]) -> Callable[..., Planted]:
    """A fault of either camera, `fault` from numbers of the diagnosis' keys ("turned.rotation_x")."""

    def plant(size: float, rng: Generator) -> Planted:
        which = "left" if rng.random() < 0.5 else "right"
        numbers = _direction(size, rng, len(keys))
        truth = {f"{which}_{k}": v for k, v in zip(keys, numbers, strict=True)}
        broken = fault(numbers)
        return Planted(truth, faults=Faults(left=broken) if which == "left" else Faults(right=broken))

    return plant


def _triple(numbers: tuple[float, ...], factor: float) -> Triple:
    x, y, z = numbers
    return factor * x, factor * y, factor * z


def _misprint(size: float, rng: Generator) -> Planted:
    which = int(rng.integers(N_DOTS))
    x, y = _direction(size, rng, 2)
    places = [(0.0, 0.0)] * N_DOTS
    places[which] = (1e3 * x, 1e3 * y)
    return Planted({f"misprint_{which}.x": x, f"misprint_{which}.y": y}, faults=Faults(misprint_mm=tuple(places)))


def _pattern(size: float, rng: Generator) -> Planted:
    x, y = _direction(size, rng, 2)
    offset = (1e3 * x, 1e3 * y)
    return Planted({"pattern_offset.x": x, "pattern_offset.y": y}, faults=Faults(pattern_offset_mm=offset))


def _table(size: float, rng: Generator) -> Planted:
    x, y = _direction(size, rng, 2)
    return Planted({"table_plane.tilt_x": x, "table_plane.tilt_y": y}, unseen=Unseen(table_turn=(x, y)))


def _one(key: str, unseen: Callable[[float], Unseen], signed: bool = True) -> Callable[..., Planted]:
    def plant(size: float, rng: Generator) -> Planted:
        value = size * (_sign(rng) if signed else 1.0)
        return Planted({key: value}, unseen=unseen(value))

    return plant


def _exposure(size: float, rng: Generator) -> Planted:
    return Planted({"exposure_blur.T2": size**2}, unseen=Unseen(exposure=size))


def _centres(size: float, rng: Generator) -> Planted:
    return Planted({"ellipse_centre.share": 1.0}, unseen=Unseen(image_centres=True))


_TURN, _SHIFT = ("rotation_x", "rotation_y", "rotation_z"), ("translation_x", "translation_y", "translation_z")

HIDDEN_EFFECTS: tuple[HiddenEffect, ...] = (
    _vector("table_tilt", "tilted table", ("table_tilt.tilt_x", "table_tilt.tilt_y"), np.radians(0.35), "rad"),
    _law("kz", "pivoting friction", "k_z", 6e-5, "m"),
    _law("spring", "force towards a point", "k", 0.05, "N/m", signed=True),
    _law("rolling_adhesive", "rolling friction by adhesion", "a", 2e-5, "N m"),
    _law("table_curved", "hollow or domed table", "kappa", 0.1, "1/m", signed=True),
    _vector("rim_oval", "oval rim", ("rim.oval_c", "rim.oval_s"), 1e-5, "m"),
    _vector("rim_lobes", "rim with three lobes", ("rim.lobes_c", "rim.lobes_s"), 1e-5, "m"),
    HiddenEffect("rim_flat", "flat of the rim", 1e-5, "m", _flat),
    _law("table_yielding", "table gives way", "c", 1e-6, "m/N"),
    _law("creep", "contact that creeps", "c", 2e-6, "m/s"),
    HiddenEffect("table_shaken", "table shaken under the cameras", 2e-6, "m", _shaken),
    HiddenEffect("frame_rate", "wrong frame rate", 0.012, "1", _clock),
    _law("rolling_classical", "classical rolling friction", "delta", 2e-4, "m"),
    _law("air_moffatt", "air layer (Moffatt)", "f", 1.0, "1"),
    _law("drag_rotation", "linear drag on the rotation", "c", 2.5e-6, "N m s"),
    _vector("centre_of_mass", "centre of mass off", ("centre_of_mass.c_1", "centre_of_mass.c_2"), 1e-4, "m"),
    _law("inertia_axial", "J3 wrong", "e", 0.005, "1", signed=True),
    _law("air_bildsten", "air layer (Bildsten)", "beta", 0.3, "1"),
    _law("air_quadratic", "quadratic air drag", "a", 0.1, "1"),
    _law("air_spin", "air drag on the spin", "a", 1e-7, "N m s"),
    _law("drag_linear", "linear drag", "c", 1e-4, "N s/m"),
    _law("pivoting_viscous", "viscous pivoting friction", "k", 1e-5, "m s"),
    _law("pivoting_contensou", "Coulomb-Contensou pivoting friction", "k", 1e-5, "m"),
    _law("km_e2", "k_m in the direction of e2", "k", 0.381e-8, "m s^2"),
    _law("kn", "friction on the nutation", "k_n", 0.381e-7, "m s^2"),
    _law("rolling_power", "exponent 1.5 beside k_m's 2", "k", 1e-5, "m"),
    _law("contour_dry", "dry contour friction", "mu_c", 1e-4, "1"),
    _law("contour_viscous", "viscous contour friction", "c", 1e-5, "N s/m"),
    _law("rolling_viscous", "viscous rolling friction", "c", 1e-6, "m s"),
    _law("centre_of_mass_axial", "centre of mass off along e3", "centre_of_mass.c_3", 1e-4, "m", signed=True),
    _law("gravity", "gravity wrong", "g_error", 0.05, "m/s^2", signed=True),
    _law("contact_radius", "radius of the contact wrong", "r_error", 2e-5, "m", signed=True),
    _law("contact_height", "height of the contact wrong", "h_error", 2e-5, "m", signed=True),
    _law("edge_radius", "rounded edge", "rho", 1e-4, "m"),
    _law("inertia_diametral", "J1 wrong", "e", 0.005, "1", signed=True),
    _vector("inertia_product", "product of inertia", ("inertia_product.J_13", "inertia_product.J_23"), 1e-8, "kg m^2"),
    HiddenEffect("time_offset", "one camera late", 1e-4, "s", _delay),
    HiddenEffect("turned", "camera turned", 2e-4, "rad", _camera(
        tuple(f"turned.{k}" for k in _TURN), lambda v: CameraFault(rotation_deg=_triple(v, 180 / np.pi)))),
    HiddenEffect("shifted", "camera shifted", 2e-4, "m", _camera(
        tuple(f"shifted.{k}" for k in _SHIFT), lambda v: CameraFault(translation_mm=_triple(v, 1e3)))),
    HiddenEffect("focal", "focal length", 1e-3, "1", _camera(
        ("focal.change",), lambda v: CameraFault(focal_scale=1 + v[0]))),
    HiddenEffect("principal_point", "principal point", 0.3, "px", _camera(
        ("principal_point.x", "principal_point.y"), lambda v: CameraFault(principal_point_change_px=(v[0], v[1])))),
    HiddenEffect("distortion", "distortion", 0.05, "1", _camera(
        ("distortion.k1",), lambda v: CameraFault(k1_change=v[0]))),
    HiddenEffect("misprint", "one dot misprinted", 2e-5, "m", _misprint),
    HiddenEffect("pattern_offset", "pattern off centre", 2e-5, "m", _pattern),
    HiddenEffect("pattern_rotation", "pattern turned", 1e-3, "rad", _one(
        "pattern_rotation.angle", lambda v: Unseen(pattern_turn=v)), visible=False),
    HiddenEffect("pattern_scale", "pattern too large", 1e-3, "1", _one(
        "pattern_scale.change", lambda v: Unseen(pattern_scale=v))),
    HiddenEffect("pattern_height", "pattern too high", 5e-5, "m", _one(
        "pattern_height.offset", lambda v: Unseen(pattern_height=v))),
    HiddenEffect("table_plane", "table not parallel to its view", 2e-4, "rad", _table),
    HiddenEffect("table_height", "table not at the height of its view", 5e-5, "m", _one(
        "table_height.offset", lambda v: Unseen(table_height=v))),
    HiddenEffect("exposure_blur", "exposure", 2e-3, "s", _exposure),
    HiddenEffect("ellipse_centre", "bias of the ellipse centre", 1.0, "1", _centres),
)  # fmt: skip


def hidden_effect(name: str) -> HiddenEffect:
    """By its name. Raises DiscTrackError."""
    for effect in HIDDEN_EFFECTS:
        if effect.name == name:
            return effect
    known = ", ".join(e.name for e in HIDDEN_EFFECTS)
    raise DiscTrackError(f"there is no effect '{name}' to hide; there are {known}")
