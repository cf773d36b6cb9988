"""Where the payload is while the tip does not hold it: with the target, or adrift since it was let go.

Its frame is that of the tip that holds it. Until a catch it coincides with the target q_{D/I}. What has been
let go keeps the twist that it had: it moves by q exp(t xi).
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from dq_space_arm_env.algebra import dual_quaternion, dual_vectors, screw
from dq_space_arm_env.scene.schema import Scene

if TYPE_CHECKING:
    from dq_space_arm_env.kernels import Kernels

Array = NDArray[Any]
FloatArray = NDArray[np.float64]

AT_TIP, AT_TARGET = -1, -2
"""Places of the payload; another number is the phase that has begun with it adrift."""


def leaves_tip(scene: Scene) -> bool:
    """Tell whether the tip of a scene does not hold its payload in some phase.

    Args:
        scene: The scene.

    Returns:
        Whether pictures have to place the payload.
    """
    return scene.payload is not None and bool(scene.phases) and 0.0 in _masses(scene)


def _masses(scene: Scene) -> tuple[float, ...]:
    """Mass of the payload in each phase, kg; 0 where it is not held."""
    assert scene.payload is not None
    nominal = (scene.payload.mass,) * len(scene.phases)
    return scene.staged.values.get("payload.mass", nominal)


def payload_places(scene: Scene) -> NDArray[np.intp]:
    """Find where the payload of a scene is in each phase.

    Args:
        scene: The scene, with phases and a payload.

    Returns:
        AT_TIP, AT_TARGET, or the phase since which it drifts, shape (2, phases): first where the catches
        before have failed, then where they have not.
    """
    phases = range(len(scene.phases))
    return np.array([[_place(scene, phase, caught) for phase in phases] for caught in (False, True)])


def _place(scene: Scene, phase: int, caught: bool) -> int:
    held, (_, _, resting, catches) = [mass != 0.0 for mass in _masses(scene)], scene.staged
    missed = None if caught else next((each for each in range(phase, -1, -1) if catches[each]), None)
    if held[phase] and missed is None:
        return AT_TIP
    if not held[phase] and any(catches[phase + 1 :]):
        return AT_TARGET
    if missed is not None:  # it goes on with the target, unless that is now a place where the tip should rest
        return AT_TARGET if resting[phase] is None else missed
    before = next((each for each in range(phase, -1, -1) if held[each]), None)
    return AT_TARGET if before is None else before + 1


def payload_path(scene: Scene, tips: ArrayLike, targets: ArrayLike, caught: bool = True) -> FloatArray | None:
    """Find the poses of the payload's frame during a flight.

    Args:
        scene: The scene.
        tips: Poses of the tip q_{G/I} at the states, shape (M + 1, 8), dimensionless and m.
        targets: Desired poses of the tip q_{D/I}, shape (M + 1, 8), or (8,) at rest, same units.
        caught: Whether the catches have not failed.

    Returns:
        Poses in the inertial frame, shape (M + 1, 8), same units; None where the payload is at the tip.
    """
    if not leaves_tip(scene):
        return None
    path = np.array(tips, dtype=np.float64)
    aims = np.broadcast_to(np.asarray(targets, dtype=np.float64), path.shape)
    starts = scene.staged.starts
    places = payload_places(scene)[int(caught)][_phases_at(starts, np.arange(len(path)))]
    path[places == AT_TARGET] = aims[places == AT_TARGET]
    for phase in np.unique(places[places >= 0]):
        start, rows = starts[phase], np.flatnonzero(places == phase)
        # What is let go was at the tip; what is missed, with the target until the step before.
        last, source = (start - 1, aims) if _masses(scene)[phase] else (start, path)
        now, before = tuple(source[last]), tuple(source[max(last - 1, 0)])
        step = screw.logarithm(dual_quaternion.multiply(dual_quaternion.conjugate(before), now))
        path[rows] = _drifted(now, step, rows - last)
    return path


def _phases_at(starts: ArrayLike, stages: ArrayLike) -> NDArray[np.intp]:
    """Phases of the steps that follow stages, given the first stages of phases; shape of the stages."""
    return np.searchsorted(starts, stages, side="right") - 1


def _drifted(pose: Any, twist: Any, times: Array) -> FloatArray:
    """Poses q exp(t xi) at some times, shape (times, 8)."""
    moved = screw.exponential(dual_vectors.scale(times.astype(np.float64), twist))
    return np.stack(np.broadcast_arrays(*dual_quaternion.multiply(pose, moved)), axis=-1)


class Payloads:
    """Places of the payloads of `count` running episodes.

    Attributes:
        releases: First stages of the phases in which the tip lets it go.
        adrift: What each payload that the tip has let go began with, shape (count, 15): stage; pose,
            dimensionless and m; twist in its own axes, rad/s and m/s. NaN where there is none.
    """

    def __init__(self, kernels: Kernels, count: int) -> None:
        scene = kernels.scene
        self._kernels, self._starts, self._may_miss = kernels, scene.staged.starts, any(scene.staged.catches)
        self._places_by_phase = payload_places(scene)
        self.releases = tuple(
            start
            for phase, (start, mass) in enumerate(zip(self._starts, _masses(scene), strict=True))
            if not mass and phase in self._places_by_phase[:, phase]
        )
        self.adrift: FloatArray = np.full((count, 15), np.nan)

    def follow(self, x: Array, memory: Array) -> None:
        """Keep where payloads are let go.

        Args:
            x: States after a step, shape (count, n_x), units of the state.
            memory: What the step hands to the next, shape (count, n).
        """
        rows = np.flatnonzero((memory[:, :1] == self.releases).any(axis=1))
        if len(rows):  # of which some may have missed it before
            places = self._places(memory[rows])
            rows = rows[(places >= 0) & (np.take(self._starts, places) == memory[rows, 0])]
            poses, twists = self._kernels.tip_pose(x[rows]), self._kernels.tip_twist(x[rows])
            self.adrift[rows] = np.column_stack([memory[rows, 0], poses, twists])

    def poses(self, memory: Array, parameters: Array, targets: Array) -> list[Array | None]:
        """Poses of the payloads' frames now; None at the tip.

        Args:
            memory: What the last step hands to the next, shape (count, n).
            parameters: Of the episodes, shape (count, n_p), units of the parameters.
            targets: Poses q_{D/I} now, shape (count, 8), dimensionless and m.

        Returns:
            A pose, shape (8,), dimensionless and m, or None for each.
        """
        found: list[Array | None] = []
        for row, place in enumerate(self._places(memory)):
            if place == AT_TIP:
                found.append(None)
            elif place == AT_TARGET:
                found.append(targets[row])
            else:
                begun = self.adrift[row]
                if np.isnan(begun[0]):
                    begun = self._missed(int(place), parameters[row])
                seconds = (memory[row, :1] - begun[0]) * self._kernels.scene.simulation.dt
                found.append(_drifted(tuple(begun[1:9].tolist()), tuple(begun[9:].tolist()), seconds)[0])
        return found

    def _places(self, memory: Array) -> NDArray[np.intp]:
        caught = memory[:, -1] != 0.0 if self._may_miss else np.ones(len(memory), dtype=np.bool_)
        phases = _phases_at(self._starts, memory[:, 0])
        return np.asarray(self._places_by_phase[caught.astype(int), phases])

    def _missed(self, phase: int, parameters: Array) -> FloatArray:
        """A payload that was missed as a phase began: it was where the target was a step before."""
        kernels, stage = self._kernels, self._starts[phase] - 1
        row = kernels.stage_parameters(parameters)[stage]
        layout = kernels.layout
        return np.array([stage, *layout.target_with(row), *layout.target_velocity_with(row)])
