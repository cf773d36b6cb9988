"""A flight of an agent, and the expert's solution from the same start."""

from __future__ import annotations

from dataclasses import dataclass
from time import perf_counter
from typing import Any

import numpy as np
from gymnasium.vector import AutoresetMode

from agents.evaluation.flights import time_per_action
from agents.evaluation.policies import ActingPolicy, check_fit
from dq_space_arm_env import DQSpaceArmVectorEnv, Scene
from experts.arm_problem import ArmProblem
from experts.guesses import GuidedDDP
from experts.report.maneuver import Maneuver


@dataclass(frozen=True, eq=False)
class Side:
    """One of two maneuvers.

    Attributes:
        name: Who flies it.
        maneuver: Its states and controls; shorter than the scene's if it diverged.
        cost: J, dimensionless.
        is_success: Whether the tip ended within the scene's tolerances.
        seconds: Time for an action of the agent, or for the whole solution of the expert, s.
    """

    name: str
    maneuver: Maneuver
    cost: float
    is_success: bool
    seconds: float

    @property
    def attitude_error(self) -> float:
        """Of the tip at the end, deg."""
        return float(np.degrees(self.maneuver.angle[-1]))

    @property
    def position_error(self) -> float:
        """Of the tip at the end, m."""
        return float(self.maneuver.distance[-1])

    @property
    def effort(self) -> float:
        """What the cost charges for controls in all, dimensionless."""
        return float(sum(actuator.effort for actuator in self.maneuver.actuators))


@dataclass(frozen=True, eq=False)
class SideBySide:
    """An agent's flight and the expert's solution.

    Attributes:
        seed: Of the start; None for the nominal one.
        agent: The agent's flight.
        expert: The expert's solution.
        converged: Whether that is an optimum; else the best trajectory found.
    """

    seed: int | None
    agent: Side
    expert: Side
    converged: bool

    @property
    def cost_gap(self) -> float:
        """J / J_expert - 1."""
        return self.agent.cost / self.expert.cost - 1.0 if self.expert.cost else float("nan")

    def record(self) -> dict[str, Any]:
        """Write it down.

        Returns:
            JSON values, None for numbers that are not finite.
        """
        sides = {
            name: {
                "name": side.name,
                "cost": _finite(side.cost),
                "is_success": side.is_success,
                "attitude_error": _finite(side.attitude_error),
                "position_error": _finite(side.position_error),
                "effort": _finite(side.effort),
                "steps": len(side.maneuver.controls),
            }
            for name, side in (("agent", self.agent), ("expert", self.expert))
        }
        return {
            "scene": self.agent.maneuver.scene.name,
            "seed": self.seed,
            "cost_gap": _finite(self.cost_gap),
            "converged": self.converged,
            "action_seconds": self.agent.seconds,
            "solve_seconds": self.expert.seconds,
            **sides,
        }


def fly_beside_expert(policy: ActingPolicy, scene: Scene, seeds: list[int | None]) -> list[SideBySide]:
    """Let an agent fly, and solve for the same starts.

    Args:
        policy: The agent.
        scene: The scene.
        seeds: Of the starts; None for the nominal one.

    Returns:
        A pair for each start.

    Raises:
        PolicyError: If the policy does not fit the scene.
        ValueError: If the scene draws a target or masses for each episode, or the policy gives something that
            is no action.
        KeyboardInterrupt: If the user interrupts it.
    """
    check_fit(policy, scene)
    environment = DQSpaceArmVectorEnv(1, scene, autoreset_mode=AutoresetMode.DISABLED)
    if environment.parameters.size:
        raise ValueError(
            f"scene {scene.name!r} draws more than the start for each episode; the expert would have to be "
            "compiled anew for it: take a scene whose spread has no target, masses or inertias"
        )
    problem = ArmProblem(scene)
    solver = GuidedDDP(problem)
    action_seconds = time_per_action(policy.act_once, scene, batched=policy.batched)
    pairs = []
    for seed in seeds:
        agent = _flown(policy, environment, seed, action_seconds)
        started = perf_counter()
        solution = solver.solve(agent.maneuver.states[0])
        seconds = perf_counter() - started
        maneuver = Maneuver(scene, solution.states, solution.controls)
        success = problem.is_success(solution.states[-1])
        expert = Side("expert", maneuver, solution.cost, success, seconds)
        pairs.append(SideBySide(seed, agent, expert, solution.converged))
    return pairs


def _flown(policy: ActingPolicy, environment: DQSpaceArmVectorEnv, seed: int | None, seconds: float) -> Side:
    if seed is None:
        observation, info = environment.reset(options={"nominal": True})
    else:
        observation, info = environment.reset(seed=[seed])
    begin = getattr(policy.act, "begin", None)
    if begin is not None:
        begin(environment)
    states, actions, cost = [environment.states[0]], [], 0.0
    over = False
    while not over:
        action = np.clip(np.asarray(policy.act(observation), dtype=np.float64), -1.0, 1.0)
        observation, reward, terminated, _, info = environment.step(action)
        cost -= float(reward[0])
        actions.append(action[0])
        states.append(environment.states[0])
        over = bool(terminated[0])
    scene = environment.scene
    controls = np.array(actions) * environment.kernels.layout.control_limit
    maneuver = Maneuver(scene, np.array(states, dtype=np.float64), controls)
    return Side(policy.label, maneuver, cost, bool(info["is_success"][0]), seconds)


def _finite(value: float) -> float | None:
    return value if np.isfinite(value) else None
