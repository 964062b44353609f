"""Effects to hide, one by one, in measured trajectories: what is planted, and what the diagnosis should then say.

An effect is hidden by the name of the candidate that means it, in the candidate's numbers and units. Every size is one
that a careful experimenter would still overlook; directions and signs are drawn, passive effects keep theirs.
"""

from functools import cache

import numpy as np
from numpy.random import Generator

from disctrack.diagnosis.motion import measurement_candidates, motion_candidates
from disctrack.diagnosis.systematic import DOT_SIGMA
from disctrack.discrepancy.system import Candidate
from disctrack.errors import DiscTrackError
from disctrack.rolling import Model
from disctrack.synthetic.description import Scene
from disctrack.validate.points import ORDINARY, STATION, Laboratory, Planted

SIZES = {
    "table_tilt": np.radians(0.35),
    "kz": 6e-5,
    "spring": 0.05,
    "rolling_adhesive": 2e-5,
    "table_curved": 0.1,
    "rim_oval": 1e-5,
    "rim_lobes": 1e-5,
    "rim_flat": 1e-5,
    "table_yielding": 1e-6,
    "creep": 2e-6,
    "table_shaken": 2e-6,
    "frame_rate": 0.012,
    "rolling_classical": 2e-4,
    "air_moffatt": 1.0,
    "drag_rotation": 2.5e-6,
    "centre_of_mass": 1e-4,
    "inertia_axial": 0.005,
    "air_bildsten": 0.3,
    "air_quadratic": 0.1,
    "air_spin": 1e-7,
    "drag_linear": 1e-4,
    "pivoting_viscous": 1e-5,
    "pivoting_contensou": 1e-5,
    "km_e2": 0.381e-8,
    "kn": 0.381e-7,
    "rolling_power": 1e-5,
    "contour_dry": 1e-4,
    "contour_viscous": 1e-5,
    "rolling_viscous": 1e-6,
    "centre_of_mass_axial": 1e-4,
    "gravity": 0.05,
    "contact_radius": 2e-5,
    "contact_height": 2e-5,
    "edge_radius": 1e-4,
    "inertia_diametral": 0.005,
    "inertia_product": 1e-8,
    "time_offset": 1e-4,
    "turned": 2e-4,
    "shifted": 2e-4,
    "focal": 1e-3,
    "principal_point": 0.3,
    "distortion": 0.05,
    "misprint": 2e-5,
    "pattern_offset": 2e-5,
    "pattern_rotation": 1e-3,
    "pattern_scale": 1e-3,
    "pattern_height": 5e-5,
    "table_plane": 2e-4,
    "table_height": 5e-5,
    "exposure_blur": 4e-6,
    "ellipse_centre": 1.0,
}
CONTROLS = {"nothing": 1.0, "prints": DOT_SIGMA, "laboratory": 1.0}  # hide nothing that may be claimed
INVISIBLE = ("pattern_rotation",)  # no recording of one disc shows it, and nothing should be said
FIRST_ALONE = ("spring", "table_curved")  # of the candidate's numbers


@cache
def alike(name: str) -> tuple[Candidate, ...]:
    """What the diagnosis calls by this name, of one camera or dot each where it is theirs; none of a control.

    Raises DiscTrackError.
    """
    if name not in SIZES | CONTROLS:
        raise DiscTrackError(f"there is no effect '{name}' to hide; there are {', '.join(SIZES | CONTROLS)}")
    disc = Scene().declared_disc
    candidates = *motion_candidates(Model(disc)), *measurement_candidates(disc)
    return tuple(c for c in candidates if name in (c.name, *c.name.split("_", 1)))


def plant(name: str, size: float, rng: Generator) -> Planted:
    """An effect of this size [SI], of one camera or dot drawn among those there are, with a sign or a direction."""
    candidates = alike(name)
    if not candidates:
        imperfect = {"prints": Laboratory(print_m=size), "laboratory": ORDINARY}
        return Planted(laboratory=imperfect.get(name, Laboratory()))
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
    if candidate.kind == "measurement":
        return Planted(truth, wrong=truth)
    if name == "rim_flat":
        return Planted(truth, effects=truth | {"rim_flat.angle": rng.uniform(0, 2 * np.pi)})
    if name == "table_shaken":  # the diagnosis' phase is that at the first frame
        turn = 2 * np.pi * candidate.shape[0].null * STATION
        cosine, sine = numbers.reshape(2, 3)
        c, s = np.cos(turn), np.sin(turn)
        numbers = np.ravel([c * cosine - s * sine, s * cosine + c * sine])
    return Planted(truth, effects=dict(zip(truth, numbers.tolist(), strict=True)))
