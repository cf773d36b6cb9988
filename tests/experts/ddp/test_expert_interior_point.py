"""The expert's optima, handed to independent solvers: IPOPT and fatrop."""

import casadi
import pytest

from dq_space_arm_env import load_scene
from experts import BoxDDP, GuidedDDP
from experts.problems.arm_problem import ArmProblem
from scripts.benchmarks.peers.interior_point_peer import InteriorPoint
from scripts.benchmarks.peers.transcription import transcribe
from scripts.benchmarks.solvers.runs import FATROP

IN_LONG_STEPS = ("approach-corridor", "line-of-sight", "plume", "servicing")
# For which IPOPT takes minutes each.
CONSTRAINED = (
    "approach-corridor",
    "joint-limits",
    "keep-out",
    "line-of-sight",
    "pointing",
    "wheel-saturation",
)


@pytest.mark.endurance
def test_ipopt_finds_nothing_better_near_the_experts_plan():
    problem = ArmProblem("paper")
    solution = BoxDDP(problem).solve()
    program = transcribe(problem)
    # The two discretizations differ by 1e-7: the expert moves the pose by exponentials.
    plan = program.join(solution.states, solution.controls)
    replay = casadi.Function("replay", [program.variables], [program.cost, program.gaps])
    cost, gaps = replay(plan)
    assert float(cost) == pytest.approx(solution.cost, rel=1e-7)
    assert float(casadi.norm_inf(gaps)) < 1e-6

    run = InteriorPoint(problem, first_barrier=1e-4).solve(u_init=solution.controls, x_init=solution.states)
    assert run.converged, run.stop_reason
    assert solution.cost <= (1.0 + 1e-4) * run.replayed_cost


@pytest.mark.endurance
def test_ipopt_finds_the_experts_plan_from_zero_controls():
    problem = ArmProblem("paper")
    run = InteriorPoint(problem).solve()
    assert run.converged, run.stop_reason
    assert run.replayed_cost == pytest.approx(BoxDDP(problem).solve().cost, rel=1e-5)


@pytest.mark.endurance
@pytest.mark.parametrize("name", CONSTRAINED)
def test_ipopt_finds_the_experts_plan_under_constraints(name):
    """From the plan's neighborhood an interior-point method arrives at the same cost."""
    solution = GuidedDDP(name).solve()
    assert solution.converged
    ipopt = InteriorPoint(ArmProblem(name), first_barrier=1e-3, tolerance=1e-8)
    run = ipopt.solve(u_init=solution.controls, x_init=solution.states)
    assert run.converged, run.stop_reason
    assert solution.cost == pytest.approx(run.replayed_cost, rel=1e-6)


@pytest.mark.endurance
@pytest.mark.parametrize("name", IN_LONG_STEPS)
def test_ipopt_finds_the_experts_plan_in_long_steps(name):
    scene = load_scene(name).replace(simulation={"steps": 125, "dt": 0.12})
    solution = GuidedDDP(scene, coarsening=1).solve()
    assert solution.converged
    assert solution.multipliers[:-1].max() > 1.0  # rows of stages hold it back
    ipopt = InteriorPoint(ArmProblem(scene), first_barrier=1e-3, tolerance=1e-8)
    run = ipopt.solve(u_init=solution.controls, x_init=solution.states)
    assert run.converged, run.stop_reason
    assert solution.cost == pytest.approx(run.replayed_cost, rel=1e-6)


@pytest.mark.slow
def test_fatrop_finds_the_experts_plan_under_constraints():
    """In long steps: CasADi finds the derivatives here, a thousand steps would take minutes."""
    scene = load_scene("joint-limits").replace(simulation={"steps": 50, "dt": 0.3})
    problem = ArmProblem(scene)
    solution = BoxDDP(problem).solve()
    assert solution.converged
    run = InteriorPoint(problem, FATROP, first_barrier=1e-4, tolerance=1e-6).solve(
        u_init=solution.controls, x_init=solution.states
    )
    assert run.converged, run.stop_reason
    assert solution.cost == pytest.approx(run.replayed_cost, rel=1e-6)
