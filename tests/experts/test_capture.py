"""The expert plans across catches, releases and changes of the base's mass."""

import subprocess
import sys

import gymnasium
import numpy as np
import pytest

import dq_space_arm_env
from experts import GuidedDDP
from experts.problems.arm_problem import ArmProblem

SCENES = ("capture-and-detumble", "release", "refuelling")


@pytest.mark.parametrize(
    ("name", "starts"),
    [
        pytest.param("capture-and-detumble", 1, marks=pytest.mark.slow),
        *(pytest.param(name, 3, marks=pytest.mark.endurance) for name in SCENES),
    ],
)
def test_plans_across_phases_succeed_in_the_environment(name: str, starts: int) -> None:
    """From drawn starts: the plan's cost is the episode's, and the payload is caught and brought to rest."""
    env = gymnasium.make("DQSpaceArm-v0", scene=name).unwrapped
    assert isinstance(env, dq_space_arm_env.DQSpaceArmEnv)
    solver = GuidedDDP(name)
    for seed in range(starts):
        env.reset(seed=seed)
        solution = solver.solve(env.state, parameters=env.parameters)
        assert solution.converged
        # Long steps are the same problem: they have the catch, and the weights of each phase.
        assert solution.metadata["long_steps"][-1]["cost"] == pytest.approx(solution.cost, rel=0.15)
        returned, shock = 0.0, 0.0
        for control in solution.controls:
            _, reward, _, _, info = env.step(env.kernels.layout.to_action(control))
            returned, shock = returned + float(reward), max(shock, info.get("shock", 0.0))
        assert info["is_success"]
        assert returned == pytest.approx(-solution.cost, rel=1e-12)
        assert np.abs(env.state - solution.states[-1]).max() < 1e-12
        if "caught" in info:
            assert info["caught"] == 1.0
            assert 0.0 < shock < 0.05  # N s: they meet at rest


@pytest.mark.slow
def test_an_end_within_the_tolerances_is_no_success_without_the_catch() -> None:
    """The answers of the environment, from every stage of the flight on."""
    lengths = {f"phases.{index}.steps": steps for index, steps in enumerate((6, 1, 5))}
    names = ("attitude_error_deg", "position_error", "angular_velocity_error_deg", "velocity_error")
    wide = dict.fromkeys(names, 180.0)
    scene = dq_space_arm_env.load_scene("capture-and-detumble")
    scene = scene.replace({**lengths, "simulation.steps": 12, "success": wide})
    for found, expected in ((wide, True), ({**wide, "position_error": 1e-3}, False)):
        env = dq_space_arm_env.DQSpaceArmEnv(scene.replace({"phases.2.catch": found}))
        env.reset(options={"nominal": True})
        states, controls = [env.state], np.zeros((12, env.kernels.n_u))
        for _ in controls:
            *_, info = env.step(np.zeros(env.kernels.n_u))
            states.append(env.state)
        problem = ArmProblem(env.scene)
        assert problem.misses(states[-1]) < 1.0
        assert problem.is_success(np.array(states), controls) == info["is_success"] == expected
        assert problem.is_success(np.array(states[6:]), controls[6:]) == expected  # it is caught in step 7
        assert problem.is_success(np.array(states[7:]), controls[7:])
        assert not problem.is_success(np.full((6, env.kernels.n_x), np.nan), controls[7:])


@pytest.mark.slow
def test_long_steps_leave_open_whether_a_catch_is_met() -> None:
    lengths = {f"phases.{index}.steps": steps for index, steps in enumerate((1, 1, 10))}
    wide, narrow = ({"attitude_error_deg": 180.0, "position_error": most} for most in (180.0, 1e-6))
    scene = dq_space_arm_env.load_scene("capture-and-detumble")
    changes = {**lengths, "simulation.steps": 12, "success": wide, "phases.2.catch": narrow}
    problem = ArmProblem(scene.replace(changes))
    states = np.tile(problem.initial_state, (13, 1))
    controls = np.zeros((12, problem.n_controls))
    assert not problem.is_success(states, controls)
    assert problem.coarsened(2).is_success(states[::2], controls[::2])


def test_a_problem_loads_no_environment() -> None:
    code = (
        "import sys, experts.problems.arm_problem; assert 'dq_space_arm_env.environment' not in sys.modules"
    )
    subprocess.run([sys.executable, "-c", code], check=True)
