"""Compare cloning with and without the expert's feedback gains: success over the number of demonstrations.

All variants learn from the same demonstrations with the same network and as many updates, and fly from the
same starts, which none has seen: those of demonstrations with another seed.
The output folder gets demonstrations/ and tests/, unless others are named; trainings.jsonl, a line for each
training; cloning.json, and with the extra `plots` cloning.png. What was interrupted is resumed by the same
command. Needs the extra `agents`.
Exit status: 0; 1 if demonstrations cannot be made or read; 2 if the input is unusable; 130 if interrupted.
"""

from __future__ import annotations

import argparse
import sys
from collections.abc import Sequence
from dataclasses import asdict
from pathlib import Path
from typing import TYPE_CHECKING

from rich.console import Console

from agents.configuration import DemonstrationSource, ImitationConfiguration, load_configuration
from agents.demonstrations import prepare_demonstrations
from agents.progress import ProgressDisplay
from dq_space_arm_env import load_scene
from experts.demonstrations import Demonstrations, DemonstrationsError
from experts.report.command import INTERRUPTED, SUCCESS, complain, guarded, parser_of, save, table_console
from experts.report.provenance import provenance
from experts.report.tables import TextTable

if TYPE_CHECKING:
    from agents.imitation.data_efficiency import Point

FAILURE = 1
TEST_SEED = 77
"""Seed of the starts that the policies fly from."""


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
    configuration = load_configuration(options.config)
    if not isinstance(configuration, ImitationConfiguration):
        raise ValueError(f"configuration {configuration.name!r} does not imitate: take cloning-with-gains")
    try:
        from agents.imitation.data_efficiency import Effort, measure, points
    except ModuleNotFoundError as error:
        raise ValueError(f'this needs {error.name}: pip install "dq-space-arm[agents]"') from error
    effort = Effort(tuple(sorted(set(options.counts))), options.seeds, options.updates)
    options.out.mkdir(parents=True, exist_ok=True)
    console = table_console()
    try:
        with ProgressDisplay(Console(stderr=True, highlight=False)) as shown:
            demonstrations, tests = _data(configuration, options, max(effort.counts), shown)
            trainings = measure(configuration, effort, demonstrations, tests, options.out, shown.update)
    except DemonstrationsError as error:
        complain([str(error)])
        return FAILURE
    except KeyboardInterrupt:
        console.print(f"Interrupted: the same command goes on in {options.out}.", markup=False)
        return INTERRUPTED
    measured = points(trainings)
    console.print(_table(measured, effort.updates, len(tests)).for_terminal())
    for sentence in _verdict(measured):
        console.print(sentence, markup=False, soft_wrap=True)
    record = {
        "configuration": configuration.model_dump(mode="json", exclude_none=True),
        "effort": asdict(effort),
        "points": [asdict(point) for point in measured],
        "trainings": [asdict(training) for training in trainings],
        **provenance("torch"),
    }
    save(console, options, "cloning", record, lambda: _picture(measured))
    return SUCCESS


def _parse(arguments: Sequence[str] | None) -> argparse.Namespace:
    parser = parser_of(__doc__, "cloning")
    parser.add_argument(
        "--config",
        default="cloning-with-gains",
        help="what scene, demonstrations, network and optimizer are taken from (default: cloning-with-gains)",
    )
    parser.add_argument(
        "--counts",
        type=int,
        nargs="+",
        default=[10, 20, 50, 100, 200, 500, 1000],
        metavar="N",
        help="numbers of demonstrations (default: 10 20 50 100 200 500 1000)",
    )
    parser.add_argument("--seeds", type=int, default=3, help="trainings of each (default: 3)")
    parser.add_argument("--updates", type=int, default=5000, help="updates of a training (default: 5000)")
    parser.add_argument("--tests", type=int, default=400, help="starts to fly from (default: 400)")
    parser.add_argument("--demonstrations", type=Path, help="folder of demonstrations, in place of new ones")
    parser.add_argument("--test-demonstrations", type=Path, help="folder of those to fly from, likewise")
    return parser.parse_args(arguments)


def _data(
    configuration: ImitationConfiguration, options: argparse.Namespace, count: int, shown: ProgressDisplay
) -> tuple[Demonstrations, Demonstrations]:
    """What to learn from, and what to fly from."""
    from agents.imitation.progress import Generating

    source = configuration.demonstrations.model_copy(update={"problems": count})
    tests = DemonstrationSource(problems=options.tests, seed=TEST_SEED)
    chosen = (
        (source, options.demonstrations, options.out / "demonstrations"),
        (tests, options.test_demonstrations, options.out / "tests"),
    )
    scene = load_scene(configuration.scene)
    learned, flown = (
        prepare_demonstrations(
            given if folder is None else DemonstrationSource(folder=str(folder)),
            scene,
            place,
            progress=lambda advance: shown.update(Generating(advance)),
        )
        for given, folder, place in chosen
    )
    return learned, flown[: options.tests]


def _table(measured: Sequence[Point], updates: int, tests: int) -> TextTable:
    from agents.imitation.data_efficiency import TITLES

    rows = tuple(
        (
            TITLES[point.variant],
            f"{point.count}",
            f"{point.trainings}",
            f"{point.success:.1%}",
            f"{point.low:.0%} to {point.high:.0%}",
            f"{point.least:.0%} to {point.most:.0%}",
            f"{point.gap:.2%}",
            f"{point.seconds:.0f}",
        )
        for point in measured
    )
    headings = (
        "cloning",
        "given",
        "trainings",
        "success",
        "95 % interval",
        "from, to",
        "cost gap",
        "s",
    )
    return TextTable(
        f"Cloning from given demonstrations, {updates} updates, flights from {tests} starts",
        headings,
        rows,
        right=1,
    )


def _verdict(measured: Sequence[Point]) -> list[str]:
    from agents.imitation.data_efficiency import TITLES, VARIANTS, saving

    sentences = []
    for variant in list(VARIANTS)[1:]:
        found = saving(measured, variant)
        if found is None:
            sentences.append(f"Cloning {TITLES[variant]} is nowhere better than actions alone.")
            continue
        sentence = (
            f"Cloning {TITLES[variant]}: {found.point.success:.1%} with {found.point.count} demonstrations; "
        )
        most = max(point.count for point in measured)
        if found.count is None:
            sentence += f"actions alone do not get there with {most}, {found.ratio:.0f} times as many."
        else:
            sentence += f"actions alone take {found.count}, {found.ratio:.0f} times as many."
        sentences.append(sentence)
    return sentences


def _picture(measured: Sequence[Point]) -> bytes:
    from agents.imitation.data_efficiency_figure import picture

    return picture(measured)


if __name__ == "__main__":
    sys.exit(main())
