"""The configuration of an agent that corrects plans by reinforcement, in worlds that differ from theirs."""

from collections.abc import Iterator
from typing import Annotated, Literal

from pydantic import Field

from agents.configuration.algorithms import PPO, SAC
from agents.configuration.demonstrations import DemonstrationSource
from agents.configuration.schema import ActionScale, AgentConfiguration, Configuration, Practice, Schedule
from dq_space_arm_env.validation import Count, Model, NonNegative, Positive, Problem

PREFIX = "residual-"


class Mismatch(Model):
    """How the world of an episode may differ from the plan's.

    Masses are fixed for each copy of the environment; the rest is drawn for each episode, uniformly between
    nothing and these numbers.
    """

    mass_factors: tuple[Positive, ...] = Field(
        default=(0.7, 0.85, 1.0, 1.15, 1.3),
        min_length=1,
        description="factors of mass and inertia of the payload, or of the last link without one",
    )
    noise: NonNegative = Field(
        default=0.01,
        description="largest standard deviation of the noise on what is measured, rad, m, rad/s, m/s",
    )
    push: NonNegative = Field(
        default=0.02,
        description="largest standard deviation of jumps of the base's velocities, rad/s, m/s",
    )
    pushes: Count = Field(default=6, description="mean number of these jumps in an episode, at random times")


class ResidualPractice(Model):
    """The environment as the agent practices in it; the plan with its gains flies, the agent corrects it."""

    copies: Count = Field(default=125, description="environments that are stepped together")
    action_repeat: Count = Field(
        default=20, description="time steps for which a correction is held; the plan's feedback acts at each"
    )
    action_scale: ActionScale = Field(
        default_factory=lambda: ActionScale(
            base_force=0.001, base_torque=0.05, joint_torque=0.2, wrist_rate=0.2
        ),
        description="largest corrections, as fractions of the limits",
    )
    reward_scale: Positive = Field(default=0.02, description="factor of rewards")
    cost_power: Positive = Field(
        default=0.5,
        description="power of the cost of a time step, at most 1; below, small errors count more",
    )
    memory: Positive = Field(
        default=0.3, description="time over which the agent sees deviations averaged, besides the last one, s"
    )

    full_authority: Positive = Field(
        default=0.3,
        description="size of the averaged deviation from the plan, rad, m, rad/s, m/s together, at which "
        "corrections count in full; below in proportion, and not at all as planned",
    )

    def _problems(self) -> Iterator[Problem]:
        if self.cost_power > 1.0:
            yield Problem(("cost_power",), self.cost_power, "must be at most 1, for the cost itself")


class ResidualPPO(PPO):
    """Proximal policy optimization of a correction."""

    name: Literal["residual-PPO"]  # type: ignore[assignment]


class ResidualSAC(SAC):
    """Soft actor-critic for a correction."""

    name: Literal["residual-SAC"]  # type: ignore[assignment]


class ResidualConfiguration(AgentConfiguration):
    """All that the training of a correction follows from, but for the code."""

    demonstrations: DemonstrationSource = Field(
        default_factory=DemonstrationSource, description="plans that are flown, with their feedback gains"
    )
    mismatch: Mismatch = Field(default_factory=Mismatch, description="what the plans do not know")
    environment: ResidualPractice = Field(
        default_factory=ResidualPractice, description="what the agent practices in"
    )
    algorithm: Annotated[ResidualPPO | ResidualSAC, Field(discriminator="name")] = Field(
        description="the algorithm, with its hyperparameters"
    )
    schedule: Schedule = Field(description="budget, evaluations and checkpoints")

    def _problems(self) -> Iterator[Problem]:
        copies, factors = self.environment.copies, self.mismatch.mass_factors
        if copies < len(factors):
            yield Problem(
                ("environment", "copies"),
                copies,
                f"must be at least {len(factors)}, one for each mass factor",
            )
        for name in ("hindsight", "demonstrations"):
            if getattr(self.algorithm, name, None) is not None:
                yield Problem(
                    ("algorithm", name), "given", "must be left out: corrections are learned without"
                )

    def learner(self) -> Configuration:
        """Describe the learner alone, to which the plan is a part of the environment.

        Returns:
            The configuration of an agent that learns by reinforcement.
        """
        kept = self.model_dump(exclude_none=True, exclude={"demonstrations", "mismatch"})
        own = ResidualPractice.model_fields.keys() - Practice.model_fields.keys()
        # The environment itself takes the power of costs.
        kept["environment"] = {
            name: value
            for name, value in kept["environment"].items()
            if name not in own and name != "cost_power"
        }
        kept["algorithm"]["name"] = self.algorithm.name.removeprefix(PREFIX)
        return Configuration.model_validate(kept)
