"""Demonstrations as flights to replay: entry point of the group `dq_space_arm.flights`."""

from dataclasses import replace
from pathlib import Path

import numpy as np

from dq_space_arm_env.scene import StateLayout
from dq_space_arm_env.scene.parameters import has_grasp
from dq_space_arm_env.task.trajectory import Trajectory
from experts.demonstrations import DemonstrationsError, load_demonstrations
from experts.demonstrations.folder import SETTINGS


def read_demonstration(source: str, label: str | None) -> Trajectory | None:
    """Read `FOLDER` or `FOLDER#3`; None if that is not a folder."""
    folder, mark, number = source.rpartition("#")
    if not (mark and Path(folder).is_dir()):
        folder, number = source, "0"
    if not Path(folder).is_dir():
        return None
    if not any((Path(folder) / name).exists() for name in (SETTINGS, "solution.npz")):
        raise ValueError(f"{folder} holds neither a solution.npz nor demonstrations, which have a {SETTINGS}")
    try:
        demonstrations = load_demonstrations(Path(folder))
        last = len(demonstrations) - 1
        if last < 0:
            raise ValueError(f"{folder} holds no demonstration: all of its problems failed")
        if not number.isdecimal() or int(number) > last:
            raise ValueError(f"{folder}: there is no demonstration {number!r}; the last one is {last}")
        demonstration, scene = demonstrations[int(number)], demonstrations.scene
    except DemonstrationsError as error:
        raise ValueError(str(error)) from error
    layout, parameters = StateLayout.of(scene), demonstration.parameters
    stages = demonstrations.kernels.stage_parameters(parameters)
    controls = layout.to_control(demonstration.actions, stages[:-1])
    if layout.parameters.move_target:
        parameters = stages
    flight = Trajectory(
        label or f"demonstration {number}", np.array(demonstration.states), controls, seed=demonstration.seed
    )
    if layout.n_p:
        flight = replace(flight, target=layout.target_with(parameters))
    if layout.n_p and has_grasp(scene):
        flight = replace(flight, target_body=layout.target_body_with(parameters))
    return replace(flight, scene=scene)
