"""Every refusal of the schema names the field, the value, and what would be right."""

import pickle
import re
from collections.abc import Callable
from typing import Any

import numpy as np
import pytest
from pydantic import ValidationError

from dq_space_arm_env.scene import (
    AxisLimits,
    Link,
    Pose,
    Scene,
    SceneError,
    Simulation,
    Spread,
    load_scene,
)
from dq_space_arm_env.scene.constraints import JointLimits

Change = Callable[..., dict[str, Any]]
Refusals = Callable[[dict[str, Any]], list[str]]

NAN, INF = float("nan"), float("inf")
TRIANGLE = [1, 1, 5]
TILTED: list[list[float]] = [[2, 0.5, 0], [0.5, 3, 0], [0, 0, 4]]

REFUSED = [  # path, value, what the sentence says
    # unknown and missing keys, texts
    ("kk", 3, "kk: unknown key; known keys here: name, description, base"),
    ("bas", 3, "unknown key; did you mean 'base'? Known keys here: name"),
    ("target.pose.dual_quat", [1] * 8, "did you mean 'dual_quaternion'?"),
    ("links.0.axis", [1, 0, 0], "about the z axis of its frame: turn that with joint.rotation"),
    ("name", "", "must not be empty"),
    ("description", True, "must be text"),
    # containers of the wrong kind
    ("links.0", [1], "must be a mapping, as {name: ..., mass: ..., "),
    ("actuators.base_torque", 1.0, "must be a mapping, as {limit: 1.0}"),
    # numbers of the wrong kind
    ("base.mass", "heavy", "finite number greater than 0 (mass of the base, kg)"),
    ("base.mass", True, "finite number greater than 0"),
    ("base.mass", 10**400, "finite number greater than 0"),
    ("base.mass", 0, "finite number greater than 0"),
    ("links.0.mass", NAN, "finite number greater than 0"),
    ("links.0.center_of_mass", [1, 2], "3 finite numbers; it has 2"),
    ("links.0.center_of_mass", [1, 2, NAN], "3 finite numbers"),
    ("links.0.actuated", "no", "must be true or false"),
    ("links.0.stiffness", -1, "0 or greater"),
    ("links.0.damping", INF, "finite number, 0 or greater"),
    # physics
    ("base.inertia", 3, "must be 3 numbers (diagonal) or 3x3"),
    ("base.inertia", [[1, 0], [0, 1], [0, 0]], "must be 3 finite numbers"),
    ("base.inertia", [[2, 0.5, 0], [0.4, 3, 0], [0, 0, 4]], "must be symmetric"),
    ("base.inertia", [[1, 2, 0], [2, 1, 0], [0, 0, 1]], "principal moments -1, 1, 3"),
    ("links.1.inertia", TRIANGLE, "two smaller must add up to at least the largest"),
    # actuators
    ("actuators.base_force.limit", 0, "greater than 0, or .inf"),
    ("actuators.base_force.limit", [1, 1, -1], "one number or 3 numbers"),
    ("actuators.base_torque.limit", [1, 1], "one number or 3 numbers"),
    ("actuators.joint_torque.limit", [1, 1, 1], "must be a number"),
    ("links.0.torque_limit", 0, "greater than 0"),
    # cost, spread, success, simulation
    ("cost.pose", [1, 2], "one number or 8 numbers, each finite and 0 or greater"),
    ("cost.terminal_pose", INF, "finite"),
    ("cost.base_force", 0, "one number or 3 numbers, each finite and greater than 0"),
    ("spread.base_rotation", -0.1, "0 or greater"),
    ("success.position_error", 0, "greater than 0"),
    ("simulation.dt", 0, "greater than 0 (time step, s)"),
    ("simulation.steps", 10.5, "whole number, 1 or greater"),
    ("simulation.integrator", "rk44", "did you mean 'rk4'?"),
    ("simulation.integrator", "euler", "must be one of symplectic_euler, rk4"),
    ("base.motion", "flat", "'spatial' or 'planar'"),
    # what must fit together
    ("payload", {"mass": 5, "inertia": [1, 1, 1]}, "the wrist is massless"),
    ("initial_state.joint_angles", [1], "must be 2 numbers (one per link); it has 1"),
    ("initial_state.joint_angles", "ab", "a list of finite numbers"),
    ("initial_state.wrist_angles", [1, 2], "3 numbers (psi, theta, phi)"),
    ("initial_state.base_velocity", [0] * 5, "must be 6 finite numbers; it has 5"),
]


@pytest.mark.parametrize(("path", "value", "what"), REFUSED)
def test_one_mistake_gives_one_sentence(
    data: dict[str, Any], change: Change, refusals: Refusals, path: str, value: Any, what: str
) -> None:
    Scene.model_validate(data)  # nothing else is wrong with it
    (sentence,) = refusals(change(data, path, value))
    field = re.sub(r"\.(\d+)", r"[\1]", path)
    assert sentence.startswith((f"{field} = ", f"{field}: unknown key"))
    assert what in sentence


@pytest.mark.parametrize(
    ("changes", "sentence"),
    [
        ([("base.mass",)], r"base.mass: missing; it is required \(mass of the base, kg\)"),
        ([("links.1.inertia",)], r"links\[1\].inertia: missing; it is required \(inertia of the link"),
        ([("links.0.name", "lower")], r"links\[1\].name = 'lower': another link has this name"),
        ([("tip.rotation", {"axis": [0, 0, 1], "angle": 3, "angel": 3})], "tip.rotation.angel: unknown key"),
        ([("spread", {7: 3})], r"spread\[7\]"),
        ([("wrist",)], "actuators.wrist_rate = .*the scene has no wrist"),
        ([("links", [])], "actuators.joint_torque = .*the scene has no links"),
        (
            [("links.1.torque_limit", 3), ("actuators.joint_torque",)],
            r"links\[1\].torque_limit = 3.0: without actuators.joint_torque all joints are passive",
        ),
        ([("links.1.torque_limit", 3), ("links.1.actuated", False)], ".* = 3.0: the joint is not actuated"),
        (
            [("links.1.torque_weight", 3), ("links.1.actuated", False)],
            r"links\[1\].torque_weight = 3.0: the joint is not actuated: remove this weight",
        ),
        (
            [("wrist",), ("actuators.wrist_rate",), ("initial_state.wrist_angles", [0, 0, 0])],
            r".*must be 0 numbers \(the scene has no wrist\); it has 3",
        ),
        (
            [("links.1",), ("initial_state.joint_angles", [1, 2])],
            r".*must be 1 number \(one per link\); it has 2",
        ),
    ],
)
def test_places_and_meanings_are_named(
    data: dict[str, Any], change: Change, refusals: Refusals, changes: list[Any], sentence: str
) -> None:
    for each in changes:
        change(data, *each)
    (found,) = refusals(data)
    assert re.match(sentence, found)


def test_spreads_need_something_to_spread(data: dict[str, Any], refusals: Refusals) -> None:
    data |= {"wrist": None, "links": [], "actuators": {}}
    data["spread"] = {"wrist_angles": 0.1, "joint_angles": 0.2, "joint_rates": 0.3}
    assert refusals(data) == [
        "spread.wrist_angles = 0.1: must be 0: the scene has no wrist",
        "spread.joint_angles = 0.2: must be 0: the scene has no links",
        "spread.joint_rates = 0.3: must be 0: the scene has no links",
    ]


class TestValidScenes:
    def test_one_number_stands_for_all_axes(self, data: dict[str, Any], change: Change) -> None:
        scene = Scene.model_validate(change(data, "cost.pose", [1, 2, 3, 4, 5, 6, 7, 0]))
        assert scene.actuators.base_force == AxisLimits(limit=(10.0, 10.0, 10.0))
        assert scene.actuators.base_torque == AxisLimits(limit=(1.0, 2.0, 3.0))
        assert scene.cost.pose == (1.0, 2.0, 3.0, 4.0, 5.0, 6.0, 7.0, 0.0)

    def test_inertia_is_stored_as_a_symmetric_matrix(self, data: dict[str, Any], change: Change) -> None:
        inertia = np.array(Scene.model_validate(data).base.inertia)
        np.testing.assert_array_equal(inertia, np.diag([10.0, 11.0, 12.0]))
        nearly = [[2, 0.5, 0], [0.5 + 1e-10, 3, 0], [0, 0, 4]]
        inertia = np.array(Scene.model_validate(change(data, "base.inertia", nearly)).base.inertia)
        assert (inertia == inertia.T).all()
        np.testing.assert_allclose(inertia, TILTED, rtol=0, atol=1e-10)

    def test_a_flat_plate_is_at_the_edge_of_validity(self, data: dict[str, Any], change: Change) -> None:
        moments = [0.1, 0.2, 0.3]  # 0.1 + 0.2 > 0.3 by rounding
        assert Scene.model_validate(change(data, "base.inertia", moments)).base.inertia[2][2] == 0.3
        turned = Pose.model_validate({"rotation": {"axis": [1, 2, 3], "angle": 40}})
        rotation = np.array(turned.rotation_matrix)
        Scene.model_validate(change(data, "base.inertia", rotation @ np.diag(moments) @ rotation.T))

    def test_numpy_numbers_are_numbers(self, data: dict[str, Any], change: Change) -> None:
        change(data, "base.mass", np.float32(100))
        change(data, "simulation.steps", np.int64(7))
        scene = Scene.model_validate(change(data, "target.pose", np.array([1.0, 0, 0, 0, 0, 0.5, 0, 0])))
        assert type(scene.base.mass) is float
        assert type(scene.simulation.steps) is int
        assert scene.target.pose.position == (1.0, 0.0, 0.0)

    def test_numpy_bounds_and_truths_are_as_pythons(self, data: dict[str, Any], change: Change) -> None:
        change(data, "links.0.actuated", np.False_)
        bounds = {
            "kind": "joint_limits",
            "name": "stops",
            "lower": np.array([-1.0, -np.inf]),
            "rate": np.float32(2),
        }
        scene = Scene.model_validate(data | {"constraints": [bounds]})
        assert scene.links[0].actuated is False
        (limits,) = scene.constraints
        assert isinstance(limits, JointLimits)
        assert (limits.lower, limits.rate) == ((-1.0, -INF), (2.0,))

    def test_scenes_are_hashable_immutable_and_picklable(self, data: dict[str, Any]) -> None:
        scene = Scene.model_validate(data)
        assert len({scene, Scene.model_validate(data), scene.replace(name="other")}) == 2
        assert pickle.loads(pickle.dumps(scene)) == scene
        with pytest.raises(ValidationError, match="frozen"):
            scene.name = "other"  # type: ignore[misc]

    def test_parts_can_be_built_in_python(self, data: dict[str, Any]) -> None:
        scene = Scene.model_validate(data)
        parts = {name: getattr(scene, name) for name in Scene.model_fields}
        assert Scene(**parts) == scene
        with pytest.raises(ValidationError, match="mas: unknown key; did you mean 'mass'"):
            Link(**(data["links"][0] | {"mas": 3}))


def test_replace_takes_models_and_plain_data_and_validates_both(data: dict[str, Any]) -> None:
    scene = Scene.model_validate(data)
    slow = scene.replace(simulation={"dt": 0.1, "steps": 10})
    assert (slow.simulation.dt, slow.simulation.steps) == (0.1, 10)
    assert slow.replace(simulation=scene.simulation) == scene
    with pytest.raises(
        SceneError, match=r"changed: 1 problem\n  - simulation\.dt = -1: must be a finite number greater"
    ):
        scene.replace(simulation={"dt": -1})
    with pytest.raises(SceneError, match=r"base\.mass = -1"):
        scene.replace(base=scene.base.model_copy(update={"mass": -1}))
    with pytest.raises(SceneError, match=r"nam: unknown key; did you mean 'name'\?"):
        scene.replace(nam="x")


def test_a_position_of_any_length_is_one_that_a_list_does_not_have() -> None:
    scene = load_scene("refuelling")
    with pytest.raises(SceneError, match="has 3 entries, the first is 0; there is no '9999"):
        scene.replace({"links." + "9" * 5000 + ".mass": 1.0})
    first, *rest = (phase.model_dump() for phase in scene.phases)
    with pytest.raises(SceneError, match="leads to no number that phases change"):
        scene.replace(phases=[first | {"changes": {"links." + "9" * 5000 + ".mass": 1.0}}, *rest])


def test_replace_changes_what_a_mapping_names_and_nothing_else() -> None:
    planar, paper = load_scene("planar"), load_scene("paper")
    heavy = planar.replace(base={"mass": 200.0})
    assert heavy.base == planar.base.model_copy(update={"mass": 200.0})
    assert heavy.base.motion == "planar"
    slow = paper.replace(simulation={"integrator": "rk6"}).replace(simulation={"dt": 0.02})
    assert (slow.simulation.integrator, slow.simulation.dt) == ("rk6", 0.02)
    assert paper.replace(cost={"base_torque": 5}).cost == paper.cost.model_copy(
        update={"base_torque": (5.0,) * 3}
    )
    moved = paper.replace(target={"pose": {"position": [1, 2, 3]}})
    assert moved.target.pose.position == (1.0, 2.0, 3.0)
    assert moved.target.pose.rotation == paper.target.pose.rotation
    assert moved.target.base_velocity == paper.target.base_velocity
    turned = moved.replace(target={"pose": {"rotation": {"axis": [0, 0, 1], "angle": 180}}})
    assert turned.target.pose.rotation == (0.0, 0.0, 0.0, 1.0)
    exact = paper.target.pose.dual_quaternion
    np.testing.assert_allclose(
        turned.replace(target={"pose": {"dual_quaternion": exact}}).target.pose.dual_quaternion,
        exact,
        rtol=0,
        atol=1e-15,
    )
    assert (
        paper.replace(actuators={"wrist_rate": None}).actuators.joint_torque == paper.actuators.joint_torque
    )
    assert paper.replace(spread={}) == paper
    assert paper.replace(spread=Spread()).spread == Spread()


def test_replace_takes_paths() -> None:
    paper = load_scene("paper")
    changed = paper.replace(
        {"links.1.mass": 4, "links.1.joint.position.0": 0.5, "cost.base_torque": 5}, name="x"
    )
    first, second, third = paper.links
    joint = second.joint.model_copy(update={"position": (0.5, *second.joint.position[1:])})
    assert changed.links == (first, second.model_copy(update={"mass": 4.0, "joint": joint}), third)
    assert changed.cost == paper.cost.model_copy(update={"base_torque": (5.0,) * 3})
    assert changed.name == "x"
    assert paper.replace() == paper
    assert paper.replace({"target.pose": paper.links[0].joint}).target.pose == paper.links[0].joint


@pytest.mark.parametrize(
    ("changes", "sections", "said"),
    [
        ({"links.3.mass": 4}, {}, "links has 3 entries, the first is 0; there is no '3'"),
        ({"links.first.mass": 4}, {}, "links has 3 entries, the first is 0; there is no 'first'"),
        ({"links.-1.mass": 4}, {}, "there is no '-1'"),
        ({"links.0.mas": 4}, {}, r"links\[0\]\.mas: unknown key; did you mean 'mass'"),
        ({"cots.pose": 4}, {}, "cots: unknown key; did you mean 'cost'"),
        ({"cost.pose.99": 4}, {}, r"cost\.pose has 8 entries"),
        ({"simulation": Simulation(), "simulation.dt": 1}, {}, "simulation is replaced as a whole"),
        ({"simulation.dt": 1}, {"simulation": {"dt": 2}}, r"simulation: is changed twice"),
        ({"name": "x"}, {"name": "y"}, "name: is changed twice"),
        ("links.0.mass", {}, "should be a mapping from paths to new values"),
        ({"base.mass.x": 4}, {}, r"base\.mass = "),
        ({"links.0.mass": float("nan")}, {}, r"links\[0\]\.mass = nan"),
        ({3: 4}, {}, "3: unknown key"),
    ],
)
def test_replace_says_what_is_wrong(changes: Any, sections: dict[str, Any], said: str) -> None:
    with pytest.raises(SceneError, match=said) as caught:
        load_scene("paper").replace(changes, **sections)
    assert str(caught.value).startswith("scene 'paper', changed")


class TestContentHash:
    def test_ignores_name_and_description_only(self, data: dict[str, Any]) -> None:
        scene = Scene.model_validate(data)
        assert scene.replace(name="other", description="words").content_hash() == scene.content_hash()
        changed = [
            scene.replace(base=scene.base.model_copy(update={"mass": 100.0000001})),
            scene.replace(simulation={"integrator": "symplectic_euler"}),
            scene.replace(target={"pose": {"rotation": [-1, 0, 0, 0], "position": [1, 0, 0]}}),
        ]
        assert len({other.content_hash() for other in [scene, *changed]}) == 4

    def test_does_not_depend_on_how_numbers_are_written(self, data: dict[str, Any], change: Change) -> None:
        before = Scene.model_validate(data).content_hash()
        change(data, "base.inertia", [[10.0, -0.0, 0], [0, 11, 0], [0, 0, 12]])
        change(data, "links.0.center_of_mass", [0.3, -0.0, 0])
        assert Scene.model_validate(data).content_hash() == before
        assert len(before) == 64

    def test_nor_on_the_sign_of_zeros_in_phases(self) -> None:
        def changed(zero: float) -> Scene:
            changes = {"cost.pose.0": zero, "target.pose.position": [1.0, zero, 0.5]}
            return load_scene("paper").replace(phases=[{"name": "a", "steps": 1000, "changes": changes}])

        assert changed(-0.0) == changed(0.0)
        assert changed(-0.0).content_hash() == changed(0.0).content_hash()


@pytest.mark.parametrize("name", ["target", "grasp", "inertial", "tip", "base"])
def test_no_other_tip_hides_a_frame(name: str) -> None:
    scene = load_scene("dual-arm")
    tips = [tip.model_dump() | {"name": name} for tip in scene.other_tips]
    with pytest.raises(SceneError, match=rf"other_tips\[0\]\.name = '{name}': is a frame of every scene"):
        scene.replace(other_tips=tips)


def test_a_tip_placed_by_its_weight_is_told_the_key_of_its_place() -> None:
    with pytest.raises(SceneError, match=r"other_tips\[0\]\.pose = .* 6 numbers, .* on its link is `frame`"):
        load_scene("dual-arm").replace({"other_tips.0.pose": {"position": [0, 0, 0.25]}})


def test_no_link_has_the_name_of_the_base(data: dict[str, Any]) -> None:
    links = [{**data["links"][0], "name": "base"}, *data["links"][1:]]
    with pytest.raises(SceneError, match=r"links\[0\]\.name = 'base': is the spacecraft's: rename the link"):
        load_scene(data | {"links": links})


def test_phases_have_names_of_their_own() -> None:
    phases = [{"name": "coast", "steps": 400}, {"name": "coast", "steps": 600}]
    with pytest.raises(SceneError, match=r"phases\[1\]\.name = 'coast': another phase has this name"):
        load_scene("paper").replace(phases=phases)


def test_mistakes_beside_phases_keep_their_place() -> None:
    phases = [{"name": "only", "steps": 900, "changes": {"base.mass": 90.0}}]
    scene = load_scene("wheels").model_dump() | {"phases": phases}
    scene["initial_state"]["wheel_speeds"] = [9000.0, 0.0, 0.0, 0.0]
    scene["constraints"] = [{"name": "reserve", "kind": "propellant"}]
    with pytest.raises(SceneError) as caught:
        load_scene(scene)
    said = str(caught.value)
    assert "changed" not in said
    assert "\n  - initial_state.wheel_speeds = " in said
    assert "\n  - constraints[0].kind = 'propellant': the scene has no actuators.tank" in said
    assert "\n  - phases = 900: have 900 steps together" in said


@pytest.mark.parametrize(
    ("changes", "said"),
    [
        ({"target.motoin": None}, "did you mean 'target.motion'? Only payload, actuators or target.motion"),
        ({"links.link 2.mass": 3.0}, "links go by their positions, from 0: did you mean 'links.1.mass'?"),
    ],
)
def test_changes_of_a_phase_suggest_what_was_meant(changes: dict[str, object], said: str) -> None:
    phases = [{"name": "only", "steps": 1000, "changes": changes}]
    with pytest.raises(SceneError, match=re.escape(said)):
        load_scene("tracking").replace(phases=phases)
