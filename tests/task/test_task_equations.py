"""Cost, observation, reward and end of an episode against the formulas written out; nothing is compiled."""

from collections.abc import Callable
from functools import partial
from typing import Any

import casadi
import numpy as np
import pytest

from dq_space_arm_env import Scene, load_scene
from dq_space_arm_env.algebra import poses
from dq_space_arm_env.compiler.graph import trace
from dq_space_arm_env.dynamics import kinematics
from dq_space_arm_env.scene.start import episode_scene, number_of_draws
from dq_space_arm_env.task import episode
from dq_space_arm_env.task.equations import SceneEquations
from dq_space_arm_env.task.step_report import FLAGS, REPORT, n_observations, observation_entries
from dq_space_arm_env.task.worst_case import worst_cost

interpreter = pytest.importorskip("graph_interpreter")

DT, STEPS = 0.05, 60


@pytest.fixture(scope="module", params=["short", "paper"])
def equations(request: Any, short_scene: Scene) -> SceneEquations:
    scene = short_scene if request.param == "short" else load_scene(request.param)
    simulation = scene.simulation.model_copy(update={"dt": DT, "steps": STEPS})
    return SceneEquations.of(scene.replace(simulation=simulation))


def run(function: Callable[..., Any], **inputs: Any) -> dict[str, np.ndarray]:
    """Values of a function over scalars, by the names of its outputs."""
    arrays = {name: np.atleast_1d(np.asarray(value, dtype=float)) for name, value in inputs.items()}
    graph = trace("graph", {name: len(array) for name, array in arrays.items()}, function)
    values = interpreter.evaluate_graph(graph, list(arrays.values()), np.float64)
    return dict(zip([name for name, _ in graph.outputs], values, strict=True))


def whole_step(equations: SceneEquations, x: Any, x_next: Any, u: Any, memory: Any, **error: Any) -> Any:
    rare = {**episode.diverged(x_next), **episode.most_cost(equations, x, memory)}
    return episode.step(equations, x, x_next, u, memory, **rare, **error)


def moving(equations: SceneEquations) -> np.ndarray:
    x, layout = equations.layout.initial_state.copy(), equations.layout
    count = layout.n_x - layout.state.pose.stop
    x[layout.state.pose.stop :] += np.random.default_rng(0).uniform(-0.3, 0.3, count)
    return x


def tip_of(equations: SceneEquations, x: np.ndarray) -> np.ndarray:
    layout, pose = equations.layout, np.zeros(8)
    pose[[0, 3, 5, 6] if layout.planar else range(8)] = x[layout.state.pose]
    angles = x[layout.state.joint_angles].tolist(), x[layout.state.wrist_angles].tolist()
    return np.array(kinematics.tip_pose(equations.tree, pose.tolist(), *angles))


def state_costs(equations: SceneEquations, x: np.ndarray, *, terminal: bool) -> list[float]:
    """Pose and base velocity, (q - q_D)' W (q - q_D) and (omega - omega_D)' W (omega - omega_D)."""
    scene, layout = equations.scene, equations.layout
    cost, twist = scene.cost, np.zeros(6)
    twist[[2, 3, 4] if layout.planar else range(6)] = x[layout.state.base_velocity]
    gap = tip_of(equations, x) - scene.target.pose.dual_quaternion
    speed = twist - scene.target.base_velocity
    pose, velocity = cost.pose, cost.base_velocity
    if terminal:
        pose, velocity = cost.terminal_pose, cost.terminal_base_velocity
    return [float(np.array(pose) @ gap**2), float(np.array(velocity) @ speed**2)]


def shown_errors(equations: SceneEquations, x: np.ndarray) -> tuple[float, float]:
    tip, target = tip_of(equations, x), equations.scene.target.pose.dual_quaternion
    position = np.array(poses.position(tip.tolist())) - poses.position(target)
    return 2.0 * np.degrees(np.arccos(min(abs(tip[:4] @ target[:4]), 1.0))), float(np.linalg.norm(position))


def test_the_nominal_start_has_no_history(equations: SceneEquations) -> None:
    count = number_of_draws(equations.scene)
    begun = run(lambda draws: episode.start(equations.scene, draws), draws=np.zeros(count)) if count else {}
    if begun:
        assert set(begun) == {"x", "memory"}
        np.testing.assert_allclose(begun["x"], equations.layout.initial_state, rtol=0, atol=1e-15)
        assert begun["memory"].tolist() == [0.0, 0.0, 0.0]


def test_actions_are_clipped_fractions_of_the_limits(equations: SceneEquations) -> None:
    limits = equations.layout.control_limit
    action = np.linspace(-1.5, 1.2, len(limits))
    given = run(partial(episode.command, equations), action=action)["u"]
    np.testing.assert_allclose(given, limits * np.clip(action, -1.0, 1.0), rtol=1e-15)


@pytest.mark.parametrize("taken", [0, 17])
def test_an_observation_tells_errors_and_the_time_left(equations: SceneEquations, taken: int) -> None:
    x, layout = moving(equations), equations.layout
    seen = run(partial(episode.observe, equations), x=x, memory=[taken, 7.0, 8.0])
    angle, distance = shown_errors(equations, x)
    assert seen["observation"][-1] == pytest.approx((STEPS - taken) * DT)
    error = poses.error_pose(tip_of(equations, x).tolist(), equations.scene.target.pose.dual_quaternion)
    kept = [0, 3, 5, 6] if layout.planar else range(8)
    count = len(list(kept))
    np.testing.assert_allclose(seen["observation"][:count], np.array(error)[list(kept)], rtol=0, atol=1e-14)
    after = [x[part] for part in (layout.state.base_velocity, layout.state.joint_angles)]
    after += [x[part] for part in (layout.state.wrist_angles, layout.state.joint_rates)]
    np.testing.assert_array_equal(seen["observation"][count:-1], np.concatenate(after))
    assert seen["report"][:-3].tolist() == [0.0] * (len(REPORT) - 3)
    np.testing.assert_allclose(seen["report"][-3:], [angle, distance, 0.0], rtol=1e-9)
    assert seen["flags"].tolist() == [0.0] * len(FLAGS)
    costs = state_costs(equations, x, terminal=False)
    np.testing.assert_allclose(seen["memory_kept"], [taken, *costs], rtol=1e-12)


@pytest.mark.parametrize(("taken", "over"), [(0, False), (STEPS - 2, False), (STEPS - 1, True)])
def test_a_step_pays_for_its_stage_and_at_the_end_for_where_it_ends(
    equations: SceneEquations, taken: int, over: bool
) -> None:
    layout, x = equations.layout, equations.layout.initial_state
    x_next, u = moving(equations), 0.3 * layout.control_limit
    before = state_costs(equations, x, terminal=False)
    given = {"x": x, "x_next": x_next, "u": u, "memory": [taken, *before]}
    done = run(partial(whole_step, equations), **given)
    effort = float(layout.control_weight @ u**2)
    terminal = state_costs(equations, x_next, terminal=True) if over else [0.0, 0.0]
    reward = -sum(before) - effort - sum(terminal)
    expected = [reward, *before, effort, *terminal, *shown_errors(equations, x_next), np.nan]
    np.testing.assert_allclose(done["report"], expected, rtol=1e-9)
    told = run(partial(whole_step, equations), **given, checked_error=[0.25])
    assert told["report"][-1] == 0.25
    assert done["flags"].tolist() == [over, False, False]
    assert done["observation"][-1] == pytest.approx((STEPS - taken - 1) * DT)
    np.testing.assert_array_equal(done["x_kept"], x_next)
    after = state_costs(equations, x_next, terminal=False)
    np.testing.assert_allclose(done["memory_kept"], [taken + 1, *after], rtol=1e-12)


@pytest.mark.parametrize("entry", [np.nan, np.inf, -6e5, 6e5])
def test_a_step_to_what_is_no_state_stays_and_pays_for_all_that_is_left(
    equations: SceneEquations, entry: float
) -> None:
    layout, x, taken = equations.layout, moving(equations), 20
    x_next, u = x.copy(), 0.3 * layout.control_limit
    x_next[layout.state.joint_angles.start] = entry
    before, effort = state_costs(equations, x, terminal=False), float(layout.control_weight @ u**2)
    given = {"x": x, "x_next": x_next, "u": u, "memory": [taken, *before]}
    done = run(partial(whole_step, equations), **given)
    terminal = state_costs(equations, x, terminal=True)
    reward = -float(casadi.DM(worst_cost(equations, [equations], x.tolist(), STEPS - taken)))
    assert reward < -(STEPS - taken) * (sum(before) + effort) - sum(terminal)
    np.testing.assert_allclose(done["report"][:6], [reward, *before, effort, *terminal], rtol=1e-12)
    assert done["flags"].tolist() == [True, False, True]
    np.testing.assert_array_equal(done["x_kept"], x)
    assert done["memory_kept"][0] == taken  # a step that is refused is none


def test_a_state_within_the_tolerances_is_a_success(short_scene: Scene) -> None:
    nominal = SceneEquations.of(short_scene)
    tip = tip_of(nominal, nominal.layout.initial_state)
    for angle, distance, success in (
        (0.9, 0.0, True),
        (1.1, 0.0, False),
        (0.0, 0.9, True),
        (0.0, 1.1, False),
    ):
        turn = angle * short_scene.success.attitude_error_deg
        moved = [distance * short_scene.success.position_error, 0.0, 0.0]
        aside = np.add(poses.position(tip.tolist()), moved)
        pose = {"position": aside.tolist(), "rotation": {"axis": [0, 0, 1], "angle": turn}}
        equations = SceneEquations.of(short_scene.replace(target={"pose": pose}))
        x = nominal.layout.initial_state
        seen = run(partial(episode.observe, equations), x=x, memory=[0.0] * 3)
        assert seen["flags"].tolist() == [0.0, success, 0.0]
        goal = equations.scene.target.pose.dual_quaternion
        for sign in (1.0, -1.0):  # q and -q are the same goal
            compared = run(
                partial(episode.compare_goals, equations.scene), achieved=tip, desired=sign * np.array(goal)
            )
            assert compared["is_success"] == [success]
            cost = min(np.array(equations.scene.cost.pose) @ (tip - s * np.array(goal)) ** 2 for s in (1, -1))
            assert compared["cost"][0] == pytest.approx(cost)
            np.testing.assert_allclose(compared["errors"], seen["report"][-3:-1], rtol=0, atol=1e-6)


@pytest.mark.parametrize("name", ["random-masses", "random-target"])
def test_parameters_are_what_the_episodes_scene_says(name: str) -> None:
    scene = load_scene(name)
    draws = np.random.default_rng(4).uniform(-1.0, 1.0, number_of_draws(scene))
    begun = run(lambda draws: episode.start(scene, draws), draws=draws)
    parametric = SceneEquations.of(scene)
    names = parametric.layout.parameters.names
    assert begun["parameters"].shape == (len(names),) == (len(set(names)),)
    known = SceneEquations.of(episode_scene(scene, begun["parameters"]))
    y = np.random.default_rng(5).uniform(-1.0, 1.0, known.field.n_y).tolist()
    u = np.random.default_rng(6).uniform(-1.0, 1.0, known.field.n_u).tolist()
    symbols = casadi.vertcat(*parametric.field.parameters)
    expressions = casadi.vertcat(*parametric.field.accelerations(y, u), *parametric.target)
    found = np.array(casadi.Function("f", [symbols], [expressions])(begun["parameters"])).ravel()
    expected = [*known.field.accelerations(y, u), *known.scene.target.pose.dual_quaternion]
    np.testing.assert_allclose(found, np.array(expected, dtype=float), rtol=0, atol=1e-11)


@pytest.mark.parametrize("name", ["paper", "planar", "dual-arm", "servicing"])
def test_names_of_an_observation_are_those_of_its_entries(name: str) -> None:
    """What the state also has is where its names say; the rest is counted, the time left is last."""
    equations = SceneEquations.of(load_scene(name))
    given = SceneEquations.of(equations.scene, equations.layout.parameters.nominal.tolist())
    x, entries = moving(equations), observation_entries(equations.scene)
    found = run(lambda x: {"seen": episode.seen(given, x, 7.0)["observation"]}, x=x)["seen"]
    assert len(entries) == len(found) == n_observations(equations.scene)
    values = dict(zip(entries, found.tolist(), strict=True))
    state = [*zip(equations.layout.state.names, equations.layout.state.units, strict=True)]
    for entry, value in zip(state, x.tolist(), strict=True):
        if not entry[0].startswith("base pose"):
            assert values[entry] == value
    assert values["time left", "s"] == 7.0
    assert [unit for _, unit in entries[: len(x[equations.layout.state.pose])]] == [
        unit for name, unit in state if name.startswith("base pose")
    ]
