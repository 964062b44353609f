"""Notebooks of the documentation: executed, stored with what their cells showed, and compared with it.

python tests/docs/notebooks.py [NAME ...] executes and stores them; tests/docs/test_notebooks.py executes and compares.
"""

import re
import shutil
import sys
import tempfile
from pathlib import Path

import nbformat
from nbclient import NotebookClient

ROOT = Path(__file__).resolve().parents[2]
FOLDER = ROOT / "disctrack" / "docs" / "notebooks"
NUMBER = re.compile(r"[-+]?(?:\d+\.?\d*|\.\d+)(?:e[-+]?\d+)?", re.IGNORECASE)
TOLERANCE = 0.02  # of a number: processors round differently, and searches end a little apart


def executed(notebook: Path, root: Path = ROOT) -> nbformat.NotebookNode:
    """The notebook after a run in an empty folder that holds a copy of the sample data."""
    content = nbformat.read(notebook, as_version=4)
    with tempfile.TemporaryDirectory() as folder:
        clip = Path("sample_data", "clip")
        shutil.copytree(root / clip, Path(folder, clip), ignore=shutil.ignore_patterns("results"))
        NotebookClient(content, timeout=600, resources={"metadata": {"path": folder}}).execute()
    for cell in content.cells:
        cell.metadata = {}  # times of execution
        if cell.cell_type == "code":
            cell.outputs = [output for output in cell.outputs if output.get("name") != "stderr"]  # progress bars
    return content


def texts(content: nbformat.NotebookNode) -> list[list[str]]:
    """What each cell of code printed and showed as text; of a figure that there is one."""
    cells = [cell for cell in content.cells if cell.cell_type == "code"]
    return [[str(output.get("text") or _of(output.get("data", {}))) for output in cell.outputs] for cell in cells]


def _of(data: dict[str, str]) -> str:
    return "a figure" if "image/png" in data else data.get("text/plain", "")


def differences(stored: str, now: str) -> list[str]:
    """Words and numbers of two texts that are not the same; a number may differ by TOLERANCE or its last digits."""
    if NUMBER.sub("#", stored).split() != NUMBER.sub("#", now).split():
        return [f"{stored!r} became {now!r}"]
    return [f"{a} became {b}" for a, b in zip(NUMBER.findall(stored), NUMBER.findall(now), strict=True) if _apart(a, b)]


def _apart(a: str, b: str) -> bool:
    digits = len(a.lower().partition("e")[0].partition(".")[2])
    exponent = int(a.lower().partition("e")[2] or 0)
    return abs(float(a) - float(b)) > max(TOLERANCE * abs(float(a)), 2.0 * 10.0 ** (exponent - digits))


def main(names: list[str]) -> None:
    """Execute and store."""
    for notebook in sorted(FOLDER.glob("*.ipynb")):
        if not names or notebook.stem in names:
            nbformat.write(executed(notebook), notebook)


if __name__ == "__main__":
    main(sys.argv[1:])
