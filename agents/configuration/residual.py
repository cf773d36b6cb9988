"""Configuration of an agent that learns to correct plans under model mismatch."""

from collections.abc import Iterator
from typing import Annotated, Any, Literal

from pydantic import Field

from agents.configuration.algorithms import PPO, SAC, Demonstrated, Hindsight, Lagrangian
from agents.configuration.reinforcement import ActionScale, Configuration, Practice, Schedule
from agents.configuration.schema import AgentConfiguration, DemonstrationSource, Many, Mismatch
from dq_space_arm_env.validation import Model, Positive, Problem

PREFIX = "residual-"
_REFUSED: Any = Field(default=None, exclude=True, description="refused: corrections are learned without it")


class ResidualPractice(Model):
    """The training environment: the plan flies with its gains, and the agent corrects it."""

    copies: Many = Field(default=125, description="environments stepped together")
    action_repeat: Many = Field(
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
        le=1.0,
        description="exponent of the cost of a step, at most 1; below 1, small errors count more",
    )
    memory: Positive = Field(
        default=0.3, description="time over which the agent sees deviations averaged, beside the current, s"
    )

    full_authority: Positive = Field(
        default=0.3,
        description="norm of the averaged deviation from the plan (rad, m, rad/s, m/s together) at which "
        "corrections have full authority; below it in proportion, on the plan none",
    )


class ResidualPPO(PPO):
    """Proximal policy optimization of a correction."""

    name: Literal["residual-PPO"]  # type: ignore[assignment]
    lagrangian: Lagrangian | None = _REFUSED


class ResidualSAC(SAC):
    """Soft actor-critic for a correction."""

    name: Literal["residual-SAC"]  # type: ignore[assignment]
    hindsight: Hindsight | None = _REFUSED
    demonstrations: Demonstrated | None = _REFUSED


class ResidualConfiguration(AgentConfiguration):
    """Everything that determines the training of a correction, apart from the code."""

    demonstrations: DemonstrationSource = Field(
        default_factory=DemonstrationSource, description="plans to fly with their feedback gains"
    )
    mismatch: Mismatch = Field(default_factory=Mismatch, description="what the plans do not model")
    environment: ResidualPractice = Field(
        default_factory=ResidualPractice, description="the training environment"
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
        if isinstance(self.algorithm, PPO):
            yield from self.algorithm.batch_problems(copies)
        for name, field in type(self.algorithm).model_fields.items():
            if field.exclude and getattr(self.algorithm, name) is not None:
                yield Problem(
                    ("algorithm", name), "given", "must be left out: corrections are learned without it"
                )

    def learner(self) -> Configuration:
        """Configuration of the learner alone, for which the plan is part of the environment."""
        kept = self.model_dump(exclude_none=True, exclude={"demonstrations", "mismatch"})
        own = ResidualPractice.model_fields.keys() - Practice.model_fields.keys()
        # The residual environment applies the cost exponent itself.
        kept["environment"] = {
            name: value
            for name, value in kept["environment"].items()
            if name not in own and name != "cost_power"
        }
        kept["algorithm"]["name"] = self.algorithm.name.removeprefix(PREFIX)
        return Configuration.model_validate(kept)
