"""Formulas as text or SymPy expressions, with names checked, and made smooth where they jump."""

import difflib
import keyword
from collections.abc import Iterable, Mapping, Sequence
from typing import Any, TypeAlias

import sympy
from sympy.parsing.sympy_parser import parse_expr

from disctrack.errors import AnalysisError

Formula: TypeAlias = str | float | sympy.Expr

FUNCTIONS = (
    "sin", "cos", "tan", "asin", "acos", "atan", "atan2", "sinh", "cosh", "tanh", "asinh", "exp", "log", "sqrt",
    "sign", "Abs", "Min", "Max", "Piecewise", "Heaviside", "pi",
)  # fmt: skip
_KNOWN = {name: getattr(sympy, name) for name in FUNCTIONS} | {"abs": sympy.Abs}


def checked_name(name: str, what: str) -> str:
    """The name, if a formula can use it. Raises AnalysisError."""
    if not name.isidentifier() or keyword.iskeyword(name):
        raise AnalysisError(f"{what} {name!r}: a formula cannot use this name. Letters, digits and _ only, as in x_1.")
    if name in _KNOWN or name == "t":
        raise AnalysisError(f"{what} {name!r}: this name has a meaning of its own in formulas. Choose another.")
    return name


def parsed(formula: Formula, symbols: Mapping[str, sympy.Symbol], what: str) -> sympy.Expr:
    """The formula in these symbols. Raises AnalysisError with `what` where it cannot be read or knows another name."""
    if isinstance(formula, str):
        try:
            found = parse_expr(formula, local_dict={**_KNOWN, **symbols}, global_dict=_globals())
        except Exception as error:
            raise AnalysisError(
                f"{what}: cannot read {formula!r} ({error}). Write it as in '-k*x - c*v**2'."
            ) from error
        found = sympy.sympify(found)
    else:
        # a user's own symbols are meant by their names
        found = sympy.sympify(formula)
        found = found.xreplace({s: symbols[s.name] for s in found.free_symbols if s.name in symbols})
    unknown = sorted(s.name for s in found.free_symbols - set(symbols.values()))
    unknown += sorted(str(f.func) for f in found.atoms(sympy.core.function.AppliedUndef))
    if unknown:
        raise AnalysisError(f"{what}: {unknown_name(unknown[0], [*symbols, *_KNOWN])} The formula is {formula}.")
    return found


def unknown_name(name: str, known: Iterable[str]) -> str:
    """'foo is not known', and the nearest name that is."""
    names = list(dict.fromkeys(known))
    near = difflib.get_close_matches(name, names, 1)
    hint = f"did you mean {near[0]!r}?" if near else f"known are {', '.join(names)}."
    return f"{name!r} is not known; {hint}"


def _globals() -> dict[str, Any]:
    names: dict[str, Any] = {}
    exec("from sympy import Symbol, Integer, Float, Rational, Function", names)
    return names


def smooth(expression: sympy.Expr, widths: dict[sympy.Expr, sympy.Symbol]) -> sympy.Expr:
    """The expression with jumps made steep but smooth: sign(a) -> tanh(a / w), a step likewise.

    A motion that crosses a jump has sensitivities that jump too; with a width they are those of the equations as they
    are solved. `widths` gets a symbol for every argument that has none yet.
    """

    def width(argument: sympy.Expr) -> sympy.Symbol:
        return widths.setdefault(argument, sympy.Symbol(f"width_{len(widths)}", positive=True))

    out = expression.replace(sympy.sign, lambda a: sympy.tanh(a / width(a)))
    return out.replace(
        lambda e: isinstance(e, sympy.Heaviside),
        lambda e: (1 + sympy.tanh(e.args[0] / width(e.args[0]))) / 2,
    )


def source_of(name: str, inputs: Sequence[sympy.Symbol | tuple[str, Sequence[sympy.Symbol]]],
              outputs: Sequence[tuple[str, sympy.Expr]], zeroed: Sequence[str]) -> str:  # fmt: skip
    """A Python function that numba compiles: scalars and arrays of symbols in, entries of arrays out."""
    used = set().union(*(e.free_symbols for _, e in outputs)) if outputs else set()
    arguments, lines = [], []
    for given in inputs:
        if isinstance(given, sympy.Symbol):
            arguments.append(given.name)
            continue
        array, symbols = given
        arguments.append(array)
        lines += [f"{s.name} = {array}[{i}]" for i, s in enumerate(symbols) if s in used]
    lines += [f"{array}[:] = 0.0" for array in zeroed]
    shared, reduced = sympy.cse([e for _, e in outputs], symbols=sympy.numbered_symbols("shared_"))
    write = sympy.printing.pycode
    lines += [f"{s.name} = {write(e, fully_qualified_modules=False)}" for s, e in shared]
    for (target, original), e in zip(outputs, reduced, strict=True):
        if original != 0:
            lines.append(f"{target} = {write(e, fully_qualified_modules=False)}")
    body = "\n    ".join(lines) or "pass"
    return f"def {name}({', '.join(arguments + list(zeroed))}):\n    {body}\n"
