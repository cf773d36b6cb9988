"""The expert where rates of controls are limited: exactly within them, and as good as another method."""

import numpy as np
import pytest

from dq_space_arm_env import DQSpaceArmEnv, load_scene
from experts import BoxDDP, GuidedDDP, RecedingHorizonExpert
from experts.problems.arm_problem import ArmProblem
from experts.problems.window_problem import WindowProblem
from scripts.benchmarks.peers.interior_point_peer import InteriorPoint

PLAIN = load_scene("planar").replace(simulation={"steps": 200, "dt": 0.075})
RATES = {"kind": "control_rate", "name": "slew", "base_torque": 20.0, "joint_torque": 5.0}
LIMITED = PLAIN.replace(constraints=[RATES])


def changes(solution, problem):
    """Largest change of each control that the state keeps, relative to its limit."""
    layout = problem.kernels.layout
    previous = solution.states[:-1, layout.state.actuators]
    change = np.abs(solution.controls[:, layout.previous_controls] - previous)
    np.testing.assert_array_equal(
        solution.states[1:, layout.state.actuators], solution.controls[:, layout.previous_controls]
    )
    return change.max(axis=0) / problem.rate_limits.change


@pytest.mark.slow
def test_maneuver_keeps_to_the_rates():
    plain, solver = BoxDDP(PLAIN).solve(), BoxDDP(LIMITED)
    problem = solver.problem
    assert isinstance(problem, ArmProblem)
    solution = solver.solve()
    assert solution.converged
    assert solution.iterations <= 110
    found = changes(solution, problem)
    assert found.max() <= 1.0 + 1e-12
    previous = problem.kernels.layout.tangent.actuators
    gains = solution.feedback_gains[:, problem.rate_limits.controls]
    follow = np.isclose(gains[:, :, previous], np.eye(previous.stop - previous.start)).all(axis=2)
    assert follow.any()
    assert np.abs(gains[follow]).sum() == pytest.approx(follow.sum())  # rows of the identity
    assert found[1:].min() > 1.0 - 1e-12  # the motors meet their limits
    assert solution.cost > 1.001 * plain.cost
    assert problem.kernels.constraints(solution.states[:-1], solution.controls).max() <= 1e-12
    # Whatever the guess, the first rollout keeps to the rates too.
    solver.max_iterations = 1
    assert changes(solver.solve(u_init=plain.controls), problem).max() <= 1.0 + 1e-12


@pytest.mark.slow
def test_interior_point_method_finds_the_same_maneuver():
    scene = LIMITED.replace(simulation={"steps": 50, "dt": 0.3})
    problem = ArmProblem(scene)
    solution = BoxDDP(problem, tolerance=1e-10).solve()
    run = InteriorPoint(problem).solve(u_init=solution.controls, x_init=solution.states)
    assert run.converged
    assert run.replayed_cost == pytest.approx(solution.cost, rel=1e-6)
    np.testing.assert_allclose(run.controls, solution.controls, rtol=0, atol=1e-3)


@pytest.mark.slow
def test_guided_solver_flies_in_the_environment():
    """Long steps may change controls more; their policy is followed within the limits of short ones."""
    wrist = {"kind": "control_rate", "name": "wrist", "wrist_rate": 10.0}
    scene = load_scene("paper").replace(constraints=[wrist])
    solver, env = GuidedDDP(scene), DQSpaceArmEnv(scene)
    assert solver.coarsening == (8,)
    assert solver.solve().cost == pytest.approx(1461.0639, rel=1e-6)
    for seed in (2, 3):
        env.reset(seed=seed)
        solution = solver.solve(env.state)
        assert solution.converged
        assert solution.iterations <= 20
        assert changes(solution, solver.problem).max() <= 1.0 + 1e-12
        policy, charge = solution.policy(), 0.0
        for k in range(scene.simulation.steps):
            *_, info = env.step(env.kernels.layout.to_action(policy(env.state, k)))
            charge += info["cost"]
        assert info["is_success"]
        assert charge <= 1e-9


@pytest.mark.slow
def test_receding_horizon_keeps_to_the_rates():
    env, expert = DQSpaceArmEnv(LIMITED), RecedingHorizonExpert(LIMITED, horizon=30)
    env.reset(seed=4)
    charge = 0.0
    for _ in range(LIMITED.simulation.steps):
        *_, info = env.step(expert(env.state))
        charge += info["cost"]
    assert info["is_success"]
    assert charge <= 1e-9


@pytest.mark.endurance
@pytest.mark.parametrize(("name", "rates"), [("wheels", {"wheels": 0.02}), ("thrusters", {"thrusters": 2.0})])
def test_wheels_and_thrusters_keep_to_their_rates(name, rates):
    limited = load_scene(name)
    slew = {"kind": "control_rate", "name": "slew", **rates}
    limited = limited.replace(constraints=[*limited.constraints, slew])
    solver = GuidedDDP(limited)
    solution = solver.solve()
    assert solution.converged
    assert changes(solution, solver.problem).max() == pytest.approx(1.0, abs=1e-12)
    assert solution.controls[:, solver.problem.kernels.layout.control.thruster_force].min(initial=0.0) >= 0.0


def closed_in_time(torque, constraints=()):
    """A wheel's torque that the second of two phases switches off."""
    coasting = {"name": "coasting", "steps": 12, "changes": {"actuators": {"base_torque": None}}}
    return load_scene(
        {
            "name": "wheel that is switched off",
            "base": {"motion": "planar", "mass": 20.0, "inertia": [1.0, 1.0, 1.0]},
            "actuators": {"base_torque": {"limit": 1.0, **torque}},
            "target": {"pose": {"rotation": {"axis": [0, 0, 1], "angle": 60}}},
            "simulation": {"steps": 24, "dt": 0.1},
            "phases": [{"name": "turning", "steps": 12}, coasting],
            "constraints": constraints,
        }
    )


@pytest.mark.slow
def test_controls_that_run_down_where_a_phase_switches_them_off_are_a_guess():
    """Their rates keep them out of limits of zero for some stages."""
    solver = BoxDDP(closed_in_time({"slew_limit": 2.0}))
    solution = solver.solve()
    assert solution.controls[12, 0] != 0.0
    assert solver.solve(u_init=solution.controls).iterations == 0
    solution.controls[13] = 0.5
    with pytest.raises(ValueError, match=r"u_init\[13, 0\] is 0\.5, outside \[-0\.0, 0\.0\]"):
        solver.solve(u_init=solution.controls)


@pytest.mark.slow
def test_controls_of_limited_rates_are_zero_when_a_phase_switches_them_off():
    """The environment switches off at once, and charges the jump that a control has not prepared."""
    scene = closed_in_time({}, [{"kind": "control_rate", "name": "rate", "base_torque": 2.0}])
    solution, env = BoxDDP(scene).solve(), DQSpaceArmEnv(scene)
    env.reset(options={"nominal": True})
    cost, charge = 0.0, 0.0
    for action in solution.controls:  # the limit is 1 N m
        _, reward, *_, info = env.step(action)
        cost, charge = cost - reward, charge + info["cost"]
    assert np.abs(solution.controls[11, 0]) == pytest.approx(0.2, rel=1e-9)
    assert np.abs(solution.controls[12:]).max() <= 1e-12
    assert cost == pytest.approx(solution.cost, rel=1e-12)
    assert charge <= 1e-12


@pytest.mark.slow
def test_the_receding_horizon_comes_down_in_time_for_what_is_beyond_its_window():
    scene = closed_in_time({}, [{"kind": "control_rate", "name": "rate", "base_torque": 2.0}])
    env, expert = DQSpaceArmEnv(scene), RecedingHorizonExpert(scene, horizon=3)
    env.reset(options={"nominal": True})
    charge, asked = 0.0, []
    for stage in range(24):
        if stage == 2:  # a push, against which it asks for all that there is
            state = env.get_state()
            state["x"][env.kernels.layout.state.base_velocity.start] += 3.0
            env.set_state(state)
        charge += env.step(expert(env.state))[-1]["cost"]
        asked.append(expert.control[0])
    assert min(asked) < -0.75
    assert charge <= 1e-12


def test_a_window_with_tolerances_as_constraints_has_the_same_limits():
    """What is switched off before the window does not limit it."""
    scene = closed_in_time({}, [{"kind": "control_rate", "name": "rate", "base_torque": 2.0}])
    turning, coasting = (phase.model_dump() for phase in scene.phases)
    again = {**turning, "name": "turning again", "steps": 8}
    scene = scene.replace(phases=[{**turning, "steps": 8}, {**coasting, "steps": 8}, again])
    window = WindowProblem(ArmProblem(scene), 8)
    window.begin_at(16)
    constrained = window.constrained(0.05)
    constrained.parameters.set(window.parameters.rows)
    np.testing.assert_array_equal(window.control_upper, np.ones((8, 1)))
    np.testing.assert_array_equal(constrained.control_upper, window.control_upper)
