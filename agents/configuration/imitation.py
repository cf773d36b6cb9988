"""Configuration of an agent that learns from demonstrations.

`agents.imitation.clone` and `aggregate` take its `Cloning` and `Dagger` as well.
"""

from collections.abc import Iterator
from typing import Annotated, Literal

from pydantic import Field, StrictInt

from agents.configuration.schema import (
    MOST_LAYERS,
    AgentConfiguration,
    DemonstrationSource,
    Few,
    Many,
    Width,
    weight_problems,
)
from dq_space_arm_env.validation import (
    Count,
    Finite,
    Flag,
    Model,
    NonNegative,
    Positive,
    Problem,
    count_up_to,
)

SMOOTH_ACTIVATIONS = ("tanh", "silu")  # differentiable everywhere, as matching gains needs

LONGEST_CHUNK = 10_000
"""Largest number of time steps of a chunk: flights remember as many actions."""
STRONGEST = 600.0
"""Exponent of the largest ratio of two weights of a temporal ensemble: no double overflows."""

WholeNumber = Annotated[StrictInt, Field(ge=0)]


class ObjectiveWeights(Model):
    """Weights of the training loss, relative to the error of actions."""

    gain_weight: NonNegative = Field(
        default=0.3,
        description="weight of the error between the policy's derivative and the feedback gain; 0: none",
    )
    augmentation_weight: NonNegative = Field(
        default=0.0,
        description="weight of the error of actions at states around the demonstrations, whose targets the "
        "gains extrapolate; 0: none",
    )
    augmentation_scale: Positive = Field(
        default=0.03, description="distance of these states, relative to the spread of the demonstrations"
    )

    @property
    def needs_gains(self) -> bool:
        return self.gain_weight > 0.0 or self.augmentation_weight > 0.0


class Optimization(Model):
    """Settings of the optimizer, Adam."""

    updates: Count = Field(default=20_000, description="steps of the optimizer")
    batch_size: Many = Field(default=256, description="time steps of an update")
    learning_rate: Positive = Field(
        default=2e-3, description="peak learning rate: linear warm-up, then cosine decay"
    )
    warm_up: WholeNumber = Field(default=200, description="updates of the warm-up")
    gradient_limit: Positive = Field(default=1.0, description="norm at which gradients are clipped")


class Fit(Model):
    """Settings of a training on demonstrations alone."""

    name: str
    optimization: Optimization = Field(default_factory=Optimization, description="the optimizer")
    validation_share: NonNegative = Field(
        default=0.05,
        description="share of the demonstrations to validate on, less than 1; the weights with the lowest "
        "validation loss are kept; 0: none, and the last weights are kept",
    )
    validate_every: Count = Field(
        default=1000, description="updates between validations, each with a checkpoint"
    )

    @property
    def needs_gains(self) -> bool:
        return False

    def _problems(self) -> Iterator[Problem]:
        if self.validation_share >= 1.0:
            yield Problem(("validation_share",), self.validation_share, "must be less than 1")


class Cloning(Fit):
    """Behavior cloning: plain, with gains, or with augmentation, by the weights of its objective."""

    name: Literal["cloning"] = "cloning"
    objective: ObjectiveWeights = Field(default_factory=ObjectiveWeights, description="the loss")
    stationary: Flag = Field(
        default=False,
        description="whether the policy does without the time left: to the end it acts as in the middle of "
        "an episode, where an expert with a finite horizon lets go",
    )

    @property
    def needs_gains(self) -> bool:
        return self.objective.needs_gains


class ActionChunking(Fit):
    """ACT: a transformer predicts the expert's next actions, a chunk; a flight averages its predictions."""

    name: Literal["act"] = "act"
    chunk: Few = Field(default=8, description="actions of a chunk")
    spacing: Few = Field(
        default=5, description="time steps between them, at least 1; a flight interpolates linearly"
    )
    weighting: Finite = Field(
        default=-1.0,
        description="m of the temporal ensemble: a prediction made a time steps ago counts exp(m a); 0: all "
        "alike; negative: newer ones count more",
    )
    width: Width = Field(default=64, description="size of a token, a multiple of `heads`")
    layers: Annotated[int, count_up_to(MOST_LAYERS)] = Field(
        default=2, description="layers of the transformer; `network` embeds the observation"
    )
    heads: Few = Field(default=4, description="heads of the attention")

    def _problems(self) -> Iterator[Problem]:
        yield from super()._problems()
        if self.width % self.heads:
            yield Problem(("heads",), self.heads, f"must divide width, {self.width}")
        yield from weight_problems("width", self.width, 12 * self.layers * self.width**2)
        steps = (self.chunk - 1) * self.spacing + 1
        if steps > LONGEST_CHUNK:
            sentence = f"{self.chunk} actions are {steps:,} time steps, must be at most {LONGEST_CHUNK:,}"
            yield Problem(("spacing",), self.spacing, sentence)
        if not abs(self.weighting) * steps <= STRONGEST:
            bound = STRONGEST / steps
            yield Problem(("weighting",), self.weighting, f"must be between {-bound:.3g} and {bound:.3g}")


class Dagger(Model):
    """DAgger: the cloned policy flies, the expert labels the states it visits, and it trains on them."""

    name: Literal["dagger"] = "dagger"
    cloning: Cloning = Field(default_factory=Cloning, description="the policy to start from")
    rounds: Few = Field(default=4, description="rounds of flying, labeling and training")
    episodes: Many = Field(default=64, description="episodes of a round")
    labels: Literal["gains", "solve"] = Field(
        default="solve",
        description="source of the labels: 'gains', the feedback policy of the demonstration from the same "
        "start; 'solve', the expert, replanning from visited states",
    )
    solves: Many = Field(
        default=2, description="with 'solve', states per episode to replan from, one in each of as many parts"
    )
    every: Count = Field(
        default=4, description="keep one time step in this many; neighbors are nearly the same"
    )
    share: Positive = Field(default=0.5, description="share of labeled states in a batch, less than 1")
    optimization: Optimization = Field(
        default_factory=lambda: Optimization(updates=4000, learning_rate=5e-4),
        description="the optimizer of each round",
    )

    def _problems(self) -> Iterator[Problem]:
        if self.share >= 1.0:
            yield Problem(("share",), self.share, "must be less than 1: the rest are demonstrations")
        if self.optimization.batch_size < 2:
            sentence = "must be at least 2: a labeled state and a demonstrated one"
            yield Problem(("optimization", "batch_size"), self.optimization.batch_size, sentence)


class LearningCurve(Model):
    """Flights during training."""

    every: Count = Field(
        default=5000, description="updates between flights, which happen at the next validation or at the end"
    )
    episodes: Many = Field(default=64, description="flights, always from the same starts")


class ImitationConfiguration(AgentConfiguration):
    """Everything that determines an imitation run, apart from the code."""

    demonstrations: DemonstrationSource = Field(
        default_factory=DemonstrationSource, description="the demonstrations to learn from"
    )
    algorithm: Cloning | Dagger | ActionChunking = Field(
        discriminator="name", description="the algorithm, with its hyperparameters"
    )
    curve: LearningCurve = Field(default_factory=LearningCurve, description="flights during training")

    @property
    def cloning(self) -> Cloning:
        """Settings of the cloning, DAgger's first stage included; ValueError for chunks of actions."""
        if isinstance(self.algorithm, ActionChunking):
            raise ValueError(f"configuration {self.name!r} clones chunks of actions, should be single ones")
        return self.algorithm if isinstance(self.algorithm, Cloning) else self.algorithm.cloning

    def _problems(self) -> Iterator[Problem]:
        if self.network.activation not in SMOOTH_ACTIVATIONS:
            yield Problem(
                ("network", "activation"),
                self.network.activation,
                f"must be one of {', '.join(SMOOTH_ACTIVATIONS)}: matching gains needs a smooth network",
            )
