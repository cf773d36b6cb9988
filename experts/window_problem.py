"""A stretch of a scene's maneuver as a shooting problem: from any state, over as many stages as one likes."""

from contextlib import AbstractContextManager

from experts.arm_problem import ArmProblem
from experts.problem import FloatArray, Kernel

_QUADRATIC = {
    "terminal_cost": "quadratic_cost",
    "terminal_cost_derivatives": "quadratic_cost_derivatives",
}


class WindowProblem:
    """Some stages of a maneuver; implements `ShootingProblem` and `HasTolerances`.

    A window that ends before the maneuver does has a quadratic model of the remaining cost for its terminal
    cost.

    Attributes:
        maneuver: The whole maneuver.
        horizon: Number of stages.
        ends_early: Whether the maneuver goes on after the last stage.
        terminal_inputs: If it does, the quadratic model: the state around which it holds, shape (1, n_x), its
            gradient (1, n_t) and its symmetric Hessian (1, n_t, n_t).
    """

    def __init__(self, maneuver: ArmProblem, horizon: int, model: tuple[FloatArray, ...] = ()) -> None:
        """Take a stretch of a maneuver.

        Args:
            maneuver: The whole maneuver.
            horizon: Number of stages.
            model: `terminal_inputs` of a stretch after which the maneuver goes on; empty if it ends there.
        """
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
        """Return one of the kernels that `experts.problem` lists.

        Args:
            name: Name of the kernel.
            batched: Whether it will work on many rows at once.

        Returns:
            The kernel, compiled or loaded from the cache.
        """
        name = _QUADRATIC.get(name, name) if self.ends_early else name
        return self.maneuver.kernel(name, batched=batched)

    def misses(self, state: FloatArray) -> float:
        """Compare the tip's final errors with what counts as a success; see `ArmProblem.misses`.

        Args:
            state: Last state, shape (n_x,), units of the state.

        Returns:
            The larger error relative to its tolerance; 0 for a window after which the maneuver goes on.
        """
        return 0.0 if self.ends_early else self.maneuver.misses(state)

    def emphasized(self, emphasis: float) -> AbstractContextManager[None]:
        """Multiply the weights of the maneuver's final pose inside a `with` block.

        Args:
            emphasis: The factor; 1 is the scene's own cost.

        Returns:
            The context.
        """
        return self.maneuver.emphasized(emphasis)

    def end_cost(self, state: FloatArray) -> float:
        """Terminal cost of the maneuver, with the emphasis of the moment.

        Args:
            state: Final state, shape (n_x,), units of the state.

        Returns:
            The cost, dimensionless.
        """
        return self.maneuver.end_cost(state)
