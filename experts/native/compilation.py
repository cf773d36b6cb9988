"""How numba compiles loops, the solver's above all, and how they call native kernels.

A kernel is a C function ``void kernel(int64 begin, int64 end, const int64 *buffers)``. The table of a
`buffer_table` holds the addresses of C-contiguous float64 arrays; for every row k in [begin, end) the kernel
reads row k of its inputs and writes row k of its outputs. Numba receives the kernel as a plain int64 address,
so one compiled loop serves every robot and can be cached on disk.
"""

from collections.abc import Callable
from typing import Any, TypeVar, cast

import numpy as np
from llvmlite import ir
from numba import njit, typeof, types
from numba.core.codegen import JITCodeLibrary
from numba.core.compiler import Compiler
from numba.core.registry import CPUDispatcher
from numba.extending import intrinsic
from numpy.typing import NDArray

from dq_space_arm_env.common.first_use import announce, compiling
from experts.native.loop_cache import LoopCache

Loop = TypeVar("Loop", bound=Callable[..., Any])
BufferTable = NDArray[np.int64]


def compiled(loop: Loop) -> Loop:
    """Compile a loop over arrays, and cache its code on disk.

    Only fused multiply-add may change rounding (``contract``). Without numba's memory management (``_nrt``) a
    loop that allocates does not compile, and no time goes into counting references to arrays, which was a
    third of the backward pass. The interpreter lock is released.
    """
    return _cached(njit(**_OPTIONS)(loop), loop)


def part(loop: Loop) -> Loop:
    """Compile like `compiled`, but for other loops only: a call from Python raises TypeError.

    LLVM optimizes the code once, within each loop that calls it. Numba would do so for a function by itself,
    for each that calls it, and so on to the outermost, and make machine code and a wrapper for Python of all
    of them: a third of the time that the solver takes to compile.
    """
    options = {"nopython": True, "no_cpython_wrapper": True, **_OPTIONS}
    return cast(Loop, _PartDispatcher(loop, targetoptions=options, pipeline_class=_PartCompiler))


def inlined(loop: Loop) -> Loop:
    """Compile like `compiled`, but as part of each loop that calls it.

    A matrix is nine arguments, and a named tuple of arrays a hundred or more: passing them takes as long as
    the work of a small function. No code is made for the function alone.
    """
    return _cached(njit(inline="always", **_OPTIONS)(loop), loop)


_OPTIONS: dict[str, Any] = {
    "nogil": True,
    "boundscheck": False,
    "error_model": "numpy",
    "fastmath": {"contract"},
    "_nrt": False,
    "no_cfunc_wrapper": True,
}


def _cached(dispatcher: Any, loop: Loop) -> Loop:
    dispatcher._cache = LoopCache(loop)  # numba's way to cache, but for whose files it trusts
    compile_loop = dispatcher._compiler.compile

    def compile_aloud(*signature: Any) -> Any:
        package = loop.__module__.partition(".")[0]
        announce(f"the code of {package}", if_first=True)
        with compiling(lambda: f"{loop.__name__.strip('_')} of {package}"):
            return compile_loop(*signature)

    dispatcher._compiler.compile = compile_aloud
    return cast(Loop, dispatcher)


def prepare(loop: Callable[..., Any], *arguments: Any) -> None:
    """Compile a loop for arguments of some types, or load it from the cache, without calling it."""
    cast(Any, loop).compile(tuple(map(typeof, arguments)))


def has_code(loop: Callable[..., Any]) -> bool:
    """Tell whether a loop is compiled in this process, for arguments of any types."""
    return bool(cast(Any, loop).overloads)


def is_prepared(loop: Callable[..., Any], *arguments: Any) -> bool:
    """Tell whether a loop is compiled for arguments of some types, here or in the cache."""
    dispatcher, signature = cast(Any, loop), tuple(map(typeof, arguments))
    return signature in dispatcher.overloads or dispatcher._cache.holds(signature, dispatcher.targetctx)


class _PartLibrary(JITCodeLibrary):
    """Code to link into that of others, as it was lowered."""

    def finalize(self) -> None:
        for library in dict.fromkeys(self._linking_libraries):
            self._final_module.link_in(library._get_module_for_linking(), preserve=True)
        self._finalized = True


class _PartCompiler(Compiler):
    """Numba's compiler, but for machine code."""

    def compile_extra(self, function: Any) -> Any:
        target, new_library = self.state.targetctx, cast(Any, _PartLibrary)
        self.state.flags.no_compile = True
        self.state.library = new_library(target.codegen(), function.__name__)
        # Numba knows a function by its entry point, even where nobody enters there.
        result = Compiler.compile_extra(self, function)._replace(entry_point=object())
        target.insert_user_function(result.entry_point, result.fndesc, [result.library])
        return result


class _PartDispatcher(CPUDispatcher):
    """What loops see of a part."""

    def add_overload(self, result: Any) -> None:
        self.overloads[tuple(result.signature.args)] = result

    def _compile_for_args(self, *args: Any, **keywords: Any) -> Any:
        raise TypeError(f"{self.py_func.__name__} is a part of compiled loops: Python cannot call it")


def _emit_call(typing_context: Any, address: Any, begin: Any, end: Any, buffers: Any) -> Any:
    signature = types.void(types.int64, types.int64, types.int64, types.Array(types.int64, 1, "C"))

    def generate(context: Any, builder: Any, signature: Any, arguments: Any) -> Any:
        address_value, begin_value, end_value, table_value = arguments
        int64 = ir.IntType(64)
        table = context.make_array(signature.args[3])(context, builder, table_value)
        function_type = ir.FunctionType(ir.VoidType(), [int64, int64, int64.as_pointer()])
        function = builder.inttoptr(address_value, function_type.as_pointer())
        builder.call(function, [begin_value, end_value, builder.bitcast(table.data, int64.as_pointer())])
        return context.get_dummy_value()

    return signature, generate


call_kernel: Any = intrinsic(_emit_call)
"""Call a native kernel from compiled code: ``call_kernel(address, begin, end, buffer_table)``."""
