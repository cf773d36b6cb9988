"""The same motion in Basilisk: wheels, thrusters, a tank, arms that turn and arms that slide."""

from collections.abc import Sequence
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from dq_space_arm_env import Kernels, Scene, compile_scene

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


class Twin:
    """A hub in Basilisk that starts as the base does; effectors come to it one by one."""

    def __init__(self, kernels: Kernels, method: str = "RK4") -> None:
        from Basilisk.simulation import spacecraft, svIntegrators
        from Basilisk.utilities import SimulationBaseClass, macros

        self.sim = SimulationBaseClass.SimBaseClass()
        process = self.sim.CreateNewProcess("dynamics")
        process.addTask(self.sim.CreateNewTask("step", macros.sec2nano(DT)))
        self.hub, self.kernels, base = spacecraft.Spacecraft(), kernels, kernels.scene.base
        self.hub.ModelTag, self.hub.hub.mHub = "hub", base.mass
        self.hub.hub.IHubPntBc_B = np.array(base.inertia)
        self.hub.hub.r_BcB_B = [[0.0], [0.0], [0.0]]
        x = kernels.layout.initial_state
        frames, masses = kernels.frame_poses(x), [base.mass, *(link.mass for link in kernels.scene.links)]
        points = [np.zeros(3), *(np.array(link.center_of_mass) for link in kernels.scene.links)]
        frames = list(frames[: len(masses)])
        if (tank := kernels.scene.actuators.tank) is not None:
            frames, masses = [*frames, frames[0]], [*masses, tank.propellant]
            points.append(np.array(tank.position))
        # C is the center of mass of all, not the base's.
        places = [
            rotation_of(pose).apply(point) + place_of(pose)
            for pose, point in zip(frames, points, strict=True)
        ]
        self.hub.hub.sigma_BNInit = rotation_of(frames[0]).as_mrp()[:, None]
        self.hub.hub.omega_BN_BInit = x[kernels.layout.state.angular_velocity][:, None]
        self.hub.hub.r_CN_NInit = np.average(places, axis=0, weights=masses)[:, None]
        self.hub.hub.v_CN_NInit = kernels.momentum(x)[:3, None] / sum(masses)
        self.method = getattr(svIntegrators, f"svIntegrator{method}")(self.hub)
        self.hub.setIntegrator(self.method)
        self.messages: list[Any] = []
        self.models: list[Any] = [self.hub]

    def add(self, effector: Any, *, dynamic: bool = False) -> None:
        """Attach an effector to the hub."""
        (self.hub.addDynamicEffector if dynamic else self.hub.addStateEffector)(effector)
        self.models.insert(-1, effector)

    def command(self, reader: Any, kind: str, field: str, values: Sequence[float]) -> None:
        """Subscribe to a message that stays as it is."""
        from Basilisk.architecture import messaging

        payload = getattr(messaging, f"{kind}MsgPayload")()
        setattr(payload, field, list(values))
        message = getattr(messaging, f"{kind}Msg")().write(payload)
        self.messages.append(message)
        reader.subscribeTo(message)

    def fly(self) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """Rotation matrix of the base after all steps; place, velocity and angular velocity in its axes."""
        from Basilisk.utilities import macros

        for model in self.models:
            self.sim.AddModelToTask("step", model)
        self.sim.InitializeSimulation()
        self.sim.ConfigureStopTime(macros.sec2nano(DT * STEPS))
        self.sim.ExecuteSimulation()
        for effector in self.models[:-1]:  # whose messages are those of the step's start
            effector.UpdateState(macros.sec2nano(DT * STEPS))
        state = self.hub.scStateOutMsg.read()
        turn = Rotation.from_mrp(state.sigma_BN)
        velocity = turn.inv().apply(state.v_BN_N)
        return turn.as_matrix(), np.array([*state.r_BN_N, *velocity, *state.omega_BN_B])


def ours(kernels: Kernels, u: Sequence[float]) -> NDArray[np.float64]:
    """Our state after the same time."""
    states: NDArray[np.float64] = kernels.simulate(
        kernels.layout.initial_state, np.array(u), STEPS, dt=DT, integrator="rk8"
    )
    return states[-1]


def compare(kernels: Kernels, x: NDArray[np.float64], twin: Twin) -> None:
    """Compare pose and velocity of the base."""
    turn, numbers = twin.fly()
    layout = kernels.layout.state
    pose = kernels.frame_poses(x)[0]
    np.testing.assert_allclose(rotation_of(pose).as_matrix(), turn, rtol=0.0, atol=1e-14)
    expected = [*place_of(pose), *x[layout.linear_velocity], *x[layout.angular_velocity]]
    np.testing.assert_allclose(expected, numbers, rtol=0.0, atol=1e-14)


def rotation_of(pose: NDArray[np.float64]) -> Rotation:
    """Rotation of a dual quaternion."""
    return Rotation.from_quat([*pose[1:4], pose[0]])


def place_of(pose: NDArray[np.float64]) -> NDArray[np.float64]:
    """Position of a dual quaternion, 2 q_d q_r*."""
    (w, *v), (a, *b) = pose[:4], pose[4:]
    place: NDArray[np.float64] = 2.0 * (w * np.array(b) - a * np.array(v) + np.cross(v, b))
    return place


def add_jets(twin: Twin) -> Any:
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
    twin, factory = Twin(kernels), simIncludeRW.rwFactory()
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
    twin = Twin(kernels)
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
    from Basilisk.simulation import linearTranslationNDOFStateEffector, spinningBodyNDOFStateEffector

    turns = joint_type == "revolute"
    kernels = compile_scene(
        scene(
            links=[link | {"joint_type": joint_type} for link in ARM],
            actuators={"joint_torque": {"limit": 10.0}, "base_force": {"limit": 1.0}},
            **{"initial_state.joint_angles": ANGLES, "initial_state.joint_rates": RATES},
        )
    )
    twin = Twin(kernels, "RKF78")
    effector: Any = (
        spinningBodyNDOFStateEffector.SpinningBodyNDOFStateEffector()
        if turns
        else linearTranslationNDOFStateEffector.LinearTranslationNDOFStateEffector()
    )
    for link, angle, rate in zip(kernels.scene.links, ANGLES, RATES, strict=True):
        com, place = (np.array(v)[:, None] for v in (link.center_of_mass, link.joint.position))
        # Their axis of sliding is given in the parent's axes, their spring is at rest at zero.
        axes = np.array(link.joint.rotation_matrix)
        body: Any = (
            spinningBodyNDOFStateEffector.SpinningBody()
            if turns
            else linearTranslationNDOFStateEffector.TranslatingBody()
        )
        body.setMass(link.mass)
        body.setK(link.stiffness)
        body.setC(link.damping)
        if turns:
            body.setISPntSc_S(np.array(link.inertia))
            body.setR_ScS_S(com)
            body.setR_SP_P(place)
            body.setDCM_S0P(axes.T)
            body.setSHat_S([[0.0], [0.0], [1.0]])
            body.setThetaInit(angle)
            body.setThetaDotInit(rate)
            effector.addSpinningBody(body)
        else:
            body.setIPntFc_F(np.array(link.inertia))
            body.setR_FcF_F(com)
            body.setR_F0P_P(place)
            body.setDCM_FP(axes.T)
            body.setFHat_P(axes[:, 2:])
            body.setRhoInit(angle)
            body.setRhoDotInit(rate)
            effector.addTranslatingBody(body)
    twin.add(effector)
    reader = effector.motorTorqueInMsg if turns else effector.motorForceInMsg
    kind = ("ArrayMotorTorque", "motorTorque") if turns else ("ArrayMotorForce", "motorForce")
    twin.command(reader, *kind, EFFORTS)
    x = ours(kernels, [0.0, 0.0, 0.0, *EFFORTS])
    compare(kernels, x, twin)
    name = "Theta" if turns else "Rho"
    names = (getattr(effector, f"getNameOf{name}{part}State")() for part in ("", "Dot"))
    found, rates = (np.ravel(twin.hub.dynManager.getStateObject(each).getState()) for each in names)
    state = kernels.layout.state
    np.testing.assert_allclose(x[state.joint_angles], found, rtol=0.0, atol=1e-14)
    np.testing.assert_allclose(x[state.joint_rates], rates, rtol=0.0, atol=1e-14)
