"""What the tip does not hold is drawn with the target until a catch, and adrift when it is let go."""

import json
import re
from base64 import b64decode
from dataclasses import replace

import numpy as np
import pytest
from start_frames import start_poses

from dq_space_arm_env import DQSpaceArmEnv, DQSpaceArmVectorEnv, load_scene
from dq_space_arm_env.algebra import dual_quaternion, poses, screw
from dq_space_arm_env.environment.rollouts import rollout
from dq_space_arm_env.viewing.payload_places import (
    AT_TARGET,
    AT_TIP,
    leaves_tip,
    payload_path,
    payload_places,
)
from dq_space_arm_env.viewing.rendering import Renderer
from dq_space_arm_env.viewing.replay import common_scene, replay_page
from dq_space_arm_env.viewing.replay.flights import prepare
from dq_space_arm_env.viewing.replay.geometry import view_of

SIZE = {"width": 80, "height": 60}
NO_TRAIL = np.zeros((0, 3))
NEVER, ALWAYS = (
    {
        "attitude_error_deg": angle,
        "position_error": size,
        "angular_velocity_error_deg": angle,
        "velocity_error": size,
    }
    for angle, size in ((1e-3, 1e-6), (180.0, 10.0))
)
ABSENT = {"payload": None}


def staged(name, phases):
    """A scene with other phases, (steps, changes, tolerances of a catch) each."""
    described = [
        {"name": f"phase {index}", "steps": steps, "changes": changes}
        | ({} if catch is None else {"catch": catch})
        for index, (steps, changes, catch) in enumerate(phases)
    ]
    steps = sum(phase["steps"] for phase in described)
    simulation = load_scene(name).simulation.model_dump() | {"steps": steps}
    return load_scene(name).replace({"phases": described, "simulation": simulation})


REST = {"target.motion": None, "target.pose.position": [1.9, -0.5, 0.9]}
RELEASE = staged("release", [(2, {}, None), (5, ABSENT | {"target.pose.position": [0.98, -0.3, 1.03]}, None)])
CAUGHT, MISSED = (
    staged("capture-and-detumble", [(3, ABSENT, None), (4, REST, each)]) for each in (ALWAYS, NEVER)
)


def moving(count, start, twist):
    """Poses that keep a twist, a step each, shape (count, 8)."""
    times = [screw.exponential(tuple(step * np.array(twist))) for step in range(count)]
    return np.array([dual_quaternion.multiply(tuple(start), each) for each in times])


TIPS = moving(
    8, poses.from_axis_angle((1.0, 0.0, 0.0), 0.3, (0.2, -1.0, 4.0)), [0.1, 0.0, 0.2, 0.3, 0.1, 0.0]
)
TARGETS = moving(8, poses.from_axis_angle((0.0, 1.0, 0.0), 2.0, (1.2, 0.5, 2.0)), [0, 0.2, 0, 0.1, 0, 0.2])


@pytest.mark.parametrize(
    ("name", "leaves"), [("paper", False), ("payload", False), ("refuelling", False), ("release", True)]
)
def test_only_some_scenes_have_a_payload_that_leaves_the_tip(name, leaves):
    scene = load_scene(name)
    assert leaves_tip(scene) is leaves
    assert (payload_path(scene, TIPS, TARGETS) is None) is not leaves


@pytest.mark.parametrize(
    ("scene", "missed", "caught"),
    [
        (RELEASE, [AT_TIP, 1], [AT_TIP, 1]),
        (CAUGHT, [AT_TARGET, 1], [AT_TARGET, AT_TIP]),
        (
            staged("capture-and-detumble", [(3, ABSENT, None), (3, {}, ALWAYS), (3, ABSENT, None)]),
            [AT_TARGET, AT_TARGET, AT_TARGET],  # the target goes on moving
            [AT_TARGET, AT_TIP, 2],
        ),
        (
            staged("release", [(3, ABSENT, None), (3, {}, ALWAYS)]),
            [AT_TARGET, 1],
            [AT_TARGET, AT_TIP],
        ),
    ],
)
def test_places_phase_by_phase(scene, missed, caught):
    assert payload_places(scene).tolist() == [missed, caught]


def test_what_is_let_go_keeps_the_twist_of_the_tip():
    """The tip moves on with one twist here, and so does what it held; then the tip turns away."""
    turned = moving(5, TIPS[3], [0.4, 0.0, 0.0, 0.0, 0.0, 0.5])[1:]
    path = payload_path(RELEASE, np.vstack([TIPS[:4], turned]), TARGETS)
    np.testing.assert_allclose(path, TIPS, rtol=0, atol=1e-12)


def test_what_is_caught_comes_with_the_target_and_goes_on_with_the_tip():
    np.testing.assert_array_equal(payload_path(CAUGHT, TIPS, TARGETS), np.vstack([TARGETS[:3], TIPS[3:]]))
    rest = np.vstack([TARGETS[:3], np.tile(TARGETS[0], (5, 1))])
    np.testing.assert_allclose(payload_path(CAUGHT, TIPS, rest, caught=False), TARGETS, rtol=0, atol=1e-12)
    still = payload_path(CAUGHT, TIPS, TARGETS[0], caught=False)
    np.testing.assert_allclose(still, np.tile(TARGETS[0], (8, 1)), rtol=0, atol=1e-12)


def test_flights_shorter_than_the_phases_have_a_path():
    for count in (1, 2, 3, 4):
        for scene in (RELEASE, CAUGHT):
            assert payload_path(scene, TIPS[:count], TARGETS[:count]).shape == (count, 8)


def test_a_payload_is_drawn_at_the_tip_or_where_it_is_told():
    scene = load_scene("payload")
    renderer, frames, target = Renderer(scene), start_poses(scene), scene.target.pose.dual_quaternion
    held = renderer.draw(frames, NO_TRAIL)
    renderer.aim_at(target, payload=frames[-1])
    np.testing.assert_array_equal(renderer.draw(frames, NO_TRAIL), held)
    gone = np.full_like(frames, np.nan)
    for pose in (frames[-1], np.array(target)):
        renderer.aim_at(np.full(8, np.nan), payload=pose)
        drawn = renderer.draw(gone, NO_TRAIL)
        renderer.aim_at(np.full(8, np.nan), payload=np.full(8, np.nan))
        rows, columns = np.nonzero((drawn != renderer.draw(gone, NO_TRAIL)).any(axis=2))
        rotation, position = poses.to_matrix(tuple(pose))
        center = np.array(rotation) @ scene.payload.center_of_mass + np.array(position)
        seen = renderer.camera.project(center)[:2]
        np.testing.assert_allclose([columns.mean(), rows.mean()], seen, rtol=0, atol=6.0)
    renderer.aim_at(target)  # the payload is at the tip again
    np.testing.assert_array_equal(renderer.draw(frames, NO_TRAIL), held)


def flown(scene, seed=0):
    """Pictures of an episode, what the renderer draws with the payload at the path, and the path."""
    env = DQSpaceArmEnv(scene, render_mode="rgb_array", **SIZE)
    env.reset(seed=seed)
    action = np.full(env.action_space.shape, 0.7)
    states, targets, bodies, pictures = [env.state], [env.target], [], [env.render()]
    layout, caught = env.kernels.layout, True
    bodies.append(layout.target_body_with(env.stage_parameters))
    for _ in range(scene.simulation.steps):
        info = env.step(action)[4]
        caught = bool(info.get("caught", True))
        states.append(env.state)
        targets.append(env.target)
        bodies.append(layout.target_body_with(env.stage_parameters))
        pictures.append(env.render())
    tips = env.kernels.tip_pose(np.array(states))
    path = payload_path(scene, tips, targets, caught)
    renderer, trail, expected = Renderer(scene, env._picture), np.array(env._trail), []
    for index, x in enumerate(states):
        renderer.aim_at(targets[index], bodies[index], path[index])
        expected.append(renderer.draw(env.kernels.frame_poses(x), trail[: index + 1]))
    return env, pictures, expected, path, tips, np.array(targets)


@pytest.mark.parametrize("scene", [CAUGHT, MISSED, RELEASE], ids=["caught", "missed", "released"])
def test_pictures_show_the_payload_where_it_is(scene):
    _, pictures, expected, path, tips, targets = flown(scene)
    for picture, other in zip(pictures, expected, strict=True):
        assert (picture != other).mean() < 2e-3  # twists at an instant, and over a step
    start = scene.staged.starts[1]
    before = tips if scene is RELEASE else targets
    np.testing.assert_array_equal(path[:start], before[:start])
    if scene is CAUGHT:
        np.testing.assert_array_equal(path[start:], tips[start:])
    else:
        left = np.abs(path[-1] - tips[-1]).max()
        assert left > 1e-4
        assert np.abs(path[start:] - targets[start:]).max() > 0.05, "it does not jump to the next target"
        assert np.abs(np.diff(path, axis=0)).max() < 0.05


@pytest.mark.parametrize("scene", [MISSED, RELEASE], ids=["missed", "released"])
def test_a_saved_state_has_the_payload_where_it_was(scene):
    """Whether or not pictures are drawn, alone or in a batch, now and later."""
    env, venv = DQSpaceArmEnv(scene), DQSpaceArmVectorEnv(2, scene)
    others = DQSpaceArmEnv(scene, render_mode="rgb_array", **SIZE), DQSpaceArmVectorEnv(2, scene)
    env.reset(seed=3)
    venv.reset(seed=[3, 4])
    actions = np.random.default_rng(0).uniform(
        -1.0, 1.0, (scene.simulation.steps - 1, *env.action_space.shape)
    )
    for action in actions[:5]:
        env.step(action)
        venv.step(np.tile(action, (2, 1)))
    others[0].reset(options={"state": env.get_state()})
    others[1].reset(options={"state": venv.get_state()})
    for action in actions[5:]:
        for each in (env, others[0]):
            each.step(action)
        for each in (venv, others[1]):
            each.step(np.tile(action, (2, 1)))
        at, beside = (
            np.array(each._payloads.poses(memory, np.atleast_2d(each.parameters), targets))
            for each, memory, targets in (
                (env, env._memory[None], env.target[None]),
                (venv, venv._envs.kept()["memory"], venv.targets),
            )
        )
        np.testing.assert_array_equal(at[0], beside[0])
        for each, other in zip((env, venv), others, strict=True):
            state, restored = each.get_state(), other.get_state()
            for name, array in state.items():
                np.testing.assert_array_equal(array, restored[name])
        assert np.isnan(env.get_state()["adrift"]).all() == (scene is MISSED)


@pytest.mark.parametrize("scene", [MISSED, RELEASE], ids=["missed", "released"])
def test_copies_are_drawn_as_single_environments_through_resets(scene):
    venv = DQSpaceArmVectorEnv(2, scene, render_mode="rgb_array", **SIZE)
    singles = [DQSpaceArmEnv(scene, render_mode="rgb_array", **SIZE) for _ in range(2)]
    venv.reset(seed=3)
    for index, single in enumerate(singles):
        single.reset(seed=3 + index)
    rng, over = np.random.default_rng(0), False
    for _ in range(2 * scene.simulation.steps):
        actions = rng.uniform(-1.0, 1.0, venv.action_space.shape)
        venv.step(actions)
        for single, action in zip(singles, actions, strict=True):
            single.reset() if over else single.step(action)
        over = singles[0]._over
        np.testing.assert_array_equal(venv.render(), [single.render() for single in singles])


@pytest.mark.parametrize("scene", [CAUGHT, MISSED, RELEASE], ids=["caught", "missed", "released"])
def test_a_rollout_knows_the_path_of_the_payload(scene):
    flight = rollout(lambda seen: np.full((len(seen), 9), 0.7), scene, [0], record=True).trajectory(
        0, "flight"
    )
    path, tips = flown(scene)[3:5]
    signs = np.sign(np.sum(path[:, :4] * flight.payload[:, :4], axis=1))[:, None]
    np.testing.assert_allclose(flight.payload, signs * path, rtol=0, atol=1e-9)
    shown = prepare([flight], scene)[0]
    np.testing.assert_array_equal(np.abs(shown.payload), np.abs(flight.payload))
    planned = prepare(common_scene([replace(flight, payload=None, target=None, target_body=None)])[0], scene)[
        0
    ]
    if scene is MISSED:  # a plan is taken at its word
        np.testing.assert_allclose(np.abs(planned.payload[3:]), np.abs(tips[3:]), rtol=0, atol=1e-9)


def test_a_page_has_the_path_of_the_payload_and_keeps_it_in_view(make_flight):
    scene = load_scene("release")
    flight = make_flight(scene, steps=20)
    far = moving(21, scene.target.pose.dual_quaternion, [0.0, 0.0, 0.0, 0.3, 0.2, 0.1])
    away = replace(flight, payload=far)
    text = re.search(r'class="replay-data"[^>]*>(.*?)</script>', replay_page([away], scene), re.DOTALL)[1]
    data = json.loads(text)
    place, blob = data["flights"][0]["payload"], b64decode(data["blob"])
    found = np.frombuffer(blob, place["type"], place["length"], place["start"]).reshape(21, 8)
    np.testing.assert_array_equal(found, far.astype(np.float32))
    assert data["solids"]["counts"][-2] > 0
    position = np.array(poses.position(tuple(far[-1])))
    views = [view_of(prepare([each], scene), scene) for each in (flight, away)]
    near, wide = (
        all((points @ axis).max() >= position @ axis for axis in (*np.eye(3), *-np.eye(3)))
        for points in (view.points for view in views)
    )
    assert (near, wide) == (False, True)
