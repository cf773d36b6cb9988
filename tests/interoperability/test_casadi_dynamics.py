"""CasADi functions of scenes against the kernels, their derivatives, and a problem solved with them."""

import casadi
import numpy as np
import pytest
from foreign_robots import drawn, relative_error
from graph_interpreter import evaluate_program

from dq_space_arm_env import casadi_dynamics, compile_scene, load_scene
from dq_space_arm_env.kernels.programs.scene_programs import ScenePrograms
from dq_space_arm_env.scene import INTEGRATORS


def value(function, *arguments):
    return np.array(function(*arguments)).ravel()


@pytest.mark.parametrize("name", ["paper", "planar", "tip-load"])
def test_functions_give_what_the_kernels_give(name):
    scene = load_scene(name)
    dynamics, kernels = casadi_dynamics(scene), compile_scene(scene)
    x, u = drawn(scene, np.random.default_rng(0))
    for function in ("forward_dynamics", "cost"):
        expected = np.ravel(getattr(kernels, function)(x, u))
        assert relative_error(value(getattr(dynamics, function), x, u), expected) < 1e-14
    for function in ("tip_pose", "terminal_cost"):
        expected = np.ravel(getattr(kernels, function)(x))
        assert relative_error(value(getattr(dynamics, function), x), expected) < 1e-14
    found = value(dynamics.step, x, u, scene.simulation.dt)
    assert relative_error(found, kernels.step(x, u)) < 1e-14


LOOPING = [name for name, entry in INTEGRATORS.items() if entry.is_adaptive or entry.symplectic]


@pytest.mark.parametrize("integrator", [name for name in INTEGRATORS if name not in LOOPING])
def test_every_integrator_of_fixed_stages_takes_the_same_step(integrator):
    scene = load_scene("planar")
    x, u = drawn(scene, np.random.default_rng(0))
    program = ScenePrograms(scene).build("step", integrator)
    expected = evaluate_program(program, {"x": x, "u": u, "h": [0.05]})["x_next"]
    found = value(casadi_dynamics(scene, integrator).step, x, u, 0.05)
    assert relative_error(found, expected) < 1e-14


@pytest.mark.parametrize("name", ["paper", "planar"])
def test_the_state_derivative_is_that_of_the_flow(name):
    dynamics = casadi_dynamics(load_scene(name), "rk8")
    x, u = drawn(dynamics.scene, np.random.default_rng(0))
    h = 2e-3
    slope = sum(
        weight * (value(dynamics.step, x, u, k * h) - value(dynamics.step, x, u, -k * h))
        for k, weight in ((1, 4 / 5), (2, -1 / 5), (3, 4 / 105), (4, -1 / 280))
    )
    assert relative_error(slope / h, value(dynamics.xdot, x, u)) < 1e-10


@pytest.mark.parametrize("start", ["at rest", "moving"])
def test_derivatives_are_those_of_the_kernels(start):
    """At rest, too, where a formula for rotations that divides by the angle has no derivative."""
    scene = load_scene("planar")
    dynamics, kernels, h = casadi_dynamics(scene), compile_scene(scene), scene.simulation.dt
    layout = dynamics.layout
    x, u = drawn(scene, np.random.default_rng(0))
    if start == "at rest":
        x, u = layout.initial_state, np.zeros(layout.n_u)
    free_x, free_u = casadi.SX.sym("x", layout.n_x), casadi.SX.sym("u", layout.n_u)
    step = dynamics.step(free_x, free_u, h)
    by_u = casadi.Function("by_u", [free_x, free_u], [casadi.jacobian(step, free_u)])
    # Beside the pose, tangent coordinates are the state's own entries.
    found, expected = np.array(by_u(x, u)), kernels.linearize(x, u)[1]
    beside = layout.n_x - layout.state.pose.stop
    np.testing.assert_allclose(found[-beside:], expected[-beside:], rtol=0, atol=1e-13)
    both = casadi.vertcat(free_x, free_u)
    curvature = casadi.Function("h", [free_x, free_u], [casadi.hessian(casadi.sum1(step), both)[0]])
    for derivative in (found, np.array(curvature(x, u))):
        assert np.isfinite(derivative).all()


def test_ipopt_solves_a_small_problem_with_them():
    """Direct multiple shooting on the planar arm: what someone's own NMPC would start from."""
    scene = load_scene("planar")
    dynamics, layout, steps = casadi_dynamics(scene, "rk4"), casadi_dynamics(scene).layout, 15
    duration = scene.simulation.dt * scene.simulation.steps
    start, limit = layout.initial_state, layout.control_limit
    opti = casadi.Opti()
    x, u = opti.variable(layout.n_x, steps + 1), opti.variable(layout.n_u, steps)
    opti.subject_to(x[:, 0] == start)
    for k in range(steps):
        opti.subject_to(x[:, k + 1] == dynamics.step(x[:, k], u[:, k], duration / steps))
        opti.subject_to(opti.bounded(-limit, u[:, k], limit))
    # One long step here stands for many of the scene's, each of which costs as much.
    running = sum(dynamics.cost(x[:, k], u[:, k]) for k in range(steps)) * scene.simulation.steps / steps
    opti.minimize(running + dynamics.terminal_cost(x[:, steps]))
    opti.set_initial(x, np.tile(start[:, None], steps + 1))
    opti.solver("ipopt", {"print_time": False}, {"print_level": 0, "sb": "yes", "max_iter": 200})
    solution = opti.solve()
    states, inputs = np.array(solution.value(x)).T, np.array(solution.value(u)).reshape(layout.n_u, -1).T
    # The scene's kernels confirm that the plan flies, and it arrives.
    kernels, flown = compile_scene(scene), start
    for control in inputs:
        flown = kernels.step(flown, control, dt=duration / steps)
    np.testing.assert_allclose(flown, states[-1], rtol=0, atol=1e-6)
    assert (np.abs(inputs) <= limit * (1 + 1e-6)).all()
    before, after = (float(kernels.terminal_cost(state)) for state in (start, flown))
    assert after < 0.05 * before


def test_integrators_that_it_cannot_have_are_refused():
    scene = load_scene("planar")
    for name in LOOPING:
        with pytest.raises(ValueError, match=rf"'{name}' repeats calls .* integrator='rk8'"):
            casadi_dynamics(scene, name)
    with pytest.raises(ValueError, match=r"'rk5' is unknown; did you mean 'rk[468]'"):
        casadi_dynamics(scene, "rk5")
    for name in (4, ["rk4"]):
        with pytest.raises(ValueError, match=r"integrator: .*4.* is unknown; "):
            casadi_dynamics(scene, name)
