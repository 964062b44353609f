"""`disctrack open`: the page that was written last, in a browser."""

import argparse
import webbrowser
from pathlib import Path

from disctrack.errors import OutputError

FOLDERS = ("results", "batch_results", ".")  # of a recording, of a batch, or the results themselves
PAGES = ("index.html", "*_analysis/report.html", "*_diagnosis/diagnosis.html", "report.html", "diagnosis.html")


def run(arguments: argparse.Namespace) -> None:
    """Open the newest page of a recording, of its results, or of a batch, and print its path."""
    folder: Path = arguments.recording
    pages = [page for below in FOLDERS for name in PAGES for page in (folder / below).glob(name)]
    if not pages:
        raise OutputError(f"{folder}: no page of results; `disctrack analyse {folder}` writes one")
    page = max(pages, key=lambda page: page.stat().st_mtime)
    webbrowser.open(page.resolve().as_uri())
    print(page)
