"""Second derivatives of the Runge-Kutta-Munthe-Kaas step, stage by stage.

The step is a composition: stage s starts from y_s = y + a_s h k_{s-1} and has the rates k_s = f(y_s, u); the
pose moves with Omega, which depends on the twists of the four stages. First derivatives Z_s of (y_s, u) are
carried forward, multipliers mu_s of k_s and nu_s of y_s backward, nu_s = f_y' mu_s + tau_s with the gradient
tau_s through the twist of the stage. Then the second derivative is

    sum_s Z_s' H_s Z_s + (terms of pairs of twists) + (terms of twists and pose),   H_s = mu_s . f_zz,

because nothing else than f and the pose update is curved. Sums of products that are symmetric only as a whole
are collected as X and added to their transpose at the end.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import casadi

from dq_space_arm_env.compiler.graph import graph_of, trace
from dq_space_arm_env.compiler.program import Program
from dq_space_arm_env.compiler.symbols import column, symbols, zeros
from dq_space_arm_env.integrators.curvature import pose_curvature, upper_triangle
from dq_space_arm_env.integrators.field import TwiceDifferentiableField, graph_inputs, split_state
from dq_space_arm_env.integrators.rk4_stages import (
    OFFSETS,
    WEIGHTS,
    pose_increment,
    stage_pattern,
    stage_twists,
)

Scalar = Any
Matrix = Any

STAGES = range(1, 5)


class StepCurvature:
    """The graphs of one field; `append` calls them in order."""

    def __init__(self, field: TwiceDifferentiableField) -> None:
        """Find out which entries can be nonzero.

        Args:
            field: The equations of motion.
        """
        self.field = field
        self.twist = list(field.pose.twist_indices)
        n_y, n_u = field.n_y, field.n_u
        y, u = symbols("y", n_y), symbols("u", n_u)
        _, by_y, by_u = field.linearized_rates(y, u)
        self.by_y, self.by_u = by_y.sparsity(), by_u.sparsity()
        self.change = stage_pattern(field)
        rates, multiplier = symbols("k", n_y), symbols("m", n_y)
        hessian = field.rates_hessian(y, u, rates, by_y, by_u, multiplier)
        twists = zeros(n_y + n_u, n_y + n_u)
        twists[self.twist, self.twist] = casadi.SX.ones(len(self.twist), len(self.twist))
        self.hessian = casadi.triu((hessian + twists).sparsity())
        self.sum = self._sum_pattern()

    def append(self, program: Program) -> Any:
        """Append all calls.

        Args:
            program: Has the buffers x, u, h, multiplier.

        Returns:
            Sparsity pattern of the upper triangle in buffer `curvature`.
        """
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
                hessian=f"H{s}",
            )
        program.call(self._twist_pairs())
        congruence = self._congruence()
        for s in STAGES[1:]:
            program.call(
                congruence,
                offset=f"offset{s}",
                change=f"K{s - 1}",
                hessian=f"H{s}",
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
        """Times at which stages start, and weights of their rates; stage 5 stands for the end of the step."""

        def times(h: list[Scalar]) -> dict[str, list[Scalar]]:
            offsets = {f"offset{s}": [a * h[0]] for s, a in enumerate((*OFFSETS, 0.0), start=1)}
            return offsets | {f"weight{s}": [b * h[0]] for s, b in enumerate(WEIGHTS, start=1)}

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

    def _pose(self) -> Any:
        """Graph of the derivatives of multiplier . (new pose) with respect to the twists of the stages.

        Gradients tau_s; Hessian blocks W_st, upper triangles for s = t; and D_s, with respect to the old pose
        and the twist of stage s.
        """
        field, n = self.field, len(self.twist)
        x, h = symbols("x", field.n_x), casadi.SX.sym("h")
        stages = [symbols(f"k{s}", field.n_y) for s in STAGES[:-1]]
        multiplier = symbols("l", n + field.n_y)
        free = [symbols(f"w{s}", n) for s in STAGES]
        names = column(*(entry for twist in free for entry in twist))
        increment = pose_increment(field.pose, free, h)
        slope = casadi.jacobian(column(*(increment[i] for i in field.pose.directions)), names)
        curved = pose_curvature(field.pose, increment, multiplier[:n])
        weights = symbols("g", n)
        bracket = casadi.dot(column(*weights), column(*(increment[i] for i in field.pose.directions)))
        twice = casadi.substitute(
            casadi.hessian(bracket, names)[0], column(*weights), casadi.densify(curved.by_increment)
        )
        twice = twice + casadi.mtimes(slope.T, casadi.mtimes(curved.increment_twice, slope))
        gradient = casadi.mtimes(slope.T, curved.by_increment)
        mixed = casadi.mtimes(curved.mixed, slope)
        twists = stage_twists(field.pose, split_state(field, x)[1], stages, h)
        values = casadi.densify(column(*(entry for twist in twists for entry in twist)))
        gradient, twice, mixed = casadi.substitute([gradient, twice, mixed], [names], [values])
        parts = [list(range(n * s, n * (s + 1))) for s in range(4)]
        outputs = {f"tau{s}": _entries(gradient[part, 0]) for s, part in zip(STAGES, parts, strict=True)}
        for s, part in zip(STAGES, parts, strict=True):
            outputs[f"D{s}"] = _entries(mixed[:, part])
            for t in range(1, s):
                outputs[f"W{s}{t}"] = _entries(twice[part, parts[t - 1]])
            outputs[f"W{s}{s}"] = _entries(twice[part, part])
        inputs = {"x": x, "h": [h], "multiplier": multiplier}
        inputs |= {f"k{s}": k for s, k in enumerate(stages, start=1)}
        return graph_of(f"{field.name}_rk4_pose_curvature", inputs, outputs)

    def _stage(self) -> Any:
        """Graph of the multipliers of a stage, and of the Hessian of what they weight."""
        field, n = self.field, len(self.twist)
        n_y, n_u = field.n_y, field.n_u
        x, u, k = symbols("x", field.n_x), symbols("u", n_u), symbols("k", n_y)
        rates, later, by_twist = symbols("r", n_y), symbols("nu", n_y), symbols("tau", n)
        offset, later_offset, weight = symbols("a", 3)
        multiplier = symbols("l", n + n_y)
        by_y, by_u = casadi.SX.sym("F", self.by_y), casadi.SX.sym("G", self.by_u)
        twist_hessian = casadi.SX.sym("W", n, n)
        mu = [weight * a + later_offset * b for a, b in zip(multiplier[n:], later, strict=True)]
        hessian = field.rates_hessian(self._start(x, k, offset), u, rates, by_y, by_u, mu)
        hessian[self.twist, self.twist] = hessian[self.twist, self.twist] + twist_hessian
        nu = casadi.densify(casadi.mtimes(by_y.T, column(*mu)))
        nu[self.twist] = nu[self.twist] + column(*by_twist)
        inputs: dict[str, Sequence[Scalar]] = {"x": x, "u": u, "k": k, "offset": [offset], "rates": rates}
        inputs |= {"by_y": by_y.nonzeros(), "by_u": by_u.nonzeros(), "multiplier": multiplier}
        inputs |= {"weight": [weight], "later": later, "later_offset": [later_offset]}
        inputs |= {"by_twist": by_twist, "twist_hessian": twist_hessian.nonzeros()}
        return graph_of(
            f"{field.name}_rk4_stage_curvature",
            graph_inputs(field, **inputs),
            {"nu": nu.nonzeros(), "hessian": casadi.project(casadi.triu(hessian), self.hessian).nonzeros()},
        )

    def _twist_pairs(self) -> Any:
        """Graph of C_s = sum over t < s of W_st (derivative of twist t)."""
        field, n = self.field, len(self.twist)
        blocks = {(s, t): casadi.SX.sym(f"W{s}{t}", n, n) for s in STAGES for t in range(1, s)}
        changes = [casadi.SX.sym(f"K{s}", self.change) for s in (1, 2)]
        h = casadi.SX.sym("h")
        moved = [self._moved(0.0, changes[0])[self.twist, :]]
        for offset, change in zip(OFFSETS[1:], changes, strict=False):
            moved.append(self._moved(offset * h, change)[self.twist, :])
        outputs = {}
        for s in STAGES[1:]:
            total = zeros(n, field.n_y + field.n_u)
            for t in range(1, s):
                total = total + casadi.mtimes(blocks[s, t], moved[t - 1])
            outputs[f"C{s}"] = casadi.project(total, self._pair_pattern()).nonzeros()
        inputs: dict[str, Sequence[Scalar]] = {"h": [h]}
        inputs |= {f"K{s}": change.nonzeros() for s, change in enumerate(changes, start=1)}
        inputs |= {f"W{s}{t}": block.nonzeros() for (s, t), block in blocks.items()}
        return graph_of(f"{field.name}_rk4_twist_pairs", inputs, outputs)

    def _pair_pattern(self) -> Any:
        """Sparsity of C_s: the columns that any twist depends on, all of them filled."""
        twist = self._moved(1.0, casadi.SX.sym("K", self.change))[self.twist, :]
        return (casadi.SX.ones(len(self.twist), len(self.twist)) @ twist).sparsity()

    def _sums(self, offset: Scalar, change: Matrix, hessian: Matrix, pairs: Matrix) -> Matrix:
        """Z' (H Z / 2 + C): with its transpose, what a stage adds to the second derivative."""
        n_y, n_u = self.field.n_y, self.field.n_u
        inputs = casadi.horzcat(zeros(n_u, n_y), casadi.SX.eye(n_u))
        start = casadi.vertcat(self._moved(offset, change), inputs)
        half = hessian - 0.5 * casadi.diag(casadi.diag(hessian))
        both = 0.5 * (half + half.T)
        product = casadi.mtimes(both, start)
        product[self.twist, :] = product[self.twist, :] + pairs
        return casadi.sparsify(casadi.mtimes(start.T, product))

    def _sum_pattern(self) -> Any:
        parts = (casadi.SX.sym("K", self.change), casadi.SX.sym("H", self.hessian))
        return self._sums(1.0, *parts, casadi.SX.sym("C", self._pair_pattern())).sparsity()

    def _congruence(self) -> Any:
        """Graph that adds a stage to X, and to the second derivative with respect to pose and (y, u)."""
        field, n = self.field, len(self.twist)
        offset, change = casadi.SX.sym("offset"), casadi.SX.sym("K", self.change)
        hessian, pairs = casadi.SX.sym("H", self.hessian), casadi.SX.sym("C", self._pair_pattern())
        old, by_pose = casadi.SX.sym("X", self.sum), casadi.SX.sym("D", n, n)
        pose_old = casadi.SX.sym("P", self._pair_pattern())
        new = old + self._sums(offset, change, hessian, pairs)
        pose_new = pose_old + casadi.mtimes(by_pose, self._moved(offset, change)[self.twist, :])
        return graph_of(
            f"{field.name}_rk4_congruence",
            {
                "offset": [offset],
                "change": change.nonzeros(),
                "hessian": hessian.nonzeros(),
                "pairs": pairs.nonzeros(),
                "by_pose": by_pose.nonzeros(),
                "sum": old.nonzeros(),
                "pose_sum": pose_old.nonzeros(),
            },
            {
                "new_sum": casadi.project(new, self.sum).nonzeros(),
                "new_pose_sum": casadi.project(pose_new, self._pair_pattern()).nonzeros(),
            },
        )

    def _total(self) -> tuple[Any, Any]:
        """Graph that puts everything together, with stage 1, whose start is that of the step."""
        field, n = self.field, len(self.twist)
        total, pose = casadi.SX.sym("X", self.sum), casadi.SX.sym("P", self._pair_pattern())
        hessian, by_pose = casadi.SX.sym("H", self.hessian), casadi.SX.sym("D", n, n)
        first = zeros(n, field.n_y + field.n_u)
        first[:, self.twist] = by_pose
        without_pose = hessian + casadi.triu(total + total.T)
        above = casadi.horzcat(zeros(n, n), pose + first)
        below = casadi.horzcat(zeros(field.n_y + field.n_u, n), without_pose)
        curvature = upper_triangle(casadi.vertcat(above, below))
        graph = graph_of(
            f"{field.name}_rk4_curvature",
            {
                "X4": total.nonzeros(),
                "P4": pose.nonzeros(),
                "H1": hessian.nonzeros(),
                "D1": by_pose.nonzeros(),
            },
            {"curvature": curvature.nonzeros()},
        )
        return graph, curvature.sparsity()


def _entries(block: Matrix) -> list[Scalar]:
    """All entries of a matrix, column by column, zeros included."""
    return list(casadi.densify(block).nonzeros())
