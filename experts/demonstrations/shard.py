"""One shard: some dozens of problems drawn, solved, checked against each other, replayed, and packed."""

import hashlib
import platform
from time import perf_counter
from typing import NamedTuple

from experts.demonstrations.columns import NOTES, actions_of, demonstration_arrays, failure_arrays
from experts.demonstrations.episodes import Episodes, draw_starts, play
from experts.demonstrations.outcomes import (
    REPLAY_DIFFERS,
    Expert,
    Outcome,
    expert_of,
    find_better_ways,
    solve,
    solve_again,
)
from experts.demonstrations.settings import Settings
from experts.demonstrations.tensors import pack
from experts.problem import FloatArray

REPLAY_TOLERANCE = 1e-9
"""Largest difference between cost and return, relative to the cost."""


class Task(NamedTuple):
    """A shard to be made; all that whoever makes it has to know.

    Attributes:
        settings: Those of the data set.
        shard: Number of the shard.
    """

    settings: Settings
    shard: int


class ShardResult(NamedTuple):
    """A shard that has been made, not yet written.

    Attributes:
        shard: Its number.
        content: Bytes of the file.
        sha256: Their SHA-256, 64 hexadecimal digits.
        host: Name of the machine that made it.
        demonstrations: Number of demonstrations in it.
        failures: Number of problems that led to none.
        solve_seconds: Wall-clock time of the first solve of each problem, s.
        seconds: Wall-clock time of each part of the work, s.
    """

    shard: int
    content: bytes
    sha256: str
    host: str
    demonstrations: int
    failures: int
    solve_seconds: list[float]
    seconds: dict[str, float]


class _Clock:
    """Adds up what the parts of the work take."""

    def __init__(self) -> None:
        self.seconds: dict[str, float] = {}
        self._last = perf_counter()

    def lap(self, part: str) -> float:
        """Count the time since the last lap for a part, and return it."""
        now = perf_counter()
        elapsed, self._last = now - self._last, now
        self.seconds[part] = self.seconds.get(part, 0.0) + elapsed
        return elapsed


def make_shard(task: Task) -> ShardResult:
    """Make a shard. Its bytes depend on nothing but the task and the kind of processor.

    Args:
        task: Which one.

    Returns:
        The shard.

    Raises:
        KeyboardInterrupt: If the user interrupts it.
    """
    settings = task.settings
    expert = expert_of(settings.scene)
    clock, solve_seconds, outcomes = _Clock(), [], []
    problems = settings.problems(task.shard)
    seeds = [settings.problem_seed(problem) for problem in problems]
    starts = draw_starts(settings.scene, seeds)
    clock.lap("draws")
    for problem, seed, start in zip(problems, seeds, starts, strict=True):
        outcomes.append(solve(expert, problem, seed, start))
        solve_seconds.append(clock.lap("solves"))
    retries = find_better_ways(expert, outcomes)
    clock.lap("neighbors")
    solve_again(expert, outcomes, retries)
    clock.lap("solves again")
    actions, episodes = _replay(expert, outcomes)
    clock.lap("replay")
    good = [outcome for outcome in outcomes if outcome.is_good]
    failed = [outcome for outcome in outcomes if not outcome.is_good]
    arrays = demonstration_arrays(expert.problem, good, actions, episodes)
    content = pack(arrays | failure_arrays(expert.problem, failed), NOTES)
    digest = hashlib.sha256(content).hexdigest()
    clock.lap("packing")
    counts = len(good), len(failed)
    return ShardResult(task.shard, content, digest, platform.node(), *counts, solve_seconds, clock.seconds)


def _replay(expert: Expert, outcomes: list[Outcome]) -> tuple[FloatArray, Episodes]:
    """Carry out what is good in the environment; what it charges otherwise than planned is so no more.

    Returns the actions and episodes of all that is good in the end.
    """
    while True:
        good = [outcome for outcome in outcomes if outcome.is_good]
        actions = actions_of(expert.problem, good)
        episodes = play(expert.problem.scene, [outcome.seed for outcome in good], actions)
        differing = [
            outcome
            for i, outcome in enumerate(good)
            if not (episodes.is_success[i] and _agrees(episodes.total_reward(i), outcome.solution.cost))
        ]
        if not differing:
            return actions, episodes
        for outcome in differing:
            outcome.reason = REPLAY_DIFFERS


def _agrees(total_reward: float, cost: float) -> bool:
    return abs(total_reward + cost) <= REPLAY_TOLERANCE * abs(cost)
