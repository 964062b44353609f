"""`disctrack open`: the page that was written last, in a browser."""

import argparse
import webbrowser
from pathlib import Path

from disctrack.errors import OutputError

FOLDERS = ("results", "batch_results", ".")  # of a recording, of a batch, or the results themselves
PAGES = ("index.html", "*_analysis/report.html", "*_diagnosis/diagnosis.html", "report.html", "diagnosis.html")


def run(arguments: argparse.Namespace) -> None:
    """Open it and print its path."""
    page = last_page(arguments.recording)
    webbrowser.open(page.resolve().as_uri())
    print(page)


def last_page(folder: Path) -> Path:
    """The newest page of a recording, of its results, or of a batch. Raises OutputError if there is none."""
    pages = [page for below in FOLDERS for name in PAGES for page in (folder / below).glob(name)]
    if not pages:
        raise OutputError(f"{folder}: no page of results; `disctrack analyse {folder}` writes one")
    return max(pages, key=lambda page: page.stat().st_mtime)
