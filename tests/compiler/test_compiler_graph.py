"""Tracing: constants fold, zeros vanish, subexpressions are shared."""

import casadi
import numpy as np
import pytest
from graph_interpreter import evaluate_graph

from dq_space_arm_env.compiler.graph import graph_of, trace


@pytest.mark.parametrize(
    ("outputs", "operations"),
    [
        (lambda x: [0.0 * x[0] + 1.0 * x[1]], 0),
        (lambda x: [x[0] * (3.0 * 4.0)], 1),
        (lambda x: [casadi.sin(x[0] * x[1]) + 1.0, casadi.sin(x[0] * x[1]) - 1.0], 4),
    ],
    ids=["zeros and ones vanish", "constants fold", "common subexpressions are shared"],
)
def test_operations_left(outputs, operations):
    assert trace("f", {"x": 2}, lambda x: {"y": outputs(x)}).operation_count == operations


def test_constant_outputs_are_kept():
    graph = trace("f", {"x": 1}, lambda x: {"y": [0.0, 2.0, x[0]]})
    (result,) = evaluate_graph(graph, [np.array([7.0])], np.float64)
    assert result.tolist() == [0.0, 2.0, 7.0]


def test_an_operation_without_instruction_is_refused():
    x = casadi.SX.sym("x")
    with pytest.raises(NotImplementedError, match="graph 'f' holds CasADi operation OP_ERF"):
        graph_of("f", {"x": [x]}, {"y": [casadi.erf(x)]})
