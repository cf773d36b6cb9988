"""A payload that is caught between two stages, over plain scalars."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import casadi

from dq_space_arm_env.algebra.vectors import norm, subtract
from dq_space_arm_env.dynamics.kinematic_tree import KinematicTree, rigid_body
from dq_space_arm_env.dynamics.plastic_impact import Velocities, capture, momentum_at_tip
from dq_space_arm_env.scene.parameters import body_numbers, catch_numbers, velocity_entries
from dq_space_arm_env.task.equations import SceneEquations

Scalar = Any
Scalars = Sequence[Scalar]


class Catching:
    """The plastic impact of a scene's tip and payload, with the masses of the stage before it.

    The latch is rigid: the payload is held where the scene puts it, whatever is left of the tip's errors.
    """

    def __init__(self, equations: SceneEquations) -> None:
        scene = equations.scene
        assert scene.payload is not None
        self.equations = equations
        own = {number.name for number in body_numbers(scene, "payload")}
        # Those that phases change are the scene's own once it is held; others may be parameters.
        unheld = own & scene.staged.values.keys()
        given = {name: value for name, value in equations.given.items() if name not in unheld}
        self._free = KinematicTree.from_scene(scene, given | dict.fromkeys(own, 0.0))
        self._loaded = KinematicTree.from_scene(scene, given)
        self._payload = rigid_body(scene.payload, "payload", scene.payload.center_of_mass, given)

    def __call__(self, x: Scalars, twist: Scalars) -> list[Scalar]:
        """State after the payload, with a twist in tip axes, 6 numbers, has been caught."""
        field, state = self.equations.field, self.equations.layout.state
        motion = field.motion(self.equations.y(x))
        velocities = Velocities(motion.angular, motion.linear, motion.joint_rates)
        free, loaded = (tree.with_propellant(motion.propellant) for tree in (self._free, self._loaded))
        after = capture(free, loaded, self._payload, motion.joint_angles, velocities, twist)
        moving = [*after.angular, *after.linear]
        caught = list(x)
        caught[state.base_velocity] = [moving[i] for i in field.pose.directions]
        caught[state.joint_rates] = after.joint_rates
        return caught

    def shock(self, x: Scalars, twist: Scalars) -> list[Scalar]:
        """Impulse [N s] and angular impulse about the tip [N m s] on a payload that moves on as x says."""
        motion = self.equations.field.motion(self.equations.y(x))
        after = momentum_at_tip(self._payload, self.equations.tip_twist(motion))
        before = momentum_at_tip(self._payload, twist)
        return [norm(subtract(a, b)) for a, b in zip(after, before, strict=True)]


def has_catch(scene: Any) -> bool:
    """Tell whether a phase of a scene begins with a catch."""
    return any(phase.catch is not None for phase in scene.phases)


def catch_of_stage(equations: SceneEquations, x: Scalars) -> list[Scalar]:
    """State after a step and, where the stage's parameters say so, the catch at its end."""
    scene, given = equations.scene, equations.given
    now, *entries = (given[number.name] for number in catch_numbers(scene))
    twist: list[Scalar] = [0.0] * 6
    for index, value in zip(velocity_entries(scene), entries, strict=True):
        twist[index] = value
    caught = Catching(equations)(x, twist)
    return [casadi.if_else(now, new, old) for new, old in zip(caught, x, strict=True)]
