"""A scene's robot in Pinocchio: its articulated-body algorithm, called state by state and in batches."""

from __future__ import annotations

from functools import partial
from typing import Any

import numpy as np

from dq_space_arm_env import Kernels
from dq_space_arm_env.dynamics import minimal
from dq_space_arm_env.dynamics.kinematic_tree import KinematicTree, RigidBody
from experts.problems.shooting_problem import FloatArray
from scripts.benchmarks.peers.robot import Robot
from scripts.benchmarks.subjects import DYNAMICS, Case, Subject


class PinocchioPeer:
    """Pinocchio's articulated-body algorithm."""

    name = "Pinocchio"

    def __init__(self, kernels: Kernels, tree: KinematicTree) -> None:
        """Build the robot: a free or planar base, then revolute joints about z."""
        import pinocchio

        self._pin, self._kernels, self._tree = pinocchio, kernels, tree
        self.notes: list[str] = []
        if not hasattr(pinocchio, "abaInParallel"):
            self.notes.append("Pinocchio's batches are left out: this build of it has none.")
        self.model = pinocchio.Model()
        self.model.gravity = pinocchio.Motion.Zero()
        base = pinocchio.JointModelPlanar() if tree.planar else pinocchio.JointModelFreeFlyer()
        joints = [self.model.addJoint(0, base, pinocchio.SE3.Identity(), "base")]
        self.model.appendBodyToJoint(joints[0], self._inertia(tree.base), pinocchio.SE3.Identity())
        for index, link in enumerate(tree.links):
            placement = pinocchio.SE3(np.array(link.joint.rotation), np.array(link.joint.position))
            parent, revolute = joints[link.parent], pinocchio.JointModelRZ()
            joints.append(self.model.addJoint(parent, revolute, placement, f"joint {index}"))
            self.model.appendBodyToJoint(joints[-1], self._inertia(link.body), pinocchio.SE3.Identity())
        self._data = self.model.createData()

    def _inertia(self, body: RigidBody) -> Any:
        return self._pin.Inertia(body.mass, np.array(body.center_of_mass), np.array(body.inertia))

    def _arguments(self, x: FloatArray, u: FloatArray) -> tuple[FloatArray, FloatArray, FloatArray]:
        """Pinocchio's q, v and tau, a row for each state."""
        robot = Robot.of(self._kernels, x, u)
        passive = minimal.passive_torques(self._tree, list(robot.angles.T), list(robot.rates.T))
        joints = robot.motors + np.reshape(passive, robot.motors.T.shape).T
        w, z = robot.rotation[:, 0], robot.rotation[:, 3]
        if self._tree.planar:
            # x, y, then cosine and sine of the angle; velocities along x and y in base axes, then about z
            turned = np.column_stack([w * w - z * z, 2.0 * w * z])
            q = [robot.position[:, :2], turned, robot.angles]
            v = [robot.linear[:, :2], robot.angular[:, 2:], robot.rates]
            return np.hstack(q), np.hstack(v), np.hstack([robot.force[:, :2], robot.torque[:, 2:], joints])
        # quaternion with the scalar last; linear before angular
        q = [robot.position, robot.rotation[:, 1:], robot.rotation[:, :1], robot.angles]
        v = [robot.linear, robot.angular, robot.rates]
        return np.hstack(q), np.hstack(v), np.hstack([robot.force, robot.torque, joints])

    def accelerations(self, x: FloatArray, u: FloatArray) -> FloatArray:
        """The accelerations of `Kernels.forward_dynamics`, by `aba`."""
        rows = zip(*self._arguments(x, u), strict=True)
        a = np.array([self._pin.aba(self.model, self._data, *row) for row in rows])
        linear = 2 if self._tree.planar else 3
        base = a.shape[1] - len(self._tree.links)
        return np.hstack([a[:, linear:base], a[:, :linear], a[:, base:]])

    def end_angles(self, x: FloatArray, integrator: str, steps: int) -> FloatArray | None:
        """None: of Pinocchio, only the dynamics are timed."""
        return None

    def cases(self, x: FloatArray, u: FloatArray) -> list[Case]:
        """`aba` called from Python state by state, and batched in C++ where this build of Pinocchio can."""
        q, v, tau = self._arguments(x, u)
        subject = Subject(what=DYNAMICS, engine=self.name, way="aba from Python")
        one = partial(self._pin.aba, self.model, self._data, q[0].copy(), v[0].copy(), tau[0].copy())
        cases = [Case(subject, one)]
        if hasattr(self._pin, "abaInParallel"):
            pool = self._pin.ModelPool(self.model, 1)
            columns = [np.asfortranarray(array.T) for array in (q, v, tau)]
            result = np.zeros(columns[1].shape, order="F")
            batch = partial(self._pin.abaInParallel, 1, pool, *columns, result)
            way = "abaInParallel"
            cases.append(Case(Subject(what=DYNAMICS, engine=self.name, way=way, batch=len(x)), batch))
        return cases
