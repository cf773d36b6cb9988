"""Demonstrations as flights to replay: entry point of the group `dq_space_arm.flights`."""

from pathlib import Path

import numpy as np

from dq_space_arm_env.scene import StateLayout
from dq_space_arm_env.task.trajectory import Trajectory
from experts.demonstrations import DemonstrationsError, load_demonstrations


def read_demonstration(source: str, label: str | None) -> Trajectory | None:
    """Read `FOLDER` or `FOLDER#3`; None if that is not a folder."""
    folder, mark, number = source.rpartition("#")
    if not (mark and Path(folder).is_dir()):
        folder, number = source, "0"
    if not Path(folder).is_dir():
        return None
    try:
        demonstrations = load_demonstrations(Path(folder))
        last = len(demonstrations) - 1
        if not number.isdecimal() or int(number) > last:
            raise ValueError(f"{folder}: there is no demonstration {number!r}; the last one is {last}")
        demonstration, scene = demonstrations[int(number)], demonstrations.scene
    except DemonstrationsError as error:
        raise ValueError(str(error)) from error
    layout, parameters = StateLayout.of(scene), demonstration.parameters
    controls = demonstration.actions * layout.limits_with(parameters)
    if layout.parameters.move_target:
        parameters = demonstrations.kernels.stage_parameters(parameters)
    target = layout.target_with(parameters) if layout.n_p else None
    name = label or f"demonstration {number}"
    return Trajectory(name, np.array(demonstration.states), controls, target=target, scene=scene)
