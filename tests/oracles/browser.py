"""A real browser, where one is installed."""

import shutil
import subprocess
from pathlib import Path

import cv2
import numpy as np

BROWSER = next(filter(None, map(shutil.which, ("chromium", "chromium-browser", "google-chrome", "chrome"))), None)
FLAGS = (
    "--headless --no-sandbox --disable-gpu --disable-quic --no-first-run --disable-background-networking "
    "--disable-component-update --disable-sync --hide-scrollbars --virtual-time-budget=4000 --enable-logging=stderr"
)


def browse(page: Path, profile: Path, *extra: str, place: str = "") -> str:
    """What the browser writes when it shows a page without an error."""
    command = [str(BROWSER), *FLAGS.split(), f"--user-data-dir={profile}", *extra, f"{page.as_uri()}{place}"]
    done = subprocess.run(command, check=True, capture_output=True, text=True, timeout=120)
    problems = [line for line in done.stderr.splitlines() if "CONSOLE" in line and "Uncaught" in line]
    assert not problems, problems
    return done.stdout


def screenshot(page: Path, folder: Path, size: tuple[int, int], *flags: str, place: str = "") -> np.ndarray:
    """(height, width, 3) BGR."""
    picture = folder / f"{page.stem}.png"
    browse(
        page, folder / "profile", f"--screenshot={picture}", f"--window-size={size[0]},{size[1]}", *flags, place=place
    )
    return cv2.imread(str(picture))
