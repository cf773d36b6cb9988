"""Random trees with joints of all types, also spherical and fixed ones, against Pinocchio and MuJoCo."""

from functools import partial

import casadi
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from dq_space_arm_env import SceneError, load_scene, scene_from_urdf, scene_to_mjcf, scene_to_urdf
from dq_space_arm_env.algebra import dual_quaternion as dq
from dq_space_arm_env.dynamics import kinematics, minimal
from dq_space_arm_env.dynamics.articulated_body import ArticulatedBodies
from dq_space_arm_env.dynamics.equations_of_motion import EquationsOfMotion
from dq_space_arm_env.dynamics.forward import forward_dynamics
from dq_space_arm_env.dynamics.kinematic_tree import KinematicTree
from dq_space_arm_env.dynamics.mass_matrix import mass_matrix
from dq_space_arm_env.dynamics.newton_euler import solve_schur
from dq_space_arm_env.dynamics.paper_field import PaperField
from dq_space_arm_env.dynamics.space_arm_field import SpaceArmField
from dq_space_arm_env.scene import Scene, StateLayout
from dq_space_arm_env.scene.start import unit_quaternions
from dq_space_arm_env.task.equations import SceneEquations

pin = pytest.importorskip("pinocchio")
mujoco = pytest.importorskip("mujoco")

TYPES = ("revolute", "prismatic", "screw", "fixed", "spherical")


def random_body(rng):
    """A cloud of points: no inertia that a rigid body cannot have."""
    points = rng.normal(size=(6, 3))
    points -= points.mean(axis=0)
    mass = float(rng.uniform(0.5, 20.0))
    inertia = mass / 6 * sum(p @ p * np.eye(3) - np.outer(p, p) for p in points)
    return {"mass": mass, "inertia": inertia.tolist()}


def random_scene(rng, joints, types=TYPES, wheels=True):
    """Links on any body before them, with springs and dampers, and rotors where a joint may have one."""
    links = []
    for index in range(joints):
        kind = str(rng.choice(types))
        x, y, z, w = Rotation.random(random_state=np.random.RandomState(rng.integers(2**31))).as_quat()
        place = {"position": rng.uniform(-1.0, 1.0, 3).tolist(), "rotation": [w, x, y, z]}
        link = {"name": f"link {index}", "joint_type": kind, "joint": place, **random_body(rng)}
        link |= {"parent": str(rng.choice(["base", *(each["name"] for each in links)]))}
        link |= {"center_of_mass": rng.uniform(-0.5, 0.5, 3).tolist()}
        if kind == "screw":
            link["pitch"] = float(rng.uniform(0.1, 0.5))
        if kind != "fixed":
            link |= {"stiffness": float(rng.uniform(0.0, 3.0)), "damping": float(rng.uniform(0.0, 1.0))}
        if kind not in ("fixed", "spherical") and rng.uniform() < 0.5:
            link["motor"] = {"inertia": 1e-3, "gear": float(rng.uniform(5.0, 50.0)), "coupling": "armature"}
        links.append(link)
    actuators = {"base_force": {"limit": 10}, "base_torque": {"limit": 5}, "joint_torque": {"limit": 2}}
    if wheels:
        axes = rng.normal(size=(2, 3)).tolist()
        actuators["wheels"] = [
            {"axis": axis, "inertia": 0.01, "torque": 1.0, "speed": 100.0, "power": 50.0} for axis in axes
        ]
        del actuators["base_torque"]
    if not joints:
        del actuators["joint_torque"]
    target = {"pose": {"position": [0, 0, 2]}}
    base = {**random_body(rng), "motion": "spatial"}
    parts = {"name": "random", "base": base, "links": links, "target": target, "actuators": actuators}
    return Scene.model_validate(parts)


def random_motion(rng, scene):
    """A state without the pose, and an input."""
    layout = StateLayout.of(scene)
    x = rng.normal(size=layout.n_x)
    for where in unit_quaternions(scene):
        x[where] /= np.linalg.norm(x[where])
    return x[layout.state.pose.stop :], rng.normal(size=layout.n_u)


def pinocchio_twin(scene):
    """The robot as Pinocchio's model, with wheels as joints of their own, and each joint's number by link."""
    model, wheels = pin.Model(), scene.actuators.wheels or ()
    model.gravity = pin.Motion.Zero()
    base = model.addJoint(0, pin.JointModelFreeFlyer(), pin.SE3.Identity(), "base")
    axial = sum((w.inertia * np.outer(w.unit_axis, w.unit_axis) for w in wheels), start=np.zeros((3, 3)))
    hub = pin.Inertia(scene.base.mass, np.zeros(3), np.array(scene.base.inertia) - axial)
    model.appendBodyToJoint(base, hub, pin.SE3.Identity())
    places, joints = [(base, pin.SE3.Identity())], {}
    for index, (link, parent) in enumerate(zip(scene.links, scene.parent_bodies, strict=True)):
        carrier, at = places[parent]
        at = at * pin.SE3(np.array(link.joint.rotation_matrix), np.array(link.joint.position))
        if not link.is_fixed:
            kind = {
                "revolute": pin.JointModelRZ,
                "prismatic": pin.JointModelPZ,
                "screw": partial(pin.JointModelHZ, link.pitch),
                "spherical": pin.JointModelSpherical,
            }[link.joint_type]()
            carrier = joints[index] = model.addJoint(carrier, kind, at, link.name)
            at = pin.SE3.Identity()
        places.append((carrier, at))
        body = pin.Inertia(link.mass, np.array(link.center_of_mass), np.array(link.inertia))
        model.appendBodyToJoint(carrier, body, at)
    spins = []
    for index, wheel in enumerate(wheels):
        turn, _ = Rotation.align_vectors([wheel.unit_axis], [[0.0, 0.0, 1.0]])
        place = pin.SE3(turn.as_matrix(), np.zeros(3))
        spins.append(model.addJoint(base, pin.JointModelRZ(), place, f"wheel {index}"))
        spin = pin.Inertia(0.0, np.zeros(3), np.diag([0.0, 0.0, wheel.inertia]))
        model.appendBodyToJoint(spins[-1], spin, pin.SE3.Identity())
    armature = np.zeros(model.nv)
    for index, number in joints.items():
        motor = scene.links[index].motor
        if motor is not None:
            armature[model.joints[number].idx_v] = motor.reflected_inertia
    model.armature = armature
    return model, joints, spins


def pinocchio_accelerations(scene, y, u):
    """Accelerations of base (angular, linear as an inertial observer sees them) and joints."""
    layout, (model, joints, spins) = StateLayout.of(scene), pinocchio_twin(scene)
    equations = EquationsOfMotion(KinematicTree.from_scene(scene), layout)
    motion, inputs = equations.motion(y.tolist()), equations.inputs(u.tolist())
    q, v, tau = np.zeros(model.nq), np.zeros(model.nv), np.zeros(model.nv)
    q[6], v[:3], v[3:6], tau[:3] = 1.0, motion.linear, motion.angular, inputs.force
    tau[3:6] = inputs.torque
    efforts = iter(inputs.joint_torques)
    angles, rates = iter(y[: len(layout.state.names[layout.state.joint_angles])]), iter(motion.joint_rates)
    order = []
    for index, number in joints.items():
        joint, link = model.joints[number], scene.links[index]
        at, own = range(joint.idx_q, joint.idx_q + joint.nq), range(joint.idx_v, joint.idx_v + joint.nv)
        given = np.array([next(angles) for _ in at])
        turn = given
        if link.is_spherical:
            given = np.roll(given, -1)  # Pinocchio's quaternion has its scalar last
            turn = Rotation.from_quat(given).as_rotvec()
        q[at], v[own] = given, [next(rates) for _ in own]
        tau[own] = [next(efforts) for _ in own] - link.stiffness * turn - link.damping * v[own]
        order += own
    for wheel, momentum, torque, number in zip(
        scene.actuators.wheels or (), motion.wheel_momenta, inputs.wheel_torques, spins, strict=True
    ):
        at = model.joints[number].idx_v
        v[at] = momentum / wheel.inertia - np.dot(wheel.unit_axis, motion.angular)
        tau[at] = torque
    a = pin.aba(model, model.createData(), q, v, tau)
    return np.array([*a[3:6], *a[:3], *a[order]])


def relative_error(actual, expected):
    return np.linalg.norm(np.asarray(actual, dtype=float) - expected) / np.linalg.norm(expected)


@pytest.mark.parametrize("joints", range(13))
def test_accelerations_agree_with_pinocchio(joints):
    """Articulated bodies from every body with mass, and the mass matrix; massless bodies harm neither."""
    for seed in range(4):
        rng = np.random.default_rng((joints, seed))
        scene = random_scene(rng, joints, wheels=seed % 2 == 1)
        tree, layout = KinematicTree.from_scene(scene), StateLayout.of(scene)
        y, u = random_motion(rng, scene)
        expected = pinocchio_accelerations(scene, y, u)
        for formulation in ("articulated_body", "minimal_coordinates"):
            found = EquationsOfMotion(tree, layout, (), formulation).accelerations(y.tolist(), u.tolist())
            assert relative_error(found, expected) < 5e-14
        if not any(tree.base.center_of_mass):  # nothing is fixed to the base
            assert relative_error(papers_accelerations(scene, y, u), expected) < 5e-14
        equations = EquationsOfMotion(tree, layout)
        motion = equations.motion(y.tolist())
        driven = equations._driven(motion, equations.inputs(u.tolist()), None)
        for root in [0, *(i for i, link in enumerate(tree.links, 1) if link.spherical in (None, 2))]:
            inertia = ArticulatedBodies(tree, driven[0], root)
            solved = minimal_accelerations(tree, inertia, driven, motion)
            assert relative_error(solved, expected) < 3e-14


def papers_accelerations(scene, y, u):
    """By (20), to which the massless bodies of spherical joints do not belong."""
    field = PaperField(SpaceArmField(KinematicTree.from_scene(scene), StateLayout.of(scene)))
    x = field.state_from_minimal([*dq.IDENTITY, *y.tolist()])
    solved, _ = solve_schur(field.tree, field.system(x, u.tolist()))
    return field.free_accelerations(x, solved)


def minimal_accelerations(tree, inertia, driven, motion):
    solved = forward_dynamics(tree, inertia, *driven)
    turning = np.cross(motion.angular, motion.linear)
    return [*solved.angular, *(np.array(solved.linear) - turning), *solved.joints]


@pytest.mark.parametrize("joints", range(13))
def test_accelerations_agree_with_mujoco(joints):
    """Its bodies that are fixed, and its balls, come from the MJCF of the scene."""
    for seed in range(3):
        rng = np.random.default_rng((joints, seed))
        kinds = ("revolute", "prismatic", "fixed", "spherical")
        scene = random_scene(rng, joints, kinds, wheels=False)
        equations = EquationsOfMotion(KinematicTree.from_scene(scene), StateLayout.of(scene))
        y, u = random_motion(rng, scene)
        motion, (model, data) = equations.motion(y.tolist()), mujoco_twin(scene)
        data.qpos[:7], data.qvel[:3], data.qvel[3:6] = np.eye(7)[3], motion.linear, motion.angular
        state, shift = StateLayout.of(scene).state, StateLayout.of(scene).state.pose.stop
        angles, rates = iter(y[: state.joint_angles.stop - shift]), iter(motion.joint_rates)
        order = []
        for link in scene.links:
            if link.is_fixed:
                continue
            joint = model.joint(f"{link.name} joint")
            at = range(joint.qposadr[0], joint.qposadr[0] + link.freedoms + link.is_spherical)
            own = range(joint.dofadr[0], joint.dofadr[0] + link.freedoms)
            data.qpos[at], data.qvel[own] = [next(angles) for _ in at], [next(rates) for _ in own]
            order += own
        data.ctrl = u = np.clip(u, -1.9, 1.9)
        mujoco.mj_forward(model, data)
        turning = np.cross(motion.angular, motion.linear)
        expected = np.array([*data.qacc[3:6], *(data.qacc[:3] - turning), *data.qacc[order]])
        assert relative_error(equations.accelerations(y.tolist(), u.tolist()), expected) < 5e-14


def mujoco_twin(scene):
    model = mujoco.MjModel.from_xml_string(scene_to_mjcf(scene))
    return model, mujoco.MjData(model)


def test_derivatives_of_both_orders_are_exact():
    """Against automatic differentiation of the rates, also at quaternions of other lengths, as in stages."""
    for seed in range(4):
        rng = np.random.default_rng(seed)
        field = SceneEquations.of(random_scene(rng, 4, ("revolute", "spherical", "fixed"))).field
        y, u, m = (
            casadi.SX.sym(name, n) for name, n in (("y", field.n_y), ("u", field.n_u), ("m", field.n_y))
        )
        parts = casadi.vertsplit(y), casadi.vertsplit(u)
        rates, both = casadi.vertcat(*field.rates(*parts)), casadi.vertcat(y, u)
        found, by_y, by_u = field.linearized_rates(*parts)
        hessian = field.rates_hessian(*parts, found, by_y, by_u, casadi.vertsplit(m))
        expected = [rates, casadi.jacobian(rates, both), casadi.hessian(casadi.dot(m, rates), both)[0]]
        actual = [casadi.vertcat(*found), casadi.horzcat(by_y, by_u), hessian]
        evaluate = casadi.Function("f", [y, u, m], [*actual, *expected])
        values = [
            np.array(each) for each in evaluate(*(rng.normal(size=each.shape[0]) for each in (y, u, m)))
        ]
        for actual_value, expected_value in zip(values[:3], values[3:], strict=True):
            assert relative_error(actual_value, expected_value) < 1e-14


def test_a_free_body_on_a_spherical_joint_at_its_center_of_mass_obeys_euler():
    scene = random_scene(np.random.default_rng(0), 0, wheels=False)
    body = {**random_body(np.random.default_rng(1)), "center_of_mass": [0, 0, 0], "joint": {}, "name": "top"}
    scene = scene.replace(links=[{**body, "joint_type": "spherical"}], actuators={})
    equations = EquationsOfMotion(KinematicTree.from_scene(scene), StateLayout.of(scene))
    y, _ = random_motion(np.random.default_rng(2), scene)
    motion, accelerations = equations.motion(y.tolist()), equations.accelerations(y.tolist(), [])
    rates = np.array(motion.joint_rates)
    rotation = np.array(minimal.quaternion_rotation(motion.joint_angles[0])).T  # to the axes of the top
    carried, inertia = rotation @ motion.angular, np.array(scene.links[0].inertia)
    omega = carried + rates
    alpha = rotation @ accelerations[:3] + np.cross(carried, rates) + accelerations[6:]
    np.testing.assert_allclose(inertia @ alpha, -np.cross(omega, inertia @ omega), rtol=0, atol=1e-14)


def test_a_fixed_link_keeps_its_frame_and_its_mass():
    rng = np.random.default_rng(3)
    scene = random_scene(rng, 8)
    tree, layout = KinematicTree.from_scene(scene), StateLayout.of(scene)
    y, _ = random_motion(rng, scene)
    angles = tree.coordinates(y[: layout.state.joint_angles.stop - 8].tolist())
    frames = kinematics.frame_poses(tree, dq.IDENTITY, angles, ())
    assert len(frames) == 1 + len(scene.links) + 1
    assert sum(body.mass for body in tree.bodies) == pytest.approx(
        scene.base.mass + sum(link.mass for link in scene.links), rel=1e-14
    )
    for link, parent, frame in zip(scene.links, scene.parent_bodies, frames[1:], strict=False):
        if link.is_fixed:
            expected = dq.multiply(frames[parent], link.joint.dual_quaternion)
            np.testing.assert_allclose(frame, expected, rtol=0, atol=1e-14)


def test_fixed_links_are_written_as_urdf_and_read_as_parts_of_what_carries_them():
    start = {"joint_angles": (), "joint_rates": ()}
    scene = load_scene("no-wrist").replace({"links.1.joint_type": "fixed"}, initial_state=start)
    text = scene_to_urdf(scene.replace(links=[link.model_dump() | {"damping": 0.0} for link in scene.links]))
    assert text.count('type="fixed"') == 2  # the tip's besides
    trees = [KinematicTree.from_scene(each) for each in (scene, scene_from_urdf(text, tip="tip"))]
    matrices = [mass_matrix(tree, minimal.link_frames(tree, [0.3, -0.7])) for tree in trees]
    np.testing.assert_allclose(*matrices, rtol=1e-14, atol=1e-14)


def test_what_spherical_and_fixed_joints_do_not_have_is_refused():
    scene = load_scene("heavy-wrist")
    with pytest.raises(SceneError, match="a spherical joint has none: remove it"):
        scene.replace({"links.3.motor": {"inertia": 1e-4, "gear": 50.0}})
    with pytest.raises(SceneError, match="a fixed joint has none: remove it"):
        scene.replace({"links.2.joint_type": "fixed", "links.2.damping": 0.1})
    with pytest.raises(SceneError, match=r"has no quaternions among its angles, .* take rk4, rk6"):
        scene.replace(simulation={"integrator": "gauss6"})
    with pytest.raises(SceneError, match=r"joint_angles.* must be 6 numbers"):
        scene.replace({"initial_state.joint_angles": [0.0] * 4})
    limits = {"kind": "joint_limits", "name": "limits", "lower": [-1.0] * 4}
    with pytest.raises(SceneError, match="link 'wrist' must have none, its joint is spherical"):
        scene.replace(constraints=[limits])
    with pytest.raises(SceneError, match="it has no spherical joints, and link 'wrist' has one"):
        scene_to_urdf(scene)
