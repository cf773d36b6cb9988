"""The most that the rest of an episode can cost, whatever its actions: what a diverged simulation is charged.

With s = sqrt(2 E), E the energy of bodies, rotors and springs, the twist of every body is bounded by s and
its inertia, so the power of the actuators, and of a wrench at the tip, is at most c s: s' = E' / s <= c.
Dampers, friction and burnt propellant only take energy away. The center of mass gains no more speed than the
forces give, and the arm reaches no farther from it than when it is stretched out; a tank that empties moves
that center, and there the base is as fast as its energy allows. A target on a screw keeps its speed; one that
tumbles keeps its energy, so its rate grows at most by the root of the ratio of its moments of inertia.

Of phases, each is charged for all steps, with the most energy and speed that any of them allows. A catch
brings the payload's energy, and loses some of it. Where masses change, the base is as fast as the energy
allows. What a phase adds by raising a mass or a stiffness is not counted.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from functools import reduce
from typing import Any

import casadi
import numpy as np
from numpy.typing import NDArray

from dq_space_arm_env.algebra import poses, quaternion
from dq_space_arm_env.algebra.vectors import cross, dot, matrix_vector, norm, subtract
from dq_space_arm_env.dynamics.elastic_gears import elastic_joints
from dq_space_arm_env.dynamics.equations_of_motion import Motion
from dq_space_arm_env.dynamics.kinematic_tree import KinematicTree, RigidBody
from dq_space_arm_env.dynamics.minimal import deflections
from dq_space_arm_env.scene.motion import Tumbling, Waypoints
from dq_space_arm_env.scene.path import given_path
from dq_space_arm_env.scene.phases import phases_change_masses
from dq_space_arm_env.task.catching import has_catch
from dq_space_arm_env.task.equations import SceneEquations, body_pose, body_velocity, grasp_pose, total

Scalar = Any
Scalars = Sequence[Scalar]

_Z = (0.0, 0.0, 1.0)


def worst_cost(now: SceneEquations, phases: Sequence[SceneEquations], x: Scalars, steps: Scalar) -> Scalar:
    """Bound of the cost of a number of steps from a state, terminal cost included.

    Args:
        now: The equations of the present stage.
        phases: Those of every phase, with the target as it is now, or at rest where the phase has it so.
        x: State, n_x scalars.
        steps: Number of time steps.
    """
    cases = [WorstCase(each) for each in phases]
    caught = WorstCase(now).payload_speeds() if has_catch(now.scene) else ()
    found = [case.speeds(x, steps * now.scene.simulation.dt, caught) for case in cases]
    most = [reduce(casadi.fmax, each) for each in zip(*found, strict=True)]
    return total([case.cost(x, steps, *most) for case in cases])


class WorstCase:
    """Bounds of one scene's motions over the rest of an episode, or of those of one phase."""

    def __init__(self, equations: SceneEquations) -> None:
        self.equations, self.tree = equations, equations.tree
        self.inputs = equations.field.inputs(equations.control_limits)
        self.force, self.torque = self._base_loads()
        self.bodies = self.tree.bodies
        self.last = self.bodies[self.tree.tip_body]  # it carries the tip
        self.mass = total([body.mass for body in self.bodies])
        places = [*(link.joint for link in self.tree.links), self.tree.wrist, self.tree.tip]
        places += [frame for _, frame in self.tree.other_tips]
        lengths = [norm(place.position) for place in places if place is not None]
        lengths += [] if self.tree.tank is None else [norm(self.tree.tank)]
        self.reach = total([*lengths, *(norm(body.center_of_mass) for body in self.bodies)])

    def _base_loads(self) -> tuple[Scalar, Scalar]:
        """Bounds of force and torque on the base."""
        limits, jets = self.equations.control_limits, self.equations.layout.control.thruster_force
        sizes = limits[jets]
        limits[jets] = [0.0] * len(sizes)
        inputs = self.equations.field.inputs(limits)
        # Against the wheels' motors; their gyroscopic torque does no work.
        torques = [norm(inputs.torque), *map(casadi.fabs, inputs.wheel_torques)]
        pairs = [*zip(sizes, self.tree.jets, strict=True)]
        torques += [casadi.fabs(size) * math.hypot(*jet.torque) for size, jet in pairs]
        fixed = norm(self.tree.base.center_of_mass)  # of what is fixed to the base
        if isinstance(fixed, casadi.SX) or fixed:
            torques.append(fixed * total([norm(inputs.force), *map(casadi.fabs, sizes)]))
        return total([norm(inputs.force), *map(casadi.fabs, sizes)]), total(torques)

    def payload_speeds(self) -> tuple[Scalar, Scalar]:
        """Bounds of angular velocity and velocity of a payload that moves with the target."""
        payload, (turning, moving) = self.equations.scene.payload, self._target_speeds()
        assert payload is not None
        return turning, moving + turning * math.hypot(*payload.center_of_mass)

    def speeds(self, x: Scalars, duration: Scalar, caught: Scalars = ()) -> tuple[Scalar, Scalar]:
        """Bounds of s, and of the base's speed, some time after a state; `caught` is what may be caught."""
        motion = self.equations.field.motion(self.equations.y(x))
        turning = norm(motion.angular) + total(_parts(self.tree, motion.joint_rates, 0))
        sliding = total(_parts(self.tree, motion.joint_rates, 1))
        moving = norm(motion.linear) + self._reach(motion) * turning + sliding
        if caught:  # as if the arm moved so fast besides
            turning, moving = turning + caught[0], moving + caught[1]
        speed = self._root_energy(motion, moving, turning) + duration * self._growth()
        if self.tree.tank is not None or phases_change_masses(self.equations.scene):
            return speed, speed / casadi.sqrt(self.tree.base.mass)
        wrench = self.tree.tip_wrench or (0.0,) * 6
        return speed, moving + duration * (self.force + norm(wrench[:3])) / self.mass

    def _reach(self, motion: Motion) -> Scalar:
        """Of any point of the arm from the base's center of mass."""
        return self.reach + total(_parts(self.tree, motion.joint_angles, 1))

    def cost(self, x: Scalars, steps: Scalar, speed: Scalar, drift: Scalar) -> Scalar:
        """Bound of the cost of a number of steps from a state, terminal cost included, at such speeds."""
        equations, base = self.equations, self.tree.base
        duration = steps * equations.scene.simulation.dt
        reach = self._reach(equations.field.motion(equations.y(x)))
        if any(link.screw.slide for link in self.tree.links):  # bodies move apart: those of tips by so much
            apart = (base, self.last, *(self.bodies[body] for body, _ in self.tree.other_tips))
            fastest = total([speed / casadi.sqrt(body.mass) for body in apart])
            reach = reach + duration * fastest
        # The dual part of a pose has half the length of its position; unit quaternions are at most 2 apart.
        gaps = 2.0, 0.5 * (self._apart(x, duration) + duration * drift + 2.0 * reach)
        references = equations.scene.target.base_velocity
        carried = (0.0, 0.0)
        if equations.scene.target.base_velocity_relative:
            carried = self._carried_speeds(2.0 * gaps[1])
        speeds = (
            _turned(base, speed) + norm(references[:3]) + carried[0],
            speed / casadi.sqrt(base.mass) + norm(references[3:]) + carried[1],
        )

        def state_cost(pose: str, velocity: str, twist: str) -> Scalar:
            cost = self._weighted(pose, 4, gaps) + self._weighted(velocity, 3, speeds)
            for tip in equations.scene.other_tips:  # the vector part of a unit quaternion is at most 1 long
                away = gaps[1] + self._grasp_length() + norm(tip.goal.position)
                cost = cost + _largest_square(getattr(tip, pose), 3, (1.0, away))
            if any(getattr(equations.scene.cost, twist)):
                cost = cost + self._weighted(twist, 3, self._relative_speeds(speed, reach, 2.0 * gaps[1]))
            return cost

        effort = equations.effort(equations.control_limits)
        stage = state_cost("pose", "base_velocity", "tip_twist") + effort
        return steps * stage + state_cost("terminal_pose", "terminal_base_velocity", "terminal_tip_twist")

    def _apart(self, x: Scalars, duration: Scalar) -> Scalar:
        """Bound of how far base and target are from the origin, added; or, with relative errors, apart."""
        scene, base, target = self.equations.scene, self.equations.base_pose(x), self.equations.target
        way: Scalar = 0.0
        if scene.target.motion is not None:
            target, way = body_pose(scene, self.equations.given), self._target_way(duration)
        inertial = any(tip.relative_to == "inertial" for tip in scene.other_tips)
        if scene.cost.pose_error == "relative" and not inertial:
            return norm(poses.position(poses.error_pose(base, target))) + way
        if scene.target.motion is None:
            return norm(poses.position(base)) + norm(poses.position(target))
        # its body is at |r| = 2 |q_d|
        return norm(poses.position(base)) + (2.0 * quaternion.norm(target[4:]) + way)

    def _target_way(self, duration: Scalar) -> Scalar:
        """Bound of the way of the target from where its body is now."""
        motion, grasp = self.equations.scene.target.motion, self._grasp_length()
        if isinstance(motion, Waypoints):  # all of them lie within this distance of the first
            return 2.0 * (np.linalg.norm(self._given_places(), axis=1).max() + grasp)
        return duration * norm(self._target_velocity()[3:]) + grasp

    def _target_speeds(self) -> tuple[Scalar, Scalar]:
        """Bounds of angular velocity and velocity of the target."""
        scene = self.equations.scene
        if scene.target.motion is None:
            return 0.0, 0.0
        if isinstance(scene.target.motion, Waypoints):
            velocities = given_path(scene, scene.simulation.steps)[:, 8:].reshape(-1, 2, 3)
            turning, moving = np.linalg.norm(velocities, axis=2).max(axis=0).tolist()
        else:
            velocity = self._target_velocity()
            turning, moving = norm(velocity[:3]), norm(velocity[3:])
        if isinstance(scene.target.motion, Tumbling):
            turning = turning * scene.target.motion.rate_growth
        return turning, moving + turning * self._grasp_length()

    def _relative_speeds(self, speed: Scalar, reach: Scalar, distance: Scalar) -> tuple[Scalar, Scalar]:
        """Bounds of angular velocity and velocity of the tip relative to a target at most so far away."""
        carried = self._carried_speeds(distance)
        wrist = total([0.0, *(casadi.fabs(rate) for rate in self.inputs.wrist_rates)])
        turning = _turned(self.last, speed) + wrist
        moving = speed / casadi.sqrt(self.last.mass) + reach * turning
        return turning + carried[0], moving + carried[1]

    def _carried_speeds(self, distance: Scalar) -> tuple[Scalar, Scalar]:
        """Likewise of the target, as if it reached so far."""
        turning, moving = self._target_speeds()
        return turning, moving + distance * turning

    def _target_velocity(self) -> list[Scalar]:
        return body_velocity(self.equations.scene, self.equations.given)

    def _grasp_length(self) -> Scalar:
        return norm(poses.position(grasp_pose(self.equations.scene, self.equations.given)))

    def _given_places(self) -> NDArray[np.float64]:
        """Places of a target that passes waypoints, relative to its start, shape (steps + 1, 3)."""
        scene = self.equations.scene
        path = given_path(scene, scene.simulation.steps)[:, :8]
        return np.stack(poses.position(tuple(path.T)), axis=1)

    def _weighted(self, field: str, size: int, lengths: Scalars) -> Scalar:
        """Cost of two vectors of these lengths; the largest weight counts for all entries of a vector."""
        return _largest_square(self.equations.state_weights(field), size, lengths)

    def _root_energy(self, motion: Motion, moving: Scalar, turning: Scalar) -> Scalar:
        """Bound of s if no body moves or turns faster."""
        moments = total([body.inertia[i][i] for body in self.bodies for i in range(3)])
        rotors = [
            casadi.sqrt(link.rotor.inertia) * (turning + abs(link.rotor.gear) * casadi.fabs(rate))
            for link, rate in zip(self.tree.links, motion.joint_rates, strict=True)
            if link.rotor is not None
        ]
        motors = zip(elastic_joints(self.tree), motion.motor_angles, motion.motor_rates, strict=True)
        for (index, gear), angle, rate in motors:
            rotors.append(casadi.sqrt(gear.inertia) * casadi.fabs(rate))
            rotors.append(casadi.sqrt(gear.stiffness) * casadi.fabs(angle - motion.joint_angles[index]))
        springs = [
            casadi.sqrt(link.stiffness) * casadi.fabs(away)
            for link, away in zip(self.tree.links, deflections(self.tree, motion.joint_angles), strict=True)
        ]
        mass = total([self.mass, *motion.propellant])
        return casadi.sqrt(mass) * moving + casadi.sqrt(moments) * turning + total([*springs, *rotors])

    def _growth(self) -> Scalar:
        """The bound c: root of the sum of f^2 / m + t' I^-1 t over the bodies' forces f and torques t."""
        inputs, links, bodies = self.inputs, self.tree.links, self.bodies
        forces: list[Scalar] = [self.force, *[0.0] * len(links)]
        # Components of the torques as they act in I^-1/2, added as if all pointed the same way.
        torques = [_turned(self.tree.base, self.torque), *[0.0] * len(links)]
        rotors: list[Scalar] = []
        for i, (link, limit) in enumerate(zip(links, inputs.joint_torques, strict=True)):
            axis, effort, parent = matrix_vector(link.joint.rotation, _Z), casadi.fabs(limit), link.parent
            if link.spherical is not None:  # about any axis of the body before, across those without mass
                before, after = links[i - link.spherical].parent, i + 3 - link.spherical
                torques[before] = torques[before] + _turned(bodies[before], effort)
                torques[after] = torques[after] + _turned(bodies[after], effort)
                continue
            if link.elastic is not None:  # it turns the rotor alone
                rotors.append(effort / casadi.sqrt(link.elastic.inertia))
                continue
            if link.screw.turn:
                own = effort * casadi.sqrt(_inverse_moment(bodies[parent], axis))
                torques[parent] = torques[parent] + own
                torques[i + 1] = torques[i + 1] + effort * casadi.sqrt(_inverse_moment(bodies[i + 1], _Z))
                continue
            # A force along the line of the joint, at a constant distance from both centers of mass.
            places = (link.joint.position, (0.0, 0.0, 0.0))
            for body, place, direction in zip((parent, i + 1), places, (axis, _Z), strict=True):
                arm = norm(cross(subtract(place, bodies[body].center_of_mass), direction))
                forces[body] = forces[body] + effort
                torques[body] = torques[body] + _turned(bodies[body], effort * arm)
        if self.tree.tip_wrench is not None:
            inner = (0.0, 0.0, 0.0) if self.tree.wrist is None else self.tree.wrist.position
            arm = norm(subtract(inner, self.last.center_of_mass)) + norm(self.tree.tip.position)
            force, torque = norm(self.tree.tip_wrench[:3]), norm(self.tree.tip_wrench[3:])
            body = self.tree.tip_body
            forces[body] = forces[body] + force
            torques[body] = torques[body] + _turned(self.last, torque + force * arm)
        massive = [link.spherical in (None, 2) for link in links]
        loaded = zip(forces, bodies, [True, *massive], strict=True)
        squares = [force * force / body.mass for force, body, has_mass in loaded if has_mass]
        return casadi.sqrt(total([*squares, *(torque * torque for torque in (*torques, *rotors))]))


def _largest_square(weights: Scalars, size: int, lengths: Scalars) -> Scalar:
    """Cost of two vectors of these lengths, of which the first has so many entries."""
    costs = []
    for part, length in zip((weights[:size], weights[size:]), lengths, strict=True):
        largest: Scalar = 0.0
        for weight in part:
            largest = casadi.fmax(largest, weight)
        costs.append(largest * (length * length))
    return total(costs)


def _parts(tree: KinematicTree, coordinates: Scalars, part: int) -> list[Scalar]:
    """Sizes by which joints turn (part 0) or slide (part 1)."""
    pairs = zip(tree.links, coordinates, strict=True)
    return [abs(link.screw[part]) * casadi.fabs(each) for link, each in pairs if link.screw[part]]


_AXES = ((1.0, 0.0, 0.0), (0.0, 1.0, 0.0), _Z)


def _turned(body: RigidBody, size: Scalar) -> Scalar:
    """Bound of |I^-1/2 v| for a vector of some size along any axis."""
    return size * casadi.sqrt(total([_inverse_moment(body, axis) for axis in _AXES]))


def _inverse_moment(body: RigidBody, axis: Scalars) -> Scalar:
    """A' I^-1 a about the center of mass."""
    (a, d, e), (_, b, f), (_, _, c) = body.inertia
    first, second, third = b * c - f * f, e * f - d * c, d * f - b * e
    fourth = d * e - a * f
    adjugate = (first, second, third), (second, a * c - e * e, fourth), (third, fourth, a * b - d * d)
    return dot(axis, matrix_vector(adjugate, axis)) / (a * first + d * second + e * third)
