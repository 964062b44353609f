"""Effects of the motion and faults of the measurement, from their two catalogues, as candidates of the search."""

from collections.abc import Collection, Sequence
from dataclasses import replace

import numpy as np

from disctrack.disc import Disc
from disctrack.discrepancy.system import Candidate, Quantity, Values
from disctrack.faults.catalogue import TYPICAL_STEPS, Fault, faults_of
from disctrack.rolling import CATALOGUE, Effect, EffectParameter, Model, State

# Effects whose parameters act so differently that each group is a candidate of its own.
_PARTS: dict[str, dict[str, tuple[str, ...]]] = {
    "centre_of_mass": {"centre_of_mass": ("c_1", "c_2"), "centre_of_mass_axial": ("c_3",)},
    "rim": {"rim_oval": ("oval_c", "oval_s"), "rim_lobes": ("lobes_c", "lobes_s")},
}
SLIP = "slip.inverse_mu"
THETA_END = np.radians(0.05)  # end of a simulation: a trial fit may run into the collapse, the data end before it
ROUGHEST = 100.0  # upper bound of the coefficient of friction of a disc that is known to slip
STATE_SCALES = dict.fromkeys(("x", "y"), 1e-6) | dict.fromkeys(("psi", "theta", "phi"), 1e-5)
STATE_SCALES |= dict.fromkeys(("thetadot", "omega2", "omega3"), 1e-3)  # SI, as the steps of a fit
SLIP_VELOCITY = ("state.v_x", "state.v_y")


def state_quantities() -> tuple[Quantity, ...]:
    """The eight numbers of the initial state."""
    units = {1e-6: "m", 1e-5: "rad", 1e-3: "rad/s"}
    return tuple(
        Quantity(f"state.{name}", units[scale], scale, meaning="at the first instant")
        for name, scale in STATE_SCALES.items()
    )


def state_of(values: Values) -> State:
    """The initial state in `values`; with v_x, v_y the disc may slip at first."""
    return State(**{k.partition(".")[2]: float(v) for k, v in values.items() if k.startswith("state.")})


def slip_start(model: Model) -> Candidate:
    """Initial velocity of the centre, and 1/mu unless the model has a coefficient of friction already."""
    usual, title = slip_candidate(CATALOGUE["slip"]), "the disc slips at first, with Coulomb friction |F_t| = mu F_z"
    inverse = () if model.effect("slip") else (replace(usual.quantities[0], lower=1.0 / ROUGHEST),)
    one = Quantity("", "m/s", 1e-3, meaning="velocity of the centre at the first instant")
    quantities = *inverse, *(replace(one, name=name) for name in SLIP_VELOCITY)
    return Candidate("slip_start", usual.effect, "motion", title, usual.source, quantities)


def effect_quantity(effect: type[Effect], parameter: EffectParameter) -> Quantity:
    """A parameter of an effect as a quantity of a fit."""
    p, size = parameter, abs(parameter.nominal)
    null = p.nominal if p.is_shape else p.null
    one = Quantity(f"{effect.name}.{p.name}", p.unit, 0.01 * size, null, p.lower, p.upper, meaning=p.meaning)
    # a position may be anywhere
    return replace(one, typical=size or np.inf, belongs_to=effect.belongs_to)


def model_quantities(model: Model) -> tuple[Quantity, ...]:
    """Parameters of the effects that the model declares: they are fitted within their bounds."""
    amounts = ((type(effect), p) for effect in model.effects for p in effect.parameters if not p.is_shape)
    return tuple(effect_quantity(effect, p) for effect, p in amounts)


def motion_candidates(model: Model, names: Sequence[str] | None = None) -> tuple[Candidate, ...]:
    """Every effect of the catalogue that may be missing: a candidate that the model does not contain.

    names : only these effects, if given
    """
    found = []
    for effect in CATALOGUE.values():
        if not effect.candidate or model.effect(effect.name) or effect.name not in (names or CATALOGUE):
            continue
        if effect.name == "slip":
            found.append(slip_candidate(effect))
            continue
        amounts = [p for p in effect.parameters if not p.is_shape and np.isfinite(p.null)]
        shape = tuple(effect_quantity(effect, p) for p in effect.parameters if p.is_shape)
        for name, members in _PARTS.get(effect.name, {effect.name: tuple(p.name for p in amounts)}).items():
            quantities = tuple(effect_quantity(effect, p) for p in amounts if p.name in members)
            if quantities:
                words = effect.name, "motion", effect.title, effect.source
                found.append(Candidate(name, *words, quantities, shape=shape, sought=effect.sought))
    return tuple(found)


def slip_candidate(effect: type[Effect]) -> Candidate:
    """Slip with the quantity 1/mu, zero if the disc never slips; without a derivative until it slips somewhere."""
    meaning = "1 / coefficient of friction"
    inverse = Quantity(SLIP, "1", 0.1, lower=0.0, upper=1e3, typical=10.0, reciprocal="mu", meaning=meaning)
    return Candidate(effect.name, effect.name, "motion", effect.title, effect.source, (inverse,), threshold=True)


def candidate_of_fault(fault: Fault) -> Candidate:
    """A fault of the measurement as a candidate."""
    several, (low, high) = len(fault.parts) > 1, fault.bounds
    one = Quantity(fault.name, fault.unit, fault.step, lower=low, upper=high, belongs_to=fault.belongs_to)
    one = replace(one, typical=TYPICAL_STEPS * fault.step)
    quantities = tuple(
        replace(one, name=name, meaning=f"{fault.meaning} ({part})" if several else fault.meaning)
        for name, part in zip(fault.names(), fault.parts, strict=True)
    )
    return Candidate(fault.name, fault.name, "measurement", fault.title, fault.source, quantities)


def measurement_candidates(disc: Disc, names: Collection[str] | None = None) -> tuple[Candidate, ...]:
    """Every fault of the catalogue as a candidate.   names : only these faults, if given"""
    return tuple(candidate_of_fault(fault) for fault in faults_of(disc) if names is None or fault.name in names)
