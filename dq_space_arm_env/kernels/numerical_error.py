"""How far a simulated motion is from the true one: another method follows it, with much finer tolerances."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from dq_space_arm_env.algebra import poses
from dq_space_arm_env.common.real_arrays import real_array
from dq_space_arm_env.kernels.robot_kernels import RobotKernels
from dq_space_arm_env.kernels.stages import fill_stages
from dq_space_arm_env.scene import INTEGRATORS, Scene

Array = NDArray[Any]

FINER, LARGEST, SMALLEST = 1e-2, 1e-8, 1e-12
"""Tolerance of the companion, relative to the scene's, and its bounds [rad, m]: less is lost in rounding."""
COMPANIONS = {"rk8": "rk6", "rodas4": "rodas5p", "rodas5p": "rodas4"}
"""Integrator of the companion, by that of the scene: never the same one, whose errors it would share."""
COMPANION = "rk8"
"""Integrator of the companion of the other ones."""


def companion(scene: Scene) -> Scene:
    """The scene in double precision, with another method and a tolerance that makes errors negligible."""
    simulation, name = scene.simulation, scene.simulation.integrator
    entry, integrator = INTEGRATORS[name], COMPANIONS.get(name, COMPANION)
    own = simulation.tolerance_of(entry.tolerances[0]) if entry.is_adaptive else simulation.division
    tolerance = min(LARGEST, max(FINER * own, SMALLEST))
    keys = {"integrator": integrator, "tolerance": tolerance, "rtol": None, "atol": None}
    return scene.replace(simulation={**keys, "precision": "float64"})


def numerical_error(finer: RobotKernels, states: ArrayLike, u: ArrayLike, p: ArrayLike | None) -> Array:
    """See `Kernels.numerical_error`; `finer` are the functions of the companion."""
    motion, controls = real_array("states", states), real_array("u", u)
    expected = (controls.shape[0] + 1, *controls.shape[1:-1], finer.n_x) if controls.ndim in (2, 3) else None
    if motion.shape != expected:
        raise ValueError(
            f"states, u: shapes {motion.shape} and {controls.shape}, should be (N + 1, n_x) and (N, n_u), or "
            "(N + 1, B, n_x) and (N, B, n_u)"
        )
    shapes = {(finer.n_p,): None, (*controls.shape[1:-1], finer.n_p): None}
    if p is not None and np.shape(p) not in shapes:
        raise ValueError(f"p: shape {np.shape(p)}, should be {' or '.join(map(str, shapes))}")
    x, errors = motion[0].astype(np.float64), np.zeros(motion.shape[:-1])
    stages = _stages(finer, p)
    if stages is not None and len(controls) >= len(stages):
        raise ValueError(
            f"u: {len(controls)} steps, should be at most {len(stages) - 1}: the phases of scene "
            f"{finer.scene.name!r} end then"
        )
    for step, control in enumerate(controls, start=1):
        own = p if stages is None else stages[step - 1]
        x = finer.call("checked_step", x=x, u=control, p=own)[0]
        tips = [tuple(np.moveaxis(finer.tip_poses(each, p), -1, 0)) for each in (x, motion[step])]
        errors[step] = np.maximum(poses.error_distance(*tips), poses.error_angle(*tips)).max(axis=-1)
    return errors


def _stages(kernels: RobotKernels, p: ArrayLike | None) -> Array | None:
    """Parameters by stage, (N + 1, n_p) or (N + 1, B, n_p), where phases change some; else None."""
    if not kernels.parameters.staged:
        return None
    given = kernels.parameters.nominal if p is None else np.asarray(p)
    rows = [np.tile(each, (kernels.scene.simulation.steps + 1, 1)) for each in np.atleast_2d(given)]
    for each in rows:
        fill_stages(kernels, each)
    return rows[0] if given.ndim == 1 else np.stack(rows, axis=1)
