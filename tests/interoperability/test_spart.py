"""The accelerations of SPARTpy, the Python port of SPART: an arm on a base that floats freely."""

from pathlib import Path

import numpy as np
import pytest

from dq_space_arm_env import compile_scene, load_scene, scene_to_urdf
from experts.report.part_costs import moving_states
from scripts.benchmarks.peers.robot import Robot

SPARTpy = pytest.importorskip("SPARTpy", reason="needs SPARTpy: pip install spartpy")
pytestmark = pytest.mark.slow

MASSLESS = (  # SPARTpy wants an inertia of each link
    '<inertial><mass value="0"/><inertia ixx="0" iyy="0" izz="0" ixy="0" ixz="0" iyz="0"/></inertial></link>'
)


@pytest.mark.parametrize("name", ["six-joint", "no-wrist"])
def test_accelerations(name: str, tmp_path: Path) -> None:
    kernels = compile_scene(load_scene(name))
    file = tmp_path / "robot.urdf"
    tip = '<link name="tip" />'
    assert tip in scene_to_urdf(kernels.scene)
    file.write_text(scene_to_urdf(kernels.scene).replace(tip, tip[:-3] + ">" + MASSLESS))
    spart = SPARTpy.SPART(str(file))
    x, u = moving_states(kernels, 8)
    robot = Robot.of(kernels, x, u)
    for row, ours in enumerate(kernels.forward_dynamics(x, u)):
        turn, angular = robot.to_inertial[row], robot.angular[row]
        velocity = np.concatenate([angular, turn @ robot.linear[row]])
        force = np.concatenate([robot.torque[row], turn @ robot.force[row]])
        place, angles, rates = robot.position[row], robot.angles[row], robot.rates[row]
        start = spart.space_robot_ode_input(
            0.0, turn.T, place, velocity, angles, rates, force, robot.motors[row]
        )
        found = spart.space_robot_ode(*start)
        # Their velocity is in inertial axes: its derivative is R (a + omega x v).
        linear = turn @ (ours[3:6] + np.cross(angular, robot.linear[row]))
        expected = np.concatenate([ours[:3], linear, ours[6:]])
        joints = found[-len(rates) :]
        np.testing.assert_allclose([*found[12:18], *joints], expected, rtol=1e-10, atol=1e-10)
