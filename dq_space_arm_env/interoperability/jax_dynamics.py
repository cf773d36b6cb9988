"""A scene as differentiable functions of JAX: compiled by XLA from its trace, or calling its kernels."""

from __future__ import annotations

from collections.abc import Callable
from functools import cache
from importlib import import_module
from math import prod
from pathlib import Path
from typing import Any

import numpy as np

from dq_space_arm_env.interoperability.differentiable_dynamics import FIRST_ONLY, DifferentiableDynamics
from dq_space_arm_env.interoperability.differentiable_kernels import DifferentiableKernels, Operation
from dq_space_arm_env.kernels import compile_scene
from dq_space_arm_env.scene import Scene, load_scene, path_rows, terminal_rows

Function = Callable[..., Any]


class JaxDynamics(DifferentiableDynamics[Any]):
    """A scene's functions of arrays, see `jax_dynamics`."""

    def __init__(self, scene: Scene, integrator: str | None, dt: float | None) -> None:
        """See `jax_dynamics`."""
        self._jax = _jax()
        super().__init__(scene, integrator, dt)

    def _checked(self, name: str, array: Any) -> Any:
        result = self._jax.numpy.asarray(array)
        if result.dtype != self._dtype:
            hint = "call jax.config.update('jax_enable_x64', True) at the start, and "
            raise ValueError(
                f"{name}: dtype {result.dtype}, scene {self.scene.name!r} computes in {self._dtype}: "
                f"{'' if self._jax.config.jax_enable_x64 else hint}convert it, or change the scene's "
                "simulation.precision"
            )
        return result

    def _broadcast(self, array: Any, shape: tuple[int, ...]) -> Any:
        return self._jax.numpy.broadcast_to(array, shape)


class _ByXLA(JaxDynamics):
    """Emitted from the trace."""

    def __init__(self, scene: Scene, integrator: str | None, dt: float | None) -> None:
        super().__init__(scene, integrator, dt)
        self._functions, self._compiled = self._emit(), cache(self._compile)

    def __reduce__(self) -> tuple[Any, ...]:
        return _ByXLA, (self.scene, self.integrator, self.dt)

    def _emit(self) -> dict[str, Function]:
        from dq_space_arm_env.interoperability.traced_functions import step_of_fixed_stages
        from dq_space_arm_env.interoperability.xla_functions import xla_function
        from dq_space_arm_env.kernels.programs.scene_programs import ScenePrograms

        programs = ScenePrograms(self.scene)
        names = ("cost", "terminal_cost", "constraints", "terminal_constraints")
        traced = {name: programs.build(name) for name in names}
        traced["step"] = step_of_fixed_stages(programs, self.integrator, "JAX")
        emitted = {name: xla_function(self._jax, program, self._dtype) for name, program in traced.items()}
        h = np.array([self.dt], self._dtype)
        return {
            "step": lambda x, u, p: (emitted["step"](x=x, u=u, parameters=p, h=h),),
            "cost": lambda x, u, p: (emitted["cost"](x=x, u=u, parameters=p)[0],),
            "terminal_cost": lambda x, p: (emitted["terminal_cost"](x=x, parameters=p)[0],),
            "constraints": lambda x, u, p: (emitted["constraints"](x=x, u=u, parameters=p),),
            "terminal_constraints": lambda x, p: (emitted["terminal_constraints"](x=x, parameters=p),),
        }

    def _run(self, name: str, arrays: list[Any], every: int = 1) -> tuple[Any, ...]:
        results: tuple[Any, ...] = self._compiled(name, every)(*arrays)
        return results

    def _compile(self, name: str, every: int) -> Function:
        function = self._rollout(every) if name == "rollout" else self._functions[name]
        compiled: Function = self._jax.jit(self._jax.vmap(function))
        return compiled

    def _rollout(self, every: int) -> Function:
        jax, functions = self._jax, self._functions

        def advance(x: Any, given: tuple[Any, Any]) -> tuple[Any, Any]:
            return functions["step"](x, *given)[0], functions["cost"](x, *given)[0]

        def stretch(x: Any, given: tuple[Any, Any]) -> tuple[Any, tuple[Any, Any]]:
            x, costs = jax.lax.scan(advance, x, given)
            return x, (x, costs)

        def rollout(x: Any, u: Any, p: Any) -> tuple[Any, Any]:
            parts = len(u) // every, every
            given = u.reshape(*parts, u.shape[1]), p[:-1].reshape(*parts, p.shape[1])
            end, (states, costs) = jax.lax.scan(jax.checkpoint(stretch), x, given)
            last = functions["terminal_cost"](end, p[-1])[0]
            states = jax.numpy.concatenate([x[None], states])
            return states, jax.numpy.append(costs.ravel(), last)

        return rollout


class _ByKernels(JaxDynamics):
    """Calling the kernels."""

    def __init__(
        self, scene: Scene | str | Path, integrator: str | None, dt: float | None, threads: int
    ) -> None:
        kernels = compile_scene(scene, threads)
        super().__init__(kernels.scene, integrator, dt)
        self._threads = threads
        self._operations = DifferentiableKernels(kernels, self.integrator, self.dt)
        self._calling = cache(self._call)

    def __reduce__(self) -> tuple[Any, ...]:
        return _ByKernels, (self.scene, self.integrator, self.dt, self._threads)

    def _run(self, name: str, arrays: list[Any], every: int = 1) -> tuple[Any, ...]:
        results: tuple[Any, ...] = self._calling(name, self._shapes(name, arrays, every), every)(*arrays)
        return results

    def _shapes(self, name: str, arrays: list[Any], every: int) -> tuple[tuple[int, ...], ...]:
        """Shapes of the results of one row."""
        n_x = self.layout.n_x
        if name == "rollout":
            steps = arrays[1].shape[1]
            return (steps // every + 1, n_x), (steps + 1,)
        if name == "step":
            return ((n_x,),)
        rows = {"constraints": path_rows, "terminal_constraints": terminal_rows}.get(name)
        return ((len(rows(self.scene)),),) if rows else ((),)

    def _call(self, name: str, shapes: tuple[tuple[int, ...], ...], every: int) -> Function:
        of = self._operations
        operation = of.rollout(every) if name == "rollout" else getattr(of, name)
        on_row = _differentiable(self._jax, operation, shapes, self._dtype)
        # Compiled, a call back is made once; else at every call anew.
        compiled: Function = self._jax.jit(self._jax.vmap(on_row))
        return compiled


def jax_dynamics(
    scene: Scene | str | Path,
    integrator: str | None = None,
    dt: float | None = None,
    *,
    kernels: bool = False,
    threads: int = 1,
) -> JaxDynamics:
    """Make a scene's step, costs, constraints and rollouts differentiable functions of JAX.

    By default they are emitted from the trace: `jit`, `vmap`, `scan`, derivatives of any order and mode,
    and every device that XLA compiles for. With `kernels` they call the compiled kernels on the CPU, which is
    many times faster there, compiles in seconds and takes every integrator; they have gradients, and refuse
    second derivatives, forward mode, and gradients of constraints by parameters.

    Args:
        scene: A scene, the name of a shipped one, or a path to a YAML file.
        integrator: Name of the integrator; the scene's by default. Without `kernels` one that takes a fixed
            number of stages.
        dt: Time step, s; the scene's by default.
        kernels: Whether to call the compiled kernels.
        threads: Most threads that a batch is shared among, with `kernels`.

    Returns:
        The functions, of arrays of the scene's precision, float64 by default: JAX must have it enabled by
        `jax.config.update("jax_enable_x64", True)`.

    Raises:
        ImportError: If JAX is not installed.
        ValueError: If the integrator is unknown or repeats calls, or dt is not a finite number.
    """
    if kernels:
        return _ByKernels(scene, integrator, dt, threads)
    return _ByXLA(load_scene(scene), integrator, dt)


def _jax() -> Any:
    try:
        return import_module("jax")
    except ImportError as error:
        raise ImportError("jax_dynamics needs the extra jax: pip install 'dq-space-arm[jax]'") from error


def _differentiable(
    jax: Any, operation: Operation, shapes: tuple[tuple[int, ...], ...], dtype: np.dtype[Any]
) -> Function:
    """Make an operation, which has rows, a function of one row with results of some shapes."""

    def call(*inputs: Any) -> Any:
        return _call_back(jax, operation.value, inputs, shapes, dtype)

    value = jax.custom_vjp(call)

    def forward(*inputs: Any) -> Any:
        given = tuple(each.value for each in inputs)
        results = value(*given)
        return results, (given, results[0], () if inputs[-1].perturbed else None)

    def backward(kept: Any, cotangents: Any) -> Any:
        given, first, wanted = kept
        operation.check(wanted is not None, given[-1].shape[-1])
        sizes = [each.shape for each in given]

        def on_rows(*rows: Any) -> Any:
            n = operation.n_inputs
            return operation.products(rows[:n], rows[n], rows[n + 1 :], wanted is not None)

        products = jax.custom_jvp(lambda *arrays: _call_back(jax, on_rows, arrays, sizes, dtype))
        products.defjvp(_refuse)

        symbolic = jax.custom_derivatives.SymbolicZero
        numbers = [
            jax.numpy.zeros(each.shape, dtype) if isinstance(each, symbolic) else each for each in cotangents
        ]
        return tuple(products(*given, first, *numbers))

    value.defvjp(forward, backward, symbolic_zeros=True)
    function: Function = value
    return function


def _refuse(primals: Any, tangents: Any) -> Any:
    raise NotImplementedError(FIRST_ONLY)


def _call_back(jax: Any, on_rows: Function, arrays: Any, shapes: Any, dtype: np.dtype[Any]) -> Any:
    """Call a function of arrays with rows from one of a single row, or of any number of axes more."""
    ranks = [array.ndim for array in arrays]

    def call(*given: Any) -> Any:
        values = [np.asarray(array) for array in given]
        inner = [array.shape[array.ndim - rank :] for array, rank in zip(values, ranks, strict=True)]
        axes = np.broadcast_shapes(
            *(array.shape[: array.ndim - rank] for array, rank in zip(values, ranks, strict=True))
        )
        rows = [
            np.broadcast_to(array, (*axes, *shape)).reshape(prod(axes), *shape)
            for array, shape in zip(values, inner, strict=True)
        ]
        results = on_rows(*rows)
        return tuple(
            result.reshape(*axes, *shape).astype(dtype, copy=False)
            for result, shape in zip(results, shapes, strict=True)
        )

    def fill(context: Any, buffers: Any, *given: Any) -> None:
        for buffer, result in zip(buffers, call(*given), strict=True):
            np.asarray(buffer)[...] = result

    wanted = tuple(jax.ShapeDtypeStruct(shape, dtype) for shape in shapes)
    in_place = import_module("jax.experimental.buffer_callback").buffer_callback
    # A pure callback waits for another thread of XLA to bring large arrays, on one processor forever.
    return jax.lax.platform_dependent(
        *arrays,
        cpu=in_place(fill, wanted, vmap_method="expand_dims"),
        default=lambda *given: jax.pure_callback(call, wanted, *given, vmap_method="expand_dims"),
    )
