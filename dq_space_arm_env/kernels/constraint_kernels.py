"""Functions on states, compiled for one scene: residuals of its constraints and their derivatives."""

from __future__ import annotations

from typing import Any

from numpy.typing import ArrayLike, NDArray

from dq_space_arm_env.kernels.library import matrices
from dq_space_arm_env.kernels.robot_kernels import RobotKernels
from dq_space_arm_env.scene.constraint_rows import path_rows, terminal_rows

Array = NDArray[Any]


class ConstraintKernels(RobotKernels):
    """The functions of a scene's constraints, see `Kernels`."""

    def constraints(self, x: ArrayLike, u: ArrayLike, p: ArrayLike | None = None) -> Array:
        """Residuals c of the rows along the path, which hold where c <= 0.

        Args:
            x: States, shape (n_x,) or (B, n_x).
            u: Inputs, shape (n_u,) or (B, n_u).
            p: Parameters, shape (n_p,) or (B, n_p), units of `parameters`; nominal ones by default.

        Returns:
            One entry per row of `dq_space_arm_env.scene.path_rows(scene)`, which has names and units, shape
            (n_c,) or (B, n_c); without the margins that the expert keeps.
        """
        return self.call("constraints", x=x, u=u, p=p)[0]

    def terminal_constraints(self, x: ArrayLike, p: ArrayLike | None = None) -> Array:
        """Residuals of the rows at the end: those of the path without input, of success, and what is zero.

        Args:
            x: States, shape (n_x,) or (B, n_x).
            p: Parameters of the end, shape (n_p,) or (B, n_p), units of `parameters`; nominal by default.

        Returns:
            One entry per row of `dq_space_arm_env.scene.terminal_rows(scene)`, shape (n_g,) or (B, n_g).
            A tolerance t of success is (e^2 / t - t) / 2 of an error e.
        """
        return self.call("terminal_constraints", x=x, p=p)[0]

    def constraint_jacobian(self, x: ArrayLike, u: ArrayLike, p: ArrayLike | None = None) -> Array:
        """Derivatives of `constraints` by tangent state and input.

        Args:
            x: States, shape (n_x,) or (B, n_x).
            u: Inputs, shape (n_u,) or (B, n_u).
            p: Parameters, shape (n_p,) or (B, n_p), units of `parameters`; nominal ones by default.

        Returns:
            Matrices, shape (n_c, n_t + n_u) or (B, n_c, n_t + n_u).
        """
        entries = self.call("constraint_jacobian", x=x, u=u, p=p)[0]
        return matrices(entries, len(path_rows(self.scene)), self.n_t + self.n_u)

    def terminal_constraint_jacobian(self, x: ArrayLike, p: ArrayLike | None = None) -> Array:
        """Derivatives of `terminal_constraints` by the tangent state.

        Args:
            x: States, shape (n_x,) or (B, n_x).
            p: Parameters of the end, shape (n_p,) or (B, n_p), units of `parameters`; nominal by default.

        Returns:
            Matrices, shape (n_g, n_t) or (B, n_g, n_t).
        """
        entries = self.call("terminal_constraint_jacobian", x=x, p=p)[0]
        return matrices(entries, len(terminal_rows(self.scene)), self.n_t)
