"""The paper's maneuver, solved, replayed, printed and drawn."""

import re
from collections.abc import Sequence
from importlib.util import find_spec
from pathlib import Path
from typing import Any

from dq_space_arm_env.command_line.verb import Interrupted
from dq_space_arm_env.common.console import FAILURE, INTERRUPTED, SUCCESS, print_document, table_console
from dq_space_arm_env.common.files import to_json, write_atomically
from dq_space_arm_env.scene import Scene
from experts.ddp.solution import Solution, StopReason
from experts.maneuver import FIGURES
from experts.report.maneuver_run import ManeuverRun, run_maneuver
from experts.report.maneuver_summary import print_tables, summarize
from experts.report.solve_progress import SolveProgress

FILES = ("solution.npz", "scene.yaml", "summary.json")
"""Files of a solve; the last one is there when the others are."""
CONVERGENCE = "convergence"
"""File of the figure of the solve, without suffix."""


def run(
    scene: Scene,
    folder: Path,
    *,
    max_iterations: int | None = None,
    figures: bool = True,
    pdf: bool = False,
    readme_picture: Path | None = None,
    as_json: bool = False,
) -> int:
    """Solve and replay a scene; the best trajectory is always saved, flagged if not converged.

    Args:
        scene: The scene.
        folder: Gets solution.npz, scene.yaml, summary.json and figures; it need not exist.
        max_iterations: Largest number of iterations; the solver's default if None.
        figures: Whether to draw figures.
        pdf: Whether to draw them also as PDF.
        readme_picture: File for a picture with snapshots and errors; None for none.
        as_json: Whether to print the summary as JSON, and tables to standard error.

    Returns:
        Exit status: 0 if the solve converged and the environment charges what was planned; 1 if not; 130 if
        interrupted.

    Raises:
        KeyboardInterrupt: If interrupted before there is anything to save.
        ValueError: If the scene cannot be solved or replayed, or figures are wanted without Matplotlib, or
            `readme_picture` without figures or with another ending than `.png`.
    """
    if figures and find_spec("matplotlib") is None:
        raise ValueError('figures need matplotlib: pip install "dq-space-arm[plots]", or give --no-figures')
    if readme_picture is not None and not figures:
        raise ValueError(
            "--readme-picture asks for a figure, and --no-figures for none: leave one of them out"
        )
    if readme_picture is not None and readme_picture.suffix.lower() != ".png":
        raise ValueError(f"--readme-picture: {readme_picture}, should end in .png")
    console = table_console(stderr=as_json)
    with SolveProgress(console, scene) as progress:
        maneuver = run_maneuver(scene, max_iterations, progress.start, progress.update)
    try:
        files = save(maneuver.solution, maneuver.scene, summarize(maneuver), folder)
        print_tables(console, maneuver)
        if figures and maneuver.is_finite:  # a diverged trajectory cannot be drawn
            files += _draw(maneuver, folder, ("png", "pdf") if pdf else ("png",), readme_picture)
    except KeyboardInterrupt as error:
        raise Interrupted(f"files already written are in {folder}") from error
    console.print(_verdict(maneuver), markup=False)
    written = ", ".join(file.name if file.parent == folder else str(file) for file in files)
    console.print(f"{folder}: {written}", markup=False)
    if as_json:
        print_document(summarize(maneuver))
    if maneuver.solution.stop_reason is StopReason.INTERRUPTED:
        return INTERRUPTED
    return SUCCESS if maneuver.solution.converged and maneuver.replay_agrees else FAILURE


def results_folder(scene: str, *parents: str) -> Path:
    """The folder of the results of a scene, given by its name or file: results/<parents>/<its stem>."""
    return Path("results", *parents) / re.sub(r"[^\w.-]+", "-", Path(scene).stem)


def save(solution: Solution, scene: Scene, summary: dict[str, Any], folder: Path) -> list[Path]:
    """Write the files of a solve; those of an earlier one, figures too, do not stay beside them.

    Args:
        solution: The solution.
        scene: The scene, of an episode with what was drawn.
        summary: JSON values.
        folder: Made if it is not there.

    Returns:
        The files.
    """
    folder.mkdir(parents=True, exist_ok=True)
    files = [folder / name for name in FILES]
    if files[-1].exists():  # without it, figures are not of a solve
        files[-1].unlink()
        for name in (*FIGURES, CONVERGENCE):
            for ending in ("png", "pdf"):
                (folder / f"{name}.{ending}").unlink(missing_ok=True)
    solution.save(files[0])
    write_atomically(files[1], scene.to_yaml())
    write_atomically(files[2], to_json(summary))
    return files


def _draw(run: ManeuverRun, folder: Path, formats: Sequence[str], readme_picture: Path | None) -> list[Path]:
    from experts.figures import write_figures, write_readme_picture
    from experts.figures.maneuver_curves import convergence_figure

    solve = run.solution, run.zero_control_cost, run.tolerance, run.solve_seconds
    more = {CONVERGENCE: lambda: convergence_figure(*solve)}
    files = write_figures(run.maneuver, folder, formats, **more)
    if readme_picture is not None:
        write_readme_picture(run.maneuver, readme_picture)
        files.append(readme_picture)
    return files


def _verdict(run: ManeuverRun) -> str:
    solution = run.solution
    if not run.is_finite:
        return f"DIVERGED: {solution.message}. There are no figures."
    if solution.stop_reason is StopReason.INTERRUPTED:
        return f"INTERRUPTED after {solution.iterations} iterations: this is the best trajectory so far."
    if not solution.converged:
        return f"NOT CONVERGED: {solution.message}. This is the best trajectory so far."
    if run.replay.caught is not None and not run.replay.caught[0]:
        return "A catch is MISSED: J is as if it were met, and the environment flies on without the payload."
    if not run.replay_agrees:
        return "The environment does not charge what the solver planned: one of them is wrong."
    return "Converged; the environment charges what the solver planned."
