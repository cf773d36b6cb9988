"""The division of a time step into substeps, as short as the error of an embedded method requires.

Every state of a batch has its own substeps: the calls are repeated until the last lane has arrived, and
waiting lanes pass through them unchanged.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import casadi

from dq_space_arm_env.algebra.symbolic import column
from dq_space_arm_env.compiler.graph import trace
from dq_space_arm_env.compiler.program import Program
from dq_space_arm_env.dynamics.vector_field import VectorField

Scalar = Any
Scalars = Sequence[Scalar]

STRETCH = 1.01
"""Factor by which the last substep may exceed the chosen length."""
LARGEST_ERROR = 1e30
"""A larger error, in units of the tolerance, is no number."""
SAFETY, LARGEST_FACTOR = 0.9, 5.0
"""The next substep is at most 0.9 root(error)^-1 times the last one, and at most 5 times."""


@dataclass(frozen=True)
class Substeps:
    """Calls around those of a method that tries a substep.

    Buffers: `left`, the fraction of the step left; `substep`, the fraction to try next; `taken` and
    `substep_time`, the one being tried, as a fraction and in s; `tries`; `error`, that of the try in units of
    the tolerance; `step_error`, the largest of those accepted.
    """

    prefix: str  # of the graphs' names
    root: Callable[[Scalar], Scalar]  # of the error, inversely proportional to the next length
    most: int  # tries, rejected ones included
    smallest: float = 1e-6  # substep, as a fraction of the step
    smallest_factor: float = 0.2  # length of a substep relative to the one before
    # Whether what is left after all tries, or where substeps become too short, is taken in one substep,
    # whatever its error; otherwise the step ends in NaN.
    finishes: bool = False

    def append_begin(self, program: Program, **starts: str) -> None:
        """Start with buffers that move on, each a copy of another one; the whole step is tried first."""
        sizes = program.scratch_sizes()

        def begin(**values: Scalars) -> dict[str, Any]:
            scalars = {"left": [1.0], "substep": [1.0], "tries": [0.0], "step_error": [0.0]}
            return {**{name: values[f"{name}_begun"] for name in starts}, **scalars}

        given = {f"{name}_begun": sizes[source] for name, source in starts.items()}
        bindings = {f"{name}_begun": source for name, source in starts.items()}
        program.call(trace(f"{self.prefix}_begin", given, begin), **bindings)

    def append_length(self, program: Program) -> None:
        """Length of the substep to try: at most what is left."""

        def length(h: Scalars, left: Scalars, substep: Scalars) -> dict[str, Any]:
            # A little more than was chosen, if a sliver would be left otherwise.
            taken = casadi.if_else(left[0] <= STRETCH * substep[0], left[0], substep[0])
            return {"taken": [taken], "substep_time": [taken * h[0]]}

        program.call(trace(f"{self.prefix}_length", {"h": 1, "left": 1, "substep": 1}, length))
        program.held |= {"taken", "substep_time"}

    def append_choice(self, program: Program, names: Mapping[str, str]) -> None:
        """Accept the try if its error is tolerable, and choose the next length.

        `names` maps each buffer that moves on to the one tried.
        """
        sizes = program.scratch_sizes()

        def choose(
            error: Scalars,
            step_error: Scalars,
            taken: Scalars,
            left: Scalars,
            tries: Scalars,
            **others: Scalars,
        ) -> dict[str, Any]:
            # Written so that NaN is rejected: of two numbers that do not compare, the second is taken.
            last = tries[0] >= self.most - 1.0
            tolerable = error[0] <= 1.0
            if self.finishes:
                tolerable = casadi.logic_or(tolerable, casadi.logic_and(last, error[0] <= LARGEST_ERROR))
            accepted = casadi.logic_and(tolerable, left[0] > 0.0)
            remaining = casadi.if_else(accepted, left[0] - taken[0], left[0])
            factor = casadi.fmax(SAFETY / self.root(error[0]), self.smallest_factor)
            substep = taken[0] * casadi.fmin(factor, LARGEST_FACTOR)
            tried, going = tries[0] + 1.0, casadi.logic_and(remaining > 0.0, casadi.logic_not(last))
            if self.finishes:
                ends = casadi.logic_or(tried >= self.most - 1.0, casadi.logic_not(substep >= self.smallest))
                substep = casadi.if_else(ends, remaining, substep)
                tried = casadi.if_else(ends, self.most - 1.0, tried)
                unfinished = going
            else:
                unfinished = casadi.logic_and(going, substep >= self.smallest)
            kept = {
                f"{old}_kept": [
                    casadi.if_else(accepted, b, a) for a, b in zip(others[old], others[new], strict=True)
                ]
                for old, new in names.items()
            }
            # A lane that is given up goes no further, however long others in its block take.
            following = casadi.if_else(unfinished, substep, 0.0)
            scalars = {
                "left_kept": [remaining],
                "substep_kept": [following],
                "tries_kept": [tried],
                "step_error_kept": [
                    casadi.if_else(accepted, casadi.fmax(step_error[0], error[0]), step_error[0])
                ],
            }
            return {**kept, **scalars, "unfinished": [unfinished]}

        values = {name: sizes[name] for pair in names.items() for name in pair}
        scalars = dict.fromkeys(("error", "step_error", "taken", "left", "tries"), 1)
        program.call(trace(f"{self.prefix}_choice", {**scalars, **values}, choose))
        # A graph may not write where it reads.
        carried = {name: sizes[name] for name in (*names, "left", "substep", "tries", "step_error")}

        def move(**kept: Scalars) -> dict[str, Any]:
            return {name: kept[f"{name}_kept"] for name in carried}

        kept_sizes = {f"{name}_kept": size for name, size in carried.items()}
        program.call(trace(f"{self.prefix}_move", kept_sizes, move))

    def append_end(self, program: Program, **ends: str) -> None:
        """Copy what moved on to other buffers, by its name; NaN if the end of the step was not reached."""
        sizes = program.scratch_sizes()

        def end(left: Scalars, **values: Scalars) -> dict[str, Any]:
            return {target: or_nan(values[name], left[0]) for name, target in ends.items()}

        ends = {**ends, "step_error": "checked_error"}
        graph = trace(f"{self.prefix}_end", {"left": 1, **{name: sizes[name] for name in ends}}, end)
        program.call(graph)


def fourth_root(error: Scalar) -> Scalar:
    """error^1/4, for an error of order h^4 or h^5."""
    return casadi.sqrt(casadi.sqrt(error))


def fifth_root(error: Scalar) -> Scalar:
    """error^3/16, close to the fifth root, for an error of order h^5 or h^6."""
    eighth = casadi.sqrt(fourth_root(error))
    return eighth * casadi.sqrt(eighth)


def largest_error(field: VectorField, estimate: Scalars, x_next: Scalars, h: Scalar, limit: float) -> Scalar:
    """The largest entry of an estimated error in units of a limit [rad, m], rates times a time h; or NaN.

    The estimate is in tangent coordinates: of the pose, if it is apart from y, then of y.
    """
    first = len(estimate) - field.n_y
    rates = {first + i for i in field.rate_indices}
    scale, rate_scale = 1.0 / limit, casadi.fabs(h) / limit
    worst: Scalar = 0.0
    for i, entry in enumerate(estimate):
        worst = casadi.fmax((rate_scale if i in rates else scale) * casadi.fabs(entry), worst)
    # A maximum passes over NaN; of a comparison with NaN nothing is true.
    return casadi.if_else(casadi.sumsqr(column(*x_next)) < math.inf, worst, math.nan)


def or_nan(values: Scalars, left: Scalar) -> list[Scalar]:
    """The values, or NaN while part of the step is left."""
    return [casadi.if_else(left > 0.0, math.nan, value) for value in values]
