"""Configuration of an agent that follows the exact gradient of its episodes' cost."""

from collections.abc import Iterator
from typing import Literal

from pydantic import Field

from agents.configuration.schema import MOST_IN_MEMORY, AgentConfiguration, Many, Mismatch, StartFrom
from dq_space_arm_env.validation import Count, Model, NonNegative, Positive, Problem


class AnalyticPolicyGradient(Model):
    """Analytic policy gradient: reverse mode through whole episodes, and SOAP on the network's weights."""

    name: Literal["APG"] = "APG"
    updates: Count = Field(default=2000, description="updates of the weights")
    learning_rate: Positive = Field(
        default=0.01, description="at its peak: it rises over the first updates, and falls like a cosine"
    )
    copies: Many = Field(default=64, description="episodes of an update")
    decisions: Many = Field(
        default=200,
        description="decisions of an episode in training, at least 3; flights decide at every time step",
    )
    crowding: NonNegative = Field(
        default=0.8,
        description="how much closer decisions are at both ends, from 0, evenly, to 1, as cosines",
    )
    starts: Many = Field(default=16384, description="starts that episodes are drawn from")
    end_weight: Positive = Field(
        default=400.0,
        description="factor of the terminal pose's cost at first, for reaching the tolerances; it falls "
        "while at most a quarter of them miss",
    )

    def _problems(self) -> Iterator[Problem]:
        if self.crowding > 1.0:
            yield Problem(("crowding",), self.crowding, "must be at most 1, as cosines")
        if self.decisions < 3:
            yield Problem(("decisions",), self.decisions, "must be at least 3")


class FlightMismatch(Mismatch):
    """Model mismatch of half of the episodes of each update; the other half has that of the masses alone."""

    delay: NonNegative = Field(default=0.2, description="longest time from an action to its effect, s")


class Progression(Model):
    """Flights and checkpoints during training."""

    evaluate_every: Count = Field(default=200, description="updates between flights for the learning curve")
    evaluation_episodes: Many = Field(default=64, description="flights, always from the same starts")
    checkpoint_every: Count = Field(default=500, description="updates between checkpoints")


class GradientConfiguration(AgentConfiguration):
    """Everything that determines a run of analytic policy gradients, apart from the code."""

    start_from: StartFrom = None
    mismatch: FlightMismatch | None = Field(
        default=None, description="what disturbs the flights of the training; absent: nothing"
    )
    algorithm: AnalyticPolicyGradient = Field(description="the algorithm, with its hyperparameters")
    progression: Progression = Field(default_factory=Progression, description="evaluations and checkpoints")

    def _problems(self) -> Iterator[Problem]:
        if self.network.activation != "tanh":
            yield Problem(
                ("network", "activation"),
                self.network.activation,
                "must be tanh for analytic gradients",
            )
        decisions = self.algorithm.copies * self.algorithm.decisions
        if decisions > MOST_IN_MEMORY:
            sentence = f"all copies take {decisions:,} decisions, at most {MOST_IN_MEMORY:,} fit into memory"
            yield Problem(("algorithm", "copies"), self.algorithm.copies, sentence)
