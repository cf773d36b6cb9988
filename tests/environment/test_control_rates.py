"""Limits of rates of controls: the controls before are part of the state, and changes are charged."""

import math

import numpy as np
import pytest
from gymnasium.utils.env_checker import check_env

from dq_space_arm_env import (
    DQSpaceArmEnv,
    DQSpaceArmGoalEnv,
    DQSpaceArmVectorEnv,
    SceneError,
    compile_scene,
    load_scene,
)
from dq_space_arm_env.kernels import Kernels
from dq_space_arm_env.kernels.programs.scene_programs import ScenePrograms
from dq_space_arm_env.scene.constraint_rows import rates_of
from dq_space_arm_env.scene.parameters import thruster_names

PLAIN = load_scene("planar").replace(simulation={"steps": 30})
RATES = {"kind": "control_rate", "name": "slew", "base_torque": 4.0, "joint_torque": 2.0, "tolerance": 0.1}
LIMITED = PLAIN.replace(constraints=[RATES])


def rates_and_point(seed=0):
    kernels, rng = compile_scene(LIMITED), np.random.default_rng(seed)
    x = kernels.retract(kernels.layout.initial_state, 0.3 * rng.standard_normal(kernels.n_t))
    return kernels, compile_scene(PLAIN), x, rng.uniform(-1.0, 1.0, kernels.n_u)


@pytest.mark.slow
def test_the_state_ends_with_the_controls_before():
    kernels, plain, x, u = rates_and_point()
    layout = kernels.layout
    kept, n = list(layout.previous_controls), plain.n_x
    assert layout.state.names[n:] == tuple(f"previous {layout.control.names[i]}" for i in kept)
    assert layout.state.units[n:] == tuple(layout.control.units[i] for i in kept)
    assert layout.control.names[kept[0]] == "base torque z"
    for integrator in ("rk4", "symplectic_euler", "dormand_prince", "gauss6", "momentum_rk4"):
        after = kernels.step(x, u, integrator=integrator)
        np.testing.assert_array_equal(after[n:], u[kept])
        np.testing.assert_allclose(after[:n], plain.step(x[:n], u, integrator=integrator), rtol=0, atol=1e-14)


@pytest.mark.slow
def test_derivatives_of_a_step_are_those_of_the_motion_and_ones():
    kernels, plain, x, u = rates_and_point()
    n_x, n_t, kept = plain.n_x, plain.n_t, list(kernels.layout.previous_controls)
    for integrator in ("rk4", "dormand_prince"):
        a, b = kernels.linearize(x, u, integrator=integrator)
        a_plain, b_plain = plain.linearize(x[:n_x], u, integrator=integrator)
        np.testing.assert_allclose(a[:n_t, :n_t], a_plain, rtol=0, atol=1e-14)
        np.testing.assert_allclose(b[:n_t], b_plain, rtol=0, atol=1e-14)
        assert not a[n_t:].any()
        assert not a[:, n_t:].any()
        np.testing.assert_array_equal(b[n_t:], np.eye(kernels.n_u)[kept])


def hessian(kernels: Kernels, x, u, multiplier):
    kernel = kernels.kernel("lagrangian_hessian", lanes=1)
    given = {"x": x, "u": u, "multiplier": multiplier, "h": [0.015], "parameters": kernels.parameters.nominal}
    arrays = [np.atleast_2d(np.asarray(given[spec.name], dtype=float)) for spec in kernel.inputs]
    blocks = [np.zeros((1, spec.stride)) for spec in kernel.outputs]
    kernel([*arrays, *blocks], 1, 1)
    heights = (len(multiplier), u.size, u.size)
    xx, ux, uu = (block[0].reshape(rows, -1) for block, rows in zip(blocks, heights, strict=True))
    return np.block([[xx, ux.T], [ux, uu]])


@pytest.mark.slow
def test_second_derivatives_are_those_of_the_motion():
    kernels, plain, x, u = rates_and_point()
    n_t = plain.n_t
    multiplier = np.random.default_rng(1).standard_normal(kernels.n_t)
    whole = hessian(kernels, x, u, multiplier)
    of_motion = [*range(n_t), *range(kernels.n_t, kernels.n_t + kernels.n_u)]
    expected = hessian(plain, x[: plain.n_x], u, multiplier[:n_t])
    np.testing.assert_allclose(whole[np.ix_(of_motion, of_motion)], expected, rtol=0, atol=1e-12)
    assert not whole[n_t : kernels.n_t].any()


def test_dense_output_ends_with_the_control():
    kernels, plain, x, u = rates_and_point()
    motion, n = kernels.integrate(x, u, 0.2), plain.n_x
    np.testing.assert_allclose(motion.x[-1], motion.sol(0.2), rtol=0, atol=1e-14)
    for state in motion.x[1:]:
        np.testing.assert_array_equal(state[n:], u[list(kernels.layout.previous_controls)])
    np.testing.assert_allclose(motion.x[-1, :n], plain.integrate(x[:n], u, 0.2).x[-1], rtol=0, atol=1e-14)


def test_a_scene_without_limits_has_nothing_of_it():
    programs, limited = ScenePrograms(PLAIN), ScenePrograms(LIMITED)
    for name in ("step", "linearize", "lagrangian_hessian"):
        count = programs.build(name).operation_count
        assert limited.build(name).operation_count == count  # what is kept is copied
    assert not programs.layout.previous_controls
    assert "previous_controls" not in PLAIN.to_yaml()


def test_changes_are_charged_and_observed():
    env, kernels = DQSpaceArmEnv(LIMITED), compile_scene(LIMITED)
    check_env(env, skip_render_check=True)
    observation, info = env.reset(seed=3)
    n, kept, dt = kernels.n_x, list(kernels.layout.previous_controls), LIMITED.simulation.dt
    previous, most = np.zeros(len(kept)), np.array([4.0] + [2.0] * (len(kept) - 1)) * dt
    rng = np.random.default_rng(4)
    for _ in range(5):
        np.testing.assert_array_equal(observation[n - len(kept) : n], previous)
        np.testing.assert_allclose(kernels.state_from_observation(observation), env.state, rtol=0, atol=1e-12)
        action = rng.uniform(-0.02, 0.02, kernels.n_u)
        observation, _, _, _, info = env.step(action)
        u = kernels.layout.to_control(action)[kept]
        falls, rises = previous - u - most, u - previous - most
        residuals = list(info["constraints"].values())
        np.testing.assert_allclose(residuals, np.stack([falls, rises], 1).ravel(), rtol=0, atol=1e-14)
        assert info["cost"] == pytest.approx(np.maximum([falls, rises], 0.0).sum() / 0.1, abs=1e-12)
        previous = u
    saved = env.get_state()
    ahead = env.step(np.zeros(kernels.n_u))
    env.set_state(saved)
    np.testing.assert_array_equal(env.step(np.zeros(kernels.n_u))[0], ahead[0])


def test_vector_and_goal_environments_see_the_same():
    vector, single, goal = DQSpaceArmVectorEnv(2, LIMITED), DQSpaceArmEnv(LIMITED), DQSpaceArmGoalEnv(LIMITED)
    for environment in (vector, single, goal):
        environment.reset(seed=6)
    for action in np.random.default_rng(0).uniform(-1.0, 1.0, (5, single.action_space.shape[0])):
        observations, _, _, _, info = vector.step(np.tile(action, (2, 1)))
        observation, _, _, _, expected = single.step(action)
        np.testing.assert_array_equal(observations[0], observation)
        assert info["cost"][0] == expected["cost"]
        np.testing.assert_array_equal(goal.step(action)[0]["observation"], single.state)


def test_the_control_before_the_episode_is_given():
    count = len(compile_scene(LIMITED).layout.previous_controls)
    given = LIMITED.replace(initial_state={"previous_controls": np.linspace(0.5, 1.5, count).tolist()})
    env = DQSpaceArmEnv(given)
    env.reset(seed=1)
    np.testing.assert_array_equal(env.state[-count:], np.linspace(0.5, 1.5, count))
    with pytest.raises(SceneError, match=rf"must be {count} numbers \(base torque z, "):
        LIMITED.replace(initial_state={"previous_controls": [1.0]})
    _, info = env.reset(options={"nominal": True})
    assert info["cost"] == 0.0  # nothing changes before the first step
    np.testing.assert_allclose(
        list(info["constraints"].values()),
        np.tile([-4.0, -4.0] + [-2.0] * (2 * count - 2), 1) * LIMITED.simulation.dt,
    )
    with pytest.raises(SceneError, match="nothing limits a control's rate"):
        PLAIN.replace(initial_state={"previous_controls": [1.0]})
    with pytest.raises(SceneError, match=r"previous_controls\[0\] = 99.0: must be within the limits of base"):
        LIMITED.replace(initial_state={"previous_controls": [99.0] * count})


def test_each_joint_wheel_and_thruster_may_have_a_rate_of_its_own():
    rates = {"kind": "control_rate", "name": "slew"}
    links = [5.0, math.inf, 1.0]
    few = load_scene("planar").replace(
        constraints=[{**rates, "joint_torque": links, "base_force": [1, 2, 3]}]
    )
    names, most = zip(*((limit.name, limit.rate) for limit in rates_of(few)), strict=True)
    first, _, last = (link.name for link in few.links)
    assert names == ("base force x", "base force y", f"{first} torque", f"{last} torque")
    assert most == (1.0, 2.0, 5.0, 1.0)
    wheels = load_scene("wheels").replace(constraints=[{**rates, "wheels": [1, 2, 3, 4]}])
    assert [limit.rate for limit in rates_of(wheels)] == [1.0, 2.0, 3.0, 4.0]
    jets = load_scene("thrusters").replace(constraints=[{**rates, "thrusters": 2.0}])
    assert [limit.name for limit in rates_of(jets)] == [f"{name} force" for name in thruster_names(jets)]
    with pytest.raises(
        SceneError, match=r"previous_controls\[3\] = -0.5: must be within the limits of .*, 0 to"
    ):
        jets.replace(
            initial_state={"previous_controls": [0.0, 0.0, 0.0, -0.5] + [0.0] * (len(rates_of(jets)) - 4)}
        )
    heavy = load_scene("heavy-wrist")  # whose wrist has three torques
    torques = [float(index + 1) for index in range(len(heavy.links))]
    heavy = heavy.replace(constraints=[*heavy.constraints, {**rates, "joint_torque": torques}])
    assert [limit.rate for limit in rates_of(heavy)] == [*torques[:-1], *[torques[-1]] * 3]
    with pytest.raises(SceneError, match=r"joint_torque = .*: must be one number, or 3: one for each"):
        few.replace(constraints=[{**rates, "joint_torque": [1.0, 2.0]}])
    with pytest.raises(SceneError, match="must be one number or several numbers, each greater than 0"):
        few.replace(constraints=[{**rates, "joint_torque": []}])
