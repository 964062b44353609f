"""Write the intermediate code that ships with the packages (`calibration.compiled`): python tests/ship_compiled.py

To be run whenever one of these functions, numba or Python changes; until then they are compiled on the user's machine.
Files that were made from the present sources, by the present programs, are left alone.
What ships is what numba hands to LLVM: all that a function calls is in it, and nothing is optimised, as that is done
for one machine.
"""

import contextlib
import gzip
import pickle
from types import SimpleNamespace

import numba.core.codegen as codegen
import numba.core.event as event
import numpy as np
from numba.core import sigutils
from numba.core.ccallback import CFunc
from numba.core.compiler_lock import global_compiler_lock

from calibration import _corner_kernel, _normal_kernel, compiled, corner_fit, normal_equations
from disctrack.readers import _png
from disctrack.rolling import equations, integrate
from disctrack.rolling._compiled import system_types
from disctrack.track import _kernels, _pose_kernel, dots, following, pose

PREPARED = (
    (_corner_kernel.fit_corners, corner_fit.prepare),
    (_normal_kernel.accumulate, normal_equations.prepare),
    (_png._undo_filters, _png.prepare),
    (_kernels.track_frames, lambda: following.prepare(np.uint8)),
    (_kernels.track_frames, lambda: following.prepare(np.uint16)),
    (_kernels.look, lambda: dots.prepare(np.uint8)),
    (_kernels.look, lambda: dots.prepare(np.uint16)),
    (_pose_kernel.fit, pose.prepare),
    (integrate._dop853, lambda: integrate.prepare(float)),
    (integrate._dop853, lambda: integrate.prepare(complex)),
)

CALLBACKS = tuple(
    (function, scalar) for function in (equations.rates, equations.event_margins) for scalar in (float, complex)
)

TYPES_IN_WORDS = 5  # of what numba keeps after the library


class Depth(event.Listener):
    """How many functions are being compiled inside one another, and those that have no way in from Python."""

    def __init__(self):
        self.inside = []

    def on_start(self, occurrence):
        self.inside.append(occurrence.data["dispatcher"])

    def on_end(self, occurrence):
        self.inside.pop()

    @property
    def is_part(self):
        return bool(self.inside) and bool(self.inside[-1].targetoptions.get("no_cpython_wrapper"))


@contextlib.contextmanager
def unoptimised(found):
    """Leave the parts as they are; `found` gets LLVM's module of every function that was compiled by itself."""
    library, jit, depth = codegen.CPUCodeLibrary, codegen.JITCPUCodegen, Depth()
    optimise, finalise, set_env = library._optimize_final_module, library._finalize_final_module, jit.set_env

    def kept(self):
        if len(depth.inside) == 1:
            bitcode = self._final_module.as_bitcode()
            found.update((f.name, bitcode) for f in self._final_module.functions if not f.is_declaration)
        if not depth.is_part:
            optimise(self)

    def left_out(self):
        if depth.is_part:
            self._finalize_dynamic_globals()
            self._finalized = True
        else:
            finalise(self)

    def where_it_is(self, name, env):
        if self._engine.get_global_value_address(name):
            set_env(self, name, env)

    library._optimize_final_module, library._finalize_final_module, jit.set_env = kept, left_out, where_it_is
    event.register("numba:compile", depth)
    try:
        yield
    finally:
        event.unregister("numba:compile", depth)
        library._optimize_final_module, library._finalize_final_module, jit.set_env = optimise, finalise, set_env


def is_present(function, n):
    """True where the n files of the function, or more, were made from the present sources, by this Python and numba."""
    stamp = compiled._ShippedOrKept(function)._impl.locator.get_source_stamp()
    made = [pickle.loads(gzip.decompress(file.read_bytes())) for file in files_of(function)]
    *_, platform, python, version = compiled.made_for("", "")
    return len(made) >= n and all((m[0], *m[2:]) == (stamp, platform, python, version) for m in made)


def files_of(function):
    """Those that ship of it, for whatever types."""
    return list(compiled.AHEAD.glob(f"{function.__module__}.{function.__qualname__}-*.gz"))


def ship(dispatcher, prepare):
    """Compile a function for the types that `prepare` calls it with, and write the files."""
    dispatcher._cache.disable()
    before, found = set(dispatcher.overloads), {}
    with unoptimised(found):
        prepare()
    for sig in set(dispatcher.overloads) - before:
        write(dispatcher._cache, dispatcher.py_func, sig, dispatcher.overloads[sig], found)


def ship_callback(function, signature):
    """The same of a C function of these types."""
    callback, found = CFunc(function, sigutils.normalize_signature(signature), {}, {"error_model": "numpy"}), {}
    whole = {"dispatcher": SimpleNamespace(targetoptions={})}  # no part of another
    with global_compiler_lock, unoptimised(found), event.trigger_event("numba:compile", whole):
        result = callback._compile_uncached()
        result.library.finalize()
    write(compiled._ShippedOrKept(function), function, callback._sig, result, found)


def write(cache, function, sig, result, found):
    """Write one file of intermediate code."""
    (name, _, _), *others = result._reduce()
    others[TYPES_IN_WORDS] = ""  # it names the folders of the machine
    stamp = cache._impl.locator.get_source_stamp()
    content = pickle.dumps(compiled.made_for(stamp, sig)) + compiled.dumps(
        (name, found[result.fndesc.llvm_func_name], others)
    )
    file = compiled.shipped_file(function, sig)
    file.write_bytes(gzip.compress(content, mtime=0))
    print(f"{file.stat().st_size / 1024:6.0f} kB  {file.name}")


if __name__ == "__main__":
    compiled.AHEAD.mkdir(exist_ok=True)
    asked = [dispatcher.py_func for dispatcher, _ in PREPARED] + [function for function, _ in CALLBACKS]
    kept = {function for function in asked if is_present(function, asked.count(function))}
    for old in set(compiled.AHEAD.iterdir()).difference(*map(files_of, kept)):
        old.unlink()
    for dispatcher, prepare in PREPARED:
        if dispatcher.py_func not in kept:
            ship(dispatcher, prepare)
    for function, scalar in CALLBACKS:
        if function not in kept:
            ship_callback(function, system_types(scalar))
