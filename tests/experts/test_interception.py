"""The expert meets targets that move: along the nominal path, along drawn ones, and along one it is told."""

from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray

from dq_space_arm_env import DQSpaceArmEnv, compile_scene
from experts import GuidedDDP, RecedingHorizonExpert, Solution

Array = NDArray[np.float64]

FASTER = {"target.velocity.omega_x": 0.02, "target.velocity.v_y": 0.01}  # rad/s, m/s


def tip_errors(name: str, states: Array, rows: Array) -> tuple[Array, Array]:
    """Angle [deg] and distance [m] of the tip from the target, stage by stage."""
    angle, distance = compile_scene(name).observation(states, np.zeros((len(states), 1)), p=rows)[1].T
    return np.degrees(angle), distance


def replay(env: DQSpaceArmEnv, solution: Solution) -> tuple[float, dict[str, Any]]:
    total, info = 0.0, {}
    for control in solution.controls:
        _, reward, _, _, info = env.step(control / env.kernels.layout.control_limit)
        total += reward
    return total, info


@pytest.mark.slow
def test_the_tip_follows_a_target_along_a_screw() -> None:
    """Within a millimeter from the fourth second on, where the file says so."""
    solution = GuidedDDP("tracking").solve()
    assert solution.converged
    rows = compile_scene("tracking").stage_parameters()
    np.testing.assert_array_equal(solution.parameters, rows)
    angle, distance = tip_errors("tracking", solution.states, rows)
    assert distance[0] > 0.3
    assert distance[267:].max() < 1e-3
    assert angle[267:].max() < 0.05
    env = DQSpaceArmEnv("tracking")
    env.reset(options={"nominal": True})
    total, info = replay(env, solution)
    assert total == pytest.approx(-solution.cost, rel=1e-12)
    assert info["is_success"]


@pytest.mark.slow
def test_drawn_tumbles_are_met_at_rest_relative_to_them() -> None:
    solver, env = GuidedDDP("tumbling-target"), DQSpaceArmEnv("tumbling-target")
    for seed in range(8):
        env.reset(seed=seed)
        solution = solver.solve(env.state, parameters=env.parameters)
        assert solution.converged, solution.message
        total, info = replay(env, solution)
        assert total == pytest.approx(-solution.cost, rel=1e-12)
        assert info["is_success"]
        assert info["velocity_error"] < 2e-3
        assert info["angular_velocity_error"] < 0.1


@pytest.mark.slow
@pytest.mark.parametrize("told", ["at the start", "in mid-flight"])
def test_the_receding_horizon_expert_meets_a_target_that_moves_as_it_is_told(told: str) -> None:
    """Its tumble is not the nominal one; told later, the expert has planned for the nominal one first."""
    env, expert = DQSpaceArmEnv("tumbling-target"), RecedingHorizonExpert("tumbling-target")
    parameters = env.kernels.parameters.nominal.copy()
    for name, change in FASTER.items():
        parameters[env.kernels.parameters.names.index(name)] += change
    observation, _ = env.reset(options={"nominal": True, "parameters": parameters})
    known = parameters if told == "at the start" else None
    expert.reset(observation, parameters=known)
    over, step, info = False, 0, {}
    while not over:
        if step == 200 and known is None:
            expert.inform(parameters)
        told_by_now = known is not None or step >= 200
        # Before it is told, it sees the state only: the observation is relative to the true target.
        action = expert(observation if told_by_now else env.state)
        observation, _, over, _, info = env.step(action)
        step += 1
    assert info["is_success"], info
