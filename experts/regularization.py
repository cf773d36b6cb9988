"""How strongly the solver damps its steps, and how that follows the success of the line search.

The schedule is Tassa's quadratic one: repeated raises grow faster and faster, so do repeated reductions.
What moves it is the accepted step length, not success alone: lowered after every success, as in the public
release, the damping settles where only tiny steps are accepted.
"""

from dataclasses import dataclass

FACTOR = 1.6
SMALLEST = 1e-6  # below it the regularization is zero
LARGEST = 1e10

LONG_STEP = 1.0  # an accepted step length from here on lowers the regularization: the full step only
SHORT_STEP = 0.2  # one below it raises the regularization


@dataclass
class Regularization:
    """The weight lambda that the backward sweep adds to Quu, in multiples of the control weights.

    Attributes:
        value: lambda, in [0, `LARGEST`] except after a raise beyond the limit.
        rate: Factor of the last change; above 1 while rising, below 1 while falling.
    """

    value: float
    rate: float = 1.0

    def increase(self) -> None:
        """Raise lambda, faster after an earlier raise."""
        self.rate = max(self.rate * FACTOR, FACTOR)
        self.value = max(self.value * self.rate, SMALLEST)

    def decrease(self) -> None:
        """Lower lambda, faster after an earlier reduction, to zero below `SMALLEST`."""
        self.rate = min(self.rate / FACTOR, 1.0 / FACTOR)
        self.value = self.value * self.rate if self.value * self.rate >= SMALLEST else 0.0

    def follow(self, alpha: float) -> None:
        """Adapt lambda to an accepted step.

        Args:
            alpha: Accepted step length, in (0, 1].
        """
        if alpha >= LONG_STEP:
            self.decrease()
        elif alpha < SHORT_STEP:
            self.increase()

    @property
    def exhausted(self) -> bool:
        """Whether lambda has left its range: no useful step is left to try."""
        return self.value > LARGEST
