"""Thrusters one by one: net force by allocation, one-sided bounds, pulses, plumes, fuel."""

from typing import Any

import numpy as np
import pytest

from dq_space_arm_env import Scene, SceneError, compile_scene, load_scene
from dq_space_arm_env.environment import DQSpaceArmEnv
from dq_space_arm_env.scene import StateLayout, path_rows
from dq_space_arm_env.scene.thrusters import allocate, fuel_used
from dq_space_arm_env.task.equations import SceneEquations
from dq_space_arm_env.task.worst_case import WorstCase

JETS = [  # they push along +-x and +-y, off the center: three would do in the plane, four are symmetric
    {"position": [-0.5, 0.2, 0.0], "direction": [1, 0, 0], "force": 2.0},
    {"position": [0.5, 0.2, 0.0], "direction": [-1, 0, 0], "force": 2.0},
    {"position": [-0.2, -0.5, 0.0], "direction": [0, 2, 0], "force": 2.0},
    {"position": [-0.2, 0.5, 0.0], "direction": [0, -2, 0], "force": 2.0},
]


def planar(**changes: Any) -> Scene:
    """A base in the plane with four jets, which compiles in a second."""
    scene = {
        "name": "jets",
        "base": {"motion": "planar", "mass": 20, "inertia": [1, 1, 1]},
        "actuators": {"thrusters": JETS},
        "target": {"pose": {"position": [0.6, 0.5, 0], "rotation": {"axis": [0, 0, 1], "angle": 60}}},
        "cost": {"thruster_force": 0.1},
        "simulation": {"dt": 0.1, "steps": 100},
    }
    return Scene.model_validate(scene).replace(changes)


def test_eight_jets_with_allocation_are_the_net_force() -> None:
    jets, net = compile_scene("thrusters"), compile_scene("paper")
    rng = np.random.default_rng(0)
    x = np.tile(net.layout.initial_state, (20, 1))
    x[:, 8:] += rng.normal(size=(20, net.n_x - 8))
    force, torque = rng.normal(size=(20, 3)), 0.3 * rng.normal(size=(20, 3))
    others = rng.normal(size=(20, 6))
    forces = allocate(jets.scene, force, torque)
    assert forces.shape == (20, 8)
    assert forces.min() >= 0.0
    found = jets.forward_dynamics(x, np.hstack([others, forces]))
    expected = net.forward_dynamics(x, np.hstack([force, torque, others]))
    np.testing.assert_allclose(found, expected, rtol=0, atol=2e-15 * np.abs(expected).max())


def test_allocation_keeps_the_direction_where_the_jets_are_too_weak() -> None:
    scene = load_scene("thrusters")
    b = np.array([[*each.unit_direction, *each.moment] for each in scene.actuators.thrusters])
    weak = allocate(scene, [100.0, 0.0, 0.0], [0.0, 0.0, 0.0])
    assert weak.max() == pytest.approx(5.0, rel=1e-12)
    net = weak @ b
    np.testing.assert_allclose(net / net[0], [1.0, 0.0, 0.0, 0.0, 0.0, 0.0], rtol=0, atol=5e-15)
    with pytest.raises(ValueError, match="no thrusters"):
        allocate(load_scene("paper"), [1.0, 0.0, 0.0], [0.0, 0.0, 0.0])


def test_a_jet_is_off_below_zero_and_fires_no_pulse_shorter_than_its_shortest() -> None:
    jets = [{**JETS[0], "minimum_impulse": 0.05}, {**JETS[1], "minimum_on_time": 0.025}, *JETS[2:]]
    env = DQSpaceArmEnv(planar(**{"actuators.thrusters": jets}))
    layout = env.kernels.layout

    def change(action: list[float]) -> np.ndarray:
        env.reset(options={"nominal": True})
        env.step(np.array(action))
        return env.state[layout.state.base_velocity]

    np.testing.assert_array_equal(change([-1.0, -0.5, -0.1, -1.0]), 0.0)
    np.testing.assert_array_equal(change([0.249, 0.249, 0.0, 0.0]), 0.0)  # 0.0498 N s
    omega, x, _ = change([0.25, 0.0, 0.0, 0.0])
    assert x == pytest.approx(0.05 / 20, rel=1e-3)
    assert omega == pytest.approx(-0.2 * 0.05, rel=1e-3)
    assert change([0.0, 0.25, 0.0, 0.0])[1] == pytest.approx(-0.05 / 20, rel=1e-3)
    np.testing.assert_array_equal(layout.to_control([-1.0, 1.0, 0.5, -0.2]), [0.0, 2.0, 1.0, 0.0])
    np.testing.assert_array_equal(layout.lower_limits(layout.control_limit), np.zeros(4))


@pytest.mark.parametrize("dt", [0.01, 0.015, 0.1])
def test_jets_that_are_on_for_whole_steps_fire_in_single_precision(dt: float) -> None:
    forces = (5.0, 0.1, 0.3, 0.7, 1.1, 3.3, 7.7, 22.0)
    jets = [{**JETS[i % 4], "force": force, "minimum_on_time": dt} for i, force in enumerate(forces)]
    changes = {"actuators.thrusters": jets, "simulation.precision": "float32", "simulation.dt": dt}
    kernels = compile_scene(planar(parameters=["actuators"], **changes))
    limits = kernels.layout.control_limit.astype("f4")
    np.testing.assert_array_equal(kernels.applied_inputs(kernels.layout.initial_state, limits), limits)
    weaker = kernels.applied_inputs(kernels.layout.initial_state, 0.9999 * limits)
    np.testing.assert_array_equal(weaker, 0.0)


@pytest.mark.slow
def test_the_expert_only_pushes_and_the_environment_flies_its_plan() -> None:
    from experts import GuidedDDP

    env = DQSpaceArmEnv(planar())
    env.reset(options={"nominal": True})
    solution = GuidedDDP(env.scene).solve(env.state)
    assert solution.converged
    assert solution.controls.min() >= 0.0
    assert (solution.controls == 0.0).mean() > 0.2  # of jets that would push back
    total = 0.0
    for u in solution.controls:
        _, reward, _, _, info = env.step(env.kernels.layout.to_action(u))
        total += reward
    assert info["is_success"]
    assert -total == pytest.approx(solution.cost, rel=2e-15)


def test_no_jet_blows_at_the_sphere() -> None:
    sphere = {"frame": "inertial", "position": [-3.0, 0.2, 0.0], "radius": 0.5}
    plume = {"kind": "plume", "name": "plume", "angle_deg": 20.0, "keeps_clear": sphere}
    scene = planar(constraints=[plume])
    assert [row.name for row in path_rows(scene)] == [f"plume: thruster {i}" for i in range(1, 5)]
    kernels = compile_scene(scene)
    x = kernels.layout.initial_state
    found = kernels.constraints(x, np.array([2.0, 2.0, 2.0, 0.0]))
    # Only the first looks there, in the middle of its cone: f sin(20 deg + asin(R / d)).
    depth = 2.0 * np.sin(np.radians(20.0) + np.arcsin(0.5 / 2.5))
    assert found[0] == pytest.approx(depth, abs=1e-5)
    assert found[1] < -0.9
    assert found[2] < 0.0
    assert found[3] == 0.0


def test_bounds_of_what_may_happen_add_jets_that_cancel() -> None:
    equations = SceneEquations.of(planar())
    worst = WorstCase(equations)
    assert float(worst.force) == pytest.approx(8.0)
    assert float(worst.torque) == pytest.approx(4 * 2.0 * 0.2)


def test_fuel_is_impulse_by_specific_impulse() -> None:
    scene = planar(**{"actuators.thrusters.0.specific_impulse": 60.0})
    controls = np.tile([1.5, 1.0, 0.0, 0.0], (10, 1))
    assert fuel_used(scene, controls) == pytest.approx(10 * 0.1 * 1.5 / (60.0 * 9.80665))
    assert fuel_used(load_scene("paper"), np.zeros((3, 12))) == 0.0


def test_fuel_and_allocation_check_their_arrays() -> None:
    scene = planar()
    assert allocate(scene, np.zeros((0, 3)), [0.0, 0.0, 0.0]).shape == (0, 4)
    for force, torque in (
        (np.zeros((2, 3)), np.zeros((3, 3))),
        (1.0, np.zeros(3)),
        (np.zeros(2), np.zeros(4)),
    ):
        with pytest.raises(ValueError, match=r"force, torque: shapes .*, should be \(3,\) or \(B, 3\)"):
            allocate(scene, force, torque)
    for call in (lambda: allocate(scene, [1j, 0, 0], np.zeros(3)), lambda: fuel_used(scene, [[1j] * 4])):
        with pytest.raises(TypeError, match="should be real numbers"):
            call()
    for wrong in (np.zeros(4), np.zeros((2, 3)), np.zeros((1, 2, 4))):
        with pytest.raises(ValueError, match=r"controls: shape .*, should be \(N, 4\)"):
            fuel_used(scene, wrong)
    with pytest.raises(ValueError, match="controls: -1 N for a thruster, should be 0 or greater"):
        fuel_used(scene, [[0.0, -1.0, 0.0, 0.0]])


def test_names_limits_and_weights_are_those_of_the_jets() -> None:
    scene = planar(**{"actuators.thrusters.1": {**JETS[1], "name": "aft"}, "parameters": ["actuators"]})
    layout = StateLayout.of(scene)
    assert layout.control.names == (
        "thruster 1 force",
        "aft force",
        "thruster 3 force",
        "thruster 4 force",
    )
    assert set(layout.control.units) == {"N"}
    assert layout.parameters.names == tuple(f"actuators.thrusters.{i}.force" for i in range(4))
    np.testing.assert_array_equal(layout.limits_with(np.array([1.0, 2.0, 3.0, 4.0])), [1.0, 2.0, 3.0, 4.0])
    np.testing.assert_array_equal(layout.control_weight, 0.1)


@pytest.mark.parametrize(
    ("jet", "sentence"),
    [
        ({"direction": [0, 0, 0]}, "must not have zero length"),
        ({"direction": [1, 0, 1]}, "the z component must be 0"),
        ({"position": [1, 0, 1]}, "the z component must be 0"),
        ({"force": -1.0}, "must be a number greater than 0"),
        ({"minimum_impulse": 0.1, "minimum_on_time": 0.1}, "minimum_on_time says the same"),
        ({"force": np.inf, "minimum_on_time": 0.1}, "the largest force is not finite"),
        ({"minimum_on_time": 0.11}, "never fires: with the largest force a time step has an impulse of"),
        ({"minimum_impulse": 5.0}, "never fires"),
        ({"limit": 2.0}, r"thrusters\[0\].limit: unknown key; did you mean 'force'\?"),
    ],
)
def test_thrusters_that_do_not_fit_are_refused(jet: dict[str, Any], sentence: str) -> None:
    with pytest.raises(SceneError, match=sentence):
        planar(**{"actuators.thrusters": [JETS[0] | jet]})
    with pytest.raises(SceneError, match="another thruster has this name"):
        planar(**{"actuators.thrusters": [JETS[0] | {"name": "thruster 2"}, JETS[1]]})
    with pytest.raises(SceneError, match="must be a list of thrusters"):
        planar(**{"actuators.thrusters": []})
