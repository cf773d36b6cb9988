"""Forward dynamics, by a formulation to be chosen: accelerations that come of all that acts on the robot."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, Protocol

from dq_space_arm_env.algebra.vectors import subtract
from dq_space_arm_env.dynamics.articulated_body import ArticulatedBodies
from dq_space_arm_env.dynamics.chain import Chain
from dq_space_arm_env.dynamics.mass_matrix import MassMatrix
from dq_space_arm_env.dynamics.minimal import ZERO, Accelerations, body_wrenches

Scalar = Any
Vector3 = Sequence[Scalar]
Wrench = tuple[Vector3, Vector3]


class Inertia(Protocol):
    """How the robot, at given joint angles and without velocities, responds to forces."""

    def accelerations(self, wrenches: Sequence[Wrench], joints: Sequence[Scalar]) -> Accelerations:
        """Accelerations that wrenches on the bodies and torques in the joints produce.

        Args:
            wrenches: Force [N] and torque [N m] on base and links about the origins of their frames, in their
                axes, n + 1 pairs.
            joints: Joint torques, n, N m.

        Returns:
            The accelerations, without any velocity-dependent term.
        """
        ...

    def solve(self, force: Vector3, torque: Vector3, joints: Sequence[Scalar]) -> Accelerations:
        """Accelerations that generalized forces produce.

        Args:
            force: Force on the base, base axes, 3, N.
            torque: Torque on the base about its center of mass, 3, N m.
            joints: Joint torques, n, N m.

        Returns:
            The accelerations, without any velocity-dependent term.
        """
        ...


def inertia_of(
    formulation: str, chain: Chain, rotations: Sequence[Sequence[Vector3]], *, many: bool = False
) -> Inertia:
    """Inertia of the robot by a formulation.

    Args:
        formulation: Its name in the scene file: `articulated_body` or `minimal_coordinates`.
        chain: The robot.
        rotations: From `minimal.joint_rotations`.
        many: Whether there are many right-hand sides, as there are for derivatives.

    Returns:
        The inertia.

    Raises:
        ValueError: If there is no such formulation.
    """
    if formulation == "minimal_coordinates":
        return MassMatrix(chain, rotations)
    if formulation != "articulated_body":
        raise ValueError(
            f"formulation: {formulation!r} is unknown; it must be articulated_body or minimal_coordinates"
        )
    root = chain.heaviest
    if root == 0 and chain.links and (chain.planar or not many):
        # The first link is as good a root, and a faster one but for many right-hand sides in space.
        root = 1
    return ArticulatedBodies(chain, rotations, root)


def forward_dynamics(
    chain: Chain,
    inertia: Inertia,
    rotations: Sequence[Sequence[Vector3]],
    angular_velocity: Vector3,
    joint_rates: Sequence[Scalar],
    acting: Sequence[Wrench],
    joints: Sequence[Scalar],
) -> Accelerations:
    """Accelerations of a motion.

    The wrenches that the motion needs without any acceleration are taken off those that act, body by body:
    added up over the chain, what acts on a light body would drown in what a heavy one needs.

    Args:
        chain: The robot.
        inertia: From `inertia_of`, at the same joint angles.
        rotations: From `minimal.joint_rotations`.
        angular_velocity: Angular velocity of the base, base axes, 3, rad/s.
        joint_rates: Joint rates, n, rad/s.
        acting: Force [N] and torque [N m] from outside on base and links about the origins of their frames,
            in their axes, n + 1 pairs.
        joints: Torques of motors, springs and dampers, n, N m.

    Returns:
        The accelerations.
    """
    rest = Accelerations(ZERO, ZERO, [0.0] * len(chain.links))
    needed = body_wrenches(chain, rotations, angular_velocity, joint_rates, rest)
    left = [(subtract(a[0], b[0]), subtract(a[1], b[1])) for a, b in zip(acting, needed, strict=True)]
    return inertia.accelerations(left, joints)
