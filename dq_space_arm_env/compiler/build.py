"""Build a program: emit it, compile it, and note down what a caller must know."""

from __future__ import annotations

from typing import Any

from llvmlite import ir

from dq_space_arm_env.compiler import native
from dq_space_arm_env.compiler.emit import Target
from dq_space_arm_env.compiler.program import Buffer, Program, emit_program


def assembly(program: Program, lanes: int, precision: str = "float64") -> str:
    """LLVM assembly of a program.

    Args:
        program: The program.
        lanes: Rows that the code works on at a time.
        precision: What it computes in, "float64" or "float32".

    Returns:
        The module as text, before optimization.
    """
    module = ir.Module(program.name)
    emit_program(module, program, Target(lanes, native.host_machine().fused, precision))
    return str(module)


def build_program(program: Program, lanes: int, precision: str = "float64") -> tuple[bytes, dict[str, Any]]:
    """Compile a program.

    Args:
        program: The program.
        lanes: Rows that the code works on at a time.
        precision: What it computes in, "float64" or "float32".

    Returns:
        Object file, and the metadata `kernels.BoundKernel` reads.
    """

    def noted(buffer: Buffer) -> list[Any]:
        return [
            buffer.name,
            buffer.size if buffer.by_column else buffer.stride,
            buffer.shared,
            buffer.dtype or precision,
            buffer.by_column,
        ]

    metadata = {
        "inputs": [noted(buffer) for buffer in program.inputs],
        "outputs": [noted(buffer) for buffer in program.outputs],
        "operations": program.operation_count,
        "indexed": program.indexed,
    }
    return native.compile_to_object(assembly(program, lanes, precision)), metadata
