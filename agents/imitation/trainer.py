"""Steps of an optimizer on demonstrations, with validations and checkpoints."""

from __future__ import annotations

import copy
import math
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from time import perf_counter
from typing import Any

import numpy as np
import torch

from agents.configuration.imitation import Optimization
from agents.imitation.checkpoints import load_checkpoint, save_checkpoint
from agents.imitation.objective import Losses, Objective
from agents.imitation.progress import TrainingAdvance
from agents.imitation.samples import Source
from agents.policies.network import PolicyNetwork
from agents.progress import Advance

VALIDATION_BATCHES = 32
"""Batches that a validation looks at, at most; their time steps are the same every time."""
UPDATES_BETWEEN_MESSAGES = 20
LAST_RATE = 1e-3
"""Learning rate at the end, relative to the largest one."""

Record = dict[str, float]
Progress = Callable[[Advance], None]
Watch = Callable[[PolicyNetwork, Record, bool], Record]
"""Looks at a network between updates, given the record of a validation and whether it is the last one; what
it returns is added to the record."""


@dataclass(frozen=True)
class Spent:
    """What a network has cost before a training.

    Attributes:
        updates: Steps of an optimizer.
        seconds: Time, s.
        environment_steps: That it has flown to be corrected.
    """

    updates: float = 0.0
    seconds: float = 0.0
    environment_steps: float = 0.0


@contextmanager
def torch_threads(count: int) -> Iterator[None]:
    """Have PyTorch use some threads inside a `with` block.

    Args:
        count: Number of threads.
    """
    before = torch.get_num_threads()
    torch.set_num_threads(count)
    try:
        yield
    finally:
        torch.set_num_threads(before)


class Trainer:
    """Trains a network with an objective.

    Attributes:
        history: Losses at every validation, beside what was spent until then, under the names of `Spent`.
    """

    def __init__(
        self,
        network: PolicyNetwork,
        objective: Objective,
        optimization: Optimization,
        *,
        validate_every: int,
        seed: int,
        part: str = "",
        before: Spent | None = None,
    ) -> None:
        """Begin.

        Args:
            network: What to train.
            objective: What to minimize.
            optimization: How.
            validate_every: Updates between validations, each with a checkpoint.
            seed: Of everything that is drawn.
            part: Name of the training among others, for messages.
            before: What others have spent on the network; nothing by default.
        """
        self._network, self._objective, self._optimization = network, objective, optimization
        self._validate_every, self._seed, self._part = validate_every, seed, part
        self._before = before or Spent()
        # One kernel for all parameters: for small networks the calls count, not the numbers.
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
        """Train until the updates are used up.

        Args:
            training: What to learn from.
            validation: What to judge by; None for nothing, and the last weights are the result.
            folder: Where to keep a checkpoint, and to look for one to go on from; None for none.
            identity: What the training follows from.
            progress: Called now and then.
            watch: Called at every validation.

        Raises:
            ValueError: If the training diverges.
            CheckpointError: If the folder holds the checkpoint of another training, or a damaged one.
        """
        if folder is not None:
            self._resume(load_checkpoint(folder, identity))
        self._begin = perf_counter() - self._seconds
        reporter = _Reporter(self._optimization.updates, self._updates, self._part, progress)
        while self._updates < self._optimization.updates:
            for batch in self._rest_of_a_pass(training):
                self._update(batch, reporter)
                if self._updates % self._validate_every == 0 or self._is_done:
                    self._look(validation, reporter, watch)
                    if folder is not None:
                        save_checkpoint(folder, {"identity": identity, **self._state()})
                if self._is_done:
                    break
            else:
                self._epoch, self._position = self._epoch + 1, 0
        if validation is not None:
            self._network.load_state_dict(self._best_weights)

    @property
    def _is_done(self) -> bool:
        return self._updates == self._optimization.updates

    def _rest_of_a_pass(self, training: Source) -> Iterator[Any]:
        """Go through the data once; its order follows from the number of the pass."""
        order = int(np.random.SeedSequence([self._seed, self._epoch]).generate_state(1)[0])
        batches = training.batches(
            self._optimization.batch_size, self._objective.needs, seed=order, drop_last=False
        )
        done = self._position
        for position, batch in enumerate(batches):
            if position >= done:
                self._position = position + 1
                yield batch

    def _update(self, batch: Any, reporter: _Reporter) -> None:
        for group in self._optimizer.param_groups:
            group["lr"] = self._rate()
        # What is drawn follows from the number of the update, so that no generator is kept.
        losses = self._objective(self._network, batch, np.random.default_rng([self._seed, self._updates]))
        self._optimizer.zero_grad()
        losses.total.backward()
        torch.nn.utils.clip_grad_norm_(self._network.parameters(), self._optimization.gradient_limit)
        self._optimizer.step()
        self._updates += 1
        reporter.add(self._updates, losses)

    def _rate(self) -> float:
        """Learning rate of the next update: a linear rise, then half a cosine."""
        settings, done = self._optimization, self._updates
        cosine = 0.5 * (1.0 + math.cos(math.pi * done / settings.updates))
        rise = min(1.0, (done + 1) / (settings.warm_up + 1))
        return settings.learning_rate * rise * (LAST_RATE + (1.0 - LAST_RATE) * cosine)

    def _look(self, validation: Source | None, reporter: _Reporter, watch: Watch | None) -> None:
        """Validate, and remember the weights if they are the best so far."""
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
                f"after {self._updates} updates the losses are no numbers any more: let "
                "optimization.learning_rate be smaller"
            )
        if validation is not None and record["validation_total"] < self._best:
            self._best = record["validation_total"]
            self._best_weights = copy.deepcopy(self._network.state_dict())
        if watch is not None:
            record |= watch(self._network, record, self._is_done)
        self.history.append(record)
        reporter.tell(self._updates, record)

    def _validate(self, validation: Source) -> Record:
        rng = np.random.default_rng(self._seed)
        rows = []
        with torch.no_grad():
            batches = validation.batches(
                self._optimization.batch_size, self._objective.needs, seed=self._seed, drop_last=False
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

    def _resume(self, content: dict[str, Any] | None) -> None:
        if content is None:
            return
        self._network.load_state_dict(content["network"])
        self._optimizer.load_state_dict(content["optimizer"])
        self._best_weights, self._best = content["best_weights"], content["best"]
        place = content["place"]
        self._epoch, self._position, self._updates = (
            place[name] for name in ("epoch", "position", "updates")
        )
        self._seconds, self.history = content["seconds"], content["history"]


class _Reporter:
    """Averages losses and tells them."""

    def __init__(self, updates: int, done: int, part: str, progress: Progress | None) -> None:
        self._updates, self._first, self._part, self._progress = updates, done, part, progress
        self._begin, self._losses = perf_counter(), Record()
        self._rows: list[tuple[float, float, float]] = []

    def add(self, done: int, losses: Losses) -> None:
        self._rows.append((losses.action.item(), losses.gain.item(), losses.augmentation.item()))
        if done % UPDATES_BETWEEN_MESSAGES == 0:
            self.tell(done)

    def means(self) -> Record:
        """Means of the losses since the last time."""
        values = np.mean(self._rows, axis=0).tolist()
        self._rows.clear()
        return dict(zip(("action", "gain", "augmentation"), values, strict=True))

    def tell(self, done: int, losses: Record | None = None) -> None:
        """Call back; losses that are not given are those of the last time."""
        self._losses = losses or self._losses
        if self._progress is not None:
            rate = (done - self._first) / (perf_counter() - self._begin)
            self._progress(TrainingAdvance(self._updates, done, rate, self._losses, self._part))
