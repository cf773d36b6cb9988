"""`dq-space-arm solve`: the optimal maneuver of a scene, from any start."""

from __future__ import annotations

from pathlib import Path

import click

from dq_space_arm_env.command_line.names import SCENE, seed_option, start_option
from dq_space_arm_env.command_line.verb import Interrupted, json_option
from dq_space_arm_env.common.console import (
    FAILURE,
    SUCCESS,
    complain,
    message_console,
    print_document,
    table_console,
)
from dq_space_arm_env.common.files import check_writable_file


@click.command(
    short_help="Solve a scene: the optimal maneuver.",
    epilog="""\b
        Examples:
          dq-space-arm solve paper           # results/solutions/paper/solution.npz
          dq-space-arm solve my.yaml --out results/mine --figures
          dq-space-arm solve paper --seed 7  # from a start drawn at random
          dq-space-arm solve paper --json | jq .cost
    """,
)
@click.argument("scene", type=SCENE)
@click.option(
    "--out",
    type=click.Path(file_okay=False, path_type=Path),
    help="Output folder.  [default: results/solutions/<scene or its file>[-<seed>]]",
)
@start_option
@seed_option
@click.option(
    "--solver",
    type=click.Choice(["guided", "box"]),
    default="guided",
    show_default=True,
    help="guided: from its own guesses (GuidedDDP); box: from zero controls (BoxDDP).",
)
@click.option("--max-iterations", type=click.IntRange(min=0), help="Replaces the solver's default.")
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

    The output folder receives solution.npz (trajectory, controls, feedback gains), scene.yaml, summary.json,
    and figures on request. Exit status 1: the solve did not converge, or misses a catch; 130: interrupted. A
    target that the optimum misses is no failure: the table, and is_success of --json, tell.
    After the preparation the best trajectory so far is always saved, flagged as not converged.
    """
    from dq_space_arm_env import load_scene
    from dq_space_arm_env.command_line.scene_warnings import maneuver_warnings
    from dq_space_arm_env.dynamics.step_stability import advice
    from dq_space_arm_env.environment.catches import ends_held
    from experts.command_line import solving
    from experts.report.reproduction import FILES

    loaded = load_scene(scene)
    if (sentence := advice(loaded)) is not None:
        message_console().print(f"{scene}: {sentence}", markup=False, soft_wrap=True)
    if figures:
        solving.check_figures()
    folder = out or solving.default_folder(scene, seed)
    for name in FILES:
        check_writable_file(folder / name, scene, start)
    run = solving.solve(
        loaded,
        message_console(),
        seed=seed,
        start=start,
        guided=solver == "guided",
        max_iterations=max_iterations,
    )
    if not run.ends_within:
        for warning in maneuver_warnings(loaded):
            complain(warning, label="Warning: ")
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
    return SUCCESS if run.solution.converged and ends_held(run.catches) else FAILURE
