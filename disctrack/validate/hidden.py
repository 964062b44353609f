"""Effects to hide, one by one, in measured trajectories: what is planted, and what the diagnosis should then say.

Every size is one that a careful experimenter would still overlook; directions and signs are drawn, passive effects keep
theirs. `CONTROLS` hide nothing that may be claimed.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.random import Generator

from disctrack.diagnosis.systematic import DOT_SIGMA
from disctrack.errors import DiscTrackError
from disctrack.rolling import CATALOGUE
from disctrack.synthetic.description import CameraFault
from disctrack.validate.points import ORDINARY, STATION, Laboratory, Planted

N_DOTS = 6


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


def _clock(size: float, rng: Generator) -> Planted:
    value = size * _sign(rng)
    return Planted({"frame_rate.change": value}, clock=value)


def _camera(keys: tuple[str, ...], fault: Callable[[tuple[float, ...]], CameraFault]) -> Callable[..., Planted]:
    """A fault of either camera, `fault` from numbers of the diagnosis' keys ("turned.rotation_x")."""

    def plant(size: float, rng: Generator) -> Planted:
        which = "left" if rng.random() < 0.5 else "right"
        numbers = _direction(size, rng, len(keys))
        truth = {f"{which}_{k}": v for k, v in zip(keys, numbers, strict=True)}
        return Planted(truth, faults={which: fault(numbers)})

    return plant


def _triple(numbers: tuple[float, ...], factor: float) -> tuple[float, float, float]:
    x, y, z = numbers
    return factor * x, factor * y, factor * z


def _misprint(size: float, rng: Generator) -> Planted:
    which = int(rng.integers(N_DOTS))
    x, y = _direction(size, rng, 2)
    places = [(0.0, 0.0)] * N_DOTS
    places[which] = (1e3 * x, 1e3 * y)
    return Planted({f"misprint_{which}.x": x, f"misprint_{which}.y": y}, faults={"misprint_mm": tuple(places)})


def _plane(keys: tuple[str, str], fault: str, factor: float) -> Callable[..., Planted]:
    """A fault with a direction in a plane; `factor` from the diagnosis' unit to that of the scene's key."""

    def plant(size: float, rng: Generator) -> Planted:
        x, y = _direction(size, rng, 2)
        return Planted(dict(zip(keys, (x, y), strict=True)), faults={fault: (factor * x, factor * y)})

    return plant


def _one(key: str, fault: str, factor: float = 1.0, null: float = 0.0) -> Callable[..., Planted]:
    """A fault of one number with a sign."""

    def plant(size: float, rng: Generator) -> Planted:
        value = size * _sign(rng)
        return Planted({key: value}, faults={fault: null + factor * value})

    return plant


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
    HiddenEffect("time_offset", "one camera late", 1e-4, "s", _one(
        "time_offset.delay", "right_delay_s")),
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
    HiddenEffect("pattern_offset", "pattern off centre", 2e-5, "m", _plane(
        ("pattern_offset.x", "pattern_offset.y"), "pattern_offset_mm", 1e3)),
    HiddenEffect("pattern_rotation", "pattern turned", 1e-3, "rad", _one(
        "pattern_rotation.angle", "pattern_turn_deg", 180 / np.pi), visible=False),
    HiddenEffect("pattern_scale", "pattern too large", 1e-3, "1", _one(
        "pattern_scale.change", "pattern_scale", null=1.0)),
    HiddenEffect("pattern_height", "pattern too high", 5e-5, "m", _one(
        "pattern_height.offset", "pattern_height_mm", 1e3)),
    HiddenEffect("table_plane", "table not parallel to its view", 2e-4, "rad", _plane(
        ("table_plane.tilt_x", "table_plane.tilt_y"), "table_turn_deg", 180 / np.pi)),
    HiddenEffect("table_height", "table not at the height of its view", 5e-5, "m", _one(
        "table_height.offset", "table_height_mm", 1e3)),
    HiddenEffect("exposure_blur", "exposure", 2e-3, "s", lambda size, _: Planted(
        {"exposure_blur.T2": size**2}, faults={"exposure_s": size})),
    HiddenEffect("ellipse_centre", "bias of the ellipse centre", 1.0, "1", lambda size, _: Planted(
        {"ellipse_centre.share": size}, faults={"ellipse_centre_share": size})),
)  # fmt: skip
CONTROLS: tuple[HiddenEffect, ...] = (
    HiddenEffect("nothing", "nothing at all", 1.0, "1", lambda size, _: Planted()),
    HiddenEffect("prints", "small errors of the dots' places, as every diagnosis allows for", DOT_SIGMA, "m",
                 lambda size, _: Planted(laboratory=Laboratory(print_m=size))),
    HiddenEffect("laboratory", "an imperfect laboratory", 1.0, "1", lambda size, _: Planted(laboratory=ORDINARY)),
)  # fmt: skip


def hidden_effect(name: str) -> HiddenEffect:
    """By its name. Raises DiscTrackError."""
    for effect in (*HIDDEN_EFFECTS, *CONTROLS):
        if effect.name == name:
            return effect
    known = ", ".join(e.name for e in (*HIDDEN_EFFECTS, *CONTROLS))
    raise DiscTrackError(f"there is no effect '{name}' to hide; there are {known}")


def together(planted: Sequence[Planted]) -> Planted:
    """Several at once; of faults that exclude each other the last one holds."""
    truth, effects, faults = (
        {k: v for p in planted for k, v in getattr(p, kind).items()} for kind in ("truth", "effects", "faults")
    )
    clock = next((p.clock for p in reversed(planted) if p.clock), 0.0)
    laboratory = next((p.laboratory for p in reversed(planted) if p.laboratory != Laboratory()), Laboratory())
    return Planted(truth, effects, faults, clock, laboratory)
