"""Policies of solved maneuvers as guesses: from another start, for another target, in other steps."""

from dataclasses import replace

import numpy as np

from dq_space_arm_env.kernels.bound import buffer_table, run_kernel
from experts.ddp.rollout import FINISHED, Trajectory
from experts.ddp.shooting import ShootingWorkspace
from experts.ddp.solution import Solution
from experts.problems.arm_problem import ArmProblem
from experts.problems.shooting_problem import FloatArray, ShootingProblem, check_array, stage_bounds
from experts.problems.window_problem import WindowProblem


def policies(solution: Solution, problem: ShootingProblem) -> dict[str, Solution]:
    """A solution as it is, and moved rigidly from its target to the present one where they differ."""
    found = {"": solution}
    if not isinstance(problem, ArmProblem | WindowProblem) or not problem.parameters.inputs:
        return found
    if solution.parameters.shape != problem.parameters.rows.shape:
        return found
    states = problem.carried(solution.states, solution.parameters)
    return found if states is None else {**found, ", moved": replace(solution, states=states)}


def coarsened(solution: Solution, problem: ArmProblem) -> Solution:
    """The policy of a solution in the longer steps of a problem; its cost becomes that of fewer stages."""
    factor = len(solution.controls) // problem.horizon
    controls = solution.controls.reshape(-1, factor, solution.controls.shape[1]).mean(axis=1)
    states = solution.states[::factor].copy()
    problem.keep_previous(states, controls)
    return replace(
        solution,
        problem=problem,
        states=states,
        controls=controls,
        feedback_gains=solution.feedback_gains[::factor],
        parameters=problem.in_long_steps(solution.parameters),
        multipliers=solution.multipliers[::factor],
        cost=solution.cost / factor,
    )


def refined(solution: Solution, problem: ShootingProblem) -> Solution:
    """The policy of a solution in the shorter steps of a problem; states between its own are interpolated.

    Controls whose rates are limited change evenly in a long step, the others at its start.
    """
    stages = len(solution.controls)
    factor = problem.horizon // stages
    references, ends = np.ascontiguousarray(solution.states[:-1]), np.ascontiguousarray(solution.states[1:])
    steps, between = np.zeros((stages, problem.n_tangent)), np.zeros((problem.horizon, problem.n_states))
    buffers = buffer_table(references, ends, steps)
    run_kernel(problem.kernel("difference").address, 0, stages, buffers)
    references, steps = (np.repeat(rows, factor, axis=0) for rows in (references, steps))
    steps *= np.tile(np.arange(factor) / factor, stages)[:, None]
    buffers = buffer_table(references, steps, between)
    run_kernel(problem.kernel("retract").address, 0, problem.horizon, buffers)
    parameters, multipliers = (
        np.concatenate([np.repeat(rows[:-1], factor, axis=0), rows[-1:]])
        for rows in (solution.parameters, solution.multipliers)
    )
    states = np.concatenate([between, solution.states[-1:]])
    controls = np.repeat(solution.controls, factor, axis=0)
    if isinstance(problem, ArmProblem):
        layout, share = problem.kernels.layout, np.tile(np.arange(1.0, factor + 1.0) / factor, stages)
        before = np.repeat(solution.states[:-1, layout.state.actuators], factor, axis=0)
        change = controls[:, layout.previous_controls] - before
        controls[:, layout.previous_controls] = before + share[:, None] * change
        problem.keep_previous(states, controls)
    return replace(
        solution,
        problem=problem,
        states=states,
        controls=controls,
        feedback_gains=np.repeat(solution.feedback_gains, factor, axis=0),
        parameters=parameters,
        multipliers=multipliers,
        cost=solution.cost * factor,
    )


def follow(solution: Solution, problem: ShootingProblem, x0: FloatArray) -> Trajectory:
    """Roll out the policy of a solution from another start; the cost is inf if it is not finite."""
    trial = Trajectory(problem)
    trial.states[0] = x0
    kernels = {name: problem.kernel(name) for name in ("difference", "step_with_cost", "terminal_cost")}
    reference = np.ascontiguousarray(solution.states), solution.controls
    policy = np.zeros_like(solution.controls), solution.feedback_gains
    trial.follow(kernels, reference, policy, 0.0, stage_bounds(problem))
    return trial


def track(problem: ShootingProblem, states: FloatArray, controls: FloatArray) -> tuple[FloatArray, float]:
    """Follow a trajectory that need not obey the dynamics; return controls (N, n_u) and cost of the rollout.

    The feedback is a linear-quadratic regulator around the guess: dynamics linearized along it, deviations
    weighted with the Gauss-Newton Hessian of the problem's own cost. Motion that does not affect the cost,
    such as that of the arm around a fixed tip, may deviate freely.
    """
    check_array("states", states, (problem.horizon + 1, problem.n_states))
    check_array("controls", controls, (problem.horizon, problem.n_controls))
    work = ShootingWorkspace(problem, second_order=False)
    work.current.states[:], work.current.controls[:] = states, controls
    work.trial.states[0] = states[0]
    work.differentiate()
    # Without gradients the guess itself has the least cost, and k vanishes.
    derivatives = work.derivatives
    for gradient in (derivatives.lx, derivatives.lu, derivatives.terminal_lx):
        gradient[:] = 0.0
    if not work.backward_pass(0.0).completed:
        return work.current.controls.copy(), np.inf
    cost = work.try_step(0.0)
    finite = work.trial.failing_stage == FINISHED
    return work.trial.controls.copy(), cost if finite else np.inf
