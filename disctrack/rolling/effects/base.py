"""An effect: a named term with parameters that is added to the ideal rolling disc.

To add one, write a function with its name in a module of this package, under `@effect(title, source, parameters ...)`:

    name(p, s, w)        adds to the wrench `w` a moment, a load lever or a force (records.WRENCH), from parameters
                         `p.<name>` and kinematics `s.<name>` (records.KINEMATICS). One expression for numbers, arrays
                         and complex numbers alike: no `if`, no `abs`; use `magnitude`, `sign`, `np.sqrt`, `np.exp`.
    name(body, p)        changes the body's constants (records.BODY) before the motion starts

The decorator adds a class of effects to CATALOGUE, which simulation, fitting and diagnosis use. (Laws by formula are
not in the catalogue but in the model, Model.laws.) A compiled law is cached until its own file or that of the helpers
changes.

Signs: M is the moment of the table on the disc at the contact, in (n0, m0, k). Its power is
M_n thetadot - M_m phidot sin(theta) + M_z omega_z + X . v_O. The power of a passive law is never positive (of a law in
psidot if psidot phidot < 0, as during the descent): its amounts have the lower bound 0.
"""

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Any, ClassVar

import numpy as np

from disctrack.errors import ModelError

CATALOGUE: "dict[str, type[Effect]]" = {}
SLOWEST_ROLLING = 1e-3  # [rad/s] rolling rate below which its direction is smoothed; discs roll faster than 1 rad/s


@dataclass(frozen=True)
class EffectParameter:
    """One parameter of an effect."""

    name: str
    unit: str
    nominal: float  # typical value, and the scale in fits
    meaning: str
    null: float = 0.0  # value at which the effect is absent
    lower: float = -np.inf
    upper: float = np.inf
    is_shape: bool = False  # exponent or scale of the law: undetermined at zero amount, not fitted by default


def magnitude(x: Any) -> Any:
    """|x|, analytic for x != 0, so that imaginary parts carry the derivative."""
    return np.sqrt(x * x)


def sign(x: Any, width: float) -> Any:
    """Sign of x, smoothed over `width`: x / sqrt(x^2 + width^2)."""
    return x / np.sqrt(x * x + width * width)


def rolling_rates(s: Any) -> Any:
    """Horizontal angular velocity along n0 and m0, and its magnitude, smoothed near zero [rad/s]."""
    roll_n, roll_m = s.thetadot, -s.phidot * s.sin_theta
    return roll_n, roll_m, np.sqrt(roll_n * roll_n + roll_m * roll_m + SLOWEST_ROLLING * SLOWEST_ROLLING)


HELPERS = (magnitude, sign, rolling_rates)


class Effect:
    """One addition to the ideal disc; an instance holds the values of its parameters."""

    name: ClassVar[str]
    title: ClassVar[str]
    source: ClassVar[str]
    parameters: ClassVar[tuple[EffectParameter, ...]]
    airborne: ClassVar[bool] = False  # acts also without contact
    sought: ClassVar[bool] = False  # its first shape parameter (an angle, a frequency) needs a global search
    candidate: ClassVar[bool] = True  # may be proposed as an explanation; False for tools
    # Recordings share the parameters if these are the same: "disc", "surface", "rig", "air". () = never shared,
    # ("nature",) = always shared
    belongs_to: ClassVar[tuple[str, ...]] = ("disc", "surface")
    law: ClassVar[Any] = None  # static method law(p, s, w), or None
    formulas: ClassVar[dict[str, str] | None] = None  # of an effect defined by formulas (effects.learned)
    adjust: ClassVar[Any] = None  # static method adjust(body, p), or None

    def __init__(self, **values: float) -> None:
        """Values by parameter name, in the parameter's unit; by default nominal values."""
        known = [p.name for p in self.parameters]
        for given in values:
            if given not in known:
                raise ModelError(f"effect '{self.name}' has no parameter '{given}'; it has {', '.join(known)}")
        self.values: Mapping[str, float] = {p.name: float(values.get(p.name, p.nominal)) for p in self.parameters}
        for p in self.parameters:
            value = self.values[p.name]
            if not p.lower <= value <= p.upper or not (np.isfinite(value) or value == p.null):
                would_supply_energy = self.law is not None and value < p.lower == 0
                raise ModelError(
                    f"{self.name}.{p.name} = {value:g} {p.unit} is outside [{p.lower:g}, {p.upper:g}]"
                    + (": a passive effect cannot feed the disc with energy" if would_supply_energy else "")
                )

    @classmethod
    def absent(cls) -> "Effect":
        """The effect with its amounts at null: the motion does not change, but has sensitivities to the parameters."""
        return cls(**{p.name: p.nominal if p.is_shape else p.null for p in cls.parameters})

    def __eq__(self, other: object) -> bool:
        if not isinstance(other, Effect):
            return NotImplemented
        return (self.name, self.formulas, self.values) == (other.name, other.formulas, other.values)

    def __hash__(self) -> int:
        return hash((self.name, tuple(self.values.items())))

    def __repr__(self) -> str:
        return f"{type(self).__name__}({', '.join(f'{k}={v!r}' for k, v in self.values.items())})"


def effect(title: str, source: str, *parameters: EffectParameter, **traits: Any) -> Callable[[Any], type[Effect]]:
    """Make a law (p, s, w) or an adjustment (body, p) an effect of the catalogue; traits: fields of `Effect`."""

    def register(function: Any) -> type[Effect]:
        name, adjusts = function.__name__, function.__code__.co_argcount == 2
        members = {
            "name": name,
            "title": title,
            "source": source,
            "parameters": parameters,
            "belongs_to": ("disc",) if adjusts else ("disc", "surface"),
            "adjust" if adjusts else "law": staticmethod(function),
        }
        own = {"__doc__": function.__doc__, "__module__": function.__module__}
        modules = {function.__module__, CATALOGUE[name].__module__} if name in CATALOGUE else ""
        if len(modules) > 1:
            raise ModelError(f"two effects are called '{name}': in {' and '.join(sorted(modules))}")
        CATALOGUE[name] = type(name, (Effect,), own | members | traits)
        return CATALOGUE[name]

    return register


def effect_class(name: str) -> type[Effect]:
    """Class of the catalogue's effect of this name; raises ModelError with the known names."""
    if name not in CATALOGUE:
        raise ModelError(f"there is no effect '{name}'; the catalogue has {', '.join(sorted(CATALOGUE))}")
    return CATALOGUE[name]


def catalogue_table() -> str:
    """The catalogue as a Markdown table: name, law, parameters with unit and nominal value, source."""
    rows = ["| effect | law | parameters (nominal) | source |", "|---|---|---|---|"]
    for kind in CATALOGUE.values():
        numbers = "; ".join(
            f"`{p.name}` {p.nominal:g} {p.unit if p.unit != '1' else ''}".strip() for p in kind.parameters
        )
        rows.append(f"| `{kind.name}` | {kind.title.replace('|', chr(92) + '|')} | {numbers} | {kind.source} |")
    return "\n".join(rows) + "\n"
