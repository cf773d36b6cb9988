"""Proximal policy optimization with a critic warm-up and an adaptive actor step size."""

from typing import Any

import numpy as np
from stable_baselines3 import PPO
from stable_baselines3.common.utils import explained_variance
from torch import nn
from torch.optim import Optimizer

from agents.reinforcement.lagrangian import Lagrangian

GROWTH = 1.3  # largest change of the step size from one update to the next, a factor
LEAST, MOST = 0.01, 1.0  # bounds of the step size, as fractions of the schedule's


class ProximalPolicyOptimization(PPO):
    """PPO of Stable-Baselines3 with two additions, both off by default.

    A cloned policy knows what to do before its critic knows what that is worth, and the first advantages, all
    noise, would undo the cloning: the critic may learn alone for `critic_warm_up` updates.

    The standard deviation of actions falls by an order of magnitude during training, and with it the step
    that keeps the policy close: with `desired_kl` the actor's step size follows the KL divergence it causes.
    The idea is that of Rudin et al. ("Learning to Walk in Minutes", CoRL 2021), who change actor and critic
    steps per minibatch by a factor of 1.5 where the exact divergence leaves a band. Here the actor's step
    changes between updates, by the square root of desired over estimated divergence, which grows with the
    square of the step; the estimate is Stable-Baselines3's mean over the minibatches of the last pass.
    """

    def __init__(
        self,
        *arguments: Any,
        critic_warm_up: int = 0,
        desired_kl: float | None = None,
        first_step_factor: float = 1.0,
        **options: Any,
    ) -> None:
        self.critic_warm_up, self.desired_kl, self.step_factor = critic_warm_up, desired_kl, first_step_factor
        super().__init__(*arguments, **options)

    def train(self) -> None:
        if isinstance(self.env, Lagrangian):
            self.env.ascend()
            self.logger.record("lagrangian/multiplier", self.env.multiplier)
            self.logger.record("lagrangian/violating_episodes", self.env.violating_episodes)
        # SB3 counts passes over the data; none is cut short while the critic warms up.
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
                # The actor has no gradients, and Adam skips parameters without.
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
            # The first group is the actor, see ScaledActionsPolicy; the critic follows the schedule.
            group = self.policy.optimizer.param_groups[0]
            group["lr"] *= self.step_factor
            self.logger.record("train/actor_learning_rate", group["lr"])
