"""Imitation: networks learn the expert's maneuvers from demonstrations.

`clone` trains a network on the expert's actions (behavior cloning), on its feedback gains (the policy's
derivative should match them), and on states around the demonstrations with actions extrapolated by the gains
(augmentation), each weighted by the settings. `aggregate` flies the network, has the expert label the states
it visits, and keeps training (DAgger). `action_chunking` trains a transformer on the actions that follow a
time step (ACT). Importing this package loads no PyTorch; training does.
"""

from __future__ import annotations

from importlib import import_module
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from agents.imitation.aggregation import Aggregated, aggregate
    from agents.imitation.cloning import Cloned, Making, clone
    from agents.imitation.imitation_training import train_by_imitation

__all__ = ["Aggregated", "Cloned", "Making", "aggregate", "clone", "train_by_imitation"]

_HOMES = {
    "Aggregated": "aggregation",
    "aggregate": "aggregation",
    "Cloned": "cloning",
    "Making": "cloning",
    "clone": "cloning",
    "train_by_imitation": "imitation_training",
}


def __getattr__(name: str) -> Any:
    if name not in _HOMES:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    try:
        module = import_module(f"{__name__}.{_HOMES[name]}")
    except ModuleNotFoundError as error:
        if error.name != "torch":
            raise
        raise ImportError(f'{name} needs torch: pip install "dq-space-arm[agents]"') from error
    return getattr(module, name)
