"""A transformer that predicts chunks of actions, as arrays in one file, evaluated with NumPy alone.

As in ACT (Zhao et al. 2023, Learning fine-grained bimanual manipulation with low-cost hardware) a flight
predicts the actions to come at each time step, a chunk, and takes the mean of all predictions for it, the
temporal ensemble. The actions of a chunk are some time steps apart, linear in between.
"""

from __future__ import annotations

import os
from collections.abc import Iterator, Mapping, Set
from dataclasses import dataclass, field
from itertools import pairwise
from pathlib import Path
from typing import Any, Self

import numpy as np
from numpy.typing import ArrayLike, NDArray

from agents.configuration.imitation import LONGEST_CHUNK, STRONGEST
from agents.policies.exported import (
    ACTIVATIONS,
    CHUNKS,
    ExportedPolicy,
    FloatArray,
    SingleArray,
)
from agents.policies.policy_files import (
    PolicyFileError,
    building,
    check_version,
    metadata_text,
    policy_arrays,
    read_metadata,
    write_policy,
)
from dq_space_arm_env.common.bounded_reading import archive_members
from dq_space_arm_env.common.real_arrays import real_array
from dq_space_arm_env.common.shown_text import shortened

NORM_EPSILON = 1e-5
"""Added to the variance in a layer normalization, PyTorch's default."""


class Ensemble:
    """Means of the chunks of B flights, the temporal ensemble.

    Of the predictions of an action, one that was made a time steps ago has a weight in proportion to
    exp(m a): 0 is the mean, a positive m as in ACT trusts the oldest most, a negative one the newest.
    """

    def __init__(self, shape: tuple[int, int, int], spacing: int, weighting: float) -> None:
        """Begin without predictions; the shape is (B, k, n_u), the spacing in time steps."""
        flights, actions, inputs = shape
        steps = np.arange((actions - 1) * spacing + 1)[:, None]
        # Each row mixes the two actions of a chunk around its time step.
        self._between = np.maximum(0.0, 1.0 - np.abs(steps / spacing - np.arange(actions)))
        self._fade = np.exp(weighting)
        self._sums = np.zeros((flights, len(steps), inputs))
        self._weights = np.zeros((flights, len(steps), 1))

    def forget(self, flights: NDArray[np.bool_]) -> None:
        """Begin some flights anew, those of a mask of shape (B,)."""
        self._sums[flights], self._weights[flights] = 0.0, 0.0

    def add(self, chunks: FloatArray) -> FloatArray:
        """Add the chunks of this time step, shape (B, k, n_u); returns its actions, shape (B, n_u)."""
        self._sums *= self._fade
        self._sums += self._between @ chunks
        self._weights = self._fade * self._weights + 1.0
        actions: FloatArray = self._sums[:, 0] / self._weights[:, 0]
        self._sums[:, :-1] = self._sums[:, 1:]
        self._weights[:, :-1] = self._weights[:, 1:]
        self._sums[:, -1], self._weights[:, -1] = 0.0, 0.0
        return actions


@dataclass(eq=False)
class ChunkingPolicy:
    """A transformer from observations to chunks of actions, with a memory: `action = policy(observation)`.

    It remembers the chunks of an episode: call `begin` when another one begins, as `rollout` does. All
    flights of a batch begin together, except by `predict`.

    Attributes:
        tensors: Weights by name, float32, see `tensor_shapes`.
        activation: Function in the layers: "tanh", "silu" or "relu".
        heads: Number of heads of the attention.
        spacing: Time steps between the actions of a chunk.
        weighting: m of the temporal ensemble, see `Ensemble`, dimensionless.
        mean: Subtracted from observations, shape (n_obs,), units of the observation.
        scale: Factor of the difference, shape (n_obs,), one over these units; 0 ignores an entry.
        metadata: JSON values: scene, configuration, training.
    """

    tensors: Mapping[str, SingleArray]
    activation: str
    heads: int
    spacing: int
    weighting: float
    mean: FloatArray
    scale: FloatArray
    metadata: Mapping[str, Any] = field(default_factory=dict)
    _doubles: dict[str, FloatArray] = field(init=False, repr=False)
    _memory: Ensemble | None = field(init=False, repr=False, default=None)
    _flights: tuple[int, ...] = field(init=False, repr=False, default=())

    def __post_init__(self) -> None:
        """Check the shapes.

        Raises:
            ValueError: If a tensor is missing, a shape does not fit, a number is not finite or out of range,
                or the activation is unknown.
        """
        self.tensors = {name: np.array(array, np.float32) for name, array in self.tensors.items()}
        self.mean, self.scale = np.array(self.mean, np.float64), np.array(self.scale, np.float64)
        _check(self)
        self._doubles = {name: array.astype(np.float64) for name, array in self.tensors.items()}

    def __repr__(self) -> str:
        chunk, width = self.tensors["positions"].shape
        trained = f", trained in {self.metadata['scene']!r}" if "scene" in self.metadata else ""
        sizes = f"{self.n_observation} -> {width} -> {self.n_action}"
        return f"<ChunkingPolicy {sizes}, {chunk} actions, {self.activation}{trained}>"

    @property
    def n_observation(self) -> int:
        """Number of entries of an observation."""
        return len(self.mean)

    @property
    def n_action(self) -> int:
        """Number of entries of an action."""
        return len(self.tensors["out_bias"])

    def begin(self, environment: object = None) -> None:
        """Forget the chunks: all flights begin anew.

        Args:
            environment: Ignored; `rollout` gives it.
        """
        self._memory = None

    def __call__(self, observation: ArrayLike) -> SingleArray:
        """Choose the actions of the next time step.

        Args:
            observation: As the environment returns it, shape (n_obs,) or (B, n_obs).

        Returns:
            Inputs as fractions of their limits, in [-1, 1], float32, shape (n_u,) or (B, n_u).

        Raises:
            TypeError: If the observation is masked, or not of real numbers.
            ValueError: If the shape does not fit, or B is not that of the flights that have begun.
        """
        seen = real_array("observation", observation)
        if seen.shape[-1:] != self.mean.shape or seen.ndim > 2:
            raise ValueError(
                f"observation: shape {seen.shape}, should be ({self.n_observation},) or (B, "
                f"{self.n_observation})"
            )
        chunks = self.chunks(np.atleast_2d(seen))
        if self._memory is None:
            self._memory = Ensemble(chunks.shape, self.spacing, self.weighting)
            self._flights = seen.shape[:-1]
        elif seen.shape[:-1] != self._flights:
            raise ValueError(
                f"observation: shape {seen.shape}, should be {(*self._flights, self.n_observation)} as "
                "at the time step before; call begin() where other flights begin"
            )
        return self._memory.add(chunks).reshape(*seen.shape[:-1], self.n_action).astype(np.float32)

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
            state: None; the policy keeps its memory itself.
            episode_start: Which episodes have just started, shape (B,): their chunks are forgotten. None for
                none of them.
            deterministic: Ignored; the policy is deterministic.

        Returns:
            Actions, shape (n_u,) or (B, n_u), and None.

        Raises:
            TypeError: If the observation is masked, or not of real numbers.
            ValueError: If a shape does not fit, or B is not that of the flights that have begun.
        """
        if episode_start is not None:
            started = np.atleast_1d(np.asarray(episode_start, np.bool_))
            if started.shape != (wanted := np.shape(observation)[:-1] or (1,)):
                raise ValueError(f"episode_start: shape {started.shape}, should be {wanted}")
            if started.all():
                self.begin()
            elif self._memory is not None and wanted == (self._flights or (1,)):
                self._memory.forget(started)
        return self(observation), None

    def chunks(self, observation: NDArray[Any]) -> FloatArray:
        """Predict the actions to come, without the ensemble.

        Args:
            observation: Shape (B, n_obs).

        Returns:
            Actions now and after `spacing`, 2 `spacing`, ... time steps, in [-1, 1], shape (B, k, n_u).
        """
        # Numbers beyond doubles give NaN, and `rollout` notes that the policy failed.
        with np.errstate(over="ignore", invalid="ignore"):
            values = (observation - self.mean) * self.scale
            last = _count(self.tensors, "embed_bias_") - 1
            for i in range(last):
                values = self._activated(self._linear(values, "embed", i))
            tokens = self._linear(values, "embed", last)[:, None] + self._doubles["positions"]
            for i in range(_count(self.tensors, "feed_in_bias_")):
                tokens = tokens + self._attention(self._normed(tokens, "attend_norm", i), i)
                inner = self._activated(self._linear(self._normed(tokens, "feed_norm", i), "feed_in", i))
                tokens = tokens + self._linear(inner, "feed_out", i)
            actions = self._normed(tokens, "norm") @ self._doubles["out_weight"] + self._doubles["out_bias"]
            return np.asarray(np.clip(actions, -1.0, 1.0))

    def _linear(self, values: FloatArray, name: str, i: int) -> FloatArray:
        # Rows of all tokens in one product: several times as fast as a stack of small ones.
        weight = self._doubles[f"{name}_weight_{i}"]
        product = values.reshape(-1, len(weight)) @ weight + self._doubles[f"{name}_bias_{i}"]
        return product.reshape(*values.shape[:-1], weight.shape[1])

    def _activated(self, values: FloatArray) -> FloatArray:
        ACTIVATIONS[self.activation](values, np.empty_like(values))
        return values

    def _normed(self, tokens: FloatArray, name: str, i: int | None = None) -> FloatArray:
        """Layer normalization."""
        end = "" if i is None else f"_{i}"
        centered = tokens - tokens.mean(axis=-1, keepdims=True)
        variance = np.square(centered).mean(axis=-1, keepdims=True)
        centered /= np.sqrt(variance + NORM_EPSILON)
        return np.asarray(
            centered * self._doubles[f"{name}_weight{end}"] + self._doubles[f"{name}_bias{end}"]
        )

    def _attention(self, tokens: FloatArray, i: int) -> FloatArray:
        """Self-attention among the tokens of a chunk, shape (B, k, d)."""
        flights, length, width = tokens.shape
        heads = self._linear(tokens, "attend_in", i).reshape(
            flights, length, 3, self.heads, width // self.heads
        )
        query, key, value = heads.transpose(2, 0, 3, 1, 4)  # (B, heads, k, d / heads) each
        scores = query @ key.swapaxes(-1, -2) / np.sqrt(width // self.heads)
        scores = np.exp(scores - scores.max(axis=-1, keepdims=True))
        scores /= scores.sum(axis=-1, keepdims=True)
        mixed = (scores @ value).transpose(0, 2, 1, 3).reshape(flights, length, width)
        return self._linear(mixed, "attend_out", i)

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
            "heads": np.array(self.heads),
            "spacing": np.array(self.spacing),
            "weighting": np.array(self.weighting),
            "mean": self.mean,
            "scale": self.scale,
            "metadata": metadata_text(self.metadata),
            **self.tensors,
        }
        write_policy(path, CHUNKS, arrays)

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
        found = arrays.pop(CHUNKS, None)
        if found is None:
            raise PolicyFileError(f"{path} holds no policy of chunks of actions: it has no {CHUNKS}")
        check_version(path, CHUNKS, found)
        with building(path):
            return cls(**_fields(arrays))


Exported = ExportedPolicy | ChunkingPolicy
"""A policy in one file, of either kind."""


def load_exported(path: str | os.PathLike[str]) -> Exported:
    """Read an exported policy of either kind; PolicyFileError if it cannot be read."""
    return (ChunkingPolicy if CHUNKS in archive_members(Path(path)) else ExportedPolicy).load(path)


def tensor_shapes(
    inputs: int, hidden: tuple[int, ...], chunk: tuple[int, int], layers: tuple[int, ...], outputs: int
) -> Iterator[tuple[str, tuple[int, ...]]]:
    """Names and shapes of the weights of a `ChunkingPolicy`.

    Args:
        inputs: Entries of an observation, n_obs.
        hidden: Sizes of the layers that embed it.
        chunk: Actions of a chunk and size of a token, (k, d).
        layers: Size of the feed-forward part of each layer of the transformer.
        outputs: Entries of an action, n_u.

    Yields:
        Names, and shapes for values in rows: a weight maps `inputs` to `outputs` as (inputs, outputs).
    """
    width, sizes = chunk[1], (inputs, *hidden, chunk[1])
    yield "positions", chunk
    for i, pair in enumerate(pairwise(sizes)):
        yield from _linear_shapes("embed", f"_{i}", *pair)
    for i, inner in enumerate(layers):
        yield from _norm_shapes("attend_norm", f"_{i}", width)
        yield from _linear_shapes("attend_in", f"_{i}", width, 3 * width)
        yield from _linear_shapes("attend_out", f"_{i}", width, width)
        yield from _norm_shapes("feed_norm", f"_{i}", width)
        yield from _linear_shapes("feed_in", f"_{i}", width, inner)
        yield from _linear_shapes("feed_out", f"_{i}", inner, width)
    yield from _norm_shapes("norm", "", width)
    yield from _linear_shapes("out", "", width, outputs)


def _linear_shapes(name: str, end: str, inputs: int, outputs: int) -> Iterator[tuple[str, tuple[int, ...]]]:
    yield from ((f"{name}_weight{end}", (inputs, outputs)), (f"{name}_bias{end}", (outputs,)))


def _norm_shapes(name: str, end: str, width: int) -> Iterator[tuple[str, tuple[int, ...]]]:
    yield from ((f"{name}_weight{end}", (width,)), (f"{name}_bias{end}", (width,)))


def _count(names: Mapping[str, Any], start: str) -> int:
    return sum(name.startswith(start) for name in names)


def _fields(arrays: Mapping[str, NDArray[Any]]) -> dict[str, Any]:
    """Arguments of a policy from the arrays of its file."""
    named = {name: arrays[name] for name in ("activation", "heads", "spacing", "weighting", "metadata")}
    for name, array in arrays.items():
        is_text = name in ("activation", "metadata")
        kinds = "U" if is_text else "iu" if name in ("heads", "spacing") else "f"
        if array.dtype.kind not in kinds or (name in named and array.shape):
            wanted = {
                "U": "a text",
                "iu": "a whole number",
                "f": "one number" if name in named else "numbers",
            }
            raise ValueError(f"{name}: shape {array.shape} of {array.dtype}, should be {wanted[kinds]}")
    others = (*named, "mean", "scale")
    return {
        "tensors": {name: array for name, array in arrays.items() if name not in others},
        "activation": str(named["activation"]),
        "heads": int(named["heads"]),
        "spacing": int(named["spacing"]),
        "weighting": float(named["weighting"]),
        "mean": arrays["mean"],
        "scale": arrays["scale"],
        "metadata": read_metadata(arrays),
    }


def _check_names(wrong: Set[str], problem: str) -> None:
    if wrong:
        raise ValueError(f"{shortened(min(wrong))}: {problem}")


def _check(policy: ChunkingPolicy) -> None:
    if policy.activation not in ACTIVATIONS:
        raise ValueError(
            f"activation: {shortened(policy.activation)} is unknown; choose from {', '.join(ACTIVATIONS)}"
        )
    tensors = policy.tensors
    _check_names({"positions", "out_bias"} - tensors.keys(), "is missing")
    chunk = tensors["positions"].shape
    if len(chunk) != 2 or 0 in chunk:
        raise ValueError(f"positions: shape {chunk}, should be (k, d)")
    hidden = tuple(tensors[f"embed_bias_{i}"].size for i in range(_count(tensors, "embed_bias_") - 1))
    layers = tuple(tensors[f"feed_in_bias_{i}"].size for i in range(_count(tensors, "feed_in_bias_")))
    inputs, outputs = policy.mean.size, tensors["out_bias"].size
    shapes = dict(tensor_shapes(inputs, hidden, (chunk[0], chunk[1]), layers, outputs))
    _check_names(shapes.keys() - tensors.keys(), "is missing")
    _check_names(tensors.keys() - shapes.keys(), "is of no layer")
    arrays: dict[str, NDArray[Any]] = {**tensors, "mean": policy.mean, "scale": policy.scale}
    for name, shape in {**shapes, "mean": (inputs,), "scale": (inputs,)}.items():
        if arrays[name].shape != shape:
            raise ValueError(f"{name}: shape {arrays[name].shape}, should be {shape}")
        if not np.isfinite(arrays[name]).all():
            raise ValueError(f"{name}: has entries that are not finite")
    if policy.heads < 1 or chunk[1] % policy.heads:
        raise ValueError(f"heads: {policy.heads}, should divide the size of a token, {chunk[1]}")
    steps = (chunk[0] - 1) * policy.spacing + 1
    if policy.spacing < 1 or steps > LONGEST_CHUNK:
        raise ValueError(
            f"spacing: {policy.spacing}, should be positive, and a chunk at most {LONGEST_CHUNK:,} steps"
        )
    if not abs(policy.weighting) * steps <= STRONGEST:
        raise ValueError(
            f"weighting: {policy.weighting}, should be at most {STRONGEST / steps:.3g} either way for chunks "
            f"of {steps} time steps"
        )
