"""Show an agent flying the maneuver, beside the expert's solution from the same start; needs no PyTorch.

The output folder gets flight.json and, with the extra `plots`, the errors of the tip and the inputs over time
as pictures. How an agent does on the 500 evaluation starts is in its card, and measured by
python -m agents.evaluate.
Exit status: 0 if the agent reaches the target; 1 if it does not, in any of the flights, or its file is
damaged; 2 if the input is unusable; 130 if interrupted.
"""

import argparse
import sys
from collections.abc import Sequence
from importlib.util import find_spec
from pathlib import Path

from rich.console import Console

from agents.evaluation.policies import as_policy
from agents.policies import PolicyFileError
from agents.showing import SideBySide, fly_beside_expert
from agents.zoo import list_policies
from dq_space_arm_env import load_scene
from experts.files import write_atomically
from experts.report.command import NO_PICTURE, complain, guarded, parser_of, table_console
from experts.report.provenance import provenance
from experts.report.summary import to_json
from experts.report.tables import TextTable

MISSED = 1


def main(arguments: Sequence[str] | None = None) -> int:
    """Run the script.

    Args:
        arguments: Command line without the program's name; that of the process if None.

    Returns:
        Exit status.
    """
    options = _parse(arguments)

    def run() -> int:
        try:
            return _run(options)
        except PolicyFileError as error:
            complain([str(error)])
            return MISSED

    return guarded(run)


def _parse(arguments: Sequence[str] | None) -> argparse.Namespace:
    parser = parser_of(__doc__, "flight")
    names = ", ".join(list_policies()) or "none yet"
    parser.add_argument(
        "--policy",
        required=True,
        help=f"name of a policy of the zoo ({names}), an exported policy (.npz), a model of "
        "Stable-Baselines3 (.zip), or the folder of a training run",
    )
    parser.add_argument("--scene", help="name of a scene, or path of a YAML file (default: the policy's)")
    parser.add_argument(
        "--seed", type=int, help="start where env.reset(seed=...) does (default: nominal start)"
    )
    parser.add_argument(
        "-n", type=int, default=1, help="number of flights, from further seeds; pictures are of the first"
    )
    parser.add_argument(
        "--gif", type=Path, metavar="FILE", help="also draw the flight, with the extra `render`"
    )
    return parser.parse_args(arguments)


def _run(options: argparse.Namespace) -> int:
    if options.n < 1:
        raise ValueError(f"-n: {options.n}, should be at least 1")
    if options.seed is not None and options.seed < 0:
        raise ValueError(f"--seed: {options.seed}, should be at least 0")
    console = table_console(120)
    policy = as_policy(options.policy)
    scene = load_scene(options.scene or str(policy.metadata.get("scene", "paper")))
    first = 0 if options.seed is None else options.seed + 1
    seeds: list[int | None] = [options.seed, *range(first, first + options.n - 1)]
    pairs = fly_beside_expert(policy, scene, seeds)
    console.print(_table(pairs).for_terminal())
    if len(pairs) == 1:
        console.print(_verdict(pairs[0]), markup=False)
    _save(console, options, pairs)
    return 0 if all(pair.agent.is_success for pair in pairs) else MISSED


def _table(pairs: Sequence[SideBySide]) -> TextTable:
    scene = pairs[0].agent.maneuver.scene
    headings = ("start", "", "cost J", "cost gap", "angle", "distance", "effort", "target", "time")
    rows = []
    for pair in pairs:
        start = "nominal" if pair.seed is None else f"seed {pair.seed}"
        for side in (pair.agent, pair.expert):
            is_agent = side is pair.agent
            time = f"{1e6 * side.seconds:.1f} us an action" if is_agent else f"{side.seconds:.2f} s to solve"
            rows.append(
                (
                    start if is_agent else "",
                    side.name if is_agent or pair.converged else f"{side.name}, not converged",
                    f"{side.cost:.2f}",
                    f"{100.0 * pair.cost_gap:.2f} %" if is_agent else "",
                    f"{side.attitude_error:.2f}°",
                    f"{side.position_error:.3f} m",
                    f"{side.effort:.3g}",
                    "reached" if side.is_success else "missed",
                    time,
                )
            )
    success = scene.success
    tolerance = f"{success.attitude_error_deg:g}°, {success.position_error:g} m"
    return TextTable(f"Scene {scene.name}; tolerance {tolerance}", headings, tuple(rows), right=2)


def _verdict(pair: SideBySide) -> str:
    verb = "reaches" if pair.agent.is_success else "does NOT reach"
    return f"{pair.agent.name} {verb} the target; its cost gap is {100.0 * pair.cost_gap:.2f} %."


def _save(console: Console, options: argparse.Namespace, pairs: Sequence[SideBySide]) -> None:
    options.out.mkdir(parents=True, exist_ok=True)
    files = ["flight.json"]
    record = {"flights": [pair.record() for pair in pairs], **provenance()}
    write_atomically(options.out / files[0], to_json(record))
    if options.picture and find_spec("matplotlib") is None:
        console.print(NO_PICTURE, markup=False)
    elif options.picture:
        from agents.showing.figure import errors_picture, inputs_picture

        for name, draw in (("errors.png", errors_picture), ("inputs.png", inputs_picture)):
            write_atomically(options.out / name, draw(pairs[0]))
            files.append(name)
    if options.gif is not None:
        from agents.showing.animation import animation

        write_atomically(options.gif, animation(pairs[0].agent))
        files.append(str(options.gif))
    console.print(f"{options.out}: {', '.join(files)}", markup=False)


if __name__ == "__main__":
    sys.exit(main())
