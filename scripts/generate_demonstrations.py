"""Generate demonstrations: optimal maneuvers from random starts, with feedback gains, to learn from.

The output folder gets settings.json, shards with the demonstrations, and manifest.json once all are there;
then README.md, a data card, and summary/ with a page of their distributions, failures and some trajectories.
A run that was interrupted or killed is resumed by the same command. On a cluster, jobs of an array share a
folder: --shard 1/8 to --shard 8/8, at once or not. With --ray, the machines of a Ray cluster do the work, and
need not share a disk.
Exit status: 0; 1 if the run had to stop, for example because the disk is full; 2 if the input is unusable;
130 if interrupted. What is complete by then remains, and the same command goes on with it.
"""

import argparse
import re
import sys
from collections.abc import Sequence
from pathlib import Path

from rich.console import Console

from dq_space_arm_env import SceneError, load_scene
from experts.demonstrations import (
    Demonstrations,
    DemonstrationsError,
    RayExecutor,
    generate_demonstrations,
)
from experts.demonstrations.progress import GenerationProgress
from experts.demonstrations.settings import SHARD_SIZE
from experts.report.command import INTERRUPTED, SUCCESS, UNUSABLE, complain
from experts.report.demonstrations import write_summary

FAILURE = 1


def main(arguments: Sequence[str] | None = None) -> int:
    """Run the script.

    Args:
        arguments: Command line without the program's name; that of the process if None.

    Returns:
        Exit status.
    """
    options = _parse(arguments)
    console = Console(highlight=False)
    try:
        scene = load_scene(options.scene)
        folder = options.out or Path("results/demonstrations") / re.sub(r"[^\w.-]+", "-", scene.name)
        with GenerationProgress(console) as progress:
            demonstrations = generate_demonstrations(
                scene,
                options.n,
                folder,
                options.seed,
                shard_size=options.shard_size,
                part=options.shard,
                workers=options.workers,
                executor=None if options.ray is None else RayExecutor(options.ray or None),
                progress=progress.update,
            )
        if demonstrations is not None and options.summary:
            write_summary(demonstrations)
    except (SceneError, ValueError) as error:
        complain([str(error)])
        return UNUSABLE
    except (DemonstrationsError, OSError) as error:
        complain([str(error)])
        return FAILURE
    except KeyboardInterrupt:
        console.print("Interrupted. The shards that are complete remain; the same command goes on with them.")
        return INTERRUPTED
    console.print(_verdict(folder, demonstrations), markup=False, soft_wrap=True)
    return SUCCESS


def _parse(arguments: Sequence[str] | None) -> argparse.Namespace:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--scene", default="paper", help="name of a shipped scene, or path of a YAML file")
    parser.add_argument("-n", type=int, default=1000, help="number of problems (default: 1000)")
    parser.add_argument("--seed", type=int, default=0, help="seed of the data set (default: 0)")
    parser.add_argument(
        "--out", type=Path, help="output folder (default: results/demonstrations/<name of the scene>)"
    )
    parser.add_argument(
        "--shard-size", type=int, default=SHARD_SIZE, help=f"problems of a file (default: {SHARD_SIZE})"
    )
    parser.add_argument(
        "--shard",
        type=_part,
        default=(1, 1),
        metavar="I/K",
        help="do part I of K only, for jobs that share a folder",
    )
    parser.add_argument(
        "--no-summary", dest="summary", action="store_false", help="no data card and no page of pictures"
    )
    who = parser.add_mutually_exclusive_group()
    who.add_argument("--workers", type=int, help="number of processes (default: one per processor)")
    who.add_argument(
        "--ray",
        nargs="?",
        const="",
        metavar="ADDRESS",
        help="let a Ray cluster do the work: host:port of its head, or local for a new one of this machine "
        "(default: what RAY_ADDRESS names, else the one that this machine is part of, else a new one)",
    )
    return parser.parse_args(arguments)


def _part(text: str) -> tuple[int, int]:
    match = re.fullmatch(r"(\d+)/(\d+)", text)
    if match is None or not 1 <= int(match[1]) <= int(match[2]):
        raise argparse.ArgumentTypeError(f"{text!r} is no part: it should be I/K with 1 <= I <= K")
    return int(match[1]), int(match[2])


def _verdict(folder: Path, demonstrations: Demonstrations | None) -> str:
    if demonstrations is None:
        return f"{folder}: this part is done; other parts are still missing."
    failures = demonstrations.manifest["failures"]
    verdict = f"{folder}: {len(demonstrations)} demonstrations"
    if failures:
        reasons = ", ".join(f"{count} {reason}" for reason, count in failures.items())
        verdict += f"; {sum(failures.values())} problems failed ({reasons})"
    return verdict + "."


if __name__ == "__main__":
    sys.exit(main())
