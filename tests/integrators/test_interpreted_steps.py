"""Every method's step and its derivatives, evaluated graph by graph in NumPy: nothing is compiled here.

A small robot in space and one in the plane, with springs and dampers, against SciPy's solution of the same
field, and against complex steps.
"""

from typing import Any

import casadi
import numpy as np
import pytest
from scipy.integrate import solve_ivp

from dq_space_arm_env import Scene
from dq_space_arm_env.algebra import dual_quaternion as dq
from dq_space_arm_env.compiler.program import Program
from dq_space_arm_env.kernels.programs.scene_programs import ScenePrograms
from dq_space_arm_env.scene import INTEGRATORS

interpreter = pytest.importorskip("graph_interpreter")

STORED = {True: [0, 3, 5, 6], False: list(range(8))}
TURNING = {True: [3, 5, 6], False: [1, 2, 3, 5, 6, 7]}
TINY = 1e-30


def robot(short_scene: Scene, motion: str) -> Scene:
    """A sprung joint, along the base's axis in the plane and askew to it in space."""
    link = short_scene.links[0].model_dump() | {"stiffness": 4.0, "damping": 0.5, "rest_angle": 0.1}
    if motion == "planar":
        return short_scene.replace(links=[link])
    joint = {"position": [0.6, 0.1, 0], "rotation": {"axis": [1, 0, 0], "angle": 80}}
    base = {"motion": "spatial", "inertia": [1.0, 1.5, 2.0]}
    return short_scene.replace(base=base, links=[link | {"joint": joint}])


@pytest.fixture(scope="module", params=["planar", "spatial"])
def programs(request: Any, short_scene: Scene) -> ScenePrograms:
    return ScenePrograms(robot(short_scene, request.param))


def start_of(programs: ScenePrograms) -> tuple[np.ndarray, np.ndarray]:
    rng, layout = np.random.default_rng(0), programs.layout
    x = layout.initial_state.copy()
    x[layout.state.pose.stop :] = rng.uniform(-0.5, 0.5, layout.n_x - layout.state.pose.stop)
    return x, rng.uniform(-0.4, 0.4, layout.n_u)


def stepped(programs: ScenePrograms, name: str, x: Any, u: Any, h: float, number: Any = float) -> np.ndarray:
    program = programs.build("step", name)
    frozen = ("taken", "substep_time")  # derivatives of adaptive methods hold their substeps fixed
    inputs = {"x": np.asarray(x), "u": np.asarray(u), "h": np.array([h])}
    return interpreter.evaluate_program(program, inputs, number, frozen=frozen)["x_next"]


def dense(program: Program, name: str, entries: np.ndarray) -> np.ndarray:
    """A matrix by rows, of which the program writes the entries that may differ from zero."""
    buffer = next(buffer for buffer in program.outputs if buffer.name == name)
    result = np.zeros(buffer.stride)
    result[list(buffer.positions if buffer.positions is not None else range(buffer.size))] = entries
    return result


def exact(programs: ScenePrograms, x: np.ndarray, u: np.ndarray, h: float) -> np.ndarray:
    """The end of the motion by SciPy, on pose and y."""
    field, planar = programs.field, programs.layout.planar
    y = casadi.SX.sym("y", field.n_y)
    function = casadi.Function("rates", [y], [casadi.vertcat(*field.rates(casadi.vertsplit(y), u.tolist()))])
    count = field.n_x - field.n_y

    def rates(_: float, state: np.ndarray) -> np.ndarray:
        pose, rest = np.zeros(8), state[count:]
        pose[STORED[planar]] = state[:count]
        twist = field.pose.full_twist([rest[i] for i in field.pose.twist_indices])
        turned = np.array(dq.derivative(tuple(pose), tuple(twist)))[STORED[planar]]
        return np.concatenate([turned, np.array(function(rest)).ravel()])

    return solve_ivp(rates, (0.0, h), x, method="DOP853", rtol=1e-13, atol=1e-14).y[:, -1]


@pytest.mark.sampled
@pytest.mark.parametrize("name", INTEGRATORS)
def test_a_step_errs_by_the_power_of_its_order(name: str, programs: ScenePrograms) -> None:
    entry = INTEGRATORS[name]
    x, u = start_of(programs)
    h = {1: 0.02, 4: 0.02 if entry.is_stiff else 0.1, 6: 0.1, 8: 0.15}.get(entry.order, 0.02)
    errors = [np.abs(stepped(programs, name, x, u, h) - exact(programs, x, u, h)).max() for h in (h, h / 2)]
    if entry.is_adaptive:
        assert errors[0] < 1e-7
        return
    assert errors[0] < 2e-2
    assert errors[0] / errors[1] > 0.65 * 2.0 ** (entry.order + 1) or errors[1] < 1e-14


@pytest.mark.sampled
@pytest.mark.parametrize("name", INTEGRATORS)
def test_derivatives_of_a_step_are_its_complex_steps(name: str, programs: ScenePrograms) -> None:
    layout, h = programs.layout, 0.05
    x, u = start_of(programs)
    program = programs.build("linearize", name)
    found = interpreter.evaluate_program(program, {"x": x, "u": u, "h": np.array([h])})
    a, b = (dense(program, name, found[name]).reshape(layout.n_t, -1) for name in "AB")
    count = len(TURNING[layout.planar])

    def moved(direction: np.ndarray) -> np.ndarray:
        twist, pose = np.zeros(8), np.zeros(8)
        twist[TURNING[layout.planar]] = 0.5 * direction[:count]
        pose[STORED[layout.planar]] = x[layout.state.pose]
        change = np.array(dq.multiply(tuple(pose), tuple(twist)))[STORED[layout.planar]]
        return x + 1j * TINY * np.concatenate([change, direction[count:]])

    def tangent(ends: np.ndarray) -> np.ndarray:
        pose, change = np.zeros(8), np.zeros(8)
        pose[STORED[layout.planar]] = ends.real[layout.state.pose]
        change[STORED[layout.planar]] = ends.imag[layout.state.pose] / TINY
        twist = 2.0 * np.array(dq.multiply(dq.conjugate(tuple(pose)), tuple(change)))
        return np.concatenate([twist[TURNING[layout.planar]], ends.imag[layout.state.pose.stop :] / TINY])

    states = [moved(row) for row in np.eye(layout.n_t)] + [x] * layout.n_u
    inputs = [u] * layout.n_t + [u + 1j * TINY * row for row in np.eye(layout.n_u)]
    ends = stepped(programs, name, np.array(states).T, np.array(inputs).T, h, np.complex128)
    columns = np.array([tangent(end) for end in ends.T]).T
    np.testing.assert_allclose(np.hstack([a, b]), columns, rtol=0, atol=1e-13 * np.abs(columns).max())
