"""Problems of one's own, and a constrained maneuver, beside Crocoddyl: the same optimum, the same kernels."""

from dataclasses import replace

import numpy as np
import pytest

from dq_space_arm_env import load_scene
from experts import BoxDDP
from experts.problems.arm_problem import ArmProblem
from scripts.benchmarks.effort import QUICK
from scripts.benchmarks.peers import crocoddyl_kernels, crocoddyl_penalties
from scripts.benchmarks.solvers.constrained import violation
from scripts.benchmarks.solvers.own_problems import measure_own_problems
from scripts.benchmarks.solvers.runs import TITLES
from scripts.examples.cart_pole import cart_pole
from scripts.examples.planar_quadrotor import HOVER, planar_quadrotor


def test_own_problems_are_measured_without_other_solvers() -> None:
    found = list(measure_own_problems(replace(QUICK, max_iterations=100)))
    rows = [row for row in found if row["table"] == "own problems"]
    assert {row["name"] for row in rows} == {"cart-pole", "planar quadrotor"}
    assert [row["solver"] for row in rows[: len(TITLES)]] == [f"BoxDDP, {title}" for title in TITLES.values()]
    assert all(row["converged"] for row in rows if row["solver"] == "BoxDDP, hybrid")
    assert all(row["status"] == "handled" for row in found if row["table"] == "claims")
    assert [row["note"] for row in found if row["table"] == "notes"] == ["Other solvers are left out."]


def test_crocoddyl_finds_the_same_optima_with_the_same_kernels() -> None:
    sentence = crocoddyl_kernels.obstacle()
    if sentence is not None:
        pytest.skip(sentence)
    for problem, first in ((cart_pole(), 0.0), (planar_quadrotor(), HOVER)):
        controls = np.full((problem.horizon, problem.n_controls), first)
        expected = BoxDDP(problem).solve(u_init=controls)
        for method in crocoddyl_kernels.METHODS:
            found, seconds, costs, converged = crocoddyl_kernels.solve_with_crocoddyl(
                problem, controls, method=method, max_iterations=300
            )
            replayed = BoxDDP(problem, max_iterations=0).solve(u_init=found).cost
            assert converged
            assert np.all(np.diff(seconds) > 0.0)
            assert replayed == pytest.approx(costs[-1], rel=1e-12)
            assert replayed == pytest.approx(expected.cost, rel=1e-5)


def test_crocoddyl_with_penalties_finds_a_constrained_optimum() -> None:
    """Only where Crocoddyl, headers and a compiler are: rows kept within 1e-6, and the expert's cost."""
    sentence = crocoddyl_kernels.obstacle()
    if sentence is not None:
        pytest.skip(sentence)
    scene = load_scene("joint-limits")
    duration = scene.simulation.dt * scene.simulation.steps
    problem = ArmProblem(scene.replace(simulation={"steps": 50, "dt": duration / 50}))
    run, expected = crocoddyl_penalties.solve_with_penalties(problem, None, 200), BoxDDP(problem).solve()
    assert run.converged
    assert violation(problem, problem.initial_state, run) <= crocoddyl_penalties.ALLOWED
    assert run.replayed_cost == pytest.approx(expected.cost, rel=1e-6)
