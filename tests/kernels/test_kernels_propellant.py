"""Thrusters that empty a tank: the rocket equation, mass properties, exact derivatives, the tank's end."""

from typing import Any

import numpy as np
import pytest
from test_kernels_derivatives import complex_step_jacobians
from test_kernels_second_order import check_lagrangian

from dq_space_arm_env import Scene, SceneError, compile_scene, list_scenes, load_scene
from dq_space_arm_env.algebra import poses
from dq_space_arm_env.environment import DQSpaceArmEnv
from dq_space_arm_env.interoperability.exporting import refuse
from dq_space_arm_env.interoperability.pinocchio_twin import (
    generalized_forces,
    pinocchio_model,
    to_pinocchio,
)
from dq_space_arm_env.kernels.programs.scene_programs import ScenePrograms
from dq_space_arm_env.scene import INTEGRATORS, StateLayout
from dq_space_arm_env.scene.thrusters import STANDARD_GRAVITY, fuel_used
from dq_space_arm_env.task.equations import SceneEquations
from dq_space_arm_env.task.worst_case import worst_cost

ARM = {  # a third of the mass is propellant, off the center
    "name": "propellant",
    "base": {"motion": "planar", "mass": 20.0, "inertia": [1.0, 1.0, 1.2]},
    "links": [
        {
            "name": "boom",
            "mass": 4.0,
            "inertia": [0.1, 0.1, 0.1],
            "center_of_mass": [0.4, 0.1, 0.0],
            "joint": {"position": [0.4, 0.0, 0.0]},
        }
    ],
    "tip": {"position": [0.8, 0.0, 0.0]},
    "actuators": {
        "thrusters": [
            {"position": [-0.5, 0.2, 0.0], "direction": [1, 0, 0], "force": 3.0, "specific_impulse": 2.0},
            {"position": [0.2, -0.5, 0.0], "direction": [1, 2, 0], "force": 3.0, "specific_impulse": 3.0},
            {"position": [0.5, 0.2, 0.0], "direction": [-1, 0, 0], "force": 3.0, "specific_impulse": 2.0},
            {"position": [-0.2, 0.5, 0.0], "direction": [0, -1, 0], "force": 3.0, "specific_impulse": 2.0},
        ],
        "tank": {"propellant": 12.0, "position": [-0.3, 0.15, 0.0]},
        "joint_torque": {"limit": 2.0},
    },
    "target": {"pose": {"position": [0.9, 0.5, 0.0]}},
    "cost": {"thruster_force": 0.1},
    "initial_state": {"base_velocity": [0.0, 0.0, 0.4, 0.3, -0.2, 0.0], "joint_rates": [0.5]},
    "simulation": {"dt": 0.05, "steps": 100},
}


def planar(**changes: Any) -> Scene:
    return Scene.model_validate(ARM).replace(changes)


def test_a_rocket_gains_the_speed_of_tsiolkovsky() -> None:
    jet = {"position": [-0.5, 0, 0], "direction": [1, 0, 0], "force": 20.0, "specific_impulse": 60.0}
    still = {"base_velocity": [0.0] * 6, "joint_rates": [], "joint_angles": []}
    scene = planar(
        links=[],
        tip={},
        initial_state=still,
        **{"actuators.thrusters": [jet], "actuators.tank.position": [-0.3, 0.0, 0.0]},
        **{"actuators.joint_torque": None, "actuators.tank.propellant": 5.0},
    )
    kernels = compile_scene(scene)
    states = kernels.simulate(kernels.layout.initial_state, np.array([20.0]), steps=100, dt=0.1)
    gas, state = 60.0 * STANDARD_GRAVITY, kernels.layout.state
    left = 5.0 - 20.0 * 0.1 * np.arange(101) / gas
    np.testing.assert_allclose(states[:, state.propellant][:, 0], left, rtol=0, atol=1e-13)
    speed = gas * np.log(25.0 / (20.0 + left))
    np.testing.assert_allclose(states[:, state.linear_velocity][:, 0], speed, rtol=0, atol=1e-12)
    assert left[0] - left[-1] == pytest.approx(fuel_used(scene, np.full((200, 1), 20.0)))  # of 10 s


@pytest.mark.parametrize("name", ["planar", pytest.param("thrusters", marks=pytest.mark.slow)])
def test_the_robot_is_the_dry_one_with_a_point_mass_in_its_tank(name: str, draw: Any) -> None:
    pin = pytest.importorskip("pinocchio")
    place = [-0.3, 0.15, 0.0 if name == "planar" else -0.2]
    tank = {"actuators.tank": {"propellant": 12.0, "position": place}}
    kernels, states, inputs = draw(planar() if name == "planar" else load_scene(name).replace(tank), 5)
    states[:, kernels.layout.state.propellant] = np.linspace(0.0, 12.0, 5)[:, None]
    dry = kernels.scene.replace({"actuators.tank": None})
    for x, u in zip(states, inputs, strict=True):
        model, plain = pinocchio_model(dry), np.delete(x, kernels.layout.state.propellant)
        mass = float(x[kernels.layout.state.propellant][0])
        model.appendBodyToJoint(1, pin.Inertia(mass, np.array(place), np.zeros((3, 3))), pin.SE3.Identity())
        q, v = to_pinocchio(dry, plain)
        data = model.createData()
        a = pin.aba(model, data, q, v, generalized_forces(dry, plain, u))
        base = [a[2], *a[:2], *a[3:]] if name == "planar" else [*a[3:6], *a[:3], *a[6:]]
        found = kernels.forward_dynamics(x, u)
        np.testing.assert_allclose(found, base, rtol=0, atol=1e-12 * np.abs(base).max())
        assert kernels.energy(x) == pytest.approx(pin.computeKineticEnergy(model, data, q, v), rel=1e-12)
    with pytest.raises(SceneError, match="its tank, which empties, has no place"):
        pinocchio_model(kernels.scene)


def test_robot_and_exhaust_keep_their_momentum() -> None:
    """Gas leaves with the velocity of the tank besides what the thrust gives it."""
    scene, u = planar(), np.array([0.7, 3.0, 1.0, 0.0, 0.5])
    kernels, dt = compile_scene(scene), 0.002
    layout, jets = kernels.layout, scene.actuators.thrusters
    tank = np.array(scene.actuators.tank.position)
    burnt = sum(jet.mass_flow * f for jet, f in zip(jets, u[1:], strict=True))
    force = sum(np.array(jet.unit_direction) * f for jet, f in zip(jets, u[1:], strict=True))
    torque = sum(jet.moment[2] * f for jet, f in zip(jets, u[1:], strict=True))
    com = np.array(scene.links[0].center_of_mass)

    def momentum(x: np.ndarray) -> np.ndarray:
        """Of the robot: linear, and angular about the origin."""
        (base, link), mass = kernels.frame_poses(x)[:2], float(x[layout.state.propellant][0])
        masses = [(20.0, np.zeros(3), base), (mass, tank, base), (4.0, com, link)]
        places = [m * np.add(*_place(frame, point)) for m, point, frame in masses]
        center = sum(places) / (24.0 + mass)
        found = kernels.momentum(x)
        return np.array([*found[:2], found[5] + np.cross(center, found[:3])[2]])

    def leaving(x: np.ndarray) -> np.ndarray:
        """Momentum that the robot loses per time, with the gas, less the thrust."""
        origin, arm = _place(kernels.frame_poses(x)[0], tank)
        axes = np.array(poses.to_matrix(tuple(kernels.frame_poses(x)[0]))[0], float)
        spin, velocity = np.array([0.0, 0.0, x[layout.state.base_velocity][0]]), np.zeros(3)
        velocity[:2] = x[layout.state.linear_velocity]
        gas = burnt * (axes @ velocity + np.cross(spin, arm))
        push = axes @ force
        about = np.cross(origin + arm, gas)[2] - np.cross(origin, push)[2] - torque
        return np.array([*(gas - push)[:2], about])

    states = kernels.simulate(layout.initial_state, u, steps=1000, dt=dt)
    assert states[0, -1] - states[-1, -1] > 0.3
    rates = np.array([leaving(x) for x in states])
    lost = dt / 3.0 * (rates[:-1:2] + 4.0 * rates[1::2] + rates[2::2]).sum(axis=0)  # Simpson
    np.testing.assert_allclose(momentum(states[0]) - momentum(states[-1]), lost, rtol=0, atol=1e-11)


def _place(frame: np.ndarray, point: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Origin of a frame, and a point of it seen from there, inertial axes."""
    rotation, origin = poses.to_matrix(tuple(frame))
    return np.array(origin, float), np.array(rotation, float) @ point


# Two share all but numbers with rodas4 and rk6.
ALIKE = ("rodas5p", "rk8")
METHODS = [name for name, entry in INTEGRATORS.items() if not (entry.keeps_momentum or name in ALIKE)]


@pytest.mark.parametrize(
    "integrator",
    [name if name == "rk4" else pytest.param(name, marks=pytest.mark.slow) for name in METHODS],
)
def test_derivatives_of_a_step_agree_with_complex_steps(integrator: str, draw: Any) -> None:
    kernels, (x,), (u,) = draw(planar(), 1)
    x[-1] = 7.0
    program = ScenePrograms(kernels.scene).build("step", integrator)
    for found, expected in zip(
        kernels.linearize(x, u, integrator=integrator),
        complex_step_jacobians(kernels, program, x, u),
        strict=True,
    ):
        np.testing.assert_allclose(found, expected, rtol=0, atol=1e-12 * np.abs(expected).max())


def test_second_derivatives_agree_with_differences(draw: Any) -> None:
    kernels, (x,), (u,) = draw(planar(), 1)
    x[-1] = 7.0
    check_lagrangian(kernels, "rk4", x, u, 0)


def test_an_empty_tank_stops_the_jets() -> None:
    env = DQSpaceArmEnv(planar(**{"actuators.tank.propellant": 0.03}))
    env.reset(options={"nominal": True})
    layout, still = env.kernels.layout.state, np.zeros(env.kernels.n_u)
    push = np.array([0.0, 1.0, 0.5, -1.0, -1.0])
    flow = 3.0 * (1.0 / 2.0 + 0.5 / 3.0) / STANDARD_GRAVITY * 0.05  # kg of a step: there are three
    before = env.state
    for left in (0.03 - flow, 0.03 - 2 * flow, 0.0, 0.0):
        env.step(push)
        assert env.state[layout.propellant][0] == pytest.approx(left, abs=1e-15)
    after = env.state
    env.step(push)
    pushed = env.state
    env.reset(options={"initial_state": after})
    env.step(still)
    np.testing.assert_allclose(pushed, env.state, rtol=0, atol=1e-30)
    # The last step burns what is left, by all jets in proportion.
    env.reset(options={"initial_state": before})
    share = 0.03 / flow - 2.0
    for action in (push, push, np.where(push > 0.0, share * push, push), still):
        env.step(action)
    np.testing.assert_allclose(after, env.state, rtol=0, atol=1e-14)


@pytest.mark.slow
def test_the_expert_keeps_its_reserve() -> None:
    from experts import GuidedDDP

    task = {
        "initial_state": {"base_velocity": [0.0] * 6, "joint_rates": [0.0]},
        "target": {"pose": {"position": [1.8, 0.4, 0.0]}},
        "simulation.dt": 0.1,
    }
    reserve = {"kind": "propellant", "name": "reserve", "reserve": 11.8}
    free, kept = planar(**task), planar(**task, constraints=[reserve])
    plans = [GuidedDDP(scene).solve(compile_scene(scene).layout.initial_state) for scene in (free, kept)]
    assert all(plan.converged for plan in plans)
    assert plans[0].states[-1, -1] < 11.6
    assert plans[1].states[-1, -1] == pytest.approx(11.8, abs=1e-6)
    plan, env = plans[1], DQSpaceArmEnv(kept)
    env.reset(options={"nominal": True})
    for u in plan.controls:
        env.step(env.kernels.layout.to_action(u))
    np.testing.assert_allclose(env.state, plan.states[-1], rtol=0, atol=1e-12)


def test_nothing_that_may_happen_costs_more_than_the_bound() -> None:
    scene = planar()
    env, equations = DQSpaceArmEnv(scene), SceneEquations.of(scene)
    rng = np.random.default_rng(0)
    env.reset(options={"nominal": True})
    bound = float(worst_cost(equations, [equations], env.state.tolist(), float(scene.simulation.steps)))
    cost = 0.0
    for _ in range(scene.simulation.steps):
        cost -= env.step(rng.uniform(-1.0, 1.0, env.kernels.n_u))[1]
    assert cost < bound < 1e5 * cost


def test_absent_tanks_leave_nothing_behind() -> None:
    for name in list_scenes():
        layout = StateLayout.of(load_scene(name))
        assert layout.state.propellant.start == layout.state.propellant.stop


@pytest.mark.parametrize(
    ("changes", "sentence"),
    [
        ({"actuators.thrusters": None}, "feeds nothing: remove it or add actuators.thrusters"),
        ({"actuators.thrusters.1.specific_impulse": None}, "must be given: the tank feeds this thruster"),
        ({"actuators.tank.position": [0, 0, 1]}, "the z component must be 0"),
        ({"actuators.tank.propellant": 0.0}, "must be a finite number greater than 0"),
        ({"simulation.integrator": "gauss6"}, "with actuators.tank use symplectic_euler, rk4"),
        (
            {"constraints": [{"kind": "propellant", "name": "r", "reserve": 12.0}]},
            "must be below the propellant at the start, 12 kg",
        ),
        (
            {"actuators.tank": None, "constraints": [{"kind": "propellant", "name": "r"}]},
            "the scene has no actuators.tank",
        ),
    ],
)
def test_tanks_that_do_not_fit_are_refused(changes: dict[str, Any], sentence: str) -> None:
    with pytest.raises(SceneError, match=sentence):
        planar(**changes)


def test_what_cannot_burn_propellant_says_so() -> None:
    kernels = compile_scene(planar())
    with pytest.raises(ValueError, match="integrator: 'momentum_rk4' keeps the momentum"):
        kernels.step(kernels.layout.initial_state, np.zeros(kernels.n_u), integrator="momentum_rk4")
    with pytest.raises(SceneError, match="no tank that empties"):
        refuse(kernels.scene, "URDF", "refuse")
