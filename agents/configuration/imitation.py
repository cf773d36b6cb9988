"""The configuration of an agent that learns from demonstrations: which ones, network, algorithm, curve.

Its classes `Cloning` and `Dagger` are also what `agents.imitation.clone` and `aggregate` take.
"""

from collections.abc import Iterator
from typing import Annotated, Literal

from pydantic import Field, StrictInt

from agents.configuration.demonstrations import DemonstrationSource
from agents.configuration.schema import AgentConfiguration
from agents.policies.activations import SMOOTH
from dq_space_arm_env.validation import Count, Model, NonNegative, Positive, Problem

WholeNumber = Annotated[StrictInt, Field(ge=0)]


class ObjectiveWeights(Model):
    """What training on demonstrations minimizes, besides the error of actions, whose weight is one."""

    gain_weight: NonNegative = Field(
        default=0.3,
        description="weight of the error of the policy's derivative, to be the feedback gain; 0: none",
    )
    augmentation_weight: NonNegative = Field(
        default=0.0,
        description="weight of the error of actions at states around the demonstrations, where the gains say "
        "what to do; 0: none",
    )
    augmentation_scale: Positive = Field(
        default=0.03, description="how far around, relative to the spread of the demonstrations"
    )

    @property
    def needs_gains(self) -> bool:
        """Whether it asks for feedback gains."""
        return self.gain_weight > 0.0 or self.augmentation_weight > 0.0


class Optimization(Model):
    """Steps of the optimizer, Adam."""

    updates: Count = Field(default=20_000, description="steps of the optimizer")
    batch_size: Count = Field(default=256, description="time steps of an update")
    learning_rate: Positive = Field(
        default=2e-3, description="largest one; it rises in the first updates, then falls along a cosine"
    )
    warm_up: WholeNumber = Field(default=200, description="updates in which it rises")
    gradient_limit: Positive = Field(default=1.0, description="gradients are scaled down to this norm")


class Cloning(Model):
    """Behavior cloning, plain, with gains, or with augmentation, as the weights of its objective say."""

    name: Literal["cloning"] = "cloning"
    objective: ObjectiveWeights = Field(default_factory=ObjectiveWeights, description="what is minimized")
    optimization: Optimization = Field(default_factory=Optimization, description="how it is minimized")
    validation_share: NonNegative = Field(
        default=0.05,
        description="share of the demonstrations to validate on, less than 1; the weights that are best "
        "there are taken; 0: none, and the last weights are taken",
    )
    validate_every: Count = Field(
        default=1000, description="updates between validations, each with a checkpoint"
    )

    def _problems(self) -> Iterator[Problem]:
        if self.validation_share >= 1.0:
            yield Problem(("validation_share",), self.validation_share, "must be less than 1")


class Dagger(Model):
    """DAgger: the cloned policy flies, and the expert says what it should have done where it went."""

    name: Literal["dagger"] = "dagger"
    cloning: Cloning = Field(default_factory=Cloning, description="what it begins with")
    rounds: Count = Field(
        default=4, description="how often the policy flies, is corrected, and is trained on"
    )
    episodes: Count = Field(default=64, description="episodes of a round")
    labels: Literal["gains", "solve"] = Field(
        default="solve",
        description="who says what should have been done: 'gains', the feedback policy of the demonstration "
        "from the same start; 'solve', the expert, who plans anew from states that the policy visits",
    )
    solves: Count = Field(
        default=2, description="with 'solve', states of an episode to plan from, one in each of as many parts"
    )
    every: Count = Field(
        default=4, description="one in so many time steps is kept; those between are nearly the same"
    )
    share: Positive = Field(
        default=0.5, description="share of a batch that comes from corrections, less than 1"
    )
    optimization: Optimization = Field(
        default_factory=lambda: Optimization(updates=4000, learning_rate=5e-4),
        description="how training goes on in every round",
    )

    def _problems(self) -> Iterator[Problem]:
        if self.share >= 1.0:
            yield Problem(("share",), self.share, "must be less than 1: the rest are demonstrations")


class LearningCurve(Model):
    """Flights while it learns."""

    every: Count = Field(
        default=5000, description="updates between flights, which wait for a validation, or for the end"
    )
    episodes: Count = Field(default=64, description="flights, always from the same starts")


class ImitationConfiguration(AgentConfiguration):
    """All that a training run by imitation follows from, but for the code."""

    demonstrations: DemonstrationSource = Field(
        default_factory=DemonstrationSource, description="what it learns from"
    )
    algorithm: Cloning | Dagger = Field(
        discriminator="name", description="the algorithm, with its hyperparameters"
    )
    curve: LearningCurve = Field(default_factory=LearningCurve, description="flights while it learns")

    @property
    def cloning(self) -> Cloning:
        """How it is cloned, first of all."""
        return self.algorithm if isinstance(self.algorithm, Cloning) else self.algorithm.cloning

    def _problems(self) -> Iterator[Problem]:
        if self.network.activation not in SMOOTH:
            yield Problem(
                ("network", "activation"),
                self.network.activation,
                f"must be one of {', '.join(SMOOTH)}: matching gains takes a smooth network",
            )
