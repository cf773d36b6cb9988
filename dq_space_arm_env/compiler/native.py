"""Machine code: compile a program for this processor, keep the object file, load it without compiling.

An object file is cached under the hash of everything that it depends on: the program's content, the
compiler's and the model's source, the versions of LLVM and CasADi, and the processor. A cached file is used
only if it belongs to this user, is writable by nobody else, and its checksum and key are right; otherwise it
is rebuilt.
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
from dataclasses import dataclass
from functools import cache
from itertools import count
from pathlib import Path
from typing import Any

import llvmlite
import llvmlite.binding as llvm
import platformdirs

_MAGIC = b"DQSpaceArm native kernel 1\n"

KernelFunction = ctypes.CFUNCTYPE(None, ctypes.c_int64, ctypes.c_int64, ctypes.c_void_p)


@dataclass(frozen=True)
class Machine:
    """The processor that code is made for.

    Attributes:
        cpu: LLVM's name of the processor.
        features: Its instruction sets, as LLVM writes them.
        lanes: Doubles in its widest vector register.
        fused: Whether it has fused multiply-add.
    """

    cpu: str
    features: str
    lanes: int
    fused: bool


@cache
def host_machine() -> Machine:
    """Describe the processor that this process runs on."""
    features = llvm.get_host_cpu_features()
    triple = llvm.get_process_triple()
    if triple.startswith(("x86_64", "amd64", "i686")):
        lanes = 8 if features.get("avx512f") else 4 if features.get("avx") else 2
        fused = bool(features.get("fma"))
    else:  # 64-bit Arm and the like: 128-bit vectors, fused multiply-add is part of the base instruction set
        lanes, fused = 2, True
    return Machine(llvm.get_host_cpu_name(), features.flatten(), lanes, fused)


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
    """Compile LLVM assembly to an object file for this processor.

    Args:
        assembly: LLVM module as text.

    Returns:
        The object file.
    """
    module, machine = _optimized(assembly)
    return bytes(machine.emit_object(module))


def disassemble(assembly: str) -> str:
    """Compile LLVM assembly and return the processor's instructions as text, to look at.

    Args:
        assembly: LLVM module as text.

    Returns:
        Assembly language of this processor.
    """
    module, machine = _optimized(assembly)
    return str(machine.emit_assembly(module))


@cache
def _linker() -> llvm.LLJIT:
    """What links object files into this process.

    LLVM's JITLink keeps the code and the constants of an object file together. Its older linker may put them
    further apart than an instruction reaches, where large libraries fill the address space, and then aborts.
    """
    llvm.initialize_native_target()
    llvm.initialize_native_asmprinter()
    return llvm.create_lljit_compiler(use_jit_link=True)


_library_numbers = count()


class NativeKernel:
    """A compiled program in memory.

    Attributes:
        address: Address of the C function `void (int64 begin, int64 end, const int64 *buffers)`.
        function: The same, callable from Python.
        metadata: What the compiler noted down, e.g. operation counts.
    """

    def __init__(self, name: str, object_code: bytes, metadata: dict[str, Any]) -> None:
        """Load an object file.

        Args:
            name: Name of the function in it.
            object_code: The object file.
            metadata: Notes to keep with the kernel.

        Raises:
            LookupError: If the object file has no such function, or needs one that is nowhere to be found.
        """
        builder = llvm.JITLibraryBuilder().add_object_img(object_code).add_current_process()
        try:
            self._library = builder.export_symbol(name).link(_linker(), f"{name} {next(_library_numbers)}")
        except RuntimeError as error:
            raise LookupError(f"the object file has no function {name!r} that can be linked") from error
        self.address: int = self._library[name]
        self.function = KernelFunction(self.address)
        self.metadata = metadata


def cache_directory() -> Path:
    """Folder of the compiled kernels: $DQ_SPACE_ARM_CACHE, or the user's cache folder of the platform."""
    configured = os.environ.get("DQ_SPACE_ARM_CACHE")
    return Path(configured) if configured else Path(platformdirs.user_cache_dir("dq-space-arm"))


def cache_key(*parts: str) -> str:
    """Hash everything a kernel depends on, the machine and the versions of the tools included."""
    machine = host_machine()
    everything = [*parts, llvmlite.__version__, str(llvm.llvm_version_info), machine.cpu, machine.features]
    return hashlib.sha256(json.dumps(everything).encode()).hexdigest()


def load_or_build(name: str, key: str, build: Callable[[], tuple[bytes, dict[str, Any]]]) -> NativeKernel:
    """Load a kernel from the cache, or build and store it.

    Args:
        name: Name of the function.
        key: Its `cache_key`.
        build: Returns the object file and the metadata; called when the cache has no sound file.

    Returns:
        The kernel, loaded.
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
    """Write a cache file under a temporary name and rename it, so that no reader sees half of it."""
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
