"""What is said to be the paper's is the paper's, and what is not is shown."""

import pytest

from dq_space_arm_env import Scene, load_scene
from experts.report.paper_numbers import ABSENT, compare_with_paper, own_choices


def differing(scene: Scene) -> dict[str, object]:
    return {row.quantity: row.scene for row in compare_with_paper(scene) if not row.agrees}


def test_scene_paper_agrees_in_every_number() -> None:
    assert differing(load_scene("paper")) == {}


def test_changed_numbers_are_named() -> None:
    cost = {"pose": [15, 15, 15, 15, 1, 1, 1, 1], "joint_torque": 0.02}
    assert differing(load_scene("paper").replace(cost=cost, simulation={"steps": 500})) == {
        "weight W_k,q, tip pose": (15, 15, 15, 15, 1, 1, 1, 1),
        "weight in R, joint torques": 0.02,
        "duration T": 7.5,
        "number of steps N": 500,
    }


def test_what_another_robot_lacks_is_absent(short_scene: Scene) -> None:
    found = differing(short_scene)
    assert found["weight in R, base force"] == found["weight in R, Euler rates"] == ABSENT


@pytest.mark.parametrize(
    ("name", "limit"), [("wheels", "wheel torque 0.2 N m"), ("thrusters", "thruster force 5 N")]
)
def test_limits_of_wheels_and_thrusters_are_own_choices(name: str, limit: str) -> None:
    assert own_choices(load_scene(name))["limits"].endswith(f"; {limit}")


def test_own_choices_are_those_of_the_scene() -> None:
    choices = own_choices(load_scene("paper"))
    assert choices["masses"] == "base 105; link 1 5; link 2 10; link 3 10 kg"
    assert "link 2 (0, 0, 0.2) turned 90° about (1, 0, 0)" in choices["joint frames"]
    assert own_choices(load_scene("payload"))["payload"].startswith("50 kg, diag(4.08, 4.08, 4.08) kg m²")
