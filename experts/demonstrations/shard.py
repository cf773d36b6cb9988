"""One shard: some dozens of problems drawn, solved, checked against each other, replayed, and packed.

Arrays of a shard with M demonstrations and F failures, N stages:

| array | shape | meaning |
|---|---|---|
| `states` | (M, N + 1, n_x) | states of the environment, units of the state |
| `observations` | (M, N + 1, n_obs) | its observations of them |
| `actions` | (M, N, n_u) | inputs as fractions of their limits, in [-1, 1] |
| `rewards` | (M, N) | rewards of the environment; their sum is minus the cost |
| `feedback_gains` | (M, N, n_u, n_t) | float32: change of the action per deviation in tangent coordinates |
| `index`, `seed` | (M,) | number of the problem; `env.reset(seed=seed)` starts there |
| `cost` | (M,) | J, dimensionless |
| `iterations`, `stop_reason` | (M,) | of the solve; the latter is an index into `REASONS` |
| `guess` | (M,) | initial guess of the solve, an index into `GUESSES` |
| `start_errors`, `final_errors` | (M, 2) | of the tip: attitude [deg] and position [m] |
| `clamped_share` | (M,) | share of the inputs, over all stages, at a limit |
| `parameters` | (M, n_p) | what varied in the scene, units of the parameters |
| `failures.index`, `.seed`, `.stop_reason`, `.cost` | (F,) | of the problems that failed |
| `failures.start` | (F, n_x) | state at stage 0, units of the state |
| `failures.final_errors` | (F, 2) | as planned |
| `failures.parameters` | (F, n_p) | what varied in the scene |

Gains are control-limited: rows of inputs at a limit are zero, but for the previous input where it limits
their rate. Only scenes in which something varies, by their spread or by their list of parameters, have
`parameters`.
"""

import hashlib
import platform
from collections.abc import Mapping, Sequence
from pathlib import Path
from time import perf_counter
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from dq_space_arm_env import Scene
from dq_space_arm_env.environment import DQSpaceArmVectorEnv
from dq_space_arm_env.environment.rollouts import Rollout, StateFeedback, rollout
from dq_space_arm_env.kernels import Kernels
from dq_space_arm_env.scene import StateLayout
from dq_space_arm_env.task.step_report import n_observations
from experts.demonstrations.outcomes import (
    GUESSES,
    REASONS,
    REPLAY_DIFFERS,
    Expert,
    Outcome,
    expert_of,
    find_better_ways,
    solve,
    solve_again,
)
from experts.demonstrations.settings import Settings, software
from experts.demonstrations.tensors import DemonstrationsError, pack
from experts.problems.arm_problem import ArmProblem
from experts.problems.shooting_problem import FloatArray

TRAJECTORIES = ("states", "observations", "actions", "rewards", "feedback_gains")
"""Arrays with a row for each stage."""
SUMMARIES = (
    "index",
    "seed",
    "cost",
    "iterations",
    "stop_reason",
    "guess",
    "start_errors",
    "final_errors",
    "clamped_share",
)
"""Arrays with a few numbers for each demonstration."""
FAILURES = ("index", "seed", "stop_reason", "cost", "start", "final_errors")
"""Arrays with a few numbers for each failure."""
PARAMETERS = "parameters"
"""Array of demonstrations and of failures where something varies in the scene, see `with_parameters`."""
NOTES = {"guesses": GUESSES, "reasons": REASONS}
REPLAY_TOLERANCE = 1e-9
"""Largest difference between cost and return, relative to the cost."""

Arrays = dict[str, NDArray[Any]]


class Starts(NamedTuple):
    """What episodes begin with."""

    states: FloatArray  # shape (B, n_x), units of the state
    parameters: FloatArray  # shape (B, n_p), units of the parameters


class ShardResult(NamedTuple):
    """A shard that has been made, not yet written."""

    shard: int
    content: bytes  # of the file
    sha256: str  # of the content, 64 hexadecimal digits
    host: str  # name of the machine that made it
    demonstrations: int
    failures: int
    solve_seconds: list[float]  # wall-clock time of the first solve of each problem, s
    seconds: dict[str, float]  # wall-clock time of each part of the work, s


class _Clock:
    """Adds up the durations of the parts of the work."""

    def __init__(self) -> None:
        self.seconds: dict[str, float] = {}
        self._last = perf_counter()

    def lap(self, part: str) -> float:
        """Credit the time since the last lap to a part, and return it."""
        now = perf_counter()
        elapsed, self._last = now - self._last, now
        self.seconds[part] = self.seconds.get(part, 0.0) + elapsed
        return elapsed


class Task(NamedTuple):
    """A shard to make: all that a worker has to know."""

    settings: Settings
    shard: int

    @property
    def label(self) -> str:
        return f"shard {self.shard}"

    def prepare(self) -> None:
        """Compile the expert."""
        expert_of(self.settings.scene)

    def run(self) -> ShardResult:
        """Make the shard."""
        return make_shard(self)

    def lost(self, sentence: str) -> ShardResult:
        """End the run; finished shards remain."""
        raise DemonstrationsError(sentence)

    @staticmethod
    def software() -> dict[str, Any]:
        """Identify the code that its bytes follow from."""
        return software()


def make_shard(task: Task) -> ShardResult:
    """Make a shard. Its bytes depend on nothing but the task and the kind of processor."""
    settings = task.settings
    expert = expert_of(settings.scene)
    clock, solve_seconds, outcomes = _Clock(), [], []
    problems = settings.problems(task.shard)
    seeds = [settings.problem_seed(problem) for problem in problems]
    starts = draw_starts(settings.scene, seeds)
    clock.lap("draws")
    for problem, seed, *start in zip(problems, seeds, *starts, strict=True):
        outcomes.append(solve(expert, problem, seed, *start))
        solve_seconds.append(clock.lap("solves"))
    retries = find_better_ways(expert, outcomes)
    clock.lap("neighbors")
    solve_again(expert, outcomes, retries)
    clock.lap("solves again")
    actions, episodes = _verified_episodes(expert, outcomes)
    clock.lap("replay")
    good = [outcome for outcome in outcomes if outcome.is_good]
    failed = [outcome for outcome in outcomes if not outcome.is_good]
    arrays = _demonstration_arrays(expert.problem, good, actions, episodes)
    content = pack(arrays | _failure_arrays(expert.problem, failed), NOTES)
    digest = hashlib.sha256(content).hexdigest()
    clock.lap("packing")
    counts = len(good), len(failed)
    return ShardResult(task.shard, content, digest, platform.node(), *counts, solve_seconds, clock.seconds)


def with_parameters(names: tuple[str, ...], layout: StateLayout) -> tuple[str, ...]:
    """Names of arrays, and the parameters if the scene has any."""
    return (*names, PARAMETERS) if layout.n_p else names


def array_kinds(scene: Scene, layout: StateLayout) -> dict[str, tuple[str, tuple[int, ...]]]:
    """Types of a shard's arrays, and their shapes after the first axis."""
    horizon, n_obs = scene.simulation.steps, n_observations(scene)
    sizes = {"n_x": layout.n_x, "n_u": layout.n_u, "n_t": layout.n_t, "n_obs": n_obs}
    sizes |= {"n_p": layout.n_p, "N": horizon, "N + 1": horizon + 1, "2": 2}
    kinds = {**_ARRAYS, **(_VARYING if layout.n_p else {})}
    return {name: (dtype, tuple(sizes[axis] for axis in axes)) for name, (dtype, *axes) in kinds.items()}


def check_arrays(path: Path, arrays: Mapping[str, NDArray[Any]], scene: Scene, layout: StateLayout) -> None:
    """Raise DemonstrationsError where a shard has other arrays than those of its scene."""
    for name, (dtype, rest) in array_kinds(scene, layout).items():
        first = "failures.index" if name.startswith("failures.") else "index"
        array, counted = arrays.get(name), arrays.get(first)
        rows = () if counted is None else counted.shape[:1]
        shape = (*rows, *rest)
        if array is None or array.shape != shape or array.dtype != dtype:
            found = "is missing" if array is None else f"has shape {array.shape} of {array.dtype}"
            raise DemonstrationsError(
                f"{path}: {name} {found}, it should have shape {shape} of {dtype}; generate it again"
            )
    for name, known in (("stop_reason", REASONS), ("failures.stop_reason", REASONS), ("guess", GUESSES)):
        if arrays[name].max(initial=0) >= len(known):
            raise DemonstrationsError(
                f"{path}: {name} has entries beyond {len(known) - 1}; generate it again"
            )
    for name in _VARYING if layout.n_p else ():
        if not np.isfinite(arrays[name]).all():
            raise DemonstrationsError(f"{path}: {name} should be finite; generate it again")


_ARRAYS: Mapping[str, tuple[str, ...]] = {  # type, and axes after the first
    "states": ("float64", "N + 1", "n_x"),
    "observations": ("float64", "N + 1", "n_obs"),
    "actions": ("float64", "N", "n_u"),
    "rewards": ("float64", "N"),
    "feedback_gains": ("float32", "N", "n_u", "n_t"),
    "index": ("int64",),
    "seed": ("int64",),
    "cost": ("float64",),
    "iterations": ("int64",),
    "stop_reason": ("uint8",),
    "guess": ("uint8",),
    "start_errors": ("float64", "2"),
    "final_errors": ("float64", "2"),
    "clamped_share": ("float64",),
    "failures.index": ("int64",),
    "failures.seed": ("int64",),
    "failures.stop_reason": ("uint8",),
    "failures.cost": ("float64",),
    "failures.start": ("float64", "n_x"),
    "failures.final_errors": ("float64", "2"),
}
_VARYING: Mapping[str, tuple[str, ...]] = {
    PARAMETERS: ("float64", "n_p"),
    f"failures.{PARAMETERS}": ("float64", "n_p"),
}


def draw_starts(scene: Scene, seeds: Sequence[int]) -> Starts:
    """Draw what `env.reset(seed=...)` draws, for B seeds."""
    environment = DQSpaceArmVectorEnv(len(seeds), scene)
    environment.reset(seed=list(seeds))
    return Starts(environment.states, environment.parameters)


def replay(scene: Scene, seeds: Sequence[int], actions: FloatArray) -> Rollout:
    """Apply actions, shape (M, N, n_u), in the vector environment, bit for bit as in single ones."""
    return rollout(StateFeedback(lambda states, step: actions[:, step]), scene, seeds, record=True)


def _verified_episodes(expert: Expert, outcomes: list[Outcome]) -> tuple[FloatArray, Rollout]:
    """Replay the good outcomes; one whose replay fails, or costs something else, becomes a failure.

    Returns actions and episodes of the outcomes that remain good; some episode if none does.
    """
    problem = expert.problem
    while True:
        good = [outcome for outcome in outcomes if outcome.is_good]
        actions = np.empty((len(good), problem.horizon, problem.n_controls))
        for row, outcome in zip(actions, good, strict=True):
            solution = outcome.solution
            row[:] = problem.kernels.layout.to_action(solution.controls, solution.parameters[:-1])
        if not good:
            return actions, replay(problem.scene, [0], np.zeros((1, *actions.shape[1:])))
        episodes = replay(problem.scene, [outcome.seed for outcome in good], actions)
        planned = np.array([outcome.solution.cost for outcome in good])
        agrees = np.abs(planned - episodes.cost) <= REPLAY_TOLERANCE * np.abs(planned)
        differing = np.flatnonzero(~(episodes.is_success & agrees))
        if not len(differing):
            return actions, episodes
        for i in differing:
            good[i].reason = REPLAY_DIFFERS


def _demonstration_arrays(
    problem: ArmProblem, outcomes: Sequence[Outcome], actions: FloatArray, episodes: Rollout
) -> Arrays:
    gains = np.empty((*actions.shape, problem.n_tangent), dtype=np.float32)
    for row, outcome in zip(gains, outcomes, strict=True):
        solution = outcome.solution
        row[:] = problem.kernels.layout.to_action_gains(solution.feedback_gains, solution.parameters[:-1])
    count, layout = len(outcomes), problem.kernels.layout
    at_limit = (actions == layout.lower_limits(np.ones(layout.n_u))) | (actions == 1.0)
    assert episodes.states is not None
    assert episodes.observations is not None
    final_errors = np.stack([episodes.attitude_error, episodes.position_error], axis=1)
    return {
        "states": episodes.states[:count],
        "observations": episodes.observations[:count],
        "actions": actions,
        "rewards": episodes.rewards[:count],
        "feedback_gains": gains,
        **_common(problem, outcomes),
        "iterations": np.array([outcome.solution.iterations for outcome in outcomes], dtype=np.int64),
        "guess": np.array([GUESSES.index(outcome.guess) for outcome in outcomes], dtype=np.uint8),
        "start_errors": episodes.initial_errors[:count],
        "final_errors": final_errors[:count],
        "clamped_share": np.mean(at_limit, axis=(1, 2)),
    }


def _failure_arrays(problem: ArmProblem, outcomes: Sequence[Outcome]) -> Arrays:
    ends = np.array([outcome.solution.states[-1] for outcome in outcomes]).reshape(-1, problem.n_states)
    starts = np.array([outcome.start for outcome in outcomes]).reshape(-1, problem.n_states)
    last = np.array([outcome.solution.parameters[-1] for outcome in outcomes])
    errors = tip_errors(problem.kernels, ends, last.reshape(len(outcomes), problem.kernels.n_p))
    errors[~np.isfinite(ends).all(axis=1)] = np.nan
    arrays = {**_common(problem, outcomes), "start": starts, "final_errors": errors}
    return {f"failures.{name}": array for name, array in arrays.items()}


def tip_errors(kernels: Kernels, states: FloatArray, parameters: FloatArray) -> FloatArray:
    """Attitude error [deg] and position error [m] of states, shape (n, 2); parameters (n_p,) or (n, n_p)."""
    return kernels.tip_errors(states, p=parameters)[:, :2] if len(states) else np.zeros((0, 2))


def _parameters(problem: ArmProblem, outcomes: Sequence[Outcome]) -> FloatArray:
    """What varied, shape (len(outcomes), n_p)."""
    rows = np.array([outcome.parameters for outcome in outcomes], dtype=np.float64)
    return rows.reshape(len(outcomes), problem.kernels.n_p)


def _common(problem: ArmProblem, outcomes: Sequence[Outcome]) -> Arrays:
    varied = {PARAMETERS: _parameters(problem, outcomes)} if problem.kernels.n_p else {}
    return {
        **varied,
        "index": np.array([outcome.index for outcome in outcomes], dtype=np.int64),
        "seed": np.array([outcome.seed for outcome in outcomes], dtype=np.int64),
        "cost": np.array([outcome.solution.cost for outcome in outcomes], dtype=np.float64),
        "stop_reason": np.array([REASONS.index(outcome.reason) for outcome in outcomes], dtype=np.uint8),
    }
