"""Flights to show side by side: recorded ones, and episodes that policies fly for the occasion."""

import webbrowser
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np
from rich.console import Console

from dq_space_arm_env import Scene
from dq_space_arm_env.command_line.policy_sources import load_policy, owns_policy, statistics_by_model
from dq_space_arm_env.command_line.simulated_episode import Start, begin, fly
from dq_space_arm_env.common.bounded_reading import archive_members
from dq_space_arm_env.common.console import complain
from dq_space_arm_env.viewing.replay import Trajectory, by_scene, common_scene, read_flight, write_replay

_SOLUTION = "solution.npz"


def collect_flights(
    sources: Sequence[tuple[str | None, str]],
    scene: Scene | None,
    console: Console,
    *,
    seed: int | None = None,
    trust: bool = False,
    normalize: Path | None = None,
) -> list[tuple[list[Trajectory], Scene]]:
    """Read flights, and let policies fly from where the first one starts, or where `seed` does.

    `sources` are pairs of a label, or None, and a recording or a policy. All are shown in `scene`; by default
    each in its own, policies in the first that a recording names. Where labels that nobody gave are equal,
    the names of the sources follow.
    """
    given = scene
    sources = [(label, _file_of(source)) for label, source in sources]
    statistics = statistics_by_model([source for _, source in sources], normalize)
    recordings: dict[int, Trajectory] = {}
    for place, (label, source) in enumerate(sources):
        if not _is_policy(source):
            recordings[place] = read_flight(source, label)
    if scene is None:
        scene = next((item.scene for item in recordings.values() if item.scene is not None), None)
    if seed is not None and len(recordings) == len(sources):
        raise ValueError(f"--seed: {seed} is where policies start, and no flight is one: leave it out")
    if len(recordings) < len(sources):
        if scene is None:
            raise ValueError("no file says which scene the policy should fly: give --scene")
        seed, begun = _common_start(scene, seed, recordings[min(recordings)] if recordings else None)
        for place, (label, source) in enumerate(sources):
            if place not in recordings:
                found = statistics.get(source)
                pilot = load_policy(source, begun, console, seed, trust=trust, normalize=found)
                recordings[place] = fly(scene, begun, pilot, seed=seed, label=label)
    flights = [recordings[place] for place in range(len(sources))]
    flights = _told_apart(flights, sources, [given or flight.scene or scene for flight in flights])
    return by_scene(flights) if given is None else [common_scene(flights, given)]


def _told_apart(
    flights: Sequence[Trajectory], sources: Sequence[tuple[str | None, str]], scenes: Sequence[Scene | None]
) -> list[Trajectory]:
    """Add the names of their sources to labels that nobody gave and that are equal in a scene."""
    keys = [(flight.label, scene and scene.name) for flight, scene in zip(flights, scenes, strict=True)]
    names = [_name_of(source) for _, source in sources]
    told = []
    for flight, key, (label, source), name in zip(flights, keys, sources, names, strict=True):
        if label is None and keys.count(key) > 1:
            flight = replace(flight, label=f"{flight.label} ({name if names.count(name) == 1 else source})")
        told.append(flight)
    return told


def _name_of(source: str) -> str:
    """Name of a source; a solution's is that of its folder."""
    path = Path(source)
    return path.resolve().parent.name if path.name == _SOLUTION else path.name


def show_maneuver(scene: Scene, page: Path, console: Console) -> str:
    """Solve and fly a scene's maneuver, open its page in the browser, and say how it ended."""
    [(shown, robot)] = collect_flights([("the first maneuver", "plan")], scene, console)
    write_replay(page, shown, robot)
    open_in_browser(page)
    flight = shown[0]
    verdict = "reaches the target" if flight.is_success else "MISSES the target"
    return (
        f"{page}: the first maneuver {verdict} at J = {flight.cost:.5g}, {flight.attitude_error:.2g} degrees "
        f"and {flight.position_error:.2g} m off; open it in a browser"
    )


def open_in_browser(page: Path) -> None:
    """Open a page in the browser, or say that there is none."""
    if not webbrowser.open(page.resolve().as_uri()):
        complain(f"no browser was found: open {page.resolve()} in one yourself", label="Warning: ")


def _common_start(scene: Scene, seed: int | None, flight: Trajectory | None) -> tuple[int | None, Start]:
    """Where policies start, and its seed: where a flight did, which a seed has with target and masses."""
    if seed is not None or flight is None:
        return seed, begin(scene, seed, None)
    if flight.seed is not None:
        drawn = begin(scene, flight.seed, None)
        if np.array_equal(drawn.state, flight.states[0]):
            return flight.seed, drawn
    return None, begin(scene, None, flight.states[0])


def _is_policy(source: str) -> bool:
    """Tell a policy from a recorded flight; a solution is both, and shown as planned."""
    return owns_policy(source) and "states" not in archive_members(Path(source))


def _file_of(source: str) -> str:
    """Find the solution in the folder that `solve` writes."""
    solution = Path(source) / _SOLUTION
    return str(solution) if solution.is_file() else source
