"""Statistics of observations that `VecNormalize` of Stable-Baselines3 saves beside a model."""

from __future__ import annotations

import dataclasses
import math
import re
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import gymnasium
import numpy as np
from gymnasium import wrappers
from gymnasium.vector import AsyncVectorEnv, VectorWrapper
from numpy.typing import NDArray

from agents.policies import ExportedPolicy
from agents.policies.pickled_arrays import Inert, PickledError, as_array, read_pickled
from dq_space_arm_env.common.bounded_reading import UnreadableError, read_bytes

_MOST_BYTES = 1 << 24
_HARMLESS = frozenset(
    {
        # of this project; what happens to actions is noted in their space, or they are held
        *("RepeatAction", "ShapeReward", "ShrinkActionSpace", "Lagrangian"),
        # of Gymnasium, most for single and vector environments alike
        *("Autoreset", "DictInfoToList", "HumanRendering", "OrderEnforcing", "PassiveEnvChecker"),
        *("RecordEpisodeStatistics", "RecordVideo", "RenderCollection", "TimeLimit"),
        *("DtypeObservation", "FlattenObservation", "NormalizeReward", "RewardWrapper"),
        *("VectorRewardWrapper", "VectorActionWrapper"),  # `SB3VecEnv` notes or refuses these
        # of Stable-Baselines3; the statistics of `VecNormalize` are read
        *("Monitor", "VecCheckNan", "VecMonitor", "VecNormalize", "VecVideoRecorder"),
    }
)
"""Wrappers that leave the numbers of observations and actions as they are, or tell what they do."""
_VEC_NORMALIZE = "stable_baselines3.common.vec_env.vec_normalize.VecNormalize"


class StatisticsError(ValueError):
    """A file holds no statistics of `VecNormalize`, or they do not fit a policy."""


class ObservationStatistics(NamedTuple):
    """What a policy sees: clip((observation - mean) scale, -limit, limit)."""

    mean: NDArray[np.float64]  # (n_obs,), units of the observation
    scale: NDArray[np.float64]  # (n_obs,), one over these units
    limit: float

    def normalize(self, observations: Any) -> Any:
        """Normalize observations, shape (B, n_obs), or arrays by name whose parts the statistics join."""
        if not isinstance(observations, Mapping):
            return np.clip((observations - self.mean) * self.scale, -self.limit, self.limit).astype(
                np.float32
            )
        names = sorted(observations)
        sizes = np.cumsum([observations[name].shape[-1] for name in names])[:-1]
        joined = self.normalize(np.concatenate([observations[name] for name in names], axis=-1))
        return dict(zip(names, np.split(joined, sizes, axis=-1), strict=True))

    def of(self, policy: ExportedPolicy) -> ExportedPolicy:
        """The policy of raw observations, from one that sees normalized ones."""
        if self.mean.shape != policy.mean.shape:
            raise StatisticsError(
                f"statistics of {self.mean.size} observations, should be {policy.mean.size}, those of the "
                "policy"
            )
        if policy.mean.any() or (policy.scale != 1.0).any():
            raise StatisticsError("statistics for a policy that has units of observations already")
        return dataclasses.replace(policy, mean=self.mean, scale=self.scale, normalized_limit=self.limit)


def read_statistics(path: str | Path) -> ObservationStatistics | None:
    """Read a file that `VecNormalize.save` wrote; nothing in it is executed.

    Args:
        path: The file.

    Returns:
        Its statistics; None if it normalizes rewards alone.

    Raises:
        StatisticsError: If the file holds something else.
    """
    try:
        saved = read_pickled(read_bytes(path, _MOST_BYTES))
        if not isinstance(saved, Inert) or saved.name != _VEC_NORMALIZE or not isinstance(saved.state, dict):
            raise StatisticsError(f"{path} is no VecNormalize of Stable-Baselines3, saved by its save()")
        return _statistics(saved.state)
    except UnreadableError as error:
        raise StatisticsError(str(error)) from error
    except PickledError as error:
        raise StatisticsError(f"{path} is no VecNormalize of Stable-Baselines3 ({error})") from error
    except (LookupError, TypeError, ValueError, AttributeError) as error:
        if isinstance(error, StatisticsError):
            raise
        raise StatisticsError(f"{path} is damaged: it has no {error}") from error


def statistics_of(model: Any, file: str | Path | None = None) -> ObservationStatistics | None:
    """Statistics of the observations of a model in memory, its own or those of a file.

    Args:
        model: A model of Stable-Baselines3, or anything that acts.
        file: What `VecNormalize.save` wrote, for a model that was loaded without its `VecNormalize`.

    Returns:
        The statistics; None if it sees observations as they are.

    Raises:
        StatisticsError: If they are missing, or given to a model that has no use for them; or if wrappers of
            its environment change observations or actions without its knowledge.
    """
    _check_wrappers(model)
    normalizer = getattr(model, "get_vec_normalize_env", lambda: None)()
    if normalizer is not None:
        if file is not None:
            raise StatisticsError("the model has its VecNormalize in memory: leave normalize out")
        return _statistics(vars(normalizer))
    normalized = _sees_normalized(model)
    if file is None and normalized is None:
        raise StatisticsError(
            "the model was given another environment since it learned, and does not tell whether its "
            "observations were normalized by VecNormalize: load it without env, or give its file"
        )
    if file is None and normalized:
        raise StatisticsError(
            "the model's observations were normalized by VecNormalize, which it was loaded without: "
            "normalize=FILE takes the file of the statistics"
        )
    statistics = None if file is None else read_statistics(file)
    if statistics is not None and normalized is False:
        raise StatisticsError("the model was trained on plain observations: leave normalize out")
    return statistics


def _check_wrappers(model: Any) -> None:
    """Refuse wrappers that may change what a model in memory sees or does without its knowledge."""
    environment: Any = getattr(model, "get_env", lambda: None)()
    while hasattr(environment, "venv"):
        _check_wrapper(environment)
        environment = environment.venv
    env: Any = getattr(environment, "vector_env", environment)
    while env is not None:
        if isinstance(env, gymnasium.Wrapper | VectorWrapper):
            _check_wrapper(env)
            env = env.env
        elif getattr(env, "envs", ()):  # one for all
            env = env.envs[0]
        else:
            _check_elsewhere(env)
            return


def _check_wrapper(env: Any) -> None:
    """Refuse a wrapper, of Gymnasium or Stable-Baselines3, unless it is known to be harmless."""
    name = type(env).__name__
    if isinstance(env, gymnasium.ActionWrapper):
        if _changes_actions(env):
            raise StatisticsError(
                f"the model's actions pass {name} of a single environment, which it does not note: train in "
                "agents.SB3VecEnv with gymnasium.wrappers.vector.RescaleAction"
            )
        return
    if _is_harmless(env):
        return
    if isinstance(env, wrappers.NormalizeObservation):
        raise StatisticsError(
            "the model's observations pass Gymnasium's NormalizeObservation, whose statistics are not "
            "read: train in VecNormalize of Stable-Baselines3"
        )
    if isinstance(env, gymnasium.ObservationWrapper):
        raise StatisticsError(
            f"the model's observations pass {name}, which only its environment applies: give a function of "
            "plain observations that applies it before model.predict"
        )
    raise StatisticsError(
        f"the model's observations or actions may pass {name}, which only its environment applies: give a "
        "function of plain observations that applies it around model.predict; one that changes rewards "
        "alone should be a gymnasium.RewardWrapper"
    )


def _is_harmless(env: Any) -> bool:
    """Whether a wrapper is one that is known to be harmless, or made from it."""
    known = "agents", "gymnasium", "stable_baselines3"
    return any(
        kind.__name__ in _HARMLESS and kind.__module__.partition(".")[0] in known
        for kind in type(env).__mro__
    )


class _Doubtful(type):
    """Type whose instances are all wrappers that would be refused."""

    def __instancecheck__(cls, env: Any) -> bool:
        try:
            _check_wrapper(env)
        except StatisticsError:
            return True
        return False


class DoubtfulWrapper(metaclass=_Doubtful):
    """What other processes are asked for: they find it by its name."""


def _check_elsewhere(env: Any) -> None:
    """Refuse wrappers in other processes, as far as these tell."""
    noted = getattr(getattr(env, "spec", None), "kwargs", None)  # by Gymnasium's `make_vec`
    asks = hasattr(env, "env_is_wrapped") or (isinstance(env, AsyncVectorEnv) and noted is None)
    if asks and getattr(env, "closed", False):
        raise StatisticsError(
            "the model's environments in other processes are closed, so that their wrappers cannot be "
            "seen: evaluate and export it before"
        )
    if hasattr(env, "env_is_wrapped"):  # of Stable-Baselines3
        is_wrapped = any(env.env_is_wrapped(DoubtfulWrapper))
    elif asks:  # "<Wrapper<Environment<Id>>>", or "<Wrapper<Environment instance>>"
        names = {name for text in env.call("__str__") for name in re.findall(r"<(\w+)(?=<\w+[< ])", text)}
        is_wrapped = not names <= _HARMLESS
    else:
        is_wrapped = bool((noted or {}).get("wrappers"))
    if is_wrapped:
        raise StatisticsError(
            "the model's observations or actions pass wrappers in other processes, which only its "
            "environment applies: wrap in this process, or train in agents.SB3VecEnv with vector wrappers"
        )


def _changes_actions(env: gymnasium.ActionWrapper[Any, Any, Any]) -> bool:
    """Whether a wrapper does more than to clip actions, or to rescale them to where they are."""
    if isinstance(env, wrappers.ClipAction):
        return False
    space: Any = env.action_space
    return not isinstance(env, wrappers.RescaleAction) or not all(
        np.allclose(env.action(end), end, rtol=1e-6) for end in (space.low, space.high)
    )


def _sees_normalized(model: Any) -> bool | None:
    """Whether a model without a `VecNormalize` was trained in one; None if that cannot be told."""
    if getattr(model, "_last_original_obs", None) is None:
        return False
    if model._last_obs is None:  # by `set_env`; algorithms off policy keep originals in any case
        return None if hasattr(model, "replay_buffer_class") else True
    if model.get_env() is not None:
        return False  # it has learned there
    return are_missing(model._last_obs, np.asarray(getattr(model.observation_space, "high", ())).tolist())


def _statistics(state: Mapping[str, Any]) -> ObservationStatistics | None:
    """Statistics from the attributes of a `VecNormalize`."""
    if not state["norm_obs"]:
        return None
    moments, epsilon, limit = state["obs_rms"], float(state["epsilon"]), float(state["clip_obs"])
    if isinstance(moments, dict):
        _check_keys(state, moments)
    parts = [moments[name] for name in sorted(moments)] if isinstance(moments, dict) else [moments]
    mean, variance = (np.concatenate([_moment(part, name) for part in parts]) for name in ("mean", "var"))
    if not (np.isfinite(mean).all() and (variance >= 0.0).all() and epsilon > 0.0 and limit > 0.0):
        raise StatisticsError("statistics of VecNormalize that are not finite, or negative")
    return ObservationStatistics(mean, 1.0 / np.sqrt(variance + epsilon), limit)


def _check_keys(state: Mapping[str, Any], moments: Mapping[str, Any]) -> None:
    """Refuse statistics of some parts of observations alone."""
    space = state["observation_space"]
    whole = space.state["spaces"] if isinstance(space, Inert) else space.spaces
    if set(moments) != set(whole):
        missing = ", ".join(sorted(set(whole) - set(moments)))
        raise StatisticsError(f"statistics of all parts of observations but {missing}, should be of all")


def _moment(part: Any, name: str) -> NDArray[np.float64]:
    """Mean or variance of a `RunningMeanStd`, shape (n,)."""
    if isinstance(part, Inert):
        array = as_array(part.state[name])
        if array is None:
            raise StatisticsError(f"statistics whose {name} is no array of floats")
    else:
        array = np.asarray(getattr(part, name), dtype=np.float64)
    return array.reshape(-1)


def are_missing(observation: Any, high: Sequence[float]) -> bool:
    """Whether a model's last observation was normalized: its unit quaternion has another length.

    Args:
        observation: An array or arrays by name, as they are or as `read_pickled` finds them.
        high: Upper bounds of the observation space, empty if it has parts.

    Returns:
        True also where that cannot be told.
    """
    if isinstance(observation, dict):
        observation, length = observation.get("achieved_goal"), 4
    else:
        units = [math.isclose(bound, 1.0 + 1e-5, abs_tol=1e-7) for bound in high[:4]]
        length = next((i for i, unit in enumerate(units) if not unit), len(units))
    seen = observation if isinstance(observation, np.ndarray) else as_array(observation)
    if seen is None or not length or not seen.size:
        return True
    sizes = np.linalg.norm(seen[..., :length], axis=-1)
    return bool((np.abs(sizes - 1.0) > 1e-3).any())
