"""Many copies of `DQSpaceArm-v0` stepped by one call of vectorized machine code."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import gymnasium
import numpy as np
from gymnasium import spaces
from gymnasium.error import ResetNeeded
from gymnasium.utils import EzPickle
from gymnasium.vector import AutoresetMode, VectorEnv
from gymnasium.vector.utils import batch_space
from numpy.typing import ArrayLike, NDArray

from dq_space_arm_env.algebra import poses
from dq_space_arm_env.environment.copies import Copies
from dq_space_arm_env.environment.dq_space_arm import DQSpaceArmEnv
from dq_space_arm_env.environment.picture_format import PictureFormat
from dq_space_arm_env.environment.results import StepResult
from dq_space_arm_env.environment.start_options import GivenStart, given_start
from dq_space_arm_env.environment.trails import Trails
from dq_space_arm_env.kernels import compile_scene
from dq_space_arm_env.kernels.report import REPORT
from dq_space_arm_env.scene import Scene
from dq_space_arm_env.scene.start import target_entries

if TYPE_CHECKING:
    from dq_space_arm_env.environment.rendering import Renderer

Array = NDArray[Any]
Mask = NDArray[np.bool_]
Rows = NDArray[np.int64]

# `info` holds the report without the reward, and the flags without the end of the episode.
_KEYS = (*REPORT[1:], "is_success", "diverged")
_NOBODY = np.empty(0, dtype=np.int64)


class DQSpaceArmVectorEnv(VectorEnv[Array, NDArray[Any], NDArray[Any]], EzPickle):
    """`num_envs` copies of `DQSpaceArmEnv`, bit for bit like single ones with the same seeds and actions.

    `gymnasium.make_vec("DQSpaceArm-v0", num_envs=1024)` makes it. Spaces, reward, `info`, options and episode
    ends are those of `DQSpaceArmEnv`; entries of `info` are arrays of shape (num_envs,), each with a mask of
    the same name preceded by an underscore (read-only where it is True everywhere). `reset(seed=s)` seeds
    copy i with s + i; a list gives each its own seed. `options` may hold "reset_mask", a bool array of shape
    (num_envs,), to reset some copies only; "initial_state" and "target" may have a row for each copy, shape
    (num_envs, n_x) and (num_envs, 8). Actions in float32, the type of the action space, are read as they are.

    What happens after the end of an episode is the autoreset mode's choice: the next step resets
    (`NEXT_STEP`, the default), the same step resets and `info` holds `final_obs` and `final_info`
    (`SAME_STEP`), or the caller does (`DISABLED`).

    With render mode "rgb_array", `render()` gives a picture of each copy, as Gymnasium's vector environments
    do; after a step that has reset a copy, it shows the new episode.
    """

    metadata: dict[str, Any] = {  # noqa: RUF012
        "render_modes": ["rgb_array"],
        "render_fps": DQSpaceArmEnv.metadata["render_fps"],
        "autoreset_mode": AutoresetMode.NEXT_STEP,
    }

    def __init__(
        self,
        num_envs: int = 1,
        scene: Scene | Mapping[str, Any] | str | Path = "paper",
        autoreset_mode: AutoresetMode | str = AutoresetMode.NEXT_STEP,
        render_mode: str | None = None,
        threads: int = 1,
        width: int = 640,
        height: int = 480,
        default_camera_config: Mapping[str, Any] | None = None,
    ) -> None:
        """Load a scene and compile what a step needs (or take it from the cache).

        Args:
            num_envs: Number of copies.
            scene: Name of a shipped scene, path of a YAML file, what such a file holds as a mapping, or a
                scene.
            autoreset_mode: What happens after the end of an episode.
            render_mode: None or "rgb_array".
            threads: Most threads that a step is shared among. More than one pays for some thousand copies on
                idle cores; with a core taken by another process it costs little.
            width: Width of the pictures, pixels.
            height: Height of the pictures, pixels.
            default_camera_config: As for `DQSpaceArmEnv`.

        Raises:
            SceneError: If the scene cannot be loaded.
            ValueError: If num_envs or threads is not positive, the scene has no normalized actions, the
                render mode is unknown, or the size or the camera of the pictures makes no sense.
        """
        picture = width, height, default_camera_config
        EzPickle.__init__(self, num_envs, scene, autoreset_mode, render_mode, threads, *picture)
        if num_envs < 1:
            raise ValueError(f"num_envs: {num_envs}, should be at least 1")
        if render_mode not in (None, "rgb_array"):
            raise ValueError(
                f"render_mode: {render_mode!r}; a vector environment has no window, "
                "should be 'rgb_array' or None"
            )
        self._picture = PictureFormat.checked(*picture)
        single = DQSpaceArmEnv(scene)
        self.scene, self.kernels = single.scene, compile_scene(single.scene, threads)
        self.num_envs, self.render_mode = num_envs, render_mode
        self.autoreset_mode = AutoresetMode(autoreset_mode)
        self.metadata = {
            **type(self).metadata,
            "render_fps": single.metadata["render_fps"],
            "autoreset_mode": self.autoreset_mode,
        }
        self.single_action_space: spaces.Space[Any] = single.action_space
        self.single_observation_space: spaces.Space[Any] = single.observation_space
        self.action_space = batch_space(self.single_action_space, num_envs)
        self.observation_space = batch_space(self.single_observation_space, num_envs)

        self._copies = Copies(self.kernels, num_envs)
        self._begun = False
        self._everything = np.ones(num_envs, dtype=np.bool_)
        self._everything.setflags(write=False)
        self._masks = dict.fromkeys((f"_{key}" for key in _KEYS), self._everything)
        # Copies whose episodes are over and that the next step, or the caller, is to reset.
        self._over = _NOBODY
        self._seen: Array | None = None
        self._trails = None if render_mode is None else Trails(num_envs)
        self._renderer: Renderer | None = None

    @property
    def states(self) -> Array:
        """The states, shape (num_envs, n_x), units as in `kernels.layout.state`; a copy."""
        return self._copies.x.copy()

    @property
    def parameters(self) -> Array:
        """What the scene drew for each copy's episode besides the state, shape (num_envs, n_p); a copy.

        See `DQSpaceArmEnv.parameters`.
        """
        return self._copies.parameters.copy()

    @property
    def targets(self) -> Array:
        """Poses q_{D/I} of the targets, shape (num_envs, 8), real part dimensionless, dual part m; a copy."""
        target = np.array(self.scene.target.pose.dual_quaternion, dtype=self.kernels.dtype)
        targets = np.tile(target, (self.num_envs, 1))
        entries = list(target_entries(self.scene))
        targets[:, entries] = self._copies.parameters[:, : len(entries)]
        return targets

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
        rows, others = np.flatnonzero(mask), np.flatnonzero(~mask)
        starts = self._given_starts(rows, rest)
        self._seed(seed, rows)
        self._copies.begin(rows, starts)
        result = self._copies.observe(rows)
        if self._seen is None:
            result.observation[others] = self._copies.observe(others).observation[others]
        else:
            result.observation[others] = self._seen[others]
        result.report[:, others], result.flags[:, others] = 0.0, False
        self._over = np.setdiff1d(self._over, rows)
        self._remember(result.observation)
        if self._trails is not None:
            self._trails.begin(rows)
            self._trails.append(self._tip_positions())
        return result.observation, self._info(result, mask)

    def _remember(self, observations: Array) -> None:
        """Where resets are the caller's, those of some copies show what the others saw last."""
        if self.autoreset_mode is AutoresetMode.DISABLED:
            self._seen = observations.copy()

    def _checked_mask(self, mask: Any) -> Mask:
        if mask is None:
            return self._everything
        if not isinstance(mask, np.ndarray) or mask.shape != (self.num_envs,) or mask.dtype != np.bool_:
            raise ValueError(
                f"options: reset_mask {mask!r}, should be a bool array of shape ({self.num_envs},)"
            )
        if not mask.any():
            raise ValueError("options: reset_mask is False everywhere, should be True for a copy to reset")
        return mask

    def _seed(self, seed: int | Sequence[int | None] | None, rows: Rows) -> None:
        """Renew the random generators of copies that are given a seed, or that have none yet."""
        if seed is None or isinstance(seed, (int, np.integer)):
            seeds = [None if seed is None else int(seed) + i for i in range(self.num_envs)]
        else:
            seeds = list(seed)
        if len(seeds) != self.num_envs:
            raise ValueError(f"seed: {len(seeds)} seeds, should be {self.num_envs}, one for each copy")
        if not self._begun:
            self._copies.seed(np.arange(self.num_envs), seeds)
            self._begun = True
        elif seed is not None:
            renewed = np.array([i for i in rows if seeds[i] is not None], dtype=np.int64)
            self._copies.seed(renewed, [seeds[i] for i in renewed])

    def _given_starts(self, rows: Rows, options: dict[str, Any]) -> GivenStart:
        """What the options want copies to start from: the same for all, or arrays with a row for each."""
        shapes = {"initial_state": self._copies.x.shape, "target": (self.num_envs, 8)}
        each = {
            name: options[name]
            for name, shape in shapes.items()
            if name in options and np.shape(options[name]) == shape
        }
        if not each:
            return given_start(self.kernels, options)
        starts = [
            given_start(self.kernels, {**options, **{name: values[i] for name, values in each.items()}})
            for i in rows
        ]
        return GivenStart(
            *(None if parts[0] is None else np.array(parts) for parts in zip(*starts, strict=True))
        )

    def step(self, actions: ArrayLike) -> tuple[Array, Array, Mask, Mask, dict[str, Any]]:
        """Apply an action to every copy for one time step.

        Args:
            actions: Inputs as fractions of their limits, shape (num_envs, n_u); clipped to [-1, 1].

        Returns:
            Observations, rewards, terminated, truncated (always False), info.

        Raises:
            ResetNeeded: Before the first reset, and with autoreset disabled when an episode is over.
            ValueError: If the actions have a wrong shape or a NaN; no copy has moved then.
        """
        resetting = self._over
        if not self._begun:
            raise ResetNeeded("the episodes have not begun: call reset() before step()")
        if len(resetting) and self.autoreset_mode is AutoresetMode.DISABLED:
            raise ResetNeeded(
                f"the episodes of copies {resetting.tolist()} are over: reset them with a reset_mask"
            )
        result = self._copies.step(actions, resetting)
        if len(resetting):
            self._begin_anew(resetting, result)
            self._over = _NOBODY
        rewards, terminated, final = result.report[0], result.flags[0], None
        if np.count_nonzero(terminated):
            rows = np.flatnonzero(terminated)
            if self.autoreset_mode is AutoresetMode.SAME_STEP:
                rewards, terminated = rewards.copy(), terminated.copy()
                final = self._final(rows, result)
                self._begin_anew(rows, result)
            else:
                self._over = rows
        self._remember(result.observation)
        if self._trails is not None:
            self._trails.append(self._tip_positions())
        info = self._info(result, self._everything)
        if final is not None:
            info |= final
        return result.observation, rewards, terminated, np.zeros(self.num_envs, dtype=np.bool_), info

    def _begin_anew(self, rows: Rows, result: StepResult) -> None:
        """Begin new episodes of copies, and put what they see where the old ones' stands."""
        self._copies.begin(rows)
        if self._trails is not None:
            self._trails.begin(rows)
        self._copies.observe(rows, result)

    def _tip_positions(self) -> Array:
        return np.array(poses.position(self.kernels.tip_pose(self._copies.x).T)).T

    def render(self) -> tuple[NDArray[np.uint8], ...] | None:
        """Draw the present state of every copy.

        Returns:
            A picture of shape (height, width, 3), uint8, for each copy; None without a render mode.

        Raises:
            ResetNeeded: Before the first reset.
        """
        if self._trails is None:
            gymnasium.logger.warn(
                "render() does nothing without a render mode, e.g. "
                'gymnasium.make_vec("DQSpaceArm-v0", render_mode="rgb_array")'
            )
            return None
        if not self._begun:
            raise ResetNeeded("call reset() before render()")
        if self._renderer is None:
            from dq_space_arm_env.environment.rendering import Renderer

            self._renderer = Renderer(self.scene, self._picture)
        frames, targets, pictures = self.kernels.frame_poses(self._copies.x), self.targets, []
        for row in range(self.num_envs):
            self._renderer.aim_at(targets[row])
            pictures.append(self._renderer.draw(frames[row], self._trails.of(row)))
        return tuple(pictures)

    def _final(self, rows: Rows, result: StepResult) -> dict[str, Any]:
        """What episodes that a step ended and begins anew leave behind."""
        ended = result.flags[0].copy()
        last_observations = np.full(self.num_envs, None, dtype=object)
        for i in rows:
            last_observations[i] = result.observation[i].copy()
        last = result._replace(report=np.where(ended, result.report, 0.0), flags=result.flags & ended)
        return {
            "final_obs": last_observations,
            "_final_obs": ended,
            "final_info": self._info(last, ended),
            "_final_info": ended.copy(),
        }

    def _info(self, result: StepResult, mask: Mask) -> dict[str, Any]:
        """What `DQSpaceArmEnv` reports, as arrays."""
        _, pose, velocity, control, end_pose, end_velocity, angle, distance = result.report
        _, success, diverged = result.flags
        whole = mask is self._everything
        return {
            "cost_pose": pose,
            "cost_base_velocity": velocity,
            "cost_control": control,
            "terminal_cost_pose": end_pose,
            "terminal_cost_base_velocity": end_velocity,
            "attitude_error": angle,
            "position_error": distance,
            "is_success": success,
            "diverged": diverged,
            **(self._masks if whole else {key: mask.copy() for key in self._masks}),
        }
