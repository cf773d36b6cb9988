"""Whatever acts, as a function of observations: exported policies, models of Stable-Baselines3, callables."""

from __future__ import annotations

import json
import zipfile
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from agents.evaluation.flights import Policy
from agents.policies import ExportedPolicy
from agents.zoo.shelf import ZooError, policy_file
from dq_space_arm_env import DQSpaceArmVectorEnv, Scene

POLICY_OF_A_RUN = "policy.npz"
"""File that stands for a folder of a training run."""
_KINDS = ("plain", "goal")
"""What the metadata of policies say that they see: what the ordinary or the goal environment shows."""


class PolicyError(ValueError):
    """Something is no policy that could be evaluated."""


class ActingPolicy(NamedTuple):
    """A policy to be evaluated.

    Attributes:
        label: What tables call it.
        act: Actions for a batch of observations, see `agents.evaluation.flights.fly`.
        act_once: Takes single observations if the policy can, for its time per action; else `act`.
        batched: Whether `act_once` wants a batch all the same.
        metadata: JSON values that describe how it came about; empty if nobody knows.
        sizes: Entries of its observations and actions; None if nobody knows.
    """

    label: str
    act: Policy
    act_once: Policy
    batched: bool
    metadata: Mapping[str, Any]
    sizes: tuple[int, int] | None = None


def as_policy(policy: Any, label: str | None = None) -> ActingPolicy:
    """Find out how to let something act.

    Args:
        policy: Name of a policy of the zoo; path of an exported policy (.npz), of a model of
            Stable-Baselines3 (.zip), or of the folder of a training run; an `ExportedPolicy`; a model; or a
            function of observations, shape (B, n_obs), that gives actions, shape (B, n_u).
        label: What tables call it; its file or class by default.

    Returns:
        The policy.

    Raises:
        PolicyError: If it is nothing of that kind, or its file cannot be read.
        PolicyFileError: If an exported policy cannot be read.
        ImportError: If a model is given and the extra `agents` is not installed.
    """
    if isinstance(policy, str | Path):
        path = policy_path(policy)
        return as_policy(_read(path), label or _label(policy))
    if isinstance(policy, ExportedPolicy):
        name = label or str(policy.metadata.get("agent", "exported policy"))
        sizes = policy.n_observation, policy.n_action
        if sees_goals(policy):
            act = _OnGoals(policy, joined=True)
            return ActingPolicy(name, act, act, True, policy.metadata, sizes)
        return ActingPolicy(name, policy, policy, False, policy.metadata, sizes)
    if callable(getattr(policy, "predict", None)):
        predict = _predictor(policy)
        return ActingPolicy(label or type(policy).__name__, predict, predict, True, {})
    if callable(policy):
        name = label or str(getattr(policy, "__name__", type(policy).__name__))
        return ActingPolicy(name, policy, policy, True, {})
    raise PolicyError(
        f"policy: {policy!r}, should be a path, an ExportedPolicy, a model of Stable-Baselines3, or a "
        "function of observations"
    )


def policy_path(policy: str | Path) -> Path:
    """Find the file that a user means.

    Args:
        policy: Name of a policy of the zoo, or a path.

    Returns:
        Path of the file; of the exported policy if a folder of a training run is given.

    Raises:
        PolicyError: If there is neither such a path nor such a name.
    """
    path = Path(policy)
    if path.is_dir():
        return path / POLICY_OF_A_RUN
    if isinstance(policy, str) and not path.suffix and len(path.parts) == 1:
        try:
            return policy_file(policy)
        except ZooError as error:
            raise PolicyError(str(error)) from error
    return path


def check_fit(policy: ActingPolicy, scene: Scene) -> None:
    """Refuse a policy that does not choose actions by what an environment shows, or was made for another one.

    Args:
        policy: The policy.
        scene: Where it is to fly.

    Raises:
        PolicyError: If it does not fit.
    """
    kind = policy.metadata.get("observation", "plain")
    if kind == "residual":
        raise PolicyError(
            f"{policy.label} chooses corrections of a plan rather than actions, so it cannot fly alone: "
            "use `dq-space-arm compare residual`"
        )
    if kind not in _KINDS:
        raise PolicyError(f"{policy.label} sees {kind!r} observations, which no environment shows")
    if policy.sizes is None:
        return
    environment = DQSpaceArmVectorEnv(1, scene)
    space, layout = environment.single_observation_space, environment.kernels.layout
    assert space.shape is not None
    seen = layout.n_x + 16 if kind == "goal" else space.shape[0]
    if policy.sizes != (seen, layout.n_u):
        origin = policy.metadata.get("scene")
        made = f", as it was trained for scene {origin!r}" if origin else ""
        raise PolicyError(
            f"{policy.label} turns {policy.sizes[0]} numbers into {policy.sizes[1]} inputs{made}; scene "
            f"{scene.name!r} shows {seen} and has {layout.n_u}: evaluate it on its own scene"
        )


def sees_goals(policy: ExportedPolicy) -> bool:
    """Tell whether a policy wants the observations of the goal environment.

    Args:
        policy: The policy.

    Returns:
        Whether it does.
    """
    return bool(policy.metadata.get("observation") == "goal")


def _label(policy: str | Path) -> str:
    path = Path(policy)
    if path.name == POLICY_OF_A_RUN:
        path = path.parent
    return path.name if path.suffix != ".npz" else "/".join(path.parts[-2:])


def _predictor(model: Any) -> Policy:
    """The deterministic actions of a model of Stable-Baselines3."""

    def act(observations: Any) -> NDArray[Any]:
        return np.asarray(model.predict(observations, deterministic=True)[0])

    if hasattr(getattr(model, "observation_space", None), "spaces"):
        return _OnGoals(act, joined=False)

    def act_in_single_precision(observations: NDArray[Any]) -> NDArray[Any]:
        # As in training: networks compute in it anyway.
        return act(observations.astype(np.float32))

    return act_in_single_precision


class _OnGoals:
    """A policy of the goal environment, flown in the ordinary one."""

    def __init__(self, act: Callable[[Any], NDArray[Any]], *, joined: bool) -> None:
        self._act, self._joined = act, joined
        self._environment: DQSpaceArmVectorEnv | None = None

    def begin(self, environment: DQSpaceArmVectorEnv) -> None:
        """Read states and targets from here."""
        self._environment = environment

    def __call__(self, observations: NDArray[Any]) -> NDArray[Any]:
        """Choose actions by what the goal environment would show."""
        environment = self._environment
        assert environment is not None
        states = environment.states
        parts = {
            "achieved_goal": np.reshape(environment.kernels.tip_pose(states), (len(states), 8)),
            "desired_goal": environment.targets,
            "observation": states,
        }
        single = {name: np.asarray(part, dtype=np.float32) for name, part in parts.items()}
        return self._act(np.concatenate(list(single.values()), axis=1) if self._joined else single)


def _read(path: Path) -> Any:
    if not path.exists():
        raise PolicyError(f"{path}: there is no such file or folder")
    if path.suffix == ".npz":
        return ExportedPolicy.load(path)
    if path.suffix == ".zip":
        return _read_model(path)
    raise PolicyError(
        f"{path}: should be an exported policy (.npz), a model of Stable-Baselines3 (.zip), or the folder of "
        "a training run, or the name of a policy of the zoo"
    )


def _read_model(path: Path) -> Any:
    """A model, by the algorithm that its file's policy class belongs to."""
    try:
        with zipfile.ZipFile(path) as archive:
            home = json.loads(archive.read("data"))["policy_class"]["__module__"]
    except (OSError, zipfile.BadZipFile, KeyError, TypeError, ValueError) as error:
        raise PolicyError(f"{path} is no model of Stable-Baselines3 ({error})") from error
    try:
        from agents.reinforcement.building import load_to_act
    except ModuleNotFoundError as error:
        raise ImportError(
            f'{path} needs {error.name}: pip install "dq-space-arm[agents]". Or export the policy, which '
            "needs neither"
        ) from error
    return load_to_act(path, home)
