"""Write the machine code that ships with the packages (`calibration.compiled`): python tests/ship_compiled.py

To be run whenever one of these functions, numba or Python changes; until then they are compiled on the user's machine.
Files that were made from the present sources, by the present programs, are left alone.
What numba hands to LLVM, with all that a function calls and nothing optimised, is optimised as a whole for each level
of processors.
"""

import contextlib
import functools
import gzip
import pickle
from pathlib import Path
from types import SimpleNamespace

import llvmlite.binding as llvm
import numba.core.codegen as codegen
import numba.core.event as event
import numpy as np
from numba.core import ir, sigutils
from numba.core.callconv import CPUCallConv
from numba.core.ccallback import CFunc
from numba.core.compiler_lock import global_compiler_lock

from calibration import _corner_kernel, _normal_kernel, compiled
from calibration.board import corner_fit
from calibration.fit import normal_equations
from disctrack.discrepancy.equations import _ode_kernel, _stiff_kernel
from disctrack.recording.readers import _png
from disctrack.rolling import equations, integrate
from disctrack.rolling._compiled import law_types, may_call, system_types
from disctrack.rolling.effects.base import HELPERS, catalogue
from disctrack.synthetic import board_raster, disc_raster
from disctrack.track import _kernels, _pose_kernel, dots, following, pose

ODE = (_ode_kernel.integrate, _ode_kernel.observe_all, _ode_kernel.rates_all)
PREPARED = (  # function, what compiles it, for how many types
    (_corner_kernel.fit_corners, corner_fit.prepare, 1),
    (_normal_kernel.accumulate, normal_equations.prepare, 1),
    (_png._undo_filters, _png.prepare, 2),
    (_kernels.track_frames, lambda: [following.prepare(bits) for bits in (np.uint8, np.uint16)], 2),
    (_kernels.look, lambda: [dots.prepare(bits) for bits in (np.uint8, np.uint16)], 2),
    (_pose_kernel.fit, pose.prepare, 1),
    *((function, _ode_kernel.prepare, 1) for function in ODE),
    (disc_raster.draw_disc, disc_raster.prepare, 1),
    (board_raster.draw_board, board_raster.prepare, 1),
    (_stiff_kernel.integrate, _stiff_kernel.prepare, 1),
    (integrate._dop853, lambda: [integrate.prepare(scalar) for scalar in (float, complex)], 2),
    (integrate._evaluate, lambda: [integrate.prepare(scalar) for scalar in (float, complex)], 2),
)
EFFECTS = tuple(kind for kind in catalogue() if kind.law)
CALLBACKS = tuple(
    callback
    for scalar in (float, complex)
    for callback in (
        *((function, system_types(scalar)) for function in (equations.rates, equations.event_margins)),
        *((kind.law, law_types(tuple(p.name for p in kind.parameters), scalar)) for kind in EFFECTS),
    )
)
for kind in EFFECTS:
    may_call(kind.law, HELPERS)

HOW_MANY = {dispatcher.py_func: n for dispatcher, _, n in PREPARED} | {f: 2 for f, _ in CALLBACKS}  # types of each

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
    """Leave the parts as they are; `found` gets LLVM's module of every function that was compiled by itself.

    Exceptions are raised in files without folders: those are this machine's.
    """
    library, jit, depth = codegen.CPUCodeLibrary, codegen.JITCPUCodegen, Depth()
    told = CPUCallConv.build_excinfo_struct
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

    def without_folder(self, exception, arguments, place, function):
        return told(self, exception, arguments, place and ir.Loc(Path(place.filename).name, place.line), function)

    library._optimize_final_module, library._finalize_final_module, jit.set_env = kept, left_out, where_it_is
    CPUCallConv.build_excinfo_struct = without_folder
    event.register("numba:compile", depth)
    try:
        yield
    finally:
        event.unregister("numba:compile", depth)
        library._optimize_final_module, library._finalize_final_module, jit.set_env = optimise, finalise, set_env
        CPUCallConv.build_excinfo_struct = told


def is_present(function, n):
    """True where the n files of the function, or more, were made from the present sources, by this Python and numba."""
    stamp = compiled._ShippedOrKept(function)._impl.locator.get_source_stamp()
    made = [pickle.loads(gzip.decompress(file.read_bytes())) for file in files_of(function)]
    *_, platform, python, version = compiled.made_for("", "")
    return len(made) >= n and all((m[0], *m[2:]) == (stamp, platform, python, version) for m in made)


def files_of(function):
    """Those that ship of it, for whatever types."""
    return list(compiled.AHEAD.glob(f"{function.__module__}.{function.__qualname__}-*.gz"))


def ship(prepared):
    """Compile functions for the types that are prepared, and write the files."""
    found = {}
    with unoptimised(found):
        for _, prepare, _ in prepared:
            prepare()
    for dispatcher, _, _ in prepared:
        for sig in dispatcher.overloads:
            write(dispatcher._cache, dispatcher.py_func, sig, dispatcher.overloads[sig], found)


def ship_callback(function, types):
    """The same of a C function of these types."""
    callback, found = CFunc(function, sigutils.normalize_signature(types), {}, {"error_model": "numpy"}), {}
    whole = {"dispatcher": SimpleNamespace(targetoptions={})}  # no part of another
    with global_compiler_lock, unoptimised(found), event.trigger_event("numba:compile", whole):
        result = callback._compile_uncached()
        result.library.finalize()
    write(compiled._ShippedOrKept(function), function, callback._sig, result, found)


def write(cache, function, sig, result, found):
    """Write one file of machine code."""
    (name, _, _), *others = result._reduce()
    others[TYPES_IN_WORDS] = ""  # it names the folders of the machine
    bitcode = found[result.fndesc.llvm_func_name]
    levels = {level: compiled.dumps(machine_code(name, bitcode, others, level)) for level in compiled.LEVELS}
    stamp = cache._impl.locator.get_source_stamp()
    content = pickle.dumps(compiled.made_for(stamp, sig)) + pickle.dumps(levels)
    file = compiled.shipped_file(function, sig)
    file.write_bytes(gzip.compress(content, mtime=0))
    print(f"{file.stat().st_size / 1024:6.0f} kB  {file.name}")


def machine_code(name, bitcode, others, level):
    """What numba would keep of a function that is compiled for this level of processors."""
    library = processor(level).create_library(name)
    library._final_module = module = llvm.parse_bitcode(bitcode)
    library._optimize_final_module()
    *others, environments = others
    left = {variable.name for variable in module.global_variables}
    used = tuple(environment for environment in environments if environment.env_name in left)
    return (name, "object", (library._codegen._tm.emit_object(module), declared(module))), *others, used


class ForLevel(codegen.JITCPUCodegen):
    """numba's generator of code, for processors of a level and not for the one at hand."""

    def __init__(self, level):
        self._level = level
        super().__init__("ahead")

    def _get_host_cpu_name(self):
        return self._level

    def _get_host_cpu_features(self):
        return ""


processor = functools.cache(ForLevel)


def declared(module):
    """Bitcode with the names that a module defines, and no more: whoever links it calls what is in the machine code."""
    lines = [f'target triple = "{module.triple}"', f'target datalayout = "{module.data_layout}"']
    lines += [
        f"@{variable.name} = {variable.linkage.name} global ptr null"
        for variable in module.global_variables
        if variable.name.startswith("_ZN08NumbaEnv")
    ]
    for function in module.functions:
        if not function.is_declaration:
            returned, _, arguments = str(function.global_value_type).partition(" (")
            body = "{ unreachable }"
            lines.append(f'define available_externally {returned} @"{function.name}"({arguments} noinline {body}')
    return llvm.parse_assembly("\n".join(lines)).as_bitcode()


if __name__ == "__main__":
    compiled.AHEAD.mkdir(exist_ok=True)
    kept = {function for function, n in HOW_MANY.items() if is_present(function, n)}
    for old in set(compiled.AHEAD.iterdir()).difference(*map(files_of, kept)):
        old.unlink()
    for dispatcher, _, _ in PREPARED:
        dispatcher._cache.disable()
    ship([one for one in PREPARED if one[0].py_func not in kept])
    for function, types in CALLBACKS:
        if function not in kept:
            ship_callback(function, types)
