"""Scenes as functions of PyTorch and JAX: against the kernels, chains of steps, and finite differences."""

import copy
import os
import pickle
import subprocess
import sys

os.environ.setdefault("JAX_PLATFORMS", "cpu")

import numpy as np
import pytest
from foreign_robots import drawn
from graph_interpreter import evaluate_graph

from dq_space_arm_env import compile_scene, jax_dynamics, list_scenes, load_scene, torch_dynamics
from dq_space_arm_env.compiler.graph import EXPRESSIONS, LIBRARY_FUNCTIONS, trace
from dq_space_arm_env.compiler.program import Buffer, Program
from dq_space_arm_env.scene import INTEGRATORS
from dq_space_arm_env.scene.start import unit_quaternions

ROWS, STEPS = 3, 6


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


def moving(scene, steps=STEPS, rows=ROWS):
    """Kernels, states (B, n_x), inputs (N, B, n_u) and parameters (n_p,)."""
    kernels, rng = compile_scene(scene), np.random.default_rng(0)
    states = np.array([drawn(kernels.scene, rng)[0] for _ in range(rows)])
    for where in unit_quaternions(kernels.scene):
        states[:, where] /= np.linalg.norm(states[:, where], axis=1, keepdims=True)
    return kernels, states, rng.normal(size=(steps, rows, kernels.n_u)), kernels.parameters.nominal * 1.1


def directions(kernels, states):
    """Directions in which states can move, (B, n_t)."""
    moves = np.random.default_rng(1).normal(size=(len(states), kernels.n_t))
    for where in unit_quaternions(kernels.scene):
        entries = moves[:, where.start + kernels.n_t - kernels.n_x :][:, :4]
        entries -= (entries * states[:, where]).sum(axis=1, keepdims=True) * states[:, where]
    return moves


def along(kernels, states, moves):
    """What the numbers of states change by along directions."""
    h = 1e-6
    return (kernels.retract(states, h * moves) - kernels.retract(states, -h * moves)) / (2 * h)


def across(kernels, states):
    """Directions in which the numbers of a state cannot move."""
    pose = kernels.layout.state.pose
    units = [slice(0, (pose.stop - pose.start) // 2), *unit_quaternions(kernels.scene)]
    for where in units:
        normal = np.zeros_like(states)
        normal[:, where] = states[:, where]
        yield normal
    if pose.stop == 8:
        normal = np.zeros_like(states)
        normal[:, :8] = np.roll(states[:, :8], 4, axis=1)
        yield normal


# PyTorch.


def test_a_step_of_tensors_is_that_of_the_kernels(torch):
    kernels, states, inputs, _ = moving("planar")
    dynamics = torch_dynamics("planar", "rk8", dt=0.03)
    for x, u in ((states, inputs[0]), (states[0], inputs[0, 0]), (states[0], inputs[0])):
        found = dynamics.step(torch.tensor(x), torch.tensor(u))
        np.testing.assert_array_equal(found, kernels.step(x, u, dt=0.03, integrator="rk8"))
        np.testing.assert_array_equal(dynamics.cost(x, u), kernels.cost(x, u))
    np.testing.assert_array_equal(dynamics.terminal_cost(states[0]), kernels.terminal_cost(states[0]))


@pytest.mark.sampled
@pytest.mark.parametrize("name", ["paper", "planar", "wheels", "random-masses", "heavy-wrist"])
def test_gradients_of_a_step_are_the_products_of_the_kernels(name, torch):
    kernels, states, inputs, p = moving(name)
    v = np.random.default_rng(2).normal(size=states.shape)
    x, u, p = (torch.tensor(array, requires_grad=True) for array in (states, inputs[0], p))
    (torch_dynamics(name).step(x, u, p) * torch.tensor(v)).sum().backward()
    after = kernels.step(states, inputs[0], p=p.detach().numpy())
    # v in tangent coordinates, column by column: along each of them.
    basis = np.eye(kernels.n_t)
    v_tangent = np.stack(
        [(along(kernels, after, np.broadcast_to(e, (ROWS, kernels.n_t))) * v).sum(axis=1) for e in basis], 1
    )
    by_x, by_u = kernels.vjp(states, inputs[0], v_tangent, p=p.detach().numpy())
    moves = directions(kernels, states)
    found = (x.grad.numpy() * along(kernels, states, moves)).sum(axis=1)
    np.testing.assert_allclose(found, (by_x * moves).sum(axis=1), rtol=1e-7, atol=1e-7)
    np.testing.assert_allclose(u.grad, by_u, rtol=1e-7, atol=1e-8)
    for normal in across(kernels, states):
        np.testing.assert_allclose((x.grad.numpy() * normal).sum(axis=1), 0.0, rtol=0, atol=1e-12)


@pytest.mark.sampled
@pytest.mark.parametrize("every", [3, 1])
@pytest.mark.parametrize("name", ["planar", "paper", "random-masses"])
def test_a_rollout_is_a_chain_of_steps(name, every, torch):
    _, states, inputs, p = moving(name)
    dynamics, results = torch_dynamics(name), []
    for chained in (False, True):
        x, u, given = (torch.tensor(array, requires_grad=True) for array in (states, inputs, p))
        if chained:
            reached, costs = [x], []
            for control in u:
                costs.append(dynamics.cost(reached[-1], control, given))
                reached.append(dynamics.step(reached[-1], control, given))
            costs.append(dynamics.terminal_cost(reached[-1], given))
            flown, costs = torch.stack(reached)[::every], torch.stack(costs)
        else:
            flown, costs = dynamics.rollout(x, u, given, every=every)
        assert flown.shape == (STEPS // every + 1, *states.shape)
        assert costs.shape == (STEPS + 1, ROWS)
        weights = torch.tensor(np.random.default_rng(3).normal(size=flown.shape[1:]))
        (costs.sum() + (flown[1:] * weights).sum()).backward()
        results.append([flown.detach(), costs.detach(), x.grad, u.grad, given.grad])
    for one, other in zip(*results, strict=True):
        np.testing.assert_allclose(one, other, rtol=1e-12, atol=1e-12)


@pytest.mark.parametrize("name", ["planar", "random-masses"])
def test_the_gradient_of_a_rollout_is_that_of_finite_differences(name, torch):
    kernels, states, inputs, p = moving(name)
    dynamics = torch_dynamics(name)
    x, u, given = (torch.tensor(array, requires_grad=True) for array in (states, inputs, p))
    dynamics.rollout(x, u, given, every=2)[1].sum().backward()
    rng, h = np.random.default_rng(4), 1e-5
    moves, controls, numbers = directions(kernels, states), rng.normal(size=u.shape), p * rng.normal()

    def cost(size):
        start = kernels.retract(states, size * moves)
        return float(dynamics.rollout(start, inputs + size * controls, p + size * numbers)[1].sum())

    found = (x.grad.numpy() * along(kernels, states, moves)).sum() + (u.grad.numpy() * controls).sum()
    found += (given.grad.numpy() * numbers).sum()
    np.testing.assert_allclose(found, (cost(h) - cost(-h)) / (2 * h), rtol=1e-6)


def test_parameters_of_each_step(torch):
    kernels, states, inputs, _ = moving("tumbling-target", rows=1)
    stages = kernels.stage_parameters()[: STEPS + 1]
    flown, costs = torch_dynamics("tumbling-target").rollout(states[0], inputs, stages[:, None])
    x = states
    for k in range(STEPS):
        np.testing.assert_allclose(costs[k], kernels.cost(x, inputs[k], p=stages[k]), rtol=1e-13)
        x = kernels.step(x, inputs[k], p=stages[k])
    np.testing.assert_allclose(costs[-1], kernels.terminal_cost(x, p=stages[-1]), rtol=1e-13)
    np.testing.assert_allclose(flown[-1], x, rtol=1e-13, atol=1e-13)


def test_a_batch_of_no_states_has_no_results(torch):
    """As of the kernels: a mask may leave none."""
    kernels, dynamics = compile_scene("planar"), torch_dynamics("planar")
    x = torch.zeros((0, kernels.n_x), dtype=torch.float64)
    u = torch.zeros((STEPS, 0, kernels.n_u), dtype=torch.float64, requires_grad=True)
    assert dynamics.step(x, u[0]).shape == dynamics.step(x, u.new_zeros(kernels.n_u)).shape == x.shape
    assert dynamics.terminal_cost(x).shape == (0,)
    for every in (1, 3):
        states, costs = dynamics.rollout(x, u, every=every)
        assert (states.shape, costs.shape) == ((STEPS // every + 1, 0, kernels.n_x), (STEPS + 1, 0))
        (by_u,) = torch.autograd.grad(costs.sum() + states.sum(), u)
        assert by_u.shape == u.shape


def test_misuse_of_tensors_is_named(torch):
    dynamics = torch_dynamics("planar")
    _, states, inputs, _ = moving("planar")
    x, u = torch.tensor(states), torch.tensor(inputs, requires_grad=True)
    with pytest.raises(ValueError, match=r"x: dtype torch.float32, scene 'planar' computes in torch.float64"):
        dynamics.step(x.float(), u[0])
    with pytest.raises(ValueError, match="x: on device meta, the kernels run on the CPU"):
        dynamics.step(x.to("meta"), u[0])
    with pytest.raises(ValueError, match=r"u: shape \(3, 2\), should be \(6\) or \(B, 6\)"):
        dynamics.step(x, u[0, :, :2])
    with pytest.raises(ValueError, match=r"u: shape \(6,\), should be \(N, 6\) or \(N, B, 6\)"):
        dynamics.rollout(x, u[0, 0])
    with pytest.raises(ValueError, match=r"u: shape \(\), should be \(N, 6\) or \(N, B, 6\)"):
        dynamics.rollout(x, u[0, 0, 0])
    with pytest.raises(ValueError, match=r"p: shape \(2,\), should be \(0\) or \(B, 0\) or \(N \+ 1, B, 0\)"):
        dynamics.rollout(x, u, p=x[0, :2])
    with pytest.raises(ValueError, match="batches differ in length"):
        dynamics.step(x[:2], u[0])
    with pytest.raises(ValueError, match="every: 4, the 6 steps"):
        dynamics.rollout(x, u, every=4)
    with pytest.raises(ValueError, match="'rk5' is unknown; did you mean"):
        torch_dynamics("planar", "rk5")
    (by_u,) = torch.autograd.grad(dynamics.cost(x, u[0]).sum(), u, create_graph=True)
    with pytest.raises(NotImplementedError, match="the kernels have first derivatives only"):
        (by_u.sum() + u.sum()).backward()


def test_maps_and_jacobians_are_those_of_single_calls(torch):
    kernels, states, inputs, p = moving("planar")
    x, u, p = torch.tensor(states), torch.tensor(inputs), torch.tensor(p)
    dynamics, func = torch_dynamics("planar"), torch.func
    for i, found in enumerate(func.vmap(dynamics.step, (None, 1, None))(x[0], u[:2], p)):
        np.testing.assert_array_equal(found, dynamics.step(x[0], u[:2, i], p))
    rows = []
    for entry in range(kernels.n_x):
        given = [each.clone().requires_grad_() for each in (x, u[0], p)]
        rows.append(torch.autograd.grad(dynamics.step(*given)[:, entry].sum(), given[:2]))
    found = func.vmap(func.jacrev(dynamics.step, (0, 1)), (0, 0, None))(x, u[0], p)
    for part, expected in zip(found, zip(*rows, strict=True), strict=True):
        np.testing.assert_allclose(part, torch.stack(expected, 1), rtol=1e-12, atol=1e-12)

    def cost(x, u):
        return dynamics.rollout(x, u, p, every=2)[1].sum()

    given = u.clone().requires_grad_()
    (by_u,) = torch.autograd.grad(cost(x, given), given)
    np.testing.assert_allclose(func.vmap(func.grad(cost, 1), (0, 1), 1)(x, u), by_u, rtol=1e-12, atol=1e-12)


@pytest.mark.filterwarnings("ignore:`torch.jit.script` is deprecated:FutureWarning")  # PyTorch's own
def test_derivatives_that_kernels_lack_are_refused_by_name(torch):
    dynamics = torch_dynamics("planar")
    _, states, inputs, _ = moving("planar")
    x, u = torch.tensor(states[0]), torch.tensor(inputs[0, 0])
    with pytest.raises(NotImplementedError, match="no derivatives in forward mode: take reverse mode"):
        torch.func.jacfwd(dynamics.step, 1)(x, u)
    with pytest.raises(NotImplementedError, match="first derivatives only"):
        torch.func.jacrev(torch.func.jacrev(dynamics.cost, 1), 1)(x, u)
    with pytest.raises(NotImplementedError, match=r"vectorize=True.*: take torch\.func\.jacrev"):
        torch.autograd.functional.jacobian(lambda u: dynamics.step(x, u), u, vectorize=True)


def test_arrays_may_change_before_the_gradient(torch):
    dynamics = torch_dynamics("planar")
    _, states, inputs, _ = moving("planar")
    gradients = []
    for change in (0.0, 1.0):
        x, u = states.copy(), torch.tensor(inputs[0], requires_grad=True)
        total = dynamics.step(x, u).sum()
        x += change
        gradients += torch.autograd.grad(total, u)
    np.testing.assert_array_equal(*gradients)


def test_modules_that_hold_dynamics_are_copied_and_saved(torch, tmp_path):
    class Model(torch.nn.Module):
        def __init__(self):
            super().__init__()
            self.dynamics = torch_dynamics("planar", "rk8", dt=0.03, threads=2)

    model = Model()
    torch.save(model.dynamics, tmp_path / "dynamics.pt")
    x, u = (each[0] for each in moving("planar")[1:3])
    for each in (copy.deepcopy(model).dynamics, torch.load(tmp_path / "dynamics.pt", weights_only=False)):
        np.testing.assert_array_equal(each.step(x, u[0]), model.dynamics.step(x, u[0]))


def test_single_precision(torch):
    scene = load_scene("planar").replace(simulation={"precision": "float32"})
    _, states, inputs, _ = moving(scene)
    x, u = torch.tensor(states).float(), torch.tensor(inputs).float().requires_grad_()
    costs = torch_dynamics(scene).rollout(x, u)[1]
    costs.sum().backward()
    double = torch.tensor(inputs, requires_grad=True)
    torch_dynamics("planar").rollout(torch.tensor(states), double)[1].sum().backward()
    assert costs.dtype == torch.float32
    np.testing.assert_allclose(u.grad, double.grad, rtol=2e-3, atol=2e-3)


# JAX.


EMITTED = [("short", "rk4"), ("planar", "momentum_rk4"), ("wheels", "symplectic_euler")]
LONG = [("paper", "rk4"), ("paper", "symplectic_euler"), ("planar", "rk8"), ("motors", "symplectic_euler")]
"""XLA compiles these for a minute."""


@pytest.fixture
def scene_named(short_scene):
    return lambda name: short_scene if name == "short" else load_scene(name)


@pytest.mark.slow
@pytest.mark.parametrize(
    ("name", "integrator"), [*EMITTED, *(pytest.param(*case, marks=pytest.mark.endurance) for case in LONG)]
)
def test_what_xla_compiles_is_the_step_of_the_kernels(name, integrator, jax, scene_named):
    scene = scene_named(name)
    kernels, states, inputs, p = moving(scene)
    dynamics = jax_dynamics(scene, integrator)
    expected = kernels.step(states, inputs[0], p=p, integrator=integrator)
    scale = np.abs(expected).max()
    for mapped in (False, True):
        step = jax.jit(jax.vmap(dynamics.step, in_axes=(0, 0, None)) if mapped else dynamics.step)
        np.testing.assert_allclose(step(states, inputs[0], p), expected, rtol=0.0, atol=1e-12 * scale)
    for found, cost in (
        (dynamics.cost(states, inputs[0], p), kernels.cost(states, inputs[0], p=p)),
        (dynamics.terminal_cost(states, p), kernels.terminal_cost(states, p=p)),
    ):
        np.testing.assert_allclose(found, cost, rtol=1e-12)


@pytest.mark.endurance
@pytest.mark.parametrize("name", list_scenes())
def test_every_scene_is_emitted(name, jax):
    scene = load_scene(name)
    integrator = scene.simulation.integrator
    if INTEGRATORS[integrator].is_adaptive or INTEGRATORS[integrator].symplectic:
        integrator = "rk4"
    kernels, states, inputs, p = moving(name)
    expected = kernels.step(states, inputs[0], p=p, integrator=integrator)
    found = jax_dynamics(name, integrator).step(states, inputs[0], p)
    np.testing.assert_allclose(found, expected, rtol=0.0, atol=1e-12 * np.abs(expected).max())


@pytest.mark.sampled
@pytest.mark.parametrize(
    ("name", "integrator"),
    [
        ("short", "symplectic_euler"),
        ("planar", "rk4"),
        pytest.param("random-masses", "symplectic_euler", marks=pytest.mark.endurance),
    ],
)
def test_gradients_by_xla_are_those_of_the_kernels(name, integrator, jax, scene_named):
    """At rest, too, where a formula that divides by an angle has no derivative."""
    scene = scene_named(name)
    kernels, states, inputs, p = moving(scene)
    controls = inputs[0].copy()
    states[0], controls[0] = kernels.layout.initial_state, 0.0
    v = np.random.default_rng(2).normal(size=states.shape)
    moved, results = along(kernels, states, directions(kernels, states)), []
    for given in (True, False):
        dynamics = jax_dynamics(scene, integrator, kernels=given)
        step = jax.jit(lambda x, u, p, v, step=dynamics.step: jax.vjp(step, x, u, p)[1](v))
        by_x, by_u, by_p = step(states, controls, p, v)
        results.append([(by_x * moved).sum(axis=1), by_u, by_p])
    for expected, found in zip(*results, strict=True):
        scale = np.abs(expected).max(initial=1.0)
        np.testing.assert_allclose(found, expected, rtol=0.0, atol=1e-10 * scale)


@pytest.mark.parametrize("kernels", [pytest.param(False, marks=pytest.mark.endurance), True])
def test_rollouts_in_jax_are_those_in_torch(kernels, jax, torch, short_scene):
    _, states, inputs, _ = moving(short_scene)
    dynamics = jax_dynamics(short_scene, "symplectic_euler", kernels=kernels)

    def cost(x, u):
        flown, costs = dynamics.rollout(x, u, every=3)
        return costs.sum() + (flown[-1] ** 2).sum()

    u = torch.tensor(inputs, requires_grad=True)
    flown, costs = torch_dynamics(short_scene, "symplectic_euler").rollout(torch.tensor(states), u, every=3)
    total = costs.sum() + (flown[-1] ** 2).sum()
    total.backward()
    found, by_u = jax.jit(jax.value_and_grad(cost, 1))(states, inputs)
    np.testing.assert_allclose(found, total.detach(), rtol=1e-12)
    np.testing.assert_allclose(by_u, u.grad, rtol=1e-10, atol=1e-10)
    # The same, mapped over states, whose parameters are shared.
    found, by_u = jax.vmap(jax.value_and_grad(cost, 1), (0, 1), (0, 1))(states, inputs)
    np.testing.assert_allclose(found.sum(), total.detach(), rtol=1e-12)
    np.testing.assert_allclose(by_u, u.grad, rtol=1e-10, atol=1e-10)
    assert dynamics.cost(states[:0], inputs[0, :0]).shape == (0,)


@pytest.mark.slow
def test_second_derivatives_by_xla(jax, short_scene):
    _, states, inputs, _ = moving(short_scene)
    x, u, h = states[0], inputs[0, 0], 1e-5
    cost = jax_dynamics(short_scene).cost
    found, push = jax.jit(jax.hessian(cost))(x, u), np.random.default_rng(5).normal(size=x.shape)
    np.testing.assert_allclose(found, found.T, rtol=0, atol=1e-12)
    assert np.abs(found).max() > 1.0
    gradient = jax.jit(jax.grad(cost))
    change = (gradient(x + h * push, u) - gradient(x - h * push, u)) / (2 * h)
    np.testing.assert_allclose(found @ push, change, rtol=1e-6, atol=1e-6)


def test_second_derivatives_of_kernels_are_refused(jax, short_scene):
    _, states, inputs, _ = moving(short_scene)
    x, u, dynamics = states[0], inputs[0, 0], jax_dynamics(short_scene, kernels=True)
    with pytest.raises(NotImplementedError, match="the kernels have first derivatives only"):
        jax.grad(lambda u: jax.grad(lambda u: dynamics.cost(x, u))(u).sum())(u)
    with pytest.raises(TypeError, match="forward-mode"):
        jax.jvp(lambda u: dynamics.step(x, u), (u,), (u,))


@pytest.mark.parametrize("kernels", [False, True])
def test_dynamics_in_jax_are_copied(kernels, jax, short_scene):
    dynamics = jax_dynamics(short_scene, "symplectic_euler", dt=0.03, kernels=kernels)
    for copied in (copy.deepcopy(dynamics), pickle.loads(pickle.dumps(dynamics))):
        assert type(copied) is type(dynamics)
        assert (copied.scene, copied.integrator, copied.dt) == (short_scene, "symplectic_euler", 0.03)


def test_kernels_take_every_integrator(jax):
    kernels, states, inputs, _ = moving("planar")
    for name in ("dormand_prince", "rodas4"):
        found = jax.jit(jax_dynamics("planar", name, kernels=True).step)(states, inputs[0])
        np.testing.assert_array_equal(found, kernels.step(states, inputs[0], integrator=name))
        with pytest.raises(ValueError, match=rf"'{name}' repeats calls .* JAX .* integrator='rk8'"):
            jax_dynamics("planar", name)


ON_ONE_PROCESSOR = """
import os
os.sched_setaffinity(0, {min(os.sched_getaffinity(0))})
import jax
import numpy as np
from dq_space_arm_env import jax_dynamics
jax.config.update("jax_enable_x64", True)
dynamics = jax_dynamics("planar", "symplectic_euler", kernels=True)
inputs = np.zeros((30, 2048, dynamics.layout.n_u))
cost = jax.jit(lambda u: dynamics.rollout(np.array(dynamics.layout.initial_state), u + 0.1)[1].sum())
print(np.isfinite(cost(inputs)))
"""


@pytest.mark.slow
@pytest.mark.skipif(not hasattr(os, "sched_setaffinity"), reason="processes choose no processors here")
def test_kernels_called_on_one_processor_wait_for_no_other(jax):
    """Where a large array came from another thread, there was none to bring it."""
    command = [sys.executable, "-c", ON_ONE_PROCESSOR]
    done = subprocess.run(command, capture_output=True, text=True, timeout=120, check=True)
    assert done.stdout == "True\n"


def test_wrong_precision_in_jax_is_named(jax):
    dynamics = jax_dynamics("planar", kernels=True)
    _, states, inputs, _ = moving("planar")
    with pytest.raises(ValueError, match=r"x: dtype float32, scene 'planar' computes in float64: convert"):
        dynamics.step(states.astype(np.float32), inputs[0])
    jax.config.update("jax_enable_x64", False)
    with pytest.raises(ValueError, match="jax_enable_x64', True"):
        dynamics.step(states, inputs[0])


@pytest.mark.parametrize("kernels", [pytest.param(False, marks=pytest.mark.slow), True])
def test_single_precision_in_jax_needs_no_double(kernels, jax, short_scene):
    scene = short_scene.replace(simulation={"precision": "float32"})
    _, states, inputs, _ = moving(scene)
    expected = compile_scene(short_scene).step(states, inputs[0])
    jax.config.update("jax_enable_x64", False)
    found = jax_dynamics(scene, kernels=kernels).step(states, inputs[0])
    assert found.dtype == np.float32
    np.testing.assert_allclose(found, expected, rtol=1e-5, atol=1e-5)


@pytest.mark.slow
def test_every_operation_is_emitted(jax):
    """Against NumPy, at points where each is defined."""
    from dq_space_arm_env.interoperability.xla_functions import xla_function

    unary = {"negate", "square", "twice", "invert", "sqrt", "absolute", "sign", "floor", "not"}
    unary |= {"sin", "cos", "arctan", *LIBRARY_FUNCTIONS} - {"power"}

    def outputs(x):
        found = []
        for name, function in EXPRESSIONS.items():
            first = x[2] if name == "arccosh" else x[0]
            found.append(function(first) if name in unary else function(first, x[1]))
        return {"y": found}

    graph = trace("all", {"x": 3}, outputs)
    program = Program("all", [Buffer("x", 3)], [Buffer("y", len(EXPRESSIONS))])
    program.call(graph)
    function = xla_function(jax, program, np.dtype(np.float64))
    for x in (np.array([0.3, 0.7, 1.5]), np.array([0.6, -0.2, 2.5]), np.array([0.4, 0.4, 1.1])):
        expected = evaluate_graph(graph, [x], np.float64)[0]
        np.testing.assert_allclose(function(x=x), expected, rtol=1e-14, atol=1e-15)


@pytest.mark.parametrize(("make", "package"), [(torch_dynamics, "torch"), (jax_dynamics, "jax")])
def test_a_missing_package_is_named(make, package, monkeypatch):
    monkeypatch.setitem(__import__("sys").modules, package, None)
    with pytest.raises(ImportError, match=rf"{package}_dynamics needs .*pip install"):
        make("planar")
