"""An episode from beginning to end: a policy found, flown, and what became of it written down."""

from __future__ import annotations

import json
import math
import zipfile
import zlib
from collections.abc import Callable
from dataclasses import dataclass
from io import BytesIO
from pathlib import Path
from time import perf_counter
from typing import Any, NamedTuple

import numpy as np
from gymnasium.vector import AutoresetMode
from numpy.typing import NDArray
from rich.console import Console
from rich.table import Table

from agents.command_line.names import check_policy, policy_files
from agents.command_line.starts import Start, begin
from dq_space_arm_env import DQSpaceArmVectorEnv, Scene
from experts import Solution
from experts.files import write_atomically
from experts.report import SolveProgress
from experts.report.tables import plain_table

FloatArray = NDArray[np.float64]
_NOISE, _RANDOM = 1, 2
"""Streams of random numbers that go with a seed."""


@dataclass(frozen=True, eq=False)
class RecordedFlight:
    """An episode as it was flown, M steps of it.

    Attributes:
        label: What a replay calls it.
        scene: The scene.
        start: Where it began, in words.
        states: Shape (M + 1, n_x), units of the state.
        controls: What was commanded, shape (M, n_u), N, N m or rad/s.
        noise: What disturbed it on the way to the actuators, shape (M, n_u), same units.
        rewards: Shape (M,), dimensionless.
        target: Pose q_{D/I} that the tip should reach, shape (8,), dimensionless and m.
        attitude_error: Of the tip at the end, deg.
        position_error: Of the tip at the end, m.
        is_success: Whether both are within the scene's tolerances.
        diverged: Whether the simulation blew up.
        seed: Of the episode; None without one.
        action_seconds: Median time that the policy took for an action, s.
    """

    label: str
    scene: Scene
    start: str
    states: FloatArray
    controls: FloatArray
    noise: FloatArray
    rewards: FloatArray
    target: FloatArray
    attitude_error: float
    position_error: float
    is_success: bool
    diverged: bool
    seed: int | None
    action_seconds: float

    @property
    def cost(self) -> float:
        """J, minus the return of the episode; dimensionless."""
        return -math.fsum(self.rewards.tolist())

    def facts(self) -> dict[str, Any]:
        """Describe the flight for programs.

        Returns:
            JSON values, units in the keys.
        """
        return {
            "label": self.label,
            "scene": self.scene.name,
            "start": self.start,
            "seed": self.seed,
            "steps": len(self.controls),
            "cost": self.cost,
            "is_success": self.is_success,
            "diverged": self.diverged,
            "final_attitude_error_deg": self.attitude_error,
            "final_position_error_m": self.position_error,
            "action_seconds": self.action_seconds,
        }

    def save(self, path: Path) -> None:
        """Write the flight into a file, complete or not at all.

        The file is NumPy's npz with `states`, `controls`, `noise` (if any), `rewards`, `target`, and `facts`,
        JSON text with the scene and what `facts` says.

        Args:
            path: The file, `.npz` by custom; its folder must exist.
        """
        arrays = {
            "states": self.states,
            "controls": self.controls,
            "rewards": self.rewards,
            "target": self.target,
        }
        if self.noise.any():
            arrays["noise"] = self.noise
        facts = {**self.facts(), "scene": self.scene.model_dump(mode="json")}
        content = BytesIO()
        np.savez_compressed(content, allow_pickle=False, facts=np.array(json.dumps(facts)), **arrays)
        write_atomically(path, content.getvalue())


Act = Callable[[NDArray[Any], FloatArray, int], NDArray[Any]]
"""From observation, shape (1, n_obs), state, shape (n_x,), and step to fractions of limits, shape (n_u,)."""


class _Pilot(NamedTuple):
    """Who flies.

    Attributes:
        label: What a replay calls the flight.
        act: Chooses actions.
        begin: Called with the environment when the episode begins.
    """

    label: str
    act: Act
    begin: Callable[[DQSpaceArmVectorEnv], object] = lambda environment: None


def fly(
    scene: Scene,
    policy: str,
    console: Console,
    *,
    seed: int | None = None,
    start: str | None = None,
    noise: float = 0.0,
    label: str | None = None,
) -> RecordedFlight:
    """Fly an episode.

    Args:
        scene: The scene.
        policy: Out of `names.POLICIES`, or the path of a solution, a policy, a model or a training run, or
            the name of a policy that is shipped.
        console: Where to show the progress of a solve.
        seed: See `starts.begin`.
        start: See `starts.begin`.
        noise: Standard deviation of the inputs' disturbance, as a fraction of their limits.
        label: What a replay calls the flight; the policy by default.

    Returns:
        The flight.

    Raises:
        ValueError: If start, noise or policy cannot be used.
    """
    if not 0.0 <= noise < math.inf:
        raise ValueError(f"--noise is {noise}; it must be at least 0, a fraction of the limits")
    check_policy(policy)
    begun = begin(scene, seed, start)
    environment = DQSpaceArmVectorEnv(1, scene, autoreset_mode=AutoresetMode.DISABLED)
    pilot = _pilot(policy, begun, environment, console, seed)
    if seed is not None:
        observation, info = environment.reset(seed=[seed])
    else:
        observation, info = environment.reset(options={"initial_state": begun.state[None]})
    pilot.begin(environment)
    generator = np.random.default_rng([seed or 0, _NOISE])
    states, actions, disturbances, rewards, times = [environment.states[0]], [], [], [], []
    for step in range(scene.simulation.steps):
        began = perf_counter()
        action = np.clip(np.asarray(pilot.act(observation, states[-1], step), dtype=np.float64), -1.0, 1.0)
        times.append(perf_counter() - began)
        disturbed = np.clip(action + noise * generator.standard_normal(action.shape), -1.0, 1.0)
        observation, reward, terminated, _, info = environment.step(disturbed[None])
        states.append(environment.states[0])
        actions.append(action)
        disturbances.append(disturbed - action)
        rewards.append(float(reward[0]))
        if terminated[0]:
            break
    limit = environment.kernels.layout.control_limit
    return RecordedFlight(
        label=label or pilot.label,
        scene=scene,
        start=begun.title,
        states=np.array(states, dtype=np.float64),
        controls=np.array(actions) * limit,
        noise=np.array(disturbances) * limit,
        rewards=np.array(rewards),
        target=np.array(environment.targets[0], dtype=np.float64),
        attitude_error=float(info["attitude_error"][0]),
        position_error=float(info["position_error"][0]),
        is_success=bool(info["is_success"][0]),
        diverged=bool(info["diverged"][0]),
        seed=seed,
        action_seconds=float(np.median(times)),
    )


def table(flight: RecordedFlight) -> Table:
    """Describe a flight for people.

    Args:
        flight: The flight.

    Returns:
        A table.
    """
    success = flight.scene.success
    verdict = (
        "DIVERGED" if flight.diverged else "success" if flight.is_success else "NOT within the tolerance"
    )
    rows = (
        ("start", flight.start, ""),
        ("cost J", f"{flight.cost:.6f}", "minus the sum of the rewards"),
        ("steps", str(len(flight.controls)), f"{1e6 * flight.action_seconds:.0f} us for an action"),
        (
            "attitude error",
            f"{flight.attitude_error:.3g} deg",
            f"tolerance {success.attitude_error_deg:g} deg",
        ),
        ("position error", f"{flight.position_error:.3g} m", f"tolerance {success.position_error:g} m"),
        ("end", verdict, ""),
    )
    return plain_table(f"Scene {flight.scene.name}, {flight.label}", ("", "", ""), rows)


def _pilot(
    policy: str, begun: Start, environment: DQSpaceArmVectorEnv, console: Console, seed: int | None
) -> _Pilot:
    """Find out who flies."""
    name, size = policy.lower(), environment.kernels.n_u
    if name == "zero":
        return _Pilot("zero inputs", lambda observation, state, step: np.zeros(size))
    if name == "random":
        generator = np.random.default_rng([seed or 0, _RANDOM])
        return _Pilot("random inputs", lambda observation, state, step: generator.uniform(-1.0, 1.0, size))
    limit = environment.kernels.layout.control_limit
    if name in ("plan", "gains"):
        plan = _plan(begun, console)
        if name == "plan":
            return _Pilot("open-loop plan", lambda observation, state, step: plan.controls[step] / limit)
        return _follower("plan with gains", plan, begun.scene, limit)
    if name == "receding":
        return _replanner(begun)
    path = Path(policy)
    if path.suffix == ".npz" and _is_solution(path):
        return _follower(path.stem, _read_solution(path), begun.scene, limit)
    return _trained(policy, begun.scene)


def _plan(begun: Start, console: Console) -> Solution:
    """The expert's maneuver from the start of this episode."""
    from experts import GuidedDDP

    with SolveProgress(console) as progress:
        return GuidedDDP(begun.scene).solve(begun.state, callback=progress.update)


def _replanner(begun: Start) -> _Pilot:
    """The expert that plans anew at every step; the maneuver as a whole is planned now."""
    from experts import RecedingHorizonExpert

    expert = RecedingHorizonExpert(begun.scene)
    expert.reset(begun.state)
    return _Pilot("receding horizon", lambda observation, state, step: expert(state))


def _follower(label: str, solution: Solution, scene: Scene, limit: FloatArray) -> _Pilot:
    """Follow a solution with its gains."""
    if len(solution.controls) != scene.simulation.steps:
        raise ValueError(
            f"{label}: the solution has {len(solution.controls)} steps, the scene {scene.simulation.steps}: "
            "solve this scene"
        )
    follow = solution.policy(scene)
    return _Pilot(label, lambda observation, state, step: follow(state, step) / limit)


def _is_solution(path: Path) -> bool:
    """Whether a file holds a solution rather than an exported policy."""
    try:
        with zipfile.ZipFile(path) as archive:
            return "feedback_gains.npy" in archive.namelist()
    except (OSError, zipfile.BadZipFile):
        return False


def _read_solution(path: Path) -> Solution:
    try:
        return Solution.load(path)
    except (OSError, ValueError, KeyError, EOFError, zipfile.BadZipFile, zlib.error) as error:
        raise ValueError(f"{path} cannot be read as a solution ({error}): solve it again") from error


def _trained(policy: str, scene: Scene) -> _Pilot:
    """A policy from a file, a training run, or those that are shipped."""
    from agents.evaluation.policies import as_policy, check_fit

    path = policy_files().get(policy, Path(policy))
    acting = as_policy(path, label=path.stem if path.is_file() else path.name)
    check_fit(acting, scene)

    def act(observation: NDArray[Any], state: FloatArray, step: int) -> NDArray[Any]:
        actions: NDArray[Any] = np.asarray(acting.act(observation))
        return np.asarray(actions[0])

    return _Pilot(acting.label, act, getattr(acting.act, "begin", lambda environment: None))
