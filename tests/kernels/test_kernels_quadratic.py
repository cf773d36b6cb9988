"""The quadratic cost of a state around a reference, and the state behind an observation."""

import numpy as np
import pytest


@pytest.fixture(params=["paper", "planar"])
def quadratic(request, draw):
    """Kernels, two states, gradient and symmetric Hessian at the first of them."""
    kernels, x, _ = draw(request.param, 2)
    rng = np.random.default_rng(5)
    root = rng.normal(size=(kernels.n_t, kernels.n_t))
    return kernels, x, rng.normal(size=kernels.n_t), root + root.T


def evaluate(name, kernels, x, reference, gradient, hessian):
    inputs = {"x": x, "x_reference": reference, "gradient": gradient, "hessian": hessian.ravel()}
    return kernels.call(name, **inputs)


def test_near_the_reference_it_is_the_quadratic_in_tangent_coordinates(quadratic):
    kernels, x, gradient, hessian = quadratic
    direction = np.random.default_rng(6).normal(size=kernels.n_t)
    errors = []
    for size in (1e-2, 5e-3):
        dx = size * direction
        moved = kernels.retract(x[0], dx)
        cost = evaluate("quadratic_cost", kernels, moved, x[0], gradient, hessian)[0][0]
        errors.append(abs(cost - (gradient @ dx + 0.5 * dx @ hessian @ dx)))
    assert errors[0] < 1e-4
    assert errors[0] / errors[1] > 7.0  # third order


def test_its_gradient_is_that_of_finite_differences_far_from_the_reference(quadratic):
    kernels, x, gradient, hessian = quadratic
    slope, _ = evaluate("quadratic_cost_derivatives", kernels, x[1], x[0], gradient, hessian)

    def cost(dx):
        return evaluate("quadratic_cost", kernels, kernels.retract(x[1], dx), x[0], gradient, hessian)[0][0]

    h = 1e-4
    expected = [(cost(step) - cost(-step)) / (2.0 * h) for step in h * np.eye(kernels.n_t)]
    np.testing.assert_allclose(slope, expected, rtol=1e-6, atol=1e-6)


def test_its_gauss_newton_hessian_is_convex_if_the_given_one_is(quadratic):
    kernels, x, gradient, hessian = quadratic
    n = kernels.n_t
    at_reference = evaluate("quadratic_cost_derivatives", kernels, x[0], x[0], gradient, hessian)
    np.testing.assert_allclose(at_reference[0], gradient, rtol=0, atol=1e-12)
    np.testing.assert_allclose(at_reference[1].reshape(n, n), hessian, rtol=0, atol=1e-12)
    convex = hessian @ hessian
    away = evaluate("quadratic_cost_derivatives", kernels, x[1], x[0], gradient, convex)[1].reshape(n, n)
    np.testing.assert_allclose(away, away.T, rtol=0, atol=1e-9)
    assert np.linalg.eigvalsh(away).min() > -1e-9


@pytest.mark.parametrize("scene", ["paper", "planar", "payload"])
def test_the_state_follows_from_the_observation(scene, draw):
    kernels, x, _ = draw(scene, 5)
    observation, _ = kernels.observation(x, np.full((5, 1), 3.0))
    np.testing.assert_allclose(kernels.state_from_observation(observation), x, rtol=0, atol=1e-13)
    n_pose = 4 if kernels.layout.planar else 8
    observation[:, :n_pose] *= 1.3
    np.testing.assert_allclose(kernels.state_from_observation(observation), x, rtol=0, atol=1e-13)
