"""`disctrack sample`: a small recording with known truth, to try the other commands on."""

import argparse
from pathlib import Path

from disctrack.commands.render import rendered
from disctrack.synthetic import description

SCENE = Path(description.__file__).with_name("sample.toml")


def run(arguments: argparse.Namespace) -> None:
    """Render it."""
    rendered(SCENE, arguments.folder, None, arguments.quiet)
    print(f"next: disctrack run {arguments.folder}")
