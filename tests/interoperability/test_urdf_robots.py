"""Scenes from the URDFs of others, and of a robot full of oddities, against Pinocchio's own reading."""

from pathlib import Path

import numpy as np
import pytest
from foreign_robots import (
    ROBOTS,
    accelerations,
    drawn,
    foreign_scene,
    held_scene,
    relative_error,
    robot_file,
    tip_pose,
)

from dq_space_arm_env import DQSpaceArmEnv, compile_scene, load_scene, scene_from_urdf, scene_to_urdf
from dq_space_arm_env.algebra import poses
from dq_space_arm_env.scene import StateLayout

pin = pytest.importorskip("pinocchio")

# The base is not the root; axes point anywhere; frames of inertias are turned; links hang on fixed joints,
# also above the base; there is a branch with a mass and one without, and a joint that needs no <axis>.
ODD_ROBOT = """
<robot name="odd" xmlns:gazebo="http://gazebosim.org">
  <link name="world"/>
  <link name="tank">
    <inertial><mass value="3"/><origin xyz="0.1 0 0.2" rpy="1 2 3"/>
      <inertia ixx="0.3" ixy="0.01" ixz="-0.02" iyy="0.4" iyz="0.03" izz="0.5"/></inertial>
  </link>
  <joint name="world tank" type="floating"><parent link="world"/><child link="tank"/></joint>
  <link name="bus">
    <inertial><mass value="20"/><origin xyz="-0.1 0.3 0.05" rpy="0.2 -0.4 0.6"/>
      <inertia ixx="2" ixy="0.1" ixz="0.2" iyy="3" iyz="-0.1" izz="2.5"/></inertial>
  </link>
  <joint name="tank bus" type="fixed">
    <origin xyz="0.5 0.6 0.7" rpy="0.3 0.2 0.1"/><parent link="tank"/><child link="bus"/>
  </joint>
  <link name="antenna"/>
  <joint name="bus antenna" type="continuous"><parent link="bus"/><child link="antenna"/></joint>
  <link name="upper">
    <inertial><mass value="2"/><origin xyz="0.2 0 0"/>
      <inertia ixx="0.01" ixy="0" ixz="0" iyy="0.05" iyz="0" izz="0.05"/></inertial>
  </link>
  <joint name="shoulder" type="revolute">
    <origin xyz="0.4 0.1 -0.2" rpy="-0.5 0.1 0.9"/><parent link="bus"/><child link="upper"/>
    <axis xyz="0 0 -2"/><limit effort="7" lower="-1" upper="2" velocity="1"/><dynamics damping="0.2"/>
  </joint>
  <link name="bracket">
    <inertial><mass value="0.5"/><origin xyz="0 0.1 0" rpy="0 0 1"/>
      <inertia ixx="0.001" ixy="0" ixz="0" iyy="0.002" iyz="0" izz="0.002"/></inertial>
  </link>
  <joint name="upper bracket" type="fixed">
    <origin xyz="0.4 0 0" rpy="0 1.5707963267948966 0"/><parent link="upper"/><child link="bracket"/>
  </joint>
  <link name="camera">
    <inertial><mass value="0.2"/>
      <inertia ixx="0.0001" ixy="0" ixz="0" iyy="0.0001" iyz="0" izz="0.0001"/></inertial>
  </link>
  <joint name="bracket camera" type="prismatic">
    <origin xyz="0 0 0.1" rpy="0 0.5 0"/><parent link="bracket"/><child link="camera"/>
    <axis xyz="1 0 0"/><limit effort="1" lower="-1" upper="1" velocity="1"/>
  </joint>
  <link name="fore">
    <inertial><mass value="1"/><origin xyz="0 0.2 0" rpy="0.1 0 0"/>
      <inertia ixx="0.02" ixy="0.001" ixz="0" iyy="0.01" iyz="0.002" izz="0.02"/></inertial>
  </link>
  <joint name="elbow" type="continuous">
    <origin xyz="0.1 0 0" rpy="0 0 0.3"/><parent link="bracket"/><child link="fore"/>
    <axis xyz="0.3 -0.5 -0.4"/><limit effort="3" velocity="1"/>
  </joint>
  <link name="hand">
    <inertial><mass value="0.4"/><origin xyz="0.05 0 0.02" rpy="0 0.7 0"/>
      <inertia ixx="0.001" ixy="0" ixz="0" iyy="0.0012" iyz="0" izz="0.0008"/></inertial>
  </link>
  <joint name="wrist" type="revolute">
    <origin xyz="0 0.4 0"/><parent link="fore"/><child link="hand"/>
    <limit effort="1.5" lower="0.2" upper="0.8" velocity="1"/>
  </joint>
  <link name="grasp"/>
  <joint name="hand grasp" type="fixed">
    <origin xyz="0.1 0 0.1" rpy="3 -1 2"/><parent link="hand"/><child link="grasp"/>
  </joint>
</robot>
"""


class Reference:
    """A URDF as Pinocchio reads it: a free flyer at the root, joints that are not given locked at zero."""

    def __init__(self, text, joints, base=None, spacecraft=None):
        full = pin.buildModelFromXML(text, pin.JointModelFreeFlyer())
        locked = [i for i in range(2, full.njoints) if full.names[i] not in joints]
        self.model = pin.buildReducedModel(full, locked, pin.neutral(full))
        self.model.gravity = pin.Motion.Zero()
        names = list(self.model.names)[2:]
        assert sorted(names) == sorted(joints)
        # Of the given joints in Pinocchio's order, and of Pinocchio's in the given order.
        self.inward, self.outward = (
            [a.index(name) for name in b] for a, b in ((joints, names), (names, joints))
        )
        frames, root = self.model.frames, pin.SE3.Identity()
        turned = root if base is None else frames[self.model.getFrameId(base)].placement
        if spacecraft is not None:
            self.model.inertias[1] += turned.act(pin.Inertia(*spacecraft))
        self.e0 = pin.SE3(turned.rotation, self.model.inertias[1].lever)
        self.data = self.model.createData()

    def configuration(self, pose, angles):
        rotation, position = (np.array(part) for part in poses.to_matrix(tuple(pose)))
        root = pin.SE3(rotation, position) * self.e0.inverse()
        tangent = np.array([*np.zeros(6), *np.array(angles)[self.inward]])
        q = pin.integrate(self.model, pin.neutral(self.model), tangent)
        q[:7] = pin.SE3ToXYZQUAT(root)
        return q

    def accelerations(self, scene, x, u):
        entries = StateLayout.of(scene).state
        q = self.configuration(x[entries.pose], x[entries.joint_angles])
        rates, damping = x[entries.joint_rates], np.array([link.damping for link in scene.links])
        twist = pin.Motion(x[entries.linear_velocity], x[entries.angular_velocity])
        v = np.array([*self.e0.act(twist).vector, *rates[self.inward]])
        force = self.e0.act(pin.Force(u[:3], u[3:6])).vector
        torques = (u[6:] - damping * rates)[self.inward]
        a = pin.aba(self.model, self.data, q, v, np.array([*force, *torques]))
        base = self.e0.actInv(pin.Motion(a[:6]))
        return np.array([*base.angular, *base.linear, *a[6:][self.outward]])

    def tip(self, scene, x, name):
        entries = StateLayout.of(scene).state
        q = self.configuration(x[entries.pose], x[entries.joint_angles])
        pin.framesForwardKinematics(self.model, self.data, q)
        return self.data.oMf[self.model.getFrameId(name)]


def check(scene, reference, tip, samples=5):
    rng = np.random.default_rng(0)
    for _ in range(samples):
        x, u = drawn(scene, rng)
        assert relative_error(accelerations(scene, x, u), reference.accelerations(scene, x, u)) < 1e-12
        rotation, position = tip_pose(scene, x)
        placement = reference.tip(scene, x, tip)
        np.testing.assert_allclose(rotation, placement.rotation, rtol=0, atol=1e-13)
        np.testing.assert_allclose(position, placement.translation, rtol=0, atol=1e-13)


def movable_joints(text, scene):
    """Names of the URDF's joints that carry the scene's links."""
    model = pin.buildModelFromXML(text)
    children = {frame.name: frame.parentJoint for frame in model.frames if frame.type == pin.FrameType.BODY}
    return [model.names[children[link.name]] for link in scene.links]


@pytest.mark.parametrize("name", ROBOTS)
def test_robots_of_others_move_as_pinocchio_says(name):
    file, tip, _ = robot_file(name)
    scene, text = foreign_scene(name), Path(file).read_text()
    check(scene, Reference(text, movable_joints(text, scene)), tip)


@pytest.mark.parametrize("name", ROBOTS)
def test_robots_of_others_survive_the_way_out_and_in_again(name):
    """Written as URDF, a scene moves the same in Pinocchio, and, read again, is the same scene."""
    scene = foreign_scene(name)
    text = scene_to_urdf(scene)
    joints = [f"{link.name} joint" for link in scene.links]
    check(scene, Reference(text, joints), "tip", samples=2)
    again = scene_from_urdf(text, "tip")
    assert [link.name for link in again.links] == [link.name for link in scene.links]
    rng = np.random.default_rng(1)
    x, u = drawn(scene, rng)
    assert relative_error(accelerations(again, x, u), accelerations(scene, x, u)) < 1e-12
    layouts = [StateLayout.of(one) for one in (scene, again)]
    np.testing.assert_array_equal(layouts[0].control_limit, layouts[1].control_limit)


def test_shapes_become_visuals():
    shapes = [
        {"box": [1, 2, 3], "pose": {"position": [0.1, 0.2, 0.3]}, "color": "#336699"},
        {"cylinder": {"radius": 0.2, "length": 3}, "pose": {"rotation": {"axis": [1, 0, 0], "angle": 30}}},
    ]
    scene = load_scene("payload")
    plain = scene_to_urdf(scene)
    bodies = ("base", "links.1", "payload")
    text = scene_to_urdf(scene.replace({f"{body}.geometry": shapes for body in bodies}))
    model = pin.buildModelFromXML(text)
    objects = pin.buildGeomFromUrdfString(model, text, pin.GeometryType.VISUAL).geometryObjects
    assert len(objects) == 6
    box, cylinder = objects[0], objects[1]
    np.testing.assert_allclose(2.0 * box.geometry.halfSide, [1.0, 2.0, 3.0])
    np.testing.assert_allclose(box.placement.translation, [0.1, 0.2, 0.3])
    np.testing.assert_allclose(box.meshColor, [0.2, 0.4, 0.6, 1.0])
    assert (cylinder.geometry.radius, 2.0 * cylinder.geometry.halfLength) == (0.2, 3.0)
    np.testing.assert_allclose(cylinder.placement.rotation[1:, 2], [-0.5, np.sqrt(0.75)])
    assert "visual" not in plain
    assert scene_from_urdf(text, "tip").content_hash() == scene_from_urdf(plain, "tip").content_hash()


@pytest.fixture(scope="module")
def odd_scene():
    return scene_from_urdf(ODD_ROBOT, "grasp", "bus", lock_branches=True)


def test_the_odd_robot_moves_as_pinocchio_says(odd_scene):
    check(odd_scene, Reference(ODD_ROBOT, ["shoulder", "elbow", "wrist"], "bus"), "grasp")


def test_branches_of_the_odd_robot_move_unless_they_are_locked():
    """Branches come after the links from base to tip, and survive the way out and in again."""
    scene = scene_from_urdf(ODD_ROBOT, "grasp", "bus")
    assert [link.name for link in scene.links] == ["upper", "fore", "hand", "camera"]
    assert (scene.parent_bodies, scene.tip_link) == ((0, 1, 2, 1), "hand")
    reference = Reference(ODD_ROBOT, ["shoulder", "elbow", "wrist", "bracket camera"], "bus")
    check(scene, reference, "grasp")
    locked = scene_from_urdf(ODD_ROBOT, "grasp", "bus", lock_branches=["bracket camera"])
    assert locked == scene_from_urdf(ODD_ROBOT, "grasp", "bus", lock_branches=True)
    text = scene_to_urdf(scene)
    check(scene, Reference(text, [f"{link.name} joint" for link in scene.links]), "tip", samples=2)
    again = scene_from_urdf(text, "tip")
    assert (again.parent_bodies, again.tip_link) == (scene.parent_bodies, scene.tip_link)
    x, u = drawn(scene, np.random.default_rng(1))
    assert relative_error(accelerations(again, x, u), accelerations(scene, x, u)) < 1e-12


def test_a_spacecraft_is_fixed_to_the_base_link():
    mass, center = 150.0, np.array([0.2, -0.3, 0.4])
    inertia = np.array([[30, 1, 2], [1, 25, 3], [2, 3, 20.0]])
    spacecraft = {"mass": mass, "inertia": inertia, "center_of_mass": center}
    scene = scene_from_urdf(ODD_ROBOT, "hand", "bus", lock_branches=True, spacecraft=spacecraft)
    assert scene.base.mass == pytest.approx(173.0, rel=1e-15)
    reference = Reference(ODD_ROBOT, ["shoulder", "elbow", "wrist"], "bus", (mass, center, inertia))
    check(scene, reference, "hand")


def test_start_limits_and_names_come_from_the_file(odd_scene):
    assert odd_scene.name == "odd"
    assert [link.name for link in odd_scene.links] == ["upper", "fore", "hand"]
    # Zero where the limits allow it, otherwise the middle.
    assert odd_scene.initial_state.joint_angles == (0.0, 0.0, 0.5)
    assert StateLayout.of(odd_scene).control_limit.tolist() == [10.0] * 3 + [5.0] * 3 + [7.0, 3.0, 1.5]
    assert [link.damping for link in odd_scene.links] == [0.2, 0.0, 0.0]


def test_the_default_target_is_the_tip_with_every_joint_further(odd_scene):
    x = StateLayout.of(odd_scene).initial_state.copy()
    x[StateLayout.of(odd_scene).state.joint_angles] += 0.3
    rotation, position = tip_pose(odd_scene, x)
    np.testing.assert_allclose(odd_scene.target.pose.position, position, rtol=0, atol=1e-14)
    np.testing.assert_allclose(odd_scene.target.pose.rotation_matrix, rotation, rtol=0, atol=1e-14)


def test_a_robot_of_others_flies_in_the_environment(odd_scene):
    """What was read from a file compiles, steps, and agrees with the equations it was made of."""
    rng = np.random.default_rng(2)
    x, u = drawn(odd_scene, rng)
    found = compile_scene(odd_scene).forward_dynamics(x, u)
    assert relative_error(found, accelerations(odd_scene, x, u)) < 1e-12
    environment = DQSpaceArmEnv(odd_scene)
    environment.reset(seed=0)
    observation, reward, *_ = environment.step(environment.action_space.sample())
    assert np.isfinite([*observation, reward]).all()


# Joints that move besides those from base to tip, the rest is held; and what is changed.
SHORT = {"simulation": {"dt": 0.02, "steps": 500}}
FLOWN = {
    "anymal-on-legs": (["LF_HAA", "LF_HFE", "LF_KFE"], {}),
    "baxter": (["right_s0", "right_s1"], {}),
    "centauro": (["j_arm2_1", "j_arm2_4"], SHORT),
    "g1": (["right_shoulder_pitch_joint", "right_elbow_joint"], SHORT),
    "tiago-dual": (
        ["arm_right_1_joint", "arm_right_4_joint"],
        {
            "simulation": {"dt": 0.01, "steps": 1000, "integrator": "rk4"},
            **{f"links.{joint}.torque_weight": 1.0 for joint in range(10)},
        },
    ),
}


@pytest.mark.endurance
@pytest.mark.parametrize("name", FLOWN)
def test_trees_of_others_are_solved_and_flown(name):
    """The maneuver that the import writes, of robots that branch."""
    from experts import GuidedDDP

    moving, changes = FLOWN[name]
    scene = held_scene(name, moving).replace(changes)
    assert scene.parent_bodies != (*range(len(scene.links)),)  # it branches
    plan = GuidedDDP(scene).solve()
    assert plan.converged
    assert plan.constraints.violation <= 1e-6
    environment = DQSpaceArmEnv(scene)
    environment.reset(options={"nominal": True})
    for u in plan.controls:
        *_, info = environment.step(environment.kernels.layout.to_action(u))
    assert info["is_success"]
    # The sliding torso's dampers start with a jump, whose steps the environment divides.
    bound = 1e-3 if name == "tiago-dual" else 1e-9
    np.testing.assert_allclose(environment.state, plan.states[-1], rtol=0, atol=bound)
