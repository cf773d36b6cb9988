"""What a flight catches, judged by its states and inputs as environments judge it."""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray

from dq_space_arm_env.algebra import poses
from dq_space_arm_env.kernels import Kernels
from dq_space_arm_env.kernels.stages import target_path
from dq_space_arm_env.scene.maneuver import Success
from dq_space_arm_env.scene.parameters import CATCH


class Catch(NamedTuple):
    """What a phase finds that begins with a catch."""

    phase: str
    step: int  # that ends with it
    errors: tuple[float, ...]  # of the tip, deg, m, deg/s and m/s relative to the target
    tolerances: Success

    @property
    def is_met(self) -> bool:
        """Whether the payload is caught."""
        return all(e <= most for e, most in zip(self.errors, self.tolerances.tolerances, strict=True))


def ends_held(found: Sequence[Catch]) -> bool:
    """Whether nothing is missed at the end: the last catch, if there is one, is met."""
    return not found or found[-1].is_met


def catches(
    kernels: Kernels, stages: NDArray[np.float64], states: ArrayLike, inputs: ArrayLike, first: int = 0
) -> list[Catch]:
    """Judge the catches of a flight.

    Args:
        kernels: Those of the scene.
        stages: Parameters of all stages of the episode, shape (steps + 1, n_p).
        states: Of M steps and at their end, shape (M + 1, n_x), units as in `kernels.layout.state`.
        inputs: Shape (M, n_u), N, N m and rad/s.
        first: Stage of the first of these states.

    Returns:
        A catch for each phase that begins with one at the end of one of these steps.
    """
    scene, entries, layout = kernels.scene, kernels.parameters, kernels.layout
    staged, moving, found = scene.staged, list(kernels.parameters.moving), []
    states, inputs = np.asarray(states), np.asarray(inputs)
    for index, (phase, stage) in enumerate(zip(scene.phases, staged.starts, strict=True)):
        step = stage - 1 - first
        if phase.catch is None or not 0 <= step < len(inputs):
            continue
        p = stages[stage - 1].copy()
        p[entries.indices(CATCH)] = 0.0  # before the impact
        x = _stepped(kernels, states[step], kernels.applied_inputs(states[step], inputs[step], p=p), p)
        if moving and staged.resting[index - 1] is None:
            p[moving] = target_path(kernels, stages[0, moving])[stage]
        tip, target = (tuple(each.tolist()) for each in (kernels.tip_pose(x, p=p), layout.target_with(p)))
        twist = kernels.relative_twist(x, p=p)
        angles = poses.error_angle(tip, target), np.linalg.norm(twist[:3])
        (turned, turning), moved = np.degrees(angles), poses.error_distance(tip, target)
        errors = (turned, moved, turning, np.linalg.norm(twist[3:]))
        found.append(Catch(phase.name, stage - 1, tuple(map(float, errors)), phase.catch))
    return found


def _stepped(kernels: Kernels, x: ArrayLike, u: ArrayLike, p: ArrayLike) -> NDArray[np.float64]:
    """State after a step as environments take it: divided where it would err by more than the tolerance."""
    simulation = kernels.scene.simulation
    if simulation.estimates_error(simulation.integrator):
        return kernels.checked_step(x, u, p=p)[0]
    return kernels.step(x, u, p=p)
