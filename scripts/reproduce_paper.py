"""Solve and replay the maneuver of Valverde & Tsiotras (ACC 2018), print the numbers, draw Figures 2 to 6.

The output folder gets solution.npz (trajectory and feedback gains), scene.yaml, summary.json and the figures.
Exit status: 0 if the solve converged and the environment charges what was planned; 1 if not; 2 if the input
is unusable; 130 if interrupted. The best trajectory so far is saved in any case, and said to be no more.
"""

import argparse
import re
import sys
from collections.abc import Sequence
from importlib.util import find_spec
from pathlib import Path

from rich.console import Console

from dq_space_arm_env import Scene, SceneError, load_scene
from dq_space_arm_env.scene import INTEGRATORS
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

SUCCESS, NOT_CONVERGED, UNUSABLE, INTERRUPTED = 0, 1, 2, 130


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
        scene = _load(options)
        folder = options.out or Path("results") / re.sub(r"[^\w.-]+", "-", scene.name)
        folder.mkdir(parents=True, exist_ok=True)
        with SolveProgress(console) as progress:
            run = run_maneuver(scene, options.max_iterations, progress.start, progress.update)
    except (SceneError, ValueError, OSError) as error:
        Console(stderr=True, highlight=False).print(str(error), style="red", markup=False)
        return UNUSABLE
    except KeyboardInterrupt:
        console.print("Interrupted: nothing is saved.")
        return INTERRUPTED
    try:
        files = _save(run, folder)
        print_tables(console, run)
        if options.figures:
            files += _draw(run, folder, ("png", "pdf") if options.pdf else ("png",), options.readme_picture)
    except KeyboardInterrupt:
        console.print(f"Interrupted; what there is lies in {folder}.")
        return INTERRUPTED
    console.print(_verdict(run), markup=False)
    written = ", ".join(file.name if file.parent == folder else str(file) for file in files)
    console.print(f"{folder}: {written}", markup=False)
    return _status(run)


def _parse(arguments: Sequence[str] | None) -> argparse.Namespace:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--scene", default="paper", help="name of a shipped scene, or path of a YAML file")
    parser.add_argument("--out", type=Path, help="output folder (default: results/<name of the scene>)")
    parser.add_argument("--integrator", choices=INTEGRATORS, help="default: the scene's")
    parser.add_argument("--max-iterations", type=int, help="default: the solver's")
    parser.add_argument("--no-figures", dest="figures", action="store_false", help="tables and files only")
    parser.add_argument("--pdf", action="store_true", help="figures also as PDF")
    parser.add_argument(
        "--readme-picture", type=Path, metavar="FILE", help="also draw snapshots and errors in one PNG"
    )
    return parser.parse_args(arguments)


def _load(options: argparse.Namespace) -> Scene:
    if options.figures and find_spec("matplotlib") is None:
        raise ValueError('figures need matplotlib: pip install "dq-space-arm[plots]", or give --no-figures')
    scene = load_scene(options.scene)
    if options.integrator is None:
        return scene
    simulation = {**scene.simulation.model_dump(), "integrator": options.integrator}
    return scene.replace(simulation=simulation)


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
    return SUCCESS if run.solution.converged and run.replay_agrees else NOT_CONVERGED


if __name__ == "__main__":
    sys.exit(main())
