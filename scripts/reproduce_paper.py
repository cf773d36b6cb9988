"""Solve, replay and draw the maneuver of Valverde & Tsiotras (ACC 2018): `make paper`."""

import sys
from collections.abc import Sequence
from pathlib import Path

import click

from dq_space_arm_env.command_line.names import SCENE, OneOf
from dq_space_arm_env.command_line.verb import json_option
from dq_space_arm_env.command_line.verb_program import run_to_end
from dq_space_arm_env.common.files import check_writable_file
from dq_space_arm_env.scene import INTEGRATORS, load_scene
from experts.report import reproduction


@click.command()
@click.option("--scene", type=SCENE, default="paper", help="Name of a shipped scene, or YAML file.")
@click.option(
    "--out",
    type=click.Path(file_okay=False, path_type=Path),
    help="Output folder.  [default: results/<name of the scene>]",
)
@click.option("--integrator", type=OneOf("integrator", lambda: INTEGRATORS), help="Replaces the scene's.")
@click.option("--max-iterations", type=int, help="Replaces the solver's default.")
@click.option("--figures/--no-figures", default=True, help="Whether to draw figures (needs the extra plots).")
@click.option("--pdf", is_flag=True, help="Figures also as PDF.")
@click.option(
    "--readme-picture",
    type=click.Path(dir_okay=False, path_type=Path),
    help="Also draw snapshots and errors in one PNG.",
)
@json_option
def reproduce(
    scene: str,
    out: Path | None,
    integrator: str | None,
    max_iterations: int | None,
    figures: bool,
    pdf: bool,
    readme_picture: Path | None,
    as_json: bool,
) -> int:
    """Solve and replay the paper's maneuver, compare it with the paper, draw Figures 2 to 6.

    The output folder receives solution.npz (trajectory and feedback gains), scene.yaml, summary.json and the
    figures. Exit status 1: the solve did not converge, or the environment does not charge what was planned;
    the best trajectory is always saved.
    """
    loaded = load_scene(scene)
    if integrator is not None:
        loaded = loaded.replace(simulation={"integrator": integrator})
    folder = out or reproduction.results_folder(scene)
    for name in reproduction.FILES:
        check_writable_file(folder / name, scene)
    if readme_picture is not None:
        check_writable_file(readme_picture)
    return reproduction.run(
        loaded,
        folder,
        max_iterations=max_iterations,
        figures=figures,
        pdf=pdf,
        readme_picture=readme_picture,
        as_json=as_json,
    )


def main(arguments: Sequence[str] | None = None) -> int:
    """Run the script and return its exit status."""
    return run_to_end(lambda: reproduce.main(arguments, standalone_mode=False))


if __name__ == "__main__":
    sys.exit(main())
