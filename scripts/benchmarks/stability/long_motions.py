"""Free motions of up to a hundred million steps: energy and momentum, and errors of the tip over run time.

A symplectic method keeps the energy's error bounded where those of others grow with the number of steps. What
remains are rounding errors, which grow with its root at best (Brouwer's law), and, in joints that turn fast
for the step, a slow diffusion. MuJoCo takes a tenth of the steps.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from functools import cache, partial
from importlib import import_module
from importlib.util import find_spec
from time import perf_counter
from typing import Any

import numpy as np

from dq_space_arm_env import Kernels, compile_scene
from dq_space_arm_env.dynamics.kinematic_tree import KinematicTree
from dq_space_arm_env.scene import INTEGRATORS
from experts.problems.shooting_problem import FloatArray
from scripts.benchmarks.effort import Effort
from scripts.benchmarks.peers.mujoco_peer import robot_xml
from scripts.benchmarks.peers.robot import Robot
from scripts.benchmarks.stability.cases import Case, Handled, NotClaimed, Outcome
from scripts.benchmarks.stability.scenes import paper

GROUP = "long motions"
ENERGY, MOMENTUM, TIP = "energy", "momentum", "tip"  # what a case measures, the first word of its name

SYMPLECTIC = tuple(name for name, entry in INTEGRATORS.items() if entry.symplectic)
METHODS = (*SYMPLECTIC, "momentum_rk4", "rk4", "rk8")
MUJOCO = ("Euler", "implicitfast", "RK4")
TIME_STEP = 0.015  # s
_POINTS = 100  # of a curve in each range of two decades
_MUJOCO_SHARE = 10


@dataclass(frozen=True)
class Motion:
    """A motion of the paper's arm without inputs."""

    name: str
    joint_rate: float  # largest at the start, rad/s
    stiffness: float  # of all joints, N m/rad
    deflection: float  # of all joints from the rest of their springs, rad
    energy_kept: float  # bound of the claim, relative
    time_steps: tuple[float, ...]  # of the work-precision curves, s


MOTIONS = (
    Motion("joints at 1 rad/s", 1.0, 0.0, 0.0, 1e-9, (0.06, 0.03, 0.015, 0.0075)),
    Motion("joints at 4 rad/s", 4.0, 0.0, 0.0, 1e-4, (0.015, 0.0075, 0.00375)),
    Motion("springs, 0.5 rad", 1.0, 10.0, 0.5, 1e-10, (0.06, 0.03, 0.015, 0.0075)),
)
MOMENTUM_KEPT = 1e-13
"""Largest drift of the momentum, relative to its size, of methods that keep it."""
_DURATION, _REFERENCE_STEPS = 6.0, 24_000  # of the tip's motion, s
_REPEATS = 5


def cases() -> Iterator[Case]:
    for motion in MOTIONS:
        for name in METHODS:
            claimed = name in SYMPLECTIC
            criterion = f"energy within {motion.energy_kept:g} over all steps" if claimed else "not claimed"
            run = partial(_energy, motion, name)
            yield Case(GROUP, f"{ENERGY}, {motion.name}", name, criterion, run, motion.energy_kept, "1")
            kept = INTEGRATORS[name].keeps_momentum
            criterion = f"momentum within {MOMENTUM_KEPT:g} over all steps" if kept else "not claimed"
            run = partial(_momentum, motion, name)
            yield Case(GROUP, f"{MOMENTUM}, {motion.name}", name, criterion, run, MOMENTUM_KEPT, "1")
        for name in MUJOCO:
            for part, measure in ((ENERGY, _energy), (MOMENTUM, _momentum)):
                run = partial(measure, motion, f"MuJoCo {name}")
                yield Case(GROUP, f"{part}, {motion.name}", f"MuJoCo {name}", "not claimed", run)
        for name in (*SYMPLECTIC, "rk4", "momentum_rk4", "rk6"):
            criterion = f"error of pose and angles after {_DURATION:g} s over run time; not claimed"
            yield Case(GROUP, f"{TIP}, {motion.name}", name, criterion, partial(_tip, motion, name))


@cache
def _arm(motion: Motion) -> tuple[Kernels, FloatArray]:
    """The arm and its start."""
    scene = paper().scene
    rests = scene.initial_state.joint_angles
    links = [
        {**link.model_dump(), "stiffness": motion.stiffness, "rest_angle": rest}
        for link, rest in zip(scene.links, rests, strict=True)
    ]
    kernels = compile_scene(scene.replace(name="long motion", links=links) if motion.stiffness else scene)
    rng, where, x = np.random.default_rng(0), kernels.layout.state, kernels.layout.initial_state.copy()
    for part, rate in (
        (where.joint_rates, motion.joint_rate),
        (where.base_velocity, 0.3 * motion.joint_rate),
    ):
        x[part] = rng.uniform(-rate, rate, part.stop - part.start)
    x[where.joint_angles] += motion.deflection
    return kernels, x


@dataclass(frozen=True)
class Invariants:
    """Largest changes of energy and momentum up to some steps, relative to their first sizes."""

    steps: FloatArray
    energy: FloatArray
    momentum: FloatArray
    microseconds: float  # per step

    @classmethod
    def of(cls, steps: Any, energy: FloatArray, momentum: FloatArray, seconds: float) -> Invariants:
        """From their values at the start and after some steps."""
        sizes = np.repeat([np.linalg.norm(momentum[0, :3]), np.linalg.norm(momentum[0, 3:])], 3)
        changes = [np.abs(energy / energy[0] - 1.0), np.abs((momentum - momentum[0]) / sizes).max(axis=1)]
        # NaN counts as infinite: a maximum would pass over it.
        kept = [np.maximum.accumulate(np.where(np.isfinite(each), each, np.inf))[1:] for each in changes]
        return cls(np.asarray(steps, float), kept[0], kept[1], 1e6 * seconds / steps[-1])


@cache
def _walked(motion: Motion, name: str, count: int) -> Invariants | None:
    """Take many steps by a method; None where its package is missing."""
    if name.startswith("MuJoCo"):
        return _walked_by_mujoco(motion, name.removeprefix("MuJoCo "), count // _MUJOCO_SHARE)
    kernels, x = _arm(motion)
    steps, states, total = [np.zeros(1)], [x[None]], 0.0
    for size in _sizes(count):
        every = size // _POINTS
        started = perf_counter()
        walked = kernels.simulate(x, np.zeros(kernels.n_u), size, TIME_STEP, name, every)
        total = perf_counter() - started
        new = np.arange(len(walked)) * every > steps[-1][-1]
        steps.append((np.arange(len(walked)) * every)[new])
        states.append(walked[new])
    every_state = np.concatenate(states)
    return Invariants.of(
        np.concatenate(steps)[1:], kernels.energy(every_state), kernels.momentum(every_state), total
    )


def _sizes(count: int) -> list[int]:
    """Numbers of steps, each a hundred times the one before."""
    return [size for size in (count // 100**k for k in reversed(range(5))) if size >= _POINTS]


def _walked_by_mujoco(motion: Motion, integrator: str, count: int) -> Invariants | None:
    if find_spec("mujoco") is None:
        return None
    mujoco: Any = import_module("mujoco")  # it has no types
    kernels, x = _arm(motion)
    model = mujoco.MjModel.from_xml_string(
        robot_xml(KinematicTree.from_scene(kernels.scene), TIME_STEP, integrator)
    )
    model.opt.enableflags |= int(mujoco.mjtEnableBit.mjENBL_ENERGY)
    # What blows up is neither started again nor reported to a file.
    model.opt.disableflags |= int(mujoco.mjtDisableBit.mjDSBL_AUTORESET)
    mujoco.set_mju_user_warning(lambda message: None)
    data, robot = mujoco.MjData(model), Robot.of(kernels, x[None], np.zeros((1, kernels.n_u)))
    data.qpos[:] = np.concatenate([robot.position[0], robot.rotation[0], robot.angles[0]])
    velocity = robot.to_inertial[0] @ robot.linear[0]
    data.qvel[:] = np.concatenate([velocity, robot.angular[0], robot.rates[0]])
    points = sorted({size * k // _POINTS for size in _sizes(count) for k in range(1, _POINTS + 1)})
    energy, momentum, done, seconds = [], [], 0, 0.0
    for point in (0, *points):
        started = perf_counter()
        mujoco.mj_step(model, data, point - done)
        seconds += perf_counter() - started
        done = point
        mujoco.mj_forward(model, data)
        mujoco.mj_subtreeVel(model, data)
        energy.append(float(data.energy.sum()))
        linear = float(model.body_subtreemass[0]) * data.subtree_linvel[0]
        momentum.append(np.concatenate([linear, data.subtree_angmom[0]]))
    return Invariants.of(points, np.array(energy), np.array(momentum), seconds)


def _energy(motion: Motion, name: str, effort: Effort) -> Outcome:
    found = _walked(motion, name, effort.energy_steps)
    if found is None:
        return NotClaimed("MuJoCo is not installed")
    return _judged(found, found.energy, name in SYMPLECTIC, "energy changes")


def _momentum(motion: Motion, name: str, effort: Effort) -> Outcome:
    found = _walked(motion, name, effort.energy_steps)
    if found is None:
        return NotClaimed("MuJoCo is not installed")
    claimed = name in INTEGRATORS and INTEGRATORS[name].keeps_momentum
    return _judged(found, found.momentum, claimed, "momentum drifts")


def _judged(found: Invariants, changes: FloatArray, claimed: bool, what: str) -> Outcome:
    curve = tuple(zip(found.steps.tolist(), changes.tolist(), strict=True))
    sentence = f"the {what} by {changes[-1]:.1e} in {found.steps[-1]:.0e} steps"
    sentence += f" of {found.microseconds:.2g} us"
    return Handled(float(changes[-1]), sentence, curve) if claimed else NotClaimed(sentence, curve)


@cache
def _end(motion: Motion) -> FloatArray:
    kernels, x = _arm(motion)
    dt, still = _DURATION / _REFERENCE_STEPS, np.zeros(kernels.n_u)
    return np.asarray(kernels.simulate(x, still, _REFERENCE_STEPS, dt, "rk8", _REFERENCE_STEPS)[-1])


def _tip(motion: Motion, name: str, effort: Effort) -> Outcome:
    """Distance of the tip from where order 8 in steps of 0.25 ms ends, over milliseconds."""
    kernels, x = _arm(motion)
    still, curve = np.zeros(kernels.n_u), []
    exact = kernels.tip_pose(_end(motion))
    for dt in motion.time_steps:
        count, times = round(_DURATION / dt), []
        for _ in range(_REPEATS):
            started = perf_counter()
            end = kernels.simulate(x, still, count, _DURATION / count, name, count)[-1]
            times.append(perf_counter() - started)
        error = float(np.abs(kernels.tip_pose(end) - exact).max())
        curve.append((1e3 * min(times), error))
    sentence = "; ".join(
        f"{1e3 * dt:g} ms: {error:.1e} in {time:.2g} ms"
        for dt, (time, error) in zip(motion.time_steps, curve, strict=True)
    )
    return NotClaimed(sentence, tuple(curve))
