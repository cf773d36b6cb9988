"""A scene's kernels as differentiable functions of PyTorch."""

from __future__ import annotations

from functools import cache
from importlib import import_module
from pathlib import Path
from typing import TYPE_CHECKING, Any

from dq_space_arm_env.interoperability.differentiable_dynamics import FIRST_ONLY, DifferentiableDynamics
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
        self._kernels = DifferentiableKernels(kernels, self.integrator, self.dt)

    def _checked(self, name: str, array: Any) -> Tensor:
        tensor, wanted = self._torch.as_tensor(array), getattr(self._torch, self._dtype.name)
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
    constraints, which are refused. There are first derivatives only: differentiating them again is refused.

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
        return [tensor.detach().numpy() for tensor in tensors]

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

    return Value
