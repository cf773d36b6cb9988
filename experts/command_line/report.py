"""`dq-space-arm report`: what a user wants to know about a scene, on one page."""

from __future__ import annotations

from pathlib import Path

import click

from dq_space_arm_env.command_line.names import SCENE
from dq_space_arm_env.command_line.verb import Interrupted, json_option
from dq_space_arm_env.common.console import FAILURE, SUCCESS, print_document, table_console
from dq_space_arm_env.common.files import check_writable


@click.command(
    short_help="Report on a scene: integrators, stability, costs, expert.",
    epilog="""\b
        Examples:
          dq-space-arm report paper --quick       # results/reports/paper/report.html
          dq-space-arm report my.yaml --out results/mine
          dq-space-arm report paper --json | jq .parts.precision.cheapest
    """,
)
@click.argument("scene", type=SCENE)
@click.option("--quick", is_flag=True, help="Measure less: a minute rather than five.")
@click.option(
    "--out",
    type=click.Path(file_okay=False, path_type=Path),
    help="Output folder.  [default: results/reports/<scene or its file>]",
)
@json_option
def report(scene: str, quick: bool, out: Path | None, as_json: bool) -> int:
    """Measure SCENE, a name or a file, and write one page as HTML, Markdown and JSON.

    Error against run time of every integrator, and the cheapest for 1e-3, 1e-6 and 1e-9 m or rad; the longest
    step, fastest motion and stiffest joints that each holds; what each part of the scene costs; and how the
    expert fares from random starts. The files are written after each part; an interrupted report resumes
    when the command is repeated. Exit status 1: a part could not be measured.
    """
    from dq_space_arm_env import load_scene
    from experts.report.reproduction import results_folder
    from experts.report.scene_report import NAME
    from experts.report.scene_report import report as measure

    loaded = load_scene(scene)
    folder = out or results_folder(scene, "reports")
    check_writable(folder)
    folder.mkdir(parents=True, exist_ok=True)
    console = table_console(stderr=as_json)
    try:
        page = measure(loaded, folder, console, quick=quick)
    except KeyboardInterrupt as error:
        if not (folder / f"{NAME}.json").exists():
            raise Interrupted("no part is finished, and nothing is saved") from error
        raise Interrupted(f"the finished parts are in {folder}; repeat the command to resume") from error
    if page.shortcomings:
        console.print(f"Exit status 1: {' '.join(page.shortcomings)}", markup=False)
    if as_json:
        print_document(page.record)
    return FAILURE if page.shortcomings else SUCCESS
