"""Which quadratic model of the problem an iteration of the solver takes, and how strongly it is damped.

Gauss-Newton's model leaves the curvature of the dynamics out. It is convex and good far from a minimum, where
the exact model is indefinite, and it creeps where residuals are large: where effort and error balance, as in
a maneuver at the edge of what the actuators can do. Newton's method with exact second derivatives ends such a
creep in a few steps. The hybrid starts with the former and tries the latter once steps get slow.
"""

from dataclasses import dataclass
from enum import StrEnum

from experts.regularization import SHORT_STEP, Regularization
from experts.solution import IterationRecord

SLOW_DECREASE = 0.05
"""A step that lowers the cost by a smaller share is slow; so is one with a short accepted length."""
SLOW_STEPS = 2
"""After this many slow steps in a row, the hybrid tries the exact model."""
EXACT_DAMPING = (1e-3, 1e-1, 1e1, 1e3)
"""Weights of the damping with which the hybrid tries the exact model, in multiples of the control weights."""
LONGEST_PAUSE = 8
"""Largest number of iterations after which the hybrid tries the exact model again when it has failed."""


class SecondOrder(StrEnum):
    """Second derivatives that the solver takes."""

    GAUSS_NEWTON = "gauss_newton"
    """Those of the cost alone, convex."""
    EXACT = "exact"
    """Those of cost and dynamics: Newton's method, full DDP."""
    HYBRID = "hybrid"
    """Gauss-Newton's until steps get slow, then the exact ones wherever they lead to a step."""

    @classmethod
    def of(cls, choice: str | None, has_second_order: bool) -> "SecondOrder":
        """Resolve a user's choice.

        Args:
            choice: Name of a member; None for the hybrid if there are exact second derivatives, else for
                Gauss-Newton.
            has_second_order: Whether the problem has exact second derivatives.

        Returns:
            The member.

        Raises:
            ValueError: If there is no such member, or it needs derivatives that the problem does not have.
        """
        if choice is None:
            return cls.HYBRID if has_second_order else cls.GAUSS_NEWTON
        names = [member.value for member in cls]
        if choice not in names:
            raise ValueError(f"second_order is {choice!r}; there are {', '.join(names)}")
        if choice != cls.GAUSS_NEWTON and not has_second_order:
            raise ValueError(
                f"second_order is {choice!r}, but the problem has no exact second derivatives; "
                f"{cls.GAUSS_NEWTON.value} needs none"
            )
        return cls(choice)


@dataclass
class ModelSchedule:
    """The state of the choice over a solve.

    Attributes:
        second_order: The user's choice.
        regularization: Damping of the only model, or of Gauss-Newton's in the hybrid.
        slow_steps: Slow steps in a row.
        called_for: Whether the hybrid wants the exact model.
        pause: Iterations for which it does without all the same.
        next_pause: Length of the pause after the next failure.
    """

    second_order: SecondOrder
    regularization: Regularization
    slow_steps: int = 0
    called_for: bool = False
    pause: int = 0
    next_pause: int = 1

    @property
    def has_exact(self) -> bool:
        """Whether there are exact second derivatives to judge a trajectory by."""
        return self.second_order is not SecondOrder.GAUSS_NEWTON

    @property
    def tries_exact_first(self) -> bool:
        """Whether the hybrid should try the exact model in this iteration."""
        return self.second_order is SecondOrder.HYBRID and self.called_for and self.pause == 0

    def call_for_exact(self) -> None:
        """Have the exact model tried from now on, at once."""
        self.called_for, self.pause = True, 0

    def postpone_exact(self) -> None:
        """Do without the exact model for a while, longer after each failure: it led to no step."""
        self.pause, self.next_pause = self.next_pause, min(2 * self.next_pause, LONGEST_PAUSE)

    def observe(self, record: IterationRecord, previous_cost: float) -> None:
        """Learn from an iteration.

        Args:
            record: What it achieved.
            previous_cost: Cost before it.
        """
        if record.exact:
            self.next_pause = 1
        self.pause = max(self.pause - 1, 0)
        slow = previous_cost - record.cost < SLOW_DECREASE * abs(previous_cost) or record.alpha < SHORT_STEP
        self.slow_steps = self.slow_steps + 1 if slow else 0
        if self.slow_steps >= SLOW_STEPS:
            self.called_for = True
