"""Functions on states, compiled for one scene: steps, derivatives, cost, observation, coordinates.

`compile_scene` returns the `Kernels` of a scene. Each function is compiled at its first call and kept on
disk; the next process loads it without tracing, compiling or importing CasADi.
"""

from __future__ import annotations

from functools import cache
from itertools import pairwise
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from dq_space_arm_env.common.real_arrays import real_array
from dq_space_arm_env.kernels.bound import walk
from dq_space_arm_env.kernels.derivative_kernels import DerivativeKernels
from dq_space_arm_env.kernels.library import check_threads
from dq_space_arm_env.scene import INTEGRATORS, Scene, load_scene

if TYPE_CHECKING:
    from dq_space_arm_env.kernels.adaptive import IntegratedMotion

Array = NDArray[Any]


class Kernels(DerivativeKernels):
    """The compiled functions of a scene.

    What varies in the scene, by its spread or its list of `parameters`, is an argument p of every function
    that may depend on it; the rest are constants of the machine code.

    Every function takes one state (n_x,) or a batch (B, n_x), and returns results of the same form, arrays of
    the scene's precision. Batches run on vector instructions, several states at a time, and give the same
    bits as the states one by one. Every function raises ValueError, naming the argument, where shapes do not
    fit.

    Attributes:
        scene: The scene.
        threads: Most threads that a batch is shared among.
        dtype: Type of all results, and of the arithmetic: the scene's precision.
        layout: Names, units and places of the entries of states, tangent states and inputs.
        n_x: Number of states.
        n_t: Number of tangent coordinates.
        n_u: Number of inputs.
        n_p: Number of parameters.
    """

    def __reduce__(self) -> tuple[Any, ...]:
        return compile_scene, (self.scene, self.threads)

    def step(
        self,
        x: ArrayLike,
        u: ArrayLike,
        dt: float | None = None,
        integrator: str | None = None,
        p: ArrayLike | None = None,
    ) -> Array:
        """Advance states by one time step under constant inputs.

        Quaternions of x have unit length, but for what rounding changes, which a step corrects.

        Args:
            x: States, shape (n_x,) or (B, n_x), units of `layout.state`.
            u: Inputs, shape (n_u,) or (B, n_u), units of `layout.control`; not clipped to the limits.
            dt: Time step, s; the scene's by default.
            integrator: Name of the integrator; the scene's by default.
            p: Parameters, shape (n_p,) or (B, n_p), units of `parameters`; nominal ones by default.

        Returns:
            States, shape (n_x,) or (B, n_x).

        Raises:
            ValueError: If dt is not a finite number, or the integrator is unknown.
        """
        return self._step_call("step", x, u, dt, integrator, p)[0]

    def checked_step(
        self,
        x: ArrayLike,
        u: ArrayLike,
        dt: float | None = None,
        integrator: str | None = None,
        p: ArrayLike | None = None,
    ) -> tuple[Array, Array]:
        """Advance states by one time step as the environment does, and tell how accurate it is.

        The step of a method that takes fixed steps is divided where an embedded method says that it errs by
        more than `simulation.tolerance`; elsewhere it is that of `step`, to the bit.

        Args:
            x: States, shape (n_x,) or (B, n_x), units of `layout.state`.
            u: Inputs, shape (n_u,) or (B, n_u), units of `layout.control`; not clipped to the limits.
            dt: Time step, s; the scene's by default.
            integrator: Name of an integrator with an estimate of its error; the scene's by default.
            p: Parameters, shape (n_p,) or (B, n_p), units of `parameters`; nominal ones by default.

        Returns:
            States, shape (n_x,) or (B, n_x), and the largest estimated error of a substep in units of the
            tolerance, shape () or (B,): above 1 where `rodas4` and `rodas5p` have tried their most substeps,
            and NaN with the state where no accurate or finite state was found.

        Raises:
            ValueError: If dt is not a finite number, or the integrator is unknown or estimates no error, as
                where `simulation.tolerance` is off.
        """
        simulation = self.scene.simulation
        name = self._integrator(integrator) or simulation.integrator
        if not simulation.estimates_error(name):
            known = ", ".join(filter(simulation.estimates_error, INTEGRATORS))
            raise ValueError(f"integrator: {name!r} estimates no error; choose from {known}")
        x_next, error = self._step_call("checked_step", x, u, dt, integrator, p)
        return x_next, error[..., 0]

    def numerical_error(self, states: ArrayLike, u: ArrayLike, p: ArrayLike | None = None) -> Array:
        """Tell how far the tips of a simulated motion are from where the same inputs truly bring them.

        A companion follows the motion from its first state in double precision, by another method: by `rk8`,
        or by `rk6` in place of `rk8`, and `rodas4` and `rodas5p` in place of each other. It divides steps by
        a hundredth of the scene's tolerance (1e-8 at most), and errors below that are hidden by its own.
        Where the motion is chaotic the two part, however accurate the single steps are.

        Args:
            states: States at the ends of time steps, the start first, shape (N + 1, n_x) or (N + 1, B, n_x).
            u: Inputs held during the steps, shape (N, n_u) or (N, B, n_u), units of `layout.control`; of a
                flight in the environment what acted, see `applied_inputs`. A catch is taken to hold.
            p: Parameters, shape (n_p,), or (B, n_p) of B motions, units of `parameters`; nominal ones by
                default.

        Returns:
            Distance [m] or angle [rad] between the tips of both, the largest, shape (N + 1,) or (N + 1, B);
            NaN where one of the two is not finite.

        Raises:
            ValueError: If the shapes do not fit, or there are more steps than the scene's phases have.
        """
        from dq_space_arm_env.kernels.numerical_error import companion, numerical_error

        return numerical_error(compile_scene(companion(self.scene)), states, u, p)

    def simulate(
        self,
        x: ArrayLike,
        u: ArrayLike,
        steps: int,
        dt: float | None = None,
        integrator: str | None = None,
        every: int = 1,
        p: ArrayLike | None = None,
    ) -> Array:
        """Take many steps in a row without returning to Python.

        The results are those of repeated calls of `step`, except for integrators that conserve the momentum:
        they hand it on from step to step besides the state, so it does not wander with the rounding errors of
        the states, where masses stay and actuators follow at once. `gauss6` also hands on what rounding cuts
        off the joint angles.

        Args:
            x: State at the start, shape (n_x,), units of `layout.state`.
            u: Inputs, shape (n_u,) for constant ones, or (steps, n_u); not clipped to the limits.
            steps: Number of steps.
            dt: Time step, s; the scene's by default.
            integrator: Name of the integrator; the scene's by default.
            every: Number of steps between the states returned.
            p: Parameters, shape (n_p,) for constant ones, or (steps, n_p), units of `parameters`; nominal
                ones by default.

        Returns:
            States, the start first, shape (steps // every + 1, n_x).

        Raises:
            ValueError: If steps or every is no positive whole number, dt is not a finite number, or the
                integrator is unknown.
        """
        for name, count in (("steps", steps), ("every", every)):
            if isinstance(count, bool) or not isinstance(count, int | np.integer) or count < 1:
                raise ValueError(f"{name}: {count!r}, should be a whole number of at least 1")
        start, inputs = real_array("x", x, self.dtype), real_array("u", u, self.dtype)
        if start.shape != (self.n_x,) or inputs.shape not in ((self.n_u,), (steps, self.n_u)):
            raise ValueError(
                f"x: shape {start.shape}, u: shape {inputs.shape}, should be ({self.n_x},), and "
                f"({self.n_u},) or ({steps}, {self.n_u})"
            )
        kernel = self.kernel("walk", integrator=self._integrator(integrator), lanes=1)
        given = self.parameter_rows(p, steps)
        sizes = {spec.name: spec.stride for spec in kernel.inputs}
        held = {"u": np.broadcast_to(inputs, (steps, self.n_u)), "parameters": given}
        if "momentum" in sizes and (changes := self._changes_of_mass(given)):
            # From there on the momentum is that of other bodies.
            parts = [start[None]]
            for begin, end in pairwise((0, *changes, steps)):
                x, own = parts[-1][-1], slice(begin, end)
                parts.append(self.simulate(x, held["u"][own], end - begin, dt, integrator, p=given[own])[1:])
            return np.concatenate(parts)[::every]
        handed_on = {"momentum": self.momentum(start, p=given[0])} if "momentum" in sizes else {}
        if "remainder" in sizes:
            handed_on["remainder"] = np.zeros(sizes["remainder"], self.dtype)
        return walk(kernel, start, handed_on, held, steps, self._time_step(dt), every)

    def _changes_of_mass(self, parameters: Array) -> list[int]:
        """Rows whose masses or inertias are not those of the row before."""
        names = self.parameters.names
        masses = [i for i, name in enumerate(names) if "mass" in name or "inertia" in name]
        changed = np.diff(parameters[:, masses], axis=0).any(axis=1)
        return (1 + np.flatnonzero(changed)).tolist()

    def integrate(
        self,
        x: ArrayLike,
        u: ArrayLike,
        duration: float,
        *,
        rtol: float | None = None,
        atol: float | None = None,
        times: ArrayLike | None = None,
        max_steps: int = 100_000,
        p: ArrayLike | None = None,
    ) -> IntegratedMotion:
        """Integrate one state over any time with adaptive steps and dense output.

        Args:
            x: State at time 0, shape (n_x,), units of `layout.state`.
            u: Input, shape (n_u,), or inputs held for equal parts of the duration, shape (N, n_u); not
                clipped to the limits.
            duration: Time to integrate over, s; backward in time if negative.
            rtol: Relative error tolerated in a step: of velocities; of pose and angles in rad and m, which
                have no natural zero. The scene's, or 1e-8, by default (1e-5 in single precision).
            atol: Absolute error tolerated in addition, rad, m, rad/s, m/s. The scene's, or 1e-10, by default
                (1e-6 in single precision).
            times: Times to return states at, shape (k,), s; the ends of the steps by default.
            max_steps: Most steps to try.
            p: Parameters, shape (n_p,), or (N, n_p) for the parts of the duration, units of `parameters`;
                nominal ones by default.

        Returns:
            Times, states, numbers of steps, and the state at any time between as a function.

        Raises:
            ValueError: If an argument is not finite or out of range, a control of the scene delays or lags,
                or parameters say that a payload is caught.
            RuntimeError: If the motion cannot be followed to its end within the tolerances or max_steps.
        """
        from dq_space_arm_env.kernels.adaptive import integrate

        default = self.scene.simulation.tolerance_of
        return integrate(
            self,
            x,
            u,
            duration,
            rtol=default("rtol") if rtol is None else rtol,
            atol=default("atol") if atol is None else atol,
            times=times,
            max_steps=max_steps,
            p=p,
        )

    def cost(self, x: ArrayLike, u: ArrayLike, p: ArrayLike | None = None) -> Any:
        """Stage cost of the paper (section V), without a factor dt.

        Args:
            x: States, shape (n_x,) or (B, n_x).
            u: Inputs, shape (n_u,) or (B, n_u).
            p: Parameters, shape (n_p,) or (B, n_p), units of `parameters`; nominal ones by default.

        Returns:
            Cost, dimensionless, a number or shape (B,).
        """
        return self.call("cost", x=x, u=u, p=p)[0][..., 0]

    def terminal_cost(self, x: ArrayLike, p: ArrayLike | None = None) -> Any:
        """Terminal cost of the paper (section V).

        Args:
            x: States, shape (n_x,) or (B, n_x).
            p: Parameters, shape (n_p,) or (B, n_p), units of `parameters`; nominal ones by default.

        Returns:
            Cost, dimensionless, a number or shape (B,).
        """
        return self.call("terminal_cost", x=x, p=p)[0][..., 0]

    def difference(self, x_reference: ArrayLike, x: ArrayLike) -> Array:
        """Tangent coordinates of x seen from a reference: the inverse of `retract`.

        Args:
            x_reference: States, shape (n_x,) or (B, n_x).
            x: States, shape (n_x,) or (B, n_x).

        Returns:
            Tangent states, shape (n_t,) or (B, n_t), units of `layout.tangent`.
        """
        return self.call("difference", x_reference=x_reference, x=x)[0]

    def retract(self, x: ArrayLike, dx: ArrayLike) -> Array:
        """Move a state along tangent coordinates; the base pose moves by q exp(dx / 2).

        All other entries are added to, also a spherical joint's quaternion: divide it by its length then.

        Args:
            x: States, shape (n_x,) or (B, n_x).
            dx: Tangent states, shape (n_t,) or (B, n_t).

        Returns:
            States, shape (n_x,) or (B, n_x).
        """
        return self.call("retract", x=x, dx=dx)[0]

    def observation(
        self, x: ArrayLike, time_left: ArrayLike, p: ArrayLike | None = None
    ) -> tuple[Array, Array]:
        """Observation of a state, and the tip's errors.

        Args:
            x: States, shape (n_x,) or (B, n_x).
            time_left: Time to the end of the episode, shape (1,) or (B, 1), s.
            p: Parameters, shape (n_p,) or (B, n_p), units of `parameters`; nominal ones by default.

        Returns:
            Observation, entries as documented in `DQSpaceArmEnv`, and (attitude error [rad], position error
            [m]), shape (2,) or (B, 2).
        """
        observation, errors = self.call("observation", x=x, time_left=time_left, p=p)
        return observation, errors

    def applied_inputs(self, x: ArrayLike, u: ArrayLike, p: ArrayLike | None = None) -> Array:
        """Inputs as the actuators apply them in the environment, which `step` takes as they are.

        Args:
            x: States, shape (n_x,) or (B, n_x).
            u: Inputs within their limits, shape (n_u,) or (B, n_u).
            p: Parameters of the stage, shape (n_p,) or (B, n_p), units of `parameters`; nominal ones by
                default.

        Returns:
            Inputs that act, shape (n_u,) or (B, n_u): slew limits, back EMF, wheels' speed and power, the
            shortest pulses and what is left in the tank allow no more.
        """
        return self.call("applied_inputs", x=x, u=u, p=p)[0]

    def tip_errors(self, x: ArrayLike, p: ArrayLike | None = None) -> Array:
        """Errors that decide about success, of several tips the largest.

        Args:
            x: States, shape (n_x,) or (B, n_x).
            p: Parameters of the stage, shape (n_p,) or (B, n_p), units of `parameters`; nominal ones by
                default.

        Returns:
            Attitude error [deg] and position error [m], shape (2,) or (B, 2); where the target moves or
            success asks for it, angular velocity [deg/s] and velocity [m/s] relative to the target besides,
            with the wrist held, shape (4,) or (B, 4). In the order of `scene.success.tolerances`.
        """
        return self.call("tip_errors", x=x, p=p)[0]

    def relative_twist(self, x: ArrayLike, u: ArrayLike | None = None, p: ArrayLike | None = None) -> Array:
        """Twist of the tip relative to the target, which may move.

        Args:
            x: States, shape (n_x,) or (B, n_x).
            u: Inputs, shape (n_u,) or (B, n_u), whose wrist rates count; the wrist is held by default.
            p: Parameters of the stage, shape (n_p,) or (B, n_p), units of `parameters`; nominal ones by
                default.

        Returns:
            Twist w_{G/D} in tip axes, angular then linear, shape (6,) or (B, 6), rad/s and m/s.
        """
        inputs = np.zeros(self.n_u, self.dtype) if u is None else u
        return self.call("relative_twist", x=x, u=inputs, p=p)[0]

    def stage_parameters(self, p: ArrayLike | None = None) -> Array:
        """Parameters of each stage of an episode: those of a target that moves, and what phases change.

        Args:
            p: Parameters at the start, shape (n_p,), units of `parameters`; nominal ones by default.

        Returns:
            Parameters of the stages and of the end, shape (N + 1, n_p), units of `parameters`.

        Raises:
            ValueError: If the parameters have another shape.
        """
        steps = self.scene.simulation.steps
        first = self.parameter_rows(p, 1)[0]
        rows = np.tile(first, (steps + 1, 1))
        if self.parameters.moving or self.parameters.staged:
            from dq_space_arm_env.kernels.stages import fill_stages

            fill_stages(self, rows)
        return rows

    def state_from_observation(self, observation: ArrayLike, p: ArrayLike | None = None) -> Array:
        """The state behind an observation.

        Args:
            observation: Shape (n_obs,) or (B, n_obs), entries as documented in `DQSpaceArmEnv`; the error
                pose need not have exactly unit norm.
            p: Parameters, shape (n_p,) or (B, n_p), units of `parameters`; nominal ones by default.

        Returns:
            States, shape (n_x,) or (B, n_x), units of `layout.state`.
        """
        return self.call("state_from_observation", observation=observation, p=p)[0]


@cache
def _compiled(scene: Scene, threads: int) -> Kernels:
    return Kernels(scene, threads)


def compile_scene(scene: Scene | str | Path, threads: int = 1) -> Kernels:
    """Kernels of a scene; within a process, equal scenes share one object.

    Args:
        scene: A scene, the name of a shipped one, or a path to a YAML file.
        threads: Most threads that a batch is shared among. One is best unless batches are large and cores
            idle.

    Returns:
        The kernels. Each is compiled at its first use, or loaded from the disk cache.

    Raises:
        SceneError: If the scene cannot be loaded.
        ValueError: If the number of threads is not a whole one of at least 1.
    """
    check_threads(threads)  # kernels for 1 thread would be found for 1.0 and for True as well
    return _compiled(load_scene(scene), threads)
