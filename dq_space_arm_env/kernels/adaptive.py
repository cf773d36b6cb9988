"""Adaptive integration of one state over any time, with dense output.

The steps are those of the Dormand-Prince pair, in machine code; their lengths are chosen here, by the
controller of Hairer, Norsett & Wanner, Solving Ordinary Differential Equations I, section II.4 (2nd ed.,
1993), with the stabilization of Hairer & Wanner II, section IV.2.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass
from numbers import Real
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from dq_space_arm_env.common.real_arrays import real_array
from dq_space_arm_env.kernels.bound import KernelCall
from dq_space_arm_env.kernels.library import KernelLibrary
from dq_space_arm_env.scene.parameters import CATCH
from dq_space_arm_env.scene.start import unit_quaternions

Array = NDArray[Any]

SAFETY = 0.9
STABILIZATION = 0.04
EXPONENT = 0.2 - 0.75 * STABILIZATION
SMALLEST_FACTOR, LARGEST_FACTOR = 0.2, 10.0
FINER = 1 / 32
"""Tolerances of the companion of `global_error`, relative to its own."""
STRETCH = 1.01
CATCH_NOW = f"{CATCH}.now"


class MotionCurve:
    """The state at any time: per step a polynomial of degree 4 in tangent coordinates, of order 4."""

    def __init__(self, kernels: KernelLibrary, times: Array, states: Array, coefficients: Array) -> None:
        """Take m steps: their ends, states there, and coefficients of theta, ..., theta^4, (m, 4, n_t)."""
        self._kernels, self._times, self._states, self._coefficients = kernels, times, states, coefficients

    def __call__(self, t: ArrayLike) -> Array:
        """Evaluate the motion.

        Args:
            t: Times within the motion, a number or shape (k,), s.

        Returns:
            States, shape (n_x,) or (k, n_x), units of `layout.state`.

        Raises:
            ValueError: If a time lies outside the motion.
        """
        end = self._times[-1]
        times = _times_within("t", t, end)
        sign = -1.0 if end < 0.0 else 1.0
        step = np.searchsorted(sign * self._times[1:-1], sign * times, side="right")
        begin = self._times[step]
        theta = ((times - begin) / (self._times[step + 1] - begin))[..., None]
        change = np.zeros(())
        for power in reversed(range(4)):
            change = theta * (self._coefficients[step, power] + change)
        x = self._kernels.call("retract", x=self._states[step], dx=change)[0]
        for where in unit_quaternions(self._kernels.scene):
            x[..., where] /= np.linalg.norm(x[..., where], axis=-1, keepdims=True)
        return x

    def difference(self, reference: Array, x: Array) -> Array:
        """Tangent coordinates of states seen from others, shape (k, n_t)."""
        return self._kernels.call("difference", x_reference=reference, x=x)[0]


@dataclass(frozen=True, eq=False)
class IntegratedMotion:
    """Result of `Kernels.integrate`."""

    t: Array  # times asked for, or ends of the steps, the start first, shape (k,), s
    x: Array  # states at these times, shape (k, n_x), units of `layout.state`
    steps: int  # taken
    rejected: int  # steps whose error was too large
    sol: MotionCurve  # the state at any time
    _finer: Callable[[Array], IntegratedMotion]  # the motion at given times, with smaller tolerances

    def global_error(self) -> Array:
        """Estimate the error of the states, by a companion with tolerances 32 times smaller.

        Its `rtol` is at least the smallest of the precision.

        Returns:
            Tangent coordinates of the states seen from those of the companion, shape (k, n_t), rad, m, rad/s
            and m/s. The companion takes about twice the steps.

        Raises:
            ValueError: If `rtol` is so small that the precision has none that is 8 times smaller.
            RuntimeError: If the companion cannot be followed to its end.
        """
        return self.sol.difference(self._finer(self.t).x, self.x)


class _Stepper:
    """The current state and the length of the next step."""

    def __init__(self, kernels: KernelLibrary, x: Array, tolerances: Array, step: float) -> None:
        self.x, self.step, self.error = x.copy(), step, 1e-4
        self.u, self._h = np.zeros(kernels.n_u, kernels.dtype), np.zeros(1, kernels.dtype)
        self.p = np.zeros(kernels.n_p, kernels.dtype)
        self.x_next, self.dense = np.zeros_like(x), np.zeros((4, kernels.n_t), kernels.dtype)
        self._error = np.zeros(1, kernels.dtype)
        arrays = {"x": self.x, "parameters": self.p, "u": self.u, "h": self._h, "tolerances": tolerances}
        arrays |= {"x_next": self.x_next, "error": self._error, "dense": self.dense}
        self._run = KernelCall(kernels.kernel("measured_step", lanes=1), arrays).of_one_row()

    def attempt(self, h: float) -> bool:
        """Try a step and choose the length of the next; returns whether the error is tolerable."""
        self._h[0] = h
        self._run()
        error = float(self._error[0])
        if error <= 1.0 and np.isfinite(self.x_next).all():
            factor = SAFETY * max(error, 1e-10) ** -EXPONENT * self.error**STABILIZATION
            self.step = abs(h) * min(max(factor, SMALLEST_FACTOR), LARGEST_FACTOR)
            self.error = max(error, 1e-4)
            return True
        factor = SAFETY * error**-EXPONENT if np.isfinite(error) else SMALLEST_FACTOR
        self.step = abs(h) * min(max(factor, SMALLEST_FACTOR), SAFETY)
        return False


def integrate(
    kernels: KernelLibrary,
    x: ArrayLike,
    u: ArrayLike,
    duration: float,
    *,
    rtol: float,
    atol: float,
    times: ArrayLike | None = None,
    max_steps: int = 100_000,
    p: ArrayLike | None = None,
) -> IntegratedMotion:
    """See `Kernels.integrate`."""
    start, held = _checked(kernels, x, u)
    parameters = kernels.parameter_rows(p, len(held))
    _check_smooth(kernels, parameters)
    _check_accuracy(kernels, duration, rtol, atol, max_steps)
    wanted = None if times is None else np.atleast_1d(_times_within("times", times, duration))
    tolerances = np.array([rtol, atol], kernels.dtype)
    stepper = _Stepper(kernels, start, tolerances, kernels.scene.simulation.dt)
    ends, states = [0.0], [start]
    coefficients: list[Array] = []
    rejected = 0
    for begin, end, control, given in _intervals(held, parameters, duration):
        stepper.u[:], stepper.p[:] = control, given
        t = begin
        while t != end:
            # Stretch the last step rather than leave a sliver.
            last = STRETCH * stepper.step >= abs(end - t)
            h = end - t if last else np.copysign(stepper.step, duration)
            if abs(h) < 16.0 * np.finfo(float).eps * abs(duration):
                raise RuntimeError(f"the motion cannot be followed beyond t = {t} s: no step is short enough")
            if len(coefficients) + rejected >= max_steps:
                raise RuntimeError(
                    f"the motion was followed to t = {t} s only: max_steps = {max_steps} were tried"
                )
            if not stepper.attempt(h):
                rejected += 1
                continue
            t = end if last else t + h
            stepper.x[:] = stepper.x_next
            ends.append(t)
            states.append(stepper.x_next.copy())
            coefficients.append(stepper.dense.copy())
    curve = MotionCurve(kernels, np.array(ends), np.array(states), np.array(coefficients))

    def finer(wanted: Array) -> IntegratedMotion:
        least = _smallest_rtol(kernels)
        if rtol < 8.0 * least:
            raise ValueError(f"rtol: {rtol}, should be at least {8.0 * least:.1e} to estimate the error")
        return integrate(
            kernels,
            x,
            u,
            duration,
            rtol=max(FINER * rtol, least),
            atol=FINER * atol,
            times=wanted,
            max_steps=max_steps,
            p=p,
        )

    if wanted is None:
        return IntegratedMotion(np.array(ends), np.array(states), len(coefficients), rejected, curve, finer)
    return IntegratedMotion(wanted, curve(wanted), len(coefficients), rejected, curve, finer)


def _times_within(name: str, given: ArrayLike, end: float) -> Array:
    """Times of a motion that ends at a time, shape () or (k,); refuses others, by the argument's name."""
    times = real_array(name, given, np.float64)
    if times.ndim > 1:
        raise ValueError(f"{name}: shape {times.shape}, should be a number or (k,)")
    within = (times >= min(0.0, end)) & (times <= max(0.0, end))
    if not within.all():
        raise ValueError(
            f"{name}: {times[~within].flat[0]} is not between 0 and {end} s, where the motion is known"
        )
    return times


def _intervals(
    held: Array, parameters: Array, duration: float
) -> Iterator[tuple[float, float, Array, Array]]:
    """Begin, end, input and parameters of each interval in which these are constant."""
    marks = np.linspace(0.0, duration, len(held) + 1).tolist()
    yield from zip(marks[:-1], marks[1:], held, parameters, strict=True)


def _checked(kernels: KernelLibrary, x: ArrayLike, u: ArrayLike) -> tuple[Array, Array]:
    """The start, shape (n_x,), and the inputs of all intervals, shape (N, n_u)."""
    start, held = real_array("x", x).astype(kernels.dtype), real_array("u", u).astype(kernels.dtype)
    if start.shape != (kernels.n_x,):
        raise ValueError(f"x: shape {start.shape}, should be ({kernels.n_x},)")
    if held.ndim == 1:
        held = held[None]
    if held.ndim != 2 or held.shape[1] != kernels.n_u or not len(held):
        raise ValueError(f"u: shape {np.shape(u)}, should be ({kernels.n_u},) or (N, {kernels.n_u})")
    for name, array in (("x", start), ("u", held)):
        if not np.isfinite(array).all():
            raise ValueError(f"{name}: {array[~np.isfinite(array)][0]} is not a finite number")
    return start, held


def _check_smooth(kernels: KernelLibrary, parameters: Array) -> None:
    """Refuse what happens from time step to time step, where steps have any length."""
    if chains := kernels.layout.chains:
        raise ValueError(
            f"scene {kernels.scene.name!r}: {chains[0].name} delays or lags by time steps, which adaptive "
            "steps do not follow: use simulate"
        )
    now = kernels.parameters.names.index(CATCH_NOW) if CATCH_NOW in kernels.parameters.names else None
    if now is not None and parameters[:, now].any():
        part = int(parameters[:, now].argmax())
        raise ValueError(f"p: a payload is caught at the end of part {part}, should be 0: use simulate")


def _smallest_rtol(kernels: KernelLibrary) -> float:
    """The smallest relative tolerance of a precision."""
    return 4.0 * float(np.finfo(kernels.dtype).eps)


def _check_accuracy(
    kernels: KernelLibrary, duration: float, rtol: float, atol: float, max_steps: int
) -> None:
    """Refuse a time, tolerances or a number of steps with which no motion can be followed."""
    for name, value in (("rtol", rtol), ("atol", atol)):
        if not (_is_number(value) and np.isfinite(value) and value > 0.0):
            raise ValueError(f"{name}: {value!r}, should be a positive number")
    if not (_is_number(duration) and np.isfinite(duration)) or duration == 0.0:
        raise ValueError(f"duration: {duration!r}, should be a finite time in s other than zero")
    if rtol < (least := _smallest_rtol(kernels)):
        raise ValueError(f"rtol: {rtol}, should be at least {least:.1e} in {kernels.dtype}")
    if not (_is_number(max_steps) and max_steps >= 1):
        raise ValueError(f"max_steps: {max_steps!r}, should be a number of at least 1")


def _is_number(value: object) -> bool:
    return isinstance(value, Real) and not isinstance(value, bool)
