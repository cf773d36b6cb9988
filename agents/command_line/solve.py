"""`dq-space-arm solve`: the optimal maneuver of a scene, from any start."""

from __future__ import annotations

from pathlib import Path

import click

from agents.command_line.names import SCENE
from agents.command_line.output import check_writable, message_console, print_document, table_console
from agents.command_line.verb import FAILURE, SUCCESS, Interrupted, Verb, json_option

start_options = (
    click.option(
        "--seed",
        type=click.IntRange(min=0),
        help="Draw the start from the scene's spread, as env.reset(seed=) does.",
    ),
    click.option(
        "--start",
        metavar="STATE",
        help="Begin here: numbers with commas between them, or a file (.npy, .json, .npz).  "
        "[default: the scene's own start]",
    ),
)
"""Options that say where an episode begins."""


@click.command(
    cls=Verb,
    short_help="Solve a scene: the optimal maneuver.",
    examples="""
        solve paper                              # results/solutions/paper/solution.npz
        solve my.yaml --out results/mine --figures
        solve paper --seed 7                     # from a start drawn at random
        solve paper --json | jq .cost
    """,
)
@click.argument("scene", type=SCENE)
@click.option(
    "--out",
    type=click.Path(file_okay=False, path_type=Path),
    help="Output folder.  [default: results/solutions/<scene>, with the seed]",
)
@start_options[1]
@start_options[0]
@click.option(
    "--solver",
    type=click.Choice(["guided", "box"]),
    default="guided",
    show_default=True,
    help="guided: with guesses of its own (GuidedDDP); box: from zero controls (BoxDDP).",
)
@click.option("--max-iterations", type=click.IntRange(min=0), help="In place of the solver's.")
@click.option("--figures", is_flag=True, help="Draw figures (needs the extra plots).")
@json_option
def solve(
    scene: str,
    out: Path | None,
    start: str | None,
    seed: int | None,
    solver: str,
    max_iterations: int | None,
    figures: bool,
    as_json: bool,
) -> int:
    """Solve SCENE, a name or a file, by control-limited differential dynamic programming.

    The output folder gets solution.npz (trajectory, controls, feedback gains), scene.yaml, summary.json, and
    figures if asked for. Exit status 1: the solve has not converged; 130: interrupted. The best trajectory so
    far is saved in any case, and said to be no more.
    """
    from agents.command_line import solving
    from dq_space_arm_env import load_scene

    loaded = load_scene(scene)
    if figures:
        solving.check_figures()
    folder = out or solving.default_folder(loaded, seed)
    check_writable(folder)
    run = solving.solve(
        loaded,
        message_console(),
        seed=seed,
        start=start,
        guided=solver == "guided",
        max_iterations=max_iterations,
    )
    files = solving.save(run, folder, figures=figures)
    record = {**solving.record(run), "files": [str(file) for file in files]}
    if as_json:
        print_document(record)
    else:
        console = table_console()
        console.print(solving.table(run))
        written = ", ".join(file.name for file in files)
        console.print(f"{folder}: {written}", markup=False, soft_wrap=True)
    if run.interrupted:
        raise Interrupted(f"the best trajectory so far is saved in {folder}")
    return SUCCESS if run.solution.converged else FAILURE
