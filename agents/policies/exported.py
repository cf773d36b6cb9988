"""A trained policy as arrays in one file, evaluated with NumPy alone.

An observation takes a few microseconds: work arrays are allocated once, and the normalization is folded into
the first layer. Weights are stored in single precision, as trained, but evaluated in double precision, which
costs little at this size: sums of some hundred terms would be off by more than 1e-6 in single precision.
"""

from __future__ import annotations

import math
import os
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from typing import Any, NamedTuple, Self

import numpy as np
from numpy.typing import ArrayLike, NDArray

from agents.policies.policy_files import (
    PolicyFileError,
    building,
    check_version,
    metadata_text,
    policy_arrays,
    read_metadata,
    write_policy,
)
from dq_space_arm_env.common.real_arrays import real_array
from dq_space_arm_env.common.shown_text import shortened
from dq_space_arm_env.task.step_report import OBSERVATION_LIMIT

CHUNKS = "chunk_format"  # instead of `format` in the files of `ChunkingPolicy`

_LONGEST = 200  # characters of a list of names

_LARGEST_VALUE = 1e300  # of anything that an observation leads to: next to no double overflows

FloatArray = NDArray[np.float64]
SingleArray = NDArray[np.float32]


CONSTANT = 1e-6
"""Standard deviation below which an entry of the observation is constant, in its unit."""


def units_of(observations: ArrayLike) -> tuple[FloatArray, FloatArray]:
    """Units in which a network sees observations.

    Args:
        observations: Samples, shape (N, n_obs).

    Returns:
        Mean and inverse standard deviation of each entry, shape (n_obs,); 0 for the latter of a constant.
    """
    samples = np.asarray(observations).astype(np.float64)
    return samples.mean(axis=0), scale_of(samples.std(axis=0))


def scale_of(deviation: FloatArray) -> FloatArray:
    """One over the standard deviation of each entry; 0 for a constant."""
    varies = deviation > CONSTANT
    return np.where(varies, 1.0 / np.where(varies, deviation, 1.0), 0.0)


def _tanh(values: FloatArray, spare: FloatArray) -> None:
    np.tanh(values, out=values)


def _relu(values: FloatArray, spare: FloatArray) -> None:
    np.maximum(values, 0.0, out=values)


def _silu(values: FloatArray, spare: FloatArray) -> None:
    # z / (1 + exp(-z)), in a form that cannot overflow: z / 2 (1 + tanh(z / 2)).
    values *= 0.5
    np.tanh(values, out=spare)
    spare += 1.0
    values *= spare


def _clip(values: FloatArray, spare: FloatArray) -> None:
    # numpy.clip takes several times as long for a few numbers.
    np.maximum(values, -1.0, out=values)
    np.minimum(values, 1.0, out=values)


# In place on an array, with a spare one of the same shape.
InPlace = Callable[[FloatArray, FloatArray], None]
ACTIVATIONS: Mapping[str, InPlace] = {"tanh": _tanh, "silu": _silu, "relu": _relu}
SQUASHES: Mapping[str, InPlace] = {"clip": _clip, "tanh": _tanh}


class _Work(NamedTuple):
    """Arrays and functions that an evaluation needs, for one observation or a batch."""

    normalized: FloatArray  # (..., n_obs)
    layers: list[tuple[FloatArray, FloatArray, FloatArray, FloatArray]]  # matrix, bias, result, spare
    activate: InPlace
    squash: InPlace

    @classmethod
    def of(cls, policy: ExportedPolicy, lead: tuple[int, ...]) -> Self:
        """Allocate arrays for one observation, lead (), or a batch, lead (B,)."""
        layers = [
            (matrix, bias, *np.empty((2, *lead, len(bias))))
            for matrix, bias in zip(policy._matrices[:-1], policy._offsets[:-1], strict=True)
        ]
        normalized = np.empty((*lead, policy.n_observation))
        return cls(normalized, layers, ACTIVATIONS[policy.activation], SQUASHES[policy.squash])


@dataclass(frozen=True, eq=False)
class ExportedPolicy:
    """A network of L layers from observations to actions: `action = policy(observation)`.

    Not safe to share between threads: it owns its work arrays.

    Attributes:
        weights: Of each layer, float32, shapes (n_obs, h_1), (h_1, h_2), ..., (h_{L-1}, n_u).
        biases: Of each layer, float32, shapes (h_1,), ..., (n_u,).
        activation: Function between layers: "tanh", "silu" or "relu".
        squash: Function that maps the last layer's outputs to [-1, 1]: "clip" or "tanh".
        action_scale: Factor of the squashed outputs, shape (n_u,), fractions of limits; None for ones.
        mean: Subtracted from observations, shape (n_obs,), units of the observation.
        scale: Factor of the difference, shape (n_obs,), one over these units; 0 ignores an entry that was
            constant in training.
        normalized_limit: Bound at which normalized observations are clipped, dimensionless; inf for none.
        metadata: JSON values: scene, configuration, training.
    """

    weights: tuple[SingleArray, ...]
    biases: tuple[SingleArray, ...]
    activation: str
    mean: FloatArray
    scale: FloatArray
    squash: str = "clip"
    action_scale: FloatArray | None = None
    normalized_limit: float = math.inf
    metadata: Mapping[str, Any] = field(default_factory=dict)
    # Weights and biases in double precision, the first matrix with the scale folded in.
    _matrices: tuple[FloatArray, ...] = field(init=False, repr=False)
    _offsets: tuple[FloatArray, ...] = field(init=False, repr=False)
    _work: _Work = field(init=False, repr=False)

    def __post_init__(self) -> None:
        """Check the shapes, and allocate work arrays.

        Raises:
            ValueError: If a shape does not fit, a number is not finite, or a function is unknown.
        """
        # Copies: a network that is trained on would change what `save` writes, and not the actions.
        self._adopt("weights", tuple(np.array(array, np.float32, order="C") for array in self.weights))
        self._adopt("biases", tuple(np.array(array, np.float32, order="C") for array in self.biases))
        self._adopt("mean", np.array(self.mean, np.float64))
        self._adopt("scale", np.array(self.scale, np.float64))
        if self.action_scale is not None:
            self._adopt("action_scale", np.array(self.action_scale, np.float64))
        _check(self)
        first, *others = (array.astype(np.float64) for array in self.weights)
        if math.isinf(self.normalized_limit):
            first *= self.scale[:, None]  # folded into the first layer, scaling is free
        self._adopt("_matrices", (first, *others))
        self._adopt("_offsets", tuple(array.astype(np.float64) for array in self.biases))
        self._adopt("_work", _Work.of(self, ()))

    def _adopt(self, name: str, value: Any) -> None:
        object.__setattr__(self, name, value)

    def __repr__(self) -> str:
        sizes = (self.n_observation, *(len(bias) for bias in self.biases))
        trained = f", trained in {self.metadata['scene']!r}" if "scene" in self.metadata else ""
        return f"<ExportedPolicy {' -> '.join(map(str, sizes))}, {self.activation}{trained}>"

    @property
    def n_observation(self) -> int:
        """Number of entries of an observation."""
        return len(self.mean)

    @property
    def n_action(self) -> int:
        """Number of entries of an action."""
        return len(self.biases[-1])

    def __call__(self, observation: ArrayLike) -> SingleArray:
        """Choose actions.

        Args:
            observation: As the environment returns it, shape (n_obs,) or (B, n_obs).

        Returns:
            Inputs as fractions of their limits, in [-1, 1], float32, shape (n_u,) or (B, n_u).

        Raises:
            TypeError: If the observation is masked, or not of real numbers.
            ValueError: If the shape does not fit.
        """
        if type(observation) is not np.ndarray:
            observation = real_array("observation", observation)
        shape = observation.shape
        if shape == self.mean.shape:
            return self._evaluate(observation, self._work)
        if len(shape) == 2 and shape[1:] == self.mean.shape:
            return self._evaluate(observation, _Work.of(self, shape[:1]))
        raise ValueError(
            f"observation: shape {shape}, should be ({self.n_observation},) or (B, {self.n_observation})"
        )

    def predict(
        self,
        observation: ArrayLike,
        state: None = None,
        episode_start: ArrayLike | None = None,
        deterministic: bool = True,
    ) -> tuple[SingleArray, None]:
        """Choose actions by the interface of Stable-Baselines3.

        Args:
            observation: Shape (n_obs,) or (B, n_obs).
            state: None; the policy has no memory.
            episode_start: Which episodes have just started, shape (B,); ignored.
            deterministic: Ignored; the policy is deterministic.

        Returns:
            Actions, shape (n_u,) or (B, n_u), and None.

        Raises:
            ValueError: If the shape does not fit.
        """
        return self(observation), None

    def _evaluate(self, observation: NDArray[Any], work: _Work) -> SingleArray:
        values = work.normalized
        np.subtract(observation, self.mean, out=values)
        if self.normalized_limit < math.inf:
            values *= self.scale
            np.clip(values, -self.normalized_limit, self.normalized_limit, out=values)
        for matrix, bias, result, spare in work.layers:
            np.dot(values, matrix, result)
            result += bias
            work.activate(result, spare)
            values = result
        action: FloatArray = np.dot(values, self._matrices[-1])
        action += self._offsets[-1]
        work.squash(action, action)
        if self.action_scale is not None:
            action *= self.action_scale
        return action.astype(np.float32)

    def save(self, path: str | os.PathLike[str]) -> None:
        """Write the policy to a file atomically.

        Args:
            path: The file, `.npz` by convention.

        Raises:
            PolicyFileError: If the network is larger than what `load` reads.
            TypeError: If the metadata are no JSON values.
        """
        arrays: dict[str, NDArray[Any]] = {
            "activation": np.array(self.activation),
            "squash": np.array(self.squash),
            "mean": self.mean,
            "scale": self.scale,
            "normalized_limit": np.array(self.normalized_limit),
            "metadata": metadata_text(self.metadata),
        }
        if self.action_scale is not None:
            arrays["action_scale"] = self.action_scale
        for i, (weight, bias) in enumerate(zip(self.weights, self.biases, strict=True)):
            arrays[f"weight_{i}"], arrays[f"bias_{i}"] = weight, bias
        write_policy(path, "format", arrays)

    @classmethod
    def load(cls, path: str | os.PathLike[str]) -> Self:
        """Read a policy written by `save`; nothing in the file is executed.

        Args:
            path: The file.

        Returns:
            The policy.

        Raises:
            PolicyFileError: If the file is missing, damaged, or of another format.
        """
        arrays = policy_arrays(path)
        found = arrays.get("format")
        if CHUNKS in arrays:
            raise PolicyFileError(
                f"{path} holds a policy of chunks of actions, which flies, but nothing else starts from it; "
                "give a policy of single actions, such as cloning-with-gains"
            )
        if found is None:
            what = ", ".join(arrays)[:_LONGEST] or "nothing"
            if {"states", "controls", "feedback_gains"} <= set(arrays):
                what = "the solution from one start, which `dq-space-arm simulate SCENE --policy` flies"
            raise PolicyFileError(f"{path} holds no policy but {what}")
        check_version(path, "format", found)
        with building(path):
            return cls(**_fields(arrays))


_TEXTS, _SINGLE = (
    ("activation", "squash", "metadata"),
    ("activation", "squash", "metadata", "normalized_limit"),
)


def _fields(arrays: Mapping[str, NDArray[Any]]) -> dict[str, Any]:
    layers = range(sum(name.startswith("weight_") for name in arrays))
    metadata = read_metadata(arrays)
    for name, array in arrays.items():
        if (array.dtype.kind in "biuf") is (name in _TEXTS) or (name in _SINGLE and array.shape):
            kind = "a text" if name in _TEXTS else "one number" if name in _SINGLE else "numbers"
            raise ValueError(f"{name}: shape {array.shape} of {array.dtype}, should be {kind}")
    return {
        "weights": tuple(arrays[f"weight_{i}"] for i in layers),
        "biases": tuple(arrays[f"bias_{i}"] for i in layers),
        "activation": str(arrays["activation"]),
        "squash": str(arrays["squash"]),
        "action_scale": arrays.get("action_scale"),
        "mean": arrays["mean"],
        "scale": arrays["scale"],
        "normalized_limit": float(arrays["normalized_limit"]),
        "metadata": metadata,
    }


def _check(policy: ExportedPolicy) -> None:
    for name, value, known in (
        ("activation", policy.activation, ACTIVATIONS),
        ("squash", policy.squash, SQUASHES),
    ):
        if value not in known:
            raise ValueError(f"{name}: {shortened(value)} is unknown; choose from {', '.join(known)}")
    if not policy.weights or len(policy.weights) != len(policy.biases):
        raise ValueError(
            f"{len(policy.weights)} weights and {len(policy.biases)} biases, should be one of each per layer"
        )
    if not policy.normalized_limit > 0.0:
        raise ValueError(f"normalized_limit: {policy.normalized_limit}, should be positive")
    if policy.mean.ndim != 1:
        raise ValueError(f"mean: shape {policy.mean.shape}, should be (n_obs,)")
    inputs = len(policy.mean)
    arrays: dict[str, tuple[NDArray[Any], tuple[int, ...]]] = {
        "mean": (policy.mean, (inputs,)),
        "scale": (policy.scale, (inputs,)),
    }
    for i, (weight, bias) in enumerate(zip(policy.weights, policy.biases, strict=True)):
        outputs = bias.size
        arrays[f"weight_{i}"] = weight, (inputs, outputs)
        arrays[f"bias_{i}"] = bias, (outputs,)
        inputs = outputs
    if policy.action_scale is not None:
        arrays["action_scale"] = policy.action_scale, (inputs,)
    for name, (array, shape) in arrays.items():
        if array.shape != shape:
            raise ValueError(f"{name}: shape {array.shape}, should be {shape}")
        if not np.isfinite(array).all():
            raise ValueError(f"{name}: has entries that are not finite")
    _check_growth(policy)
    scale = policy.action_scale
    if scale is not None and not ((scale >= 0.0) & (scale <= 1.0)).all():
        raise ValueError(f"action_scale: {scale}, should be in [0, 1]")


def _check_growth(policy: ExportedPolicy) -> None:
    """Refuse numbers with which an observation that the environment may give makes a layer overflow."""
    with np.errstate(over="ignore", invalid="ignore"):
        seen = np.abs(policy.scale) * (OBSERVATION_LIMIT + np.abs(policy.mean))
        _check_bound("scale and mean", seen)
        largest = np.minimum(seen, policy.normalized_limit)
        for i, (weight, bias) in enumerate(zip(policy.weights, policy.biases, strict=True)):
            # Rows are scaled before they are summed where the scale is folded into them.
            sums = largest @ np.abs(weight.astype(np.float64)) + np.abs(bias.astype(np.float64))
            _check_bound(f"weight_{i} and bias_{i}", sums)
            largest = np.minimum(sums, 1.0) if policy.activation == "tanh" else sums


def _check_bound(name: str, values: FloatArray) -> None:
    if not (values <= _LARGEST_VALUE).all():
        raise ValueError(
            f"{name}: an observation within {OBSERVATION_LIMIT:g} gives {np.max(values):.3g}, should stay "
            f"below {_LARGEST_VALUE:g}"
        )
