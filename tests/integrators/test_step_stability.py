"""What an explicit method cannot follow is predicted from the dampers and springs of a scene."""

import numpy as np
import pytest
from motions import sprung

from dq_space_arm_env import compile_scene, load_scene
from dq_space_arm_env.dynamics.step_stability import advice, joint_motion, stable
from dq_space_arm_env.scene import INTEGRATORS


def grows(scene, dt):
    """Whether rates of 1e-6 rad/s grow over 400 steps."""
    kernels = compile_scene(scene)
    where, x = kernels.layout.state, kernels.layout.initial_state.copy()
    x[where.base_velocity] = 0.0
    x[where.joint_rates] = 1e-6 * np.random.default_rng(0).normal(size=kernels.layout.n_joints)
    with np.errstate(all="ignore"):
        end = kernels.simulate(x, np.zeros(kernels.n_u), 400, dt, every=400)[-1]
    return not np.abs(end[where.joint_rates]).max() < 1e-3


@pytest.mark.parametrize(
    ("name", "integrator"), [("free-floating", "rk4"), ("planar", "rk8"), ("six-joint", "symplectic_euler")]
)
@pytest.mark.parametrize(("stiffness", "damping"), [(0.0, 3e4), (1e6, 0.0)])
def test_steps_are_stable_up_to_the_predicted_length(stiffness, damping, name, integrator):
    scene = sprung(name, stiffness, damping, integrator=integrator)
    motion, entry = joint_motion(scene), INTEGRATORS[integrator]
    longest = entry.imaginary_interval / motion.frequency if stiffness else entry.real_interval / motion.decay
    assert not grows(scene, 0.98 * longest)
    assert grows(scene, 1.03 * longest)
    assert advice(sprung(name, stiffness, damping, integrator=integrator, dt=0.98 * longest)) is None
    told = advice(sprung(name, stiffness, damping, integrator=integrator, dt=1.03 * longest))
    assert told is not None
    assert f"where {integrator} is unstable in steps of" in told
    assert "set simulation.integrator to rodas4, or dt to" in told


def test_a_scene_gets_the_stiff_method_only_where_it_needs_one():
    assert joint_motion(load_scene("paper")) == (0.0, 0.0)
    assert stable(load_scene("paper")) == load_scene("paper")
    stiff = sprung("free-floating", 0.0, 1e4)
    assert stable(stiff).simulation.integrator == "rodas4"
    assert stable(stable(stiff)) == stable(stiff)
    assert advice(stable(stiff)) is None


def test_the_stiff_method_is_not_advised_where_a_tank_refuses_it():
    jet = {"position": [-0.5, 0, 0], "direction": [1, 0, 0], "force": 5.0, "specific_impulse": 220.0}
    actuators = {"base_force": None, "thrusters": [jet], "tank": {"propellant": 3.0}}
    stiff = sprung("no-wrist", 1e7, 0.0).replace(actuators=actuators)
    assert "set simulation.dt to" in advice(stiff)
    assert stable(stiff) == stiff
