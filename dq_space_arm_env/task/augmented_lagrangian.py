"""The augmented Lagrangian of a scene's task: its cost, and a penalty for each row of its constraints.

A row c = 0 with multiplier l and penalty r adds l c + r c^2 / 2. A row c <= 0 adds the penalty-barrier of
Ben-Tal & Zibulevsky (SIAM Journal on Optimization 7, 1997),

    l / r f(r c),    f(t) = t + t^2 / 2           for t >= -1/2,
                            -log(-2 t) / 4 - 3/8  below,

which has two continuous derivatives: the usual quadratic one has a kink where a row becomes active, at which
Newton's steps are cut short. Multipliers and penalties are parameters of the stages, after those of the
scene; in the last stage they are those of the rows at the end.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, NamedTuple, Self

import casadi

from dq_space_arm_env.dynamics.space_arm_field import SpaceArmField
from dq_space_arm_env.scene.constraint_rows import Row, n_multipliers, penalized_rows, terminal_rows
from dq_space_arm_env.scene.schema import Scene
from dq_space_arm_env.task.constraint_residuals import penalized_residuals
from dq_space_arm_env.task.equations import SceneEquations, total
from dq_space_arm_env.task.terminal_residuals import terminal_residuals

Scalar = Any
Scalars = Sequence[Scalar]

_TINY = 1e-300  # penalty that stands for none


class Penalty(NamedTuple):
    """The penalty of a row, and its derivatives by the residual."""

    value: Scalar
    slope: Scalar
    curvature: Scalar


@dataclass(frozen=True)
class PenalizedEquations(SceneEquations):
    """A scene's equations, whose cost has the penalties of its constraints."""

    multipliers: Scalars = ()
    penalties: Scalars = ()

    @classmethod
    def of(cls, scene: Scene, parameters: Scalars | None = None) -> Self:
        """Equations of a scene with symbols for what varies, multipliers and penalties."""
        plain, count = SceneEquations.of(scene, parameters), n_multipliers(scene)
        names = ("multiplier", "penalty")
        multipliers, penalties = ([casadi.SX.sym(f"{name}_{i}") for i in range(count)] for name in names)
        symbols = [*plain.field.parameters, *multipliers, *penalties]
        field = SpaceArmField(plain.tree, plain.layout, symbols, scene.simulation.formulation)
        parts = {name: getattr(plain, name) for name in SceneEquations.__dataclass_fields__}
        return cls(**{**parts, "field": field}, multipliers=multipliers, penalties=penalties)

    def cost_terms(self, x: Scalars, u: Scalars) -> list[Scalar]:
        """The terms of the stage cost, and the penalty of the path's rows."""
        residuals = penalized_residuals(self, self.base_pose(x), self.y(x), u)
        penalties = self.penalized(penalized_rows(self.scene), residuals)
        return [*super().cost_terms(x, u), total([each.value for each in penalties])]

    def terminal_cost_terms(self, x: Scalars) -> list[Scalar]:
        """The terms of the terminal cost, and the penalty of the rows at the end."""
        residuals = terminal_residuals(self, self.base_pose(x), self.y(x))
        penalties = self.penalized(terminal_rows(self.scene), residuals)
        return [*super().terminal_cost_terms(x), total([each.value for each in penalties])]

    def penalized(self, rows: Sequence[Row], residuals: Scalars) -> list[Penalty]:
        """Penalties of rows with their residuals; the expert keeps to the margins."""
        return [
            _penalty(row, residual + row.margin, multiplier, penalty)
            for row, residual, multiplier, penalty in zip(
                rows, residuals, self.multipliers, self.penalties, strict=False
            )
        ]


def _penalty(row: Row, c: Scalar, multiplier: Scalar, penalty: Scalar) -> Penalty:
    if row.is_equality:
        return Penalty(multiplier * c + 0.5 * penalty * c * c, multiplier + penalty * c, penalty)
    r = casadi.fmax(penalty, _TINY)
    t = r * c
    is_far = t < -0.5
    far = casadi.if_else(is_far, t, -0.5)
    value = casadi.if_else(is_far, -0.25 * casadi.log(-2.0 * far) - 0.375, t + 0.5 * t * t)
    slope = casadi.if_else(is_far, -0.25 / far, 1.0 + t)
    curvature = casadi.if_else(is_far, 0.25 / (far * far), 1.0)
    return Penalty(multiplier / r * value, multiplier * slope, multiplier * r * curvature)
