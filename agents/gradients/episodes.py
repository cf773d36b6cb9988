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
from collections.abc import Iterator, Mapping, Sequence
from itertools import pairwise
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from agents.gradients.disturbed_flights import Met, arrivals
from agents.gradients.episode_loops import (
    Call,
    Calls,
    Flown,
    Slopes,
    add_alternation,
    add_slopes_of_roughness,
    fly_decisions,
    trace_back_decisions,
)
from agents.gradients.layers import Layers
from agents.gradients.penalties import Penalties
from dq_space_arm_env import Scene, compile_scene
from dq_space_arm_env.environment.disturbances import displaced
from dq_space_arm_env.kernels.bound import KernelCall, address_of
from dq_space_arm_env.kernels.library import PENALIZED
from dq_space_arm_env.scene import StateLayout
from dq_space_arm_env.scene.parameters import CONTROL_UNITS
from experts.problems.arm_problem import misses

Array = NDArray[Any]

END_BACK = PENALIZED + "emphasized_terminal_cost_vjp"

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
    of costs has it. Actuators that delay by whole time steps have one for each of these, however many are
    asked for: in a longer one they would delay longer.
    """
    dt, steps = scene.simulation.dt, scene.simulation.steps
    if any(chain.delay for chain in StateLayout.of(scene).chains):
        return every_step(scene)
    starts = scene.staged.starts if scene.phases else (0,)
    times = [np.zeros(1)]
    for start, end in pairwise((*starts, steps)):
        begun, due = sum(map(len, times)) - 1, max(1, round(decisions * end / steps))
        single = end < steps
        # Before that step there is another decision, unless it is all of the phase.
        count = 1 if single and end - start == 1 else max(1 + single, due - begun)
        even = np.linspace(0.0, 1.0, count - single + 1)
        ends = 0.5 * (1.0 - np.cos(np.pi * even))
        spread = (end - single - start) * dt * (even + crowding * (ends - even))
        times += [start * dt + spread[1:], *([np.array([end * dt])] if single else [])]
    return np.concatenate(times)


def every_step(scene: Scene) -> Array:
    """Times of all time steps and of the end, s, (N + 1,)."""
    return scene.simulation.dt * np.arange(scene.simulation.steps + 1)


def first_decisions(scene: Scene, times: Array) -> list[int]:
    """Index of the first decision of each phase, of all at given times; [0] without phases."""
    starts = scene.staged.starts if scene.phases else (0,)
    return [int(each) for each in np.searchsorted(times, (np.array(starts) - 0.5) * scene.simulation.dt)]


class Episodes:
    """B episodes of K decisions: their arrays, and tables of these for the kernels.

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
        self._layers, (decisions, count, n_obs) = layers, layers.shape
        self.substeps, self._times = np.ones(decisions, int), times
        dtype, layout = kernels.dtype, kernels.layout
        self.units = np.full(kernels.n_u, units, np.float64)
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
        self.parameters = np.zeros((decisions + 1, count, kernels.n_p), dtype)
        self.penalties = Penalties(kernels, decisions, count, self._weights[-1])

        def zeros(*shape: int) -> Array:
            return np.zeros((*shape[:-1], count, shape[-1]), dtype)

        self._states, self._costs = zeros(decisions + 1, kernels.n_x), zeros(decisions + 1, 1)
        self._measured = np.zeros_like(self._states) if noisy else self._states
        self._terminal, self._emphasis, self._by_state = zeros(1), zeros(1), zeros(kernels.n_t)
        self._cost_weights = np.repeat(self._weights[:, None, None], count, axis=1).astype(dtype)
        self._flown = Flown(
            observations=zeros(decisions, n_obs),
            wanted=zeros(decisions, kernels.n_u),
            inputs=zeros(decisions + 1, kernels.n_u),
            **dict.fromkeys(("mean", "scale", "units", "low", "high", "efforts"), np.empty(0)),
            held=steps / dt - self._weights[:-1],  # the input's cost is not of a point in time
            spent=np.zeros(count),
        )
        self._inputs = self._flown.inputs
        self._slopes = Slopes(
            by_state=zeros(decisions + 1, kernels.n_t),
            by_output=np.zeros((decisions, count, kernels.n_u)),
            by_input=zeros(kernels.n_u),
            by_inputs=zeros(kernels.n_u),
            by_observation=zeros(n_obs),
            by_observed=zeros(kernels.n_t),
            lost=np.zeros(count, np.bool_),
            sizes=np.zeros(count),
            ordered=np.zeros(count),
        )
        self._cotangents = self._slopes.by_state
        self.divide(self.substeps)
        self._end = self._bind_end()
        self.roughness = ROUGH
        self._met, self._usual, self._firsts, self._dt = Met(), USUAL, firsts, dt
        self._inner = np.ones(decisions - 2)  # whether both neighbours are of the same phase
        for first in firsts[1:]:
            self._inner[max(first - 2, 0) : first] = 0.0
        self._arrivals = arrivals(times, dt, firsts, count)

    def follow_on(self, others: Episodes) -> None:
        """Take the penalties that others of the same scene have come to, and their shares of an actuator."""
        self.roughness, self._relative = others.roughness, others._relative
        self.penalties.prices[:], self.penalties.cost = others.penalties.prices, others.penalties.cost

    def divide(self, substeps: Array) -> None:
        """Divide decisions into equal integration steps, (K,), that hold the input."""
        self.substeps = substeps
        chains = [self._chain(k) for k in range(len(substeps))]
        first = [self._first_arrays(k, *chain) for k, chain in enumerate(chains)]
        further = [arrays for k, chain in enumerate(chains) for arrays in self._further_arrays(k, *chain)]
        self._kept = first, further  # alive: the tables hold their addresses
        is_constrained = self.penalties.is_constrained
        self._calls = Calls(
            observation=self._call("observation", first),
            step=self._call("step_with_cost", first),
            step_back=self._call("step_with_cost_vjp", first, is_penalized=is_constrained),
            observation_back=self._call("observation_vjp", first),
            further_step=self._call("step", further),
            further_step_back=self._call("vjp", further),
            further_begins=np.append(0, np.cumsum(substeps - 1)),
        )

    def _chain(self, k: int) -> tuple[list[Array], list[Array]]:
        """States of a decision's substeps, first and last included, and their cotangents."""
        between = self.substeps[k] - 1
        count, dtype = self._states.shape[1], self._kernels.dtype
        pairs = ((self._states, self._kernels.n_x), (self._cotangents, self._kernels.n_t))
        states, slopes = (
            [each[k], *np.zeros((between, count, size), dtype), each[k + 1]] for each, size in pairs
        )
        return states, slopes

    def _first_arrays(self, k: int, states: list[Array], slopes: list[Array]) -> dict[str, dict[str, Array]]:
        """Arrays of a decision by kernel and name, those of further substeps left out."""
        count, dtype, times, ways = self._states.shape[1], self._kernels.dtype, self._times, self._slopes
        left = np.full((count, 1), times[-1] - times[k], dtype)
        given = {"u": self._inputs[k], "h": self._substep(k), "parameters": self.parameters[k]}
        seen = {**given, "x": self._measured[k], "time_left": left}
        step = {**given, "x": states[0], "x_next": states[1], "cost": self._costs[k]}
        back = {**given, "x": states[0], "v": slopes[1], "v_cost": self._cost_weights[k]}
        back |= {"x_cotangent": slopes[0], "u_cotangent": ways.by_input}
        if self.penalties.is_constrained:
            back["parameters"] = self.penalties.parameters[k]
        errors = np.zeros((count, 2), dtype)
        return {
            "observation": {**seen, "observation": self._flown.observations[k], "errors": errors},
            "step_with_cost": step,
            "step_with_cost_vjp": back,
            "observation_vjp": {**seen, "v": ways.by_observation, "x_cotangent": ways.by_observed},
        }

    def _further_arrays(
        self, k: int, states: list[Array], slopes: list[Array]
    ) -> Iterator[dict[str, dict[str, Array]]]:
        """Arrays of a decision's substeps after the first, by kernel and name."""
        given = {"u": self._inputs[k], "h": self._substep(k), "parameters": self.parameters[k]}
        for index in range(1, self.substeps[k]):
            step = {**given, "x": states[index], "x_next": states[index + 1]}
            back = {**given, "x": states[index], "v": slopes[index + 1], "x_cotangent": slopes[index]}
            yield {"step": step, "vjp": {**back, "u_cotangent": self._slopes.by_input}}

    def _substep(self, k: int) -> Array:
        """Length of a decision's substeps, s, (1,)."""
        length = (self._times[k + 1] - self._times[k]) / self.substeps[k]
        return np.array([length], self._kernels.dtype)

    def _call(
        self, name: str, arrays: Sequence[Mapping[str, Mapping[str, Array]]], *, is_penalized: bool = False
    ) -> Call:
        """A kernel on the arrays of decisions or substeps; none is compiled where there are none."""
        if not arrays:
            return Call(0, np.zeros((0, 0), np.int64))
        kernel = self._kernels.kernel(PENALIZED + name if is_penalized else name)
        names = [spec.name for spec in (*kernel.inputs, *kernel.outputs)]
        return Call(
            kernel.address, np.array([[address_of(each[name][key]) for key in names] for each in arrays])
        )

    def _bind_end(self) -> dict[str, KernelCall]:
        """The calls at the end, where the inputs are zero."""
        one = np.ones_like(self._terminal)
        given = {"x": self._states[-1], "u": self._inputs[-1], "parameters": self.parameters[-1]}
        given |= {"emphasis": self._emphasis}
        penalized = {"parameters": self.penalties.parameters[-1]}
        by_state = {"v": self._cost_weights[-1], "x_cotangent": self._by_state}
        arrays = {
            "cost": {"cost": self._costs[-1]},
            "emphasized_terminal_cost": {"cost": self._terminal},
            "cost_vjp": {**by_state, "u_cotangent": self._slopes.by_input},
            END_BACK: {"v": one, "x_cotangent": self._cotangents[-1], **penalized},
        }
        return {
            name: KernelCall(self._kernels.kernel(name), given | others) for name, others in arrays.items()
        }

    def meet(self, met: Met) -> None:
        """Let delays, jumps and noise disturb the next flights; ValueError for noise on flights without."""
        if met.noise is not None and self._measured is self._states:
            raise ValueError("noise: these episodes are made without it, should be made with noisy=True")
        count = self._states.shape[1]
        self._met, self._arrivals = met, arrivals(self._times, self._dt, self._firsts, count, met.delays)
        self._usual = USUAL_DISTURBED

    @np.errstate(over="ignore", invalid="ignore")  # of episodes that diverge
    def fly(self, starts: Array, mean: Array, scale: Array, emphasis: float) -> Array:
        """Fly from states (B, n_x); observations are normalized as `(o - mean) * scale`.

        Returns the costs, (B,), with the terminal pose's multiplied by the emphasis.
        """
        self._states[0], self._emphasis[:] = starts, emphasis
        self.penalties.prepare(self.parameters, emphasis)
        self._layers.prepare()
        rows, decisions, layout = len(starts), len(self.substeps), self._kernels.layout
        # Phases change limits and weights.
        given_now = self.parameters if self._kernels.parameters.staged else self.parameters[:1]
        high = layout.limits_with(given_now)
        weights = layout.weights_with(given_now[:decisions, 0])  # of all episodes alike
        efforts = np.array(np.broadcast_to(weights, (decisions, self._kernels.n_u)), np.float64)
        every = len(self.parameters), *high.shape[1:]
        units, low, high = (  # copies, as loops are compiled for arrays that may be written to
            np.array(np.broadcast_to(each, every), np.float64, order="C")
            for each in (self.units * high, layout.lower_limits(high), high)
        )
        mean, scale = np.array(mean, np.float64), np.array(scale, np.float64)
        self._flown = self._flown._replace(
            mean=mean, scale=scale, units=units, low=low, high=high, efforts=efforts
        )
        self._flown.spent[:] = 0.0
        given = self._calls, self._layers.network, self._arrivals, self._flown
        if self._met.jumps is None and self._measured is self._states:
            fly_decisions(0, decisions, *given)
        else:
            for k in range(decisions):
                self._disturb(k)
                fly_decisions(k, k + 1, *given)
        self._end["cost"](rows)
        self._end["emphasized_terminal_cost"](rows)
        total = self._weights @ self._costs[..., 0] + self._flown.spent + self._terminal[:, 0]
        return np.asarray(total)

    def _disturb(self, k: int) -> None:
        """Push the bases at the beginning of a decision, and measure the states with noise."""
        jumps, noise = self._met.jumps, self._met.noise
        if jumps is not None:
            struck = jumps[k].any(axis=1)
            self._states[k][struck] = self._kernels.retract(self._states[k][struck], jumps[k][struck])
        if noise is not None:
            self._measured[k] = displaced(self._kernels, self._states[k], noise[k])
        elif self._measured is not self._states:
            self._measured[k] = self._states[k]

    @np.errstate(over="ignore", invalid="ignore")
    def gradient(
        self, starts: Array, mean: Array, scale: Array, emphasis: float
    ) -> tuple[list[Array], Array]:
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
        if lost.any():
            self._layers.forget(lost)
        self._slopes.lost[:] = lost
        self._end[END_BACK](rows)
        self._end["cost_vjp"](rows)
        self._cotangents[-1] += self._by_state
        self._cotangents[-1][lost] = 0.0
        self._slopes.by_output[:] = 0.0
        if self._met.jumps is None and self._met.noise is None:  # which make outputs rough with good reason
            # A smooth policy pays the fourth power of the steps.
            weights = 2.0 * self.roughness * typical / (kept * len(self.substeps)) * self._inner
            outputs = self._layers.network.values[-1]
            add_slopes_of_roughness(self._slopes.by_output, outputs, self.units, weights)
        steep = STEEP_PENALTIES if self.penalties.are_strict else STEEP
        given = self._calls, self._layers.network, self._arrivals, self._flown
        trace_back_decisions(*given, self._slopes, kept, steep, self._usual)
        return self._layers.gradient(), costs

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
        alternation = np.zeros(len(self.units))
        add_alternation(alternation, self._inputs[:-1], self._inner)
        count = len(self._inner) * self._inputs.shape[1]
        alternates = alternation / count > ALTERNATING * self._kernels.layout.control_limit
        factor = ROUGHER if alternates.any() else SMOOTHER
        self.roughness = min(max(self.roughness * factor, ROUGH), ROUGHEST)

    def errors(self) -> Array:
        """How much each decision's integration changes the cost of the episodes of the last `gradient`, (K,).

        Errors of the steps, by steps half as long, times the slope of the cost behind them; infinite where
        no episode comes through.
        """
        kernels, found = self._kernels, np.full(len(self.substeps), math.inf)
        step, halved = kernels.kernel("step"), np.empty_like(self._states[1:])
        for k, count in enumerate(2 * self.substeps):
            given = {"u": self._inputs[k], "h": self._substep(k) / 2.0, "parameters": self.parameters[k]}
            x = self._states[k]
            for _ in range(count):
                KernelCall(step, {**given, "x": x, "x_next": halved[k]})(len(x))
                x = halved[k].copy()
        ends = (np.reshape(each, (-1, kernels.n_x)) for each in (halved, self._states[1:]))
        errors = kernels.difference(*ends).reshape(self._cotangents[1:].shape) * self._cotangents[1:]
        with np.errstate(invalid="ignore"):  # of episodes that diverge
            sizes = np.abs(errors.sum(axis=-1))
        if self._met.jumps is not None:
            sizes[:-1][self._met.jumps[1:].any(axis=-1)] = math.nan
        for k, each in enumerate(sizes):
            if np.isfinite(each).any():
                found[k] = each[np.isfinite(each)].mean()
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
