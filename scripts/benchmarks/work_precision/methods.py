"""Ways to take a step: the integrators by name, and the paper's own formulation, projected or not."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import numpy as np

from dq_space_arm_env import Kernels, Scene, compile_scene
from dq_space_arm_env.kernels.adaptive import CATCH_NOW
from dq_space_arm_env.kernels.bound import BoundKernel, KernelCall
from dq_space_arm_env.scene import INTEGRATORS
from experts.problems.shooting_problem import FloatArray
from scripts.benchmarks.work_precision.motions import MotionCase

PAPER, PROJECTED = "paper", "paper_projected"
PAPER_TITLES = {PAPER: "paper's 46 states, RK4", PROJECTED: "the same, projected"}
_PAPER_STEPS = {PAPER: "step", PROJECTED: "projected_step"}

_ROWS = 1024  # steps that are taken without coming back to Python, and states of a batch


@dataclass(frozen=True)
class Method:
    """A way to take a step."""

    name: str
    order: int
    is_adaptive: bool = False

    @property
    def title(self) -> str:
        """Name in tables."""
        return PAPER_TITLES.get(self.name, self.name)

    @property
    def iterates(self) -> bool:
        """Whether the work of a step depends on how long it is, though no tolerance divides it."""
        return not self.is_paper_form and INTEGRATORS[self.name].iterates

    @property
    def is_paper_form(self) -> bool:
        """Whether its state is the paper's."""
        return self.name in PAPER_TITLES

    def kernels(self, scene: Scene, tolerance: float | None = None) -> Kernels:
        """The scene's kernels, with the tolerance of an adaptive method if given."""
        changes: dict[str, object] = {"precision": "float64"}
        if tolerance is not None:
            changes |= {"integrator": self.name, **INTEGRATORS[self.name].within(tolerance)}
        return compile_scene(scene.replace(simulation=changes))

    def step_kernel(self, kernels: Kernels, lanes: int | None) -> BoundKernel:
        """The kernel that takes a step; the next state is its only output."""
        if self.is_paper_form:
            return kernels.paper_kernel(_PAPER_STEPS[self.name], lanes=lanes)
        return kernels.kernel("step", integrator=self.name, lanes=lanes)

    def own_state(self, kernels: Kernels, x: FloatArray) -> FloatArray:
        """States in minimal coordinates as the method has them, shape (B, n)."""
        return _mapped(kernels.paper_kernel("from_minimal", lanes=1), x) if self.is_paper_form else x

    def minimal_state(self, kernels: Kernels, x: FloatArray) -> FloatArray:
        """The method's states in minimal coordinates, shape (B, n_x)."""
        return _mapped(kernels.paper_kernel("to_minimal", lanes=1), x) if self.is_paper_form else x


def methods_of(case: MotionCase, names: Sequence[str] = ()) -> list[Method]:
    """The methods that follow a motion: integrators that take its robot, the paper's form; or those named."""
    known = (*INTEGRATORS, *PAPER_TITLES)
    for name in names:
        if name not in known:
            raise ValueError(f"methods: {name!r} is unknown; choose from {', '.join(known)}")
    methods = [
        Method(name, entry.order, entry.is_adaptive)
        for name, entry in INTEGRATORS.items()
        if entry.takes(case.scene)
    ]
    if case.with_paper_form:
        methods += [Method(name, INTEGRATORS["rk4"].order) for name in PAPER_TITLES]
    return [method for method in methods if not names or method.name in names]


def _mapped(kernel: BoundKernel, x: FloatArray) -> FloatArray:
    """A kernel of states applied to rows."""
    result: FloatArray = np.zeros((len(x), kernel.outputs[0].stride))
    kernel([np.ascontiguousarray(x), result], len(x))
    return result


class Walk:
    """A motion step by step, the next state written below the one before."""

    def __init__(self, method: Method, kernels: Kernels, case: MotionCase) -> None:
        kernel = method.step_kernel(kernels, lanes=1)
        self._method, self._kernels, self._case = method, kernels, case
        self._start = method.own_state(kernels, case.start[None])[0]
        self._states = np.zeros((_ROWS + 1, len(self._start)))
        self._inputs, self._step = np.zeros((_ROWS, kernels.n_u)), np.zeros(1)
        nominal, names = kernels.parameters.nominal, kernels.parameters.names
        self._parameters = np.zeros((_ROWS, len(nominal)))
        # Of each hold; a catch comes at its end, not after each of its steps.
        self._given = np.broadcast_to(nominal, (len(case.controls), len(nominal)))
        if case.parameters is not None:
            self._given = case.parameters
        self._catch = names.index(CATCH_NOW) if CATCH_NOW in names else None
        arrays = {"x": self._states, "parameters": self._parameters, "u": self._inputs, "h": self._step}
        self._call = KernelCall(kernel, {**arrays, kernel.outputs[0].name: self._states[1:]})

    def run(self, per_hold: int) -> None:
        for _ in self._chunks(per_hold):
            pass

    @property
    def state(self) -> FloatArray:
        """End of the last run in minimal coordinates, shape (n_x,); NaN if it diverged."""
        state: FloatArray = self._method.minimal_state(self._kernels, self._states[:1])[0]
        return state

    def passed(self, per_hold: int, count: int) -> tuple[FloatArray, FloatArray]:
        """States along the motion, and the inputs there."""
        total = per_hold * len(self._case.controls)
        wanted = np.linspace(0, total - 1, count).astype(int)
        states, inputs = [], []
        for first, rows in self._chunks(per_hold):
            here = wanted[(wanted >= first) & (wanted < first + rows)] - first
            states.append(self._states[here])
            inputs.append(self._inputs[here])
        passed = np.concatenate(states)
        return self._method.minimal_state(self._kernels, passed), np.concatenate(inputs)

    def _chunks(self, per_hold: int) -> Iterator[tuple[int, int]]:
        """Walk in chunks; yields the number of the first step, and how many steps the arrays hold."""
        self._step[0] = self._case.hold / per_hold
        self._states[0] = self._start
        total = per_hold * len(self._case.controls)
        for first in range(0, total, _ROWS):
            rows = min(_ROWS, total - first)
            holds, steps = np.divmod(first + np.arange(rows), per_hold)
            self._inputs[:rows], self._parameters[:rows] = self._case.controls[holds], self._given[holds]
            if self._catch is not None:
                self._parameters[:rows][steps < per_hold - 1, self._catch] = 0.0
            self._call(rows)
            yield first, rows
            self._states[0] = self._states[rows]
