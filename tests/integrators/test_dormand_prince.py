"""The adaptive pair inside a time step: tolerances, lanes of their own, failure, derivatives."""

import gymnasium
import numpy as np
import pytest
from motions import free_body, moving_start, rollout, simulated

from dq_space_arm_env import compile_scene


def adaptive(scene="paper", **settings):
    return simulated(scene, **{"integrator": "dormand_prince", **settings})


def starts(kernels, count, largest=4.0):
    """States from nearly still to fast: they need very different numbers of steps."""
    rates = np.linspace(0.01, largest, count)
    return np.array([moving_start(kernels, k, rate, 0.5 * rate) for k, rate in enumerate(rates)])


def test_errors_follow_the_tolerance_whatever_the_time_step():
    kernels = compile_scene("paper")
    x = moving_start(kernels, joint_rate=0.8, base_rate=0.4)
    still = np.zeros((2000, kernels.n_u))
    reference = rollout(kernels, x, still, 3.0 / 2000, "rk8")[-1]
    for tolerance in (1e-4, 1e-6, 1e-8, 1e-10):
        chosen = compile_scene(adaptive(rtol=tolerance, atol=0.01 * tolerance))
        for dt in (0.3, 3.0):
            count = round(3.0 / dt)
            final = rollout(chosen, x, still[:count], dt, "dormand_prince")[-1]
            error = np.linalg.norm(kernels.difference(reference, final))
            assert 0.01 * tolerance < error < 200.0 * tolerance


def test_the_error_of_the_pose_decides_alone_where_velocities_are_exact():
    """A ball whose torque is not along its spin: the velocity is linear in time, the pose is not."""
    ball = {"mass": 2.0, "inertia": [0.5, 0.5, 0.5]}
    simulation = {"integrator": "dormand_prince", "rtol": 1e-8, "atol": 1e-10}
    chosen = free_body("base_torque", base=ball, simulation=simulation)
    x, u = chosen.layout.initial_state.copy(), np.array([0.0, 0.4, 0.0])
    x[chosen.layout.state.base_velocity] = [1.0, 0.0, 0.5, 0.0, 0.0, 0.0]
    end = chosen.step(x, u, 3.0)
    reference = rollout(chosen, x, np.broadcast_to(u, (600, 3)), 3.0 / 600, "rk8")[-1]
    assert np.linalg.norm(chosen.difference(reference, end)) < 3e-7
    motion = chosen.integrate(x, u, 3.0, rtol=1e-8, atol=1e-10)
    assert np.linalg.norm(chosen.difference(reference, motion.x[-1])) < 3e-7


def test_every_lane_takes_steps_of_its_own():
    kernels = compile_scene(adaptive(rtol=1e-6))
    x = starts(kernels, 19)
    u = np.random.default_rng(0).normal(size=(19, kernels.n_u))
    together = kernels.step(x, u, 0.5)
    one_by_one = [kernels.step(a, b, 0.5) for a, b in zip(x, u, strict=True)]
    np.testing.assert_array_equal(together, one_by_one)
    assert np.isfinite(together).all()


def test_a_step_back_in_time_returns_within_the_tolerance():
    kernels = compile_scene(adaptive(rtol=1e-10, atol=1e-12))
    x = moving_start(kernels, joint_rate=0.8, base_rate=0.4)
    u = np.zeros(kernels.n_u)
    back = kernels.step(kernels.step(x, u, 2.0), u, -2.0)
    assert np.linalg.norm(kernels.difference(x, back)) < 3e-10
    np.testing.assert_allclose(kernels.step(x, u, 0.0), x, rtol=0, atol=1e-15)


def test_what_cannot_be_followed_is_nan_and_harms_no_other_lane():
    kernels = compile_scene(adaptive())
    x = starts(kernels, 11, largest=0.5)
    u = np.zeros((11, kernels.n_u))
    expected = kernels.step(x, u, 0.5)
    spoilt = x.copy()
    spoilt[3, kernels.layout.state.joint_rates] = 1e200  # its accelerations overflow
    spoilt[7, kernels.layout.state.joint_angles] = np.nan
    result = kernels.step(spoilt, u, 0.5)
    assert np.isnan(result[[3, 7]]).all()
    others = [k for k in range(11) if k not in (3, 7)]
    np.testing.assert_array_equal(result[others], expected[others])


def test_a_time_out_of_reach_ends_in_nan_and_not_in_an_endless_loop():
    kernels = compile_scene(adaptive(rtol=1e-13, atol=1e-14))
    x, u = moving_start(kernels, joint_rate=4.0, base_rate=2.0), np.zeros(kernels.n_u)
    assert np.isfinite(kernels.step(x, u, 0.5)).all()
    assert np.isnan(kernels.step(x, u, 1000.0)).all()


def test_the_environment_simulates_with_it_and_reports_a_failure():
    env = gymnasium.make("DQSpaceArm-v0", scene=adaptive("random-masses"))
    env.reset(seed=0)
    action = np.full(env.action_space.shape, 0.5, env.action_space.dtype)
    observation, reward, terminated, _, _ = env.step(action)
    assert np.isfinite(observation).all()
    assert np.isfinite(reward)
    assert not terminated
    hopeless = gymnasium.make("DQSpaceArm-v0", scene=adaptive("tumbling", dt=1000.0))
    hopeless.reset(seed=0)
    observation, reward, terminated, _, _ = hopeless.step(np.zeros(hopeless.action_space.shape))
    assert terminated
    assert np.isfinite(observation).all()


@pytest.mark.sampled
@pytest.mark.parametrize("scene", ["paper", "planar"])
def test_derivatives_over_many_shares_agree_with_differences(scene):
    """Shares are held fixed in the derivatives: what differences see of their changes is of the tolerance."""
    kernels = compile_scene(adaptive(scene, rtol=1e-9, atol=1e-11))
    x, dt, size = moving_start(kernels, joint_rate=0.8, base_rate=0.4), 1.0, 1e-3
    u = np.random.default_rng(3).normal(size=kernels.n_u)
    a, b = kernels.linearize(x, u, dt)
    end = kernels.step(x, u, dt)

    def ends(moves, changes):
        moved = kernels.retract(np.broadcast_to(x, (len(moves), kernels.n_x)), moves)
        final = kernels.step(moved, u + changes, dt)
        return kernels.difference(np.broadcast_to(end, final.shape), final)

    def differences(ends_of):
        near, far = ((ends_of(k * size) - ends_of(-k * size)) / (2.0 * k * size) for k in (1.0, 2.0))
        return ((4.0 * near - far) / 3.0).T

    n_t, n_u = kernels.n_t, kernels.n_u
    of_x = differences(lambda h: ends(h * np.eye(n_t), np.zeros((n_t, n_u))))
    of_u = differences(lambda h: ends(np.zeros((n_u, n_t)), h * np.eye(n_u)))
    # Seen from its end the difference is nonlinear only in second order, which central differences cancel.
    np.testing.assert_allclose(a, of_x, rtol=0, atol=3e-8 * np.abs(a).max())
    np.testing.assert_allclose(b, of_u, rtol=0, atol=8e-9 * np.abs(b).max())


@pytest.mark.slow
def test_derivatives_with_a_catch_agree_with_differences():
    """A step and its linearization stand in one program there, each with a loop of its own."""
    scene = adaptive("planar").replace(
        payload={"mass": 20.0, "inertia": [1.0, 1.0, 1.0]},
        phases=[
            {"name": "free", "steps": 1, "changes": {"payload": None}},
            {"name": "held", "steps": 1, "catch": {"position_error": 9.0}},
        ],
        simulation={"steps": 2},
    )
    kernels = compile_scene(scene)
    x, u, p = moving_start(kernels), np.full(kernels.n_u, 0.3), kernels.stage_parameters()[0]
    assert p[kernels.parameters.indices("catch")][0] == 1.0
    _, b = kernels.linearize(x, u, 1.0, p=p)
    end, moves = kernels.step(x, u, 1.0, p=p), 1e-4 * np.eye(kernels.n_u)
    ends = kernels.step(x, np.vstack([u + moves, u - moves]), 1.0, p=p)
    ahead, behind = np.split(kernels.difference(end, ends), 2)
    np.testing.assert_allclose(b, ((ahead - behind) / 2e-4).T, rtol=0, atol=1e-7 * np.abs(b).max())


@pytest.mark.parametrize(
    ("settings", "sentence"),
    [
        ({"integrator": "rk4", "rtol": 1e-6}, r"simulation.rtol = 1e-06: rk4 takes fixed steps"),
        ({"rtol": -1.0}, r"simulation.rtol = -1.0: must be a finite number greater than 0"),
        ({"precision": "float32", "rtol": 1e-9}, r"simulation.rtol = 1e-09: must be at least 1e-06"),
    ],
)
def test_tolerances_that_mean_nothing_are_refused(settings, sentence):
    with pytest.raises(ValueError, match=sentence):
        adaptive(**settings)
