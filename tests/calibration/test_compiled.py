"""Functions that ship as machine code are those that numba would compile."""

import gzip
import os
import pickle
import subprocess
import sys

import llvmlite.binding as llvm
import numpy as np
import pytest

from calibration import compiled
from disctrack.recording.readers import _png
from tests.ship_compiled import HOW_MANY

LEVELS = [  # that a processor of x86-64 has, by what numba takes from the environment
    pytest.param({"NUMBA_CPU_NAME": level, "NUMBA_CPU_FEATURES": ",".join(sorted(needed))}, id=level)
    for level, needed in compiled.LEVELS.items()
]
MOTION = """
import sys
from pathlib import Path
import numpy as np
from calibration import compiled
from disctrack.disc import MA_2014 as disc
from disctrack.rolling import CATALOGUE, Model, sensitivities, steady_precession
told = []
if "anew" in sys.argv:
    compiled.AHEAD = Path("nowhere")
with compiled.when_compiling(lambda: told.append(1)):
    model = Model(disc, effects=[CATALOGUE[name]() for name in ("km", "kz", "air_quadratic", "spring")])
    state = steady_precession(np.radians(12.0), disc)
    found = sensitivities(model, state, np.linspace(0.0, 0.05, 11), ["km.k_m", "spring.k"])
print(len(told))
print(*found.q.ravel())
print(*found.dq.ravel())
"""


def motion(folder, *words, **environment):
    """Functions that were compiled, motion and its derivatives, from a process of its own."""
    environment = os.environ | {"NUMBA_CACHE_DIR": str(folder)} | environment
    told = subprocess.run([sys.executable, "-c", MOTION, *words], env=environment, capture_output=True, text=True)
    assert told.returncode == 0, told.stderr
    n, *found = told.stdout.splitlines()
    return int(n), *(np.array(line.split(), float) for line in found)


@pytest.mark.statistical
@pytest.mark.skipif("x86_64-unknown-linux" not in llvm.get_process_triple(), reason="code for Linux, x86-64")
@pytest.mark.parametrize("environment", LEVELS)
def test_where_the_code_that_ships_fits_nothing_is_compiled_and_motions_are_those_of_any_level(environment, tmp_path):
    n, q, dq = motion(tmp_path / "here")
    n_level, q_level, dq_level = motion(tmp_path / "level", **environment)
    assert (n, n_level) == (0, 0)
    assert not list(tmp_path.rglob("*.nb?"))  # and nothing is kept
    np.testing.assert_allclose(q_level, q, rtol=1e-11, atol=1e-12)
    np.testing.assert_allclose(dq_level, dq, rtol=1e-9, atol=1e-9 * abs(dq).max())


@pytest.mark.slow  # 20 s
def test_code_that_ships_gives_the_motions_of_code_that_is_compiled_here(tmp_path):
    _, q, dq = motion(tmp_path / "ships")
    n, q_anew, dq_anew = motion(tmp_path / "anew", "anew")
    assert n > 8
    np.testing.assert_allclose(q_anew, q, rtol=1e-11, atol=1e-12)
    np.testing.assert_allclose(dq_anew, dq, rtol=1e-9, atol=1e-9 * abs(dq).max())


def headers(function):
    name = f"{function.__module__}.{function.__qualname__}-*.gz"
    for file in compiled.AHEAD.glob(name):
        with gzip.open(file) as content:
            yield pickle.load(content)


@pytest.mark.parametrize("function", HOW_MANY, ids=lambda function: function.__qualname__)
def test_what_ships_was_made_from_the_present_sources(function):
    found = list(headers(function))
    assert len(found) == HOW_MANY[function]
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


def damaged(content):
    """(name, bytes) of a file that ships and came to harm."""
    yield "empty", b""
    yield "head alone", content[:5]
    yield "half", content[: len(content) // 2]
    yield "without its sum", content[:-8]
    yield "not packed", gzip.decompress(content)
    yield "something else", b"<!DOCTYPE html><title>404</title>" * 20
    yield "something else, packed", gzip.compress(b"no pickle at all")
    yield "half of it, packed", gzip.compress(gzip.decompress(content)[:-200])
    yield "another object", gzip.compress(pickle.dumps({"a": 1}) + pickle.dumps([2]))
    for place in np.linspace(12, len(content) - 30, 25).astype(int):
        yield f"a bit at {place}", content[:place] + bytes([content[place] ^ 16]) + content[place + 1 :]


def test_damaged_files_are_left_alone_and_the_function_is_compiled(monkeypatch, tmp_path):
    function = _png._undo_filters.py_func
    codegen = _png._undo_filters.targetctx.codegen()
    _png.prepare()
    sig = next(iter(_png._undo_filters.overloads))
    content, there = compiled.shipped_file(function, sig).read_bytes(), tmp_path / "ahead"
    made = pickle.loads(gzip.decompress(content))
    if made[1:] != compiled.made_for(made[0], sig)[1:]:
        pytest.skip("made for another machine, so it is compiled here")
    there.mkdir()
    monkeypatch.setattr(compiled, "AHEAD", there)
    file = compiled.shipped_file(function, sig)
    file.write_bytes(content)
    assert compiled._shipped(function, sig, made[0], codegen) is not None
    for name, harmed in damaged(content):
        file.write_bytes(harmed)
        assert compiled._shipped(function, sig, made[0], codegen) is None, name


KEPT = """
import sys
from pathlib import Path
import numpy as np
from calibration import compiled
compiled.AHEAD = Path("nowhere")
told = []
from disctrack.recording.readers import _lzw
with compiled.when_compiling(lambda: told.append(1)):
    rows = np.array([[3, 4, 5]], np.uint8)
    _lzw.undo_differences(rows)
print(len(told), *rows[0])
"""


@pytest.mark.statistical
def test_kept_code_that_was_cut_off_is_made_anew_and_kept(tmp_path):
    def run():
        environment = os.environ | {"NUMBA_CACHE_DIR": str(tmp_path)}
        told = subprocess.run([sys.executable, "-c", KEPT], env=environment, capture_output=True, text=True)
        assert told.returncode == 0, told.stderr
        return told.stdout.split()

    assert run() == ["1", "3", "7", "12"]
    assert run()[0] == "0"
    for pattern, keep in (("*.nbi", 0), ("*.nbi", 60), ("*.nbc", 100)):
        (file,) = tmp_path.rglob(pattern)
        file.write_bytes(file.read_bytes()[:keep])
        assert run() == ["1", "3", "7", "12"], (pattern, keep)
        assert run() == ["0", "3", "7", "12"], (pattern, keep)
