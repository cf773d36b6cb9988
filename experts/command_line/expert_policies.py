"""The expert's policies for `simulate` and `replay`: entry point of the group `dq_space_arm.policies`."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING

from dq_space_arm_env.common.bounded_reading import archive_members

if TYPE_CHECKING:
    from rich.console import Console

    from dq_space_arm_env import Scene
    from dq_space_arm_env.command_line.simulated_episode import Pilot, Start
    from experts import Solution

_NAMES = {
    "plan": "the expert's plan from this start, open loop",
    "gains": "the expert's plan with its feedback gains",
    "receding": "the expert, replanning the next stages at every step",
}


def policy_names() -> dict[str, str]:
    """List the expert's policies."""
    return _NAMES


def owns_policy(policy: str) -> bool:
    """Recognize the names, and the files of solutions."""
    return policy.lower() in _NAMES or "feedback_gains" in archive_members(Path(policy))


def load_policy(policy: str, start: Start, console: Console, seed: int | None, trust: bool) -> Pilot:
    """Solve the maneuver from a start, or read its solution, which holds no code."""
    from dq_space_arm_env import compile_scene
    from dq_space_arm_env.command_line.simulated_episode import Pilot
    from dq_space_arm_env.environment.rollouts import StateFeedback
    from dq_space_arm_env.scene import StateLayout

    name, layout = policy.lower(), StateLayout.of(start.scene)
    if name == "receding":
        from experts import RecedingHorizonExpert

        expert = RecedingHorizonExpert(start.scene)
        expert.reset(start.state, parameters=start.parameters)
        return Pilot("receding horizon", StateFeedback(lambda states, step: expert(states[0])[None]))
    if name == "plan":
        solution = _plan(start, console)
        actions = layout.to_action(solution.controls, solution.parameters[:-1])
        return Pilot("open-loop plan", StateFeedback(lambda states, step: actions[step][None]))
    if name == "gains":
        label, solution = "plan with gains", _plan(start, console)
    else:
        label, solution = Path(policy).stem, _read(Path(policy), start.scene)
    follow = solution.policy(start.scene)
    stages = compile_scene(start.scene).stage_parameters(start.parameters)
    acting = StateFeedback(lambda states, step: layout.to_action(follow(states[0], step), stages[step])[None])
    return Pilot(label, acting)


def _plan(start: Start, console: Console) -> Solution:
    from experts import GuidedDDP
    from experts.ddp.solution import uninterrupted
    from experts.report import SolveProgress

    with SolveProgress(console, start.scene) as progress:
        solver = GuidedDDP(start.scene)
        solver.prepare(progress.update)
        progress.start()
        found = solver.solve(start.state, callback=progress.update, parameters=start.parameters)
        return uninterrupted(found)


def _read(path: Path, scene: Scene) -> Solution:
    import zipfile
    import zlib

    from experts import Solution

    try:
        solution = Solution.load(path)
    except (OSError, ValueError, KeyError, EOFError, zipfile.BadZipFile, zlib.error) as error:
        raise ValueError(f"{path} cannot be read as a solution ({error}): solve it again") from error
    if len(solution.controls) != scene.simulation.steps:
        raise ValueError(
            f"{path.stem}: the solution has {len(solution.controls)} steps, the scene "
            f"{scene.simulation.steps}: solve this scene"
        )
    return solution
