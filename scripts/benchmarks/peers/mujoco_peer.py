"""A scene's robot in MuJoCo: forward dynamics, steps in C++ batches, and a Gymnasium environment around it.

The environment is what one would write around `mj_step`. It does less than `DQSpaceArm-v0`: no tip pose, no
wrist, no forces in base axes, a reward of two sums of squares, an empty `info`, no check of actions or
results, and a start that is not drawn from the scene's spread.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from functools import partial
from importlib import import_module
from itertools import cycle
from typing import Any

import gymnasium
import numpy as np
from gymnasium import spaces
from gymnasium.envs.registration import EnvSpec
from numpy.typing import NDArray

from dq_space_arm_env import Kernels
from dq_space_arm_env.dynamics.kinematic_tree import KinematicTree, RigidBody
from experts.problems.shooting_problem import FloatArray
from experts.report.part_costs import finite_limits
from scripts.benchmarks.peers.robot import Robot
from scripts.benchmarks.subjects import (
    DYNAMICS,
    ENVIRONMENT,
    STEP,
    SYNCHRONOUS,
    SYNCHRONOUS_COPIES,
    Case,
    Subject,
    single_case,
    vector_case,
)

WRAPPED = "gymnasium.make"
# States and steps of a call; which of them is fastest depends on the caches.
_ROLLOUTS = ((64, 32), (1024, 1), (1024, 8))
_BATCHES = ((64, 1), (1024, 1), (1024, 8))
_INTEGRATORS = {"symplectic_euler": "Euler", "rk4": "RK4"}


class MujocoPeer:
    """MuJoCo's forward dynamics, and its steps with Euler and RK4."""

    name = "MuJoCo"

    def __init__(self, kernels: Kernels, tree: KinematicTree) -> None:
        mujoco: Any = import_module("mujoco")  # it has no types
        self._rollout: Any = import_module("mujoco.rollout")
        self._mujoco, self._kernels, self._tree = mujoco, kernels, tree
        self.notes: list[str] = []
        self._batch: Any = None
        try:
            self._batch = import_module("mujoco.batch")
        except ImportError:
            self.notes.append(f"mujoco.batch is left out: MuJoCo {mujoco.__version__} has no such module.")
        time_step = kernels.scene.simulation.dt
        self.models = {
            name: mujoco.MjModel.from_xml_string(robot_xml(tree, time_step, theirs))
            for name, theirs in _INTEGRATORS.items()
        }

    def _arguments(self, x: FloatArray, u: FloatArray) -> tuple[FloatArray, FloatArray, FloatArray]:
        """MuJoCo's qpos, qvel and generalized forces; of the base, only angular parts are in base axes."""
        robot = Robot.of(self._kernels, x, u)
        velocity = np.einsum("bij,bj->bi", robot.to_inertial, robot.linear)
        force = np.einsum("bij,bj->bi", robot.to_inertial, robot.force)
        if self._tree.planar:
            turn = 2.0 * np.arctan2(robot.rotation[:, 3:], robot.rotation[:, :1])
            qpos = np.hstack([robot.position[:, :2], turn, robot.angles])
        else:
            qpos = np.hstack([robot.position, robot.rotation, robot.angles])
        qvel = self._generalized(velocity, robot.angular, robot.rates)
        return qpos, qvel, self._generalized(force, robot.torque, robot.motors)

    def _generalized(self, linear: FloatArray, angular: FloatArray, joints: FloatArray) -> FloatArray:
        """MuJoCo's order of velocities and forces."""
        if self._tree.planar:
            linear, angular = linear[:, :2], angular[:, 2:]
        return np.hstack([linear, angular, joints])

    def accelerations(self, x: FloatArray, u: FloatArray) -> FloatArray:
        """The accelerations of `Kernels.forward_dynamics`, by `mj_forward`."""
        robot = Robot.of(self._kernels, x, u)
        model = self.models["rk4"]
        data = self._mujoco.MjData(model)
        theirs = np.zeros((len(x), model.nv))
        for row, (qpos, qvel, force) in enumerate(zip(*self._arguments(x, u), strict=True)):
            data.qpos[:], data.qvel[:], data.qfrc_applied[:] = qpos, qvel, force
            self._mujoco.mj_forward(model, data)
            theirs[row] = data.qacc
        linear = 2 if self._tree.planar else 3
        base = model.nv - len(self._tree.links)
        inertial = np.zeros((len(x), 3))
        inertial[:, :linear] = theirs[:, :linear]
        # The components of the velocity turn with the base: R' a - omega x v.
        along_base = np.einsum("bji,bj->bi", robot.to_inertial, inertial)
        dual = along_base - np.cross(robot.angular, robot.linear)
        return np.hstack([theirs[:, linear:base], dual[:, :linear], theirs[:, base:]])

    def end_angles(self, x: FloatArray, integrator: str, steps: int) -> FloatArray | None:
        """Joint angles after steps without inputs."""
        model = self.models[integrator]
        data = self._mujoco.MjData(model)
        qpos, qvel, _ = self._arguments(x, np.zeros((len(x), self._kernels.n_u)))
        result = np.zeros((len(x), len(self._tree.links)))
        for row in range(len(x)):
            self._mujoco.mj_resetData(model, data)
            data.qpos[:], data.qvel[:] = qpos[row], qvel[row]
            self._mujoco.mj_step(model, data, steps)
            result[row] = data.qpos[model.nq - result.shape[1] :]
        return result

    def cases(self, x: FloatArray, u: FloatArray) -> list[Case]:
        """`mj_forward` from Python, and with each integrator the batches and the environments."""
        arguments = self._arguments(x, u)
        cases = [self._forward_case(*(array[0] for array in arguments))]
        for integrator in self.models:
            cases += self._rollout_cases(integrator, *arguments)
            if self._batch is not None:
                cases += self._batch_cases(integrator, *arguments)
            cases += self._environment_cases(integrator)
        return cases

    def _forward_case(self, qpos: FloatArray, qvel: FloatArray, force: FloatArray) -> Case:
        model = self.models["rk4"]
        data = self._mujoco.MjData(model)
        data.qpos[:], data.qvel[:], data.qfrc_applied[:] = qpos, qvel, force
        subject = Subject(what=DYNAMICS, engine=self.name, way="mj_forward from Python")
        return Case(subject, partial(self._mujoco.mj_forward, model, data))

    def _rollout_cases(
        self, integrator: str, qpos: FloatArray, qvel: FloatArray, force: FloatArray
    ) -> Iterator[Case]:
        """Trajectories from given states, on the calling thread."""
        model, kind = self.models[integrator], self._mujoco.mjtState
        data = self._mujoco.MjData(model)
        for count, steps in _ROLLOUTS:
            start = self._states(model, qpos[:count], qvel[:count])
            run = partial(
                self._rollout.Rollout(nthread=0).rollout,
                model,
                data,
                start,
                np.ascontiguousarray(np.repeat(force[: len(start), None], steps, axis=1)),
                control_spec=kind.mjSTATE_QFRC_APPLIED.value,
                state=np.zeros((len(start), steps, start.shape[1])),
            )
            yield Case(self._batch_subject("rollout", integrator, len(start), steps), run)

    def _states(self, model: Any, qpos: FloatArray, qvel: FloatArray) -> FloatArray:
        """MuJoCo's full physics states, a row for each state."""
        data, kind = self._mujoco.MjData(model), self._mujoco.mjtState.mjSTATE_FULLPHYSICS
        states = np.zeros((len(qpos), self._mujoco.mj_stateSize(model, kind)))
        for row, state in enumerate(states):
            data.qpos[:], data.qvel[:] = qpos[row], qvel[row]
            self._mujoco.mj_getState(model, data, state, kind)
        return states

    def _batch_cases(
        self, integrator: str, qpos: FloatArray, qvel: FloatArray, force: FloatArray
    ) -> Iterator[Case]:
        """Simulations that go on from call to call, each with forces and, in turns, their opposites."""
        for count, steps in _BATCHES:
            used = len(qpos[:count])
            batch = self._batch.Batch(self.models[integrator], used, nthread=1)
            batch.qpos, batch.qvel = qpos[:count], qvel[:count]
            forces = cycle((force[:count], -force[:count]))

            def run(batch: Any = batch, forces: Iterator[FloatArray] = forces, steps: int = steps) -> None:
                batch.qfrc_applied = next(forces)
                batch.step(nstep=steps)

            yield Case(self._batch_subject("batch", integrator, used, steps), run)

    def _batch_subject(self, module: str, integrator: str, count: int, steps: int) -> Subject:
        way = f"{module}, {count} x {steps} step{'s' * (steps > 1)}"
        return Subject(what=STEP, engine=self.name, way=way, integrator=integrator, batch=count * steps)

    def _environment_cases(self, integrator: str) -> Iterator[Case]:
        """The Gymnasium environment, alone and copied."""
        layout, steps = self._kernels.layout, self._kernels.scene.simulation.steps
        start, limits = layout.initial_state[None], finite_limits(self._kernels)[None]
        robot = Robot.of(self._kernels, start, limits)
        spec = mujoco_spec(
            self.models[integrator],
            self._arguments(start, limits)[0][0],
            self._generalized(robot.force, robot.torque, robot.motors)[0],
            steps,
        )
        subject = partial(Subject, what=ENVIRONMENT, engine=self.name, integrator=integrator)
        yield single_case(subject(way=WRAPPED), gymnasium.make(spec), steps)
        vector = gymnasium.make_vec(spec, num_envs=SYNCHRONOUS_COPIES, vectorization_mode="sync")
        yield vector_case(subject(way=SYNCHRONOUS, batch=SYNCHRONOUS_COPIES), vector, steps)


def robot_xml(tree: KinematicTree, time_step: float, integrator: str) -> str:
    """Write a robot as an MJCF model, with nothing that it does not have."""
    slides = '<joint type="slide" axis="1 0 0"/><joint type="slide" axis="0 1 0"/>'
    freedom = slides + '<joint type="hinge" axis="0 0 1"/>' if tree.planar else "<freejoint/>"
    carried = [""] * len(tree.bodies)
    for index, link in reversed([*enumerate(tree.links)]):
        carried[link.parent] = (
            f'<body pos="{_numbers(link.joint.position)}" quat="{_numbers(link.joint.dual_quaternion[:4])}">'
            f'<joint type="hinge" axis="0 0 1" damping="{link.damping!r}" stiffness="{link.stiffness!r}" '
            f'springref="{link.rest_angle!r}"/>{_inertial(link.body)}{carried[index + 1]}</body>'
            + carried[link.parent]
        )
    unused = ["contact", "constraint", "gravity"]
    unused += ["spring"] * (not any(link.stiffness for link in tree.links))
    unused += ["damper"] * (not any(link.damping for link in tree.links))
    flags = " ".join(f'{flag}="disable"' for flag in unused)
    return (
        '<mujoco><compiler angle="radian"/>'
        f'<option timestep="{time_step!r}" integrator="{integrator}"><flag {flags}/></option>'
        f"<worldbody><body>{freedom}{_inertial(tree.base)}{carried[0]}</body></worldbody></mujoco>"
    )


def _inertial(body: RigidBody) -> str:
    (xx, xy, xz), (_, yy, yz), (_, _, zz) = body.inertia
    inertia = _numbers((xx, yy, zz, xy, xz, yz))
    return f'<inertial mass="{body.mass!r}" pos="{_numbers(body.center_of_mass)}" fullinertia="{inertia}"/>'


def _numbers(values: Sequence[float]) -> str:
    return " ".join(repr(float(value)) for value in values)


_BOUND = 1e6
_START_RATES = 0.05


class MujocoEnvironment(gymnasium.Env[FloatArray, NDArray[Any]]):
    """Generalized forces as actions, positions and velocities as observations."""

    metadata: dict[str, Any] = {"render_modes": []}  # noqa: RUF012

    def __init__(self, model: Any, qpos: FloatArray, limits: FloatArray, steps: int) -> None:
        mujoco: Any = import_module("mujoco")  # it has no types
        self._mj_step, self._mj_reset = mujoco.mj_step, mujoco.mj_resetData
        self._model, self._data = model, mujoco.MjData(model)
        # Views of MuJoCo's memory: asking for them anew takes longer than a step may.
        self._qpos, self._qvel = self._data.qpos, self._data.qvel
        self._forces = self._data.qfrc_applied
        self._start, self._limits, self._steps = qpos, limits, steps
        self._goal = np.concatenate((qpos, np.zeros(model.nv)))  # back to the start, at rest
        self._count = 0
        self.action_space = spaces.Box(-1.0, 1.0, (model.nv,), np.float32)
        self.observation_space = spaces.Box(-_BOUND, _BOUND, (model.nq + model.nv,), np.float64)

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[FloatArray, dict[str, Any]]:
        """Begin an episode at the start's positions, with small random velocities."""
        super().reset(seed=seed)
        self._mj_reset(self._model, self._data)
        self._qpos[:] = self._start
        self._qvel[:] = self.np_random.uniform(-_START_RATES, _START_RATES, self._qvel.shape)
        self._count = 0
        return np.concatenate((self._qpos, self._qvel)), {}

    def step(self, action: NDArray[Any]) -> tuple[FloatArray, float, bool, bool, dict[str, Any]]:
        """Apply an action, shape (nv,), fractions of the limits in [-1, 1], for one time step."""
        self._forces[:] = self._limits * action
        self._mj_step(self._model, self._data)
        self._count += 1
        observation = np.concatenate((self._qpos, self._qvel))
        error = observation - self._goal
        reward = -float(error @ error + action @ action)
        return observation, reward, self._count >= self._steps, False, {}


def mujoco_spec(model: Any, qpos: FloatArray, limits: FloatArray, steps: int) -> EnvSpec:
    """Spec for `gymnasium.make` and `gymnasium.make_vec`, which add their usual wrappers."""

    def create(**_: Any) -> MujocoEnvironment:
        return MujocoEnvironment(model, qpos, limits, steps)

    return EnvSpec("MujocoSpaceArm-v0", entry_point=create)
