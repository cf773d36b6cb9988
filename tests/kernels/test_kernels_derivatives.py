"""Exact derivatives: complex steps through the traced graphs, for every robot and integrator."""

from itertools import product

import numpy as np
import pytest

from dq_space_arm_env import compile_scene, list_scenes, load_scene
from dq_space_arm_env.algebra import dual_quaternion as dq
from dq_space_arm_env.kernels.programs.scene_programs import ScenePrograms
from dq_space_arm_env.scene import INTEGRATORS
from scripts.benchmarks.robots import robots

interpreter = pytest.importorskip("graph_interpreter")

H = 1e-30  # a complex step has no cancellation: any size works


def tangent_of(layout, x, dx):
    """First-order tangent coordinates of a change dx of the stored numbers of a state."""
    pose = layout.state.pose
    if layout.planar:
        q, dq_stored = np.zeros(8), np.zeros(8)
        q[[0, 3, 5, 6]], dq_stored[[0, 3, 5, 6]] = x[pose], dx[pose]
    else:
        q, dq_stored = x[pose], dx[pose]
    twist = 2.0 * np.array(dq.multiply(dq.conjugate(tuple(q)), tuple(dq_stored)))
    twist = twist[[1, 2, 3, 5, 6, 7]]
    return np.concatenate([twist[[2, 3, 4]] if layout.planar else twist, dx[pose.stop :]])


def moved(layout, x, direction):
    """The state moved by an infinitesimal imaginary tangent vector."""
    result = x.astype(complex)
    n = 3 if layout.planar else 6
    result[layout.state.pose.stop :] += 1j * H * direction[n:]
    twist = np.zeros(8)
    slots = np.array([3, 5, 6] if layout.planar else [1, 2, 3, 5, 6, 7])
    twist[slots] = 0.5 * direction[:n]
    stored = [0, 3, 5, 6] if layout.planar else list(range(8))
    q = np.zeros(8)
    q[stored] = x[layout.state.pose]
    change = np.array(dq.multiply(tuple(q), tuple(twist)))
    result[layout.state.pose] += 1j * H * change[stored]
    return result


def complex_step_jacobians(kernels, program, x, u):
    """Derivatives of a traced step."""
    layout, h = kernels.layout, [kernels.scene.simulation.dt]

    # One lane for each direction.
    x_lanes = [moved(layout, x, row) for row in np.eye(kernels.n_t)] + [x] * kernels.n_u
    u_lanes = [u] * kernels.n_t + [u + 1j * H * row for row in np.eye(kernels.n_u)]
    inputs = {"x": np.array(x_lanes).T, "u": np.array(u_lanes).T, "h": h}
    inputs["parameters"] = kernels.parameters.nominal
    # Derivatives of adaptive methods are those of the steps taken, with their lengths held fixed.
    buffers = interpreter.evaluate_program(program, inputs, np.complex128, frozen=("taken", "substep_time"))
    x_next = buffers["x_next"].T
    columns = np.array([tangent_of(layout, row.real, row.imag / H) for row in x_next])
    return columns[: kernels.n_t].T, columns[kernels.n_t :].T


STRUCTURES = ("no-wrist", "paper", "planar", "random-masses", "six-joint", "tip-load")


def scenes_and_integrators():
    """Every robot with rk4 and methods with second derivatives; the others on scenes of each structure."""
    for integrator, scene in product(INTEGRATORS, robots()):
        spherical = any(link.is_spherical for link in load_scene(scene).links)
        if spherical and not INTEGRATORS[integrator].turns_quaternions:
            continue
        if integrator in ("rodas5p", "rk8") and scene != "planar":
            continue  # they share all but numbers with rodas4 and rk6
        if integrator == "rk4" or scene in STRUCTURES or INTEGRATORS[integrator].curvature == integrator:
            yield scene, integrator


@pytest.mark.sampled
@pytest.mark.parametrize(("scene", "integrator"), list(scenes_and_integrators()))
def test_linearization_agrees_with_complex_steps(scene, integrator, draw):
    kernels, states, inputs = draw(scene, 3)
    a, b = kernels.linearize(states, inputs, integrator=integrator)
    program = ScenePrograms(kernels.scene).build("step", integrator)
    for k in range(3):
        expected_a, expected_b = complex_step_jacobians(kernels, program, states[k], inputs[k])
        np.testing.assert_allclose(a[k], expected_a, rtol=0, atol=2e-13 * max(1.0, np.abs(expected_a).max()))
        np.testing.assert_allclose(b[k], expected_b, rtol=0, atol=2e-13)


@pytest.mark.sampled
@pytest.mark.parametrize("scene", robots())
def test_machine_code_agrees_with_the_interpreted_graph(scene, draw):
    kernels, states, inputs = draw(scene, 2)
    program = ScenePrograms(kernels.scene).build("step", "rk4")
    given = {"h": [kernels.scene.simulation.dt], "parameters": kernels.parameters.nominal}
    for x, u in zip(states, inputs, strict=True):
        expected = interpreter.evaluate_program(program, {"x": x, "u": u, **given}, np.longdouble)["x_next"]
        found, largest = kernels.step(x, u, integrator="rk4"), float(np.abs(expected).max())
        np.testing.assert_allclose(found, expected.astype(float), rtol=1e-13, atol=1e-14 * max(10.0, largest))


@pytest.mark.sampled
@pytest.mark.parametrize("scene", list_scenes())
def test_cost_derivatives_agree_with_complex_steps(scene, draw):
    kernels, states, inputs = draw(scene, 3)
    programs = ScenePrograms(kernels.scene)
    cost, terminal = programs.build("cost"), programs.build("emphasized_terminal_cost")
    emphasis = [3.0]
    lx, lu, lxx, luu = kernels.call("cost_derivatives", x=states, u=inputs)
    terminal_lx, terminal_lxx = kernels.call("terminal_cost_derivatives", x=states, emphasis=emphasis)
    layout = kernels.layout
    for k, (x, u) in enumerate(zip(states, inputs, strict=True)):

        def gradient(program, variations, fixed):
            given = {**fixed, **variations, "parameters": kernels.parameters.nominal}
            result = interpreter.evaluate_program(program, given, np.complex128)
            return result["cost"][0].imag / H

        along_x = {"x": np.array([moved(layout, x, row) for row in np.eye(kernels.n_t)]).T}
        along_u = {"u": np.array([u + 1j * H * row for row in np.eye(kernels.n_u)]).T}
        scale = np.abs(lx[k]).max()
        np.testing.assert_allclose(lx[k], gradient(cost, along_x, {"u": u}), rtol=0, atol=1e-13 * scale)
        np.testing.assert_allclose(lu[k], gradient(cost, along_u, {"x": x}), rtol=1e-12)
        expected = gradient(terminal, along_x, {"emphasis": emphasis})
        np.testing.assert_allclose(
            terminal_lx[k], expected, rtol=0, atol=1e-13 * np.abs(terminal_lx[k]).max()
        )
    n_u = kernels.n_u
    np.testing.assert_array_equal(luu[0].reshape(n_u, n_u), np.diag(2.0 * layout.control_weight))
    for hessian in (*lxx, *terminal_lxx):
        matrix = hessian.reshape(kernels.n_t, kernels.n_t)
        np.testing.assert_allclose(matrix, matrix.T, rtol=0, atol=max(1e-11, 1e-15 * np.abs(matrix).max()))
        eigenvalues = np.linalg.eigvalsh(matrix)
        assert eigenvalues[0] > -max(1e-10, 1e-15 * eigenvalues[-1])  # Gauss-Newton: never negative


def test_gauss_newton_hessian_is_exact_at_the_target():
    """With no residual the Hessian of the pose cost is 2 J' W J: differences of the gradient."""
    scene = load_scene("no-wrist")
    x = compile_scene(scene).layout.initial_state
    q = compile_scene(scene).tip_pose(x).tolist()
    kernels = compile_scene(scene.replace(target={"pose": {"dual_quaternion": q}}))
    u = np.zeros((1, kernels.n_u))
    lxx = kernels.call("cost_derivatives", x=x[None], u=u)[2].reshape(kernels.n_t, kernels.n_t)
    h, numeric = 1e-6, np.zeros_like(lxx)
    for i, row in enumerate(np.eye(kernels.n_t)):
        plus, minus = (
            kernels.call("cost_derivatives", x=kernels.retract(x, sign * h * row)[None], u=u)[0][0]
            for sign in (1.0, -1.0)
        )
        numeric[:, i] = (plus - minus) / (2 * h)
    np.testing.assert_allclose(lxx, numeric, rtol=0, atol=1e-6 * np.abs(lxx).max())
