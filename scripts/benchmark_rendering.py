"""Time the pictures of the environment: steps with a picture each, as RecordVideo takes them, per scene.

The baseline is Gymnasium's CartPole-v1, whose flat pictures pygame draws (600 by 400 pixels), if it is
installed. Times are processor time of this process, which other processes do not add to: the best of the
samples, and the median beside it. The output folder gets rendering.json.
Exit status: 0; 2 if the input is unusable; 130 if interrupted.
"""

import argparse
import sys
import time
from collections.abc import Sequence
from importlib.util import find_spec
from typing import Any

import gymnasium
import numpy as np
from rich.table import Table

import dq_space_arm_env  # noqa: F401 - registers the environment
from experts.report.command import SUCCESS, Destination, guarded, parser_of
from experts.report.provenance import provenance

BASELINE = "CartPole-v1"
_STEPS_PER_SAMPLE = 5


def main(arguments: Sequence[str] | None = None) -> int:
    """Run the script.

    Args:
        arguments: Command line without the program's name; that of the process if None.

    Returns:
        Exit status.
    """
    options = _parse(arguments)
    return guarded(lambda: _run(options))


def _run(options: argparse.Namespace) -> int:
    size = {"width": options.width, "height": options.height}
    environments = {
        name: gymnasium.make("DQSpaceArm-v0", scene=name, render_mode="rgb_array", **size)
        for name in options.scene or ["paper"]
    }
    if find_spec("pygame") is not None:
        environments[BASELINE] = gymnasium.make(BASELINE, render_mode="rgb_array")
    records = [_measure(name, env, options.samples) for name, env in environments.items()]
    baseline = next((record for record in records if record["name"] == BASELINE), None)
    table = Table("", "picture", "ms, best", "median", "pictures/s", f"of {BASELINE}'s rate")
    for record in records:
        rate = 1e3 / record["best_ms"]
        ratio = "" if baseline is None else f"{baseline['best_ms'] / record['best_ms']:.2f}"
        shape = "{} x {}".format(*record["size"])
        numbers = f"{record['best_ms']:.2f}", f"{record['median_ms']:.2f}", f"{rate:.0f}"
        table.add_row(record["name"], shape, *numbers, ratio)
    destination = Destination(options.out)
    console = destination.console()
    console.print("A step and its picture, processor time")
    console.print(table)
    options.out.mkdir(parents=True, exist_ok=True)
    record = {"unit": "ms of processor time per step with its picture", "environments": records}
    destination.save(console, "rendering", {**record, **provenance("pygame-ce")}, None)
    return SUCCESS


def _measure(name: str, env: gymnasium.Env[Any, Any], samples: int) -> dict[str, Any]:
    """Time steps with random actions, each with its picture; an episode that ends is followed by another."""
    env.reset(seed=0)
    env.action_space.seed(0)
    picture: Any = env.render()
    durations = []
    for _ in range(samples):
        begin = time.process_time()
        for _ in range(_STEPS_PER_SAMPLE):
            _, _, terminated, truncated, _ = env.step(env.action_space.sample())
            if terminated or truncated:
                env.reset()
            env.render()
        durations.append((time.process_time() - begin) / _STEPS_PER_SAMPLE)
    env.close()
    return {
        "name": name,
        "size": [picture.shape[1], picture.shape[0]],
        "best_ms": 1e3 * min(durations),
        "median_ms": 1e3 * float(np.median(durations)),
    }


def _parse(arguments: Sequence[str] | None) -> argparse.Namespace:
    parser = parser_of(__doc__, "rendering")
    parser.add_argument(
        "--scene",
        action="append",
        help="name of a shipped scene, or path of a YAML file; repeatable (default: paper)",
    )
    parser.add_argument("--width", type=int, default=640, help="pixels (default: 640)")
    parser.add_argument("--height", type=int, default=480, help="pixels (default: 480)")
    parser.add_argument("--samples", type=int, default=40, help="samples of 5 steps (default: 40)")
    options = parser.parse_args(arguments)
    if options.samples < 1:
        parser.error("--samples should be at least 1")
    return options


if __name__ == "__main__":
    sys.exit(main())
