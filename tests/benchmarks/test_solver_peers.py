"""The same maneuver in other solvers: steps, costs and optima that agree; what is said where they cannot."""

from itertools import count
from typing import Any

import casadi
import numpy as np
import pytest

from dq_space_arm_env import Scene, load_scene
from dq_space_arm_env.algebra import dual_quaternion as dq
from dq_space_arm_env.algebra import poses
from dq_space_arm_env.dynamics import kinematics
from dq_space_arm_env.dynamics.kinematic_tree import KinematicTree
from experts import BoxDDP
from experts.problems.arm_problem import ArmProblem
from experts.problems.paper_problem import PaperProblem
from experts.problems.shooting_problem import FloatArray
from scripts.benchmarks.peers import crocoddyl_maneuver, crocoddyl_peer, interior_point_peer
from scripts.benchmarks.peers.crocoddyl_maneuver import CrocoddylManeuver
from scripts.benchmarks.peers.crocoddyl_peer import solve_with_crocoddyl
from scripts.benchmarks.peers.interior_point_peer import InteriorPoint
from scripts.benchmarks.peers.transcription import transcribe
from scripts.benchmarks.solvers.runs import FATROP, SolverRun, roll_out
from scripts.benchmarks.subjects import COMPARED_INTEGRATORS

pytestmark = pytest.mark.slow  # they compile many variants of scenes


def shortened(name: str, steps: int, integrator: str = "symplectic_euler") -> ArmProblem:
    scene = load_scene(name)
    changes = {"steps": steps, "integrator": integrator}
    return ArmProblem(scene.replace(simulation=changes))


def random_controls(problem: ArmProblem, share: float = 0.2) -> FloatArray:
    rng = np.random.default_rng(0)
    shape = problem.horizon, problem.n_controls
    return np.asarray(share * problem.control_upper * rng.uniform(-1.0, 1.0, shape))


def check_record(run: SolverRun, problem: ArmProblem, start: FloatArray) -> None:
    """Whatever the solver: sizes, limits, a clock that runs, and costs that are those of the controls."""
    assert run.costs.shape == run.seconds.shape == (run.iterations + 1,)
    assert run.seconds[0] == 0.0
    assert np.all(np.diff(run.seconds) > 0.0)
    assert np.all(np.abs(run.controls) <= problem.control_upper)
    assert run.replayed_cost == run.costs[-1] == roll_out(problem, start, run.controls).cost
    assert set(run.parts) == {"derivatives", "sweep", "rollout"}
    assert all(time >= 0.0 for time in run.parts.values())


# IPOPT -----------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("integrator", COMPARED_INTEGRATORS)
def test_interior_point_methods_find_the_optimum_of_the_expert(short_scene: Scene, integrator: str) -> None:
    problem = ArmProblem(short_scene, integrator)
    run, expected = InteriorPoint(problem).solve(), BoxDDP(problem).solve()
    assert run.converged
    assert run.stop_reason == "Solve_Succeeded"
    assert run.replayed_cost == pytest.approx(expected.cost, rel=1e-6)
    assert run.controls == pytest.approx(expected.controls, abs=1e-2)
    zero = roll_out(problem, problem.initial_state, np.zeros_like(run.controls)).cost
    assert run.costs[0] == pytest.approx(zero, rel=1e-2)  # IPOPT moves a guess off the bounds
    check_record(run, problem, problem.initial_state)
    other = InteriorPoint(problem, FATROP).solve()
    assert other.converged
    assert 0 < other.iterations < 100
    assert other.replayed_cost == pytest.approx(expected.cost, rel=1e-6)
    assert other.controls == pytest.approx(run.controls, abs=1e-2)


def test_ipopt_takes_another_start_and_a_guess_of_states_and_controls(short_scene: Scene) -> None:
    problem = ArmProblem(short_scene)
    start = problem.initial_state.copy()
    start[problem.kernels.layout.state.joint_angles] += 0.3
    plan = BoxDDP(problem).solve(start)
    warm = InteriorPoint(problem, first_barrier=1e-5).solve(start, plan.controls, x_init=plan.states)
    cold = InteriorPoint(problem).solve(start)
    for run in (warm, cold):
        assert run.replayed_cost == pytest.approx(plan.cost, rel=1e-6)
        check_record(run, problem, start)
    assert warm.costs[0] < 1.1 * plan.cost < cold.costs[0]
    assert warm.iterations < cold.iterations


def test_the_clock_of_ipopt_runs_from_the_call_on(
    short_scene: Scene, monkeypatch: pytest.MonkeyPatch
) -> None:
    """It counts how often it is read: once in each callback, and once after it, which is not counted."""
    solver = InteriorPoint(ArmProblem(short_scene), max_iterations=2)
    monkeypatch.setattr(interior_point_peer, "perf_counter", count().__next__)
    assert solver.solve().seconds.tolist() == [0.0, 2.0, 3.0]


def test_ipopt_says_when_iterations_or_time_are_used_up(short_scene: Scene) -> None:
    problem = ArmProblem(short_scene)
    settings: tuple[dict[str, Any], ...] = ({"max_iterations": 2}, {"max_seconds": 1e-3})
    few, brief = (InteriorPoint(problem, **setting).solve() for setting in settings)
    assert (few.converged, few.iterations, few.stop_reason) == (False, 2, "Maximum_Iterations_Exceeded")
    assert (brief.converged, brief.stop_reason) == (False, "Maximum_WallTime_Exceeded")


@pytest.mark.parametrize("integrator", COMPARED_INTEGRATORS)
def test_transcription_has_the_experts_steps_and_costs(integrator: str) -> None:
    problem = shortened("paper", 20, integrator)
    trajectory = roll_out(problem, problem.initial_state, random_controls(problem))
    program = transcribe(problem)
    values = casadi.Function("values", [program.variables], [program.cost, program.gaps])
    cost, gaps = values(program.join(trajectory.states, trajectory.controls))
    assert float(cost) == pytest.approx(trajectory.cost, rel=1e-12)
    # Of RK4, the pose is integrated otherwise: order 4 as well, another error.
    assert float(casadi.norm_inf(gaps)) < (1e-9 if integrator == "rk4" else 1e-12)


def test_transcription_has_the_parameters_of_the_stages() -> None:
    """A target that tumbles, the twist relative to it in the cost, and rows that know where it is."""
    problem = shortened("servicing", 20, "rk4")
    trajectory = roll_out(problem, problem.initial_state, random_controls(problem))
    program = transcribe(problem)
    values = casadi.Function("values", [program.variables], [program.cost, program.gaps, program.rows])
    cost, gaps, rows = values(program.join(trajectory.states, trajectory.controls))
    assert float(cost) == pytest.approx(trajectory.cost, rel=1e-12)
    assert float(casadi.norm_inf(gaps)) < 1e-9
    assert problem.constraints is not None
    expected = problem.constraints.find(trajectory.states, trajectory.controls)[1:-1]
    of_stages = np.asarray(rows).ravel()[: 20 * (program.n_x + program.n_path)]
    found = of_stages.reshape(20, -1)[1:, program.n_x :]
    np.testing.assert_allclose(found, expected[:, : program.n_path], rtol=0, atol=1e-12)
    assert np.ptp(found, axis=0).min() > 1e-4


@pytest.mark.parametrize("integrator", COMPARED_INTEGRATORS)
def test_transcription_has_the_derivatives_that_casadi_finds(short_scene: Scene, integrator: str) -> None:
    limits = {"kind": "joint_limits", "name": "limits", "lower": -1, "upper": 1, "rate": 0.5}
    short = {"dt": 0.05, "steps": 3, "integrator": integrator}
    scene = short_scene.replace(simulation=short, constraints=[limits])
    program = transcribe(ArmProblem(scene))
    rng = np.random.default_rng(0)
    values, pushed = rng.normal(size=program.variables.numel()), rng.normal(size=program.rows.numel())
    symbols = casadi.MX.sym("l", len(pushed))
    jacobian = casadi.jacobian(program.rows, program.variables)
    lagrangian = 1.7 * program.cost + casadi.dot(symbols, program.rows)
    hessian = casadi.hessian(lagrangian, program.variables)[0]
    expected = casadi.Function("expected", [program.variables, symbols], [jacobian, hessian])(values, pushed)
    found = program.jacobian(values, [])[1], program.hessian(values, [], 1.7, pushed)
    for ours, theirs in zip(found, expected, strict=True):
        assert float(casadi.norm_inf(theirs)) > 1.0
        assert float(casadi.norm_inf(ours - theirs)) < 1e-11


# Crocoddyl -------------------------------------------------------------------------------------------------


@pytest.fixture
def crocoddyl() -> Any:
    """Crocoddyl, or no test."""
    return pytest.importorskip("crocoddyl")


@pytest.mark.parametrize("integrator", COMPARED_INTEGRATORS)
@pytest.mark.parametrize("name", ["no-wrist", "paper", "payload"])
def test_crocoddyl_takes_the_same_steps(crocoddyl: Any, name: str, integrator: str) -> None:
    problem = shortened(name, 40, integrator)
    controls = random_controls(problem)
    if integrator == "rk4":
        controls[:, problem.kernels.layout.control.wrist_rate] = 0.0  # a ramp in a step of Crocoddyl
    ours = roll_out(problem, problem.initial_state, controls).states
    maneuver = CrocoddylManeuver(problem)
    theirs = maneuver.states(maneuver.shooting.rollout(maneuver.model_inputs(controls)))
    pose = problem.kernels.layout.state.pose
    assert np.abs(ours[-1, pose.stop :] - ours[0, pose.stop :]).max() > 1e-3
    assert theirs[:, pose.stop :] == pytest.approx(ours[:, pose.stop :], abs=1e-13)
    assert theirs[:, pose] == pytest.approx(ours[:, pose], abs=1e-8 if integrator == "rk4" else 1e-13)


@pytest.mark.parametrize("name", ["no-wrist", "paper"])
def test_crocoddyl_has_the_exact_cost(crocoddyl: Any, name: str) -> None:
    ratios = {}
    for integrator in COMPARED_INTEGRATORS:
        problem = shortened(name, 200, integrator)
        controls = random_controls(problem)
        cost = roll_out(problem, problem.initial_state, controls).cost
        maneuver = CrocoddylManeuver(problem, exact_pose_cost=True)
        inputs = maneuver.model_inputs(controls)
        ratios[integrator] = maneuver.shooting.calc(maneuver.shooting.rollout(inputs), inputs) / cost
    assert ratios["symplectic_euler"] == pytest.approx(1.0, abs=1e-12)
    assert ratios["rk4"] == pytest.approx(1.0, abs=1e-2)


@pytest.mark.parametrize(
    ("angle", "distance", "error"), [(1e-3, 1e-3, 1e-3), (0.2, 0.3, 0.06), (0.7, 0.9, 0.2)]
)
def test_crocoddyl_approximates_the_pose_cost(
    crocoddyl: Any, angle: float, distance: float, error: float
) -> None:
    """The tip a rotation and a displacement away from the target, in random directions."""
    problem = shortened("paper", 1)
    layout, rng = problem.kernels.layout, np.random.default_rng(0)
    tree, target = KinematicTree.from_scene(problem.scene), problem.scene.target.pose.dual_quaternion
    angles = (
        problem.initial_state[layout.state.joint_angles],
        problem.initial_state[layout.state.wrist_angles],
    )
    to_base = dq.conjugate(kinematics.arm_pose(tree, *angles))
    exact, approximate = (CrocoddylManeuver(problem, exact_pose_cost=flag).shooting for flag in (True, False))
    maneuver = CrocoddylManeuver(problem)
    for _ in range(50):
        axis, shift = rng.normal(size=(2, 3))
        shift *= distance / np.linalg.norm(shift)
        tip = dq.multiply(
            target, poses.from_axis_angle(tuple(axis / np.linalg.norm(axis)), angle, tuple(shift))
        )
        state = problem.initial_state.copy()
        state[layout.state.pose] = dq.multiply(tip, to_base)
        maneuver.start_at(state)
        costs = []
        for shooting in (exact, approximate):
            data = shooting.terminalModel.createData()
            shooting.terminalModel.calc(data, maneuver.shooting.x0)
            costs.append(data.cost)
        assert costs[1] == pytest.approx(costs[0], rel=error)
        expected = 150.0 * sum((a - b) ** 2 for a, b in zip(tip, target, strict=True))
        assert costs[0] == pytest.approx(expected, rel=1e-9)


def test_crocoddyl_has_the_jacobian_of_the_exact_pose_cost(crocoddyl: Any) -> None:
    problem = shortened("paper", 1)
    shooting = CrocoddylManeuver(problem, exact_pose_cost=True).shooting
    model = shooting.runningModels[0].differential
    numeric = crocoddyl.DifferentialActionModelNumDiff(model, True)
    x = model.state.integrate(shooting.x0, np.random.default_rng(0).normal(size=model.state.ndx))
    u = np.ones(model.nu)
    datas = model.createData(), numeric.createData()
    for each, data in zip((model, numeric), datas, strict=True):
        each.calc(data, x, u)
        each.calcDiff(data, x, u)
    assert datas[0].Lx == pytest.approx(datas[1].Lx, rel=1e-4, abs=1e-3 * np.abs(datas[1].Lx).max())


@pytest.mark.parametrize("method", crocoddyl_peer.METHODS)
def test_crocoddyl_finds_the_optimum_of_the_expert(crocoddyl: Any, method: str) -> None:
    problem = shortened("no-wrist", 50)
    start = problem.initial_state.copy()
    start[problem.kernels.layout.state.joint_angles] += 0.1
    first = random_controls(problem, 0.01)
    run = solve_with_crocoddyl(problem, start, first, method=method, exact_pose_cost=True)
    expected = BoxDDP(problem).solve(start)
    assert run.converged
    assert run.replayed_cost == pytest.approx(expected.cost, rel=1e-5)
    assert run.costs[0] == roll_out(problem, start, first).cost
    assert run.own_costs == pytest.approx(run.costs, rel=1e-9)
    check_record(run, problem, start)


@pytest.mark.slow
def test_crocoddyl_comes_near_with_compiled_residuals_and_a_wrist(crocoddyl: Any) -> None:
    problem = shortened("paper", 100)
    expected = BoxDDP(problem).solve().cost
    exact, compiled = (
        solve_with_crocoddyl(problem, exact_pose_cost=flag, max_iterations=150) for flag in (True, False)
    )
    assert exact.replayed_cost == pytest.approx(expected, rel=2e-3)
    assert compiled.replayed_cost == pytest.approx(expected, rel=5e-2)
    assert compiled.own_costs[-1] != pytest.approx(compiled.replayed_cost, rel=1e-3)
    for run in (exact, compiled):
        check_record(run, problem, problem.initial_state)


def test_crocoddyl_refuses_weights_that_its_residual_has_not(crocoddyl: Any) -> None:
    scene = load_scene("no-wrist")
    weights = (15.0, 15.0, 15.0, 14.0, *(15.0,) * 4)
    problem = ArmProblem(scene.replace(cost={"pose": weights}))
    with pytest.raises(ValueError, match="within the real or the dual part"):
        CrocoddylManeuver(problem)
    CrocoddylManeuver(problem, exact_pose_cost=True)


@pytest.mark.parametrize(
    ("name", "reason"),
    [
        ("planar", "a planar base"),
        ("free-floating", "parts without an actuator"),
        ("tip-load", "a wrench"),
        ("tracking", "a target that moves"),
        ("refuelling", "phases"),
        ("elastic-joints", "steps of rodas4 or motors"),
        ("sliding", "joints that slide"),
        ("six-joint", "steps of rk6"),
        ("thrusters", "thrusters"),
        ("wheels", "wheels"),
    ],
)
def test_crocoddyl_is_left_out_with_a_sentence(name: str, reason: str) -> None:
    sentence = crocoddyl_maneuver.obstacle(ArmProblem(name))
    assert sentence is not None
    assert reason in sentence
    assert crocoddyl_maneuver.obstacle(ArmProblem("paper")) is None


@pytest.mark.parametrize("name", ["tracking", "release"])
def test_the_papers_formulation_refuses_more_than_a_target_at_rest(name: str) -> None:
    with pytest.raises(ValueError, match="formulation knows only its own cost of a target at rest"):
        PaperProblem(load_scene(name))


@pytest.mark.parametrize(
    ("name", "more"),
    [
        ("release", "phases"),
        ("dual-arm", "tips of other arms"),
        ("motors", "actuators that delay or lag"),
        ("six-joint", "steps of rk6"),
    ],
)
def test_interior_point_methods_refuse_what_they_are_not_given(name: str, more: str) -> None:
    with pytest.raises(ValueError, match=f"interior-point methods are left out: they are not given {more}"):
        transcribe(ArmProblem(name))


def test_the_papers_formulation_brings_the_tip_to_a_grasp_frame() -> None:
    grasp = {"position": [-0.3, 0.0, 0.1], "rotation": {"axis": [0, 0, 1], "angle": 20}}
    scene = load_scene("paper").replace({"target.grasp": grasp, "simulation.steps": 5})
    problems = PaperProblem(scene), ArmProblem(scene)
    costs = [BoxDDP(problem, max_iterations=1).solve().cost for problem in problems]
    assert costs[0] == pytest.approx(costs[1], rel=1e-6)
