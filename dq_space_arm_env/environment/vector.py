"""Many copies of `DQSpaceArm-v0` stepped by one call of vectorized machine code."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
from gymnasium import spaces
from gymnasium.error import ResetNeeded
from gymnasium.vector import AutoresetMode, VectorEnv
from gymnasium.vector.utils import batch_space
from numpy.typing import ArrayLike, NDArray

from dq_space_arm_env.environment.dq_space_arm import OBSERVATION_LIMIT, DQSpaceArmEnv
from dq_space_arm_env.environment.start_options import given_start
from dq_space_arm_env.kernels.report import REPORT
from dq_space_arm_env.scene import Scene
from dq_space_arm_env.scene.start import number_of_draws, start_from_draws

Array = NDArray[np.float64]
Mask = NDArray[np.bool_]

_COLUMN = {name: REPORT.index(name) for name in REPORT}
# Terms of the stage cost, those of the terminal cost, and the tip's errors, as `info` names them.
_STAGE, _TERMINAL, _ERRORS = REPORT[:3], REPORT[3:5], REPORT[5:7]


class DQSpaceArmVectorEnv(VectorEnv[Array, NDArray[Any], NDArray[Any]]):
    """`num_envs` copies of `DQSpaceArmEnv`, bit for bit like single ones with the same seeds and actions.

    `gymnasium.make_vec("DQSpaceArm-v0", num_envs=1024)` makes it. Spaces, reward, `info`, options and episode
    ends are those of `DQSpaceArmEnv`; entries of `info` are arrays of shape (num_envs,), each with a mask of
    the same name preceded by an underscore. `reset(seed=s)` seeds copy i with s + i; a list gives each its
    own seed. `options` may hold "reset_mask", a bool array of shape (num_envs,), to reset some copies only,
    and "initial_state" of shape (n_x,) or (num_envs, n_x).

    What happens after the end of an episode is the autoreset mode's choice: the next step resets
    (`NEXT_STEP`, the default), the same step resets and `info` holds `final_obs` and `final_info`
    (`SAME_STEP`), or the caller does (`DISABLED`).
    """

    metadata: dict[str, Any] = {"render_modes": [], "autoreset_mode": AutoresetMode.NEXT_STEP}  # noqa: RUF012

    def __init__(
        self,
        num_envs: int = 1,
        scene: Scene | str | Path = "paper",
        autoreset_mode: AutoresetMode | str = AutoresetMode.NEXT_STEP,
        render_mode: None = None,
    ) -> None:
        """Load a scene and compile what a step needs (or take it from the cache).

        Args:
            num_envs: Number of copies.
            scene: Name of a shipped scene, path of a YAML file, or a scene.
            autoreset_mode: What happens after the end of an episode.
            render_mode: None; a single environment draws pictures.

        Raises:
            SceneError: If the scene cannot be loaded.
            ValueError: If num_envs is not positive, the scene has no normalized actions, or a render mode is
                given.
        """
        if num_envs < 1:
            raise ValueError(f"num_envs: {num_envs}, should be at least 1")
        if render_mode is not None:
            raise ValueError(
                f"render_mode: {render_mode!r}; a vector environment draws nothing, should be None"
            )
        single = DQSpaceArmEnv(scene)
        self.scene, self.kernels = single.scene, single.kernels
        self.num_envs, self.render_mode = num_envs, render_mode
        self.autoreset_mode = AutoresetMode(autoreset_mode)
        self.metadata = {**type(self).metadata, "autoreset_mode": self.autoreset_mode}
        self.single_action_space: spaces.Space[Any] = single.action_space
        self.single_observation_space: spaces.Space[Any] = single.observation_space
        self.action_space = batch_space(self.single_action_space, num_envs)
        self.observation_space = batch_space(self.single_observation_space, num_envs)

        self._kernel = self.kernels.kernel("environment_step")
        self._draws = number_of_draws(self.scene)
        self._steps, self._dt = self.scene.simulation.steps, self.scene.simulation.dt
        self._x = np.zeros((num_envs, self.kernels.n_x))
        self._terminal_cost = np.zeros(num_envs)
        self._step_counts = np.zeros(num_envs)  # whole numbers, as floats: they become times
        self._over = np.zeros(num_envs, dtype=np.bool_)
        self._generators: list[np.random.Generator] = []
        self._seen: Array | None = None

    @property
    def states(self) -> Array:
        """The states, shape (num_envs, n_x), units as in `kernels.layout.state`; a copy."""
        return self._x.copy()

    def reset(
        self, *, seed: int | Sequence[int | None] | None = None, options: dict[str, Any] | None = None
    ) -> tuple[Array, dict[str, Any]]:
        """Begin episodes.

        Args:
            seed: Seed s for seeds s, s + 1, ...; one seed per copy; or None to go on with the generators.
            options: As for `DQSpaceArmEnv.reset`, and "reset_mask".

        Returns:
            Observations, shape (num_envs, n_obs); of copies that are not reset, their present ones. And info.

        Raises:
            ValueError: If an option or the number of seeds is wrong.
        """
        rest = dict(options or {})
        mask = self._checked_mask(rest.pop("reset_mask", None))
        self._seed(seed, mask)
        self._start(mask, rest)
        observations, reports = self._observe(self._x, (self._steps - self._step_counts) * self._dt)
        if self._seen is not None and not mask.all():
            observations[~mask] = self._seen[~mask]
        self._terminal_cost = reports[:, _COLUMN["terminal_cost"]].copy()
        self._remember(observations)
        return observations, self._info(reports, mask)

    def _remember(self, observations: Array) -> None:
        """Where resets are the caller's, those of some copies show what the others saw last."""
        if self.autoreset_mode is AutoresetMode.DISABLED:
            self._seen = observations.copy()

    def _checked_mask(self, mask: Any) -> Mask:
        if mask is None:
            return np.ones(self.num_envs, dtype=np.bool_)
        if not isinstance(mask, np.ndarray) or mask.shape != (self.num_envs,) or mask.dtype != np.bool_:
            raise ValueError(
                f"options: reset_mask {mask!r}, should be a bool array of shape ({self.num_envs},)"
            )
        if not mask.any():
            raise ValueError("options: reset_mask is False everywhere, should be True for a copy to reset")
        return mask

    def _seed(self, seed: int | Sequence[int | None] | None, mask: Mask) -> None:
        """Renew the random generators of the masked copies that are given a seed, or that have none yet."""
        if seed is None or isinstance(seed, (int, np.integer)):
            seeds = [None if seed is None else int(seed) + i for i in range(self.num_envs)]
        else:
            seeds = list(seed)
        if len(seeds) != self.num_envs:
            raise ValueError(f"seed: {len(seeds)} seeds, should be {self.num_envs}, one for each copy")
        if not self._generators:
            self._generators = [np.random.default_rng(s) for s in seeds]
        for i in np.flatnonzero(mask):
            if seeds[i] is not None:
                self._generators[i] = np.random.default_rng(seeds[i])

    def _start(self, mask: Mask, options: dict[str, Any]) -> None:
        """Put the masked copies at the start of an episode."""
        states: Any = options.get("initial_state")
        if np.ndim(states) == 2 and np.shape(states) == self._x.shape:
            for i in np.flatnonzero(mask):
                self._x[i] = given_start(self.kernels, {**options, "initial_state": states[i]})
        else:
            start = given_start(self.kernels, options)
            self._x[mask] = self._draw(mask) if start is None else start
        self._step_counts[mask] = 0
        self._over[mask] = False

    def _draw(self, mask: Mask) -> Array:
        """Random starts, each from its copy's own generator."""
        draws = [self._generators[i].uniform(-1.0, 1.0, self._draws) for i in np.flatnonzero(mask)]
        return start_from_draws(self.scene, np.array(draws))

    def _run(self, x: Array, actions: Array, time_left: Array, dt: float) -> tuple[Array, Array, Array]:
        """Next states, observations and reports."""
        outputs = [np.empty((len(x), spec.stride)) for spec in self._kernel.outputs]
        self._kernel([x, actions, np.array([dt]), time_left, *outputs], len(x))
        return outputs[0], outputs[1], outputs[2]

    def _observe(self, x: Array, time_left: Array) -> tuple[Array, Array]:
        """Observations and reports of given states: what a step of no duration sees, without a stage cost."""
        _, observations, reports = self._run(x, np.zeros((len(x), self.kernels.n_u)), time_left, 0.0)
        reports[:, : len(_STAGE)] = 0.0
        return observations, reports

    def step(self, actions: ArrayLike) -> tuple[Array, Array, Mask, Mask, dict[str, Any]]:
        """Apply an action to every copy for one time step.

        Args:
            actions: Inputs as fractions of their limits, shape (num_envs, n_u); clipped to [-1, 1].

        Returns:
            Observations, rewards, terminated, truncated (always False), info.

        Raises:
            ResetNeeded: Before the first reset, and with autoreset disabled when an episode is over.
            ValueError: If the actions have a wrong shape or a NaN.
        """
        values, resetting = self._checked_actions(actions), self._over
        last = self._step_counts == self._steps - 1
        time_left = (self._steps - 1 - self._step_counts) * self._dt
        x_next, observations, reports = self._run(self._x, values, time_left, self._dt)
        rewards = -reports[:, _COLUMN["stage_cost"]]
        rewards[last] -= reports[last, _COLUMN["terminal_cost"]]
        # Written so that NaN counts as diverged.
        diverged = ~(reports[:, _COLUMN["observation_square"]] <= OBSERVATION_LIMIT**2) & ~resetting
        if diverged.any():
            _refuse_nan(values)
            self._end_diverged(diverged, time_left, x_next, observations, reports, rewards)
        terminated = (last | diverged) & ~resetting
        self._x = x_next
        self._step_counts += 1
        if resetting.any():
            rewards[resetting] = 0.0
            self._restart(resetting, observations, reports)
        info = self._autoreset(terminated, diverged, observations, reports)
        self._terminal_cost = reports[:, _COLUMN["terminal_cost"]].copy()
        self._remember(observations)
        return observations, rewards, terminated, np.zeros(self.num_envs, dtype=np.bool_), info

    def _checked_actions(self, actions: ArrayLike) -> Array:
        if not self._generators:
            raise ResetNeeded("the episodes have not begun: call reset() before step()")
        values = np.ascontiguousarray(actions, dtype=np.float64)
        if values.shape != (self.num_envs, self.kernels.n_u):
            raise ValueError(f"actions: shape {values.shape}, should be {(self.num_envs, self.kernels.n_u)}")
        if self.autoreset_mode is AutoresetMode.DISABLED and self._over.any():
            copies = np.flatnonzero(self._over).tolist()
            raise ResetNeeded(f"the episodes of copies {copies} are over: reset them with a reset_mask")
        return values

    def _end_diverged(
        self,
        diverged: Mask,
        time_left: Array,
        x_next: Array,
        observations: Array,
        reports: Array,
        rewards: Array,
    ) -> None:
        """Keep the last sound state of diverged copies and charge what is left of their episodes."""
        remaining = self._steps - self._step_counts[diverged]
        rewards[diverged] = (
            -reports[diverged, _COLUMN["stage_cost"]] * remaining - self._terminal_cost[diverged]
        )
        x_next[diverged] = self._x[diverged]
        seen, report = self._observe(x_next[diverged], time_left[diverged])
        report[:, : len(_STAGE)] = reports[diverged, : len(_STAGE)]
        observations[diverged], reports[diverged] = seen, report

    def _restart(self, mask: Mask, observations: Array, reports: Array) -> None:
        """Begin new episodes of some copies and put what they see where the old ones' stands."""
        self._x[mask] = self._draw(mask)
        self._step_counts[mask] = 0
        time_left = np.full(int(mask.sum()), self._steps * self._dt)
        observations[mask], reports[mask] = self._observe(self._x[mask], time_left)

    def _autoreset(
        self, terminated: Mask, diverged: Mask, observations: Array, reports: Array
    ) -> dict[str, Any]:
        """Reset now or leave it to the next step, as the mode says, and collect `info`."""
        everything = np.ones(self.num_envs, dtype=np.bool_)
        if self.autoreset_mode is not AutoresetMode.SAME_STEP or not terminated.any():
            self._over = terminated
            return self._info(reports, everything, terminated, diverged)
        final_info = self._info(reports, terminated, terminated, diverged)
        final_observations = np.full(self.num_envs, None, dtype=object)
        for i in np.flatnonzero(terminated):
            final_observations[i] = observations[i].copy()
        self._restart(terminated, observations, reports)
        info = self._info(reports, everything)
        info |= {"final_obs": final_observations, "_final_obs": terminated.copy()}
        return info | {"final_info": final_info, "_final_info": terminated.copy()}

    def _info(
        self, reports: Array, mask: Mask, terminal: Mask | None = None, diverged: Mask | None = None
    ) -> dict[str, Any]:
        """What `DQSpaceArmEnv` reports, as arrays; zero for copies outside the mask."""
        whole = bool(mask.all())
        nobody = np.zeros(self.num_envs, dtype=np.bool_)
        info: dict[str, Any] = {}
        for name in _STAGE + _ERRORS:
            column = reports[:, _COLUMN[name]]
            info[name] = column.copy() if whole else np.where(mask, column, 0.0)
        for name in _TERMINAL:
            ended = nobody if terminal is None else terminal & mask
            info[name] = np.where(ended, reports[:, _COLUMN[name]], 0.0)
        sound = mask if diverged is None else mask & ~diverged
        success = self.scene.success
        close = info["attitude_error"] <= success.attitude_error_deg
        info["is_success"] = close & (info["position_error"] <= success.position_error) & sound
        info["diverged"] = mask & ~sound
        return info | {f"_{name}": mask.copy() for name in info}


def _refuse_nan(actions: Array) -> None:
    """Raise ValueError if diverged states are the work of actions that are not numbers."""
    missing = np.isnan(actions).any(axis=1)
    if missing.any():
        copies = np.flatnonzero(missing).tolist()
        raise ValueError(f"actions: NaN for copies {copies}, should be numbers in [-1, 1]")
