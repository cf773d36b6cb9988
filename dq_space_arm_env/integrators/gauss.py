"""Gauss methods: symplectic and symmetric, with exact momentum, for joints of any stiffness.

Collocation at Gauss points is symplectic in canonical coordinates and conserves quadratic invariants (Hairer,
Lubich & Wanner, Geometric Numerical Integration, VI.4.2 and IV.2.1): a discrete Hamilton's principle holds
(Marsden & West, Discrete mechanics and variational integrators, Acta Numerica 2001, section 2.6). In
`quaternion_coordinates`, and canonical momenta of the joints, the total momentum is a constant, the base's
quaternion keeps its length, and the error of the energy stays bounded. Forces, dampers and other inputs act
at the stages.

With w_j = h b_j f(z + Z_j) the stages solve Z_i = sum_j w_j / 2 + sum_j s_ij w_j, s_ij = a_ij / b_j - 1/2:
the condition b_i a_ij + b_j a_ji = b_i b_j of symplectic methods makes s antisymmetric, which rounding its
entries leaves so. Passes over all stages are repeated until they change by rounding only: a tolerance would
let the energy drift (Hairer, McLachlan & Razakarivony, Achieving Brouwer's law with implicit Runge-Kutta
methods, BIT 48, 2008). A step whose passes do not converge ends in NaN.

A pass is a fixed-point iteration, but for springs and dampers. In the canonical momenta p and angles q of the
joints they add the linear part q' = W p, p' = -K q - D W p, W from the inverse mass matrix at the start. A
pass solves it exactly, a simplified Newton iteration: the passes converge at any stiffness.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

import casadi

from dq_space_arm_env.algebra.symbolic import column, dense_entries, symbols
from dq_space_arm_env.compiler.graph import graph_of
from dq_space_arm_env.compiler.program import Buffer, Program
from dq_space_arm_env.dynamics.space_arm_field import SpaceArmField
from dq_space_arm_env.dynamics.vector_field import VectorField, split_state
from dq_space_arm_env.integrators.canonical_coordinates import CanonicalCoordinates
from dq_space_arm_env.integrators.method import graph_inputs
from dq_space_arm_env.integrators.quaternion_coordinates import QuaternionCoordinates
from dq_space_arm_env.integrators.rosenbrock_system import RosenbrockSystem
from dq_space_arm_env.integrators.substeps import or_nan
from dq_space_arm_env.integrators.tangent_linearization import append_tangent_linearization

Scalar = Any
Scalars = Sequence[Scalar]
Matrix = Any

MOST_PASSES = 60
"""Passes after which a step counts as not convergent."""
ROUNDINGS = 256.0
"""A pass may be the last one if it changes the angles by fewer units of their last digit: in fast motions the
roundings of a pass are some fifty."""
FURTHER_PASSES = 3
"""Passes beyond the last one for derivatives, which converge at the same rate, but later."""


# 2 pi in three parts (Cody & Waite): products of the first two with a number of turns are exact.
_TURN = (6.28125, 0.0019353071693331003, 1.0253376606378076e-11)


@dataclass(frozen=True)
class GaussTableau:
    """Coefficients of a method with s stages."""

    order: int
    weights: tuple[float, ...]  # b_i
    couplings: tuple[tuple[float, ...], ...]  # s_ij below the diagonal, row i of i numbers

    @property
    def stages(self) -> int:
        """Number of stages."""
        return len(self.weights)

    def coupling(self, i: int, j: int) -> float:
        """s_ij = -s_ji."""
        return self.couplings[i][j] if j < i else -self.couplings[j][i] if i < j else 0.0

    def coefficients(self) -> list[list[float]]:
        """a_ij."""
        numbers = range(self.stages)
        return [[self.weights[j] * (0.5 + self.coupling(i, j)) for j in numbers] for i in numbers]


_ROOT = math.sqrt(15.0)
GAUSS_6 = GaussTableau(
    order=6,
    weights=(5 / 18, 4 / 9, 5 / 18),
    couplings=((), (3 * _ROOT / 20,), (3 * _ROOT / 25, 3 * _ROOT / 20)),
)


@dataclass(frozen=True)
class Gauss:
    """A Gauss method with fixed steps, given by its tableau."""

    tableau: GaussTableau

    def append_step(self, program: Program, field: VectorField) -> None:
        self._append(program, _Graphs(self.tableau, field))

    def append_walk(self, program: Program, field: VectorField) -> None:
        """See `MomentumIntegrator`; what rounding cuts off the joint angles is handed on as well."""
        graphs = _Graphs(self.tableau, field, walks=True)
        self._append(program, graphs)
        if graphs.joints:
            program.call(graphs.cut_off())
            program.inputs = [*program.inputs, Buffer("remainder", graphs.joints)]
            program.outputs = [*program.outputs, Buffer("remainder_next", graphs.joints)]

    def append_linearization(self, program: Program, field: VectorField) -> tuple[Any, Any]:
        def append(program: Program, field: VectorField) -> None:
            self._append(program, _Graphs(self.tableau, field), FURTHER_PASSES)

        return append_tangent_linearization(program, field, append)

    def _append(self, program: Program, graphs: _Graphs, further: int = 0) -> None:
        """Append a step with further passes after those that it needs."""
        program.call(graphs.enter())
        rates, passed, taken = graphs.rates(), graphs.passed(), graphs.taken()
        numbers = range(self.tableau.stages)
        tried = {"kept_total": "passed_total", **{f"kept{i}": f"passed{i}" for i in numbers}}
        # In the first pass, the rates at the start are those of all stages.
        program.call(rates, stage="stage0", rate="rate0")
        one = {f"{name}{i}": f"{name}0" for name in ("rate", "stage") for i in numbers}
        program.call(passed, **one)
        program.call(taken, **tried)

        def append_pass() -> None:
            for i in numbers:
                program.call(rates, stage=f"stage{i}", rate=f"rate{i}")
            program.call(passed)

        with program.repeated_while("unfinished"):
            append_pass()
            program.call(graphs.judged())
            program.call(taken)
            program.call(graphs.noted())
        for _ in range(further):
            append_pass()
            program.call(taken, **tried)
        program.call(graphs.leave())
        program.held |= {"factor", "inverse_inertia", "stiffness"}


class _Graphs:
    """Graphs of a step: its start, rates at a stage, a pass over the stages, its judgement, the new state.

    Stages are increments Z_i of the state in canonical coordinates.
    """

    def __init__(self, tableau: GaussTableau, field: VectorField, walks: bool = False) -> None:
        if not isinstance(field, SpaceArmField):
            raise TypeError(f"equations {field.name!r} do not tell the momentum of the system")
        self.tableau, self.field, self.walks = tableau, field, walks
        self.prefix = f"{field.name}_gauss{tableau.order}"
        self.equations = CanonicalCoordinates(field, QuaternionCoordinates(field))
        self.given, self.n = self.equations.given, self.equations.n_y
        self.x, self.u, self.momentum = (
            symbols(name, size) for name, size in (("x", field.n_x), ("u", field.n_u), ("momentum", 6))
        )
        self.h, self.start = casadi.SX.sym("h"), symbols("start", self.n)
        self.rate, self.stage, self.new = (
            [symbols(f"{name}{i}", self.n) for i in range(tableau.stages)]
            for name in ("rate", "stage", "passed")
        )
        # sum_j w_j of the last pass that was kept, which makes the state after the step, and of the new one
        self.total, self.new_total = symbols("total", self.n), symbols("passed_total", self.n)
        self.weighted = [  # w_j
            [self.h * (weight * entry) for entry in rate]
            for weight, rate in zip(tableau.weights, self.rate, strict=True)
        ]
        self.joints = len(self.given.joint_indices)
        self.remainder, self.moved = symbols("remainder", self.joints), symbols("moved", self.joints)
        handed = self.given.turned_back(self.x, self.momentum) if walks else None
        self.begun = self.given.start(self._wrapped(), handed)
        self.stiffness, self.damping = self.equations.passive_slopes(self.begun["local"])
        self.inverse_inertia = self.equations.inverse_inertia(self.begun["local"])
        self.system = self._system()

    def _graph(self, name: str, inputs: Mapping[str, Scalars], outputs: Mapping[str, Scalars]) -> Any:
        return graph_of(f"{self.prefix}_{name}", graph_inputs(self.field, **inputs), outputs)

    def _whole(self) -> dict[str, Scalars]:
        """The state at the start, with what is handed on."""
        handed: dict[str, Scalars] = {"x": self.x}
        if self.walks:
            handed["momentum"] = self.momentum
        if self.walks and self.joints:
            handed["remainder"] = self.remainder
        return handed

    def _wrapped(self) -> list[Scalar]:
        """The start without the pose, angles of revolute joints without a spring within half a turn.

        Increments are added to them: the digits of many turns would be missing behind the point. Where a
        joint slides, another turn is another place.
        """
        y = list(split_state(self.field, self.x)[1])
        stiffness, _ = self.equations.passive_slopes(self.given.start(y)["local"])
        for j, index in enumerate(self.given.shape_indices[: self.joints]):
            if not stiffness[j, :].nnz() and not self.field.tree.links[j].screw.slide:
                turns = casadi.floor(y[index] * (0.5 / math.pi) + 0.5)
                for part in _TURN:
                    y[index] = y[index] - turns * part
            if self.walks:
                y[index] = y[index] + self.remainder[j]
        return y

    def enter(self) -> Any:
        """Graph of the start in canonical coordinates, and the linear equations of springs and dampers."""
        outputs = {"start": self.equations.entered(self.begun["local"]), "center": self.begun["center"]}
        outputs |= {"stage0": [0.0] * self.n, "judgement": [1.0, math.inf, 0.0]}
        inputs = self._whole()
        if self.system is not None:
            inputs["h"] = [self.h]
            outputs |= {"factor": self.system.variables, "stiffness": self.stiffness.nonzeros()}
            outputs["inverse_inertia"] = self.inverse_inertia.nonzeros()
        return self._graph("carry_in" if self.walks else "enter", inputs, outputs)

    def rates(self) -> Any:
        """Graph of the rates at a stage."""
        at = [old + new for old, new in zip(self.start, self.stage[0], strict=True)]
        inputs = {"start": self.start, "stage": self.stage[0], "u": self.u}
        return self._graph("rates", inputs, {"rate": self.equations.rates(at, self.u)})

    def passed(self) -> Any:
        """Graph of the stages after a pass, and of the sum of w_j that made them."""
        count, new = self.tableau.stages, []
        total = [sum(entries) for entries in zip(*self.weighted, strict=True)]
        for i in range(count):
            entries = [0.5 * entry for entry in total]
            for j in range(count):
                if coupling := self.tableau.coupling(i, j):
                    entries = [a + coupling * b for a, b in zip(entries, self.weighted[j], strict=True)]
            new.append(entries)
        inputs = {"h": [self.h], **_numbered("rate", self.rate)}
        if self.system is not None:
            inputs |= _numbered("stage", self.stage)
            new = self._solved(new, inputs)
        outputs = {**_numbered("passed", new), "passed_total": total}
        return graph_of(f"{self.prefix}_passed", inputs, outputs)

    # Springs and dampers: for residuals r of all stages,
    #     dq = r_q + (h A x W) dp,   dp = r_p - (h A x K) dq - (h A x D W) dp,
    # x the Kronecker product.

    def _system(self) -> RosenbrockSystem | None:
        """The equations of dp, dq eliminated; None without springs and dampers."""
        if not self.stiffness.nnz() and not self.damping.nnz():
            return None
        steps = self.h * casadi.SX(casadi.DM(self.tableau.coefficients()))
        slopes = casadi.kron(casadi.mtimes(steps, steps), casadi.mtimes(self.stiffness, self.inverse_inertia))
        slopes += casadi.kron(steps, casadi.mtimes(self.damping, self.inverse_inertia))
        size = slopes.shape[0]
        # The last stage is eliminated first: pivots of 1 + a A + b A^2 stay large for any a, b >= 0.
        return RosenbrockSystem(casadi.sparsify(casadi.SX.eye(size) + slopes), list(reversed(range(size))))

    def _solved(self, target: Sequence[Scalars], inputs: dict[str, Scalars]) -> list[list[Scalar]]:
        """The stages after a pass with the linear equations solved; adds to the inputs what it reads."""
        assert self.system is not None
        known = self.system.renamed()
        stiffness = casadi.SX.sym("stiffness", self.stiffness.sparsity())
        inverse_inertia = casadi.SX.sym("inverse_inertia", self.inverse_inertia.sparsity())
        inputs |= {"factor": known.variables, "stiffness": stiffness.nonzeros()}
        inputs["inverse_inertia"] = inverse_inertia.nonzeros()
        steps = self.h * casadi.SX(casadi.DM(self.tableau.coefficients()))
        change = [
            [new - old for old, new in zip(stage, entries, strict=True)]
            for stage, entries in zip(self.stage, target, strict=True)
        ]
        first, momenta = self.given.shape.start, self.given.joint_rates
        angles = slice(first, first + momenta.stop - momenta.start)
        by_angles, by_momenta = (
            column(*(entry for entries in change for entry in entries[part])) for part in (angles, momenta)
        )
        right = by_momenta - casadi.mtimes(casadi.kron(steps, stiffness), by_angles)
        by_momenta = casadi.densify(column(*known.solve(dense_entries(right))))
        by_angles = by_angles + casadi.mtimes(casadi.kron(steps, inverse_inertia), by_momenta)
        n = angles.stop - angles.start
        for i, entries in enumerate(change):
            entries[angles] = dense_entries(by_angles[i * n : (i + 1) * n])
            entries[momenta] = dense_entries(by_momenta[i * n : (i + 1) * n])
        return [
            [old + new for old, new in zip(stage, entries, strict=True)]
            for stage, entries in zip(self.stage, change, strict=True)
        ]

    def judged(self) -> Any:
        """Graph of what a pass changed, whether another one follows, and the stages and sum of w_j to keep.

        The judgement: 1 until passes have converged, the sum of the last changes of angles, the passes taken.
        """
        pending, last_change, passes = symbols("judgement", 3)
        rotation, shape = self.given.rotation, self.given.shape
        angles = [*range(rotation.start, rotation.stop), *range(shape.start, shape.stop)]
        change: Scalar = 0.0  # a sum: NaN passes through it
        for old, new in zip(self.stage, self.new, strict=True):
            change = change + sum(casadi.fabs(new[k] - old[k]) for k in angles)
        scale = 1.0 + sum(casadi.fabs(self.start[k]) for k in angles)
        small = scale + change * (1.0 / ROUNDINGS) <= scale  # in any precision; false for NaN
        falling = casadi.logic_and(change < last_change, change > 0.0)
        last = passes >= MOST_PASSES - 1.0
        converged = casadi.logic_and(small, casadi.logic_or(casadi.logic_not(falling), last))
        # A lane that is done waits for others in its block, unchanged.
        going = casadi.logic_and(pending, passes < MOST_PASSES)
        taken = casadi.if_else(change < math.inf, passes + 1.0, MOST_PASSES)
        judged = [
            casadi.if_else(going, casadi.logic_not(converged), pending),
            casadi.if_else(going, change, last_change),
            casadi.if_else(going, taken, passes),
        ]

        def kept(old: Scalars, new: Scalars) -> list[Scalar]:
            return [casadi.if_else(going, b, a) for a, b in zip(old, new, strict=True)]

        inputs: dict[str, Scalars] = {"start": self.start, "judgement": [pending, last_change, passes]}
        inputs |= {**_numbered("stage", self.stage), **_numbered("passed", self.new)}
        inputs |= {"total": self.total, "passed_total": self.new_total}
        unfinished = casadi.logic_and(judged[0], judged[2] < MOST_PASSES)
        outputs = _numbered("kept", list(map(kept, self.stage, self.new)))
        outputs |= {"kept_total": kept(self.total, self.new_total)}
        outputs |= {"judged": judged, "unfinished": [unfinished]}
        return graph_of(f"{self.prefix}_judged", inputs, outputs)

    def taken(self) -> Any:
        """Graph that copies stages and sum of w_j: a graph may not write where it reads."""
        inputs = {**_numbered("kept", self.stage), "kept_total": self.total}
        outputs = {**_numbered("stage", self.stage), "total": self.total}
        return graph_of(f"{self.prefix}_taken", inputs, outputs)

    def noted(self) -> Any:
        """Graph that copies the judgement."""
        judged = symbols("judged", 3)
        return graph_of(f"{self.prefix}_noted", {"judged": judged}, {"judgement": judged})

    def leave(self) -> Any:
        """Graph of the new state and momentum; NaN where passes did not converge."""
        given, center, judgement = self.given, symbols("center", 3), symbols("judgement", 3)
        total = [old + new for old, new in zip(self.start, self.total, strict=True)]
        end, first = given.parts(self.equations.left(total)), self.given.shape.start
        moved = self.total[first : first + self.joints]
        if self.walks:
            moved = [a + b for a, b in zip(self.remainder, moved, strict=True)]
        # The base's velocity belongs to the angles as they are stored.
        angles = [self.x[index] + change for index, change in zip(self._angles, moved, strict=True)]
        end = replace(end, shape=[*angles, *end.shape[self.joints :]])
        x_next = given.end(self.x, center, end)
        outputs = {"x_next": or_nan(x_next, judgement[0])}
        if self.walks:
            handed = given.handed_on(self.x, self.momentum, given.parts(self.start), end)
            outputs["momentum_next"] = or_nan(handed, judgement[0])
            outputs |= {"moved": moved} if self.joints else {}
        inputs = self._whole() | {"start": self.start, "total": self.total}
        inputs |= {"center": center, "judgement": judgement}
        return self._graph("carry_out" if self.walks else "leave", inputs, outputs)

    def cut_off(self) -> Any:
        """Graph of what the sums of angles and their changes lack (compensated summation)."""
        after = symbols("x_next", self.field.n_x)
        lacking = [
            change - (after[index] - self.x[index])
            for index, change in zip(self._angles, self.moved, strict=True)
        ]
        inputs = {"x": self.x, "moved": self.moved, "x_next": after}
        return graph_of(f"{self.prefix}_cut_off", inputs, {"remainder_next": lacking})

    @property
    def _angles(self) -> list[int]:
        """Joint angles in x."""
        pose = self.field.n_x - self.field.n_y
        return [pose + index for index in self.given.shape_indices[: self.joints]]


def _numbered(name: str, vectors: Sequence[Scalars]) -> dict[str, Scalars]:
    return {f"{name}{i}": vector for i, vector in enumerate(vectors)}
