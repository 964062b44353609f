"""Effects defined by formulas: laws found from a residual, or laws to try without programming.

    effect_from_formulas("braking", {"load_z": "-c * sign(omega_z, 0.01) * sin_theta**2"})

defines an effect "braking" with the parameter c. A formula uses the names of records.KINEMATICS, parameters of the
effect (every other name) and sqrt, exp, log, sin, cos, magnitude(x) = |x|, sign(x, width). Its value is one of the
components that a law may set (records.WRENCH): M_n, M_m, M_z [N m]; load_n, load_m, load_z, moments per normal force
[m]; X_n, X_m, X_z [N].
"""

import ast
from collections.abc import Callable, Mapping
from functools import lru_cache

import numpy as np

from calibration.kit.compiled import function_of
from disctrack.rolling.effects.base import CATALOGUE, Effect, EffectParameter, ModelError, magnitude, sign
from disctrack.rolling.records import KINEMATICS, LAW_COMPONENTS

_OF_NUMPY = {name: getattr(np, name) for name in ("sqrt", "exp", "log", "sin", "cos")}
_FUNCTIONS: dict[str, object] = {"magnitude": magnitude, "sign": sign, **_OF_NUMPY}
_ALLOWED = (
    ast.Expression, ast.BinOp, ast.UnaryOp, ast.Call, ast.Name, ast.Load, ast.Constant,
    ast.Add, ast.Sub, ast.Mult, ast.Div, ast.Pow, ast.USub, ast.UAdd,
)  # fmt: skip


def effect_from_formulas(
    name: str,
    formulas: Mapping[str, str],
    parameters: tuple[EffectParameter, ...] = (),
    *,
    title: str = "",
    source: str = "learned from a residual",
) -> type[Effect]:
    """Effect class whose law adds these formulas to the wrench. It is part of a model, not of the catalogue.

    formulas : component of the wrench -> formula.   parameters : by default unit "SI", nominal 1, no bounds.
    Raises ModelError for an invalid formula and for a name of the catalogue.
    """
    if name in CATALOGUE:
        raise ModelError(f"there is an effect '{name}' already, with another law: choose another name")
    lines, free = [], []
    for component, formula in formulas.items():
        if component not in LAW_COMPONENTS:
            raise ModelError(f"{name}: '{component}' is no component; a law sets {', '.join(LAW_COMPONENTS)}")
        text, names = _translate(name, formula)
        lines.append(f"    w.{component} += {text}")
        free += [n for n in dict.fromkeys(names) if n not in free]
    given = {p.name: p for p in parameters}
    unused = set(given) - set(free)
    if unused or not lines:
        raise ModelError(f"{name}: no formula uses {', '.join(sorted(unused)) or 'anything: there is none'}")
    members = {
        "name": name,
        "title": title or "; ".join(f"{k} = {v}" for k, v in formulas.items()),
        "source": source,
        "parameters": tuple(given.get(n, EffectParameter(n, "SI", 1.0, "number of the formula")) for n in free),
        "formulas": dict(formulas),
        "law": staticmethod(_function("\n".join(lines))),
    }
    return type(f"Formula_{name}", (Effect,), members)


@lru_cache(maxsize=64)  # formulas that differ only in values are compiled once
def _function(lines: str) -> Callable[..., None]:
    return function_of(f"def law(p, s, w):\n{lines}\n", "law", {**_FUNCTIONS})  # checked node by node in _translate


def _translate(name: str, formula: str) -> tuple[str, list[str]]:
    """Formula with the prefixes s. and p. of its names, and the names of the parameters."""
    try:
        tree = ast.parse(formula, mode="eval")
    except SyntaxError as error:
        raise ModelError(f"{name}: '{formula}' is no formula: {error.msg}") from error
    functions = {node.func for node in ast.walk(tree) if isinstance(node, ast.Call)}
    parameters: list[str] = []
    for node in ast.walk(tree):
        if not isinstance(node, _ALLOWED) or (
            isinstance(node, ast.Constant) and not isinstance(node.value, int | float)
        ):
            raise ModelError(f"{name}: '{formula}': {ast.unparse(node)} is not allowed in a formula")
        if isinstance(node, ast.Call) and not (isinstance(node.func, ast.Name) and node.func.id in _FUNCTIONS):
            known = ", ".join(_FUNCTIONS)
            raise ModelError(f"{name}: '{formula}': no function {ast.unparse(node.func)}; there are {known}")
    for node in [n for n in ast.walk(tree) if isinstance(n, ast.Name) and n not in functions]:
        if node.id in KINEMATICS:
            node.id = f"s.{node.id}"
        else:
            parameters.append(node.id)
            node.id = f"p.{node.id}"
    return ast.unparse(tree), parameters
