"""`disctrack warm-up`: compile the inner loops before the first recording, as for a container image."""

import argparse
import sys
from concurrent.futures import ProcessPoolExecutor
from functools import partial
from multiprocessing import get_context

import numpy as np

from calibration.board import corner_fit
from calibration.kit.compiled import FOLDER
from disctrack import rolling
from disctrack.discrepancy.equations import _ode_kernel
from disctrack.recording.readers import _pixel_kernels
from disctrack.synthetic import _raster_kernel as raster
from disctrack.track.follow.tracking import prepare


def run(arguments: argparse.Namespace) -> None:
    """Compile the inner loops of all stages, in two processes, the longest first."""
    parts = [partial(prepare, np.uint8), *(module.prepare for module in (rolling, raster, corner_fit))]
    parts += [_ode_kernel.prepare, _pixel_kernels.prepare, partial(prepare, np.uint16)]
    print("compiling the inner loops: once per installation, about 100 s of a free core", file=sys.stderr, flush=True)
    with ProcessPoolExecutor(2, get_context("spawn")) as pool:
        for part in [pool.submit(part) for part in parts]:
            part.result()
    print(f"inner loops are compiled: kept in {FOLDER}")
