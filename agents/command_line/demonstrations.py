"""`dq-space-arm demonstrations`: optimal maneuvers from random starts, made, looked at, and exported."""

import re
from pathlib import Path

import click

from agents.command_line.names import SCENE, Type
from agents.command_line.output import check_writable, print_document, table_console
from agents.command_line.verb import Verbs, json_option, keeping

_KEPT = "the shards that are complete remain; the same command goes on with them"


class _Part(Type):
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
            self.fail(f"{value!r} is no part: it should be I/K with 1 <= I <= K", param, ctx)
        return int(match[1]), int(match[2])


@click.group(
    cls=Verbs,
    examples="""
        demonstrations generate -n 1000                      # results/demonstrations/paper
        demonstrations show results/demonstrations/paper     # what is in it
        demonstrations export results/demonstrations/paper dq-space-arm/paper-v0   # for Minari
    """,
)
def demonstrations() -> None:
    """Make demonstrations, look at them, export them.

    Optimal maneuvers from random starts, with the feedback gains along them, to learn from.
    """


@demonstrations.command(
    examples="""
        demonstrations generate -n 1000
        demonstrations generate --scene payload -n 200 --workers 2
        demonstrations generate -n 10000 --shard 3/8   # the third job of an array of eight
        demonstrations generate -n 10000 --ray         # the machines of a Ray cluster
    """,
)
@click.option(
    "--scene", type=SCENE, default="paper", show_default=True, help="Name of a shipped scene, or YAML file."
)
@click.option("-n", "count", type=int, default=1000, show_default=True, help="Number of problems.")
@click.option("--seed", type=int, default=0, show_default=True, help="Seed of the data set.")
@click.option(
    "--out",
    type=click.Path(file_okay=False, path_type=Path),
    help="Output folder.  [default: results/demonstrations/<name of the scene>]",
)
@click.option("--shard-size", type=int, help="Problems of a file.  [default: 32]")
@click.option(
    "--shard", type=_Part(), default="1/1", help="Do part I of K only, for jobs that share a folder."
)
@click.option("--summary/--no-summary", default=True, help="Whether to write data card and page.")
@click.option("--workers", type=int, help="Number of processes.  [default: one per processor]")
@click.option(
    "--ray",
    is_flag=False,
    flag_value="",
    metavar="[ADDRESS]",
    help="Let a Ray cluster do the work: host:port of its head, or local for a new one of this machine. "
    "Default: what RAY_ADDRESS names, else the one that this machine is part of, else a new one.",
)
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
    """Generate demonstrations; a run that was interrupted or killed is resumed by the same command.

    The output folder gets settings.json, shards, and manifest.json once all are there; then README.md, a data
    card, and summary/ with a page of distributions, failures and trajectories. Exit status 1: the run had to
    stop, for example because the disk is full.
    """
    if workers is not None and ray is not None:
        raise click.UsageError("--workers and --ray exclude each other", click.get_current_context())
    from dq_space_arm_env import load_scene
    from experts.demonstrations.settings import SHARD_SIZE
    from experts.report.demonstrations import command
    from experts.report.reproduction import results_folder

    loaded = load_scene(scene)
    folder = out or results_folder(loaded, "demonstrations")
    check_writable(folder)
    with keeping(_KEPT):
        record = command.generate(
            table_console(as_json=as_json),
            loaded,
            folder,
            count,
            seed=seed,
            shard_size=SHARD_SIZE if shard_size is None else shard_size,
            part=shard,
            workers=workers,
            ray=ray,
            summary=summary,
        )
    if as_json:
        print_document(record)


@demonstrations.command(
    examples="""
        demonstrations export results/demonstrations/paper dq-space-arm/paper-v0
        demonstrations export results/demonstrations/paper dq-space-arm/paper-v0 --no-gains --overwrite
    """,
)
@click.argument("folder", type=click.Path(exists=True, file_okay=False, path_type=Path))
@click.argument("dataset")
@click.option("--overwrite", is_flag=True, help="Replace a data set of this name.")
@click.option(
    "--gains/--no-gains",
    default=True,
    help="Whether to write the feedback gains, most of the size.",
)
@click.option("--author", help="Who made the data.")
@click.option("--author-email", help="How to reach them.")
@click.option("--code-permalink", help="Address of the code that made the data.")
@json_option
def export(
    folder: Path,
    dataset: str,
    overwrite: bool,
    gains: bool,
    author: str | None,
    author_email: str | None,
    code_permalink: str | None,
    as_json: bool,
) -> None:
    """Write the demonstrations in FOLDER as Minari's DATASET, a name with a version.

    It goes where Minari looks for data sets: into MINARI_DATASETS_PATH, or ~/.minari/datasets. Needs the
    extra `minari`.
    """
    from experts.report.demonstrations import command

    record = command.export(
        table_console(as_json=as_json),
        folder,
        dataset,
        gains=gains,
        author=author,
        author_email=author_email,
        code_permalink=code_permalink,
        overwrite=overwrite,
    )
    if as_json:
        print_document(record)


@demonstrations.command(examples="demonstrations show results/demonstrations/paper")
@click.argument("folder", type=click.Path(exists=True, file_okay=False, path_type=Path))
@json_option
def show(folder: Path, as_json: bool) -> None:
    """Say what is in FOLDER: numbers, distributions, failures."""
    from experts.report.demonstrations import command

    record = command.show(table_console(as_json=as_json), folder)
    if as_json:
        print_document(record)
