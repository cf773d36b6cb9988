"""One episode: its start, from the options of a verb, and its flight."""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray

from dq_space_arm_env.common.bounded_formats import read_array, read_arrays
from dq_space_arm_env.common.bounded_reading import read_json
from dq_space_arm_env.common.suggestions import did_you_mean
from dq_space_arm_env.environment import DQSpaceArmEnv
from dq_space_arm_env.environment.catches import Catch, catches
from dq_space_arm_env.environment.disturbances import Disturbances
from dq_space_arm_env.environment.rollouts import Policy, StateFeedback, rollout
from dq_space_arm_env.kernels import compile_scene
from dq_space_arm_env.scene import Scene, StateLayout
from dq_space_arm_env.scene.maneuver import Success
from dq_space_arm_env.scene.start import episode_scene
from dq_space_arm_env.task.trajectory import Trajectory

FILES = (".npy", ".json", ".npz")  # that a state is read from
_NOISE = 1  # stream of random numbers that belongs to a seed
OWN = "the scene's own"
_UNREADABLE = (TypeError, ValueError, KeyError, IndexError, OverflowError)
"""What reading numbers from a text or a file raises."""


class Pilot(NamedTuple):
    """A policy, ready to fly an episode with `rollout`."""

    label: str
    policy: Policy | StateFeedback


class Start(NamedTuple):
    """The beginning of an episode."""

    state: NDArray[np.float64]  # shape (n_x,), units of the state
    scene: Scene
    parameters: NDArray[np.float64]  # what varies in the scene, such as a drawn target, shape (n_p,)
    title: str  # for tables

    @property
    def episode_scene(self) -> Scene:
        """The scene with the parameters of this episode as constants."""
        return episode_scene(self.scene, self.parameters.tolist()) if self.parameters.size else self.scene


def begin(scene: Scene, seed: int | None = None, given: str | NDArray[np.float64] | None = None) -> Start:
    """Begin an episode at the scene's own start, at one drawn as `env.reset(seed=seed)` does, or at a state.

    `given` is a state, shape (n_x,), or its text or file, see `read_state`.
    """
    if seed is not None and given is not None:
        raise ValueError("--seed and --start exclude each other: a start is drawn, or given")
    if seed is None and given is None:
        layout = StateLayout.of(scene)
        return Start(np.array(layout.initial_state), scene, np.array(layout.parameters.nominal), OWN)
    env = DQSpaceArmEnv(scene)
    if seed is not None:
        env.reset(seed=seed)
        drawn = any(scene.spread.model_dump().values())
        title = f"drawn with seed {seed}" if drawn else f"{OWN} (no spread)"
    else:
        state = read_state(given, env.kernels.n_x) if isinstance(given, str) else given
        try:
            env.reset(options={"initial_state": state})
        except ValueError as error:
            where = "--start" if isinstance(given, str) else "the start"
            raise ValueError(str(error).replace("options: initial_state", where)) from error
        title = "given"
    state, parameters = (np.asarray(each, dtype=np.float64) for each in (env.state, env.parameters))
    return Start(state, scene, parameters, title)


def fly(
    scene: Scene,
    start: Start,
    pilot: Pilot,
    *,
    seed: int | None,
    noise: ArrayLike = 0.0,
    label: str | None = None,
) -> Trajectory:
    """Fly from a start.

    `noise` is the standard deviation of the inputs, as a fraction of their limits, shape () or (n_u,).
    """
    seeds, starts = (None, start.state[None]) if seed is None else ([seed], None)
    disturbances = None
    if np.any(noise):
        generator = np.random.default_rng([seed or 0, _NOISE])
        disturbances = Disturbances(scene, generator, inputs=np.atleast_2d(noise))
    flown = rollout(pilot.policy, scene, seeds, starts=starts, disturbances=disturbances, record=True)
    return flown.trajectory(0, label or pilot.label, start.title)


def read_noise(texts: Sequence[str], scene: Scene) -> NDArray[np.float64]:
    """Read the noise of the inputs, shape (n_u,), as fractions of their limits.

    Texts are a fraction, for all inputs, or ACTUATOR=SIGMA in the actuator's unit, which counts for its own.
    """
    layout = StateLayout.of(scene)
    fractions = np.zeros(layout.n_u)
    parts = {name: part for name, part in vars(layout.control).items() if isinstance(part, slice)}
    present = {name: part for name, part in parts.items() if part.stop > part.start}
    kinds = [text.rpartition("=")[0] for text in texts]
    for kind in kinds:
        if kinds.count(kind) > 1:
            given = ", ".join(text for text, each in zip(texts, kinds, strict=True) if each == kind)
            raise ValueError(f"--noise {given}: should be given once for {kind or 'all inputs'}")
    for text in sorted(texts, key=lambda each: "=" in each):  # the fraction first
        name, mark, number = text.rpartition("=")
        if mark and name not in present:
            known = ", ".join(f"{each} [{_units(layout, each)}]" for each in present)
            alike = [each for each in present if each.rpartition("_")[2] == name.rpartition("_")[2]]
            hint = did_you_mean(name, alike or present)
            raise ValueError(f"--noise {text}: {hint}the actuators of scene {scene.name} are {known}")
        unit = f"standard deviation, {_units(layout, name)}" if mark else "fraction of the limits"
        try:
            sigma = float(number)
        except ValueError:
            raise ValueError(f"--noise {text}: should be a number, or ACTUATOR=NUMBER") from None
        if not 0.0 <= sigma < math.inf:
            raise ValueError(f"--noise is {name}{mark}{sigma}; it must be at least 0, a {unit}")
        part = present[name] if mark else slice(None)
        if mark and _limits_change(layout, scene, part):
            raise ValueError(
                f"--noise {text}: phases of scene {scene.name} change the limits of {name}: give a fraction "
                "of them, for all inputs, such as --noise 0.1"
            )
        fractions[part] = sigma / layout.control_limit[part] if mark else sigma
    return fractions


def _limits_change(layout: StateLayout, scene: Scene, part: slice) -> bool:
    """Whether inputs have other limits in some phase than in the scene, but for those out of work."""
    names, staged = layout.parameters.names, scene.staged.values if scene.phases else {}
    rows = np.tile(layout.parameters.nominal, (max(len(scene.phases), 1), 1))
    for name, values in staged.items():
        if name in names:
            rows[:, names.index(name)] = values
    limits = layout.limits_with(rows)[:, part]
    return bool(((limits != layout.control_limit[part]) & (limits != 0.0)).any())


def drowned_inputs(noise: NDArray[np.float64], scene: Scene) -> str | None:
    """Say which inputs drown in noise beyond their limits; None if none does."""
    layout = StateLayout.of(scene)
    found = [
        f"{name} ({limit:.2g} {unit})"
        for name, limit, unit, share in zip(
            layout.control.names, layout.control_limit, layout.control.units, noise, strict=True
        )
        if share > 1.0
    ]
    return f"the noise is larger than the limits of {', '.join(found)}" if found else None


def _units(layout: StateLayout, actuator: str) -> str:
    return ", ".join(dict.fromkeys(layout.control.units[getattr(layout.control, actuator)]))


def final_errors(start: Start, flight: Trajectory) -> tuple[float, ...]:
    """Errors at the end of a flight, see `Kernels.tip_errors`."""
    kernels = compile_scene(start.scene)
    row = kernels.stage_parameters(start.parameters)[len(flight.controls)]
    return tuple(kernels.tip_errors(flight.states[-1], p=row).tolist())


def flown_catches(start: Start, states: ArrayLike, inputs: ArrayLike) -> list[Catch]:
    """Judge the catches of an episode by states (N + 1, n_x) and inputs (N, n_u)."""
    kernels = compile_scene(start.scene)
    return catches(kernels, kernels.stage_parameters(start.parameters), states, inputs)


def catch_rows(catch: Catch) -> Iterator[tuple[str, str, str]]:
    """Rows of a table."""
    missed = "MISSED", "nothing is held from then on"
    yield f"catch, {catch.phase}", *(("caught", "") if catch.is_met else missed)
    for name, error, note in error_rows(catch.tolerances, catch.errors):
        yield f"  {name}", error, note


def error_rows(
    success: Success, errors: Sequence[float], condition: str = ""
) -> Iterator[tuple[str, str, str]]:
    """Rows of a table: errors at the end in the order of the tolerances, and whether each is within its own.

    `condition` is what these verdicts hold under, such as " as if caught".
    """
    names = (
        ("attitude error", "deg"),
        ("position error", "m"),
        ("angular velocity", "deg/s"),
        ("velocity", "m/s"),
    )
    for (name, unit), error, most in zip(names, errors, success.tolerances, strict=False):
        notes = ["relative to the target"] if "velocity" in name else []
        if math.isfinite(most):
            verdict = "within" if error <= most else "NOT within"
            notes.append(f"{verdict} the tolerance of {most:g} {unit}{condition}")
        yield name, f"{error:.3g} {unit}", "; ".join(notes)


def numerical_error(start: Start, flight: Trajectory, caught: Sequence[Catch] = ()) -> float:
    """How far the tip ends from where the same inputs truly bring it, m or rad, whichever is larger.

    Where it misses a catch, before that: the true motion is taken to hold the payload from then on.
    """
    kernels = compile_scene(start.scene)
    inputs = flight.controls if flight.noise is None else flight.controls + flight.noise
    stages = kernels.stage_parameters(start.parameters)[: len(inputs)]
    inputs = kernels.applied_inputs(flight.states[:-1], inputs, p=stages)
    errors = kernels.numerical_error(flight.states, inputs, start.parameters)
    last = next((catch.step for catch in caught if not catch.is_met), -1)
    return float(errors[last])


def read_state(text: str, size: int) -> NDArray[np.float64]:
    """Read a state, shape (size,), units of the state, from text or a file.

    Text is numbers separated by commas. A file is .npy, .json with a list, or .npz, the first row of its
    `states`.
    """
    path = Path(text)
    if path.suffix in FILES and not path.is_file():
        raise ValueError(f"--start {text}: there is no such file")
    try:
        values = np.asarray(_from_file(path) if path.suffix in FILES else text.split(","), dtype=np.float64)
    except _UNREADABLE as error:
        raise ValueError(
            f"--start {text}: should be {size} numbers separated by commas, or a file ({', '.join(FILES)})"
        ) from error
    if values.shape != (size,):
        raise ValueError(f"--start: has shape {values.shape}, should be the scene's ({size},)")
    return values


def _from_file(path: Path) -> Any:
    if path.suffix == ".json":
        return read_json(path)
    return read_arrays(path, ("states",))["states"][0] if path.suffix == ".npz" else read_array(path)
