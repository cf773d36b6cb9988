"""Subjects that are timed: forward dynamics, steps, their gradients, environments; their times per state.

Environments get random actions, each followed by its opposite, which keeps the robot from spinning up. A
vector environment staggers the episodes of its copies evenly: resets are part of the time, and a sample
holds whole periods of them.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass
from functools import partial
from itertools import cycle
from typing import Any

import gymnasium
import numpy as np

from dq_space_arm_env import Kernels, Scene, compile_scene
from dq_space_arm_env.kernels.bound import KernelCall
from dq_space_arm_env.scene import INTEGRATORS
from dq_space_arm_env.scene.start import number_of_draws
from experts.report.part_costs import finite_limits, moving_states
from experts.report.timing import time_in_turns
from scripts.benchmarks.effort import Sampling
from scripts.benchmarks.harness import Row, select

OURS = "dq-space-arm"
DYNAMICS, STEP, ENVIRONMENT = "forward dynamics", "step", "environment step"
GRADIENT, JACOBIANS = "gradient of a step", "Jacobians of a step"
EPISODES = "gradient of episodes, by decision"
GOALS = "goal environment step"
FLOAT64, FLOAT32 = "float64", "float32"
COMPARED_INTEGRATORS = ("symplectic_euler", "rk4")  # integrators that other engines and solvers have as well


def compared_integrators(scene: Scene) -> tuple[str, ...]:
    """Those of `COMPARED_INTEGRATORS` that take a scene's robot."""
    return tuple(name for name in COMPARED_INTEGRATORS if INTEGRATORS[name].takes(scene))


@dataclass(frozen=True, kw_only=True)
class Subject:
    """A subject of timing."""

    what: str  # DYNAMICS, STEP, GRADIENT, JACOBIANS, EPISODES, ENVIRONMENT or GOALS
    engine: str
    way: str  # of calling it
    integrator: str = ""
    batch: int = 1  # states of a call; a call of several steps handles a state once per step
    precision: str = FLOAT64
    threads: int = 1
    operations: int | None = None  # per state, a multiply-add counting as two


@dataclass(frozen=True)
class Case:
    """Something to time."""

    subject: Subject
    run: Callable[[], object]
    period: int = 1  # calls after which the work repeats; a sample is a multiple of it


def time_cases(cases: Sequence[Case], sampling: Sampling) -> list[Row]:
    """Time cases, each warmed up, in turns; a row for each, with ns per state."""
    runs, periods = [case.run for case in cases], [case.period for case in cases]
    rows = []
    for case, sample in zip(cases, time_in_turns(runs, *sampling, periods), strict=True):
        best, median = (each / case.subject.batch for each in sample)
        rate = {"states_per_second": 1e9 / best}
        rows.append({**vars(case.subject), "best_ns": best, "median_ns": median, **rate})
    return rows


def fastest(timings: Iterable[Row], **wanted: object) -> Row | None:
    """The fastest of the timings that have these values."""
    return min(select(timings, **wanted), key=lambda timing: float(timing["best_ns"]), default=None)


@dataclass(frozen=True)
class Variant:
    """A way to run a scene."""

    precision: str = FLOAT64
    threads: int = 1

    def scene(self, scene: Scene, integrator: str | None = None) -> Scene:
        """The scene in this precision, with another integrator if one is named."""
        changes = {"precision": self.precision, "integrator": integrator or scene.simulation.integrator}
        return scene.replace(simulation=changes)

    def compile(self, scene: Scene) -> Kernels:
        return compile_scene(self.scene(scene), threads=self.threads)

    def make_vec(
        self, scene: Scene, num_envs: int, integrator: str
    ) -> gymnasium.vector.VectorEnv[Any, Any, Any]:
        return gymnasium.make_vec(
            "DQSpaceArm-v0", num_envs=num_envs, scene=self.scene(scene, integrator), threads=self.threads
        )


PLAIN = Variant()
VARIANTS = (PLAIN, Variant(FLOAT32), Variant(threads=2), Variant(FLOAT32, 2))


SCALAR, VECTOR = "scalar kernel", "vector kernel"
PROGRAMS = {
    DYNAMICS: "forward_dynamics",
    STEP: "step",
    GRADIENT: "vjp",
    JACOBIANS: "linearize",
    ENVIRONMENT: "environment_step",
}


def kernel_cases(scene: Scene, batch_sizes: Sequence[int]) -> list[Case]:
    """All timed kernels of a scene for each batch size: scalar code, and vector code in each variant.

    Gradients, by reverse mode and by Jacobians, are timed in double precision on one thread alone.
    """
    chosen = scene.simulation.integrator
    programs = [
        (DYNAMICS, ""),
        *((STEP, name) for name in compared_integrators(scene)),
        (ENVIRONMENT, chosen),
    ]
    cases = []
    for what, integrator in programs:
        for variant, way in ((PLAIN, SCALAR), *((variant, VECTOR) for variant in VARIANTS)):
            for batch in batch_sizes:
                cases.append(kernel_case(scene, what, integrator, batch, variant, way))
    gradients = [(what, batch) for what in (GRADIENT, JACOBIANS) for batch in batch_sizes]
    return cases + [kernel_case(scene, what, chosen, batch) for what, batch in gradients]


def kernel_case(
    scene: Scene, what: str, integrator: str, batch: int, variant: Variant = PLAIN, way: str = VECTOR
) -> Case:
    """A kernel on arrays of its own."""
    kernels = variant.compile(scene)
    lanes = 1 if way == SCALAR else None
    kernel = kernels.kernel(PROGRAMS[what], integrator=integrator or None, lanes=lanes)
    x, u = moving_states(kernels, batch)
    inputs = {"x": x, "u": u, "action": u / finite_limits(kernels), "h": np.array([scene.simulation.dt])}
    inputs["v"] = np.ones((batch, kernels.n_t))
    inputs["parameters"] = np.tile(kernels.parameters.nominal, (batch, 1))
    if what == ENVIRONMENT:
        inputs |= _episodes(kernels, batch)
    arrays = {spec.name: np.ascontiguousarray(inputs[spec.name], spec.dtype) for spec in kernel.inputs}
    arrays |= {
        spec.name: np.zeros((spec.stride, batch) if spec.by_column else (batch, spec.stride), spec.dtype)
        for spec in kernel.outputs
    }
    subject = Subject(
        what=what,
        engine=OURS,
        way=way,
        integrator=integrator,
        batch=batch,
        precision=variant.precision,
        threads=variant.threads,
        operations=kernel.operation_count,
    )
    call = KernelCall(kernel, arrays)
    # One row is called as the single environment does it, many as the vector environment does.
    run = call.of_one_row() if batch == 1 else partial(call, batch, variant.threads)
    return Case(subject, run)


def episodes_case(scene: Scene) -> Case:
    """Gradient by the weights of the episodes of an update of `apg`: policy, steps and both back."""
    from threadpoolctl import ThreadpoolController

    from agents.gradients.episodes import Episodes, decision_times
    from agents.gradients.layers import Layers, random_weights
    from agents.gradients.starts import Starts

    copies, decisions = 128, 50
    times = decision_times(scene, decisions, crowding=0.8)
    starts = Starts.draw(scene, copies, times, [0], (1.0,))[1]
    kernels = compile_scene(scene)
    seen = kernels.observation(starts.states, np.full((copies, 1), times[-1]), starts.parameters)[0].shape[1]
    weights = random_weights([seen, 64, 64, kernels.n_u], np.random.default_rng(0))
    episodes = Episodes(scene, Layers(weights, decisions, copies), times, 0.1)
    episodes.parameters[:] = starts.at(np.arange(copies))
    pools = ThreadpoolController()

    def run() -> None:
        with pools.limit(limits=1, user_api="blas"):  # as in training
            episodes.gradient(starts.states, np.zeros(seen), np.ones(seen), 1.0)

    return Case(Subject(what=EPISODES, engine=OURS, way="policy and kernels", batch=copies * decisions), run)


FUNCTION = "function of Kernels"


def function_cases(scene: Scene, batch_sizes: Sequence[int]) -> list[Case]:
    """Functions of `Kernels` called from Python, which checks arguments and makes arrays for the results."""
    kernels, cases = PLAIN.compile(scene), []
    for batch in batch_sizes:
        x, u = moving_states(kernels, batch)
        x, u = (x, u) if batch > 1 else (x[0], u[0])
        count = kernels.operation_count("forward_dynamics")
        dynamics = Subject(what=DYNAMICS, engine=OURS, way=FUNCTION, batch=batch, operations=count)
        cases.append(Case(dynamics, partial(kernels.forward_dynamics, x, u)))
        for name in compared_integrators(scene):
            count = kernels.operation_count("step", integrator=name)
            step = Subject(
                what=STEP, engine=OURS, way=FUNCTION, integrator=name, batch=batch, operations=count
            )
            cases.append(Case(step, partial(kernels.step, x, u, integrator=name)))
    return cases


def _episodes(kernels: Kernels, count: int) -> dict[str, np.ndarray]:
    """Inputs of the environment's step besides state and action, for episodes that have just begun."""
    start = kernels.kernel("environment_start")
    draws = np.random.default_rng(1).uniform(-1.0, 1.0, (count, number_of_draws(kernels.scene)))
    begun = {spec.name: np.zeros((count, spec.stride), dtype=spec.dtype) for spec in start.outputs}
    KernelCall(start, {"draws": draws, **begun}).on_rows(np.arange(count))
    return begun


MAKE, MAKE_VEC, UNWRAPPED = "gymnasium.make", "gymnasium.make_vec", "gymnasium.make, unwrapped"
SYNCHRONOUS, SYNCHRONOUS_COPIES = "SyncVectorEnv", 64


def environment_cases(scene: Scene, batch_sizes: Sequence[int]) -> list[Case]:
    """Single environments and vector environments of each size, with each integrator, and in each variant."""
    chosen, steps = scene.simulation.integrator, scene.simulation.steps
    compared, cases = compared_integrators(scene), []
    for integrator in compared:
        for way in (UNWRAPPED, MAKE):
            env = gymnasium.make("DQSpaceArm-v0", scene=PLAIN.scene(scene, integrator))
            subject = Subject(what=ENVIRONMENT, engine=OURS, way=way, integrator=integrator)
            cases.append(single_case(subject, env if way == MAKE else env.unwrapped, steps))
    for variant in VARIANTS:
        for integrator in compared if variant == PLAIN else (chosen,):
            for batch in batch_sizes:
                subject = Subject(
                    what=ENVIRONMENT,
                    engine=OURS,
                    way=MAKE_VEC,
                    integrator=integrator,
                    batch=batch,
                    precision=variant.precision,
                    threads=variant.threads,
                )
                cases.append(vector_case(subject, variant.make_vec(scene, batch, integrator), steps))
    return cases


def goal_cases(scene: Scene, batch_sizes: Sequence[int]) -> list[Case]:
    """Native vector environments of goals, and single ones in Gymnasium's own; none with several tips."""
    chosen, cases = scene.simulation.integrator, []
    ways = [(MAKE_VEC, batch) for batch in batch_sizes] + [(SYNCHRONOUS, SYNCHRONOUS_COPIES)]
    for way, batch in () if scene.other_tips else ways:
        mode = "sync" if way == SYNCHRONOUS else "vector_entry_point"
        env = gymnasium.make_vec(
            "DQSpaceArmGoal-v0", batch, scene=PLAIN.scene(scene), vectorization_mode=mode
        )
        subject = Subject(what=GOALS, engine=OURS, way=way, integrator=chosen, batch=batch)
        cases.append(vector_case(subject, env, scene.simulation.steps))
    return cases


def single_case(subject: Subject, env: gymnasium.Env[Any, Any], steps: int) -> Case:
    """Step an environment, and reset it at the end of an episode."""
    actions = _alternating(env.action_space)
    env.reset(seed=0)

    def run() -> None:
        if env.step(next(actions))[2]:
            env.reset()

    return Case(subject, run, period=steps)


def vector_case(subject: Subject, env: gymnasium.vector.VectorEnv[Any, Any, Any], steps: int) -> Case:
    """Step a vector environment whose copies' episodes are evenly apart."""
    actions = _alternating(env.action_space)
    env.reset(seed=0)
    _spread_episodes(env, actions, steps)
    period = math.ceil((steps + 1) / env.num_envs)  # the reset takes a step of its own
    return Case(subject, lambda: env.step(next(actions)), period)


def _alternating(space: gymnasium.Space[Any]) -> Iterator[Any]:
    space.seed(0)
    action = space.sample()
    return cycle((action, -action))


def _spread_episodes(
    env: gymnasium.vector.VectorEnv[Any, Any, Any], actions: Iterator[Any], steps: int
) -> None:
    """Begin the copies' episodes one after another, the last one when the first is nearly over."""
    starts = np.arange(env.num_envs) * steps // env.num_envs
    for step in range(int(starts.max()) + 1):
        beginning = starts == step
        if step and beginning.any():
            env.reset(options={"reset_mask": beginning})
        env.step(next(actions))
