"""A scene that compiles and solves in seconds: planar, wheels and one joint, no thrusters, no wrist."""

import numpy as np
import pytest

from dq_space_arm_env import Scene, load_scene
from dq_space_arm_env.scene import StateLayout
from experts.report import Maneuver, ManeuverRun, run_maneuver


@pytest.fixture(scope="session")
def short_scene() -> Scene:
    return Scene.model_validate(
        {
            "name": "short",
            "base": {"motion": "planar", "mass": 20, "inertia": [1, 1, 1]},
            "links": [
                {
                    "name": "link",
                    "mass": 2,
                    "inertia": [0.01, 0.05, 0.05],
                    "center_of_mass": [0.3, 0, 0],
                    "joint": {"position": [0.3, 0, 0]},
                }
            ],
            "tip": {"position": [0.6, 0, 0]},
            "actuators": {"base_torque": {"limit": 2}, "joint_torque": {"limit": 0.5}},
            "target": {"pose": {"position": [0.6, 0.5, 0], "rotation": {"axis": [0, 0, 1], "angle": 60}}},
            "simulation": {"dt": 0.05, "steps": 60},
        }
    )


@pytest.fixture(scope="session")
def spread_scene(short_scene: Scene) -> Scene:
    """With random starts; its kernels are the same."""
    return short_scene.replace(spread={"joint_angles": 0.5, "base_position": 0.1, "base_rotation": 0.1})


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
