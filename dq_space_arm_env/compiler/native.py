"""Machine code: compile for this processor, cache the object file, load it without compiling.

An object file is cached under the hash of everything it depends on: the program's content, the compiler's and
the model's source, the versions of LLVM and CasADi, and the processor. A cached file is used only if it
belongs to this user, is writable by nobody else, and its checksum and key match; otherwise it is rebuilt.
"""

from __future__ import annotations

import contextlib
import ctypes
import hashlib
import json
import os
import stat
import tempfile
import warnings
from collections.abc import Callable
from functools import cache
from itertools import count
from pathlib import Path
from typing import Any

import llvmlite
import llvmlite.binding as llvm
import platformdirs

from dq_space_arm_env.common.host_machine import host_machine

_MAGIC = b"DQSpaceArm native kernel 1\n"

KernelFunction = ctypes.CFUNCTYPE(None, ctypes.c_int64, ctypes.c_int64, ctypes.c_void_p)


# Above this many lines of assembly, LLVM's optimizer and its thorough code generator cost seconds and gain a
# few per cent: the trace has shared and folded everything already.
_LARGE_MODULE = 12_000


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


def compile_to_object(assembly: str) -> bytes:
    """Compile LLVM assembly to an object file for this processor."""
    module, machine = _optimized(assembly)
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


def cache_directory() -> Path:
    """Folder of the compiled kernels: $DQ_SPACE_ARM_CACHE, or the platform's user cache folder."""
    configured = os.environ.get("DQ_SPACE_ARM_CACHE")
    return Path(configured) if configured else Path(platformdirs.user_cache_dir("dq-space-arm"))


def cache_key(*parts: str) -> str:
    """Hash everything a kernel depends on, including the machine and tool versions."""
    machine = host_machine()
    everything = [*parts, llvmlite.__version__, str(llvm.llvm_version_info), machine.cpu, machine.features]
    return hashlib.sha256(json.dumps(everything).encode()).hexdigest()


def load_or_build(name: str, key: str, build: Callable[[], tuple[bytes, dict[str, Any]]]) -> NativeKernel:
    """Load a kernel from the cache, or build and store it.

    `build` returns the object file and the metadata; it is called when the cache has no sound file.
    """
    path = cache_directory() / f"{name}-{key[:32]}.kernel"
    cached = _read(path, key)
    if cached is None:
        cached = build()
        _write(path, key, *cached)
    return NativeKernel(name, *cached)


def _read(path: Path, key: str) -> tuple[bytes, dict[str, Any]] | None:
    """Read a cache file; None if it is missing, foreign or damaged."""
    try:
        with path.open("rb") as file:
            status = os.fstat(file.fileno())
            foreign = hasattr(os, "getuid") and status.st_uid != os.getuid()
            if foreign or status.st_mode & (stat.S_IWGRP | stat.S_IWOTH):
                return None
            content = file.read()
    except OSError:
        return None
    digest, payload = content[len(_MAGIC) : len(_MAGIC) + 32], content[len(_MAGIC) + 32 :]
    if not content.startswith(_MAGIC) or hashlib.sha256(payload).digest() != digest:
        return None
    header, _, object_code = payload.partition(b"\n")
    notes = json.loads(header)
    return (object_code, notes["metadata"]) if notes["key"] == key else None


def _write(path: Path, key: str, object_code: bytes, metadata: dict[str, Any]) -> None:
    """Write a cache file under a temporary name and rename it, so no reader sees a partial one."""
    payload = json.dumps({"key": key, "metadata": metadata}).encode() + b"\n" + object_code
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        descriptor, temporary = tempfile.mkstemp(dir=path.parent, suffix=".tmp")
        try:
            with os.fdopen(descriptor, "wb") as file:
                file.write(_MAGIC + hashlib.sha256(payload).digest() + payload)
            Path(temporary).replace(path)
        except BaseException:
            with contextlib.suppress(OSError):
                Path(temporary).unlink()
            raise
    except OSError as error:
        warnings.warn(
            f"cannot keep compiled kernels in {path.parent} ({error.strerror}); they are compiled again "
            "in every process. Set DQ_SPACE_ARM_CACHE to a folder that can be written.",
            stacklevel=2,
        )
