"""`disctrack warm-up`: compile the inner loops ahead of the first recording, as when the image of a cluster is made."""

import argparse
from collections.abc import Callable
from concurrent.futures import ProcessPoolExecutor
from functools import partial
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
from disctrack.track.dots import template as dots
from disctrack.track.follow.tracking import prepare

_DEPTHS = (np.uint8, np.uint16)
# What is compiled -> seconds of processor time that it took where it was measured, and by which functions
PARTS: dict[str, tuple[int, list[Callable[[], object]]]] = {
    "tracking": (40, [partial(ready, dtype) for dtype in _DEPTHS for ready in (prepare, dots.prepare)]),
    "the simulation of motions": (30, [assembly.prepare]),
    "rendering": (10, [raster.prepare]),
    "corners": (8, [corner_fit.prepare, normal_equations.prepare]),
    "equations": (5, [_ode_kernel.prepare]),
    "readers": (1, [png.prepare]),
}


def run(arguments: argparse.Namespace) -> int:
    """Compile the inner loops of all stages, in two processes; returns the exit code."""
    with ProcessPoolExecutor(2, get_context("spawn")) as pool:
        list(pool.map(_compiled, PARTS))
    print(f"inner loops are compiled: kept in {FOLDER}")
    return DONE


def _compiled(what: str) -> None:
    seconds, functions = PARTS[what]
    with compiling(what, seconds):
        for function in functions:
            function()
