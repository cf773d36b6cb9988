"""How far a training run has come, and what it took."""

from typing import NamedTuple


class Progress(NamedTuple):
    """State of a run, kept in its checkpoints."""

    environment_steps: int = 0  # of all copies together
    seconds: float = 0.0  # training time, over all starts of the run
    expert_solves: int = 0  # for demonstrations, or for the policy it started from
    seconds_before: float = 0.0  # time for these, and for training the policy it started from
