"""`dq-space-arm compare cloning`: success over demonstrations, with feedback gains and without."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

from agents.configuration import DemonstrationSource, ImitationConfiguration, load_configuration
from agents.demonstrations import prepare_demonstrations
from dq_space_arm_env import load_scene
from dq_space_arm_env.common.console import message_console
from dq_space_arm_env.common.progress import ProgressDisplay
from dq_space_arm_env.common.provenance import provenance
from dq_space_arm_env.common.results import Destination
from dq_space_arm_env.common.tables import Column, Row, tabulate
from experts.demonstrations import Demonstrations

if TYPE_CHECKING:
    from matplotlib.axes import Axes

TEST_SEED = 77  # of the starts that the policies fly from


@dataclass(frozen=True)
class Options:
    """Trainings to run, and their demonstrations."""

    configuration: str = "cloning-with-gains"
    counts: Sequence[int] = (10, 20, 50, 100, 200, 500, 1000)
    seeds: int = 5
    updates: int = 5000
    tests: int = 400
    demonstrations: Path | None = None
    test_demonstrations: Path | None = None

    def __post_init__(self) -> None:
        """Raise ValueError for numbers below 1, before demonstrations are generated."""
        numbers = {
            "counts": min(self.counts),
            "seeds": self.seeds,
            "updates": self.updates,
            "tests": self.tests,
        }
        for name, number in numbers.items():
            if number < 1:
                raise ValueError(f"--{name}: {number}, should be at least 1")


def run(destination: Destination, options: Options) -> None:
    """Measure, print the table and the verdict, and write the files; finished trainings are kept."""
    configuration = load_configuration(options.configuration)
    if not isinstance(configuration, ImitationConfiguration) or configuration.algorithm.name == "act":
        raise ValueError(
            f"configuration {configuration.name!r} clones no single actions: use cloning-with-gains"
        )
    try:
        from agents.evaluation.data_efficiency import Effort, measure, points
    except ModuleNotFoundError as error:
        raise ValueError(f'this needs {error.name}: pip install "dq-space-arm[agents]"') from error
    folder, console = destination.folder, destination.console()
    folder.mkdir(parents=True, exist_ok=True)
    with ProgressDisplay(message_console()) as shown:
        demonstrations, tests, most = _data(configuration, options, folder, shown)
        counts = tuple(sorted({min(count, most) for count in options.counts}))
        effort = Effort(counts, options.seeds, options.updates)
        trainings = measure(configuration, effort, demonstrations, tests, folder, shown.update)
    measured = points(trainings)
    record = {
        "configuration": configuration.model_dump(mode="json", exclude_none=True),
        "effort": asdict(effort),
        "points": measured,
        "trainings": trainings,
        **provenance("torch"),
    }
    written = destination.write("cloning", record, {"cloning.png": lambda: _picture(measured)})
    title = f"Cloning: {effort.updates} updates, flights from {len(tests)} starts"
    console.print(tabulate(title, measured, _columns()).for_terminal())
    for sentence in _verdict(measured):
        console.print(sentence, markup=False, soft_wrap=True)
    destination.tell(console, written, record)


def _data(
    configuration: ImitationConfiguration, options: Options, folder: Path, shown: ProgressDisplay
) -> tuple[list[Demonstrations], Demonstrations, int]:
    """Demonstrations to learn from, for each seed or for all; to fly from; and most to learn from.

    Problems fail now and then: of generated demonstrations each seed has a few less than were asked for.
    """
    most = max(options.counts)
    scene, source = load_scene(configuration.scene), configuration.resolved().demonstrations
    if options.demonstrations is not None:
        source = DemonstrationSource(folder=str(options.demonstrations))
    learned = {"demonstrations": source}
    if source.folder is None and source.minari is None:
        first = source.seed or 0
        learned = {
            f"demonstrations-{seed}" if seed else "demonstrations": source.model_copy(
                update={"problems": most, "seed": first + seed}
            )
            for seed in range(options.seeds)
        }
    tests = DemonstrationSource(problems=options.tests, seed=TEST_SEED)
    if options.test_demonstrations is not None:
        tests = DemonstrationSource(folder=str(options.test_demonstrations))
    *pools, flown = (
        prepare_demonstrations(given, scene, folder / name, progress=shown.update)
        for name, given in {**learned, "tests": tests}.items()
    )
    if source.folder is None and source.minari is None:
        most = min(most, *map(len, pools))
    return pools, flown[: options.tests], most


def _columns() -> list[Column]:
    from agents.evaluation.data_efficiency import TITLES

    return [
        Column("variant", "cloning", TITLES.__getitem__),
        Column("count", "demonstrations", str),
        Column("trainings"),
        Column("success", "success", ".1%"),
        Column("low", "95 % from", ".0%"),
        Column("high", "to", ".0%"),
        Column("least", "least", ".0%"),
        Column("most", "most", ".0%"),
        Column("gap", "cost gap", ".2%"),
        Column("seconds", "s", ".0f"),
    ]


def _verdict(measured: Sequence[Row]) -> list[str]:
    from agents.evaluation.data_efficiency import TITLES, VARIANTS, saving

    sentences = []
    for variant in list(VARIANTS)[1:]:
        found = saving(measured, variant)
        if found is None:
            sentences.append(f"Cloning {TITLES[variant]} is nowhere better than actions alone.")
            continue
        need, times = f"{found.needed}", f"{found.ratio:.3g} times"
        if found.needed is None:
            need, times = f"more than {max(point['count'] for point in measured)}", f"more than {times}"
        sentences.append(
            f"Cloning {TITLES[variant]}: {found.point['success']:.1%} with {found.point['count']} "
            f"demonstrations; actions alone need {need}, {times} as many."
        )
    return sentences


def _picture(measured: Sequence[Row]) -> bytes:
    """Draw success and cost gap over the number of demonstrations, a curve per variant."""
    from matplotlib.ticker import NullFormatter, PercentFormatter, ScalarFormatter

    from agents.evaluation.data_efficiency import TITLES
    from experts.figures.plots import Plot

    success, gap = "Successful flights, 95 % intervals", "Median cost gap"
    curves = [{"count": point["count"], "cloning": TITLES[point["variant"]]} for point in measured]
    rows: list[dict[str, Any]] = []
    for curve, point in zip(curves, measured, strict=True):
        rows.append({**curve, "panel": success, **{key: point[key] for key in ("success", "low", "high")}})
    for curve, point in zip(curves, measured, strict=True):
        height = max(point["gap"], 1e-4)
        rows.append({**curve, "panel": gap, "success": height, "low": height, "high": height})

    def decorate(axes: Axes, panel: str) -> None:
        axes.set_xticks(sorted({point["count"] for point in measured}))
        axes.xaxis.set_major_formatter(ScalarFormatter())
        axes.xaxis.set_minor_formatter(NullFormatter())
        axes.set_ylabel("")
        if panel == gap:
            axes.set_yscale("log")
        else:
            axes.set_ylim(-0.02, 1.02)
        axes.yaxis.set_major_formatter(PercentFormatter(1.0))

    plot = Plot(
        "count",
        "success",
        color="cloning",
        facet="panel",
        log="x",
        interval=("low", "high"),
        labels={"count": "demonstrations"},
        decorate=decorate,
    )
    return plot.png(rows)
