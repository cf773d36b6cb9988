"""A maneuver in the quantities that the paper plots: errors of the tip, inputs by actuator."""

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from dq_space_arm_env import Scene
from dq_space_arm_env.algebra import poses
from dq_space_arm_env.scene import StateLayout
from dq_space_arm_env.scene.parameters import CONTROL_UNITS
from dq_space_arm_env.scene.path import shown_target
from dq_space_arm_env.viewing.payload_places import payload_path
from dq_space_arm_env.viewing.replay.flights import frame_poses, target_during, tip_errors
from experts.problems.shooting_problem import FloatArray

FIGURES = (
    "figure-2-snapshots",
    "figure-3-pose-error",
    "figure-4-error-norms",
    "figure-5-base-inputs",
    "figure-6-arm-inputs",
)
"""Files of the paper's figures, without suffix: `experts.figures`, which needs Matplotlib, draws them."""
_AT_LIMIT = 1.0 - 1e-9


@dataclass(frozen=True, eq=False)
class ActuatorHistory:
    """The inputs of one actuator during a maneuver."""

    name: str
    unit: str
    inputs: tuple[str, ...]
    values: FloatArray  # Inputs, constant over a time step, shape (N, inputs), `unit`
    limits: FloatArray  # Largest magnitude of each input in any step, shape (inputs,), `unit`
    at_limit: NDArray[np.bool_]  # Whether each input is as large, or small, as it may be, shape (N, inputs)
    weights: FloatArray  # Weight of each squared input in the cost, shape (N, inputs), 1/unit^2

    @property
    def largest(self) -> FloatArray:
        """Largest magnitude of each input, shape (inputs,), `unit`."""
        return np.asarray(np.abs(self.values).max(axis=0))

    @property
    def clamped_share(self) -> float:
        """Share of the inputs at a limit over all stages, 0 to 1."""
        return float(np.mean(self.at_limit))

    @property
    def effort(self) -> float:
        """Sum of the weighted squares of the inputs: their part of J."""
        return float(np.sum(self.weights * self.values**2))


@dataclass(frozen=True, eq=False)
class Maneuver:
    """A trajectory of a scene; of an episode's scene, where target or masses are drawn. Compiles nothing."""

    scene: Scene
    states: FloatArray
    controls: FloatArray
    caught: bool = True  # whether no catch has failed

    @cached_property
    def time(self) -> FloatArray:
        """Time of each state, shape (N + 1,), s."""
        return np.asarray(np.arange(len(self.states)) * self.scene.simulation.dt, dtype=np.float64)

    @cached_property
    def frames(self) -> FloatArray:
        """Poses as of `Kernels.frame_poses`, the tip's last, shape (N + 1, frames, 8), m."""
        return frame_poses(self.scene, StateLayout.of(self.scene), self.states)

    @cached_property
    def target(self) -> tuple[FloatArray, ...] | tuple[float, ...]:
        """Pose q_{D/I} of the target at the states, 8 numbers, or 8 of shape (N + 1,) where it moves."""
        target = shown_target(self.scene)[0]
        return tuple(target.tolist()) if target.ndim == 1 else tuple(target[: len(self.states)].T)

    @cached_property
    def payload(self) -> FloatArray | None:
        """Poses of the payload where phases have it, shape (N + 1, 8), m; None if it is at the tip."""
        target = np.atleast_2d(np.transpose(self.target))
        return payload_path(self.scene, self.frames[:, -1], target, self.caught)

    @cached_property
    def error_pose(self) -> FloatArray:
        """Error dual quaternion q_{D/G} (31), shape (N + 1, 8), dimensionless and m."""
        tip = tuple(self.frames[:, -1].T)
        return np.stack(poses.error_pose(tip, self.target), axis=1)

    @cached_property
    def position_error(self) -> FloatArray:
        """Position r = 2 q_d q_r* of the target seen from the tip, in the tip's axes, shape (N + 1, 3), m."""
        return np.stack(poses.position(tuple(self.error_pose.T)), axis=1)

    @cached_property
    def distance(self) -> FloatArray:
        """Length of the position error, of the worst tip, shape (N + 1,), m."""
        return self._errors[1]

    @cached_property
    def angle(self) -> FloatArray:
        """Euler angle of the attitude error, of the worst tip, shape (N + 1,), rad."""
        return self._errors[0]

    @cached_property
    def _errors(self) -> tuple[FloatArray, FloatArray]:
        target, body = target_during(self.scene, len(self.states) - 1)
        return tip_errors(self.scene, self.frames, target, body)

    @cached_property
    def actuators(self) -> tuple[ActuatorHistory, ...]:
        """The scene's actuators in the order of the controls."""
        layout = StateLayout.of(self.scene)
        weights = self._in_steps(layout.control.weights, layout.control_weight)
        limits = self._in_steps(layout.control.limits, layout.control_limit)
        least = layout.lower_limits(limits)
        at_limit = (self.controls >= _AT_LIMIT * limits) | (self.controls <= _AT_LIMIT * least)
        at_limit &= limits > 0.0  # out of work is not at a limit
        histories = []
        for name in CONTROL_UNITS:
            entries = getattr(layout.control, name)
            if entries.start == entries.stop:
                continue
            history = ActuatorHistory(
                name,
                layout.control.unit(entries),
                layout.control.names[entries],
                self.controls[:, entries],
                limits[:, entries].max(axis=0),
                at_limit[:, entries],
                weights[:, entries],
            )
            histories.append(history)
        return tuple(histories)

    def actuator(self, name: str) -> ActuatorHistory | None:
        """The actuator of a name in the scene's `actuators`; None if the scene does not have it."""
        return next((actuator for actuator in self.actuators if actuator.name == name), None)

    def _in_steps(self, names: Sequence[str], values: FloatArray) -> FloatArray:
        """Numbers of the controls in each step, shape (N, n_u): phases may change them."""
        found, staged = np.tile(values, (len(self.controls), 1)), self.scene.staged
        phases = np.searchsorted(staged.starts, np.arange(len(found)), side="right") - 1
        for column, name in enumerate(names):
            if name in staged.values:
                found[:, column] = np.array(staged.values[name])[phases]
        return found
