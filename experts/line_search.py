"""The line search along a control update: how far to go."""

import numpy as np

from experts.backward_sweep import SweepOutcome
from experts.parallel_rollouts import LANES
from experts.problem import FloatArray
from experts.shooting import ShootingWorkspace

SHORTER_STEPS: FloatArray = np.float64(0.5) ** np.arange(1, LANES + 1)
"""Step lengths after the full one, as many as are rolled out at once."""
STEP_LENGTHS: FloatArray = np.concatenate([[1.0], SHORTER_STEPS])
"""All step lengths."""
ACCEPTANCE = 1e-4
"""Share of the promised decrease that a step must achieve."""


def line_search(work: ShootingWorkspace, outcome: SweepOutcome) -> float:
    """Move along an update: by the full step, else by the shorter one of lowest cost.

    Only steps that achieve enough of their promise are taken.

    Args:
        work: Holds the trajectory and the update.
        outcome: What the sweep promised.

    Returns:
        Length of the accepted step, in (0, 1]; 0 if there was none, and the trajectory stays as it is.
    """
    cost = work.current.cost
    if cost - work.try_step(1.0) > ACCEPTANCE * outcome.promise(1.0):
        work.accept()
        return 1.0
    costs = work.try_steps(SHORTER_STEPS)
    promised = np.array([outcome.promise(alpha) for alpha in SHORTER_STEPS])
    best = int(np.argmin(np.where(cost - costs > ACCEPTANCE * promised, costs, np.inf)))
    if not cost - costs[best] > ACCEPTANCE * promised[best]:
        return 0.0
    work.choose(best, float(costs[best]))
    work.accept()
    return float(SHORTER_STEPS[best])
