"""Exact second derivatives: differences of the exact first derivatives along retractions, for every robot."""

import numpy as np
import pytest
from test_kernels_odd_scenes import ODD

from dq_space_arm_env import load_scene
from dq_space_arm_env.algebra import screw
from dq_space_arm_env.scene import INTEGRATORS
from scripts.benchmarks.robots import robots

STEP = 5e-4

CURVED = [name for name, entry in INTEGRATORS.items() if entry.curvature == name]
SCENES = (*robots(), "random-target")  # whose target is a parameter of the cost
# Each of the others takes seconds to compile.
LATE = [pytest.mark.slow] * 6 + [pytest.mark.endurance] * len(ODD)
ODD_SCENES = [
    s if s in ("base", "wrist") else pytest.param(s, marks=late) for s, late in zip(ODD, LATE, strict=False)
]


def right_jacobian(kernels, twist):
    """Right Jacobian of the exponential over the base's tangent directions, identity for the rest."""
    jacobian = np.eye(kernels.n_t)
    directions = [2, 3, 4] if kernels.layout.planar else list(range(6))
    full = np.zeros(6)
    full[directions] = twist[: len(directions)]
    block = np.array(screw.exponential_right_jacobian(full.tolist()))
    jacobian[: len(directions), : len(directions)] = block[np.ix_(directions, directions)]
    return jacobian


def lagrangian_gradient(kernels, integrator, x, u, multiplier, successor, p=None):
    """Gradient of cost(x (+) z, u) + multiplier . (step(x (+) z, u) (-) successor), by (z, u)."""

    def gradient(z, v):
        moved = kernels.retract(x, z)
        a, b = kernels.linearize(moved, v, integrator=integrator, p=p)
        lx, lu, *_ = kernels.call("cost_derivatives", x=moved, u=v, p=p)
        image = kernels.difference(successor, kernels.step(moved, v, integrator=integrator, p=p))
        weights = np.linalg.solve(right_jacobian(kernels, image).T, multiplier)
        return np.concatenate([right_jacobian(kernels, z).T @ (lx + a.T @ weights), lu + b.T @ weights])

    return lambda w: gradient(w[: kernels.n_t], u + w[kernels.n_t :])


def differences(gradient, size):
    """Jacobian of a function at zero by central differences, extrapolated to order 4."""

    def slope(direction, step):
        return (gradient(step * direction) - gradient(-step * direction)) / (2.0 * step)

    return np.array([(4.0 * slope(e, STEP / 2) - slope(e, STEP)) / 3.0 for e in np.eye(size)])


def lagrangian_hessian(kernels, integrator, x, u, multiplier, p=None):
    h = np.array([kernels.scene.simulation.dt])
    blocks = kernels.call("lagrangian_hessian", integrator, x=x, u=u, multiplier=multiplier, h=h, p=p)
    n_t, n_u = kernels.n_t, kernels.n_u
    lux = blocks[1].reshape(n_u, n_t)
    return np.block([[blocks[0].reshape(n_t, n_t), lux.T], [lux, blocks[2].reshape(n_u, n_u)]])


def check_lagrangian(kernels, integrator, x, u, seed, p=None):
    multiplier = 300.0 * np.random.default_rng(seed).normal(size=kernels.n_t)
    successor = kernels.step(x, u, integrator=integrator, p=p)
    gradient = lagrangian_gradient(kernels, integrator, x, u, multiplier, successor, p)
    expected = differences(gradient, kernels.n_t + kernels.n_u)
    hessian = lagrangian_hessian(kernels, integrator, x, u, multiplier, p)
    np.testing.assert_array_equal(hessian, hessian.T)
    np.testing.assert_allclose(hessian, expected, rtol=0, atol=1e-8 * np.abs(expected).max())


def scenes_and_integrators():
    for scene in SCENES:
        spherical = any(link.is_spherical for link in load_scene(scene).links)
        yield from ((scene, name) for name in CURVED if INTEGRATORS[name].turns_quaternions or not spherical)


@pytest.mark.sampled
@pytest.mark.parametrize(("scene", "integrator"), list(scenes_and_integrators()))
def test_lagrangian_hessian_agrees_with_differences_of_the_gradient(scene, integrator, draw):
    kernels, states, inputs = draw(scene, 2)
    for seed, (x, u) in enumerate(zip(states, inputs, strict=True)):
        check_lagrangian(kernels, integrator, x, u, seed)


@pytest.mark.sampled
@pytest.mark.parametrize("integrator", CURVED)
@pytest.mark.parametrize("scene", ODD_SCENES)
def test_lagrangian_hessian_of_odd_scenes(scene, integrator, draw):
    kernels, states, inputs = draw(ODD[scene], 1)
    check_lagrangian(kernels, integrator, states[0], inputs[0], 0)


@pytest.mark.slow
def test_lagrangian_hessian_across_a_catch(draw):
    kernels, states, inputs = draw("capture-and-detumble", 2)
    rows, (start,) = kernels.stage_parameters(), np.flatnonzero(kernels.scene.staged.catches)
    stage = kernels.scene.staged.starts[start] - 1
    rows[:, kernels.parameters.indices("cost")] *= 1e-6  # what counts is the impact
    for seed, (p, x, u) in enumerate(zip(rows[stage - 1 : stage + 1], states, inputs, strict=True)):
        check_lagrangian(kernels, "rk4", x, u, seed, p)
    free = rows[stage].copy()
    free[kernels.parameters.indices("catch")] = 0.0
    with_catch, without = (
        lagrangian_hessian(kernels, "rk4", x, u, np.full(kernels.n_t, 300.0), p) for p in (rows[stage], free)
    )
    assert np.abs(with_catch - without).max() > 1e-3 * np.abs(with_catch).max()


@pytest.mark.parametrize("scene", ["paper", "planar", "six-joint", "no-wrist"])
def test_terminal_cost_hessian_agrees_with_differences_of_the_gradient(scene, draw):
    kernels, states, _ = draw(scene, 3)
    for x in states:

        def gradient(z, x=x):
            moved = kernels.retract(x, z)
            slope = kernels.call("terminal_cost_derivatives", x=moved, emphasis=[3.0])[0]
            return right_jacobian(kernels, z).T @ slope

        expected = differences(gradient, kernels.n_t)
        hessian = kernels.call("terminal_cost_hessian", x=x, emphasis=[3.0])[0]
        hessian = hessian.reshape(kernels.n_t, kernels.n_t)
        np.testing.assert_allclose(hessian, expected, rtol=0, atol=1e-8 * np.abs(expected).max())
