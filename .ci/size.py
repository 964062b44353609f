"""How large the packages are, room by room, and whether they stay within their budget: python .ci/size.py [--write]

code       lines that are neither blank, comment nor docstring
classes    all; constants: numbers at module level with a name in capitals, thresholds mostly
long, wide functions above 60 lines (kernels: 120), or of more than 8 arguments (kernels: 16)
Any, late  uses of typing.Any; imports inside functions

budget.toml holds what each room may have. --write lowers it to what there is; raising a number is a change of the file
by hand, in a commit of its own that says why.
"""

import argparse
import ast
import io
import sys
import tokenize
import tomllib
from collections.abc import Iterator
from pathlib import Path

ROOT = Path(__file__).resolve().parents[1]
BUDGET = Path(__file__).with_name("budget.toml")
COLUMNS = ("code", "classes", "constants", "long", "wide", "Any", "late")
NO_CODE = {getattr(tokenize, name) for name in ("COMMENT", "NL", "NEWLINE", "INDENT", "DEDENT", "ENDMARKER")}
Counts = dict[str, int]


def counts_of(path: Path) -> Counts:
    """All columns of one file."""
    text = path.read_text(encoding="utf-8")
    tree = ast.parse(text)
    lines = set()
    for token in tokenize.generate_tokens(io.StringIO(text).readline):
        if token.type not in NO_CODE:
            lines.update(range(token.start[0], token.end[0] + 1))
    found = dict.fromkeys(COLUMNS, 0)
    found["constants"] = sum(numbers_with_a_name(node) for node in tree.body)
    is_kernel = "kernel" in path.name
    for node in ast.walk(tree):
        if isinstance(node, (ast.Module, ast.ClassDef, ast.FunctionDef, ast.AsyncFunctionDef)):
            lines.difference_update(docstring_lines(node))
        if isinstance(node, (ast.FunctionDef, ast.AsyncFunctionDef)):
            found["long"] += node.end_lineno - node.lineno + 1 > (120 if is_kernel else 60)
            found["wide"] += n_arguments(node.args) > (16 if is_kernel else 8)
            found["late"] += sum(isinstance(below, (ast.Import, ast.ImportFrom)) for below in ast.walk(node))
        found["classes"] += isinstance(node, ast.ClassDef)
        found["Any"] += isinstance(node, ast.Name) and node.id == "Any"
    return found | {"code": len(lines)}


def docstring_lines(node: ast.Module | ast.ClassDef | ast.FunctionDef | ast.AsyncFunctionDef) -> range:
    if ast.get_docstring(node, clean=False) is None:
        return range(0)
    return range(node.body[0].lineno, node.body[0].end_lineno + 1)


def n_arguments(arguments: ast.arguments) -> int:
    named = [*arguments.posonlyargs, *arguments.args, *arguments.kwonlyargs]
    return len(named) - (bool(arguments.args) and arguments.args[0].arg in ("self", "cls"))


def numbers_with_a_name(node: ast.stmt) -> int:
    targets = node.targets if isinstance(node, ast.Assign) else [node.target] if isinstance(node, ast.AnnAssign) else []
    value = getattr(node, "value", None)
    names = [name for target in targets for name in (target.elts if isinstance(target, ast.Tuple) else [target])]
    if value is None or not names:
        return 0
    in_capitals = all(isinstance(name, ast.Name) and name.id.lstrip("_").isupper() for name in names)
    return len(names) if in_capitals and any(is_number(below) for below in ast.walk(value)) else 0


def is_number(node: ast.AST) -> bool:
    return isinstance(node, ast.Constant) and isinstance(node.value, (int, float)) and not isinstance(node.value, bool)


def rooms() -> Iterator[tuple[str, Counts]]:
    """Each room with its counts; then the total of both packages."""
    found: dict[str, Counts] = {}
    for package in ("calibration", "disctrack", "tests"):
        for path in sorted((ROOT / package).rglob("*.py")):
            parts = path.relative_to(ROOT).parts
            room = package if package != "disctrack" else "/".join(parts[:2]) if len(parts) > 2 else "disctrack"
            row = found.setdefault(room, dict.fromkeys(COLUMNS, 0))
            for column, n in counts_of(path).items():
                row[column] += n
    yield from sorted(found.items(), key=lambda item: -item[1]["code"])
    yield "total", {column: sum(row[column] for room, row in found.items() if room != "tests") for column in COLUMNS}


def main() -> int:
    """Print the table; exit code 1 where a number is above its budget."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--write", action="store_true", help="lower the budget to what there is")
    write = parser.parse_args().write
    budget = tomllib.loads(BUDGET.read_text(encoding="utf-8")) if BUDGET.exists() else {}
    over, kept = [], []
    print(f"{'':28}" + "".join(f"{column:>10}" for column in COLUMNS) + f"{'code allowed':>14}")
    for room, row in rooms():
        allowed = budget.get(room, {})
        over += [f"{room}: {row[column]} {column}, {n} allowed" for column, n in allowed.items() if row[column] > n]
        if room not in budget and not write:
            over.append(f"{room}: has no budget")
        print(f"{room:28}" + "".join(f"{row[column]:10}" for column in COLUMNS) + f"{allowed.get('code', ''):>14}")
        lowered = {column: min(row[column], allowed.get(column, row[column])) for column in COLUMNS}
        kept.append(f'["{room}"]\n' + "".join(f"{column} = {n}\n" for column, n in lowered.items()))
    if write:
        BUDGET.write_text("# what each room may have (size.py); --write lowers it\n\n" + "\n".join(kept))
    print(*over or ["within the budget"], sep="\n")
    return bool(over)


if __name__ == "__main__":
    sys.exit(main())
