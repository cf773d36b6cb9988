"""Machine code: operations against NumPy and mpmath, lanes against scalars, rows, instructions."""

import platform
import threading

import casadi
import mpmath
import numpy as np
import pytest
from graph_interpreter import evaluate_graph

from dq_space_arm_env.compiler import emit, native
from dq_space_arm_env.compiler.build import assembly, build_program
from dq_space_arm_env.compiler.cotangent import append_cotangents
from dq_space_arm_env.compiler.graph import trace
from dq_space_arm_env.compiler.program import Buffer, Program
from dq_space_arm_env.compiler.tangent import append_tangents

LANES = (1, native.host_machine().lanes)
EPS = np.finfo(float).eps
PRECISIONS = ("float64", "float32")
EVERY_CODE = [(lanes * (2 if p == "float32" and lanes > 1 else 1), p) for p in PRECISIONS for lanes in LANES]


def program_of(function, outputs, **sizes):
    graph = trace("graph", sizes, function)
    program = Program("program", [Buffer(*item) for item in sizes.items()], outputs)
    program.call(graph)
    return program


def run(program, lanes, rows, *arrays, precision="float64"):
    kernel = native.NativeKernel(program.name, *build_program(program, lanes, precision))
    buffers = np.array([array.ctypes.data for array in arrays], dtype=np.int64)
    kernel.function(0, rows, buffers.ctypes.data)


def evaluate(function, size_out, lanes, x, precision="float64"):
    program = program_of(function, [Buffer("y", size_out)], x=x.shape[1])
    y = np.zeros((len(x), size_out), precision)
    run(program, lanes, len(x), np.ascontiguousarray(x, precision), y, precision=precision)
    return y


def test_an_input_that_no_call_reads_is_not_loaded():
    def loads(inputs):
        program = Program("program", inputs, [Buffer("y", 1)])
        program.call(trace("graph", {"x": 2}, lambda x: {"y": [x[0] + x[1]]}))
        return assembly(program, 1).count(" load ")

    x, unread = Buffer("x", 2), Buffer("unread", 3)
    assert loads([x, unread]) == loads([x]) + 1, "its address"


def everything(x):
    a, b, c = x
    smaller, both, either = a < b, casadi.logic_and(a < b, b <= c), casadi.logic_or(a == b, a != c)
    arithmetic = [a + b, a - b, a * b + c, c - a * b, a * b - c, a / b, -a, a * a, 2 * a, 1 / a]
    functions = [
        casadi.sqrt(casadi.fabs(a)),
        casadi.fabs(c),
        casadi.sin(a) * casadi.cos(a),
        casadi.atan2(a, b),
    ]
    choices = [
        smaller + 1.0,
        casadi.fmin(a, b),
        casadi.fmax(a, b),
        casadi.if_else(smaller, a, b),
        casadi.if_else(both, a, b * c),
        casadi.if_else(either, a + 1, b + 2),
        casadi.if_else(casadi.logic_not(smaller), a, c),
    ]
    return {"y": arithmetic + functions + choices}


@pytest.mark.parametrize(("lanes", "precision"), EVERY_CODE)
def test_every_operation_agrees_with_numpy(lanes, precision):
    x = np.random.default_rng(0).normal(size=(100, 3)).astype(precision)
    x[:10, 1] = x[:10, 0]
    graph = trace("graph", {"x": 3}, everything)
    expected = np.array([evaluate_graph(graph, [row.astype(float)], np.float64)[0] for row in x])
    eps = np.finfo(precision).eps
    # Differences of products lose what cancels: their error is relative to the products.
    found = evaluate(everything, expected.shape[1], lanes, x, precision)
    np.testing.assert_allclose(found, expected, rtol=18 * eps, atol=2 * eps)


@pytest.mark.parametrize("lanes", LANES)
def test_a_function_in_blocks_computes_the_same_bits(lanes, monkeypatch):
    x = np.random.default_rng(0).normal(size=(100, 3))
    size = len(everything(casadi.SX.sym("x", 3).elements())["y"])
    whole = evaluate(everything, size, lanes, x)
    monkeypatch.setattr(emit, "_LARGE_GRAPH", 10)
    monkeypatch.setattr(emit, "_LONGEST_BLOCK", 3)
    np.testing.assert_array_equal(evaluate(everything, size, lanes, x), whole)


def of_the_library(x):
    """Functions that the C library computes, each within its domain; |x| < 1."""
    names = ("exp", "log", "tan", "asin", "acos", "sinh", "cosh", "tanh", "asinh", "acosh", "atanh")
    shifted = {"log": x[0] + 1.5, "acosh": x[0] + 2.5}
    functions = [getattr(casadi, name)(shifted.get(name, x[0])) for name in names]
    powers = [(x[0] + 1.5) ** x[1], (x[0] + 1.5) ** 2.5, x[0] ** 3, casadi.log1p(x[1]), casadi.expm1(x[1])]
    return {"y": [*functions, *powers, casadi.atan(3.0 * x[1]), casadi.sign(x[1]), casadi.floor(4.0 * x[1])]}


@pytest.mark.parametrize("precision", PRECISIONS)
def test_functions_of_the_library_agree_with_numpy_and_lanes_with_scalars(precision):
    x = np.random.default_rng(0).uniform(-0.9, 0.9, size=(21, 2)).astype(precision)
    x[0, 1] = 0.0
    graph = trace("graph", {"x": 2}, of_the_library)
    expected = np.array([evaluate_graph(graph, [row.astype(float)], np.float64)[0] for row in x])
    size = expected.shape[1]
    one, many = (evaluate(of_the_library, size, lanes, x, p) for lanes, p in EVERY_CODE if p == precision)
    np.testing.assert_array_equal(one, many)
    np.testing.assert_allclose(one, expected, rtol=20 * np.finfo(precision).eps, atol=0.0)


@pytest.mark.parametrize("precision", PRECISIONS)
@pytest.mark.parametrize("rows", [1, 2, 7, 8, 9, 16, 23, 33])
def test_lanes_give_the_bits_of_the_scalar_code(rows, precision):
    x = np.random.default_rng(rows).normal(size=(rows, 3)) * 10.0 ** np.arange(-2, 4, 2)
    scalar, vector = (evaluate(everything, 21, lanes, x, p) for lanes, p in EVERY_CODE if p == precision)
    np.testing.assert_array_equal(scalar, vector)


def angles():
    rng = np.random.default_rng(0)
    spread = rng.choice([-1, 1], 4000) * 10.0 ** rng.uniform(-300, 6, 4000)
    near_zeros = np.arange(-300, 300) * (np.pi / 2) * (1 + rng.choice([0, 1, -1], 600) * EPS)
    return np.concatenate([spread, near_zeros, [0.0, 5e-324, 1e6, -1e6]])[:, None]


@pytest.mark.parametrize("lanes", LANES)
def test_sine_and_cosine_are_right_to_the_last_place_up_to_1e6(lanes):
    x = angles()
    y = evaluate(lambda x: {"y": [casadi.sin(x[0]), casadi.cos(x[0])]}, 2, lanes, x)
    with mpmath.workdps(60):
        for (angle,), (sine, cosine) in zip(x, y, strict=True):
            for value, exact in ((sine, mpmath.sin(angle)), (cosine, mpmath.cos(angle))):
                # 1e-27: what three pieces of pi/2 leave where the function nearly vanishes at large angles.
                tolerance = 1.5 * EPS * abs(exact) + 1e-27 * (1 + abs(angle)) + 5e-324
                assert abs(value - exact) <= tolerance, angle


@pytest.mark.parametrize(("lanes", "precision"), [code for code in EVERY_CODE if code[1] == "float32"])
def test_single_precision_functions_are_right_to_the_last_places(lanes, precision):
    rng = np.random.default_rng(3)
    x = (rng.choice([-1, 1], 4000) * 10.0 ** rng.uniform(-30, np.log10(6e3), 4000)).astype(np.float32)
    y = rng.normal(size=4000).astype(np.float32)
    columns = lambda x: {"y": [casadi.sin(x[0]), casadi.cos(x[0]), casadi.atan2(x[1], x[0])]}  # noqa: E731
    values = evaluate(columns, 3, lanes, np.column_stack([x, y]), precision)
    wide = x.astype(float)
    exact = np.column_stack([np.sin(wide), np.cos(wide), np.arctan2(y, wide)])
    eps = np.finfo(np.float32).eps
    # 2e-14: what three pieces of pi/2 leave where the function nearly vanishes at large angles.
    assert (np.abs(values - exact) <= 3 * eps * np.abs(exact) + 2e-14 * (1 + np.abs(x[:, None]))).all()


@pytest.mark.parametrize("lanes", LANES)
def test_arctangent_is_right_in_all_quadrants(lanes):
    rng = np.random.default_rng(1)
    x = rng.normal(size=(3000, 2)) * 10.0 ** rng.uniform(-150, 150, (3000, 2))
    x = np.concatenate([x, rng.normal(size=(3000, 2)), [[0.0, 1.0], [1.0, 0.0], [-1.0, 0.0], [0.0, 0.0]]])
    y = evaluate(lambda x: {"y": [casadi.atan2(x[0], x[1])]}, 1, lanes, x)[:, 0]
    with mpmath.workdps(40):
        exact = np.array([float(mpmath.atan2(*row)) for row in x])
    assert np.max(np.abs(y - exact) / np.maximum(np.abs(exact), 1e-300)) < 3 * EPS


@pytest.mark.parametrize("lanes", LANES)
def test_nan_and_infinity_pass_through(lanes):
    x = np.array([[np.nan], [np.inf], [-np.inf]])
    columns = lambda x: {"y": [casadi.sin(x[0]), casadi.cos(x[0]), x[0] * 2, casadi.sqrt(x[0])]}  # noqa: E731
    y = evaluate(columns, 4, lanes, x)
    assert np.isnan(y[:, :2]).all()
    assert np.isnan(y[0]).all()
    assert y[1:, 2].tolist() == [np.inf, -np.inf]
    assert y[1, 3] == np.inf


@pytest.mark.parametrize("lanes", LANES)
def test_all_rows_read_a_shared_input_and_scatter_into_runs_of_every_length(lanes):
    places = [i for first, end in ((1, 2), (4, 7), (9, 17), (20, 31)) for i in range(first, end)]
    order = np.random.default_rng(3).permutation(places)
    outputs = [Buffer("y", len(order), positions=tuple(order.tolist()), stride=33)]
    program = Program("program", [Buffer("x", len(order)), Buffer("h", 1, shared=True)], outputs)
    sizes = {"x": len(order), "h": 1}
    program.call(trace("graph", sizes, lambda x, h: {"y": [h[0] * entry for entry in x]}))
    x, h, y = np.random.default_rng(4).normal(size=(19, len(order))), np.array([0.3]), np.full((19, 33), 9.0)
    run(program, lanes, 19, x, h, y)
    expected = np.full((19, 33), 9.0)
    expected[:, order] = 0.3 * x
    np.testing.assert_array_equal(y, expected)


@pytest.mark.sampled
@pytest.mark.parametrize(("lanes", "precision"), EVERY_CODE)
@pytest.mark.parametrize("dtype", ["", "float64", "float32", "bool"])
def test_rows_of_every_size_and_type_pass_through_registers(lanes, precision, dtype):
    kind = dtype or precision
    for size in range(1, 2 * lanes + 4, 1 if lanes == 1 else 3):
        graph = trace("graph", {"x": size}, lambda x: {"y": list(x), "z": list(x)})
        outputs = [Buffer("y", size, dtype=dtype), Buffer("z", size, dtype=dtype, by_column=True)]
        program = Program("program", [Buffer("x", size, dtype=dtype)], outputs)
        program.call(graph)
        kernel = native.NativeKernel(program.name, *build_program(program, lanes, precision))
        rows = lanes + 3
        x = np.random.default_rng(size).integers(0, 2, (rows + 2, size)).astype(kind)
        y, z = np.full((rows + 2, size), 7, kind), np.full((size, rows + 2), 7, kind)
        buffers = np.array([x.ctypes.data, y.ctypes.data, z.ctypes.data, rows + 2], dtype=np.int64)
        kernel.function(1, rows + 1, buffers.ctypes.data)
        inside = slice(1, rows + 1)
        np.testing.assert_array_equal(y[inside], x[inside])
        np.testing.assert_array_equal(z[:, inside], x[inside].T)
        untouched = np.array(7).astype(kind)
        assert (y[[0, -1]] == untouched).all()
        assert (z[:, [0, -1]] == untouched).all()


@pytest.mark.parametrize(("lanes", "precision"), EVERY_CODE)
@pytest.mark.parametrize("count", [0, 1, 5, 19])
def test_an_indexed_program_works_on_the_rows_of_its_list(lanes, precision, count):
    graph = trace("graph", {"x": 3}, lambda x: {"y": [2 * entry for entry in x], "z": x})
    outputs = [Buffer("y", 3), Buffer("z", 3, by_column=True)]
    program = Program("program", [Buffer("x", 3)], outputs, indexed=True)
    program.call(graph)
    kernel = native.NativeKernel(program.name, *build_program(program, lanes, precision))
    x = np.arange(60).reshape(20, 3).astype(precision)
    y, z = np.full((20, 3), -1, precision), np.full((3, 20), -1, precision)
    rows = np.random.default_rng(count).permutation(20)[:count]
    buffers = np.array([rows.ctypes.data, x.ctypes.data, y.ctypes.data, z.ctypes.data, 20], dtype=np.int64)
    kernel.function(0, count, buffers.ctypes.data)
    np.testing.assert_array_equal(y[rows], 2 * x[rows])
    np.testing.assert_array_equal(z[:, rows], x[rows].T)
    assert (np.delete(y, rows, axis=0) == -1).all()
    assert (np.delete(z, rows, axis=1) == -1).all()


def test_calls_share_code_and_scratch_starts_as_zero():
    total = trace("total", {"sum": 1, "x": 1}, lambda sum, x: {"next": [sum[0] + x[0]]})
    program = Program("program", [Buffer("x", 1)], [Buffer("c", 1)])
    program.call(total, sum="a", next="b")
    program.call(total, sum="b", next="c")
    for lanes in LANES:
        x, y = np.arange(9.0)[:, None].copy(), np.zeros((9, 1))
        run(program, lanes, 9, x, y)
        np.testing.assert_array_equal(y, 2 * x)
    assert program.operation_count == 2
    assert assembly(program, 1).count("define internal") == 1


def test_one_graph_traced_twice_is_compiled_once():
    program = Program("program", [Buffer("x", 1)], [Buffer("c", 1)])
    for source, target in (("x", "b"), ("b", "c")):
        graph = trace("kept", {"a": 1}, lambda a: {"kept": [casadi.if_else(a[0] > 0.0, a[0], np.nan)]})
        program.call(graph, a=source, kept=target)
    assert assembly(program, 1).count("define internal") == 1


@pytest.mark.parametrize("use", [build_program, append_tangents, append_cotangents])
def test_calls_of_two_graphs_of_one_name_are_refused(use):
    """The function of a name is that of its first graph, so the second would compute what the first does."""
    program = Program("program", [Buffer("x", 1)], [Buffer("y", 1)])
    for factor, source, target in ((2.0, "x", "a"), (2.0, "a", "b"), (3.0, "b", "y")):
        graph = trace("scaled", {"x": 1}, lambda x, factor=factor: {"y": [factor * x[0]]})
        program.call(graph, x=source, y=target)
    given = {build_program: [1], append_tangents: [["x"], "y"], append_cotangents: [{"y": "x"}, ["x"]]}
    with pytest.raises(ValueError, match="calls of two graphs named 'scaled', should have"):
        use(program, *given[use])


def test_programs_that_need_more_memory_than_a_small_stack_run_on_it():
    lanes = native.host_machine().lanes
    size = 2**18 // (8 * lanes) + 1
    spread = trace("spread", {"x": 1}, lambda x: {"a": [x[0]] * size})
    gathered = trace("gathered", {"a": size}, lambda a: {"y": [a[0] + a[size - 1]]})
    program = Program("program", [Buffer("x", 1)], [Buffer("y", 1)])
    program.call(spread)
    program.call(gathered)
    x, y = np.arange(9.0)[:, None].copy(), np.zeros((9, 1))
    before = threading.stack_size(2**18)
    try:
        thread = threading.Thread(target=run, args=(program, lanes, 9, x, y))
        thread.start()
        thread.join()
    finally:
        threading.stack_size(before)
    np.testing.assert_array_equal(y, 2 * x)


def test_calls_that_disagree_on_a_size_are_refused():
    graph = trace("graph", {"x": 3}, lambda x: {"y": [x[0]]})
    program = Program("program", [Buffer("x", 2)], [Buffer("y", 1)])
    program.call(graph)
    with pytest.raises(ValueError, match="'graph' takes 3 scalars for 'x', buffer 'x' has 2"):
        build_program(program, 1)


@pytest.mark.skipif(platform.machine() not in ("x86_64", "AMD64"), reason="names of x86 registers")
@pytest.mark.parametrize(("precision", "suffix"), [("float64", "pd"), ("float32", "ps")])
def test_batches_use_the_widest_vector_registers_and_call_no_library(precision, suffix):
    lanes = native.host_machine().lanes
    register = {8: "zmm", 4: "ymm", 2: "xmm"}[lanes]
    program = program_of(everything, [Buffer("y", 21)], x=3)
    wide = lanes if precision == "float64" else 2 * lanes
    module, machine = native._optimized(assembly(program, wide, precision))
    instructions = machine.emit_assembly(module)
    packed = [line for line in instructions.splitlines() if suffix in line and register in line]
    assert len(packed) > 50
    calls = [line for line in instructions.splitlines() if "call" in line.split("#")[0].split()]
    assert all("graph" in line for line in calls), calls
