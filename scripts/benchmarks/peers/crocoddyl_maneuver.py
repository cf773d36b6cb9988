"""A scene's maneuver in the terms of Crocoddyl 3: the same robot, limits, horizon, time step and cost.

An iteration runs Crocoddyl's compiled code only: forward dynamics of a free-flying chain
(`DifferentialActionModelFreeFwdDynamics`), its integrators, and its residuals. Three things differ from our
problem:

- **Pose cost.** Crocoddyl has no residual q_{G/I} - q_{D/I}. Its log6 residual of a frame half way between
  tip and inertial origin, in axes along the line between them, has weights for which both costs agree to
  second order at the target, see `_log_weights`. They are 6 % apart 0.2 rad and 0.3 m away from it, 20 % at
  0.7 rad and 0.9 m. `exact_pose_cost` takes the cost itself, as a residual in Python, which makes iterations
  two to four times as slow: good for counting iterations and comparing costs, not for time.
- **Integrator.** Crocoddyl's Euler is our symplectic Euler. Its RK4 moves the pose by the mean twist of a
  step (ours by one Munthe-Kaas increment), and integrates the running cost, which ours takes at the beginning
  of each step. It also evaluates costs, with their derivatives, in all four stages.
- **Wrist.** Inputs that are velocities have no place in a chain of torques. The massless wrist becomes three
  revolute joints with nothing but a rotor: they move independently of the rest, and their torque is the
  change of their rate in a step. Their rates, now states, carry the weight of the wrist's inputs, and their
  limits become a penalty. With Euler, u_k = rate_{k+1} makes both problems the same but for these limits;
  with RK4 a rate is a ramp in between.

A scene without a wrist, with Euler and the exact pose cost, is the same problem to 1e-12.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from dq_space_arm_env.algebra import poses
from dq_space_arm_env.dynamics.kinematic_tree import KinematicTree
from experts.problems.arm_problem import ArmProblem
from experts.problems.paper_problem import beyond_the_paper
from experts.problems.shooting_problem import FloatArray
from scripts.benchmarks.peers.pinocchio_peer import PinocchioPeer
from scripts.benchmarks.peers.robot import Robot, beyond_the_robot
from scripts.benchmarks.subjects import COMPARED_INTEGRATORS

RATE_PENALTY = 3e3
"""Weight of the squared excess of a wrist rate over its limit, (s/rad)^2.

On scene `paper` the excess gains 0.3 % of the cost, and controls clipped to the limits end 0.03 % above the
optimum. More weight brings both down, and takes more iterations.
"""


def obstacle(problem: ArmProblem) -> str | None:
    """The sentence that tells why Crocoddyl cannot take a maneuver; None if it can."""
    layout, tree = problem.kernels.layout, KinematicTree.from_scene(problem.scene)
    inputs = 6 + layout.n_joints + 3 * layout.has_wrist
    reasons = {
        "a planar base": tree.planar,
        "arms that branch": tree.path_to(tree.tip_body) != [*range(len(tree.links))],
        "parts without an actuator": not tree.planar and layout.n_u < inputs,
        "springs or dampers": any(link.stiffness or link.damping for link in tree.links),
        "a wrench at the tip": tree.tip_wrench is not None,
        f"steps of {problem.integrator}": problem.integrator not in COMPARED_INTEGRATORS,
    }
    found = [reason for reason, applies in reasons.items() if applies]
    found += beyond_the_robot(problem.scene) + beyond_the_paper(problem.scene)
    return f"Crocoddyl is left out: it is not given {' or '.join(found)}." if found else None


class CrocoddylManeuver:
    """A maneuver as Crocoddyl's shooting problem, with conversions of its states and inputs."""

    def __init__(self, problem: ArmProblem, *, exact_pose_cost: bool = False) -> None:
        import crocoddyl
        import pinocchio

        sentence = obstacle(problem)
        if sentence is not None:
            raise ValueError(sentence)
        self._crocoddyl, self._pinocchio = crocoddyl, pinocchio
        self._problem, self._layout = problem, problem.kernels.layout
        self._exact_pose_cost = exact_pose_cost
        self._model, self._tip = self._robot()
        self._state = crocoddyl.StateMultibody(self._model)
        running, terminal = self._stage(), self._terminal_stage()
        start = self._model_states(problem.initial_state[np.newaxis])[0]
        self.shooting = crocoddyl.ShootingProblem(start, [running] * problem.horizon, terminal)

    # Between both ------------------------------------------------------------------------------------------

    def start_at(self, x0: FloatArray) -> None:
        self.shooting.x0 = self._model_states(x0[np.newaxis])[0]

    def model_inputs(self, controls: FloatArray) -> list[FloatArray]:
        """Crocoddyl's inputs: wrench on the base, joint torques, changes of the wrist's rates."""
        inputs = controls.copy()
        wrist = self._layout.control.wrist_rate
        inputs[1:, wrist] -= controls[:-1, wrist]
        return list(inputs)

    def controls(self, inputs: Sequence[FloatArray]) -> FloatArray:
        """Controls within the limits, shape (N, n_u); of the wrist's rates, the mean of each step."""
        controls = np.array(inputs)
        wrist = self._layout.control.wrist_rate
        rates = np.cumsum(controls[:, wrist], axis=0)
        if self._problem.scene.simulation.integrator == "rk4":
            rates[1:] = 0.5 * (rates[1:] + rates[:-1])
            rates[0] *= 0.5
        controls[:, wrist] = rates
        return np.clip(controls, self._problem.control_lower, self._problem.control_upper)

    def states(self, model_states: Sequence[FloatArray]) -> FloatArray:
        """States of the problem, shape (B, n_x), with the sign of the pose nearer to the start's."""
        q, v = np.split(np.array(model_states), [self._model.nq], axis=1)
        entries, joints = self._layout.state, 7 + self._layout.n_joints
        result = np.zeros((len(q), self._layout.n_x))
        scalar_first = q[:, [6, 3, 4, 5]]
        for row, rotation, position in zip(result, scalar_first, q[:, :3], strict=True):
            row[entries.pose] = poses.from_rotation_and_position(tuple(rotation), tuple(position))
        result[result[:, :4] @ self._problem.initial_state[:4] < 0.0, entries.pose] *= -1.0
        result[:, entries.joint_angles], result[:, entries.wrist_angles] = q[:, 7:joints], q[:, joints:]
        result[:, entries.linear_velocity], result[:, entries.angular_velocity] = v[:, :3], v[:, 3:6]
        result[:, entries.joint_rates] = v[:, 6 : joints - 1]
        return result

    def _model_states(self, states: FloatArray) -> FloatArray:
        """Crocoddyl's states: pose with the quaternion's scalar last, angles, linear before angular."""
        kernels = self._problem.kernels
        robot = Robot.of(kernels, states, np.zeros((len(states), self._layout.n_u)))
        wrist = states[:, self._layout.state.wrist_angles]
        return np.hstack(
            [
                robot.position,
                np.roll(robot.rotation, -1, axis=1),
                robot.angles,
                wrist,
                robot.linear,
                robot.angular,
                robot.rates,
                np.zeros_like(wrist),
            ]
        )

    # The robot ---------------------------------------------------------------------------------------------

    def _robot(self) -> tuple[Any, int]:
        """Pinocchio's model, with joints for the wrist, and the index of the tip's frame."""
        pin, tree = self._pinocchio, KinematicTree.from_scene(self._problem.scene)
        model = PinocchioPeer(self._problem.kernels, tree).model
        parent = model.njoints - 1
        if tree.wrist is not None:
            placement = pin.SE3(np.array(tree.wrist.rotation), np.array(tree.wrist.position))
            for axis in ("Z", "Y", "X"):
                joint = getattr(pin, f"JointModelR{axis}")()
                parent = model.addJoint(parent, joint, placement, f"wrist {axis}")
                placement = pin.SE3.Identity()
            # torque / rotor inertia * time step is the change of the rate: with this rotor, torque itself
            armature = model.armature.copy()
            armature[-3:] = self._problem.time_step
            model.armature = armature
        tip = pin.SE3(np.array(tree.tip.rotation), np.array(tree.tip.position))
        frame = model.addFrame(pin.Frame("tip", parent, tip, pin.FrameType.OP_FRAME))
        return model, frame

    # Costs -------------------------------------------------------------------------------------------------

    def _stage(self) -> Any:
        """The action model of a step; Crocoddyl multiplies its cost by the time step."""
        cost, h = self._problem.scene.cost, self._problem.time_step
        costs = self._state_costs(cost.pose, cost.base_velocity, 1.0 / h)
        effort = self._layout.control_weight / h
        effort[self._layout.control.wrist_rate] = 0.0  # a cost of its rates, see `_state_costs`
        residual = self._crocoddyl.ResidualModelControl(self._state)
        costs.addCost("effort", self._quadratic(residual, effort), 1.0)
        dynamics = self._dynamics(costs)
        crocoddyl = self._crocoddyl
        if self._problem.scene.simulation.integrator == "rk4":
            stage = crocoddyl.IntegratedActionModelRK(dynamics, crocoddyl.RKType.four, h, False)
        else:
            stage = crocoddyl.IntegratedActionModelEuler(dynamics, h, False)
        limit = self._layout.control_limit.copy()
        limit[self._layout.control.wrist_rate] *= 2.0  # a rate may turn around within a step
        stage.u_lb, stage.u_ub = -limit, limit
        return stage

    def _terminal_stage(self) -> Any:
        cost = self._problem.scene.cost
        costs = self._state_costs(cost.terminal_pose, cost.terminal_base_velocity, 1.0)
        return self._crocoddyl.IntegratedActionModelEuler(self._dynamics(costs), 0.0, False)

    def _dynamics(self, costs: Any) -> Any:
        actuation = self._crocoddyl.ActuationModelFull(self._state)
        return self._crocoddyl.DifferentialActionModelFreeFwdDynamics(self._state, actuation, costs)

    def _state_costs(self, pose: Sequence[float], velocity: Sequence[float], factor: float) -> Any:
        """Costs of pose, base velocity and wrist rates; the weights are ours times a factor."""
        state, model, wrist = self._state, self._model, self._layout.control.wrist_rate
        costs = self._crocoddyl.CostModelSum(state)
        costs.addCost("pose", self._pose_cost(np.array(pose) * factor), 1.0)
        reference, weights = state.zero(), np.zeros(state.ndx)
        twist = [3, 4, 5, 0, 1, 2]  # linear before angular
        reference[model.nq : model.nq + 6] = np.array(self._problem.scene.target.base_velocity)[twist]
        weights[model.nv : model.nv + 6] = np.array(velocity)[twist] * factor
        n = wrist.stop - wrist.start
        weights[state.ndx - n :] = self._layout.control_weight[wrist] * factor
        residual = self._crocoddyl.ResidualModelState(state, reference)
        costs.addCost("velocity", self._quadratic(residual, weights), 1.0)
        if n > 0:
            limit = np.full(state.ndx, np.inf)
            limit[state.ndx - n :] = self._layout.control_limit[wrist]
            bounds = self._crocoddyl.ActivationBounds(-limit, limit)
            barrier = self._crocoddyl.ActivationModelQuadraticBarrier(bounds)
            penalty = self._crocoddyl.CostModelResidual(state, barrier, residual)
            costs.addCost("wrist limits", penalty, 2.0 * RATE_PENALTY * factor)
        return costs

    def _quadratic(self, residual: Any, weights: FloatArray) -> Any:
        """Sum of weight * residual^2; Crocoddyl's has a factor of one half."""
        activation = self._crocoddyl.ActivationModelWeightedQuad(2.0 * weights)
        return self._crocoddyl.CostModelResidual(self._state, activation, residual)

    def _pose_cost(self, weights: FloatArray) -> Any:
        target = tuple(self._problem.target.tolist())
        if self._exact_pose_cost:
            residual = _exact_residual(self._state, self._tip, np.array(target))
            return self._quadratic(residual, weights)
        pin = self._pinocchio
        log = _log_weights(target, weights)
        offset = pin.SE3(log.rotation, log.position)
        frame = pin.Frame(self._model.frames[self._tip])
        frame.name, frame.placement = "half way", frame.placement * offset
        # Running and terminal costs share the frame.
        index = (
            self._model.addFrame(frame)
            if not self._model.existFrame("half way")
            else self._model.getFrameId("half way")
        )
        rotation, position = poses.to_matrix(target)
        reference = pin.SE3(np.array(rotation), np.array(position)) * offset
        residual = self._crocoddyl.ResidualModelFramePlacement(self._state, index, reference)
        return self._quadratic(residual, log.weights)


@dataclass(frozen=True, eq=False)
class _LogWeights:
    """A frame at the tip and weights of its log6 residual."""

    position: FloatArray  # origin in the tip's frame, shape (3,), m
    rotation: FloatArray  # from its axes to the tip's, shape (3, 3)
    weights: FloatArray  # of the residual, linear before angular, shape (6,)


def _log_weights(target: Sequence[float], weights: FloatArray) -> _LogWeights:
    """Approximate the pose cost by a weighted square of log6, equal to second order at the target.

    A small twist (w, v) of the tip changes q_r by q_r w / 2, and q_d = q_r r / 2 by (q_r v + q_d w) / 2,
    where r is the tip's position in its own axes. The squares of these changes are |w|^2 / 4 and
    (|v + r x w / 2|^2 + (r . w)^2 / 4) / 4. The first term of the latter is the velocity of the point at
    -r / 2; with the third axis along r all is diagonal there.
    """
    real, dual = weights[:4], weights[4:]
    if np.ptp(real) > 0.0 or np.ptp(dual) > 0.0:
        raise ValueError(
            f"cost: pose weights {weights.tolist()} differ within the real or the dual part of the pose; "
            "Crocoddyl's log6 residual has no weights for that, exact_pose_cost has"
        )
    r = np.array(poses.body_position(tuple(target)))
    distance = float(np.linalg.norm(r))
    axis = r / distance if distance > 0.0 else np.array([0.0, 0.0, 1.0])
    # Two more axes at right angles: the orthogonal complement of the first.
    other = np.linalg.svd(axis[np.newaxis])[2][1]
    rotation = np.column_stack([other, np.cross(axis, other), axis])
    along = real[0] + 0.25 * dual[0] * distance**2
    return _LogWeights(-0.5 * r, rotation, 0.25 * np.array([*[dual[0]] * 3, real[0], real[0], along]))


def _exact_residual(state: Any, frame: int, target: FloatArray) -> Any:
    """The residual q_{G/I} - q_{D/I}, of the two signs of q_{G/I} the one with q_r . q_{D,r} >= 0."""
    import crocoddyl
    import pinocchio

    class TipPose(crocoddyl.ResidualModelAbstract):
        """Dual quaternion of the tip less its target."""

        def __init__(self) -> None:
            crocoddyl.ResidualModelAbstract.__init__(self, state, 8, True, False, False)

        def calc(self, data: Any, x: FloatArray, u: FloatArray | None = None) -> None:
            placement = pinocchio.updateFramePlacement(state.pinocchio, data.shared.pinocchio, frame)
            data.r[:] = _dual_quaternion(placement) - target

        def calcDiff(self, data: Any, x: FloatArray, u: FloatArray | None = None) -> None:
            """Compute its Jacobian by the configuration: 1/2 q (twist)."""
            jacobian = pinocchio.getFrameJacobian(
                state.pinocchio, data.shared.pinocchio, frame, pinocchio.LOCAL
            )
            data.Rx[:, : state.nv] = _by_twist(data.r + target) @ jacobian

    def _dual_quaternion(placement: Any) -> FloatArray:
        rotation = np.roll(pinocchio.Quaternion(placement.rotation).coeffs(), 1)
        if rotation @ target[:4] < 0.0:
            rotation = -rotation
        q = poses.from_rotation_and_position(tuple(rotation), tuple(placement.translation))
        return np.array(q)

    return TipPose()


def _by_twist(q: FloatArray) -> FloatArray:
    """Derivative of a pose by a twist in body axes, linear before angular, shape (8, 6)."""
    real, dual = 0.5 * _left_products(q[:4]), 0.5 * _left_products(q[4:])
    return np.block([[np.zeros((4, 3)), real], [real, dual]])


def _left_products(q: FloatArray) -> FloatArray:
    """Products of a quaternion with i, j, k as columns, shape (4, 3)."""
    w, x, y, z = q
    return np.array([[-x, -y, -z], [w, -z, y], [z, w, -x], [-y, x, w]])
