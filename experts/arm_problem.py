"""A scene as a shooting problem: its kernels, bounds, horizon and start under the names the solver uses."""

from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import numpy as np

from dq_space_arm_env import Scene, compile_scene, load_scene
from dq_space_arm_env.scene import CURVED_INTEGRATORS
from experts.native_call import buffer_table, run_kernel
from experts.problem import FloatArray, Kernel
from experts.screw_motion import ScrewMotion, screw_motion

CURVATURE_OF = {
    **{name: name for name in CURVED_INTEGRATORS},
    "rk6": "rk4",
    "rk8": "rk4",
    "momentum_rk4": "rk4",
}
"""Whose second derivatives the solver takes with an integrator. Newton's method needs a few digits of them:
those of methods of order 4 and above differ by O(dt^5), while the gradients, which decide where the solver
ends, are always the method's own."""
SCREW_DURATION = 0.15
"""Share of the horizon that a guess by screw motion gives the tip: the cost asks for haste."""


class ArmProblem:
    """The maneuver of a scene in minimal coordinates, in double precision; implements `ShootingProblem`.

    Attributes:
        scene: The scene.
        kernels: Its compiled functions.
        terminal_inputs: The emphasis on the pose in the terminal cost, shape (1,); see `emphasized`.
        has_second_order: Whether there are second derivatives for its integrator, see `CURVATURE_OF`; the
            solver does with Gauss-Newton's model where there are none.
    """

    has_retraction = True

    def __init__(self, scene: Scene | str | Path, integrator: str | None = None) -> None:
        """Take a scene.

        Args:
            scene: A scene, the name of a shipped one, or a path to a YAML file.
            integrator: Name of the integrator; the scene's by default.

        Raises:
            SceneError: If the scene cannot be loaded.
            ValueError: If the integrator is unknown.
        """
        self.scene = in_double_precision(load_scene(scene), integrator)
        self.kernels = compile_scene(self.scene)
        self.has_second_order = self.scene.simulation.integrator in CURVATURE_OF
        layout = self.kernels.layout
        self.n_states, self.n_tangent, self.n_controls = layout.n_x, layout.n_t, layout.n_u
        self.horizon = self.scene.simulation.steps
        self.time_step = self.scene.simulation.dt
        self.control_lower: FloatArray = -layout.control_limit
        self.control_upper: FloatArray = layout.control_limit
        self.initial_state: FloatArray = layout.initial_state
        self._emphasis: FloatArray = np.ones(1)
        self.terminal_inputs: tuple[FloatArray, ...] = (self._emphasis,)

    @contextmanager
    def emphasized(self, emphasis: float) -> Iterator[None]:
        """Multiply the weights of the tip's final pose for what is solved inside a `with` block.

        Args:
            emphasis: The factor; 1 is the scene's own cost.
        """
        self._emphasis[0] = emphasis
        try:
            yield
        finally:
            self._emphasis[0] = 1.0

    def end_cost(self, state: FloatArray) -> float:
        """Terminal cost of a final state, with the emphasis of the moment.

        Args:
            state: Shape (n_x,), units of `kernels.layout.state`.

        Returns:
            The cost, dimensionless.
        """
        row, cost = np.ascontiguousarray(state, dtype=np.float64), np.zeros(1)
        buffers = buffer_table(row, *self.terminal_inputs, cost)
        run_kernel(self.kernel("terminal_cost").address, 0, 1, buffers)
        return float(cost[0])

    def misses(self, state: FloatArray) -> float:
        """Compare the tip's final errors with what counts as a success.

        Args:
            state: Final state, shape (n_x,), units of `kernels.layout.state`.

        Returns:
            The larger one of the attitude and the position error, each relative to its tolerance in the
            scene.
        """
        angle, distance = self.kernels.observation(state, [0.0])[1]
        success = self.scene.success
        return max(
            float(np.degrees(angle)) / success.attitude_error_deg, float(distance) / success.position_error
        )

    def is_success(self, state: FloatArray) -> bool:
        """Tell whether an episode that ends in a state counts as a success.

        Args:
            state: Final state, shape (n_x,), units of `kernels.layout.state`.

        Returns:
            Whether the tip's errors are within the scene's tolerances.
        """
        return self.misses(state) <= 1.0

    def screw_motion(self, x0: FloatArray) -> ScrewMotion:
        """Guess the maneuver from a start, from kinematics alone; see `experts.screw_motion`.

        Args:
            x0: State at stage 0, shape (n_x,), units of `kernels.layout.state`.

        Returns:
            The guess.

        Raises:
            ValueError: If x0 has the wrong shape or is not finite.
        """
        return screw_motion(self, x0, duration=SCREW_DURATION * self.horizon * self.time_step)

    def kernel(self, name: str, *, batched: bool = False) -> Kernel:
        """Return one of the kernels that `experts.problem` lists.

        Args:
            name: Name of the kernel.
            batched: Whether it will work on many rows at once: vector code; scalar code otherwise.

        Returns:
            The kernel, compiled or loaded from the cache.
        """
        name = "emphasized_terminal_cost" if name == "terminal_cost" else name
        integrator = None
        if name == "lagrangian_hessian":
            integrator = CURVATURE_OF[self.scene.simulation.integrator]
        return self.kernels.kernel(name, integrator=integrator, lanes=None if batched else 1)


def in_double_precision(scene: Scene, integrator: str | None = None) -> Scene:
    """A scene as the solver takes it: convergence needs the digits, whatever agents simulate in.

    Args:
        scene: The scene.
        integrator: Name of the integrator; the scene's by default.

    Returns:
        The scene with double precision and the integrator.

    Raises:
        ValueError: If the integrator is unknown.
    """
    changes = {"precision": "float64", "integrator": integrator or scene.simulation.integrator}
    return scene.replace(simulation={**scene.simulation.model_dump(), **changes})
