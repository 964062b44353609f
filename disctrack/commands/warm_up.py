"""`disctrack warm-up`: compile the inner loops before the first recording, as for a container image."""

import argparse
from collections.abc import Callable, Sequence
from concurrent.futures import ProcessPoolExecutor
from functools import partial
from multiprocessing import get_context

import numpy as np

from calibration.board import corner_fit
from calibration.kit.compiled import FOLDER
from disctrack import rolling
from disctrack.discrepancy.equations import _ode_kernel
from disctrack.progress import compiling
from disctrack.recording.readers import _pixel_kernels
from disctrack.synthetic import raster
from disctrack.track.follow.tracking import prepare


def run(arguments: argparse.Namespace) -> None:
    """Compile the inner loops of all stages, in two processes."""
    # with estimates of the processor time [s]
    parts: list[tuple[str, int, list[Callable[[], object]]]] = [
        ("tracking", 40, [partial(prepare, kind) for kind in (np.uint8, np.uint16)]),
        ("the simulation of motions", 30, [rolling.prepare]),
        ("rendering", 10, [raster.prepare]),
        ("corners", 8, [corner_fit.prepare]),
        ("equations", 5, [_ode_kernel.prepare]),
        ("readers", 1, [_pixel_kernels.prepare]),
    ]
    with ProcessPoolExecutor(2, get_context("spawn")) as pool:
        for part in [pool.submit(_compiled, *part) for part in parts]:
            part.result()
    print(f"inner loops are compiled: kept in {FOLDER}")


def _compiled(what: str, seconds: int, functions: Sequence[Callable[[], object]]) -> None:
    with compiling(what, seconds):
        for function in functions:
            function()
