"""Scenes: validated descriptions of a spacecraft with an arm, and of the maneuver asked of it."""

from dq_space_arm_env.scene.bodies import Base, Link, Payload, Wrist
from dq_space_arm_env.scene.constraint_rows import Row, path_rows, terminal_rows
from dq_space_arm_env.scene.entries import ControlEntries, StateEntries, TangentEntries
from dq_space_arm_env.scene.integrator_registry import INTEGRATORS
from dq_space_arm_env.scene.layout import StateLayout
from dq_space_arm_env.scene.loading import list_scenes, load_scene, scenes_directory
from dq_space_arm_env.scene.maneuver import (
    Actuators,
    AxisLimits,
    Cost,
    InitialState,
    JointLimit,
    Spread,
    Success,
    Target,
    TipWrench,
)
from dq_space_arm_env.scene.pose import AxisAngle, Pose
from dq_space_arm_env.scene.schema import Scene
from dq_space_arm_env.scene.shapes import Cylinder, Shape
from dq_space_arm_env.scene.simulation import Simulation
from dq_space_arm_env.scene.start import draw_initial_state, initial_state
from dq_space_arm_env.validation.problems import SceneError

__all__ = [
    "INTEGRATORS",
    "Actuators",
    "AxisAngle",
    "AxisLimits",
    "Base",
    "ControlEntries",
    "Cost",
    "Cylinder",
    "InitialState",
    "JointLimit",
    "Link",
    "Payload",
    "Pose",
    "Row",
    "Scene",
    "SceneError",
    "Shape",
    "Simulation",
    "Spread",
    "StateEntries",
    "StateLayout",
    "Success",
    "TangentEntries",
    "Target",
    "TipWrench",
    "Wrist",
    "draw_initial_state",
    "initial_state",
    "list_scenes",
    "load_scene",
    "path_rows",
    "scenes_directory",
    "terminal_rows",
]
