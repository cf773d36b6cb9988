"""Flights to be shown beside each other: those of files, and episodes that policies fly for it."""

import zipfile
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from agents.evaluation.policies import as_policy, check_fit
from agents.policies import PolicyFileError
from agents.zoo import list_policies
from dq_space_arm_env import DQSpaceArmVectorEnv, Scene
from experts.demonstrations import DemonstrationsError
from experts.replay import Flight, Recording, common_scene, read_recording


def fly_recorded(
    policy: Any,
    scene: Scene,
    *,
    start: ArrayLike | None = None,
    seed: int | None = None,
    label: str | None = None,
) -> Flight:
    """Let a policy fly one episode.

    Args:
        policy: Whatever `agents.evaluate` takes: an exported policy or its file, for example.
        scene: The scene.
        start: State to start from, shape (n_x,), units of the state; the scene's nominal start by default.
        seed: Start instead where `env.reset(seed=seed)` does.
        label: What the flight is called; by default what the policy is.

    Returns:
        The flight, up to where the simulation blows up if it does.

    Raises:
        ValueError: If both start and seed are given, the start is no state, or something is no policy.
    """
    if start is not None and seed is not None:
        raise ValueError("start and seed exclude each other")
    acting = as_policy(policy, label)
    check_fit(acting, scene)
    environment = DQSpaceArmVectorEnv(1, scene)
    given = {"nominal": True} if start is None else {"initial_state": np.asarray(start, dtype=np.float64)}
    observation, _ = environment.reset(seed=seed, options=None if seed is not None else given)
    begin = getattr(acting.act, "begin", None)
    if begin is not None:
        begin(environment)
    target = environment.targets[0].copy()
    limit = environment.kernels.layout.control_limit
    states, controls = [environment.states[0].copy()], []
    for _ in range(scene.simulation.steps):
        action = np.clip(np.asarray(acting.act(observation), dtype=np.float64), -1.0, 1.0)
        observation, _, terminated, truncated, _ = environment.step(action)
        controls.append(action[0] * limit)
        states.append(environment.states[0].copy())
        if terminated[0] or truncated[0]:
            break
    return Flight(acting.label, np.array(states), np.array(controls), target=target)


def collect_flights(
    sources: Sequence[tuple[str | None, str]], scene: Scene | None = None, *, seed: int | None = None
) -> tuple[list[Flight], Scene]:
    """Read flights, and let policies fly from where the first flight starts.

    Args:
        sources: What the page calls a flight, or None, and the flight: what `read_recording` reads, the
            folder of a solution, or a policy (a name of the zoo, an exported one, a model of
            Stable-Baselines3, or the folder of a training run).
        scene: The scene to show; by default the first that a file names.
        seed: Policies start where `env.reset(seed=seed)` does.

    Returns:
        The flights in the same order, and the scene.

    Raises:
        ValueError: If a flight cannot be read or flown, or they do not fit on one page.
    """
    sources = [(label, _file_of(source)) for label, source in sources]
    recordings: dict[int, Recording] = {}
    try:
        for place, (label, source) in enumerate(sources):
            if not _is_policy(source):
                recordings[place] = read_recording(source, label)
    except DemonstrationsError as error:
        raise ValueError(str(error)) from error
    if scene is None:
        scene = next((item.scene for item in recordings.values() if item.scene is not None), None)
    if len(recordings) < len(sources):
        if scene is None:
            raise ValueError("no file says which scene the policy should fly: give --scene")
        _fly(sources, recordings, scene, seed)
    return common_scene([recordings[place] for place in range(len(sources))], scene)


def _file_of(source: str) -> str:
    """The folder that `solve` writes stands for the solution in it."""
    solution = Path(source) / "solution.npz"
    return str(solution) if solution.is_file() else source


def _is_policy(source: str) -> bool:
    path = Path(source)
    if not path.exists() and source in list_policies():
        return True
    if path.is_dir():
        return (path / "policy.npz").is_file()
    if path.suffix == ".zip":
        return True
    return path.is_file() and zipfile.is_zipfile(path) and _holds_network(path)


def _holds_network(path: Path) -> bool:
    with zipfile.ZipFile(path) as archive:
        return "weight_0.npy" in archive.namelist()


def _fly(
    sources: Sequence[tuple[str | None, str]],
    recordings: dict[int, Recording],
    scene: Scene,
    seed: int | None,
) -> None:
    """Add the flights of the policies."""
    first = min(recordings, default=None)
    start = None if first is None or seed is not None else recordings[first].flight.states[0]
    for place, (label, source) in enumerate(sources):
        if place not in recordings:
            try:
                flight = fly_recorded(source, scene, start=start, seed=seed, label=label)
            except PolicyFileError as error:
                raise ValueError(str(error)) from error
            recordings[place] = Recording(flight, scene)
