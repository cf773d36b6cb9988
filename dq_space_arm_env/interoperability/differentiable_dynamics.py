"""What scenes in PyTorch and in JAX have in common: their functions, and the shapes these take."""

from __future__ import annotations

from abc import ABC, abstractmethod
from typing import Any, Generic, TypeVar

import numpy as np

from dq_space_arm_env.interoperability.exporting import integrator_name
from dq_space_arm_env.kernels import compile_scene
from dq_space_arm_env.scene import Scene, StateLayout

ArrayT = TypeVar("ArrayT")

FIRST_ONLY = "the kernels have first derivatives only: for second ones take jax_dynamics without kernels"
"""Refusal of derivatives of the kernels' products."""
NO_FORWARD_MODE = (
    "the kernels have no derivatives in forward mode: take reverse mode, such as jacrev, or jax_dynamics "
    "without kernels"
)
"""Refusal of tangents."""


class DifferentiableDynamics(ABC, Generic[ArrayT]):
    """A scene's functions in another library, see `torch_dynamics` and `jax_dynamics`.

    Of one stage they take its parameters p: where a target moves or phases change, its row of
    `Kernels.stage_parameters`, by default the first. A step whose row says that a payload is caught ends
    with the impact. Limits of inputs that phases change are in the row, see `StateLayout.limits_with`.

    Gradients by a state are by its numbers, (n_x,), and exact along all directions in which the state can
    move: chained steps have exact gradients. Across them, where |q_r| = 1, q_r . q_d = 0 or a joint's
    |q| = 1 would break, a derivative has no meaning.

    Attributes:
        scene: The scene.
        layout: Names, units and places of the entries of states and inputs; the inputs are not clipped to
            their limits, `layout.control_limit`.
        integrator: Name of the integrator.
        dt: Time step, s.
    """

    def __init__(self, scene: Scene, integrator: str | None, dt: float | None) -> None:
        self.scene, self.layout = scene, StateLayout.of(scene)
        self.integrator = integrator_name(scene, integrator)
        self.dt = scene.simulation.dt if dt is None else float(dt)
        if not np.isfinite(self.dt):
            raise ValueError(f"dt: {self.dt} is not a finite time step in s")

    def step(self, x: ArrayT, u: ArrayT, p: ArrayT | None = None) -> ArrayT:
        """Advance states by one time step under constant inputs.

        Args:
            x: States, shape (n_x,) or (B, n_x), units of `layout.state`.
            u: Inputs, shape (n_u,) or (B, n_u), units of `layout.control`.
            p: Parameters, shape (n_p,) or (B, n_p); nominal ones by default.

        Returns:
            States, shape (n_x,) or (B, n_x).

        Raises:
            ValueError: If a shape, element type or device does not fit.
        """
        return self._one("step", x, u, p)

    def cost(self, x: ArrayT, u: ArrayT, p: ArrayT | None = None) -> ArrayT:
        """Stage cost, without a factor dt.

        Args:
            x: States, shape (n_x,) or (B, n_x).
            u: Inputs, shape (n_u,) or (B, n_u).
            p: Parameters, shape (n_p,) or (B, n_p); nominal ones by default.

        Returns:
            Cost, dimensionless, shape () or (B,).

        Raises:
            ValueError: As for `step`.
        """
        return self._one("cost", x, u, p)

    def terminal_cost(self, x: ArrayT, p: ArrayT | None = None) -> ArrayT:
        """Terminal cost.

        Args:
            x: States, shape (n_x,) or (B, n_x).
            p: Parameters, shape (n_p,) or (B, n_p); nominal ones by default.

        Returns:
            Cost, dimensionless, shape () or (B,).

        Raises:
            ValueError: As for `step`.
        """
        return self._one("terminal_cost", x, None, p)

    def constraints(self, x: ArrayT, u: ArrayT, p: ArrayT | None = None) -> ArrayT:
        """Residuals c of the rows along the path, which hold where c <= 0.

        Args:
            x: States, shape (n_x,) or (B, n_x).
            u: Inputs, shape (n_u,) or (B, n_u).
            p: Parameters, shape (n_p,) or (B, n_p); nominal ones by default.

        Returns:
            One entry per row of `dq_space_arm_env.scene.path_rows(scene)`, which has names, units and
            tolerances, shape (n_c,) or (B, n_c); without the margins that the expert keeps.

        Raises:
            ValueError: As for `step`.
        """
        return self._one("constraints", x, u, p)

    def terminal_constraints(self, x: ArrayT, p: ArrayT | None = None) -> ArrayT:
        """Residuals of the rows at the end: those of the path without input, of success, and what is zero.

        Args:
            x: States, shape (n_x,) or (B, n_x).
            p: Parameters of the end, shape (n_p,) or (B, n_p); nominal ones by default.

        Returns:
            One entry per row of `dq_space_arm_env.scene.terminal_rows(scene)`, shape (n_g,) or (B, n_g).

        Raises:
            ValueError: As for `step`.
        """
        return self._one("terminal_constraints", x, None, p)

    def rollout(self, x: ArrayT, u: ArrayT, p: ArrayT | None = None, every: int = 1) -> tuple[ArrayT, ArrayT]:
        """Take N steps in a row, and keep their states and costs.

        Its gradient needs the states that it returns, and nothing else: with `every` above 1 the steps
        between them are taken again, for a share of 1 / `every` of the memory. The tip is taken to hold what
        it catches, wherever it is: an episode's catch may miss.

        Args:
            x: States at the start, shape (n_x,) or (B, n_x), units of `layout.state`.
            u: Inputs, shape (N, n_u) or (N, B, n_u), units of `layout.control`.
            p: Parameters, shape (n_p,) or (B, n_p), or (N + 1, B, n_p) for the steps and the end, where B may
                be 1; nominal ones by default, where a target moves or phases change those of each stage.
            every: Number of steps between the states returned; N must be a multiple.

        Returns:
            States, the start first, shape (N / every + 1, n_x) or (N / every + 1, B, n_x), and costs,
            dimensionless: of each step and last the terminal one, shape (N + 1,) or (N + 1, B); their sum is
            the cost of the maneuver.

        Raises:
            ValueError: As for `step`, if N is not a multiple of every, or if the stages of p by default are
                other ones: N exceeds the scene's steps, or dt is not the scene's.
        """
        given = {"x": self._checked("x", x), "u": self._checked("u", u)}
        self._require(given, {"x": (1, 2), "u": (2, 3)})
        given["p"] = self._parameters(self._stages(len(given["u"])) if p is None else p)
        self._require({"p": given["p"]}, {"p": (1, 2, 3)})
        steps = len(given["u"])
        if every < 1 or steps < 1 or steps % every:
            raise ValueError(f"every: {every}, the {steps} steps of u should be one or more times as many")
        if given["p"].ndim == 3 and len(given["p"]) != steps + 1:
            raise ValueError(
                f"p: {len(given['p'])} rows for {steps} steps and the end, should be {steps + 1}"
            )
        batched = given["x"].ndim == 2 or given["u"].ndim == 3 or (p is not None and given["p"].ndim > 1)
        inputs, fixed = given["u"], given["p"]
        inputs = inputs.swapaxes(0, 1) if inputs.ndim == 3 else inputs[None]
        fixed = fixed.swapaxes(0, 1) if fixed.ndim == 3 else _in_rows(fixed)[:, None]
        rows = {"x": _in_rows(given["x"]), "u": inputs, "p": fixed}
        times = {"x": (), "u": (steps,), "p": (steps + 1,)}
        states, costs = self._run("rollout", self._spread(rows, times), every)
        return (states.swapaxes(0, 1), costs.swapaxes(0, 1)) if batched else (states[0], costs[0])

    def _one(self, name: str, x: ArrayT, u: ArrayT | None, p: ArrayT | None) -> ArrayT:
        """A function of one point in time."""
        given = {"x": self._checked("x", x), "u": None if u is None else self._checked("u", u)}
        given = {key: array for key, array in given.items() if array is not None}
        given["p"] = self._parameters(p)
        self._require(given, dict.fromkeys(given, (1, 2)))
        rows = {key: _in_rows(array) for key, array in given.items()}
        result: ArrayT = self._run(name, self._spread(rows, dict.fromkeys(rows, ())))[0]
        return result if any(array.ndim == 2 for array in given.values()) else result[0]  # type: ignore[index]

    def _require(self, given: dict[str, Any], ranks: dict[str, tuple[int, ...]]) -> None:
        sizes = {"x": self.layout.n_x, "u": self.layout.n_u, "p": self.layout.n_p}
        for name, array in given.items():
            if array.ndim not in ranks[name] or array.shape[-1] != sizes[name]:
                in_time = name == "u" and ranks[name] != (1, 2)
                axes = ("", "N, ", "N, B, ") if in_time else ("", "B, ", "N + 1, B, ")
                shapes = " or ".join(f"({axes[rank - 1]}{sizes[name]})" for rank in ranks[name])
                raise ValueError(f"{name}: shape {tuple(array.shape)}, should be {shapes}")

    def _spread(self, rows: dict[str, Any], times: dict[str, tuple[int, ...]]) -> list[Any]:
        """Repeat single rows, and parameters in time, up to the shapes of all."""
        counts = {name: len(array) for name, array in rows.items()}
        several = {count for count in counts.values() if count != 1}
        if len(several) > 1:
            raise ValueError(f"batches differ in length: {counts}")
        count = several.pop() if several else 1
        return [
            self._broadcast(array, (count, *times[name], array.shape[-1])) for name, array in rows.items()
        ]

    def _stages(self, steps: int) -> Any:
        """Nominal parameters of the stages, (N + 1, 1, n_p); None where they are all the same."""
        entries, simulation = self.layout.parameters, self.scene.simulation
        if not (entries.moving or entries.staged):
            return None
        if steps > simulation.steps or self.dt != simulation.dt:
            raise ValueError(
                f"p: the stages of scene {self.scene.name!r} are {simulation.steps} of {simulation.dt} s, "
                f"and {steps} of {self.dt} s are asked for: give the parameters of each, (N + 1, B, n_p)"
            )
        return compile_scene(self.scene).stage_parameters()[: steps + 1, None]

    def _parameters(self, p: ArrayT | None) -> Any:
        if p is None:
            return self._checked("p", np.array(self.layout.parameters.nominal, self._dtype))
        return self._checked("p", p)

    @property
    def _dtype(self) -> np.dtype[Any]:
        return np.dtype(self.scene.simulation.precision)

    @abstractmethod
    def _checked(self, name: str, array: Any) -> Any:
        """The library's array; ValueError for the wrong element type or device."""

    @abstractmethod
    def _broadcast(self, array: Any, shape: tuple[int, ...]) -> Any:
        """The library's `broadcast_to`."""

    @abstractmethod
    def _run(self, name: str, arrays: list[Any], every: int = 1) -> tuple[Any, ...]:
        """Run a function on arrays with rows first, (B, ...)."""


def _in_rows(array: Any) -> Any:
    return array if array.ndim == 2 else array[None]
