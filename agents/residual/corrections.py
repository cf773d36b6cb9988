"""Corrections of plans: their observations, and controllers that add them to a plan with its gains."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from agents.evaluation.plans import FloatArray, Followed, Plans
from agents.policies import ExportedPolicy
from dq_space_arm_env import Kernels, Scene, compile_scene
from dq_space_arm_env.common.shown_text import shortened
from dq_space_arm_env.environment.rollouts import StateFeedback
from dq_space_arm_env.task.step_report import n_observations

SMALL = 0.02
"""Deviations below this size are observed nearly linearly, rad, m, rad/s, m/s."""
_SETTINGS = {"action_scale", "repeat", "memory", "full_authority"}
"""Of `correcting`, in the metadata of a policy."""


class CorrectionObserver:
    """Observations that corrections are chosen by, float32, for B flights at one stage.

    They hold the environment's observation of the measured state; the deviation from the plan in tangent
    coordinates, at this stage and averaged over the last ones, which distinguishes wrong masses from noise;
    and the action of the plan with its gains. Deviations range from hundredths to units, and are scaled as
    asinh(d / `SMALL`) to resolve both.
    """

    def __init__(self, scene: Scene, memory: float, full_authority: float) -> None:
        """Time constant of the average, s; averaged deviation at which corrections count in full."""
        self._full = full_authority
        self._kernels = compile_scene(scene)
        self._dt, self._steps = scene.simulation.dt, scene.simulation.steps
        self._share = min(1.0, self._dt / memory)
        self.average: FloatArray | None = None
        self._parameters: FloatArray | None = None
        self._stages: FloatArray | None = None

    @staticmethod
    def size(kernels: Kernels) -> int:
        """Entries of an observation."""
        return n_observations(kernels.scene) + 2 * kernels.n_t + kernels.n_u

    def reset(self, parameters: FloatArray | None = None) -> None:
        """Clear the average; what varies in the plans' scene, shape (B, n_p), is nominal unless given."""
        self.average, self._parameters = None, parameters
        self._stages = None  # parameters by stage, shape (B, N + 1, n_p), of moving targets or phases
        if self._kernels.parameters.moving or self._kernels.parameters.staged:
            known = [None] if parameters is None else list(parameters)
            self._stages = np.stack([self._kernels.stage_parameters(each) for each in known])

    def authority(self) -> FloatArray:
        """Share of corrections that counts, in [0, 1], shape (B, 1): it grows with the averaged deviation."""
        assert self.average is not None
        size = np.linalg.norm(self.average, axis=1, keepdims=True)
        return np.asarray(np.minimum(1.0, size / self._full))

    def __call__(self, stage: int, measured: FloatArray, followed: Followed) -> NDArray[np.float32]:
        """Observe measured states, shape (B, n_x), once per stage."""
        if self.average is None:
            self.average = np.zeros_like(followed.deviation)
        self.average += self._share * (followed.deviation - self.average)
        time_left = np.full((len(measured), 1), (self._steps - stage) * self._dt)
        parameters = self._parameters if self._stages is None else self._stages[:, stage]
        seen = self._kernels.observation(measured, time_left, p=parameters)[0]
        deviations = (np.arcsinh(each / SMALL) for each in (followed.deviation, self.average))
        parts = (seen, *deviations, followed.action)
        return np.concatenate(parts, axis=1).astype(np.float32)


def correction(policy: ExportedPolicy, scene: Scene, plans: Plans) -> StateFeedback:
    """Fly plans of a scene with their gains and the corrections of an exported policy."""
    return correcting(scene, plans, policy, **correction_settings(policy, scene))


def correction_settings(policy: ExportedPolicy, scene: Scene) -> dict[str, Any]:
    """Settings of an exported correction; ValueError if it is none, or does not fit the scene."""
    settings = policy.metadata.get("residual")
    if settings is None:
        raise ValueError(
            "policy: chooses actions rather than corrections of a plan; evaluate it with "
            "`dq-space-arm evaluate`"
        )
    kernels = compile_scene(scene)
    expected, actual = (
        (CorrectionObserver.size(kernels), kernels.n_u),
        (policy.n_observation, policy.n_action),
    )
    if actual != expected:
        raise ValueError(
            f"policy: corrects scene {policy.metadata.get('scene')!r}, with {actual[0]} observed numbers "
            f"and {actual[1]} inputs; scene {scene.name!r} has {expected[0]} and {expected[1]}"
        )
    _check_settings(settings, kernels.n_u)
    return dict(settings)


def _check_settings(settings: Any, n_u: int) -> None:
    """Refuse settings that no training has noted: anybody may have written the metadata of a policy."""
    if not isinstance(settings, Mapping) or set(settings) != _SETTINGS:
        wanted = ", ".join(sorted(_SETTINGS))
        raise ValueError(f"policy: residual: {shortened(settings)}, should be a mapping of {wanted}")
    repeat, scale = settings["repeat"], settings["action_scale"]
    if isinstance(repeat, bool) or not isinstance(repeat, int) or repeat < 1:
        raise ValueError(
            f"policy: residual.repeat: {shortened(repeat)}, should be a whole number, at least 1"
        )
    for name in ("memory", "full_authority"):
        if not _is_number(settings[name]) or settings[name] <= 0.0:
            raise ValueError(f"policy: residual.{name}: {shortened(settings[name])}, should be positive")
    scales: list[Any] = scale if isinstance(scale, list) and len(scale) == n_u else [None]
    if not all(_is_number(each) and 0.0 <= each <= 1.0 for each in scales):
        raise ValueError(
            f"policy: residual.action_scale: {shortened(scale)}, should be {n_u} numbers from 0 to 1"
        )


def _is_number(value: Any) -> bool:
    return isinstance(value, int | float) and not isinstance(value, bool) and math.isfinite(value)


def correcting(
    scene: Scene,
    plans: Plans,
    policy: Callable[[NDArray[Any]], NDArray[Any]],
    *,
    action_scale: ArrayLike,
    repeat: int,
    memory: float,
    full_authority: float,
) -> StateFeedback:
    """Fly plans with their gains and a correction: clip(plan's action + authority * correction).

    Args:
        scene: The scene of the plans.
        plans: A plan for each flight.
        policy: Corrections, shape (B, n_u), fractions of limits, for observations of `CorrectionObserver`.
        action_scale: Largest corrections, shape (n_u,), fractions of limits.
        repeat: Time steps for which a correction is held.
        memory: Time constant of the averaged deviation, s.
        full_authority: Size of the averaged deviation at which corrections count in full. The authority is
            zero on the plan, where there is nothing to correct.
    """
    kernels, observer = compile_scene(scene), CorrectionObserver(scene, memory, full_authority)
    scale, held = np.asarray(action_scale, dtype=np.float64), np.zeros(kernels.n_u)

    def act(states: FloatArray, stage: int) -> FloatArray:
        nonlocal held
        followed = plans.follow(kernels, stage, states)
        seen = observer(stage, states, followed)
        if stage % repeat == 0:
            held = policy(seen)
        return corrected(followed.action, held, scale, observer.authority())

    return StateFeedback(act, lambda environment: observer.reset(plans.known))


def corrected(
    action: FloatArray, correction: NDArray[Any], scale: FloatArray, authority: ArrayLike = 1.0
) -> FloatArray:
    """Add bounded corrections to actions, all in fractions of limits, shape (B, n_u)."""
    return np.asarray(np.clip(action + authority * np.clip(correction, -scale, scale), -1.0, 1.0))
