"""A scene as a shooting problem: its kernels, bounds, horizon and start under the names the solver uses."""

from collections.abc import Iterator
from contextlib import AbstractContextManager, contextmanager
from pathlib import Path
from typing import Any

import numpy as np

from dq_space_arm_env import Scene, compile_scene, load_scene
from dq_space_arm_env.kernels.bound import buffer_table, run_kernel
from dq_space_arm_env.scene import INTEGRATORS
from experts.problems.shooting_problem import FloatArray, Kernel, ShootingProblem, check_problem


class ArmProblem:
    """The maneuver of a scene in minimal coordinates, in double precision; implements `ShootingProblem`.

    Attributes:
        terminal_inputs: Emphasis on the pose in the terminal cost, shape (1,); see `emphasized`.
        has_second_order: Whether the registry of integrators names second derivatives for the scene's; the
            solver uses Gauss-Newton's model where there are none.
    """

    has_retraction = True

    def __init__(self, scene: Scene | str | Path, integrator: str | None = None) -> None:
        self.scene = in_double_precision(load_scene(scene), integrator)
        self.kernels = compile_scene(self.scene)
        self.has_second_order = INTEGRATORS[self.scene.simulation.integrator].curvature is not None
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
        """Multiply the weights of the tip's final pose inside a `with` block."""
        self._emphasis[0] = emphasis
        try:
            yield
        finally:
            self._emphasis[0] = 1.0

    def end_cost(self, state: FloatArray) -> float:
        """Terminal cost of a final state, shape (n_x,), with the current emphasis."""
        row, cost = np.ascontiguousarray(state, dtype=np.float64), np.zeros(1)
        buffers = buffer_table(row, *self.terminal_inputs, cost)
        run_kernel(self.kernel("terminal_cost").address, 0, 1, buffers)
        return float(cost[0])

    def misses(self, state: FloatArray) -> float:
        """Larger of the tip's attitude and position error at a final state, relative to its tolerance."""
        angle, distance = self.kernels.observation(state, [0.0])[1]
        success = self.scene.success
        return max(
            float(np.degrees(angle)) / success.attitude_error_deg, float(distance) / success.position_error
        )

    def is_success(self, state: FloatArray) -> bool:
        """Whether an episode that ends in a state is a success."""
        return self.misses(state) <= 1.0

    def kernel(self, name: str, *, batched: bool = False) -> Kernel:
        """Return a kernel of `ShootingProblem`."""
        name = "emphasized_terminal_cost" if name == "terminal_cost" else name
        integrator = None
        if name == "lagrangian_hessian":
            integrator = INTEGRATORS[self.scene.simulation.integrator].curvature
        return self.kernels.kernel(name, integrator=integrator, lanes=None if batched else 1)


def as_problem(scene_or_problem: Any) -> ShootingProblem:
    """Turn a scene into a problem, and check sizes and bounds; a problem passes unchanged."""
    is_problem = hasattr(scene_or_problem, "kernel")
    problem: ShootingProblem = scene_or_problem if is_problem else ArmProblem(scene_or_problem)
    check_problem(problem)
    return problem


def in_double_precision(scene: Scene, integrator: str | None = None) -> Scene:
    """Return the scene in double precision, which convergence needs, and with an integrator."""
    changes = {"precision": "float64", "integrator": integrator or scene.simulation.integrator}
    return scene.replace(simulation=changes)


_QUADRATIC = {"terminal_cost": "quadratic_cost", "terminal_cost_derivatives": "quadratic_cost_derivatives"}


class WindowProblem:
    """Some stages of a maneuver; implements `ShootingProblem`.

    The terminal cost of a window that ends before the maneuver is a quadratic model of the remaining cost.

    Attributes:
        ends_early: Whether the maneuver continues after the last stage.
        terminal_inputs: If it does, the quadratic model: its reference state, shape (1, n_x), gradient (1,
            n_t) and symmetric Hessian (1, n_t, n_t).
    """

    def __init__(self, maneuver: ArmProblem, horizon: int, model: tuple[FloatArray, ...] = ()) -> None:
        self.maneuver, self.horizon, self.ends_early = maneuver, horizon, bool(model)
        self.terminal_inputs = model or maneuver.terminal_inputs
        self.has_second_order = maneuver.has_second_order and not self.ends_early
        self.has_retraction = True
        self.n_states, self.n_tangent = maneuver.n_states, maneuver.n_tangent
        self.n_controls = maneuver.n_controls
        self.time_step = maneuver.time_step
        self.control_lower: FloatArray = maneuver.control_lower
        self.control_upper: FloatArray = maneuver.control_upper
        self.initial_state: FloatArray = maneuver.initial_state

    def kernel(self, name: str, *, batched: bool = False) -> Kernel:
        """Return a kernel of `ShootingProblem`."""
        name = _QUADRATIC.get(name, name) if self.ends_early else name
        return self.maneuver.kernel(name, batched=batched)

    def misses(self, state: FloatArray) -> float:
        """See `ArmProblem.misses`; 0 for a window after which the maneuver continues."""
        return 0.0 if self.ends_early else self.maneuver.misses(state)

    def emphasized(self, emphasis: float) -> AbstractContextManager[None]:
        """See `ArmProblem.emphasized`."""
        return self.maneuver.emphasized(emphasis)

    def end_cost(self, state: FloatArray) -> float:
        """See `ArmProblem.end_cost`."""
        return self.maneuver.end_cost(state)
