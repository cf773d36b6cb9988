"""MuJoCo behind an ordinary Gymnasium environment: the least that such an environment does.

It is what one would write around `mj_step`, and does less than `DQSpaceArm-v0`: no pose of the tip and no
wrist, no forces in the base's axes, a reward of two sums of squares, an empty `info`, no check of actions or
results, a start that is not drawn from the scene's spread.
"""

from __future__ import annotations

from importlib import import_module
from typing import Any

import gymnasium
import numpy as np
from gymnasium import spaces
from gymnasium.envs.registration import EnvSpec
from numpy.typing import NDArray

from experts.problem import FloatArray

_BOUND = 1e6
_START_RATES = 0.05


class MujocoEnvironment(gymnasium.Env[FloatArray, NDArray[Any]]):
    """Generalized forces as actions, positions and velocities as observations."""

    metadata: dict[str, Any] = {"render_modes": []}  # noqa: RUF012

    def __init__(self, model: Any, qpos: FloatArray, limits: FloatArray, steps: int) -> None:
        """Prepare.

        Args:
            model: An `MjModel`, which environments may share.
            qpos: Positions at the start, shape (nq,), m and rad.
            limits: Largest generalized forces, shape (nv,), N and N m.
            steps: Steps of an episode.
        """
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
    """Describe the environment to `gymnasium.make` and `gymnasium.make_vec`, which add their usual wrappers.

    Args:
        model: As of `MujocoEnvironment`, and so are the others.
        qpos: Shape (nq,), m and rad.
        limits: Shape (nv,), N and N m.
        steps: Steps of an episode.

    Returns:
        The specification; it is not registered.
    """

    def create(**_: Any) -> MujocoEnvironment:
        return MujocoEnvironment(model, qpos, limits, steps)

    return EnvSpec("MujocoSpaceArm-v0", entry_point=create)
