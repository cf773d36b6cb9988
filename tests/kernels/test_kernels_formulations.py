"""Every kernel by one formulation of the dynamics and by the other."""

import numpy as np
import pytest
from test_kernels_odd_scenes import ODD

from dq_space_arm_env import compile_scene, load_scene
from dq_space_arm_env.environment import DQSpaceArmEnv
from dq_space_arm_env.kernels.programs.scene_programs import ScenePrograms
from scripts.benchmarks.robots import robots

BOTH = ("articulated_body", "minimal_coordinates")
DEFAULT = None  # the articulated body, unless the integrator keeps the momentum
DIFFERENTIATED = ("paper", "planar")
SCENES = {name: load_scene(name) for name in robots()} | ODD


def by(scene, formulation):
    return scene.replace(simulation={"formulation": formulation})


def assert_close(found, expected, bound=1e-12):
    assert np.linalg.norm(found - expected) <= bound * np.linalg.norm(expected)


def both(draw, scene, count):
    """Kernels of the default and of the mass matrix, states and inputs."""
    kernels, states, inputs = draw(scene, count)
    return [kernels, compile_scene(by(scene, "minimal_coordinates"))], states, inputs


@pytest.mark.sampled
@pytest.mark.parametrize("name", SCENES)
def test_accelerations_and_reactions_agree_to_1e_12(name, draw):
    kernels, states, inputs = both(draw, SCENES[name], 10)
    for function in ("forward_dynamics", "reaction_wrenches"):
        found, expected = (getattr(each, function)(states, inputs) for each in kernels)
        for row, right in zip(found, expected, strict=True):
            assert_close(row, right)


@pytest.mark.sampled
@pytest.mark.parametrize(
    "name", [s if s in DIFFERENTIATED else pytest.param(s, marks=pytest.mark.endurance) for s in robots()]
)
def test_derivatives_of_a_step_agree_to_1e_12(name, draw):
    kernels, states, inputs = both(draw, load_scene(name), 3)
    found, expected = (each.linearize(states, inputs) for each in kernels)
    for ours, right in zip(found, expected, strict=True):
        assert_close(ours, right)


@pytest.mark.slow
def test_second_derivatives_agree(draw):
    kernels, states, inputs = both(draw, load_scene("planar"), 1)
    multiplier, h = np.ones(kernels[0].n_t), np.array([0.1])
    arguments = {"x": states[0], "u": inputs[0], "multiplier": multiplier, "h": h}
    found, expected = (each.call("lagrangian_hessian", "rk4", **arguments) for each in kernels)
    for ours, right in zip(found, expected, strict=True):
        assert_close(ours, right, 1e-11)


@pytest.mark.sampled
@pytest.mark.parametrize(
    ("integrator", "other"),
    [
        ("dormand_prince", "minimal_coordinates"),
        ("momentum_rk4", "articulated_body"),
        pytest.param("rodas4", "articulated_body", marks=pytest.mark.slow),
    ],
)
def test_steps_of_other_methods_agree_to_1e_12(integrator, other, draw):
    """The default is compared with the formulation that it is not."""
    scene = load_scene("paper")
    kernels, states, inputs = draw(scene, 3)
    found = kernels.step(states, inputs, integrator=integrator)
    expected = compile_scene(by(scene, other)).step(states, inputs, integrator=integrator)
    assert_close(found, expected)


@pytest.mark.slow
def test_environments_that_draw_masses_agree():
    scenes = [by(load_scene("random-masses"), each) for each in (DEFAULT, "minimal_coordinates")]
    environments = [DQSpaceArmEnv(scene) for scene in scenes]
    observations = [env.reset(seed=5)[0] for env in environments]
    for _ in range(3):
        np.testing.assert_allclose(*observations, rtol=1e-11, atol=1e-11)
        action = 0.5 * np.ones(environments[0].action_space.shape)
        observations = [env.step(action)[0] for env in environments]


def operations(scene, program, integrator="", **changes):
    scene = scene.replace(simulation=changes)
    return ScenePrograms(scene).build(program, integrator).operation_count


@pytest.mark.sampled
@pytest.mark.parametrize("name", ["paper", "planar", "six-joint"])
def test_without_a_choice_it_is_the_one_with_fewer_operations(name):
    scene = load_scene(name)
    for program, integrator in (("forward_dynamics", ""), ("step", "rk4"), ("step", "momentum_rk4")):
        counts = [operations(scene, program, integrator, formulation=each) for each in BOTH]
        assert operations(scene, program, integrator) == min(counts)
        assert counts[0] != counts[1]
