"""Build a program: emit it, compile it, and note down what a caller must know."""

from __future__ import annotations

from typing import Any

from llvmlite import ir

from dq_space_arm_env.compiler import native
from dq_space_arm_env.compiler.emit import Target
from dq_space_arm_env.compiler.program import Program, emit_program


def assembly(program: Program, lanes: int) -> str:
    """LLVM assembly of a program.

    Args:
        program: The program.
        lanes: Rows that the code works on at a time.

    Returns:
        The module as text, before optimization.
    """
    module = ir.Module(program.name)
    emit_program(module, program, Target(lanes, native.host_machine().fused))
    return str(module)


def build_program(program: Program, lanes: int) -> tuple[bytes, dict[str, Any]]:
    """Compile a program.

    Args:
        program: The program.
        lanes: Rows that the code works on at a time.

    Returns:
        Object file, and the metadata `kernels.BoundKernel` reads.
    """
    metadata = {
        "inputs": [[buffer.name, buffer.stride, buffer.shared] for buffer in program.inputs],
        "outputs": [[buffer.name, buffer.stride, buffer.shared] for buffer in program.outputs],
        "operations": program.operation_count,
    }
    return native.compile_to_object(assembly(program, lanes)), metadata
