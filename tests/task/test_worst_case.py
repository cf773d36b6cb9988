"""The charge of a diverged simulation: no motion that the inputs can cause costs more."""

import casadi
import numpy as np
import pytest

from dq_space_arm_env import DQSpaceArmEnv, compile_scene, load_scene
from dq_space_arm_env.scene import list_scenes
from dq_space_arm_env.task.equations import SceneEquations
from dq_space_arm_env.task.worst_case import worst_cost

STEPS = 100


def charge(scene, states, steps):
    """The bound for a batch of states, shape (B,)."""
    equations = SceneEquations.of(scene, compile_scene(scene).layout.parameters.nominal.tolist())
    x = casadi.SX.sym("x", equations.field.n_x)
    bound = casadi.Function("bound", [x], [worst_cost(equations, [equations], casadi.vertsplit(x), steps)])
    return np.array([float(bound(state)) for state in states])


def starts(kernels, count):
    """States of all speeds."""
    rng, layout = np.random.default_rng(3), kernels.layout
    x = np.tile(layout.initial_state, (count, 1))
    scales = 10.0 ** rng.uniform(-2.0, 2.0, (count, 1))
    for part in (layout.state.base_velocity, layout.state.joint_rates):
        x[:, part] += scales * rng.uniform(-1.0, 1.0, x[:, part].shape)
    x[:, layout.state.joint_angles] += rng.uniform(-3.0, 3.0, x[:, layout.state.joint_angles].shape)
    return x


@pytest.mark.sampled
@pytest.mark.parametrize("name", [n for n in list_scenes() if n != "six-joint"])
def test_no_motion_costs_more(name):
    """Accurate motions under inputs at their limits: constant, switching, and along the velocities."""
    scene = load_scene(name)
    kernels, rng = compile_scene(scene), np.random.default_rng(4)
    rows = kernels.stage_parameters()  # of a target that moves
    begun = starts(kernels, 48)
    x, cost = begun.copy(), np.zeros(len(begun))
    u = rng.choice([-1.0, 1.0], (len(x), kernels.n_u))
    for step in range(STEPS):
        if step % 10 == 0:
            u[::3] = rng.choice([-1.0, 1.0], u[::3].shape)
        controls = kernels.layout.control_limit * u
        cost += kernels.cost(x, controls, p=rows[step])
        x, error = kernels.checked_step(x, controls)
        assert (error <= 1.0).all()
    cost += kernels.terminal_cost(x, p=rows[STEPS])
    bounds = charge(scene, begun, STEPS)
    assert (cost < bounds).all()
    # It is of use only if it is not beyond all measure.
    limit = 1e6 if any(scene.cost.terminal_tip_twist) else 1e5  # the lightest body may take all the energy
    assert np.median(bounds / cost) < limit * max(1, len(scene.phases))  # each phase is charged for all steps


def test_a_light_body_that_slides_away_costs_no_more_with_a_tip_of_its_own():
    """A probe of 1 kg, which a constant force pushes from a base of a tonne that carries the main tip."""
    mass, force, steps = 1.0, 10.0, 100
    body = {"mass": mass, "inertia": [0.1, 0.1, 0.1], "center_of_mass": [0, 0, 0]}
    scene = load_scene(
        {
            "name": "probe",
            "base": {"mass": 1000.0, "inertia": [100, 100, 100]},
            "links": [{**body, "name": "slide", "joint": {}, "joint_type": "prismatic"}],
            "tip_link": "base",
            "other_tips": [{"name": "probe", "link": "slide", "goal": {}}],
            "actuators": {"joint_torque": {"limit": force}},
            "target": {"pose": {}},
            "cost": {"pose": 0, "terminal_pose": 0, "joint_torque": 1e-6},
            "simulation": {"dt": 1.0, "steps": steps},
        }
    )
    equations = SceneEquations.of(scene, [])
    start, state, cost = equations.layout.initial_state.tolist(), equations.layout.state, 0.0
    for time in range(steps + 1):
        x, back = list(start), -force / scene.base.mass  # acceleration of the base
        x[7] = 0.25 * back * time**2  # half of its position
        x[state.joint_angles.start] = 0.5 * (force / mass - back) * time**2
        x[state.base_velocity.stop - 1] = back * time
        terms = equations.cost_terms(x, [force]) if time < steps else equations.terminal_cost_terms(x)
        cost += sum(map(float, terms))
    assert cost < float(worst_cost(equations, [equations], start, steps))


def test_a_simulation_that_diverges_pays_more_than_the_true_motion():
    """Constant full actions, which undivided steps of `planar` at 150 ms do not follow."""
    scene = load_scene("planar").replace(simulation={"dt": 0.15, "steps": 400})
    whole, divided = (DQSpaceArmEnv(scene.replace(simulation={"tolerance": t})) for t in ("off", 1e-6))
    rng, diverged = np.random.default_rng(0), 0
    for _ in range(6):
        action = rng.choice([-1.0, 1.0], whole.action_space.shape)
        returns, ends = [], []
        for env in (whole, divided):
            env.reset(options={"nominal": True})
            total, over = 0.0, False
            while not over:
                _, reward, over, _, info = env.step(action)
                total += reward
            returns.append(total)
            ends.append(info["diverged"])
        assert not ends[1]
        if ends[0]:
            diverged += 1
            assert returns[0] < returns[1]
    assert diverged >= 3


BODY = {
    "base": {"motion": "planar", "mass": 10.0, "inertia": [1, 1, 1]},
    "actuators": {"base_force": {"limit": 0.1}, "base_torque": {"limit": 0.1}},
    "simulation": {"steps": 20, "dt": 0.1},
}
PHASES = ({"name": "first", "steps": 10}, {"name": "second", "steps": 10})


def obstacle(place):
    """A place that no body may touch, or the episode ends."""
    bodies, there = (
        [{"frame": "base", "radius": 0.1}],
        {"frame": "inertial", "position": place, "radius": 0.15},
    )
    ends = {"name": "keep", "kind": "distance", "bodies": bodies, "obstacles": [there]}
    return {**ends, "terminates": True, "tolerance": 0.01}


@pytest.mark.slow
def test_ending_early_does_not_save_the_way_to_where_the_target_comes_to_rest():
    away = {"target.motion": None, "target.pose.position": [3000, 0, 0]}
    scene = load_scene(
        {
            **BODY,
            "name": "rests far away",
            "target": {
                "pose": {"position": [0.5, 0, 0]},
                "motion": {"kind": "screw", "linear_velocity": [0.01, 0, 0]},
            },
            "phases": [PHASES[0], {**PHASES[1], "changes": away}],
            "constraints": [obstacle([0, 0.3, 0])],
        }
    )
    check_that_ending_early_costs_more(scene, "base v_y", 1.2)


@pytest.mark.slow
def test_ending_early_does_not_save_what_a_caught_body_brings():
    """A body of a tonne at 5 m/s takes the robot along."""
    boom = {"name": "boom", "mass": 1.0, "inertia": [0.1, 0.1, 0.1], "center_of_mass": [0.5, 0, 0]}
    caught = {"attitude_error_deg": 5, "position_error": 0.05}
    scene = load_scene(
        {
            **BODY,
            "name": "caught by a tonne",
            "links": [{**boom, "joint": {"position": [0.5, 0, 0]}}],
            "tip": {"position": [1.0, 0, 0]},
            "payload": {"mass": 1000.0, "inertia": [100, 100, 100]},
            "actuators": {**BODY["actuators"], "joint_torque": {"limit": 0.1}},
            "target": {
                "pose": {"position": [1.5, -5, 0]},
                "motion": {"kind": "screw", "linear_velocity": [0, 5, 0]},
            },
            "cost": {"pose": 0.0, "terminal_pose": 0.0, "base_velocity": [0, 0, 0, 100, 100, 100]},
            "phases": [{**PHASES[0], "changes": {"payload": None}}, {**PHASES[1], "catch": caught}],
            "constraints": [obstacle([-0.257, 0, 0])],
        }
    )
    info = check_that_ending_early_costs_more(scene, "base v_x", -0.1)
    assert info["caught"] == 1.0


def check_that_ending_early_costs_more(scene, velocity, toward_the_obstacle):
    """Fly on without an action, and into the obstacle; returns the last info of the former."""
    env, ends = DQSpaceArmEnv(scene), []
    for speed in (0.0, toward_the_obstacle):
        x = env.kernels.layout.initial_state.copy()
        x[env.kernels.layout.state.names.index(velocity)] += speed
        env.reset(options={"initial_state": x})
        total, over = 0.0, False
        while not over:
            _, reward, over, _, info = env.step(np.zeros(env.action_space.shape))
            total += reward
        ends.append((total, env.get_state()["memory"][0], info))
    (flown, steps, info), (ended, few, _) = ends
    assert (steps, few < steps) == (scene.simulation.steps, True)
    assert ended < flown
    return info


@pytest.mark.parametrize("spread", [{"base_mass": 0.1}, {"link_masses": 0.1}])
def test_masses_vary_beside_a_link_that_is_fixed_to_the_base(spread):
    panel = {"name": "panel", "mass": 5.0, "inertia": [0.3, 0.4, 0.7], "center_of_mass": [0.0, 0.8, 0.0]}
    scene = load_scene(
        {
            "name": "panel",
            "base": {"mass": 100.0, "inertia": [10.0, 10.0, 9.0]},
            "links": [{**panel, "joint": {"position": [0.0, 0.5, 0.0]}, "joint_type": "fixed"}],
            "tip_link": "base",
            "actuators": {"base_force": {"limit": 10.0}, "base_torque": {"limit": 2.0}},
            "target": {"pose": {"position": [1.0, 0.0, 2.0]}},
            "spread": spread,
        }
    )
    p = casadi.SX.sym("p", len(compile_scene(scene).layout.parameters.names))
    equations = SceneEquations.of(scene, casadi.vertsplit(p))
    x = casadi.SX.sym("x", equations.field.n_x)
    bound = casadi.Function("bound", [x, p], [worst_cost(equations, [equations], casadi.vertsplit(x), STEPS)])
    layout = compile_scene(scene).layout
    expected = charge(scene.replace(spread={}), [layout.initial_state], STEPS)
    assert float(bound(layout.initial_state, layout.parameters.nominal)) == pytest.approx(expected[0])
