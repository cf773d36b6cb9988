"""The receding-horizon expert in a simulated episode: time per action, and what it costs beside its plan.

An episode is flown several times with the same disturbances: by the expert, with each of its horizons, by the
feedback policy of the full-horizon plan, and with the plan's controls alone.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from time import perf_counter
from typing import Any

import numpy as np

from dq_space_arm_env import Kernels, Scene, compile_scene
from experts.arm_problem import ArmProblem
from experts.maneuver_plan import ManeuverPlan
from experts.problem import FloatArray
from experts.receding_horizon import RecedingHorizonExpert
from experts.report.solvers.effort import Effort

PUSH = 0.02
"""Standard deviation of the jumps of all base velocities, rad/s and m/s."""
PUSHES = 6
"""Pushes in an episode, evenly apart."""
NOISE = 0.01
"""Standard deviation of the noise on every tangent coordinate of the state that the policy sees, rad, m,
rad/s, m/s."""
MASS_FACTORS = (0.8, 1.2)
UNDISTURBED = "none"
"""Name of the disturbance that is none."""

Control = Callable[[FloatArray, int], FloatArray]
"""Function of a state, shape (n_x,), and a stage; it returns a control, shape (n_u,), units of the scene."""


@dataclass(frozen=True)
class Disturbance:
    """What differs from the plan's world.

    Attributes:
        name: Its name.
        push: Standard deviation of the pushes, rad/s and m/s.
        noise: Standard deviation of the noise on the state.
        mass_factor: Factor of mass and inertia of the payload, or of the last link if there is no payload.
    """

    name: str
    push: float = 0.0
    noise: float = 0.0
    mass_factor: float = 1.0

    @property
    def is_random(self) -> bool:
        """Whether episodes differ by their seeds."""
        return self.push > 0.0 or self.noise > 0.0


@dataclass(frozen=True)
class Episode:
    """An episode that was flown.

    Attributes:
        cost: Total cost, dimensionless; inf if it was not finite.
        attitude_error_deg: Euler angle of the tip's attitude error at the end, deg.
        position_error: Distance of the tip from the target at the end, m.
    """

    cost: float
    attitude_error_deg: float
    position_error: float


@dataclass(frozen=True)
class Flight:
    """Episodes that the expert has flown with one horizon under one disturbance.

    Attributes:
        scene: Name of the scene.
        disturbance: Name of the disturbance.
        horizon: Stages that it looks ahead.
        period_ms: Duration of a stage, ms.
        median_ms: Median time per action, ms.
        percentile_99_ms: 99th percentile of it, ms.
        late: Share of the actions that took longer than a stage.
        plan_cost: Cost of the full-horizon plan, undisturbed.
        costs: Cost of each episode.
        policy_costs: The same flown by the plan's feedback policy.
        open_loop_costs: The same flown with the plan's controls alone.
        attitude_error_deg: Largest attitude error at the end of an episode, deg.
        position_error: Largest position error at the end of an episode, m.
        fallbacks: Actions that were the plan's since no finite rollout began at the state.
    """

    scene: str
    disturbance: str
    horizon: int
    period_ms: float
    median_ms: float
    percentile_99_ms: float
    late: float
    plan_cost: float
    costs: tuple[float, ...]
    policy_costs: tuple[float, ...]
    open_loop_costs: tuple[float, ...]
    attitude_error_deg: float
    position_error: float
    fallbacks: int


def disturbances(scene: Scene, other_masses: bool) -> list[Disturbance]:
    """List the disturbances for a scene.

    Args:
        scene: The scene.
        other_masses: Whether masses are among them.

    Returns:
        None, pushes, noise, and other masses.
    """
    found = [
        Disturbance(UNDISTURBED),
        Disturbance(f"pushes, {PUSH:g} rad/s, m/s", push=PUSH),
        Disturbance(f"noise, {NOISE:g} rad, m, /s", noise=NOISE),
    ]
    if other_masses and (scene.payload or scene.links):
        body = "payload" if scene.payload else "last link"
        found += [Disturbance(f"{body} x {factor:g}", mass_factor=factor) for factor in MASS_FACTORS]
    return found


def fly(
    kernels: Kernels, control: Control, disturbance: Disturbance, start: FloatArray, seed: int
) -> Episode:
    """Simulate an episode.

    Args:
        kernels: The world.
        control: Who flies.
        disturbance: Pushes and noise.
        start: State at stage 0, shape (n_x,), units of the state.
        seed: Seed of pushes and noise.

    Returns:
        What it cost and where it ended.
    """
    rng = np.random.default_rng(seed)
    steps = kernels.scene.simulation.steps
    interval = max(steps // (PUSHES + 1), 1)
    state, cost = start, 0.0
    jump = np.zeros(kernels.n_t)
    velocity = kernels.layout.tangent.base_velocity
    for k in range(steps):
        if disturbance.push and k % interval == interval - 1:
            jump[velocity] = disturbance.push * rng.normal(size=velocity.stop - velocity.start)
            state = kernels.retract(state, jump)
        seen = state
        if disturbance.noise:
            seen = kernels.retract(state, disturbance.noise * rng.normal(size=kernels.n_t))
        u = control(seen, k)
        cost += float(kernels.cost(state, u))
        state = kernels.step(state, u)
        if not np.isfinite(state).all():
            return Episode(np.inf, np.inf, np.inf)
    angle, distance = kernels.observation(state, [0.0])[1]
    return Episode(cost + float(kernels.terminal_cost(state)), float(np.degrees(angle)), float(distance))


def measure_flights(problem: ArmProblem, effort: Effort, seed: int) -> Iterator[Flight]:
    """Fly a scene's nominal maneuver with each horizon under each disturbance.

    Args:
        problem: The maneuver.
        effort: How much to measure.
        seed: First seed of the disturbances.

    Yields:
        What the expert did.
    """
    scene, start = problem.scene, problem.initial_state
    horizons = [min(horizon, problem.horizon) for horizon in effort.horizons]
    experts = [RecedingHorizonExpert(scene, horizon) for horizon in dict.fromkeys(horizons)]
    plan = _plan(experts[0], start)
    for disturbance in disturbances(scene, effort.other_masses):
        world = compile_scene(with_masses(scene, disturbance.mass_factor))
        seeds = [seed + i for i in range(effort.episodes if disturbance.is_random else 1)]
        baselines = [
            tuple(fly(world, control, disturbance, start, each).cost for each in seeds)
            for control in (plan.policy, _open_loop(plan.solution.controls))
        ]
        for expert in experts:
            yield _flight(problem, expert, world, disturbance, seeds, *baselines)


def _plan(expert: RecedingHorizonExpert, start: FloatArray) -> ManeuverPlan:
    expert.reset(start)
    assert expert.plan is not None  # `reset` with a state plans
    return expert.plan


def _open_loop(controls: FloatArray) -> Control:
    return lambda state, stage: np.asarray(controls[stage])


def _flight(
    problem: ArmProblem,
    expert: RecedingHorizonExpert,
    world: Kernels,
    disturbance: Disturbance,
    seeds: Sequence[int],
    policy_costs: tuple[float, ...],
    open_loop_costs: tuple[float, ...],
) -> Flight:
    """Have the expert fly with a clock; the plan is made before the clock starts."""
    seconds: list[float] = []
    limits = problem.control_upper

    def control(state: FloatArray, stage: int) -> FloatArray:
        started = perf_counter()
        action = expert(state)
        seconds.append(perf_counter() - started)
        return np.asarray(action * limits)

    episodes, fallbacks, start = [], 0, problem.initial_state
    for seed in seeds:
        plan = _plan(expert, start)
        episodes.append(fly(world, control, disturbance, start, seed))
        fallbacks += expert.fallbacks
    times = 1e3 * np.array(seconds)
    period = 1e3 * problem.time_step
    return Flight(
        scene=problem.scene.name,
        disturbance=disturbance.name,
        horizon=expert.horizon,
        period_ms=period,
        median_ms=float(np.median(times)),
        percentile_99_ms=float(np.percentile(times, 99)),
        late=float(np.mean(times > period)),
        plan_cost=plan.solution.cost,
        costs=tuple(episode.cost for episode in episodes),
        policy_costs=policy_costs,
        open_loop_costs=open_loop_costs,
        attitude_error_deg=max(episode.attitude_error_deg for episode in episodes),
        position_error=max(episode.position_error for episode in episodes),
        fallbacks=fallbacks,
    )


def with_masses(scene: Scene, factor: float) -> Scene:
    """Multiply mass and inertia of the payload, or of the last link if there is no payload.

    Args:
        scene: A scene with a payload or a link, unless the factor is 1.
        factor: The factor.

    Returns:
        The changed scene.
    """
    if factor == 1.0:
        return scene
    if scene.payload is not None:
        return scene.replace(payload=_scaled(scene.payload.model_dump(), factor))
    links = [link.model_dump() for link in scene.links]
    return scene.replace(links=[*links[:-1], _scaled(links[-1], factor)])


def _scaled(body: dict[str, Any], factor: float) -> dict[str, Any]:
    inertia = (factor * np.array(body["inertia"])).tolist()
    return {**body, "mass": factor * body["mass"], "inertia": inertia}
