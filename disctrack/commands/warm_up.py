"""`disctrack warm-up`: compile the inner loops ahead of the first recording, as when the image of a cluster is made."""

from __future__ import annotations

import argparse

import numpy as np

from calibration import corner_fit, normal_equations
from disctrack.commands import DONE
from disctrack.progress import compiling
from disctrack.readers import _png as png
from disctrack.rolling import integrate
from disctrack.track import _kernels as kernels
from disctrack.track import dots
from disctrack.track.tracking import prepare


def run(arguments: argparse.Namespace) -> int:
    """Compile what reading, calibrating, tracking and simulating use; returns the exit code."""
    with compiling("readers", 1):
        png.prepare()
    with compiling("corners", "1 to 8"):
        corner_fit.prepare()
        normal_equations.prepare()
    with compiling("tracking, 8 bit", "5 to 20"):
        prepare(np.uint8)
        dots.prepare(np.uint8)
    with compiling("tracking, 16 bit", "5 to 20"):
        prepare(np.uint16)
        dots.prepare(np.uint16)
    with compiling("the integrator of motions", "2 to 20"):
        integrate.prepare(float)
        integrate.prepare(complex)
    print(f"inner loops are compiled; kept in {kernels.track_frames.stats.cache_path}")
    return DONE
