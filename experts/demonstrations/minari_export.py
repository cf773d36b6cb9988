"""Export demonstrations to Minari, the format in which offline reinforcement learning shares episodes.

An episode holds observations, actions, rewards and terminations. Its `infos` have a row for each observation:
errors of the tip as in the environment's `info`, the state, and the feedback gain, which is zero at the end,
where no action is taken; where something varies in the scene, the parameters as well, those of the row's
stage; where a scene has constraints or phases, the environment's `cost` and `phase`.
Its metadata hold the seed for `env.reset(seed=seed)`, the cost, and other numbers.
`recover_environment()` makes the environment with the complete scene, wherever that came from.

Actions are float64, and so is the data set's action space, although the environment's own is float32: it
reads float64 at full precision, which reproduces an episode's rewards bit for bit.

The data set is written under a hidden name, a few episodes at a time, and renamed, so that nobody sees a
partial one. A process of its own writes it, for HDF5 ends a process that finds the disk full.
"""

import os
import re
import shutil
import warnings
from collections.abc import Callable, Iterator
from contextlib import closing, contextmanager
from pathlib import Path, PurePosixPath
from typing import Any

import gymnasium
import numpy as np

import dq_space_arm_env
from dq_space_arm_env.common.worker_process import WorkerLostError, WorkerProcess
from dq_space_arm_env.scene import Scene
from dq_space_arm_env.scene.entries import ParameterEntries
from experts.demonstrations.folder import CARD
from experts.demonstrations.reading import Demonstration, Demonstrations
from experts.demonstrations.shard import PARAMETERS, tip_errors
from experts.demonstrations.staging import staged
from experts.demonstrations.tensors import DemonstrationsError
from experts.problems.arm_problem import misses

ALGORITHM = "Control-limited differential dynamic programming (box-DDP)"
PIECE = 16
"""Episodes written at a time: some ten megabytes."""
PADDING, MARGIN = 1.3, 2**25
"""Overhead of HDF5 on the size of the arrays: a factor, and bytes."""
MINARI_MISSING = 'this needs Minari: pip install "dq-space-arm[minari]" ({} is missing)'
# Minari knows no namespace of one character.
_ID = re.compile(r"(?![-\w]/[^/]*$)([-\w]+/)*[-\w]+-v\d+")
_PARTS = ("data", CARD, "namespace_metadata.json")
_FOLDER_VARIABLE = "MINARI_DATASETS_PATH"
_DESCRIPTION = """\
{count} optimal maneuvers of scene {name!r} in DQSpaceArm-v0, from random starts: converged, successful, \
and replayed in the environment. The environment reset with an episode's seed, and given its actions \
(float64), repeats its rewards. infos has a row for each observation: attitude_error [deg] and \
position_error [m] of the tip, is_success, state{reported}{parameters}{gains}."""
_PARAMETERS = ", parameters of the stage ({})"
_COST = ", cost (violations of constraints, each over its tolerance)"
_PHASE = ", phase ({})"
_GAINS = """, and feedback_gains G of the optimal policy clip(action + G @ deviation, -1, 1), where the \
deviation from the state is env.unwrapped.kernels.difference(state, other_state); zero in rows of inputs \
at a limit"""


def export_to_minari(
    demonstrations: Demonstrations,
    dataset_id: str,
    *,
    feedback_gains: bool = True,
    author: str | None = None,
    author_email: str | None = None,
    code_permalink: str | None = None,
    card: str | None = None,
    overwrite: bool = False,
    progress: Callable[[int], None] | None = None,
) -> Any:
    """Write demonstrations as a data set of Minari (HDF5), in `MINARI_DATASETS_PATH` or ~/.minari/datasets.

    Args:
        demonstrations: Demonstrations to export.
        dataset_id: Name with a version, for example "space-arm/paper/expert-v0".
        feedback_gains: Whether to include the gains, two thirds of the size.
        author: Author of the data.
        author_email: Address of the author.
        code_permalink: Address of the code that made the data.
        card: Text of a README.md beside the data.
        overwrite: Whether to replace a data set of this name, once the new one is complete.
        progress: Called with the number of episodes written.

    Returns:
        The `minari.MinariDataset`.

    Raises:
        DemonstrationsError: If Minari is not installed, there are no demonstrations, a data set of this name
            exists, another process is writing it, or the disk is full. Nothing is changed then.
        ValueError: If the name does not follow Minari's pattern.
    """
    try:
        # Minari imports these two only after it has begun to write.
        import h5py  # noqa: F401
        import minari
        import PIL  # noqa: F401
    except ModuleNotFoundError as error:
        raise DemonstrationsError(MINARI_MISSING.format(error.name)) from error
    check_dataset_id(dataset_id)
    if not len(demonstrations):
        raise DemonstrationsError(f"{demonstrations.path} has no demonstration to export")
    origin = {"author": author, "author_email": author_email, "code_permalink": code_permalink}
    count, scene = len(demonstrations), demonstrations.scene.name
    described = _DESCRIPTION.format(
        count=count,
        name=scene,
        reported=_reported(demonstrations.scene),
        parameters=_named(demonstrations.kernels.parameters),
        gains=_GAINS if feedback_gains else "",
    )
    try:
        with _staging(dataset_id, overwrite) as folder, closing(WorkerProcess(quiet=True)) as worker:
            worker.assign(_create, folder, dataset_id, demonstrations.settings, described, origin)
            worker.answer()
            for done in _added(worker, folder / dataset_id, demonstrations, feedback_gains):
                if progress is not None:
                    progress(done)
            if card is not None:
                (folder / dataset_id / CARD).write_text(card, encoding="utf-8")
    except (OSError, WorkerLostError) as error:
        lost = isinstance(error, WorkerLostError)
        reason = "HDF5 ended the process that wrote it" if lost else getattr(error, "strerror", "") or error
        raise DemonstrationsError(
            f"the data set cannot be written: {reason}; nothing of it remains"
        ) from error
    return minari.load_dataset(dataset_id)


def _named(found: ParameterEntries) -> str:
    """Names and units of the parameters for the description; nothing where there are none."""
    names = (f"{name} [{unit}]" for name, unit in zip(found.names, found.units, strict=True))
    return _PARAMETERS.format(", ".join(names)) if found.names else ""


def _reported(scene: Scene) -> str:
    """What constraints and phases add to the description."""
    phases = ", ".join(f"{number}: {phase.name}" for number, phase in enumerate(scene.phases))
    return (_COST if scene.constraints else "") + (_PHASE.format(phases) if phases else "")


def check_dataset_id(dataset_id: str) -> None:
    """Raise ValueError if a name is not one of Minari's: it becomes a path."""
    if not _ID.fullmatch(dataset_id):
        raise ValueError(
            f"dataset_id: {dataset_id!r}, should be a name with a version, such as "
            "space-arm/paper/expert-v0, in a namespace of two characters or more if any"
        )


@contextmanager
def _staging(dataset_id: str, overwrite: bool) -> Iterator[Path]:
    """Yield a folder for Minari to work in, and move the data set into place at the end."""
    from minari.namespace import create_namespace, list_local_namespaces
    from minari.storage import get_dataset_path

    for above in PurePosixPath(dataset_id).parents:
        if above.name and (get_dataset_path(str(above)) / "data" / "metadata.json").exists():
            raise DemonstrationsError(
                f"dataset_id: {dataset_id!r} is in the data set {above}, with which it would be deleted; "
                "choose another namespace"
            )
    place = get_dataset_path(dataset_id)
    staging = get_dataset_path() / f".{dataset_id.replace('/', '.')}.part"  # no other name has a dot
    if place.is_symlink():
        place = place.resolve()  # else the link would be replaced, and what it leads to would stay
        staging = place.with_name(f".{place.name}.part")
    name = f"the Minari data set {dataset_id}"
    # A folder without data is a namespace that holds other data sets.
    with staged(place, staging, marker="data", overwrite=overwrite, name=name, parts=_PARTS) as made:
        yield staging
        namespace = dataset_id.rpartition("/")[0]
        if namespace and namespace not in list_local_namespaces():
            create_namespace(namespace)
        (staging / dataset_id).rename(made)


def _create(
    folder: Path, dataset_id: str, settings: dict[str, Any], description: str, origin: dict[str, str | None]
) -> None:
    """Create an empty data set in a folder; the worker does."""
    import minari

    os.environ[_FOLDER_VARIABLE] = str(folder)
    # By its content: a scene's name may mean something else elsewhere, or nothing.
    environment = gymnasium.make("DQSpaceArm-v0", scene=settings["scene"])
    with warnings.catch_warnings():
        # Minari recommends all of them; they are up to the user.
        warnings.filterwarnings("ignore", f"`({'|'.join(origin)})` is set to None", UserWarning)
        dataset = minari.create_dataset_from_buffers(
            dataset_id,
            [],
            env=environment,
            eval_env=environment,
            action_space=gymnasium.spaces.Box(-1.0, 1.0, environment.action_space.shape, np.float64),
            algorithm_name=ALGORITHM,
            description=description,
            requirements=[f"dq-space-arm>={dq_space_arm_env.__version__}"],
            data_format="hdf5",
            **origin,
        )
    # The scene is in the environment's specification.
    dataset.storage.update_metadata({"demonstrations": {k: v for k, v in settings.items() if k != "scene"}})
    environment.close()


def _added(
    worker: WorkerProcess, folder: Path, demonstrations: Demonstrations, feedback_gains: bool
) -> Iterator[int]:
    """Write all episodes, a few at a time, and yield how many there are."""
    for begin in range(0, len(demonstrations), PIECE):
        piece = list(demonstrations[begin : begin + PIECE])
        episodes = [_episode(demonstrations, demonstration, feedback_gains) for demonstration in piece]
        # First for all of them, later in case others write to the disk too.
        remaining = len(demonstrations) if begin == 0 else len(piece)
        _check_space(folder, remaining * _size(episodes[0]))
        worker.assign(_add, folder, begin, episodes, [_metadata(demonstration) for demonstration in piece])
        worker.answer()
        yield begin + len(piece)


def _add(folder: Path, begin: int, episodes: list[Any], metadata: list[dict[str, Any]]) -> None:
    """Add episodes to a data set, the first at a position; the worker does."""
    import minari

    dataset = minari.MinariDataset(folder / "data")
    dataset.update_dataset_from_buffer(episodes)
    dataset.storage.update_episode_metadata(metadata, range(begin, begin + len(episodes)))


def _episode(demonstrations: Demonstrations, demonstration: Demonstration, feedback_gains: bool) -> Any:
    from minari.data_collector import EpisodeBuffer

    stages = len(demonstration.rewards)
    terminations = np.zeros(stages, dtype=np.bool_)
    terminations[-1] = True
    return EpisodeBuffer(
        seed=demonstration.seed,
        observations=demonstration.observations,
        actions=demonstration.actions,
        rewards=demonstration.rewards,
        terminations=terminations,
        truncations=np.zeros(stages, dtype=np.bool_),
        infos=_infos(demonstrations, demonstration, feedback_gains),
    )


def _size(episode: Any) -> int:
    """Size of an episode's arrays, bytes."""
    arrays = (episode.observations, episode.actions, episode.rewards, *episode.infos.values())
    return sum(int(array.nbytes) for array in arrays)


def _check_space(folder: Path, size: int) -> None:
    """Fail early where space is short: on a full disk the HDF5 library aborts the process."""
    needed, free = PADDING * size + MARGIN, shutil.disk_usage(folder).free
    if free < needed:
        raise OSError(f"the disk has {free / 1e6:,.0f} MB left, but {needed / 1e6:,.0f} MB are needed")


def _infos(
    demonstrations: Demonstrations, demonstration: Demonstration, feedback_gains: bool
) -> dict[str, Any]:
    """Return arrays with N + 1 rows."""
    states, kernels = demonstration.states, demonstrations.kernels
    parameters = kernels.stage_parameters(demonstration.parameters)
    attitude, position = tip_errors(kernels, states, parameters).T
    infos = {
        "state": states,
        "attitude_error": attitude,
        "position_error": position,
        "is_success": misses(kernels, states, parameters) <= 1.0,
    }
    if kernels.scene.constraints:
        infos["cost"] = demonstration.constraint_costs()  # as `reset` and `step` report it
    if kernels.scene.phases:
        infos["phase"] = parameters[:, kernels.parameters.names.index("phase")]
    if parameters.size:
        infos[PARAMETERS] = parameters
    if feedback_gains:
        gains = demonstration.feedback_gains
        infos["feedback_gains"] = np.concatenate([gains, np.zeros_like(gains[:1])])
    return infos


def _metadata(demonstration: Demonstration) -> dict[str, Any]:
    """Return the numbers that Minari's own collector writes, and ours."""
    rewards, facts = demonstration.rewards, demonstration.facts
    errors = {
        f"{when}_{what}_error": value
        for when in ("start", "final")
        for what, value in zip(("attitude", "position"), facts[f"{when}_errors"], strict=True)
    }
    return {
        "rewards_sum": float(rewards.sum()),
        "rewards_mean": float(rewards.mean()),
        "rewards_std": float(rewards.std()),
        "rewards_max": float(rewards.max()),
        "rewards_min": float(rewards.min()),
        "problem": demonstration.index,
        "cost": demonstration.cost,
        "iterations": facts["iterations"],
        "guess": facts["guess"],
        "clamped_share": facts["clamped_share"],
        **errors,
    }
