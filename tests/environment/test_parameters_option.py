"""The option `parameters` of `reset`: what varies in a scene, given instead of drawn."""

import gymnasium
import numpy as np
import pytest
from short_scenes import short

from dq_space_arm_env import DQSpaceArmVectorEnv, load_scene
from dq_space_arm_env.scene import SceneError

NAMES = ["payload.mass", "links.1.damping", "actuators.joint_torque", "cost.base_torque", "target.pose"]


def make(scene):
    return gymnasium.make("DQSpaceArm-v0", scene=scene).unwrapped


@pytest.fixture(scope="module")
def scene():
    return load_scene("payload").replace(
        parameters=NAMES, spread={"joint_angles": 0.3}, simulation={"steps": 5}
    )


def given(kernels, **changes):
    p = kernels.parameters.nominal.copy()
    for name, value in changes.items():
        p[kernels.parameters.indices(name.replace("__", "."))] = value
    return p


CHANGES = {
    "payload__mass": 80.0,
    "links__1__damping": 2.0,
    "actuators__joint_torque__limit": 3.0,
    "cost__base_torque": 7.0,
    "target__pose": [1.0, 0, 0, 0, 0, 0.5, 0.1, 0.4],
}


def test_an_episode_is_that_of_a_scene_with_these_numbers(scene):
    env = make(scene)
    p = given(env.kernels, **CHANGES)
    env.reset(seed=2, options={"parameters": p})
    np.testing.assert_array_equal(env.parameters, p)
    constant = env.episode_scene
    assert constant.payload.mass == 80.0
    assert constant.links[1].damping == 2.0
    assert constant.actuators.joint_torque.limit == 3.0
    assert constant.cost.base_torque == (7.0, 7.0, 7.0)
    np.testing.assert_array_equal(constant.target.pose.dual_quaternion, env.target)
    twin = make(constant)
    twin.reset(options={"initial_state": env.state})
    rng = np.random.default_rng(0)
    for _ in range(5):
        action = rng.uniform(-1.2, 1.2, env.action_space.shape)
        actual, expected = env.step(action), twin.step(action)
        np.testing.assert_allclose(actual[0], expected[0], rtol=1e-11, atol=1e-11)
        assert actual[1] == pytest.approx(expected[1], rel=1e-10)
        assert actual[4] == pytest.approx(expected[4], rel=1e-9)
    env.reset()
    np.testing.assert_array_equal(env.parameters, env.kernels.parameters.nominal)


def test_sub_environments_have_parameters_of_their_own(scene):
    venv, singles = DQSpaceArmVectorEnv(3, scene), [make(scene) for _ in range(3)]
    rows = np.array([given(venv.kernels, payload__mass=mass) for mass in (20.0, 60.0, 90.0)])
    observations, _ = venv.reset(seed=4, options={"parameters": rows})
    for i, env in enumerate(singles):
        observation, _ = env.reset(seed=4 + i, options={"parameters": rows[i]})
        np.testing.assert_array_equal(observations[i], observation)
    actions = np.random.default_rng(0).uniform(-1, 1, venv.action_space.shape)
    for _ in range(5):
        found = venv.step(actions)
        for i, env in enumerate(singles):
            np.testing.assert_array_equal(found[0][i], env.step(actions[i])[0])
    venv.reset(options={"parameters": rows[2]})
    np.testing.assert_array_equal(venv.parameters, np.tile(rows[2], (3, 1)))


def test_a_start_has_the_sign_of_the_given_target(scene):
    env = make(scene)
    for sign in (1.0, -1.0):
        p = given(env.kernels, target__pose=sign * np.array(CHANGES["target__pose"]))
        env.reset(seed=0, options={"parameters": p})
        assert env.kernels.tip_pose(env.state)[:4] @ env.target[:4] >= 0.0


@pytest.mark.parametrize(
    ("name", "parameters", "message"),
    [
        ("paper", [1.0], r"parameters \[1.\] of shape \(1,\), should be finite numbers of shape \(0,\)"),
        ("named", np.ones(3), r"shape \(3,\)"),
        ("named", {"payload__mass": np.nan}, "should be finite numbers"),
        ("named", {"payload__mass": -1.0}, "payload.mass = -1"),
        ("named", {"target__pose": np.ones(8)}, "target"),
        ("named", {"target__pose": [1.0, 0, 0, 0, 0, 5e5, 0, 0]}, r"pose\.position: 1e\+06 m; lengths of"),
        ("named", "no", "parameters"),
    ],
)
def test_parameters_that_no_scene_may_have_are_refused(scene, name, parameters, message):
    env = make(scene if name == "named" else short("paper"))
    env.reset(seed=0)
    before = env.get_state()
    if isinstance(parameters, dict):
        parameters = given(env.kernels, **parameters)
    with pytest.raises((ValueError, TypeError), match=message) as caught:
        env.reset(options={"parameters": parameters})
    assert isinstance(caught.value, SceneError) == ("mass = " in message or message == "target")
    np.testing.assert_array_equal(env.state, before["x"])


@pytest.mark.parametrize("precision", ["float64", "float32"])
def test_waypoints_say_how_fast_the_target_moves(precision):
    points = [{"time": 0.0, "pose": {}}, {"time": 6.0, "pose": {"position": [1, 0, 0]}}]
    motion = {"kind": "waypoints", "points": points}
    env = make(short("planar", 5, precision).replace({"target.motion": motion}))
    env.reset(seed=0)
    env.reset(options={"parameters": env.parameters})
    fast = given(env.kernels, target__velocity__v_x=1e5)
    with pytest.raises(ValueError, match=r"target\.velocity\.v_x is 100000, should be 0\.166667: the waypo"):
        env.reset(options={"parameters": fast})


def test_what_is_drawn_is_told_by_name_at_reset():
    env = gymnasium.make("DQSpaceArm-v0", scene="random-masses")
    _, info = env.reset(seed=4)
    inside = env.unwrapped
    assert info["parameters"] == dict(
        zip(inside.kernels.parameters.names, inside.parameters.tolist(), strict=True)
    )
    assert len(set(info["parameters"])) == inside.kernels.n_p > 0
    assert "parameters" not in env.step(env.action_space.sample())[4]
    assert "parameters" not in gymnasium.make("DQSpaceArm-v0", scene="paper").reset(seed=4)[1]
