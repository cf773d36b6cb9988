"""Motions that the tests of integrators follow, and their end by an independent code."""

import numpy as np
from scipy.integrate import solve_ivp

from dq_space_arm_env import compile_scene, load_scene
from dq_space_arm_env.algebra import dual_quaternion as dq
from dq_space_arm_env.scene import Actuators, InitialState, Spread


def simulated(scene, **changes):
    """A shipped scene with other settings of the simulation."""
    scene = load_scene(scene)
    return scene.replace(simulation=changes)


def sprung(scene="paper", stiffness=0.0, damping=0.0, joints=None, **simulation):
    """The scene with a spring, at rest at the start, and a damper in every joint or in some."""
    scene = simulated(scene, **simulation)
    layout = compile_scene(scene).layout
    angles = layout.initial_state[layout.state.joint_angles].tolist()
    links = [link.model_dump() for link in scene.links]
    for j in range(len(links)) if joints is None else joints:
        links[j] |= {"stiffness": stiffness, "damping": damping, "rest_angle": angles[j]}
    return scene.replace(links=links)


def free_body(*actuators, **changes):
    """Kernels of a body without an arm."""
    limits = {name: {"limit": 1.0} for name in actuators or ("base_force",)}
    bare = {"links": [], "wrist": None, "initial_state": InitialState(), "spread": Spread()}
    return compile_scene(load_scene("paper").replace(actuators=Actuators(**limits), **bare, **changes))


def rollout(kernels, x, controls, dt, integrator, p=None):
    """States along a sequence of inputs."""
    return kernels.simulate(x, controls, len(controls), dt, integrator, p=p)


def moving_start(kernels, seed=0, joint_rate=0.4, base_rate=0.15):
    rng = np.random.default_rng(seed)
    layout, x = kernels.layout.state, kernels.layout.initial_state.copy()
    for part, rate in ((layout.joint_rates, joint_rate), (layout.base_velocity, base_rate)):
        x[part] = rng.uniform(-rate, rate, part.stop - part.start)
    return x


def exact_motion(kernels, x, u, end, method="DOP853", tolerance=1e-13, p=None):
    """End of a motion by SciPy, on the vector field of (8) and (22)."""
    layout, wrist = kernels.layout.state, u[kernels.layout.control.wrist_rate]

    def field(_, state):
        pose_rate = dq.derivative(tuple(state[layout.pose]), tuple(state[layout.base_velocity]))
        accelerations = kernels.forward_dynamics(state, u, p=p)
        return np.concatenate([pose_rate, state[layout.joint_rates], wrist, accelerations])

    return solve_ivp(field, (0.0, end), x, method=method, rtol=tolerance, atol=tolerance).y[:, -1]


def convergence(kernels, name, counts, reference=("rk4", 8192)):
    """Errors at the end of 1.2 s, against a finer motion, for each number of steps."""
    x = moving_start(kernels, joint_rate=0.8, base_rate=0.4)
    u = np.random.default_rng(1).uniform(-0.3, 0.3, kernels.n_u)

    def end(method, steps):
        return rollout(kernels, x, np.tile(u, (steps, 1)), 1.2 / steps, method)[-1]

    exact = end(*reference)
    return [np.linalg.norm(kernels.difference(exact, end(name, steps))) for steps in counts]
