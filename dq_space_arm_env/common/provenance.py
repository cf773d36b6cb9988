"""Provenance of a result: versions, commit and machine."""

import importlib.metadata
import platform
import subprocess
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

from dq_space_arm_env.common.host_machine import host_machine

PACKAGES = ("casadi", "gymnasium", "llvmlite", "matplotlib", "numba", "numpy", "pydantic")


def provenance(*peers: str) -> dict[str, Any]:
    """Describe this process: date, commit, versions (also of `peers`), machine; None for what is unknown."""
    return {
        "date": datetime.now(UTC).isoformat(timespec="seconds"),
        "commit": _commit(Path(__file__).resolve().parents[2]),
        "versions": {
            "dq-space-arm": _version("dq-space-arm"),
            "python": platform.python_version(),
            **{package: _version(package) for package in (*PACKAGES, *peers)},
        },
        "machine": {
            "system": platform.platform(),
            "processor": host_machine().cpu,
            "processor_name": _processor_name(),
            "vector_lanes": host_machine().lanes,
        },
    }


def _version(package: str) -> str | None:
    try:
        return importlib.metadata.version(package)
    except importlib.metadata.PackageNotFoundError:
        return None


def _processor_name() -> str:
    information = Path("/proc/cpuinfo")
    if information.exists():
        for line in information.read_text(encoding="utf-8").splitlines():
            if line.startswith("model name"):
                return line.partition(":")[2].strip()
    return platform.processor() or platform.machine()


def _commit(checkout: Path) -> dict[str, Any] | None:
    """Hash of the checked-out commit, and whether files differ from it; None if there is no commit."""

    def git(*arguments: str) -> str:
        command = ["git", "-C", str(checkout), *arguments]
        return subprocess.run(command, capture_output=True, text=True, check=True, timeout=10).stdout.strip()

    try:
        # An installed package may lie inside somebody else's repository.
        if Path(git("rev-parse", "--show-toplevel")).resolve() != checkout.resolve():
            return None
        return {"hash": git("rev-parse", "HEAD"), "modified": bool(git("status", "--porcelain"))}
    except (OSError, subprocess.SubprocessError):
        return None
