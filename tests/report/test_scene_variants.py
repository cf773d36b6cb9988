"""Scenes with one part left out or added."""

import numpy as np
import pytest

from dq_space_arm_env import Scene, compile_scene, list_scenes, load_scene
from dq_space_arm_env.scene import StateLayout
from experts.report.scene_variants import feature_variants, in_the_plane, with_links, without_wrist
from scripts.benchmarks.robots import robots


def test_parts_left_out_take_their_states_and_inputs_along() -> None:
    sizes = {
        title: (StateLayout.of(scene).n_x, StateLayout.of(scene).n_u)
        for title, scene in feature_variants(load_scene("paper")).items()
    }
    expected = {
        "paper, as it is": (23, 12),
        "without wrist": (20, 9),
        "without joint torques": (23, 9),
        "without base force and torque": (23, 6),
        "with a tip wrench": (23, 12),
        "with 1 link": (19, 10),
        "in the plane, without wrist": (13, 6),
    }
    assert sizes.items() >= expected.items()


@pytest.mark.parametrize(
    ("name", "title"), [("payload", "without payload"), ("tip-load", "without tip wrench")]
)
def test_parts_that_only_some_scenes_have_are_left_out_too(name: str, title: str) -> None:
    variants = feature_variants(load_scene(name))
    whole, rest = compile_scene(load_scene(name)), compile_scene(variants[title])
    x = np.tile(whole.layout.initial_state, (1, 1))
    u = np.ones((1, whole.n_u))
    assert not np.allclose(whole.forward_dynamics(x, u), rest.forward_dynamics(x, u))


@pytest.mark.parametrize("name", [*robots(), "random-target"])
def test_parts_of_every_robot_make_scenes(name: str) -> None:
    """Each of them is validated; here, that there is something to compare."""
    scene = load_scene(name)
    variants = feature_variants(scene)
    branches = scene.parent_bodies != (*range(len(scene.links)),)
    assert ("with 1 link" in variants) != branches
    # A payload needs a link.
    assert ("with 0 links" in variants) == (scene.payload is None and not branches)
    whole = variants.pop(f"{name}, as it is")
    assert len(variants) >= (7 if branches else 10)
    hashes = {variant.content_hash() for variant in variants.values()}
    assert len(hashes - {whole.content_hash()}) == len(variants)


@pytest.mark.parametrize("name", list_scenes())
def test_parts_of_every_scene_make_scenes(name: str) -> None:
    """With constraints, phases, and targets that move."""
    assert len(feature_variants(load_scene(name))) > 10


def test_masses_are_observed_where_some_are_drawn() -> None:
    spread = {"observed": True, "link_masses": 0.1, "joint_angles": 0.1}
    scene = load_scene("no-wrist").replace(spread=spread)
    observed = {title: variant.spread.observed for title, variant in feature_variants(scene).items()}
    assert not observed.pop("without random masses")
    assert not observed.pop("with 0 links")
    assert observed.pop("without random starts")
    assert all(observed.values())


def test_a_random_target_has_a_random_motion() -> None:
    scene = load_scene("capture-and-detumble")
    moved = {"target_angular_velocity", "target_linear_velocity", "target_rotation", "target_position"}
    variants = feature_variants(scene)
    for title, kept in (("without random starts", True), ("without random target", False)):
        drawn = {name for name, width in variants[title].spread.model_dump().items() if width}
        assert drawn & moved == (moved if kept else set())
        assert ("joint_angles" in drawn) != kept


def test_constraints_go_with_what_they_need_and_others_stay() -> None:
    clear = {"frame": "target", "radius": 0.1}
    rates = {"kind": "control_rate", "name": "rates", "base_force": 5.0, "joint_torque": 3.0}
    plume = {"kind": "plume", "name": "gas", "angle_deg": 20.0, "keeps_clear": clear}
    scene = load_scene("no-wrist").replace(
        constraints=[rates, plume],
        parameters=["actuators.base_force", "base.mass"],
        initial_state={"previous_controls": [0.1] * 6},
    )
    variants = feature_variants(scene)
    (kept,) = variants["without base force"].constraints
    assert (kept.name, kept.base_force, kept.joint_torque) == ("rates", None, (3.0,))
    assert variants["without base force"].parameters == ("base.mass",)
    assert [each.name for each in variants["without joint torques"].constraints] == ["rates", "gas"]
    assert [each.name for each in variants["with 0 links"].constraints] == ["rates", "gas"]
    joints = scene.replace(
        constraints=[{**rates, "base_force": None}], initial_state={"previous_controls": ()}
    )
    assert feature_variants(joints)["without joint torques"].constraints == ()


def test_without_payload_the_phases_stay() -> None:
    without = feature_variants(load_scene("capture-and-detumble"))["without payload"]
    assert [phase.name for phase in without.phases] == ["approach", "latch", "detumble"]
    assert not any(phase.catch for phase in without.phases)


def test_features_that_a_scene_has_are_left_out_and_others_added(short_scene: Scene) -> None:
    drawing = feature_variants(load_scene("random-masses"))
    assert drawing["without random masses"].spread.payload_mass == 0.0
    assert drawing["without payload"].spread.link_masses == 0.1
    assert drawing["with random target"].spread.target_position > 0.0
    sprung = feature_variants(short_scene)["with springs and dampers"]
    assert sprung.links[0].stiffness > 0.0
    assert feature_variants(sprung)["without springs and dampers"].links[0].stiffness == 0.0


@pytest.mark.parametrize("name", ["paper", "six-joint", "tip-load", "payload"])
def test_in_the_plane_the_bodies_keep_their_masses_and_the_arm_its_length(name: str) -> None:
    scene = load_scene(name)
    flat = in_the_plane(scene)
    assert flat.base.motion == "planar"
    assert [link.mass for link in flat.links] == [link.mass for link in scene.links]
    assert (flat.payload is None) == (scene.payload is None)
    assert (flat.tip_wrench is None) == (scene.tip_wrench is None)
    for link, own in zip(flat.links, scene.links, strict=True):
        assert sum(link.joint.position) == pytest.approx(sum(own.joint.position))


def test_without_wrist_the_tip_stays_where_it_is_at_zero_angles() -> None:
    paper = compile_scene(load_scene("paper"))
    x, wrist = paper.layout.initial_state.copy(), paper.layout.state.wrist_angles
    x[wrist] = 0.0
    stiff = compile_scene(without_wrist(paper.scene))
    assert stiff.tip_pose(np.delete(x, wrist)) == pytest.approx(paper.tip_pose(x), abs=1e-15)


@pytest.mark.parametrize("count", [0, 1, 2])
@pytest.mark.parametrize("name", ["paper", "no-wrist"])
def test_a_shorter_arm_ends_where_the_next_joint_was(name: str, count: int) -> None:
    scene = load_scene(name)
    shorter = with_links(scene, count)
    assert shorter.links == scene.links[:count]
    end = shorter.tip if shorter.wrist is None else shorter.wrist.frame
    assert end == scene.links[count].joint
    assert shorter.initial_state.joint_angles == scene.initial_state.joint_angles[:count]
