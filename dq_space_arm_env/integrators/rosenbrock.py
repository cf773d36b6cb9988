"""Rosenbrock methods for joints of any stiffness: linearly implicit, in canonical momenta, with substeps.

Each stage solves a linear system with the exact Jacobian of the equations of motion, and all stages share its
factors (Hairer & Wanner, Solving Ordinary Differential Equations II, IV.7). In canonical momenta
(`canonical_coordinates`) the torques of springs and dampers are linear, so that Jacobian is right at any
deflection and speed. A stage of the momenta, U = z_y W, follows from that of the rates,

    (z_y - gamma h F_y) W_i = gamma h F(z + sum a_ij U_j) + gamma sum c_ij U_j,

where y has joint rates, z(y) the canonical momenta, and F = z'. With the angles eliminated first, the system
of the rates is M + gamma h D + (gamma h)^2 K but for small terms: symmetric, positive definite.

The last stage is the error of an embedded method. Where it exceeds the tolerance, the step is divided. Both
methods are L-stable: a vibration that the substeps cannot resolve dies within a few of them, and the step
says that it is not accurate. The total momentum is kept to rounding.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import casadi

from dq_space_arm_env.algebra.symbolic import column, dense_entries, symbols
from dq_space_arm_env.compiler.graph import graph_of
from dq_space_arm_env.compiler.program import Program
from dq_space_arm_env.dynamics.space_arm_field import SpaceArmField
from dq_space_arm_env.dynamics.vector_field import VectorField, split_state
from dq_space_arm_env.integrators.canonical_coordinates import CanonicalCoordinates
from dq_space_arm_env.integrators.method import graph_inputs
from dq_space_arm_env.integrators.rosenbrock_system import RosenbrockSystem
from dq_space_arm_env.integrators.rosenbrock_tableaus import RosenbrockTableau
from dq_space_arm_env.integrators.substeps import Substeps, fourth_root, largest_error
from dq_space_arm_env.integrators.tangent_linearization import append_tangent_linearization

Scalar = Any
Scalars = Sequence[Scalar]
Matrix = Any

MOST_SUBSTEPS = 500
"""Tries of a step, rejected ones included; what is left then is taken in one substep, whatever its error."""
SMALLEST, SMALLEST_FACTOR = 1e-12, 0.1
"""Smallest length of a substep, relative to the step, and to the substep before."""


@dataclass(frozen=True)
class Rosenbrock:
    """A Rosenbrock method, given by its tableau.

    The error of a substep is the largest, over angles [rad], position [m], and velocities times the length of
    the whole step, of the difference between both solutions. Derivatives are those of the substeps taken,
    their lengths held fixed.
    """

    tableau: RosenbrockTableau
    tolerance: float = 1e-6  # rad, m

    def append_step(self, program: Program, field: VectorField) -> None:
        graphs = _Graphs(self.tableau, field)
        program.call(graphs.momentum())
        self._append(program, graphs, "momentum_start")

    def append_walk(self, program: Program, field: VectorField) -> None:
        """See `MomentumIntegrator`."""
        self._append(program, _Graphs(self.tableau, field), "momentum")

    def append_linearization(self, program: Program, field: VectorField) -> tuple[Any, Any]:
        return append_tangent_linearization(program, field, self.append_step)

    def _append(self, program: Program, graphs: _Graphs, momentum: str) -> None:
        """Append the substeps, from x and a buffer of the momentum to x_next and momentum_next."""
        substeps = Substeps(
            graphs.prefix, fourth_root, MOST_SUBSTEPS, SMALLEST, SMALLEST_FACTOR, finishes=True
        )
        substeps.append_begin(program, state="x", momentum_here=momentum)
        first, stage = graphs.first(), graphs.stage()
        with program.repeated_while("unfinished"):
            substeps.append_length(program)
            program.call(first, x="state", momentum="momentum_here", h="substep_time")
            for number in range(1, self.tableau.stages):
                program.call(graphs.sums(number))
                names = {name: f"{name}{number}" for name in ("at", "carried", "rate_stage", "stage")}
                program.call(stage, h="substep_time", **names)
            program.call(graphs.total(self.tolerance), x="state", momentum="momentum_here")
            moved = ("state", "momentum_here")
            substeps.append_choice(program, {name: f"{name}_tried" for name in moved})
        substeps.append_end(program, state="x_next", momentum_here="momentum_next")


class _Graphs:
    """Graphs of a substep: start and first stage, sums before a stage, stage, new state with its error."""

    def __init__(self, tableau: RosenbrockTableau, field: VectorField) -> None:
        if not isinstance(field, SpaceArmField):
            raise TypeError(f"equations {field.name!r} do not tell the momentum of the system")
        self.tableau, self.field = tableau, field
        self.prefix = f"{field.name}_rosenbrock{tableau.order}"
        self.equations = CanonicalCoordinates(field)
        self.given, self.n = self.equations.given, self.equations.n_y
        self.rates = range(self.given.joint_rates.start, self.given.joint_rates.stop)
        self.x, self.u, self.momentum_here = (
            symbols(name, size) for name, size in (("x", field.n_x), ("u", field.n_u), ("momentum", 6))
        )
        self.h = casadi.SX.sym("h")
        momentum = self.given.turned_back(self.x, self.momentum_here)
        begun = self.given.start(split_state(field, self.x)[1], momentum)
        self.center = begun["center"]
        self.start, self.slope, by_y, slope_by_y = self.equations.linearized(begun["local"], self.u)
        self.momenta_by_y = casadi.sparsify(by_y[list(self.rates), :])
        self.system = RosenbrockSystem(by_y - tableau.gamma * self.h * slope_by_y, self._order())

    def _order(self) -> list[int]:
        """Unknowns in the order of elimination: what hardly couples, joint angles, rotation, joint rates."""
        given, n = self.given, len(self.rates)
        angles = range(given.shape.start, given.shape.start + n)
        last = [*angles, *range(given.rotation.start, given.rotation.stop), *self.rates]
        return [*(i for i in range(self.n) if i not in last), *last]

    def _graph(self, name: str, inputs: Mapping[str, Scalars], outputs: Mapping[str, Scalars]) -> Any:
        return graph_of(f"{self.prefix}_{name}", graph_inputs(self.field, **inputs), outputs)

    def momentum(self) -> Any:
        """Graph of the momentum at the start of a step, inertial axes."""
        linear, angular, _ = self.given.balance.momentum(split_state(self.field, self.x)[1])
        outputs = {"momentum_start": self.given.turned_out(self.x, linear, angular)}
        return self._graph("momentum", {"x": self.x}, outputs)

    def first(self) -> Any:
        """Graph of the start of a substep, the factors, and the first stage."""
        scale = self.tableau.gamma * self.h
        stages = self._stages(self.system, self.momenta_by_y, [scale * rate for rate in self.slope])
        outputs: dict[str, Scalars] = {"start": self.start, "center": self.center}
        outputs |= {"factor": self.system.variables, "momenta_by_y": self.momenta_by_y.nonzeros()}
        outputs |= {f"{name}0": stage for name, stage in stages.items()}
        inputs = {"x": self.x, "momentum": self.momentum_here, "u": self.u, "h": [self.h]}
        return self._graph("first", inputs, outputs)

    def stage(self) -> Any:
        """Graph of any other stage."""
        known, by_y = self.system.renamed(), casadi.SX.sym("by_y", self.momenta_by_y.sparsity())
        at, carried, scale = symbols("at", self.n), symbols("carried", self.n), self.tableau.gamma * self.h
        rates = self.equations.rates(at, self.u)
        right = [scale * rate + other for rate, other in zip(rates, carried, strict=True)]
        inputs = {"factor": known.variables, "momenta_by_y": by_y.nonzeros(), "u": self.u, "h": [self.h]}
        return self._graph(
            "stage", {**inputs, "at": at, "carried": carried}, self._stages(known, by_y, right)
        )

    def _stages(self, system: RosenbrockSystem, momenta_by_y: Matrix, right: Scalars) -> dict[str, Scalars]:
        """A stage of the rates, W, and of the momenta, U."""
        rate_stage = system.solve(right)
        momenta = dense_entries(casadi.mtimes(momenta_by_y, casadi.densify(column(*rate_stage))))
        stage = list(rate_stage)
        stage[self.rates.start :] = momenta
        return {"rate_stage": rate_stage, "stage": stage}

    def sums(self, number: int) -> Any:
        """Graph of a stage's sums over the earlier ones: z + sum a_ij U_j, and gamma sum c_ij U_j."""
        start, stages = symbols("z", self.n), [symbols(f"U{i}", self.n) for i in range(number)]
        at, carried = list(start), [0.0] * self.n
        for a, c, stage in zip(
            self.tableau.starts[number], self.tableau.couplings[number], stages, strict=True
        ):
            at = [old + a * new for old, new in zip(at, stage, strict=True)]
            carried = [old + (self.tableau.gamma * c) * new for old, new in zip(carried, stage, strict=True)]
        inputs = {"start": start, **{f"stage{i}": stage for i, stage in enumerate(stages)}}
        outputs = {f"at{number}": at, f"carried{number}": carried}
        return graph_of(f"{self.prefix}_sums{number}", inputs, outputs)

    def total(self, tolerance: float) -> Any:
        """Graph of the new state and momentum, and of the error."""
        given, last = self.given, self.tableau.stages - 1
        start, at, stage, error = (symbols(name, self.n) for name in ("start", "at", "U", "W"))
        center = symbols("center", 3)
        end = given.parts(self.equations.left([a + b for a, b in zip(at, stage, strict=True)]))
        x_next = given.end(self.x, center, end)
        momentum = given.handed_on(self.x, self.momentum_here, given.parts(start), end)
        estimate = given.estimate(end, given.parts(error))
        worst = largest_error(self.field, estimate, x_next, self.h, tolerance)
        inputs = {"x": self.x, "momentum": self.momentum_here, "start": start, "center": center}
        inputs |= {f"at{last}": at, f"stage{last}": stage, f"rate_stage{last}": error, "h": [self.h]}
        outputs = {"state_tried": x_next, "momentum_here_tried": momentum, "error": [worst]}
        return self._graph("total", inputs, outputs)
