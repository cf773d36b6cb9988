"""Running episodes as arrays by name: saved, put back, and kept by `copy.deepcopy` and `pickle`."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np
from gymnasium.utils import EzPickle
from numpy.typing import NDArray

from dq_space_arm_env.common.shown_text import shortened

Array = NDArray[Any]


class PicklesEpisodes(EzPickle):
    """Pickles the arguments of an environment, its specification, and its running episodes."""

    def __getstate__(self: Any) -> dict[str, Any]:
        running = self.get_state() if self._begun else None
        return {**EzPickle.__getstate__(self), "spec": self.spec, "state": running}

    def __setstate__(self: Any, d: dict[str, Any]) -> None:
        EzPickle.__setstate__(self, d)
        self.spec = d["spec"]
        if d["state"] is not None:
            self.set_state(d["state"])


def checked_state(state: Mapping[str, Any], expected: Mapping[str, Array], steps: int) -> dict[str, Array]:
    """Arrays of a saved state with the names, shapes and types of those expected; others are passed over.

    Raises:
        ValueError: If the state is no mapping, an array is missing, or has another shape or type, or the
            memory counts a number of steps that an episode of so many does not have.
    """
    if not isinstance(state, Mapping):
        raise ValueError(f"state: {shortened(state)}, should be what get_state() returns")
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
    return found
