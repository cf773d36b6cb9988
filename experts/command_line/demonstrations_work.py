"""Generating, exporting and looking at demonstrations, as commands: what they print and write."""

from pathlib import Path
from typing import Any

from rich.console import Console
from rich.progress import Progress

from dq_space_arm_env import Scene
from dq_space_arm_env.common.progress import ProgressDisplay
from dq_space_arm_env.common.tables import TextTable
from experts.demonstrations import (
    Demonstrations,
    DemonstrationsError,
    Executor,
    generate_demonstrations,
    load_demonstrations,
)
from experts.demonstrations import facts as tables
from experts.demonstrations.data_card import data_card
from experts.demonstrations.facts import gather
from experts.demonstrations.lerobot_export import export_to_lerobot
from experts.demonstrations.minari_export import export_to_minari
from experts.report.data_set_summary import write_summary


def generate(
    console: Console,
    scene: Scene,
    folder: Path,
    n: int,
    *,
    seed: int,
    shard_size: int,
    part: tuple[int, int] = (1, 1),
    executor: Executor | None = None,
    summary: bool = True,
) -> dict[str, Any]:
    """Generate demonstrations, or go on with a folder of them, and say how it went."""
    try:
        with ProgressDisplay(console) as progress:
            demonstrations = generate_demonstrations(
                scene,
                n,
                folder,
                seed,
                shard_size=shard_size,
                part=part,
                executor=executor,
                progress=progress.update,
            )
        if demonstrations is not None and summary:
            write_summary(demonstrations)
    except OSError as error:
        raise DemonstrationsError(str(error)) from error
    console.print(_verdict(folder, demonstrations), markup=False, soft_wrap=True)
    return {
        "folder": str(folder),
        "complete": demonstrations is not None,
        "demonstrations": None if demonstrations is None else len(demonstrations),
        "failures": {} if demonstrations is None else dict(demonstrations.manifest["failures"]),
    }


def _verdict(folder: Path, demonstrations: Demonstrations | None) -> str:
    if demonstrations is None:
        return f"{folder}: this part is done; other parts are still missing."
    failures = demonstrations.manifest["failures"]
    verdict = f"{folder}: {len(demonstrations)} demonstrations"
    if failures:
        reasons = ", ".join(f"{count} {reason}" for reason, count in failures.items())
        verdict += f"; {sum(failures.values())} problems failed ({reasons})"
    return verdict + "."


def export(
    console: Console,
    folder: Path,
    dataset: str,
    *,
    gains: bool = True,
    author: str | None = None,
    author_email: str | None = None,
    code_permalink: str | None = None,
    overwrite: bool = False,
) -> dict[str, Any]:
    """Write demonstrations as a data set of Minari, with a data card."""
    demonstrations = load_demonstrations(folder, verify=True)
    with Progress(console=console, disable=not console.is_terminal) as progress:
        task = progress.add_task("episodes", total=len(demonstrations))
        written = export_to_minari(
            demonstrations,
            dataset,
            feedback_gains=gains,
            author=author,
            author_email=author_email,
            code_permalink=code_permalink,
            card=data_card(gather(demonstrations), dataset),
            overwrite=overwrite,
            progress=lambda done: progress.update(task, completed=done),
        )
    size, path = written.storage.metadata["dataset_size"], written.storage.data_path
    line = f"{written.id}: {written.total_episodes} episodes, {size:g} MB in {path}"
    console.print(line, markup=False, soft_wrap=True)
    return {
        "dataset": written.id,
        "episodes": int(written.total_episodes),
        "megabytes": float(size),
        "path": str(path),
    }


def export_lerobot(console: Console, folder: Path, out: Path, *, overwrite: bool = False) -> dict[str, Any]:
    """Write demonstrations as a data set of LeRobot, with a data card."""
    demonstrations = load_demonstrations(folder, verify=True)
    with Progress(console=console, disable=not console.is_terminal) as progress:
        task = progress.add_task("episodes", total=len(demonstrations))
        path = export_to_lerobot(
            demonstrations,
            out,
            card=data_card(gather(demonstrations), lerobot=True),
            overwrite=overwrite,
            progress=lambda done: progress.update(task, completed=done),
        )
    size = sum(file.stat().st_size for file in path.rglob("*") if file.is_file()) / 1e6
    line = f"{path}: {len(demonstrations)} episodes, {size:.1f} MB"
    console.print(line, markup=False, soft_wrap=True)
    return {
        "dataset": str(path),
        "episodes": len(demonstrations),
        "megabytes": round(size, 1),
        "path": str(path),
    }


def show(console: Console, folder: Path) -> dict[str, Any]:
    """Say what is in a folder of demonstrations."""
    facts = gather(load_demonstrations(folder))
    shown = [tables.contents(facts)]
    if len(facts.demonstrations):
        shown += [tables.distributions(facts), tables.guesses(facts)]
        shown += [tables.parameters(facts)] if facts.demonstrations.kernels.n_p else []
    if len(facts.failures["index"]):
        shown.append(tables.failure_reasons(facts))
    for table in shown:
        console.print(table.for_terminal())
    return {table.title.partition("\n")[0]: _records(table) for table in shown}


def _records(table: TextTable) -> Any:
    """A table as JSON values: a mapping if it has two columns and no headings, else a list of rows."""
    if not any(table.headings):
        return {row[0]: row[1] for row in table.rows}
    names = ("name", *table.headings[1:])
    return [dict(zip(names, row, strict=True)) for row in table.rows]
