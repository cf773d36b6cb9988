"""A scene's robot as a Pinocchio model (`pip install pin`); conversions of states and inputs."""

from __future__ import annotations

from collections.abc import Sequence
from importlib import import_module
from itertools import accumulate
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from dq_space_arm_env.algebra import poses
from dq_space_arm_env.common.real_arrays import real_array
from dq_space_arm_env.dynamics import minimal
from dq_space_arm_env.dynamics.equations_of_motion import EquationsOfMotion
from dq_space_arm_env.dynamics.kinematic_tree import KinematicTree, Placement, RigidBody, Screw
from dq_space_arm_env.interoperability.exporting import (
    changed_robots,
    coupled_rotors,
    depth_first,
    tip_on_its_body,
)
from dq_space_arm_env.scene import Scene, SceneError, StateLayout, load_scene
from dq_space_arm_env.scene.bodies import freedoms
from dq_space_arm_env.scene.pose import PLANAR_POSE
from dq_space_arm_env.scene.start import unit_quaternions

Array = NDArray[np.float64]

_UNIT_TOLERANCE = 1e-6


def pinocchio_model(scene: Scene | str | Path) -> Any:
    """Build a scene's robot as a `pinocchio.Model`.

    Joint `base` is a free flyer (planar scenes: a planar joint) with the frame e0, at the center of mass;
    each link has a joint about or along z, called by its name, or a spherical one; a link that is fixed is
    part of what carries it. Where arms branch, one arm follows the other, as Pinocchio's algorithms need it,
    also where the scene has its links in another order. There is no gravity; limits are not set. Rotors are
    its `armature`. Frame `tip` is G, with the wrist at its initial angles. `to_pinocchio` and
    `generalized_forces` give the arguments of Pinocchio's algorithms: `pinocchio.aba(model, data, q, v, tau)`
    is (dv, dw, joint accelerations), where (dw, dv) are the scene's base accelerations.

    Args:
        scene: A scene, the name of a shipped one, or a path to a YAML file; its nominal
            masses and inertias, the payload part of the tip's link.

    Returns:
        The model; nv = 6 + n for n degrees of freedom of joints, 3 + n in a planar scene.

    Raises:
        ImportError: If Pinocchio is not installed.
        SceneError: If the scene has reaction wheels or a tank, a rotor is coupled to the body that carries
            it, or phases change the robot.
    """
    pin = _pinocchio()
    scene = load_scene(scene)
    tree = _equations(scene).tree
    problems = [*coupled_rotors(scene), *changed_robots(scene)]
    if problems:
        raise SceneError("\n  - ".join([f"scene {scene.name!r} cannot be a Pinocchio model:", *problems]))
    model = pin.Model()
    model.name = scene.name
    model.gravity = pin.Motion.Zero()
    free = pin.JointModelPlanar() if tree.planar else pin.JointModelFreeFlyer()
    joints = [model.addJoint(0, free, pin.SE3.Identity(), "base")] * (1 + len(tree.links))
    model.appendBodyToJoint(joints[0], _inertia(pin, tree.base), pin.SE3.Identity())
    moving = freedoms(scene.links)
    for number in _places(scene)[1]:
        link, (index, _) = tree.links[number], moving[number]
        joint = joints[link.parent]
        if not link.spherical:  # Pinocchio has one joint for all three
            kind = pin.JointModelSpherical() if link.spherical == 0 else _joint(pin, link.screw)
            joint = model.addJoint(joint, kind, _placement(pin, link.joint), scene.links[index].name)
        joints[number + 1] = joint
        if link.body.mass:
            model.appendBodyToJoint(joint, _inertia(pin, link.body), pin.SE3.Identity())
    if any(link.rotor is not None for link in tree.links):
        armature = np.zeros(model.nv)
        for joint, link in zip(joints[1:], tree.links, strict=True):
            if link.rotor is not None:
                armature[model.joints[joint].idx_v] = link.rotor.reflected
        model.armature = armature
    rotation, position = poses.to_matrix(tip_on_its_body(scene))
    tip = pin.SE3(np.array(rotation), np.array(position))
    place = tree.places[scene.tip_body][1]
    if place is not None:
        tip = _placement(pin, place) * tip
    model.addFrame(pin.Frame("tip", joints[tree.tip_body], tip, pin.FrameType.OP_FRAME))
    return model


def _places(scene: Scene) -> tuple[list[int], list[int]]:
    """Where Pinocchio's coordinates and velocities of joints are among a state's joint angles and rates."""

    def places(sizes: Sequence[int]) -> list[int]:
        ends = [*accumulate(sizes)]
        return [place for link in depth_first(scene) for place in range(ends[link] - sizes[link], ends[link])]

    links = scene.links
    return places([len(link.coordinates) for link in links]), places([link.freedoms for link in links])


def _joint(pin: Any, screw: Screw) -> Any:
    if not screw.turn:
        return pin.JointModelPZ()
    return pin.JointModelHZ(screw.slide) if screw.slide else pin.JointModelRZ()


def to_pinocchio(scene: Scene | str | Path, x: ArrayLike) -> tuple[Array, Array]:
    """Write a state as Pinocchio's configuration and velocity.

    Args:
        scene: A scene, the name of a shipped one, or a path to a YAML file.
        x: State, shape (n_x,), units of the state; the wrist's angles are not part of the model.

    Returns:
        q: position of e0 in inertial axes, m, quaternion with the scalar last, joint angles in the order of
        the model, rad, or quaternions likewise, shape (7 + n,), 1 more for each spherical joint (planar: x,
        y, cosine and sine of the angle, joint angles, (4 + n,)); v: linear velocity of e0, m/s, angular
        velocity, rad/s, both in base axes, joint rates, rad/s, shape (6 + n,) (planar: v_x, v_y, omega_z,
        joint rates, (3 + n,)).

    Raises:
        TypeError: If x is masked, or not of real numbers.
        ValueError: If x has another shape, a quaternion is no unit one within 1e-6, or the scene has reaction
            wheels or a tank (`SceneError`).
    """
    scene = load_scene(scene)
    equations, entries = _equations(scene), StateLayout.of(scene).state
    values = _checked("x", x, equations.n_x)
    quaternions = unit_quaternions(scene)
    pose = tuple(equations.pose.full(values[entries.pose].tolist()))
    _check_lengths("x", pose[:4], *(values[where] for where in quaternions))
    position, (w, i, j, k) = poses.position(pose), pose[:4]
    motion = equations.motion(values[entries.pose.stop :].tolist())
    if equations.tree.planar:
        base = [*position[:2], w * w - k * k, 2.0 * w * k]
        velocity = [*motion.linear[:2], motion.angular[2]]
    else:
        base, velocity = [*position, i, j, k, w], [*motion.linear, *motion.angular]
    values = values.copy()
    for where in quaternions:
        values[where] = np.roll(values[where], -1)
    angles, rates = _places(scene)
    joints = values[entries.joint_angles][angles]
    return np.array([*base, *joints]), np.array([*velocity, *(motion.joint_rates[place] for place in rates)])


def from_pinocchio(
    scene: Scene | str | Path, q: ArrayLike, v: ArrayLike, wrist_angles: ArrayLike = ()
) -> Array:
    """Write Pinocchio's configuration and velocity as a state, the inverse of `to_pinocchio`.

    Args:
        scene: A scene, the name of a shipped one, or a path to a YAML file.
        q: Configuration as of `to_pinocchio`, m and rad.
        v: Velocity, shape (6 + n,), or (3 + n,) in a planar scene, m/s and rad/s.
        wrist_angles: psi, theta, phi, shape (3,), rad; shape (0,) without a wrist.

    Returns:
        State, shape (n_x,), units of the state; the sign of q_{e0/I} is that of q, in a planar scene the one
        with a scalar part of at least 0. What else the state has, as previous controls, is zero.

    Raises:
        TypeError: If something is masked, or not of real numbers.
        ValueError: If a shape is wrong, or a quaternion (planar: cosine and sine) no unit one within 1e-6.
    """
    scene = load_scene(scene)
    layout = StateLayout.of(scene)
    n, planar = layout.n_joints, layout.planar
    quaternions = unit_quaternions(scene)
    configuration = _checked("q", q, n + len(quaternions) + (4 if planar else 7))
    velocity = _checked("v", v, n + (3 if planar else 6))
    wrist = _checked("wrist_angles", wrist_angles, 3 if layout.has_wrist else 0)
    if planar:
        (x, y, cosine, sine), angles = configuration[:4], configuration[4:]
        half = 0.5 * np.arctan2(sine, cosine)
        pose = poses.from_rotation_and_position((np.cos(half), 0.0, 0.0, np.sin(half)), (x, y, 0.0))
        base = [pose[i] for i in PLANAR_POSE]
        twist, rates = [velocity[2], *velocity[:2]], velocity[3:]
    else:
        position, (i, j, k, w), angles = configuration[:3], configuration[3:7], configuration[7:]
        base = list(poses.from_rotation_and_position((w, i, j, k), tuple(position)))
        twist, rates = [*velocity[3:6], *velocity[:3]], velocity[6:]
    ours = _places(scene)
    angles, rates = angles[np.argsort(ours[0])], rates[np.argsort(ours[1])]
    previous = np.zeros(layout.n_x - layout.state.joint_rates.stop)
    x = np.array([*base, *angles, *wrist, *twist, *rates, *previous], dtype=np.float64)
    _check_lengths(
        "q", configuration[2:4] if planar else configuration[3:7], *(x[each] for each in quaternions)
    )
    for where in quaternions:
        x[where] = np.roll(x[where], 1)
    return x


def generalized_forces(scene: Scene | str | Path, x: ArrayLike, u: ArrayLike) -> Array:
    """Collect inputs, joint springs and dampers, and the tip wrench as Pinocchio's generalized forces tau.

    Args:
        scene: A scene, the name of a shipped one, or a path to a YAML file.
        x: State, shape (n_x,), units of the state.
        u: Inputs that act, shape (n_u,), units of the inputs: of actuators with a lag or a delay the outputs,
            not the commands; the wrist's rates do no work.

    Returns:
        Force at e0, N, torque, N m, both in base axes, joint torques in the order of the model, N m, shape
        (6 + n,) (planar: f_x, f_y, tau_z, joint torques, (3 + n,)).

    Raises:
        TypeError: If x or u is masked, or not of real numbers.
        ValueError: If x or u has another shape, or the scene reaction wheels or a tank (`SceneError`).
    """
    scene = load_scene(scene)
    equations, entries = _equations(scene), StateLayout.of(scene).state
    values = _checked("x", x, equations.n_x)
    motion = equations.motion(values[entries.pose.stop :].tolist())
    inputs = equations.inputs(_checked("u", u, equations.n_u).tolist())
    frames = minimal.link_frames(equations.tree, motion.joint_angles)
    tip = equations.tip_forces(motion, frames, equations.tree.tip_wrench)
    passive = minimal.passive_torques(equations.tree, motion.joint_angles, motion.joint_rates)
    base = [*map(sum, zip(inputs.force, tip.force, strict=True))]
    base += map(sum, zip(inputs.torque, tip.torque, strict=True))
    if equations.tree.planar:
        base = [*base[:2], base[5]]
    joints = [*map(sum, zip(inputs.joint_torques, passive, tip.joints, strict=True))]
    return np.array([*base, *(joints[place] for place in _places(scene)[1])], dtype=np.float64)


def _pinocchio() -> Any:
    try:
        return import_module("pinocchio")
    except ImportError as error:
        raise ImportError("pinocchio_model needs Pinocchio: pip install pin") from error


def _equations(scene: Scene) -> EquationsOfMotion:
    for part, words in (("wheels", "reaction wheels have"), ("tank", "tank, which empties, has")):
        if getattr(scene.actuators, part) is not None:
            raise SceneError(
                f"scene {scene.name!r} cannot be written for Pinocchio: its {words} no place in the model; "
                f"leave out what is there with replace({{'actuators.{part}': None}})"
            )
    return EquationsOfMotion(KinematicTree.from_scene(scene), StateLayout.of(scene))


def _checked(name: str, values: ArrayLike, size: int) -> Array:
    array = real_array(name, values, np.float64)
    if array.shape != (size,):
        raise ValueError(f"{name}: shape {array.shape}, it must be ({size},)")
    return array


def _check_lengths(name: str, *quaternions: ArrayLike) -> None:
    """Raise ValueError for quaternions (or cosine and sine) that are no unit ones."""
    for part in map(np.asarray, quaternions):
        if not abs(np.linalg.norm(part) - 1.0) <= _UNIT_TOLERANCE:
            raise ValueError(f"{name}: {part} has norm {np.linalg.norm(part):.9g}, it must be 1 within 1e-6")


def _inertia(pin: Any, body: RigidBody) -> Any:
    return pin.Inertia(body.mass, np.array(body.center_of_mass), np.array(body.inertia))


def _placement(pin: Any, placement: Placement) -> Any:
    return pin.SE3(np.array(placement.rotation), np.array(placement.position))
