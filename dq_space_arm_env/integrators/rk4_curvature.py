"""Second derivatives of the classical Runge-Kutta-Munthe-Kaas step, stage by stage.

The step is a composition: stage s starts from y_s = y + a_s h k_{s-1} and has the rates k_s = f(y_s, u); the
pose moves with Omega, which depends on the twists of the four stages. First derivatives Z_s of (y_s, u) are
propagated forward, multipliers mu_s of k_s and nu_s of y_s backward, nu_s = f_y' mu_s + tau_s with the
gradient tau_s through the twist of the stage. Then the second derivative is

    sum_s Z_s' H_s Z_s + (terms of pairs of twists) + (terms of twists and pose),   H_s = mu_s . f_zz,

because only f and the pose update are curved.

It is accumulated as X, which is added to its transpose at the end, so each mixed derivative may stand on
either side of the diagonal. It stands in the row of the state that couples with more others: the rows of the
inputs and of the base's linear velocity stay empty, which saves half of the work. B_s is H_s in this form,
and C_s holds the contribution of the pairs of twists to the same rows: X = sum_s Z_s' (B_s Z_s + C_s).
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from itertools import pairwise
from typing import Any

import casadi

from dq_space_arm_env.algebra.symbolic import column, symbols, zeros
from dq_space_arm_env.compiler.graph import graph_of, trace
from dq_space_arm_env.compiler.program import Program
from dq_space_arm_env.dynamics.vector_field import TwiceDifferentiableField, split_state
from dq_space_arm_env.integrators.explicit_stages import stage_pattern
from dq_space_arm_env.integrators.method import graph_inputs
from dq_space_arm_env.integrators.munthe_kaas import TwistCurvature, stage_twists, twist_curvature
from dq_space_arm_env.integrators.pose_update import upper_triangle
from dq_space_arm_env.integrators.tableaus import RK4_OFFSETS, RK4_WEIGHTS

Scalar = Any
Matrix = Any

STAGES = range(1, 5)


class StepCurvature:
    """The graphs for one field; `append` calls them in order."""

    def __init__(self, field: TwiceDifferentiableField) -> None:
        """Find the structural nonzeros, and the side of the diagonal on which they stand."""
        self.field = field
        self.twist = list(field.pose.twist_indices)
        n_y, n_u = field.n_y, field.n_u
        y, u = symbols("y", n_y), symbols("u", n_u)
        _, by_y, by_u = field.linearized_rates(y, u)
        self.by_y, self.by_u = by_y.sparsity(), by_u.sparsity()
        self.change = stage_pattern(field)
        rates, multiplier = symbols("k", n_y), symbols("m", n_y)
        hessian = field.rates_hessian(y, u, rates, by_y, by_u, multiplier)
        pose = self._pose_derivatives(symbols("x", field.n_x), [y] * 3, casadi.SX.sym("h"), multiplier)
        blocks = [block.sparsity() for block in pose.twice.values()]
        twice = _union(blocks + [block.T for block in blocks])
        twists = zeros(n_y + n_u, n_y + n_u)
        twists[self.twist, self.twist] = casadi.SX(twice)
        coupled = hessian.sparsity().unite(casadi.sparsify(twists).sparsity())
        # Each of (y, u) ranks before those that couple with fewer.
        couplings = [end - begin for begin, end in pairwise(coupled.colind())]
        order = sorted(range(n_y + n_u), key=lambda i: -couplings[i])
        rank = [order.index(i) for i in range(n_y + n_u)]
        self.half = _half(coupled, rank)
        self.twice, self.twist_half = twice, _half(twice, [rank[i] for i in self.twist])
        self.by_pose = _union(block.sparsity() for block in pose.by_pose.values())
        moved = self._moved(1.0, casadi.SX.sym("K", self.change))[self.twist, :]
        self.pairs = casadi.mtimes(casadi.SX(self.twist_half), moved).sparsity()
        self.pose_sum = casadi.mtimes(casadi.SX(self.by_pose), moved).sparsity()
        self.sum = self._stage_sum(*self._stage_symbols()).sparsity()

    def append(self, program: Program) -> Any:
        """Append all calls; x, u, h, multiplier are buffers. Returns the pattern of `curvature`."""
        program.call(self._offsets())
        jacobians, sensitivity = self._jacobians(), self._sensitivity()
        for s in STAGES:
            names = {"k": f"k{s - 1}", "offset": f"offset{s}"}
            program.call(jacobians, **names, rates=f"k{s}", by_y=f"by_y{s}", by_u=f"by_u{s}")
        for s in STAGES[:-1]:
            program.call(
                sensitivity,
                by_y=f"by_y{s}",
                by_u=f"by_u{s}",
                change=f"K{s - 1}",
                offset=f"offset{s}",
                rate_change=f"K{s}",
            )
        program.call(self._pose())
        stage = self._stage()
        for s in reversed(STAGES):
            program.call(
                stage,
                k=f"k{s - 1}",
                offset=f"offset{s}",
                rates=f"k{s}",
                by_y=f"by_y{s}",
                by_u=f"by_u{s}",
                weight=f"weight{s}",
                later=f"nu{s + 1}",
                later_offset=f"offset{s + 1}",
                by_twist=f"tau{s}",
                twist_hessian=f"W{s}{s}",
                nu=f"nu{s}",
                half=f"B{s}",
            )
        program.call(self._twist_pairs())
        congruence = self._congruence()
        for s in STAGES[1:]:
            program.call(
                congruence,
                offset=f"offset{s}",
                change=f"K{s - 1}",
                half=f"B{s}",
                pairs=f"C{s}",
                by_pose=f"D{s}",
                sum=f"X{s - 1}",
                pose_sum=f"P{s - 1}",
                new_sum=f"X{s}",
                new_pose_sum=f"P{s}",
            )
        total, pattern = self._total()
        program.call(total)
        return pattern

    def _offsets(self) -> Any:
        """Offsets and weights of the stages, times h; stage 5 stands for the end of the step."""

        def times(h: list[Scalar]) -> dict[str, list[Scalar]]:
            offsets = {f"offset{s}": [a * h[0]] for s, a in enumerate((*RK4_OFFSETS, 0.0), start=1)}
            return offsets | {f"weight{s}": [b * h[0]] for s, b in enumerate(RK4_WEIGHTS, start=1)}

        return trace(f"{self.field.name}_rk4_times", {"h": 1}, times)

    def _start(self, x: Sequence[Scalar], k: Sequence[Scalar], offset: Scalar) -> list[Scalar]:
        y = split_state(self.field, x)[1]
        return [entry + offset * rate for entry, rate in zip(y, k, strict=True)]

    def _jacobians(self) -> Any:
        """Graph of a stage's rates and of their Jacobians at the stage's own start."""
        field = self.field
        x, u, k = symbols("x", field.n_x), symbols("u", field.n_u), symbols("k", field.n_y)
        offset = casadi.SX.sym("offset")
        rates, by_y, by_u = field.linearized_rates(self._start(x, k, offset), u)
        return graph_of(
            f"{field.name}_rk4_jacobians",
            graph_inputs(field, x=x, u=u, k=k, offset=[offset]),
            {
                "rates": rates,
                "by_y": casadi.project(by_y, self.by_y).nonzeros(),
                "by_u": casadi.project(by_u, self.by_u).nonzeros(),
            },
        )

    def _moved(self, offset: Scalar, change: Matrix) -> Matrix:
        """Derivative of a stage's start with respect to (y, u)."""
        n_y, n_u = self.field.n_y, self.field.n_u
        return casadi.horzcat(casadi.SX.eye(n_y), zeros(n_y, n_u)) + offset * change

    def _sensitivity(self) -> Any:
        """Graph of the derivative of a stage's rates with respect to (y, u) at the start of the step."""
        by_y, by_u = casadi.SX.sym("F", self.by_y), casadi.SX.sym("G", self.by_u)
        change, offset = casadi.SX.sym("K", self.change), casadi.SX.sym("offset")
        n_y = self.field.n_y
        rate_change = casadi.mtimes(by_y, self._moved(offset, change)) + casadi.horzcat(zeros(n_y, n_y), by_u)
        return graph_of(
            f"{self.field.name}_rk4_sensitivity",
            {
                "by_y": by_y.nonzeros(),
                "by_u": by_u.nonzeros(),
                "change": change.nonzeros(),
                "offset": [offset],
            },
            {"rate_change": casadi.project(rate_change, self.change).nonzeros()},
        )

    def _pose_derivatives(
        self, x: Sequence[Scalar], stages: Sequence[Sequence[Scalar]], h: Scalar, multiplier: Sequence[Scalar]
    ) -> TwistCurvature:
        """Derivatives of multiplier . (new pose) by the twists, for the rates of the first three stages."""
        field, n = self.field, len(self.twist)
        twists = stage_twists(field.pose, split_state(field, x)[1], stages, h)
        return twist_curvature(field.pose, [column(*twist) for twist in twists], h, multiplier[:n])

    def _pose(self) -> Any:
        """Graph of the derivatives of multiplier . (new pose) with respect to the twists of the stages.

        Gradients tau_s; Hessian blocks W_st, in half for s = t; and D_s, by the old pose and the twist of
        stage s.
        """
        field = self.field
        x, h = symbols("x", field.n_x), casadi.SX.sym("h")
        stages = [symbols(f"k{s}", field.n_y) for s in STAGES[:-1]]
        multiplier = symbols("l", len(self.twist) + field.n_y)
        pose = self._pose_derivatives(x, stages, h, multiplier)
        outputs = {f"tau{s}": casadi.densify(pose.by_twist[s]).nonzeros() for s in STAGES}
        for (s, t), block in pose.twice.items():
            pattern = self.twist_half if s == t else self.twice
            outputs[f"W{s}{t}"] = casadi.project(block, pattern).nonzeros()
        outputs |= {f"D{s}": casadi.project(pose.by_pose[s], self.by_pose).nonzeros() for s in STAGES}
        inputs = {"x": x, "h": [h], "multiplier": multiplier}
        inputs |= {f"k{s}": k for s, k in enumerate(stages, start=1)}
        return graph_of(f"{field.name}_rk4_pose_curvature", inputs, outputs)

    def _stage(self) -> Any:
        """Graph of the multipliers of a stage, and of half of the Hessian of what they weight."""
        field, n = self.field, len(self.twist)
        n_y, n_u = field.n_y, field.n_u
        x, u, k = symbols("x", field.n_x), symbols("u", n_u), symbols("k", n_y)
        rates, later, by_twist = symbols("r", n_y), symbols("nu", n_y), symbols("tau", n)
        offset, later_offset, weight = symbols("a", 3)
        multiplier = symbols("l", n + n_y)
        by_y, by_u = casadi.SX.sym("F", self.by_y), casadi.SX.sym("G", self.by_u)
        twist_hessian = casadi.SX.sym("W", self.twist_half)
        mu = [weight * a + later_offset * b for a, b in zip(multiplier[n:], later, strict=True)]
        hessian = field.rates_hessian(self._start(x, k, offset), u, rates, by_y, by_u, mu)
        half = casadi.project(hessian, self.half)
        half[self.twist, self.twist] = half[self.twist, self.twist] + twist_hessian
        half = casadi.project(half - 0.5 * casadi.diag(casadi.diag(half)), self.half)
        nu = casadi.densify(casadi.mtimes(by_y.T, column(*mu)))
        nu[self.twist] = nu[self.twist] + column(*by_twist)
        inputs: dict[str, Sequence[Scalar]] = {"x": x, "u": u, "k": k, "offset": [offset], "rates": rates}
        inputs |= {"by_y": by_y.nonzeros(), "by_u": by_u.nonzeros(), "multiplier": multiplier}
        inputs |= {"weight": [weight], "later": later, "later_offset": [later_offset]}
        inputs |= {"by_twist": by_twist, "twist_hessian": twist_hessian.nonzeros()}
        return graph_of(
            f"{field.name}_rk4_stage_curvature",
            graph_inputs(field, **inputs),
            {"nu": nu.nonzeros(), "half": half.nonzeros()},
        )

    def _twist_pairs(self) -> Any:
        """Graph of C_s: contributions of second derivatives by two twists to the rows of stage s."""
        field, n = self.field, len(self.twist)
        blocks = {(s, t): casadi.SX.sym(f"W{s}{t}", self.twice) for s in STAGES for t in range(1, s)}
        changes = [casadi.SX.sym(f"K{s}", self.change) for s in STAGES[:-1]]
        h = casadi.SX.sym("h")
        moved = {1: casadi.horzcat(casadi.SX.eye(field.n_y), zeros(field.n_y, field.n_u))[self.twist, :]}
        for s, change in zip(STAGES[1:], changes, strict=True):
            moved[s] = self._moved(RK4_OFFSETS[s - 1] * h, change)[self.twist, :]
        totals = {s: zeros(n, field.n_y + field.n_u) for s in STAGES}
        for (s, t), block in blocks.items():
            # A mixed derivative that does not stand in a row of stage s stands in one of stage t.
            own = casadi.project(block, self.twist_half)
            totals[s] += casadi.mtimes(own, moved[t])
            totals[t] += casadi.mtimes(casadi.sparsify(block - own).T, moved[s])
        inputs: dict[str, Sequence[Scalar]] = {"h": [h]}
        inputs |= {f"K{s}": change.nonzeros() for s, change in enumerate(changes, start=1)}
        inputs |= {f"W{s}{t}": block.nonzeros() for (s, t), block in blocks.items()}
        outputs = {f"C{s}": casadi.project(total, self.pairs).nonzeros() for s, total in totals.items()}
        return graph_of(f"{field.name}_rk4_twist_pairs", inputs, outputs)

    def _stage_symbols(self) -> tuple[Scalar, Matrix, Matrix, Matrix]:
        """Symbols a_s h, K_{s-1}, B_s, C_s."""
        named = {"K": self.change, "B": self.half, "C": self.pairs}
        return (casadi.SX.sym("offset"), *(casadi.SX.sym(name, p) for name, p in named.items()))

    def _stage_sum(self, offset: Scalar, change: Matrix, half: Matrix, pairs: Matrix) -> Matrix:
        """Z' (B Z + C): with its transpose, a stage's contribution to the second derivative."""
        n_y, n_u = self.field.n_y, self.field.n_u
        inputs = casadi.horzcat(zeros(n_u, n_y), casadi.SX.eye(n_u))
        start = casadi.vertcat(self._moved(offset, change), inputs)
        product = casadi.mtimes(half, start)
        product[self.twist, :] = product[self.twist, :] + pairs
        return casadi.sparsify(casadi.mtimes(start.T, casadi.sparsify(product)))

    def _congruence(self) -> Any:
        """Graph that adds a stage to X, and to the second derivative by pose and (y, u)."""
        offset, change, half, pairs = self._stage_symbols()
        old, by_pose = casadi.SX.sym("X", self.sum), casadi.SX.sym("D", self.by_pose)
        pose_old = casadi.SX.sym("P", self.pose_sum)
        new = old + self._stage_sum(offset, change, half, pairs)
        pose_new = pose_old + casadi.mtimes(by_pose, self._moved(offset, change)[self.twist, :])
        return graph_of(
            f"{self.field.name}_rk4_congruence",
            {
                "offset": [offset],
                "change": change.nonzeros(),
                "half": half.nonzeros(),
                "pairs": pairs.nonzeros(),
                "by_pose": by_pose.nonzeros(),
                "sum": old.nonzeros(),
                "pose_sum": pose_old.nonzeros(),
            },
            {
                "new_sum": casadi.project(new, self.sum).nonzeros(),
                "new_pose_sum": casadi.project(pose_new, self.pose_sum).nonzeros(),
            },
        )

    def _total(self) -> tuple[Any, Any]:
        """Graph of the sum, with stage 1, which starts where the step does."""
        field, n = self.field, len(self.twist)
        later, pose = casadi.SX.sym("X", self.sum), casadi.SX.sym("P", self.pose_sum)
        _, _, half, pairs = self._stage_symbols()
        by_pose = casadi.SX.sym("D", self.by_pose)
        total = later + half
        total[self.twist, :] = total[self.twist, :] + pairs
        first = zeros(n, field.n_y + field.n_u)
        first[:, self.twist] = by_pose
        above = casadi.horzcat(zeros(n, n), pose + first)
        below = casadi.horzcat(zeros(field.n_y + field.n_u, n), casadi.triu(total + total.T))
        curvature = upper_triangle(casadi.vertcat(above, below))
        graph = graph_of(
            f"{field.name}_rk4_curvature",
            {
                "X4": later.nonzeros(),
                "P4": pose.nonzeros(),
                "B1": half.nonzeros(),
                "C1": pairs.nonzeros(),
                "D1": by_pose.nonzeros(),
            },
            {"curvature": curvature.nonzeros()},
        )
        return graph, curvature.sparsity()


def _union(patterns: Iterable[Any]) -> Any:
    """Union of patterns."""
    first, *others = patterns
    for pattern in others:
        first = first.unite(pattern)
    return first


def _half(pattern: Any, rank: Sequence[int]) -> Any:
    """Half of a symmetric pattern: the entries whose row does not rank after their column."""
    kept = [(i, j) for i, j in zip(*pattern.get_triplet(), strict=True) if rank[i] <= rank[j]]
    return casadi.Sparsity.triplet(*pattern.shape, [i for i, _ in kept], [j for _, j in kept])
