"""Second derivatives of the Munthe-Kaas pose update with respect to the twists of the four stages.

Each stage turns where it starts, P_s = a_s h w_{s-1}, and its twist o_s into a slope w_s; the pose moves with
Omega = h sum b_s w_s. As in any chain, Jacobians S_st = dw_s/do_t are carried forward and multipliers eta_s
of w_s backward. Only the curvature of each link then has to be derived, over 12 numbers at most instead of
the 24 of all twists; that of one stage lasts for all.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import casadi

from dq_space_arm_env.compiler.symbols import column, symbols, zeros
from dq_space_arm_env.integrators.curvature import pose_curvature
from dq_space_arm_env.integrators.field import PoseCoordinates
from dq_space_arm_env.integrators.rk4_stages import OFFSETS, WEIGHTS, stage_slope

Scalar = Any
Matrix = Any


@dataclass(frozen=True, eq=False)
class TwistCurvature:
    """Derivatives of multiplier . (new pose), over the base's n tangent directions; stages count from 1.

    Attributes:
        by_twist: Gradient with respect to the twist of each stage, SX (n, 1).
        twice: Hessian blocks of two twists (s, t), s >= t, SX (n, n), rows of s.
        by_pose: Second derivative with respect to the old pose (rows) and the twist of a stage, SX (n, n).
    """

    by_twist: Mapping[int, Matrix]
    twice: Mapping[tuple[int, int], Matrix]
    by_pose: Mapping[int, Matrix]


@dataclass(frozen=True, eq=False)
class _Stage:
    """A stage's slope w at its start P and twist o.

    Attributes:
        start: P, (n, 1).
        twist: o, (n, 1).
        slope: w, (n, 1).
        by_start: dw/dP, (n, n).
        by_twist: dw/do, (n, n).
    """

    start: Matrix
    twist: Matrix
    slope: Matrix
    by_start: Matrix
    by_twist: Matrix


class _StageSlope:
    """Slopes of stages and their derivatives, derived once over symbols."""

    def __init__(self, pose: PoseCoordinates) -> None:
        n = len(pose.directions)
        self._start, self._twist, self._multiplier = (column(*symbols(name, n)) for name in ("P", "o", "eta"))
        full = [pose.full_twist(casadi.vertsplit(entries)) for entries in (self._start, self._twist)]
        slope = stage_slope(*full)
        self._slope = column(*(slope[i] for i in pose.directions))
        self._jacobians = [casadi.jacobian(self._slope, entries) for entries in (self._start, self._twist)]
        gradient = casadi.mtimes(self._jacobians[0].T, self._multiplier)
        self._curvature = [casadi.jacobian(gradient, entries) for entries in (self._start, self._twist)]

    def at(self, start: Matrix, twist: Matrix) -> _Stage:
        """A stage with its first derivatives."""
        names = casadi.vertcat(self._start, self._twist)
        values = casadi.densify(casadi.vertcat(start, twist))
        return _Stage(start, twist, *casadi.substitute([self._slope, *self._jacobians], [names], [values]))

    def curvature(self, stage: _Stage, multiplier: Matrix) -> tuple[Matrix, Matrix]:
        """Second derivatives of multiplier . w: by start twice, by start (rows) and twist. By twist: zero."""
        names = casadi.vertcat(self._start, self._twist, self._multiplier)
        values = casadi.densify(casadi.vertcat(stage.start, stage.twist, multiplier))
        by_start, by_both = casadi.substitute(self._curvature, [names], [values])
        return by_start, by_both


def twist_curvature(
    pose: PoseCoordinates, twists: Sequence[Matrix], h: Scalar, multiplier: Sequence[Scalar]
) -> TwistCurvature:
    """Derivatives of multiplier . (new pose) with respect to the twists of the stages.

    Args:
        pose: Tells which directions the base can move in.
        twists: Free entries of the base twist at the four stages, SX (n, 1) each.
        h: Time step, s.
        multiplier: Weights of the n tangent directions of the new pose.

    Returns:
        The derivatives.
    """
    slopes, n = _StageSlope(pose), len(pose.directions)
    numbers = range(1, len(twists) + 1)
    offsets, weights = (dict(zip(numbers, values, strict=True)) for values in (OFFSETS, WEIGHTS))
    stages: dict[int, _Stage] = {}
    # by[s, t] = S_st; by_start[s, t] = dP_s/do_t.
    by: dict[tuple[int, int], Matrix] = {}
    by_start: dict[tuple[int, int], Matrix] = {}
    start = zeros(n, 1)
    for s, twist in zip(numbers, twists, strict=True):
        if s > 1:
            start = offsets[s] * h * stages[s - 1].slope
        stages[s] = slopes.at(start, twist)
        by[s, s] = stages[s].by_twist
        for t in range(1, s):
            by_start[s, t] = offsets[s] * h * by[s - 1, t]
            by[s, t] = casadi.mtimes(stages[s].by_start, by_start[s, t])
    omega = h * sum(weights[s] * stages[s].slope for s in numbers)
    by_omega = {t: h * sum(weights[s] * by[s, t] for s in numbers if s >= t) for t in numbers}
    increment = pose.full_twist(casadi.vertsplit(casadi.densify(omega)))
    curved = pose_curvature(pose, increment, multiplier)

    twice = {
        (s, t): casadi.mtimes(by_omega[s].T, casadi.mtimes(curved.increment_twice, by_omega[t]))
        for s in numbers
        for t in range(1, s + 1)
    }
    by_twist = {}
    later = zeros(n, 1)  # what the next stage passes on to the slope that it starts with
    for s in reversed(numbers):
        eta = weights[s] * h * curved.by_increment + later
        by_twist[s] = casadi.mtimes(stages[s].by_twist.T, eta)
        later = offsets[s] * h * casadi.mtimes(stages[s].by_start.T, eta)
        start_twice, mixed = slopes.curvature(stages[s], eta)
        for t in range(1, s):
            twice[s, t] += casadi.mtimes(mixed.T, by_start[s, t])
            moved = casadi.mtimes(start_twice, by_start[s, t])
            for r in range(t, s):
                twice[r, t] += casadi.mtimes(by_start[s, r].T, moved)
    by_pose = {s: casadi.sparsify(casadi.mtimes(curved.mixed, by_omega[s])) for s in numbers}
    return TwistCurvature(by_twist, {pair: casadi.sparsify(block) for pair, block in twice.items()}, by_pose)
