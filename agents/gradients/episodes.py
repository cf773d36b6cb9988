"""Episodes flown by a network, and the exact gradient of their cost by its weights.

An episode is divided into K decisions, at t_0 = 0, ..., t_K = T, instead of its N time steps, which are many
more. Between two times the input is constant: what the network would give half a time step before their
middle, since a flight holds each action for a time step; extrapolated from its last two outputs, or, where
actions act late, interpolated between earlier ones. The cost is summed by the trapezoidal rule. Both err with
the square of the steps, so that a policy flies at every time step as it was trained. Where the integration of
a decision errs, it is divided into substeps; where phases change parameters, a decision ends.
"""

from __future__ import annotations

import math
from itertools import pairwise
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from agents.gradients.disturbed_flights import Arrival, Met, arrivals
from agents.gradients.layers import Layers, SingleArray
from agents.gradients.penalties import Penalties
from dq_space_arm_env import Scene, compile_scene
from dq_space_arm_env.kernels.bound import KernelCall
from dq_space_arm_env.kernels.library import PENALIZED
from dq_space_arm_env.scene.parameters import CONTROL_UNITS
from experts.problems.arm_problem import misses

Array = NDArray[Any]

DIVERGED = 20.0  # times the median cost; episodes beyond it do not count
STEEP = 10.0  # times the slope that usual episodes do not exceed; slopes beyond it are shortened
STEEP_PENALTIES = 40.0  # likewise where `Penalties.are_strict`
ROUGH = 0.003  # least penalty of outputs that alternate by their limits, relative to the cost of an episode
ROUGHEST = 10.0  # most
ROUGHER = 1.1  # factor of its rise in an update in which inputs alternate
SMOOTHER = 0.99  # and of its fall in others
ALTERNATING = 0.01  # mean of how far an input turns back after a decision, of its limit, that counts as such
USUAL = 0.5  # share of the usual episodes
USUAL_DISTURBED = 0.9  # where a push just before the end is as usual as none, and a thousand times as steep


def decision_times(scene: Scene, decisions: int, crowding: float) -> Array:
    """Times of decisions and end, s, (K + 1,); closer at both ends by a share of a cosine's spacing.

    Every phase has its share of them; before another one its last decision is a single time step, as the sum
    of costs has it.
    """
    dt, steps = scene.simulation.dt, scene.simulation.steps
    starts = scene.staged.starts if scene.phases else (0,)
    times = [np.zeros(1)]
    for start, end in pairwise((*starts, steps)):
        begun, due = sum(map(len, times)) - 1, max(1, round(decisions * end / steps))
        count, single = max(1, due - begun), end < steps
        even = np.linspace(0.0, 1.0, count - single + 1)
        ends = 0.5 * (1.0 - np.cos(np.pi * even))
        spread = (end - single - start) * dt * (even + crowding * (ends - even))
        times += [start * dt + spread[1:], *([np.array([end * dt])] if single else [])]
    return np.concatenate(times)


def first_decisions(scene: Scene, times: Array) -> list[int]:
    """Index of the first decision of each phase, of all at given times; [0] without phases."""
    starts = scene.staged.starts if scene.phases else (0,)
    return [int(each) for each in np.searchsorted(times, (np.array(starts) - 0.5) * scene.simulation.dt)]


class Episodes:
    """B episodes of K decisions: their arrays, and kernels bound to these.

    Attributes:
        substeps: Equal integration steps of each decision, shape (K,); see `divide`.
        parameters: Parameters of each decision and of the end, shape (K + 1, B, n_p).
        units: Inputs of an output of 1, fractions of the limits, shape (n_u,).
        penalties: Those of the scene's constraints, and of success, in the cost.
        roughness: Penalty of outputs that alternate, relative to an episode's cost; see `price_roughness`.
    """

    def __init__(
        self, scene: Scene, layers: Layers, times: Array, units: ArrayLike, *, noisy: bool = False
    ) -> None:
        """Prepare episodes whose network gives its outputs in some units, alike or not for all inputs."""
        self._kernels = kernels = compile_scene(scene)
        self._layers, (decisions, count, n_obs) = layers, layers.values[0].shape
        self.substeps, self._times = np.ones(decisions, int), times
        dtype, layout = kernels.dtype, kernels.layout
        self.units, self._efforts = np.full(kernels.n_u, units, np.float64), layout.control_weight
        self._relative = self.units / self.units.max()  # of the inputs of one actuator
        actuators = (getattr(layout.control, name) for name in CONTROL_UNITS)
        self._actuators = [entries for entries in actuators if entries.start < entries.stop]
        steps, dt = np.diff(times), scene.simulation.dt
        self._weights, firsts = np.zeros(decisions + 1), first_decisions(scene, times)
        for first, end in pairwise((*firsts, decisions + 1)):
            inside, last = steps[first : end - 1], end > decisions
            self._weights[first:end] = 0.5 * (np.append(0.0, inside) + np.append(inside, 0.0)) / dt
            # The sum over time steps has a phase's first and last state whole, but not that at the very end.
            self._weights[first] += 0.5
            self._weights[end - 1] += -0.5 if last else 0.5
        self._held = steps / dt - self._weights[:-1]  # of the input's cost, which is not of a point in time
        self.parameters = np.zeros((decisions + 1, count, kernels.n_p), dtype)
        self.penalties = Penalties(kernels, decisions, count, self._weights[-1])
        self._states = np.zeros((decisions + 1, count, kernels.n_x), dtype)
        self._measured = np.zeros_like(self._states) if noisy else self._states
        self._observations = np.zeros((decisions, count, n_obs), dtype)
        self._wanted = np.zeros((decisions, count, kernels.n_u), dtype)
        self._inputs = np.zeros((decisions + 1, count, kernels.n_u), dtype)
        self._costs = np.zeros((decisions + 1, count, 1), dtype)
        self._terminal, self._emphasis = np.zeros((2, count, 1), dtype)
        self._cotangents = np.zeros((decisions + 1, count, kernels.n_t), dtype)
        self._by_input, self._by_held = np.zeros((2, count, kernels.n_u), dtype)
        # New arrays of this size in every update would take longer than what is computed in them.
        self._by_output, self._rough, self._outputs, second = np.zeros((4, decisions, count, kernels.n_u))
        self._second = second[:-2]
        self._by_observation = np.zeros((count, n_obs), dtype)
        self._by_state = np.zeros((count, kernels.n_t), dtype)
        self._cost_weights = np.repeat(self._weights[:, None, None], count, axis=1).astype(dtype)
        self._calls: list[dict[str, KernelCall]] = []
        self._further: list[list[tuple[KernelCall, KernelCall]]] = []
        self.divide(self.substeps)
        self._end = self._bind_end()
        self.roughness = ROUGH
        self._met, self._usual, self._firsts, self._dt = Met(), USUAL, firsts, dt
        self._inner = np.ones((decisions - 2, 1, 1))  # whether both neighbours are of the same phase
        for first in firsts[1:]:
            self._inner[max(first - 2, 0) : first] = 0.0
        self._arrivals: list[Arrival] = arrivals(times, dt, firsts)

    def divide(self, substeps: Array) -> None:
        """Divide decisions into equal integration steps, (K,), that hold the input."""
        self.substeps = substeps
        chains = [self._chain(k) for k in range(len(substeps))]
        self._calls = [self._bind(k, states, slopes) for k, (states, slopes) in enumerate(chains)]
        self._further = [self._bind_further(k, states, slopes) for k, (states, slopes) in enumerate(chains)]

    def _chain(self, k: int) -> tuple[list[Array], list[Array]]:
        """States of a decision's substeps, first and last included, and their cotangents."""
        between = self.substeps[k] - 1
        count, dtype = self._states.shape[1], self._kernels.dtype
        pairs = ((self._states, self._kernels.n_x), (self._cotangents, self._kernels.n_t))
        states, slopes = (
            [each[k], *np.zeros((between, count, size), dtype), each[k + 1]] for each, size in pairs
        )
        return states, slopes

    def _substep(self, k: int) -> Array:
        """Length of a decision's substeps, s, (1,)."""
        length = (self._times[k + 1] - self._times[k]) / self.substeps[k]
        return np.array([length], self._kernels.dtype)

    def _bind_further(
        self, k: int, states: list[Array], slopes: list[Array]
    ) -> list[tuple[KernelCall, KernelCall]]:
        """The calls of a decision's substeps after the first, forward and back."""
        given = {"u": self._inputs[k], "h": self._substep(k), "parameters": self.parameters[k]}
        found = []
        for index in range(1, self.substeps[k]):
            arrays = {**given, "x": states[index], "x_next": states[index + 1], "v": slopes[index + 1]}
            arrays |= {"x_cotangent": slopes[index], "u_cotangent": self._by_held}
            step, back = (KernelCall(self._kernels.kernel(name), arrays) for name in ("step", "vjp"))
            found.append((step, back))
        return found

    def _bind(self, k: int, states: list[Array], slopes: list[Array]) -> dict[str, KernelCall]:
        """The calls of a decision, those of further substeps left out."""
        count, dtype, times = self._states.shape[1], self._kernels.dtype, self._times
        given = {
            "x": states[0],
            "u": self._inputs[k],
            "h": self._substep(k),
            "parameters": self.parameters[k],
            "time_left": np.full((count, 1), times[-1] - times[k], dtype),
        }
        after = {"x_next": states[1], "cost": self._costs[k]}
        seen = {"x": self._measured[k], "observation": self._observations[k]}
        seen |= {"errors": np.zeros((count, 2), dtype)}
        back = {"v": slopes[1], "v_cost": self._cost_weights[k]}
        back |= {"x_cotangent": slopes[0], "u_cotangent": self._by_input}
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
        along = self.penalties.is_constrained and name == "step_with_cost_vjp"
        if along or name == "emphasized_terminal_cost_vjp":
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
        self._met, self._arrivals = met, arrivals(self._times, self._dt, self._firsts, met.delays)
        self._usual = USUAL_DISTURBED

    @np.errstate(over="ignore", invalid="ignore")  # of episodes that diverge
    def fly(self, starts: Array, mean: Array, scale: Array, emphasis: float) -> Array:
        """Fly from states (B, n_x); observations are normalized as `(o - mean) * scale`.

        Returns the costs, (B,), with the terminal pose's multiplied by the emphasis.
        """
        self._states[0], self._emphasis[:] = starts, emphasis
        self.penalties.prepare(self.parameters, emphasis)
        rows, layout = len(starts), self._kernels.layout
        # Phases change limits.
        high = layout.limits_with(self.parameters if self._kernels.parameters.staged else self.parameters[:1])
        every = len(self.parameters), *high.shape[1:]
        self._low, self._high = (np.broadcast_to(each, every) for each in (layout.lower_limits(high), high))
        units = np.broadcast_to(self.units * high, every)
        for k, calls in enumerate(self._calls):
            self._disturb(k)
            calls["observation"](rows)
            np.subtract(self._observations[k], mean, out=self._by_observation)
            np.multiply(self._by_observation, scale, out=self._layers.values[0][k])
            self._layers.forward(k)
            arrival = self._arrivals[k]
            np.multiply(arrival.of(self._layers.values[-1]), units[k] * arrival.arrived, out=self._wanted[k])
            np.maximum(self._wanted[k], self._low[k], out=self._inputs[k])  # `numpy.clip` takes twice as long
            np.minimum(self._inputs[k], self._high[k], out=self._inputs[k])
            calls["step_with_cost"](rows)
            for step, _ in self._further[k]:
                step(rows)
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

        The gradient, not the costs, has the penalties of constraints and of roughness. Episodes that
        diverge, or cost many times the median, do not count; where the slope of one grows to many times the
        median, it is shortened, and the gradient is no longer exact.
        """
        costs = self.fly(starts, mean, scale, emphasis)
        finite = np.isfinite(costs)
        typical = float(np.median(costs[finite])) if finite.any() else 0.0
        lost = ~finite | (costs > DIVERGED * typical)
        rows, kept = len(starts), max(1, len(starts) - int(lost.sum()))
        if any_lost := bool(lost.any()):
            for values in self._layers.values:
                values[:, lost] = 0.0
        self._end["emphasized_terminal_cost_vjp"](rows)
        self._end["cost_vjp"](rows)
        self._cotangents[-1] += self._by_state
        self._cotangents[-1][lost] = 0.0
        self._by_output[:] = 0.0
        by_roughness = self._by_roughness(typical / kept)
        # What does not depend on slopes, for all decisions at once.
        decisions = len(self._calls)
        by_effort = 2.0 * self._held[:, None, None] * self._efforts * self._inputs[:-1]
        above, below = (self._wanted > self._high[:decisions]), (self._wanted < self._low[:decisions])
        is_limited: Array = np.any(above | below, axis=(1, 2))
        units, scales = self.units * self._high / kept, scale * kept
        # Late outputs of one phase may act in the next, whose limits are others.
        is_late = self._met.delays is not None and len(self._firsts) > 1
        steep = STEEP_PENALTIES if self.penalties.are_strict else STEEP
        for k in range(decisions - 1, -1, -1):
            further: Array | float = 0.0
            for _, reverse in reversed(self._further[k]):
                reverse(rows)
                further = further + self._by_held
            self._calls[k]["step_with_cost_vjp"](rows)
            if self._further[k]:
                self._by_input += further
            slope = np.add(self._by_input, by_effort[k], out=by_effort[k])
            if is_limited[k]:  # beyond a limit only what leads back counts
                slope[(above[k] & (slope < 0.0)) | (below[k] & (slope > 0.0))] = 0.0
            if any_lost:
                slope[lost] = 0.0
            self._arrivals[k].back(slope * units[k] if is_late else slope, self._by_output)
            by_output = self._by_output[k] if is_late else self._by_output[k] * units[k]
            back = self._layers.backward(k, by_output + by_roughness[k])
            np.multiply(back, scales, out=self._by_observation)
            self._calls[k]["observation_vjp"](rows)
            self._cotangents[k] += self._by_state
            if any_lost:
                self._cotangents[k][lost] = 0.0
            _shorten(self._cotangents[k], steep, self._usual)
        return self._layers.gradient(), costs

    def _by_roughness(self, cost: float) -> Array:
        """Slopes by the outputs, (K, B, n_u), of a penalty of their second differences.

        Without it policies learn to alternate from decision to decision, which no flight at every time step
        does. A smooth policy pays the fourth power of the steps; jumps and noise go unpunished.
        """
        slopes, second = self._rough, self._second
        if self._met.jumps is not None or self._met.noise is not None:
            return slopes
        outputs = np.multiply(self._layers.values[-1], self.units, out=self._outputs)
        np.multiply(outputs[1:-1], -2.0, out=second)
        second += outputs[2:]
        second += outputs[:-2]
        second *= 2.0 * self.roughness * cost / len(slopes) * self._inner
        slopes[:-2], slopes[-2:] = second, 0.0
        second *= 2.0
        slopes[1:-1] -= second
        second *= 0.5
        slopes[2:] += second
        slopes *= self.units
        return slopes

    def price_violations(self, cost: float, judged: int) -> None:
        """Let penalties follow what the episodes flown last violate, and the cost of recent ones.

        The first ones, as many as are judged, by where they end, too.
        """
        self.penalties.cost = cost
        if self.penalties.is_constrained:
            self.penalties.follow_path(self._states, self._inputs, self.parameters)
        if judged:
            self.penalties.follow_ends(self._states[-1, :judged], self.parameters[-1, :judged])

    def price_roughness(self) -> None:
        """Let the penalty of outputs that alternate follow how far the inputs flown last do.

        Episodes that diverge, whose inputs are not numbers, do not hide that others alternate.
        """
        changes = np.diff(self._inputs[:-1] / self._kernels.layout.control_limit, axis=0)
        before, after = changes[:-1], changes[1:]
        back = np.maximum(np.minimum(before, -after), np.minimum(-before, after))  # the smaller of the two
        alternates = (np.fmax(back, 0.0) * self._inner).mean(axis=(0, 1)) > ALTERNATING
        factor = ROUGHER if alternates.any() else SMOOTHER
        self.roughness = min(max(self.roughness * factor, ROUGH), ROUGHEST)

    def errors(self) -> Array:
        """How much each decision's integration changes the cost of the episodes of the last `gradient`, (K,).

        Errors of the steps, by steps half as long, times the slope of the cost behind them; infinite where
        no episode comes through.
        """
        kernels, found = self._kernels, np.full(len(self._calls), math.inf)
        for k, count in enumerate(2 * self.substeps):
            states, p = self._states[k], self.parameters[k] if kernels.n_p else None
            for _ in range(count):
                states = kernels.step(states, self._inputs[k], float(self._substep(k)[0]) / 2.0, p=p)
            errors = kernels.difference(states, self._states[k + 1]) * self._cotangents[k + 1]
            with np.errstate(invalid="ignore"):  # of episodes that diverge
                sizes = np.abs(errors.sum(axis=1))
            if self._met.jumps is not None and k + 1 < len(self._calls):
                sizes[self._met.jumps[k + 1].any(axis=1)] = math.nan
            if np.isfinite(sizes).any():
                found[k] = sizes[np.isfinite(sizes)].mean()
        return found

    def misses(self) -> Array:
        """Largest error of the tip at the end of each episode flown last, relative to its tolerance, (B,)."""
        with np.errstate(invalid="ignore"):  # of episodes that diverged
            return misses(self._kernels, self._states[-1], self.parameters[-1])

    def sizes(self) -> Array:
        """Root mean squares of the inputs flown last, by actuator, fractions of the limits, (n_u,)."""
        squares = np.square(self._inputs[:-1]).mean(axis=0)
        squares = squares[np.isfinite(squares).all(axis=1)].mean(axis=0)
        squares /= np.square(self._relative * self._kernels.layout.control_limit)
        for entries in self._actuators:
            squares[entries] = squares[entries].mean()
        return np.asarray(self._relative * np.sqrt(squares))


def _shorten(slopes: Array, steep: float, share: float) -> None:
    """Shorten rows many times longer than a share of them, as chaotic motions have; drop those not finite."""
    # Columns side by side, and a quantile by hand, take a fraction of the time for a few numbers.
    sizes = np.abs(slopes.T, order="C").max(axis=0)
    ordered, count = np.sort(sizes), len(sizes)  # finite ones first
    finite: Any = True
    if not math.isfinite(ordered[-1]):
        finite = np.isfinite(sizes)
        count = int(np.count_nonzero(finite))
        slopes[~finite] = 0.0
    place = share * (count - 1)
    most = steep * 0.5 * (ordered[math.floor(place)] + ordered[math.ceil(place)]) if count else 0.0
    if count and ordered[count - 1] > most:
        long = finite & (sizes > most)
        slopes[long] *= (most / sizes[long])[:, None]
