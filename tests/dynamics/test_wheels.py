"""Reaction wheels: gyroscopic coupling against Basilisk and Pinocchio, momentum, limits of the motors."""

from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from pinocchio_twin import pin, pinocchio_model, random_tree
from scipy.spatial.transform import Rotation

from dq_space_arm_env import Scene, SceneError, compile_scene, list_scenes, load_scene
from dq_space_arm_env.dynamics.equations_of_motion import EquationsOfMotion
from dq_space_arm_env.dynamics.kinematic_tree import KinematicTree
from dq_space_arm_env.environment import DQSpaceArmEnv
from dq_space_arm_env.interoperability.pinocchio_twin import pinocchio_model as twin
from dq_space_arm_env.interoperability.urdf_export import scene_to_urdf
from dq_space_arm_env.scene import StateLayout

AXES = ((1.0, 0.0, 0.0), (0.0, 0.8, 0.6), (0.48, -0.6, 0.64))
MOMENTS = (0.05, 0.04, 0.06)
SKEW = [{"axis": axis, "inertia": moment, "torque": 10.0} for axis, moment in zip(AXES, MOMENTS, strict=True)]
HUB = [[10.5, 0.4, -0.3], [0.4, 11.2, 0.25], [-0.3, 0.25, 9.35]]


def skew_scene(**changes: Any) -> Scene:
    """The robot of `no-wrist` with three skew wheels, and full inertia of the hub."""
    return load_scene("no-wrist").replace({"base.inertia": HUB, "actuators.wheels": SKEW, **changes})


def small_scene(**changes: Any) -> Scene:
    """A hub with one joint and two skew wheels, which compiles in a second."""
    scene = skew_scene()
    links = [scene.links[1].model_copy(update={"torque_limit": None})]
    start = {"joint_angles": [0.5], "joint_rates": [0.1], "wheel_speeds": [80.0, -60.0]}
    return scene.replace({"links": links, "initial_state": start, "actuators.wheels": SKEW[1:], **changes})


# Basilisk 2.12.1, a hub with reactionWheelStateEffector and three links, RK4 at 1.5 ms; inputs held 15 ms.
WHEEL_TORQUES = (
    (2.4603067149651485e-05, -0.1440250892498306, -0.005482757107244352),
    (-0.01571187536243277, -0.1590891969732098, 0.08016706890007076),
    (0.005402563358755533, -0.1231788204053132, 0.09015586962897341),
    (-0.006110539807210626, -0.14016519184807566, 0.10713774016320123),
    (0.010505815597767542, -0.16854186595651222, 0.09941496355073454),
    (0.024401241116352116, -0.17677883455474144, 0.09084768477919564),
    (-0.025432788042112277, -0.17563890542287589, 0.06316529924416536),
    (0.009984945440623933, -0.17514225835522487, 0.10542528717643404),
)
BEFORE: dict[str, Any] = {
    "rotation": (0.9233805168766387, 0.20519567041703082, -0.3077935056255462, 0.10259783520851541),
    "position": (0.3, -2.9, 4.4),
    "angular": (0.1, -0.07, 0.05),
    "velocity": (0.02, -0.03, 0.01),
    "speeds": (100.0, -80.0, 60.0),
    "angles": (-0.6, 0.9, -1.6),
    "rates": (0.3, -0.2, 0.4),
}
AFTER: dict[str, Any] = {
    "rotation": (0.9204850639965918, 0.21025044230623016, -0.3117240363957479, 0.10644305333072308),
    "position": (0.30236325820624166, -2.9035316468981422, 4.401256411748292),
    "angular": (0.10137189252149277, -0.0715954332883783, 0.05322983809415788),
    "velocity": (0.019416376365895147, -0.028861245262814663, 0.01094338578418492),
    "speeds": (99.9995472970892, -80.47412161726294, 60.15402492432024),
    "angles": (-0.5652944146340725, 0.8749420279983342, -1.5502141634646203),
    "rates": (0.2784174994198275, -0.2174296521367357, 0.42967691689760246),
}


def basilisk_state(kernels: Any, given: dict[str, Any]) -> np.ndarray:
    """A state of the reference, whose velocity is in inertial axes."""
    changes = {"rotation": given["rotation"], "position": given["position"]}
    turn = Rotation.from_quat(given["rotation"], scalar_first=True)
    linear = turn.inv().apply(given["velocity"]).tolist()
    start = {
        "base_pose": changes,
        "base_velocity": [*given["angular"], *linear],
        "joint_angles": given["angles"],
        "joint_rates": given["rates"],
        "wheel_speeds": given["speeds"],
    }
    return StateLayout.of(kernels.scene.replace(initial_state=start)).initial_state.copy()


def test_a_motion_of_basilisk_is_reproduced() -> None:
    kernels = compile_scene(skew_scene())
    x = basilisk_state(kernels, BEFORE)
    for k, torques in enumerate(WHEEL_TORQUES):
        t = 0.015 * k
        force = [1.5 * np.sin(t), 1.5 * np.cos(0.8 * t), -1.5 * np.sin(0.6 * t)]
        torque = [0.2 * np.cos(t), 0.2 * np.sin(0.9 * t), 0.2 * np.cos(0.4 * t)]
        joints = [0.05 * np.sin(1.1 * t), -0.05 * np.cos(0.9 * t), 0.05 * np.sin(0.7 * t)]
        for _ in range(10):
            x = kernels.step(x, np.array([*force, *torque, *joints, *torques]), dt=0.0015)
    expected = basilisk_state(kernels, AFTER)
    expected[:8] *= np.sign(expected[:4] @ x[:4])
    np.testing.assert_allclose(x, expected, rtol=0, atol=6e-14)


def test_accelerations_are_those_of_wheels_as_bodies_of_their_own() -> None:
    rng, layout = np.random.default_rng(0), StateLayout.of(skew_scene())
    for _ in range(20):
        tree = random_tree(rng, 3, branches=True, wrist=False)
        equations = EquationsOfMotion(KinematicTree.from_scene(skew_scene()), layout)
        wheels = equations.tree.wheels
        inertia = np.array(tree.base.inertia)
        inertia -= sum(w.inertia * np.outer(w.axis, w.axis) for w in wheels)
        base = type(tree.base)(tree.base.mass, tree.base.center_of_mass, inertia.tolist())
        equations.tree = replace(tree, base=base, wheels=wheels)
        y, u = rng.normal(size=equations.n_y), rng.normal(size=equations.n_u)
        found = equations.accelerations(y.tolist(), u.tolist())

        # The locked wheels as revolute leaves, their axial inertia taken from the hub.
        model = pinocchio_model(tree)
        model.inertias[1] = pin.Inertia(tree.base.mass, np.zeros(3), inertia)
        for i, wheel in enumerate(wheels):
            turn, _ = Rotation.align_vectors([wheel.axis], [[0.0, 0.0, 1.0]])
            place = pin.SE3(turn.as_matrix(), np.zeros(3))
            joint = model.addJoint(1, pin.JointModelRZ(), place, f"wheel {i}")
            axial = np.diag([0.0, 0.0, wheel.inertia])
            model.appendBodyToJoint(joint, pin.Inertia(0.0, np.zeros(3), axial), pin.SE3.Identity())
        motion = equations.motion(y.tolist())
        speeds = [
            h / w.inertia - np.dot(w.axis, motion.angular)
            for w, h in zip(wheels, motion.wheel_momenta, strict=True)
        ]
        q = np.array([0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 1.0, *motion.joint_angles, 0.0, 0.0, 0.0])
        v = np.array([*motion.linear, *motion.angular, *motion.joint_rates, *speeds])
        force, torque, joints, motors = np.split(u, [3, 6, 9])
        acceleration = pin.aba(model, model.createData(), q, v, np.array([*force, *torque, *joints, *motors]))
        expected = np.array([*acceleration[3:6], *acceleration[:3], *acceleration[6:9]])
        np.testing.assert_allclose(found, expected, rtol=0, atol=1e-14 * np.abs(expected).max())
        # h' = u
        change = acceleration[9:] + [np.dot(w.axis, acceleration[3:6]) for w in wheels]
        np.testing.assert_allclose(MOMENTS * change, motors, rtol=0, atol=1e-15 * np.abs(expected).max())


def test_motors_change_the_energy_by_their_power_and_no_total_momentum() -> None:
    scene = small_scene(**{"actuators.base_force": None, "actuators.base_torque": None})
    kernels = compile_scene(scene)
    x, rng, u = kernels.layout.initial_state, np.random.default_rng(1), np.zeros(3)
    momentum, energy, work = kernels.momentum(x), kernels.energy(x), 0.0
    speeds_of = np.array([wheel.unit_axis for wheel in scene.actuators.wheels])
    for _ in range(100):
        u[1:] = rng.uniform(-0.5, 0.5, 2)
        for _ in range(10):
            powers = []
            ahead = kernels.simulate(x, np.tile(u, (2, 1)), 2, dt=0.0005)
            for state in ahead:
                speeds = state[kernels.layout.state.wheel_momenta] / MOMENTS[1:]
                speeds = speeds - speeds_of @ state[kernels.layout.state.angular_velocity]
                powers.append(u[1:] @ speeds)
            work += 0.001 * (powers[0] + 4.0 * powers[1] + powers[2]) / 6.0
            x = ahead[-1]
    np.testing.assert_allclose(kernels.momentum(x), momentum, rtol=0, atol=7e-14)
    assert abs(kernels.energy(x) - energy - work) < 1e-9 * energy
    assert abs(kernels.energy(x) - energy) > 0.1


@pytest.mark.parametrize("integrator", ["momentum_rk4", "rodas4", "gauss6"])
def test_momentum_methods_keep_the_total_momentum(integrator: str) -> None:
    kernels = compile_scene(small_scene())
    rng, x = np.random.default_rng(2), kernels.layout.initial_state
    u = np.zeros((2000, kernels.n_u))
    u[:, 6:] = rng.uniform(-0.3, 0.3, (2000, 3))  # joint and wheels: internal torques
    states = kernels.simulate(x, u, 2000, integrator=integrator, every=20)
    momentum = kernels.momentum(states)
    assert np.abs(states[-1] - x)[kernels.layout.state.wheel_momenta].min() > 0.01
    assert np.abs(momentum - momentum[0]).max() < 2e-14
    by_rk4 = kernels.momentum(kernels.simulate(x, u, 2000, integrator="rk4", every=20))
    assert np.abs(by_rk4 - by_rk4[0]).max() > 1e-12
    np.testing.assert_allclose(
        states[-1], kernels.simulate(x, u, 2000, integrator="rk4", every=20)[-1], rtol=0, atol=2e-11
    )


def test_absent_wheels_leave_nothing_behind() -> None:
    assert "wheels" in list_scenes()
    for name in list_scenes():
        layout = StateLayout.of(load_scene(name))
        count = layout.state.wheel_momenta.stop - layout.state.wheel_momenta.start
        assert count == (4 if name == "wheels" else 0)
        assert count == layout.control.wheel_torque.stop - layout.control.wheel_torque.start


def environment(**wheel: float) -> DQSpaceArmEnv:
    wheels = [{**SKEW[1], "torque": 0.5, **wheel}, {**SKEW[2], "torque": 0.5}]
    return DQSpaceArmEnv(small_scene(**{"actuators.wheels": wheels, "constraints": ()}))


def wheel_speed(env: DQSpaceArmEnv) -> float:
    layout = env.kernels.layout.state
    momentum, angular = env.state[layout.wheel_momenta][0], env.state[layout.angular_velocity]
    return float(momentum / MOMENTS[1] - np.dot(AXES[1], angular))


def test_a_wheel_stops_gaining_speed_at_its_largest_and_brakes() -> None:
    env = environment(speed=80.5)
    env.reset(options={"nominal": True})
    action = np.zeros(env.kernels.n_u)
    action[7] = 1.0
    speeds = []
    for _ in range(10):  # 0.1875 rad/s per step at full torque
        env.step(action)
        speeds.append(wheel_speed(env))
    assert speeds[0] == pytest.approx(80.1875, abs=0.01)
    assert speeds[-1] == pytest.approx(80.5, abs=0.002)
    assert max(speeds) < 80.502
    env.step(-action)
    assert wheel_speed(env) == pytest.approx(80.5 - 0.1875, abs=0.01)


def test_a_motor_takes_no_more_than_its_power() -> None:
    env = environment(power=20.0)
    env.reset(options={"nominal": True})
    action = np.zeros(env.kernels.n_u)
    action[7] = -1.0
    start = wheel_speed(env)
    env.step(action)
    assert wheel_speed(env) - start == pytest.approx(-20.0 / 80.0 * 0.015 / MOMENTS[1], rel=0.05)


def test_limits_of_the_power_are_numbers_in_phases_without_wheels() -> None:
    wheels = [{**wheel, "torque": 0.5, "power": 20.0} for wheel in SKEW[1:]]
    phases: list[dict[str, Any]] = [
        {"name": "with", "steps": 1},
        {"name": "without", "steps": 1, "changes": {"actuators.wheels": None}},
    ]
    scene = small_scene(
        **{"actuators.wheels": wheels, "phases": phases, "simulation.steps": 2},
        constraints=[{"name": "wheels", "kind": "wheel_limits"}],
    )
    kernels = compile_scene(scene)
    x, still = kernels.layout.initial_state, np.zeros(kernels.n_u)
    given, missing, _ = kernels.stage_parameters()
    residuals = kernels.constraints(x, still, given)
    np.testing.assert_array_equal(kernels.constraints(x, still, missing), residuals)
    jacobian = kernels.constraint_jacobian(x, still, given)
    np.testing.assert_array_equal(kernels.constraint_jacobian(x, still, missing), jacobian)


@pytest.mark.parametrize(
    ("changes", "sentence"),
    [
        ({"actuators.wheels": []}, "must be a list of wheels, or a set"),
        ({"actuators.wheels": {"set": "pyramid", "inertia": 9, "torque": 1}}, "as much inertia as the base"),
        ({"actuators.wheels": {"set": "cube", "inertia": 1, "torque": 1}}, "'orthogonal' or 'pyramid'"),
        ({"initial_state": {"wheel_speeds": [1.0]}}, "must be 3 numbers (one per wheel)"),
        (
            {"spread": {"wheel_speeds": 3.0}, "actuators.wheels": [{**SKEW[0], "speed": 2.0}]},
            "starts at up to 3 rad/s",
        ),
        ({"constraints": [{"kind": "wheel_limits", "name": "w"}]}, "no largest speed or power"),
        (
            {"constraints": [{"kind": "wheel_momentum", "name": "w", "capacity": 1}]},
            "by the kind wheel_limits",
        ),
    ],
)
def test_wheels_that_do_not_fit_are_refused(changes: dict[str, Any], sentence: str) -> None:
    with pytest.raises(SceneError, match=sentence.replace("(", r"\(").replace(")", r"\)")):
        skew_scene(**changes)


def test_formats_without_wheels_say_so() -> None:
    for write in (scene_to_urdf, twin):
        with pytest.raises(SceneError, match="reaction wheels"):
            write(skew_scene())


def test_sets_store_as_much_about_each_axis() -> None:
    for name, count in (("orthogonal", 3), ("pyramid", 4)):
        scene = skew_scene(**{"actuators.wheels": {"set": name, "inertia": 0.01, "torque": 1.0}})
        axes = np.array([wheel.unit_axis for wheel in scene.actuators.wheels])
        np.testing.assert_allclose(axes.T @ axes, count / 3.0 * np.eye(3), rtol=0, atol=1e-15)
        assert Scene.model_validate(scene.model_dump()) == scene
