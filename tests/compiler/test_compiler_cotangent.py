"""Cotangent programs: products with derivatives from the left, against complex steps."""

from dataclasses import replace

import casadi
import numpy as np
import pytest
from graph_interpreter import evaluate_program
from random_programs import random_graph
from test_compiler_tangent import complex_steps, everything, stages

from dq_space_arm_env.compiler import native
from dq_space_arm_env.compiler.build import build_program
from dq_space_arm_env.compiler.cotangent import append_cotangents
from dq_space_arm_env.compiler.graph import trace
from dq_space_arm_env.compiler.program import Buffer, Program
from dq_space_arm_env.compiler.reverse_mode import COTANGENT
from dq_space_arm_env.kernels.bound import BoundKernel


def products(make, inputs, of, by):
    """Values and products of a random row with the derivative by each input; the row; interpreted."""
    program = make()
    size = program.scratch_sizes()[of]
    program.inputs = [*program.inputs, Buffer("v", size)]
    append_cotangents(program, {of: "v"}, by)
    v = np.random.default_rng(0).normal(size=size)
    buffers = evaluate_program(program, {**inputs, "v": v})
    return buffers[of], [buffers[f"{name}{COTANGENT}"] for name in by], v


def assert_products(make, inputs, of, by, rtol=1e-12):
    values, actual, v = products(make, inputs, of, by)
    plain = evaluate_program(make(), inputs)[of]
    np.testing.assert_allclose(values, plain, rtol=1e-9, atol=1e-12)
    for name, product in zip(by, actual, strict=True):
        expected = v @ complex_steps(make(), inputs, name, of)
        np.testing.assert_allclose(
            product, expected, rtol=rtol, atol=rtol * np.abs(expected).max(initial=0.0)
        )


@pytest.mark.parametrize("seed", range(4))
def test_every_operation_is_differentiated(seed):
    graph = trace("graph", {"x": 3, "p": 2}, lambda x, p: {"y": everything(x, p)})

    def make():
        program = Program("program", [Buffer("x", 3), Buffer("p", 2)], [Buffer("y", 12)])
        program.call(graph)
        return program

    rng = np.random.default_rng(seed)
    assert_products(make, {"x": rng.normal(size=3), "p": rng.normal(size=2)}, "y", ["x", "p"])


def several_calls(seed):
    """Random graphs called with inputs bound this way and that; buffers are written twice."""
    first = random_graph(np.random.default_rng(seed), "first", count=90)
    second = replace(first, name="second", results=((89, 60, 45), (50,)))
    program = Program("calls", [Buffer("p", 3), Buffer("x", 3)], [])
    program.call(first, r="x", y="y1", z="z1")
    program.call(first, r="p", x="y1", y="y2", z="z2")
    program.call(second, r="y1", x="y2", y="y1", z="z1")
    program.call(second, p="y2", r="x", x="y1", y="y3", z="z3")
    parts = {name: size for i in (1, 2, 3) for name, size in ((f"y{i}", 3), (f"z{i}", 1))}
    program.call(
        trace("joined", parts, lambda **parts: {"all": [e for part in parts.values() for e in part]})
    )
    return program


def test_random_programs():
    compared = 0
    for seed in range(60):
        rng = np.random.default_rng(seed)
        inputs = {"p": rng.normal(size=3), "x": rng.normal(size=3)}
        with np.errstate(all="ignore"):
            slopes = [complex_steps(several_calls(seed), inputs, name, "all") for name in inputs]
            _, actual, v = products(lambda seed=seed: several_calls(seed), inputs, "all", inputs)
        sizes = [np.abs(slope).max() for slope in slopes]
        # Long random chains amplify rounding, and run into 1 / 0, which a complex step may get past.
        if not all(size < 1e6 for size in sizes) or not np.isfinite(actual).all():
            continue
        for slope, size, product in zip(slopes, sizes, actual, strict=True):
            np.testing.assert_allclose(product, v @ slope, rtol=1e-8, atol=1e-9 * size)
            compared += size > 1e-3
    assert compared > 25


@pytest.mark.parametrize("lanes", [1, native.host_machine().lanes])
def test_machine_code_agrees_with_the_interpreter(lanes):
    program = stages()
    program.inputs = [*program.inputs, Buffer("v", 2)]
    append_cotangents(program, {"k3": "v"}, ["p", "k0"])
    program.outputs = [Buffer("k3", 2), *(Buffer(f"{name}{COTANGENT}", 2) for name in ("p", "k0"))]
    rows = dict(zip(("p", "k0", "v"), np.random.default_rng(0).normal(size=(3, 11, 2)), strict=True))
    kernel = BoundKernel(native.NativeKernel("stages", *build_program(program, lanes)))
    results = [np.zeros((11, 2)) for _ in range(3)]
    kernel([*rows.values(), *results], 11)
    buffers = evaluate_program(program, {name: array.T for name, array in rows.items()})
    for spec, result in zip(program.outputs, results, strict=True):
        np.testing.assert_allclose(result, buffers[spec.name].T, rtol=1e-13, atol=1e-14)


def test_all_stages_run_the_same_graphs():
    program = stages()
    program.inputs = [*program.inputs, Buffer("v", 2)]
    append_cotangents(program, {"k3": "v"}, ["p"])
    calls = [call.graph for call in program.calls if call.graph.name == "stage_cotangent"]
    assert len(calls) == 3
    assert len({id(graph) for graph in calls}) == 1
    # Sines and cosines are computed once, on the way there.
    assert not {"sin", "cos"} & {node.operation for node in calls[0].nodes}


def test_an_input_that_is_overwritten_is_differentiated_as_it_was():
    """x is read, replaced, and read again; so is what depends on it."""

    def make():
        program = Program("program", [Buffer("x", 2)], [])
        program.call(trace("first", {"x": 2}, lambda x: {"y": [x[0] * x[1], x[1]]}))
        program.call(trace("second", {"y": 2}, lambda y: {"x": [y[0] * y[1], 3.0 * y[0]]}))
        program.call(trace("third", {"x": 2, "y": 2}, lambda x, y: {"sum": [x[0] * y[0], x[1] + y[1]]}))
        return program

    _, (product,), v = products(make, {"x": [2.0, 3.0]}, "sum", ["x"])
    # sum = (a^2 b^3, 3 a b + b) of x = (a, b)
    a, b = 2.0, 3.0
    expected = v @ np.array([[2 * a * b**3, 3 * a**2 * b**2], [3 * b, 3 * a + 1]])
    np.testing.assert_allclose(product, expected, rtol=1e-14)


def test_what_depends_on_nothing_has_the_product_zero():
    def make():
        program = Program("program", [Buffer("p", 2), Buffer("x", 2)], [])
        program.call(trace("graph", {"p": 2, "x": 2}, lambda p, x: {"y": [x[0] * x[1]], "z": [p[0]]}))
        return program

    inputs = {"p": [1.0, 2.0], "x": [3.0, 4.0]}
    assert products(make, inputs, "y", ["p"])[1][0].tolist() == [0.0, 0.0]
    assert_products(make, inputs, "z", ["p", "x"])


def test_the_branch_that_is_not_taken_may_be_infinite():
    def make():
        def root(p):
            return {"y": [casadi.if_else(p[0] > 0, casadi.sqrt(p[0]), 3 * p[0])]}

        program = Program("program", [Buffer("p", 1)], [])
        program.call(trace("graph", {"p": 1}, root))
        return program

    for value, slope in ((4.0, 0.25), (0.0, 3.0)):
        with np.errstate(divide="ignore", invalid="ignore"):
            _, ((product,),), v = products(make, {"p": [value]}, "y", ["p"])
        assert product == pytest.approx(slope * v[0], rel=1e-15)


def test_what_a_program_holds_is_constant():
    program = Program("program", [Buffer("p", 1), Buffer("v", 1)], [], held={"length"})
    program.call(trace("choose", {"p": 1}, lambda p: {"length": [p[0] * p[0]]}))
    program.call(trace("use", {"p": 1, "length": 1}, lambda p, length: {"y": [p[0] * length[0]]}))
    append_cotangents(program, {"y": "v"}, ["p"])
    assert evaluate_program(program, {"p": [3.0], "v": [1.0]})[f"p{COTANGENT}"].tolist() == [9.0]


@pytest.mark.parametrize(
    ("of", "by", "message"),
    [
        ({"k3": "k0"}, ["mass"], "'stages' has no input 'mass'"),
        ({"k3": "k0"}, ["k1"], "'stages' has no input 'k1'"),
        ({"end": "k0"}, ["p"], "'stages' has no buffer 'end'"),
        ({"k3": "v"}, ["p"], "'stages' has no buffer 'v'"),
    ],
)
def test_mistakes_are_named(of, by, message):
    with pytest.raises(ValueError, match=message):
        append_cotangents(stages(), of, by)


def test_a_loop_is_refused():
    program = stages()
    program.call(trace("begin", {}, lambda: {"left": [1.0]}))
    with program.repeated_while("left"):
        program.call(trace("end", {"k0": 2}, lambda k0: {"left": [0.0 * k0[0]]}))
    with pytest.raises(ValueError, match="'stages' has a loop"):
        append_cotangents(program, {"k3": "k0"}, ["p"])
