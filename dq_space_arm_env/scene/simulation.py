"""Time discretization of a scene, and the numbers it is computed with."""

from collections.abc import Iterator
from typing import Literal

from pydantic import Field, StrictStr, field_validator

from dq_space_arm_env.common.suggestions import did_you_mean
from dq_space_arm_env.scene.integrator_registry import INTEGRATORS
from dq_space_arm_env.validation.fields import Positive, PositiveOrOff, Steps, TimeStep
from dq_space_arm_env.validation.problems import Model, Problem, problem

TOLERANCES = {
    "float64": {"rtol": 1e-8, "atol": 1e-10, "tolerance": 1e-6},
    "float32": {"rtol": 1e-5, "atol": 1e-6, "tolerance": 1e-4},
}
"""Default tolerances of adaptive integrators, by precision and key."""
DIVIDED = 1e-3
"""Default tolerance by which the environment divides steps of Runge-Kutta methods, rad and m.

No planned motion reaches it, not even in steps of 0.1 s, so environment and expert agree to the bit; a
motion under random or saturated actions keeps its energy. Under held actions a smaller one predicts no more:
those are chaotic.
"""
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
    tolerance: PositiveOrOff | None = Field(
        default=None,
        exclude_if=lambda value: value is None,  # the hash of a scene without it is as old as the scene
        description="largest error of a substep, rad and m: by it `rodas4` and `rodas5p` divide time steps, "
        "absent: 1e-6, or 1e-4 in single precision; and the environment those of Runge-Kutta methods, which "
        "`off` leaves whole, absent: 1e-3",
    )

    @field_validator("integrator")
    @classmethod
    def _is_known(cls, name: str) -> str:
        if name not in INTEGRATORS:
            known = f"it must be one of {', '.join(INTEGRATORS)}"
            raise problem(f"unknown; {did_you_mean(name, INTEGRATORS, known)}")
        return name

    def _problems(self) -> Iterator[Problem]:
        """Find tolerances without use, or beyond single precision."""
        entry = INTEGRATORS[self.integrator]
        reason = "has other tolerances" if entry.is_adaptive else "takes fixed steps"
        if entry.is_adaptive and self.tolerance == "off":
            yield Problem(("tolerance",), "off", f"{self.integrator} cannot do without: remove it")
            return
        for key in TOLERANCES[self.precision]:
            value = getattr(self, key)
            if value is not None and value != "off" and key not in entry.uses:
                users = " or ".join(name for name, each in INTEGRATORS.items() if key in each.uses)
                yield Problem(
                    (key,), value, f"{self.integrator} {reason}: remove it, or set integrator to {users}"
                )
        if self.precision == "float32" and self.rtol is not None and self.rtol < SMALLEST_SINGLE_RTOL:
            sentence = f"must be at least {SMALLEST_SINGLE_RTOL:g} in single precision"
            yield Problem(("rtol",), self.rtol, sentence)

    def tolerance_of(self, key: str) -> float:
        """The tolerance under a key, the default of the precision if it is absent or off."""
        given = getattr(self, key)
        return float(TOLERANCES[self.precision][key] if given in (None, "off") else given)

    @property
    def division(self) -> float:
        """The tolerance by which the environment divides steps of Runge-Kutta methods, rad and m."""
        return DIVIDED if self.tolerance in (None, "off") else float(self.tolerance)

    def estimates_error(self, integrator: str) -> bool:
        """Whether a step of the environment tells its error with an integrator."""
        entry = INTEGRATORS[integrator]
        return entry.is_adaptive or (entry.is_embedded and self.tolerance != "off")
