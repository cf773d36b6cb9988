"""A scene's base in Basilisk with what is attached to it, and its arm, whose joints turn or slide."""

from __future__ import annotations

from collections.abc import Sequence
from importlib import import_module
from typing import Any

import numpy as np

from dq_space_arm_env import Kernels
from dq_space_arm_env.algebra import poses, rotations
from experts.problems.shooting_problem import FloatArray


class BasiliskTwin:
    """A hub that starts as the base of a scene does; effectors come to it one by one, and it flies once."""

    def __init__(self, kernels: Kernels, step: float, method: str = "RK4") -> None:
        """Make the hub, which an integrator such as RK4 takes on in steps of so many seconds."""
        base: Any = import_module("Basilisk.utilities.SimulationBaseClass")
        spacecraft: Any = import_module("Basilisk.simulation.spacecraft")
        integrators: Any = import_module("Basilisk.simulation.svIntegrators")
        self._messaging: Any = import_module("Basilisk.architecture.messaging")
        self.sim, self.kernels, self.hub = base.SimBaseClass(), kernels, spacecraft.Spacecraft()
        process = self.sim.CreateNewProcess("dynamics")
        process.addTask(self.sim.CreateNewTask("step", nanoseconds(step)))
        body, x = kernels.scene.base, kernels.layout.initial_state
        self.hub.ModelTag, self.hub.hub.mHub = "hub", body.mass
        self.hub.hub.IHubPntBc_B = np.array(body.inertia)
        self.hub.hub.r_BcB_B = [[0.0], [0.0], [0.0]]
        scalar, *vector = kernels.frame_poses(x)[0][:4].tolist()
        self.hub.hub.sigma_BNInit = np.array(vector)[:, None] / (1.0 + scalar)
        self.hub.hub.omega_BN_BInit = x[kernels.layout.state.angular_velocity][:, None]
        place, mass = self._center_of_mass(x)
        self.hub.hub.r_CN_NInit = place[:, None]
        self.hub.hub.v_CN_NInit = kernels.momentum(x)[:3, None] / mass
        self._method = getattr(integrators, f"svIntegrator{method}")(self.hub)
        self.hub.setIntegrator(self._method)
        self._messages: list[Any] = []
        self.models: list[Any] = [self.hub]  # in the order in which they are called, the hub last
        self._chain: Any = None
        self._is_ready = False

    def _center_of_mass(self, x: FloatArray) -> tuple[FloatArray, float]:
        """Center of mass of hub, links and propellant, inertial axes, m; their mass, kg. It is C there."""
        scene, tank = self.kernels.scene, self.kernels.scene.actuators.tank
        frames = [tuple(pose.tolist()) for pose in self.kernels.frame_poses(x)]
        parts = [(frames[0], (0.0, 0.0, 0.0), scene.base.mass)]
        parts += [
            (frame, link.center_of_mass, link.mass)
            for frame, link in zip(frames[1:], scene.links, strict=False)
        ]
        if tank is not None:
            parts.append((frames[0], tank.position, tank.propellant))
        masses = np.array([mass for _, _, mass in parts])
        places = []
        for frame, point, _ in parts:
            rotation, position = poses.to_matrix(frame)
            places.append(np.array(rotation) @ np.array(point) + np.array(position))
        return np.average(places, axis=0, weights=masses), float(masses.sum())

    def add(self, effector: Any) -> None:
        """Attach an effector to the hub."""
        self.hub.addStateEffector(effector)
        self.models.insert(-1, effector)

    def command(self, reader: Any, kind: str, field: str, values: Sequence[float]) -> Any:
        """Make a message for a reader; it is returned, for `write`."""
        message = getattr(self._messaging, f"{kind}Msg")()
        self._messages.append(message)
        reader.subscribeTo(message)
        self.write(message, kind, field, values)
        return message

    def write(self, message: Any, kind: str, field: str, values: Sequence[float]) -> None:
        """Change what a message says from now on."""
        payload = getattr(self._messaging, f"{kind}MsgPayload")()
        setattr(payload, field, list(values))
        message.write(payload)

    def add_chain(self, efforts: Sequence[float]) -> Any:
        """Attach the scene's arm, whose joints all turn or all slide, with its motors' efforts, N m or N.

        Returns:
            The message of the efforts.
        """
        scene, state = self.kernels.scene, self.kernels.layout.state
        x, slides = self.kernels.layout.initial_state, scene.links[0].joint_type == "prismatic"
        name = "linearTranslationNDOFStateEffector" if slides else "spinningBodyNDOFStateEffector"
        module: Any = import_module(f"Basilisk.simulation.{name}")
        self._chain = getattr(module, name[0].upper() + name[1:])()
        add = _add_sliding if slides else _add_turning
        for link, place, rate in zip(scene.links, x[state.joint_angles], x[state.joint_rates], strict=True):
            add(module, self._chain, link, float(place), float(rate))
        self.add(self._chain)
        if slides:
            return self.command(self._chain.motorForceInMsg, "ArrayMotorForce", "motorForce", efforts)
        return self.command(self._chain.motorTorqueInMsg, "ArrayMotorTorque", "motorTorque", efforts)

    def fly(self, until: float) -> None:
        """Go on to a time, s, which is a whole number of steps."""
        if not self._is_ready:
            for model in self.models:
                self.sim.AddModelToTask("step", model)
            self.sim.InitializeSimulation()
            self._is_ready = True
        self.sim.ConfigureStopTime(nanoseconds(until))
        self.sim.ExecuteSimulation()

    def state(self) -> FloatArray:
        """Pose, twist and joints at the end as a state of the scene, shape (n_x,); else its start's."""
        found, x = self.hub.scStateOutMsg.read(), self.kernels.layout.initial_state.copy()
        state, sigma = self.kernels.layout.state, np.array(found.sigma_BN)  # modified Rodrigues parameters
        square = float(sigma @ sigma)
        q = [(1.0 - square) / (1.0 + square), *(2.0 / (1.0 + square) * sigma)]
        x[state.pose] = poses.from_rotation_and_position(q, list(found.r_BN_N))
        x[state.angular_velocity] = found.omega_BN_B
        x[state.linear_velocity] = rotations.rotate([q[0], *(-entry for entry in q[1:])], list(found.v_BN_N))
        if self._chain is not None:
            name = "Theta" if hasattr(self._chain, "getNameOfThetaState") else "Rho"
            for part, suffix in ((state.joint_angles, ""), (state.joint_rates, "Dot")):
                entry = getattr(self._chain, f"getNameOf{name}{suffix}State")()
                x[part] = np.ravel(self.hub.dynManager.getStateObject(entry).getState())
        return x


def nanoseconds(seconds: float) -> int:
    """Basilisk's time."""
    return round(1e9 * seconds)


def _add_turning(module: Any, chain: Any, link: Any, angle: float, rate: float) -> None:
    body = module.SpinningBody()
    body.setMass(link.mass)
    body.setISPntSc_S(np.array(link.inertia))
    body.setR_ScS_S(np.array(link.center_of_mass)[:, None])
    body.setR_SP_P(np.array(link.joint.position)[:, None])
    body.setDCM_S0P(np.array(link.joint.rotation_matrix).T)
    body.setSHat_S([[0.0], [0.0], [1.0]])
    body.setK(link.stiffness)
    body.setC(link.damping)
    body.setThetaInit(angle)
    body.setThetaDotInit(rate)
    chain.addSpinningBody(body)


def _add_sliding(module: Any, chain: Any, link: Any, place: float, rate: float) -> None:
    body, axes = module.TranslatingBody(), np.array(link.joint.rotation_matrix)
    body.setMass(link.mass)
    body.setIPntFc_F(np.array(link.inertia))
    body.setR_FcF_F(np.array(link.center_of_mass)[:, None])
    body.setR_F0P_P(np.array(link.joint.position)[:, None])
    body.setDCM_FP(axes.T)
    body.setFHat_P(axes[:, 2:])  # the axis of sliding is given in the parent's axes
    body.setK(link.stiffness)
    body.setC(link.damping)
    body.setRhoInit(place)
    body.setRhoDotInit(rate)
    chain.addTranslatingBody(body)
