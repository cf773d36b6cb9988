"""Running episodes as arrays by name: saved, put back, and kept by `copy.deepcopy` and `pickle`."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np
from gymnasium.utils import EzPickle
from numpy.typing import NDArray

from dq_space_arm_env.common.shown_text import shortened
from dq_space_arm_env.scene import Scene, list_scenes
from dq_space_arm_env.task.step_report import OBSERVATION_LIMIT

Array = NDArray[Any]

# Attributes of Gymnasium's environments that hold random generators, and the seed.
_RANDOM = (
    "_np_random",
    "_np_random_seed",
    "action_space",
    "observation_space",
    "single_action_space",
    "single_observation_space",
)


class PicklesEpisodes(EzPickle):
    """Pickles the arguments of an environment, its specification, its running episodes and its generators."""

    def __getstate__(self: Any) -> dict[str, Any]:
        running = self.get_state() if self._begun else None
        random = {name: self.__dict__[name] for name in _RANDOM if name in self.__dict__}
        return {**EzPickle.__getstate__(self), "spec": self.spec, "state": running, "random": random}

    def __setstate__(self: Any, d: dict[str, Any]) -> None:
        EzPickle.__setstate__(self, d)
        self.spec = d["spec"]
        if d["state"] is not None:
            self.set_state(d["state"])
        self.__dict__.update(d["random"])


def scene_to_copy(given: object, loaded: Scene) -> Scene | str:
    """The scene from which copies are made: the one loaded, since its file or its mapping may change.

    A shipped one keeps its name: copies take longer from a scene, which is validated again.
    """
    return given if isinstance(given, str) and given in list_scenes() else loaded


def checked_state(state: Mapping[str, Any], expected: Mapping[str, Array], steps: int) -> dict[str, Array]:
    """Arrays of a saved state with the names, shapes and types of those expected; others are passed over.

    Raises:
        ValueError: If the state is no mapping, an array is missing, has another shape or type, or numbers
            that are not finite, or so large that an episode would have diverged, or the memory counts a
            number of steps that an episode of so many does not have, or goes on after.
    """
    if not isinstance(state, Mapping):
        raise ValueError(
            f"state: {shortened(state)}, should be what get_state() returns; an episode begins at a state of "
            "the scene by options={'initial_state': x}"
        )
    found = {}
    for name, wanted in expected.items():
        if name not in state:
            raise ValueError(f"state: {name} is missing, should have {wanted.shape}, {wanted.dtype}")
        array = np.asarray(state[name])
        if array.shape != wanted.shape or array.dtype != wanted.dtype:
            raise ValueError(
                f"state: {name} has shape {array.shape}, type {array.dtype}, should have {wanted.shape}, "
                f"{wanted.dtype}"
            )
        found[name] = array
    taken = found.get("memory", np.zeros(1))[..., 0]
    if not ((taken >= 0.0) & (taken <= steps) & (taken % 1.0 == 0.0)).all():
        raise ValueError(f"state: memory counts {taken} steps, should be whole numbers up to {steps}")
    if not np.all(found.get("over", True) | (taken < steps)):
        raise ValueError(f"state: memory counts {taken} steps; after {steps} an episode is over")
    for name, array in found.items():
        # A payload that the tip has not let go is adrift since NaN.
        if name != "adrift" and array.dtype.kind == "f" and not np.isfinite(array).all():
            raise ValueError(f"state: {name} {shortened(array)}, should be finite numbers")
        if name == "x" and np.abs(array).max(initial=0.0) > OBSERVATION_LIMIT:
            raise ValueError(
                f"state: x {shortened(array)}, should be at most {OBSERVATION_LIMIT:g} in size, before which "
                "an episode has diverged"
            )
    return found
