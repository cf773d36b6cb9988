"""Time discretization of a scene, and the numbers it is computed with."""

from collections.abc import Iterator
from typing import Literal

from pydantic import Field, StrictStr, field_validator

from dq_space_arm_env.common.suggestions import did_you_mean
from dq_space_arm_env.scene.integrator_registry import INTEGRATORS
from dq_space_arm_env.validation.fields import Positive, Steps, TimeStep
from dq_space_arm_env.validation.problems import Model, Problem, problem

TOLERANCES = {
    "float64": {"rtol": 1e-8, "atol": 1e-10, "tolerance": 1e-6},
    "float32": {"rtol": 1e-5, "atol": 1e-6, "tolerance": 1e-4},
}
"""Default tolerances of adaptive integrators, by precision and key."""
SMALLEST_SINGLE_RTOL = 1e-6
"""Smallest relative tolerance that single precision can keep."""


class Simulation(Model):
    """Time step, integrator and precision."""

    dt: TimeStep = Field(default=0.015, description="time step, s")
    steps: Steps = Field(default=1000, description="number of time steps of an episode")
    integrator: StrictStr = Field(default="rk4", description="name of the integrator")
    precision: Literal["float64", "float32"] = Field(
        default="float64",
        description="precision of the machine code: 'float64', or 'float32', about twice as fast in batches "
        "and accurate to six digits",
    )
    formulation: Literal["articulated_body", "minimal_coordinates"] | None = Field(
        default=None,
        description="how accelerations are solved for: 'articulated_body', joint by joint, or "
        "'minimal_coordinates', with the mass matrix, where a base lighter than its arm loses digits; "
        "absent: the faster one, which is articulated_body unless the integrator keeps the momentum",
    )
    rtol: Positive | None = Field(
        default=None,
        description="relative tolerance of `dormand_prince`, of velocities and, in rad and m, of pose "
        "and angles; absent: 1e-8, or 1e-5 in single precision",
    )
    atol: Positive | None = Field(
        default=None,
        description="absolute tolerance of `dormand_prince`, rad, m, rad/s, m/s; absent: 1e-10, or "
        "1e-6 in single precision",
    )
    tolerance: Positive | None = Field(
        default=None,
        exclude_if=lambda value: value is None,  # the hash of a scene without it is as old as the scene
        description="largest error of a substep of `rodas4` and `rodas5p`, rad and m; absent: 1e-6, or 1e-4 "
        "in single precision",
    )

    @field_validator("integrator")
    @classmethod
    def _is_known(cls, name: str) -> str:
        if name not in INTEGRATORS:
            raise problem(
                f"unknown; {did_you_mean(name, INTEGRATORS)}It must be one of {', '.join(INTEGRATORS)}"
            )
        return name

    def _problems(self) -> Iterator[Problem]:
        """Find tolerances without use, or beyond single precision."""
        entry = INTEGRATORS[self.integrator]
        reason = "has other tolerances" if entry.is_adaptive else "takes fixed steps"
        for key in TOLERANCES[self.precision]:
            value = getattr(self, key)
            if value is not None and key not in entry.tolerances:
                users = " or ".join(name for name, each in INTEGRATORS.items() if key in each.tolerances)
                yield Problem(
                    (key,), value, f"{self.integrator} {reason}: remove it, or set integrator to {users}"
                )
        if self.precision == "float32" and self.rtol is not None and self.rtol < SMALLEST_SINGLE_RTOL:
            sentence = f"must be at least {SMALLEST_SINGLE_RTOL:g} in single precision"
            yield Problem(("rtol",), self.rtol, sentence)

    def tolerance_of(self, key: str) -> float:
        """The tolerance under a key, the default of the precision if it is absent."""
        given: float | None = getattr(self, key)
        return TOLERANCES[self.precision][key] if given is None else given
