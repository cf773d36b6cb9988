"""Random robots, and the same robots as Pinocchio models: a free flyer with joints about and along z."""

from typing import Any

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from dq_space_arm_env.algebra import poses
from dq_space_arm_env.dynamics.kinematic_tree import JointedLink, KinematicTree, Placement, RigidBody, Screw

pin = pytest.importorskip("pinocchio")


def random_rotation(rng: np.random.Generator) -> Rotation:
    return Rotation.random(random_state=np.random.RandomState(rng.integers(2**31)))


def random_placement(rng: np.random.Generator) -> Placement:
    rotation = random_rotation(rng)
    position = rng.uniform(-1.0, 1.0, 3)
    x, y, z, w = rotation.as_quat()
    dual_quaternion = poses.from_rotation_and_position((w, x, y, z), tuple(position.tolist()))
    matrix, _ = poses.to_matrix(dual_quaternion)
    return Placement(tuple(position.tolist()), matrix, dual_quaternion)


def random_body(rng: np.random.Generator, at_origin: bool = False) -> RigidBody:
    # Inertia of a cloud of points: it satisfies the triangle inequality by construction.
    points = rng.normal(size=(6, 3))
    points -= points.mean(axis=0)
    mass = float(rng.uniform(0.5, 20.0))
    inertia = mass / 6 * sum(p @ p * np.eye(3) - np.outer(p, p) for p in points)
    center = np.zeros(3) if at_origin else rng.uniform(-0.5, 0.5, 3)
    return RigidBody(mass, tuple(center.tolist()), tuple(tuple(row) for row in inertia.tolist()))


def random_screw(rng: np.random.Generator) -> Screw:
    """A revolute joint as often as one of another kind."""
    kinds = [Screw(1.0, 0.0), Screw(1.0, 0.0), Screw(0.0, 1.0), Screw(1.0, float(rng.uniform(-0.5, 0.5)))]
    return kinds[rng.integers(len(kinds))]


def random_tree(rng: np.random.Generator, joints: int, branches: bool, wrist: bool = True) -> KinematicTree:
    """A robot whose links follow each other, or sit on any body before them, as the tip then does."""
    parents = [int(rng.integers(i + 1)) if branches else i for i in range(joints)]
    links = tuple(
        JointedLink(random_body(rng), random_placement(rng), random_screw(rng), parent, 0.0, 0.0, 0.0)
        for parent in parents
    )
    return KinematicTree(
        base=random_body(rng, at_origin=True),
        links=links,
        tip_body=int(rng.integers(joints + 1)) if branches else joints,
        wrist=random_placement(rng) if wrist else None,
        tip=random_placement(rng),
        other_tips=(),
        tip_wrench=None,
        planar=False,
    )


def pinocchio_model(tree: KinematicTree) -> Any:
    """The tree as a Pinocchio model without gravity."""
    model = pin.Model()
    model.gravity = pin.Motion.Zero()
    model.addJoint(0, pin.JointModelFreeFlyer(), pin.SE3.Identity(), "base")
    model.appendBodyToJoint(1, _inertia(tree.base), pin.SE3.Identity())
    for index, link in enumerate(tree.links):
        add_link(model, 1 + link.parent, link, f"joint {index}")
    return model


def add_link(model: Any, parent: int, link: JointedLink, name: str) -> int:
    """Add a link to Pinocchio's model, and give the number of its joint."""
    placement = pin.SE3(np.array(link.joint.rotation), np.array(link.joint.position))
    turn, slide = link.screw
    joint = pin.JointModelHZ(slide) if slide else pin.JointModelRZ()
    joint = joint if turn else pin.JointModelPZ()
    number: int = model.addJoint(parent, joint, placement, name)
    model.appendBodyToJoint(number, _inertia(link.body), pin.SE3.Identity())
    return number


def _inertia(body: RigidBody) -> Any:
    return pin.Inertia(body.mass, np.array(body.center_of_mass), np.array(body.inertia))


def configuration(base_pose: Any, joint_angles: Any) -> np.ndarray:
    """Pinocchio's q: position, quaternion with the scalar last, joint angles."""
    position = poses.position(tuple(base_pose))
    w, x, y, z = base_pose[:4]
    return np.array([*position, x, y, z, w, *joint_angles])


def velocity(angular: Any, linear: Any, joint_rates: Any) -> np.ndarray:
    """Pinocchio's v: linear, then angular velocity in body axes, joint rates."""
    return np.array([*linear, *angular, *joint_rates])


def tip_on_its_body(tree: KinematicTree, wrist_angles: Any) -> tuple[np.ndarray, np.ndarray]:
    """Rotation matrix and position of the tip in the frame of the body that carries it, by matrices."""
    rotation, position = np.eye(3), np.zeros(3)
    if tree.wrist is not None:
        psi, theta, phi = wrist_angles
        rotation = np.array(tree.wrist.rotation) @ Rotation.from_euler("ZYX", [psi, theta, phi]).as_matrix()
        position = np.array(tree.wrist.position)
    position = position + rotation @ np.array(tree.tip.position)
    return rotation @ np.array(tree.tip.rotation), position
