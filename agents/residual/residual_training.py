"""Training of corrections, from a configuration to a policy."""

import os
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
from pydantic import ValidationError
from stable_baselines3.common.base_class import BaseAlgorithm
from torch import nn

from agents.configuration import ConfigurationError
from agents.configuration.residual import ResidualConfiguration
from agents.demonstrations import check_gains, expert_seconds, prepare_demonstrations
from agents.evaluation.plan_followers import follower
from agents.evaluation.plans import Plans
from agents.policies import ExportedPolicy
from agents.reinforcement.callback import TrainingCallback
from agents.reinforcement.checkpoint import Progress
from agents.reinforcement.networks import export_policy
from agents.reinforcement.reinforcement_training import Trained, make_learner, train_learner
from agents.reinforcement.training_environment import held_environment, largest_actions
from agents.residual.corrections import correction
from agents.residual.environment import ResidualVectorEnv
from agents.residual.mismatch import Worlds, fly_mismatched
from agents.run_folder import BEST, DEMONSTRATIONS, RunFolder
from agents.vec_env import SB3VecEnv
from agents.wrappers.shaping import action_scale
from agents.wrappers.vector import ShapeReward
from dq_space_arm_env import Scene, load_scene
from dq_space_arm_env.common.progress import Advance
from dq_space_arm_env.environment.disturbances import with_loads
from dq_space_arm_env.validation.problems import problem_list
from experts.demonstrations import Demonstrations

VALIDATION_SEED = 1
"""Seed of the worlds of evaluations during training."""
VALIDATION_SHARE = 0.2
"""Largest share of the demonstrations held out for evaluations."""


def train_residual(
    configuration: ResidualConfiguration,
    out: str | os.PathLike[str],
    report: Callable[[Advance], None] = lambda advance: None,
) -> Trained:
    """Train a correction; an interrupted run resumes from its last checkpoint."""
    scene = load_scene(configuration.scene)
    # What is wrong is said before any problem is solved.
    try:
        learner = configuration.learner()
    except ValidationError as error:
        raise ConfigurationError(problem_list(f"configuration {configuration.name!r}", error)) from error
    largest_actions(configuration.environment.action_scale, scene)
    with_loads(scene, configuration.mismatch.mass_factors)
    folder = RunFolder(Path(out), configuration)
    demonstrations = prepare_demonstrations(
        configuration.demonstrations, scene, folder.path / DEMONSTRATIONS, progress=report
    )
    check_gains(demonstrations, "corrected plans fly with: generate others")
    practiced, kept = split(demonstrations, configuration.schedule.evaluation_episodes)
    environment = make_residual_environment(configuration, scene, practiced)

    def begin() -> tuple[BaseAlgorithm, Progress]:
        model = make_learner(learner, environment)
        silence(model)
        return model, Progress(0, 0.0, demonstrations.settings["problems"], expert_seconds(demonstrations))

    return train_learner(
        learner,
        folder,
        environment,
        begin,
        lambda before: ResidualCallback(configuration, scene, folder, before, report, kept),
    )


def split(demonstrations: Demonstrations, episodes: int) -> tuple[Demonstrations, Demonstrations]:
    """Demonstrations to train on, and held-out ones for evaluations; a single one serves for both."""
    kept = min(episodes, int(VALIDATION_SHARE * len(demonstrations)))
    first = max(1, len(demonstrations) - kept)
    return demonstrations[:first], demonstrations[min(first, len(demonstrations) - 1) :]


def make_residual_environment(
    configuration: ResidualConfiguration, scene: Scene, demonstrations: Demonstrations
) -> SB3VecEnv:
    """The environment that a correction is trained in."""
    practice = configuration.environment
    scale = action_scale(largest_actions(practice.action_scale, scene), scene)
    environment = ResidualVectorEnv(
        demonstrations,
        scene,
        practice.copies,
        mismatch=configuration.mismatch,
        action_scale=scale,
        memory=practice.memory,
        full_authority=practice.full_authority,
        cost_power=practice.cost_power,
        seed=configuration.seed,
    )
    held = held_environment(environment, practice.action_repeat)
    return SB3VecEnv(ShapeReward(held, practice.reward_scale))


def silence(model: BaseAlgorithm) -> None:
    """Zero the last layer, so that learning begins with the plan and its gains."""
    policy: Any = model.policy
    last = policy.action_net if hasattr(policy, "action_net") else policy.actor.mu
    nn.init.zeros_(last.weight)
    nn.init.zeros_(last.bias)


class ResidualCallback(TrainingCallback):
    """Evaluates corrections relative to the plan with its gains alone, in the same worlds."""

    def __init__(
        self,
        configuration: ResidualConfiguration,
        scene: Scene,
        folder: RunFolder,
        before: Progress,
        report: Callable[[Advance], None],
        demonstrations: Demonstrations,
    ) -> None:
        super().__init__(configuration.learner(), scene, folder, before, report)
        self._residual = configuration
        # If there are fewer plans than episodes, they are flown several times, in different worlds.
        episodes = configuration.schedule.evaluation_episodes
        self._plans = Plans.of(demonstrations).choose(np.resize(np.arange(len(demonstrations)), episodes))
        self._worlds = Worlds.drawn(configuration.mismatch, episodes, VALIDATION_SEED)
        plan = follower(scene, self._plans, feedback=True)
        self._uncorrected = fly_mismatched(plan, scene, self._plans, self._worlds)
        self._best_saving = max((line["saving"] for line in self._curve), default=-np.inf)

    @property
    def _measured(self) -> tuple[str, ...]:
        return ("saving",)

    def metadata(self) -> dict[str, Any]:
        """Metadata of the policy's file: its training so far, and how it flies."""
        practice = self._residual.environment
        return super().metadata() | {
            "configuration": self._residual.model_dump(mode="json", exclude_none=True),
            "residual": {
                "action_scale": action_scale(
                    largest_actions(practice.action_scale, self._scene), self._scene
                ).tolist(),
                "repeat": practice.action_repeat,
                "memory": practice.memory,
                "full_authority": practice.full_authority,
            },
        }

    def export(self) -> ExportedPolicy:
        """The policy as arrays."""
        policy = export_policy(self.model, {})
        return replace(policy, metadata={**self.metadata(), "observation": "residual"})

    def evaluate(self) -> None:
        """Add a point to the learning curve, and save the policy if it is the best so far."""
        policy = self.export()
        corrected = correction(policy, self._scene, self._plans)
        flown = fly_mismatched(corrected, self._scene, self._plans, self._worlds)
        base = self._uncorrected
        ratio = flown.cost / base.cost
        saved = 1.0 - float(np.exp(np.mean(np.log(ratio))))
        self._add_to_curve(
            {
                "success_rate": float(np.mean(flown.is_success)),
                "median_cost": float(np.median(flown.cost)),
                "attitude_error": float(np.median(flown.attitude_error)),
                "position_error": float(np.median(flown.position_error)),
                "uncorrected_success_rate": float(np.mean(base.is_success)),
                "uncorrected_median_cost": float(np.median(base.cost)),
                "saving": saved,
                "median_saving": 1.0 - float(np.median(ratio)),
                "share_better": float(np.mean(ratio < 1.0)),
            }
        )
        if saved > self._best_saving:
            self._best_saving = saved
            policy.save(self._folder.path / BEST)
        self._report(self._advance())
