"""Episodes flown by a network, and the exact gradient of their cost by its weights.

An episode is divided into K decisions, at t_0 = 0, ..., t_K = T, instead of its N time steps, which are many
more. Between two times the input is constant: what the network would give at their middle, extrapolated from
its last two outputs, or, where actions act late, interpolated between earlier ones. The cost is summed by the
trapezoidal rule. Both err with the square of the steps, so that a policy flies at every time step as it was
trained.
"""

from __future__ import annotations

import math
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from agents.gradients.disturbed_flights import Arrival, Met, arrivals
from agents.gradients.layers import Layers, SingleArray
from agents.gradients.penalties import Penalties
from dq_space_arm_env import Scene, compile_scene
from dq_space_arm_env.kernels.bound import KernelCall
from dq_space_arm_env.kernels.library import PENALIZED
from dq_space_arm_env.scene.constraint_rows import penalized_rows
from dq_space_arm_env.scene.parameters import CONTROL_UNITS
from experts.problems.arm_problem import misses

Array = NDArray[Any]

DIVERGED = 20.0  # times the median cost; episodes beyond it do not count
STEEP = 10.0  # times the slope that usual episodes do not exceed; slopes beyond it are shortened
STEEP_PENALTIES = 100.0  # likewise where few episodes may violate constraints
USUAL = 0.5  # share of the usual episodes
USUAL_DISTURBED = 0.9  # where a push just before the end is as usual as none, and a thousand times as steep


def decision_times(scene: Scene, decisions: int, crowding: float) -> Array:
    """Times of decisions and end, s, (K + 1,); closer at both ends by a share of a cosine's spacing."""
    even = np.linspace(0.0, 1.0, decisions + 1)
    ends = 0.5 * (1.0 - np.cos(np.pi * even))
    return scene.simulation.steps * scene.simulation.dt * (even + crowding * (ends - even))


class Episodes:
    """B episodes of K decisions: their arrays, and kernels bound to these.

    Attributes:
        parameters: Parameters of each decision and of the end, shape (K + 1, B, n_p).
        units: Inputs of an output of 1, fractions of the limits, shape (n_u,).
        penalties: Those of the scene's constraints in the cost; None without.
    """

    def __init__(
        self, scene: Scene, layers: Layers, times: Array, units: ArrayLike, *, noisy: bool = False
    ) -> None:
        """Prepare episodes whose network gives its outputs in some units, alike or not for all inputs."""
        self._kernels = kernels = compile_scene(scene)
        self._layers, (decisions, count, n_obs) = layers, layers.values[0].shape
        dtype, layout = kernels.dtype, kernels.layout
        self.units, self._efforts = np.full(kernels.n_u, units, np.float64), layout.control_weight
        actuators = (getattr(layout.control, name) for name in CONTROL_UNITS)
        self._actuators = [entries for entries in actuators if entries.start < entries.stop]
        steps, dt = np.diff(times), scene.simulation.dt
        self._weights = 0.5 * (np.append(0.0, steps) + np.append(steps, 0.0)) / dt
        # The sum over time steps has the first one's state whole, and the last one's not at all.
        self._weights += 0.5 * (np.arange(decisions + 1) == 0) - 0.5 * (np.arange(decisions + 1) == decisions)
        self._held = steps / dt - self._weights[:-1]  # of the input's cost, which is not of a point in time
        self.parameters = np.zeros((decisions + 1, count, kernels.n_p), dtype)
        self.penalties: Penalties | None = None
        if penalized_rows(scene):
            self.penalties = Penalties(kernels, decisions, count, self._weights[-1])
        self._states = np.zeros((decisions + 1, count, kernels.n_x), dtype)
        self._measured = np.zeros_like(self._states) if noisy else self._states
        self._observations = np.zeros((decisions, count, n_obs), dtype)
        self._wanted = np.zeros((decisions, count, kernels.n_u), dtype)
        self._inputs = np.zeros((decisions + 1, count, kernels.n_u), dtype)
        self._costs = np.zeros((decisions + 1, count, 1), dtype)
        self._terminal, self._emphasis = np.zeros((2, count, 1), dtype)
        self._cotangents = np.zeros((decisions + 1, count, kernels.n_t), dtype)
        self._by_input = np.zeros((count, kernels.n_u), dtype)
        self._by_output = np.zeros((decisions, count, kernels.n_u))
        self._by_observation = np.zeros((count, n_obs), dtype)
        self._by_state = np.zeros((count, kernels.n_t), dtype)
        self._cost_weights = np.repeat(self._weights[:, None, None], count, axis=1).astype(dtype)
        self._calls = [self._bind(index, times) for index in range(decisions)]
        self._end = self._bind_end()
        self._times, self._met, self._usual = times, Met(), USUAL
        self._arrivals: list[Arrival] = arrivals(times)

    def _bind(self, k: int, times: Array) -> dict[str, KernelCall]:
        """The calls of a decision."""
        count, dtype = self._states.shape[1], self._kernels.dtype
        given = {
            "x": self._states[k],
            "u": self._inputs[k],
            "h": np.array([times[k + 1] - times[k]], dtype),
            "parameters": self.parameters[k],
            "time_left": np.full((count, 1), times[-1] - times[k], dtype),
        }
        after = {"x_next": self._states[k + 1], "cost": self._costs[k]}
        seen = {"x": self._measured[k], "observation": self._observations[k]}
        seen |= {"errors": np.zeros((count, 2), dtype)}
        back = {"v": self._cotangents[k + 1], "v_cost": self._cost_weights[k]}
        back |= {"x_cotangent": self._cotangents[k], "u_cotangent": self._by_input}
        by_observation = {"x": self._measured[k], "v": self._by_observation, "x_cotangent": self._by_state}
        arrays = {
            "observation": seen,
            "step_with_cost": after,
            "step_with_cost_vjp": back,
            "observation_vjp": by_observation,
        }
        return {name: self._call(name, k, given | others) for name, others in arrays.items()}

    def _call(self, name: str, k: int, arrays: dict[str, Array]) -> KernelCall:
        """A kernel on arrays; slopes of costs have those of the penalties."""
        if self.penalties is not None and name in ("step_with_cost_vjp", "emphasized_terminal_cost_vjp"):
            name, arrays = PENALIZED + name, {**arrays, "parameters": self.penalties.parameters[k]}
        return KernelCall(self._kernels.kernel(name), arrays)

    def _bind_end(self) -> dict[str, KernelCall]:
        """The calls at the end, where the inputs are zero."""
        one = np.ones_like(self._terminal)
        given = {"x": self._states[-1], "u": self._inputs[-1], "parameters": self.parameters[-1]}
        given |= {"emphasis": self._emphasis}
        arrays = {
            "cost": {"cost": self._costs[-1]},
            "emphasized_terminal_cost": {"cost": self._terminal},
            "cost_vjp": {
                "v": self._cost_weights[-1],
                "x_cotangent": self._by_state,
                "u_cotangent": self._by_input,
            },
            "emphasized_terminal_cost_vjp": {"v": one, "x_cotangent": self._cotangents[-1]},
        }
        return {name: self._call(name, -1, given | others) for name, others in arrays.items()}

    def meet(self, met: Met) -> None:
        """Let delays, jumps and noise disturb the next flights."""
        self._met, self._arrivals = met, arrivals(self._times, met.delays)
        self._usual = USUAL_DISTURBED

    def fly(self, starts: Array, mean: Array, scale: Array, emphasis: float) -> Array:
        """Fly from states (B, n_x); observations are normalized as `(o - mean) * scale`.

        Returns the costs, (B,), with the terminal pose's multiplied by the emphasis.
        """
        self._states[0], self._emphasis[:] = starts, emphasis
        if self.penalties is not None:
            self.penalties.prepare(self.parameters, emphasis)
        rows, layout = len(starts), self._kernels.layout
        units, high = self.units * layout.control_limit, layout.limits_with(self.parameters[0])
        self._low, self._high = layout.lower_limits(high), high
        for k, calls in enumerate(self._calls):
            self._disturb(k)
            calls["observation"](rows)
            with np.errstate(over="ignore", invalid="ignore"):  # of episodes that diverge
                self._layers.values[0][k] = (self._observations[k] - mean) * scale
                self._layers.forward(k)
            arrival = self._arrivals[k]
            np.multiply(arrival.of(self._layers.values[-1]), units * arrival.arrived, out=self._wanted[k])
            np.clip(self._wanted[k], self._low, self._high, out=self._inputs[k])
            calls["step_with_cost"](rows)
        self._end["cost"](rows)
        self._end["emphasized_terminal_cost"](rows)
        efforts = np.square(self._inputs[:-1]) @ self._efforts
        total = self._weights @ self._costs[..., 0] + self._held @ efforts + self._terminal[:, 0]
        return np.asarray(total)

    def _disturb(self, k: int) -> None:
        """Push the bases at the beginning of a decision, and measure the states with noise."""
        jumps, noise = self._met.jumps, self._met.noise
        if jumps is not None:
            struck = jumps[k].any(axis=1)
            self._states[k][struck] = self._kernels.retract(self._states[k][struck], jumps[k][struck])
        if noise is not None:
            self._measured[k] = self._kernels.retract(self._states[k], noise[k])
        elif self._measured is not self._states:
            self._measured[k] = self._states[k]

    def gradient(
        self, starts: Array, mean: Array, scale: Array, emphasis: float
    ) -> tuple[list[SingleArray], Array]:
        """Exact gradient of the mean cost by the network's weights, and the costs of `fly`.

        Episodes that diverge, or cost many times the median, do not count; where the slope of one grows to
        many times the median, it is shortened, and the gradient is no longer exact.
        """
        costs = self.fly(starts, mean, scale, emphasis)
        finite = np.isfinite(costs)
        lost = ~finite | (costs > DIVERGED * (np.median(costs[finite]) if finite.any() else 0.0))
        rows, kept = len(starts), max(1, len(starts) - int(lost.sum()))
        for values in self._layers.values:
            values[:, lost] = 0.0
        self._end["emphasized_terminal_cost_vjp"](rows)
        self._end["cost_vjp"](rows)
        self._cotangents[-1] += self._by_state
        self._cotangents[-1][lost] = 0.0
        self._by_output[:] = 0.0
        by_unit = self.units * self._kernels.layout.control_limit / kept
        for k in range(len(self._calls) - 1, -1, -1):
            self._calls[k]["step_with_cost_vjp"](rows)
            slope = self._by_input + 2.0 * self._held[k] * self._efforts * self._inputs[k]
            # Beyond a limit only what leads back counts.
            wanted = self._wanted[k]
            slope[((wanted > self._high) & (slope < 0.0)) | ((wanted < self._low) & (slope > 0.0))] = 0.0
            slope[lost] = 0.0
            self._arrivals[k].back(slope, self._by_output)
            back = self._layers.backward(k, self._by_output[k] * by_unit)
            np.multiply(back, scale * kept, out=self._by_observation)
            self._calls[k]["observation_vjp"](rows)
            self._cotangents[k] += self._by_state
            self._cotangents[k][lost] = 0.0
            steep = STEEP if self.penalties is None else STEEP_PENALTIES
            _shorten(self._cotangents[k], steep, self._usual)
        return self._layers.gradient(), costs

    def price_violations(self, cost: float) -> None:
        """Let penalties follow what the episodes flown last violate, and the cost of recent ones."""
        if self.penalties is not None:
            self.penalties.cost = cost
            self.penalties.follow(self._states, self._inputs, self.parameters)

    def misses(self) -> Array:
        """Largest error of the tip at the end of each episode flown last, relative to its tolerance, (B,)."""
        with np.errstate(invalid="ignore"):  # of episodes that diverged
            return misses(self._kernels, self._states[-1], self.parameters[-1])

    def sizes(self) -> Array:
        """Root mean squares of the inputs flown last, by actuator, fractions of the limits, (n_u,)."""
        squares = np.square(self._inputs[:-1]).mean(axis=0)
        squares = squares[np.isfinite(squares).all(axis=1)].mean(axis=0)
        squares /= np.square(self._kernels.layout.control_limit)
        for entries in self._actuators:
            squares[entries] = squares[entries].mean()
        return np.asarray(np.sqrt(squares))


def _shorten(slopes: Array, steep: float, share: float) -> None:
    """Shorten rows many times longer than a share of them, as chaotic motions have; drop those not finite."""
    sizes = np.abs(slopes).max(axis=1)
    finite = np.isfinite(sizes)
    ordered, count = np.sort(sizes), int(np.count_nonzero(finite))  # finite ones first
    # A quantile; `numpy.quantile` takes several times as long for a few numbers.
    place = share * (count - 1)
    most = steep * 0.5 * (ordered[math.floor(place)] + ordered[math.ceil(place)]) if count else 0.0
    long = finite & (sizes > most)
    if long.any():
        slopes[long] *= (most / sizes[long])[:, None]
    if count < len(sizes):
        slopes[~finite] = 0.0
