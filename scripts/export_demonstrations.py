"""Write demonstrations as a data set of Minari, which offline reinforcement learning reads.

It goes where Minari looks for data sets: into MINARI_DATASETS_PATH, or ~/.minari/datasets. Needs the extra
`minari`.
Exit status: 0; 1 if the data set cannot be written, for example because there is one of this name or the disk
is full; 2 if the name is none; 130 if interrupted. Nothing is changed then.
"""

import argparse
import sys
from collections.abc import Sequence
from pathlib import Path

from rich.console import Console
from rich.progress import Progress

from experts.demonstrations import DemonstrationsError, load_demonstrations
from experts.demonstrations.minari_export import export_to_minari
from experts.report.command import INTERRUPTED, SUCCESS, UNUSABLE, complain
from experts.report.demonstrations import data_card, gather

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
        console.print(_export(console, options), markup=False, soft_wrap=True)
    except ValueError as error:
        complain([str(error)])
        return UNUSABLE
    except DemonstrationsError as error:
        complain([str(error)])
        return FAILURE
    except KeyboardInterrupt:
        console.print("Interrupted: nothing is saved.")
        return INTERRUPTED
    return SUCCESS


def _parse(arguments: Sequence[str] | None) -> argparse.Namespace:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument(
        "folder", type=Path, help="folder that scripts/generate_demonstrations.py has completed"
    )
    parser.add_argument("dataset", help="name with a version, for example space-arm/paper/expert-v0")
    parser.add_argument("--overwrite", action="store_true", help="replace a data set of this name")
    parser.add_argument(
        "--no-gains",
        dest="gains",
        action="store_false",
        help="leave out the feedback gains, most of the size",
    )
    parser.add_argument("--author", help="who made the data")
    parser.add_argument("--author-email", help="how to reach them")
    parser.add_argument("--code-permalink", help="address of the code that made the data")
    return parser.parse_args(arguments)


def _export(console: Console, options: argparse.Namespace) -> str:
    demonstrations = load_demonstrations(options.folder, verify=True)
    with Progress(console=console, disable=not console.is_terminal) as progress:
        task = progress.add_task("episodes", total=len(demonstrations))
        dataset = export_to_minari(
            demonstrations,
            options.dataset,
            feedback_gains=options.gains,
            author=options.author,
            author_email=options.author_email,
            code_permalink=options.code_permalink,
            card=data_card(gather(demonstrations), options.dataset),
            overwrite=options.overwrite,
            progress=lambda done: progress.update(task, completed=done),
        )
    megabytes = dataset.storage.metadata["dataset_size"]
    return f"{dataset.id}: {dataset.total_episodes} episodes, {megabytes:g} MB in {dataset.storage.data_path}"


if __name__ == "__main__":
    sys.exit(main())
