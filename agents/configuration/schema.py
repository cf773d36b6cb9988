"""Settings shared by all agents: name, scene, seed, network, and demonstrations."""

import re
from collections.abc import Iterator
from itertools import pairwise
from pathlib import Path
from typing import Annotated, Literal, Self, TypeVar

from pydantic import Field, StrictInt, StrictStr

from dq_space_arm_env.validation import Count, Model, NonNegative, Positive, Problem, count_up_to

RESERVED_SEED = 20180627
"""Seed that the evaluation starts follow from; demonstrations with it would hold the answers."""


Width = Annotated[int, count_up_to(2**14)]
"""Size of a layer, at most what a matrix of a gigabyte has."""
Few = Annotated[int, count_up_to(10_000)]
"""Number of networks, rounds or the like."""
Many = Annotated[int, count_up_to(10_000_000)]
"""Number of things that are in memory together, some hundred bytes each."""
StartFrom = Annotated[
    StrictStr | None,
    Field(
        min_length=1,
        description="policy to start from: name in the zoo, file or run folder; absent: a random one",
    ),
]
MOST_IN_MEMORY = 100_000_000
"""Largest number of decisions in memory, some ten gigabytes."""
MOST_LAYERS = 32
MOST_WEIGHTS = 2**24
"""Largest number of weights between hidden layers: exported policies have room for as many more."""
_NO_NAME = r"[^\w.-]"
_Part = TypeVar("_Part", bound=Model)


def weight_problems(key: str, value: object, weights: int) -> Iterator[Problem]:
    """Tell whether layers of some sizes have more weights between them than a policy's file may have."""
    if weights > MOST_WEIGHTS:
        sentence = f"makes {weights:,} weights between layers, must make at most {MOST_WEIGHTS:,}"
        yield Problem((key,), value, sentence)


class Network(Model):
    """The network of the policy, and of its critics."""

    hidden: tuple[Width, ...] = Field(
        default=(128, 128), max_length=MOST_LAYERS, description="sizes of the hidden layers"
    )
    activation: Literal["tanh", "relu", "silu"] = Field(default="tanh", description="between the layers")

    def _problems(self) -> Iterator[Problem]:
        yield from weight_problems("hidden", list(self.hidden), sum(a * b for a, b in pairwise(self.hidden)))


class AgentConfiguration(Model):
    """Settings common to all agents."""

    name: StrictStr = Field(min_length=1, pattern=r"^[\w.-]+$", description="name of the agent")
    description: StrictStr = Field(default="", description="what it is, and what to expect")
    scene: StrictStr = Field(default="paper", description="name of a shipped scene, or path of a YAML file")
    seed: StrictInt = Field(default=0, ge=0, lt=2**31, description="seed of everything random")
    threads: Few = Field(default=1, description="threads of PyTorch, or of NumPy's matrices")
    network: Network = Field(default_factory=Network, description="the networks")

    def resolved(self) -> Self:
        """The configuration with a seed for its demonstrations: the run's, unless they have their own."""
        return _with_demonstrations_drawn(self, self.seed)


class DemonstrationSource(Model):
    """Demonstrations to learn from: generated for the run, or existing ones.

    The cheapest successful maneuver may end just within the tolerances, where a slightly less exact policy
    misses. Demonstrations may therefore have to meet stricter ones.
    """

    problems: Many = Field(
        default=1000, description="problems to solve, unless there is folder or minari; few of them fail"
    )
    seed: StrictInt | None = Field(
        default=None,
        ge=0,
        description="seed of their starts, unless there is folder or minari; absent: the run's, so that each "
        "run draws its own",
    )
    tolerance_scale: Positive = Field(
        default=1.0, description="tolerances of success that they meet, relative to the scene's, at most 1"
    )
    folder: StrictStr | None = Field(
        default=None, description="folder of existing demonstrations; absent: they are generated"
    )
    minari: StrictStr | None = Field(
        default=None, description="Minari data set written by `demonstrations export`"
    )

    def _problems(self) -> Iterator[Problem]:
        if self.tolerance_scale > 1.0:
            yield Problem(
                ("tolerance_scale",),
                self.tolerance_scale,
                "must be at most 1, for the scene's own tolerances",
            )
        existing = "folder" if self.folder is not None else "minari"
        if self.tolerance_scale < 1.0 and getattr(self, existing) is not None:
            sentence = f"must be absent: existing demonstrations, here of {existing}, have met their own"
            yield Problem(("tolerance_scale",), self.tolerance_scale, sentence)
        if self.folder is not None and self.minari is not None:
            yield Problem(("minari",), self.minari, "must be absent if a folder is given: give one")


class Mismatch(Model):
    """Model mismatch: how an episode's world may differ from the scene.

    Masses are those of a copy or start; the rest is drawn per episode, uniformly between zero and these
    numbers.
    """

    mass_factors: tuple[Positive, ...] = Field(
        default=(0.7, 0.85, 1.0, 1.15, 1.3),
        min_length=1,
        description="factors of mass and inertia of the payload, or of the last link without one",
    )
    noise: NonNegative = Field(
        default=0.01, description="largest standard deviation of the measurement noise, rad, m, rad/s, m/s"
    )
    push: NonNegative = Field(
        default=0.02, description="largest standard deviation of jumps of the base velocities, rad/s, m/s"
    )
    pushes: Count = Field(default=6, description="mean number of these jumps per episode, at random times")


def name_in(name: str, scene: str) -> str:
    """Name of an agent in a scene, a name or file; what no name may have becomes a hyphen."""
    return f"{name}-{re.sub(_NO_NAME, '-', Path(scene).stem)}"


def _with_demonstrations_drawn(model: _Part, seed: int) -> _Part:
    """A copy in which all demonstrations have a seed."""
    if isinstance(model, DemonstrationSource):
        return model.model_copy(update={"seed": seed if model.seed is None else model.seed})
    parts = {name: getattr(model, name) for name in type(model).model_fields}
    drawn = {
        name: _with_demonstrations_drawn(part, seed)
        for name, part in parts.items()
        if isinstance(part, Model)
    }
    return model.model_copy(update=drawn)
