"""The configuration of an agent that learns by reinforcement: scene, practice, network, algorithm, budget."""

import math
from collections.abc import Iterator
from typing import Literal

from pydantic import Field, StrictBool, StrictInt, StrictStr

from agents.configuration.algorithms import PPO, SAC, Algorithm, OffPolicy
from dq_space_arm_env.validation import Count, Model, NonNegative, Positive, Problem

_REWARDS = ("reward_scale", "cost_power", "success_reward", "end_error_cost")
"""What the practice changes in rewards."""


class ActionScale(Model):
    """Largest actions of the agent, as fractions of the actuators' limits.

    The paper's weights make thrusters dear: a random force of some newtons costs more in a second than the
    maneuver does, so that an agent that may try it learns nothing but to leave it alone.
    """

    base_force: Positive = Field(default=1.0, description="fraction of the limit, at most 1")
    base_torque: Positive = Field(default=1.0, description="fraction of the limit, at most 1")
    joint_torque: Positive = Field(default=1.0, description="fraction of the limit, at most 1")
    wrist_rate: Positive = Field(default=1.0, description="fraction of the limit, at most 1")

    def _problems(self) -> Iterator[Problem]:
        for name, value in self:
            if value > 1.0:
                yield Problem((name,), value, "must be at most 1, where the actuator's limit is")


class Practice(Model):
    """The environment as the agent practices in it; it is judged in the unchanged one."""

    copies: Count = Field(default=128, description="environments that are stepped together")
    action_repeat: Count = Field(default=1, description="time steps for which an action is held")
    action_scale: ActionScale = Field(
        default_factory=ActionScale, description="largest actions, as fractions of the limits"
    )
    reward_scale: Positive = Field(default=1.0, description="factor of rewards")
    cost_power: Positive = Field(
        default=1.0,
        description="power of the mean cost of held actions, at most 1; below, small errors count more",
    )
    success_reward: NonNegative = Field(
        default=0.0, description="reward of an episode that ends in success, not scaled by reward_scale"
    )
    end_error_cost: NonNegative = Field(
        default=0.0,
        description="what it costs to end far off, not scaled by reward_scale; half of it where one error "
        "is as large as its tolerance and the other zero",
    )
    normalize_observations: StrictBool = Field(
        default=True, description="whether networks see observations in units of their variation"
    )

    def _problems(self) -> Iterator[Problem]:
        if self.cost_power > 1.0:
            yield Problem(("cost_power",), self.cost_power, "must be at most 1, for the cost itself")


class Network(Model):
    """The network of the policy, and of its critics."""

    hidden: tuple[Count, ...] = Field(default=(128, 128), description="sizes of the hidden layers")
    activation: Literal["tanh", "relu", "silu"] = Field(default="tanh", description="between the layers")


class Schedule(Model):
    """How long the training is, and what is done now and then, in environment steps of all copies."""

    total_steps: Count = Field(description="environment steps")
    minutes: Positive | None = Field(
        default=None, description="time at which training ends, wherever it is; absent: no limit"
    )
    evaluate_every: Count = Field(default=1_000_000, description="environment steps between evaluations")
    evaluation_episodes: Count = Field(default=64, description="episodes of such an evaluation")
    checkpoint_every: Count = Field(default=5_000_000, description="environment steps between checkpoints")


class AgentConfiguration(Model):
    """What the configurations of all agents have in common."""

    name: StrictStr = Field(min_length=1, pattern=r"^[\w.-]+$", description="name of the agent")
    description: StrictStr = Field(default="", description="what it is, and what to expect")
    scene: StrictStr = Field(default="paper", description="name of a shipped scene, or path of a YAML file")
    seed: StrictInt = Field(default=0, ge=0, lt=2**31, description="seed of everything random")
    threads: Count = Field(default=1, description="threads of PyTorch")
    network: Network = Field(default_factory=Network, description="the networks")


class Configuration(AgentConfiguration):
    """All that a training run by reinforcement follows from, but for the code."""

    environment: Practice = Field(default_factory=Practice, description="what the agent practices in")
    start_from: StrictStr | None = Field(
        default=None,
        min_length=1,
        description="policy to begin with: one of the zoo, file of an exported one, or folder of a run; "
        "absent: a random one",
    )
    algorithm: Algorithm = Field(description="the algorithm, with its hyperparameters")
    schedule: Schedule = Field(description="budget, evaluations and checkpoints")

    def _problems(self) -> Iterator[Problem]:
        if self.start_from is not None and not isinstance(self.algorithm, PPO):
            yield Problem(
                ("start_from",), self.start_from, f"is for PPO, not for {self.algorithm.name}: leave it out"
            )
        if isinstance(self.algorithm, SAC) and self.algorithm.layer_norm and not self.network.hidden:
            yield Problem(
                ("network", "hidden"), [], "must have a layer for algorithm.layer_norm to normalize"
            )
        if isinstance(self.algorithm, OffPolicy) and self.algorithm.hindsight is not None:
            for name in _REWARDS:
                value, plain = getattr(self.environment, name), Practice.model_fields[name].default
                if value != plain:
                    yield Problem(
                        ("environment", name),
                        value,
                        f"must be {plain:g} with hindsight, which recomputes rewards from goals alone",
                    )

    def decisions(self, steps: int) -> int:
        """Convert environment steps into decisions, each of which is held for several steps.

        Args:
            steps: Environment steps of all copies together.

        Returns:
            Decisions of all copies together, at least 1.
        """
        return max(1, math.ceil(steps / self.environment.action_repeat))
