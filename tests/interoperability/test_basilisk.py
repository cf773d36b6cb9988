"""The same motion in Basilisk: wheels, thrusters, a tank, arms that turn and arms that slide."""

from collections.abc import Sequence
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray

from dq_space_arm_env import Kernels, Scene, compile_scene
from scripts.benchmarks.basilisk import BENCHMARK
from scripts.benchmarks.effort import QUICK
from scripts.benchmarks.harness import select
from scripts.benchmarks.peers.basilisk_peer import BasiliskTwin, nanoseconds

pytest.importorskip("Basilisk", reason="needs Basilisk: pip install bsk")
pytestmark = pytest.mark.slow

DT, STEPS = 0.002, 500
BODY = {"mass": 60.0, "inertia": [[6.0, 0.3, -0.2], [0.3, 7.0, 0.4], [-0.2, 0.4, 5.0]]}
START = {
    "base_pose": {"position": [0.3, -0.4, 0.5], "rotation": {"axis": [1, 2, 3], "angle": 40}},
    "base_velocity": [0.3, -0.2, 0.25, 0.1, 0.05, -0.1],
}
JETS = [
    {"position": [0.4, -0.3, 0.2], "direction": [1, 2, 2], "force": 3.0, "specific_impulse": 3.0},
    {"position": [-0.5, 0.2, 0.1], "direction": [0, -3, 4], "force": 2.0, "specific_impulse": 4.0},
]


def scene(**changes: Any) -> Scene:
    plain = {"name": "basilisk", "base": BODY, "target": {"pose": {}}, "initial_state": START}
    return Scene.model_validate(plain).replace(changes)


def end_of(twin: BasiliskTwin) -> NDArray[np.float64]:
    """The state of the scene after all steps."""
    twin.fly(DT * STEPS)
    for effector in twin.models[:-1]:  # whose messages are those of the step's start
        effector.UpdateState(nanoseconds(DT * STEPS))
    return twin.state()


def ours(kernels: Kernels, u: Sequence[float]) -> NDArray[np.float64]:
    """Our state after the same time."""
    states: NDArray[np.float64] = kernels.simulate(
        kernels.layout.initial_state, np.array(u), STEPS, dt=DT, integrator="rk8"
    )
    return states[-1]


def compare(kernels: Kernels, x: NDArray[np.float64], twin: BasiliskTwin) -> NDArray[np.float64]:
    """Compare pose and velocity of the base."""
    end, layout = end_of(twin), kernels.layout.state
    sign = np.sign(x[layout.pose] @ end[layout.pose])
    for part, factor in ((layout.pose, sign), (layout.base_velocity, 1.0)):
        np.testing.assert_allclose(x[part], factor * end[part], rtol=0.0, atol=1e-14)
    return end


def add_jets(twin: BasiliskTwin) -> Any:
    """Thrusters that fire all the time."""
    from Basilisk.simulation import thrusterDynamicEffector
    from Basilisk.utilities import simIncludeThruster

    effector, factory = (
        thrusterDynamicEffector.ThrusterDynamicEffector(),
        simIncludeThruster.thrusterFactory(),
    )
    effector.ModelTag = "jets"
    for jet in twin.kernels.scene.actuators.thrusters:
        place, direction = [*jet.position], [*jet.unit_direction]
        impulse = jet.specific_impulse
        # A nozzle without area: what the flow does to a base that turns is left out, as here.
        factory.create(
            "Blank_Thruster", place, direction, MaxThrust=jet.force, steadyIsp=impulse, areaNozzle=0.0
        )
    factory.addToSpacecraft("jets", effector, twin.hub)
    twin.models.insert(-1, effector)
    times = [10.0 * DT * STEPS] * len(twin.kernels.scene.actuators.thrusters)
    twin.command(effector.cmdsInMsg, "THRArrayOnTimeCmd", "OnTimeRequest", times)
    return effector


def test_wheels_and_thrusters() -> None:
    from Basilisk.simulation import reactionWheelStateEffector
    from Basilisk.utilities import simIncludeRW

    axes, torques, speeds = [[2, 1, 2], [0, 3, 4], [-1, 2, 2]], [0.2, -0.15, 0.1], [300.0, -200.0, 100.0]
    wheels = [{"axis": axis, "inertia": 0.02, "torque": 1.0} for axis in axes]
    kernels = compile_scene(
        scene(actuators={"wheels": wheels, "thrusters": JETS}, **{"initial_state.wheel_speeds": speeds})
    )
    twin, factory = BasiliskTwin(kernels, DT), simIncludeRW.rwFactory()
    for wheel, speed in zip(kernels.scene.actuators.wheels, speeds, strict=True):
        factory.create(
            "custom", [*wheel.unit_axis], Omega=speed * 30.0 / np.pi, Js=wheel.inertia, useMaxTorque=False
        )
    effector = reactionWheelStateEffector.ReactionWheelStateEffector()
    factory.addToSpacecraft("wheels", effector, twin.hub)
    twin.models.insert(-1, effector)
    twin.command(effector.rwMotorCmdInMsg, "ArrayMotorTorque", "motorTorque", torques)
    add_jets(twin)
    x = ours(kernels, [*torques, *(jet["force"] for jet in JETS)])
    compare(kernels, x, twin)
    found = [message.read().Omega for message in effector.rwOutMsgs]
    momenta, angular = x[kernels.layout.state.wheel_momenta], x[kernels.layout.state.angular_velocity]
    units = np.array([wheel.unit_axis for wheel in kernels.scene.actuators.wheels])
    np.testing.assert_allclose(momenta / 0.02 - units @ angular, found, rtol=0.0, atol=1e-11)


def test_a_tank_that_thrusters_empty() -> None:
    from Basilisk.simulation import fuelTank

    tank = {"propellant": 12.0, "position": [-0.3, 0.15, 0.2]}
    kernels = compile_scene(scene(actuators={"thrusters": JETS, "tank": tank}))
    twin = BasiliskTwin(kernels, DT)
    jets, effector, model = add_jets(twin), fuelTank.FuelTank(), fuelTank.FuelTankModelConstantVolume()
    model.propMassInit, model.radiusTankInit = tank["propellant"], 0.0
    model.r_TcT_TInit = [[0.0], [0.0], [0.0]]
    effector.setTankModel(model)
    effector.setR_TB_B(np.array(tank["position"])[:, None])
    effector.setUpdateOnly(True)
    effector.addThrusterSet(jets)
    twin.add(effector)
    x = ours(kernels, [jet["force"] for jet in JETS])
    compare(kernels, x, twin)
    assert effector.fuelTankOutMsg.read().fuelMass == pytest.approx(x[-1], abs=1e-13)
    assert x[-1] < 11.9


ARM = [
    {
        "name": f"link {i}",
        "mass": 4.0 + i,
        "inertia": [[0.2, 0.01, 0.02], [0.01, 0.3, -0.02], [0.02, -0.02, 0.25]],
        "center_of_mass": [0.1, 0.3 - 0.1 * i, 0.2],
        "joint": {"position": [0.2, 0.1 * i, 0.5], "rotation": {"axis": [1, i, 0.5], "angle": 60}},
        "stiffness": 3.0 * i,
        "damping": 0.2,
    }
    for i in range(3)
]
ANGLES, RATES, EFFORTS = (0.3, -0.5, 0.7), (0.4, -0.3, 0.2), (0.5, -0.4, 0.3)


@pytest.mark.parametrize("joint_type", ["revolute", "prismatic"])
def test_arms_that_turn_and_slide(joint_type: str) -> None:
    kernels = compile_scene(
        scene(
            links=[link | {"joint_type": joint_type} for link in ARM],
            actuators={"joint_torque": {"limit": 10.0}, "base_force": {"limit": 1.0}},
            **{"initial_state.joint_angles": ANGLES, "initial_state.joint_rates": RATES},
        )
    )
    twin = BasiliskTwin(kernels, DT, "RKF78")
    twin.add_chain(EFFORTS)
    x, state = ours(kernels, [0.0, 0.0, 0.0, *EFFORTS]), kernels.layout.state
    end = compare(kernels, x, twin)
    for part in (state.joint_angles, state.joint_rates):
        np.testing.assert_allclose(x[part], end[part], rtol=0.0, atol=1e-14)


def test_the_benchmark_finds_the_same_motion() -> None:
    rows = [*BENCHMARK.measure(replace(QUICK, duration=1.0))]
    (claim,) = select(rows, table="claims")
    assert claim["status"] == "handled", claim
    for row in select(rows, table="motion", ours_method="rk4"):  # the same formulas
        assert row["theirs_error"] == pytest.approx(row["ours_error"], rel=0.1)
