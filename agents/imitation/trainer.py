"""Train a network on demonstrations, with validation and checkpoints that resume exactly."""

from __future__ import annotations

import copy
import io
import math
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass
from datetime import timedelta
from pathlib import Path
from time import perf_counter
from typing import Any, Generic, NamedTuple, Protocol, TypeVar

import numpy as np
import torch

from agents.configuration.imitation import Optimization
from agents.imitation.objective import Losses
from agents.imitation.samples import Source
from agents.policies.network import NormalizedNetwork
from agents.policies.tensor_files import read_tensors
from agents.run_folder import RunFolderError
from dq_space_arm_env.common.bounded_reading import read_bytes
from dq_space_arm_env.common.files import differences, write_atomically
from dq_space_arm_env.common.progress import Advance
from experts.demonstrations.reading import Batch

CHECKPOINT = "checkpoint.pt"
MOST_BYTES = 1 << 30  # of a checkpoint that is read
RECORD_BYTES = 1 << 10  # of a record of its history, at most; a few numbers with their names
VALIDATION_BATCHES = 32  # at most; the same time steps every time
UPDATES_BETWEEN_MESSAGES = 20
FINAL_RATE = 1e-3  # learning rate at the end, relative to its peak

_DAMAGED = "{} cannot be read ({}); remove it to restart the training"

Record = dict[str, float]
Progress = Callable[[Advance], None]
Watch = Callable[[NormalizedNetwork, Record, bool], Record]
"""Called with the network, the record of a validation, and whether it is the last; returns what to add."""


N = TypeVar("N", bound=NormalizedNetwork)
_N_contra = TypeVar("_N_contra", bound=NormalizedNetwork, contravariant=True)


class Loss(Protocol[_N_contra]):
    """What a training minimizes."""

    @property
    def needs(self) -> tuple[str, ...]:
        """Names of the arrays that a batch must have."""

    def __call__(self, network: _N_contra, batch: Batch, rng: np.random.Generator) -> Losses:
        """Evaluate the losses, with gradients, on a batch."""


class CheckpointError(RunFolderError):
    """A checkpoint cannot be used."""


@dataclass(frozen=True)
class Spent:
    """Effort spent on a network before a training."""

    updates: float = 0.0
    seconds: float = 0.0
    environment_steps: float = 0.0


class TrainingAdvance(NamedTuple):
    """Progress of a training, for display."""

    total: int  # updates
    done: int
    rate: float  # updates per second in this run; 0 at first
    losses: Mapping[str, float]  # of the last validation, or of the training since without one, by name
    part: str = ""  # label of the line

    def describe(self) -> str:
        line = f"{self.part}{': ' * bool(self.part)}{self.done} of {self.total} updates"
        for name in ("action", "gain"):
            value = self.losses.get(f"validation_{name}", self.losses.get(name, 0.0))
            if value:
                line += f", {name} loss {value:.2e}"
        if self.rate > 0.0:
            line += f", {self.rate:.0f} a second"
            seconds_left = (self.total - self.done) / self.rate
            if seconds_left > 0.0:
                line += f", {timedelta(seconds=round(seconds_left))} left"
        if "success_rate" in self.losses:
            line += f"; success {self.losses['success_rate']:.0%}"
        return line


@contextmanager
def torch_threads(count: int) -> Iterator[None]:
    """Set PyTorch's number of threads inside a `with` block."""
    before = torch.get_num_threads()
    torch.set_num_threads(count)
    try:
        yield
    finally:
        torch.set_num_threads(before)


class Trainer(Generic[N]):
    """Trains a network with Adam on an objective; `history` holds a record per validation."""

    def __init__(
        self,
        network: N,
        objective: Loss[N],
        optimization: Optimization,
        *,
        validate_every: int,
        seed: int,
        part: str = "",
        before: Spent | None = None,
    ) -> None:
        self._network, self._objective, self._optimization = network, objective, optimization
        self._validate_every, self._seed, self._part = validate_every, seed, part
        self._before = before or Spent()
        # One kernel for all parameters: small networks are bound by calls, not by arithmetic.
        self._optimizer = torch.optim.Adam(network.parameters(), lr=optimization.learning_rate, fused=True)
        self._epoch, self._position, self._updates = 0, 0, 0
        self._best, self._best_weights = math.inf, copy.deepcopy(network.state_dict())
        self.history: list[Record] = []
        self._seconds, self._begin = 0.0, perf_counter()

    def train(
        self,
        training: Source,
        validation: Source | None,
        folder: Path | None,
        identity: dict[str, Any],
        *,
        progress: Progress | None = None,
        watch: Watch | None = None,
    ) -> None:
        """Train to the last update, resuming from a checkpoint in `folder` whose identity must match.

        With validation data, the network ends with the weights of the lowest validation loss.
        """
        if folder is not None:
            records = self._optimization.updates // self._validate_every + 1
            content = _load_checkpoint(folder, identity, records)
            self._resume(folder / CHECKPOINT, content)
        self._begin = perf_counter() - self._seconds
        reporter = _Reporter(self._optimization.updates, self._updates, self._part, progress)
        while self._updates < self._optimization.updates:
            for batch in self._rest_of_epoch(training):
                self._update(batch, reporter)
                if self._updates % self._validate_every == 0 or self._is_done:
                    self._record(validation, reporter, watch)
                    if folder is not None:
                        _save_checkpoint(folder, {"identity": identity, **self._state()})
                if self._is_done:
                    break
            else:
                self._epoch, self._position = self._epoch + 1, 0
        if validation is not None:
            self._network.load_state_dict(self._best_weights)

    @property
    def _is_done(self) -> bool:
        return self._updates == self._optimization.updates

    def _rest_of_epoch(self, training: Source) -> Iterator[Any]:
        """The rest of one pass over the data, in an order seeded by the epoch."""
        order = int(np.random.SeedSequence([self._seed, self._epoch]).generate_state(1)[0])
        batches = training.batches(self._optimization.batch_size, self._objective.needs, seed=order)
        done = self._position
        for position, batch in enumerate(batches):
            if position >= done:
                self._position = position + 1
                yield batch

    def _update(self, batch: Any, reporter: _Reporter) -> None:
        for group in self._optimizer.param_groups:
            group["lr"] = self._rate()
        # Seeded by the update, so that checkpoints need no generator state.
        losses = self._objective(self._network, batch, np.random.default_rng([self._seed, self._updates]))
        self._optimizer.zero_grad()
        losses.total.backward()
        torch.nn.utils.clip_grad_norm_(self._network.parameters(), self._optimization.gradient_limit)
        self._optimizer.step()
        self._updates += 1
        reporter.add(self._updates, losses)

    def _rate(self) -> float:
        """Learning rate of the next update: linear warm-up times cosine decay."""
        settings, done = self._optimization, self._updates
        cosine = 0.5 * (1.0 + math.cos(math.pi * done / settings.updates))
        warm_up = min(1.0, (done + 1) / (settings.warm_up + 1))
        return settings.learning_rate * warm_up * (FINAL_RATE + (1.0 - FINAL_RATE) * cosine)

    def _record(self, validation: Source | None, reporter: _Reporter, watch: Watch | None) -> None:
        """Validate, and keep the weights if they are the best so far."""
        self._seconds = perf_counter() - self._begin
        record = {
            "updates": self._before.updates + self._updates,
            "seconds": self._before.seconds + self._seconds,
            "environment_steps": self._before.environment_steps,
            **reporter.means(),
        }
        if validation is not None:
            record |= {f"validation_{name}": value for name, value in self._validate(validation).items()}
        if not all(map(math.isfinite, record.values())):
            raise ValueError(
                f"training diverged: after {self._updates} updates the losses are no longer finite; "
                "reduce optimization.learning_rate"
            )
        if validation is not None and record["validation_total"] < self._best:
            self._best = record["validation_total"]
            self._best_weights = copy.deepcopy(self._network.state_dict())
        if validation is not None and self._is_done:
            self._network.load_state_dict(self._best_weights)  # those that are kept are watched last
        if watch is not None:
            record |= watch(self._network, record, self._is_done)
        self.history.append(record)
        reporter.tell(self._updates, record)
        self._begin = perf_counter() - self._seconds  # validation is no training

    def _validate(self, validation: Source) -> Record:
        rng = np.random.default_rng(self._seed)
        rows = []
        with torch.no_grad():
            batches = validation.batches(
                self._optimization.batch_size, self._objective.needs, seed=self._seed
            )
            for _, batch in zip(range(VALIDATION_BATCHES), batches, strict=False):
                losses = self._objective(self._network, batch, rng)
                rows.append([losses.total.item(), losses.action.item(), losses.gain.item()])
        return dict(zip(("total", "action", "gain"), np.mean(rows, axis=0).tolist(), strict=True))

    def _state(self) -> dict[str, Any]:
        return {
            "network": self._network.state_dict(),
            "optimizer": self._optimizer.state_dict(),
            "best_weights": self._best_weights,
            "best": self._best,
            "place": {"epoch": self._epoch, "position": self._position, "updates": self._updates},
            "seconds": self._seconds,
            "history": self.history,
        }

    def _resume(self, path: Path, content: dict[str, Any] | None) -> None:
        if content is None:
            return
        try:
            self._restore(content)
        except (AttributeError, KeyError, RuntimeError, TypeError, ValueError) as error:
            reason = f"it has no {error}" if isinstance(error, KeyError) else error
            raise CheckpointError(_DAMAGED.format(path, reason)) from error

    def _restore(self, content: dict[str, Any]) -> None:
        self._network.load_state_dict(content["network"])
        self._optimizer.load_state_dict(content["optimizer"])
        self._best_weights, self._best = content["best_weights"], content["best"]
        place = content["place"]
        self._epoch, self._position, self._updates = (
            place[name] for name in ("epoch", "position", "updates")
        )
        self._seconds, self.history = content["seconds"], content["history"]


class _Reporter:
    """Averages losses, and reports progress."""

    def __init__(self, updates: int, done: int, part: str, progress: Progress | None) -> None:
        self._updates, self._first, self._part, self._progress = updates, done, part, progress
        self._begin, self._losses = perf_counter(), Record()
        self._rows: list[tuple[float, float, float]] = []

    def add(self, done: int, losses: Losses) -> None:
        self._rows.append((losses.action.item(), losses.gain.item(), losses.augmentation.item()))
        if done % UPDATES_BETWEEN_MESSAGES == 0:
            self.tell(done)

    def means(self) -> Record:
        """Mean losses since the last call."""
        values = np.mean(self._rows, axis=0).tolist()
        self._rows.clear()
        return dict(zip(("action", "gain", "augmentation"), values, strict=True))

    def tell(self, done: int, losses: Record | None = None) -> None:
        """Report losses, by default the last ones reported."""
        self._losses = losses or self._losses
        if self._progress is not None:
            rate = (done - self._first) / (perf_counter() - self._begin)
            self._progress(TrainingAdvance(self._updates, done, rate, self._losses, self._part))


def _save_checkpoint(folder: Path, content: dict[str, Any]) -> None:
    folder.mkdir(parents=True, exist_ok=True)
    stream = io.BytesIO()
    torch.save(content, stream)
    write_atomically(folder / CHECKPOINT, stream.getvalue())


def _load_checkpoint(folder: Path, identity: dict[str, Any], records: int) -> dict[str, Any] | None:
    """Read a checkpoint of a training with this identity, if there is one; nothing in it is executed.

    Its history has so many records at most.
    """
    path = folder / CHECKPOINT
    if not path.is_file():
        return None
    try:
        content = read_tensors(read_bytes(path, MOST_BYTES), more=RECORD_BYTES * records)
        found = differences(content["identity"], identity)
    except Exception as error:  # damaged bytes make the reader raise anything
        raise CheckpointError(_DAMAGED.format(path, error)) from error
    if found:
        raise CheckpointError(f"{path} is of another training: {'; '.join(found)}. Use another folder")
    return dict(content)
