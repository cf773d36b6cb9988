"""Find and load any agent: by name in the zoo, by path, as a model of Stable-Baselines3, or as a function."""

from __future__ import annotations

import os
from collections.abc import Callable, Iterable, Mapping
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from agents.policies import ExportedPolicy
from agents.policies.chunking import ChunkingPolicy, load_exported
from agents.policies.flying import Policy
from agents.run_folder import CONFIGURATION, POLICY
from agents.zoo.model_archive import (
    ModelArchiveError,
    NeedsCodeError,
    environment_scale,
    read_attributes,
    read_model,
    sees_normalized,
)
from agents.zoo.normalization import ObservationStatistics, StatisticsError, read_statistics, statistics_of
from agents.zoo.onnx_model import OnnxModel, OnnxModelError
from agents.zoo.shelf import ZooError, policy_file
from dq_space_arm_env import DQSpaceArmVectorEnv, Scene
from dq_space_arm_env.environment.goal_rewards import show_goals
from dq_space_arm_env.environment.rollouts import StateFeedback
from dq_space_arm_env.scene import StateLayout, list_scenes
from dq_space_arm_env.task.step_report import n_observations


class PolicyError(ValueError):
    """Not a policy that can act."""


class ActingPolicy(NamedTuple):
    """A policy ready to fly."""

    label: str  # its name in tables
    act: Policy | StateFeedback  # batches -> actions, for `rollout`
    # For timing single actions: takes an observation without a batch if it can, else `act`.
    act_once: Policy | StateFeedback
    batched: bool  # whether `act_once` wants a batch nevertheless
    metadata: Mapping[str, Any]  # JSON values; empty if unknown
    sizes: tuple[int, int] | None = None  # entries of observations and actions, if known


def as_policy(
    policy: Any, label: str | None = None, *, trust: bool = False, normalize: str | Path | None = None
) -> ActingPolicy:
    """Make a policy ready to fly, whatever it is.

    A model's file (.zip) may hold code. None is run unless you trust the file: built-in policies of
    Stable-Baselines3 and those of this package are read by their tensors.

    Args:
        policy: Name in the zoo; path of an exported policy (.npz), of a network (.onnx), of a model of
            Stable-Baselines3 (.zip), or of a run folder; an `ExportedPolicy`; a model; or a function from
            observations, shape (B, n_obs), to actions, shape (B, n_u).
        label: Its name in tables; the file or class by default.
        trust: Whether to execute the code in a model's file where its tensors do not suffice.
        normalize: File of the `VecNormalize` that a model was trained in, as its `save` writes it, if the
            model is a file (.zip) or was loaded without it; nothing in it is executed.

    Returns:
        The policy.

    Raises:
        PolicyError: If it is none of these, or cannot be read, or normalization is missing or of no use.
        PolicyFileError: If an exported policy cannot be read.
        ImportError: If a model is given and the extra `agents`, or `onnx`, is not installed.
    """
    if isinstance(policy, ActingPolicy):
        if normalize is not None:
            raise PolicyError("normalize: the policy is ready to fly: give it where that is made")
        return policy if label is None else policy._replace(label=label)
    if isinstance(policy, str | Path):
        path, name = policy_path(policy), label or _label(policy)
        if normalize is None:
            return as_policy(read_policy(path, trust=trust), name)
        return _as_normalized(path, name, trust, Path(normalize))
    if isinstance(policy, ExportedPolicy | ChunkingPolicy):
        if normalize is not None:
            raise PolicyError("normalize: the policy already holds its normalization")
        name = label or str(policy.metadata.get("agent", "exported policy"))
        sizes = policy.n_observation, policy.n_action
        if isinstance(policy, ExportedPolicy) and sees_goals(policy):
            act = _on_goals(policy, joined=True)
            return ActingPolicy(name, act, act, True, policy.metadata, sizes)
        return ActingPolicy(name, policy, policy, False, policy.metadata, sizes)
    if callable(getattr(policy, "predict", None)):
        predict = _predictor(policy, _statistics(policy, normalize))
        return ActingPolicy(label or type(policy).__name__, predict, predict, True, {}, _sizes(policy))
    if normalize is not None:
        raise PolicyError("normalize: is for models of Stable-Baselines3")
    if isinstance(policy, OnnxModel):
        return ActingPolicy(label or "ONNX model", policy, policy, True, {}, policy.sizes)
    if callable(policy):
        name = label or str(getattr(policy, "__name__", type(policy).__name__))
        return ActingPolicy(name, policy, policy, True, {})
    raise PolicyError(
        f"policy: {policy!r}, should be a path, an ExportedPolicy, a model of Stable-Baselines3, or a "
        "function of observations"
    )


def _as_normalized(path: Path, label: str, trust: bool, file: Path) -> ActingPolicy:
    """Make a model's file ready to fly, with the statistics of its observations."""
    if path.suffix != ".zip":
        raise PolicyError(f"normalize: {path} is no model of Stable-Baselines3 (.zip), which alone needs it")
    try:
        statistics = read_statistics(file)
        loaded = read_policy(path, trust=trust, normalized=True)
        if statistics is not None and not sees_normalized(read_attributes(path)):
            raise PolicyError(f"normalize: {path} was trained on plain observations, and flies without")
        if isinstance(loaded, ExportedPolicy):
            return as_policy(loaded if statistics is None else statistics.of(loaded), label)
    except StatisticsError as error:
        raise PolicyError(f"normalize: {error}") from error
    predict = _predictor(loaded, statistics)
    return ActingPolicy(label, predict, predict, True, {}, _sizes(loaded))


def _sizes(model: Any) -> tuple[int, int] | None:
    """Entries of a model's observations and actions; None where they have names, or it does not tell."""
    spaces = (getattr(model, name, None) for name in ("observation_space", "action_space"))
    shapes: list[Any] = [getattr(space, "shape", None) for space in spaces]
    if any(shape is None or len(shape) != 1 for shape in shapes):
        return None
    return shapes[0][0], shapes[1][0]


def _statistics(model: Any, file: str | Path | None) -> ObservationStatistics | None:
    """Statistics of the observations of a model in memory."""
    try:
        return statistics_of(model, file)
    except StatisticsError as error:
        raise PolicyError(f"policy: {error}") from error


def policy_path(policy: str | Path) -> Path:
    """Resolve a name in the zoo, a run folder or a path to a file."""
    path = Path(policy)
    if path.is_dir():
        return path / POLICY
    if isinstance(policy, str) and not path.suffix and len(path.parts) == 1:
        try:
            return policy_file(policy)
        except ZooError as error:
            raise PolicyError(str(error)) from error
    return path


def check_fit(policy: ActingPolicy, scene: Scene) -> None:
    """Refuse a policy whose observations or actions are not those of the scene."""
    kind = policy.metadata.get("observation", "plain")
    if kind == "residual":
        raise PolicyError(
            f"{policy.label} corrects a plan and cannot fly alone: use `dq-space-arm compare residual`"
        )
    if kind not in ("plain", "goal"):
        raise PolicyError(f"{policy.label} needs {kind!r} observations, which no environment has")
    if policy.sizes is None:
        return
    layout = StateLayout.of(scene)  # nothing compiles for a policy that is refused
    seen = n_observations(scene)
    if kind == "goal":  # beside two poses
        seen = layout.goal_observation(layout.initial_state, layout.parameters.nominal).size + 16
    if policy.sizes != (seen, layout.n_u):
        origin = policy.metadata.get("scene")
        made = f" (it was trained for scene {origin!r})" if origin else ""
        stacked, rest = divmod(policy.sizes[0], seen)
        remedy = "evaluate it on its own scene"
        if stacked > 1 and not rest and policy.sizes[1] == layout.n_u:
            remedy += (
                f"; if it sees the last {stacked} observations, as of VecFrameStack, fly it by a function"
            )
        raise PolicyError(
            f"{policy.label} maps {policy.sizes[0]} observations to {policy.sizes[1]} inputs{made}; scene "
            f"{scene.name!r} has {seen} and {layout.n_u}: {remedy}"
        )


def scene_of(policies: Iterable[ActingPolicy]) -> str:
    """The scene that policies were trained in, a name or file; "paper" if they differ or none is known.

    Raises PolicyError for a file that is not there.
    """
    scenes = set()
    for policy in policies:
        configuration = policy.metadata.get("configuration")
        settings = configuration if isinstance(configuration, Mapping) else {}
        scenes.add(str(settings.get("scene") or policy.metadata.get("scene", "paper")))
    scene = scenes.pop() if len(scenes) == 1 else "paper"
    if scene not in list_scenes() and not os.path.isfile(scene):  # noqa: PTH113 - False for any text
        raise PolicyError(f"the policy was trained in {scene}, which is not here: give scene (--scene)")
    return scene


def sees_goals(policy: ExportedPolicy) -> bool:
    """Whether a policy takes the observations of the goal environment."""
    return bool(policy.metadata.get("observation") == "goal")


def _label(policy: str | Path) -> str:
    path = Path(policy)
    if path.name == POLICY:
        path = path.parent
    return path.name if path.suffix != ".npz" else "/".join(path.parts[-2:])


def _predictor(model: Any, statistics: ObservationStatistics | None) -> Policy | StateFeedback:
    """Deterministic actions of a model of Stable-Baselines3, in units of the environment's."""
    space: Any = getattr(model, "action_space", None)
    factors = None
    if hasattr(space, "environment_scale"):
        try:
            factors = environment_scale(space, space.shape[0]).astype(np.float32)
        except NeedsCodeError as error:
            raise PolicyError(f"policy: {error}") from error

    memory: dict[str, Any] = {}  # of a recurrent network; others have none

    def forget(environment: DQSpaceArmVectorEnv) -> None:
        memory.clear()

    def act(observations: Any) -> NDArray[Any]:
        if statistics is not None:
            observations = statistics.normalize(observations)
        chosen, state = model.predict(observations, deterministic=True, **memory)
        if state is not None:
            memory["state"] = state
        actions = np.asarray(chosen)
        return actions if factors is None else actions * factors

    if hasattr(getattr(model, "observation_space", None), "spaces"):
        return _on_goals(act, joined=False, forget=forget)

    def act_in_single_precision(observations: NDArray[Any]) -> NDArray[Any]:
        return act(observations.astype(np.float32))  # as in training

    vars(act_in_single_precision)["begin"] = forget
    return act_in_single_precision


def _on_goals(
    act: Callable[[Any], NDArray[Any]],
    *,
    joined: bool,
    forget: Callable[[DQSpaceArmVectorEnv], None] = lambda environment: None,
) -> StateFeedback:
    """A policy of the goal environment, flown in the ordinary one; it sees measured states, as others do."""
    flown_in: list[DQSpaceArmVectorEnv] = []

    def begin(environment: DQSpaceArmVectorEnv) -> None:
        flown_in[:] = [environment]
        forget(environment)

    def act_on_states(states: NDArray[np.float64], step: int) -> NDArray[Any]:
        (environment,) = flown_in
        parts = show_goals(environment.kernels, states, environment.stage_parameters)
        single = {name: parts[name].astype(np.float32) for name in sorted(parts)}  # as their space has them
        return act(np.concatenate(list(single.values()), axis=1) if joined else single)

    return StateFeedback(act_on_states, begin)


def read_policy(path: Path, *, trust: bool = False, normalized: bool = False) -> Any:
    """Read a policy, or a model of Stable-Baselines3; only a trusted file's code is executed.

    A model that was trained on normalized observations is refused unless the caller normalizes them.
    """
    if not path.exists():
        if path.name == POLICY and (path.parent / CONFIGURATION).exists():
            raise PolicyError(
                f"{path.parent}: this training has no policy yet; run its command again to finish it"
            )
        raise PolicyError(f"{path}: there is no such file or folder")
    if path.suffix == ".npz":
        return load_exported(path)
    if path.suffix == ".zip":
        return _read_model(path, trust=trust, normalized=normalized)
    if path.suffix == ".onnx":
        try:
            return OnnxModel(path)
        except OnnxModelError as error:
            raise PolicyError(str(error)) from error
    raise PolicyError(
        f"{path}: should be an exported policy (.npz), a network (.onnx), a model of Stable-Baselines3 "
        "(.zip), a run folder, or a name in the zoo"
    )


def _read_model(path: Path, *, trust: bool, normalized: bool) -> Any:
    """Read a model by its tensors, or have Stable-Baselines3 load it, which executes what its pickles say."""
    try:
        return read_model(path, normalized=normalized)
    except NeedsCodeError as error:
        if trust:
            return _load_model(path)
        raise PolicyError(
            f"{error}: only code in the file can fly it, so give --trust, in Python trust=True, if you trust "
            "whoever made it"
        ) from error
    except ModelArchiveError as error:
        raise PolicyError(str(error)) from error
    except ModuleNotFoundError as error:
        raise _lacking(path, error) from error


def _load_model(path: Path) -> Any:
    """Load a trusted model to act, without a replay buffer; its attributes tell the algorithm."""
    try:
        from sb3_contrib import TQC
        from stable_baselines3 import PPO, SAC, TD3
    except ModuleNotFoundError as error:
        raise _lacking(path, error) from error
    attributes = read_attributes(path)
    marks: dict[str, Any] = {"top_quantiles_to_drop_per_net": TQC, "target_entropy": SAC, "policy_delay": TD3}
    learner = next((marks[name] for name in marks if name in attributes), PPO)
    options: dict[str, Any] = {}
    if learner is not PPO:
        options = {"buffer_size": 1, "replay_buffer_class": None, "replay_buffer_kwargs": {}}
    try:
        return learner.load(path, device="cpu", **options)
    except Exception as error:  # of other algorithms, or of the code in the file
        raise PolicyError(
            f"{path}: {learner.__name__}.load fails on it ({type(error).__name__}: {error}): load it by its "
            "own class in Python, and give the model"
        ) from error


def _lacking(path: Path, error: ModuleNotFoundError) -> ImportError:
    return ImportError(
        f'{path} needs {error.name}: pip install "dq-space-arm[agents]". An exported policy needs neither'
    )
