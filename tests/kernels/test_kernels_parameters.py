"""Derivatives of steps and costs by the parameters of an episode, against complex steps."""

from itertools import product

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from dq_space_arm_env import load_scene
from dq_space_arm_env.algebra import dual_quaternion as dq
from dq_space_arm_env.algebra.symbolic import symbols as symbols_of
from dq_space_arm_env.compiler import native
from dq_space_arm_env.compiler.build import build_program
from dq_space_arm_env.compiler.graph import graph_of
from dq_space_arm_env.compiler.program import Buffer, Program
from dq_space_arm_env.integrators import integrator_of
from dq_space_arm_env.kernels.bound import BoundKernel
from dq_space_arm_env.kernels.programs.environment_programs import EnvironmentPrograms
from dq_space_arm_env.kernels.programs.parameter_programs import ParameterPrograms
from dq_space_arm_env.scene import INTEGRATORS, StateLayout
from dq_space_arm_env.task.equations import SceneEquations, total

interpreter = pytest.importorskip("graph_interpreter")

H = 1e-30  # a complex step has no cancellation: any size works

EVERYTHING = {
    "target_rotation": 0.4,
    "target_position": 0.3,
    "base_mass": 0.2,
    "base_inertia": 0.3,
    "link_masses": 0.4,
    "link_inertias": 0.5,
}


def scene_of(name):
    """A scene of the package, one with all that may be drawn (paper+, planar+), or by a seed a random one."""
    if isinstance(name, int):
        return random_scene(name)
    return load_scene(name[:-1]).replace(spread=EVERYTHING) if name.endswith("+") else load_scene(name)


def random_body(rng):
    """Point masses on the axes a, b, c of a turned frame."""
    turn = Rotation.random(random_state=rng).as_matrix()
    masses = rng.uniform(0.1, 1.0, 3)
    inertia = turn @ np.diag(masses.sum() - masses) @ turn.T
    center = rng.normal(scale=0.3, size=3).tolist()
    return {
        "mass": rng.uniform(1, 9),
        "center_of_mass": center,
        "inertia": (0.5 * (inertia + inertia.T)).tolist(),
    }


def random_scene(seed):
    """Bodies, springs and frames at random; all but the frames are parameters, and target and weights."""
    rng = np.random.default_rng(seed)
    places = [f"links.{index}" for index in range(rng.integers(1, 5))]
    links = []
    for name in places:
        rotation = Rotation.random(random_state=rng).as_quat(scalar_first=True).tolist()
        joint = {"position": rng.normal(scale=0.5, size=3).tolist(), "rotation": rotation}
        springs = dict(zip(("stiffness", "rest_angle", "damping"), rng.uniform(0.1, 5.0, 3), strict=True))
        links.append(random_body(rng) | springs | {"name": name, "joint": joint})
    base = random_body(rng)
    at_rest = [0.0] * len(links)
    return load_scene("payload" if rng.integers(2) else "paper").replace(
        base={name: base[name] for name in ("mass", "inertia")},
        links=links,
        initial_state={"joint_angles": at_rest, "joint_rates": at_rest},
        parameters=["target.pose", "base", *places, "cost"],
    )


def point(scene, seed=0):
    """A moving state, inputs, the parameters of an episode, and the time step."""
    rng = np.random.default_rng(seed)
    start = EnvironmentPrograms(scene).build("environment_start", "rk4")
    draws = rng.uniform(-1, 1, start.inputs[0].size)
    parameters = interpreter.evaluate_program(start, {"draws": draws})["parameters"]
    layout = StateLayout.of(scene)
    x = layout.initial_state.copy()
    x[layout.state.pose.stop :] += rng.normal(size=layout.n_x - layout.state.pose.stop)
    h = [scene.simulation.dt]
    return {"x": x, "u": rng.normal(size=layout.n_u), "parameters": parameters, "h": h}


def lanes_of(inputs):
    """One lane for each parameter, with a complex step along it."""
    n = len(inputs["parameters"])
    lanes = {name: np.repeat(np.array(value)[:, None], n, axis=1) for name, value in inputs.items()}
    return lanes | {"parameters": lanes["parameters"] + 1j * H * np.eye(n)}


def step_by_complex_steps(equations, integrator, inputs):
    """P by complex steps, in tangent coordinates."""
    field, layout = equations.field, equations.layout
    buffers = [Buffer("x", field.n_x), Buffer("u", field.n_u), Buffer("h", 1)]
    program = Program(
        "step", [*buffers, Buffer("parameters", len(field.parameters))], [Buffer("x_next", field.n_x)]
    )
    integrator_of(equations.scene.simulation, integrator).append_step(program, field)
    # Derivatives of adaptive methods are those of the steps taken, with their lengths held fixed.
    frozen = ("taken", "substep_time")
    x_next = interpreter.evaluate_program(program, lanes_of(inputs), np.complex128, frozen)["x_next"]
    pose, stored = layout.state.pose, list(field.pose.stored)
    columns = []
    for column in x_next.T:
        q, change = np.zeros((2, 8))
        q[stored], change[stored] = column.real[pose], column.imag[pose] / H
        twist = 2.0 * np.array(dq.to_vector(dq.multiply(dq.conjugate(tuple(q)), tuple(change))))
        columns.append([*twist[list(field.pose.directions)], *column.imag[pose.stop :] / H])
    return np.array(columns).T


DEFAULT = (
    ("random-masses", "rk4"),
    ("random-target", "rk4"),
    ("planar+", "dormand_prince"),
    ("planar+", "rodas4"),
    ("planar+", "momentum_rk4"),
    (0, "rk4"),
)


def cases():
    """Every method with each kind of parameters; by default, one method of each kind."""
    scenes = ("random-masses", "random-target", "paper+", "planar+")
    for case in (*product(scenes, INTEGRATORS), *product((0, 1, 2), ("rk4", "symplectic_euler", "rodas4"))):
        if case[1] in ("rodas5p", "rk8") and case[0] != "planar+":
            continue  # they share all but numbers with rodas4 and rk6
        is_shown = case[0] in ("random-masses", "random-target") or case in ((0, "rodas4"), (2, "rodas4"))
        late = pytest.mark.endurance if is_shown else pytest.mark.slow
        yield pytest.param(*case, marks=() if case in DEFAULT else late)


@pytest.mark.sampled
@pytest.mark.parametrize(("name", "integrator"), list(cases()))
def test_a_step_is_differentiated_by_parameters(name, integrator):
    scene = scene_of(name)
    equations, inputs = SceneEquations.of(scene), point(scene)
    if INTEGRATORS[integrator].is_adaptive:
        inputs["h"] = [0.01 if isinstance(name, int) else 0.15]  # several substeps
    expected = step_by_complex_steps(equations, integrator, inputs)
    program = ParameterPrograms(equations).linearize(integrator)
    actual = interpreter.evaluate_program(program, inputs)["P"].reshape(expected.shape)
    # A target does not move the robot; masses do.
    assert (expected != 0.0).any() == (name != "random-target")
    np.testing.assert_allclose(actual, expected, rtol=0, atol=1e-12 * np.abs(expected).max())
    # Parameters differ in size, from 0.02 kg m^2 to 100 kg.
    largest = np.abs(expected).max(axis=0)
    assert (np.abs(actual - expected) <= 1e-11 * largest).all()


@pytest.mark.parametrize(
    "name", ["random-target", "random-masses", 0, pytest.param("planar+", marks=pytest.mark.slow)]
)
def test_costs_are_differentiated_by_parameters(name):
    scene = scene_of(name)
    equations, inputs = SceneEquations.of(scene), point(scene)
    programs, n = ParameterPrograms(equations), len(inputs["parameters"])
    field, parameters = equations.field, list(equations.field.parameters)
    sizes = {"x": field.n_x, "u": field.n_u}
    symbols = {key: symbols_of(key, size) for key, size in sizes.items()}
    costs = {
        "cost": total(equations.cost_terms(symbols["x"], symbols["u"])),
        "terminal_cost": total(equations.terminal_cost_terms(symbols["x"])),
    }
    for key, cost in costs.items():
        graph = graph_of(key, symbols | {"parameters": parameters}, {"cost": [cost]})
        program = Program(key, [Buffer(*item) for item in graph.inputs], [Buffer("cost", 1)])
        program.call(graph)
        expected = interpreter.evaluate_program(program, lanes_of(inputs), np.complex128)["cost"][0].imag / H
        derivative = getattr(programs, key)()
        actual = interpreter.evaluate_program(derivative, inputs)["lp"]
        np.testing.assert_allclose(actual, expected, rtol=1e-12, atol=1e-12 * np.abs(expected).max())
        assert (expected != 0.0).any() == (name != "random-masses")
        assert len(actual) == n


@pytest.mark.sampled
@pytest.mark.parametrize("lanes", [1, native.host_machine().lanes])
def test_machine_code_agrees_with_the_interpreter(lanes):
    scene = scene_of("planar+")
    program = ParameterPrograms(SceneEquations.of(scene)).linearize("symplectic_euler")
    kernel = BoundKernel(native.NativeKernel(program.name, *build_program(program, lanes)))
    points = [point(scene, seed) for seed in range(9)]
    arrays = [np.array([row[spec.name] for row in points]) for spec in kernel.inputs]
    matrices = np.zeros((9, kernel.outputs[0].stride))
    kernel([*arrays, matrices], 9)
    expected = np.array([interpreter.evaluate_program(program, row)["P"] for row in points])
    np.testing.assert_allclose(matrices, expected, rtol=0, atol=1e-13 * np.abs(expected).max())


def test_a_scene_without_parameters_is_refused():
    with pytest.raises(ValueError, match="scene 'paper' has no parameters to differentiate by"):
        ParameterPrograms(SceneEquations.of(load_scene("paper")))
