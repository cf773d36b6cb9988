"""The solver's loops are the same for all problems: each is compiled once."""

import numpy as np
import pytest

from dq_space_arm_env import Scene, load_scene
from experts.ddp import shooting
from experts.ddp.backward_pass import backward_pass
from experts.ddp.derivatives import change_by_rounding, find_costates
from experts.ddp.parallel_rollouts import _roll_out
from experts.ddp.rollout import closed_loop_rollout, rollout
from experts.problems.arm_problem import ArmProblem

LOOPS = (rollout, closed_loop_rollout, _roll_out, find_costates, change_by_rounding)


@pytest.mark.slow
def test_no_scene_needs_other_loops():
    shooting.compile_other_loops()
    compiled = [set(loop.overloads) for loop in LOOPS]
    exercise(load_scene("planar"))
    longest = set(backward_pass.overloads)
    for name in ("refuelling", "joint-limits"):  # limits of phases; constraints
        exercise(load_scene(name))
    assert [set(loop.overloads) for loop in LOOPS] == compiled
    assert set(backward_pass.overloads) == longest


def exercise(scene: Scene) -> None:
    problem = ArmProblem(scene)
    work = shooting.ShootingWorkspace(problem, second_order=True)
    work.start(problem.initial_state, np.zeros((problem.horizon, problem.n_controls)))
    work.differentiate()
    work.differentiate_twice()
    work.backward_pass(1.0)
    work.cost_rounding()
    work.try_step(1.0)
    work.try_steps(shooting.SHORTER_STEPS)


def test_a_second_workspace_does_not_ask_for_its_loops(monkeypatch: pytest.MonkeyPatch):
    shooting.compile_other_loops()
    monkeypatch.setattr(shooting, "is_prepared", None)
    monkeypatch.setattr(shooting, "prepare", None)
    shooting.compile_other_loops()
