"""The benchmark of the expert as a command: what it prints, writes, and how it ends."""

from collections.abc import Sequence
from dataclasses import replace

from dq_space_arm_env import list_scenes, load_scene
from experts.checks import check_at_least
from experts.report.command import INTERRUPTED, SUCCESS, Destination
from experts.report.provenance import provenance
from experts.report.solvers.benchmark import ExpertBenchmark
from experts.report.solvers.effort import FULL, PARTS, QUICK, Effort
from experts.report.solvers.records import benchmark_record


def run(
    destination: Destination,
    effort: Effort,
    *,
    scenes: Sequence[str] = ("paper",),
    parts: Sequence[str] = (),
    seed: int = 0,
) -> int:
    """Measure; `expert.json` and `expert.png` hold the numbers, after an interrupt those that there are.

    Args:
        destination: Where results go.
        effort: How much to measure.
        scenes: Names or paths of scenes; all that are shipped if there are none.
        parts: Out of `PARTS`; all if there are none.
        seed: Of random starts and disturbances.

    Returns:
        Exit status: 0, or 130 if interrupted.

    Raises:
        SceneError: If a scene cannot be loaded.
        ValueError: If the seed is negative, or a scene cannot be measured.
    """
    check_at_least("--seed", seed, 0)
    console = destination.console()
    loaded = [load_scene(name) for name in scenes or list_scenes()]
    found = ExpertBenchmark(effort, seed)
    measured = tuple(parts) or PARTS
    for scene in loaded:
        found.check(scene, measured)
    destination.folder.mkdir(parents=True, exist_ok=True)
    interrupted = False
    try:
        for scene in loaded:
            found.run(console, scene, measured)
    except KeyboardInterrupt:
        interrupted = True
        console.print("Interrupted: what is measured so far is saved.")
    record = {**benchmark_record(found, interrupted=interrupted), **provenance("crocoddyl", "pin")}
    solved = [starts for starts in found.random_starts if starts.starts]

    def picture() -> bytes:
        from experts.report.figures.solvers import picture as draw

        return draw(found.comparisons, solved)

    destination.save(console, "expert", record, picture if found.comparisons or solved else None)
    return INTERRUPTED if interrupted else SUCCESS


def effort_of(
    *, quick: bool = False, full: bool = False, starts: int | None = None, slow_peers: bool, peers: bool
) -> Effort:
    """Decide how much to measure.

    Args:
        quick: Little of each, and no other solvers.
        full: 200 random starts.
        starts: Random starts of each scene, in place of the number that goes with the others.
        slow_peers: Whether to compare also solvers that take minutes.
        peers: Whether to compare other solvers at all.

    Returns:
        The effort.

    Raises:
        ValueError: If there are no starts.
    """
    effort = QUICK if quick else FULL if full else Effort()
    count = effort.starts if starts is None else starts
    check_at_least("--starts", count, 1)
    return replace(
        effort,
        starts=count,
        peers=effort.peers and peers,
        slow_peers=effort.slow_peers or slow_peers,
    )
