"""Penalties in the cost of episodes: of a scene's constraints, and of success at the end.

A row has one multiplier for all episodes. The slopes of an episode's cost are then those of the augmented
Lagrangian of `task.augmented_lagrangian`. A policy has to keep to a row from all starts: dual ascent lets the
price of a violation rise while too many episodes have one, however large, and else fall. Since the penalty is
a barrier inside, a higher price keeps flights at a larger distance. Rates of controls, and what is exact at
the end, have no penalty, nor have slew limits and the torques of motors at speed, to which environments clip.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from dq_space_arm_env import Kernels, Scene
from dq_space_arm_env.scene.constraint_rows import n_multipliers, path_rows, penalized_rows, terminal_rows
from dq_space_arm_env.scene.constraints import TorqueSpeed

Array = NDArray[Any]

LEAST = 0.01  # price at first, and at least: one that had vanished would come back too late
STIFFNESS = 5.0  # penalty of a row, relative to one over its tolerance
STIFFER = 10.0  # factor by which the penalties of success become stiffer


class _Ascent(NamedTuple):
    """How prices follow the shares of episodes that violate rows, with tolerances for units of violations."""

    charged: float  # violation that counts
    near: float  # violation; where few episodes come so near, a price falls as fast as it rises
    allowed: float  # share of the episodes at which a price stays
    most: float  # share beyond which it rises no faster
    fastest: float  # change of its logarithm in an update, at most
    dearest: float  # price at most


# Flights between decisions keep within their tolerances; rows share what is allowed.
ALONG = _Ascent(charged=0.5, near=-5.0, allowed=0.01, most=0.1, fastest=0.05, dearest=1e3)
FEWER = 0.2  # factor by which the most of them becomes less as penalties become stiffer
# An error of e tolerances violates by (e^2 - 1) / 2: those above 0.93 count, and all are near.
AT_END = _Ascent(charged=-0.07, near=-1.0, allowed=0.002, most=0.04, fastest=0.04, dearest=6.0)


def priced_rows(scene: Scene) -> NDArray[np.bool_]:
    """Which of `penalized_rows` have a price: not the torques to which environments clip by themselves."""
    clipped = {each.name for each in scene.constraints if isinstance(each, TorqueSpeed)}
    return np.array([row.name.partition(":")[0] not in clipped for row in penalized_rows(scene)], np.bool_)


class Penalties:
    """Penalties of B episodes of K decisions.

    Attributes:
        parameters: Those of the penalized programs, shape (K + 1, B, n_p + 2 m); of the end alone, K = 0,
            where no row along the path has a price.
        prices: Of the rows along the path, then of those of success, shape (r,): what a violation by the
            tolerance costs at first order, relative to a cost; along the path if it lasts all the episode.
            Those of success are zero before `follow_ends`.
        cost: That cost; multipliers are proportional to it.
        hardening: How far the penalties of success have become stiffer, from 0 to 1.
    """

    def __init__(self, kernels: Kernels, decisions: int, count: int, last_weight: float) -> None:
        """Prepare for so many decisions and episodes; the end counts in the cost with a weight."""
        scene, path = kernels.scene, penalized_rows(kernels.scene)
        self._kernels, self._last_weight = kernels, last_weight
        held_at_end = [not row.has_input for row in path]
        self._path, self._first_end = slice(len(path)), sum(held_at_end)
        success = [row for row in terminal_rows(scene)[self._first_end :] if not row.is_equality]
        self._ends = slice(len(path), len(path) + len(success))
        self._tolerances = np.array([row.tolerance for row in (*path, *success)])
        self._at_end = np.array([*held_at_end, *[True] * len(success)])
        self._is_penalized = np.array([not row.is_rate for row in path_rows(scene)], np.bool_)
        self._priced = np.concatenate([priced_rows(scene), np.ones(len(success), np.bool_)])
        self.prices, self.cost = np.where(self._priced, LEAST, 0.0), 0.0
        self.prices[self._ends] = 0.0
        self.hardening = 0.0
        m, stages = n_multipliers(scene), decisions + 1 if self.is_constrained else 1
        self.parameters = np.zeros((stages, count, kernels.n_p + 2 * m), kernels.dtype)
        self._multipliers, self._penalties = np.split(self.parameters[..., kernels.n_p :], 2, axis=-1)

    @property
    def is_constrained(self) -> bool:
        """Whether a row along the path has a price."""
        return bool(self._priced[self._path].any())

    @property
    def are_strict(self) -> bool:
        """Whether rows along the path have prices, or one of success can rise no further."""
        return self.is_constrained or bool((self.prices[self._ends] >= AT_END.dearest).any())

    def prepare(self, parameters: Array, emphasis: float) -> None:
        """Take the scene's parameters of each decision and the end, (K + 1, B, n_p), and the end's emphasis.

        The emphasis multiplies all of the terminal cost but the base's velocity: here, not the penalties.
        """
        self.parameters[..., : self._kernels.n_p] = parameters[-len(self.parameters) :]
        path, penalties = self._path, STIFFNESS / self._tolerances
        penalties[self._ends] *= STIFFER**self.hardening
        multipliers = self.prices / self._tolerances * self.cost
        multipliers[path] /= self._kernels.scene.simulation.steps
        self._multipliers[:-1, :, path], self._penalties[:-1, :, path] = multipliers[path], penalties[path]
        multipliers[path] *= self._last_weight
        n_end = int(self._at_end.sum())  # those of what is exact, which come after, stay zero
        self._multipliers[-1, :, :n_end] = multipliers[self._at_end] / emphasis
        self._penalties[-1, :, :n_end] = penalties[self._at_end]

    def follow_path(self, states: Array, inputs: Array, parameters: Array) -> None:
        """Let the prices of the path follow what episodes violate after each decision's step.

        Args:
            states: Shape (K + 1, B, n_x).
            inputs: Shape (K + 1, B, n_u).
            parameters: Shape (K + 1, B, n_p).
        """
        kernels, rows = self._kernels, len(inputs[:-1]) * inputs.shape[1]
        after, held, given = (
            np.reshape(each, (rows, each.shape[-1])) for each in (states[1:], inputs[:-1], parameters[1:])
        )
        residuals = kernels.constraints(after, held, given if kernels.n_p else None)[:, self._is_penalized]
        worst = residuals.reshape(len(inputs) - 1, inputs.shape[1], -1).max(axis=0)
        priced = max(1, int((self.prices[self._path] > LEAST).sum()))
        most = ALONG.most * FEWER**self.hardening
        self._follow(self._path, worst, ALONG._replace(allowed=ALONG.allowed / priced, most=most))

    def follow_ends(self, states: Array, parameters: Array) -> None:
        """Let the prices of success follow where episodes end, with states (B, n_x), parameters (B, n_p)."""
        kernels = self._kernels
        residuals = kernels.terminal_constraints(states, p=parameters if kernels.n_p else None)
        count = self._ends.stop - self._ends.start
        self._follow(self._ends, residuals[:, self._first_end :][:, :count], AT_END)

    def _follow(self, rows: slice, worst: Array, ascent: _Ascent) -> None:
        """Let the prices of rows follow the largest residuals of episodes, (B, r), but of lost ones."""
        worst = worst[~np.isnan(worst).any(axis=1)]
        if not len(worst):
            return
        charged, close, allowed, most, fastest, dearest = ascent
        relative = worst / self._tolerances[rows]
        violating = np.minimum((relative > charged).mean(axis=0), most)
        near = np.minimum((relative > close).mean(axis=0) / most, 1.0)
        factors = np.exp(fastest * ((violating - most) / most + near * (1.0 - allowed / most)))
        prices = np.clip(self.prices[rows] * factors, LEAST, dearest)
        self.prices[rows] = np.where(self._priced[rows], prices, 0.0)
