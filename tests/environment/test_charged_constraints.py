"""Environments charge the constraints of their scene: single, vector, and Stable-Baselines3's."""

import math

import numpy as np
import pytest
from gymnasium.vector import AutoresetMode

from dq_space_arm_env import DQSpaceArmEnv, DQSpaceArmGoalEnv, DQSpaceArmVectorEnv, compile_scene, load_scene
from dq_space_arm_env.environment.rollouts import rollout

LIMITS = {"kind": "joint_limits", "name": "limits", "lower": [-0.7, 0.0, -math.inf], "tolerance": 0.05}
BALL = {
    "kind": "distance",
    "name": "ball",
    "bodies": [{"frame": "link 3", "to": [0.85, 0, 0], "radius": 0.05}],
    "obstacles": [{"frame": "target", "radius": 0.3}],
    "observed": 0.5,
}
PLUME = {"kind": "plume", "name": "plume", "angle_deg": 60, "keeps_clear": {"frame": "target", "radius": 0.5}}
EXACT = {"kind": "terminal", "name": "exact", "exact": ["pose"], "tolerance": 0.1}


def scene(*constraints, name="paper", steps=40, dt=0.05):
    return load_scene(name).replace(constraints=constraints, simulation={"steps": steps, "dt": dt})


CONSTRAINED = scene(LIMITS, BALL, PLUME, EXACT)


def pushes(steps, n_u, seed=0):
    return np.random.default_rng(seed).uniform(-1.0, 1.0, (steps, n_u))


def test_costs_are_violations_over_tolerances():
    """Of the state after the step, of the input where it counts; what is exact at the end counts there."""
    env, kernels = DQSpaceArmEnv(CONSTRAINED), compile_scene(CONSTRAINED)
    _, info = env.reset(seed=1)
    names = ["limits: link 1 lower", "limits: link 2 lower", "ball: link 3 0 to target 0", "plume"]
    assert list(info["constraints"])[:4] == names
    assert list(info["constraints"])[4] == "exact: tip angular x"
    tolerances, charged = np.array([0.05, 0.05, 0.01, 0.01]), 0.0
    for step, action in enumerate(pushes(40, 12)):
        before, u = env.state, kernels.layout.to_control(action)
        _, _, over, _, info = env.step(action)
        path = kernels.constraints(env.state, u)
        path[3] = kernels.constraints(before, u)[3]
        final = kernels.terminal_constraints(env.state)[-6:]
        np.testing.assert_allclose(list(info["constraints"].values()), [*path, *final], rtol=0, atol=1e-12)
        expected = (np.maximum(path, 0.0) / tolerances).sum()
        assert over == (step == 39)
        expected += np.abs(final).sum() / 0.1 if over else 0.0
        assert info["cost"] == pytest.approx(expected, abs=1e-9)
        charged += info["cost"]
    assert charged > 0.0


def test_volumes_that_never_meet_cost_nothing():
    """Without a row there are no residuals to report."""
    fixed = {"frame": "base", "radius": 1.0}
    apart = {"kind": "distance", "name": "apart", "bodies": [fixed], "obstacles": [fixed]}
    venv, env = (kind(scene=scene(apart, name="planar")) for kind in (DQSpaceArmVectorEnv, DQSpaceArmEnv))
    (_, info), (_, single) = (each.reset(seed=0) for each in (venv, env))
    assert info["cost"] == [0.0] == [single["cost"]]
    assert info.keys() == {*single, *(f"_{name}" for name in single)}
    assert venv.step(np.zeros((1, 6)))[-1]["cost"] == [0.0]


@pytest.mark.sampled
@pytest.mark.parametrize("mode", list(AutoresetMode)[:2])
def test_vector_environments_charge_the_same_to_the_bit(mode):
    single = [DQSpaceArmEnv(CONSTRAINED) for _ in range(3)]
    vector = DQSpaceArmVectorEnv(3, CONSTRAINED, autoreset_mode=mode)
    _, info = vector.reset(seed=5)
    singles = [env.reset(seed=5 + i)[1] for i, env in enumerate(single)]
    for action in pushes(39, 12):
        for i, expected in enumerate(singles):
            assert info["cost"][i] == expected["cost"]
            for name, value in expected["constraints"].items():
                assert info["constraints"][name][i] == value
                assert info["constraints"][f"_{name}"][i]
        observations, *_, info = vector.step(np.tile(action, (3, 1)))
        results = [env.step(action) for env in single]
        singles = [result[-1] for result in results]
        np.testing.assert_array_equal(observations, [result[0] for result in results])


def test_margins_are_observed():
    plain = DQSpaceArmEnv(scene(LIMITS, {**BALL, "observed": None}))
    env = DQSpaceArmEnv(CONSTRAINED)
    seen, without = env.reset(seed=2)[0], plain.reset(seed=2)[0]
    assert env.observation_space.contains(seen)
    assert len(seen) == len(without) + 1
    residual = compile_scene(CONSTRAINED).constraints(env.state, np.zeros(12))[2]
    assert seen[-2] == pytest.approx(math.tanh(-residual / 0.5), abs=1e-12)
    np.testing.assert_array_equal(np.delete(seen, -2), without)


@pytest.mark.slow
def test_a_violation_may_end_the_episode_and_never_pays():
    """The end is charged with at least what the rest of the episode would have cost."""
    ending = scene({**LIMITS, "terminates": True})
    env, endless = DQSpaceArmEnv(ending), DQSpaceArmEnv(scene(LIMITS))
    env.reset(options={"nominal": True})
    endless.reset(options={"nominal": True})
    action = np.zeros(12)
    action[6] = -1.0  # link 1 turns to its limit
    over, others = False, []
    while not over:
        _, reward, over, _, info = env.step(action)
        others.append(endless.step(action)[1])
        assert over or reward == others[-1]
    assert len(others) < 40
    assert info["constraints"]["limits: link 1 lower"] > 0.05
    assert not info["is_success"]
    rest = [others[-1], *(endless.step(action)[1] for _ in range(40 - len(others)))]
    assert reward <= sum(rest)
    with pytest.raises(ValueError, match="terminates"):
        DQSpaceArmGoalEnv(ending)


def test_what_is_exact_at_the_end_is_charged_at_an_early_one_too():
    limits = {**LIMITS, "lower": [-0.7, -math.inf, -math.inf], "terminates": True}
    env = DQSpaceArmEnv(scene(limits, EXACT, name="planar"))
    env.reset(options={"nominal": True})
    action, over, steps = np.zeros(env.action_space.shape), False, 0
    action[3] = -1.0  # link 1 turns to its limit
    while not over:
        _, _, over, _, info = env.step(action)
        steps += 1
    assert steps < 40
    limit, *exact = info["constraints"].values()
    charged = limit / 0.05 + sum(abs(each) for each in exact) / 0.1
    assert info["cost"] == pytest.approx(charged, rel=1e-12)


def test_rollouts_count_violations():
    flown = rollout(lambda seen: np.zeros((len(seen), 12)), CONSTRAINED, seeds=range(4))
    env, expected = DQSpaceArmEnv(CONSTRAINED), []
    for seed in range(4):
        env.reset(seed=seed)
        expected.append(np.mean([env.step(np.zeros(12))[-1]["cost"] > 1.0 for _ in range(40)]))
    np.testing.assert_allclose(flown.constraint_violations, expected)
    plain = rollout(lambda seen: np.zeros((len(seen), 12)), "paper", seeds=range(1), steps=2)
    assert plain.constraint_violations is None


def test_without_constraints_nothing_is_there():
    env = DQSpaceArmEnv("paper")
    assert "cost" not in env.reset(seed=0)[1]
    assert "constraints" not in env.step(np.zeros(12))[-1]


def test_unusable_actions_do_not_hide_in_constraints():
    env = DQSpaceArmEnv(CONSTRAINED)
    env.reset(seed=0)
    with pytest.raises(ValueError, match="NaN"):
        env.step(np.full(12, np.nan))
