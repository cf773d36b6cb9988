"""What flights are compared under: how the worlds differ from the plan's."""

from typing import NamedTuple

from agents.evaluation.conditions import PAYLOAD_CHANGE
from experts.report.solvers.receding import NOISE, PUSH


class Condition(NamedTuple):
    """How worlds differ from the plan's.

    Attributes:
        name: What tables call it.
        mass_factor: Factor of mass and inertia of the payload, or of the last link without one.
        noise: Standard deviation of what is measured, rad, m, rad/s, m/s.
        push: Standard deviation of the jumps of the base's velocities, rad/s, m/s.
    """

    name: str
    mass_factor: float = 1.0
    noise: float = 0.0
    push: float = 0.0


_LIGHT, _HEAVY = 1.0 - PAYLOAD_CHANGE, 1.0 + PAYLOAD_CHANGE
CONDITIONS = {
    condition.name: condition
    for condition in (
        Condition("as-planned"),
        Condition("light", mass_factor=_LIGHT),
        Condition("heavy", mass_factor=_HEAVY),
        Condition("noise", noise=NOISE),
        Condition("small-pushes", push=PUSH / 4.0),
        Condition("pushes", push=PUSH),
        Condition("light-noise-pushes", _LIGHT, NOISE, PUSH),
        Condition("heavy-noise-pushes", _HEAVY, NOISE, PUSH),
    )
}
"""As for the benchmark of the receding-horizon expert, with the masses of the evaluation protocol."""
