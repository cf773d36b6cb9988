"""Integrator and time step of a scene, chosen by measuring the error of a swing of its arm."""

from __future__ import annotations

from collections.abc import Sequence
from time import perf_counter
from typing import NamedTuple

import numpy as np

from dq_space_arm_env.algebra import poses
from dq_space_arm_env.dynamics.step_stability import STIFF, joint_motion
from dq_space_arm_env.interoperability.swing_efforts import FloatArray, swing_torques
from dq_space_arm_env.kernels import Kernels, compile_scene
from dq_space_arm_env.scene import INTEGRATORS, Scene

ACCURACY = 1e-4
"""Error of the tip at the end of the swing that is small enough, m and rad."""
DIVISIONS = (1, 2, 4)
"""Numbers of steps of `rk4` in a time step. More would make episodes of too many steps."""
_AMPLITUDE = 0.5  # rad, m: of the swing


class StepTrial(NamedTuple):
    """An integrator with a time step, and what it achieves."""

    integrator: str
    division: int  # steps in a time step of the scene
    error: float  # of the tip at the end of the swing, m or rad; inf if it diverges
    microseconds: float  # per simulated second, of one motion

    def of(self, scene: Scene) -> Scene:
        """The scene with this integrator and time step; episodes last as long."""
        dt, steps = scene.simulation.dt / self.division, scene.simulation.steps * self.division
        return scene.replace(simulation={"integrator": self.integrator, "dt": dt, "steps": steps})


def needs_stiff_method(scene: Scene) -> bool:
    """Whether the dampers of the joints stop them too fast for every division of `rk4`."""
    shortest = scene.simulation.dt / max(DIVISIONS)
    return joint_motion(scene).decay * shortest > INTEGRATORS["rk4"].real_interval


def measured_steps(scene: Scene) -> list[StepTrial]:
    """Try integrators and time steps, the cheapest first, until one follows a swing of the arm.

    All joints swing together by some half a radian there and back, in the time of an episode, each torque
    held for a time step of the scene. The error is the distance from the end of the same motion in steps half
    as long.

    Args:
        scene: A scene with joints, driven or not.

    Returns:
        The trials, see `best_of`: `rk4` in whole time steps or in parts of them, and, where each of them
        misses the accuracy, `rodas4`, which may miss it too.
    """
    kernels = compile_scene(scene)
    trials: list[StepTrial] = []
    for division in DIVISIONS:
        trials.append(_tried(kernels, "rk4", division))
        if trials[-1].error <= ACCURACY:
            return trials
    return [*trials, _tried(kernels, STIFF, 1)]


def best_of(trials: Sequence[StepTrial]) -> StepTrial:
    """The one that errs least; `rodas4` where all diverge."""
    return min(reversed(trials), key=lambda each: each.error)


def _tried(kernels: Kernels, integrator: str, division: int) -> StepTrial:
    finer, _ = _end(kernels, integrator, 2 * division)  # compiles
    coarse, seconds = _end(kernels, integrator, division)
    error = np.inf
    if np.isfinite([*finer, *coarse]).all():
        tips = [tuple(kernels.tip_pose(each).tolist()) for each in (coarse, finer)]
        error = max(float(poses.error_distance(*tips)), float(poses.error_angle(*tips)))
    simulation = kernels.scene.simulation
    return StepTrial(integrator, division, error, 1e6 * seconds / (simulation.steps * simulation.dt))


def _end(kernels: Kernels, integrator: str, division: int) -> tuple[FloatArray, float]:
    """State at the end of the swing, shape (n_x,), and the time that it took, s."""
    layout, simulation = kernels.layout, kernels.scene.simulation
    held = np.zeros((simulation.steps, layout.n_u))
    torques = swing_torques(kernels.scene, _AMPLITUDE)
    held[:, layout.control.joint_torque] = torques[:, list(layout.actuated_joints)]
    controls = np.repeat(held, division, axis=0)
    began = perf_counter()
    with np.errstate(all="ignore"):
        dt, steps = simulation.dt / division, len(controls)
        states = kernels.simulate(layout.initial_state, controls, steps, dt, integrator, every=steps)
    return np.asarray(states[-1]), perf_counter() - began
