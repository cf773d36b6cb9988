"""The expert's optimum on scene `paper`, handed to an independent solver: IPOPT."""

import casadi
import numpy as np
import pytest

from experts import BoxDDP, GuidedDDP
from experts.problems.arm_problem import ArmProblem
from scripts.benchmarks.peers.ipopt_peer import solve_with_ipopt
from scripts.benchmarks.peers.ipopt_transcription import transcribe


@pytest.mark.slow
def test_ipopt_finds_nothing_better_near_the_experts_plan():
    problem = ArmProblem("paper")
    solution = BoxDDP(problem).solve()
    program = transcribe(problem.scene)
    # The two discretizations differ by 1e-7: the expert moves the pose by exponentials.
    plan = np.concatenate([solution.states.ravel(), solution.controls.ravel()])
    replay = casadi.Function("replay", [program.variables], [program.cost, program.gaps])
    cost, gaps = replay(plan)
    assert float(cost) == pytest.approx(solution.cost, rel=1e-7)
    assert float(casadi.norm_inf(gaps)) < 1e-6

    run = solve_with_ipopt(problem, u_init=solution.controls, x_init=solution.states, first_barrier=1e-4)
    assert run.converged, run.stop_reason
    assert solution.cost <= (1.0 + 1e-4) * run.replayed_cost


@pytest.mark.slow
def test_ipopt_finds_the_experts_plan_from_zero_controls():
    problem = ArmProblem("paper")
    run = solve_with_ipopt(problem)
    assert run.converged, run.stop_reason
    assert run.replayed_cost == pytest.approx(BoxDDP(problem).solve().cost, rel=1e-5)


@pytest.mark.slow
@pytest.mark.parametrize("name", ["joint-limits", "keep-out", "pointing"])
def test_ipopt_finds_the_experts_plan_under_constraints(name):
    """From the plan's neighborhood an interior-point method arrives at the same cost."""
    solution = GuidedDDP(name).solve()
    assert solution.converged
    run = solve_with_ipopt(
        ArmProblem(name),
        u_init=solution.controls,
        x_init=solution.states,
        first_barrier=1e-3,
        tolerance=1e-8,
    )
    assert run.converged, run.stop_reason
    assert solution.cost == pytest.approx(run.replayed_cost, rel=1e-6)
