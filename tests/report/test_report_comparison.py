"""What is said to be the paper's is the paper's, and what is not is shown."""

from dq_space_arm_env import Scene, load_scene
from experts.report.comparison import ABSENT, compare_with_paper, numbers, own_choices


def differing(scene: Scene) -> dict[str, object]:
    return {row.quantity: row.scene for row in compare_with_paper(scene) if not row.agrees}


def test_scene_paper_agrees_in_every_number() -> None:
    assert differing(load_scene("paper")) == {}


def test_changed_numbers_are_named() -> None:
    scene = load_scene("paper").replace(
        cost={"pose": [15, 15, 15, 15, 1, 1, 1, 1], "joint_torque": 0.02}, simulation={"steps": 500}
    )
    assert differing(scene) == {
        "weight W_k,q, tip pose": (15, 15, 15, 15, 1, 1, 1, 1),
        "weight in R, joint torques": 0.02,
        "duration T": 7.5,
        "number of steps N": 500,
    }


def test_other_robots_differ(short_scene: Scene) -> None:
    found = differing(short_scene)
    assert found["arm"] == "1 revolute joint, no wrist, base in the plane"
    assert found["weight in R, base force"] == ABSENT
    assert found["weight in R, Euler rates"] == ABSENT


def test_own_choices_of_scene_paper() -> None:
    choices = own_choices(load_scene("paper"))
    assert choices["masses"] == "base 105; link 1 5; link 2 10; link 3 10 kg"
    assert choices["base at the start"] == "(0.3, -2.9, 4.4) m"
    assert choices["limits"] == "base force 10 N; base torque 5 N m; joint torque 2 N m; Euler rate 0.5 rad/s"
    assert "link 2 (0, 0, 0.2) turned 90° about (1, 0, 0)" in choices["joint frames"]
    assert choices["integrator"] == "rk4"


def test_payload_and_tip_wrench_are_among_the_choices() -> None:
    assert own_choices(load_scene("payload"))["payload"].startswith("50 kg, diag(4.08, 4.08, 4.08) kg m²")
    assert own_choices(load_scene("tip-load"))["wrench at the tip"] == "(0.2, 0, -0.1) N, (0.05, 0, 0.02) N m"
    assert "payload" not in own_choices(load_scene("paper"))


def test_vectors_are_written_shortly() -> None:
    assert numbers((0.0, -0.0)) == "0"
    assert numbers((0.5, -1.0)) == "(0.5, -1)"
