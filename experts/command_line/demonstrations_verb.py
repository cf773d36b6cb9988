"""`dq-space-arm demonstrations`: generate, inspect and export optimal maneuvers from random starts."""

import re
from pathlib import Path

import click

from dq_space_arm_env.command_line.names import scene_option
from dq_space_arm_env.command_line.verb import json_option, keeping
from dq_space_arm_env.common.console import print_document, table_console
from dq_space_arm_env.common.files import check_writable
from experts.command_line.ray_option import chosen_executor, ray_option

_KEPT = "complete shards remain; run the same command to resume"


class _Part(click.ParamType[tuple[int, int]]):
    """Part I of K of a data set."""

    name = "I/K"

    def convert(
        self, value: object, param: click.Parameter | None, ctx: click.Context | None
    ) -> tuple[int, int]:
        """Read it."""
        if isinstance(value, tuple):
            return value
        match = re.fullmatch(r"(\d+)/(\d+)", str(value))
        if match is None or not 1 <= int(match[1]) <= int(match[2]):
            self.fail(f"{value!r} is not a valid shard: use I/K with 1 <= I <= K", param, ctx)
        return int(match[1]), int(match[2])


@click.group(
    epilog="""\b
        Examples:
          dq-space-arm demonstrations generate -n 1000                   # results/demonstrations/paper
          dq-space-arm demonstrations show results/demonstrations/paper  # what is in it
          dq-space-arm demonstrations export results/demonstrations/paper dq-space-arm/paper-v0
    """
)
def demonstrations() -> None:
    """Generate, inspect and export demonstrations.

    Demonstrations are optimal maneuvers from random starts, with the feedback gains along them.
    """


@demonstrations.command(
    epilog="""\b
        Examples:
          dq-space-arm demonstrations generate -n 1000
          dq-space-arm demonstrations generate --scene payload -n 200 --workers 2
          dq-space-arm demonstrations generate -n 10000 --shard 3/8  # the third job of an array of eight
          dq-space-arm demonstrations generate -n 10000 --ray        # the machines of a Ray cluster
    """
)
@scene_option
@click.option("-n", "count", type=int, default=1000, show_default=True, help="Number of problems.")
@click.option("--seed", type=int, default=0, show_default=True, help="Seed of the data set.")
@click.option(
    "--out",
    type=click.Path(file_okay=False, path_type=Path),
    help="Output folder.  [default: results/demonstrations/<scene or its file>]",
)
@click.option("--shard-size", type=int, help="Problems per file.  [default: 32]")
@click.option(
    "--shard", type=_Part(), default="1/1", help="Do part I of K only, in jobs that share a folder."
)
@click.option("--summary/--no-summary", default=True, help="Write data card and summary page.")
@click.option("--workers", type=int, help="Number of processes.  [default: one per processor]")
@ray_option
@json_option
def generate(
    scene: str,
    count: int,
    seed: int,
    out: Path | None,
    shard_size: int | None,
    shard: tuple[int, int],
    summary: bool,
    workers: int | None,
    ray: str | None,
    as_json: bool,
) -> None:
    """Generate demonstrations; re-run the command to resume an interrupted run.

    The output folder receives settings.json and shards; once they are complete, manifest.json, README.md (a
    data card), and summary/ with a page of distributions, failures and trajectories. Exit status 1: the run
    had to stop, for example because the disk is full.
    """
    executor = chosen_executor(workers, ray)
    from dq_space_arm_env import load_scene
    from experts.command_line import demonstrations_work as command
    from experts.demonstrations.settings import SHARD_SIZE
    from experts.report.reproduction import results_folder

    loaded = load_scene(scene)
    folder = out or results_folder(scene, "demonstrations")
    check_writable(folder)
    with keeping(_KEPT):
        record = command.generate(
            table_console(stderr=as_json),
            loaded,
            folder,
            count,
            seed=seed,
            shard_size=SHARD_SIZE if shard_size is None else shard_size,
            part=shard,
            executor=executor,
            summary=summary,
        )
    if as_json:
        print_document(record)


@demonstrations.command(
    epilog="""\b
        Examples:
          dq-space-arm demonstrations export results/demonstrations/paper dq-space-arm/paper-v0
          dq-space-arm demonstrations export results/demonstrations/paper new/paper-v1 --no-gains --overwrite
          dq-space-arm demonstrations export results/demonstrations/paper results/lerobot --format lerobot
    """
)
@click.argument("folder", type=click.Path(exists=True, file_okay=False, path_type=Path))
@click.argument("dataset")
@click.option(
    "--format",
    "kind",
    type=click.Choice(["minari", "lerobot"]),
    default="minari",
    show_default=True,
    help="Format of the data set.",
)
@click.option("--overwrite", is_flag=True, help="Replace a data set of this name.")
@click.option("--gains/--no-gains", default=None, help="Minari: write the feedback gains, most of the size.")
@click.option("--author", help="Minari: author of the data.")
@click.option("--author-email", help="Minari: address of the author.")
@click.option("--code-permalink", help="Minari: address of the code that generated the data.")
@json_option
def export(
    folder: Path,
    dataset: str,
    kind: str,
    overwrite: bool,
    gains: bool | None,
    author: str | None,
    author_email: str | None,
    code_permalink: str | None,
    as_json: bool,
) -> None:
    """Write the demonstrations in FOLDER as DATASET, of Minari or LeRobot.

    For Minari, DATASET is a name with a version. It goes where Minari looks for data sets:
    MINARI_DATASETS_PATH, or ~/.minari/datasets. Needs the extra `minari`.

    For LeRobot, DATASET is a folder to create, a LeRobotDataset v3.0. Needs the extra `lerobot`.
    """
    from experts.command_line import demonstrations_work as command

    console = table_console(stderr=as_json)
    if kind == "lerobot":
        if (gains, author, author_email, code_permalink) != (None,) * 4:
            raise click.UsageError(
                "--gains, --author, --author-email and --code-permalink are for --format minari",
                click.get_current_context(),
            )
        check_writable(Path(dataset))
        record = command.export_lerobot(console, folder, Path(dataset), overwrite=overwrite)
    else:
        record = command.export(
            console,
            folder,
            dataset,
            gains=gains is not False,
            author=author,
            author_email=author_email,
            code_permalink=code_permalink,
            overwrite=overwrite,
        )
    if as_json:
        print_document(record)


@demonstrations.command(
    epilog="""\b
        Examples:
          dq-space-arm demonstrations show results/demonstrations/paper
    """
)
@click.argument("folder", type=click.Path(exists=True, file_okay=False, path_type=Path))
@json_option
def show(folder: Path, as_json: bool) -> None:
    """Summarize FOLDER: numbers, distributions, failures."""
    from experts.command_line import demonstrations_work as command

    record = command.show(table_console(stderr=as_json), folder)
    if as_json:
        print_document(record)
