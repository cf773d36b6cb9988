"""Tracing: constants fold, zeros vanish, subexpressions are shared."""

import casadi
import numpy as np
import pytest
from graph_interpreter import evaluate_graph

from dq_space_arm_env.compiler.graph import graph_of, trace


def count(function, **sizes):
    return trace("f", sizes, function).operation_count


def test_structural_zeros_and_ones_vanish():
    assert count(lambda x: {"y": [0.0 * x[0] + 1.0 * x[1]]}, x=2) == 0


def test_constants_fold():
    assert count(lambda x: {"y": [x[0] * (3.0 * 4.0)]}, x=1) == 1


def test_common_subexpressions_are_shared():
    def twice(x):
        return {"y": [casadi.sin(x[0] * x[1]) + 1.0, casadi.sin(x[0] * x[1]) - 1.0]}

    assert count(twice, x=2) == 4


def test_an_output_nobody_asked_for_costs_nothing():
    def function(x):
        _unused = casadi.sin(x[0]) * x[0]
        return {"y": [x[0] + 1.0]}

    assert count(function, x=1) == 1


def test_constant_outputs_are_kept():
    graph = trace("f", {"x": 1}, lambda x: {"y": [0.0, 2.0, x[0]]})
    (result,) = evaluate_graph(graph, [np.array([7.0])], np.float64)
    assert result.tolist() == [0.0, 2.0, 7.0]


def test_an_operation_without_instruction_is_refused():
    x = casadi.SX.sym("x")
    with pytest.raises(NotImplementedError, match="graph 'f' holds CasADi operation"):
        graph_of("f", {"x": [x]}, {"y": [casadi.tanh(x)]})
