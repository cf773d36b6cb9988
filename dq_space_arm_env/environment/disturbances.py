"""Disturbances of episodes: pushes, noise on measurements and inputs, masses other than the model's."""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray

from dq_space_arm_env.common.real_arrays import real_array
from dq_space_arm_env.kernels import Kernels
from dq_space_arm_env.scene import Scene, StateLayout
from dq_space_arm_env.scene.parameters import Number, body_numbers, is_part
from dq_space_arm_env.scene.start import unit_quaternions

FloatArray = NDArray[np.float64]


class Disturbance(NamedTuple):
    """What disturbs B episodes in one time step; None for nothing."""

    push: FloatArray | None = None  # jump of the state in tangent coordinates, shape (B, n_t)
    measurement: FloatArray | None = (
        None  # noise on the measured state in tangent coordinates, shape (B, n_t)
    )
    inputs: FloatArray | None = None  # noise on the actions, fractions of the limits, shape (B, n_u)


class Disturbances:
    """Random pushes and noise for B episodes, drawn step by step.

    Draws depend on the generator alone: with equal generators all controllers meet the same disturbances.

    Args:
        scene: The scene.
        rng: Source of random numbers.
        push: Standard deviation of the jumps of the base's velocities, shape () or (B,), rad/s and m/s; None
            for no pushes.
        pushes: Mean number of pushes in an episode.
        evenly: Whether pushes come at even intervals instead of at random times.
        measurement: Standard deviation of the noise on every tangent coordinate, shape () or (B,), rad, m,
            rad/s and m/s; None for no noise.
        inputs: Standard deviation of the noise on the inputs, shape (), (B,) or (B, n_u), fractions of the
            limits; None for no noise.
        count: B, if no standard deviation tells it.

    Raises:
        TypeError: If a standard deviation is masked, or not of real numbers.
        ValueError: If one is negative, not finite or of another shape, or `pushes` is negative or not finite.
    """

    def __init__(
        self,
        scene: Scene,
        rng: np.random.Generator,
        *,
        push: ArrayLike | None = None,
        pushes: float = 0.0,
        evenly: bool = False,
        measurement: ArrayLike | None = None,
        inputs: ArrayLike | None = None,
        count: int = 1,
    ) -> None:
        layout, steps = StateLayout.of(scene), scene.simulation.steps
        self._rng, self._step, self._steps = rng, 0, steps
        self._n_t, self._n_u, self._velocity = layout.n_t, layout.n_u, layout.tangent.base_velocity
        if not 0.0 <= pushes < np.inf:
            raise ValueError(f"pushes: {pushes}, should be a finite number of at least 0")
        given = {"push": push, "measurement": measurement, "inputs": inputs}
        columns = {name: _column(name, sigma) for name, sigma in given.items() if sigma is not None}
        self.count = max([count, *map(len, columns.values())])
        pushed = len(range(self._n_t)[self._velocity])
        widths = {"push": pushed, "measurement": self._n_t, "inputs": self._n_u}
        self._push, self._measurement, self._inputs = (
            self._for_episodes(name, columns[name], width) if name in columns else None
            for name, width in widths.items()
        )
        self._probability = pushes / steps
        self._interval = max(steps // int(pushes + 1), 1) if evenly else 0
        self._last = self._interval * int(pushes)  # the steps after the last of these have none

    @property
    def episodes(self) -> int:
        """Number of episodes that `draw` disturbs."""
        return self.count

    def _for_episodes(self, name: str, column: FloatArray, width: int) -> FloatArray:
        """Standard deviations for each episode, shape (B, 1), or for each of its numbers, (B, width)."""
        if column.shape[0] not in (1, self.count) or column.shape[1] not in (1, width):
            raise ValueError(
                f"{name}: shape {column.shape}, should be one row for all of the {self.count} episodes or "
                f"one for each, and in each row one number or {width}"
            )
        return np.broadcast_to(column, (self.count, column.shape[1]))

    def draw(self) -> Disturbance:
        """Draw the disturbances of the next step."""
        push, measurement, inputs = self._draw_push(), None, None
        if self._measurement is not None:
            measurement = self._measurement * self._rng.standard_normal((self.count, self._n_t))
        if self._inputs is not None:
            inputs = self._inputs * self._rng.standard_normal((self.count, self._n_u))
        self._step = (self._step + 1) % self._steps  # the next episode has its own pushes
        return Disturbance(push, measurement, inputs)

    def _draw_push(self) -> FloatArray | None:
        if self._push is None:
            return None
        if not self._interval:
            struck = self._rng.random((self.count, 1)) < self._probability
        elif self._step % self._interval == self._interval - 1 and self._step < self._last:
            struck = np.ones((self.count, 1), dtype=np.bool_)
        else:
            return None
        push = np.zeros((self.count, self._n_t))
        strength = self._rng.standard_normal(push[:, self._velocity].shape)
        push[:, self._velocity] = np.where(struck, self._push * strength, 0.0)
        return push


def _column(name: str, sigma: ArrayLike) -> FloatArray:
    """Standard deviations as rows, one for each episode."""
    found = real_array(name, sigma, np.float64)
    wrong = found[~(np.isfinite(found) & (found >= 0.0))]
    if wrong.size:
        raise ValueError(f"{name}: {wrong[0]}, should be finite and at least 0")
    if found.ndim > 2:
        raise ValueError(f"{name}: shape {found.shape}, should have at most two axes")
    return found if found.ndim == 2 else np.atleast_1d(found)[:, None]


def displaced(kernels: Kernels, x: NDArray[Any], increments: FloatArray) -> NDArray[Any]:
    """Displace states, shape (B, n_x), by tangent coordinates, (B, n_t).

    Quaternions of spherical joints, which a retraction adds to, get their unit length back.
    """
    moved = kernels.retract(x, increments)
    for where in unit_quaternions(kernels.scene):
        rows = (moved[:, where] != x[:, where]).any(axis=1)  # the others keep their bits
        moved[rows, where] /= np.linalg.norm(moved[rows, where], axis=1, keepdims=True)
    return moved


def load_place(scene: Scene) -> str | None:
    """Name the body whose mass differs: "payload", or without one the tip's link; None for a base alone."""
    if scene.payload is not None:
        return "payload"
    return f"links.{scene.tip_body - 1}" if scene.tip_body else None


def load_numbers(scene: Scene) -> list[Number]:
    """Mass and inertia of that body, without the entries that are zero; none for a base alone."""
    place = load_place(scene)
    found = () if place is None else body_numbers(scene, place)
    parts = f"{place}.mass", f"{place}.inertia"
    return [each for each in found if each.nominal and any(is_part(each.name, part) for part in parts)]


def with_loads(
    scene: Scene, factors: ArrayLike, parameters: ArrayLike | None = None
) -> tuple[Scene, FloatArray]:
    """Multiply mass and inertia of the payload, or of the last link if there is no payload.

    One compiled scene serves all factors: mass and inertia are among its parameters.

    Args:
        scene: A scene with a payload or a link, unless all factors are 1.
        factors: Factors of B episodes, shape (B,), dimensionless.
        parameters: What else varies, shape (n_p,) or (B, n_p), units of the parameters; nominal values
            by default.

    Returns:
        The scene to fly in, and the parameters of each episode in it, shape (B, n_p').

    Raises:
        ValueError: If there is no mass to multiply, or phases change it.
    """
    factors = np.asarray(factors, dtype=np.float64)
    names = [number.name for number in load_numbers(scene)]
    changed = [name for name in names if scene.phases and name in scene.staged.values]
    if (factors != 1.0).any() and (not names or changed):
        reason = f"phases that change {changed[0]}" if names else "neither payload nor links"
        raise ValueError(f"scene {scene.name!r} has {reason}: mass_factors should be 1 alone")
    flown, known = scene.replace(parameters=[*scene.parameters, *names]), StateLayout.of(scene).parameters
    varying = StateLayout.of(flown).parameters
    rows = np.tile(varying.nominal, (len(factors), 1))
    rows[:, [varying.names.index(name) for name in known.names]] = (
        known.nominal if parameters is None else parameters
    )
    rows[:, [varying.names.index(name) for name in names]] *= factors[:, None]
    return flown, rows
