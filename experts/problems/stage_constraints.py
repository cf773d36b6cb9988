"""Constraints of a problem's stages and of its end, as the solver sees them.

A problem that has constraints has an attribute `constraints`, and a cost with their penalties: multipliers
and penalties are columns of `parameters.more`, which its kernels read (`ShootingProblem`).
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from dq_space_arm_env.scene.constraint_rows import Row
from experts.problems.shooting_problem import FloatArray


@dataclass(frozen=True, eq=False)
class StageConstraints:
    """Rows c <= 0 or c = 0 of N stages and of the end, up to m of each.

    Attributes:
        path: Rows of the stages; those without the input do not hold at stage 0, whose state is given.
        terminal: Rows of the end.
        multipliers: Present multipliers, shape (N + 1, m); zero where there is no row.
        penalties: Present penalties, shape (N + 1, m); with zeros the rows do not count.
        residuals: Function of states (N + 1, n_x) and controls (N, n_u) to residuals with the margins of
            their rows, (N, n_c) and (n_g,).
        slopes: Function of a final state (n_x,) to the derivatives of the rows at the end by the tangent
            state, (n_g, n_t).
        reserve: Margins of the rows at the end besides their own, shape (n_g,); only residuals have them.
        end_weight: Factor of multipliers and penalties at the end, see `ArmProblem.coarsened`.
    """

    path: Sequence[Row]
    terminal: Sequence[Row]
    multipliers: FloatArray
    penalties: FloatArray
    residuals: Callable[[FloatArray, FloatArray], tuple[FloatArray, FloatArray]]
    slopes: Callable[[FloatArray], FloatArray]
    reserve: FloatArray
    end_weight: float

    def find(self, states: FloatArray, controls: FloatArray) -> FloatArray:
        """Residuals, shape (N + 1, m), zero where there is no row."""
        found = np.zeros_like(self.multipliers)
        path, terminal = self.residuals(states, controls)
        found[:-1, : len(self.path)], found[-1, : len(self.terminal)] = path, terminal
        found[~self.holds] = 0.0
        return found

    @property
    def holds(self) -> NDArray[np.bool_]:
        """Where there is a row that holds, shape (N + 1, m)."""
        holds = np.zeros(self.multipliers.shape, np.bool_)
        holds[1:-1, : len(self.path)] = True
        holds[0, : len(self.path)] = [row.has_input for row in self.path]
        holds[-1, : len(self.terminal)] = True
        return holds

    @property
    def equalities(self) -> NDArray[np.bool_]:
        """Where a row is an equality, shape (N + 1, m)."""
        found = np.zeros(self.multipliers.shape, np.bool_)
        found[:-1, : len(self.path)] = [row.is_equality for row in self.path]
        found[-1, : len(self.terminal)] = [row.is_equality for row in self.terminal]
        return found

    def name(self, stage: int, column: int) -> str:
        """Name of a row."""
        rows = self.path if stage < len(self.multipliers) - 1 else self.terminal
        return rows[column].name
