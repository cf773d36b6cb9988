"""Second derivatives and regularization of an iteration, and the state of a solve that decides on them.

The Gauss-Newton model (iLQR) leaves out the curvature of the dynamics. It is convex and works well far from a
minimum, where the exact model is indefinite, but it converges slowly where residuals are large: where effort
balances error, as in a maneuver at the limits of the actuators. Newton's method with exact second derivatives
finishes such a solve in a few steps. The hybrid starts with the former and tries the latter once steps slow
down.

Where the pose's cost bends much, Gauss-Newton's model creeps: it leaves out that curvature too, which is
indefinite. The mirrored model keeps it, but changes the sign of negative eigenvalues of a stage's Hessian.

The regularization mu follows Tassa's quadratic schedule: repeated increases accelerate, and so do repeated
decreases. It reacts to the accepted step length, not to success alone: decreased after every success, as in
the public release, it settles where only tiny steps are accepted.
"""

from dataclasses import dataclass, field
from enum import StrEnum

import numpy as np

from experts.ddp.solution import IterationRecord, Stop, StopReason

SLOW_REDUCTION = 0.05
"""A step that reduces the cost by a smaller share is slow; so is one with a short accepted length."""
SLOW_STEPS = 2
"""Consecutive slow steps after which the hybrid tries the exact model."""
EXACT_MU = (1e-3, 1e-1, 1e1, 1e3)
"""Regularizations with which the hybrid tries the exact model, in multiples of the control weights."""
WEAKEST_EXACT_MU = 1e-3
"""First and least regularization of the exact model beside the mirrored one."""
STRONGEST_EXACT_MU = 1e2
"""Beyond it a step of the mirrored model is worth more than one of the exact model."""
EXACT_MU_FACTOR = 4.0
"""Change of that regularization from one step to the next."""
HALF_STEP = 0.5
"""A step of the exact model below this length calls for more regularization: its model reached too far."""
LONGEST_PAUSE = 8
"""Most iterations that the hybrid waits before it tries the exact model again."""

MU_FACTOR = 1.6
SMALLEST_MU = 1e-6  # below it mu is zero
LARGEST_MU = 1e10
LONG_STEP = 1.0  # an accepted step length from here on decreases mu: the full step only
SHORT_STEP = 0.2  # one below it, or no step at all, increases mu


class SecondOrder(StrEnum):
    """Second derivatives that the solver uses."""

    GAUSS_NEWTON = "gauss_newton"
    """Those of the cost alone: convex."""
    EXACT = "exact"
    """Those of cost and dynamics: Newton's method, full DDP."""
    HYBRID = "hybrid"
    """Gauss-Newton's until steps slow down, then exact ones wherever they yield a step."""
    MIRRORED = "mirrored"
    """As the hybrid, but first the exact ones of the cost alone, made convex: where it bends much."""

    @classmethod
    def of(cls, choice: str | None, has_second_order: bool) -> "SecondOrder":
        """Resolve a user's choice; None takes the hybrid where the problem has exact second derivatives."""
        if choice is None:
            return cls.HYBRID if has_second_order else cls.GAUSS_NEWTON
        names = [member.value for member in cls]
        if choice not in names:
            raise ValueError(f"second_order is {choice!r}; choose one of {', '.join(names)}")
        if choice != cls.GAUSS_NEWTON and not has_second_order:
            raise ValueError(
                f"second_order is {choice!r}, but the problem has no exact second derivatives; "
                f"{cls.GAUSS_NEWTON.value} needs none"
            )
        return cls(choice)


@dataclass
class Regularization:
    """The weight mu of diag(luu) that the backward pass adds to Quu."""

    mu: float  # in [0, LARGEST_MU], except after an increase beyond the limit
    factor: float = 1.0  # of the last change; above 1 while increasing, below 1 while decreasing

    def increase(self) -> None:
        self.factor = max(self.factor * MU_FACTOR, MU_FACTOR)
        self.mu = max(self.mu * self.factor, SMALLEST_MU)

    def decrease(self) -> None:
        self.factor = min(self.factor / MU_FACTOR, 1.0 / MU_FACTOR)
        self.mu = self.mu * self.factor if self.mu * self.factor >= SMALLEST_MU else 0.0

    def adapt(self, alpha: float) -> None:
        """React to an accepted step length; 0 if no step was accepted."""
        if alpha >= LONG_STEP:
            self.decrease()
        elif alpha < SHORT_STEP:
            self.increase()

    @property
    def exhausted(self) -> bool:
        """Whether mu has left its range: no useful step is left to try."""
        return self.mu > LARGEST_MU


@dataclass
class ExactRegularization:
    """Regularization of the exact model beside the mirrored one, remembered from step to step.

    In a narrow, bent valley the weakest one that leaves the model convex is not the best: its steps leave the
    valley and are cut to a small length.
    """

    mu: float = WEAKEST_EXACT_MU

    def increase(self) -> bool:
        """Increase mu; False if it is as large as is useful."""
        if self.mu * EXACT_MU_FACTOR > STRONGEST_EXACT_MU:
            return False
        self.mu *= EXACT_MU_FACTOR
        return True

    def adapt(self, alpha: float) -> None:
        """React to an accepted step length."""
        if alpha >= LONG_STEP:
            self.mu = max(self.mu / EXACT_MU_FACTOR, WEAKEST_EXACT_MU)
        elif alpha < HALF_STEP:
            self.increase()


@dataclass
class HybridSwitch:
    """When the hybrid tries exact second derivatives."""

    slow_steps: int = 0  # consecutive ones
    wants_exact: bool = False
    pause: int = 0  # iterations to wait all the same
    next_pause: int = 1  # length of the pause after the next failure

    @property
    def tries_exact(self) -> bool:
        return self.wants_exact and self.pause == 0

    def request_exact(self) -> None:
        """Try the exact model from now on, at once."""
        self.wants_exact, self.pause = True, 0

    def postpone_exact(self) -> None:
        """Pause after an exact model that yielded no step, longer after each failure."""
        self.pause, self.next_pause = self.next_pause, min(2 * self.next_pause, LONGEST_PAUSE)

    def observe(self, record: IterationRecord, previous_cost: float) -> None:
        """Note whether an iteration was slow."""
        if record.exact:
            self.next_pause = 1
        self.pause = max(self.pause - 1, 0)
        reduction = previous_cost - record.cost
        slow = reduction < SLOW_REDUCTION * abs(previous_cost) or record.alpha < SHORT_STEP
        self.slow_steps = self.slow_steps + 1 if slow else 0
        if self.slow_steps >= SLOW_STEPS:
            self.wants_exact = True


@dataclass
class SolverState:
    """What a solve carries from iteration to iteration."""

    regularization: Regularization  # of the only model, or of Gauss-Newton's in the hybrid
    switch: HybridSwitch = field(default_factory=HybridSwitch)
    exact_regularization: ExactRegularization = field(default_factory=ExactRegularization)
    moved: bool = True  # whether the trajectory has changed since it was differentiated
    optimality: float = np.inf  # predicted relative reduction of an unregularized step, inf where unknown
    idle_iterations: int = 0  # consecutive ones that hardly reduced the cost
    note: str = ""  # for the message: how gaps were closed that no step closed
    records: list[IterationRecord] = field(default_factory=list)

    def iteration_limit(self, max_iterations: int) -> Stop | None:
        """Stop if the iterations are used up."""
        if len(self.records) < max_iterations:
            return None
        return Stop(StopReason.MAX_ITERATIONS, f"the limit of {max_iterations} iterations is reached")
