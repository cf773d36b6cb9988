"""Actuators that lag, delay and slew: exact steps, derivatives, limits; nothing of it where they do not."""

import numpy as np
import pytest
from scipy.integrate import solve_ivp

from dq_space_arm_env import DQSpaceArmEnv, SceneError, compile_scene, load_scene
from dq_space_arm_env.algebra import screw
from dq_space_arm_env.kernels.programs.scene_programs import ScenePrograms

PLAIN = load_scene("planar").replace(simulation={"steps": 30})
CHAINED = PLAIN.replace(
    {
        "actuators.base_force.time_constant": 0.05,
        "actuators.base_torque.delay": 2,
        "actuators.joint_torque.time_constant": 0.02,
        "actuators.joint_torque.delay": 1,
    }
)
INTEGRATORS = ("rk4", "symplectic_euler", "gauss6", "momentum_rk4")


def point(scene, seed=0):
    kernels, rng = compile_scene(scene), np.random.default_rng(seed)
    x = kernels.retract(kernels.layout.initial_state, 0.3 * rng.standard_normal(kernels.n_t))
    return kernels, x, rng.uniform(-1.0, 1.0, kernels.n_u)


def test_the_state_ends_with_what_is_on_its_way():
    kernels, x, u = point(CHAINED)
    layout, plain = kernels.layout, compile_scene(PLAIN)
    assert layout.state.drives == slice(plain.n_x, plain.n_x + 2 + 2 + 3 * 2)
    assert layout.state.names[plain.n_x : plain.n_x + 4] == (
        "base force x output",
        "base force y output",
        "base torque z commanded 2 before",
        "base torque z commanded 1 before",
    )
    assert layout.state.units[-2:] == ("N m", "N m")
    after, dt = kernels.step(x, u), CHAINED.simulation.dt
    old, new = x[layout.state.drives], after[layout.state.drives]
    decay = np.exp(-dt / np.array([0.05, 0.02]))
    np.testing.assert_allclose(new[:2], decay[0] * old[:2] + (1 - decay[0]) * u[:2], rtol=0, atol=1e-15)
    np.testing.assert_array_equal(new[2:4], [old[3], u[2]])
    np.testing.assert_array_equal(new[4::2], u[3:])
    np.testing.assert_allclose(
        new[5::2], decay[1] * old[5::2] + (1 - decay[1]) * old[4::2], rtol=0, atol=1e-15
    )


@pytest.mark.sampled
@pytest.mark.parametrize("integrator", INTEGRATORS)
def test_the_motion_sees_the_mean_of_the_outputs(integrator):
    kernels, x, u = point(CHAINED)
    plain, (dt, n) = compile_scene(PLAIN), (CHAINED.simulation.dt, kernels.layout.state.drives.start)
    k = x[n:]

    def mean(constant, output, followed):
        """Mean of the output over the step, by integration of output and mean together."""

        def rates(_, y):
            return (followed - y[0]) / constant, y[0] / dt

        return solve_ivp(rates, (0.0, dt), [output, 0.0], rtol=1e-12, atol=1e-15).y[1, -1]

    seen = [mean(0.05, k[0], u[0]), mean(0.05, k[1], u[1]), k[2]]
    seen += [mean(0.02, output, waited) for waited, output in k[4:].reshape(-1, 2)]
    after = kernels.step(x, u, integrator=integrator)[:n]
    np.testing.assert_allclose(after, plain.step(x[:n], seen, integrator=integrator), rtol=0, atol=1e-10)


def differences(function, size, step=1e-3):
    weights = ((1, 4 / 5), (2, -1 / 5), (3, 4 / 105), (4, -1 / 280))
    rows = [
        sum(w * (function(j * step * e) - function(-j * step * e)) for j, w in weights) / step
        for e in np.eye(size)
    ]
    return np.array(rows).T


@pytest.mark.sampled
@pytest.mark.parametrize("integrator", INTEGRATORS)
def test_derivatives_agree_with_differences(integrator):
    kernels, x, u = point(CHAINED)
    first, n_t = kernels.step(x, u, integrator=integrator), kernels.n_t

    def moved(z):
        after = kernels.step(kernels.retract(x, z[:n_t]), u + z[n_t:], integrator=integrator)
        return kernels.difference(first, after)

    expected = differences(moved, n_t + kernels.n_u)
    np.testing.assert_allclose(
        np.hstack(kernels.linearize(x, u, integrator=integrator)), expected, rtol=0, atol=1e-10
    )


@pytest.mark.slow
def test_second_derivatives_are_those_of_the_motion_seen_through_the_chains():
    kernels, x, u = point(CHAINED)
    multiplier = np.random.default_rng(1).standard_normal(kernels.n_t)
    n_t, still = kernels.n_t, np.zeros(kernels.n_t)
    h = np.array([CHAINED.simulation.dt])
    blocks = kernels.call("lagrangian_hessian", x=x, u=u, multiplier=multiplier, h=h)
    bare = kernels.call("lagrangian_hessian", x=x, u=u, multiplier=still, h=h)
    lxx, lux, luu = (a - b for a, b in zip(blocks, bare, strict=True))
    # Entries by the chains and the controls, in which tangent coordinates are flat.
    chains = list(range(kernels.layout.tangent.drives.start, n_t))

    def gradient(z):
        after = x.copy()
        after[kernels.layout.state.drives] += z[: len(chains)]
        a, b = kernels.linearize(after, u + z[len(chains) :])
        image = kernels.difference(kernels.step(x, u), kernels.step(after, u + z[len(chains) :]))
        twist = np.zeros(6)
        twist[[2, 3, 4]] = image[:3]
        block = np.array(screw.exponential_right_jacobian(twist.tolist()))[np.ix_([2, 3, 4], [2, 3, 4])]
        weights = multiplier.copy()
        weights[:3] = np.linalg.solve(block.T, multiplier[:3])
        return np.concatenate([a[:, chains].T @ weights, b.T @ weights])

    expected = differences(gradient, len(chains) + kernels.n_u, step=0.03)
    lxx, lux = lxx.reshape(n_t, n_t), lux.reshape(-1, n_t)
    luu = luu.reshape(kernels.n_u, -1)
    found = np.block([[lxx[np.ix_(chains, chains)], lux[:, chains].T], [lux[:, chains], luu]])
    np.testing.assert_allclose(found, expected, rtol=0, atol=1e-9 * np.abs(expected).max())


def test_a_lag_without_time_is_the_ideal_actuator():
    kernels, x, u = point(PLAIN.replace({"actuators.joint_torque.time_constant": 1e-12}))
    plain = compile_scene(PLAIN)
    n = plain.n_x
    np.testing.assert_allclose(kernels.step(x, u)[:n], plain.step(x[:n], u), rtol=0, atol=3e-11)
    slow = PLAIN.replace({"actuators.joint_torque.time_constant": 1e9})
    still, kept = compile_scene(slow), np.append(u[:3], x[n:])
    np.testing.assert_allclose(still.step(x, u)[:n], plain.step(x[:n], kept), rtol=0, atol=1e-10)


def test_wrists_that_lag_have_their_rates_in_the_state():
    """The tip's twist follows from the state alone."""
    scene = load_scene("paper").replace({"actuators.wrist_rate.time_constant": 0.1})
    kernels, x, u = point(scene)
    rates = x[kernels.layout.state.drives]
    plain = compile_scene("paper")
    expected = plain.tip_twist(x[: plain.n_x], np.append(np.zeros(9), rates))
    np.testing.assert_allclose(kernels.tip_twist(x, u), expected, rtol=0, atol=1e-13)
    np.testing.assert_allclose(kernels.relative_twist(x), expected, rtol=0, atol=1e-13)


def test_environments_slew_no_faster_than_the_actuators():
    scene = PLAIN.replace({"actuators.joint_torque.slew_limit": 4.0})
    env, layout = DQSpaceArmEnv(scene), compile_scene(scene).layout
    env.reset(seed=0)
    kept, most = layout.state.actuators, 4.0 * scene.simulation.dt
    before = env.state[kept].copy()
    for action in np.random.default_rng(0).uniform(-1.0, 1.0, (8, layout.n_u)):
        env.step(action)
        wanted = layout.to_control(action)[list(layout.previous_controls)]
        np.testing.assert_allclose(
            env.state[kept], np.clip(wanted, before - most, before + most), rtol=0, atol=1e-14
        )
        before = env.state[kept].copy()


def test_a_scene_with_ideal_actuators_has_nothing_of_it():
    programs = ScenePrograms(PLAIN)
    assert programs.layout.chains == ()
    assert programs.layout.state.drives.stop == programs.layout.state.drives.start
    assert not {"time_constant", "delay", "slew_limit"} & {*PLAIN.to_yaml().replace(":", " ").split()}
    assert "exp" not in {node.operation for call in programs.build("step").calls for node in call.graph.nodes}


@pytest.mark.parametrize("change", [{"delay": 21}, {"delay": 1.5}, {"time_constant": 0}, {"slew_limit": -1}])
def test_impossible_dynamics_are_refused(change):
    (name, value), *_ = change.items()
    with pytest.raises(SceneError, match=f"actuators.base_force.{name}"):
        PLAIN.replace({f"actuators.base_force.{name}": value})


def test_voltage_leaves_less_torque_the_faster_a_motor_turns():
    """The environment clips, the constraint measures, and the kernels take what they are given."""
    motor = {"stall_torque": 1.0, "no_load_speed": 0.5}
    charged = [{"kind": "torque_speed", "name": "voltage", "tolerance": 0.1}]
    scene = PLAIN.replace({"links.1.motor": motor, "constraints": charged})
    env, plain, kernels = DQSpaceArmEnv(scene), compile_scene(PLAIN), compile_scene(scene)
    env.reset(seed=0)
    layout, rng = kernels.layout, np.random.default_rng(0)
    torque, rate = layout.control.joint_torque.start + 1, layout.state.joint_rates.start + 1
    clipped = 0
    for action in rng.choice([-1.0, 1.0], (20, layout.n_u)):
        x, u = env.state.copy(), layout.to_control(action)
        fallen = motor["stall_torque"] * x[rate] / motor["no_load_speed"]
        rows = kernels.constraints(x, u)
        expected = [-1.0 - fallen - u[torque], u[torque] - 1.0 + fallen]
        np.testing.assert_allclose(rows, expected, rtol=0, atol=1e-14)
        _, _, _, _, info = env.step(action)
        given, u[torque] = u[torque], np.clip(u[torque], -1.0 - fallen, 1.0 - fallen)
        clipped += given != u[torque]
        np.testing.assert_allclose(env.state, plain.step(x, u), rtol=0, atol=1e-13)
        assert info["cost"] < 1e-12
    assert clipped > 5
    with pytest.raises(SceneError, match="need each other"):
        PLAIN.replace({"links.1.motor": {"stall_torque": 1.0}})
    with pytest.raises(SceneError, match="no motor that drives a joint"):
        PLAIN.replace(constraints=charged)
