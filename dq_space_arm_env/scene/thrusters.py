"""Thrusters of a scene, one by one, and their tank; allocation of forces and torques to them."""

import math
from collections.abc import Iterator, Mapping
from typing import Annotated, Any, ClassVar

import numpy as np
from numpy.typing import ArrayLike, NDArray
from pydantic import BeforeValidator, Field

from dq_space_arm_env.common.real_arrays import real_array
from dq_space_arm_env.scene.constraints import Direction
from dq_space_arm_env.scene.integrator_registry import INTEGRATORS
from dq_space_arm_env.scene.parameters import control_numbers, thruster_names
from dq_space_arm_env.validation.fields import Limit, Name, Position, Positive, Three
from dq_space_arm_env.validation.problems import Model, Problem, problem

Scene = Any  # `schema.Scene`
Array = NDArray[np.float64]

STANDARD_GRAVITY = 9.80665
"""Acceleration by which specific impulse is given in seconds, m/s^2."""


class Thruster(Model):
    """A thruster fixed to the base, which only pushes: its gas leaves against its force."""

    _other_words: ClassVar[Mapping[str, str]] = {"limit": "force"}

    name: Name | None = Field(default=None, description="name of the thruster; absent: its number")
    position: Position = Field(description="where the force acts, in the base frame, m")
    direction: Direction = Field(
        description="direction of the force on the base, base axes, of any length but zero"
    )
    force: Limit = Field(description="largest force, N; .inf: unlimited")
    minimum_impulse: Positive | None = Field(
        default=None,
        description="impulse of the shortest pulse, N s: a step with less does not fire; absent: any",
    )
    minimum_on_time: Positive | None = Field(
        default=None,
        description="the same as the time of the largest force, s; absent: any",
    )
    specific_impulse: Positive | None = Field(
        default=None, description="impulse per weight of fuel, s; absent: fuel is not counted"
    )

    @property
    def unit_direction(self) -> Three:
        """The direction as a unit vector."""
        length = math.hypot(*self.direction)
        x, y, z = (entry / length for entry in self.direction)
        return x, y, z

    @property
    def moment(self) -> Three:
        """Torque about the base's center of mass per unit of force, m."""
        (a, b, c), (x, y, z) = self.position, self.unit_direction
        return b * z - c * y, c * x - a * z, a * y - b * x

    @property
    def mass_flow(self) -> float:
        """Propellant that leaves per force and time, 1 / (I_sp g0), s/m; 0 where it is not counted."""
        return 0.0 if self.specific_impulse is None else 1.0 / (self.specific_impulse * STANDARD_GRAVITY)

    def impulse_bit(self, force: Any) -> Any:
        """Impulse of the shortest pulse, N s, of a thruster with a largest force, N; 0 for any."""
        if self.minimum_on_time is not None:
            return self.minimum_on_time * force
        return self.minimum_impulse or 0.0


def _read_thrusters(value: Any) -> Any:
    if not isinstance(value, list | tuple) or not value:
        raise problem("must be a list of thrusters: [{position, direction, force}, ...]")
    return value


Thrusters = Annotated[tuple[Thruster, ...], BeforeValidator(_read_thrusters)]


class Tank(Model):
    """A tank in the base that feeds all thrusters; the base gets lighter as they burn its propellant.

    The propellant is a point mass; mass, inertia and frame of the base are those without it.
    """

    propellant: Positive = Field(description="mass of the propellant at the start, kg")
    position: Position = Field(
        default=(0.0, 0.0, 0.0), description="where the propellant is, in the base frame, m"
    )


def tank_problems(scene: Scene) -> Iterator[Problem]:
    """Find a tank that feeds nothing or leaves the plane, thrusters that burn it at an unknown rate."""
    tank, here = scene.actuators.tank, ("actuators", "tank")
    if tank is None:
        return
    thrusters = scene.actuators.thrusters or ()
    if not thrusters:
        yield Problem(here, tank, "feeds nothing: remove it or add actuators.thrusters")
    for index, thruster in enumerate(thrusters):
        if thruster.specific_impulse is None:
            sentence = "must be given: the tank feeds this thruster"
            yield Problem(("actuators", "thrusters", index, "specific_impulse"), None, sentence)
    if scene.base.motion == "planar" and tank.position[2]:
        sentence = 'base.motion is "planar": the z component must be 0'
        yield Problem((*here, "position"), tank.position, sentence)
    if (refusal := burning_refusal(scene.simulation.integrator)) is not None:
        yield Problem(("simulation", "integrator"), scene.simulation.integrator, refusal)


def burning_refusal(integrator: str) -> str | None:
    """Say why a method cannot integrate a robot that burns propellant; None if it can."""
    if not INTEGRATORS[integrator].keeps_momentum:
        return None
    others = ", ".join(name for name, entry in INTEGRATORS.items() if not entry.keeps_momentum)
    return f"keeps the momentum, of which burnt propellant takes some along: with actuators.tank use {others}"


def thruster_problems(scene: Scene) -> Iterator[Problem]:
    """Find thrusters that contradict themselves or others, or leave the plane of a planar base."""
    names = thruster_names(scene)
    for index, thruster in enumerate(scene.actuators.thrusters or ()):
        here = ("actuators", "thrusters", index)
        if names[index] in names[:index]:
            yield Problem((*here, "name"), names[index], "another thruster has this name")
        most = thruster.force * scene.simulation.dt
        if thruster.impulse_bit(thruster.force) > (1.0 + 1e-12) * most:
            field = "minimum_impulse" if thruster.minimum_on_time is None else "minimum_on_time"
            sentence = f"never fires: with the largest force a time step has an impulse of {most:g} N s"
            yield Problem((*here, field), getattr(thruster, field), sentence)
        if thruster.minimum_on_time is not None:
            if thruster.minimum_impulse is not None:
                sentence = "must be absent: minimum_on_time says the same"
                yield Problem((*here, "minimum_impulse"), thruster.minimum_impulse, sentence)
            if math.isinf(thruster.force):
                sentence = "must be absent: the largest force is not finite"
                yield Problem((*here, "minimum_on_time"), thruster.minimum_on_time, sentence)
        if scene.base.motion == "planar":
            for field in ("position", "direction"):
                if (vector := getattr(thruster, field))[2]:
                    sentence = 'base.motion is "planar": the z component must be 0'
                    yield Problem((*here, field), vector, sentence)


def allocate(scene: Scene, force: ArrayLike, torque: ArrayLike) -> Array:
    """Find the forces of a scene's thrusters that give a net force and torque, by non-negative least squares.

    Where the largest forces do not suffice, all are reduced in proportion: the net force keeps its direction.

    Args:
        scene: The scene, with thrusters.
        force: On the base, base axes, shape (3,) or (B, 3), N.
        torque: About the base's center of mass, base axes, shape (3,) or (B, 3), N m.

    Returns:
        One force per thruster, shape (n,) or (B, n), N; the nearest net force and torque where no
        forces give the wanted ones.

    Raises:
        TypeError: If force or torque is masked, or not of real numbers.
        ValueError: If the scene has no thrusters, a shape is wrong, or a number is not finite.
    """
    thrusters = scene.actuators.thrusters
    if not thrusters:
        raise ValueError(f"scene {scene.name!r} has no thrusters to allocate forces to")
    parts = real_array("force", force, np.float64), real_array("torque", torque, np.float64)
    batches = {part.shape[:-1] for part in parts} - {()}
    if any(part.shape[-1:] != (3,) or part.ndim > 2 for part in parts) or len(batches) > 1:
        shapes = " and ".join(str(part.shape) for part in parts)
        raise ValueError(f"force, torque: shapes {shapes}, should be (3,) or (B, 3)")
    wanted = np.concatenate(np.broadcast_arrays(*parts), axis=-1)
    if not np.isfinite(wanted).all():
        raise ValueError(f"force, torque: {wanted}, should be finite")
    wrenches = np.array([[*each.unit_direction, *each.moment] for each in thrusters]).T
    forces = np.array([_non_negative(wrenches, each) for each in np.atleast_2d(wanted)])
    forces = forces.reshape(-1, len(thrusters))
    share = np.array([each.force for each in thrusters]) / np.maximum(forces, 1e-300)
    forces *= np.minimum(share.min(axis=1, keepdims=True), 1.0)
    return forces[0] if wanted.ndim == 1 else forces


def _non_negative(matrix: Array, wanted: Array) -> Array:
    """Least squares with x >= 0 (Lawson & Hanson, Solving Least Squares Problems, 1974, chapter 23)."""
    count = matrix.shape[1]
    x, active = np.zeros(count), np.zeros(count, bool)
    tolerance = 1e-13 * float(np.linalg.norm(wanted))
    for _ in range(10 * count):
        slope = np.where(active, -np.inf, matrix.T @ (wanted - matrix @ x))
        if active.all() or slope.max() <= tolerance:
            break
        active[slope.argmax()] = True
        while True:
            found = np.zeros(count)
            found[active] = np.linalg.lstsq(matrix[:, active], wanted, rcond=None)[0]
            below = active & (found <= 0.0)
            if not below.any():
                x = found
                break
            # As far as all stay positive; those that reach zero leave.
            x = x + np.min(x[below] / (x[below] - found[below])) * (found - x)
            active &= x > 1e-15 * max(float(x.max()), 1e-300)
            x[~active] = 0.0
    return x


def fuel_used(scene: Scene, controls: ArrayLike) -> float:
    """Fuel that the thrusters of a maneuver burn: sum f dt / (I_sp g0) over those with a specific impulse.

    The masses of a scene change by it where `actuators.tank` feeds the thrusters.

    Args:
        scene: The scene, with thrusters.
        controls: Inputs of the stages, shape (N, n_u), of which the last are the thrusters' forces, N.

    Returns:
        The fuel, kg.

    Raises:
        TypeError: If the controls are masked, or not of real numbers.
        ValueError: If the controls have a wrong shape, or a thruster a force below 0.
    """
    thrusters, given = scene.actuators.thrusters or (), real_array("controls", controls, np.float64)
    n_u = sum(map(len, control_numbers(scene).values()))
    if given.ndim != 2 or given.shape[1] != n_u:
        raise ValueError(f"controls: shape {given.shape}, should be (N, {n_u})")
    jets = given[:, n_u - len(thrusters) :]
    if (least := jets.min(initial=0.0)) < -1e-9:
        raise ValueError(f"controls: {least:g} N for a thruster, should be 0 or greater")
    used, forces = 0.0, jets.sum(axis=0)
    for each, total in zip(thrusters, forces, strict=True):
        used += float(total) * scene.simulation.dt * each.mass_flow
    return used
