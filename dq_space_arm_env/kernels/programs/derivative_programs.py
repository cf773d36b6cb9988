"""Programs of derivatives in tangent coordinates: of a step, of the cost, and of the Lagrangian.

First derivatives are exact. `cost_derivatives` gives the Gauss-Newton Hessian, which is positive
semidefinite; `lagrangian_hessian` and `terminal_cost_hessian` give the exact second derivatives for Newton's
method.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from typing import Any

import casadi
import numpy as np

from dq_space_arm_env.algebra import dual_matrices, dual_vectors
from dq_space_arm_env.algebra import dual_quaternion as dq
from dq_space_arm_env.algebra.symbolic import column, matrix, symbols, zeros
from dq_space_arm_env.compiler.graph import graph_of
from dq_space_arm_env.compiler.program import Buffer, Program
from dq_space_arm_env.dynamics import kinematics
from dq_space_arm_env.integrators import integrator_of
from dq_space_arm_env.integrators.method import (
    TwiceDifferentiableIntegrator,
    graph_inputs,
    program_inputs,
)
from dq_space_arm_env.kernels.programs.constraint_programs import constraint_residuals
from dq_space_arm_env.kernels.programs.stage_programs import of_stage, stage_method
from dq_space_arm_env.scene.constraint_rows import penalized_rows, terminal_rows
from dq_space_arm_env.task.augmented_lagrangian import PenalizedEquations
from dq_space_arm_env.task.constraint_residuals import penalized_residuals
from dq_space_arm_env.task.equations import SceneEquations, vector_parts

Scalar = Any
Scalars = Sequence[Scalar]
Matrix = Any


class DerivativePrograms:
    """Builds the programs of one scene."""

    def __init__(self, equations: SceneEquations) -> None:
        self.equations = equations
        self.scene, self.layout, self.field = equations.scene, equations.layout, equations.field
        self.tree = equations.tree

    def _state_cost_derivatives(
        self, x: Scalars, weights: tuple[Scalars, Scalars], emphasis: Scalar = 1.0
    ) -> tuple[Any, Any]:
        """Gradient and Gauss-Newton Hessian of the state's cost in tangent coordinates, sparse SX.

        The weights are those of pose and velocity; an emphasis multiplies the first. The tip's pose moves
        with the base by q_{e0/I} d q_{G/e0} / 2 for a twist increment d, and with the angles by (27).
        """
        field, (pose, velocity) = self.field, weights
        motion = field.motion(self.equations.y(x))
        arm = kinematics.arm_pose(self.tree, motion.joint_angles, motion.wrist_angles)
        base = self.equations.base_pose(x)
        tip = dq.multiply(base, arm)
        angles = column(*self.equations.y(x)[: self._angle_count()])
        left, right = dual_matrices.left_matrix(base), dual_matrices.right_matrix(arm)
        directions = []
        for direction in field.pose.directions:
            twist = [0.0] * 8
            twist[(1, 2, 3, 5, 6, 7)[direction]] = 0.5
            moved = dual_matrices.matrix_multiply(left, dual_matrices.matrix_multiply(right, twist))
            directions.append(column(*moved))
        by_angles = casadi.mtimes(matrix(left), casadi.jacobian(column(*arm), angles))
        others = zeros(8, field.n_t - len(directions) - self._angle_count())
        by_state = casadi.sparsify(casadi.horzcat(*directions, by_angles, others))
        error = column(*tip) - column(*self.equations.target)
        weighted = emphasis * casadi.mtimes(casadi.diag(column(*pose)), by_state)
        gradient = 2.0 * casadi.mtimes(weighted.T, error)
        hessian = 2.0 * casadi.mtimes(by_state.T, weighted)
        start = field.n_t - field.n_y
        for index, direction in zip(field.pose.twist_indices, field.pose.directions, strict=True):
            weight = velocity[direction]
            deviation = self.equations.y(x)[index] - self.scene.target.base_velocity[direction]
            gradient[start + index] += 2.0 * weight * deviation
            hessian[start + index, start + index] += 2.0 * weight
        return gradient, casadi.sparsify(hessian)

    def _relative_residual(self, x: Scalars, u: Scalars, cost: str) -> tuple[Matrix, Matrix, Matrix]:
        """Twist of tip or base, or pose of the tip, relative to the target, by tangent state z and input.

        Then z and input, and their values.
        """
        field = self.field
        z, w = symbols("z", field.n_t), symbols("w", field.n_u)
        frame, y = self.equations.moved(x, z)
        motion = field.motion(y)
        if not cost.endswith("base_velocity"):
            arm = kinematics.arm_pose(self.tree, motion.joint_angles, motion.wrist_angles)
            frame = dq.multiply(frame, arm)
        if cost.endswith("pose"):
            own, target = self.equations.compared_poses(frame)
        elif cost.endswith("tip_twist"):
            own = self.equations.tip_twist(motion, field.inputs(w).wrist_rates)
            target = self.equations.target_twist(frame)
        else:
            own = dual_vectors.subtract((*motion.angular, *motion.linear), self.scene.target.base_velocity)
            target = self.equations.target_twist(frame)
        residual = column(*(a - b for a, b in zip(own, target, strict=True)))
        return residual, column(*z, *w), casadi.densify(column(*[0.0] * field.n_t, *u))

    def _relative_cost_derivatives(
        self, x: Scalars, u: Scalars, field: str, *, exact: bool, emphasis: Scalar = 1.0
    ) -> tuple[Matrix, Matrix]:
        """Gradient and Hessian (exact or Gauss-Newton's) of one of `_relative_costs` by tangent state, u."""
        weights = [emphasis * weight for weight in self.equations.state_weights(field)]
        return self._square_derivatives(*self._relative_residual(x, u, field), weights, exact=exact)

    def _other_tip_derivatives(
        self, x: Scalars, u: Scalars, index: int, weights: Scalars, *, exact: bool
    ) -> tuple[Matrix, Matrix]:
        """Likewise of another tip's cost."""
        z, w = symbols("z", self.field.n_t), symbols("w", self.field.n_u)
        error = self.equations.other_errors(*self.equations.moved(x, z))[index]
        values = casadi.densify(column(*[0.0] * self.field.n_t, *u))
        residual, moved = column(*vector_parts(error)), column(*z, *w)
        return self._square_derivatives(residual, moved, values, weights, exact=exact)

    def _square_derivatives(
        self, residual: Matrix, moved: Matrix, values: Matrix, given: Scalars, *, exact: bool
    ) -> tuple[Matrix, Matrix]:
        """Gradient and Hessian of the weighted square of a residual at the values of what moves it."""
        weights = casadi.diag(column(*(2.0 * weight for weight in given)))
        jacobian = casadi.jacobian(residual, moved)
        gradient = casadi.mtimes(jacobian.T, casadi.mtimes(weights, residual))
        hessian = casadi.mtimes(jacobian.T, casadi.mtimes(weights, jacobian))
        if exact:
            factor = casadi.SX.sym("factor", len(given))
            curvature = casadi.hessian(casadi.dot(factor, residual), moved)[0]
            weighted = casadi.densify(casadi.mtimes(weights, residual))
            hessian = hessian + casadi.substitute(curvature, factor, weighted)
        symmetric = casadi.triu2symm(casadi.triu(hessian))  # to the last bit
        gradient, hessian = casadi.substitute([gradient, symmetric], [moved], [values])
        return gradient, casadi.sparsify(hessian)

    def _penalty_derivatives(
        self, equations: PenalizedEquations, x: Scalars, u: Scalars | None, *, exact: bool
    ) -> tuple[Matrix, Matrix]:
        """Gradient and Hessian (exact or Gauss-Newton's) of the penalties by tangent state and input.

        Those of the path's rows; without input those of the rows at the end, by the tangent state.
        """
        residuals, moved, values = constraint_residuals(equations, x, u, penalized_residuals)
        rows = terminal_rows(self.scene) if u is None else penalized_rows(self.scene)
        penalties = equations.penalized(rows, residuals)
        slopes = casadi.densify(column(*(each.slope for each in penalties)))
        jacobian, factor = casadi.jacobian(column(*residuals), moved), symbols("factor", len(rows))
        stiffness = casadi.diag(casadi.densify(column(*(each.curvature for each in penalties))))
        hessian = casadi.mtimes(jacobian.T, casadi.mtimes(stiffness, jacobian))
        if exact:
            curvature = casadi.hessian(casadi.dot(column(*factor), column(*residuals)), moved)[0]
            hessian = hessian + casadi.substitute(curvature, casadi.densify(column(*factor)), slopes)
        gradient, symmetric = casadi.mtimes(jacobian.T, slopes), casadi.triu2symm(casadi.triu(hessian))
        gradient, hessian = casadi.substitute([gradient, symmetric], [moved], [values])
        return gradient, casadi.sparsify(hessian)

    def _further_terms(self, x: Scalars, u: Scalars, *, exact: bool) -> Iterator[tuple[Matrix, Matrix]]:
        """Gradients and Hessians by tangent state and input of what only some stage costs have."""
        for cost in self._relative_costs():
            yield self._relative_cost_derivatives(x, u, cost, exact=exact)
        for index, tip in enumerate(self.scene.other_tips):
            yield self._other_tip_derivatives(x, u, index, tip.pose, exact=exact)
        if isinstance(self.equations, PenalizedEquations) and penalized_rows(self.scene):
            yield self._penalty_derivatives(self.equations, x, u, exact=exact)

    def _further_terminal_terms(
        self, x: Scalars, emphasis: Scalar, *, exact: bool
    ) -> Iterator[tuple[Matrix, Matrix]]:
        """Likewise of terminal costs by the tangent state; for their twists the wrist is held."""
        held, n_t = [0.0] * self.field.n_u, self.field.n_t
        for cost in self._relative_costs("terminal_"):
            stressed = 1.0 if cost == "terminal_base_velocity" else emphasis
            slope, curvature = self._relative_cost_derivatives(x, held, cost, exact=exact, emphasis=stressed)
            yield slope[:n_t], curvature[:n_t, :n_t]
        for index, tip in enumerate(self.scene.other_tips):
            weights = [emphasis * weight for weight in tip.terminal_pose]
            slope, curvature = self._other_tip_derivatives(x, held, index, weights, exact=exact)
            yield slope[:n_t], curvature[:n_t, :n_t]
        if isinstance(self.equations, PenalizedEquations):
            slope, curvature = self._penalty_derivatives(self.equations, x, None, exact=exact)
            yield emphasis * slope, emphasis * curvature

    def _relative_costs(self, prefix: str = "") -> list[str]:
        """Those terms relative to the target that have weights."""
        fields = ["tip_twist", *(["base_velocity"] if self.scene.target.base_velocity_relative else [])]
        fields += ["pose"] if self.scene.cost.pose_error == "relative" else []
        return [prefix + field for field in fields if any(getattr(self.scene.cost, prefix + field))]

    def _stage_weights(self, prefix: str = "") -> tuple[Scalars, Scalars]:
        """Weights of pose and base velocity, none of those in `_relative_costs`."""
        pose = self.equations.state_weights(prefix + "pose")
        velocity = self.equations.state_weights(prefix + "base_velocity")
        if self.scene.cost.pose_error == "relative":
            pose = [0.0] * 8
        if self.scene.target.base_velocity_relative:
            velocity = [0.0] * 6
        return pose, velocity

    def _terminal_weights(self) -> tuple[Scalars, Scalars]:
        return self._stage_weights("terminal_")

    def _angle_count(self) -> int:
        state = self.layout.state
        return int(state.wrist_angles.stop - state.joint_angles.start)

    def cost(self) -> Program:
        """Gradient and Gauss-Newton Hessian of the stage cost."""
        field = self.field
        x, u = symbols("x", field.n_x), symbols("u", field.n_u)
        gradient, hessian = self._state_cost_derivatives(x, self._stage_weights())
        n_t, n_u = field.n_t, field.n_u
        weights = [2.0 * weight for weight in self.equations.control_weights]
        by_input: Matrix = column(*(weight * value for weight, value in zip(weights, u, strict=True)))
        squared, mixed = casadi.diag(column(*weights)), zeros(n_u, n_t)
        for slope, curvature in self._further_terms(x, u, exact=False):
            gradient, by_input = gradient + slope[:n_t], by_input + slope[n_t:]
            hessian = casadi.sparsify(hessian + curvature[:n_t, :n_t])
            squared = casadi.sparsify(squared + curvature[n_t:, n_t:])
            mixed = casadi.sparsify(mixed + curvature[n_t:, :n_t])
        matrices = {"lxx": hessian, "luu": squared} | ({"lux": mixed} if mixed.nnz() else {})
        outputs = {
            "lx": casadi.densify(gradient).nonzeros(),
            "lu": casadi.densify(by_input).nonzeros(),
            **{name: entries.nonzeros() for name, entries in matrices.items()},
        }
        graph = graph_of("cost_derivatives_graph", graph_inputs(field, x=x, u=u), outputs)
        buffers = [sparse_buffer(name, entries.sparsity()) for name, entries in matrices.items()]
        program = Program(
            "cost_derivatives",
            program_inputs(field, Buffer("x", field.n_x), Buffer("u", n_u)),
            [Buffer("lx", n_t), Buffer("lu", n_u), *buffers],
        )
        program.call(graph)
        return program

    def terminal_cost(self) -> Program:
        """Gradient and Gauss-Newton Hessian of the terminal cost, with an emphasis on its pose."""
        field = self.field
        x, emphasis = symbols("x", field.n_x), casadi.SX.sym("emphasis")
        gradient, hessian = self._state_cost_derivatives(x, self._terminal_weights(), emphasis)
        for slope, curvature in self._further_terminal_terms(x, emphasis, exact=False):
            gradient, hessian = gradient + slope, casadi.sparsify(hessian + curvature)
        outputs = {"lx": casadi.densify(gradient).nonzeros(), "lxx": hessian.nonzeros()}
        inputs = graph_inputs(field, x=x, emphasis=[emphasis])
        graph = graph_of("terminal_cost_derivatives_graph", inputs, outputs)
        program = Program(
            "terminal_cost_derivatives",
            program_inputs(field, Buffer("x", field.n_x), Buffer("emphasis", 1)),
            [Buffer("lx", field.n_t), sparse_buffer("lxx", hessian.sparsity())],
        )
        program.call(graph)
        return program

    def linearize(self, integrator: str) -> Program:
        """A and B of a step."""
        field = self.field
        inputs = [Buffer("x", field.n_x), Buffer("u", field.n_u), Buffer("h", 1, shared=True)]
        program = Program("linearize", program_inputs(field, *inputs), [])
        a, b = stage_method(self.equations, integrator).append_linearization(program, field)
        program.outputs = [sparse_buffer("A", a), sparse_buffer("B", b)]
        return program

    def lagrangian_hessian(self, integrator: str) -> Program:
        """Hessian of stage cost + multiplier . step, in tangent coordinates around x and its successor."""
        method = integrator_of(self.scene.simulation, integrator)
        if not isinstance(method, TwiceDifferentiableIntegrator):
            name = integrator or self.scene.simulation.integrator
            raise ValueError(f"integrator: {name!r} has no second derivatives, which this asks for")
        method = of_stage(self.equations, method)
        field = self.field
        buffers = [Buffer("x", field.n_x), Buffer("u", field.n_u), Buffer("multiplier", field.n_t)]
        buffers.append(Buffer("h", 1, shared=True))
        program = Program("lagrangian_hessian", program_inputs(field, *buffers), [])
        pattern = method.append_curvature(program, field)
        curvature, x = casadi.SX.sym("curvature", pattern), symbols("x", field.n_x)
        state = self._state_cost_hessian(x, self._stage_weights())
        effort = casadi.diag(column(*(2.0 * weight for weight in self.equations.control_weights)))
        total, given = curvature + casadi.triu(casadi.diagcat(state, effort)), {"x": x}
        u = symbols("u", field.n_u)
        for _, bend in self._further_terms(x, u, exact=True):
            given["u"] = u
            total = total + casadi.triu(bend)
        hessian = casadi.sparsify(casadi.triu2symm(total))
        blocks = {
            "Lxx": hessian[: field.n_t, : field.n_t],
            "Lux": hessian[field.n_t :, : field.n_t],
            "Luu": hessian[field.n_t :, field.n_t :],
        }
        outputs = {name: block.nonzeros() for name, block in blocks.items()}
        inputs = graph_inputs(field, **given, curvature=curvature.nonzeros())
        program.call(graph_of("lagrangian_hessian_graph", inputs, outputs))
        program.outputs = [sparse_buffer(name, block.sparsity()) for name, block in blocks.items()]
        return program

    def terminal_cost_hessian(self) -> Program:
        """Exact Hessian of the terminal cost, with an emphasis on its pose."""
        field = self.field
        x, emphasis = symbols("x", field.n_x), casadi.SX.sym("emphasis")
        hessian = self._state_cost_hessian(x, self._terminal_weights(), emphasis)
        for _, bend in self._further_terminal_terms(x, emphasis, exact=True):
            hessian = casadi.sparsify(hessian + bend)
        program = Program(
            "terminal_cost_hessian",
            program_inputs(field, Buffer("x", field.n_x), Buffer("emphasis", 1)),
            [sparse_buffer("Lxx", hessian.sparsity())],
        )
        inputs = graph_inputs(field, x=x, emphasis=[emphasis])
        program.call(graph_of("terminal_cost_hessian_graph", inputs, {"Lxx": hessian.nonzeros()}))
        return program

    def _state_cost_hessian(
        self, x: Scalars, weights: tuple[Scalars, Scalars], emphasis: Scalar = 1.0
    ) -> Matrix:
        """Exact Hessian of the state's cost: Gauss-Newton's, plus the residual times the tip's curvature.

        A twist increment d moves the tip to q_{e0/I} (1 + d / 2 + d^2 / 8) q_{G/e0} to second order, with
        dual quaternion products.
        """
        field, n = self.field, len(self.field.pose.directions)
        hessian = self._state_cost_derivatives(x, weights, emphasis)[1]
        base = self.equations.base_pose(x)
        increment, angles = symbols("d", n), symbols("angle", self._angle_count())
        motion = field.motion([*angles, *[0.0] * (field.n_y - len(angles))])
        arm = kinematics.arm_pose(self.tree, motion.joint_angles, motion.wrist_angles)
        half = dq.from_vector([0.5 * entry for entry in field.pose.full_twist(increment)])
        square = dq.multiply(half, half)
        turned = [a + 0.5 * b for a, b in zip(half, square, strict=True)]
        turned[0] = turned[0] + 1.0
        tip = column(*dq.multiply(base, dq.multiply(turned, arm)))
        error = column(*self.equations.tip(x)) - column(*self.equations.target)
        residual = casadi.SX.sym("residual", 8)
        moved = column(*increment, *angles)
        curvature = casadi.hessian(casadi.dot(residual, tip), moved)[0]
        weighted = casadi.densify(2.0 * emphasis * column(*weights[0]) * error)
        values = column(*[0.0] * n, *self.equations.y(x)[: len(angles)])
        curvature = casadi.substitute(
            [curvature], [casadi.vertcat(residual, moved)], [casadi.densify(casadi.vertcat(weighted, values))]
        )[0]
        rest = field.n_t - curvature.shape[0]
        return casadi.sparsify(hessian + casadi.diagcat(curvature, zeros(rest, rest)))


def sparse_buffer(name: str, pattern: Any) -> Buffer:
    """Output for the nonzeros (by column) of a row-major matrix; the rest of the array stays as it is."""
    rows, columns = pattern.get_triplet()
    count, width = pattern.shape
    positions = np.array(rows, dtype=int) * width + np.array(columns, dtype=int)
    return Buffer(name, pattern.nnz(), positions=tuple(positions.tolist()), stride=count * width)
