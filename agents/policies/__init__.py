"""Policies: small networks that map an observation to an action.

`ExportedPolicy` holds a trained network as arrays in one file and needs NumPy alone. `PolicyNetwork` is its
trainable twin in PyTorch, loaded on first use. `ChunkingPolicy` holds a transformer that predicts chunks of
actions in the same way.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

from agents.policies.chunking import ChunkingPolicy
from agents.policies.exported import ExportedPolicy
from agents.policies.policy_files import PolicyFileError

if TYPE_CHECKING:
    from agents.policies.network import PolicyNetwork

__all__ = ["ChunkingPolicy", "ExportedPolicy", "PolicyFileError", "PolicyNetwork"]


def __getattr__(name: str) -> Any:
    if name != "PolicyNetwork":
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    try:
        from agents.policies.network import PolicyNetwork
    except ModuleNotFoundError as error:
        if error.name != "torch":
            raise
        raise ImportError('PolicyNetwork needs torch: pip install "dq-space-arm[agents]"') from error
    return PolicyNetwork
