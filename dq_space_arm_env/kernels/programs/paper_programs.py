"""Programs of the paper's own formulation, 46 states with the tip's pose appended; nothing varies."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any

from dq_space_arm_env.compiler.graph import trace
from dq_space_arm_env.compiler.program import Buffer, Program
from dq_space_arm_env.dynamics import newton_euler
from dq_space_arm_env.dynamics.kinematic_tree import KinematicTree
from dq_space_arm_env.dynamics.paper_field import PaperField
from dq_space_arm_env.dynamics.paper_joints import bodies_of
from dq_space_arm_env.integrators import integrator_of
from dq_space_arm_env.kernels.programs.derivative_programs import sparse_buffer
from dq_space_arm_env.scene.layout import StateLayout
from dq_space_arm_env.scene.schema import Scene
from dq_space_arm_env.task.equations import SceneEquations, weighted_square

Scalar = Any
Scalars = Sequence[Scalar]

# Every number of the redundant state is advanced by the classical method; symplectic Euler would need
# positions whose rates are velocities.
INTEGRATOR = "rk4"


def _fixed_to_base(scene: Scene) -> bool:
    """Whether a link is one body with the base."""
    return any(body == 0 for body, _ in KinematicTree.from_scene(scene).places[1:])


class PaperPrograms:
    """Builds the programs of one scene in the paper's formulation."""

    def __init__(self, scene: Scene) -> None:
        """Lay out the equations; ValueError for what (20) has no rows or frames for."""
        self.scene = scene
        self.layout = StateLayout.of(scene)
        missing = {
            "elastic gears": any(link.is_elastic for link in scene.links),
            "actuators that lag or delay": bool(self.layout.chains),
            "tanks": scene.actuators.tank is not None,
            # The base's frame would not be at its center of mass, where e_0 is.
            "links fixed to the base": _fixed_to_base(scene),
        }
        for what, present in missing.items():
            if present:
                raise ValueError(f"the paper's formulation has no {what}, and scene {scene.name!r} has some")
        nominal = SceneEquations.of(scene, self.layout.parameters.nominal.tolist())
        self.field, self.target = PaperField(nominal.field), nominal.target

    def build(self, name: str) -> Program:
        """Trace a program by name.

        `step`, `step_with_cost`, `linearize`, `difference`, `cost_derivatives`, `terminal_cost`,
        `terminal_cost_derivatives`; `projected_step`, whose state is exactly one that the joints allow;
        `from_minimal` and `to_minimal`, which translate states; `system` (20), its solution `accelerations`
        (22), `refined_accelerations` by one step of iterative refinement, and `free_accelerations`, those of
        base and joints among the dual ones.
        """
        return {
            "step": self._step,
            "projected_step": self._projected_step,
            "to_minimal": self._to_minimal,
            "system": self._system,
            "accelerations": self._accelerations,
            "refined_accelerations": self._refined_accelerations,
            "free_accelerations": self._free_accelerations,
            "step_with_cost": self._step_with_cost,
            "linearize": self._linearize,
            "difference": self._difference,
            "cost_derivatives": self._cost_derivatives,
            "terminal_cost": self._terminal_cost,
            "terminal_cost_derivatives": self._terminal_cost_derivatives,
            "from_minimal": self._from_minimal,
        }[name]()

    def _step(self) -> Program:
        n_x, n_u = self.field.n_x, self.field.n_u
        inputs = [Buffer("x", n_x), Buffer("u", n_u), Buffer("h", 1, shared=True)]
        program = Program("step", inputs, [Buffer("x_next", n_x)])
        integrator_of(self.scene.simulation, INTEGRATOR).append_step(program, self.field)
        return program

    def _projected_step(self) -> Program:
        """A step, with its result rebuilt from minimal coordinates."""

        def project(x_next: Scalars) -> dict[str, Scalars]:
            x = self.field.minimal_from_state(x_next)
            return {"x_projected": self.field.state_from_minimal(x)}

        program = self._step()
        program.name, program.outputs = "projected_step", [Buffer("x_projected", self.field.n_x)]
        program.call(trace("projection_graph", {"x_next": self.field.n_x}, project))
        return program

    def _to_minimal(self) -> Program:
        return self._of_state_and("to_minimal", lambda x: {"y": self.field.minimal_from_state(x)})

    def _of_state_and(self, name: str, outputs: Callable[..., dict[str, Scalars]], **sizes: int) -> Program:
        """Program of a single graph."""
        graph = trace(name + "_graph", {"x": self.field.n_x, **sizes}, outputs)
        program = Program(
            name,
            [Buffer(key, size) for key, size in graph.inputs],
            [Buffer(key, size) for key, size in graph.outputs],
        )
        program.call(graph)
        return program

    def _system(self) -> Program:
        """Matrix (row by row) and right-hand side of (20)."""

        def outputs(x: Scalars, u: Scalars) -> dict[str, Scalars]:
            system = self.field.system(x, u)
            upper = [[*left, *right] for left, right in zip(system.s11, system.s12, strict=True)]
            lower = [
                [*row, *(own if i == j else 0.0 for j in range(len(system.s22)))]
                for i, (row, own) in enumerate(zip(system.s21, system.s22, strict=True))
            ]
            matrix = [entry for row in (*upper, *lower) for entry in row]
            return {"matrix": matrix, "right": [*system.b1, *system.b2]}

        return self._of_state_and("system", outputs, u=self.field.n_u)

    def _accelerations(self) -> Program:
        """Accelerations of base and joints by the Schur complement (21), (22)."""
        return self._schur("accelerations", 0)

    def _refined_accelerations(self) -> Program:
        """The same, refined to recover the digits lost in the Schur complement."""
        return self._schur("refined_accelerations", 1)

    def _schur(self, name: str, refinements: int) -> Program:
        def outputs(x: Scalars, u: Scalars) -> dict[str, Scalars]:
            ydot, _ = newton_euler.solve_schur(self.field.tree, self.field.system(x, u), refinements)
            return {"accelerations": self.field.free_accelerations(x, ydot)}

        return self._of_state_and(name, outputs, u=self.field.n_u)

    def _free_accelerations(self) -> Program:
        return self._of_state_and(
            "free_accelerations",
            lambda x, ydot: {"accelerations": self.field.free_accelerations(x, ydot)},
            ydot=8 * len(bodies_of(self.field.tree)),
        )

    def _state_weights(self, pose: Scalars, velocity: Scalars) -> tuple[list[float], list[float]]:
        """References and weights of every entry of the state."""
        references, weights = [0.0] * self.field.n_x, [0.0] * self.field.n_x
        tip = range(self.field.tip.start, self.field.tip.stop)
        for index, reference, weight in zip(tip, self.target, pose, strict=True):
            references[index], weights[index] = reference, weight
        for index, reference, weight in zip(
            self.field.base_twist, self.scene.target.base_velocity, velocity, strict=True
        ):
            references[index], weights[index] = reference, weight
        return references, weights

    def _stage_weights(self) -> tuple[list[float], list[float]]:
        return self._state_weights(self.scene.cost.pose, self.scene.cost.base_velocity)

    def _terminal_weights(self) -> tuple[list[float], list[float]]:
        return self._state_weights(self.scene.cost.terminal_pose, self.scene.cost.terminal_base_velocity)

    def _step_with_cost(self) -> Program:
        references, weights = self._stage_weights()
        efforts = self.layout.control_weight.tolist()
        n_x, n_u = self.field.n_x, self.field.n_u

        def stage_cost(x: Scalars, u: Scalars) -> dict[str, Scalars]:
            effort = weighted_square(u, [0.0] * n_u, efforts)
            return {"cost": [weighted_square(x, references, weights) + effort]}

        program = Program(
            "step_with_cost",
            [Buffer("x", n_x), Buffer("u", n_u), Buffer("h", 1, shared=True)],
            [Buffer("x_next", n_x), Buffer("cost", 1)],
        )
        integrator_of(self.scene.simulation, INTEGRATOR).append_step(program, self.field)
        program.call(trace("cost_graph", {"x": n_x, "u": n_u}, stage_cost))
        return program

    def _linearize(self) -> Program:
        inputs = [Buffer("x", self.field.n_x), Buffer("u", self.field.n_u), Buffer("h", 1, shared=True)]
        program = Program("linearize", inputs, [])
        a, b = integrator_of(self.scene.simulation, INTEGRATOR).append_linearization(program, self.field)
        program.outputs = [sparse_buffer("A", a), sparse_buffer("B", b)]
        return program

    def _difference(self) -> Program:
        n_x = self.field.n_x
        graph = trace(
            "difference_graph",
            {"x_reference": n_x, "x": n_x},
            lambda x_reference, x: {"dx": [a - b for a, b in zip(x, x_reference, strict=True)]},
        )
        program = Program("difference", [Buffer("x_reference", n_x), Buffer("x", n_x)], [Buffer("dx", n_x)])
        program.call(graph)
        return program

    def _terminal_cost(self) -> Program:
        references, weights = self._terminal_weights()
        graph = trace(
            "terminal_cost_graph",
            {"x": self.field.n_x},
            lambda x: {"cost": [weighted_square(x, references, weights)]},
        )
        program = Program("terminal_cost", [Buffer("x", self.field.n_x)], [Buffer("cost", 1)])
        program.call(graph)
        return program

    def _cost_derivatives(self) -> Program:
        n_x, n_u = self.field.n_x, self.field.n_u
        state = self._stage_weights()
        efforts = [2.0 * weight for weight in self.layout.control_weight.tolist()]

        def derivatives(x: Scalars, u: Scalars) -> dict[str, Scalars]:
            lu = [weight * value for weight, value in zip(efforts, u, strict=True)]
            return {**_quadratic(x, *state), "lu": lu, "luu": efforts}

        graph = trace("cost_derivatives_graph", {"x": n_x, "u": n_u}, derivatives)
        outputs = [Buffer("lx", n_x), Buffer("lu", n_u), _diagonal("lxx", n_x), _diagonal("luu", n_u)]
        program = Program("cost_derivatives", [Buffer("x", n_x), Buffer("u", n_u)], outputs)
        program.call(graph)
        return program

    def _terminal_cost_derivatives(self) -> Program:
        n_x, state = self.field.n_x, self._terminal_weights()
        graph = trace("terminal_derivatives_graph", {"x": n_x}, lambda x: _quadratic(x, *state))
        outputs = [Buffer("lx", n_x), _diagonal("lxx", n_x)]
        program = Program("terminal_cost_derivatives", [Buffer("x", n_x)], outputs)
        program.call(graph)
        return program

    def _from_minimal(self) -> Program:
        n = self.field.minimal.n_x
        graph = trace("from_minimal_graph", {"x": n}, lambda x: {"y": self.field.state_from_minimal(x)})
        program = Program("from_minimal", [Buffer("x", n)], [Buffer("y", self.field.n_x)])
        program.call(graph)
        return program


def _quadratic(x: Scalars, references: Sequence[float], weights: Sequence[float]) -> dict[str, Scalars]:
    """Gradient and diagonal Hessian of the sum of w (x - reference)^2."""
    terms = zip(x, references, weights, strict=True)
    return {
        "lx": [2.0 * weight * (value - reference) for value, reference, weight in terms],
        "lxx": [2.0 * weight for weight in weights],
    }


def _diagonal(name: str, size: int) -> Buffer:
    return Buffer(name, size, positions=tuple(range(0, size * size, size + 1)), stride=size * size)
