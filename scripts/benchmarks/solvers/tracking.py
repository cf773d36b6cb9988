"""The tip's error while the target moves: the expert beside the paper's formulation, whose target rests.

Both plan the whole episode from the scene's own start, with the same weights and limits. The target rests at
its mean, which for a screw motion is its pose halfway.
"""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np

from dq_space_arm_env import load_scene
from dq_space_arm_env.algebra import poses
from experts.ddp.solution import uninterrupted
from experts.guesses.guided import GuidedDDP
from experts.problems.arm_problem import ArmProblem
from experts.problems.shooting_problem import FloatArray
from scripts.benchmarks.harness import Row, claim

SCENE = "tracking"
TRANSIENT = 4.0  # s, for the tip to reach the target
MOST_ANGLE, MOST_DISTANCE = 0.05, 1.0
"""Largest errors of the tip after the transient, deg and mm."""


def measure_tracking() -> Iterator[Row]:
    """The tip's errors every other second, and the largest after the transient."""
    problem = ArmProblem(SCENE)
    rows = problem.kernels.stage_parameters()
    layout, targets = problem.kernels.layout, problem.kernels.layout.target_with(rows)
    mean = layout.target_body_with(rows)[len(rows) // 2].tolist()
    spread = dict.fromkeys(("target_angular_velocity", "target_linear_velocity"), 0.0)
    target = {"pose": {"dual_quaternion": mean}, "motion": None}
    fixed = ArmProblem(load_scene(SCENE).replace(target=target, spread=spread))
    moving, resting = (_errors(each, targets) for each in (problem, fixed))
    duration = problem.time_step * problem.horizon
    for time in [*np.arange(0.0, duration, 2.0), duration]:
        stage = round(time / problem.time_step)
        yield _row(f"{time:g}", moving[:, stage], resting[:, stage])
    later = round(TRANSIENT / problem.time_step)
    largest = moving[:, later:].max(axis=1), resting[:, later:].max(axis=1)
    yield _row(f"{TRANSIENT:g} on, most", *largest)
    for error, bound, unit in zip(largest[0], (MOST_ANGLE, MOST_DISTANCE), ("deg", "mm"), strict=True):
        yield claim(
            "tracking", SCENE, "tip's error", float(error), bound, unit=unit, note="after the transient"
        )


def _row(time: str, moving: FloatArray, resting: FloatArray) -> Row:
    errors = dict(zip(("angle_deg", "distance_mm"), map(float, moving), strict=True))
    fixed = dict(zip(("fixed_angle_deg", "fixed_distance_mm"), map(float, resting), strict=True))
    return {"table": "tracking", "scene": SCENE, "time": time, **errors, **fixed}


def _errors(problem: ArmProblem, targets: FloatArray) -> FloatArray:
    """Angles [deg] and distances [mm] of the planned tip from the target that moves, shape (2, N + 1)."""
    solution = uninterrupted(GuidedDDP(problem).solve())
    tips = tuple(problem.kernels.tip_pose(solution.states).T)
    goals = tuple(targets.T)
    angles = np.degrees(poses.error_angle(tips, goals))
    return np.stack([angles, 1e3 * poses.error_distance(tips, goals)])
