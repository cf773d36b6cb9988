"""`dq-space-arm compare cloning`: success over demonstrations, with feedback gains and without."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import TYPE_CHECKING

from rich.console import Console

from agents.configuration import DemonstrationSource, ImitationConfiguration, load_configuration
from agents.demonstrations import prepare_demonstrations
from agents.progress import ProgressDisplay
from dq_space_arm_env import load_scene
from experts.demonstrations import Demonstrations
from experts.report.command import Destination
from experts.report.provenance import provenance
from experts.report.tables import TextTable

if TYPE_CHECKING:
    from agents.imitation.data_efficiency import Point

TEST_SEED = 77
"""Seed of the starts that the policies fly from."""


@dataclass(frozen=True)
class Options:
    """What to train, and from what.

    Attributes:
        configuration: Name or path of what scene, demonstrations, network and optimizer are taken from.
        counts: Numbers of demonstrations.
        seeds: Trainings of each.
        updates: Updates of a training.
        tests: Starts to fly from.
        demonstrations: Folder of demonstrations, in place of new ones.
        test_demonstrations: Folder of those to fly from, likewise.
    """

    configuration: str = "cloning-with-gains"
    counts: Sequence[int] = (10, 20, 50, 100, 200, 500, 1000)
    seeds: int = 3
    updates: int = 5000
    tests: int = 400
    demonstrations: Path | None = None
    test_demonstrations: Path | None = None


def run(destination: Destination, options: Options) -> None:
    """Measure, print the table and the verdict, and write the files; finished trainings are taken up.

    Args:
        destination: Where the results go.
        options: What to train, and from what.

    Raises:
        ValueError: If the configuration, the demonstrations or an option cannot be used.
        DemonstrationsError: If demonstrations cannot be made or read.
    """
    configuration = load_configuration(options.configuration)
    if not isinstance(configuration, ImitationConfiguration):
        raise ValueError(f"configuration {configuration.name!r} does not imitate: take cloning-with-gains")
    try:
        from agents.imitation.data_efficiency import Effort, measure, points
    except ModuleNotFoundError as error:
        raise ValueError(f'this needs {error.name}: pip install "dq-space-arm[agents]"') from error
    effort = Effort(tuple(sorted(set(options.counts))), options.seeds, options.updates)
    folder = destination.folder
    folder.mkdir(parents=True, exist_ok=True)
    console = destination.console()
    with ProgressDisplay(Console(stderr=True, highlight=False)) as shown:
        demonstrations, tests = _data(configuration, options, folder, max(effort.counts), shown)
        trainings = measure(configuration, effort, demonstrations, tests, folder, shown.update)
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
    destination.save(console, "cloning", record, lambda: _picture(measured))


def _data(
    configuration: ImitationConfiguration,
    options: Options,
    folder: Path,
    count: int,
    shown: ProgressDisplay,
) -> tuple[Demonstrations, Demonstrations]:
    """What to learn from, and what to fly from."""
    from agents.imitation.progress import Generating

    source = configuration.demonstrations.model_copy(update={"problems": count})
    tests = DemonstrationSource(problems=options.tests, seed=TEST_SEED)
    chosen = (
        (source, options.demonstrations, folder / "demonstrations"),
        (tests, options.test_demonstrations, folder / "tests"),
    )
    scene = load_scene(configuration.scene)
    learned, flown = (
        prepare_demonstrations(
            given if other is None else DemonstrationSource(folder=str(other)),
            scene,
            place,
            progress=lambda advance: shown.update(Generating(advance)),
        )
        for given, other, place in chosen
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
