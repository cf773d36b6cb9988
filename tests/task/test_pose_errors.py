"""The pose error of the cost: q_{G/I} - q_{D/I}, or q_{D/G} - 1, which common motions leave as it is.

Nothing is compiled. Derivatives against complex steps, which have no cancellation.
"""

from functools import cache, partial
from typing import Any

import numpy as np
import pytest

from dq_space_arm_env import Scene, load_scene
from dq_space_arm_env.algebra import dual_quaternion as dq
from dq_space_arm_env.algebra import screw
from dq_space_arm_env.compiler.graph import trace
from dq_space_arm_env.kernels.programs.scene_programs import ScenePrograms
from dq_space_arm_env.scene import StateLayout
from dq_space_arm_env.task import episode
from dq_space_arm_env.task.step_report import observation_entries
from dq_space_arm_env.task.worst_case import worst_cost
from experts.problems.paper_problem import PaperProblem

interpreter = pytest.importorskip("graph_interpreter")

H = 1e-30
RELATIVE: dict[str, Any] = {
    "cost.pose_error": "relative",
    "cost.pose": [3.0, 1.0, 2.0, 4.0, 20.0, 10.0, 15.0, 5.0],
    "cost.terminal_pose": [150.0, 90.0, 80.0, 110.0, 120.0, 130.0, 160.0, 70.0],
    "parameters": ["target.pose", "cost.pose"],
}
SCENES = ["paper", "planar", "tumbling-target"]


@cache
def programs_of(name: str, pose_error: str = "relative") -> ScenePrograms:
    return ScenePrograms(load_scene(name).replace({**RELATIVE, "cost.pose_error": pose_error}))


@cache
def program(name: str, pose_error: str, function: str, integrator: str = "") -> Any:
    return programs_of(name, pose_error).build(function, integrator)


def values(name: str, function: str, pose_error: str = "relative", **inputs: Any) -> dict[str, np.ndarray]:
    """What a program computes; inputs of shape (n,) or (n, lanes)."""
    built = program(name, pose_error, function)
    given = {each.name: np.asarray(inputs[each.name]) for each in built.inputs}
    dtype = np.complex128 if any(map(np.iscomplexobj, given.values())) else np.float64
    found = interpreter.evaluate_program(built, given, dtype)
    return {each.name: found[each.name] for each in built.outputs}


def point(name: str) -> dict[str, np.ndarray]:
    """A state all over the place, an input, and parameters."""
    layout, rng = programs_of(name).layout, np.random.default_rng(7)
    x = rng.normal(size=layout.n_x)
    x[layout.state.pose] = moved_pose(layout, layout.initial_state[layout.state.pose], rng.normal(size=6))
    parameters = layout.parameters.nominal.copy()
    where = layout.parameters.indices("target.pose")
    parameters[where] = moved_pose(layout, parameters[where], rng.normal(size=6))
    return {"x": x, "u": rng.normal(size=layout.n_u), "parameters": parameters, "emphasis": np.array([3.0])}


def full(layout: StateLayout, stored: np.ndarray) -> np.ndarray:
    pose = np.zeros((8, *stored.shape[1:]), stored.dtype)
    pose[[0, 3, 5, 6] if layout.planar else range(8)] = stored
    return pose


def moved_pose(
    layout: StateLayout, stored: np.ndarray, twist: np.ndarray, *, left: bool = False
) -> np.ndarray:
    """A pose moved by a twist in its own axes, or from the left: in inertial axes."""
    given = twist * (np.array([0, 0, 1, 1, 1, 0]) if layout.planar else 1.0)
    pair = full(layout, stored).tolist(), screw.exponential(given.tolist())
    product = np.array(dq.multiply(*(pair[::-1] if left else pair)))
    return product[[0, 3, 5, 6]] if layout.planar else product


def lanes(layout: StateLayout, x: np.ndarray) -> np.ndarray:
    """States moved by an imaginary step along each tangent direction, shape (n_x, n_t)."""
    x_lanes = np.repeat(x[:, None].astype(complex), layout.n_t, axis=1)
    n = 3 if layout.planar else 6
    x_lanes[layout.state.pose.stop :, n:] += 1j * H * np.eye(layout.n_t - n)
    for lane, slot in enumerate((3, 5, 6) if layout.planar else (1, 2, 3, 5, 6, 7)):
        half = [0.0] * 8
        half[slot] = 0.5
        change = np.array(dq.multiply(full(layout, x[layout.state.pose]).tolist(), half))
        x_lanes[layout.state.pose, lane] += 1j * H * change[[0, 3, 5, 6] if layout.planar else range(8)]
    return x_lanes


def matrix(name: str, function: str, output: str, given: dict[str, np.ndarray]) -> np.ndarray:
    """A square matrix of a program, from its nonzeros."""
    buffer = next(each for each in program(name, "relative", function).outputs if each.name == output)
    entries = np.zeros(buffer.stride)
    found = values(name, function, **given)[output]
    entries[range(buffer.size) if buffer.positions is None else list(buffer.positions)] = found
    return entries.reshape(round(buffer.stride**0.5), -1)


@pytest.mark.parametrize("name", SCENES)
def test_derivatives_of_the_relative_error(name: str) -> None:
    """Gradients by state and parameters, the Gauss-Newton Hessian, and the exact one."""
    layout, given = programs_of(name).layout, point(name)
    stepped = {**given, "x": lanes(layout, given["x"])}
    for cost, slopes in (
        ("cost", "cost_derivatives"),
        ("emphasized_terminal_cost", "terminal_cost_derivatives"),
    ):
        expected = values(name, cost, **stepped)["cost"][0].imag / H
        found = values(name, slopes, **given)["lx"]
        np.testing.assert_allclose(found, expected, rtol=0, atol=1e-13 * np.abs(expected).max())

    p_lanes = given["parameters"][:, None] + 1j * H * np.eye(layout.n_p)
    expected = values(name, "cost", **{**given, "parameters": p_lanes})["cost"][0].imag / H
    found = values(name, "cost_by_parameters", **given)["lp"]
    np.testing.assert_allclose(found, expected, rtol=0, atol=1e-13 * np.abs(expected).max())

    # Along a retraction the gradient turns by half the twist, which adds an antisymmetric part.
    turned = values(name, "terminal_cost_derivatives", **stepped)["lx"].imag / H
    expected = 0.5 * (turned + turned.T)
    found = matrix(name, "terminal_cost_hessian", "Lxx", given)
    np.testing.assert_allclose(found, expected, rtol=0, atol=1e-12 * np.abs(expected).max())

    tips = values(name, "tip_pose", **stepped)["pose"]
    target = layout.target_with(given["parameters"])
    error = np.array(dq.multiply(dq.conjugate(tuple(tips)), tuple(target))).imag / H
    without = {**given, "parameters": given["parameters"].copy()}
    without["parameters"][layout.parameters.indices("cost.pose")] = 0.0
    weights = np.zeros(8)
    weights[[0, 3, 5, 6] if layout.planar else range(8)] = given["parameters"][
        layout.parameters.indices("cost.pose")
    ]
    found = matrix(name, "cost_derivatives", "lxx", given) - matrix(name, "cost_derivatives", "lxx", without)
    expected = 2.0 * error.T @ (weights[:, None] * error)
    np.testing.assert_allclose(found, expected, rtol=0, atol=1e-12 * np.abs(expected).max())


def test_the_lagrangian_has_the_exact_hessian_of_the_relative_error() -> None:
    programs, given = programs_of("planar"), point("planar")
    layout = programs.layout
    given |= {"multiplier": np.zeros(layout.n_t), "h": np.array([0.01])}
    built = programs.build("lagrangian_hessian", "symplectic_euler")
    buffer = next(each for each in built.outputs if each.name == "Lxx")
    inputs = {each.name: given[each.name] for each in built.inputs}
    found = np.zeros(layout.n_t**2)
    found[list(buffer.positions)] = interpreter.evaluate_program(built, inputs)["Lxx"]
    stepped = {**given, "x": lanes(layout, given["x"])}
    turned = values("planar", "cost_derivatives", **stepped)["lx"].imag / H
    expected = 0.5 * (turned + turned.T)
    np.testing.assert_allclose(
        found.reshape(expected.shape), expected, rtol=0, atol=1e-12 * np.abs(expected).max()
    )


@pytest.mark.parametrize("name", SCENES)
def test_a_common_rigid_motion_changes_nothing(name: str) -> None:
    """Costs, gradients, Hessians and the charge of a divergence; with the paper's error the costs change."""
    layout, given = programs_of(name).layout, point(name)
    motion, shifted = (
        np.array([0.9, -0.7, 1.3, 2.0, -3.0, 4.0]),
        {key: row.copy() for key, row in given.items()},
    )
    for row, where in (
        (shifted["x"], layout.state.pose),
        (shifted["parameters"], layout.parameters.indices("target.pose")),
    ):
        row[where] = moved_pose(layout, row[where], motion, left=True)
    for function in (
        "cost",
        "terminal_cost",
        "cost_derivatives",
        "terminal_cost_derivatives",
        "terminal_cost_hessian",
    ):
        here, there = (values(name, function, **each) for each in (given, shifted))
        for output, found in here.items():
            np.testing.assert_allclose(there[output], found, rtol=0, atol=1e-12 * np.abs(found).max())
    here, there = (values(name, "cost", "paper", **each)["cost"] for each in (given, shifted))
    assert abs(there - here) > 10.0

    equations = programs_of(name).equations
    charge = trace(
        "charge",
        {"x": layout.n_x},
        lambda x: {"most": [worst_cost(equations, [equations], x, 10.0)]},
        parameters=equations.field.parameters,
    )
    bounds = [
        interpreter.evaluate_graph(charge, [each[key] for key, _ in charge.inputs], np.float64)[0]
        for each in (given, shifted)
    ]
    np.testing.assert_allclose(bounds[1], bounds[0], rtol=1e-12)
    assert bounds[0] > 10.0 * values(name, "cost", **given)["cost"]


def test_goals_are_compared_as_the_cost_compares() -> None:
    """The reward of goal environments, for either sign of a goal, before and after a common motion."""
    layout, rng = programs_of("paper").layout, np.random.default_rng(2)
    achieved, desired = (moved_pose(layout, np.eye(8)[0], rng.normal(size=6)) for _ in range(2))
    weights = np.array(RELATIVE["cost.pose"])
    error = np.array(dq.multiply(dq.conjugate(tuple(achieved)), tuple(desired)))
    expected = min(weights @ (sign * error - np.eye(8)[0]) ** 2 for sign in (1.0, -1.0))
    graph = trace(
        "goal", {"achieved": 8, "desired": 8}, partial(episode.compare_goals, programs_of("paper").scene)
    )
    names = [key for key, _ in graph.outputs]
    motion = rng.normal(size=6)
    for pair in (
        (achieved, desired),
        (achieved, -desired),
        [moved_pose(layout, q, motion, left=True) for q in (achieved, desired)],
    ):
        found = interpreter.evaluate_graph(graph, [*pair], np.float64)[names.index("cost")]
        assert found[0] == pytest.approx(expected, rel=1e-12)


def observed(scene: Scene, x: np.ndarray, parameters: np.ndarray) -> np.ndarray:
    built = ScenePrograms(scene).build("observation")
    inputs = {"x": x, "parameters": parameters, "time_left": np.array([1.0])}
    return interpreter.evaluate_program(built, inputs)["observation"]


@pytest.mark.parametrize("name", ["random-target", "planar", "tumbling-target", "capture-and-detumble"])
def test_an_observed_target_tells_the_papers_cost(name: str) -> None:
    """The cost follows from the observation, whose other entries stay; the new ones' derivative is zero."""
    plain = load_scene(name)
    scene, layout = plain.replace({"target.observed": True}), StateLayout.of(plain)
    x, parameters = layout.initial_state.copy(), layout.parameters.nominal.copy()
    entries = [entry for entry, _ in observation_entries(scene)]
    where = [index for index, entry in enumerate(entries) if entry.startswith("target q_")]
    seen, less = observed(scene, x, parameters), observed(plain, x, parameters)
    np.testing.assert_array_equal(np.delete(seen, where), less)
    target, error = (full(layout, seen[each]) for each in (where, slice(len(where))))
    np.testing.assert_array_equal(target, layout.target_with(parameters))
    tip = np.array(dq.multiply(tuple(target), dq.conjugate(tuple(error))))
    programs = ScenePrograms(scene)
    found = interpreter.evaluate_program(programs.build("tip_pose"), {"x": x, "parameters": parameters})[
        "pose"
    ]
    np.testing.assert_allclose(tip, found, rtol=0, atol=1e-14)
    built = programs.build("observation_jacobian")
    jacobian = interpreter.evaluate_program(built, {"x": x, "parameters": parameters})["jacobian"]
    assert not jacobian.reshape(len(entries), layout.n_t)[where].any()
    assert plain.content_hash() != scene.content_hash()
    assert "observed" not in plain.model_dump()["target"]
    assert "pose_error" not in plain.model_dump()["cost"]


def test_the_papers_formulation_refuses_the_relative_error() -> None:
    with pytest.raises(ValueError, match=r"has errors relative to the tip \(cost.pose_error\)"):
        PaperProblem(load_scene("paper").replace({"cost.pose_error": "relative"}))
