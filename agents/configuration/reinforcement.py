"""Configuration of an agent that learns by reinforcement: environment, algorithm, budget."""

import math
from collections.abc import Iterator

from pydantic import Field

from agents.configuration.algorithms import PPO, Algorithm, Hindsight, OffPolicy
from agents.configuration.schema import MOST_IN_MEMORY, AgentConfiguration, Many, StartFrom
from dq_space_arm_env.validation import Count, Flag, Model, NonNegative, Positive, Problem

_REWARD_SHAPING = ("reward_scale", "cost_power", "success_reward", "end_error_cost")


class ActionScale(Model):
    """Largest actions of the agent, as fractions of the actuators' limits.

    The paper's weights make thrusters expensive: a random force of some newtons costs more in a second than
    the whole maneuver, and an agent free to try it learns only to leave it alone.
    """

    base_force: Positive = Field(default=1.0, description="fraction of the limit, at most 1")
    base_torque: Positive = Field(default=1.0, description="fraction of the limit, at most 1")
    joint_torque: Positive = Field(default=1.0, description="fraction of the limit, at most 1")
    wrist_rate: Positive = Field(default=1.0, description="fraction of the limit, at most 1")
    wheel_torque: Positive | None = Field(
        default=None, description="fraction of the limit, at most 1, in a scene with wheels; absent: 1"
    )
    thruster_force: Positive | None = Field(
        default=None, description="fraction of the limit, at most 1, in a scene with thrusters; absent: 1"
    )

    def _problems(self) -> Iterator[Problem]:
        for name, value in self:
            if value is not None and value > 1.0:
                yield Problem((name,), value, "must be at most 1, where the actuator's limit is")


class Practice(Model):
    """The training environment; evaluations use the unchanged one."""

    copies: Many = Field(default=128, description="environments stepped together")
    action_repeat: Many = Field(default=1, description="time steps for which an action is held")
    action_scale: ActionScale = Field(
        default_factory=ActionScale, description="largest actions, as fractions of the limits"
    )
    reward_scale: Positive = Field(default=1.0, description="factor of rewards")
    cost_power: Positive = Field(
        default=1.0,
        le=1.0,
        description="exponent of the mean cost of a held action, at most 1; below 1, small errors count more",
    )
    success_reward: NonNegative = Field(
        default=0.0, description="reward for ending an episode in success, not scaled by reward_scale"
    )
    end_error_cost: NonNegative = Field(
        default=0.0,
        description="cost of ending far off the target, not scaled by reward_scale; half of it where one "
        "error equals its tolerance and the others are zero",
    )
    normalize_observations: Flag = Field(
        default=True,
        description="whether networks see observations in units of their spread; with start_from, as it does",
    )


class Schedule(Model):
    """Length of the training, and its evaluations and checkpoints, in environment steps of all copies."""

    total_steps: Count = Field(description="environment steps")
    minutes: Positive | None = Field(
        default=None, description="time limit of the training, min; absent: none"
    )
    evaluate_every: Count = Field(default=1_000_000, description="environment steps between evaluations")
    evaluation_episodes: Many = Field(default=64, description="episodes of an evaluation")
    checkpoint_every: Count = Field(default=5_000_000, description="environment steps between checkpoints")


class Configuration(AgentConfiguration):
    """Everything that determines a reinforcement-learning run, apart from the code."""

    environment: Practice = Field(default_factory=Practice, description="the training environment")
    start_from: StartFrom = None
    algorithm: Algorithm = Field(description="the algorithm, with its hyperparameters")
    schedule: Schedule = Field(description="budget, evaluations and checkpoints")

    def _problems(self) -> Iterator[Problem]:
        if self.start_from is not None and not isinstance(self.algorithm, PPO):
            yield Problem(
                ("start_from",), self.start_from, f"is for PPO, not for {self.algorithm.name}: leave it out"
            )
        decisions = self.environment.copies * getattr(self.algorithm, "n_steps", 1)
        if decisions > MOST_IN_MEMORY:
            sentence = (
                f"all copies gather {decisions:,} decisions, at most {MOST_IN_MEMORY:,} fit into memory"
            )
            yield Problem(("environment", "copies"), self.environment.copies, sentence)
        if isinstance(self.algorithm, PPO):
            yield from self.algorithm.batch_problems(self.environment.copies)
        if isinstance(self.algorithm, OffPolicy) and self.algorithm.layer_norm and not self.network.hidden:
            yield Problem(
                ("network", "hidden"), [], "must have a layer for algorithm.layer_norm to normalize"
            )
        if isinstance(self.algorithm, OffPolicy) and self.algorithm.hindsight is not None:
            for name in _REWARD_SHAPING:
                value, plain = getattr(self.environment, name), Practice.model_fields[name].default
                if value != plain:
                    yield Problem(
                        ("environment", name),
                        value,
                        f"must be {plain:g} with hindsight, which recomputes rewards from goals alone",
                    )

    @property
    def hindsight(self) -> Hindsight | None:
        """Settings of hindsight on the goal environment, if the agent learns there."""
        return self.algorithm.hindsight if isinstance(self.algorithm, OffPolicy) else None

    def decisions(self, steps: int) -> int:
        """Convert environment steps to decisions, each held for `action_repeat` steps; at least 1."""
        return max(1, math.ceil(steps / self.environment.action_repeat))
