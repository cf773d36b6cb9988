"""Programs as functions of JAX, which XLA compiles for any device.

A step is thousands of operations on numbers, on which XLA takes minutes if it sees each stage anew, and more
if it differentiates them. Here it sees each graph once: the calls of a program are a loop over a vector that
holds all buffers, and in it a choice among the graphs.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import Any

import numpy as np

from dq_space_arm_env.compiler.graph import LIBRARY_FUNCTIONS, Graph
from dq_space_arm_env.compiler.program import Program
from dq_space_arm_env.interoperability.traced_functions import evaluated

Array = Any
_SAME_NAMES = (
    *("add", "subtract", "multiply", "divide", "square", "sqrt", "sin", "cos", "arctan", "arctan2"),
    *("absolute", "sign", "floor", "minimum", "maximum", *LIBRARY_FUNCTIONS),
)
_TRUTHS = ("less", "less_equal", "equal", "not_equal")
_OTHERS: Mapping[str, str] = {"not": "logical_not", "and": "logical_and", "or": "logical_or"}


def xla_function(jax: Any, program: Program, dtype: np.dtype[Any]) -> Callable[..., Array]:
    """Turn a program without loops into a function of its inputs, vectors by name, giving its one output."""
    sizes = program.scratch_sizes()
    places = dict(zip(sizes, np.cumsum([0, *sizes.values()]).tolist(), strict=False))
    graphs = {id(call.graph): call.graph for call in program.calls}
    branches = [_branch(jax, graph, dtype) for graph in graphs.values()]
    which = np.array([list(graphs).index(id(call.graph)) for call in program.calls])
    offsets = np.zeros((len(which), max(len(g.inputs) + len(g.outputs) for g in graphs.values())), np.int64)
    for row, call in zip(offsets, program.calls, strict=True):
        names = [name for name, _ in (*call.graph.inputs, *call.graph.outputs)]
        row[: len(names)] = [places[call.bindings.get(name, name)] for name in names]
    result = program.outputs[0].name

    def function(**inputs: Array) -> Array:
        empty = {name: jax.numpy.zeros(size, dtype) for name, size in sizes.items()}
        buffers = jax.numpy.concatenate([inputs.get(name, zeros) for name, zeros in empty.items()])

        def run(buffers: Array, call: tuple[Array, Array]) -> tuple[Array, None]:
            return jax.lax.switch(call[0], branches, buffers, call[1]), None

        buffers = jax.lax.scan(run, buffers, (which, offsets))[0]
        return buffers[places[result] : places[result] + sizes[result]]

    return function


def _branch(jax: Any, graph: Graph, dtype: np.dtype[Any]) -> Callable[[Array, Array], Array]:
    """Run a graph on the buffers at offsets, those of its inputs and then of its outputs."""
    operations = _operations(jax, dtype)

    def outputs(arguments: list[Array]) -> list[Array]:
        scalars = [[number[0] for number in jax.lax.split(vector, [1] * len(vector))] for vector in arguments]
        results = evaluated(graph, scalars, operations, float)
        # Without a barrier, XLA would compute what two results share twice.
        results = jax.lax.optimization_barrier(
            [[jax.numpy.asarray(number, dtype) for number in numbers] for numbers in results]
        )
        return [jax.numpy.stack(numbers) if numbers else jax.numpy.zeros(0, dtype) for numbers in results]

    # Derivatives keep the inputs alone, and compute what is between again.
    kept = jax.checkpoint(outputs)

    def run(buffers: Array, offsets: Array) -> Array:
        arguments = [
            jax.lax.dynamic_slice(buffers, (offset,), (size,))
            for offset, (_, size) in zip(offsets, graph.inputs, strict=False)
        ]
        for offset, values in zip(offsets[len(arguments) :], kept(arguments), strict=False):
            buffers = jax.lax.dynamic_update_slice(buffers, values, (offset,))
        return buffers

    return run


def _operations(jax: Any, dtype: np.dtype[Any]) -> dict[str, Callable[..., Array]]:
    """Operations of nodes; truths are 0 and 1."""
    xp = jax.numpy

    def truth(function: Callable[..., Array]) -> Callable[..., Array]:
        return lambda *values: function(*values).astype(dtype)

    return {
        **{name: getattr(xp, name) for name in _SAME_NAMES},
        **{name: truth(getattr(xp, name)) for name in _TRUTHS},
        **{name: truth(getattr(xp, other)) for name, other in _OTHERS.items()},
        "negate": xp.negative,
        "twice": lambda a: a + a,
        "invert": lambda a: 1 / a,
        "if_else_zero": lambda condition, a: xp.where(condition != 0, a, 0.0),
    }
