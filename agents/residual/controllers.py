"""Who flies several episodes at once: the plan alone, with its gains, with a correction, or replanning."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, Protocol

import numpy as np
from numpy.typing import ArrayLike, NDArray

from agents.plans import FloatArray, Followed, Plans
from agents.policies import ExportedPolicy
from dq_space_arm_env import Kernels, Scene, compile_scene
from experts import RecedingHorizonExpert

SMALL = 0.02
"""Size of deviations up to which they are seen in proportion, rad, m, rad/s, m/s."""


class Controller(Protocol):
    """Chooses actions for B flights at the same stage."""

    def begin(self, plans: Plans) -> None:
        """Begin flights.

        Args:
            plans: Of each of them.
        """

    def __call__(self, stage: int, measured: FloatArray) -> NDArray[Any]:
        """Choose actions.

        Args:
            stage: Stage k; it is called at each, from 0.
            measured: States, shape (B, n_x), units of the state.

        Returns:
            Inputs as fractions of their limits, in [-1, 1], shape (B, n_u).
        """


class OpenLoop:
    """The plan's actions, whatever happens."""

    def begin(self, plans: Plans) -> None:
        """Begin flights, see `Controller`."""
        self._plans = plans

    def __call__(self, stage: int, measured: FloatArray) -> NDArray[Any]:
        """Choose actions, see `Controller`."""
        return self._plans.planned(stage)


class GainScheduled:
    """The plan with its feedback gains."""

    def __init__(self, scene: Scene) -> None:
        """Take the scene of the plans."""
        self._kernels = compile_scene(scene)

    def begin(self, plans: Plans) -> None:
        """Begin flights, see `Controller`."""
        self._plans = plans

    def __call__(self, stage: int, measured: FloatArray) -> NDArray[Any]:
        """Choose actions, see `Controller`."""
        return self._plans.follow(self._kernels, stage, measured).action


class RecedingHorizon:
    """The receding-horizon expert, which plans each flight in the nominal scene and replans at each step."""

    def __init__(self, scene: Scene, horizon: int = 50) -> None:
        """Prepare.

        Args:
            scene: The nominal scene.
            horizon: Stages that it looks ahead.
        """
        self._scene, self._horizon = scene, horizon
        self._experts: list[RecedingHorizonExpert] = []

    def begin(self, plans: Plans) -> None:
        """Begin flights, see `Controller`; it makes plans of its own from where they begin."""
        while len(self._experts) < len(plans):
            self._experts.append(RecedingHorizonExpert(self._scene, self._horizon))
        for expert, state in zip(self._experts, plans.starts, strict=False):
            expert.reset(state)

    def __call__(self, stage: int, measured: FloatArray) -> NDArray[Any]:
        """Choose actions, see `Controller`."""
        return np.stack([expert(state) for expert, state in zip(self._experts, measured, strict=False)])


class Sight:
    """What a correction is chosen by: B observations of a stage, float32.

    That is the environment's observation of what is measured; the deviation from the plan in tangent
    coordinates, of this stage and averaged over the last ones, which tells other masses from noise; and the
    action of the plan with its gains. Deviations are some hundredths where all goes well, and some units
    where it does not: they are shown as asinh(d / `SMALL`), in which both can be told.
    """

    def __init__(self, scene: Scene, memory: float, full_authority: float) -> None:
        """Prepare.

        Args:
            scene: The scene of the plans.
            memory: Time constant of the average, s.
            full_authority: Size of the averaged deviation at which corrections count in full, rad, m, rad/s,
                m/s together.
        """
        self._full = full_authority
        self._kernels = compile_scene(scene)
        self._dt, self._steps = scene.simulation.dt, scene.simulation.steps
        self._share = min(1.0, self._dt / memory)
        self._average: FloatArray | None = None

    @staticmethod
    def size(kernels: Kernels) -> int:
        """Entries of an observation of a scene with these functions."""
        return kernels.n_x + 1 + 2 * kernels.n_t + kernels.n_u

    def begin(self) -> None:
        """Forget what was averaged."""
        self._average = None

    def authority(self) -> FloatArray:
        """Tell how far corrections are trusted at this stage, by how far flights are from their plans.

        Returns:
            Size of the averaged deviation relative to that of full authority, at most 1, shape (B, 1).
        """
        assert self._average is not None
        size = np.linalg.norm(self._average, axis=1, keepdims=True)
        return np.asarray(np.minimum(1.0, size / self._full))

    def __call__(self, stage: int, measured: FloatArray, followed: Followed) -> NDArray[np.float32]:
        """Look, once at each stage.

        Args:
            stage: Stage k, in [0, N).
            measured: States, shape (B, n_x), units of the state.
            followed: What the plans ask for there.

        Returns:
            Shape (B, n_x + 1 + 2 n_t + n_u).
        """
        if self._average is None:
            self._average = np.zeros_like(followed.deviation)
        self._average += self._share * (followed.deviation - self._average)
        time_left = np.full((len(measured), 1), (self._steps - stage) * self._dt)
        seen = self._kernels.observation(measured, time_left)[0]
        deviations = (np.arcsinh(each / SMALL) for each in (followed.deviation, self._average))
        parts = (seen, *deviations, followed.action)
        return np.concatenate(parts, axis=1).astype(np.float32)


class Corrected:
    """The plan with its gains, and a correction added: action = clip(plan's action + authority * correction).

    As long as the flight is as planned there is nothing to correct, and the authority, which grows with the
    deviation from the plan, is zero.
    """

    def __init__(
        self,
        scene: Scene,
        policy: Callable[[NDArray[Any]], NDArray[Any]],
        *,
        action_scale: ArrayLike,
        repeat: int,
        memory: float,
        full_authority: float,
    ) -> None:
        """Take a policy.

        Args:
            scene: The scene of the plans.
            policy: Corrections, shape (B, n_u), fractions of limits, for observations of `Sight`.
            action_scale: Largest corrections, shape (n_u,), fractions of limits.
            repeat: Time steps for which a correction is held.
            memory: Time over which deviations are averaged, s.
            full_authority: Size of the averaged deviation at which corrections count in full.
        """
        self._kernels, self._policy = compile_scene(scene), policy
        self._sight, self._repeat = Sight(scene, memory, full_authority), repeat
        self._scale = np.asarray(action_scale, dtype=np.float64)
        self._correction: NDArray[Any] = np.zeros(self._kernels.n_u)

    @classmethod
    def by(cls, policy: ExportedPolicy, scene: Scene) -> Corrected:
        """Let an exported policy correct.

        Args:
            policy: As the training of a correction exports it.
            scene: The scene of the plans.

        Returns:
            The controller.

        Raises:
            ValueError: If the policy is no correction, or is one for other states or inputs.
        """
        settings = policy.metadata.get("residual")
        if settings is None:
            raise ValueError(
                "policy: chooses actions rather than corrections of a plan; evaluate it by "
                "`dq-space-arm evaluate`"
            )
        kernels = compile_scene(scene)
        expected, actual = (Sight.size(kernels), kernels.n_u), (policy.n_observation, policy.n_action)
        if actual != expected:
            raise ValueError(
                f"policy: corrects scene {policy.metadata.get('scene')!r}, with {actual[0]} observed numbers "
                f"and {actual[1]} inputs; scene {scene.name!r} has {expected[0]} and {expected[1]}"
            )
        return cls(scene, policy, **settings)

    def begin(self, plans: Plans) -> None:
        """Begin flights, see `Controller`."""
        self._plans = plans
        self._sight.begin()

    def __call__(self, stage: int, measured: FloatArray) -> NDArray[Any]:
        """Choose actions, see `Controller`."""
        followed = self._plans.follow(self._kernels, stage, measured)
        seen = self._sight(stage, measured, followed)
        if stage % self._repeat == 0:
            self._correction = self._policy(seen)
        return corrected(followed.action, self._correction, self._scale, self._sight.authority())


def corrected(
    action: FloatArray, correction: NDArray[Any], scale: FloatArray, authority: ArrayLike = 1.0
) -> FloatArray:
    """Add corrections to actions.

    Args:
        action: Shape (B, n_u), fractions of limits.
        correction: Shape (B, n_u), fractions of limits.
        scale: Largest corrections, shape (n_u,), fractions of limits.
        authority: Share of them that counts, in [0, 1], shape (B, 1).

    Returns:
        Within the limits, shape (B, n_u).
    """
    return np.asarray(np.clip(action + authority * np.clip(correction, -scale, scale), -1.0, 1.0))
