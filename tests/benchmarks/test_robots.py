"""One shipped scene stands for each distinct robot."""

from collections import Counter

from dq_space_arm_env import list_scenes, load_scene
from scripts.benchmarks.robots import OTHER_MOTIONS, PREFERRED, robot, robots


def test_each_shipped_robot_is_there_once_and_the_papers_first() -> None:
    found = robots()
    assert found[0] == "paper"
    assert set(PREFERRED) <= set(found) <= set(list_scenes())
    kinds = Counter(robot(load_scene(name)) for name in found)
    assert set(kinds.values()) == {1}
    shipped = (load_scene(name) for name in list_scenes())
    assert set(kinds) == {robot(scene) for scene in shipped if not scene.phases}
    assert not set(found) & set(OTHER_MOTIONS)


def test_another_task_is_no_other_robot() -> None:
    paper = load_scene("paper")
    others = [
        paper.replace(target={"pose": {"position": [1.0, 0.0, 0.0]}}, spread={"target_position": 0.1}),
        paper.replace(cost={"pose": 3.0}, success={"position_error": 0.2}, name="another"),
        paper.replace({"actuators.base_force.limit": 3.0, "links.0.torque_limit": 1.0}),
        paper.replace(simulation={"dt": 0.02, "steps": 10}, initial_state={"joint_angles": [0.0, 0.0, 0.0]}),
        paper.replace(parameters=["target.pose", "cost", "actuators"]),
    ]
    assert {robot(scene) for scene in others} == {robot(paper)}


def test_what_changes_the_dynamics_is_another_robot() -> None:
    paper = load_scene("paper")
    others = [
        paper,
        paper.replace({"links.0.mass": 6.0}),
        paper.replace({"links.0.actuated": False}),
        paper.replace(base={"mass": 100.0}),
        paper.replace(actuators={"base_force": None}),
        paper.replace(tip={"position": [0.1, 0.0, 0.0]}),
        paper.replace(tip_wrench={"force": [1.0, 0.0, 0.0]}),
        paper.replace(spread={"base_mass": 0.1}),
        paper.replace(parameters=["links.0.mass"]),
        paper.replace(simulation={"integrator": "rk6"}),
        paper.replace(simulation={"precision": "float32"}),
    ]
    assert len({robot(scene) for scene in others}) == len(others)
