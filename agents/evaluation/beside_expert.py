"""A flight of an agent beside the expert's solution from the same start."""

from __future__ import annotations

import math
from dataclasses import dataclass
from time import perf_counter
from typing import Any

import numpy as np

from agents.policies.flying import time_per_action
from agents.zoo.finding import ActingPolicy, check_fit
from dq_space_arm_env import Scene
from dq_space_arm_env.common.files import json_value
from dq_space_arm_env.environment.rollouts import rollout
from dq_space_arm_env.scene.start import episode_scene
from experts.ddp.solution import uninterrupted
from experts.guesses.guided import GuidedDDP
from experts.maneuver import Maneuver
from experts.problems.arm_problem import ArmProblem


@dataclass(frozen=True, eq=False)
class Side:
    """One of two maneuvers."""

    name: str
    maneuver: Maneuver  # shorter than the scene's if it diverged
    cost: float  # J, dimensionless
    is_success: bool
    seconds: float  # per action of the agent, or for the whole solution of the expert, s

    def record(self) -> dict[str, Any]:
        """The maneuver as JSON values."""
        facts = {
            "name": self.name,
            "cost": self.cost,
            "is_success": self.is_success,
            "attitude_error": float(np.degrees(self.maneuver.angle[-1])),  # deg
            "position_error": float(self.maneuver.distance[-1]),  # m
            "effort": float(sum(actuator.effort for actuator in self.maneuver.actuators)),
            "steps": len(self.maneuver.controls),
        }
        return dict(json_value(facts))


@dataclass(frozen=True, eq=False)
class SideBySide:
    """An agent's flight and the expert's solution."""

    seed: int | None  # of the start; None for the nominal one
    agent: Side
    expert: Side
    converged: bool  # whether the solution is an optimum; else the best trajectory found

    @property
    def cost_gap(self) -> float:
        """J / J_expert - 1."""
        return self.agent.cost / self.expert.cost - 1.0 if self.expert.cost else math.nan

    def record(self) -> dict[str, Any]:
        """Both maneuvers as JSON values."""
        return {
            "scene": self.agent.maneuver.scene.name,
            "seed": self.seed,
            "cost_gap": json_value(self.cost_gap),
            "converged": self.converged,
            "action_seconds": self.agent.seconds,
            "solve_seconds": self.expert.seconds,
            "agent": self.agent.record(),
            "expert": self.expert.record(),
        }


def fly_beside_expert(policy: ActingPolicy, scene: Scene, seeds: list[int | None]) -> list[SideBySide]:
    """Fly an agent, and solve from the same starts; None is the nominal start.

    Raises PolicyError if the policy does not fit the scene, and ValueError if the policy gives NaN.
    """
    check_fit(policy, scene)
    problem = ArmProblem(scene)
    solver = GuidedDDP(problem)
    action_seconds = time_per_action(policy.act_once, scene, batched=policy.batched)
    pairs = []
    for seed in seeds:
        flown = rollout(policy.act, scene, None if seed is None else [seed], record=True)
        if flown.policy_failed[0]:
            raise ValueError(f"{policy.label} gives NaN in place of an action")
        path, parameters = flown.trajectory(), flown.parameters[0]
        flown_in = episode_scene(scene, parameters.tolist())
        caught = flown.caught is None or bool(flown.caught[0])
        maneuver = Maneuver(flown_in, path.states, path.controls, caught)
        agent = Side(policy.label, maneuver, path.cost, path.is_success, action_seconds)
        started = perf_counter()
        solution = uninterrupted(solver.solve(path.states[0], parameters=parameters))
        seconds = perf_counter() - started
        maneuver = Maneuver(flown_in, solution.states, solution.controls)
        success = problem.is_success(solution.states, solution.controls)
        expert = Side("expert", maneuver, solution.cost, success, seconds)
        pairs.append(SideBySide(seed, agent, expert, solution.converged))
    return pairs
