"""Every refusal of the schema names the field, the value, and what would be right."""

import pickle
from collections.abc import Callable
from typing import Any

import numpy as np
import pytest
from pydantic import ValidationError

from dq_space_arm_env.scene import INTEGRATORS, AxisLimits, Link, Pose, Scene

Change = Callable[..., dict[str, Any]]
Refusals = Callable[[dict[str, Any]], list[str]]

NAN, INF = float("nan"), float("inf")
TRIANGLE = [1, 1, 5]
TILTED: list[list[float]] = [[2, 0.5, 0], [0.5, 3, 0], [0, 0, 4]]

REFUSED = [
    # unknown and missing keys, texts
    ("mas", 3, "mas: unknown key", "Known keys here: name, description, base"),
    ("bas", 3, "bas: unknown key", "did you mean 'base'?"),
    ("base.mas", 3, "base.mas: unknown key", "did you mean 'mass'?"),
    (
        "links.1.centre_of_mass",
        [0, 0, 0],
        "links[1].centre_of_mass: unknown key",
        "did you mean 'center_of_mass'?",
    ),
    ("links.1.joint.positon", [0, 0, 0], "links[1].joint.positon: unknown key", "did you mean 'position'?"),
    (
        "target.pose.dual_quat",
        [1] * 8,
        "target.pose.dual_quat: unknown key",
        "did you mean 'dual_quaternion'?",
    ),
    (
        "links.0.joint.rotation",
        {"axis": [0, 0, 1], "angle": 3, "angel": 3},
        "links[0].joint.rotation.angel: unknown key",
        "angle",
    ),
    ("actuators.joint_torques", {}, "actuators.joint_torques: unknown key", "did you mean 'joint_torque'?"),
    ("actuators.base_force.limits", 3, "actuators.base_force.limits: unknown key", "did you mean 'limit'?"),
    ("spread.7", 3, "spread[7]", "keys must be text"),
    ("name", "", "name = ''", "must not be empty"),
    ("name", 3, "name = 3", "must be text"),
    ("description", True, "description = True", "must be text"),
    ("links.0.name", "lower", "links[1].name = 'lower'", "another link has this name"),
    # containers of the wrong kind
    ("base", 3, "base = 3", "must be a mapping"),
    ("wrist", "yes", "wrist = 'yes'", "must be a mapping"),
    ("links", 3, "links = 3", "must be a list"),
    ("links", {"mass": 1}, "links = {'mass': 1}", "must be a list"),
    ("links.0", [1], "links[0] = [1]", "must be a mapping"),
    # numbers of the wrong kind
    ("base.mass", "heavy", "base.mass = 'heavy'", "finite number greater than 0 (mass of the base, kg)"),
    ("base.mass", "3", "base.mass = '3'", "finite number greater than 0"),
    ("base.mass", True, "base.mass = True", "finite number greater than 0"),
    ("base.mass", [1], "base.mass = [1]", "finite number greater than 0"),
    ("base.mass", None, "base.mass = None", "finite number greater than 0"),
    ("base.mass", 10**400, "base.mass = 1000", "finite number greater than 0"),
    ("base.mass", 0, "base.mass = 0", "finite number greater than 0"),
    ("links.0.mass", -1, "links[0].mass = -1", "finite number greater than 0"),
    ("links.0.mass", NAN, "links[0].mass = nan", "finite number greater than 0"),
    ("links.0.mass", INF, "links[0].mass = inf", "finite number greater than 0"),
    ("links.0.center_of_mass", 3, "links[0].center_of_mass = 3", "must be 3 finite numbers"),
    ("links.0.center_of_mass", [1, 2], "links[0].center_of_mass = [1, 2]", "3 finite numbers; it has 2"),
    ("links.0.center_of_mass", [1, 2, NAN], "links[0].center_of_mass = [1, 2, nan]", "3 finite numbers"),
    ("links.0.center_of_mass", [1, 2, "3"], "links[0].center_of_mass", "3 finite numbers"),
    ("links.0.actuated", "no", "links[0].actuated = 'no'", "must be true or false"),
    ("links.0.actuated", 0, "links[0].actuated = 0", "must be true or false"),
    ("links.0.stiffness", -1, "links[0].stiffness = -1", "0 or greater"),
    ("links.0.damping", INF, "links[0].damping = inf", "finite number, 0 or greater"),
    ("links.0.rest_angle", INF, "links[0].rest_angle = inf", "must be a finite number"),
    ("target.base_velocity", [0, 0, 0], "target.base_velocity = [0, 0, 0]", "6 finite numbers; it has 3"),
    # physics
    ("base.inertia", 3, "base.inertia = 3", "must be 3 numbers (diagonal) or 3x3"),
    ("base.inertia", [1, 2], "base.inertia = [1, 2]", "must be 3 numbers (diagonal) or 3x3"),
    ("base.inertia", [[1, 0], [0, 1], [0, 0]], "base.inertia = [[1, 0]", "must be 3 finite numbers"),
    ("base.inertia", [[1, 0, 0], 2, 3], "base.inertia = [[1, 0, 0], 2, 3]", "must be 3 finite numbers"),
    ("base.inertia", [1, 2, NAN], "base.inertia = [1, 2, nan]", "finite"),
    ("base.inertia", [[2, 0.5, 0], [0.4, 3, 0], [0, 0, 4]], "base.inertia = [[2, 0.5", "must be symmetric"),
    (
        "base.inertia",
        [1, 1, 0],
        "base.inertia = [1, 1, 0]",
        "positive definite: its principal moments are 0, 1, 1",
    ),
    ("base.inertia", [1, 1, -1], "base.inertia = [1, 1, -1]", "positive definite"),
    ("base.inertia", [[1, 2, 0], [2, 1, 0], [0, 0, 1]], "base.inertia", "principal moments are -1, 1, 3"),
    (
        "links.1.inertia",
        TRIANGLE,
        "links[1].inertia = [1, 1, 5]",
        "two smaller must add up to at least the largest",
    ),
    # actuators
    ("actuators.base_force.limit", 0, "actuators.base_force.limit = 0", "greater than 0, or .inf"),
    (
        "actuators.base_force.limit",
        [1, 1, -1],
        "actuators.base_force.limit = [1, 1, -1]",
        "one number or 3 numbers",
    ),
    (
        "actuators.base_torque.limit",
        [1, 1],
        "actuators.base_torque.limit = [1, 1]",
        "one number or 3 numbers",
    ),
    ("actuators.wrist_rate.limit", NAN, "actuators.wrist_rate.limit = nan", "greater than 0, or .inf"),
    (
        "actuators.joint_torque.limit",
        [1, 1, 1],
        "actuators.joint_torque.limit = [1, 1, 1]",
        "must be a number",
    ),
    ("actuators.joint_torque.limit", -2, "actuators.joint_torque.limit = -2", "greater than 0, or .inf"),
    ("actuators.joint_torque.limit", NAN, "actuators.joint_torque.limit = nan", "greater than 0, or .inf"),
    ("actuators.joint_torque", 2, "actuators.joint_torque = 2", "must be a mapping"),
    ("links.0.torque_limit", 0, "links[0].torque_limit = 0", "greater than 0"),
    # cost, spread, success, simulation
    ("cost.pose", [1, 2], "cost.pose = [1, 2]", "one number or 8 numbers, each finite and 0 or greater"),
    ("cost.pose", -1, "cost.pose = -1", "0 or greater"),
    ("cost.terminal_pose", INF, "cost.terminal_pose = inf", "finite"),
    ("cost.base_velocity", [1] * 8, "cost.base_velocity", "one number or 6 numbers"),
    ("cost.terminal_base_velocity", "1", "cost.terminal_base_velocity = '1'", "one number or 6 numbers"),
    ("cost.base_force", 0, "cost.base_force = 0", "one number or 3 numbers, each finite and greater than 0"),
    ("cost.base_torque", [1, 1, 0], "cost.base_torque = [1, 1, 0]", "greater than 0"),
    ("cost.joint_torque", 0, "cost.joint_torque = 0", "greater than 0"),
    ("cost.joint_torque", [1, 1], "cost.joint_torque = [1, 1]", "greater than 0"),
    ("cost.wrist_rate", NAN, "cost.wrist_rate = nan", "greater than 0"),
    ("spread.base_rotation", -0.1, "spread.base_rotation = -0.1", "0 or greater"),
    ("spread.joint_rates", [1, 1], "spread.joint_rates = [1, 1]", "finite number, 0 or greater"),
    ("success.position_error", 0, "success.position_error = 0", "greater than 0"),
    ("success.attitude_error_deg", NAN, "success.attitude_error_deg = nan", "greater than 0"),
    ("simulation.dt", 0, "simulation.dt = 0", "greater than 0 (time step, s)"),
    ("simulation.dt", INF, "simulation.dt = inf", "finite"),
    ("simulation.steps", 0, "simulation.steps = 0", "whole number, 1 or greater"),
    ("simulation.steps", 10.0, "simulation.steps = 10.0", "whole number, 1 or greater"),
    ("simulation.steps", True, "simulation.steps = True", "whole number, 1 or greater"),
    ("simulation.integrator", "rk44", "simulation.integrator = 'rk44'", "did you mean 'rk4'?"),
    (
        "simulation.integrator",
        "euler",
        "simulation.integrator = 'euler'",
        "must be one of symplectic_euler, rk4",
    ),
    ("simulation.integrator", 4, "simulation.integrator = 4", "must be text"),
    ("base.motion", "flat", "base.motion = 'flat'", "'spatial' or 'planar'"),
    # what must fit together
    ("payload", {"mass": 5, "inertia": [1, 1, 1]}, "payload = Payload(mass=5.0", "the wrist is massless"),
    (
        "initial_state.joint_angles",
        [1],
        "initial_state.joint_angles = (1.0,)",
        "must be 2 numbers (one per link); it has 1",
    ),
    (
        "initial_state.joint_rates",
        [1, 2, 3],
        "initial_state.joint_rates = (1.0, 2.0, 3.0)",
        "must be 2 numbers",
    ),
    ("initial_state.joint_angles", "ab", "initial_state.joint_angles = 'ab'", "a list of finite numbers"),
    (
        "initial_state.wrist_angles",
        [1, 2],
        "initial_state.wrist_angles = (1.0, 2.0)",
        "3 numbers (psi, theta, phi)",
    ),
    (
        "initial_state.base_velocity",
        [0] * 5,
        "initial_state.base_velocity",
        "must be 6 finite numbers; it has 5",
    ),
]


@pytest.mark.parametrize(("path", "value", "where", "what"), REFUSED)
def test_one_mistake_gives_one_sentence(
    data: dict[str, Any], change: Change, refusals: Refusals, path: str, value: Any, where: str, what: str
) -> None:
    Scene.model_validate(data)  # nothing else is wrong with it
    if path == "spread.7":
        data["spread"] = {7: value}
    else:
        change(data, path, value)
    sentences = refusals(data)
    assert len(sentences) == 1
    assert sentences[0].startswith(where)
    assert what in sentences[0]


@pytest.mark.parametrize(
    ("path", "sentence"),
    [
        ("name", "name: missing; it is required (name of the scene)"),
        ("base.mass", "base.mass: missing; it is required (mass of the base, kg)"),
        ("target.pose", "target.pose: missing; it is required (desired pose"),
        ("links.1.inertia", "links[1].inertia: missing; it is required (inertia of the link"),
        ("actuators.base_force.limit", "actuators.base_force.limit: missing; it is required"),
    ],
)
def test_missing_keys_are_named_with_their_meaning(
    data: dict[str, Any], change: Change, refusals: Refusals, path: str, sentence: str
) -> None:
    assert refusals(change(data, path))[0].startswith(sentence)


def test_all_mistakes_are_reported_at_once(data: dict[str, Any], refusals: Refusals) -> None:
    data["base"]["mass"] = -1
    data["links"][1]["mas"] = 3
    data["target"]["pose"] = [1, 2]
    paths = [sentence.split(" = ")[0].split(":")[0] for sentence in refusals(data)]
    assert paths == ["base.mass", "links[1].mas", "target.pose"]


def test_what_is_not_a_mapping_is_no_scene() -> None:
    with pytest.raises(ValidationError, match="scene = 3: must be a mapping"):
        Scene.model_validate(3)


class TestPartsThatNeedEachOther:
    def test_wrist_rate_needs_a_wrist(self, data: dict[str, Any], change: Change, refusals: Refusals) -> None:
        (sentence,) = refusals(change(data, "wrist"))
        assert sentence.startswith("actuators.wrist_rate = ")
        assert "the scene has no wrist" in sentence

    def test_joint_torque_needs_links(self, data: dict[str, Any], change: Change, refusals: Refusals) -> None:
        (sentence,) = refusals(change(data, "links", []))
        assert sentence.startswith("actuators.joint_torque = ")
        assert "the scene has no links" in sentence

    def test_torque_limit_needs_motors(
        self, data: dict[str, Any], change: Change, refusals: Refusals
    ) -> None:
        change(data, "links.1.torque_limit", 3)
        Scene.model_validate(data)
        (sentence,) = refusals(change(data, "actuators.joint_torque"))
        assert sentence.startswith(
            "links[1].torque_limit = 3.0: without actuators.joint_torque all joints are passive"
        )

    def test_torque_limit_needs_an_actuated_joint(
        self, data: dict[str, Any], change: Change, refusals: Refusals
    ) -> None:
        change(data, "links.1.torque_limit", 3)
        (sentence,) = refusals(change(data, "links.1.actuated", False))
        assert sentence.startswith("links[1].torque_limit = 3.0: the joint is not actuated")

    def test_wrist_angles_need_a_wrist(
        self, data: dict[str, Any], change: Change, refusals: Refusals
    ) -> None:
        change(change(data, "wrist"), "actuators.wrist_rate")
        (sentence,) = refusals(change(data, "initial_state.wrist_angles", [0, 0, 0]))
        assert "must be 0 numbers (the scene has no wrist); it has 3" in sentence

    def test_spreads_need_something_to_spread(self, data: dict[str, Any], refusals: Refusals) -> None:
        data |= {"wrist": None, "links": [], "actuators": {}}
        data["spread"] = {"wrist_angles": 0.1, "joint_angles": 0.2, "joint_rates": 0.3}
        assert refusals(data) == [
            "spread.wrist_angles = 0.1: must be 0: the scene has no wrist",
            "spread.joint_angles = 0.2: must be 0: the scene has no links",
            "spread.joint_rates = 0.3: must be 0: the scene has no links",
        ]


class TestValidScenes:
    def test_defaults_are_filled_in(self, data: dict[str, Any]) -> None:
        scene = Scene.model_validate(data)
        assert scene.initial_state.joint_angles == scene.initial_state.joint_rates == (0.0, 0.0)
        assert scene.initial_state.wrist_angles == (0.0, 0.0, 0.0)
        assert scene.cost.pose == (15.0,) * 8
        assert scene.cost.base_force == (10.0,) * 3
        assert scene.simulation.integrator in INTEGRATORS

    def test_without_wrist_and_links_the_angles_are_empty(self) -> None:
        scene = Scene.model_validate(
            {"name": "box", "base": {"mass": 1, "inertia": [1, 1, 1]}, "target": {"pose": {}}}
        )
        assert scene.initial_state.wrist_angles == scene.initial_state.joint_angles == ()

    def test_one_number_stands_for_all_axes(self, data: dict[str, Any], change: Change) -> None:
        scene = Scene.model_validate(change(data, "cost.pose", [1, 2, 3, 4, 5, 6, 7, 0]))
        assert scene.actuators.base_force == AxisLimits(limit=(10.0, 10.0, 10.0))
        assert scene.actuators.base_torque == AxisLimits(limit=(1.0, 2.0, 3.0))
        assert scene.cost.pose == (1.0, 2.0, 3.0, 4.0, 5.0, 6.0, 7.0, 0.0)

    def test_limits_may_be_infinite(self, data: dict[str, Any], change: Change) -> None:
        change(data, "actuators.base_force.limit", [1, INF, 2])
        change(data, "actuators.joint_torque.limit", INF)
        scene = Scene.model_validate(change(data, "links.0.torque_limit", INF))
        assert scene.actuators.base_force is not None
        assert scene.actuators.base_force.limit == (1.0, INF, 2.0)
        assert scene.links[0].torque_limit == INF

    def test_inertia_is_stored_as_a_symmetric_matrix(self, data: dict[str, Any], change: Change) -> None:
        assert Scene.model_validate(data).base.inertia == (
            (10.0, 0.0, 0.0),
            (0.0, 11.0, 0.0),
            (0.0, 0.0, 12.0),
        )
        nearly = [[2, 0.5, 0], [0.5 + 1e-10, 3, 0], [0, 0, 4]]
        inertia = np.array(Scene.model_validate(change(data, "base.inertia", nearly)).base.inertia)
        assert (inertia == inertia.T).all()
        np.testing.assert_allclose(inertia, TILTED, atol=1e-10)

    def test_a_flat_plate_is_at_the_edge_of_the_triangle_inequality(
        self, data: dict[str, Any], change: Change
    ) -> None:
        plate = Scene.model_validate(
            change(data, "base.inertia", [0.1, 0.2, 0.3])
        )  # 0.1 + 0.2 > 0.3 by rounding
        assert plate.base.inertia[2][2] == 0.3
        rotation = np.array(
            Pose.model_validate({"rotation": {"axis": [1, 2, 3], "angle": 40}}).rotation_matrix
        )
        Scene.model_validate(change(data, "base.inertia", rotation @ np.diag([0.1, 0.2, 0.3]) @ rotation.T))

    def test_numpy_numbers_are_numbers(self, data: dict[str, Any], change: Change) -> None:
        change(data, "base.mass", np.float32(100))
        change(data, "simulation.steps", np.int64(7))
        scene = Scene.model_validate(change(data, "target.pose", np.array([1.0, 0, 0, 0, 0, 0.5, 0, 0])))
        assert type(scene.base.mass) is float
        assert type(scene.simulation.steps) is int
        assert scene.target.pose.position == (1.0, 0.0, 0.0)

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


class TestReplace:
    def test_takes_models_and_plain_data(self, data: dict[str, Any]) -> None:
        scene = Scene.model_validate(data)
        slow = scene.replace(simulation={"dt": 0.1, "steps": 10})
        assert (slow.simulation.dt, slow.simulation.steps) == (0.1, 10)
        assert slow.replace(simulation=scene.simulation) == scene

    def test_validates(self, data: dict[str, Any]) -> None:
        scene = Scene.model_validate(data)
        with pytest.raises(ValidationError, match=r"simulation\.dt = -1"):
            scene.replace(simulation={"dt": -1})
        with pytest.raises(ValidationError, match=r"nam: unknown key; did you mean 'name'\?"):
            scene.replace(nam="x")

    def test_validates_what_model_copy_made(self, data: dict[str, Any]) -> None:
        scene = Scene.model_validate(data)
        with pytest.raises(ValidationError, match=r"base\.mass = -1"):
            scene.replace(base=scene.base.model_copy(update={"mass": -1}))


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
