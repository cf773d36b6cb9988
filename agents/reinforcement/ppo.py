"""Proximal policy optimization with a first phase for the critic, and steps as large as the policy bears."""

from typing import Any

import numpy as np
from stable_baselines3 import PPO
from stable_baselines3.common.utils import explained_variance
from torch import nn
from torch.optim import Optimizer

GROWTH = 1.3
"""Factor by which the step size changes from one update to the next at most."""
LEAST, MOST = 0.01, 1.0
"""Bounds of the step size, as fractions of the schedule's."""


class ProximalPolicyOptimization(PPO):
    """PPO of Stable-Baselines3 with two additions, both of which are off by default.

    A policy that was cloned knows what to do before its critic knows what that is worth, and the first
    advantages, all noise, would undo what it knows: so the critic may learn alone for some updates.

    The deviation of actions falls by an order of magnitude in training, and with it the size of a step that
    leaves the policy close to what it was: so the actor's step size may follow the divergence that it
    causes, within what the schedule allows. The idea is that of Rudin et al. ("Learning to walk in minutes",
    CoRL 2021); what is done is not quite theirs. They change the step size of actor and critic from minibatch
    to minibatch by a factor of 1.5 where the exact divergence leaves a band. Here it changes between updates,
    for the actor alone, by the root of desired over estimated divergence, which grows with the square of the
    step; the estimate is that of Stable-Baselines3, the mean over the minibatches of the last pass.

    Attributes:
        critic_warm_up: Updates in which the critic learns alone.
        desired_kl: Divergence of the policy that an update is to cause; None for steps by the schedule.
        step_factor: What the schedule's step size is multiplied by for the actor, in [LEAST, MOST].
    """

    def __init__(
        self,
        *arguments: Any,
        critic_warm_up: int = 0,
        desired_kl: float | None = None,
        first_step_factor: float = 1.0,
        **options: Any,
    ) -> None:
        """Make a learner.

        Args:
            *arguments: As for PPO.
            critic_warm_up: Updates in which the critic learns alone.
            desired_kl: Divergence of the policy that an update is to cause, mean over the minibatches of its
                last pass; None for steps by the schedule.
            first_step_factor: See `step_factor`.
            **options: As for PPO.
        """
        self.critic_warm_up, self.desired_kl, self.step_factor = critic_warm_up, desired_kl, first_step_factor
        super().__init__(*arguments, **options)

    def train(self) -> None:
        """Learn from the decisions gathered last."""
        # SB3 counts passes; while the critic warms up, none is cut short.
        if self._n_updates < self.critic_warm_up * self.n_epochs:
            self._train_critic()
            return
        super().train()
        if self.desired_kl is not None:
            divergence = float(self.logger.name_to_value["train/approx_kl"])
            factor = self.step_factor * float(
                np.clip(np.sqrt(self.desired_kl / max(divergence, 1e-12)), 1.0 / GROWTH, GROWTH)
            )
            self.step_factor = float(np.clip(factor, LEAST, MOST))

    def _train_critic(self) -> None:
        self.policy.set_training_mode(True)
        self._update_learning_rate(self.policy.optimizer)
        losses = []
        for _ in range(self.n_epochs):
            for data in self.rollout_buffer.get(self.batch_size):
                values = self.policy.predict_values(data.observations).flatten()
                loss = nn.functional.mse_loss(values, data.returns)
                self.policy.optimizer.zero_grad()
                (self.vf_coef * loss).backward()
                # The actor has no gradients, and Adam leaves alone what has none.
                nn.utils.clip_grad_norm_(self.policy.parameters(), self.max_grad_norm)
                self.policy.optimizer.step()
                losses.append(loss.item())
            self._n_updates += 1
        buffer = self.rollout_buffer
        self.logger.record("train/value_loss", np.mean(losses))
        self.logger.record(
            "train/explained_variance", explained_variance(buffer.values.flatten(), buffer.returns.flatten())
        )

    def _update_learning_rate(self, optimizers: list[Optimizer] | Optimizer) -> None:
        super()._update_learning_rate(optimizers)
        if self.desired_kl is not None:
            # The first group is the actor, see ScaledActionsPolicy; the critic goes by the schedule.
            group = self.policy.optimizer.param_groups[0]
            group["lr"] *= self.step_factor
            self.logger.record("train/actor_learning_rate", group["lr"])
