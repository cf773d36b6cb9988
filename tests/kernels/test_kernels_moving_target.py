"""Exact derivatives where the target moves and the tip's twist relative to it has a weight."""

from typing import Any

import numpy as np
import pytest
from test_kernels_second_order import check_lagrangian, differences, right_jacobian

from dq_space_arm_env import Scene, compile_scene, load_scene
from dq_space_arm_env.kernels import Kernels

COST = {
    "base_velocity": [3.0, 2.0, 5.0, 1.0, 4.0, 6.0],
    "terminal_base_velocity": [30.0, 20.0, 50.0, 10.0, 40.0, 60.0],
    "tip_twist": [10.0, 20.0, 30.0, 40.0, 50.0, 60.0],
    "terminal_tip_twist": [600.0, 500.0, 400.0, 300.0, 200.0, 100.0],
}
EMPHASIS = np.array([3.0])


def moving(name: str) -> Scene:
    planar = name == "planar"
    motion = {
        "kind": "screw" if planar else "tumbling",
        "angular_velocity": [0.0, 0.0, 0.4] if planar else [0.3, -0.5, 0.4],
        "linear_velocity": [0.2, -0.3, 0.0] if planar else [0.2, -0.3, 0.1],
    }
    grasp: dict[str, Any] = {"position": [-0.4, 0.1, 0.0], "rotation": {"axis": [0, 0, 1], "angle": 40}}
    if not planar:
        motion["inertia"] = [4.9, 7.1, 8.7]
        grasp = {"position": [-0.4, 0.1, 0.2], "rotation": {"axis": [0.2, 0.1, 1.0], "angle": 40}}
    target: dict[str, Any] = {"motion": motion, "grasp": grasp}
    if name != "no-wrist":
        target |= {"base_velocity_relative": True, "base_velocity": [0.0, 0.0, 0.2, 0.1, -0.3, 0.0]}
    return load_scene(name).replace(target=target, cost=COST)


@pytest.fixture(params=["paper", "planar", pytest.param("no-wrist", marks=pytest.mark.slow)])
def drawn(request: pytest.FixtureRequest, draw: Any) -> tuple[Kernels, Any, Any]:
    kernels, states, inputs = draw(moving(request.param), 2)
    return kernels, states, inputs


def square(kernels: Kernels, entries: Any, rows: int) -> Any:
    return entries.reshape(rows, -1)


@pytest.mark.slow
def test_gradients_agree_with_differences_of_the_costs(drawn: Any) -> None:
    kernels, states, inputs = drawn
    n_t = kernels.n_t
    for x, u in zip(states, inputs, strict=True):
        slope, by_input = kernels.call("cost_derivatives", x=x, u=u)[:2]

        def cost(w: Any, x: Any = x, u: Any = u) -> Any:
            return kernels.cost(kernels.retract(x, w[:n_t]), u + w[n_t:])

        expected = differences(cost, n_t + kernels.n_u)
        found = np.concatenate([slope, by_input])
        np.testing.assert_allclose(found, expected, rtol=0, atol=1e-9 * np.abs(expected).max())
        final = kernels.call("terminal_cost_derivatives", x=x, emphasis=EMPHASIS)[0]

        def last(z: Any, x: Any = x) -> Any:
            return kernels.call("emphasized_terminal_cost", x=kernels.retract(x, z), emphasis=EMPHASIS)[0][0]

        expected = differences(last, n_t)
        np.testing.assert_allclose(final, expected, rtol=0, atol=1e-9 * np.abs(expected).max())


@pytest.mark.sampled
def test_hessians_of_the_twist_are_gauss_newtons(drawn: Any) -> None:
    """2 J' W J by the twist's exact differences, on top of the Hessian without the twist's weights."""
    kernels, states, inputs = drawn
    n_t, n_u = kernels.n_t, kernels.n_u
    plain = compile_scene(kernels.scene.replace(cost={"tip_twist": 0.0, "terminal_tip_twist": 0.0}))
    for x, u in zip(states, inputs, strict=True):

        def twist(w: Any, x: Any = x, u: Any = u) -> Any:
            return kernels.relative_twist(kernels.retract(x, w[:n_t]), u + w[n_t:])

        def held(z: Any, x: Any = x) -> Any:
            return kernels.relative_twist(kernels.retract(x, z))

        jacobian = differences(twist, n_t + n_u)
        expected = 2.0 * jacobian @ np.diag(COST["tip_twist"]) @ jacobian.T
        found = kernels.call("cost_derivatives", x=x, u=u)
        without = plain.call("cost_derivatives", x=x, u=u)
        scale = np.abs(expected).max()
        lxx = square(kernels, found[2] - without[2], n_t)
        luu = square(kernels, found[3] - without[3], n_u)
        np.testing.assert_allclose(lxx, expected[:n_t, :n_t], rtol=0, atol=1e-9 * scale)
        np.testing.assert_allclose(luu, expected[n_t:, n_t:], rtol=0, atol=1e-9 * scale)
        if len(found) == 5:
            lux = square(kernels, found[4], n_u)
            np.testing.assert_allclose(lux, expected[n_t:, :n_t], rtol=0, atol=1e-9 * scale)
            assert np.abs(lux).max() > 1.0
        else:  # without a wrist no input moves the tip at once
            assert kernels.scene.wrist is None
            assert not expected[n_t:].any()
        jacobian = differences(held, n_t)
        weighted = 3.0 * np.diag(COST["terminal_tip_twist"])
        expected = 2.0 * jacobian @ weighted @ jacobian.T
        last, other = (
            k.call("terminal_cost_derivatives", x=x, emphasis=EMPHASIS)[1] for k in (kernels, plain)
        )
        hessian = square(kernels, last - other, n_t)
        np.testing.assert_allclose(hessian, expected, rtol=0, atol=1e-9 * np.abs(expected).max())


@pytest.mark.slow
def test_lagrangian_hessian_agrees_with_differences_of_the_gradient(drawn: Any) -> None:
    kernels, states, inputs = drawn
    for seed, (x, u) in enumerate(zip(states, inputs, strict=True)):
        check_lagrangian(kernels, "rk4", x, u, seed)


@pytest.mark.sampled
def test_terminal_cost_hessian_agrees_with_differences_of_the_gradient(drawn: Any) -> None:
    kernels, states, _ = drawn
    for x in states:

        def gradient(z: Any, x: Any = x) -> Any:
            slope = kernels.call("terminal_cost_derivatives", x=kernels.retract(x, z), emphasis=EMPHASIS)[0]
            return right_jacobian(kernels, z).T @ slope

        expected = differences(gradient, kernels.n_t)
        hessian = kernels.call("terminal_cost_hessian", x=x, emphasis=EMPHASIS)[0]
        hessian = square(kernels, hessian, kernels.n_t)
        np.testing.assert_allclose(hessian, expected, rtol=0, atol=1e-8 * np.abs(expected).max())


@pytest.mark.sampled
def test_the_observation_changes_as_its_jacobian_says(drawn: Any) -> None:
    kernels, states, _ = drawn
    for x in states:

        def seen(z: Any, x: Any = x) -> Any:
            return kernels.observation(kernels.retract(x, z), [3.0])[0]

        expected = differences(seen, kernels.n_t).T
        jacobian = kernels.observation_jacobian(x)
        np.testing.assert_allclose(jacobian, expected, rtol=0, atol=1e-10 * np.abs(expected).max())
        assert np.abs(jacobian[kernels.n_x : -1]).max() > 0.1


def test_derivatives_by_the_targets_numbers_agree_with_differences(draw: Any) -> None:
    kernels, states, inputs = draw(moving("paper"), 1)
    x, u, p = states[0], inputs[0], kernels.parameters.nominal
    expected = differences(lambda change: kernels.cost(x, u, p=p + change), kernels.n_p)
    found = kernels.cost_by_parameters(x, u, p)
    np.testing.assert_allclose(found, expected, rtol=0, atol=1e-9 * np.abs(expected).max())
    velocity = kernels.parameters.indices("target.velocity")
    assert np.abs(expected[velocity]).min() > 1.0
