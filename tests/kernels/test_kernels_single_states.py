"""Calls on single states: prepared arrays give the results, errors and bits of any other call."""

import copy
import pickle

import numpy as np
import pytest

from dq_space_arm_env import Kernels, compile_scene, load_scene
from dq_space_arm_env.scene import Spread

FORMS = {
    "list": lambda row: row.tolist(),
    "strided": lambda row: np.repeat(row, 2)[::2],
    "read-only": lambda row: np.frombuffer(row.tobytes()),
    "big-endian": lambda row: row.astype(">f8"),
    "unaligned": lambda row: np.frombuffer(b"." + row.tobytes(), offset=1),
    "object of a subclass": lambda row: row.view(type("Subclass", (np.ndarray,), {})),
}


def functions(kernels):
    """Functions of state and input, of one output or two."""
    return (
        kernels.step,
        kernels.forward_dynamics,
        kernels.linearize,
        kernels.cost,
        lambda x, u: kernels.step(x, u, 0.01, "symplectic_euler"),
        lambda x, u: kernels.observation(x, np.ones(1)),
    )


def numbers(results):
    """All numbers of an output, or of several."""
    return np.concatenate(
        [np.ravel(result) for result in (results if isinstance(results, tuple) else (results,))]
    )


@pytest.mark.parametrize("form", FORMS)
def test_arguments_of_any_form_give_the_same_bits(form, draw):
    kernels, states, inputs = draw("paper", 1)
    x, u = states[0], inputs[0]
    for function in functions(kernels):
        function(x, u)
        expected = numbers(function(x, u))
        np.testing.assert_array_equal(numbers(function(FORMS[form](x), FORMS[form](u))), expected)
        np.testing.assert_array_equal(numbers(function(x[None], u[None])), expected)


def test_single_precision_takes_both_precisions(draw):
    kernels, states, inputs = draw(load_scene("paper").replace(simulation={"precision": "float32"}), 1)
    x, u = states[0].astype(np.float32), inputs[0].astype(np.float32)
    for function in (kernels.step, kernels.forward_dynamics):
        expected = function(x, u)
        assert expected.dtype == np.float32
        for other in ((x, u), (x.astype(float), u), (x.astype(float), u.astype(float))):
            np.testing.assert_array_equal(function(*other), expected)


def test_numbers_that_are_not_finite_pass_through(draw):
    kernels, states, inputs = draw("paper", 1)
    x, u = states[0], inputs[0].copy()
    for bad in (np.nan, np.inf):
        u[0] = bad
        np.testing.assert_array_equal(kernels.step(x, u), kernels.step(x.tolist(), u.tolist()))
    assert np.isfinite(kernels.step(x, inputs[0])).all()


def test_results_are_the_callers(draw):
    kernels, states, inputs = draw("paper", 2)
    first = kernels.step(states[0], inputs[0])
    before = first.copy()
    second = kernels.step(states[1], inputs[1])
    assert not np.shares_memory(first, second)
    np.testing.assert_array_equal(first, before)
    first[:] = 0.0
    np.testing.assert_array_equal(kernels.step(states[0], inputs[0]), before)


@pytest.mark.parametrize(
    ("change", "error", "message"),
    [
        (lambda x: x[:-1], ValueError, "step: x has 22 entries per row, scene 'paper' has 23"),
        (lambda x: x[None, None], ValueError, r"x: shape \(1, 1, 23\), should be \(n,\) or \(B, n\)"),
        (lambda x: x[0], ValueError, r"x: shape \(\), should be \(n,\) or \(B, n\)"),
        (lambda x: x * 1j, TypeError, "x: of type complex128, should be real numbers"),
        (lambda x: np.ma.masked_array(x), TypeError, "x: a masked array"),
        (lambda x: x.astype("M8[s]"), TypeError, "x: of type datetime64"),
        (lambda x: x.astype(object), TypeError, "x: of type object"),
    ],
)
def test_wrong_arguments_are_named_at_any_call(change, error, message, draw):
    kernels, states, inputs = draw("paper", 1)
    x, u = states[0], inputs[0]
    expected = kernels.step(x, u)
    for _ in range(2):
        with pytest.raises(error, match=message):
            kernels.step(change(x), u)
    np.testing.assert_array_equal(kernels.step(x, u), expected)


def test_kernels_that_nobody_called_yet_can_be_copied(draw):
    _, states, inputs = draw("paper", 1)
    fresh = Kernels(load_scene("paper"))
    expected = compile_scene("paper").step(states[0], inputs[0])
    for copied in (copy.deepcopy(fresh), pickle.loads(pickle.dumps(fresh))):
        np.testing.assert_array_equal(copied.step(states[0], inputs[0]), expected)


def test_parameters_are_those_of_each_call(draw):
    """Nominal ones unless given, call after call, and checked as in batches."""
    kernels, states, inputs = draw(load_scene("paper").replace(spread={"base_mass": 0.2}), 1)
    x, u, nominal = states[0], inputs[0], kernels.parameters.nominal
    heavier = 1.5 * nominal
    expected = {p.tobytes(): kernels.step(x[None], u[None], p=p)[0] for p in (nominal, heavier)}
    assert not np.array_equal(*expected.values())
    for p in (None, heavier, None, nominal, heavier.tolist(), None):
        found = kernels.step(x, u, p=p)
        np.testing.assert_array_equal(found, expected[np.array(nominal if p is None else p).tobytes()])
    with pytest.raises(ValueError, match="p: shape"):
        kernels.step(x, u, p=np.zeros(len(nominal) + 1))
    constant = compile_scene(load_scene("paper").replace(spread=Spread()))
    constant.step(x, u)
    with pytest.raises(ValueError, match="p: shape"):
        constant.step(x, u, p=np.ones(1))
