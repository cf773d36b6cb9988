"""Training a correction, from a configuration to a policy."""

import os
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
from stable_baselines3.common.base_class import BaseAlgorithm
from torch import nn

from agents.configuration.residual import ResidualConfiguration
from agents.demonstrations import expert_seconds, prepare_demonstrations
from agents.plans import Plans
from agents.policies import ExportedPolicy
from agents.reinforcement.building import action_scale, make_learner
from agents.reinforcement.checkpoints import Progress
from agents.reinforcement.export import export_policy
from agents.reinforcement.held_actions import HeldActions
from agents.reinforcement.training import Trained, train_learner
from agents.reinforcement.watching import Advance, Watcher
from agents.residual.controllers import Corrected, GainScheduled
from agents.residual.environment import ResidualVecEnv
from agents.residual.flights import Adversity, fly
from agents.run_folder import BEST, DEMONSTRATIONS, RunFolder
from dq_space_arm_env import Scene, load_scene
from experts.demonstrations import Demonstrations

VALIDATION_SEED = 1
"""Of the worlds of evaluations during training."""
VALIDATION_SHARE = 0.2
"""Share of the demonstrations whose starts are kept for evaluations, at most."""


def train_residual(
    configuration: ResidualConfiguration,
    out: str | os.PathLike[str],
    report: Callable[[Advance], None] = lambda advance: None,
) -> Trained:
    """Train a correction; a run that was interrupted or killed goes on at its last checkpoint.

    Args:
        configuration: Of the agent.
        out: Folder of the run; made if it does not exist.
        report: Called between updates.

    Returns:
        The trained agent. Its policy chooses corrections; `agents.residual.controllers.Corrected` flies it.

    Raises:
        SceneError: If the scene cannot be loaded.
        ValueError: If it draws targets or masses, or has no masses that could be others.
        DemonstrationsError: If demonstrations cannot be made or read, or are of another scene.
        RunFolderError: If the folder is for another configuration.
        KeyboardInterrupt: If the user interrupts it; the last checkpoint remains.
    """
    scene = load_scene(configuration.scene)
    folder = RunFolder(Path(out), configuration)
    demonstrations = prepare_demonstrations(configuration.demonstrations, scene, folder.path / DEMONSTRATIONS)
    practiced, kept = split(demonstrations, configuration.schedule.evaluation_episodes)
    environment = make_residual_environment(configuration, scene, practiced)
    learner = configuration.learner()

    def begin() -> tuple[BaseAlgorithm, Progress]:
        model = make_learner(learner, environment)
        silence(model)
        return model, Progress(0, 0.0, demonstrations.settings["problems"], expert_seconds(demonstrations))

    return train_learner(
        learner,
        folder,
        environment,
        begin,
        lambda before: ResidualWatcher(configuration, scene, folder, before, report, kept),
    )


def split(demonstrations: Demonstrations, episodes: int) -> tuple[Demonstrations, Demonstrations]:
    """Keep some demonstrations for evaluations.

    Args:
        demonstrations: All of them.
        episodes: How many to keep, if there are enough.

    Returns:
        Those to practice on, and those that are kept; the same one for both if there is one only.
    """
    kept = min(episodes, int(VALIDATION_SHARE * len(demonstrations)))
    first = max(1, len(demonstrations) - kept)
    return demonstrations[:first], demonstrations[min(first, len(demonstrations) - 1) :]


def make_residual_environment(
    configuration: ResidualConfiguration, scene: Scene, demonstrations: Demonstrations
) -> HeldActions:
    """Make the environment that a correction is practiced in.

    Args:
        configuration: Of the agent.
        scene: Its scene.
        demonstrations: Plans to correct.

    Returns:
        The environment.

    Raises:
        ValueError: If the scene has no masses that could be others.
    """
    practice = configuration.environment
    scale = action_scale(practice.action_scale, scene)
    environment = ResidualVecEnv(
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
    return HeldActions(
        environment, repeat=practice.action_repeat, action_scale=scale, reward_scale=practice.reward_scale
    )


def silence(model: BaseAlgorithm) -> None:
    """Let a policy correct nothing, so that learning begins with the plan and its gains.

    Args:
        model: Of PPO or SAC; its last layer becomes zero.
    """
    policy: Any = model.policy
    last = policy.action_net if hasattr(policy, "action_net") else policy.actor.mu
    nn.init.zeros_(last.weight)
    nn.init.zeros_(last.bias)


class ResidualWatcher(Watcher):
    """Evaluates corrections beside the plan with its gains alone, in the same worlds."""

    def __init__(
        self,
        configuration: ResidualConfiguration,
        scene: Scene,
        folder: RunFolder,
        before: Progress,
        report: Callable[[Advance], None],
        demonstrations: Demonstrations,
    ) -> None:
        """Set up.

        Args:
            configuration: Of the agent.
            scene: Its scene.
            folder: Folder of the run.
            before: How far the run had come when it was resumed.
            report: Called between updates.
            demonstrations: Plans of the flights by which it is judged; it has not practiced on them.
        """
        super().__init__(configuration.learner(), scene, folder, before, report)
        self._residual = configuration
        # Fewer plans than episodes are flown several times, in different worlds.
        episodes = configuration.schedule.evaluation_episodes
        self._plans = Plans.of(demonstrations).choose(np.resize(np.arange(len(demonstrations)), episodes))
        self._adversity = Adversity.drawn(configuration.mismatch, episodes, VALIDATION_SEED)
        self._uncorrected = fly(GainScheduled(scene), scene, self._plans, self._adversity)
        self._best_saving = max((line["saving"] for line in self._curve), default=-np.inf)

    def metadata(self) -> dict[str, Any]:
        """Describe how the policy was trained so far, and how it flies, for its file.

        Returns:
            JSON values.
        """
        practice = self._residual.environment
        return super().metadata() | {
            "configuration": self._residual.model_dump(mode="json", exclude_none=True),
            "residual": {
                "action_scale": action_scale(practice.action_scale, self._scene).tolist(),
                "repeat": practice.action_repeat,
                "memory": practice.memory,
                "full_authority": practice.full_authority,
            },
        }

    def export(self) -> ExportedPolicy:
        """Write the policy as arrays.

        Returns:
            The policy.
        """
        policy = export_policy(self.model, {})
        return replace(policy, metadata={**self.metadata(), "observation": "residual"})

    def evaluate(self) -> None:
        """Add a line to the learning curve, and keep the policy if it is the best so far."""
        policy = self.export()
        flown = fly(Corrected.by(policy, self._scene), self._scene, self._plans, self._adversity)
        progress, base = self.progress, self._uncorrected
        ratio = flown.cost / base.cost
        saved = 1.0 - float(np.exp(np.mean(np.log(ratio))))
        line = {
            "environment_steps": progress.environment_steps,
            "seconds": round(progress.seconds_before + progress.seconds, 3),
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
        self._curve.append(line)
        self._folder.write_evaluations(self._curve)
        for name in line.keys() - {"environment_steps", "seconds"}:
            self.logger.record(f"evaluation/{name}", line[name])
        self.logger.dump(self.model.num_timesteps)
        if saved > self._best_saving:
            self._best_saving = saved
            policy.save(self._folder.path / BEST)
        self._report(self._advance())
