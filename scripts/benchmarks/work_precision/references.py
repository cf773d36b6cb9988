"""Reference ends of motions, from codes that share no dynamics with ours.

The solution of a body alone is known to 30 digits. SciPy's DOP853 integrates arms, hold by hold, on
Pinocchio's articulated-body algorithm, or on our own accelerations where Pinocchio is missing. Our own method
of order 8 follows the maneuvers of all scenes, after the codes have been compared.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from dq_space_arm_env import Kernels, compile_scene
from dq_space_arm_env.algebra import poses, quaternion, rotations
from dq_space_arm_env.dynamics import minimal
from dq_space_arm_env.dynamics.kinematic_tree import KinematicTree
from dq_space_arm_env.scene import INTEGRATORS
from experts.problems.shooting_problem import FloatArray
from scripts.benchmarks.peers.pinocchio_peer import PinocchioPeer
from scripts.benchmarks.peers.robot import Robot
from scripts.benchmarks.work_precision.many_digits import torque_free_motion
from scripts.benchmarks.work_precision.methods import Method, Walk
from scripts.benchmarks.work_precision.motions import MotionCase

TOLERANCE = 1e-13
_Rates = Callable[[float, FloatArray, FloatArray], FloatArray]


@dataclass(frozen=True, eq=False)
class Reference:
    """End of a motion."""

    state: FloatArray  # the state, shape (n_x,), units of the scene's layout
    source: str
    second: FloatArray | None = None


def reference_of(case: MotionCase, *, second: bool = False) -> Reference:
    """End of a motion, and a second opinion if asked for."""
    kernels = compile_scene(case.scene)
    if not case.has_other_code:
        return _fine_end(case)
    if case.is_single_body:
        return Reference(_body_end(case, kernels), "power series with 30 digits")
    arm = _Arm(case, kernels)
    try:
        rates = arm.pinocchio_rates()
    except ImportError:
        return Reference(arm.end(arm.own_rates()), f"DOP853 at {TOLERANCE:g} on our own accelerations")
    return Reference(
        arm.end(rates),
        f"DOP853 at {TOLERANCE:g} on Pinocchio's dynamics",
        arm.end(arm.own_rates()) if second else None,
    )


def _fine_end(case: MotionCase) -> Reference:
    """The end by our own method of order 8, with fine steps; that of order 6 tells how far to trust it."""
    ends = []
    for name, per_hold in (("rk8", 4), ("rk6", 8)):
        method = Method(name, INTEGRATORS[name].order)
        walk = Walk(method, method.kernels(case.scene), case)
        walk.run(per_hold)
        ends.append(walk.state)
    return Reference(ends[0], "rk8 with a quarter of the step", ends[1])


def _body_end(case: MotionCase, kernels: Kernels) -> FloatArray:
    """The end of a free body: it turns by Euler's equations, its center moves along a line."""
    state = kernels.layout.state
    start, twist = case.start[state.pose].tolist(), case.start[state.base_velocity].tolist()
    inertia = np.diagonal(np.array(case.scene.base.inertia)).tolist()
    q, omega = torque_free_motion(inertia, twist[:3], start[:4], case.duration)
    rotation, position = poses.to_matrix(tuple(start))
    velocity = np.array(rotation) @ twist[3:]
    end = np.zeros(kernels.n_x)
    where = np.array(position) + case.duration * velocity
    attitude = [float(entry) for entry in q]
    end[state.pose] = poses.from_rotation_and_position(attitude, where.tolist())
    turned, _ = poses.to_matrix(tuple(end[state.pose].tolist()))
    end[state.base_velocity] = [*(float(rate) for rate in omega), *(np.array(turned).T @ velocity)]
    return end


class _Arm:
    """An arm as SciPy integrates it: position, quaternion, joints, wrist if any, base twist, joint rates."""

    def __init__(self, case: MotionCase, kernels: Kernels) -> None:
        self._case, self._kernels = case, kernels
        self._tree = KinematicTree.from_scene(case.scene)
        self._n, self._wrist = kernels.layout.n_joints, kernels.layout.state.wrist_angles
        self._angles = slice(7, 7 + self._n)
        self._turns = slice(7 + self._n, 7 + self._n + self._wrist.stop - self._wrist.start)
        self._velocities = slice(self._turns.stop, self._turns.stop + 6 + self._n)

    def _from_state(self, x: FloatArray) -> FloatArray:
        robot, state = Robot.of(self._kernels, x[None], np.zeros((1, self._kernels.n_u))), x[self._wrist]
        parts = (robot.position, robot.rotation, robot.angles, state[None])
        s: FloatArray = np.hstack([*parts, robot.angular, robot.linear, robot.rates])[0]
        return s

    def _to_state(self, s: FloatArray) -> FloatArray:
        layout = self._kernels.layout.state
        x = np.zeros(self._kernels.n_x)
        q = s[3:7] / np.linalg.norm(s[3:7])
        x[layout.pose] = poses.from_rotation_and_position(q.tolist(), s[:3].tolist())
        x[layout.joint_angles], x[layout.wrist_angles] = s[self._angles], s[self._turns]
        velocities = s[self._velocities]
        x[layout.base_velocity], x[layout.joint_rates] = velocities[:6], velocities[6:]
        return x

    def end(self, accelerations: _Rates) -> FloatArray:
        """Integrate hold by hold; `accelerations` gives those of twist and joints."""
        from scipy.integrate import solve_ivp

        control = self._kernels.layout.control.wrist_rate
        s = self._from_state(self._case.start)
        for u in self._case.controls:

            def rates(t: float, s: FloatArray, u: FloatArray = u) -> FloatArray:
                change = np.empty_like(s)
                q, velocities = s[3:7].tolist(), s[self._velocities]
                change[:3] = rotations.rotate(q, velocities[3:6].tolist())
                change[3:7] = quaternion.derivative(q, velocities[:3].tolist())
                change[self._angles] = velocities[6:]
                change[self._turns] = u[control] if control.stop > control.start else 0.0
                change[self._velocities] = accelerations(t, s, u)
                return change

            span = (0.0, self._case.hold)
            found = solve_ivp(rates, span, s, method="DOP853", rtol=TOLERANCE, atol=TOLERANCE)
            if not found.success:
                raise RuntimeError(f"no reference for case {self._case.name}: {found.message}")
            s = found.y[:, -1]
        return self._to_state(s)

    def own_rates(self) -> _Rates:
        """Our own accelerations."""
        return lambda t, s, u: self._kernels.forward_dynamics(self._to_state(s), u)

    def pinocchio_rates(self) -> _Rates:
        """Pinocchio's accelerations."""
        import pinocchio

        model = PinocchioPeer(self._kernels, self._tree).model
        data, start, joints = model.createData(), self._case.start[None], slice(6, None)
        held: dict[bytes, FloatArray] = {}

        def forces(u: FloatArray) -> FloatArray:
            key = u.tobytes()
            if key not in held:
                robot = Robot.of(self._kernels, start, u[None])
                held.clear()
                held[key] = np.hstack([robot.force, robot.torque, robot.motors])[0]
            return held[key]

        def accelerations(t: float, s: FloatArray, u: FloatArray) -> FloatArray:
            velocities, angles = s[self._velocities], s[self._angles]
            # Pinocchio: the quaternion's scalar last, linear before angular
            q = np.concatenate([s[:3], s[4:7], s[3:4], angles])
            q[3:7] /= np.linalg.norm(q[3:7])
            v = np.concatenate([velocities[3:6], velocities[:3], velocities[6:]])
            tau = forces(u).copy()
            tau[joints] += minimal.passive_torques(self._tree, angles.tolist(), velocities[joints].tolist())
            a = pinocchio.aba(model, data, q, v, tau)
            return np.concatenate([a[3:6], a[:3], a[6:]])

        return accelerations
