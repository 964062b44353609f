"""Write the intermediate code that ships with the packages (`calibration.compiled`): python tests/ship_compiled.py

To be run whenever one of these functions, numba or Python changes; until then they are compiled on the user's machine.
What ships is what numba hands to LLVM: all that a function calls is in it, and nothing is optimised, as that is done
for one machine.
"""

import contextlib
import gzip
import pickle

import numba.core.codegen as codegen
import numba.core.event as event
import numpy as np

from calibration import _corner_kernel, _normal_kernel, compiled, corner_fit, normal_equations
from disctrack.readers import _png
from disctrack.rolling import integrate
from disctrack.track import _kernels, following

PREPARED = (
    (_corner_kernel.fit_corners, corner_fit.prepare),
    (_normal_kernel.accumulate, normal_equations.prepare),
    (_png._undo_filters, _png.prepare),
    (_kernels.track_frames, lambda: following.prepare(np.uint8)),
    (_kernels.track_frames, lambda: following.prepare(np.uint16)),
    (integrate._dop853, lambda: integrate.prepare(float)),
    (integrate._dop853, lambda: integrate.prepare(complex)),
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


def ship(dispatcher, prepare):
    """Compile a function for the types that `prepare` calls it with, and write the files."""
    dispatcher._cache.disable()
    stamp = dispatcher._cache._impl.locator.get_source_stamp()
    before, found = set(dispatcher.overloads), {}
    with unoptimised(found):
        prepare()
    for sig in set(dispatcher.overloads) - before:
        result = dispatcher.overloads[sig]
        (name, _, _), *others = result._reduce()
        others[TYPES_IN_WORDS] = ""  # it names the folders of the machine
        content = pickle.dumps(compiled.made_for(stamp, sig)) + compiled.dumps(
            (name, found[result.fndesc.llvm_func_name], others)
        )
        file = compiled.shipped_file(dispatcher.py_func, sig)
        file.write_bytes(gzip.compress(content, mtime=0))
        print(f"{file.stat().st_size / 1024:6.0f} kB  {file.name}  {sig}")


if __name__ == "__main__":
    compiled.AHEAD.mkdir(exist_ok=True)
    for old in compiled.AHEAD.iterdir():
        old.unlink()
    for dispatcher, prepare in PREPARED:
        ship(dispatcher, prepare)
