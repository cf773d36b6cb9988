"""The expert plans across catches, releases and changes of the base's mass."""

import gymnasium
import numpy as np
import pytest

import dq_space_arm_env
from experts import GuidedDDP


@pytest.mark.parametrize(
    "name",
    [
        pytest.param("capture-and-detumble", marks=pytest.mark.slow),
        *(pytest.param(name, marks=pytest.mark.endurance) for name in ("release", "refuelling")),
    ],
)
def test_plans_across_phases_succeed_in_the_environment(name: str) -> None:
    """From drawn starts: the plan's cost is the episode's, and the payload is caught and brought to rest."""
    env = gymnasium.make("DQSpaceArm-v0", scene=name).unwrapped
    assert isinstance(env, dq_space_arm_env.DQSpaceArmEnv)
    solver = GuidedDDP(name)
    for seed in range(3):
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
