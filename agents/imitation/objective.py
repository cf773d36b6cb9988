"""Loss of training by imitation: errors of actions, of their derivatives, and around demonstrations.

With x (+) d the state moved along tangent coordinates d, the expert acts as a(x (+) d) = clip(a + G d) to
first order, so a policy pi that observes o(x) should satisfy

    d/de pi(o(x (+) e d)) = G d   at e = 0

in every direction d. Each update checks one random direction per time step, which in expectation checks the
whole Jacobian. Inputs at a limit are left out: their rows of G are zero because the limit holds them, and
clipping holds the policy's output as well, whatever lies beyond.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from agents.configuration.imitation import ObjectiveWeights
from agents.imitation.samples import COLUMNS, NAMES, Statistics
from agents.policies.network import NormalizedNetwork, PolicyNetwork
from dq_space_arm_env.kernels import Kernels
from experts.demonstrations.reading import Batch
from experts.demonstrations.shard import PARAMETERS
from experts.problems.shooting_problem import FloatArray

STEP = 1e-5  # of central differences, relative to the direction: truncation and rounding errors near 1e-10


@dataclass(frozen=True)
class Losses:
    """Mean errors, squared but in chunks, in units of the demonstrations' spread; 0 without weight."""

    total: Tensor  # the weighted sum, which is minimized
    action: Tensor
    gain: Tensor  # of derivatives, relative to the size of the gains
    augmentation: Tensor  # of actions at states around the demonstrations


class Objective:
    """Evaluates a network on batches; `kernels` are in double precision."""

    def __init__(self, kernels: Kernels, statistics: Statistics, weights: ObjectiveWeights) -> None:
        self._kernels, self._weights, self._spread = kernels, weights, statistics.spread
        self._least = kernels.layout.lower_limits(np.ones(kernels.n_u))
        self._gain_size = torch.from_numpy(statistics.gain_size.astype(np.float32))

    @property
    def needs(self) -> tuple[str, ...]:
        """Names of the arrays that a batch must have."""
        if self._weights.needs_gains:
            return COLUMNS if self._kernels.n_p else NAMES
        return ("observations", "actions")

    def __call__(self, network: PolicyNetwork, batch: Batch, rng: np.random.Generator) -> Losses:
        """Evaluate the losses, with gradients, on B time steps with the arrays of `needs`."""
        weights, arrays = self._weights, batch.arrays
        normalized = network.normalized(arrays["observations"])
        none = torch.zeros(())
        gain, augmentation = none, none
        if weights.gain_weight:
            directions = self._directions(arrays["states"], rng)
            seen = arrays["states"], arrays["observations"]
            change = observation_change(self._kernels, *seen, directions, arrays.get(PARAMETERS))
            tangent = torch.from_numpy((change * network.observation_scale.numpy()).astype(np.float32))
            outputs, slopes = network.forward_with_tangent(normalized, tangent)
            gain = self._gain_error(network, slopes, batch, directions)
        else:
            outputs = network(normalized)
        action = action_errors(network, outputs, arrays["actions"], self._least).square().mean()
        if weights.augmentation_weight:
            augmentation = self._augmentation_error(network, batch, rng)
        total = action + weights.gain_weight * gain + weights.augmentation_weight * augmentation
        return Losses(total, action, gain, augmentation)

    def _directions(self, states: FloatArray, rng: np.random.Generator) -> FloatArray:
        return rng.standard_normal((len(states), len(self._spread))) * self._spread

    def _gain_error(
        self, network: PolicyNetwork, slopes: Tensor, batch: Batch, directions: FloatArray
    ) -> Tensor:
        """Error of d/de pi(o(x (+) e d)) - G d, each input relative to the size of its gains."""
        wanted = torch.from_numpy(_times(batch.arrays["feedback_gains"], directions).astype(np.float32))
        actions = batch.arrays["actions"]
        free = torch.from_numpy((self._least < actions) & (actions < 1.0))
        errors = (slopes * network.action_scale.float() - wanted) / self._gain_size
        return torch.where(free, errors, 0.0).square().mean()

    def _augmentation_error(self, network: PolicyNetwork, batch: Batch, rng: np.random.Generator) -> Tensor:
        """Error of actions at x (+) d, against clip(a + G d)."""
        arrays = batch.arrays
        directions = self._weights.augmentation_scale * self._directions(arrays["states"], rng)
        states = self._kernels.retract(arrays["states"], directions)
        time_left, parameters = arrays["observations"][:, -1:], arrays.get(PARAMETERS)
        observations = self._kernels.observation(states, time_left, p=parameters)[0]
        wanted = np.clip(arrays["actions"] + _times(arrays["feedback_gains"], directions), self._least, 1.0)
        outputs = network(network.normalized(observations))
        return action_errors(network, outputs, wanted, self._least).square().mean()


def observation_change(
    kernels: Kernels,
    states: FloatArray,
    observations: FloatArray,
    directions: FloatArray,
    parameters: FloatArray | None = None,
) -> FloatArray:
    """Directional derivative d/de o(x (+) e d) at e = 0, shape (B, n_obs), one direction per state."""
    time_left = observations[:, -1:]
    ahead, behind = (
        kernels.observation(kernels.retract(states, sign * STEP * directions), time_left, p=parameters)[0]
        for sign in (1.0, -1.0)
    )
    return np.asarray((ahead - behind) / (2.0 * STEP))


def _times(gains: NDArray[np.float32], directions: FloatArray) -> FloatArray:
    """G d, shape (B, n_u)."""
    return np.asarray(np.matmul(gains, directions[:, :, None].astype(np.float32))[:, :, 0])


def action_errors(
    network: NormalizedNetwork, outputs: Tensor, actions: FloatArray, least: FloatArray
) -> Tensor:
    """Errors of actions; one that is at a limit may be wanted beyond it, which clipping undoes."""
    wanted = torch.from_numpy(actions)
    errors = network.action_mean + network.action_scale * outputs - wanted
    beyond = ((wanted >= 1.0) & (errors > 0.0)) | ((wanted <= torch.from_numpy(least)) & (errors < 0.0))
    return (torch.where(beyond, 0.0, errors) / network.action_scale).float()
