"""Policies: small networks that choose an action from an observation.

`ExportedPolicy` is a trained network as arrays in one file; it needs NumPy alone. `PolicyNetwork` is the same
network in PyTorch, to be trained, and exports itself. Importing this package loads no PyTorch; using
`PolicyNetwork` does.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

from agents.policies.exported import ExportedPolicy, PolicyFileError

if TYPE_CHECKING:
    from agents.policies.network import PolicyNetwork

__all__ = ["ExportedPolicy", "PolicyFileError", "PolicyNetwork"]


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
