"""The native vector environment: many `DQSpaceArm-v0` stepped by one call of vectorized machine code."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import gymnasium
import numpy as np
from gymnasium import spaces
from gymnasium.error import ResetNeeded
from gymnasium.vector import AutoresetMode, VectorEnv
from gymnasium.vector.utils import batch_space
from numpy.typing import ArrayLike, NDArray

from dq_space_arm_env.algebra import poses
from dq_space_arm_env.common.real_arrays import real_array
from dq_space_arm_env.common.shown_text import shortened
from dq_space_arm_env.environment.disturbances import displaced
from dq_space_arm_env.environment.dq_space_arm import DQSpaceArmEnv
from dq_space_arm_env.environment.reset_options import (
    GivenStart,
    check_scene,
    checked_options,
    given_start,
    saved_state,
)
from dq_space_arm_env.environment.saved_states import PicklesEpisodes, checked_state, scene_to_copy
from dq_space_arm_env.environment.specification import (
    PlainSpec,
    action_space,
    frames_per_second,
    observation_space,
)
from dq_space_arm_env.environment.sub_environments import StepResult, SubEnvironments
from dq_space_arm_env.kernels import compile_scene
from dq_space_arm_env.scene import Scene, load_scene
from dq_space_arm_env.task.step_report import STATE_LIMIT, grouped, report_names
from dq_space_arm_env.viewing.payload_places import Payloads, leaves_tip
from dq_space_arm_env.viewing.picture_format import PictureFormat
from dq_space_arm_env.viewing.trails import Trails

if TYPE_CHECKING:
    from dq_space_arm_env.viewing.rendering import Renderer

Array = NDArray[Any]
Mask = NDArray[np.bool_]
Rows = NDArray[np.int64]

_NONE = np.empty(0, dtype=np.int64)


class DQSpaceArmVectorEnv(VectorEnv[Any, NDArray[Any], NDArray[Any]], PicklesEpisodes):
    """`num_envs` sub-environments, bit-equal to single `DQSpaceArmEnv` with the same seeds and actions.

    `gymnasium.make_vec("DQSpaceArm-v0", num_envs=1024)` creates it. Spaces, reward, `info`, options and
    episode ends are those of `DQSpaceArmEnv`. Entries of `info` are arrays of shape (num_envs,), each with a
    mask of the same name preceded by an underscore (read-only where True everywhere). `reset(seed=s)` seeds
    sub-environment i with s + i; a list gives each its own seed. `options` may hold "reset_mask", a bool
    array of shape (num_envs,), to reset only some; those that the first reset leaves out wait at the scene's
    own start, as if their episodes were over. "initial_state", "target" and "parameters" may have a row
    per sub-environment, shapes (num_envs, n_x), (num_envs, 8) and (num_envs, n_p). Actions in float32, the
    type of the action space, are used without a copy.

    The autoreset mode determines what follows the end of an episode: the next step resets (`NEXT_STEP`, the
    default), the same step resets and `info` holds `final_obs` and `final_info` (`SAME_STEP`), or the caller
    does (`DISABLED`).

    With render mode "rgb_array", `render()` returns a picture of each sub-environment, as in Gymnasium's
    vector environments; after a step that has reset one, its picture shows the new episode.
    """

    spec = PlainSpec()
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
        max_episode_steps: int | None = None,
    ) -> None:
        """Load a scene and compile its step, or take it from the cache.

        Args:
            num_envs: Number of sub-environments.
            scene: Name of a shipped scene, path of a YAML file, its content as a mapping, or a scene.
            autoreset_mode: What follows the end of an episode.
            render_mode: None or "rgb_array".
            threads: Largest number of threads for a step. More than one pays from some thousand
                sub-environments on idle cores, and costs little on busy ones.
            width: Width of the pictures, pixels.
            height: Height of the pictures, pixels.
            default_camera_config: As for `DQSpaceArmEnv`.
            max_episode_steps: None; episodes are as long as the scene says.

        Raises:
            SceneError: If the scene cannot be loaded.
            ValueError: If num_envs or threads is not positive, the scene has no normalized actions, the
                autoreset mode or the render mode is unknown, size or camera of the pictures is invalid, or
                `max_episode_steps` is given.
        """
        if max_episode_steps not in (None, -1):
            raise ValueError(
                f"max_episode_steps: {max_episode_steps}, should be left out: the task ends with the "
                "scene's steps. For shorter tasks give scene.replace(simulation={'steps': ...}); to cut "
                "episodes off, vectorization_mode='sync'"
            )
        picture = width, height, default_camera_config
        if isinstance(num_envs, bool) or not isinstance(num_envs, int | np.integer) or num_envs < 1:
            raise ValueError(f"num_envs: {num_envs!r}, should be a whole number of at least 1")
        if render_mode not in (None, "rgb_array"):
            raise ValueError(
                f"render_mode: {render_mode!r}; a vector environment has no window, "
                "should be 'rgb_array' or None"
            )
        modes = [mode.value for mode in AutoresetMode]
        if not isinstance(autoreset_mode, AutoresetMode) and autoreset_mode not in modes:
            raise ValueError(f"autoreset_mode: {autoreset_mode!r}, should be one of {', '.join(modes)}")
        self._picture = PictureFormat.checked(*picture)
        self.scene = load_scene(scene)
        self.kernels = compile_scene(self.scene, threads)
        copied = scene_to_copy(scene, self.scene)
        PicklesEpisodes.__init__(self, num_envs, copied, autoreset_mode, render_mode, threads, *picture)
        self.num_envs, self.render_mode = num_envs, render_mode
        self.autoreset_mode = AutoresetMode(autoreset_mode)
        self.metadata = type(self).metadata | {
            "render_fps": frames_per_second(self.scene),
            "autoreset_mode": self.autoreset_mode,
        }
        self.single_action_space: spaces.Space[Any] = action_space(self.kernels)
        self.single_observation_space = self._make_observation_space()
        check_scene(self.scene)
        self.action_space = batch_space(self.single_action_space, num_envs)
        self.observation_space = batch_space(self.single_observation_space, num_envs)

        self._envs = self._make_sub_environments()
        self._begun, disabled = False, self.autoreset_mode is AutoresetMode.DISABLED
        self._all = np.ones(num_envs, dtype=np.bool_)
        self._all.setflags(write=False)
        # `info` holds the report without the reward, and the flags without the end of the episode.
        self._names = report_names(self.scene)[1:]
        keys = (*grouped(dict.fromkeys(self._names)), "is_success", "diverged")
        self._masks = dict.fromkeys((f"_{key}" for key in keys), self._all)
        # Rows whose episodes are over or have not begun, to be reset by the next step or the caller.
        self._over: Rows = np.arange(num_envs)
        self._seen = np.zeros(self.observation_space.shape or (), self.kernels.dtype) if disabled else None
        self._trails = None if render_mode is None else Trails(num_envs)
        self._payloads = Payloads(self.kernels, num_envs) if leaves_tip(self.scene) else None
        self._renderer: Renderer | None = None

    def _make_observation_space(self) -> spaces.Space[Any]:
        return observation_space(self.kernels)

    def _make_sub_environments(self) -> SubEnvironments:
        return SubEnvironments(self.kernels, self.num_envs)

    @property
    def states(self) -> Array:
        """The states, shape (num_envs, n_x), units as in `kernels.layout.state`; a copy.

        `ResetNeeded` before the first reset, here and in the three that follow.
        """
        self._require_reset("reading the states")
        return self._envs.x.copy()

    @property
    def parameters(self) -> Array:
        """Parameters of each episode, shape (num_envs, n_p), see `DQSpaceArmEnv.parameters`; a copy."""
        self._require_reset("reading the parameters")
        return self._envs.parameters.copy()

    @property
    def targets(self) -> Array:
        """Poses q_{D/I} of the targets now, shape (num_envs, 8), dimensionless and m; a copy."""
        return self.kernels.layout.target_with(self.stage_parameters)

    @property
    def stage_parameters(self) -> Array:
        """Parameters of each episode now, shape (num_envs, n_p), see `DQSpaceArmEnv.stage_parameters`."""
        self._require_reset("reading the parameters")
        return self._envs.stage_parameters()

    @property
    def elapsed_steps(self) -> NDArray[np.int64]:
        """Time steps that each episode has taken, shape (num_envs,). `ResetNeeded` before the first reset."""
        self._require_reset("reading the elapsed steps")
        return self._envs.kept()["memory"][:, 0].astype(np.int64)

    def _require_reset(self, what: str) -> None:
        if not self._begun:
            raise ResetNeeded(f"the episodes have not begun: call reset() before {what}")

    def reset(
        self, *, seed: int | Sequence[int | None] | None = None, options: dict[str, Any] | None = None
    ) -> tuple[Any, dict[str, Any]]:
        """Begin episodes.

        Args:
            seed: Seed s for s, s + 1, ...; one seed per sub-environment; or None to keep the generators.
            options: As for `DQSpaceArmEnv.reset`, and "reset_mask"; "state" is what `get_state` gives, or
                `DQSpaceArmEnv.get_state`, the same for all, generators included unless there is a seed.

        Returns:
            Observations, shape (num_envs, n_obs), the present ones where nothing is reset; and info.

        Raises:
            ValueError: If an option or the number of seeds is wrong.
        """
        rest = checked_options(options)
        mask = self._checked_mask(rest.pop("reset_mask", None))
        rows, others = np.flatnonzero(mask), np.flatnonzero(~mask)
        saved = saved_state(rest)
        if saved is None:
            starts, first = self._given_starts(rows, rest), not self._begun
            self._seed(seed, self._checked_seeds(seed), rows)
            self._envs.begin(rows, starts)
            if first and len(others):
                self._envs.begin(others, given_start(self.kernels, {"nominal": True}))
                self._remember(self.observe())
            self._over = np.setdiff1d(self._over, rows)
            self._begin_trails(rows)
            self._extend_trails(None if first else rows)
        else:
            seeds = self._checked_seeds(seed)  # if one is refused, nothing has changed
            self.set_state(self._given_state(saved, rows), rows)
            self._seed(seed, seeds, rows)
        result = self._envs.observe(rows)
        self._show_again(others, result)
        result.report[:, others], result.flags[:, others] = 0.0, False
        self._remember(result.observation)
        return result.observation, self._info(result, mask) | self._drawn(rows)

    def _show_again(self, rows: Rows, result: StepResult) -> None:
        """Put observations of sub-environments that are not reset into a result."""
        if self._seen is None:
            result.observation[rows] = self._envs.observe(rows).observation[rows]
        else:
            result.observation[rows] = self._seen[rows]

    def _remember(self, observations: Array) -> None:
        """Keep observations for resets of some sub-environments, which return the others' last ones."""
        if self._seen is not None:
            self._seen[...] = observations

    def _checked_mask(self, mask: Any) -> Mask:
        if mask is None:
            return self._all
        if not isinstance(mask, np.ndarray) or mask.shape != (self.num_envs,) or mask.dtype != np.bool_:
            raise ValueError(
                f"options: reset_mask {mask!r}, should be a bool array of shape ({self.num_envs},)"
            )
        if not mask.any():
            raise ValueError(
                "options: reset_mask is False everywhere, should be True for a sub-environment to reset"
            )
        return mask

    def _checked_seeds(self, seed: int | Sequence[int | None] | None) -> list[int | None]:
        """A seed, or None, for each sub-environment."""
        seeds: list[int | None]
        if seed is None or isinstance(seed, (int, np.integer)):
            seeds = [None if seed is None else int(seed) + i for i in range(self.num_envs)]
        elif isinstance(seed, Iterable):
            seeds = list(seed)
        else:
            raise ValueError(f"seed: {seed!r}, should be a whole number, or one for each sub-environment")
        if len(seeds) != self.num_envs:
            raise ValueError(f"seed: {len(seeds)} seeds, should be {self.num_envs}, one per sub-environment")
        for each in seeds:
            if each is not None and not (isinstance(each, int | np.integer) and each >= 0):
                raise ValueError(f"seed: {shortened(each)}, should be a whole number of at least 0, or None")
        return seeds

    def _seed(self, seed: int | Sequence[int | None] | None, seeds: Sequence[int | None], rows: Rows) -> None:
        """Seed the generators that are given a seed or have none yet."""
        if isinstance(seed, int | np.integer):
            super().reset(seed=int(seed))  # np_random, which nothing is drawn from here, and np_random_seed
        if not self._begun:
            self._envs.seed(np.arange(self.num_envs), seeds)
            self._begun = True
        elif seed is not None:
            renewed = np.array([i for i in rows if seeds[i] is not None], dtype=np.int64)
            self._envs.seed(renewed, [seeds[i] for i in renewed])

    def _given_starts(self, rows: Rows, options: dict[str, Any]) -> GivenStart:
        """Starts that the options give: the same for all, or arrays with a row for each."""
        shapes = {
            "initial_state": self._envs.x.shape,
            "target": (self.num_envs, 8),
            "parameters": self._envs.parameters.shape,
        }
        each = {name: options[name] for name in shapes if name in options and np.ndim(options[name]) == 2}
        for name, values in each.items():
            if np.shape(values) != (shape := shapes[name]):
                raise ValueError(
                    f"options: {name} of shape {np.shape(values)}, should be {shape[1:]} for all, or {shape} "
                    "with a row for each sub-environment"
                )
        if not each:
            return given_start(self.kernels, options)
        starts = [
            given_start(self.kernels, {**options, **{name: values[i] for name, values in each.items()}})
            for i in rows
        ]
        return GivenStart(
            *(None if parts[0] is None else np.array(parts) for parts in zip(*starts, strict=True))
        )

    def step(self, actions: ArrayLike) -> tuple[Any, Array, Mask, Mask, dict[str, Any]]:
        """Apply an action to every sub-environment for one time step.

        Args:
            actions: Inputs as fractions of their limits, shape (num_envs, n_u); clipped to [-1, 1].

        Returns:
            Observations, rewards, terminated, truncated (always False), info.

        Raises:
            ResetNeeded: Before the first reset, and with autoreset disabled when an episode is over.
            TypeError: If the actions are masked, or not of real numbers.
            ValueError: If the actions have a wrong shape or a NaN; nothing has moved then.
        """
        resetting = self._over
        self._require_reset("step()")
        if len(resetting) and self.autoreset_mode is AutoresetMode.DISABLED:
            raise ResetNeeded(
                f"the episodes of sub-environments {resetting.tolist()} are over: "
                "reset them with a reset_mask"
            )
        result = self._envs.step(actions, resetting)
        begun = resetting
        if len(resetting):
            self._begin_anew(resetting, result)
            self._over = _NONE
        rewards, terminated, final = result.report[0], result.flags[0], dict[str, Any]()
        if np.count_nonzero(terminated):
            (rows,) = terminated.nonzero()
            if self.autoreset_mode is AutoresetMode.SAME_STEP:
                rewards, terminated = rewards.copy(), terminated.copy()
                final = self._final(rows, result)
                self._begin_anew(rows, result)
                begun = np.union1d(resetting, rows)
            else:
                self._over = rows
        self._remember(result.observation)
        self._extend_trails()
        info = self._info(result, self._all) | final
        if len(begun):
            info |= self._drawn(begun)
        return result.observation, rewards, terminated, np.zeros(self.num_envs, dtype=np.bool_), info

    def perturb(self, increments: ArrayLike) -> None:
        """Displace the states, as a push from outside would: x becomes x (+) increment.

        Args:
            increments: Tangent coordinates in the order of `kernels.layout.tangent`, shape (num_envs, n_t),
                rad, m, rad/s, m/s; sub-environments whose row is zero stay exactly as they are. Quaternions
                of spherical joints get their unit length back.

        Raises:
            ResetNeeded: Before the first reset.
            TypeError: If the increments are masked, or not of real numbers.
            ValueError: If the increments have a wrong shape, or are not finite or beyond 5e5 in norm.
        """
        self._require_reset("perturb()")
        increments = real_array("increments", increments, np.float64)
        expected = self.num_envs, self.kernels.n_t
        if increments.shape != expected:
            raise ValueError(f"increments: shape {increments.shape}, should be {expected}")
        if not np.isfinite(increments).all():
            raise ValueError(f"increments: {shortened(increments)}, should be finite")
        with np.errstate(over="ignore"):
            largest = np.linalg.norm(increments, axis=1).max()
        if largest > STATE_LIMIT:
            raise ValueError(
                f"increments: a norm of {largest:.3g}, should be at most {STATE_LIMIT:g}, beyond which a "
                "simulation counts as diverged"
            )
        rows = np.flatnonzero(increments.any(axis=1))
        if len(rows):
            self._envs.move(rows, displaced(self.kernels, self._envs.x[rows], increments[rows]))
            if self._seen is not None:
                self._seen[rows] = self.observe()[rows]

    def observe(self, states: ArrayLike | None = None) -> Any:
        """Give observations without a step.

        Args:
            states: States in place of the present ones, for example as measured with noise, shape (num_envs,
                n_x), units as in `kernels.layout.state`.

        Returns:
            Observations, shape (num_envs, n_obs).

        Raises:
            ResetNeeded: Before the first reset.
            TypeError: If the states are masked, or not of real numbers.
            ValueError: If the states have a wrong shape.
        """
        self._require_reset("observe()")
        x = self._envs.x if states is None else real_array("states", states)
        if x.shape != self._envs.x.shape:
            raise ValueError(f"states: shape {x.shape}, should be {self._envs.x.shape}")
        return self._envs.observe_states(x)

    def get_state(self, rows: ArrayLike | None = None) -> dict[str, Array]:
        """Copy what all later steps and resets depend on.

        Args:
            rows: Numbers of sub-environments, or a mask, shape (num_envs,); None for all.

        Returns:
            Arrays by name with a row for each, see `DQSpaceArmEnv.get_state`; for `set_state`, of this
            environment or another of the same scene.

        Raises:
            ResetNeeded: Before the first reset.
            ValueError: If there is no such sub-environment.
        """
        self._require_reset("get_state()")
        chosen = self._checked_rows(rows)
        return {name: array[chosen] for name, array in self._kept().items()}

    def set_state(self, state: Mapping[str, Array], rows: ArrayLike | None = None) -> None:
        """Go on where `get_state` was called: the same actions give the same bits.

        Args:
            state: What `get_state` returned for as many sub-environments, arrays of its shapes.
            rows: Numbers of those that take it, or a mask, shape (num_envs,); None for all.

        Raises:
            ResetNeeded: For some of the sub-environments, before the first reset of all.
            ValueError: If there is no such sub-environment, or an array is missing, has another shape or
                type, or is not finite; nothing is changed then.
        """
        chosen = self._checked_rows(rows)
        if not self._begun and len(chosen) < self.num_envs:
            raise ResetNeeded("the other episodes have not begun: call reset() before set_state() of some")
        kept = self._kept()
        observes = isinstance(state, Mapping) and "seen" in kept and "seen" not in state
        if observes:  # environments that reset themselves do not keep what they have shown
            del kept["seen"]
        expected = {name: array[chosen] for name, array in kept.items()}
        found = checked_state(state, expected, self.scene.simulation.steps)
        self._begin_trails(chosen)
        for name, array in kept.items():
            array[chosen] = found[name]
        self._begun, self._over = True, np.flatnonzero(kept["over"])
        if observes and self._seen is not None:
            self._seen[chosen] = self.observe()[chosen]
        self._extend_trails(chosen)

    def _kept(self) -> dict[str, Array]:
        """Arrays that all later steps depend on; "over" is made anew."""
        kept = {**self._envs.kept(), "over": np.isin(np.arange(self.num_envs), self._over)}
        if self._payloads is not None:
            kept["adrift"] = self._payloads.adrift
        return kept if self._seen is None else {**kept, "seen": self._seen}

    def _given_state(self, state: Any, rows: Rows) -> Any:
        """The option "state" for some sub-environments; that of a single environment is the same for all."""
        if not isinstance(state, Mapping):
            return state
        if np.ndim(state.get("over", [])) == 0:
            state = {
                name: np.broadcast_to(array, (self.num_envs, *np.shape(array)))
                for name, array in state.items()
            }
        arrays = {name: np.asarray(array) for name, array in state.items()}
        return {
            name: array[rows] if array.shape[:1] == (self.num_envs,) else array
            for name, array in arrays.items()
        }

    def _checked_rows(self, rows: ArrayLike | None) -> Rows:
        everyone = np.arange(self.num_envs)
        try:
            chosen = everyone if rows is None else np.atleast_1d(everyone[np.asarray(rows)])
        except IndexError as error:
            raise ValueError(
                f"rows: {shortened(rows)}, should be numbers below {self.num_envs}, or a mask"
            ) from error
        if chosen.ndim > 1:
            raise ValueError(f"rows: {shortened(rows)}, should be a list of numbers, or a mask")
        if len(np.unique(chosen)) < len(chosen):
            raise ValueError(f"rows: {shortened(rows)} has a sub-environment twice")
        return chosen

    def _begin_anew(self, rows: Rows, result: StepResult) -> None:
        """Begin new episodes, and overwrite the old observations."""
        self._envs.begin(rows)
        self._begin_trails(rows)
        self._envs.observe(rows, result)

    def _begin_trails(self, rows: Rows) -> None:
        """Forget what was before in some episodes, which pictures show."""
        if self._trails is not None:
            self._trails.begin(rows)
        if self._payloads is not None:
            self._payloads.adrift[rows] = np.nan

    def _extend_trails(self, rows: Rows | None = None) -> None:
        """Keep what later pictures show of some episodes, or all, and where payloads are let go."""
        if self._trails is not None:
            rows = np.arange(self.num_envs) if rows is None else rows
            tips = self.kernels.tip_pose(self._envs.x[rows])
            self._trails.extend(rows, np.array(poses.position(tips.T)).T)
        if self._payloads is not None:
            self._payloads.follow(self._envs.x, self._envs.kept()["memory"])

    def render(self) -> tuple[NDArray[np.uint8], ...] | None:
        """Draw the present state of every sub-environment.

        Returns:
            A picture of shape (height, width, 3), uint8, for each; None without a render mode.

        Raises:
            ResetNeeded: Before the first reset.
        """
        if self._trails is None:
            gymnasium.logger.warn(
                "render() does nothing without a render mode, e.g. "
                'gymnasium.make_vec("DQSpaceArm-v0", render_mode="rgb_array")'
            )
            return None
        self._require_reset("render()")
        if self._renderer is None:
            from dq_space_arm_env.viewing.rendering import Renderer

            self._renderer = Renderer(self.scene, self._picture)
        frames, parameters, pictures = self.kernels.frame_poses(self._envs.x), self.stage_parameters, []
        layout = self.kernels.layout
        targets, bodies = layout.target_with(parameters), layout.target_body_with(parameters)
        payloads: list[Array | None] = [None] * self.num_envs
        if self._payloads is not None:
            payloads = self._payloads.poses(self._envs.kept()["memory"], self._envs.parameters, targets)
        for row in range(self.num_envs):
            self._renderer.aim_at(targets[row], bodies[row], payloads[row])
            pictures.append(self._renderer.draw(frames[row], self._trails.of(row)))
        return tuple(pictures)

    def _final(self, rows: Rows, result: StepResult) -> dict[str, Any]:
        """Entries of `info` on episodes that the same step ended and restarted."""
        ended = result.flags[0].copy()
        last_observations = np.full(self.num_envs, None, dtype=object)
        for i in rows:
            last_observations[i] = _row(result.observation, i)
        last = result._replace(report=np.where(ended, result.report, 0.0), flags=result.flags & ended)
        return {
            "final_obs": last_observations,
            "_final_obs": ended,
            "final_info": self._info(last, ended),
            "_final_info": ended.copy(),
        }

    def _drawn(self, rows: Rows) -> dict[str, Any]:
        """Entry of `info` on parameters of episodes that have just begun; none where nothing varies."""
        if not self.kernels.n_p:
            return {}
        mask = np.zeros(self.num_envs, dtype=np.bool_)
        mask[rows] = True
        columns = np.where(mask, self._envs.parameters.T, 0.0).astype(np.float64)
        values: dict[str, Any] = dict(zip(self.kernels.parameters.names, columns, strict=True))
        return {
            "parameters": values | {f"_{name}": mask.copy() for name in values},
            "_parameters": mask,
        }

    def _info(self, result: StepResult, mask: Mask) -> dict[str, Any]:
        """Entries of `DQSpaceArmEnv`'s info, as arrays."""
        _, success, diverged = result.flags
        whole = mask is self._all
        values: dict[str, Any] = dict(zip(self._names, result.report[1:], strict=True))
        if self.scene.constraints:
            values = grouped(values)
            if inner := values.get("constraints"):  # as Gymnasium nests dictionaries
                values["constraints"] = inner | {f"_{name}": mask.copy() for name in inner}
        return {
            **values,
            "is_success": success,
            "diverged": diverged,
            **(self._masks if whole else {key: mask.copy() for key in self._masks}),
        }


def _row(observations: Any, row: int) -> Any:
    """A copy of the observation of one sub-environment, of an array or of arrays by name."""
    if isinstance(observations, dict):
        return {name: part[row].copy() for name, part in observations.items()}
    return observations[row].copy()
