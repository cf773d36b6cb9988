"""Units of a network before its training, from trial flights: of its observations, and of its outputs."""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from agents.gradients.layers import FIRST_OUTPUTS
from agents.gradients.starts import Starts
from agents.policies.exported import units_of
from dq_space_arm_env import DQSpaceArmVectorEnv, Scene, compile_scene
from dq_space_arm_env.task.step_report import STATE_LIMIT

Array = NDArray[Any]

LARGEST = 0.1  # of the outputs, fractions of the limits
FARTHEST = 5.0  # motion [rad, m] by the first outputs over an episode; units are smaller beyond
TRIAL_ACTIONS = 0.005  # standard deviation of the actions that measure the spread of observations
SEEN = 128  # episodes of that
PART = 0.1  # least deviation of an observation, of that in motions over a radian or a meter
SMALLER = 0.01  # inputs relative to the first ones, by which their motions are measured
TINY = 1e-12  # motion [rad, m] that is none


class FirstUnits(NamedTuple):
    """Mean and inverse deviation of observations, (n_obs,); inputs of an output of 1, (n_u,), of limits."""

    mean: Array
    scale: Array
    outputs: Array


def first_units(scene: Scene, times: Array, rng: np.random.Generator, seed: int) -> FirstUnits:
    """Measure units with inputs that are held between some times, (K + 1,).

    Observations have those under small random inputs; but where a motion over a radian or a meter varies an
    entry much more, as velocities that friction keeps small otherwise, a part of that.
    """
    moved = motions(scene, LARGEST * FIRST_OUTPUTS)
    outputs = LARGEST * FARTHEST / np.maximum(moved, FARTHEST)
    environment = DQSpaceArmVectorEnv(SEEN, scene)
    environment.reset(seed=int(rng.integers(2**31)))
    shape, turn = (len(times) - 1, SEEN, len(outputs)), len(times) // 2
    limit = environment.kernels.layout.control_limit
    small = TRIAL_ACTIONS * (outputs / LARGEST) * limit * rng.normal(size=shape)
    mean, scale = units_of(_observations(environment, times, small))
    # There and back, as far as the limits allow.
    far = limit * np.minimum(LARGEST * FIRST_OUTPUTS / np.maximum(moved, TINY), 1.0)
    shares = np.random.default_rng(seed).uniform(-1.0, 1.0, shape[1:])
    far = np.repeat((far * shares)[None], shape[0], axis=0)
    far[turn:] *= -1.0
    most = units_of(_observations(environment, times, far))[1]
    return FirstUnits(mean, np.where(most > 0.0, np.minimum(scale, most / PART), scale), outputs)


def _observations(environment: DQSpaceArmVectorEnv, times: Array, inputs: Array) -> Array:
    """Observations (N, n_obs) under inputs (K, B, n_u), those of flights that have not diverged."""
    kernels, states, seen = environment.kernels, environment.states, []
    given = environment.parameters if kernels.n_p else None
    stages = None  # a target that moves stands at its start: its motion would count as spread
    if kernels.parameters.staged:
        stages = Starts.of(kernels, states, environment.parameters, times).at(np.arange(SEEN))
        moving = list(kernels.parameters.moving)
        stages[:, :, moving] = environment.parameters[:, moving]
    for k, step in enumerate(np.diff(times)):
        left = np.full((SEEN, 1), times[-1] - times[k])
        p = given if stages is None else stages[k]
        seen.append(kernels.observation(states, left, p)[0])
        states = kernels.step(states, inputs[k], step, p=p)
    samples = np.concatenate(seen)
    return np.asarray(samples[(np.abs(samples) < STATE_LIMIT).all(axis=1)])  # false for NaN


def motions(scene: Scene, share: float) -> Array:
    """How far each input, at a share of its limit, moves something, (n_u,).

    Largest motion of joints, wrist, and base over an episode, rad and m; by much smaller inputs, linearly.
    The base's is that of its dual quaternion's entries: half of its angles and positions.
    """
    kernels = compile_scene(scene)
    small = SMALLER * share * np.diag(kernels.layout.control_limit)
    inputs = np.vstack([small, np.zeros_like(small[:1])])
    states = np.repeat(kernels.layout.initial_state[None], len(inputs), axis=0)
    for _ in range(scene.simulation.steps):
        states = kernels.step(states, inputs, scene.simulation.dt)
    entries = kernels.layout.state
    moved = np.abs(states[:-1] - states[-1])[:, : entries.base_velocity.start]
    return np.asarray(moved.max(axis=1) / SMALLER)
