"""What a caller of the kernels sees: shapes, errors, bit equality, and how much each scene needs."""

import copy
import gc
import pickle
import weakref

import numpy as np
import pytest

from dq_space_arm_env import DQSpaceArmEnv, compile_scene, list_scenes, load_scene
from dq_space_arm_env.kernels.bound import KernelCall
from scripts.benchmarks.robots import robots


@pytest.mark.sampled
@pytest.mark.parametrize("scene", robots())
def test_batches_give_the_bits_of_single_states(scene, draw):
    kernels, states, inputs = draw(scene, 11)
    functions = {
        "step": kernels.step,
        "forward_dynamics": kernels.forward_dynamics,
        "cost": kernels.cost,
        "tip_pose": lambda x, u: kernels.tip_pose(x),
        "momentum": lambda x, u: kernels.momentum(x),
        "energy": lambda x, u: kernels.energy(x),
    }
    for name, function in functions.items():
        batch = function(states, inputs)
        single = [function(x, u) for x, u in zip(states, inputs, strict=True)]
        np.testing.assert_array_equal(batch, single, err_msg=name)


def test_results_have_the_form_of_the_arguments(draw):
    kernels, states, inputs = draw("paper", 3)
    assert kernels.step(states[0], inputs[0]).shape == (23,)
    assert kernels.step(states, inputs).shape == (3, 23)
    assert kernels.step(states[:1], inputs[:1]).shape == (1, 23)
    assert kernels.step(states, inputs[0]).shape == (3, 23)
    a, b = kernels.linearize(states, inputs)
    assert (a.shape, b.shape) == ((3, 21, 21), (3, 21, 12))
    assert kernels.cost(states, inputs).shape == (3,)
    assert np.ndim(kernels.cost(states[0], inputs[0])) == 0
    assert kernels.reaction_wrenches(states, inputs).shape == (3, 15)
    assert kernels.momentum(states[0]).shape == (6,)


def test_inputs_are_not_changed_and_need_not_be_contiguous(draw):
    kernels, states, inputs = draw("paper", 8)
    before = states.copy()
    strided = np.repeat(states, 2, axis=1)[:, ::2]
    np.testing.assert_array_equal(kernels.step(strided, inputs), kernels.step(states, inputs))
    np.testing.assert_array_equal(states, before)


@pytest.mark.parametrize(
    ("call", "message"),
    [
        (lambda k, x, u: k.step(x[:-1], u), "x has 22 entries per row, scene 'paper' has 23"),
        (lambda k, x, u: k.step(x, u[:-1]), "u has 11 entries per row, scene 'paper' has 12"),
        (lambda k, x, u: k.step(x[None, None], u), r"x: shape \(1, 1, 23\)"),
        (lambda k, x, u: k.step(np.tile(x, (2, 1)), np.tile(u, (3, 1))), "batches differ in length"),
        (lambda k, x, u: k.step(x, u, integrator="rk5"), "integrator: 'rk5' is unknown; choose from .*rk4"),
        (lambda k, x, u: k.step(x, u, integrator=["rk4"]), r"integrator: \['rk4'\] is unknown; choose from"),
        (lambda k, x, u: k.checked_step(x, u, integrator=["rk4"]), r"integrator: \['rk4'\] is unknown"),
        (lambda k, x, u: k.step([[1.0, 2.0], [3.0]], u), "x: rows that differ in length, should be an array"),
        (lambda k, x, u: k.numerical_error([x, x], 0.0), r"states, u: shapes \(2, 23\) and \(\), should be"),
        (lambda k, x, u: k.step(x, u, dt=float("nan")), "dt: nan is not a finite time step"),
        (lambda k, x, u: k.step(x, u, dt="a"), "dt: 'a' is not a finite time step"),
        (lambda k, x, u: k.step(x, u, dt=True), "dt: True is not a finite time step"),
        (lambda k, x, u: k.simulate(x, u, 0), "steps: 0, should be a whole number of at least 1"),
        (lambda k, x, u: k.simulate(x, u, 2.5), "steps: 2.5, should be a whole number of at least 1"),
        (lambda k, x, u: k.simulate(x, u, 4, every=2.0), "every: 2.0, should be a whole number"),
    ],
)
def test_wrong_arguments_are_named(call, message, draw):
    kernels, states, inputs = draw("paper", 1)
    with pytest.raises(ValueError, match=message):
        call(kernels, states[0], inputs[0])


def test_actuators_that_lag_need_a_time(draw):
    kernels, states, inputs = draw(
        load_scene("planar").replace({"actuators.base_torque.time_constant": 0.1}), 1
    )
    with pytest.raises(ValueError, match=r"dt: 0, should not be 0: actuators lag"):
        kernels.step(states[0], inputs[0], dt=0)


def test_a_call_of_one_row_keeps_its_arrays_alive(draw):
    kernels, states, inputs = draw("paper", 1)
    kernel = kernels.kernel("step", lanes=1)
    arrays = {"x": states[0].copy(), "u": inputs[0].copy(), "h": np.array([0.015]), "x_next": np.zeros(23)}
    references = [weakref.ref(array) for array in arrays.values()]
    result = arrays["x_next"]
    incomplete = KernelCall(kernel, {name: array for name, array in arrays.items() if name != "x_next"})
    for run in (incomplete.of_one_row, lambda: incomplete(1)):
        with pytest.raises(ValueError, match=r"the kernel has no array for x_next$"):
            run()
    run = KernelCall(kernel, arrays).of_one_row()
    del arrays
    gc.collect()
    assert all(reference() is not None for reference in references)
    run()
    np.testing.assert_array_equal(result, kernels.step(states[0], inputs[0]))


def test_the_same_scene_gives_the_same_kernels():
    assert compile_scene("paper") is compile_scene(load_scene("paper"))


def test_copies_of_kernels_are_the_same_kernels():
    kernels = compile_scene("planar", threads=2)
    assert copy.deepcopy(kernels) is kernels
    assert pickle.loads(pickle.dumps(kernels)) is kernels


def test_difference_and_retraction_are_inverse(draw):
    for scene in ("paper", "planar"):
        kernels, states, _ = draw(scene, 20)
        dx = np.random.default_rng(5).normal(size=(20, kernels.n_t)) * 0.5
        moved = kernels.retract(states, dx)
        np.testing.assert_allclose(kernels.difference(states, moved), dx, rtol=0, atol=2e-13)


def size_of(scene):
    kernels = compile_scene(scene)
    dynamics, step = (kernels.operation_count(name) for name in ("forward_dynamics", "step"))
    return {"states": kernels.n_x, "inputs": kernels.n_u, "dynamics": dynamics, "step": step}


@pytest.mark.slow
def test_what_a_scene_does_not_need_is_not_there():
    sizes = {scene: size_of(scene) for scene in list_scenes()}
    paper = sizes["paper"]
    whole = {"paper": (23, 12), "free-floating": (23, 6), "no-wrist": (20, 9), "planar": (13, 6)}
    assert {name: (sizes[name]["states"], sizes[name]["inputs"]) for name in whole} == whole
    # Leaving out actuators, the wrist, or dimensions of space leaves out operations; more joints or a load
    # add some.
    for smaller in ("free-floating", "reaction-wheels", "planar"):
        assert sizes[smaller]["dynamics"] < paper["dynamics"], smaller
    for smaller in ("free-floating", "reaction-wheels", "no-wrist", "planar"):
        assert sizes[smaller]["step"] < paper["step"], smaller
    assert sizes["free-floating"]["dynamics"] < sizes["reaction-wheels"]["dynamics"]
    assert sizes["planar"]["step"] < 0.41 * paper["step"]
    assert sizes["tip-load"]["dynamics"] > paper["dynamics"]
    assert sizes["six-joint"]["dynamics"] > paper["dynamics"]
    assert sizes["far"] == paper


def test_a_feature_removed_from_the_paper_scene_pays():
    paper = load_scene("paper")
    whole = size_of(paper)
    without_force = paper.actuators.model_copy(update={"base_force": None})
    smaller = size_of(paper.replace(actuators=without_force))
    assert smaller["inputs"] == whole["inputs"] - 3
    assert smaller["dynamics"] < whole["dynamics"]
    locked = [link.model_dump() | {"actuated": i > 0} for i, link in enumerate(paper.links)]
    passive = size_of(paper.replace(links=locked))
    assert passive["inputs"] == whole["inputs"] - 1
    assert passive["dynamics"] <= whole["dynamics"]
    springs = [link.model_dump() | {"stiffness": 1.0} for link in paper.links]
    assert size_of(paper.replace(links=springs))["dynamics"] > whole["dynamics"]


@pytest.mark.parametrize("name", ["paper", "dual-arm", "tumbling-target"])
def test_errors_of_the_tips_are_those_that_the_environment_reports(name):
    scene = load_scene(name)
    if scene.other_tips:  # whose velocities count too
        scene = scene.replace(success={"velocity_error": 0.01, "angular_velocity_error_deg": 1.0})
    env = DQSpaceArmEnv(scene)
    env.reset(seed=1)
    names = ["attitude_error", "position_error", "angular_velocity_error", "velocity_error"]
    action = np.linspace(-1.0, 1.0, env.action_space.shape[0], dtype=np.float32)
    for _ in range(5):
        info = env.step(action)[4]
    errors = compile_scene(scene).tip_errors(env.state, p=env.stage_parameters)
    assert len(errors) == (2 if name == "paper" else 4)
    np.testing.assert_array_equal(errors, [info[name] for name in names[: len(errors)]])
    if scene.other_tips:
        main = compile_scene(scene).relative_twist(env.state, p=env.stage_parameters)
        assert errors[3] > np.linalg.norm(main[3:])  # the other tip is the faster one


ACTUATORS = {
    "motors": {},
    "wheels": {"actuators.wheels.0.power": 0.05, "constraints": []},
    "thrusters": {"actuators.thrusters.0.minimum_impulse": 0.05},
    "paper": {"actuators.base_force": {"limit": 10.0, "slew_limit": 100.0}},
}


@pytest.mark.parametrize("name", ACTUATORS)
def test_applied_inputs_are_those_that_act_in_the_environment(name):
    scene = load_scene(name).replace(ACTUATORS[name]) if ACTUATORS[name] else load_scene(name)
    env, kernels = DQSpaceArmEnv(scene), compile_scene(scene)
    env.reset(seed=2)
    rng, clipped = np.random.default_rng(3), False
    for _ in range(40):
        x, row = env.state, env.stage_parameters
        action = rng.choice([-1.0, 0.3, 1.0], kernels.n_u)
        asked = kernels.layout.to_control(action, row if kernels.n_p else None)
        acting = kernels.applied_inputs(x, asked, p=row)
        env.step(action)
        np.testing.assert_allclose(env.state, kernels.step(x, acting, p=row), rtol=0.0, atol=1e-9)
        clipped = clipped or bool(np.abs(acting - asked).max() > 1e-3)
    assert clipped
