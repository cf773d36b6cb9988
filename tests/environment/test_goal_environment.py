"""`DQSpaceArmGoal-v0`: the conventions of goal environments, rewards for any goal, and how episodes end."""

import copy
import pickle
import threading
import warnings

import gymnasium
import numpy as np
import pytest
from gymnasium.error import ResetNeeded
from gymnasium.utils.env_checker import check_env, data_equivalence
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation
from short_scenes import diverging, short

from dq_space_arm_env import DQSpaceArmGoalEnv
from dq_space_arm_env.algebra import poses

KINDS = ("sparse", "dense")
DRAWN = short("random-target")
DIVERGING = diverging("random-target", 1e4, 20)


def make(scene="random-target", **arguments):
    return gymnasium.make("DQSpaceArmGoal-v0", scene=scene, **arguments).unwrapped


def episode(env, seed=0):
    """All that an episode of random actions returns."""
    env.action_space.seed(seed)
    env.reset(seed=seed)
    results = []
    while not results or not (results[-1][2] or results[-1][3]):
        results.append(env.step(env.action_space.sample()))
    return results


def pose(rotation, position):
    quaternion = rotation.as_quat(scalar_first=True)
    return np.array(poses.from_rotation_and_position(tuple(quaternion), tuple(position)))


def rotation_and_position(goals):
    """Rotations and positions r = 2 q_d q_r* of goals, without the algebra of the package."""
    real, dual = np.asarray(goals, dtype=np.float64)[..., :4], np.asarray(goals, dtype=np.float64)[..., 4:]
    w, v = real[..., :1], real[..., 1:]
    positions = 2.0 * (w * dual[..., 1:] - dual[..., :1] * v - np.cross(dual[..., 1:], v))
    return Rotation.from_quat(real, scalar_first=True), positions


def expected_errors(achieved, desired):
    """Angle in degrees and distance in m."""
    rotation, position = rotation_and_position(achieved)
    desired_rotation, desired_position = rotation_and_position(desired)
    angle = np.degrees((rotation.inv() * desired_rotation).magnitude())
    return angle, np.linalg.norm(position - desired_position, axis=-1)


def neighbors(count, seed=0):
    """Pairs of goals about as far apart as the tolerances of 3 deg and 0.1 m, with arbitrary signs."""
    rng = np.random.default_rng(seed)
    rotations = Rotation.random(count, rng=rng)
    axes = rng.normal(size=(count, 3))
    axes /= np.linalg.norm(axes, axis=1, keepdims=True)
    turned = rotations * Rotation.from_rotvec(rng.uniform(0.0, 6.0, (count, 1)) * axes, degrees=True)
    positions = rng.uniform(-6.0, 6.0, (count, 3))
    moved = positions + rng.uniform(-0.1, 0.1, (count, 3))
    achieved = np.array([pose(*pair) for pair in zip(rotations, positions, strict=True)])
    desired = np.array([pose(*pair) for pair in zip(turned, moved, strict=True)])
    return achieved * rng.choice([-1.0, 1.0], (count, 1)), desired * rng.choice([-1.0, 1.0], (count, 1))


@pytest.mark.parametrize("kind", KINDS)
@pytest.mark.parametrize("scene", ["random-target", "paper", "planar", "payload", "tumbling-target"])
def test_check_env_has_no_complaint(scene, kind):
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        check_env(make(scene, reward_type=kind), skip_render_check=True)


def test_spaces_are_as_small_as_unit_quaternions_allow():
    env = make(short("paper"))
    for space in env.observation_space.spaces.values():
        assert (space.high[:4] > 1.0).all()
        assert (space.high[:4] < 1.001).all()
        np.testing.assert_array_equal(space.low, -space.high)
        assert (space.high[4:] > 1e5).all()


def test_an_info_that_says_nothing_of_a_divergence_reports_none():
    env = make(short("paper"), reward_type="dense")
    achieved, desired = neighbors(2)
    sound = env.compute_reward(achieved, desired, {"diverged": np.array([False, False])})
    for silent in (None, {}, [{}, {}]):
        np.testing.assert_array_equal(env.compute_reward(achieved, desired, silent), sound)
    lost = env.compute_reward(achieved, desired, {"diverged": np.array([False, True])})
    assert lost[0] == sound[0]
    assert lost[1] < sound[1]
    for odd in ([None, None], "no", 3):
        with pytest.raises(ValueError, match=r"info: .* should be a dictionary, or one for each goal"):
            env.compute_reward(achieved, desired, odd)


@pytest.mark.sampled
@pytest.mark.parametrize("kind", KINDS)
@pytest.mark.parametrize(
    "scene",
    [
        pytest.param(DRAWN, id="drawn goal"),
        pytest.param(short("paper"), id="fixed goal"),
        pytest.param(short("planar"), id="planar"),
        pytest.param(short("random-target", precision="float32"), id="float32"),
        pytest.param(DIVERGING, id="diverging"),
    ],
)
def test_what_a_step_returns_is_what_goals_and_info_give(scene, kind):
    """The identities that goal environments promise, for every step of an episode, alone and together."""
    env = make(scene, reward_type=kind)
    results = []
    env.action_space.seed(0)
    env.reset(seed=0)
    over = False
    while not over:
        observation, reward, terminated, truncated, info = env.step(env.action_space.sample())
        goals = observation["achieved_goal"], observation["desired_goal"]
        assert env.compute_reward(*goals, info) == reward
        assert env.compute_terminated(*goals, info) is terminated is False
        assert env.compute_truncated(*goals, info) is truncated
        assert env.observation_space.contains(observation)  # in the precision of the scene, too
        results.append((*goals, reward, info))
        over = truncated
    achieved, desired, rewards, infos = (list(part) for part in zip(*results, strict=True))
    assert len(set(rewards)) > 1 or kind == "sparse"
    together = env.compute_reward(np.array(achieved), np.array(desired), infos)
    assert together.shape == (len(results),)
    np.testing.assert_array_equal(together, rewards)
    again = env.compute_reward(np.array(achieved), np.array(desired), np.array(infos))
    np.testing.assert_array_equal(again, rewards)


def test_dynamics_costs_and_draws_are_those_of_the_environment_without_goals():
    env, twin = make(DRAWN), gymnasium.make("DQSpaceArm-v0", scene=DRAWN).unwrapped
    info, expected = env.reset(seed=3)[1], twin.reset(seed=3)[1]
    assert info.pop("parameters") == expected.pop("parameters")
    assert info == pytest.approx(expected, rel=1e-12)
    rng = np.random.default_rng(0)
    over = False
    while not over:
        action = rng.uniform(-1, 1, 12)
        observation, _, _, over, info = env.step(action)
        *_, expected = twin.step(action)
        np.testing.assert_array_equal(observation["observation"], twin.state)
        np.testing.assert_array_equal(env.state, twin.state)
        np.testing.assert_array_equal(env.parameters, twin.parameters)
        np.testing.assert_array_equal(observation["achieved_goal"], env.kernels.tip_pose(twin.state))
        assert info.keys() == expected.keys()
        assert info == pytest.approx(expected, rel=1e-12)


@pytest.mark.parametrize(("name", "more"), [("release", 1), ("capture-and-detumble", 7), ("tracking", 6)])
def test_the_observation_has_the_phase_and_the_velocity_of_the_target(name, more):
    env = make(short(name))
    observation, info = env.reset(seed=3)
    over = False
    while not over:
        seen, n_x = observation["observation"], env.kernels.n_x
        assert len(seen) == n_x + more
        np.testing.assert_array_equal(seen[n_x : n_x + more % 6], [info["phase"]] if more % 6 else [])
        velocity = env.kernels.layout.target_velocity_with(env._env.stage_parameters)
        np.testing.assert_array_equal(seen[len(seen) - more // 6 * 6 :], velocity[: more // 6 * 6])
        observation, _, _, over, info = env.step(np.zeros(env.action_space.shape))


def test_the_goal_is_the_target_of_the_episode():
    env = make(DRAWN)
    goals = []
    for seed in range(3):
        observation, _ = env.reset(seed=seed)
        goals.append(observation["desired_goal"])
        target = env.episode_scene.target.pose.dual_quaternion
        np.testing.assert_allclose(observation["desired_goal"], target, rtol=0, atol=1e-14)
        assert observation["achieved_goal"][:4] @ observation["desired_goal"][:4] >= 0.0
        after, *_ = env.step(env.action_space.sample())
        np.testing.assert_array_equal(after["desired_goal"], observation["desired_goal"])
    assert len(np.unique(goals, axis=0)) == 3


def test_sparse_rewards_are_successes_by_angle_and_distance():
    achieved, desired = neighbors(2000)
    angle, distance = expected_errors(achieved, desired)
    success = (angle <= 3.0) & (distance <= 0.1)
    assert 0.2 < success.mean() < 0.8
    for precision in ("float64", "float32"):
        rewards = make(short("random-target", precision=precision)).compute_reward(achieved, desired, {})
        margin = np.minimum(np.abs(angle - 3.0), np.abs(distance - 0.1))
        clear = margin > (1e-9 if precision == "float64" else 1e-4)
        np.testing.assert_array_equal(rewards[clear], np.where(success, 0.0, -1.0)[clear])
        assert clear.mean() > 0.95


def test_dense_rewards_are_the_papers_pose_cost_with_the_scenes_weights():
    weights = np.array([1.0, 2.0, 3.0, 4.0, 5.0, 6.0, 7.0, 8.0])
    cost = DRAWN.cost.model_dump() | {"pose": weights.tolist()}
    env = make(DRAWN.replace(cost=cost), reward_type="dense")
    achieved, desired = neighbors(50)
    costs = [((achieved - sign * desired) ** 2) @ weights for sign in (1.0, -1.0)]
    np.testing.assert_allclose(env.compute_reward(achieved, desired, {}), -np.minimum(*costs), rtol=1e-12)
    # With the signs of an episode it is the cost of the environment without goals, one step later.
    rewards, infos = zip(*((result[1], result[4]) for result in episode(env)), strict=True)
    np.testing.assert_allclose(rewards[:-1], [-info["cost_pose"] for info in infos[1:]], rtol=1e-12)


ENVIRONMENTS = {kind: make(reward_type=kind) for kind in KINDS}
angles = st.floats(-3.0, 3.0)
meters = st.floats(-10.0, 10.0)
goals = st.builds(
    lambda vector, position: pose(Rotation.from_rotvec(vector), position),
    st.tuples(angles, angles, angles),
    st.tuples(meters, meters, meters),
)


@pytest.mark.parametrize("kind", KINDS)
@settings(derandomize=True, max_examples=60, deadline=None)
@given(achieved=goals, desired=goals)
def test_rewards_do_not_depend_on_signs(kind, achieved, desired):
    env = ENVIRONMENTS[kind]
    reward = env.compute_reward(achieved, desired, {})
    for first, second in ((-1, 1), (1, -1), (-1, -1)):
        assert env.compute_reward(first * achieved, second * desired, {}) == reward
    assert env.compute_reward(achieved, -achieved, {}) == 0.0


def test_goals_alone_and_in_batches():
    env = make()
    achieved, desired = neighbors(7)
    rewards = env.compute_reward(achieved, desired, [{}] * 7)
    singles = [env.compute_reward(*pair, {}) for pair in zip(achieved, desired, strict=True)]
    assert all(isinstance(reward, float) for reward in singles)
    np.testing.assert_array_equal(rewards, singles)
    one = env.compute_reward(achieved, achieved[2], None)
    np.testing.assert_array_equal(one, [-1, -1, 0, -1, -1, -1, -1])
    assert env.compute_reward(achieved[:0], desired[:0], []).shape == (0,)
    grid = env.compute_reward(achieved[:6].reshape(2, 3, 8), desired[:6].reshape(2, 3, 8), None)
    np.testing.assert_array_equal(grid, rewards[:6].reshape(2, 3))
    for infos, goals in (([{}], achieved), ([{}] * 2, achieved[0]), ({"diverged": [True] * 2}, achieved[:1])):
        with pytest.raises(ValueError, match=r"info: of shape .*, should be one dictionary or of shape"):
            env.compute_reward(goals, goals, infos)
    with pytest.raises(ValueError, match="reward_type: 'dens' is unknown; choose from sparse and dense"):
        DQSpaceArmGoalEnv(reward_type="dens")
    with pytest.raises(ValueError, match=r"goals: shapes \(7, 8\) and \(7,\), should be \(8,\) or \(B, 8\)"):
        env.compute_reward(achieved, desired[:, 0], None)


@pytest.mark.parametrize("reward_type", ["sparse", "dense"])
def test_goals_that_are_no_poses_are_refused(reward_type):
    env = DQSpaceArmGoalEnv(short("random-target"), reward_type)
    sound = np.tile(env.reset(seed=0)[0]["desired_goal"], (3, 1))
    for row in (np.zeros(8), np.full(8, np.nan), [1, 0, 0, 0, np.inf, 0, 0, 0]):
        wrong = np.vstack([sound[:2], row])
        with pytest.raises(ValueError, match=r"(?s)achieved_goal: .*, should be poses"):
            env.compute_reward(wrong, sound, {})
        with pytest.raises(ValueError, match=r"(?s)desired_goal: .*, should be poses"):
            env.compute_reward(sound, wrong, {})
    with pytest.raises(ValueError, match=r"info: of shape \(2,\), should be .* of shape \(3,\)"):
        env.compute_reward(sound, sound, [{}, {}])


def test_a_goal_that_is_held_is_a_success_and_does_not_end_the_episode():
    env = make(short("random-target", 5))
    observation, _ = env.reset(options={"nominal": True})
    observation, info = env.reset(options={"nominal": True, "target": observation["achieved_goal"]})
    np.testing.assert_allclose(observation["achieved_goal"], observation["desired_goal"], rtol=0, atol=1e-15)
    assert info["is_success"]
    assert [info["attitude_error"], info["position_error"]] == pytest.approx([0, 0], abs=1e-13)
    for step in range(1, 6):
        _, reward, terminated, truncated, info = env.step(np.zeros(12))
        assert (reward, info["is_success"], terminated, truncated) == (0.0, True, False, step == 5)
    with pytest.raises(ResetNeeded, match="the episode is over"):
        env.step(np.zeros(12))


@pytest.mark.parametrize("kind", KINDS)
def test_a_diverged_step_truncates_and_costs_as_much_as_an_episode(kind):
    env = make(DIVERGING, reward_type=kind)
    *_, (observation, reward, terminated, truncated, info) = results = episode(env)
    assert len(results) < 20
    assert info["diverged"]
    assert not info["is_success"]
    assert (terminated, truncated) == (False, True)
    assert env.observation_space.contains(observation)
    alone = env.compute_reward(observation["achieved_goal"], observation["desired_goal"], {})
    assert reward == 20 * alone
    assert alone < 0.0
    # Even at the goal it does not count as a success.
    goal = observation["achieved_goal"]
    assert env.compute_reward(goal, goal, info) == (-20.0 if kind == "sparse" else 0.0)
    assert not any(result[4]["diverged"] for result in results[:-1])


def test_goals_of_planar_scenes_are_poses_in_the_plane():
    scene = short("planar")
    spread = scene.spread.model_dump() | {"target_position": 0.2, "target_rotation": 0.5}
    env = make(scene.replace(spread=spread))
    observation, _ = env.reset(seed=0)
    assert observation["observation"].shape == (13,)
    for key in ("achieved_goal", "desired_goal"):
        np.testing.assert_array_equal(observation[key][[1, 2, 4, 7]], 0.0)
    target = env.episode_scene.target.pose.dual_quaternion
    np.testing.assert_allclose(observation["desired_goal"], target, rtol=0, atol=1e-14)
    goal = pose(Rotation.from_rotvec([0, 0, 1.0]), [1.5, 0.5, 0.0])
    observation, info = env.reset(options={"target": goal})
    np.testing.assert_allclose(observation["desired_goal"], goal, rtol=0, atol=1e-15)
    angle, distance = expected_errors(observation["achieved_goal"], goal)
    assert [info["attitude_error"], info["position_error"]] == pytest.approx([angle, distance])


def test_same_seed_same_episode_to_the_bit_in_copies_too():
    env = make(DRAWN, reward_type="dense")
    for twin in (make(DRAWN, reward_type="dense"), pickle.loads(pickle.dumps(env)), copy.deepcopy(env)):
        assert data_equivalence(episode(twin, seed=4), episode(env, seed=4), exact=True)
    assert not data_equivalence(episode(env, seed=4)[0][0], episode(env, seed=5)[0][0])
    assert not np.array_equal(*(env.reset()[0]["desired_goal"] for _ in range(2)))


def test_make_vec_steps_several_one_by_one_too():
    venv = gymnasium.make_vec(
        "DQSpaceArmGoal-v0", num_envs=4, scene=short("random-target", 3), vectorization_mode="sync"
    )
    observations, _ = venv.reset(seed=0)
    assert observations["desired_goal"].shape == (4, 8)
    venv.action_space.seed(0)
    for _ in range(3):
        observations, rewards, terminated, truncated, infos = venv.step(venv.action_space.sample())
        goals = observations["achieved_goal"], observations["desired_goal"]
        np.testing.assert_array_equal(venv.envs[0].unwrapped.compute_reward(*goals, infos), rewards)
    assert truncated.all()
    assert not terminated.any()
    venv.close()


def test_an_episode_that_has_just_begun_is_not_truncated():
    env = make(DIVERGING)
    observation, *_, info = episode(env)[-1]
    goals = observation["achieved_goal"], observation["desired_goal"]
    assert env.unwrapped.compute_truncated(*goals, info)
    observation, info = env.reset()
    assert not env.unwrapped.compute_truncated(*goals, info)


def test_rewards_are_computed_while_another_thread_steps():
    env = make(DRAWN)
    observation, _ = env.reset(seed=0)
    goals = (np.tile(observation[name], (4096, 1)) for name in ("achieved_goal", "desired_goal"))
    achieved, desired = goals
    expected, wrong, ended = env.compute_reward(achieved, desired), [], threading.Event()

    def relabel():
        while not ended.is_set():
            wrong.append(not np.array_equal(env.compute_reward(achieved, desired), expected))

    learner = threading.Thread(target=relabel)
    learner.start()
    while len(wrong) < 200 and learner.is_alive():
        if env.step(np.zeros(env.action_space.shape, np.float32))[3]:
            env.reset()
    ended.set()
    learner.join()
    assert not any(wrong)


def test_a_refused_reset_changes_nothing():
    env = make(DRAWN)
    env.reset(seed=0)
    while not env.step(np.zeros(env.action_space.shape, np.float32))[3]:
        pass
    before = env.get_state()
    with pytest.raises(ValueError, match="bogus"):
        env.reset(seed=9, options={"bogus": 1})
    assert data_equivalence(env.get_state(), before)
    assert env.compute_truncated(None, None)


def test_steps_look_for_no_names(monkeypatch):
    env = make(short("capture-and-detumble"))
    env.reset(seed=0)
    action = np.zeros(env.action_space.shape, np.float32)
    env.step(action)
    monkeypatch.setattr("dq_space_arm_env.scene.entries.is_part", None)
    monkeypatch.setattr("dq_space_arm_env.scene.schema.staged_numbers", None)
    env.step(action)
