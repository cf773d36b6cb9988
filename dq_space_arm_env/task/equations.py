"""A scene's task over plain scalars: the paper's quadratic cost (section V), and the observation.

The stage cost of step k is

    (q_{G/I} - q_{D/I})' W_q (q_{G/I} - q_{D/I}) + (omega - omega_D)' W_omega (omega - omega_D) + u' R u,

without a factor dt; the terminal cost has the first two terms with weights W_fq, W_fomega. q and -q are the
same pose but cost differently: the sign of q_{G/I} is fixed at the start, q_r . q_{D,r} >= 0, and carried
along by continuity. A scene may square q_{D/G} - 1 instead, with q_{D/G} = q_{G/I}* q_{D/I} (31), which a
common rigid motion of base and target leaves as it is (`cost.pose_error: relative`).

Where a scene weighs it, the tip's twist relative to the target is a further term,

    w^G_{G/D} = w^G_{G/I} - q_{G/D}* w^D_{D/I} q_{G/D}.

The wrist's Euler rates, which are inputs, are part of it in the stage cost; at the end the wrist is held. If
they lag behind their commands they are states, and part of it at the end too.

Other tips add squares of the vector parts of their error poses q_{D/G}, each with its own weights.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import casadi

from dq_space_arm_env.algebra import dual_quaternion as dq
from dq_space_arm_env.algebra import dual_vectors, poses
from dq_space_arm_env.algebra.scalars import select
from dq_space_arm_env.algebra.symbolic import symbols
from dq_space_arm_env.algebra.vectors import norm
from dq_space_arm_env.dynamics import kinematics
from dq_space_arm_env.dynamics.equations_of_motion import Motion
from dq_space_arm_env.dynamics.kinematic_tree import KinematicTree
from dq_space_arm_env.dynamics.space_arm_field import SpaceArmField
from dq_space_arm_env.dynamics.vector_field import split_state
from dq_space_arm_env.scene.bodies import freedoms
from dq_space_arm_env.scene.constraints import limited_motors
from dq_space_arm_env.scene.layout import StateLayout
from dq_space_arm_env.scene.parameters import (
    PHASE,
    grasp_numbers,
    has_grasp,
    observed_masses,
    target_entries,
    target_numbers,
    velocity_entries,
    velocity_numbers,
    weight_name,
)
from dq_space_arm_env.scene.schema import Scene

Scalar = Any
Scalars = Sequence[Scalar]


@dataclass(frozen=True)
class SceneEquations:
    """A scene's equations of motion with its cost and observation."""

    scene: Scene
    tree: KinematicTree
    target: Scalars  # q_{D/I}, 8 numbers or symbols
    target_velocity: Scalars  # twist of D in its axes, 6 numbers or symbols
    layout: StateLayout
    field: SpaceArmField
    given: Mapping[str, Scalar]  # the parameters by name

    @classmethod
    def of(cls, scene: Scene, parameters: Scalars | None = None) -> SceneEquations:
        """Equations of a scene with symbols, `field.parameters`, for what varies; or with given values."""
        layout = StateLayout.of(scene)
        varying: list[Scalar] = []
        if parameters is None:
            parameters = varying = symbols("parameter", layout.n_p)
        given = dict(zip(layout.parameters.names, parameters, strict=True))
        target: Scalars = body_pose(scene, given)
        velocity: Scalars = body_velocity(scene, given)
        if has_grasp(scene):
            grasp = grasp_pose(scene, given)
            target = dq.multiply(target, grasp)
            velocity = dual_vectors.inverse_transform(*poses.to_matrix(grasp), velocity)
        tree = KinematicTree.from_scene(scene, given)
        field = SpaceArmField(tree, layout, varying, scene.simulation.formulation)
        return cls(scene, tree, target, velocity, layout, field, given)

    def y(self, x: Scalars) -> Scalars:
        """State without the pose."""
        return split_state(self.field, x)[1]

    def base_pose(self, x: Scalars) -> Scalars:
        """Pose of the base q_{e0/I}, 8 numbers."""
        return self.field.pose.full(split_state(self.field, x)[0])

    def moved(self, x: Scalars, z: Scalars) -> tuple[Scalars, Scalars]:
        """Pose of the base and y of a state moved by z in tangent coordinates, to second order in z.

        A twist increment d moves the pose by 1 + d / 2 + d^2 / 8, with dual quaternion products.
        """
        n = len(self.field.pose.directions)
        half = dq.from_vector([0.5 * entry for entry in self.field.pose.full_twist(z[:n])])
        turned = [a + 0.5 * b for a, b in zip(half, dq.multiply(half, half), strict=True)]
        turned[0] = turned[0] + 1.0
        y = [a + b for a, b in zip(self.y(x), z[n:], strict=True)]
        return dq.multiply(self.base_pose(x), turned), y

    def tip(self, x: Scalars) -> Scalars:
        """Pose of the tip q_{G/I}, 8 numbers, eq. (27)."""
        motion = self.field.motion(self.y(x))
        return kinematics.tip_pose(self.tree, self.base_pose(x), motion.joint_angles, motion.wrist_angles)

    def state_cost_terms(self, x: Scalars) -> list[Scalar]:
        """Pose and base velocity: the stage cost's terms of the state."""
        return [self._pose_cost(x, "pose"), self._velocity_cost(x, "base_velocity")]

    def effort(self, u: Scalars) -> Scalar:
        """Effort u' R u, the stage cost's term of the input."""
        return weighted_square(u, [0.0] * self.field.n_u, self.control_weights)

    def twist_cost_terms(self, x: Scalars, u: Scalars) -> list[Scalar]:
        """The stage cost's term of the tip's twist; none where it has no weight."""
        if not any(self.scene.cost.tip_twist):
            return []
        twist = self.relative_twist(x, self.field.inputs(u).wrist_rates)
        return [weighted_square(twist, [0.0] * 6, self.state_weights("tip_twist"))]

    def cost_terms(self, x: Scalars, u: Scalars) -> list[Scalar]:
        """Pose, base velocity, effort, and tip's twist if it has a weight: the terms of the stage cost."""
        return [*self.state_cost_terms(x), self.effort(u), *self.twist_cost_terms(x, u)]

    def terminal_cost_terms(self, x: Scalars) -> list[Scalar]:
        """Pose, base velocity, and tip's twist if it has a weight: the terms of the terminal cost."""
        terms = [self._pose_cost(x, "terminal_pose"), self._velocity_cost(x, "terminal_base_velocity")]
        if any(self.scene.cost.terminal_tip_twist):
            weights = self.state_weights("terminal_tip_twist")
            terms.append(weighted_square(self.relative_twist(x), [0.0] * 6, weights))
        return terms

    def relative_twist(self, x: Scalars, wrist_rates: Scalars | None = None) -> Scalars:
        """Twist of the tip relative to the target in tip axes, 6; with the wrist held unless it has rates."""
        tip, moving = self.tip(x), self.field.motion(self.y(x))
        return dual_vectors.subtract(self.tip_twist(moving, wrist_rates), self.target_twist(tip))

    def tip_twist(self, motion: Motion, wrist_rates: Scalars | None = None) -> Scalars:
        """Twist of the tip in its axes, 6; of a wrist whose rates are states, with these."""
        wrist_rates = motion.wrist_rates or wrist_rates
        base = (*motion.angular, *motion.linear)
        angles = motion.joint_angles, motion.wrist_angles
        return kinematics.tip_twist(self.tree, *angles, base, motion.joint_rates, wrist_rates)

    def target_twist(self, tip: Scalars) -> Scalars:
        """Twist of the target in the axes of a tip or another frame, 6: Ad(q_{D/G}) w^D."""
        return dual_vectors.transform(
            *poses.to_matrix(poses.error_pose(tip, self.target)), self.target_velocity
        )

    def other_errors(self, base: Scalars, y: Scalars) -> list[Scalars]:
        """Error poses q_{D/G} of the other tips, 8 numbers each, from the base's pose and the rest of x."""
        angles, errors = self.field.motion(y).joint_angles, list[Scalars]()
        for tip, (body, frame) in zip(self.scene.other_tips, self.tree.other_tips, strict=True):
            seen = kinematics.seen_from_base(self.tree, angles, body, frame.dual_quaternion)
            goal: Scalars = tip.goal.dual_quaternion
            if tip.relative_to == "target":
                goal = dq.multiply(body_pose(self.scene, self.given), goal)
            errors.append(poses.error_pose(dq.multiply(base, seen), goal))
        return errors

    def other_twists(self, base: Scalars, y: Scalars) -> list[Scalars]:
        """Twists of the other tips relative to their goals in tip axes, 6 each."""
        motion = self.field.motion(y)
        twists = kinematics.other_tip_twists(
            self.tree, motion.joint_angles, (*motion.angular, *motion.linear), motion.joint_rates
        )
        carrying = body_velocity(self.scene, self.given)
        for index, (tip, error) in enumerate(
            zip(self.scene.other_tips, self.other_errors(base, y), strict=True)
        ):
            if tip.relative_to == "target" and self.scene.target.motion is not None:
                goal = dual_vectors.inverse_transform(
                    tip.goal.rotation_matrix, tip.goal.position, carrying
                )  # in the goal's axes; Ad(q_{D/G}) brings it into the tip's
                along = dual_vectors.transform(*poses.to_matrix(error), goal)
                twists[index] = dual_vectors.subtract(twists[index], along)
        return twists

    def compared_poses(self, tip: Scalars) -> tuple[Scalars, Scalars]:
        """What the cost squares the difference of, for a pose of the tip: q_{G/I}, q_{D/I}, or q_{D/G}, 1."""
        return compared_poses(self.scene, tip, self.target)

    def _pose_cost(self, x: Scalars, field: str) -> Scalar:
        cost = weighted_square(*self.compared_poses(self.tip(x)), self.state_weights(field))
        for tip, error in zip(
            self.scene.other_tips, self.other_errors(self.base_pose(x), self.y(x)), strict=True
        ):
            cost = cost + weighted_square(vector_parts(error), [0.0] * 6, getattr(tip, field))
        return cost

    def _velocity_cost(self, x: Scalars, field: str) -> Scalar:
        motion = self.field.motion(self.y(x))
        references = self.desired_base_velocity(self.base_pose(x))
        return weighted_square((*motion.angular, *motion.linear), references, self.state_weights(field))

    def desired_base_velocity(self, base: Scalars) -> Scalars:
        """Desired velocity of the base in its axes, 6, from its pose: it may be relative to the target's."""
        desired: Scalars = self.scene.target.base_velocity
        if self.scene.target.base_velocity_relative:
            desired = dual_vectors.add(desired, self.target_twist(base))
        return desired

    def state_weights(self, field: str) -> list[Scalar]:
        """Weights of the state in the cost by their field in the scene, such as "terminal_pose"."""
        nominal = getattr(self.scene.cost, field)
        return [self.given.get(weight_name(field, index), weight) for index, weight in enumerate(nominal)]

    @property
    def control_weights(self) -> list[Scalar]:
        """Weights of the squared inputs in the cost, n_u."""
        names, nominal = self.layout.control.weights, self.layout.control_weight.tolist()
        return [self.given.get(name, weight) for name, weight in zip(names, nominal, strict=True)]

    @property
    def control_limits(self) -> list[Scalar]:
        """Largest magnitudes of the inputs, n_u."""
        names, nominal = self.layout.control.limits, self.layout.control_limit.tolist()
        return [self.given.get(name, limit) for name, limit in zip(names, nominal, strict=True)]

    def observe(self, x: Scalars, time_left: Scalar, besides: Scalars = ()) -> dict[str, list[Scalar]]:
        """Observation, with what is `besides`, and the errors of the tips: angle in rad, distance in m."""
        tip = self.tip(x)
        motion = self.field.motion(self.y(x))
        # Error pose q_{D/G} = q_{G/I}* q_{D/I}, eq. (31); in a planar scene four entries vanish identically.
        error = self.field.pose.reduced(poses.error_pose(tip, self.target))
        twists: list[Scalar] = []
        if self.scene.target.motion is not None:
            carried = self.target_twist(tip)
            relative = dual_vectors.subtract(self.tip_twist(motion), carried)
            twists = [twist[i] for twist in (relative, carried) for i in self.field.pose.directions]
        observation = [
            *error,
            *x[self.layout.state.base_velocity],
            *x[self.layout.state.joint_angles],
            *motion.wrist_angles,
            *motion.joint_rates,
            *motion.motor_angles,
            *motion.motor_rates,
            *motion.wheel_momenta,
            *motion.propellant,
            *motion.previous_controls,
            *motion.drives,
            *([self.given[PHASE]] if self.scene.phases else []),
            *(self.field.pose.reduced(self.target) if self.scene.target.observed else []),
            *(self.given[drawn.name] / drawn.nominal - 1.0 for drawn in observed_masses(self.scene)),
            *besides,
            *twists,
            time_left,
        ]
        errors = [poses.error_angle(tip, self.target), poses.error_distance(tip, self.target)]
        if self.scene.target.motion is not None:  # the target's twist has the error's position computed
            errors[1] = norm(poses.position(poses.error_pose(tip, self.target)))
        for other in self.other_errors(self.base_pose(x), self.y(x)):  # the worst tip counts
            own = poses.error_angle(other, dq.IDENTITY), norm(poses.position(other))
            errors = [larger(a, b) for a, b in zip(errors, own, strict=True)]
        return {"observation": observation, "errors": errors}


def compared_poses(scene: Scene, tip: Scalars, target: Scalars) -> tuple[Scalars, Scalars]:
    """Two dual quaternions whose difference is the pose error of a scene's cost, 8 numbers each."""
    if scene.cost.pose_error == "paper":
        return tip, target
    return poses.error_pose(tip, target), dq.IDENTITY


def vector_parts(pose: Scalars) -> list[Scalar]:
    """Vector parts of a dual quaternion, rotation then position, 6."""
    return [*pose[1:4], *pose[5:8]]


def larger(a: Scalar, b: Scalar) -> Scalar:
    """The larger one of two numbers."""
    return select(b > a, b, a)


def torque_ranges(equations: SceneEquations, motion: Motion, u: Scalars) -> list[tuple[Scalar, ...]]:
    """Torque, and the least and the greatest that full voltage leaves, of motors with a stall torque."""
    links, layout, found = equations.scene.links, equations.layout, []
    elastic = [joint for joint, (link, _) in enumerate(freedoms(links)) if links[link].is_elastic]
    for index, link in limited_motors(equations.scene):
        joint = layout.actuated_joints[index]
        rate = motion.motor_rates[elastic.index(joint)] if link.is_elastic else motion.joint_rates[joint]
        torque = u[layout.control.joint_torque.start + index]
        assert link.motor is not None
        found.append((torque, *(link.motor.envelope(rate) or ())))
    return found


def body_pose(scene: Scene, given: Mapping[str, Scalar]) -> list[Scalar]:
    """Pose of the target's body q_{T/I}, 8 numbers, where some may be given by name."""
    pose: list[Scalar] = list(scene.target.pose.dual_quaternion)
    for number, index in zip(target_numbers(scene), target_entries(scene), strict=True):
        pose[index] = given.get(number.name, number.nominal)
    return pose


def grasp_pose(scene: Scene, given: Mapping[str, Scalar]) -> list[Scalar]:
    """Grasp frame in the target's body q_{D/T}, likewise."""
    pose: list[Scalar] = list(scene.target.grasp.dual_quaternion)
    for number, index in zip(grasp_numbers(scene), target_entries(scene), strict=False):
        pose[index] = given.get(number.name, number.nominal)
    return pose


def body_velocity(scene: Scene, given: Mapping[str, Scalar]) -> list[Scalar]:
    """Twist of the target's body in its axes, 6 numbers, where some may be given by name; zero at rest."""
    velocity: list[Scalar] = [0.0] * 6
    if scene.target.motion is not None:
        for number, index in zip(velocity_numbers(scene), velocity_entries(scene), strict=True):
            velocity[index] = given.get(number.name, number.nominal)
    return velocity


def weighted_square(
    values: Sequence[Scalar], references: Sequence[Scalar], weights: Sequence[Scalar]
) -> Scalar:
    """Sum of w (value - reference)^2, a term of the cost."""
    # Squares that share a weight are added first: fewer products, and stage and terminal cost share the sums.
    # Weights that are symbols compare by identity.
    sums: dict[Scalar, tuple[Scalar, Scalar]] = {}
    for value, reference, weight in zip(values, references, weights, strict=True):
        error = value - reference
        key = id(weight) if isinstance(weight, casadi.SX) else weight
        sums[key] = weight, sums.get(key, (weight, 0.0))[1] + error * error
    result: Scalar = 0.0
    for weight, squares in sums.values():
        result = result + weight * squares
    return result


def total(terms: Scalars) -> Scalar:
    """Sum of scalars, from left to right."""
    result: Scalar = 0.0
    for term in terms:
        result = result + term
    return result
