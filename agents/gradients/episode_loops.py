"""The loops over the decisions of episodes, forward and back, in machine code.

A decision is small: some rows, a network of some thousand weights, four kernels. In NumPy most of the time
would go into calls.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from experts.native.compilation import BufferTable, call_kernel, compiled, part
from experts.native.vector_code import TILE_ROWS
from experts.native.vector_tiles import layer_rows

Array = NDArray[Any]
Whole = NDArray[np.int64]


class Call(NamedTuple):
    """A kernel and the addresses of its arrays."""

    address: int
    tables: BufferTable  # a row for each decision, or each substep after a decision's first


class Calls(NamedTuple):
    """The kernels of all decisions."""

    observation: Call
    step: Call
    step_back: Call
    observation_back: Call
    further_step: Call
    further_step_back: Call
    further_begins: Whole  # the second substep of each decision, (K + 1,)


class Arrivals(NamedTuple):
    """Which outputs act in each decision: the newest arrived, and its difference to the one before."""

    newest: Whole  # index of a decision, (K, B)
    before: Whole
    ahead: Array  # in units of the time between these two
    arrived: Array  # 0 where nothing has, otherwise 1


class Network(NamedTuple):
    """Layers of a policy, see `Layers`; rows are padded to whole vectors."""

    values: tuple[Array, ...]  # of each layer and the inputs, (K, B, n)
    cotangents: tuple[Array, ...]
    matrices: tuple[Array, ...]
    transposes: tuple[Array, ...]
    biases: tuple[Array, ...]
    zeros: Array  # as many as the widest layer has


class Flown(NamedTuple):
    """What episodes of K decisions read and write; (K, B, n) where nothing else is said."""

    observations: Array
    wanted: Array  # inputs before their limits
    inputs: Array
    mean: Array  # of the observations, (n_obs,)
    scale: Array
    units: Array  # inputs of an output of 1, (K, B or 1, n_u)
    low: Array  # limits of the inputs likewise
    high: Array
    held: Array  # weight of a decision's input in the cost, (K,)
    efforts: Array  # weights of inputs in the cost, (K, n_u)
    spent: Array  # cost of the inputs of each episode, (B,)


class Slopes(NamedTuple):
    """What the way back reads and writes."""

    by_state: Array  # of what follows a decision, (K + 1, B, n_t)
    by_output: Array  # (K, B, n_u); holds those of the roughness at first
    by_input: Array  # of a substep, (B, n_u)
    by_inputs: Array  # of all of a decision, (B, n_u)
    by_observation: Array  # (B, n_obs)
    by_observed: Array  # (B, n_t)
    lost: NDArray[np.bool_]  # episodes that do not count, (B,)
    sizes: Array  # (B,)
    ordered: Array  # (B,)


@compiled
def fly_decisions(
    first: int, end: int, calls: Calls, network: Network, arrivals: Arrivals, flown: Flown
) -> None:
    """Fly the decisions from the first to the last before the end."""
    count, last = flown.inputs.shape[1], len(network.matrices)
    for k in range(first, end):
        call_kernel(calls.observation.address, 0, count, calls.observation.tables[k])
        _normalize(network.values[0][k], flown.observations[k], flown.mean, flown.scale)
        for index in range(last):
            _layer(
                network.values[index + 1][k],
                network.values[index][k],
                network.matrices[index],
                network.biases[index],
            )
            if index + 1 < last:
                _to_tanh(network.values[index + 1][k])
        _act(k, network.values[last], arrivals, flown)
        call_kernel(calls.step.address, 0, count, calls.step.tables[k])
        for substep in range(calls.further_begins[k], calls.further_begins[k + 1]):
            call_kernel(calls.further_step.address, 0, count, calls.further_step.tables[substep])


@compiled
def trace_back_decisions(
    calls: Calls,
    network: Network,
    arrivals: Arrivals,
    flown: Flown,
    slopes: Slopes,
    kept: int,
    steep: float,
    usual: float,
) -> None:
    """Carry the slopes of the end back through all decisions.

    Within the network they are divided by the number of episodes that count. Slopes by the states are
    shortened where they are so many times as steep as a usual share of the episodes.
    """
    decisions, count = len(flown.wanted), flown.inputs.shape[1]
    last = len(network.matrices)
    for k in range(decisions - 1, -1, -1):
        slopes.by_inputs[:] = 0.0
        for substep in range(calls.further_begins[k + 1] - 1, calls.further_begins[k] - 1, -1):
            call_kernel(calls.further_step_back.address, 0, count, calls.further_step_back.tables[substep])
            _add(slopes.by_inputs, slopes.by_input)
        call_kernel(calls.step_back.address, 0, count, calls.step_back.tables[k])
        _add(slopes.by_inputs, slopes.by_input)
        _act_back(k, arrivals, flown, slopes, kept)
        _put_in(network.cotangents[last][k], slopes.by_output[k])
        for index in range(last, 0, -1):
            if index < last:
                _through_tanh(network.cotangents[index][k], network.values[index][k])
            _layer(
                network.cotangents[index - 1][k],
                network.cotangents[index][k],
                network.transposes[index - 1],
                network.zeros,
            )
        _normalize_back(slopes.by_observation, network.cotangents[0][k], flown.scale, kept)
        call_kernel(calls.observation_back.address, 0, count, calls.observation_back.tables[k])
        _add(slopes.by_state[k], slopes.by_observed)
        for i in range(count):
            if slopes.lost[i]:
                slopes.by_state[k, i, :] = np.nan  # no usual slope; `_shorten` makes it zero
        _shorten(slopes.by_state[k], steep, usual, slopes.sizes, slopes.ordered)


@compiled
def add_slopes_of_roughness(by_output: Array, outputs: Array, units: Array, weights: Array) -> None:
    """Add to slopes by outputs, (K, B, n_u), those of a penalty of their second differences in some units.

    Without it policies learn to alternate from decision to decision, which no flight at every time step does.
    The weights, (K - 2,), are those of half the squares.
    """
    for k in range(len(weights)):
        for i in range(by_output.shape[1]):
            for a in range(by_output.shape[2]):
                second = outputs[k, i, a] - 2.0 * outputs[k + 1, i, a] + outputs[k + 2, i, a]
                second *= weights[k] * units[a] * units[a]
                by_output[k, i, a] += second
                by_output[k + 1, i, a] -= 2.0 * second
                by_output[k + 2, i, a] += second


@compiled
def add_alternation(alternation: Array, inputs: Array, inner: Array) -> None:
    """Add up how far inputs, (K, B, n_u), turn back after a change, the smaller of the two, by actuator.

    Where inner, (K - 2,), is zero nothing counts, nor do changes that are no numbers.
    """
    for k in range(len(inner)):
        for i in range(inputs.shape[1]):
            for a in range(inputs.shape[2]):
                before = inputs[k + 1, i, a] - inputs[k, i, a]
                after = inputs[k + 2, i, a] - inputs[k + 1, i, a]
                if before * after < 0.0:
                    alternation[a] += min(abs(before), abs(after)) * inner[k]


@part
def _layer(target: Array, given: Array, matrix: Array, bias: Array) -> None:
    """Compute a layer's sums, (B, n)."""
    for i in range(0, target.shape[0], TILE_ROWS):
        layer_rows(target, i, bias, given, matrix)


@part
def _normalize(target: Array, observations: Array, mean: Array, scale: Array) -> None:
    """Turn observations (B, n_obs) into inputs of the network, whose rows are padded."""
    for i in range(observations.shape[0]):
        for j in range(observations.shape[1]):
            target[i, j] = (observations[i, j] - mean[j]) * scale[j]


@part
def _normalize_back(target: Array, cotangents: Array, scale: Array, kept: int) -> None:
    """Turn slopes by inputs of the network into those by observations, (B, n_obs), no longer divided."""
    for i in range(target.shape[0]):
        for j in range(target.shape[1]):
            target[i, j] = cotangents[i, j] * (scale[j] * kept)


@part
def _put_in(target: Array, source: Array) -> None:
    """Copy numbers into rows that are padded."""
    for i in range(source.shape[0]):
        for j in range(source.shape[1]):
            target[i, j] = source[i, j]


@part
def _add(target: Array, more: Array) -> None:
    """Add a matrix to another of its shape."""
    for i in range(more.shape[0]):
        for j in range(more.shape[1]):
            target[i, j] += more[i, j]


@part
def _to_tanh(values: Array) -> None:
    """Replace values by their hyperbolic tangents.

    Lambert's continued fraction of an eighth of the argument, then tanh 2x = 2 tanh x / (1 + tanh^2 x) three
    times, on numerators and denominators: it errs by 3e-7 in single precision, by 4e-9 in double, and LLVM
    makes vector code of it, not of calls of a mathematical library.
    """
    of = values.dtype.type
    for i in range(values.shape[0]):
        for j in range(values.shape[1]):
            x = min(max(values[i, j] * of(0.125), of(-1.25)), of(1.25))
            s = x * x
            n = x * (of(1.0) + s * (of(5.0 / 39.0) + s * (of(2.0 / 715.0) + s * of(1.0 / 135135.0))))
            d = of(1.0) + s * (of(6.0 / 13.0) + s * (of(10.0 / 429.0) + s * of(4.0 / 19305.0)))
            for _ in range(3):
                n, d = of(2.0) * n * d, d * d + n * n
            values[i, j] = n / d


@part
def _through_tanh(cotangents: Array, values: Array) -> None:
    """Multiply cotangents by the slopes of hyperbolic tangents, given their values."""
    for i in range(values.shape[0]):
        for j in range(values.shape[1]):
            cotangents[i, j] -= cotangents[i, j] * values[i, j] * values[i, j]


@part
def _act(k: int, outputs: Array, arrivals: Arrivals, flown: Flown) -> None:
    """Turn the outputs that act in a decision into its inputs."""
    of_each = flown.units.shape[1] > 1
    for i in range(outputs.shape[1]):
        newest, before = arrivals.newest[k, i], arrivals.before[k, i]
        ahead, arrived, row = arrivals.ahead[k, i], arrivals.arrived[k, i], i if of_each else 0
        spent = 0.0
        for a in range(flown.inputs.shape[2]):
            output = outputs[newest, i, a]
            output += ahead * (output - outputs[before, i, a])
            wanted = output * flown.units[k, row, a] * arrived
            flown.wanted[k, i, a] = wanted
            if wanted < flown.low[k, row, a]:  # NaN stays what it is
                wanted = flown.low[k, row, a]
            elif wanted > flown.high[k, row, a]:
                wanted = flown.high[k, row, a]
            flown.inputs[k, i, a] = wanted
            spent += flown.efforts[k, a] * wanted * wanted
        flown.spent[i] += flown.held[k] * spent


@part
def _act_back(k: int, arrivals: Arrivals, flown: Flown, slopes: Slopes, kept: int) -> None:
    """Add to the slopes by outputs what a decision's inputs contribute."""
    of_each = flown.units.shape[1] > 1
    for i in range(slopes.by_inputs.shape[0]):
        newest, before = arrivals.newest[k, i], arrivals.before[k, i]
        ahead, row = arrivals.ahead[k, i], i if of_each else 0
        for a in range(slopes.by_inputs.shape[1]):
            effort = 2.0 * flown.held[k] * flown.efforts[k, a] * flown.inputs[k, i, a]
            slope, wanted = slopes.by_inputs[i, a] + effort, flown.wanted[k, i, a]
            # Beyond a limit only what leads back counts.
            above = wanted > flown.high[k, row, a] and slope < 0.0
            below = wanted < flown.low[k, row, a] and slope > 0.0
            if above or below or slopes.lost[i]:
                continue
            slope *= flown.units[k, row, a] * arrivals.arrived[k, i] / kept
            slopes.by_output[newest, i, a] += (1.0 + ahead) * slope
            slopes.by_output[before, i, a] -= ahead * slope


@part
def _shorten(slopes: Array, steep: float, usual: float, sizes: Array, ordered: Array) -> None:
    """Shorten rows many times longer than a share of them, as chaotic motions have; drop those not finite."""
    count = 0
    for i in range(slopes.shape[0]):
        sizes[i] = 0.0
        for j in range(slopes.shape[1]):
            size = abs(slopes[i, j])
            if not size <= sizes[i]:  # NaN, too
                sizes[i] = size
            if not np.isfinite(sizes[i]):
                break
        if np.isfinite(sizes[i]):
            ordered[count] = sizes[i]
            count += 1
        else:
            slopes[i, :] = 0.0
    if count == 0:
        return
    _sort(ordered, count)
    place = usual * (count - 1)
    most = steep * 0.5 * (ordered[int(np.floor(place))] + ordered[int(np.ceil(place))])
    if ordered[count - 1] > most:
        for i in range(slopes.shape[0]):
            if np.isfinite(sizes[i]) and sizes[i] > most:
                for j in range(slopes.shape[1]):
                    slopes[i, j] *= most / sizes[i]


@part
def _sort(values: Array, count: int) -> None:
    """Sort the first values (Shell); what NumPy sorts with takes memory that compiled loops do not have."""
    gap = count // 2
    while gap > 0:
        for i in range(gap, count):
            value, place = values[i], i
            while place >= gap and values[place - gap] > value:
                values[place] = values[place - gap]
                place -= gap
            values[place] = value
        gap //= 2
