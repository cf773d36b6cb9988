"""The receding-horizon expert in simulated episodes: time per action, and cost beside that of its plan.

An episode is flown several times with the same disturbances: by the expert with each of its horizons, by the
feedback policy of the full-horizon plan, and with the plan's controls alone.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass

import numpy as np

from dq_space_arm_env import Scene
from dq_space_arm_env.environment.disturbances import Disturbances, with_loads
from dq_space_arm_env.environment.rollouts import Rollout, StateFeedback, rollout
from experts.maneuver_plan import ManeuverPlan
from experts.problems.arm_problem import ArmProblem
from experts.problems.shooting_problem import FloatArray
from experts.receding_horizon import RecedingHorizonExpert
from scripts.benchmarks.effort import Effort
from scripts.benchmarks.harness import Row, claim, note

PUSH = 0.02  # standard deviation of the jumps of all base velocities, rad/s and m/s
PUSHES = 6  # in an episode, evenly apart
NOISE = 0.01  # standard deviation on every tangent coordinate of the measured state, rad, m, rad/s, m/s
MASS_FACTORS = (0.8, 1.2)
UNDISTURBED = "none"
HORIZON_LOSS = 0.05
"""Largest cost of looking ahead for a part of the maneuver, relative to the plan, undisturbed."""

Controller = Callable[[FloatArray, int], FloatArray]
"""From a state, shape (n_x,), and a stage to an action, shape (n_u,), fractions of the limits."""


@dataclass(frozen=True)
class World:
    """Deviations of the simulated world from the plan's."""

    name: str
    push: float | None = None
    noise: float | None = None
    mass_factor: float = 1.0

    @property
    def is_random(self) -> bool:
        """Whether episodes differ by their seeds."""
        return self.push is not None or self.noise is not None


def worlds(scene: Scene, other_masses: bool) -> list[World]:
    """No disturbance, pushes, noise, and other masses."""
    found = [
        World(UNDISTURBED),
        World(f"pushes, {PUSH:g} rad/s, m/s", push=PUSH),
        World(f"noise, {NOISE:g} rad, m, /s", noise=NOISE),
    ]
    if other_masses and (scene.payload or scene.links):
        body = "payload" if scene.payload else "last link"
        found += [World(f"{body} x {factor:g}", mass_factor=factor) for factor in MASS_FACTORS]
    return found


def fly(problem: ArmProblem, controller: Controller, world: World, seed: int) -> Rollout:
    """Simulate an episode from the problem's initial state."""
    scene = problem.scene
    rng = np.random.default_rng(seed)
    found = Disturbances(scene, rng, push=world.push, pushes=PUSHES, evenly=True, measurement=world.noise)
    policy = StateFeedback(lambda states, stage: controller(states[0], stage)[None])
    parameters = None
    if world.mass_factor != 1.0:
        scene, parameters = with_loads(scene, [world.mass_factor])
    starts = problem.initial_state[None]
    return rollout(policy, scene, starts=starts, parameters=parameters, disturbances=found)


def cost_of(flight: Rollout) -> float:
    """Cost of the only episode; infinite if the simulation diverged."""
    return np.inf if flight.diverged[0] else float(flight.cost[0])


def measure_flights(problem: ArmProblem, effort: Effort) -> Iterator[Row]:
    """Fly a scene's nominal maneuver with each horizon under each disturbance."""
    scene = problem.scene
    horizons = [min(horizon, problem.horizon) for horizon in effort.horizons]
    try:
        experts = [RecedingHorizonExpert(scene, horizon) for horizon in dict.fromkeys(horizons)]
        plan = _plan(experts[0], problem)
    except RuntimeError as error:  # no maneuver can be simulated from the start
        yield note(f"Scene {scene.name} has no receding horizon: {error}")
        return
    for world in worlds(scene, effort.other_masses):
        seeds = [effort.seed + i for i in range(effort.episodes if world.is_random else 1)]
        policy, open_loop = (
            [cost_of(fly(problem, _acting(problem, control), world, seed)) for seed in seeds]
            for control in (plan.policy, lambda state, stage: np.asarray(plan.solution.controls[stage]))
        )
        for expert in experts:
            row = _flight(problem, expert, world, seeds)
            yield {**row, "policy_cost": float(np.mean(policy)), "open_loop_cost": float(np.mean(open_loop))}
            if not world.is_random and world.mass_factor == 1.0:
                loss = row["cost"] / row["plan_cost"] - 1.0
                subject, remark = f"horizon of {expert.horizon}", "cost above that of the plan, relative"
                yield claim(
                    "receding horizon", f"scene {scene.name}", subject, loss, HORIZON_LOSS, note=remark
                )


def _acting(problem: ArmProblem, control: Callable[[FloatArray, int], FloatArray]) -> Controller:
    """Scale controls, in units of the scene, to actions."""
    layout, rows = problem.kernels.layout, problem.parameters.rows
    return lambda state, stage: layout.to_action(control(state, stage), rows[stage])


def _plan(expert: RecedingHorizonExpert, problem: ArmProblem) -> ManeuverPlan:
    expert.reset(problem.initial_state)
    assert expert.plan is not None  # `reset` with a state plans
    return expert.plan


def _flight(problem: ArmProblem, expert: RecedingHorizonExpert, world: World, seeds: list[int]) -> Row:
    """Fly the expert and time its actions; the plan is made before the clock starts."""
    flights, fallbacks, replans, plan_cost = [], 0, 0, 0.0
    for seed in seeds:
        plan_cost = _plan(expert, problem).solution.cost
        flights.append(fly(problem, lambda state, stage: expert(state), world, seed))
        fallbacks += expert.fallbacks
        replans += expert.replans
    times = 1e3 * np.concatenate([flight.action_seconds[: flight.length[0]] for flight in flights])
    period = 1e3 * problem.time_step
    return {
        "table": "flights",
        "scene": problem.scene.name,
        "disturbance": world.name,
        "horizon": expert.horizon,
        "period_ms": period,
        "median_ms": float(np.median(times)),
        "percentile_99_ms": float(np.percentile(times, 99)),
        "late": float(np.mean(times > period)),
        "plan_cost": plan_cost,
        "cost": float(np.mean([cost_of(flight) for flight in flights])),
        "success": float(np.mean([flight.is_success[0] for flight in flights])),
        "replans": replans / len(flights),
        "attitude_error_deg": max(float(flight.attitude_error[0]) for flight in flights),
        "position_error_m": max(float(flight.position_error[0]) for flight in flights),
        "fallbacks": fallbacks,
    }
