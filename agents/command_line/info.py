"""`dq-space-arm info`: versions, machine and caches, what a bug report needs; and --version."""

import os
import re
import sys
from pathlib import Path
from typing import Any

import click

from agents.command_line.names import configuration_files, package_folder, policy_files, scene_files
from agents.command_line.output import print_document, table_console
from agents.command_line.verb import Verb, json_option

EXTRAS = {
    "agents": ("stable-baselines3", "sb3-contrib", "torch", "tensorboard"),
    "docs": ("sphinx", "myst-parser", "furo"),
    "minari": ("minari",),
    "plots": ("matplotlib",),
    "ray": ("ray",),
    "render": ("pygame-ce",),
    "test": ("pytest", "hypothesis", "mpmath", "mujoco", "pin", "scipy"),
}
"""Packages of each extra whose versions matter."""
VARIABLES = (
    "DQ_SPACE_ARM_CACHE",
    "DQ_SPACE_ARM_DEBUG",
    "MINARI_DATASETS_PATH",
    "NO_COLOR",
    "FORCE_COLOR",
    "NUMBA_CACHE_DIR",
    "NUMBA_DISABLE_JIT",
    "OMP_NUM_THREADS",
    "RAY_ADDRESS",
)
"""Environment variables that change what this program does."""


def package_version() -> str:
    """Read the version of this package where it is written, without importing the package.

    Returns:
        For example "0.1.0".

    Raises:
        ImportError: If the package is damaged.
    """
    source = (package_folder("dq_space_arm_env") / "__init__.py").read_text(encoding="utf-8")
    found = re.search(r'^__version__ = "(.+)"$', source, flags=re.MULTILINE)
    if found is None:
        raise ImportError("the package dq_space_arm_env has no version: install dq-space-arm again")
    return found[1]


def _print_version(context: click.Context, parameter: click.Parameter, value: bool) -> None:
    if value and not context.resilient_parsing:
        click.echo(f"{context.find_root().info_name} {package_version()}")
        context.exit()


version_option = click.option(
    "--version",
    is_flag=True,
    is_eager=True,
    expose_value=False,
    callback=_print_version,
    help="Show the version.",
)
"""Adds --version to a program."""


@click.command(
    cls=Verb,
    short_help="Show versions, machine and caches, for a bug report.",
    examples="""
        info          # for people
        info --json   # for programs
    """,
)
@json_option
def info(as_json: bool) -> None:
    """Show versions, machine and caches: paste it into a bug report."""
    found = gather()
    if as_json:
        print_document(found)
        return
    from experts.report.tables import plain_table

    console = table_console()
    for title, values in found.items():
        rows = [(name, _text(value)) for name, value in values.items()]
        console.print(plain_table(title, ("", ""), rows))


def gather() -> dict[str, dict[str, Any]]:
    """Find out about this installation.

    Returns:
        JSON values: this package, versions, extras, machine, caches, environment variables.
    """
    import dq_space_arm_env
    from experts.report.provenance import provenance

    peers = sorted({name for names in EXTRAS.values() for name in names} - {"matplotlib"})
    others = ("click", "platformdirs", "pyyaml", "rich", "safetensors")
    origin = provenance(*others, *peers)
    versions = origin["versions"]
    extras = {
        extra: {name: versions.pop(name) for name in names if name in versions}
        for extra, names in EXTRAS.items()
    }
    return {
        "dq-space-arm": {
            "version": dq_space_arm_env.__version__,
            "folder": str(Path(dq_space_arm_env.__file__).parent),
            "commit": origin["commit"],
            "scenes": len(scene_files()),
            "configurations of agents": len(configuration_files()),
            "policies": len(policy_files()),
        },
        "versions": {name: version for name, version in versions.items() if name != "dq-space-arm"},
        "extras": extras,
        "machine": {
            **origin["machine"],
            "processors": os.cpu_count(),
            "processors for this process": len(os.sched_getaffinity(0))
            if hasattr(os, "sched_getaffinity")
            else os.cpu_count(),
            "memory_GB": _memory(),
            "python": sys.executable,
            "terminal": sys.stdout.isatty(),
            "encoding": sys.stdout.encoding,
        },
        "caches": caches(),
        "environment": {name: os.environ.get(name) for name in VARIABLES},
    }


def caches() -> dict[str, Any]:
    """Measure the caches.

    Returns:
        JSON values: the folder, whether it can be written, and files and megabytes of kernels and of optimal
        costs.
    """
    from dq_space_arm_env.compiler.native import cache_directory

    folder = cache_directory()
    nearest = next(path for path in (folder, *folder.parents) if path.exists())
    return {
        "folder": str(folder),
        "writable": os.access(nearest, os.W_OK),
        "compiled kernels": _size(folder.glob("*.kernel")),
        "optimal costs": _size((folder / "optimal-costs").rglob("*")),
    }


def _size(paths: Any) -> dict[str, Any]:
    sizes = [path.stat().st_size for path in paths if path.is_file()]
    return {"files": len(sizes), "MB": round(sum(sizes) / 1e6, 1)}


def _memory() -> float | None:
    """Memory of the machine, GB; None where it cannot be asked for."""
    try:
        return round(os.sysconf("SC_PHYS_PAGES") * os.sysconf("SC_PAGE_SIZE") / 1e9, 1)
    except (AttributeError, ValueError, OSError):
        return None


def _text(value: Any) -> str:
    """A value for people: missing ones as a dash, nested ones on a line."""
    if value is None:
        return "-"
    if isinstance(value, bool):
        return "yes" if value else "no"
    if isinstance(value, dict):
        return ", ".join(f"{name} {_text(part)}" for name, part in value.items())
    return str(value)
