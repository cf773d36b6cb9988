"""Fly a corrected plan beside the plan alone and the receding-horizon expert, under model mismatch.

    python scripts/compare_residual.py --policy results/agents/residual-0

All fly from the same evaluation starts and meet the same pushes and noise.
"""

import argparse
import json
from pathlib import Path

from rich.console import Console

from agents.demonstrations import stricter
from agents.policies import PolicyFileError
from agents.residual.evaluation import (
    CONDITIONS,
    compare_under_mismatch,
    comparison_table,
    evaluation_plans,
)
from dq_space_arm_env import load_scene
from experts.demonstrations import DemonstrationsError
from experts.files import write_atomically
from experts.report.command import complain, guarded


def main() -> int:
    """Run the script.

    Returns:
        Exit status: 0; 1 if a file cannot be used; 2 if the input is unusable; 130 if interrupted.
    """
    names = [condition.name for condition in CONDITIONS]
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--policy", required=True, help="exported policy (.npz), or folder of a training run")
    parser.add_argument("--scene", default="paper", help="name of a shipped scene, or path of a YAML file")
    parser.add_argument("-n", type=int, default=128, help="number of starts, the first of the 500")
    parser.add_argument("--condition", nargs="+", default=names, choices=names, help="(default: all)")
    parser.add_argument(
        "--tolerance-scale",
        type=float,
        default=0.7,
        help="tolerances that plans meet, relative to the scene's",
    )
    parser.add_argument(
        "--receding", type=int, default=0, help="flights of the receding-horizon expert; all get as few then"
    )
    parser.add_argument(
        "--out", type=Path, default=Path("results") / "residual", help="folder for plans and table"
    )
    parser.add_argument("--workers", type=int, help="processes that plan (default: one per processor)")
    options = parser.parse_args()
    return guarded(lambda: _compare(options))


def _compare(options: argparse.Namespace) -> int:
    console = Console(highlight=False)
    scene = load_scene(options.scene)
    try:
        plans = evaluation_plans(
            stricter(scene, options.tolerance_scale),
            options.out / f"plans-{options.n}-{options.tolerance_scale:g}",
            options.n,
            workers=options.workers,
        )
        comparisons = compare_under_mismatch(
            options.policy,
            plans,
            scene,
            conditions=[each for each in CONDITIONS if each.name in options.condition],
            receding_flights=options.receding,
            progress=lambda what: console.print(what, style="dim"),
        )
    except (DemonstrationsError, PolicyFileError) as error:
        complain([str(error)])
        return 1
    console.print(comparison_table(comparisons))
    rows = [row for comparison in comparisons for row in comparison.summary()]
    write_atomically(options.out / "comparison.json", json.dumps(rows, indent=1) + "\n")
    return 0


if __name__ == "__main__":
    raise SystemExit(main())
