"""Targets, masses and inertias that a scene draws for each episode: inputs of the machine code."""

import gymnasium
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from dq_space_arm_env import DQSpaceArmVectorEnv, compile_scene, load_scene
from dq_space_arm_env.scene import Spread, StateLayout
from dq_space_arm_env.scene.start import episode_scene, episode_start, number_of_draws, parameter_values
from dq_space_arm_env.task.step_report import observation_entries

TARGETS = {"joint_angles": 0.5, "target_rotation": 0.4, "target_position": 0.3}
MASSES = {"base_mass": 0.2, "base_inertia": 0.3, "link_masses": 0.4, "link_inertias": 0.5}
PAYLOAD = {"payload_mass": 0.6, "payload_inertia": 0.7}


def spread_out(name):
    scene = load_scene(name)
    return scene.replace(spread=TARGETS | MASSES | (PAYLOAD if scene.payload else {}))


def drawn_scene(scene, draws):
    return episode_scene(scene, parameter_values(scene, episode_start(scene, draws.tolist())))


def make(scene):
    return gymnasium.make("DQSpaceArm-v0", scene=scene).unwrapped


@pytest.mark.sampled
@pytest.mark.parametrize("name", ["paper", "payload", "planar", "tip-load", "no-wrist"])
def test_an_episode_is_that_of_a_scene_with_the_drawn_numbers(name):
    """The machine code with parameters against that of a scene in which they are constants."""
    env = make(spread_out(name))
    for seed in range(2):
        env.reset(seed=seed)
        twin = make(env.episode_scene)
        observation, _ = twin.reset(options={"initial_state": env.state})
        rng = np.random.default_rng(seed)
        for _ in range(5):
            action = rng.uniform(-1, 1, env.action_space.shape)
            actual, expected = env.step(action), twin.step(action)
            np.testing.assert_allclose(actual[0], expected[0], rtol=1e-12, atol=1e-12)
            assert actual[1] == pytest.approx(expected[1], rel=1e-11)
            for key, value in expected[4].items():
                assert actual[4][key] == pytest.approx(value, rel=1e-10, abs=1e-10), key
        assert (np.abs(observation - actual[0]) > 1e-6).any()


def test_episodes_differ_in_what_is_drawn():
    env = make(spread_out("payload"))
    drawn = []
    for seed in range(3):
        env.reset(seed=seed)
        drawn.append(env.parameters)
    names = env.kernels.parameters.names
    assert len(names) == len(drawn[0])
    assert (np.ptp(drawn, axis=0) > 0).all()
    scene = env.episode_scene
    assert scene.base.mass == drawn[-1][names.index("base.mass")]
    assert scene.payload.inertia[1][1] == drawn[-1][names.index("payload.inertia.yy")]
    assert abs(scene.base.mass / 105 - 1) <= 0.2


@pytest.mark.parametrize("options", [{"nominal": True}, "given"])
def test_a_given_start_has_the_nominal_target_and_masses(options):
    env = make(spread_out("payload"))
    if options == "given":
        options = {"initial_state": env.kernels.layout.initial_state}
    env.reset(seed=0)
    env.reset(options=options)
    assert env.episode_scene.base == env.scene.base
    found, nominal = (scene.target.pose.dual_quaternion for scene in (env.episode_scene, env.scene))
    np.testing.assert_allclose(found, nominal, rtol=0, atol=1e-15)


def test_what_is_drawn_is_a_parameter():
    paper, payload = load_scene("paper"), load_scene("payload")
    assert names_of(paper) == []
    # The target is a parameter as a whole, so that it can be set to any.
    moved = names_of(paper.replace(spread={"target_position": 0.1}))
    assert moved == [f"target.pose.q_{part}{index}" for part in "rd" for index in range(4)]
    assert names_of(payload.replace(spread={"payload_mass": 0.1})) == ["payload.mass"]
    # What is zero stays zero under a factor.
    turned = names_of(payload.replace(spread={"base_inertia": 0.1}))
    assert turned == ["base.inertia.xx", "base.inertia.yy", "base.inertia.zz"]


def names_of(scene):
    return list(StateLayout.of(scene).parameters.names)


def test_a_scene_that_draws_states_only_pays_nothing():
    for name, draws in (("paper", False), ("random-target", True)):
        inputs = [spec.name for spec in compile_scene(name).kernel("environment_step").inputs]
        assert ("parameters" in inputs) == draws
    paper = load_scene("paper")
    still = compile_scene(paper.replace(spread=Spread())).operation_count("environment_step")
    assert compile_scene("paper").operation_count("environment_step") == still
    drawn = compile_scene("random-target").operation_count("environment_step")
    assert still < drawn < 1.05 * still
    fixed = compile_scene("payload").operation_count("environment_step")
    assert fixed < compile_scene("random-masses").operation_count("environment_step") < 1.1 * fixed


def test_copies_have_parameters_of_their_own():
    venv = DQSpaceArmVectorEnv(5, spread_out("payload"))
    venv.reset(seed=3)
    for copy, parameters in enumerate(venv.parameters):
        env = make(venv.scene)
        env.reset(seed=3 + copy)
        np.testing.assert_array_equal(parameters, env.parameters)


def test_masses_are_observed_where_asked():
    plain = spread_out("payload")
    scene = plain.replace({"spread.observed": True})
    telling, plainly = DQSpaceArmVectorEnv(5, scene), DQSpaceArmVectorEnv(5, plain)
    seen, less = (venv.reset(seed=3)[0] for venv in (telling, plainly))
    entries = [name for name, _ in observation_entries(scene)]
    where = [index for index, name in enumerate(entries) if name.startswith("relative change of ")]
    places = ["base", "links.0", "links.1", "links.2", "payload"]
    told = {f"{place}.{quantity}" for place in places for quantity in ("mass", "inertia.xx")}
    assert {entries[index].removeprefix("relative change of ") for index in where} == told
    for index in where:
        column = telling.kernels.parameters.names.index(entries[index].removeprefix("relative change of "))
        relative = telling.parameters[:, column] / telling.kernels.parameters.nominal[column]
        np.testing.assert_allclose(seen[:, index], relative - 1.0, rtol=0, atol=1e-15)
    np.testing.assert_array_equal(np.delete(seen, where, axis=1), less)
    calm = telling.kernels.observation_jacobian(telling.states, p=telling.parameters)
    assert not calm[:, where].any()
    nominal, _ = make(scene).reset(options={"nominal": True})
    assert not nominal[where].any()
    assert "observed" not in plain.model_dump()["spread"]


def test_drawn_bodies_keep_their_proportions():
    scene = spread_out("payload")
    draws = np.random.default_rng(0).uniform(-1, 1, number_of_draws(scene))
    drawn = drawn_scene(scene, draws)
    bodies = zip(
        (scene.base, *scene.links, scene.payload), (drawn.base, *drawn.links, drawn.payload), strict=True
    )
    # The last draws: base, masses of the links, inertias of the links, payload.
    n = len(scene.links)
    widths = np.array([0.2, 0.3, *[0.4] * n, *[0.5] * n, 0.6, 0.7])
    factors = 1.0 + widths * draws[-len(widths) :]
    masses = [factors[0], *factors[2 : 2 + n], factors[-2]]
    inertias = [factors[1], *factors[2 + n : 2 + 2 * n], factors[-1]]
    for (nominal, body), mass, inertia in zip(bodies, masses, inertias, strict=True):
        assert body.mass == pytest.approx(mass * nominal.mass, rel=1e-15)
        np.testing.assert_allclose(body.inertia, inertia * np.array(nominal.inertia), rtol=1e-15)
    assert not any(drawn.spread.model_dump().values())


def test_a_drawn_target_is_turned_in_its_axes_and_moved_in_inertial_ones():
    scene = load_scene("random-target")
    draws = np.random.default_rng(1).uniform(-1, 1, number_of_draws(scene))
    drawn = drawn_scene(scene, draws).target.pose
    nominal = scene.target.pose
    expected = nominal.position + scene.spread.target_position * draws[-3:]
    np.testing.assert_allclose(drawn.position, expected, rtol=0, atol=1e-14)
    before, after = (Rotation.from_quat(pose.rotation, scalar_first=True) for pose in (nominal, drawn))
    relative = before.inv() * after
    np.testing.assert_allclose(
        relative.as_rotvec(), scene.spread.target_rotation * draws[-6:-3], rtol=0, atol=1e-14
    )


@pytest.mark.parametrize(
    ("spread", "message"),
    [
        ({"base_mass": 1.0}, r"spread.base_mass = 1.*must be a fraction: 0 or greater, and less than 1"),
        ({"payload_mass": 0.1}, "spread.payload_mass = 0.1.*must be 0: the scene has no payload"),
        ({"observed": True}, "spread.observed = true: must be false: neither masses nor inertias are drawn"),
        ({"target_position": -1}, "spread.target_position = -1.*0 or greater"),
    ],
)
def test_a_spread_without_sense_is_refused(spread, message):
    with pytest.raises(ValueError, match=message):
        load_scene("paper").replace(spread=spread)
