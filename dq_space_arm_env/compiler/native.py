"""Machine code: compile for this processor, cache the object file, load it without compiling.

An object file is cached under the hash of everything it depends on: the program's content, the compiler's and
the model's source, the versions of CasADi and LLVM, and the processor.
"""

from __future__ import annotations

import ctypes
import json
from collections.abc import Callable, Iterator
from contextlib import contextmanager, nullcontext
from functools import cache
from itertools import count
from threading import Lock
from typing import Any

import llvmlite.binding as llvm

from dq_space_arm_env.common.code_cache import keep_code, read_code
from dq_space_arm_env.common.host_machine import host_machine

KernelFunction = ctypes.CFUNCTYPE(None, ctypes.c_int64, ctypes.c_int64, ctypes.c_void_p)


# Lines of assembly above which LLVM's optimizer, half of the time that small modules take, gains nothing: the
# trace has shared and folded everything already.
_LARGE_MODULE = 3_000
# Lines above which a function's instructions stay in their order, see `_in_given_order`.
_LONG_FUNCTION = 3_000
_ORDER = Lock()


def _target_machine(opt: int) -> llvm.TargetMachine:
    llvm.initialize_native_target()
    llvm.initialize_native_asmprinter()
    machine = host_machine()
    features = machine.features
    if machine.lanes == 8:
        # LLVM prefers 256-bit vectors on some processors and would split ours.
        features += ",-prefer-256-bit"
    return llvm.Target.from_triple(llvm.get_process_triple()).create_target_machine(
        cpu=machine.cpu, features=features, opt=opt, reloc="pic", codemodel="default"
    )


def _optimized(assembly: str) -> tuple[llvm.ModuleRef, llvm.TargetMachine]:
    module = llvm.parse_assembly(assembly)
    module.verify()
    large = assembly.count("\n") > _LARGE_MODULE
    machine = _target_machine(opt=1 if large else 2)
    module.triple = machine.triple
    module.data_layout = str(machine.target_data)
    if not large:
        builder = llvm.create_pass_builder(machine, llvm.create_pipeline_tuning_options(speed_level=1))
        builder.getModulePassManager().run(module, builder)
    return module, machine


@contextmanager
def _in_given_order() -> Iterator[None]:
    """Keep LLVM from scheduling instructions, by an option of the whole process; no result depends on it.

    A trace computes a value shortly before its readers need it. In functions of thousands of instructions
    LLVM's machine scheduler moves the two apart: it takes half of the code generator's time, and what no
    longer fits in registers a sixth of the code's.
    """
    with _ORDER:
        llvm.set_option("", "-enable-misched=false")
        try:
            yield
        finally:
            llvm.set_option("", "-enable-misched=true")


def compile_to_object(assembly: str) -> bytes:
    """Compile LLVM assembly to an object file for this processor."""
    module, machine = _optimized(assembly)
    longest = max(function.count("\n") for function in assembly.split("\ndefine "))
    with _in_given_order() if longest > _LONG_FUNCTION else nullcontext():
        return bytes(machine.emit_object(module))


@cache
def _linker() -> llvm.LLJIT:
    """The linker of object files into this process.

    LLVM's JITLink keeps the code and the constants of an object file together. Its older linker may put them
    further apart than an instruction reaches, where large libraries fill the address space, and then aborts.
    """
    llvm.initialize_native_target()
    llvm.initialize_native_asmprinter()
    return llvm.create_lljit_compiler(use_jit_link=True)


_library_numbers = count()


class NativeKernel:
    """A compiled C function `void (int64 begin, int64 end, const int64 *buffers)` in memory.

    `address` is its address, `function` the same callable from Python, `metadata` the compiler's notes.
    """

    def __init__(self, name: str, object_code: bytes, metadata: dict[str, Any]) -> None:
        """Load an object file; LookupError if the function or one it needs is missing."""
        builder = llvm.JITLibraryBuilder().add_object_img(object_code).add_current_process()
        try:
            self._library = builder.export_symbol(name).link(_linker(), f"{name} {next(_library_numbers)}")
        except RuntimeError as error:
            raise LookupError(f"the object file has no function {name!r} that can be linked") from error
        self.address: int = self._library[name]
        self.function = KernelFunction(self.address)
        self.metadata = metadata


def load_or_build(name: str, key: str, build: Callable[[], tuple[bytes, dict[str, Any]]]) -> NativeKernel:
    """Load a kernel from the cache, or build and store it.

    `build` returns the object file and the metadata; it is called when the cache has no sound file.
    """
    kept = read_code(name, key)
    if kept is None:
        object_code, metadata = build()
        keep_code(name, key, json.dumps(metadata).encode() + b"\n" + object_code)
    else:
        header, _, object_code = kept.partition(b"\n")
        metadata = json.loads(header)
    return NativeKernel(name, object_code, metadata)
