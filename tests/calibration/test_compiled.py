"""Functions that ship as intermediate code are those that numba would compile."""

import gzip
import pickle

import numpy as np
import pytest

from calibration import compiled
from calibration._corner_kernel import fit_corners
from calibration._normal_kernel import accumulate
from disctrack.readers import _png
from disctrack.rolling import equations, integrate
from disctrack.track._kernels import look, track_frames
from disctrack.track._pose_kernel import fit

SHIPPED = {
    "fit_corners": (fit_corners.py_func, 1),
    "accumulate": (accumulate.py_func, 1),
    "_undo_filters": (_png._undo_filters.py_func, 2),
    "track_frames": (track_frames.py_func, 2),
    "look": (look.py_func, 2),
    "fit": (fit.py_func, 1),
    "_dop853": (integrate._dop853.py_func, 2),
    "rates": (equations.rates, 2),
    "event_margins": (equations.event_margins, 2),
}


def headers(function):
    name = f"{function.__module__}.{function.__qualname__}-*.gz"
    for file in compiled.AHEAD.glob(name):
        with gzip.open(file) as content:
            yield pickle.load(content)


@pytest.mark.parametrize("name", SHIPPED)
def test_what_ships_was_made_from_the_present_sources(name):
    function, n = SHIPPED[name]
    found = list(headers(function))
    assert len(found) == n
    *_, python, numba_version = compiled.made_for("", "")
    if any(made[-2:] != (python, numba_version) for made in found):
        pytest.skip("made for another Python or numba, so it is compiled here")
    stamp = compiled._ShippedOrKept(function)._impl.locator.get_source_stamp()
    assert {made[0] for made in found} == {stamp}, "make it anew: python tests/ship_compiled.py"


def test_what_ships_names_no_folder_of_the_machine_that_made_it():
    for file in compiled.AHEAD.glob("*.gz"):
        content = gzip.decompress(file.read_bytes())
        assert b"site-packages" not in content
        assert str(compiled.AHEAD.parents[1]).encode() not in content


def test_shipped_code_does_what_the_function_says(rng):
    raw = rng.integers(0, 256, (6, 41), dtype=np.uint8)
    raw[:, 0] = [0, 1, 2, 3, 4, 4]
    expected, got = np.empty((6, 40), np.uint8), np.empty((6, 40), np.uint8)
    with np.errstate(over="ignore"):
        _png._undo_filters.py_func(raw, 1, expected)
    _png._undo_filters(raw, 1, got)
    np.testing.assert_array_equal(got, expected)


def test_code_for_other_sources_types_or_programs_is_left_alone(monkeypatch, tmp_path):
    function = _png._undo_filters.py_func
    codegen = _png._undo_filters.targetctx.codegen()
    _png.prepare()
    for sig in _png._undo_filters.overloads:
        with gzip.open(compiled.shipped_file(function, sig)) as content:
            stamp = pickle.load(content)[0]
        assert compiled._shipped(function, sig, "other sources", codegen) is None
        assert compiled._shipped(function, (*sig, 1), stamp, codegen) is None
        monkeypatch.setattr(compiled.numba, "__version__", "0.0")
        assert compiled._shipped(function, sig, stamp, codegen) is None
        monkeypatch.undo()
