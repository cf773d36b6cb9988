"""Time discretization of a scene, and the numbers it is computed with."""

from collections.abc import Iterator
from typing import Literal

from pydantic import Field, StrictStr, field_validator

from dq_space_arm_env.common.suggestions import did_you_mean
from dq_space_arm_env.scene.integrator_registry import INTEGRATORS
from dq_space_arm_env.validation.fields import Positive, Steps, TimeStep
from dq_space_arm_env.validation.problems import Model, Problem, problem

TOLERANCES = {"float64": (1e-8, 1e-10), "float32": (1e-5, 1e-6)}
"""Default relative and absolute tolerance of adaptive integrators, by precision."""
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
        description="relative tolerance of an adaptive integrator, of velocities and, in rad and m, of pose "
        "and angles; absent: 1e-8, or 1e-5 in single precision",
    )
    atol: Positive | None = Field(
        default=None,
        description="absolute tolerance of an adaptive integrator, rad, m, rad/s, m/s; absent: 1e-10, or "
        "1e-6 in single precision",
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
        adaptive = " or ".join(name for name, entry in INTEGRATORS.items() if entry.is_adaptive)
        for name in ("rtol", "atol"):
            value = getattr(self, name)
            if value is not None and not INTEGRATORS[self.integrator].is_adaptive:
                sentence = f"{self.integrator} takes fixed steps: remove it, or set integrator to {adaptive}"
                yield Problem((name,), value, sentence)
        if self.precision == "float32" and self.rtol is not None and self.rtol < SMALLEST_SINGLE_RTOL:
            sentence = f"must be at least {SMALLEST_SINGLE_RTOL:g} in single precision"
            yield Problem(("rtol",), self.rtol, sentence)

    @property
    def tolerances(self) -> tuple[float, float]:
        """Relative and absolute tolerance of an adaptive integrator."""
        rtol, atol = TOLERANCES[self.precision]
        return (rtol if self.rtol is None else self.rtol, atol if self.atol is None else self.atol)
