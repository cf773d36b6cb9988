"""`dq-space-arm info`, for bug reports, and --version."""

import os
import re
import sys
from pathlib import Path
from typing import Any

import click

from dq_space_arm_env.command_line.names import package_folder, scene_files
from dq_space_arm_env.command_line.policy_sources import policy_names
from dq_space_arm_env.command_line.verb import json_option
from dq_space_arm_env.common.console import print_document, table_console
from dq_space_arm_env.common.entry_points import entry_points, load
from dq_space_arm_env.common.host_machine import processors

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
"""Environment variables that affect the program."""


def package_version() -> str:
    """Read the version of the package without importing it."""
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


@click.command(
    short_help="Show versions, machine and caches, for a bug report.",
    epilog="""\b
        Examples:
          dq-space-arm info          # for people
          dq-space-arm info --json   # for programs
          dq-space-arm info --speed  # how fast this machine is
    """,
)
@click.option("--speed", is_flag=True, help="Measure steps and solutions, beside a reference, in seconds.")
@json_option
def info(speed: bool, as_json: bool) -> None:
    """Show versions, machine and caches, to paste into a bug report; or how fast the machine is."""
    if speed:
        _show_speed(as_json)
        return
    found = gather()
    if as_json:
        print_document(found)
        return
    from dq_space_arm_env.common.tables import plain_table

    console = table_console()
    for title, values in found.items():
        rows = [(name, _text(value)) for name, value in values.items()]
        console.print(plain_table(title, ("", ""), rows))


def _show_speed(as_json: bool) -> None:
    """Measure what packages offer to measure."""
    from dq_space_arm_env.common.provenance import provenance
    from dq_space_arm_env.common.tables import Column, tabulate

    rows = [row for reference in entry_points("dq_space_arm.speeds").values() for row in load(reference)()]
    if as_json:
        print_document({"speed": rows, "machine": provenance()["machine"]})
        return
    columns = (
        Column("measured", ""),
        Column("seconds", "here", _duration),
        Column("reference_seconds", "reference", _duration),
        Column("ratio", "ratio", ".2f"),
        Column("per_second", "a second", lambda rate: f"{rate:,.0f}"),
    )
    machine = provenance()["machine"]["processor_name"]
    title = (
        f"Scene paper, one core of {machine}\nThe best of some samples; the reference is a virtual AMD EPYC."
    )
    table_console().print(tabulate(title, rows, columns).for_terminal())


def _duration(seconds: float) -> str:
    """A time with its unit."""
    units = (("ns", 1e9), ("us", 1e6), ("ms", 1e3), ("s", 1.0))
    unit, scale = next((each for each in units if seconds * each[1] < 1e3), units[-1])
    return f"{seconds * scale:.3g} {unit}"


def gather() -> dict[str, dict[str, Any]]:
    """Describe this installation."""
    import dq_space_arm_env
    from dq_space_arm_env.common.provenance import provenance

    required = _required()
    origin = provenance("torch", *(name for names in required.values() for name in names))
    versions = origin["versions"]
    extras = {
        extra: {name: versions.pop(name) for name in names if name in versions}
        for extra, names in required.items()
        if extra
    }
    return {
        "dq-space-arm": {
            "version": dq_space_arm_env.__version__,
            "folder": str(Path(dq_space_arm_env.__file__).parent),
            "commit": origin["commit"],
            "scenes": len(scene_files()),
            "policies": len(policy_names()),
            "verbs": ", ".join(entry_points("dq_space_arm.verbs")),
        },
        "versions": {name: version for name, version in versions.items() if name != "dq-space-arm"},
        "extras": extras,
        "machine": {
            **origin["machine"],
            "processors": os.cpu_count(),
            "processors for this process": processors(),
            "memory_GB": _memory(),
            "python": sys.executable,
            "terminal": sys.stdout.isatty(),
            "encoding": sys.stdout.encoding,
        },
        "caches": caches(),
        "environment": {name: os.environ.get(name) for name in VARIABLES},
    }


def _required() -> dict[str, list[str]]:
    """List the required packages by extra; those of the core under an empty name."""
    from importlib.metadata import requires

    required: dict[str, list[str]] = {}
    for requirement in requires("dq-space-arm") or ():
        package = re.match(r"[\w.-]+", requirement)
        extra = re.search(r"extra == ['\"](\w+)", requirement)
        if package and package[0] != "dq-space-arm":
            required.setdefault(extra[1] if extra else "", []).append(package[0])
    return dict(sorted(required.items()))


def caches() -> dict[str, Any]:
    """Measure the caches."""
    from dq_space_arm_env.common.code_cache import cache_directory

    folder = cache_directory()
    # Path.exists would fail below a folder that may not be entered.
    nearest = next(path for path in (folder, *folder.parents) if os.path.lexists(path))
    return {
        "folder": str(folder),
        "writable": os.access(nearest, os.W_OK),
        "compiled kernels": _size(folder, ".kernel"),
        "optimal costs": _size(folder / "optimal-costs"),
    }


def _size(folder: Path, ending: str = "") -> dict[str, Any]:
    """Count files and their bytes in a folder; none where it cannot be read."""
    found = ((inner, name) for inner, _, names in os.walk(folder) for name in names)
    paths = (Path(inner, name) for inner, name in found if name.endswith(ending))
    sizes = [path.stat().st_size for path in paths if path.is_file()]
    return {"files": len(sizes), "MB": round(sum(sizes) / 1e6, 1)}


def _memory() -> float | None:
    """Memory of the machine, GB; None where the system does not say."""
    try:
        return round(os.sysconf("SC_PHYS_PAGES") * os.sysconf("SC_PAGE_SIZE") / 1e9, 1)
    except (AttributeError, ValueError, OSError):
        return None


def _text(value: Any) -> str:
    """Write a value for people: missing ones as a dash, nested ones on a line."""
    if value is None:
        return "-"
    if isinstance(value, bool):
        return "yes" if value else "no"
    if isinstance(value, dict):
        return ", ".join(f"{name} {_text(part)}" for name, part in value.items())
    return str(value)
