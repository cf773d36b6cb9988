"""Constraints and phases in CasADi, PyTorch and JAX against the kernels: residuals, Jacobians, stages."""

import os

os.environ.setdefault("JAX_PLATFORMS", "cpu")

import casadi
import numpy as np
import pytest
from test_differentiable_dynamics import directions, moving

from dq_space_arm_env import casadi_dynamics, compile_scene, jax_dynamics, load_scene, torch_dynamics
from dq_space_arm_env.environment import DQSpaceArmEnv

CONSTRAINED = [
    *("joint-limits", "keep-out", "approach-corridor", "pointing", "wheel-saturation", "servicing"),
    *("line-of-sight", "plume", "wheels", "motors"),
]
FUNCTIONS = {"constraints": ("x", "u"), "terminal_constraints": ("x",)}
"""Functions of residuals, and what they are differentiated by."""
ANYWAY = {
    "attitude_error_deg": 180.0,
    "position_error": 100.0,
    "angular_velocity_error_deg": None,
    "velocity_error": None,
}


@pytest.fixture
def torch():
    return pytest.importorskip("torch")


@pytest.fixture
def jax():
    jax = pytest.importorskip("jax")
    before = jax.config.jax_enable_x64
    jax.config.update("jax_enable_x64", True)
    yield jax
    jax.config.update("jax_enable_x64", before)


@pytest.fixture(scope="module")
def caught():
    """Capture and detumble in 12 steps, with a catch that succeeds anywhere."""
    lengths = {f"phases.{index}.steps": steps for index, steps in enumerate((6, 1, 5))}
    return load_scene("capture-and-detumble").replace(
        {**lengths, "phases.2.catch": ANYWAY, "simulation.steps": 12}
    )


def chart(kernels, x):
    """What the numbers of a state change by along its tangent coordinates, (n_x, n_t), to fourth order."""
    h, basis = 1e-3, np.eye(kernels.n_t)

    def difference(size):
        return (kernels.retract(x, size * basis) - kernels.retract(x, -size * basis)).T

    x = np.tile(x, (kernels.n_t, 1))
    return (8 * difference(h) - difference(2 * h)) / (12 * h)


def assert_close(found, expected, tolerance=1e-10):
    scale = np.abs(expected).max(initial=1.0)
    np.testing.assert_allclose(found, expected, rtol=0.0, atol=tolerance * scale)


def of_kernels(kernels, function, arguments, p):
    """Residuals, and their Jacobians by tangent state and, along the path, input."""
    jacobian = getattr(kernels, f"{function.removesuffix('s')}_jacobian")(*arguments, p=p)
    return getattr(kernels, function)(*arguments, p=p), jacobian


def by_casadi(residuals, *names):
    """The Jacobian of residuals by inputs of these names, a function of all inputs."""
    symbols = {name: casadi.SX.sym(name, *residuals.size_in(name)) for name in residuals.name_in()}
    wanted = casadi.vertcat(*(symbols[name] for name in names))
    return casadi.Function("j", [*symbols.values()], [casadi.jacobian(residuals(*symbols.values()), wanted)])


@pytest.mark.sampled
@pytest.mark.parametrize("function", FUNCTIONS)
@pytest.mark.parametrize("name", CONSTRAINED)
def test_casadi_gives_residuals_and_jacobians_of_the_kernels(name, function):
    kernels, states, inputs, p = moving(name)
    residuals = getattr(casadi_dynamics(kernels.scene), function)
    names = FUNCTIONS[function]
    jacobian = by_casadi(residuals, *names)
    for x, u in zip(states, inputs[0], strict=True):
        numbers = {"x": x, "u": u, "parameters": p}
        given = [numbers[name] for name in residuals.name_in()]
        expected = of_kernels(kernels, function, [numbers[name] for name in names], p)
        assert_close(residuals(*given).full().ravel(), expected[0], 1e-13)
        found = jacobian(*given).full()
        assert np.abs(expected[1]).max() > 1e-3
        assert_close(found[:, : len(x)] @ chart(kernels, x), expected[1][:, : kernels.n_t])
        assert_close(found[:, len(x) :], expected[1][:, kernels.n_t :])


@pytest.mark.sampled
@pytest.mark.parametrize("function", FUNCTIONS)
@pytest.mark.parametrize("name", CONSTRAINED)
def test_gradients_of_residuals_of_tensors(name, function, torch):
    kernels, states, inputs, p = moving(name)
    moves, rng = directions(kernels, states), np.random.default_rng(2)
    arrays = [states, inputs[0]][: len(FUNCTIONS[function])]
    tensors = [torch.tensor(array, requires_grad=True) for array in arrays]
    found = getattr(torch_dynamics(name), function)(*tensors, torch.tensor(p))
    residuals, jacobians = of_kernels(kernels, function, arrays, p)
    np.testing.assert_array_equal(found.detach(), residuals)
    v = rng.normal(size=found.shape)
    (found * torch.tensor(v)).sum().backward()
    products = np.einsum("bc,bcn->bn", v, jacobians)
    along = np.array([chart(kernels, x) @ move for x, move in zip(states, moves, strict=True)])
    by_x = (tensors[0].grad.numpy() * along).sum(axis=1)
    assert_close(by_x, (products[:, : kernels.n_t] * moves).sum(axis=1))
    if len(tensors) > 1:
        assert_close(tensors[1].grad, products[:, kernels.n_t :], 1e-13)


@pytest.mark.slow
@pytest.mark.sampled
@pytest.mark.parametrize("function", FUNCTIONS)
@pytest.mark.parametrize(
    "name",  # XLA compiles those of servicing for a minute
    [pytest.param(each, marks=pytest.mark.endurance if each == "servicing" else ()) for each in CONSTRAINED],
)
def test_jax_gives_residuals_and_jacobians_of_the_kernels(name, function, jax):
    kernels, states, inputs, p = moving(name)
    n_x, batch = kernels.n_x, [states, inputs[0]][: len(FUNCTIONS[function])]
    expected, rows = of_kernels(kernels, function, batch, p), chart(kernels, states[0])
    for calling in (False, True):
        value = getattr(jax_dynamics(name, "rk4", kernels=calling), function)
        assert_close(jax.jit(value)(*batch, p), expected[0], 1e-13)
        derivatives = (jax.jacrev,) if calling else (jax.jacrev, jax.jacfwd)
        for derivative in derivatives:
            by = jax.jit(derivative(value, tuple(range(len(batch)))))(*(array[0] for array in batch), p)
            found = np.hstack(by)
            assert_close(found[:, :n_x] @ rows, expected[1][0, :, : kernels.n_t])
            assert_close(found[:, n_x:], expected[1][0, :, kernels.n_t :])


@pytest.mark.slow
def test_derivatives_of_residuals_by_parameters(torch, jax):
    """XLA has them, as CasADi does; the kernels refuse them."""
    kernels, states, inputs, p = moving("servicing")
    x, u = states[0], inputs[0, 0]
    expected = by_casadi(casadi_dynamics(kernels.scene).constraints, "parameters")(x, p, u).full()
    assert np.abs(expected).max() > 0.1
    assert_close(jax.jacfwd(jax_dynamics("servicing").constraints, 2)(x, u, p), expected, 1e-12)
    given = torch.tensor(p, requires_grad=True)
    for found in (
        torch_dynamics("servicing").constraints(torch.tensor(x), torch.tensor(u), given),
        torch_dynamics("servicing").terminal_constraints(torch.tensor(x), given),
    ):
        with pytest.raises(NotImplementedError, match="no derivatives by parameters: for these"):
            found.sum().backward()
    calling = jax_dynamics("servicing", kernels=True)
    with pytest.raises(NotImplementedError, match="no derivatives by parameters"):
        jax.grad(lambda p: calling.constraints(x, u, p).sum())(p)


def test_without_constraints_there_are_no_rows(torch, jax):
    kernels, states, inputs, _ = moving("planar")
    success = kernels.terminal_constraints(states)
    assert success.shape == (3, 2)
    assert casadi_dynamics(kernels.scene).constraints(states[0], inputs[0, 0]).shape == (0, 1)
    for dynamics in (torch_dynamics("planar"), jax_dynamics("planar", kernels=True)):
        assert tuple(dynamics.constraints(states[0], inputs[0, 0]).shape) == (0,)
        assert tuple(dynamics.constraints(states, inputs[0]).shape) == (3, 0)
        assert_close(dynamics.terminal_constraints(states), success, 1e-13)


def test_ipopt_keeps_to_constraints():
    """The planar arm turns a joint by more than 1.5 rad, unless it may not."""
    free, kept = planned(3.0), planned(0.9)
    assert (free.max(axis=0) > 1.5).any()
    assert kept.max() == pytest.approx(0.9, abs=1e-6)


def planned(upper, steps=15):
    """Joint angles of the optimum by direct multiple shooting, at most `upper`, rad."""
    stops = {"name": "stops", "kind": "joint_limits", "upper": upper}
    scene = load_scene("planar").replace(constraints=[stops])
    dynamics = casadi_dynamics(scene, "rk4")
    layout, duration = dynamics.layout, scene.simulation.dt * scene.simulation.steps
    start, limit = layout.initial_state, layout.control_limit
    opti = casadi.Opti()
    x, u = opti.variable(layout.n_x, steps + 1), opti.variable(layout.n_u, steps)
    opti.subject_to(x[:, 0] == start)
    for k in range(steps):
        opti.subject_to(x[:, k + 1] == dynamics.step(x[:, k], u[:, k], duration / steps))
        opti.subject_to(opti.bounded(-limit, u[:, k], limit))
        opti.subject_to(dynamics.constraints(x[:, k], u[:, k]) <= 0)
    opti.subject_to(dynamics.terminal_constraints(x[:, steps]) <= 0)
    running = sum(dynamics.cost(x[:, k], u[:, k]) for k in range(steps)) * scene.simulation.steps / steps
    opti.minimize(running + dynamics.terminal_cost(x[:, steps]))
    opti.set_initial(x, np.tile(start[:, None], steps + 1))
    opti.solver("ipopt", {"print_time": False}, {"print_level": 0, "sb": "yes", "max_iter": 200})
    states = np.array(opti.solve().value(x)).T
    return states[:, layout.state.joint_angles]


# Phases.


def test_each_library_takes_the_step_of_a_stage(caught, torch, jax):
    """Before the catch, with it at the end, and after it, with the payload held."""
    kernels, states, inputs, _ = moving(caught)
    rows, x, u, h = kernels.stage_parameters(), states[0], inputs[0, 0], caught.simulation.dt
    symbolic, free = casadi_dynamics(caught), list(rows[6])
    free[kernels.parameters.names.index("catch.now")] = 0.0
    assert np.abs(kernels.step(x, u, p=rows[6]) - kernels.step(x, u, p=free)).max() > 1e-3
    numeric = [torch_dynamics(caught), jax_dynamics(caught, kernels=True)]
    for stage in (0, 5, 6, 7, 11):
        p = rows[stage]
        expected = kernels.step(x, u, p=p)
        assert_close(symbolic.step(x, p, u, h).full().ravel(), expected, 1e-13)
        assert_close(symbolic.cost(x, p, u).full().ravel(), kernels.cost(x, u, p=p), 1e-13)
        for dynamics in numeric:
            np.testing.assert_array_equal(dynamics.step(x, u, p), expected)
    np.testing.assert_array_equal(numeric[0].step(x, u), kernels.step(x, u, p=rows[0]))


@pytest.mark.slow
def test_xla_takes_the_step_of_a_stage(caught, jax):
    kernels, states, inputs, _ = moving(caught)
    rows, x, u = kernels.stage_parameters(), states[0], inputs[0, 0]
    steps = jax_dynamics(caught).step(x, u, rows)
    assert_close(steps, kernels.step(np.tile(x, (13, 1)), np.tile(u, (13, 1)), p=rows), 1e-12)


@pytest.mark.parametrize("which", ["torch", "kernels", pytest.param("xla", marks=pytest.mark.slow)])
def test_a_rollout_costs_what_the_episode_costs(which, caught, torch, jax):
    """Its stages have their own parameters unasked, the impact included."""
    env, rng = DQSpaceArmEnv(caught), np.random.default_rng(0)
    env.reset(options={"nominal": True})
    rows, returned, inputs = env.kernels.stage_parameters(), 0.0, []
    for stage in range(12):
        action = rng.uniform(-0.3, 0.3, env.kernels.n_u)
        inputs.append(env.kernels.layout.limits_with(rows[stage]) * action)
        returned += float(env.step(action)[1])
    dynamics = (
        torch_dynamics(caught) if which == "torch" else jax_dynamics(caught, kernels=which == "kernels")
    )
    start = np.array(env.kernels.layout.initial_state)
    states, costs = dynamics.rollout(start, np.array(inputs))
    np.testing.assert_allclose(states[-1], env.state, rtol=0, atol=1e-12)
    np.testing.assert_allclose(costs.sum(), -returned, rtol=1e-12)
    few = dynamics.rollout(start, np.array(inputs[:4]))[0]
    np.testing.assert_allclose(few, states[:5], rtol=0, atol=1e-13)


def test_stages_that_the_scene_does_not_have_are_asked_for(caught, torch):
    n_u, start = compile_scene(caught).n_u, np.array(compile_scene(caught).layout.initial_state)
    with pytest.raises(ValueError, match=r"are 12 of 0.015 s, and 13 of 0.015 s are asked for: give"):
        torch_dynamics(caught).rollout(start, np.zeros((13, n_u)))
    dynamics = torch_dynamics(caught, dt=0.03)
    with pytest.raises(ValueError, match=r"and 6 of 0.03 s are asked for"):
        dynamics.rollout(start, np.zeros((6, n_u)))
    rows = compile_scene(caught).stage_parameters()[::2, None]
    assert dynamics.rollout(start, np.zeros((6, n_u)), rows)[0].shape == (7, 1, len(start))
