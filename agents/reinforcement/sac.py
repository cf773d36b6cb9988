"""Soft actor-critic that also learns from demonstrations, with its replay buffer.

Part of each batch is demonstrated, after Ball et al., "Efficient Online Reinforcement Learning with Offline
Data" (ICML 2023). The actor may be drawn to demonstrated actions as in Fujimoto and Gu, "A Minimalist
Approach to Offline Reinforcement Learning" (NeurIPS 2021).
"""

from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from stable_baselines3 import SAC
from stable_baselines3.common.buffers import ReplayBuffer
from stable_baselines3.common.type_aliases import ReplayBufferSamples
from stable_baselines3.common.utils import polyak_update
from stable_baselines3.common.vec_env import VecNormalize
from torch import Tensor
from torch.nn.functional import mse_loss

from agents.reinforcement.off_policy import FallingEntropy
from agents.reinforcement.warm_start import Flown


class DemonstrationBuffer(ReplayBuffer):
    """A replay buffer that fills the end of each batch with demonstrated transitions, a `share` of it."""

    def __init__(self, *arguments: Any, **options: Any) -> None:
        super().__init__(*arguments, **options)
        self.share = 0.0
        self._demonstrated: tuple[NDArray[np.float32], ...] = ()

    def demonstrate(self, flown: Flown, unit: NDArray[np.float32], share: float) -> None:
        """Add demonstrations; actions are kept in fractions of `unit`, the agent's largest, shape (n_u,)."""
        self.share = share
        columns = (
            flown.observations,
            flown.actions / unit,
            flown.next_observations,
            flown.done[:, None],
            flown.rewards[:, None],
        )
        self._demonstrated = tuple(np.asarray(column, dtype=np.float32) for column in columns)

    def demonstrated(self, batch_size: int) -> int:
        """Number of demonstrated transitions in a batch."""
        return round(self.share * batch_size)

    def sample(self, batch_size: int, env: VecNormalize | None = None) -> ReplayBufferSamples:
        """Draw a batch, demonstrated transitions last."""
        count = self.demonstrated(batch_size)
        own = super().sample(batch_size - count, env)
        if not count:
            return own
        # The generator that SB3's buffers draw from, which its seed sets.
        rows = np.random.randint(len(self._demonstrated[0]), size=count)  # noqa: NPY002
        others = (self.to_torch(column[rows]) for column in self._demonstrated)
        parts = (own.observations, own.actions, own.next_observations, own.dones, own.rewards)
        return ReplayBufferSamples(*(torch.cat(pair) for pair in zip(parts, others, strict=True)))


class SoftActorCritic(FallingEntropy, SAC):
    """SAC of Stable-Baselines3 with a target entropy that may fall, and a cloning term in the actor's loss.

    `cloning_weight` weighs the mean squared difference from demonstrated actions, relative to the mean size
    of values; 0 is SAC's own loss.
    """

    def __init__(self, *arguments: Any, cloning_weight: float = 0.0, **options: Any) -> None:
        self.cloning_weight = cloning_weight
        super().__init__(*arguments, **options)

    def train(self, gradient_steps: int, batch_size: int = 64) -> None:
        if not self.cloning_weight:
            super().train(gradient_steps, batch_size)
            return
        self.policy.set_training_mode(True)
        entropy_optimizers = [] if self.ent_coef_optimizer is None else [self.ent_coef_optimizer]
        self._update_learning_rate([self.actor.optimizer, self.critic.optimizer, *entropy_optimizers])
        losses = []
        for _ in range(gradient_steps):
            losses.append(self._step(batch_size))
            polyak_update(self.critic.parameters(), self.critic_target.parameters(), self.tau)
        self._n_updates += gradient_steps
        names = ("critic_loss", "actor_loss", "cloning_loss", "ent_coef")
        for name, values in zip(names, zip(*losses, strict=True), strict=True):
            self.logger.record(f"train/{name}", np.mean(values))

    def _step(self, batch_size: int) -> tuple[float, ...]:
        """One step of temperature, critics and actor: SAC plus the cloning term."""
        buffer = self.replay_buffer
        assert isinstance(buffer, DemonstrationBuffer)
        data = buffer.sample(batch_size)
        actions, log_probability = self.actor.action_log_prob(data.observations)
        temperature = self._temperature(log_probability)
        with torch.no_grad():
            next_actions, next_log = self.actor.action_log_prob(data.next_observations)
            values = self._lowest(self.critic_target(data.next_observations, next_actions))
            values = values - temperature * next_log.reshape(-1, 1)
            target = data.rewards + (1.0 - data.dones) * self.gamma * values
        critics = self.critic(data.observations, data.actions)
        critic_loss = 0.5 * torch.stack([mse_loss(values, target) for values in critics]).sum()
        self.critic.optimizer.zero_grad()
        critic_loss.backward()
        self.critic.optimizer.step()

        values = self._lowest(self.critic(data.observations, actions))
        count = buffer.demonstrated(batch_size)
        shown, wanted = data.observations[-count:], data.actions[-count:]
        cloning_loss = mse_loss(self.actor(shown, deterministic=True), wanted)
        weight = self.cloning_weight * values.abs().mean().detach()
        actor_loss = (temperature * log_probability.reshape(-1, 1) - values).mean() + weight * cloning_loss
        self.actor.optimizer.zero_grad()
        actor_loss.backward()
        self.actor.optimizer.step()
        return critic_loss.item(), actor_loss.item(), cloning_loss.item(), temperature.item()

    def _temperature(self, log_probability: Tensor) -> Tensor:
        """Entropy weight before this step, which then updates it."""
        if self.ent_coef_optimizer is None or self.log_ent_coef is None:
            return self.ent_coef_tensor
        temperature = torch.exp(self.log_ent_coef.detach())
        assert isinstance(self.target_entropy, float)
        loss = -(self.log_ent_coef * (log_probability + self.target_entropy).detach()).mean()
        self.ent_coef_optimizer.zero_grad()
        loss.backward()
        self.ent_coef_optimizer.step()
        return temperature

    @staticmethod
    def _lowest(values: tuple[Tensor, ...]) -> Tensor:
        """Minimum over the critics, shape (B, 1)."""
        return torch.cat(values, dim=1).min(dim=1, keepdim=True).values
