"""Formulas as text or SymPy expressions: parsed, with names checked, and smoothed where they jump."""

import ast
import difflib
import keyword
import math
import operator
from collections.abc import Iterable, Mapping, Sequence
from typing import Any, TypeAlias

import numpy as np
import sympy

from disctrack.errors import AnalysisError

Formula: TypeAlias = str | float | sympy.Expr

FUNCTIONS = (
    "sin", "cos", "tan", "asin", "acos", "atan", "atan2", "sinh", "cosh", "tanh", "asinh", "exp", "log", "sqrt",
    "sign", "Abs", "Min", "Max", "Piecewise", "Heaviside", "pi",
)  # fmt: skip
_KNOWN = {name: getattr(sympy, name) for name in FUNCTIONS} | {"abs": sympy.Abs}
MOST_PARTS = 4000  # of a formula as text: names, numbers and signs
_OPERATIONS: Mapping[type, Any] = {
    ast.Add: operator.add, ast.Sub: operator.sub, ast.Mult: operator.mul, ast.Div: operator.truediv,
    ast.USub: operator.neg, ast.UAdd: operator.pos, ast.BitAnd: sympy.And, ast.BitOr: sympy.Or,
    ast.Lt: sympy.Lt, ast.LtE: sympy.Le, ast.Gt: sympy.Gt, ast.GtE: sympy.Ge, ast.Eq: sympy.Eq, ast.NotEq: sympy.Ne,
}  # fmt: skip


def check_name(name: str, what: str) -> None:
    """Raise AnalysisError if a formula cannot use the name."""
    if not name.isidentifier() or keyword.iskeyword(name):
        raise AnalysisError(f"{what} {name!r}: a formula cannot use this name. Letters, digits and _ only, as in x_1.")
    if name in _KNOWN or name == "t":
        raise AnalysisError(f"{what} {name!r}: this name has a meaning of its own in formulas. Choose another.")


def parsed(formula: Formula, symbols: Mapping[str, sympy.Symbol], what: str) -> sympy.Expr:
    """The formula in these symbols. Raises AnalysisError with `what` where it cannot be read or knows another name."""
    if isinstance(formula, str):
        try:
            tree = ast.parse(formula.strip(), mode="eval")
            parts = sum(isinstance(node, ast.expr) for node in ast.walk(tree))
            if parts > MOST_PARTS:
                raise ValueError(f"it has {parts} parts, and {MOST_PARTS} are the most")
            found = sympy.sympify(_value(tree.body, {**_KNOWN, **symbols}))
            if not isinstance(found, sympy.Expr):
                raise ValueError("it has no number as its value")
        except NameError as error:
            raise AnalysisError(
                f"{what}: {_unknown_name(str(error.name), [*symbols, *_KNOWN])} The formula is {formula}."
            ) from error
        except Exception as error:
            shown = formula if len(formula) < 200 else f"{formula[:200]} ..."
            raise AnalysisError(f"{what}: cannot read {shown!r} ({error}). Write it as in '-k*x - c*v**2'.") from error
    else:
        # symbols of the user are identified by their names
        found = sympy.sympify(formula, strict=True)
        found = found.xreplace({s: symbols[s.name] for s in found.free_symbols if s.name in symbols})
    unknown = sorted(s.name for s in found.free_symbols - set(symbols.values()))
    unknown += sorted(str(f.func) for f in found.atoms(sympy.core.function.AppliedUndef))
    if unknown:
        raise AnalysisError(f"{what}: {_unknown_name(unknown[0], [*symbols, *_KNOWN])} The formula is {formula}.")
    return found


def check_known(name: str, known: Iterable[str], where: str) -> None:
    """Raise AnalysisError if the name is not among the known ones."""
    if name not in known:
        raise AnalysisError(f"{where}: {_unknown_name(name, known)}")


def _unknown_name(name: str, known: Iterable[str]) -> str:
    """'foo is not known', and the nearest known name."""
    names = list(dict.fromkeys(known))
    near = difflib.get_close_matches(name, names, 1)
    hint = f"did you mean {near[0]!r}?" if near else f"known are {', '.join(names)}."
    return f"{name!r} is not known; {hint}"


def _value(node: ast.expr, names: Mapping[str, Any]) -> Any:
    """Value of a syntax tree; only the syntax that formulas need is ever evaluated.

    Raises NameError, SyntaxError, TypeError, ValueError, RecursionError.
    """
    match node:
        case ast.Constant(value=bool() | int() | float() as value):
            return sympy.sympify(value)
        case ast.Name(id=name):
            if name not in names:
                raise NameError(name=name)
            return names[name]
        case ast.BinOp(op=ast.Add() | ast.Sub()):
            terms: list[Any] = []  # without recursion: a sum may be long
            inner: ast.expr = node
            while isinstance(inner, ast.BinOp) and isinstance(inner.op, ast.Add | ast.Sub):
                right = _value(inner.right, names)
                terms.append(right if isinstance(inner.op, ast.Add) else -right)
                inner = inner.left
            return sympy.Add(_value(inner, names), *reversed(terms))
        case ast.BinOp(left=left, op=ast.Pow(), right=right):
            return _power(_value(left, names), _value(right, names))
        case ast.BinOp(left=left, op=op, right=right) | ast.Compare(left=left, ops=[op], comparators=[right]) if (
            type(op) in _OPERATIONS
        ):
            return _OPERATIONS[type(op)](_value(left, names), _value(right, names))
        case ast.UnaryOp(op=op, operand=operand) if type(op) in _OPERATIONS:
            return _OPERATIONS[type(op)](_value(operand, names))
        case ast.Tuple(elts=elements):
            return tuple(_value(e, names) for e in elements)
        case ast.Call(func=ast.Name() as function, args=arguments, keywords=[]):
            return _value(function, names)(*(_value(a, names) for a in arguments))
    raise SyntaxError(f"{ast.unparse(node)!r} is nothing that a formula may hold")


def _power(base: Any, exponent: Any) -> Any:
    if base.is_number and exponent.is_number and base != 0:
        size = float(exponent) * math.log2(abs(complex(base)))
        if abs(size) > 1000:
            raise ValueError(f"{base}**{exponent} is beyond all numbers")
    return base**exponent


def smooth(expression: sympy.Expr, widths: dict[sympy.Expr, sympy.Symbol], moving: set[sympy.Symbol]) -> sympy.Expr:
    """The expression with jumps smoothed: sign(a) -> tanh(a / w), and steps likewise.

    A root of a sum of squares of states has no derivative at zero: sqrt(a) -> sqrt(a + w^2).

    With a finite width, the sensitivities of a motion that crosses a jump are continuous and consistent with the
    solution. `widths` gets a symbol for every new argument.
    """

    def width(argument: sympy.Expr) -> sympy.Symbol:
        return widths.setdefault(argument, sympy.Symbol(f"width_{len(widths)}", positive=True))

    out = expression.replace(sympy.Heaviside, lambda a, _: (1 + sympy.sign(a)) / 2)
    out = out.replace(sympy.sign, lambda a: sympy.tanh(a / width(a)))
    return out.replace(
        lambda e: e.is_Pow and e.base.is_Add and e.exp < 1 and (2 * e.exp).is_odd and _vanishes(e.base, moving),
        lambda e: (e.base + width(sympy.sqrt(e.base)) ** 2) ** e.exp,
    )


def _vanishes(squares: sympy.Expr, moving: set[sympy.Symbol]) -> bool:
    """Is it a sum of squares that may all vanish?"""
    return bool(squares.is_nonnegative) and all(term.free_symbols & moving for term in squares.args)


def source_of(name: str, inputs: Mapping[str, Sequence[sympy.Symbol]], outputs: Mapping[str, Sequence[object]]) -> str:
    """Source of a function for numba of t and arrays: symbols by the array that holds them, and arrays to be filled."""
    entries = {
        f"{array}{list(index)}": e
        for array, nested in outputs.items()
        for index, e in np.ndenumerate(np.array(nested, object))
        if e != 0
    }
    used = set().union(*(e.free_symbols for e in entries.values()))
    lines = [f"{s} = {array}[{i}]" for array, symbols in inputs.items() for i, s in enumerate(symbols) if s in used]
    lines += [f"{array}[:] = 0.0" for array in outputs]
    shared, reduced = sympy.cse(list(entries.values()), symbols=sympy.numbered_symbols("shared_"))
    for target, e in [*shared, *zip(entries, reduced, strict=True)]:
        lines.append(f"{target} = {sympy.printing.pycode(e, fully_qualified_modules=False)}")
    body = "\n    ".join(lines)
    return f"def {name}({', '.join(['t', *inputs, *outputs])}):\n    {body}\n"
