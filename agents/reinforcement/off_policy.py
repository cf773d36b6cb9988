"""What SAC, TQC and TD3 lack to learn from scratch: normalized critics, and exploration that ends.

Critics learn what an action is worth from actions that differ, and little noise at the end lets the actor be
precise. Layer normalization keeps critics from overestimating out-of-distribution actions (Ball et al.,
"Efficient Online Reinforcement Learning with Offline Data", ICML 2023).
"""

from collections.abc import Mapping
from typing import Any, cast

import numpy as np
from numpy.typing import NDArray
from sb3_contrib import TQC
from sb3_contrib.tqc.policies import TQCPolicy
from stable_baselines3 import TD3
from stable_baselines3.common.noise import ActionNoise, NormalActionNoise
from stable_baselines3.common.off_policy_algorithm import OffPolicyAlgorithm
from stable_baselines3.common.policies import BasePolicy
from stable_baselines3.common.torch_layers import BaseFeaturesExtractor, create_mlp
from stable_baselines3.sac.policies import SACPolicy
from stable_baselines3.td3.policies import TD3Policy
from torch import nn
from torch.optim import Optimizer


class _LayerNormalized(BasePolicy):
    """A policy whose critics have a layer normalization before each activation."""

    def make_critic(self, features_extractor: BaseFeaturesExtractor | None = None) -> Any:
        critic = cast(Any, super()).make_critic(features_extractor)  # of SAC, TQC or TD3
        for number, plain in enumerate(critic.q_networks):
            linear = [module for module in plain if isinstance(module, nn.Linear)]
            layers = create_mlp(
                linear[0].in_features,
                linear[-1].out_features,
                [layer.out_features for layer in linear[:-1]],
                type(plain[1]),
                post_linear_modules=[nn.LayerNorm],
            )
            critic.q_networks[number] = nn.Sequential(*layers)
            setattr(critic, f"qf{number}", critic.q_networks[number])
        return critic.to(self.device)


class LayerNormalizedSAC(_LayerNormalized, SACPolicy):
    """The policy of SAC, with layer-normalized critics."""


class LayerNormalizedTQC(_LayerNormalized, TQCPolicy):
    """The policy of TQC, with layer-normalized critics."""


class LayerNormalizedTD3(_LayerNormalized, TD3Policy):
    """The policy of TD3, with layer-normalized critics."""


LAYER_NORMALIZED: Mapping[str, type[BasePolicy]] = {
    "SAC": LayerNormalizedSAC,
    "TQC": LayerNormalizedTQC,
    "TD3": LayerNormalizedTD3,
}


def _remaining(model: OffPolicyAlgorithm) -> float:
    """Share of the schedule that is left."""
    # Negative where the copies gather more decisions before the last update than the schedule has left.
    remaining: float = max(model._current_progress_remaining, 0.0)
    return remaining


class FallingEntropy(OffPolicyAlgorithm):
    """A maximum-entropy algorithm whose target entropy goes linearly to `final_target_entropy`, if given."""

    target_entropy: str | float

    def __init__(self, *arguments: Any, final_target_entropy: float | None = None, **options: Any) -> None:
        self.final_target_entropy = final_target_entropy
        super().__init__(*arguments, **options)

    def _setup_model(self) -> None:
        super()._setup_model()
        # "auto" until here, a number now; Stable-Baselines3 types it as either.
        self.first_target_entropy = float(vars(self)["target_entropy"])

    def _update_learning_rate(self, optimizers: list[Optimizer] | Optimizer) -> None:
        super()._update_learning_rate(optimizers)
        if self.final_target_entropy is not None:
            first, last = self.first_target_entropy, self.final_target_entropy
            self.target_entropy = last + (first - last) * _remaining(self)
            self.logger.record("train/target_entropy", self.target_entropy)


class TruncatedQuantileCritics(FallingEntropy, TQC):
    """TQC of Stable-Baselines3 with a target entropy that may fall."""


class TwinDelayed(TD3):
    """TD3 of Stable-Baselines3 with normal exploration noise that goes linearly to its end.

    `deviations` are its first and last standard deviations, in action scales.
    """

    def __init__(self, *arguments: Any, deviations: tuple[float, float], **options: Any) -> None:
        self.deviations = deviations
        super().__init__(*arguments, **options)

    @property
    def deviation(self) -> float:
        """Current standard deviation of the noise, in action scales."""
        first, last = self.deviations
        deviation: float = last + (first - last) * _remaining(self)
        return deviation

    def _sample_action(
        self, learning_starts: int, action_noise: ActionNoise | None = None, n_envs: int = 1
    ) -> tuple[NDArray[Any], NDArray[Any]]:
        assert self.action_space.shape is not None
        deviation = np.full((n_envs, *self.action_space.shape), self.deviation)
        noise = NormalActionNoise(np.zeros_like(deviation), deviation)
        actions: tuple[NDArray[Any], NDArray[Any]] = super()._sample_action(learning_starts, noise, n_envs)
        return actions
