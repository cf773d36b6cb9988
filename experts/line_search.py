"""The line search along a control update: how far to go."""

import numpy as np

from experts.backward_sweep import SweepOutcome
from experts.shooting import ShootingWorkspace

STEP_LENGTHS = 10.0 ** np.linspace(0.0, -3.0, 11)
ACCEPTANCE = 1e-4
"""Share of the promised decrease that a step must achieve."""


def line_search(work: ShootingWorkspace, outcome: SweepOutcome) -> float:
    """Move to the first trial of an update that achieves enough of its promise.

    Args:
        work: Holds the trajectory and the update.
        outcome: What the sweep promised.

    Returns:
        Length of the accepted step, in (0, 1]; 0 if there was none, and the trajectory stays as it is.
    """
    cost = work.current.cost
    for alpha in STEP_LENGTHS:
        promised = -alpha * (outcome.linear + alpha * outcome.quadratic)
        if cost - work.try_step(alpha) > ACCEPTANCE * promised:
            work.accept()
            return float(alpha)
    return 0.0
