"""A model of the motion: the declared disc and gravity, and the effects that are added to them."""

from collections.abc import Mapping
from dataclasses import dataclass, replace
from types import SimpleNamespace
from typing import Any

import numpy as np

from calibration.kit.types import Density, Gravity, checked
from disctrack.disc import AIR_DENSITY, Disc
from disctrack.errors import ModelError
from disctrack.rolling.effects.base import CATALOGUE, Effect, EffectParameter, effect_class
from disctrack.rolling.effects.learned import effect_from_formulas
from disctrack.rolling.records import BODY, UNEVEN

DEFAULT_THETA_END = np.radians(0.5)  # nutation at which the disc of Ma et al. (2014) touches its paper


@checked
@dataclass(frozen=True)
class Model:
    """Disc, gravity and effects; parameters are addressed as "effect.parameter".

    >>> Model(read_recording("clip").disc).gravity
    9.81
    """

    disc: Disc
    gravity: Gravity = 9.81  # [m/s^2] along -k, unless an effect changes it
    effects: tuple[Effect, ...] = ()
    air_density: Density = AIR_DENSITY  # [kg/m^3]
    laws: tuple[type[Effect], ...] = ()  # by formula; their parameters may be used like those of the catalogue

    def __post_init__(self) -> None:
        object.__setattr__(self, "effects", tuple(self.effects))
        object.__setattr__(self, "laws", tuple(self.laws))
        names = [effect.name for effect in self.effects]
        if twice := [name for name in names if names.count(name) > 1]:
            raise ModelError(f"effect '{twice[0]}' is in the model twice: give it once, with the sum of its amounts")

    @property
    def values(self) -> dict[str, float]:
        """Parameter values by "effect.parameter"."""
        return {f"{e.name}.{k}": v for e in self.effects for k, v in e.values.items()}

    @property
    def parameters(self) -> dict[str, EffectParameter]:
        """Parameters by "effect.parameter"."""
        return {f"{e.name}.{p.name}": p for e in self.effects for p in e.parameters}

    def effect(self, name: str) -> Effect | None:
        """The effect of this name, or None."""
        return next((e for e in self.effects if e.name == name), None)

    def with_effects(self, *effects: Effect) -> "Model":
        """Copy with these effects appended, or in place of those of the same name."""
        return replace(self, effects=tuple({e.name: e for e in (*self.effects, *effects)}.values()))

    def with_values(self, values: Mapping[str, float]) -> "Model":
        """Copy with new values by "effect.parameter"; effects not in the model are added, other parameters at null."""
        new = {e.name: dict(e.values) for e in self.effects}
        for full_name, value in values.items():
            effect, parameter = self.split_name(full_name)
            new.setdefault(effect.name, dict(effect.absent().values))[parameter] = value
        return replace(self, effects=tuple(self.effect_class(name)(**v) for name, v in new.items()))

    def knowing(self, *laws: type[Effect]) -> "Model":
        """Copy that also accepts parameters of these laws, which replace laws of the same name."""
        return replace(self, laws=tuple({law.name: law for law in (*self.laws, *laws)}.values()))

    def effect_class(self, name: str) -> type[Effect]:
        """Class of the effect of this name: in the model, among its laws, or in the catalogue; raises ModelError."""
        return self._known(name) or effect_class(name)

    def _known(self, name: str) -> type[Effect] | None:
        own = (*(type(effect) for effect in self.effects), *self.laws)
        return next((e for e in own if e.name == name), CATALOGUE.get(name))

    def split_name(self, full_name: str) -> tuple[type[Effect], str]:
        """(effect, "parameter") of "effect.parameter"; raises ModelError if no effect has this parameter."""
        name, _, parameter = full_name.partition(".")
        effect = self.effect_class(name)
        known = [p.name for p in effect.parameters]
        if parameter not in known:
            raise ModelError(f"'{full_name}' is no parameter; effect '{name}' has {', '.join(known)}")
        return effect, parameter

    def has_name(self, full_name: str) -> bool:
        """Is this the name of a parameter that the model has or accepts?"""
        name, _, parameter = full_name.partition(".")
        effect = self._known(name)
        return effect is not None and parameter in [p.name for p in effect.parameters]


def body_constants(model: Model, theta_end: float, values: Mapping[str, Any] = {}) -> dict[str, Any]:
    """Constants of records.BODY after all adjustments; complex if they depend on complex `values` (by full name)."""
    disc = model.disc
    body = SimpleNamespace(**dict.fromkeys(BODY, 0.0))
    body.mass, body.radius, body.half_thickness = disc.mass, disc.radius, disc.half_thickness
    body.J_11 = body.J_22 = disc.moment_diametral
    body.J_33 = disc.moment_axial
    body.g_z = -model.gravity
    body.air_density = model.air_density
    body.theta_end = theta_end
    for effect in model.effects:
        if effect.adjust is not None:
            effect.adjust(body, SimpleNamespace(**effect_values(effect, values)))
    body.uneven = float(any(getattr(body, name) != 0.0 for name in UNEVEN))
    return vars(body)


def effect_values(effect: Effect, values: Mapping[str, Any]) -> dict[str, Any]:
    """Parameter values of one effect; `values` (by full name) take precedence."""
    return {name: values.get(f"{effect.name}.{name}", value) for name, value in effect.values.items()}


def effects_from_tables(
    tables: Mapping[str, Mapping[str, float]], formulas: Mapping[str, Mapping[str, str]] | None = None
) -> tuple[Effect, ...]:
    """Effects from nested tables {effect: {parameter: value}}, as in a scene or a saved model.

    An effect with an empty table has nominal values. Otherwise missing amounts are null, and missing shape parameters
    (an exponent) nominal. Raises ModelError.
    formulas : {effect: {component: formula}} of effects that are not in the catalogue (effects.learned)
    """
    laws = {name: effect_from_formulas(name, law) for name, law in (formulas or {}).items()}
    for name in laws:
        if name not in tables:
            raise ModelError(f"the law by formula '{name}' has no numbers: give effects.{name}, or take it out")
    return tuple(_from_table(laws.get(name) or effect_class(name), values) for name, values in tables.items())


def _from_table(effect: type[Effect], values: Mapping[str, float]) -> Effect:
    amounts = [p.name for p in effect.parameters if not p.is_shape]
    if values and set(values) <= {p.name for p in effect.parameters if p.is_shape}:
        raise ModelError(f"effect '{effect.name}' has a shape but no amount: give {' or '.join(amounts)}")
    return effect(**({p.name: p.null for p in effect.parameters if not p.is_shape} | dict(values) if values else {}))
