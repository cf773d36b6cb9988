"""Functions on states, compiled for one scene: derivatives of steps, costs and observations."""

from __future__ import annotations

from math import isfinite
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from dq_space_arm_env.kernels.constraint_kernels import ConstraintKernels
from dq_space_arm_env.kernels.library import matrices
from dq_space_arm_env.scene import INTEGRATORS
from dq_space_arm_env.task.step_report import n_observations

Array = NDArray[Any]


class DerivativeKernels(ConstraintKernels):
    """The derivatives of a scene's steps, costs and observations, see `Kernels`; exact to rounding."""

    def linearize(
        self,
        x: ArrayLike,
        u: ArrayLike,
        dt: float | None = None,
        integrator: str | None = None,
        p: ArrayLike | None = None,
    ) -> tuple[Array, Array]:
        """Exact derivatives of a step in tangent coordinates, lengths of substeps held: dx+ = A dx + B du.

        Args:
            x: States, shape (n_x,) or (B, n_x).
            u: Inputs, shape (n_u,) or (B, n_u).
            dt: Time step, s; the scene's by default.
            integrator: Name of the integrator; the scene's by default.
            p: Parameters, shape (n_p,) or (B, n_p), units of `parameters`; nominal ones by default.

        Returns:
            A, shape (n_t, n_t) or (B, n_t, n_t), and B, shape (n_t, n_u) or (B, n_t, n_u).

        Raises:
            ValueError: As for `step`.
        """
        a, b = self._step_call("linearize", x, u, dt, integrator, p)
        return matrices(a, self.n_t, self.n_t), matrices(b, self.n_t, self.n_u)

    def vjp(
        self,
        x: ArrayLike,
        u: ArrayLike,
        v: ArrayLike,
        dt: float | None = None,
        integrator: str | None = None,
        p: ArrayLike | None = None,
    ) -> tuple[Array, Array]:
        """Vector-Jacobian products of a step, v A and v B of `linearize`, in a third of its time or less.

        By reverse mode, but for methods that iterate: those are linearized and multiplied.

        Args:
            x: States, shape (n_x,) or (B, n_x).
            u: Inputs, shape (n_u,) or (B, n_u).
            v: Cotangents of the next state, one entry per tangent coordinate there, shape (n_t,) or (B, n_t).
            dt: Time step, s; the scene's by default.
            integrator: Name of the integrator; the scene's by default.
            p: Parameters, shape (n_p,) or (B, n_p), units of `parameters`; nominal ones by default.

        Returns:
            Cotangents of state and input, shapes (n_t,) and (n_u,), or (B, n_t) and (B, n_u), units of v's
            entries over those of `layout.tangent` and `layout.control`. Where v is a cost's gradient by the
            next state, these are its gradients by state and input.

        Raises:
            ValueError: As for `step`.
        """
        by_state, by_input = self._step_call("vjp", x, u, dt, integrator, p, v=v)
        return by_state, by_input

    def linearize_parameters(
        self,
        x: ArrayLike,
        u: ArrayLike,
        dt: float | None = None,
        integrator: str | None = None,
        p: ArrayLike | None = None,
    ) -> Array:
        """Exact derivative of a step by the parameters, in tangent coordinates: dx+ = P dp.

        Args:
            x: States, shape (n_x,) or (B, n_x).
            u: Inputs, shape (n_u,) or (B, n_u).
            dt: Time step, s; the scene's by default.
            integrator: Name of the integrator; the scene's by default.
            p: Parameters, shape (n_p,) or (B, n_p), units of `parameters`; nominal ones by default.

        Returns:
            P, shape (n_t, n_p) or (B, n_t, n_p).

        Raises:
            ValueError: As for `step`, or if the scene has no parameters.
        """
        by_parameters = self._step_call("linearize_parameters", x, u, dt, integrator, p)[0]
        return matrices(by_parameters, self.n_t, self.n_p)

    def cost_gradient(self, x: ArrayLike, u: ArrayLike, p: ArrayLike | None = None) -> tuple[Array, Array]:
        """Exact gradient of the stage cost by tangent state and input.

        Args:
            x: States, shape (n_x,) or (B, n_x).
            u: Inputs, shape (n_u,) or (B, n_u).
            p: Parameters, shape (n_p,) or (B, n_p), units of `parameters`; nominal ones by default.

        Returns:
            Gradients, shapes (n_t,) and (n_u,), or (B, n_t) and (B, n_u).
        """
        by_state, by_input = self.call("cost_vjp", x=x, u=u, v=np.ones(1), p=p)
        return by_state, by_input

    def terminal_cost_gradient(self, x: ArrayLike, p: ArrayLike | None = None) -> Array:
        """Exact gradient of the terminal cost by the tangent state.

        Args:
            x: States, shape (n_x,) or (B, n_x).
            p: Parameters, shape (n_p,) or (B, n_p), units of `parameters`; nominal ones by default.

        Returns:
            Gradients, shape (n_t,) or (B, n_t).
        """
        return self.call("emphasized_terminal_cost_vjp", x=x, emphasis=np.ones(1), v=np.ones(1), p=p)[0]

    def cost_by_parameters(self, x: ArrayLike, u: ArrayLike, p: ArrayLike | None = None) -> Array:
        """Exact gradient of the stage cost by the parameters.

        Args:
            x: States, shape (n_x,) or (B, n_x).
            u: Inputs, shape (n_u,) or (B, n_u).
            p: Parameters, shape (n_p,) or (B, n_p), units of `parameters`; nominal ones by default.

        Returns:
            Gradients, shape (n_p,) or (B, n_p).

        Raises:
            ValueError: If the scene has no parameters.
        """
        return self.call("cost_by_parameters", x=x, u=u, p=p)[0]

    def terminal_cost_by_parameters(self, x: ArrayLike, p: ArrayLike | None = None) -> Array:
        """Exact gradient of the terminal cost by the parameters.

        Args:
            x: States, shape (n_x,) or (B, n_x).
            p: Parameters, shape (n_p,) or (B, n_p), units of `parameters`; nominal ones by default.

        Returns:
            Gradients, shape (n_p,) or (B, n_p).

        Raises:
            ValueError: If the scene has no parameters.
        """
        return self.call("terminal_cost_by_parameters", x=x, p=p)[0]

    def observation_jacobian(self, x: ArrayLike, p: ArrayLike | None = None) -> Array:
        """Exact derivative of the observation in tangent coordinates, of observation(retract(x, z)) by z.

        Args:
            x: States, shape (n_x,) or (B, n_x).
            p: Parameters, shape (n_p,) or (B, n_p), units of `parameters`; nominal ones by default.

        Returns:
            Derivatives at z = 0, shape (n_obs, n_t) or (B, n_obs, n_t), units of the observation per unit of
            `layout.tangent`. The time left has no derivative: its row is zero.
        """
        jacobian = self.call("observation_jacobian", x=x, p=p)[0]
        return matrices(jacobian, n_observations(self.scene), self.n_t)

    def observation_vjp(self, x: ArrayLike, v: ArrayLike, p: ArrayLike | None = None) -> Array:
        """Vector-Jacobian product of the observation, v J of `observation_jacobian`.

        Args:
            x: States, shape (n_x,) or (B, n_x).
            v: Cotangents of the observation, shape (n_obs,) or (B, n_obs).
            p: Parameters, shape (n_p,) or (B, n_p), units of `parameters`; nominal ones by default.

        Returns:
            Cotangents of the state in tangent coordinates, shape (n_t,) or (B, n_t).
        """
        return self.call("observation_vjp", x=x, v=v, p=p)[0]

    def _step_call(
        self,
        name: str,
        x: ArrayLike,
        u: ArrayLike,
        dt: float | None,
        integrator: str | None,
        p: ArrayLike | None,
        **others: ArrayLike,
    ) -> tuple[Array, ...]:
        """Run a program of a step."""
        if integrator is not None:
            integrator = self._integrator(integrator)
        if dt is None:
            return self.call(name, integrator, x=x, u=u, p=p, **others)
        return self.call(name, integrator, x=x, u=u, h=self._time_step(dt), p=p, **others)

    def _integrator(self, name: str | None) -> str | None:
        if name is not None and not (isinstance(name, str) and name in INTEGRATORS):
            raise ValueError(f"integrator: {name!r} is unknown; choose from {', '.join(INTEGRATORS)}")
        return name

    def _time_step(self, dt: float | None) -> Array:
        step: Any = self.scene.simulation.dt if dt is None else dt
        is_number = isinstance(step, float | int | np.floating | np.integer) and not isinstance(step, bool)
        if not (is_number and isfinite(step)):
            raise ValueError(f"dt: {step!r} is not a finite time step in s")
        if step == 0 and any(chain.time_constant is not None for chain in self.layout.chains):
            raise ValueError(f"dt: {step!r}, should not be 0: actuators lag")
        return np.array([step], self.dtype)
