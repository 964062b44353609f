"""`disctrack warm-up`: compile the inner loops ahead of the first recording, as when the image of a cluster is made."""

import argparse

import numpy as np

from calibration.board import corner_fit
from calibration.fit import normal_equations
from calibration.kit.compiled import FOLDER
from disctrack.commands import DONE
from disctrack.progress import compiling
from disctrack.recording.readers import _png as png
from disctrack.rolling import _assembly as assembly
from disctrack.synthetic import board_raster, disc_raster
from disctrack.track.dots import template as dots
from disctrack.track.follow.tracking import prepare


def run(arguments: argparse.Namespace) -> int:
    """Compile what reading, calibrating, tracking, simulating and rendering use; returns the exit code."""
    with compiling("readers", 1):
        png.prepare()
    with compiling("corners", 8):
        corner_fit.prepare()
        normal_equations.prepare()
    for dtype in (np.uint8, np.uint16):
        with compiling(f"tracking, {8 * np.dtype(dtype).itemsize} bit", 20):
            prepare(dtype)
            dots.prepare(dtype)
    with compiling("the simulation of motions", 30):
        assembly.prepare()
    with compiling("rendering", 10):
        disc_raster.prepare()
        board_raster.prepare()
    print(f"inner loops are compiled: kept in {FOLDER}")
    return DONE
