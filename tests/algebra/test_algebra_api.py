"""Every public function of the algebra, on floats, on NumPy batches and under CasADi.

The functions are found through `__all__`, their arguments chosen by parameter name: a new function is tested
here without a line, and a new parameter name fails until it is given samples.
"""

import ast
import inspect
import math
import pathlib
import re

import casadi
import numpy as np
import pytest

from dq_space_arm_env import algebra
from dq_space_arm_env.algebra import (
    dual_matrices,
    dual_quaternion,
    dual_vectors,
    poses,
    quaternion,
    rotations,
    scalars,
    screw,
    vectors,
)

pytestmark = pytest.mark.filterwarnings("error")

MODULES = (
    scalars,
    vectors,
    quaternion,
    rotations,
    dual_quaternion,
    dual_matrices,
    dual_vectors,
    poses,
    screw,
)
PUBLIC = [getattr(module, name) for module in MODULES for name in module.__all__]
FUNCTIONS = [public for public in PUBLIC if callable(public)]
BATCH = 6


def _label(function):
    return f"{function.__module__.rpartition('.')[2]}.{function.__name__}"


def _samples():
    """Return samples by kind, batch axis last: the first few are the singular points of the conversions."""
    generator = np.random.default_rng(2018)
    normal = generator.normal
    turn = math.sqrt(0.5)
    # Identity, half turns, 3-2-1 gimbal lock up and down, generic.
    unit_4 = np.array(
        [[1, 0, 0, 0], [0, 0.6, 0, 0.8], [turn, 0, turn, 0], [0.5, 0.5, -0.5, 0.5], *normal(size=(2, 4))]
    ).T
    unit_4 = unit_4 / np.linalg.norm(unit_4, axis=0)
    position = np.array([[0, 0, 0], [0, 0, 0], *normal(size=(4, 3))]).T
    unit_8 = np.array(poses.from_rotation_and_position(unit_4, position))
    twist = np.array(
        [[0] * 6, [0, 0, 0, 1, 2, 3], [1e-9, 0, 0, 0, 1, 0], [0, 0, math.pi, 1, 0, 1], *normal(size=(2, 6))]
    ).T
    axis = normal(size=(3, BATCH))
    return {
        "condition": np.array([True, False, True, False, True, False]),
        "positive": np.array([0.25, 1.0, 2.0, 1e-3, 7.0, 0.5]),
        "number": np.array([0.0, 1.0, -0.7, 0.3, 2.0, -1.5]),
        "3": position,
        "axis": axis / np.linalg.norm(axis, axis=0),
        "4": unit_4 * np.array([1.0, 2.0, 0.5, 1.0, 1.0, 3.0]),
        "unit 4": unit_4,
        "6": twist,
        "8": unit_8 * np.array([1.0, 2.0, 0.5, 1.0, 1.0, 3.0]),
        "unit 8": unit_8,
        "other unit 8": np.concatenate([unit_8[:, :2], unit_8[:, :1:-1]], axis=1),
        "rotation matrix": np.array(rotations.to_matrix(unit_4)),
        "3x3": normal(size=(3, 3, BATCH)),
        "4x4": normal(size=(4, 4, BATCH)),
        "8x8": normal(size=(8, 8, BATCH)),
    }


SAMPLES = _samples()

# The kind of each parameter, where need be by module.
KINDS = {
    **dict.fromkeys(["condition"], "condition"),
    **dict.fromkeys(["mass", "scalars.x", "scalars.y", "scalars.a", "scalars.b"], "positive"),
    **dict.fromkeys(["if_true", "if_false", "factor", "angle", "psi", "theta", "phi"], "number"),
    **dict.fromkeys(["exponent", "fraction"], "number"),
    **dict.fromkeys(["vectors.a", "vectors.b", "angular_velocity", "position", "rotation_vector"], "3"),
    **dict.fromkeys(["quaternion.v", "rotations.v", "dual_vectors.real", "dual_vectors.dual"], "3"),
    **dict.fromkeys(["axis"], "axis"),
    **dict.fromkeys(["quaternion.a", "quaternion.b", "quaternion.s"], "4"),
    **dict.fromkeys(["dual_quaternion.real", "dual_quaternion.dual"], "4"),
    **dict.fromkeys(["quaternion.q", "rotations.q", "rotation"], "unit 4"),
    **dict.fromkeys(["dual_vectors.a", "dual_vectors.b", "dual_vectors.s", "dual_quaternion.v"], "6"),
    **dict.fromkeys(["twist", "velocity"], "6"),
    **dict.fromkeys(["dual_quaternion.a", "dual_quaternion.b", "dual_quaternion.s"], "8"),
    **dict.fromkeys(["dual_matrices.a", "dual_matrices.b", "dual_matrices.s"], "8"),
    **dict.fromkeys(["dual_quaternion.q", "dual_matrices.q", "poses.q", "screw.q"], "unit 8"),
    **dict.fromkeys(["actual", "start"], "unit 8"),
    **dict.fromkeys(["desired", "end"], "other unit 8"),
    **dict.fromkeys(["rotation_matrix", "rotations.matrix", "poses.matrix"], "rotation matrix"),
    **dict.fromkeys(["vectors.matrix", "left", "right", "inertia"], "3x3"),
    **dict.fromkeys(["quaternion.matrix"], "4x4"),
    **dict.fromkeys(["dual_matrices.matrix"], "8x8"),
}


def _arguments(function):
    """Return an array for each parameter of a function, component axes first, batch axis last."""
    module = _label(function).partition(".")[0]
    names = inspect.signature(function).parameters
    return [SAMPLES[KINDS.get(f"{module}.{name}") or KINDS[name]] for name in names]


def _nested(array, leaf):
    """Return nested tuples of the components of an array, each made by `leaf`; the last axis is the batch."""
    if array.ndim == 1:
        return leaf(array)
    return tuple(_nested(row, leaf) for row in array)


def _flat(result):
    """Return the scalars of nested tuples in order."""
    if isinstance(result, tuple):
        return [scalar for part in result for scalar in _flat(part)]
    return [result]


def _call_on_floats(function, index):
    return function(*[_nested(a, lambda batch: batch[index].item()) for a in _arguments(function)])


def _expected(function):
    """Return the values on floats, shape (number of scalars returned, BATCH)."""
    return np.array([_flat(_call_on_floats(function, index)) for index in range(BATCH)]).T


@pytest.mark.parametrize("function", FUNCTIONS, ids=_label)
def test_floats(function):
    result = _call_on_floats(function, 0)
    assert all(type(scalar) is float for scalar in _flat(result))
    assert np.isfinite(_expected(function)).all()


@pytest.mark.parametrize("as_array", [False, True], ids=["tuples", "array"])
@pytest.mark.parametrize("function", FUNCTIONS, ids=_label)
def test_numpy_batches(function, as_array):
    arguments = _arguments(function)
    if not as_array:
        arguments = [_nested(a, lambda batch: batch) for a in arguments]
    with np.errstate(divide="raise", invalid="raise", over="raise"):
        result = _flat(function(*arguments))
    batches = np.array([np.broadcast_to(scalar, BATCH) for scalar in result])
    np.testing.assert_allclose(batches, _expected(function), rtol=1e-14, atol=1e-15)


@pytest.mark.parametrize("function", FUNCTIONS, ids=_label)
def test_casadi(function):
    symbols = []

    def new_symbol(_):
        symbols.append(casadi.SX.sym(f"x{len(symbols)}"))
        return symbols[-1]

    outputs = casadi.vertcat(*_flat(function(*[_nested(a, new_symbol) for a in _arguments(function)])))
    inputs = casadi.vertcat(*symbols)
    traced = casadi.Function("traced", [inputs], [outputs])
    jacobian = casadi.Function("jacobian", [inputs], [casadi.jacobian(outputs, inputs)])
    values = np.concatenate([np.reshape(a, (-1, BATCH)) for a in _arguments(function)]).astype(float)
    np.testing.assert_allclose(traced(values).full(), _expected(function), rtol=1e-14, atol=1e-15)
    assert np.isfinite(jacobian(values).full()).all()


@pytest.mark.parametrize("function", FUNCTIONS, ids=_label)
def test_docstring_gives_shapes(function):
    """As many shapes as there are parameters, in the manner of NumPy's signatures."""
    if function.__module__ != scalars.__name__:
        shape = r"\([\d, ]*\)"
        count = len(inspect.signature(function).parameters)
        assert re.search(rf"{shape}(, {shape}){{{count - 1}}}\s->\s{shape}", function.__doc__)


def test_import_is_light():
    """At import, the algebra needs only NumPy and the standard library; `symbolic` is CasADi's side of it."""
    imported = set()
    for path in pathlib.Path(algebra.__file__).parent.glob("*.py"):
        if path.stem == "symbolic":
            continue
        for node in ast.parse(path.read_text()).body:
            if isinstance(node, ast.Import):
                imported |= {alias.name for alias in node.names}
            if isinstance(node, ast.ImportFrom):
                imported.add(node.module)
    foreign = {name for name in imported if not name.startswith("dq_space_arm_env.algebra")}
    assert foreign <= {"collections.abc", "functools", "inspect", "math", "numpy", "sys", "types", "typing"}


def test_unknown_scalar_is_refused():
    with pytest.raises(TypeError, match=r"scalars\.sin got a str: 'north'\. A scalar must be a number"):
        scalars.sin("north")


class TestStructuralZeros:
    """What is constant in the arguments leaves no operation in the trace."""

    symbols = tuple(casadi.SX.sym(f"s{i}") for i in range(8))

    def operations(self, outputs):
        trace = casadi.Function("trace", list(self.symbols), [casadi.vertcat(*outputs)])
        moves = {casadi.OP_INPUT, casadi.OP_OUTPUT, casadi.OP_CONST}
        return sum(trace.instruction_id(i) not in moves for i in range(trace.n_instructions()))

    def test_identity_factor(self):
        for product in (
            dual_quaternion.multiply(dual_quaternion.IDENTITY, self.symbols),
            dual_quaternion.multiply(self.symbols, dual_quaternion.IDENTITY),
            dual_quaternion.adjoint(dual_quaternion.IDENTITY, self.symbols),
            dual_matrices.matrix_multiply(
                dual_matrices.adjoint_matrix(dual_quaternion.IDENTITY), self.symbols
            ),
        ):
            assert all(casadi.is_equal(a, b) for a, b in zip(product, self.symbols, strict=True))

    def test_zero_factor(self):
        product = dual_quaternion.multiply(dual_quaternion.ZERO, self.symbols)
        assert all(casadi.SX(scalar).is_zero() for scalar in product)

    def test_transform_along_z(self):
        """With R = 1 and p = (0, 0, d), R a and R b + p x R a take 2 products and 2 sums."""
        identity = ((1.0, 0.0, 0.0), (0.0, 1.0, 0.0), (0.0, 0.0, 1.0))
        assert self.operations(dual_vectors.transform(identity, (0.0, 0.0, 0.6), self.symbols[:6])) == 4

    def test_exponential_of_a_revolute_joint(self):
        pose = screw.exponential((0.0, 0.0, self.symbols[0], 0.0, 0.0, 0.0))
        assert [casadi.SX(scalar).is_zero() for scalar in pose] == [False, True, True, False] + [True] * 4


def test_select_does_not_warn_and_broadcasts():
    chosen = scalars.select(np.array([True, False, True]), np.array([1.0, np.nan, 3.0]), 0.0)
    np.testing.assert_array_equal(chosen, [1.0, 0.0, 3.0])
