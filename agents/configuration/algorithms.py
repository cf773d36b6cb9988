"""Reinforcement-learning algorithms and their hyperparameters, named as in Stable-Baselines3."""

from collections.abc import Iterator
from typing import Annotated, Literal

from pydantic import Field

from agents.configuration.schema import MOST_IN_MEMORY, DemonstrationSource, Few, Many
from dq_space_arm_env.validation import (
    Count,
    Finite,
    FiniteOrAuto,
    Flag,
    Model,
    NonNegative,
    Positive,
    PositiveOrAuto,
    Problem,
    Share,
    count_up_to,
)


class _Common(Model):
    learning_rate: Positive = Field(default=3e-4, description="initial step size of Adam")
    final_learning_rate: NonNegative | None = Field(
        default=None, description="final step size, reached linearly; absent: learning_rate"
    )
    batch_size: Many = Field(default=256, description="decisions per minibatch")
    gamma: Share = Field(default=0.98, description="discount per decision")


class Lagrangian(Model):
    """Price of violating the scene's constraints, by dual ascent (PPO-Lagrangian, Ray et al., 2019)."""

    limit: Share = Field(default=0.01, description="share of the episodes that may violate constraints")
    initial: Positive = Field(
        default=5e-4, description="multiplier at first and at least: a price in units of the shaped rewards"
    )
    learning_rate: Positive = Field(
        default=0.25,
        description="growth of the multiplier's logarithm in an update, over the excess of the share of "
        "episodes that violate; the excess counts up to 0.1",
    )


class PPO(_Common):
    """Proximal policy optimization (Schulman et al., 2017)."""

    name: Literal["PPO"]
    batch_size: Many = Field(default=4096, description="decisions per minibatch")
    n_steps: Many = Field(default=50, description="decisions of each copy between updates")
    n_epochs: Few = Field(default=10, description="passes over these decisions per update")
    gae_lambda: Share = Field(default=0.95, description="decay of the advantage estimate")
    clip_range: Positive = Field(default=0.2, description="largest change of a probability ratio")
    ent_coef: NonNegative = Field(default=0.0, description="weight of the entropy")
    vf_coef: Positive = Field(default=0.5, description="weight of the value function's loss")
    max_grad_norm: Positive = Field(default=0.5, description="largest norm of a gradient")
    target_kl: Positive | None = Field(
        default=None, description="KL divergence at which an update ends early; absent: none"
    )
    desired_kl: Positive | None = Field(
        default=None,
        description="KL divergence that an update should cause: the actor's step size adapts to it, below "
        "learning_rate; absent: it is learning_rate",
    )
    first_step_factor: Positive = Field(
        default=1.0,
        description="the actor's initial step size with desired_kl, relative to learning_rate, at most 1",
    )
    critic_warm_up: Annotated[int, Field(strict=True, ge=0)] = Field(
        default=0, description="first updates, which train the critic alone"
    )
    log_std_init: Finite = Field(
        default=-0.7, description="log of the initial standard deviation of actions, in action scales"
    )
    lagrangian: Lagrangian | None = Field(
        default=None, description="charge violations of the scene's constraints; absent: rewards alone count"
    )

    def _problems(self) -> Iterator[Problem]:
        if self.first_step_factor > 1.0:
            yield Problem(
                ("first_step_factor",), self.first_step_factor, "must be at most 1, learning_rate itself"
            )
        if self.batch_size < 2:
            yield Problem(
                ("batch_size",),
                self.batch_size,
                "must be at least 2: advantages are normalized per minibatch",
            )

    def batch_problems(self, copies: int) -> Iterator[Problem]:
        """Tell whether a minibatch is larger than the decisions of all copies between updates."""
        if self.batch_size > (most := self.n_steps * copies):
            sentence = f"must be at most {most:,}, n_steps times environment.copies"
            yield Problem(("algorithm", "batch_size"), self.batch_size, sentence)


class Hindsight(Model):
    """Hindsight experience replay (Andrychowicz et al., NeurIPS 2017), on the goal environment."""

    n_sampled_goal: Few = Field(default=4, description="relabeled decisions per real one")
    goal_selection_strategy: Literal["future", "final", "episode"] = Field(
        default="future", description="which achieved goals replace desired ones"
    )
    reward_type: Literal["sparse", "dense"] = Field(
        default="sparse", description="reward of the goal environment"
    )


class OffPolicy(_Common):
    """Settings common to the algorithms with a replay buffer."""

    buffer_size: Annotated[int, count_up_to(MOST_IN_MEMORY)] = Field(
        default=1_000_000, description="decisions in the replay buffer"
    )
    learning_starts: Count = Field(default=10_000, description="random decisions before learning")
    tau: Positive = Field(default=0.005, description="update rate of the target networks")
    train_freq: Many = Field(default=1, description="decisions of each copy between updates")
    gradient_steps: Many = Field(default=1, description="gradient steps per update")
    n_critics: Few = Field(default=2, description="critics; the lowest value or quantiles count")
    layer_norm: Flag = Field(default=False, description="whether critics are layer-normalized")
    hindsight: Hindsight | None = Field(
        default=None, description="learn on the goal environment, with hindsight; absent: neither"
    )

    def _problems(self) -> Iterator[Problem]:
        if self.tau > 1.0:
            yield Problem(("tau",), self.tau, "must be at most 1, where targets are the critics themselves")
        if self.learning_starts > self.buffer_size:
            yield Problem(
                ("learning_starts",),
                self.learning_starts,
                f"must be at most buffer_size, which is {self.buffer_size}",
            )


class _MaximumEntropy(OffPolicy):
    ent_coef: PositiveOrAuto = Field(
        default="auto", description="weight of the entropy, or 'auto' to learn it"
    )
    ent_coef_init: Positive = Field(default=0.1, description="initial weight of the entropy if it is learned")
    target_entropy: FiniteOrAuto = Field(
        default="auto", description="entropy it is learned for; 'auto': minus the number of actions"
    )
    final_target_entropy: Finite | None = Field(
        default=None, description="final target entropy, reached linearly; absent: target_entropy"
    )

    def _problems(self) -> Iterator[Problem]:
        yield from super()._problems()
        if self.final_target_entropy is not None and self.ent_coef != "auto":
            yield Problem(
                ("final_target_entropy",),
                self.final_target_entropy,
                f"must be absent with ent_coef = {self.ent_coef:g}: no entropy is aimed at then",
            )


class Demonstrated(Model):
    """Demonstrations in the replay buffer (Ball et al., ICML 2023)."""

    source: DemonstrationSource = Field(
        default_factory=DemonstrationSource, description="where they come from"
    )
    share: Positive = Field(default=0.5, description="share of demonstrations in a batch, less than 1")
    cloning_weight: NonNegative = Field(
        default=0.0,
        description="weight of the mean squared difference from demonstrated actions (in action scales) in "
        "the actor's loss, relative to the mean size of values",
    )

    def _problems(self) -> Iterator[Problem]:
        if self.share >= 1.0:
            yield Problem(
                ("share",), self.share, "must be less than 1: the rest are the agent's own decisions"
            )


class SAC(_MaximumEntropy):
    """Soft actor-critic (Haarnoja et al., 2018)."""

    name: Literal["SAC"]
    demonstrations: Demonstrated | None = Field(
        default=None, description="expert decisions to learn from as well; absent: none"
    )

    def _problems(self) -> Iterator[Problem]:
        yield from super()._problems()
        if self.demonstrations is not None and self.hindsight is not None:
            yield Problem(
                ("demonstrations",), "given", "must be absent with hindsight, which has its own replay buffer"
            )
        share = 0.5 if self.demonstrations is None else self.demonstrations.share
        if self.demonstrations is not None and not 1 <= round(share * self.batch_size) < self.batch_size:
            yield Problem(
                ("demonstrations", "share"),
                share,
                f"must leave room for decisions of both kinds in a batch of {self.batch_size}",
            )


class TQC(_MaximumEntropy):
    """Truncated quantile critics (Kuznetsov et al., ICML 2020)."""

    name: Literal["TQC"]
    n_quantiles: Few = Field(default=25, description="quantiles of a critic")
    top_quantiles_to_drop_per_net: Count = Field(
        default=2, description="highest quantiles of each critic to drop"
    )

    def _problems(self) -> Iterator[Problem]:
        yield from super()._problems()
        if self.top_quantiles_to_drop_per_net >= self.n_quantiles:
            yield Problem(
                ("top_quantiles_to_drop_per_net",),
                self.top_quantiles_to_drop_per_net,
                f"must be less than n_quantiles, which is {self.n_quantiles}",
            )


class TD3(OffPolicy):
    """Twin delayed deep deterministic policy gradient (Fujimoto et al., ICML 2018)."""

    name: Literal["TD3"]
    policy_delay: Count = Field(default=2, description="critic updates per actor update")
    target_policy_noise: NonNegative = Field(
        default=0.2, description="noise of target actions, in action scales"
    )
    target_noise_clip: Positive = Field(default=0.5, description="bound of this noise, in action scales")
    action_noise: NonNegative = Field(
        default=0.1, description="standard deviation of the exploration noise, in action scales"
    )
    final_action_noise: NonNegative | None = Field(
        default=None, description="final standard deviation, reached linearly; absent: action_noise"
    )


Algorithm = Annotated[PPO | SAC | TQC | TD3, Field(discriminator="name")]
