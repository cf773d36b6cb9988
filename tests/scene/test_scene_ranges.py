"""Numbers that the arithmetic cannot carry, and names that cannot be written, are refused by name."""

import re
from collections.abc import Callable
from typing import Any

import numpy as np
import pytest

from dq_space_arm_env import load_scene
from dq_space_arm_env.environment import DQSpaceArmEnv
from dq_space_arm_env.scene import Scene, SceneError
from dq_space_arm_env.scene.loading import list_scenes

Change = Callable[..., dict[str, Any]]
Refusals = Callable[[dict[str, Any]], list[str]]

TOO_LARGE = [
    ("spread.base_position", 1e200),
    ("spread.base_rotation", 1e200),
    ("spread.joint_angles", 1e7),
    ("spread.joint_rates", 1e200),
    ("target.pose", {"position": [1e16, 0, 0]}),
    ("initial_state.base_pose", {"position": [0, 1e16, 0]}),
    ("initial_state.joint_angles", [1e16, 0]),
    ("initial_state.base_velocity", [1e200, 0, 0, 0, 0, 0]),
    ("links.0.center_of_mass", [1e16, 0, 0]),
    ("links.0.joint", {"position": [0, 0, 1e16]}),
    ("links.0.stiffness", 1e200),
    ("links.0.rest_angle", 1e200),
    ("tip", {"position": [1e16, 0, 0]}),
    ("base.mass", 1e200),
    ("base.inertia", [1e200, 1e200, 1e200]),
    ("actuators.base_force.limit", 1e200),
    ("actuators.joint_torque.limit", 1e200),
    ("cost.pose", 1e200),
    ("cost.joint_torque", 1e200),
    ("tip_wrench", {"force": [1e200, 0, 0]}),
    ("success.position_error", 1e200),
    ("simulation.dt", 1e200),
]
TOO_SMALL = [
    ("base.mass", 1e-200),
    ("base.inertia", [1e-200, 1e-200, 1e-200]),
    ("cost.base_force", 1e-200),
    ("actuators.base_force.limit", 1e-200),
    ("simulation.dt", 1e-200),
]


@pytest.mark.parametrize(
    ("path", "value", "said"),
    [(*each, "at most") for each in TOO_LARGE]
    + [(*each, "at least") for each in TOO_SMALL]
    + [("simulation.steps", 10**18, "a whole number of at most 10,000,000")],
)
def test_a_number_out_of_range_is_named(
    data: dict[str, Any], change: Change, refusals: Refusals, path: str, value: Any, said: str
) -> None:
    (sentence,) = refusals(change(data, path, value))
    assert sentence.startswith(re.sub(r"\.(\d+)", r"[\1]", path))
    assert said in sentence


def test_a_cost_that_overflows_is_refused(data: dict[str, Any], change: Change, refusals: Refusals) -> None:
    change(data, "actuators.base_force.limit", 1e10)
    (sentence,) = refusals(change(data, "cost.base_force", 1e10))
    assert sentence.startswith("cost.base_force = ")
    assert "an episode may cost 1e+33" in sentence
    assert sentence.endswith("lower it or actuators.base_force")


def test_the_weight_of_a_motor_is_named_where_it_is_too_large(
    data: dict[str, Any], change: Change, refusals: Refusals
) -> None:
    """Another joint has the largest limit."""
    change(data, "links.1.torque_limit", 1e6)
    change(data, "links.0.torque_limit", 1e4)
    (sentence,) = refusals(change(data, "links.0.torque_weight", 1e24))
    assert sentence.startswith("links[0].torque_weight = 1e+24: with the limit 10000 ")
    assert sentence.endswith("lower it or links.0.torque_limit")


@pytest.mark.parametrize(
    ("changes", "said"),
    [
        ({"spread": {"base_position": 1e7}}, r"spread\.base_position = 1e\+07: starts may have a norm"),
        ({"spread": {"joint_rates": 1e6}}, r"spread\.joint_rates = 1e\+06"),
        ({"target": {"pose": {"position": [1e8, 0, 0]}}}, r"target\.pose\.position: 1e\+08 m"),
        ({"tip": {"position": [1e8, 0, 0]}}, r"tip\.position: 1e\+08 m"),
        (
            {"actuators": {"base_force": {"limit": 1e6, "time_constant": 0.05}}},
            r"actuators\.base_force\.limit\.x = 1e\+06: what lags, is late or limited in its rate",
        ),
    ],
)
def test_an_environment_refuses_what_it_cannot_observe(changes: dict[str, Any], said: str) -> None:
    with pytest.raises(ValueError, match=said):
        DQSpaceArmEnv(load_scene("planar").replace(**changes))


def test_what_is_accepted_flies() -> None:
    """The largest spread that an environment takes leaves its starts sound."""
    env = DQSpaceArmEnv(load_scene("planar").replace(spread={"base_position": 5e5, "joint_rates": 1e5}))
    for seed in range(3):
        observation, _ = env.reset(seed=seed)
        assert env.observation_space.contains(observation)
        *_, info = env.step(np.zeros(env.action_space.shape or ()))
        assert info.pop("diverged") or info["step_error"] <= 1.0  # joints may be too fast to follow
        del info["step_error"]
        assert np.isfinite([float(value) for value in info.values()]).all()


@pytest.mark.parametrize("path", ["name", "links.0.name"])
@pytest.mark.parametrize(
    "name", ["\x1b[31mred", "a\x00b", "two\nlines", "a\u202eb", "\udc80", "\ufffe", "\x9b1m"]
)
def test_names_have_no_control_characters(
    data: dict[str, Any], change: Change, refusals: Refusals, path: str, name: str
) -> None:
    (sentence,) = refusals(change(data, path, name))
    assert "must have no control characters" in sentence or "valid string" in sentence
    assert sentence.isprintable()


def test_keys_are_shown_without_their_control_characters(
    data: dict[str, Any], change: Change, refusals: Refusals
) -> None:
    data["\x1b[31mmass\x9b"] = 3
    (sentence,) = refusals(data)
    assert sentence.startswith(r"\x1b[31mmass\x9b: unknown key")


def test_huge_values_are_cut_before_they_are_written(data: dict[str, Any], change: Change) -> None:
    bomb: list[Any] = ["x"] * 10
    for _ in range(40):
        bomb = [bomb] * 10
    for path in ("base.mass", "links.0.center_of_mass", "description", "simulation.integrator"):
        with pytest.raises(SceneError) as caught:
            load_scene(change({**data}, path, bomb))
        assert len(str(caught.value)) < 2000


def test_a_thousand_problems_are_counted(data: dict[str, Any]) -> None:
    with pytest.raises(SceneError) as caught:
        load_scene({**data, **{f"key {number}": 0 for number in range(1000)}})
    assert "1000 problems" in str(caught.value)
    assert str(caught.value).endswith("and 980 more")


@pytest.mark.parametrize("name", list_scenes())
def test_the_scenes_that_ship_are_within(name: str) -> None:
    assert isinstance(DQSpaceArmEnv(load_scene(name)).scene, Scene)
