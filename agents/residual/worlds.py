"""Worlds that differ from a plan: other masses, pushes that change velocities, noise on measurements."""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray

from dq_space_arm_env import Scene, compile_scene
from dq_space_arm_env.kernels.report import STATE_LIMIT
from experts.report.solvers.receding import with_masses

FloatArray = NDArray[np.float64]


class Disturbance(NamedTuple):
    """What happens to B flights in one time step.

    Attributes:
        jump: Of the states in tangent coordinates, shape (B, n_t); only of the base's velocities.
        noise: On what is measured then, in tangent coordinates, shape (B, n_t).
    """

    jump: FloatArray
    noise: FloatArray


class Disturbances:
    """Draws what happens to B flights, step by step; equal generators give equal draws, whoever flies."""

    def __init__(
        self, scene: Scene, noise: ArrayLike, push: ArrayLike, pushes: float, rng: np.random.Generator
    ) -> None:
        """Take what is to be drawn.

        Args:
            scene: The scene.
            noise: Standard deviation on every tangent coordinate, shape (B,), rad, m, rad/s, m/s.
            push: Standard deviation of the jumps of the base's velocities, shape (B,), rad/s, m/s.
            pushes: Mean number of jumps in an episode.
            rng: Draws them.
        """
        layout = compile_scene(scene).layout
        self._noise, self._push = (np.asarray(value, np.float64)[:, None] for value in (noise, push))
        self._velocity = layout.tangent.base_velocity
        self._share, self._rng = pushes / scene.simulation.steps, rng
        self._shape = len(self._noise), layout.n_t

    def draw(self) -> Disturbance:
        """Draw what happens in the next step.

        Returns:
            The draw.
        """
        jump = np.zeros(self._shape)
        struck = self._rng.random((self._shape[0], 1)) < self._share
        strength = self._rng.standard_normal(jump[:, self._velocity].shape)
        jump[:, self._velocity] = np.where(struck, self._push * strength, 0.0)
        return Disturbance(jump, self._noise * self._rng.standard_normal(self._shape))


class Worlds:
    """The dynamics of B flights, each with masses of its own, and the cost, which does not depend on them.

    Attributes:
        scene: The plan's scene, in which masses are the nominal ones.
        kernels: Its functions.
        factors: Factor of mass and inertia of the payload, or of the last link without one, shape (B,).
    """

    def __init__(self, scene: Scene, factors: Sequence[float]) -> None:
        """Compile a scene for each of the masses.

        Args:
            scene: The plan's scene.
            factors: B of them.

        Raises:
            ValueError: If the scene has neither payload nor links, and a factor is not 1.
        """
        self.scene, self.factors = scene, np.array(factors, dtype=np.float64)
        if scene.payload is None and not scene.links and (self.factors != 1.0).any():
            raise ValueError(
                f"scene {scene.name!r} has neither payload nor links: mass_factors should be 1 alone"
            )
        self.kernels = compile_scene(scene)
        self._limits = self.kernels.layout.control_limit
        self._groups = [
            (compile_scene(with_masses(scene, float(factor))), np.flatnonzero(self.factors == factor))
            for factor in np.unique(self.factors)
        ]

    def begin(self, starts: FloatArray) -> Flight:
        """Begin flights.

        Args:
            starts: States, shape (B, n_x), units of the state.

        Returns:
            The flights.
        """
        return Flight(self, starts)

    def step(self, states: FloatArray, actions: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Move by one time step.

        Args:
            states: Shape (B, n_x), units of the state.
            actions: Inputs as fractions of their limits, in [-1, 1], shape (B, n_u).

        Returns:
            States, shape (B, n_x), and costs of the step, shape (B,), dimensionless.
        """
        inputs = actions * self._limits
        following = np.empty_like(states)
        for kernels, rows in self._groups:
            following[rows] = kernels.step(states[rows], inputs[rows])
        return following, np.asarray(self.kernels.cost(states, inputs))


class Flight:
    """B flights at the same stage.

    What blows up stays at its last sound state, whose cost it is charged, as in `DQSpaceArmEnv`.

    Attributes:
        states: Shape (B, n_x), units of the state.
        stage: Number of steps so far.
        cost: So far, shape (B,), dimensionless.
        diverged: Whether the simulation blew up, shape (B,).
    """

    def __init__(self, worlds: Worlds, starts: FloatArray) -> None:
        """Begin.

        Args:
            worlds: Where.
            starts: States, shape (B, n_x), units of the state.
        """
        self._worlds, self.states, self.stage = worlds, np.array(starts, dtype=np.float64), 0
        self.cost, self.diverged = np.zeros(len(starts)), np.zeros(len(starts), dtype=np.bool_)

    def measure(self, disturbance: Disturbance) -> FloatArray:
        """Be pushed, and look.

        Args:
            disturbance: What happens.

        Returns:
            States as they are measured, shape (B, n_x), units of the state.
        """
        retract = self._worlds.kernels.retract
        self.states = retract(self.states, disturbance.jump)
        return np.asarray(retract(self.states, disturbance.noise))

    def act(self, actions: FloatArray) -> FloatArray:
        """Take a step.

        Args:
            actions: Inputs as fractions of their limits, in [-1, 1], shape (B, n_u).

        Returns:
            Its costs, shape (B,), dimensionless; that of the last step has the terminal cost.
        """
        following, cost = self._worlds.step(self.states, actions)
        sound = np.isfinite(following).all(axis=1) & (np.abs(following).max(axis=1) < STATE_LIMIT)
        self.diverged |= ~sound
        self.states = np.where(self.diverged[:, None], self.states, following)
        self.stage += 1
        if self.stage == self._worlds.scene.simulation.steps:
            cost = cost + self._worlds.kernels.terminal_cost(self.states)
        self.cost += cost
        return np.asarray(cost)

    def errors(self) -> tuple[FloatArray, FloatArray]:
        """Compare the tip with the target.

        Returns:
            Attitude error, shape (B,), deg, and position error, shape (B,), m.
        """
        no_time = np.zeros((len(self.states), 1))
        angle, distance = self._worlds.kernels.observation(self.states, no_time)[1].T
        return np.degrees(angle), np.asarray(distance)

    def is_success(self) -> NDArray[np.bool_]:
        """Tell which flights have arrived.

        Returns:
            Whether the tip is within the scene's tolerances, shape (B,).
        """
        angle, distance = self.errors()
        tolerances = self._worlds.scene.success
        arrived = (angle <= tolerances.attitude_error_deg) & (distance <= tolerances.position_error)
        return np.asarray(arrived & ~self.diverged)
