"""A plan carried out: in the environment, step by step, and with a finer integration of the same controls."""

import math
from typing import NamedTuple

import gymnasium
import numpy as np

from dq_space_arm_env import DQSpaceArmEnv, Scene, compile_scene
from dq_space_arm_env.algebra import poses
from experts.problem import FloatArray

COST_TERMS = (
    "cost_pose",
    "cost_base_velocity",
    "cost_control",
    "terminal_cost_pose",
    "terminal_cost_base_velocity",
)
"""The terms of the cost, as the environment's `info` names them."""


class Replay(NamedTuple):
    """An episode with given controls.

    Attributes:
        total_reward: Return of the episode, dimensionless.
        cost_terms: Sum of each of `COST_TERMS` over the episode, dimensionless.
        attitude_error: Euler angle of the tip's attitude error at the end, deg.
        position_error: Distance of the tip from the target at the end, m.
        is_success: Whether both are within the scene's tolerances.
        diverged: Whether the simulation blew up.
    """

    total_reward: float
    cost_terms: dict[str, float]
    attitude_error: float
    position_error: float
    is_success: bool
    diverged: bool


def replay(scene: Scene, controls: FloatArray) -> Replay:
    """Play controls in the environment, from the scene's nominal start.

    Args:
        scene: The scene.
        controls: One row per step of the scene, within the limits, shape (N, n_u), N, N m or rad/s.

    Returns:
        How the episode went.

    Raises:
        ValueError: If the environment refuses the scene, for example for want of a finite limit.
    """
    env = gymnasium.make("DQSpaceArm-v0", scene=scene)
    space_arm = env.unwrapped
    assert isinstance(space_arm, DQSpaceArmEnv)
    actions = controls / space_arm.kernels.layout.control_limit
    _, info = env.reset(options={"nominal": True})
    rewards, terms = [], []
    for action in actions:
        _, reward, terminated, _, info = env.step(action)
        rewards.append(float(reward))
        terms.append([info[name] for name in COST_TERMS])
        if terminated:
            break
    env.close()
    sums = (math.fsum(column) for column in zip(*terms, strict=True))
    return Replay(
        math.fsum(rewards),
        dict(zip(COST_TERMS, sums, strict=True)),
        info["attitude_error"],
        info["position_error"],
        info["is_success"],
        info["diverged"],
    )


def errors_with_finer_steps(scene: Scene, controls: FloatArray, substeps: int = 4) -> tuple[float, float]:
    """Integrate the controls with RK4 and a shorter time step: what is left of a plan in accurate dynamics.

    Args:
        scene: The scene.
        controls: One row per step of the scene, shape (N, n_u), N, N m or rad/s.
        substeps: Steps of the integration in a step of the scene.

    Returns:
        Euler angle of the tip's attitude error [deg] and its distance from the target [m] at the end.
    """
    kernels = compile_scene(scene)
    state = kernels.layout.initial_state
    step = scene.simulation.dt / substeps
    for control in np.repeat(controls, substeps, axis=0):
        state = kernels.step(state, control, dt=step, integrator="rk4")
    tip, target = tuple(kernels.tip_pose(state).tolist()), scene.target.pose.dual_quaternion
    return math.degrees(poses.error_angle(tip, target)), poses.error_distance(tip, target)
