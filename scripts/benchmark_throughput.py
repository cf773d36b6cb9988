"""Time the compiled kernels and the environments on one thread, beside Pinocchio and MuJoCo if installed.

For each scene: forward dynamics and integrator steps in ns per state, by scalar and by vector code;
environment steps per second; and how far the engines' results are apart. Then the time that a new process
needs. The output folder gets throughput.json and, with the extra `plots`, throughput.png.
Every number is the best of several samples, with the median beside it: on a shared machine the best says what
the code can do, and a median far above it that the machine was busy.
Exit status: 0; 2 if the input is unusable; 130 if interrupted.
"""

import argparse
import importlib.metadata
import platform
import sys
from collections.abc import Sequence
from dataclasses import asdict
from importlib.util import find_spec
from pathlib import Path
from typing import Any

from rich.console import Console

from dq_space_arm_env import SceneError, list_scenes, load_scene
from experts.report import to_json, write_atomically
from experts.report.provenance import provenance
from experts.report.start_up import measure_start_up
from experts.report.throughput import QUICK, Effort, measure_scene, to_record
from experts.report.throughput_tables import print_scene, print_start_up

SUCCESS, UNUSABLE, INTERRUPTED = 0, 2, 130
SCENES = ("paper", "planar", "six-joint")


def main(arguments: Sequence[str] | None = None) -> int:
    """Run the script.

    Args:
        arguments: Command line without the program's name; that of the process if None.

    Returns:
        Exit status.
    """
    options = _parse(arguments)
    console = Console(highlight=False)
    effort = QUICK if options.quick else Effort()
    names = list_scenes() if options.all else options.scene or SCENES[: 1 if options.quick else None]
    try:
        scenes = [load_scene(name) for name in names]
        options.out.mkdir(parents=True, exist_ok=True)
        results = []
        for scene in scenes:
            results.append(measure_scene(scene, effort))
            print_scene(console, results[-1])
        start_up = measure_start_up(scenes[0], effort.repeats)
        print_start_up(console, scenes[0].name, start_up)
        record = {
            "effort": asdict(effort),
            "threads": 1,
            "scenes": [to_record(result) for result in results],
            "start_up": {"scene": scenes[0].name, "unit": "s", **start_up},
            **_provenance(),
        }
        write_atomically(options.out / "throughput.json", to_json(record))
        files = ["throughput.json"]
        if options.picture and find_spec("matplotlib") is None:
            console.print(
                'No picture: it needs matplotlib (pip install "dq-space-arm[plots]").', markup=False
            )
        elif options.picture:
            from experts.report.figures.throughput import picture

            write_atomically(options.out / "throughput.png", picture(results))
            files.append("throughput.png")
    except (SceneError, ValueError, OSError) as error:
        Console(stderr=True, highlight=False).print(str(error), style="red", markup=False)
        return UNUSABLE
    except KeyboardInterrupt:
        console.print("Interrupted: nothing is saved.")
        return INTERRUPTED
    console.print(f"{options.out}: {', '.join(files)}", markup=False)
    return SUCCESS


def _parse(arguments: Sequence[str] | None) -> argparse.Namespace:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    scenes = parser.add_mutually_exclusive_group()
    scenes.add_argument(
        "--scene",
        action="append",
        help=f"name of a shipped scene, or path of a YAML file; repeatable (default: {', '.join(SCENES)})",
    )
    scenes.add_argument("--all", action="store_true", help="all shipped scenes")
    parser.add_argument(
        "--quick", action="store_true", help="three batch sizes, short samples, by default one scene"
    )
    parser.add_argument("--out", type=Path, default=Path("results/throughput"), help="output folder")
    parser.add_argument("--no-picture", dest="picture", action="store_false", help="tables and JSON only")
    return parser.parse_args(arguments)


def _provenance() -> dict[str, Any]:
    """Where the numbers come from, with the peers' versions and the processor's own name."""
    record = provenance()
    for package in ("pin", "mujoco"):
        try:
            record["versions"][package] = importlib.metadata.version(package)
        except importlib.metadata.PackageNotFoundError:
            record["versions"][package] = None
    record["machine"]["processor_name"] = _processor_name()
    return record


def _processor_name() -> str:
    information = Path("/proc/cpuinfo")
    if information.exists():
        for line in information.read_text(encoding="utf-8").splitlines():
            if line.startswith("model name"):
                return line.partition(":")[2].strip()
    return platform.processor() or platform.machine()


if __name__ == "__main__":
    sys.exit(main())
