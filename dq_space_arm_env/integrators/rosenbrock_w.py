"""A linearly implicit method for stiff joints: springs and dampers implicit, everything else explicit.

A W-method keeps its order with any matrix in place of the Jacobian, which should contain whatever is stiff.
In coordinates with the momentum in place of the base's velocity (`momentum_coordinates`), the stiff part of
the equations of motion is the block of the joints,

    angles' = rates,    S rates' = -K angles - D rates + ...,

with the inertia S that the joints feel on the free base. Each stage solves a system of one unknown per joint,
with the positive definite matrix S + h g D + (h g)^2 K, factorized once per step: the method costs little
more than an explicit one of as many stages.

ROS34PW2 of Rang & Angermann, New Rosenbrock W-methods of order 3 for partial differential algebraic equations
of index 1, BIT 45 (2005): four stages, order 3 with any matrix, L-stable, stiffly accurate.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import casadi

from dq_space_arm_env.algebra.symbolic import column, columns, matrix, symbols, zeros
from dq_space_arm_env.compiler.graph import graph_of
from dq_space_arm_env.compiler.program import Program
from dq_space_arm_env.dynamics.linear import LDLFactor, factorize_ldl, solve_ldl
from dq_space_arm_env.dynamics.vector_field import VectorField
from dq_space_arm_env.integrators.method import graph_inputs
from dq_space_arm_env.integrators.momentum_coordinates import MomentumCoordinates

Scalar = Any
Scalars = Sequence[Scalar]
Matrix = Any

# Stage i solves (1 - h GAMMA J) k_i = h f(y + sum_j ALPHA[i][j] k_j) + h J sum_j GAMMAS[i][j] k_j.
GAMMA = 0.43586652150845900
ALPHA = ((), (0.87173304301691801,), (0.84457060015369423, -0.11299064236484185), (0.0, 0.0, 1.0))
GAMMAS = (
    (),
    (-0.87173304301691801,),
    (-0.90338057013044082, 0.054180672388095326),
    (0.24212380706095346, -1.2232505839045147, 0.54526025533510214),
)
WEIGHTS = (0.24212380706095346, -1.2232505839045147, 1.5452602553351020, GAMMA)
STAGES = range(1, 5)


class RosenbrockW:
    """ROS34PW2 with the springs and dampers of the joints as its matrix."""

    def append_step(self, program: Program, field: VectorField) -> None:
        _Stages(field).append_step(program)

    def append_linearization(self, program: Program, field: VectorField) -> tuple[Any, Any]:
        return _Stages(field).append_linearization(program)


class _Stages:
    """The graphs of a step."""

    def __init__(self, field: VectorField) -> None:
        if not isinstance(field, MomentumCoordinates):
            raise TypeError(f"equations {field.name!r} do not tell which part of them is stiff")
        self.field = field
        self.angles, self.rates = list(field.stiff_angles), list(field.stiff_rates)
        self.n, self.n_y, self.n_u = len(self.angles), field.n_y, field.n_u
        # Symbols of what stays for all stages: S and its factors with springs and dampers, row by row.
        self.h = casadi.SX.sym("h")
        self.inertia = symbols("s", self.n * self.n)
        self.lower = symbols("l", self.n * (self.n - 1) // 2)
        self.inverse = symbols("d", self.n)

    def append_step(self, program: Program) -> None:
        program.call(self._prepare())
        stage = self._stage()
        for number in STAGES:
            if number > 1:
                program.call(self._combination(number))
            at, held = ("at", "held") if number > 1 else ("x", "nothing_held")
            program.call(stage, at=at, held=held, k=f"k{number}")
        y, stages = symbols("x", self.n_y), self._increments(WEIGHTS)
        total = self._moved(y, WEIGHTS, stages)
        program.call(self._graph("sum", {"x": y, **_named("k", stages)}, {"x_next": total}))

    def append_linearization(self, program: Program) -> tuple[Any, Any]:
        pattern = self._pattern()
        program.call(self._prepare())
        stage = self._linearized_stage(pattern)
        for number in STAGES:
            program.call(self._linearized_combination(number, pattern))
            program.call(stage, k=f"k{number}", K=f"K{number}")
        changes = [casadi.SX.sym(f"K{s}", pattern) for s in STAGES]
        total = casadi.sparsify(self._summed(WEIGHTS, changes) + self._identity())
        a, b = total[:, : self.n_y], total[:, self.n_y :]
        inputs = _named("K", [change.nonzeros() for change in changes])
        outputs = {"A": a.nonzeros(), "B": b.nonzeros()}
        program.call(self._graph("linearized_sum", inputs, outputs))
        return a.sparsity(), b.sparsity()

    def _graph(self, name: str, inputs: Mapping[str, Scalars], outputs: Mapping[str, Scalars]) -> Any:
        return graph_of(f"{self.field.name}_rosenbrock_{name}", graph_inputs(self.field, **inputs), outputs)

    def _increments(self, coefficients: Sequence[float]) -> list[list[Scalar]]:
        return [symbols(f"k{s}", self.n_y) for s, _ in enumerate(coefficients, start=1)]

    def _moved(self, y: Scalars, coefficients: Sequence[float], stages: Sequence[Scalars]) -> list[Scalar]:
        """Add multiples of the increments to y."""
        moved = list(y)
        for factor, k in zip(coefficients, stages, strict=True):
            if factor:
                moved = [entry + factor * change for entry, change in zip(moved, k, strict=True)]
        return moved

    def _prepare(self) -> Any:
        """Graph of S at the start of the step, and of the factors of S + h g D + (h g)^2 K."""
        y, hg = symbols("x", self.n_y), GAMMA * self.h
        inertia = self.field.joint_inertia(y)
        system = [list(row) for row in inertia]
        for i, (spring, damper) in enumerate(zip(self.field.stiffness, self.field.damping, strict=True)):
            system[i][i] = system[i][i] + hg * (damper + hg * spring)
        factor = factorize_ldl(system)
        outputs = {
            "inertia": [entry for row in inertia for entry in row],
            "lower": [entry for row in factor.lower for entry in row],
            "inverse": factor.inverse_diagonal,
        }
        return self._graph("prepare", {"x": y, "h": [self.h]}, outputs)

    def _factor(self) -> LDLFactor:
        rows = [self.lower[i * (i - 1) // 2 : i * (i + 1) // 2] for i in range(self.n)]
        return LDLFactor(rows, self.inverse)

    def _inputs(self, at: Scalars, u: Scalars, held: Scalars) -> dict[str, Scalars]:
        inputs: dict[str, Scalars] = {"at": at, "u": u, "held": held, "h": [self.h]}
        return inputs | {"inertia": self.inertia, "lower": self.lower, "inverse": self.inverse}

    def _combination(self, number: int) -> Any:
        """Graph of a stage's argument of the rates, and of the vector that its matrix acts on."""
        y, stages = symbols("x", self.n_y), self._increments(ALPHA[number - 1])
        held = self._moved([0.0] * self.n_y, GAMMAS[number - 1], stages)
        outputs = {
            "at": self._moved(y, ALPHA[number - 1], stages),
            "held": [held[i] for i in (*self.angles, *self.rates)],
        }
        return self._graph(f"combination_{number}", {"x": y, **_named("k", stages)}, outputs)

    def _increment(self, rates: Scalars, held: Scalars) -> list[Scalar]:
        """Solve a stage: (1 - h g J) k = h rates + h J held, J of the joints alone."""
        h, n, springs, dampers = self.h, self.n, self.field.stiffness, self.field.damping
        moved = [h * (rates[i] + w) for i, w in zip(self.angles, held[n:], strict=True)]
        right = []
        for i in range(n):
            push: Scalar = 0.0
            for j, index in enumerate(self.rates):
                push = push + self.inertia[i * n + j] * rates[index]
            pull = springs[i] * (held[i] + GAMMA * moved[i]) + dampers[i] * held[n + i]
            right.append(h * (push - pull))
        solved = solve_ldl(self._factor(), right)
        k = [h * rate for rate in rates]
        for i in range(n):
            k[self.angles[i]] = moved[i] + (GAMMA * h) * solved[i]
            k[self.rates[i]] = solved[i]
        return k

    def _stage(self) -> Any:
        at, u, held = symbols("at", self.n_y), symbols("u", self.n_u), symbols("w", 2 * self.n)
        k = self._increment(self.field.rates(at, u), held)
        return self._graph("stage", self._inputs(at, u, held), {"k": k})

    # Derivatives by (y, u) at the step's start; K is that of a stage's increment.

    def _identity(self) -> Matrix:
        return casadi.horzcat(casadi.SX.eye(self.n_y), zeros(self.n_y, self.n_u))

    def _summed(self, coefficients: Sequence[float], changes: Sequence[Matrix]) -> Matrix:
        total = zeros(self.n_y, self.n_y + self.n_u)
        for factor, change in zip(coefficients, changes, strict=True):
            if factor:
                total = total + factor * change
        return total

    def _pattern(self) -> Any:
        """Sparsity that contains K at every stage; the solution mixes the rows of the joints."""
        y, u = symbols("y", self.n_y), symbols("u", self.n_u)
        _, by_y, by_u = self.field.linearized_rates(y, u)
        direct = casadi.horzcat(casadi.DM(by_y.sparsity(), 1), casadi.DM(by_u.sparsity(), 1))
        joints = [*self.angles, *self.rates]
        pattern = casadi.Sparsity(self.n_y, self.n_y + self.n_u)
        while True:
            start = casadi.DM(pattern.unite(self._identity().sparsity()), 1)
            grown = direct + casadi.mtimes(casadi.DM(by_y.sparsity(), 1), start)
            shared = casadi.sum1(grown[joints, :]) + casadi.sum1(start[joints, :])
            grown[joints, :] = casadi.repmat(shared, len(joints), 1)
            sparsity = casadi.sparsify(grown).sparsity()
            if sparsity == pattern:
                return pattern
            pattern = sparsity

    def _linearized_combination(self, number: int, pattern: Any) -> Any:
        """Graph of `_combination` and of its derivatives."""
        y, stages = symbols("x", self.n_y), self._increments(ALPHA[number - 1])
        changes = [casadi.SX.sym(f"K{s}", pattern) for s in range(1, number)]
        held = self._moved([0.0] * self.n_y, GAMMAS[number - 1], stages)
        joints = [*self.angles, *self.rates]
        at_change = self._summed(ALPHA[number - 1], changes) + self._identity()
        held_change = self._summed(GAMMAS[number - 1], changes)[joints, :]
        outputs = {
            "at": self._moved(y, ALPHA[number - 1], stages),
            "held": [held[i] for i in joints],
            "at_change": _filled(at_change, pattern.unite(self._identity().sparsity())),
            "held_change": _filled(held_change, _rows(pattern, joints)),
        }
        inputs = {"x": y, **_named("k", stages), **_named("K", [change.nonzeros() for change in changes])}
        return self._graph(f"linearized_combination_{number}", inputs, outputs)

    def _linearized_stage(self, pattern: Any) -> Any:
        """Graph of a stage's increment and of its derivative K."""
        x, u, at = symbols("x", self.n_y), symbols("u", self.n_u), symbols("at", self.n_y)
        held, n, h = symbols("w", 2 * self.n), self.n, self.h
        at_change = casadi.SX.sym("Z", pattern.unite(self._identity().sparsity()))
        held_change = casadi.SX.sym("W", _rows(pattern, [*self.angles, *self.rates]))
        rates, by_y, by_u = self.field.linearized_rates(at, u)
        k = self._increment(rates, held)
        change = casadi.mtimes(by_y, at_change) + casadi.horzcat(zeros(self.n_y, self.n_y), by_u)
        moved = h * (change[self.angles, :] + held_change[n:, :])
        inertia = zeros(0, 0) if n == 0 else matrix([self.inertia[i * n : i * n + n] for i in range(n)])
        springs, dampers = (
            casadi.SX(casadi.diag(casadi.DM(list(values))))
            for values in (self.field.stiffness, self.field.damping)
        )
        pull = casadi.mtimes(springs, held_change[:n, :] + GAMMA * moved)
        pull = pull + casadi.mtimes(dampers, held_change[n:, :])
        right = h * (casadi.mtimes(inertia, change[self.rates, :]) - pull)
        unbalanced = [k[i] - h * rates[i] for i in self.rates]
        right = casadi.sparsify(right - self._inertia_change(x, unbalanced))
        solved = columns(*(self._solved(right[:, j]) for j in range(right.shape[1])), rows=n)
        change = h * change
        change[self.angles, :] = moved + (GAMMA * h) * solved
        change[self.rates, :] = solved
        inputs = {"x": x, **self._inputs(at, u, held)}
        inputs |= {"at_change": at_change.nonzeros(), "held_change": held_change.nonzeros()}
        return self._graph("linearized_stage", inputs, {"k": k, "K": _filled(change, pattern)})

    def _solved(self, right: Matrix) -> Matrix:
        entries: list[Scalar] = [0.0] * self.n
        for row, value in zip(right.row(), right.nonzeros(), strict=True):
            entries[row] = value
        return column(*solve_ldl(self._factor(), entries)) if right.nnz() else zeros(self.n, 1)

    def _inertia_change(self, x: Scalars, vector: Scalars) -> Matrix:
        """Derivative of S times a constant vector by (y, u) at the start of the step."""
        free, weights = symbols("y", self.n_y), symbols("v", self.n)
        products = []
        for row in self.field.joint_inertia(free):
            products.append(casadi.dot(column(*row), casadi.vertcat(*weights)))
        jacobian = casadi.jacobian(column(*products), column(*free))
        values = casadi.densify(column(*x, *vector))
        jacobian = casadi.substitute(jacobian, column(*free, *weights), values)
        return casadi.horzcat(jacobian, zeros(self.n, self.n_u))


def _named(letter: str, values: Sequence[Scalars]) -> dict[str, Scalars]:
    return {f"{letter}{number}": value for number, value in enumerate(values, start=1)}


def _filled(expression: Matrix, pattern: Any) -> list[Scalar]:
    """Nonzeros of a pattern that holds those of the expression."""
    projected: list[Scalar] = casadi.project(expression, pattern).nonzeros()
    return projected


def _rows(pattern: Any, rows: Sequence[int]) -> Any:
    """Sparsity of some rows."""
    return casadi.DM(pattern, 1)[list(rows), :].sparsity()
