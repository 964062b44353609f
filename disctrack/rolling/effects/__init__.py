"""Effects that a model of the motion may have or lack; every module of this package is read: a new file suffices."""

from importlib import import_module
from pkgutil import iter_modules

from disctrack.rolling.effects.base import (
    CATALOGUE,
    Effect,
    EffectParameter,
    ModelError,
    catalogue_table,
    effect,
    effect_class,
)

for _module in iter_modules(__path__):
    import_module(f"{__name__}.{_module.name}")

from disctrack.rolling.effects.learned import effect_from_formulas  # noqa: E402 (after its package is read)

__all__ = [
    "CATALOGUE",
    "Effect",
    "EffectParameter",
    "ModelError",
    "catalogue_table",
    "effect",
    "effect_class",
    "effect_from_formulas",
]
