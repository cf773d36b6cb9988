"""A scene's kernels as differentiable functions of PyTorch."""

from __future__ import annotations

from functools import cache, partial
from importlib import import_module
from pathlib import Path
from typing import TYPE_CHECKING, Any

from dq_space_arm_env.interoperability.differentiable_dynamics import (
    FIRST_ONLY,
    NO_FORWARD_MODE,
    DifferentiableDynamics,
)
from dq_space_arm_env.interoperability.differentiable_kernels import DifferentiableKernels
from dq_space_arm_env.kernels import compile_scene
from dq_space_arm_env.scene import Scene

if TYPE_CHECKING:
    from torch import Tensor


class TorchDynamics(DifferentiableDynamics["Tensor"]):
    """A scene's functions of tensors, see `torch_dynamics`."""

    def __init__(
        self, scene: Scene | str | Path, integrator: str | None, dt: float | None, threads: int
    ) -> None:
        """See `torch_dynamics`."""
        self._torch, kernels = _torch(), compile_scene(scene, threads)
        super().__init__(kernels.scene, integrator, dt)
        self._threads, self._kernels = threads, DifferentiableKernels(kernels, self.integrator, self.dt)

    def __reduce__(self) -> tuple[Any, ...]:
        return torch_dynamics, (self.scene, self.integrator, self.dt, self._threads)

    def _checked(self, name: str, array: Any) -> Tensor:
        torch, wanted = self._torch, getattr(self._torch, self._dtype.name)
        # A tensor that shares an array's memory would not tell backward() that the array has changed.
        tensor = array if isinstance(array, torch.Tensor) else torch.tensor(array)
        if tensor.device.type != "cpu":
            raise ValueError(f"{name}: on device {tensor.device}, the kernels run on the CPU: move it there")
        if tensor.dtype != wanted:
            raise ValueError(
                f"{name}: dtype {tensor.dtype}, scene {self.scene.name!r} computes in {wanted}: convert "
                "it, or change the scene's simulation.precision"
            )
        result: Tensor = tensor
        return result

    def _broadcast(self, array: Tensor, shape: tuple[int, ...]) -> Tensor:
        return array.broadcast_to(shape)

    def _run(self, name: str, arrays: list[Any], every: int = 1) -> tuple[Any, ...]:
        operation = self._kernels.rollout(every) if name == "rollout" else getattr(self._kernels, name)
        results: tuple[Any, ...] = _function().apply(operation, *arrays)
        return results


def torch_dynamics(
    scene: Scene | str | Path, integrator: str | None = None, dt: float | None = None, threads: int = 1
) -> TorchDynamics:
    """Make a scene's kernels differentiable functions of PyTorch, on the CPU.

    The gradients are those of the kernels, by reverse mode, also by the parameters, but for those of
    constraints, which are refused. There are first derivatives only: differentiating them again is refused,
    and so is forward mode. `torch.func.vmap` and `jacrev` take all calls that they map in one.

    Args:
        scene: A scene, the name of a shipped one, or a path to a YAML file.
        integrator: Name of the integrator; the scene's by default.
        dt: Time step, s; the scene's by default.
        threads: Most threads that a batch is shared among.

    Returns:
        The functions, of tensors on the CPU of the scene's precision, float64 by default.

    Raises:
        ImportError: If PyTorch is not installed.
        ValueError: If the integrator is unknown, or dt is not a finite number.
    """
    return TorchDynamics(scene, integrator, dt, threads)


def _torch() -> Any:
    try:
        return import_module("torch")
    except ImportError as error:
        raise ImportError("torch_dynamics needs PyTorch: pip install torch") from error


@cache
def _function() -> Any:
    """The function that runs an operation on tensors; its class can only be made where PyTorch is."""
    torch = _torch()
    base: Any = torch.autograd.Function

    def arrays(tensors: Any) -> list[Any]:
        try:
            return [tensor.detach().numpy() for tensor in tensors]
        except RuntimeError as error:  # PyTorch's older vmap, which knows no functions but its own
            raise NotImplementedError(
                "the kernels need the numbers of tensors, which autograd's jacobian(..., vectorize=True) and "
                "grad(..., is_grads_batched=True) do not give: take torch.func.jacrev"
            ) from error

    def on_rows(apply: Any, size: int, dims: Any, tensors: Any) -> Any:
        """Run a function of rows on tensors mapped along some dimensions: theirs and its own as one."""
        spread = [
            each.expand(size, *each.shape) if dim is None else each.movedim(dim, 0)
            for each, dim in zip(tensors, dims, strict=True)
        ]
        results = apply(*(each.flatten(0, 1) for each in spread))
        rows = size, spread[0].shape[1]
        return tuple(each.reshape(*rows, *each.shape[1:]) for each in results), (0,) * len(results)

    class Value(base):  # type: ignore[misc]
        @staticmethod
        def forward(operation: Any, *inputs: Any) -> Any:
            return tuple(map(torch.from_numpy, operation.value(*arrays(inputs))))

        @staticmethod
        def setup_context(ctx: Any, inputs: Any, output: Any) -> None:
            ctx.operation = inputs[0]
            ctx.save_for_backward(*inputs[1:], output[0])

        @staticmethod
        def backward(ctx: Any, *cotangents: Any) -> Any:
            wanted = ctx.needs_input_grad[-1]
            return None, *Products.apply(ctx.operation, wanted, *ctx.saved_tensors, *cotangents)

        @staticmethod
        def jvp(ctx: Any, *tangents: Any) -> Any:
            raise NotImplementedError(NO_FORWARD_MODE)

        @staticmethod
        def vmap(info: Any, dims: Any, operation: Any, *inputs: Any) -> Any:
            return on_rows(partial(Value.apply, operation), info.batch_size, dims[1:], inputs)

    class Products(base):  # type: ignore[misc]
        @staticmethod
        def forward(operation: Any, wanted: bool, *tensors: Any) -> Any:
            given = arrays(tensors)
            n = operation.n_inputs
            products = operation.products(given[:n], given[n], given[n + 1 :], wanted)
            return tuple(map(torch.from_numpy, products))

        @staticmethod
        def setup_context(ctx: Any, inputs: Any, output: Any) -> None:
            """Nothing is kept."""

        @staticmethod
        def backward(ctx: Any, *cotangents: Any) -> Any:
            raise NotImplementedError(FIRST_ONLY)

        jvp = backward

        @staticmethod
        def vmap(info: Any, dims: Any, operation: Any, wanted: bool, *tensors: Any) -> Any:
            return on_rows(partial(Products.apply, operation, wanted), info.batch_size, dims[2:], tensors)

    return Value
