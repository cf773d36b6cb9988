"""A scene's kernels, and their products with cotangents, as any library that differentiates wants them.

Kernels differentiate in tangent coordinates; users hold states, whose pose has eight numbers for six
directions. The gradient by a state is the shortest one that agrees with the kernels' along all of them: what
any smooth formula for the same function has, less its parts across the poses.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from dq_space_arm_env.algebra import dual_quaternion
from dq_space_arm_env.dynamics.equations_of_motion import EquationsOfMotion
from dq_space_arm_env.dynamics.kinematic_tree import KinematicTree
from dq_space_arm_env.interoperability.exporting import integrator_name
from dq_space_arm_env.kernels import Kernels
from dq_space_arm_env.kernels.bound import KernelCall
from dq_space_arm_env.scene.start import unit_quaternions

Array = NDArray[Any]
Arrays = tuple[Array, ...]

NOT_BY_PARAMETERS = (
    "the kernels of constraints have no derivatives by parameters: "
    "for these take jax_dynamics without kernels"
)
"""Refusal of gradients of constraints by parameters."""


@dataclass(frozen=True)
class Operation:
    """A function of arrays with a row for each state, (B, ...)."""

    value: Callable[..., Arrays]  # of the inputs
    backward: Callable[[Sequence[Array], Array, Sequence[Array], bool], Arrays]
    n_inputs: int = 3
    by_parameters: bool = True  # whether there are products of the parameters

    def check(self, with_parameters: bool, n_p: int) -> bool:
        """Whether products of n_p parameters are wanted; NotImplementedError if there are none."""
        if with_parameters and n_p and not self.by_parameters:
            raise NotImplementedError(NOT_BY_PARAMETERS)
        return with_parameters and n_p > 0

    def products(
        self, given: Sequence[Array], first: Array, cotangents: Sequence[Array], with_parameters: bool
    ) -> Arrays:
        """Cotangents of the inputs from these, the first output, and the outputs' cotangents.

        Those of the parameters, the last input, are zero unless they are wanted.
        """
        return self.backward(given, first, cotangents, self.check(with_parameters, given[-1].shape[-1]))


class DifferentiableKernels:
    """Operations of a scene: of (x, u, p) or, at the end, of (x, p), and rollouts."""

    def __init__(self, kernels: Kernels, integrator: str | None, dt: float | None) -> None:
        """Take a scene's kernels; integrator and time step [s] are the scene's by default."""
        self._kernels, self._dt = kernels, kernels.scene.simulation.dt if dt is None else dt
        self._integrator = integrator_name(kernels.scene, integrator)
        self._charts = _Charts(kernels)
        self.step = Operation(self._step, self._step_products)
        self.cost = Operation(self._cost, self._cost_products)
        self.terminal_cost = Operation(self._terminal_cost, self._terminal_cost_products, 2)
        self.constraints = Operation(self._constraints, self._constraints_products, by_parameters=False)
        self.terminal_constraints = Operation(
            self._terminal_constraints, self._terminal_constraints_products, 2, by_parameters=False
        )

    def rollout(self, every: int) -> Operation:
        """A rollout of (x, u, p), shapes (B, n_x), (B, N, n_u), (B, N + 1, n_p).

        It gives the states after every so many steps, the start first, (B, N / every + 1, n_x), and all
        costs, the terminal one last, (B, N + 1). The products fly again from the states kept.
        """

        def value(x: Array, u: Array, p: Array) -> Arrays:
            (inputs, given), costs = _in_time(u, p), self._zeros(u.shape[1] + 1, len(x), 1)
            states, run = self._zeros(u.shape[1] // every + 1, *x.shape), self._call("step_with_cost", len(x))
            states[0] = x
            for number, part in enumerate(_parts(len(inputs), every)):
                flown = self._fly(run, states[number], inputs[part], given[part], costs[part])
                states[number + 1] = flown[-1]
            costs[-1, :, 0] = self._kernels.terminal_cost(states[-1], p=given[-1])
            return states.swapaxes(0, 1), costs[..., 0].swapaxes(0, 1)

        def products(
            given: Sequence[Array], states: Array, cotangents: Sequence[Array], with_parameters: bool
        ) -> Arrays:
            return self._rollout_products(given, states, cotangents, with_parameters, every)

        return Operation(value, products)

    def _zeros(self, *shape: int) -> Array:
        return np.zeros(shape, self._kernels.dtype)

    def _options(self, p: Array) -> dict[str, Any]:
        return {"dt": self._dt, "integrator": self._integrator, "p": p}

    def _step(self, x: Array, u: Array, p: Array) -> Arrays:
        return (self._kernels.step(x, u, **self._options(p)),)

    def _step_products(
        self, given: Sequence[Array], x_next: Array, cotangents: Sequence[Array], with_parameters: bool
    ) -> Arrays:
        x, u, p = given
        v = self._charts.lower(x_next, cotangents[0])
        by_x, by_u = self._kernels.vjp(x, u, v, **self._options(p))
        return self._charts.lift(x, by_x), by_u, self._by_parameters(x, u, p, v, with_parameters)

    def _by_parameters(self, x: Array, u: Array, p: Array, v: Array, wanted: bool) -> Array:
        if not wanted:
            return np.zeros_like(p)
        by_p = self._kernels.linearize_parameters(x, u, **self._options(p))
        return _weighted(v, by_p)

    def _cost(self, x: Array, u: Array, p: Array) -> Arrays:
        return (self._kernels.cost(x, u, p=p),)

    def _cost_products(
        self, given: Sequence[Array], _: Array, cotangents: Sequence[Array], with_parameters: bool
    ) -> Arrays:
        (x, u, p), v = given, cotangents[0][:, None]
        by_x, by_u = self._kernels.cost_gradient(x, u, p=p)
        by_p = self._kernels.cost_by_parameters(x, u, p=p) if with_parameters else np.zeros_like(p)
        return self._charts.lift(x, v * by_x), v * by_u, v * by_p

    def _terminal_cost(self, x: Array, p: Array) -> Arrays:
        return (self._kernels.terminal_cost(x, p=p),)

    def _terminal_cost_products(
        self, given: Sequence[Array], _: Array, cotangents: Sequence[Array], with_parameters: bool
    ) -> Arrays:
        (x, p), v = given, cotangents[0][:, None]
        by_p = self._kernels.terminal_cost_by_parameters(x, p=p) if with_parameters else np.zeros_like(p)
        return self._charts.lift(x, v * self._kernels.terminal_cost_gradient(x, p=p)), v * by_p

    def _constraints(self, x: Array, u: Array, p: Array) -> Arrays:
        return (self._kernels.constraints(x, u, p=p),)

    def _constraints_products(
        self, given: Sequence[Array], _: Array, cotangents: Sequence[Array], with_parameters: bool
    ) -> Arrays:
        x, u, p = given
        products = _weighted(cotangents[0], self._kernels.constraint_jacobian(x, u, p=p))
        n_t = self._kernels.n_t
        return self._charts.lift(x, products[:, :n_t]), products[:, n_t:], np.zeros_like(p)

    def _terminal_constraints(self, x: Array, p: Array) -> Arrays:
        return (self._kernels.terminal_constraints(x, p=p),)

    def _terminal_constraints_products(
        self, given: Sequence[Array], _: Array, cotangents: Sequence[Array], with_parameters: bool
    ) -> Arrays:
        x, p = given
        products = _weighted(cotangents[0], self._kernels.terminal_constraint_jacobian(x, p=p))
        return self._charts.lift(x, products), np.zeros_like(p)

    def _call(self, name: str, rows: int) -> Callable[..., None]:
        """A kernel of a step with its cost, run on arrays by name."""
        lanes = 1 if rows == 1 else None
        kernel = self._kernels.kernel(name, integrator=self._integrator, lanes=lanes)
        call = KernelCall(kernel, {"h": np.array([self._dt], self._kernels.dtype)})
        names = {spec.name for spec in (*kernel.inputs, *kernel.outputs)}

        def run(**arrays: Array) -> None:
            call.place(**{key: array for key, array in arrays.items() if key in names})
            call(rows, self._kernels.threads)

        return run

    def _fly(self, run: Callable[..., None], start: Array, u: Array, p: Array, costs: Array) -> Array:
        """The states of some steps, the start first, (k + 1, B, n_x); writes their costs, (k, B, 1)."""
        states = self._zeros(len(u) + 1, *start.shape)
        states[0] = start
        for k in range(len(u)):
            run(x=states[k], u=u[k], parameters=p[k], x_next=states[k + 1], cost=costs[k])
        return states

    def _rollout_products(
        self,
        given: Sequence[Array],
        states: Array,
        cotangents: Sequence[Array],
        with_parameters: bool,
        every: int,
    ) -> Arrays:
        (x, u, p), kernels = given, self._kernels
        forward, backward = self._call("step_with_cost", len(x)), self._call("step_with_cost_vjp", len(x))
        kept, of_states, of_costs = _in_time(states, cotangents[0], cotangents[1][..., None])
        inputs, parameters = _in_time(u, p)
        by_u, by_p = np.zeros_like(inputs), np.zeros_like(parameters)
        lowered = self._charts.lower(*(each.reshape(-1, x.shape[1]) for each in (kept, of_states)))
        lowered = lowered.reshape(len(kept), len(x), kernels.n_t)
        v = lowered[-1] + of_costs[-1] * kernels.terminal_cost_gradient(kept[-1], p=parameters[-1])
        before, unused = np.zeros_like(v), np.zeros_like(of_costs[:every])
        if with_parameters:
            by_p[-1] = of_costs[-1] * kernels.terminal_cost_by_parameters(kept[-1], p=parameters[-1])
        for number, part in reversed(list(enumerate(_parts(len(inputs), every)))):
            flown = kept[number : number + 1]
            if every > 1:
                flown = self._fly(forward, kept[number], inputs[part], parameters[part], unused)
            for k in reversed(range(part.start, part.stop)):
                here = {"x": flown[k - part.start], "u": inputs[k], "p": parameters[k]}
                if with_parameters:
                    by_p[k] = self._by_parameters(**here, v=v, wanted=True)
                    by_p[k] += of_costs[k] * kernels.cost_by_parameters(**here)
                out = {"x_cotangent": before, "u_cotangent": by_u[k]}
                backward(**here, parameters=parameters[k], v=v, v_cost=of_costs[k], **out)
                v, before = before, v
            v += lowered[number]
        return self._charts.lift(x, v), by_u.swapaxes(0, 1), by_p.swapaxes(0, 1)


def _weighted(v: Array, matrices: Array) -> Array:
    """Sums of the rows of matrices, (B, m, n), each times its entry of v, (B, m)."""
    return np.asarray(np.einsum("bi,bij->bj", v, matrices))


def _in_time(*arrays: Array) -> list[Array]:
    """Arrays with time first, (T, B, n), from those with rows first."""
    return [np.ascontiguousarray(array.swapaxes(0, 1)) for array in arrays]


def _parts(steps: int, every: int) -> list[slice]:
    return [slice(begin, begin + every) for begin in range(0, steps, every)]


class _Charts:
    """Cotangents in tangent coordinates, and by the numbers of a state."""

    def __init__(self, kernels: Kernels) -> None:
        scene, dtype = kernels.scene, kernels.dtype
        pose = EquationsOfMotion(KinematicTree.from_scene(scene), kernels.layout).pose
        stored, twists = np.eye(len(pose.stored)), 0.5 * np.eye(len(pose.directions))
        full = [pose.full(row.tolist()) for row in stored]
        moves = [(0.0, *twist[:3], 0.0, *twist[3:]) for twist in map(pose.full_twist, twists.tolist())]
        # Of a pose q, the pose q d / 2 by the directions d, and the directions 2 q* dq by dq: bilinear.
        moved = [[pose.reduced(dual_quaternion.multiply(q, move)) for move in moves] for q in full]
        seen = [[dual_quaternion.multiply(dual_quaternion.conjugate(q), dq) for dq in full] for q in full]
        directions = [(1, 2, 3, 5, 6, 7)[i] for i in pose.directions]
        self._n, self._m = n, m = len(stored), len(directions)
        # Tables of sums over pairs, of q and a cotangent.
        self._lowering = np.array(moved, dtype).transpose(0, 2, 1).reshape(n * n, m)
        self._lifting = 2.0 * np.array(seen, dtype)[:, :, directions].transpose(0, 2, 1).reshape(n * m, n)
        # Where |q_r| = 1, and where q_r . q_d = 0 besides.
        self._unit = [slice(0, n // 2), *unit_quaternions(scene)]
        self._spatial = n == 8

    def lower(self, x: Array, cotangents: Array) -> Array:
        """Cotangents in tangent coordinates, (B, n_t), from those by a state's numbers, (B, n_x)."""
        n = self._n
        turned = _pairs(x[:, :n], cotangents[:, :n]) @ self._lowering
        return np.concatenate([turned, cotangents[:, n:]], axis=1)

    def lift(self, x: Array, cotangents: Array) -> Array:
        """The shortest cotangents by a state's numbers, (B, n_x), that `lower` takes to these, (B, n_t)."""
        n, m = self._n, self._m
        pose = _pairs(x[:, :n], cotangents[:, :m]) @ self._lifting
        lifted = np.concatenate([pose, cotangents[:, m:]], axis=1)
        for where in self._unit:
            _remove(lifted[:, where], x[:, where])
        if self._spatial:
            _remove(lifted[:, :8], np.roll(x[:, :8], 4, axis=1))  # (q_d, q_r), at right angles to (q_r, 0)
        return lifted


def _pairs(x: Array, y: Array) -> Array:
    """Products of every entry of a row with every one of the other's, (B, n m)."""
    return (x[:, :, None] * y[:, None, :]).reshape(len(x), x.shape[1] * y.shape[1])


def _remove(vectors: Array, normals: Array) -> None:
    """Take the parts along normals off vectors."""
    sizes = np.einsum("bi,bi->b", vectors, normals) / np.einsum("bi,bi->b", normals, normals)
    vectors -= sizes[:, None] * normals
