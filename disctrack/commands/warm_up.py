"""`disctrack warm-up`: compile the inner loops ahead of the first recording, as when the image of a cluster is made."""

import argparse
from concurrent.futures import ProcessPoolExecutor
from multiprocessing import get_context

import numpy as np

from calibration.board import corner_fit
from calibration.fit import normal_equations
from calibration.kit.compiled import FOLDER
from disctrack.commands import DONE
from disctrack.discrepancy.equations import _ode_kernel
from disctrack.progress import compiling
from disctrack.recording.readers import _png as png
from disctrack.rolling import _assembly as assembly
from disctrack.synthetic import raster
from disctrack.track.follow.tracking import prepare


def run(arguments: argparse.Namespace) -> int:
    """Compile the inner loops of all stages, in two processes; returns the exit code."""
    with ProcessPoolExecutor(2, get_context("spawn")) as pool:
        for part in [pool.submit(part) for part in (_tracking, _motions, _images)]:
            part.result()
    print(f"inner loops are compiled: kept in {FOLDER}")
    return DONE


def _tracking() -> None:
    with compiling("tracking", 40):
        for dtype in (np.uint8, np.uint16):
            prepare(dtype)


def _motions() -> None:
    with compiling("the simulation of motions", 30):
        assembly.prepare()
    with compiling("equations", 5):
        _ode_kernel.prepare()


def _images() -> None:
    with compiling("readers", 1):
        png.prepare()
    with compiling("corners", 8):
        corner_fit.prepare()
        normal_equations.prepare()
    with compiling("rendering", 10):
        raster.prepare()
