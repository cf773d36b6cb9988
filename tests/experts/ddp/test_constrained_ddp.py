"""Box-DDP under constraints: optimality conditions, feasibility, infeasible scenes, gains, files."""

import math
import re

import numpy as np
import pytest

from dq_space_arm_env import DQSpaceArmEnv, compile_scene, load_scene
from experts import BoxDDP, GuidedDDP, Solution
from experts.ddp.solution import StopReason
from experts.problems.arm_problem import ArmProblem
from experts.receding_horizon import RecedingHorizonExpert
from scripts.benchmarks.solvers.runs import roll_out

LIMITS = {
    "kind": "joint_limits",
    "name": "limits",
    "lower": [-2.0, -0.6, -1.7],
    "upper": [math.inf, 1.0, math.inf],
    "rate": 1e3,  # that no joint comes near
}
BALL = {
    "kind": "distance",
    "name": "ball",
    "bodies": [
        {"frame": "link 2", "to": [0.75, 0, 0], "radius": 0.05},
        {"frame": "link 3", "to": [0.85, 0, 0], "radius": 0.05},
    ],
    "obstacles": [{"frame": "inertial", "position": [0.5, -3.2, 5.4], "radius": 0.1}],
}
POSE = {"kind": "terminal", "name": "exact", "exact": ["pose"]}
# Costs of minima, each found from two guesses and with other penalties.
CASES = {
    "limits": ([LIMITS], 1436.0406),
    "ball": ([BALL], 1432.7256),
    "pose": ([POSE], 1422.2509),
    "all": ([LIMITS, BALL, POSE], 1447.8408),
}
MOST_ITERATIONS = {"limits": 35, "ball": 50, "pose": 12, "all": 60}
FREE = 1422.18983
CONSTRAINED = (
    "approach-corridor",
    "joint-limits",
    "keep-out",
    "line-of-sight",
    "plume",
    "pointing",
    "wheel-saturation",
)


@pytest.fixture(scope="module")
def free():
    """The maneuver of scene `paper` without constraints."""
    return BoxDDP("paper").solve()


@pytest.fixture(scope="module", params=CASES)
def solved(request, free):
    """A constrained problem, its solution from the unconstrained one, and the cost of its minimum."""
    constraints, cost = CASES[request.param]
    problem = ArmProblem(load_scene("paper").replace(constraints=constraints))
    none = np.zeros_like(problem.constraints.multipliers)
    solution = BoxDDP(problem, initial_regularization=1e-3).solve(u_init=free.controls, multipliers=none)
    return problem, solution, cost


@pytest.mark.sampled
@pytest.mark.parametrize("case", CASES)
def test_minimum_from_the_unconstrained_one(case, free):
    constraints, cost = CASES[case]
    problem = ArmProblem(load_scene("paper").replace(constraints=constraints))
    solution = BoxDDP(problem, initial_regularization=1e-3).solve(u_init=free.controls)
    assert solution.converged, solution.message
    assert solution.cost == pytest.approx(cost, rel=1e-6)
    assert solution.iterations <= MOST_ITERATIONS[case]


@pytest.mark.sampled
def test_minimum(solved):
    problem, solution, cost = solved
    report = solution.constraints
    assert solution.converged, solution.message
    assert solution.cost == pytest.approx(cost, rel=1e-6)
    assert solution.cost > FREE
    assert report.violation <= 1e-6
    assert report.complementarity <= 1e-7
    assert (solution.multipliers[~problem.constraints.equalities] >= 0.0).all()
    replay = problem.kernels
    spent = replay.cost(solution.states[:-1], solution.controls).sum() + replay.terminal_cost(
        solution.states[-1]
    )
    assert solution.cost == pytest.approx(spent, rel=1e-12)  # without penalties


@pytest.mark.sampled
def test_first_order_conditions(solved):
    """With the multipliers, no input inside its bounds changes the Lagrangian to first order."""
    problem, solution, _ = solved
    k, x, u = problem.kernels, solution.states, solution.controls
    a, b = k.linearize(x[:-1], u)
    lx, lu = (k.call("cost_derivatives", x=x[:-1], u=u)[i] for i in (0, 1))
    m, n_t = solution.multipliers, k.n_t
    rows, final = len(problem.constraints.path), len(problem.constraints.terminal)
    by = k.constraint_jacobian(x[:-1], u) if rows else np.zeros((len(u), 0, n_t + k.n_u))
    costate = k.call("terminal_cost_derivatives", x=x[-1], emphasis=[1.0])[0]
    costate = costate + k.terminal_constraint_jacobian(x[-1]).T @ m[-1, :final]
    slopes = np.zeros_like(u)
    for i in reversed(range(len(u))):
        pushed = by[i].T @ m[i, :rows]
        slopes[i] = lu[i] + pushed[n_t:] + b[i].T @ costate
        costate = lx[i] + pushed[:n_t] + a[i].T @ costate
    free = (u > 0.999 * problem.control_lower) & (u < 0.999 * problem.control_upper)
    scale = np.abs(lu).max(axis=0)
    assert np.abs(slopes / scale)[free].max() < 0.1
    at_upper = u >= problem.control_upper
    assert (slopes[at_upper] <= 1e-6).all()


def test_gains_are_soft(solved, free):
    """No gain is stiffer than a penalty of the size that gains may know makes it."""
    _, solution, _ = solved
    assert 0.0 < np.abs(solution.feedback_gains).max() < 3.0 * np.abs(free.feedback_gains).max()


def test_the_arm_keeps_off_between_the_stages(solved):
    problem, solution, _ = solved
    names = [row.name for row in problem.constraints.path]
    columns = [i for i, name in enumerate(names) if name.startswith("ball")]
    k, x, u = problem.kernels, solution.states, solution.controls
    between = [k.step(x[:-1], u, dt=share * 0.015) for share in (0.25, 0.5, 0.75)]
    for states in between if columns else ():
        assert k.constraints(states, u)[:, columns].max() < 1e-4  # m


def test_multipliers_start_the_next_solve(solved):
    problem, solution, cost = solved
    start = problem.initial_state.copy()
    start[problem.kernels.layout.state.joint_angles] += 0.01
    again = BoxDDP(problem, initial_regularization=1e-3).solve(
        start, solution.controls, multipliers=solution.multipliers
    )
    assert again.converged, again.message
    assert again.iterations <= 40
    assert again.cost == pytest.approx(cost, rel=0.05)


def test_files_keep_multipliers(solved, tmp_path):
    _, solution, _ = solved
    solution.save(tmp_path / "plan.npz")
    loaded = Solution.load(tmp_path / "plan.npz")
    np.testing.assert_array_equal(loaded.multipliers, solution.multipliers)
    assert loaded.constraints == solution.constraints


def test_penalties_leave_no_trace(solved):
    """Outside of a solve the problem's cost is that of the scene."""
    problem, solution, _ = solved
    assert not problem.parameters.more.any()
    again = roll_out(problem, solution.states[0], solution.controls)
    assert again.cost == pytest.approx(solution.cost, rel=1e-12)


@pytest.mark.sampled
def test_an_error_in_a_callback_leaves_no_penalties_either():
    problem = ArmProblem("joint-limits")

    def fail(record):
        assert problem.parameters.more.any()
        raise RuntimeError("no more")

    with pytest.raises(RuntimeError, match="no more"):
        BoxDDP(problem).solve(callback=fail, multipliers=np.ones_like(problem.constraints.multipliers))
    assert not problem.parameters.more.any()


def test_the_optimality_of_an_earlier_trajectory_is_not_told(solved, free):
    """Steps that were judged go on where constraints ask for more."""
    problem, solution, _ = solved
    none = np.zeros_like(problem.constraints.multipliers)
    given = {"initial_regularization": 1e-3, "max_iterations": solution.iterations - 1}
    cut = BoxDDP(problem, **given).solve(u_init=free.controls, multipliers=none)
    assert cut.stop_reason is StopReason.MAX_ITERATIONS
    assert cut.optimality == math.inf
    assert solution.optimality < math.inf


@pytest.mark.slow
def test_an_infeasible_scene_is_named():
    """The elbow cannot keep a meter from what it is attached to."""
    entry = {**BALL, "obstacles": [{"frame": "base", "position": [0, 0, 0.8], "radius": 0.5}]}
    scene = load_scene("paper").replace(constraints=[entry], simulation={"steps": 100, "dt": 0.15})
    solution = BoxDDP(scene).solve()
    assert solution.stop_reason is StopReason.INFEASIBLE
    assert re.search(r"violated are ball: link 2 0 to base 0 by 0\.\d+ m at \S+ s; ", solution.message)
    assert solution.constraints.violation > 0.1


def test_without_constraints_there_are_no_multipliers(free):
    assert free.constraints is None
    assert free.multipliers.size == 0
    with pytest.raises(ValueError, match="has no constraints"):
        BoxDDP("paper").solve(multipliers=np.zeros((1001, 1)))


@pytest.mark.slow
def test_constraints_that_the_cheapest_maneuver_keeps_change_nothing(free):
    wide = {**LIMITS, "lower": -3.0, "upper": 3.0}
    solution = BoxDDP(load_scene("paper").replace(constraints=[wide])).solve()
    assert solution.converged
    np.testing.assert_allclose(solution.controls, free.controls, rtol=0, atol=1e-9)
    assert not solution.multipliers.any()


def test_multipliers_of_another_problem_are_refused():
    scene = load_scene("paper").replace(constraints=[LIMITS])
    with pytest.raises(ValueError, match="multipliers has shape"):
        BoxDDP(scene).solve(multipliers=np.zeros((1001, 99)))
    with pytest.raises(TypeError, match="multipliers: of type <U3, should be real numbers"):
        BoxDDP(scene).solve(multipliers=np.full((1001, 3), "0.0"))


@pytest.mark.parametrize(
    "name",
    [
        pytest.param(name, marks=pytest.mark.slow if name == "joint-limits" else pytest.mark.endurance)
        for name in CONSTRAINED
    ],
)
def test_random_starts_keep_to_the_constraints(name):
    solver, kernels = GuidedDDP(name), compile_scene(name)
    env = DQSpaceArmEnv(name)
    for seed in range(500, 510):
        env.reset(seed=seed)
        solution = solver.solve(env.state)
        assert solution.converged, (seed, solution.message)
        charged = [env.step(kernels.layout.to_action(u))[-1] for u in solution.controls]
        assert charged[-1]["is_success"], seed
        assert max(info["cost"] for info in charged) < 0.01


@pytest.mark.slow
def test_receding_horizon_keeps_to_limits():
    env, expert = DQSpaceArmEnv("joint-limits"), RecedingHorizonExpert("joint-limits")
    seen, _ = env.reset(seed=3)
    over, worst = False, 0.0
    while not over:
        seen, _, over, _, info = env.step(expert(seen))
        worst = max(worst, *info["constraints"].values())
    assert info["is_success"]
    assert worst < 0.01
