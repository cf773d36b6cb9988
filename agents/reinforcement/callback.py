"""Evaluate, write checkpoints and report progress between updates of a learner."""

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
from agents.policies import ExportedPolicy
from agents.reinforcement.checkpoint import Progress, write_checkpoint
from agents.reinforcement.lagrangian import Lagrangian
from agents.reinforcement.networks import export_policy
from agents.run_folder import BEST, DivergedError, RunFolder, validate, validation_seeds
from agents.zoo.finding import as_policy
from dq_space_arm_env import Scene


class Advance(NamedTuple):
    """Progress of a run, for display."""

    environment_steps: int  # of all copies together
    total_steps: int
    seconds: float  # training time, over all starts of the run
    evaluation: dict[str, Any] | None  # last line of the learning curve

    @property
    def done(self) -> int:
        return min(self.environment_steps, self.total_steps)

    @property
    def total(self) -> int:
        return self.total_steps

    def describe(self) -> str:
        line = f"{self.environment_steps:,} of {self.total_steps:,} steps, "
        line += f"{timedelta(seconds=round(self.seconds))}"
        if self.evaluation is not None:
            curve = self.evaluation
            line += (
                f"; success {curve['success_rate']:.0%}, cost {curve['median_cost']:.4g}, "
                f"{curve['attitude_error']:.1f} deg, {curve['position_error']:.3f} m"
            )
            if "multiplier" in curve:
                line += f", {curve['violating_episodes']:.0%} violate at a price of {curve['multiplier']:.3g}"
        return line


class TimeIsUp(Exception):  # noqa: N818 - an event, not a mistake
    """The time of a run is up; its learner has used all the data that it has gathered."""


class TrainingCallback(BaseCallback):
    """Evaluates, writes checkpoints and reports between updates; stops there when time is up."""

    def __init__(
        self,
        configuration: Configuration,
        scene: Scene,
        folder: RunFolder,
        before: Progress,
        report: Callable[[Advance], None],
    ) -> None:
        super().__init__()
        self._configuration, self._scene, self._folder = configuration, scene, folder
        self._before, self._report = before, report
        self._started = perf_counter()
        self._curve = folder.evaluations(until=before.environment_steps, names=self._measured)
        folder.write_evaluations(self._curve)
        self._best = max(map(_score, self._curve), default=None)
        schedule = configuration.schedule
        self._next_evaluation = _next(before.environment_steps, schedule.evaluate_every)
        self._next_checkpoint = _next(before.environment_steps, schedule.checkpoint_every)
        self._seeds = validation_seeds(schedule.evaluation_episodes)

    @property
    def _measured(self) -> tuple[str, ...]:
        """What the best policy is chosen by, beside what all learning curves have."""
        charged = getattr(self._configuration.algorithm, "lagrangian", None) is not None
        return ("multiplier", "violating_episodes") if charged else ()

    @property
    def progress(self) -> Progress:
        steps = self.model.num_timesteps * self._configuration.environment.action_repeat
        seconds = self._before.seconds + perf_counter() - self._started
        return self._before._replace(environment_steps=steps, seconds=seconds)

    def metadata(self) -> dict[str, Any]:
        """Metadata of the exported policy: agent, scene, configuration, provenance, training effort."""
        progress = self.progress
        effort = {
            "environment_steps": progress.environment_steps,
            "updates": gradient_steps(self.model),
            "seconds": progress.seconds_before + progress.seconds,
            "expert_solves": progress.expert_solves,
        }
        return self._folder.metadata(self._configuration, self._scene, effort)

    def export(self) -> ExportedPolicy:
        return export_policy(self.model, self.metadata())

    def check_network(self) -> None:
        """Raise `DivergedError` where a weight is no finite number, before anything of it is written."""
        with torch.no_grad():
            if not all(bool(torch.isfinite(weights).all()) for weights in self.model.policy.parameters()):
                raise self.diverged()

    def diverged(self) -> DivergedError:
        last = self._folder.checkpoint()
        kept = (
            "there is no checkpoint yet" if last is None else f"the checkpoint at {int(last.name):,} is kept"
        )
        steps, rate = self.progress.environment_steps, self._configuration.algorithm.learning_rate
        return DivergedError(
            f"{self._folder.path}: training diverged before step {steps:,}: the network yields NaN; {kept}. "
            f"Set algorithm.learning_rate below {rate:g} and train in another folder"
        )

    def _on_step(self) -> bool:
        return True

    @property
    def is_time_up(self) -> bool:
        minutes = self._configuration.schedule.minutes
        return minutes is not None and self.progress.seconds >= 60.0 * minutes

    def _on_rollout_start(self) -> None:
        # The only point where the learner has used all the data it has gathered.
        self.check_network()
        if self.is_time_up:  # the end evaluates and writes a checkpoint in any case
            raise TimeIsUp
        steps, schedule = self.progress.environment_steps, self._configuration.schedule
        if steps >= self._next_evaluation:
            self._next_evaluation = _next(steps, schedule.evaluate_every)
            self.evaluate()
        if steps >= self._next_checkpoint:
            self._next_checkpoint = _next(steps, schedule.checkpoint_every)
            self.write_checkpoint()
        self._report(self._advance())

    def write_checkpoint(self) -> None:
        progress = self.progress
        self._folder.add_checkpoint(
            progress.environment_steps, lambda folder: write_checkpoint(folder, self.model, progress)
        )

    def evaluate(self) -> None:
        """Add a line to the learning curve, and keep the policy if it is the best so far."""
        begun = perf_counter()
        found = validate(as_policy(self.model).act, self._scene, self._seeds)
        self._started += perf_counter() - begun  # flights are no training
        environment = self.model.get_env()
        if isinstance(environment, Lagrangian):
            found["multiplier"] = environment.multiplier
        line = self._add_to_curve(found)
        if self._best is None or _score(line) > self._best:
            self._best = _score(line)
            self.export().save(self._folder.path / BEST)
        self._report(self._advance())

    def _add_to_curve(self, found: dict[str, float]) -> dict[str, Any]:
        """Write an evaluation to the learning curve and TensorBoard; return its line."""
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
        return line

    def _advance(self) -> Advance:
        progress, last = self.progress, self._curve[-1] if self._curve else None
        total = self._configuration.schedule.total_steps
        return Advance(progress.environment_steps, total, progress.seconds, last)


def gradient_steps(model: BaseAlgorithm) -> int:
    """Count the gradient steps of the critics."""
    updates = int(model._n_updates)
    if not isinstance(model, PPO):
        return updates
    # Stable-Baselines3 counts passes over the data there.
    minibatches: int = math.ceil(model.n_steps * model.n_envs / model.batch_size)
    return updates * minibatches


def _score(line: dict[str, Any]) -> tuple[float, float]:
    """More successes win, less the violations if they are charged; a tie goes to the lower cost."""
    violating = line["violating_episodes"] if "multiplier" in line else 0.0
    return line["success_rate"] - violating, -line["median_cost"]


def _next(steps: int, every: int) -> int:
    return (steps // every + 1) * every
