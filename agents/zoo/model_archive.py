"""Models of Stable-Baselines3 (.zip), read by their tensors: the file may hold code, and none of it is run.

A model's file holds its attributes as JSON, those that JSON cannot hold as pickles in text, and its tensors
in files of PyTorch. Pickles execute what they contain: only arrays are read from them, by `read_pickled`. The
actor of every built-in policy follows from these, the tensors, and the names of classes in the JSON.
"""

from __future__ import annotations

import base64
import re
from collections.abc import Mapping
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from agents.policies import ExportedPolicy
from agents.policies.pickled_arrays import PickledError, as_array, read_pickled
from agents.policies.tensor_files import TensorFileError, read_tensors
from agents.zoo.normalization import are_missing
from dq_space_arm_env.common.bounded_reading import parse_json, read_member

MOST_BYTES = {"data": 1 << 23, "policy.pth": 1 << 27}
"""Largest members of a model's file that are read."""

_POLICIES = frozenset(
    {
        "stable_baselines3.common.policies",
        "stable_baselines3.sac.policies",
        "stable_baselines3.td3.policies",
        "sb3_contrib.tqc.policies",
        "agents.reinforcement.networks",
        "agents.reinforcement.off_policy",
    }
)
"""Modules whose policies act as this file computes."""
_SCALED_ACTIONS = "agents.reinforcement.networks"  # an output of 1 means the bound of the box
_EXTRACTORS = (
    "stable_baselines3.common.torch_layers.FlattenExtractor",
    "stable_baselines3.common.torch_layers.CombinedExtractor",
    "agents.reinforcement.networks.ScaledObservations",
)
_ACTIVATIONS = {
    "torch.nn.modules.activation.Tanh": "tanh",
    "torch.nn.modules.activation.ReLU": "relu",
    "torch.nn.modules.activation.SiLU": "silu",
}


class ModelArchiveError(ValueError):
    """A file is no model of Stable-Baselines3, or is damaged."""


class NeedsCodeError(ModelArchiveError):
    """A model acts by code in its file."""


class NeedsStatisticsError(ModelArchiveError):
    """A model sees observations that `VecNormalize` has normalized."""


class _Actor(NamedTuple):
    """Where a kind of policy keeps its actor."""

    layers: str  # prefix of the numbered layers
    last: str  # name of the last layer; empty if it is numbered as well
    extractors: tuple[str, ...]  # prefixes of what prepares observations, the first that is there
    squash: str
    activation: str  # unless the file says otherwise
    ignored: tuple[str, ...]  # prefixes of tensors without effect on deterministic actions


_CRITICS = ("critic.", "critic_target.", "actor_target.", "actor.log_std.")
_ACTORS = (
    _Actor(
        "mlp_extractor.policy_net.",
        "action_net",
        ("pi_features_extractor.", "features_extractor."),
        "clip",
        "tanh",
        (
            "features_extractor.",
            "vf_features_extractor.",
            "mlp_extractor.value_net.",
            "value_net.",
            "log_std",
        ),
    ),
    _Actor("actor.latent_pi.", "actor.mu", ("actor.features_extractor.",), "tanh", "relu", _CRITICS),
    _Actor("actor.mu.", "", ("actor.features_extractor.",), "tanh", "relu", _CRITICS),
)


def read_model(path: Path, *, normalized: bool = False) -> ExportedPolicy:
    """Read the deterministic policy of PPO, A2C, SAC, TQC, TD3 or DDPG without executing anything.

    Args:
        path: The model's file.
        normalized: Whether the caller normalizes observations, should the model have been trained so.

    Returns:
        The policy; it acts like the model up to rounding in single precision.

    Raises:
        NeedsStatisticsError: If it was trained on normalized observations, and nobody normalizes them.
        NeedsCodeError: If the policy is not one of Stable-Baselines3's or of this package.
        ModelArchiveError: If the file is damaged, or no model.
        ImportError: If PyTorch is not installed.
    """
    try:
        attributes = read_attributes(path)
        if not normalized and sees_normalized(attributes):
            raise NeedsStatisticsError(
                f"{path}: its observations were normalized by VecNormalize, whose statistics are in a file "
                "of their own: --normalize FILE, in Python normalize=FILE, takes them"
            )
        return _policy(attributes, _read_arrays(path))
    except NeedsStatisticsError:
        raise
    except NeedsCodeError as error:
        raise NeedsCodeError(f"{path}: {error}") from error
    except TensorFileError as error:
        raise ModelArchiveError(f"{path}: policy.pth is {error}") from error
    except (KeyError, TypeError, ValueError, AttributeError) as error:
        missing = f"it has no {error}" if isinstance(error, KeyError) else error
        raise ModelArchiveError(f"{path} is not a model of Stable-Baselines3 ({missing})") from error


def read_attributes(path: Path) -> dict[str, Any]:
    """Attributes of a model by name; those that JSON cannot hold are mappings with pickled text, not read."""
    attributes = parse_json(read_member(path, "data", MOST_BYTES["data"]), "data")
    if not isinstance(attributes, dict):
        raise ValueError("data should be a mapping")
    return attributes


def sees_normalized(attributes: Mapping[str, Any]) -> bool:
    """Whether a model was trained on normalized observations.

    Stable-Baselines3 keeps original observations beside a `VecNormalize` alone, which may still leave them as
    they are and normalize rewards: the last observations tell.
    """
    if attributes.get("_last_original_obs") is None:
        return False
    try:
        last = read_pickled(base64.b64decode(attributes["_last_obs"][":serialized:"]))
    except (LookupError, TypeError, ValueError, PickledError):
        return True
    return are_missing(last, _bounds(attributes["observation_space"], "high").tolist())


def _read_arrays(path: Path) -> dict[str, NDArray[Any]]:
    """Tensors of a model's policy by name."""
    content = read_member(path, "policy.pth", MOST_BYTES["policy.pth"])
    if len(content) > path.stat().st_size:
        raise ValueError("policy.pth is compressed, which Stable-Baselines3 does not do")
    tensors = read_tensors(content)
    if not isinstance(tensors, dict):
        raise ValueError("policy.pth should be a mapping")
    for name, tensor in tensors.items():
        # A tensor may repeat one number at any length.
        if tensor.numel() * tensor.element_size() > len(content):
            raise ValueError(f"{str(name)[:80]} has more numbers than the file")
    return {str(name): tensor.detach().numpy() for name, tensor in tensors.items()}


def _policy(data: Mapping[str, Any], tensors: Mapping[str, NDArray[Any]]) -> ExportedPolicy:
    module, options = str(data["policy_class"]["__module__"]), _checked_options(data)
    if module not in _POLICIES:
        raise NeedsCodeError(f"its policy is a class of {module[:80]!r}, not of Stable-Baselines3")
    # Without hidden layers there is the last alone.
    actor = next(
        (
            each
            for each in _ACTORS
            if f"{each.last}.weight" in tensors or any(name.startswith(each.layers) for name in tensors)
        ),
        None,
    )
    if actor is None:
        raise NeedsCodeError("its network is none of PPO, A2C, SAC, TQC, TD3 or DDPG")
    weights, biases = _layers(actor, tensors)
    scale = _action_scale(data["action_space"], len(biases[-1]))
    factor = environment_scale(data["action_space"], len(biases[-1]))
    if actor.squash == "clip":
        if module == _SCALED_ACTIONS:
            if (factor != 1.0).any():
                raise NeedsCodeError("its actions are rescaled, and not clipped before")
            weights[-1], biases[-1] = weights[-1] * scale, biases[-1] * scale
        elif not (scale == 1.0).all():
            raise NeedsCodeError(f"its actions reach {scale}, should reach 1")
        scale = np.ones_like(scale)
    mean, units = _units(actor, tensors, len(weights[0]))
    is_goal = str(data["observation_space"][":type:"]) == "<class 'gymnasium.spaces.dict.Dict'>"
    return ExportedPolicy(
        weights=tuple(weights),
        biases=tuple(biases),
        activation=_activation(options, actor.activation),
        squash=actor.squash,
        action_scale=scale * factor,
        mean=mean,
        scale=units,
        metadata={"observation": "goal" if is_goal else "plain"},
    )


def _checked_options(data: Mapping[str, Any]) -> Mapping[str, Any]:
    """Options of the policy; those that change how it acts in other ways are refused."""
    options = data["policy_kwargs"]
    if data.get("use_sde") or options.get("use_sde"):
        raise NeedsCodeError("its actions depend on state-dependent exploration")
    extractor = _class_name(options.get("features_extractor_class", _EXTRACTORS[0]))
    if extractor not in _EXTRACTORS:
        raise NeedsCodeError(
            f"its observations go through {extractor!r}, not through one of {', '.join(_EXTRACTORS)}"
        )
    return dict(options)


def _layers(
    actor: _Actor, tensors: Mapping[str, NDArray[Any]]
) -> tuple[list[NDArray[Any]], list[NDArray[Any]]]:
    """Weights, transposed, and biases of the actor's layers in order."""
    numbers = {
        int(match[1])
        for name in tensors
        if (match := re.fullmatch(re.escape(actor.layers) + r"(\d{1,4})\.weight", name))
    }
    names = [f"{actor.layers}{number}" for number in sorted(numbers)] + ([actor.last] if actor.last else [])
    used = {f"{name}.{part}" for name in names for part in ("weight", "bias")}
    known = (*actor.ignored, *actor.extractors)
    others = sorted(name for name in tensors if name not in used and not name.startswith(known))
    if others:
        raise NeedsCodeError(f"its network has {others[0][:80]!r}, which plain layers have not")
    if any(tensors[f"{name}.weight"].ndim != 2 for name in names):
        raise NeedsCodeError("its network has layers that are not linear")
    weights = [tensors[f"{name}.weight"].astype(np.float64).T for name in names]
    return weights, [tensors[f"{name}.bias"].astype(np.float64) for name in names]


def _action_scale(space: Mapping[str, Any], n_action: int) -> NDArray[np.float64]:
    """Largest actions, shape (n_u,), of a symmetric box."""
    low, high = (_bounds(space, name) for name in ("low", "high"))
    if high.shape != (n_action,) or not np.array_equal(low, -high) or not (high <= 1.0).all():
        raise NeedsCodeError(
            f"its actions are in [{str(low)[:80]}, {str(high)[:80]}], should be {n_action} symmetric "
            "ranges, at most 1"
        )
    return high


def _bounds(space: Mapping[str, Any], name: str) -> NDArray[np.float64]:
    """Bounds of a box, "low" or "high", shape (n,); none of other spaces.

    They are read from its pickle: the text beside it has as few digits as NumPy was set to print.
    """
    box = read_pickled(base64.b64decode(space[":serialized:"]))
    if name not in box.state:
        return np.zeros(0)
    found = as_array(box.state[name])
    if found is None or found.ndim > 1:
        raise ValueError(f"{name} of a space is no vector")
    return found


def environment_scale(space: Any, n_action: int) -> NDArray[np.float64]:
    """Factors from a model's actions to the environment's, shape (n_u,), which its action space carries.

    Args:
        space: The space, or its attributes by name; `SB3VecEnv` notes there what Gymnasium's wrappers do.
        n_action: n_u.

    Raises:
        NeedsCodeError: If a wrapper does something else than to rescale actions.
    """
    attributes = space if isinstance(space, Mapping) else vars(space)
    found = attributes.get("environment_scale", [1.0] * n_action)
    if isinstance(found, str):
        raise NeedsCodeError(f"its actions pass {found[:80]!r}, which only the environment can apply")
    factors = np.array(found, dtype=np.float64)
    if factors.shape != (n_action,) or not ((factors > 0.0) & (factors <= 1.0)).all():
        raise ValueError(f"environment_scale of {n_action} actions is {str(found)[:80]}")
    return factors


def _units(
    actor: _Actor, tensors: Mapping[str, NDArray[Any]], n_observation: int
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Mean and scale of observations, shape (n_obs,) each."""
    prefix = next((each for each in actor.extractors if any(name.startswith(each) for name in tensors)), None)
    if prefix is None:
        return np.zeros(n_observation), np.ones(n_observation)
    found = {name.removeprefix(prefix): tensor for name, tensor in tensors.items() if name.startswith(prefix)}
    if set(found) != {"mean", "scale"}:
        raise NeedsCodeError("its observations go through a network of their own")
    return found["mean"].astype(np.float64), found["scale"].astype(np.float64)


def _activation(options: Mapping[str, Any], default: str) -> str:
    if "activation_fn" not in options:
        return default
    name = _class_name(options["activation_fn"])
    if name not in _ACTIVATIONS:
        raise NeedsCodeError(f"its activation is {name!r}, not one of {', '.join(_ACTIVATIONS)}")
    return _ACTIVATIONS[name]


def _class_name(text: Any) -> str:
    """The full name in `<class 'package.module.Name'>`; a user's class may share the last part."""
    return str(text)[:200].removeprefix("<class '").removesuffix("'>")
