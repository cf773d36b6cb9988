"""Tangent programs: derivatives of programs against complex steps, and which calls they are made of."""

import math

import casadi
import numpy as np
import pytest
from graph_interpreter import evaluate_program
from random_programs import random_program
from test_compiler_native import of_the_library

from dq_space_arm_env.compiler import native
from dq_space_arm_env.compiler.build import build_program
from dq_space_arm_env.compiler.graph import trace
from dq_space_arm_env.compiler.program import Buffer, Program
from dq_space_arm_env.compiler.tangent import append_for_each, append_matrix, append_tangents
from dq_space_arm_env.kernels.bound import BoundKernel

H = 1e-30  # a complex step has no cancellation: any size works


def complex_steps(program, inputs, by, of):
    """Derivatives (m, n) of a buffer by the entries of an input."""
    n = len(inputs[by])
    lanes = {name: np.repeat(np.array(value)[:, None], n, axis=1) for name, value in inputs.items()}
    lanes[by] = lanes[by] + 1j * H * np.eye(n)
    return evaluate_program(program, lanes, np.complex128, frozen=program.held)[of].imag / H


def with_matrix(program, by, of):
    """Append the derivative of a buffer as output `matrix`."""
    sizes = program.scratch_sizes()
    tangents = append_tangents(program, [by], of)
    append_matrix(program, tangents, (sizes[of], sizes[by]), "matrix")
    program.outputs = [*program.outputs, Buffer("matrix", sizes[of] * sizes[by])]
    return program


def derivatives(program, inputs, by, of):
    """Values and derivatives (m, n) by a tangent program, interpreted."""
    size = program.scratch_sizes()[of]
    buffers = evaluate_program(with_matrix(program, by, of), inputs)
    return buffers[of], buffers["matrix"].reshape(size, -1)


def assert_derivatives(make, inputs, by, of, rtol=1e-12):
    expected = complex_steps(make(), inputs, by, of)
    values, actual = derivatives(make(), inputs, by, of)
    plain = evaluate_program(make(), inputs)[of]
    np.testing.assert_allclose(values, plain, rtol=1e-9, atol=1e-12)
    np.testing.assert_allclose(actual, expected, rtol=rtol, atol=rtol * np.abs(expected).max(initial=0.0))


# Against complex steps ------------------------------------------------------------------------------------


def test_functions_of_the_library():
    def program():
        graph = trace("graph", {"x": 2}, of_the_library)
        program = Program("program", [Buffer("x", 2)], [])
        program.call(graph)
        return program

    for x in np.random.default_rng(0).uniform(-0.9, 0.9, size=(4, 2)):
        assert_derivatives(program, {"x": x}, "x", "y")


def everything(x, p):
    a, b, c = x[0], x[1] * p[0], x[2] + p[1] * p[1]
    smaller = a < b
    return [
        a + b * c,
        c - a / b,
        1 / c,
        -b + 2 * c,
        casadi.sqrt(casadi.fabs(b)) * casadi.fabs(c),
        casadi.sin(b) * casadi.cos(c),
        casadi.atan2(b, c),
        casadi.fmin(a, b) - casadi.fmax(b, c),
        casadi.if_else(smaller, b * b, c),
        casadi.if_else(casadi.logic_or(smaller, b == c), a, casadi.sin(b)),
        casadi.if_else(casadi.logic_and(b <= c, a != c), b, c) + smaller,
        casadi.if_else(casadi.logic_not(smaller), 0.0, b),
    ]


@pytest.mark.parametrize("by", ["x", "p"])
@pytest.mark.parametrize("seed", range(4))
def test_every_operation_is_differentiated(seed, by):
    graph = trace("graph", {"x": 3, "p": 2}, lambda x, p: {"y": everything(x, p)})

    def make():
        program = Program("program", [Buffer("x", 3), Buffer("p", 2)], [Buffer("y", 12)])
        program.call(graph)
        return program

    rng = np.random.default_rng(seed)
    inputs = {"x": rng.normal(size=3), "p": rng.normal(size=2)}
    assert_derivatives(make, inputs, by, "y")


@pytest.mark.parametrize("of", ["y2", "y4", "sum"])
@pytest.mark.parametrize("seed", range(12))
def test_random_programs_with_loops(seed, of):
    rng = np.random.default_rng(seed)
    inputs = {"p": rng.normal(size=3), "x": rng.normal(size=3)}
    with np.errstate(all="ignore"):
        expected = complex_steps(random_program(np.random.default_rng(seed)), inputs, "p", of)
        values, actual = derivatives(random_program(np.random.default_rng(seed)), inputs, "p", of)
        # Long random chains amplify rounding, and run into 1 / 0.
        kept = np.isfinite(values) & (np.abs(expected).max(axis=1) < 1e6)
        np.testing.assert_allclose(actual[kept], expected[kept], rtol=1e-8, atol=1e-8)


@pytest.mark.parametrize("lanes", [1, native.host_machine().lanes])
def test_machine_code_agrees_with_the_interpreter(lanes):
    program = with_matrix(stages(), "p", "k3")
    rows = np.random.default_rng(0).normal(size=(2, 11, 2))
    inputs = dict(zip(("p", "k0"), rows, strict=True))
    kernel = BoundKernel(native.NativeKernel("stages", *build_program(program, lanes)))
    values, matrix = np.zeros((11, 2)), np.zeros((11, 4))
    kernel([inputs["p"], inputs["k0"], values, matrix], 11)
    buffers = evaluate_program(program, {name: array.T for name, array in inputs.items()})
    np.testing.assert_allclose(matrix, buffers["matrix"].T, rtol=1e-13, atol=1e-14)


# Which calls ----------------------------------------------------------------------------------------------


def stages():
    def stage(p, k):
        return {"k_next": [casadi.sin(p[0]) * k[0] + k[1], casadi.cos(k[0] * p[1])], "unused": [k[0] * p[0]]}

    graph = trace("stage", {"p": 2, "k": 2}, stage)
    program = Program("stages", [Buffer("p", 2), Buffer("k0", 2)], [Buffer("k3", 2)])
    for number in range(3):
        program.call(graph, k=f"k{number}", k_next=f"k{number + 1}", unused="unused")
    return program


def test_all_directions_and_stages_run_the_same_graph():
    program = stages()
    assert append_tangents(program, ["p"], "k3") == ("k3.0", "k3.1")
    calls = [call for call in program.calls if call.graph.name == "stage_tangent"]
    assert len(calls) == 6
    assert len({id(call.graph) for call in calls}) == 1
    # A result that no one wants is not differentiated.
    assert [name for name, _ in calls[0].graph.outputs] == ["k_next.tangent"]
    # Sines and cosines are computed once for all directions.
    assert {node.operation for node in calls[0].graph.nodes} <= {
        "input",
        "negate",
        "add",
        "subtract",
        "multiply",
    }


def test_calls_without_tangents_are_left_as_they_are():
    program = stages()
    before = list(program.calls)
    program.call(trace("other", {"k0": 2}, lambda k0: {"y": [k0[0] * k0[1]]}))
    other = program.calls[-1]
    assert append_tangents(program, ["p"], "y") is None
    assert program.calls == [*before, other]
    append_matrix(program, None, (1, 2), "matrix")
    program.outputs = [Buffer("matrix", 2)]
    assert evaluate_program(program, {"p": [1.0, 2.0], "k0": [3.0, 4.0]})["matrix"].tolist() == [0.0, 0.0]


def test_conditions_have_no_derivative():
    graph = trace("graph", {"p": 1, "x": 1}, lambda p, x: {"y": [casadi.if_else(p[0] < 1, x[0], -x[0])]})
    program = Program("program", [Buffer("p", 1), Buffer("x", 1)], [Buffer("y", 1)])
    program.call(graph)
    assert append_tangents(program, ["p"], "y") is None


def test_the_branch_that_is_not_taken_may_be_infinite():
    def make():
        def root(p):
            return {"y": [casadi.if_else(p[0] > 0, casadi.sqrt(p[0]), 3 * p[0])]}

        program = Program("program", [Buffer("p", 1)], [Buffer("y", 1)])
        program.call(trace("graph", {"p": 1}, root))
        return program

    for value, slope in ((4.0, 0.25), (0.0, 3.0)):
        with np.errstate(divide="ignore"):
            assert derivatives(make(), {"p": [value]}, "p", "y")[1].tolist() == [[slope]]


def test_a_buffer_written_again_loses_its_tangents():
    """`y` depends on p at first, then not, then on what it was."""

    def make():
        program = Program("program", [Buffer("p", 2), Buffer("x", 2)], [Buffer("sum", 2)])
        program.call(trace("first", {"p": 2}, lambda p: {"y": [p[0] * p[1], p[1]]}))
        program.call(trace("keep", {"y": 2}, lambda y: {"kept": [y[0] * y[1], y[0]]}))
        program.call(trace("second", {"x": 2}, lambda x: {"y": x}))
        add = trace("add", {"y": 2, "kept": 2}, lambda y, kept: {"sum": [y[0] * kept[0], y[1] + kept[1]]})
        program.call(add)
        return program

    assert_derivatives(make, {"p": [2.0, 3.0], "x": [5.0, 7.0]}, "p", "sum")


def test_a_graph_maps_the_tangents_and_the_matrix_has_one_row_per_number():
    program = stages()
    tangents = append_tangents(program, ["p"], "k3")
    sums = trace("sums", {"d": 2, "k0": 2}, lambda d, k0: {"s": [d[0] + d[1], d[0] * k0[0], d[1] - d[0]]})
    mapped = append_for_each(program, sums, "d", tangents, "mapped")
    assert mapped == ("mapped.0", "mapped.1")
    append_matrix(program, mapped, (3, 2), "matrix")
    program.outputs = [Buffer("matrix", 6)]
    inputs = {"p": [0.3, 0.7], "k0": [1.5, -0.4]}
    slope = complex_steps(stages(), inputs, "p", "k3")
    expected = np.array([slope[0] + slope[1], slope[0] * 1.5, slope[1] - slope[0]])
    np.testing.assert_allclose(
        evaluate_program(program, inputs)["matrix"].reshape(3, 2), expected, rtol=1e-13
    )


@pytest.mark.parametrize(
    ("by", "of", "message"),
    [
        ("mass", "k3", "'stages' has no input 'mass' of float numbers"),
        ("k1", "k3", "'stages' has no input 'k1'"),
        ("flag", "k3", "'stages' has no input 'flag' of float numbers"),
        ("p", "end", "'stages' has no buffer 'end'"),
        ("k0", "k3", "'stages': 'back' overwrites 'k0'"),
    ],
)
def test_mistakes_are_named(by, of, message):
    program = stages()
    program.inputs = [*program.inputs, Buffer("flag", 1, dtype="bool")]
    program.call(trace("back", {"k3": 2}, lambda k3: {"k0": k3}))
    with pytest.raises(ValueError, match=message):
        append_tangents(program, [by], of)


def test_a_program_with_tangents_is_refused():
    program = stages()
    append_tangents(program, ["p"], "k3")
    with pytest.raises(ValueError, match="'stages' has tangents already"):
        append_tangents(program, ["p"], "k3")


# Loops ----------------------------------------------------------------------------------------------------


def fixed_point(extra=0):
    """x = cos(p x) by iteration, and a few passes after it has converged."""

    def following(p, x):
        return {"next": [casadi.cos(p[0] * x[0])]}

    def move(next, x):
        return {"x": next, "unfinished": [casadi.fabs(next[0] - x[0]) > 1e-3]}

    step = trace("following", {"p": 1, "x": 1}, following)
    program = Program("iteration", [Buffer("p", 1)], [Buffer("x", 1)])
    program.call(trace("begin", {}, lambda: {"x": [0.5]}))
    with program.repeated_while("unfinished"):
        program.call(step)
        # A graph may not write where it reads.
        program.call(
            trace(
                "compare",
                {"next": 1, "x": 1},
                lambda next, x: {"y": move(next, x)["x"], "z": move(next, x)["unfinished"]},
            )
        )
        program.call(trace("move", {"y": 1, "z": 1}, lambda y, z: {"x": y, "unfinished": z}))
    for number in range(extra):
        old, new = ("x" if number == 0 else f"x{number}"), f"x{number + 1}"
        program.call(step, x=old, next=new)
    return program


def test_a_loop_gives_the_derivative_of_the_passes_taken():
    assert_derivatives(fixed_point, {"p": [0.6]}, "p", "x")


def test_passes_after_a_fixed_point_make_its_derivative_exact():
    (x,), ((slope,),) = derivatives(fixed_point(60), {"p": [0.6]}, "p", "x60")
    assert math.isclose(x, math.cos(0.6 * x), rel_tol=1e-15)
    # dx = -sin(p x) (x dp + p dx)
    s = math.sin(0.6 * x)
    assert math.isclose(slope, -s * x / (1 + 0.6 * s), rel_tol=1e-13)
    (_, ((early,),)) = derivatives(fixed_point(), {"p": [0.6]}, "p", "x")
    assert not math.isclose(early, slope, rel_tol=1e-5)


def test_what_a_program_holds_is_constant():
    def make():
        program = Program("program", [Buffer("p", 1)], [Buffer("y", 1)], held={"length"})
        program.call(trace("choose", {"p": 1}, lambda p: {"length": [p[0] * p[0]]}))
        program.call(trace("use", {"p": 1, "length": 1}, lambda p, length: {"y": [p[0] * length[0]]}))
        return program

    assert derivatives(make(), {"p": [3.0]}, "p", "y")[1].tolist() == [[9.0]]
    assert_derivatives(make, {"p": [3.0]}, "p", "y")
