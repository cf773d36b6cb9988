"""Read demonstrations: views of mapped files, batches of time steps, splits by problem.

Files are read on access and not kept: a data set may be far larger than memory.
"""

import os
from bisect import bisect_right
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property, lru_cache
from itertools import accumulate, pairwise
from pathlib import Path
from typing import Any, Self, overload

import numpy as np
from numpy.typing import ArrayLike, NDArray
from pydantic import ValidationError

from dq_space_arm_env import DQSpaceArmEnv, Scene, compile_scene
from dq_space_arm_env.common.real_arrays import real_array
from dq_space_arm_env.kernels import Kernels
from dq_space_arm_env.scene import StateLayout
from dq_space_arm_env.scene.start import episode_scene
from dq_space_arm_env.validation import problem_list
from dq_space_arm_env.validation.problems import SceneError
from experts.demonstrations.descriptions import checked_descriptions
from experts.demonstrations.folder import SETTINGS, SHARDS
from experts.demonstrations.outcomes import GUESSES, REASONS
from experts.demonstrations.shard import (
    FAILURES,
    PARAMETERS,
    SUMMARIES,
    TRAJECTORIES,
    check_arrays,
    with_parameters,
)
from experts.demonstrations.tensors import DemonstrationsError, Tensors, map_tensors
from experts.problems.shooting_problem import FloatArray

OPEN_SHARDS = 64
"""Files mapped at a time, the least recently used one is closed."""
MIXED = 64
"""Demonstrations whose time steps are shuffled together."""


@dataclass(frozen=True, eq=False)
class Demonstration:
    """One optimal maneuver of N stages; arrays are read-only views of the file.

    Attributes:
        index: Number of its problem.
        seed: `env.reset(seed=seed)` starts at the same state, and draws the same parameters.
        cost: J; the sum of the rewards is -J.
        states: Shape (N + 1, n_x), units of the state.
        observations: Observations of the environment, shape (N + 1, n_obs).
        actions: Inputs as fractions of their limits, shape (N, n_u).
        rewards: Shape (N,).
        feedback_gains: G of a = clip(a_k + G_k (x (-) x_k)) for actions a, float32, shape (N, n_u, n_t); zero
            in the rows of inputs at a limit, but for the previous input where it limits their rate.
        parameters: What varied in the scene, shape (n_p,), entries and units as in `kernels.parameters`.
        scene: The scene of all of them, in double precision.
        facts: The other numbers about it, by the names of `shard.SUMMARIES`; guess and stop reason in words.
    """

    index: int
    seed: int
    cost: float
    states: FloatArray
    observations: FloatArray
    actions: FloatArray
    rewards: FloatArray
    feedback_gains: NDArray[np.float32]
    parameters: FloatArray
    scene: Scene
    facts: Mapping[str, Any]

    def __repr__(self) -> str:
        episode = f"seed {self.seed}, J = {self.cost:.6g}, {len(self.actions)} steps"
        return f"<Demonstration {self.index} in {self.scene.name!r}: {episode}>"

    @property
    def episode_scene(self) -> Scene:
        """The scene with everything drawn as plain numbers, as `env.unwrapped.episode_scene` has it.

        Raises:
            DemonstrationsError: If no scene may have these parameters, for example a negative mass.
        """
        try:
            return episode_scene(self.scene, self.parameters.tolist())
        except SceneError as error:
            raise DemonstrationsError(f"demonstration {self.index} is damaged: {error}") from error

    def constraint_costs(self) -> FloatArray:
        """Replay the episode from its first state for `info["cost"]`: violations, each over its tolerance.

        Returns:
            At the start and after each action, dimensionless, shape (N + 1,); zeros without constraints.
        """
        environment = DQSpaceArmEnv(self.scene)
        varied = {"parameters": self.parameters} if len(self.parameters) else {}
        infos = [environment.reset(options={"initial_state": self.states[0], **varied})[1]]
        infos += [environment.step(action)[-1] for action in self.actions]
        return np.array([info.get("cost", 0.0) for info in infos])


@dataclass(frozen=True, eq=False)
class Batch:
    """Time steps of several demonstrations, B of them.

    Attributes:
        demonstration: Position of each one's demonstration in the data set, shape (B,).
        stage: Stage of each, in [0, N), shape (B,).
        arrays: The requested arrays by name, each of shape (B, ...).
    """

    demonstration: NDArray[np.int64]
    stage: NDArray[np.int64]
    arrays: Mapping[str, NDArray[Any]]


class _Files:
    """The shards of a folder, some of them mapped."""

    def __init__(self, folder: Path, shards: Sequence[Mapping[str, Any]], scene: Scene) -> None:
        self._made_of = folder, shards, scene
        self.scene, self.layout = scene, StateLayout.of(scene)
        self._sizes = [int(shard["demonstrations"]) for shard in shards]
        self.paths = [folder / SHARDS / shard["file"] for shard in shards]
        self.ends = list(accumulate(self._sizes))
        self.mapped = lru_cache(maxsize=OPEN_SHARDS)(self._map)
        self.stages = lru_cache(maxsize=2 * MIXED)(self._stages)  # of one group and the rest of the last

    @cached_property
    def kernels(self) -> Kernels:
        return compile_scene(self.scene)

    def __reduce__(self) -> tuple[Any, ...]:
        """Pickle what they are made of: another process maps the files itself."""
        return type(self), self._made_of

    def _map(self, shard: int) -> Tensors:
        tensors, path = map_tensors(self.paths[shard]), self.paths[shard]
        check_arrays(path, tensors.arrays, self.scene, self.layout)
        if len(tensors.arrays["index"]) != self._sizes[shard]:
            raise DemonstrationsError(
                f"{path} holds {len(tensors.arrays['index'])} demonstrations, its manifest says "
                f"{self._sizes[shard]}; generate it again"
            )
        return tensors

    def locate(self, place: int) -> tuple[Tensors, int]:
        """Return the shard of a demonstration, and its row there."""
        shard = bisect_right(self.ends, place)
        return self.mapped(shard), place - (self.ends[shard - 1] if shard else 0)

    def _stages(self, place: int) -> FloatArray:
        tensors, row = self.locate(place)
        return self.kernels.stage_parameters(tensors.arrays[PARAMETERS][row])

    def column(self, name: str) -> NDArray[Any]:
        """Return an array of all shards, concatenated in memory."""
        # Bypasses the cache: one pass over all shards would evict those in use.
        return np.concatenate([self._map(shard).arrays[name] for shard in range(len(self.paths))])


class Demonstrations(Sequence[Demonstration]):
    """The demonstrations of a folder, or some of them; a copy or pickle opens the files anew.

    Attributes:
        path: The folder.
        settings: Content of `settings.json`, all that they follow from.
        manifest: Content of `manifest.json`, the outcome of every problem.
        scene: The scene, in double precision.
    """

    def __init__(
        self,
        path: Path,
        settings: Mapping[str, Any],
        manifest: Mapping[str, Any],
        *,
        selection: tuple[_Files, NDArray[np.int64]] | None = None,
    ) -> None:
        """Wrap a folder's descriptions; `load_demonstrations` reads and checks them.

        Args:
            path: The folder.
            settings: Content of its `settings.json`.
            manifest: Content of its `manifest.json`.
            selection: The files, and positions of the demonstrations in the folder; None for all.
        """
        self.path, self.settings, self.manifest = path, settings, manifest
        self.scene = Scene.model_validate(settings["scene"])
        if selection is None:
            files = _Files(path, manifest["shards"], self.scene)
            selection = files, np.arange(manifest["demonstrations"], dtype=np.int64)
        self._files, self._places = selection

    def __repr__(self) -> str:
        return f"<{len(self)} Demonstrations in {self.scene.name!r}, {str(self.path)!r}>"

    @property
    def kernels(self) -> Kernels:
        """Compiled functions of the scene: layout of states, difference, retraction, observation."""
        return self._files.kernels

    def __len__(self) -> int:
        return len(self._places)

    @overload
    def __getitem__(self, position: int) -> Demonstration: ...

    @overload
    def __getitem__(self, position: slice) -> Self: ...

    def __getitem__(self, position: int | slice) -> Demonstration | Self:
        if isinstance(position, slice):
            return self.select(np.arange(len(self))[position])
        (arrays, _), row = self._files.locate(int(self._places[position]))
        facts: dict[str, Any] = {name: arrays[name][row].tolist() for name in SUMMARIES}
        facts["stop_reason"], facts["guess"] = REASONS[facts["stop_reason"]], GUESSES[facts["guess"]]
        named = {name: facts.pop(name) for name in ("index", "seed", "cost")}
        named |= {name: arrays[name][row] for name in TRAJECTORIES}
        varied = arrays[PARAMETERS][row] if self._files.layout.n_p else np.zeros(0)
        return Demonstration(**named, parameters=varied, scene=self.scene, facts=facts)

    def select(self, positions: ArrayLike) -> Self:
        """Select demonstrations.

        Args:
            positions: Their positions in this sequence, shape (M,); or a mask of all, shape (len(self),).

        Returns:
            The selection, in this order.

        Raises:
            IndexError: If there is no such position.
            ValueError: If a mask or the positions have another shape.
            TypeError: If they are neither whole numbers nor a mask.
        """
        given = np.asarray(positions)
        if given.dtype == np.bool_:
            if given.shape != (len(self),):
                raise ValueError(f"positions is a mask of shape {given.shape}; expected ({len(self)},)")
            given = np.flatnonzero(given)
        elif given.size and not np.issubdtype(given.dtype, np.integer):
            raise TypeError(f"positions are of type {given.dtype}; expected whole numbers, or a mask")
        if given.ndim != 1:
            raise ValueError(f"positions have shape {given.shape}; expected (M,)")
        chosen = self._places[given.astype(np.int64)]
        return type(self)(self.path, self.settings, self.manifest, selection=(self._files, chosen))

    def column(self, name: str) -> NDArray[Any]:
        """Read one number about every demonstration into memory.

        Args:
            name: One of `shard.SUMMARIES`, for example "cost" or "seed"; "parameters" if the scene has any.

        Returns:
            Shape (len(self),), or (len(self), 2) for the tip's errors, (len(self), n_p) for parameters.

        Raises:
            ValueError: If there is no such column.
        """
        _check_names((name,), with_parameters(SUMMARIES, self._files.layout))
        return self._files.column(name)[self._places]

    def failures(self) -> dict[str, NDArray[Any]]:
        """Read about the folder's problems without a demonstration, F of them.

        Returns:
            `index`, `seed`, `cost` and, in words, `reason`, each of shape (F,); `start`, states at stage 0,
            shape (F, n_x); `final_errors` of the tip, attitude [deg] and position [m], shape (F, 2); and
            `parameters` if the scene has any, shape (F, n_p).
        """
        names = with_parameters(FAILURES, self._files.layout)
        columns = {name: self._files.column(f"failures.{name}") for name in names}
        reasons = columns.pop("stop_reason")
        return {**columns, "reason": np.array(REASONS)[reasons]}

    def split(self, *fractions: float, seed: int = 0) -> tuple[Self, ...]:
        """Split by problem: no two parts share a demonstration, or time steps of one.

        Args:
            *fractions: Share of each part; together at most 1.
            seed: Seed of the shuffle.

        Returns:
            The parts, each in the order of the problems.

        Raises:
            TypeError: If a fraction is no number.
            ValueError: If a fraction is negative or NaN, or they exceed 1 together.
        """
        ends = np.cumsum(real_array("fractions", fractions, np.float64))
        if not fractions or not all(each >= 0.0 for each in fractions) or ends[-1] > 1.0 + 1e-9:
            raise ValueError(f"fractions: {fractions}, should be positive and at most 1 together")
        shuffled = np.random.default_rng(seed).permutation(len(self))
        bounds = [0, *np.rint(ends * len(self)).astype(np.int64).tolist()]
        return tuple(self.select(np.sort(shuffled[a:b])) for a, b in pairwise(bounds))

    def batches(
        self,
        size: int,
        names: Sequence[str] = ("observations", "actions"),
        *,
        seed: int | None = None,
        drop_last: bool = False,
    ) -> Iterator[Batch]:
        """Iterate over all time steps once.

        With a seed they are shuffled: demonstrations in a random order, and the time steps of some dozens of
        them mixed, so that memory holds no more than those.

        Args:
            size: Time steps of a batch.
            names: Arrays to read, of `shard.TRAJECTORIES`; states and observations without the last, at which
                no action is taken. Also "parameters" if the scene has any, those of the stage.
            seed: Seed of the order; None for the order of problems and stages.
            drop_last: Whether to omit a smaller last batch.

        Yields:
            Batches, copies in memory.

        Raises:
            ValueError: If the size is no whole number or not positive, or a name is unknown.
        """
        if not isinstance(size, int | np.integer) or size < 1:
            raise ValueError(f"size: {size!r}, should be a whole number of at least 1")
        _check_names(names, with_parameters(TRAJECTORIES, self._files.layout))
        return self._batches(size, tuple(names), seed, drop_last)

    def _batches(
        self, size: int, names: tuple[str, ...], seed: int | None, drop_last: bool
    ) -> Iterator[Batch]:
        rng = None if seed is None else np.random.default_rng(seed)
        order = np.arange(len(self)) if rng is None else rng.permutation(len(self))
        horizon, rest = self.scene.simulation.steps, np.zeros((0, 2), dtype=np.int64)
        for begin in range(0, len(order), MIXED):
            group = order[begin : begin + MIXED]
            steps = np.stack([np.repeat(group, horizon), np.tile(np.arange(horizon), len(group))], axis=1)
            steps = np.concatenate([rest, steps if rng is None else rng.permutation(steps)])
            whole = len(steps) - len(steps) % size
            for first in range(0, whole, size):
                yield self._gather(steps[first : first + size], names)
            rest = steps[whole:]
        if len(rest) and not drop_last:
            yield self._gather(rest, names)

    def _gather(self, steps: NDArray[np.int64], names: tuple[str, ...]) -> Batch:
        """Copy time steps, pairs of demonstration and stage, out of the files."""
        positions, stages = steps[:, 0].copy(), steps[:, 1].copy()
        arrays: dict[str, NDArray[Any]] = {}
        entries = self._files.layout.parameters
        order = np.argsort(positions, kind="stable")
        for mine in np.split(order, np.flatnonzero(np.diff(positions[order])) + 1):
            place = int(self._places[positions[mine[0]]])
            tensors, row = self._files.locate(place)
            for name in names:
                source = tensors.arrays[name][row]
                if name != PARAMETERS:
                    rows = source[stages[mine]]
                elif entries.moving or entries.staged:
                    rows = self._files.stages(place)[stages[mine]]
                else:
                    rows = source[None]
                if name not in arrays:
                    arrays[name] = np.empty((len(steps), *rows.shape[1:]), rows.dtype)
                arrays[name][mine] = rows
        return Batch(positions, stages, arrays)

    def tangent(self, reference: ArrayLike, states: ArrayLike) -> FloatArray:
        """Compute deviations from reference states in tangent coordinates, for the feedback gains.

        Args:
            reference: States of a demonstration, shape (..., n_x), units of the state.
            states: States to compare with them, shape (..., n_x); the two are broadcast.

        Returns:
            x (-) x_reference, shape (..., n_t), units of `kernels.layout.tangent`. The optimal action there
            is, to first order, clip(action + feedback_gains @ deviation, -1, 1).

        Raises:
            ValueError: If the shapes do not fit.
        """
        first, second = np.broadcast_arrays(np.asarray(reference), np.asarray(states))
        n_x = first.shape[-1] if first.ndim else 0
        if n_x != self.kernels.n_x:
            raise ValueError(f"states have shape {first.shape}; expected (..., {self.kernels.n_x})")
        rows = self.kernels.difference(first.reshape(-1, n_x), second.reshape(-1, n_x))
        return np.asarray(rows.reshape(*first.shape[:-1], -1))


def load_demonstrations(path: str | os.PathLike[str], *, verify: bool = False) -> Demonstrations:
    """Open a folder that `generate_demonstrations` completed.

    With `verify`, every byte of settings, manifest and shards is checked: the manifest has the hashes of the
    other files, and follows from them, so it is made again and compared. Card, log and summary, from which
    nothing is learned, are not. This finds damage and careless changes. Whoever rewrites the whole folder can
    write a manifest that fits: to recognize a data set, compare the hash of its `manifest.json`, which stands
    for all of it, with one that you keep elsewhere.

    Args:
        path: The folder.
        verify: Whether to compare the hash of every file with the manifest, rather than its size.

    Returns:
        The demonstrations; their files are mapped on access.

    Raises:
        DemonstrationsError: If there is no such folder, it is not complete, or a file is damaged.
    """
    folder = Path(path).absolute()  # files are read on access, wherever the process works by then
    settings, manifest = checked_descriptions(folder, verify)
    try:
        return Demonstrations(folder, settings, manifest)
    except ValidationError as error:
        raise DemonstrationsError(problem_list(f"{folder / SETTINGS}: scene", error)) from error


def _check_names(names: Sequence[str], known: Sequence[str]) -> None:
    unknown = [name for name in names if name not in known]
    if unknown:
        raise ValueError(f"{', '.join(unknown)}: unknown; choose from {', '.join(known)}")
