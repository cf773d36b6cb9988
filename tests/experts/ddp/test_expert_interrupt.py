"""Ctrl-C during a solve: the process survives and returns the best trajectory so far."""

import os
import signal
import subprocess
import sys
import time
from dataclasses import replace

import pytest
from rich.console import Console

from dq_space_arm_env import load_scene
from dq_space_arm_env.command_line.simulated_episode import begin
from dq_space_arm_env.environment.dq_space_arm import DQSpaceArmEnv
from experts import BoxDDP, GuidedDDP
from experts.command_line.expert_policies import load_policy
from experts.ddp.solution import StopReason, uninterrupted
from experts.demonstrations import outcomes
from experts.demonstrations.outcomes import Expert
from experts.maneuver_plan import ManeuverPlan
from experts.problems.arm_problem import ArmProblem
from experts.report.expert_trials import solve_episode
from experts.report.integrator_precision import expert_motion

SOLVE = """
import signal
from experts import BoxDDP
signal.signal(signal.SIGINT, signal.default_int_handler)  # a background job inherits that it is ignored
solver = BoxDDP("six-joint", max_iterations=1_000_000, tolerance=0.0, plateau_decrease=0.0)
started = []
def announce(record):
    if not started:
        print("solving", flush=True)
        started.append(record)
solution = solver.solve(callback=announce)
print(solution.stop_reason.value, solution.iterations > 0, solution.cost > 0.0)
"""


@pytest.mark.sampled
@pytest.mark.skipif(os.name == "nt", reason="POSIX signals")
@pytest.mark.parametrize("delay", [0.02, 0.05, 0.11, 0.17])
def test_a_real_interrupt_ends_the_solve_with_its_best_trajectory(delay):
    process = subprocess.Popen([sys.executable, "-c", SOLVE], stdout=subprocess.PIPE, text=True)
    assert process.stdout is not None
    assert process.stdout.readline() == "solving\n"
    time.sleep(delay)
    process.send_signal(signal.SIGINT)
    output, _ = process.communicate(timeout=60)
    assert process.returncode == 0
    assert output == "interrupted True True\n"


# What calls the solver -------------------------------------------------------------------------------------


@pytest.fixture
def stopped(monkeypatch):
    """Solves of the problem "planar" that return, interrupted, after their first iteration."""

    def interrupt(record):
        raise KeyboardInterrupt

    solution = BoxDDP("planar").solve(callback=interrupt)
    assert solution.stop_reason is StopReason.INTERRUPTED
    for solver in (BoxDDP, GuidedDDP):
        monkeypatch.setattr(solver, "solve", lambda self, *arguments, **options: solution)
    return solution


def test_only_an_interrupted_solution_interrupts(stopped):
    converged = replace(stopped, stop_reason=StopReason.CONVERGED)
    assert uninterrupted(converged) is converged
    with pytest.raises(KeyboardInterrupt):
        uninterrupted(stopped)


def test_no_caller_takes_an_interrupted_solution_for_a_failed_one(stopped):
    planar, problem = load_scene("planar"), ArmProblem("planar")
    expert, begun = GuidedDDP(problem), begin(planar)
    for call in (
        lambda: ManeuverPlan.make(expert, begun.state, 0),
        lambda: expert_motion(planar, 10),
        lambda: solve_episode(expert, DQSpaceArmEnv(planar), 0),
        lambda: outcomes.solve(Expert(problem, expert), 0, 0, begun.state, begun.parameters),
        lambda: load_policy("plan", begun, Console(quiet=True), None, False),
    ):
        with pytest.raises(KeyboardInterrupt):
            call()
