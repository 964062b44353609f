"""Rounding and formatting of numbers, with their standard deviations and units."""

from dataclasses import dataclass
from math import floor, inf, isfinite, log10, nan

_PREFIXES = {"n": 1e-9, "µ": 1e-6, "m": 1e-3, "": 1.0}
_PREFIXED = ("m", "s", "rad", "N", "Hz", "J", "W", "N m", "m/s", "m/s²")
_RAISED = str.maketrans("-0123456789", "⁻⁰¹²³⁴⁵⁶⁷⁸⁹")
_LONGEST = 7  # digits before or after the point; powers of ten beyond


@dataclass(frozen=True)
class Measured:
    """A number, its standard deviation if known, and their unit (SI, or as declared; "" for none)."""

    value: float
    sigma: float = nan
    unit: str = ""

    def __str__(self) -> str:
        """Value and sigma, both with two digits of sigma, the unit with its prefix: 60.0 ± 1.2 µm."""
        return measured(self.value, self.sigma, self.unit)


def measured(value: float, sigma: float = nan, unit: str = "") -> str:
    """Value and sigma to two digits of sigma; without a sigma three digits of the value."""
    if not isfinite(value):
        return "unknown"
    known = isfinite(sigma) and sigma > 0
    unit = unit_text(unit)
    size = max(abs(value), sigma if known else 0.0)
    if unit in _PREFIXED and 0 < size < 1:
        prefix, factor = next(((p, f) for p, f in _PREFIXES.items() if size < 999.5 * f))
        value, sigma, unit = value / factor, sigma / factor, prefix + unit
    tail = f" {unit}" if unit else ""
    if not known:
        return rounded(value) + tail
    last = floor(log10(float(f"{sigma:.1e}"))) - 1  # power of ten of sigma's second digit, once rounded
    size = max(abs(value), sigma)
    if -last > _LONGEST or size >= 10.0**_LONGEST:
        power = floor(log10(size))
        digits = power - last
        numbers = (_fixed(x / 10.0**power, digits) for x in (value, sigma))
        return f"({' ± '.join(numbers)}) × {_ten(power)}{tail}"
    return f"{_fixed(value, -last)} ± {_fixed(sigma, -last)}{tail}"


def rounded(value: float | None, digits: int = 3) -> str:
    """The number with this many digits, in powers of ten if very large or small; empty for None."""
    if value is None or value != value:
        return ""
    if abs(value) == inf:
        return "∞" if value > 0 else "-∞"
    text = f"{value:.{digits}g}"
    number, e, power = text.partition("e")
    if not e:
        return text if value else "0"
    if 0 < int(power) < _LONGEST:  # 1.2e+04
        return f"{float(text):.0f}"
    return f"{number} × {_ten(int(power))}"


def score(value: float | None) -> str:
    """A decrease of chi-square to tenths, above a thousand to four digits."""
    return rounded(value, 4) if value is None or not abs(value) < 1000 else _fixed(value, 1)


def probability(p: float) -> str:
    """Relation and number, to follow "p": "= 0.57"."""
    if not isfinite(p):
        return "unknown"
    return "< 10⁻³⁰⁰" if p < 1e-300 else f"= {rounded(p, 2)}"  # below the range of floating-point numbers


def unit_text(unit: str) -> str:
    """A unit as printed: m s² for "m s^2", rad/s for "rad s-1", empty for "1"."""
    if unit in ("1", ""):
        return ""
    unit = unit.replace("^2", "²").replace("^3", "³")
    if unit.endswith(("s-1", "s-2")):
        unit = unit.replace(" s-1", "/s").replace(" s-2", "/s²")
    return "µ" + unit[1:] if unit in ("um", "urad", "us", "uN") else unit


def in_unit(name: str, unit: str) -> str:
    """The name with its unit, for headers and axes."""
    return f"{name} [{unit_text(unit)}]" if unit_text(unit) else name


def _fixed(value: float, digits: int) -> str:
    text = f"{round(value, digits):.{max(digits, 0)}f}"
    return text[1:] if text.startswith("-") and float(text) == 0 else text


def _ten(power: int) -> str:
    return f"10{str(power).translate(_RAISED)}"
