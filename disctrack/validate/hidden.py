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
from disctrack.faults.catalogue import faults_of
from disctrack.rolling import CATALOGUE
from disctrack.synthetic.description import Scene
from disctrack.validate.points import ORDINARY, STATION, Laboratory, Planted

Plant = Callable[[float, Generator], Planted]


@dataclass(frozen=True)
class HiddenEffect:
    """An effect that can be hidden at any size."""

    name: str  # of the candidate that means it
    size: float
    unit: str
    plant: Plant
    visible: bool = True  # False: no recording of one disc shows it, and nothing should be said


def _sign(rng: Generator) -> float:
    return float(rng.choice([-1.0, 1.0]))


def _direction(size: float, rng: Generator, n: int) -> list[float]:
    v = rng.standard_normal(n)
    return [float(x) for x in size * v / np.linalg.norm(v)]


def _motion(name: str, size: float, unit: str, *keys: str, signed: bool = False) -> HiddenEffect:
    """An effect of the motion: one number, or several with a direction; keys of another effect by their full name."""
    names = [key if "." in key else f"{name}.{key}" for key in keys]

    def plant(size: float, rng: Generator) -> Planted:
        one = [size * (_sign(rng) if signed else 1.0)] if len(names) == 1 else _direction(size, rng, len(names))
        values = dict(zip(names, one, strict=True))
        return Planted(values, effects=values)

    return HiddenEffect(name, size, unit, plant)


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


def _wrong(name: str, size: float, visible: bool = True) -> HiddenEffect:
    """A fault of the measurement, of one camera or dot drawn among those there are, with a sign or a direction."""
    alike = [f for f in faults_of(Scene().declared_disc) if name in (f.name, *f.name.split("_", 1))]

    def plant(size: float, rng: Generator) -> Planted:
        fault = alike[int(rng.integers(len(alike)))]
        numbers = _direction(size, rng, len(fault.parts))
        numbers = np.abs(numbers).tolist() if fault.bounds[0] == 0 else numbers
        truth = dict(zip(fault.names(), numbers, strict=True))
        return Planted(truth, wrong=truth)

    return HiddenEffect(name, size, alike[0].unit, plant, visible)


HIDDEN_EFFECTS: tuple[HiddenEffect, ...] = (
    _motion("table_tilt", np.radians(0.35), "rad", "table_tilt.tilt_x", "table_tilt.tilt_y"),
    _motion("kz", 6e-5, "m", "k_z"),
    _motion("spring", 0.05, "N/m", "k", signed=True),
    _motion("rolling_adhesive", 2e-5, "N m", "a"),
    _motion("table_curved", 0.1, "1/m", "kappa", signed=True),
    _motion("rim_oval", 1e-5, "m", "rim.oval_c", "rim.oval_s"),
    _motion("rim_lobes", 1e-5, "m", "rim.lobes_c", "rim.lobes_s"),
    HiddenEffect("rim_flat", 1e-5, "m", _flat),
    _motion("table_yielding", 1e-6, "m/N", "c"),
    _motion("creep", 2e-6, "m/s", "c"),
    HiddenEffect("table_shaken", 2e-6, "m", _shaken),
    _wrong("frame_rate", 0.012),
    _motion("rolling_classical", 2e-4, "m", "delta"),
    _motion("air_moffatt", 1.0, "1", "f"),
    _motion("drag_rotation", 2.5e-6, "N m s", "c"),
    _motion("centre_of_mass", 1e-4, "m", "centre_of_mass.c_1", "centre_of_mass.c_2"),
    _motion("inertia_axial", 0.005, "1", "e", signed=True),
    _motion("air_bildsten", 0.3, "1", "beta"),
    _motion("air_quadratic", 0.1, "1", "a"),
    _motion("air_spin", 1e-7, "N m s", "a"),
    _motion("drag_linear", 1e-4, "N s/m", "c"),
    _motion("pivoting_viscous", 1e-5, "m s", "k"),
    _motion("pivoting_contensou", 1e-5, "m", "k"),
    _motion("km_e2", 0.381e-8, "m s^2", "k"),
    _motion("kn", 0.381e-7, "m s^2", "k_n"),
    _motion("rolling_power", 1e-5, "m", "k"),
    _motion("contour_dry", 1e-4, "1", "mu_c"),
    _motion("contour_viscous", 1e-5, "N s/m", "c"),
    _motion("rolling_viscous", 1e-6, "m s", "c"),
    _motion("centre_of_mass_axial", 1e-4, "m", "centre_of_mass.c_3", signed=True),
    _motion("gravity", 0.05, "m/s^2", "g_error", signed=True),
    _motion("contact_radius", 2e-5, "m", "r_error", signed=True),
    _motion("contact_height", 2e-5, "m", "h_error", signed=True),
    _motion("edge_radius", 1e-4, "m", "rho"),
    _motion("inertia_diametral", 0.005, "1", "e", signed=True),
    _motion("inertia_product", 1e-8, "kg m^2", "inertia_product.J_13", "inertia_product.J_23"),
    _wrong("time_offset", 1e-4),
    _wrong("turned", 2e-4),
    _wrong("shifted", 2e-4),
    _wrong("focal", 1e-3),
    _wrong("principal_point", 0.3),
    _wrong("distortion", 0.05),
    _wrong("misprint", 2e-5),
    _wrong("pattern_offset", 2e-5),
    _wrong("pattern_rotation", 1e-3, visible=False),
    _wrong("pattern_scale", 1e-3),
    _wrong("pattern_height", 5e-5),
    _wrong("table_plane", 2e-4),
    _wrong("table_height", 5e-5),
    _wrong("exposure_blur", 4e-6),
    _wrong("ellipse_centre", 1.0),
)  # fmt: skip
CONTROLS: tuple[HiddenEffect, ...] = (
    HiddenEffect("nothing", 1.0, "1", lambda size, _: Planted()),
    # small errors of the dots' places, as every diagnosis allows for
    HiddenEffect("prints", DOT_SIGMA, "m", lambda size, _: Planted(laboratory=Laboratory(print_m=size))),
    HiddenEffect("laboratory", 1.0, "1", lambda size, _: Planted(laboratory=ORDINARY)),
)


def hidden_effect(name: str) -> HiddenEffect:
    """By its name. Raises DiscTrackError."""
    by_name = {effect.name: effect for effect in (*HIDDEN_EFFECTS, *CONTROLS)}
    if name not in by_name:
        raise DiscTrackError(f"there is no effect '{name}' to hide; there are {', '.join(by_name)}")
    return by_name[name]


def together(planted: Sequence[Planted]) -> Planted:
    """Several at once."""
    truth, effects, wrong = (
        {k: v for p in planted for k, v in getattr(p, kind).items()} for kind in ("truth", "effects", "wrong")
    )
    laboratory = next((p.laboratory for p in reversed(planted) if p.laboratory != Laboratory()), Laboratory())
    return Planted(truth, effects, wrong, laboratory=laboratory)
