"""`disctrack warm-up`: compile the inner loops ahead of the first recording, as when the image of a cluster is made."""

import argparse

import numpy as np

from calibration.board import corner_fit
from calibration.compiled import when_compiling
from calibration.fit import normal_equations
from disctrack.commands import DONE
from disctrack.progress import compiling
from disctrack.recording.readers import _png as png
from disctrack.rolling import _assembly as assembly
from disctrack.rolling import integrate
from disctrack.synthetic import board_raster, disc_raster
from disctrack.track import _kernels as kernels
from disctrack.track import dots
from disctrack.track.tracking import prepare


def run(arguments: argparse.Namespace) -> int:
    """Compile what reading, calibrating, tracking, simulating and rendering use; returns the exit code."""
    compiled: list[None] = []
    with when_compiling(lambda: compiled.append(None)):
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
            for scalar in (float, complex):
                integrate.prepare(scalar)
                assembly.prepare(scalar)
        with compiling("rendering", 10):
            disc_raster.prepare()
            board_raster.prepare()
    where = f"kept in {kernels.track_frames.stats.cache_path}" if compiled else "those that ship fit this machine"
    print(f"inner loops are compiled: {where}")
    return DONE
