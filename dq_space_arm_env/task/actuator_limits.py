"""What actuators do with their inputs: physics of the environment that no input overrides.

Plans know these limits as bounds of the inputs and as constraints; kernels take inputs as they are. Of two
numbers of which one is NaN, compiled minima and maxima are the second: there stands the input, and NaN stays.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Any

import casadi

from dq_space_arm_env.dynamics import reaction_wheels
from dq_space_arm_env.dynamics.jets import burnt
from dq_space_arm_env.scene.constraint_rows import slew_limits
from dq_space_arm_env.scene.constraints import limited_motors
from dq_space_arm_env.scene.schema import Scene
from dq_space_arm_env.task.equations import SceneEquations, torque_ranges

Scalar = Any
Scalars = Sequence[Scalar]

_ROUNDING = {"float64": 1e-12, "float32": 1e-6}
"""More than what rounding adds to the shortest pulse, relative to it."""
_LEAST_BURN = 1e-30  # kg, below which nothing burns
_LEAST_SPEED = 1e-9  # rad/s, below which no power limits a wheel's torque


def reads_state(scene: Scene) -> bool:
    """Tell whether what actuators do depends on the state: they slew, slow down, or burn propellant."""
    limited = (math.isfinite(min(wheel.speed, wheel.power)) for wheel in scene.actuators.wheels or ())
    return bool(any(limited) or scene.actuators.tank or slew_limits(scene) or limited_motors(scene))


def are_ideal(scene: Scene) -> bool:
    """Tell whether actuators apply all that is asked of them within their limits."""
    return not reads_state(scene) and not any(
        jet.impulse_bit(jet.force) for jet in scene.actuators.thrusters or ()
    )


def applied(equations: SceneEquations, x: Scalars, u: Scalars) -> list[Scalar]:
    """Inputs that act, n_u, of those that are asked for; the state matters where `reads_state`."""
    scene, result = equations.scene, list(u)
    if reads_state(scene):
        _follow(equations, x, result)
        _drive(equations, x, result)
        part = equations.layout.control.wheel_torque
        result[part] = _wheel_torques(equations, x, result[part])
    first = equations.layout.control.thruster_force.start
    for index, thruster in enumerate(scene.actuators.thrusters or (), first):
        if thruster.impulse_bit(thruster.force):
            # A pulse of the largest force with the impulse f h; one of the shortest is rounded into it.
            shortest = thruster.impulse_bit(equations.control_limits[index])
            least = (1.0 - _ROUNDING[scene.simulation.precision]) * shortest / scene.simulation.dt
            result[index] = casadi.if_else(result[index] < least, 0.0, result[index])
    if scene.actuators.tank is not None:
        _burn(equations, x, result)
    return result


def _follow(equations: SceneEquations, x: Scalars, u: list[Scalar]) -> None:
    """Let inputs change no faster than the actuators slew, from those before."""
    layout, dt = equations.layout, equations.scene.simulation.dt
    for limit in slew_limits(equations.scene):
        before = x[layout.state.actuators][layout.previous_controls.index(limit.control)]
        highest, lowest = before + limit.rate * dt, before - limit.rate * dt
        u[limit.control] = casadi.fmin(highest, casadi.fmax(lowest, u[limit.control]))


def _burn(equations: SceneEquations, x: Scalars, u: list[Scalar]) -> None:
    """Keep the thrusters within what is left in the tank: the last of it is shared in proportion."""
    (left,) = equations.field.motion(equations.y(x)).propellant
    jets, part = equations.tree.jets, equations.layout.control.thruster_force
    asked = burnt(jets, u[part]) * equations.scene.simulation.dt
    share = casadi.fmin(1.0, casadi.fmax(left, 0.0) / casadi.fmax(asked, _LEAST_BURN))
    u[part] = [share * force for force in u[part]]


def _drive(equations: SceneEquations, x: Scalars, u: list[Scalar]) -> None:
    """Keep the joints' motors within what their voltage leaves at their speed."""
    motion, first = equations.field.motion(equations.y(x)), equations.layout.control.joint_torque.start
    ranges = torque_ranges(equations, motion, u)
    for (index, _), (torque, least, greatest) in zip(limited_motors(equations.scene), ranges, strict=True):
        u[first + index] = casadi.fmin(greatest, casadi.fmax(least, torque))


def _wheel_torques(equations: SceneEquations, x: Scalars, torques: Scalars) -> list[Scalar]:
    """Torques held for a step that drive no wheel beyond its largest speed, and take no more than its power.

    A wheel beyond its largest speed, as the base turns under it, may be braked.
    """
    motion, dt = equations.field.motion(equations.y(x)), equations.scene.simulation.dt
    found = reaction_wheels.speeds(equations.tree.wheels, motion.wheel_momenta, motion.angular)
    result = []
    for wheel, speed, torque in zip(equations.scene.actuators.wheels or (), found, torques, strict=True):
        if math.isfinite(wheel.speed):
            # J (+-Omega_max - Omega) / h reaches the largest speed at the end of the step.
            to_top, to_bottom = (wheel.inertia / dt * (end - speed) for end in (wheel.speed, -wheel.speed))
            torque = casadi.fmin(casadi.fmax(to_top, 0.0), casadi.fmax(casadi.fmin(to_bottom, 0.0), torque))
        if math.isfinite(wheel.power):
            most = wheel.power / casadi.fmax(casadi.fabs(speed), _LEAST_SPEED)
            torque = casadi.fmin(most, casadi.fmax(-most, torque))
        result.append(torque)
    return result
