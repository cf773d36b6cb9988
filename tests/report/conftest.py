"""A solved maneuver of the short scene, and states of the paper's robot."""

import numpy as np
import pytest

from dq_space_arm_env import Scene, load_scene
from dq_space_arm_env.scene import StateLayout
from experts.report import Maneuver, ManeuverRun, run_maneuver


@pytest.fixture(scope="session")
def short_run(short_scene: Scene) -> ManeuverRun:
    return run_maneuver(short_scene)


@pytest.fixture(scope="session")
def paper_maneuver() -> Maneuver:
    """The paper's robot in arbitrary states, the first one its start, with arbitrary inputs; not a motion."""
    scene = load_scene("paper")
    rng = np.random.default_rng(0)
    layout = StateLayout.of(scene)
    states = np.tile(layout.initial_state, (41, 1))
    states[1:, 8:14] += rng.uniform(-1.0, 1.0, (40, 6))  # joint and wrist angles
    controls = layout.control_limit * rng.uniform(-0.9, 0.9, (40, 12))
    controls[:, :3] *= 1e-3  # as small as the forces of the paper's maneuver are
    controls[3:7, 6] = 2.0  # the first joint at its limit
    return Maneuver(scene, states, controls)
