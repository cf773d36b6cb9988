"""The same robot in Pinocchio and in MuJoCo, ready to be timed; neither is a dependency of this package.

Each peer is given what makes it fast: Pinocchio's batched articulated-body algorithm and MuJoCo's batched
rollout, both in C++ on one thread, MuJoCo without contacts, constraints and gravity, and with the inputs as
generalized forces, so that it evaluates no actuators.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import partial
from importlib import import_module
from typing import Any, Protocol

import numpy as np

from dq_space_arm_env import Kernels
from dq_space_arm_env.algebra import poses
from dq_space_arm_env.dynamics import minimal
from dq_space_arm_env.dynamics.chain import Chain, RigidBody
from dq_space_arm_env.scene.start import PLANAR_POSE, PLANAR_TWIST
from experts.problem import FloatArray
from experts.report.throughput import DYNAMICS, STEP, Case

_ROLLOUT_STATES, _ROLLOUT_STEPS = 64, 32
_MUJOCO_INTEGRATORS = {"symplectic_euler": "Euler", "rk4": "RK4"}


class Peer(Protocol):
    """Another engine with the robot of a scene."""

    name: str

    def accelerations(self, x: FloatArray, u: FloatArray) -> FloatArray:
        """What `Kernels.forward_dynamics` gives, from this engine."""

    def end_angles(self, x: FloatArray, integrator: str, steps: int) -> FloatArray | None:
        """Joint angles, shape (B, n), rad, after steps without inputs; None if the engine takes no steps."""

    def cases(self, x: FloatArray, u: FloatArray) -> list[Case]:
        """What to time."""


def peers_of(kernels: Kernels) -> tuple[list[Peer], list[str]]:
    """Build a scene's robot in the engines that are installed.

    Args:
        kernels: Functions of the scene.

    Returns:
        The peers, and a sentence for each that there is not.
    """
    chain = Chain.from_scene(kernels.scene)
    if chain.tip_wrench is not None:
        return [], [
            f"Scene {kernels.scene.name}: no peers, for they have no wrench that turns with the wrist."
        ]
    peers: list[Peer] = []
    missing = []
    for title, package, kind in (("Pinocchio", "pin", PinocchioPeer), ("MuJoCo", "mujoco", MujocoPeer)):
        try:
            peers.append(kind(kernels, chain))
        except ImportError:
            missing.append(f"{title} is left out: it is not installed (pip install {package}).")
    return peers, missing


@dataclass(frozen=True)
class _Robot:
    """States and inputs as full vectors, a row for each state; a planar base has zeros where it cannot move.

    Attributes:
        rotation: Attitude of the base as a unit quaternion, scalar first, shape (B, 4).
        to_inertial: The same as rotation matrices, shape (B, 3, 3).
        position: Position of the base's center of mass, inertial axes, shape (B, 3), m.
        angular: Angular velocity of the base, base axes, shape (B, 3), rad/s.
        linear: Velocity of the base, base axes, shape (B, 3), m/s.
        angles: Joint angles, shape (B, n), rad.
        rates: Joint rates, shape (B, n), rad/s.
        force: On the base, base axes, shape (B, 3), N.
        torque: On the base, base axes, shape (B, 3), N m.
        motors: Joint torques, shape (B, n), N m.
    """

    rotation: FloatArray
    to_inertial: FloatArray
    position: FloatArray
    angular: FloatArray
    linear: FloatArray
    angles: FloatArray
    rates: FloatArray
    force: FloatArray
    torque: FloatArray
    motors: FloatArray

    @classmethod
    def of(cls, kernels: Kernels, x: FloatArray, u: FloatArray) -> _Robot:
        """Name the parts of states (B, n_x) and inputs (B, n_u)."""
        layout, count = kernels.layout, len(x)
        state, control = layout.state, layout.control
        pose, twist = np.zeros((count, 8)), np.zeros((count, 6))
        pose[:, PLANAR_POSE if layout.planar else slice(8)] = x[:, state.pose]
        twist[:, PLANAR_TWIST if layout.planar else slice(6)] = x[:, state.base_velocity]
        force, torque, motors = np.zeros((count, 3)), np.zeros((count, 3)), np.zeros((count, layout.n_joints))
        forces, torques = u[:, control.base_force], u[:, control.base_torque]
        force[:, : forces.shape[1]] = forces
        torque[:, 3 - torques.shape[1] :] = torques  # a planar base's only torque is the one about z
        motors[:, list(layout.actuated_joints)] = u[:, control.joint_torque]
        return cls(
            rotation=pose[:, :4],
            to_inertial=np.array([poses.to_matrix(tuple(row))[0] for row in pose.tolist()]),
            position=np.array([poses.position(tuple(row)) for row in pose.tolist()]),
            angular=twist[:, :3],
            linear=twist[:, 3:],
            angles=x[:, state.joint_angles],
            rates=x[:, state.joint_rates],
            force=force,
            torque=torque,
            motors=motors,
        )


class PinocchioPeer:
    """Pinocchio's articulated-body algorithm."""

    name = "Pinocchio"

    def __init__(self, kernels: Kernels, chain: Chain) -> None:
        """Build the robot: a free or planar base, then revolute joints about z."""
        import pinocchio

        self._pin, self._kernels, self._chain = pinocchio, kernels, chain
        self.model = pinocchio.Model()
        self.model.gravity = pinocchio.Motion.Zero()
        base = pinocchio.JointModelPlanar() if chain.planar else pinocchio.JointModelFreeFlyer()
        parent = self.model.addJoint(0, base, pinocchio.SE3.Identity(), "base")
        self.model.appendBodyToJoint(parent, self._inertia(chain.base), pinocchio.SE3.Identity())
        for index, link in enumerate(chain.links):
            placement = pinocchio.SE3(np.array(link.joint.rotation), np.array(link.joint.position))
            parent = self.model.addJoint(parent, pinocchio.JointModelRZ(), placement, f"joint {index}")
            self.model.appendBodyToJoint(parent, self._inertia(link.body), pinocchio.SE3.Identity())
        self._data = self.model.createData()

    def _inertia(self, body: RigidBody) -> Any:
        return self._pin.Inertia(body.mass, np.array(body.center_of_mass), np.array(body.inertia))

    def _arguments(self, x: FloatArray, u: FloatArray) -> tuple[FloatArray, FloatArray, FloatArray]:
        """Pinocchio's q, v and tau, a row for each state."""
        robot = _Robot.of(self._kernels, x, u)
        passive = minimal.passive_torques(self._chain, list(robot.angles.T), list(robot.rates.T))
        joints = robot.motors + np.reshape(passive, robot.motors.T.shape).T
        w, z = robot.rotation[:, 0], robot.rotation[:, 3]
        if self._chain.planar:
            # x, y, then cosine and sine of the angle; velocities along x and y in base axes, then about z
            turned = np.column_stack([w * w - z * z, 2.0 * w * z])
            q = [robot.position[:, :2], turned, robot.angles]
            v = [robot.linear[:, :2], robot.angular[:, 2:], robot.rates]
            return np.hstack(q), np.hstack(v), np.hstack([robot.force[:, :2], robot.torque[:, 2:], joints])
        # quaternion with the scalar last; linear before angular
        q = [robot.position, robot.rotation[:, 1:], robot.rotation[:, :1], robot.angles]
        v = [robot.linear, robot.angular, robot.rates]
        return np.hstack(q), np.hstack(v), np.hstack([robot.force, robot.torque, joints])

    def accelerations(self, x: FloatArray, u: FloatArray) -> FloatArray:
        """What `Kernels.forward_dynamics` gives, from `aba`."""
        rows = zip(*self._arguments(x, u), strict=True)
        a = np.array([self._pin.aba(self.model, self._data, *row) for row in rows])
        linear = 2 if self._chain.planar else 3
        base = a.shape[1] - len(self._chain.links)
        return np.hstack([a[:, linear:base], a[:, :linear], a[:, base:]])

    def end_angles(self, x: FloatArray, integrator: str, steps: int) -> FloatArray | None:
        """None: of Pinocchio, only the dynamics are timed."""
        return None

    def cases(self, x: FloatArray, u: FloatArray) -> list[Case]:
        """`aba` called from Python state by state, and batched in C++ where this build of Pinocchio can."""
        q, v, tau = self._arguments(x, u)
        one = partial(self._pin.aba, self.model, self._data, q[0].copy(), v[0].copy(), tau[0].copy())
        cases = [Case(DYNAMICS, self.name, "aba, a call from Python", "", 1, one)]
        if hasattr(self._pin, "abaInParallel"):
            pool = self._pin.ModelPool(self.model, 1)
            columns = [np.asfortranarray(array.T) for array in (q, v, tau)]
            result = np.zeros(columns[1].shape, order="F")
            batch = partial(self._pin.abaInParallel, 1, pool, *columns, result)
            cases.append(Case(DYNAMICS, self.name, "abaInParallel, 1 thread", "", len(x), batch))
        return cases


class MujocoPeer:
    """MuJoCo's forward dynamics and its rollout with Euler and RK4."""

    name = "MuJoCo"

    def __init__(self, kernels: Kernels, chain: Chain) -> None:
        """Build the robot for each integrator."""
        mujoco: Any = import_module("mujoco")  # it has no types
        self._rollout: Any = import_module("mujoco.rollout")
        self._mujoco, self._kernels, self._chain = mujoco, kernels, chain
        time_step = kernels.scene.simulation.dt
        self.models = {
            name: mujoco.MjModel.from_xml_string(robot_xml(chain, time_step, theirs))
            for name, theirs in _MUJOCO_INTEGRATORS.items()
        }

    def _arguments(self, x: FloatArray, u: FloatArray) -> tuple[FloatArray, FloatArray, FloatArray]:
        """MuJoCo's qpos, qvel and generalized forces; of the base, only angular parts are in base axes."""
        robot = _Robot.of(self._kernels, x, u)
        velocity = np.einsum("bij,bj->bi", robot.to_inertial, robot.linear)
        force = np.einsum("bij,bj->bi", robot.to_inertial, robot.force)
        if self._chain.planar:
            turn = 2.0 * np.arctan2(robot.rotation[:, 3:], robot.rotation[:, :1])
            position = [robot.position[:, :2], turn]
            rates, forces = [velocity[:, :2], robot.angular[:, 2:]], [force[:, :2], robot.torque[:, 2:]]
        else:
            position = [robot.position, robot.rotation]
            rates, forces = [velocity, robot.angular], [force, robot.torque]
        return (
            np.hstack([*position, robot.angles]),
            np.hstack([*rates, robot.rates]),
            np.hstack([*forces, robot.motors]),
        )

    def accelerations(self, x: FloatArray, u: FloatArray) -> FloatArray:
        """What `Kernels.forward_dynamics` gives, from `mj_forward`."""
        robot = _Robot.of(self._kernels, x, u)
        model = self.models["rk4"]
        data = self._mujoco.MjData(model)
        theirs = np.zeros((len(x), model.nv))
        for row, (qpos, qvel, force) in enumerate(zip(*self._arguments(x, u), strict=True)):
            data.qpos[:], data.qvel[:], data.qfrc_applied[:] = qpos, qvel, force
            self._mujoco.mj_forward(model, data)
            theirs[row] = data.qacc
        linear = 2 if self._chain.planar else 3
        base = model.nv - len(self._chain.links)
        inertial = np.zeros((len(x), 3))
        inertial[:, :linear] = theirs[:, :linear]
        # The components of the velocity turn with the base: R' a - omega x v.
        along_base = np.einsum("bji,bj->bi", robot.to_inertial, inertial)
        dual = along_base - np.cross(robot.angular, robot.linear)
        return np.hstack([theirs[:, linear:base], dual[:, :linear], theirs[:, base:]])

    def _states(self, integrator: str, x: FloatArray, u: FloatArray) -> FloatArray:
        """MuJoCo's full physics states, a row for each state."""
        model = self.models[integrator]
        data = self._mujoco.MjData(model)
        spec = self._mujoco.mjtState.mjSTATE_FULLPHYSICS
        states = np.zeros((len(x), self._mujoco.mj_stateSize(model, spec)))
        qpos, qvel, _ = self._arguments(x, u)
        for row, state in enumerate(states):
            data.qpos[:], data.qvel[:] = qpos[row], qvel[row]
            self._mujoco.mj_getState(model, data, state, spec)
        return states

    def end_angles(self, x: FloatArray, integrator: str, steps: int) -> FloatArray | None:
        """Joint angles after steps without inputs."""
        model = self.models[integrator]
        data = self._mujoco.MjData(model)
        qpos, qvel, _ = self._arguments(x, np.zeros((len(x), self._kernels.n_u)))
        result = np.zeros((len(x), len(self._chain.links)))
        for row in range(len(x)):
            self._mujoco.mj_resetData(model, data)
            data.qpos[:], data.qvel[:] = qpos[row], qvel[row]
            self._mujoco.mj_step(model, data, steps)
            result[row] = data.qpos[model.nq - result.shape[1] :]
        return result

    def cases(self, x: FloatArray, u: FloatArray) -> list[Case]:
        """`mj_forward` from Python, and a rollout of some states over some steps for each integrator."""
        mujoco = self._mujoco
        data = mujoco.MjData(self.models["rk4"])
        qpos, qvel, force = self._arguments(x, u)
        data.qpos[:], data.qvel[:], data.qfrc_applied[:] = qpos[0], qvel[0], force[0]
        forward = partial(mujoco.mj_forward, self.models["rk4"], data)
        cases = [Case(DYNAMICS, self.name, "mj_forward, a call from Python", "", 1, forward)]
        for integrator in self.models:
            model = self.models[integrator]
            start = self._states(integrator, x[:_ROLLOUT_STATES], u[:_ROLLOUT_STATES])
            inputs = np.repeat(force[:_ROLLOUT_STATES, None], _ROLLOUT_STEPS, axis=1)
            run = partial(
                self._rollout.Rollout(nthread=0).rollout,
                model,
                mujoco.MjData(model),
                start,
                np.ascontiguousarray(inputs),
                control_spec=mujoco.mjtState.mjSTATE_QFRC_APPLIED.value,
                state=np.zeros((len(start), _ROLLOUT_STEPS, start.shape[1])),
            )
            steps = len(start) * _ROLLOUT_STEPS
            way = f"rollout of {len(start)} x {_ROLLOUT_STEPS} steps"
            cases.append(Case(STEP, self.name, way, integrator, steps, run))
        return cases


def robot_xml(chain: Chain, time_step: float, integrator: str) -> str:
    """Write a robot as an MJCF model, without gravity, contacts and constraints.

    Args:
        chain: The robot.
        time_step: Time step, s.
        integrator: MuJoCo's name of the integrator.

    Returns:
        The model.
    """
    slides = '<joint type="slide" axis="1 0 0"/><joint type="slide" axis="0 1 0"/>'
    freedom = slides + '<joint type="hinge" axis="0 0 1"/>' if chain.planar else "<freejoint/>"
    links = "".join(
        f'<body pos="{_numbers(link.joint.position)}" quat="{_numbers(link.joint.dual_quaternion[:4])}">'
        f'<joint type="hinge" axis="0 0 1" damping="{link.damping!r}" stiffness="{link.stiffness!r}" '
        f'springref="{link.rest_angle!r}"/>{_inertial(link.body)}'
        for link in chain.links
    )
    return (
        '<mujoco><compiler angle="radian"/>'
        f'<option gravity="0 0 0" timestep="{time_step!r}" integrator="{integrator}">'
        '<flag contact="disable" constraint="disable"/></option>'
        f"<worldbody><body>{freedom}{_inertial(chain.base)}{links}"
        f"{'</body>' * (1 + len(chain.links))}</worldbody></mujoco>"
    )


def _inertial(body: RigidBody) -> str:
    (xx, xy, xz), (_, yy, yz), (_, _, zz) = body.inertia
    inertia = _numbers((xx, yy, zz, xy, xz, yz))
    return f'<inertial mass="{body.mass!r}" pos="{_numbers(body.center_of_mass)}" fullinertia="{inertia}"/>'


def _numbers(values: Sequence[float]) -> str:
    return " ".join(repr(float(value)) for value in values)
