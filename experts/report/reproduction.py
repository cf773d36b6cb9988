"""The paper's maneuver as a command: solved, replayed, printed and drawn."""

import re
from collections.abc import Sequence
from importlib.util import find_spec
from pathlib import Path

from dq_space_arm_env import Scene, load_scene
from experts import StopReason
from experts.report import (
    ManeuverRun,
    SolveProgress,
    print_tables,
    run_maneuver,
    summarize,
    to_json,
    write_atomically,
)
from experts.report.command import INACCURATE, INTERRUPTED, SUCCESS, Destination, complain


def run(
    destination: Destination,
    scene: Scene,
    *,
    max_iterations: int | None = None,
    pdf: bool = False,
    readme_picture: Path | None = None,
) -> int:
    """Solve and replay a scene; the best trajectory is saved in any case, and said to be no more.

    Args:
        destination: Gets solution.npz, scene.yaml and summary.json; with a picture, the figures too.
        scene: The scene.
        max_iterations: Largest number of iterations; the solver's default if None.
        pdf: Whether to draw the figures also as PDF.
        readme_picture: File for a picture with snapshots and errors; None for none.

    Returns:
        Exit status: 0 if the solve converged and the environment charges what was planned; 1 if not; 130 if
        interrupted.

    Raises:
        KeyboardInterrupt: If interrupted before there is anything to save.
        ValueError: If the scene cannot be solved or replayed, or figures are wanted without Matplotlib.
    """
    if destination.picture and find_spec("matplotlib") is None:
        raise ValueError('figures need matplotlib: pip install "dq-space-arm[plots]", or give --no-figures')
    console, folder = destination.console(), destination.folder
    folder.mkdir(parents=True, exist_ok=True)
    with SolveProgress(console) as progress:
        maneuver = run_maneuver(scene, max_iterations, progress.start, progress.update)
    try:
        files = _save(maneuver, folder)
        print_tables(console, maneuver)
        if destination.picture:
            files += _draw(maneuver, folder, ("png", "pdf") if pdf else ("png",), readme_picture)
    except KeyboardInterrupt:
        complain([f"Interrupted; what there is lies in {folder}."])
        return INTERRUPTED
    console.print(_verdict(maneuver), markup=False)
    written = ", ".join(file.name if file.parent == folder else str(file) for file in files)
    console.print(f"{folder}: {written}", markup=False)
    if destination.document:
        destination.print(summarize(maneuver))
    return _status(maneuver)


def scene_with(source: str, integrator: str | None) -> Scene:
    """Load a scene, with another integrator if one is named.

    Args:
        source: Name or path.
        integrator: Its name; None for the scene's own.

    Returns:
        The scene.

    Raises:
        SceneError: If it cannot be loaded.
    """
    scene = load_scene(source)
    if integrator is None:
        return scene
    return scene.replace(simulation={**scene.simulation.model_dump(), "integrator": integrator})


def results_folder(scene: Scene, *parents: str) -> Path:
    """Name the folder of a scene's results.

    Args:
        scene: The scene.
        *parents: Folders in between.

    Returns:
        results/<parents>/<name of the scene>, with characters that a path may have.
    """
    return Path("results", *parents) / re.sub(r"[^\w.-]+", "-", scene.name)


def _save(run: ManeuverRun, folder: Path) -> list[Path]:
    solution, scene, summary = (folder / name for name in ("solution.npz", "scene.yaml", "summary.json"))
    run.solution.save(solution)
    write_atomically(scene, run.scene.to_yaml())
    write_atomically(summary, to_json(summarize(run)))
    return [solution, scene, summary]


def _draw(run: ManeuverRun, folder: Path, formats: Sequence[str], readme_picture: Path | None) -> list[Path]:
    """Draw the figures; a trajectory that is not finite cannot be drawn."""
    if not run.is_finite:
        return []
    from experts.report.figures import write_figures, write_readme_picture

    files = write_figures(run, folder, formats)
    if readme_picture is not None:
        write_readme_picture(run, readme_picture)
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
    if not run.replay_agrees:
        return "The environment does not charge what the solver has planned: one of them is wrong."
    return "Converged; the environment charges what the solver has planned."


def _status(run: ManeuverRun) -> int:
    if run.solution.stop_reason is StopReason.INTERRUPTED:
        return INTERRUPTED
    return SUCCESS if run.solution.converged and run.replay_agrees else INACCURATE
