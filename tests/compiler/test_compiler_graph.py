"""Tracing: constants fold, zeros vanish, subexpressions are shared."""

import casadi
import numpy as np
import pytest
from graph_interpreter import evaluate_graph

from dq_space_arm_env.algebra import scalars
from dq_space_arm_env.algebra.symbolic import Symbol, symbols
from dq_space_arm_env.compiler.graph import graph_of, trace


@pytest.mark.parametrize(
    ("outputs", "operations"),
    [
        (lambda x: [0.0 * x[0] + 1.0 * x[1]], 0),
        (lambda x: [x[0] * (3.0 * 4.0)], 1),
        (lambda x: [casadi.hypot(*x)], 4),
        (lambda x: [casadi.sin(x[0] * x[1]) + 1.0, casadi.sin(x[0] * x[1]) - 1.0], 4),
    ],
    ids=["zeros and ones vanish", "constants fold", "hypot is a root", "common subexpressions are shared"],
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


def test_symbols_with_their_own_operators_are_traced_like_those_of_casadi():
    def function(x):
        a, b = x
        smaller = scalars.select(a < b, a - 1.0, 2 / b)
        return {
            "y": [smaller * 3, -a + scalars.sin(b) * a, (a <= 0.5) + (b > 2) + (a >= b), 1 - a * b, 0.0 * a]
        }

    plain = [casadi.SX.sym(f"x_{i}") for i in range(2)]
    expected = graph_of("graph", {"x": plain}, function(plain))
    assert trace("graph", {"x": 2}, function) == expected
    (a,), number = symbols("a", 1), np.float64(2.0)
    for value in (a * a, 2.0 * a, scalars.sqrt(a), scalars.select(a < 1, a, 1.0)):
        assert type(value) is Symbol
    assert str(number * a) == str(number * plain[0]).replace("x_0", "a_0")
