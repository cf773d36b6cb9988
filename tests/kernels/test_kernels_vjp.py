"""Vector-Jacobian products of steps, costs and observations, against the whole Jacobians."""

from itertools import product

import numpy as np
import pytest
from test_kernels_derivatives import STRUCTURES
from test_kernels_odd_scenes import ODD

from dq_space_arm_env import list_scenes
from dq_space_arm_env.scene import INTEGRATORS
from dq_space_arm_env.scene.start import unit_quaternions

SHIPPED = list_scenes()


def assert_products(products, v, *jacobians):
    for found, jacobian in zip(products, jacobians, strict=True):
        expected = np.einsum("bi,bij->bj", v, jacobian)
        scale = np.abs(v).sum(axis=1, keepdims=True) * max(1.0, np.abs(jacobian).max(initial=0.0))
        assert (np.abs(found - expected) <= 1e-12 * scale).all()


OTHERS = ("heavy-wrist", "dual-arm", "motors", "thrusters")
CASES = [(scene, "rk4") for scene in (*STRUCTURES, *OTHERS)]
# rodas5p and rk8 share all but numbers with rodas4 and rk6.
CASES += [("planar", name) for name in INTEGRATORS if name not in ("rk4", "rodas5p", "rk8")]


@pytest.mark.sampled
@pytest.mark.parametrize(("scene", "integrator"), CASES)
def test_products_of_a_step_agree_with_its_linearization(scene, integrator, draw):
    kernels, states, inputs = draw(scene, 5)
    v = np.random.default_rng(2).normal(size=(5, kernels.n_t))
    products = kernels.vjp(states, inputs, v, integrator=integrator)
    assert_products(products, v, *kernels.linearize(states, inputs, integrator=integrator))


@pytest.mark.slow
@pytest.mark.parametrize("integrator", [name for name in INTEGRATORS if INTEGRATORS[name].curvature == name])
@pytest.mark.parametrize("name", ODD)
def test_products_agree_at_the_edges_of_the_schema(name, integrator, draw):
    kernels, states, inputs = draw(ODD[name], 2)
    v = np.random.default_rng(2).normal(size=(2, kernels.n_t))
    products = kernels.vjp(states, inputs, v, dt=0.1, integrator=integrator)
    assert_products(products, v, *kernels.linearize(states, inputs, dt=0.1, integrator=integrator))


@pytest.mark.sampled
@pytest.mark.parametrize("scene", SHIPPED)
def test_gradients_of_costs_and_products_of_the_observation(scene, draw):
    kernels, states, inputs = draw(scene, 5)
    one = np.ones((5, 1))
    by_state, by_input, *_ = kernels.call("cost_derivatives", x=states, u=inputs)
    gradients = kernels.cost_gradient(states, inputs)
    assert_products(gradients, one, by_state[:, None], by_input[:, None])
    by_state = kernels.call("terminal_cost_derivatives", x=states, emphasis=[1.0])[0]
    assert_products([kernels.terminal_cost_gradient(states)], one, by_state[:, None])
    jacobian = kernels.observation_jacobian(states)
    v = np.random.default_rng(2).normal(size=(5, jacobian.shape[1]))
    # A joint's quaternion has unit norm: a derivative along it says nothing.
    along = np.repeat(np.eye(kernels.n_t)[None], 5, axis=0)
    for where in unit_quaternions(kernels.scene):
        quaternion, rows = states[:, where], range(*where.indices(kernels.n_x))
        for (i, row), (j, column) in product(enumerate(rows), repeat=2):
            shift = kernels.n_t - kernels.n_x
            along[:, row + shift, column + shift] -= quaternion[:, i] * quaternion[:, j]
    found = np.einsum("bi,bij->bj", kernels.observation_vjp(states, v), along)
    assert_products([found], v, jacobian @ along)


def test_step_and_cost_together(draw):
    kernels, states, inputs = draw("paper", 3)
    v, v_cost = np.random.default_rng(2).normal(size=(3, kernels.n_t)), np.array([[0.5], [1.0], [-2.0]])
    by_state, by_input = kernels.call("step_with_cost_vjp", x=states, u=inputs, v=v, v_cost=v_cost)
    together = kernels.vjp(states, inputs, v)
    gradients = kernels.cost_gradient(states, inputs)
    for both, step, cost in zip((by_state, by_input), together, gradients, strict=True):
        np.testing.assert_allclose(both, step + v_cost * cost, rtol=1e-11, atol=1e-11)


@pytest.mark.slow
def test_costs_with_penalties(draw):
    """Parameters end with multipliers and penalties; the expert's derivatives are the reference."""
    kernels, states, inputs = draw("keep-out", 3)
    rng = np.random.default_rng(2)
    stages = {"x": states, "u": inputs, "v": rng.normal(size=(3, kernels.n_t)), "v_cost": np.ones((3, 1))}
    of_step = kernels.vjp(states, inputs, stages["v"])
    for name, other, rows in (
        ("step_with_cost_vjp", "cost_derivatives", of_step),
        ("emphasized_terminal_cost_vjp", "terminal_cost_derivatives", (0.0,)),
    ):
        kernel, reference = kernels.kernel(f"penalized_{name}"), kernels.kernel(f"penalized_{other}")
        sizes = {spec.name: spec.stride for spec in kernel.inputs}
        given = {**stages, "h": [kernels.scene.simulation.dt], "emphasis": np.full((3, 1), 2.0)}
        given["v"] = stages["v"] if "v_cost" in sizes else np.ones((3, 1))
        extra = np.repeat(rng.uniform(0.5, 2.0, (1, sizes["parameters"] - kernels.n_p)), 3, axis=0)
        given["parameters"] = np.hstack([np.repeat(kernels.parameter_rows(None, 1), 3, axis=0), extra])
        results = [
            {spec.name: np.zeros((3, spec.stride)) for spec in each.outputs} for each in (kernel, reference)
        ]
        for each, arrays in zip((kernel, reference), results, strict=True):
            each([*(np.array(given[spec.name]) for spec in each.inputs), *arrays.values()], 3)
        found, expected = (list(arrays.values()) for arrays in results)
        assert np.abs(expected[0]).max() > 1.0
        for both, cost, step in zip(found, expected, rows, strict=False):
            np.testing.assert_allclose(both, step + cost, rtol=1e-11, atol=1e-11)


def test_a_batch_gives_the_bits_of_its_states(draw):
    kernels, states, inputs = draw("paper", 5)
    v = np.random.default_rng(2).normal(size=(5, kernels.n_t))
    together = kernels.vjp(states, inputs, v)
    for row in range(5):
        alone = kernels.vjp(states[row], inputs[row], v[row])
        for batch, single in zip(together, alone, strict=True):
            np.testing.assert_array_equal(batch[row], single)


def test_parameters_change_the_products(draw):
    kernels, states, inputs = draw("random-masses", 3)
    v = np.random.default_rng(2).normal(size=(3, kernels.n_t))
    p = kernels.parameters.nominal * np.array([[1.0], [1.2], [0.7]])
    products = kernels.vjp(states, inputs, v, p=p)
    assert_products(products, v, *kernels.linearize(states, inputs, p=p))
    assert np.abs(products[1][1] - kernels.vjp(states[1], inputs[1], v[1])[1]).max() > 1e-6


def test_shapes_that_do_not_fit_are_named(draw):
    kernels, states, inputs = draw("paper", 2)
    with pytest.raises(ValueError, match=r"v"):
        kernels.vjp(states, inputs, np.ones((2, 3)))
    with pytest.raises(ValueError, match="dt: nan"):
        kernels.vjp(states, inputs, np.ones(kernels.n_t), dt=float("nan"))
    with pytest.raises(ValueError, match="integrator: 'rk5' is unknown"):
        kernels.vjp(states, inputs, np.ones(kernels.n_t), integrator="rk5")
