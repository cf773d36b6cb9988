"""Functions on states, compiled for one scene: dynamics, poses, Jacobians and momentum of its robot."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from dq_space_arm_env.kernels.library import KernelLibrary, matrices

Array = NDArray[Any]


class RobotKernels(KernelLibrary):
    """The functions of a scene's robot, see `Kernels`."""

    def forward_dynamics(
        self, x: ArrayLike, u: ArrayLike, w_tip: ArrayLike | None = None, p: ArrayLike | None = None
    ) -> Array:
        """Accelerations, those of eq. (20), by the scene's formulation.

        Args:
            x: States, shape (n_x,) or (B, n_x).
            u: Inputs, shape (n_u,) or (B, n_u).
            w_tip: Force [N], then torque [N m] at the tip in tip axes (16), shape (6,) or (B, 6); the scene's
                by default.
            p: Parameters, shape (n_p,) or (B, n_p), units of `parameters`; nominal ones by default.

        Returns:
            Dual acceleration of the base in base axes, angular [rad/s^2] then linear [m/s^2], then joint
            accelerations [rad/s^2], shape (6 + n,) or (B, 6 + n); (3 + n) for a planar base.
        """
        if w_tip is None:
            return self.call("forward_dynamics", x=x, u=u, p=p)[0]
        return self.call("forward_dynamics_with_tip_wrench", x=x, u=u, w_tip=w_tip, p=p)[0]

    def reaction_wrenches(self, x: ArrayLike, u: ArrayLike, p: ArrayLike | None = None) -> Array:
        """The paper's T (21): wrenches of body i on body i+1, in joint axes about the joint origin.

        Articulated bodies give them whatever the scene's formulation, to rounding even where the base has
        1e-12 or 1e12 times the mass of the arm.

        Args:
            x: States, shape (n_x,) or (B, n_x).
            u: Inputs, shape (n_u,) or (B, n_u).
            p: Parameters, shape (n_p,) or (B, n_p), units of `parameters`; nominal ones by default.

        Returns:
            fx, fy, fz [N], tx, ty [N m] joint by joint, of prismatic joints fx, fy [N], tx, ty, tz [N m], of
            spherical ones fx, fy, fz, of fixed ones nothing; shape (5 n,) or (B, 5 n) where all move by one
            coordinate.
        """
        return self.call("reaction_wrenches", x=x, u=u, p=p)[0]

    def mass_matrix(self, x: ArrayLike, p: ArrayLike | None = None) -> Array:
        """Mass matrix M in minimal coordinates: M a + h = f, with h from `bias_forces`.

        The accelerations a are those of `forward_dynamics`: base angular [rad/s^2], base linear [m/s^2], both
        in base axes, then joints [rad/s^2]. The generalized forces f are dual to them: torque on the base
        about its origin [N m], force [N], both in base axes, then joint torques [N m]. Inputs u have the
        base's force before its torque.

        Args:
            x: States, shape (n_x,) or (B, n_x); only joint angles, and propellant, matter.
            p: Parameters, shape (n_p,) or (B, n_p), units of `parameters`; nominal ones by default.

        Returns:
            Symmetric matrices, shape (6 + n, 6 + n) or (B, 6 + n, 6 + n), (3 + n) for a planar base; kg m^2
            where torque meets rotation, kg m where it meets translation, kg where force does.
        """
        return matrices(self.call("mass_matrix", x=x, p=p)[0], self._n_velocities, self._n_velocities)

    def bias_forces(self, x: ArrayLike, p: ArrayLike | None = None) -> Array:
        """Bias h of M a + h = f: velocity-dependent forces, joint springs and dampers.

        Args:
            x: States, shape (n_x,) or (B, n_x).
            p: Parameters, shape (n_p,) or (B, n_p), units of `parameters`; nominal ones by default.

        Returns:
            Generalized forces in the order of `mass_matrix`, torque [N m] and force [N] on the base, base
            axes, then joint torques [N m], shape (6 + n,) or (B, 6 + n); (3 + n) for a planar base. They hold
            the accelerations of `forward_dynamics` at zero; for a base alone that is a force m omega x v,
            since its velocity has components in turning axes. The scene's wrench at the tip is not included.
        """
        return self.call("bias_forces", x=x, p=p)[0]

    def tip_jacobian(self, x: ArrayLike, p: ArrayLike | None = None) -> Array:
        """Body Jacobian J of the tip: its twist is J (base velocity, joint rates, wrist's Euler rates).

        A wrench at the tip in tip axes, torque then force, adds J' times itself to the generalized forces of
        `mass_matrix` (the columns before the wrist's).

        Args:
            x: States, shape (n_x,) or (B, n_x); only the angles matter.
            p: Parameters, shape (n_p,) or (B, n_p), units of `parameters`; nominal ones by default.

        Returns:
            Twists in tip axes, angular [rad/s] then linear [m/s], per unit of the base's angular [rad/s] and
            linear velocity [m/s] in base axes, of each joint rate and of each Euler rate psi, theta, phi
            [rad/s], if there is a wrist; shape (6, 6 + n + 3) or (B, 6, 6 + n + 3). A planar base has 3
            columns: omega_z, v_x, v_y.
        """
        return matrices(self.call("tip_jacobian", x=x, p=p)[0], 6, self._n_velocities + self._n_wrist)

    def generalized_jacobian(self, x: ArrayLike, p: ArrayLike | None = None) -> Array:
        """Generalized Jacobian of the free-floating arm, J_m - J_b H_b^-1 H_bm.

        It maps rates of joints and wrist to the tip's twist where the total momentum is zero (Umetani &
        Yoshida, IEEE Transactions on Robotics and Automation 5, 1989).

        Args:
            x: States, shape (n_x,) or (B, n_x); only the angles matter.
            p: Parameters, shape (n_p,) or (B, n_p), units of `parameters`; nominal ones by default.

        Returns:
            Twists in tip axes, angular [rad/s] then linear [m/s], per unit of each joint rate and of each
            Euler rate psi, theta, phi [rad/s], if there is a wrist; shape (6, n + 3) or (B, 6, n + 3).
        """
        columns = self.layout.n_joints + self._n_wrist
        return matrices(self.call("generalized_jacobian", x=x, p=p)[0], 6, columns)

    def tip_twist(self, x: ArrayLike, u: ArrayLike | None = None, p: ArrayLike | None = None) -> Array:
        """Twist of the tip with respect to the inertial frame, in tip axes.

        Args:
            x: States, shape (n_x,) or (B, n_x).
            u: Inputs, shape (n_u,) or (B, n_u), zero by default; only the wrist's Euler rates matter.
            p: Parameters, shape (n_p,) or (B, n_p), units of `parameters`; nominal ones by default.

        Returns:
            Angular velocity [rad/s], then linear velocity [m/s], shape (6,) or (B, 6).
        """
        u = np.zeros(self.n_u, self.dtype) if u is None else u
        return self.call("tip_twist", x=x, u=u, p=p)[0]

    def tip_pose(self, x: ArrayLike, p: ArrayLike | None = None) -> Array:
        """Pose of the tip q_{G/I}, eq. (27).

        Args:
            x: States, shape (n_x,) or (B, n_x).
            p: Parameters, shape (n_p,) or (B, n_p), units of `parameters`; nominal ones by default.

        Returns:
            Unit dual quaternions, shape (8,) or (B, 8), real part dimensionless, dual part m.
        """
        return self.call("tip_pose", x=x, p=p)[0]

    def tip_poses(self, x: ArrayLike, p: ArrayLike | None = None) -> Array:
        """Poses of the tips of all arms in the inertial frame, q_{G/I} last.

        Args:
            x: States, shape (n_x,) or (B, n_x).
            p: Parameters, shape (n_p,) or (B, n_p), units of `parameters`; nominal ones by default.

        Returns:
            Unit dual quaternions, shape (tips, 8) or (B, tips, 8), real part dimensionless, dual part m.
        """
        if not self.scene.other_tips:
            return self.tip_pose(x, p)[..., None, :]
        first = 1 + len(self.scene.links)
        return self.frame_poses(x, p)[..., [*range(first, first + len(self.scene.other_tips)), -1], :]

    def frame_poses(self, x: ArrayLike, p: ArrayLike | None = None) -> Array:
        """Poses of base, joint frames, other tips, wrist frame (if any) and tip in the inertial frame.

        Args:
            x: States, shape (n_x,) or (B, n_x).
            p: Parameters, shape (n_p,) or (B, n_p), units of `parameters`; nominal ones by default.

        Returns:
            Unit dual quaternions, shape (frames, 8) or (B, frames, 8), real part dimensionless, dual part m.
        """
        poses = self.call("frame_poses", x=x, p=p)[0]
        return poses.reshape(*poses.shape[:-1], -1, 8)

    def momentum(self, x: ArrayLike, p: ArrayLike | None = None) -> Array:
        """Momentum of the whole system in inertial axes.

        Args:
            x: States, shape (n_x,) or (B, n_x).
            p: Parameters, shape (n_p,) or (B, n_p), units of `parameters`; nominal ones by default.

        Returns:
            Linear momentum [kg m/s], then angular momentum about the system's center of mass [kg m^2/s],
            shape (6,) or (B, 6).
        """
        return self.call("momentum", x=x, p=p)[0]

    def energy(self, x: ArrayLike, p: ArrayLike | None = None) -> Any:
        """Kinetic energy and the potential energy of joint springs.

        Args:
            x: States, shape (n_x,) or (B, n_x).
            p: Parameters, shape (n_p,) or (B, n_p), units of `parameters`; nominal ones by default.

        Returns:
            Energy, J, a number or shape (B,).
        """
        return self.call("energy", x=x, p=p)[0][..., 0]

    @property
    def _n_velocities(self) -> int:
        """Number of generalized velocities: base and joints."""
        return self.layout.n_joints + (3 if self.layout.planar else 6)

    @property
    def _n_wrist(self) -> int:
        """Number of the wrist's Euler rates."""
        return 3 if self.layout.has_wrist else 0
