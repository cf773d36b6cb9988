"""What is done now and then while an agent learns: evaluations, checkpoints, and saying how it goes."""

import math
from collections.abc import Callable
from datetime import timedelta
from time import perf_counter
from typing import Any, NamedTuple

import torch
from stable_baselines3 import PPO
from stable_baselines3.common.base_class import BaseAlgorithm
from stable_baselines3.common.callbacks import BaseCallback

from agents.configuration import Configuration
from agents.evaluation.policies import as_policy
from agents.policies import ExportedPolicy
from agents.reinforcement.checkpoints import Progress, write_checkpoint
from agents.reinforcement.export import export_policy
from agents.run_folder import BEST, RunFolder
from agents.validation import validate, validation_seeds
from dq_space_arm_env import Scene


class Advance(NamedTuple):
    """How far a training run has come.

    Attributes:
        environment_steps: Of all copies together.
        total_steps: Those that were asked for.
        seconds: Time spent on it, in all of its starts, s.
        evaluation: The last line of the learning curve, None before the first.
    """

    environment_steps: int
    total_steps: int
    seconds: float
    evaluation: dict[str, Any] | None

    @property
    def done(self) -> int:
        """Environment steps, as many as were asked for at most."""
        return min(self.environment_steps, self.total_steps)

    @property
    def total(self) -> int:
        """Environment steps that were asked for."""
        return self.total_steps

    def describe(self) -> str:
        """Put into one line how far it has come.

        Returns:
            The line.
        """
        line = f"{self.environment_steps:,} of {self.total_steps:,} steps, "
        line += f"{timedelta(seconds=round(self.seconds))}"
        if self.evaluation is not None:
            curve = self.evaluation
            line += (
                f"; success {curve['success_rate']:.0%}, cost {curve['median_cost']:.4g}, "
                f"{curve['attitude_error']:.1f} deg, {curve['position_error']:.3f} m"
            )
        return line


class DivergedError(RuntimeError):
    """A training has run away: its network no longer gives numbers."""


class Watcher(BaseCallback):
    """Evaluates, writes checkpoints, and reports, between updates of the learner."""

    def __init__(
        self,
        configuration: Configuration,
        scene: Scene,
        folder: RunFolder,
        before: Progress,
        report: Callable[[Advance], None],
    ) -> None:
        """Set up.

        Args:
            configuration: Of the agent.
            scene: Its scene.
            folder: Folder of the run.
            before: How far the run had come when it was resumed.
            report: Called between updates.
        """
        super().__init__()
        self._configuration, self._scene, self._folder = configuration, scene, folder
        self._before, self._report = before, report
        self._started = perf_counter()
        self._curve = folder.evaluations(until=before.environment_steps)
        folder.write_evaluations(self._curve)
        self._best = max(map(_score, self._curve), default=None)
        schedule = configuration.schedule
        self._next_evaluation = _next(before.environment_steps, schedule.evaluate_every)
        self._next_checkpoint = _next(before.environment_steps, schedule.checkpoint_every)
        self._seeds = validation_seeds(schedule.evaluation_episodes)

    @property
    def progress(self) -> Progress:
        """How far the run has come."""
        steps = self.model.num_timesteps * self._configuration.environment.action_repeat
        seconds = self._before.seconds + perf_counter() - self._started
        return self._before._replace(environment_steps=steps, seconds=seconds)

    def metadata(self) -> dict[str, Any]:
        """Describe how the policy was trained so far, for its file.

        Returns:
            JSON values.
        """
        progress = self.progress
        return {
            "agent": self._configuration.name,
            "scene": self._scene.name,
            "scene_hash": self._scene.content_hash(),
            "configuration": self._configuration.model_dump(mode="json", exclude_none=True),
            "provenance": self._folder.provenance,
            "training": {
                "environment_steps": progress.environment_steps,
                "updates": gradient_steps(self.model),
                "seconds": progress.seconds_before + progress.seconds,
                "expert_solves": progress.expert_solves,
            },
        }

    def export(self) -> ExportedPolicy:
        """Write the policy, as it is at the moment, as arrays.

        Returns:
            The policy.
        """
        return export_policy(self.model, self.metadata())

    def check_network(self) -> None:
        """Refuse to go on with a network that is no longer made of numbers; nothing of it is written.

        Raises:
            DivergedError: If it is not.
        """
        with torch.no_grad():
            if not all(bool(torch.isfinite(weights).all()) for weights in self.model.policy.parameters()):
                raise self.diverged()

    def diverged(self) -> DivergedError:
        """Say where a training has diverged, and what is kept.

        Returns:
            The error, to be raised.
        """
        last = self._folder.checkpoint()
        kept = (
            "there is no checkpoint yet" if last is None else f"the checkpoint at {int(last.name):,} is kept"
        )
        steps, rate = self.progress.environment_steps, self._configuration.algorithm.learning_rate
        return DivergedError(
            f"{self._folder.path}: the training has diverged before step {steps:,}, its network no longer "
            f"gives numbers; {kept}. Let algorithm.learning_rate be smaller than {rate:g}, in another folder"
        )

    def _on_step(self) -> bool:
        return not self.is_time_up

    @property
    def is_time_up(self) -> bool:
        """Whether the run has had the time that it may take; without a limit it never has."""
        minutes = self._configuration.schedule.minutes
        return minutes is not None and self.progress.seconds >= 60.0 * minutes

    def _on_rollout_start(self) -> None:
        """Here, and only here, all that was seen has been learned from."""
        self.check_network()
        steps, schedule = self.progress.environment_steps, self._configuration.schedule
        if steps >= self._next_evaluation:
            self._next_evaluation = _next(steps, schedule.evaluate_every)
            self.evaluate()
        if steps >= self._next_checkpoint:
            self._next_checkpoint = _next(steps, schedule.checkpoint_every)
            self.write_checkpoint()
        self._report(self._advance())

    def write_checkpoint(self) -> None:
        """Write all that the run needs to go on."""
        progress = self.progress
        self._folder.add_checkpoint(
            progress.environment_steps, lambda folder: write_checkpoint(folder, self.model, progress)
        )

    def evaluate(self) -> None:
        """Add a line to the learning curve, and keep the policy if it is the best so far."""
        found = validate(as_policy(self.model).act, self._scene, self._seeds)
        progress = self.progress
        line = {
            "environment_steps": progress.environment_steps,
            "seconds": round(progress.seconds_before + progress.seconds, 3),
            **found,
        }
        self._curve.append(line)
        self._folder.write_evaluations(self._curve)
        for name, value in found.items():
            self.logger.record(f"evaluation/{name}", value)
        self.logger.dump(self.model.num_timesteps)
        if self._best is None or _score(line) > self._best:
            self._best = _score(line)
            self.export().save(self._folder.path / BEST)
        self._report(self._advance())

    def _advance(self) -> Advance:
        progress, last = self.progress, self._curve[-1] if self._curve else None
        total = self._configuration.schedule.total_steps
        return Advance(progress.environment_steps, total, progress.seconds, last)


def gradient_steps(model: BaseAlgorithm) -> int:
    """Count the gradient steps of a learner.

    Args:
        model: The learner.

    Returns:
        Steps of its critics.
    """
    updates = int(model._n_updates)
    if not isinstance(model, PPO):
        return updates
    # Stable-Baselines3 counts passes there.
    minibatches: int = math.ceil(model.n_steps * model.n_envs / model.batch_size)
    return updates * minibatches


def _score(line: dict[str, Any]) -> tuple[float, float]:
    """The more successes the better; of as many, the cheaper."""
    return line["success_rate"], -line["median_cost"]


def _next(steps: int, every: int) -> int:
    return (steps // every + 1) * every
