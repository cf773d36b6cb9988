"""Solves with parameters: as constants, from stage to stage, moved targets, and derivatives."""

import numpy as np
import pytest

from dq_space_arm_env import SceneError, load_scene
from dq_space_arm_env.algebra import poses
from dq_space_arm_env.scene.start import episode_scene
from experts import BoxDDP, GuidedDDP, RecedingHorizonExpert, Solution
from experts.problems.arm_problem import ArmProblem

STEPS = 60


@pytest.fixture(scope="module")
def scene():
    names = ["target.pose", "links.0.mass", "base.inertia", "actuators", "cost.joint_torque"]
    return load_scene("planar").replace(parameters=names, simulation={"steps": STEPS, "dt": 0.1})


@pytest.fixture(scope="module")
def solver(scene):
    return BoxDDP(scene)


def values(solver, target=(0.1, -0.1), turn=0.2, **others):
    """Parameters with the target moved [m] and turned [rad]; others by name."""
    entries, layout = solver.problem.kernels.parameters, solver.problem.kernels.layout
    p = entries.nominal.copy()
    rotation, position = poses.to_matrix(layout.target.tolist())
    angle = np.arctan2(rotation[1][0], rotation[0][0]) + turn
    moved = np.add(position, (*target, 0.0)).tolist()
    q = np.array(poses.from_rotation_and_position((np.cos(angle / 2), 0.0, 0.0, np.sin(angle / 2)), moved))
    q *= np.sign(q[:4] @ layout.target[:4])
    p[entries.indices("target.pose")] = q[[0, 3, 5, 6]]
    for name, value in others.items():
        p[entries.names.index(name.replace("__", "."))] = value
    return p


@pytest.mark.slow
def test_a_solve_is_that_of_the_scene_with_these_numbers(scene, solver):
    p = values(solver, links__0__mass=14.0, base__inertia__zz=7.0)
    solution = solver.solve(parameters=p)
    expected = BoxDDP(episode_scene(scene, p)).solve(solver.problem.initial_state)
    assert solution.converged
    assert solution.cost == pytest.approx(expected.cost, rel=1e-12)
    np.testing.assert_allclose(solution.states, expected.states, rtol=0, atol=1e-8)
    np.testing.assert_array_equal(solution.parameters, np.tile(p, (STEPS + 1, 1)))
    # Without parameters they are nominal again, whatever was solved before.
    nominal = solver.solve()
    assert nominal.cost == pytest.approx(
        BoxDDP(episode_scene(scene, nominal.parameters[0])).solve().cost, rel=1e-12
    )


@pytest.mark.parametrize(
    ("change", "said"),
    [
        ({"links__0__mass": -1.0}, r"links\[0\].mass = -1.0"),
        ({"actuators__joint_torque__limit": 0.0}, "joint_torque"),
        ({"target": (1e300, 0.0)}, "target"),
    ],
)
def test_parameters_that_no_scene_may_have_are_refused(solver, change, said):
    for solve in (solver.solve, RecedingHorizonExpert(solver.problem.scene).reset):
        with pytest.raises(SceneError, match=said):
            solve(parameters=values(solver, **change))


def test_limits_that_are_parameters_bound_the_controls(solver):
    names = solver.problem.kernels.layout.control
    free = solver.solve()
    limit = 0.5 * np.abs(free.controls[:, names.joint_torque]).max()
    p = values(solver, (0.0, 0.0), 0.0, actuators__joint_torque__limit=limit)
    rows = np.tile(p, (STEPS + 1, 1))
    rows[20:] = solver.problem.kernels.parameters.nominal
    bounded = solver.solve(parameters=rows)
    torques = np.abs(bounded.controls[:, names.joint_torque])
    assert bounded.converged
    assert torques[:20].max() == limit
    assert bounded.cost > free.cost
    policy = bounded.policy()
    far = bounded.states[3] + np.eye(len(bounded.states[0]))[-1]
    assert np.abs(policy(far, 3)[names.joint_torque]).max() <= limit
    assert np.abs(policy(far, 30)[names.joint_torque]).max() > limit


def test_stages_have_parameters_of_their_own(solver):
    """A target that moves on the way, and a link that grows heavy."""
    share = np.linspace(0.0, 1.0, STEPS + 1)[:, None]
    rows = (1.0 - share) * solver.problem.parameters.nominal + share * values(solver, links__0__mass=20.0)
    kernels = solver.problem.kernels
    solution = solver.solve(parameters=rows)
    assert solution.converged
    flown = kernels.simulate(solution.states[0], solution.controls, STEPS, p=rows[:-1])
    np.testing.assert_allclose(solution.states, flown, rtol=0, atol=1e-12)
    cost = kernels.cost(flown[:-1], solution.controls, p=rows[:-1]).sum()
    cost += kernels.terminal_cost(flown[-1], p=rows[-1])
    assert solution.cost == pytest.approx(cost, rel=1e-12)
    # The shorter steps of the line search fly through other code.
    guess = np.random.default_rng(0).uniform(-1.0, 1.0, solution.controls.shape)
    guess *= solver.problem.control_upper * 0.9
    again = solver.solve(u_init=guess, parameters=rows)
    assert (again.history["alpha"] < 1.0).any()
    assert again.cost == pytest.approx(solution.cost, rel=1e-6)


def test_multiple_shooting_begins_with_states_and_parameters(solver):
    p = values(solver)
    states = solver.solve().states
    solution = solver.solve(x_init=states, parameters=p)
    assert solution.converged
    assert solution.cost == pytest.approx(solver.solve(parameters=p).cost, rel=1e-6)


def test_the_optimal_cost_changes_as_the_derivatives_by_parameters_say(solver):
    """dJ*/dp = sum of l_p + P' lambda: at an optimum the change of the controls does not count."""
    kernels, p = solver.problem.kernels, values(solver, links__0__mass=14.0)
    exact = BoxDDP(solver.problem, tolerance=1e-12)
    solution = exact.solve(parameters=p)
    x, u = solution.states, solution.controls
    a = kernels.linearize(x[:-1], u, p=p)[0]
    by_parameters, by_state = kernels.linearize_parameters(x[:-1], u, p=p), exact._work.derivatives
    costate, gradient = by_state.terminal_lx[0], kernels.terminal_cost_by_parameters(x[-1], p=p)
    gradient = gradient + kernels.cost_by_parameters(x[:-1], u, p=p).sum(axis=0)
    for k in reversed(range(STEPS)):
        gradient += by_parameters[k].T @ costate
        costate = by_state.lx[k] + a[k].T @ costate
    # Limits do not enter the dynamics, and a target moves on the unit quaternions only.
    entries = kernels.parameters
    for name in ("links.0.mass", "base.inertia.zz", "cost.joint_torque"):
        i = entries.names.index(name)
        size = 1e-4 * p[i]
        costs = [exact.solve(u_init=u, parameters=p + d * np.eye(len(p))[i]).cost for d in (size, -size)]
        assert gradient[i] == pytest.approx((costs[0] - costs[1]) / (2.0 * size), rel=1e-5, abs=1e-8)


@pytest.mark.slow
def test_the_present_parameters_of_a_problem_are_those_of_a_guided_solve(scene, solver):
    """Preparing guesses takes nominal ones in between."""
    p, problem = values(solver), ArmProblem(scene)
    problem.parameters.set(p)
    solution = GuidedDDP(problem).solve(parameters=problem.parameters.rows)
    np.testing.assert_array_equal(solution.parameters, np.tile(p, (STEPS + 1, 1)))


def test_a_solved_maneuver_serves_other_targets(solver):
    guided = GuidedDDP(solver.problem, screw_motion=False, attempts=1)
    guided.library  # noqa: B018  # solved beforehand
    for seed in range(3):
        rng = np.random.default_rng(seed)
        p = values(guided, rng.uniform(-0.2, 0.2, 2), rng.uniform(-0.4, 0.4))
        solution = guided.solve(parameters=p)
        assert solution.converged
        assert guided.problem.misses(solution.states[-1]) <= 1.0
        assert solution.metadata["guess"] in ("policy 0", "policy 0, moved")
        assert solution.iterations <= 20


def test_a_maneuver_moves_with_its_target(scene):
    problem = ArmProblem(scene)
    solver = BoxDDP(problem)
    solution = solver.solve()
    assert problem.carried(solution.states, solution.parameters) is None
    p = values(solver)
    problem.parameters.set(p)
    moved = problem.carried(solution.states, solution.parameters)
    # The tip sees its target as before, and the motion is one of the robot.
    errors = [
        problem.kernels.observation(x, [0.0], p=q)[1]
        for x, q in ((moved[-1], p), (solution.states[-1], None))
    ]
    np.testing.assert_allclose(errors[0], errors[1], rtol=0, atol=1e-12)
    flown = problem.kernels.simulate(moved[0], solution.controls, STEPS)
    np.testing.assert_allclose(flown, moved, rtol=0, atol=1e-9)


@pytest.mark.parametrize(
    ("parameters", "message"),
    [
        (np.ones(3), r"parameters have shape \(3,\)"),
        (np.ones((STEPS, 14)), "with a row for each stage"),
        (np.full(14, np.nan), r"parameters\[0\] is nan"),
    ],
)
def test_parameters_that_do_not_fit_are_refused(solver, parameters, message):
    count = solver.problem.kernels.n_p
    if np.shape(parameters)[-1] == 14:
        parameters = np.resize(parameters, (*np.shape(parameters)[:-1], count))
    for each in (solver, GuidedDDP(solver.problem, library=[])):
        with pytest.raises(ValueError, match=message):
            each.solve(parameters=parameters)


def test_a_solution_keeps_its_parameters(solver, tmp_path):
    solution = solver.solve(parameters=values(solver))
    solution.save(tmp_path / "solution.npz")
    found = Solution.load(tmp_path / "solution.npz")
    np.testing.assert_array_equal(found.parameters, solution.parameters)
    # A file written before there were any.
    arrays = dict(np.load(tmp_path / "solution.npz"))
    del arrays["parameters"]
    np.savez(tmp_path / "old.npz", **arrays)
    assert Solution.load(tmp_path / "old.npz").parameters.shape == (STEPS + 1, 0)
