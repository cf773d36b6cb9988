"""Scenes at the edges of the schema: nothing but a base, nothing but a wrist, no actuator, no motor."""

import numpy as np
import pytest
from test_kernels_derivatives import complex_step_jacobians
from test_kernels_dynamics import paper_solution, relative_error

from dq_space_arm_env import load_scene
from dq_space_arm_env.kernels.programs.scene_programs import ScenePrograms
from dq_space_arm_env.scene import INTEGRATORS, Actuators, InitialState, Spread, Target

PAPER = load_scene("paper")
LINKS = [link.model_dump() for link in PAPER.links]
HERE = Target(pose={"position": [0.5, 0.0, 0.0]})


def only(**actuators):
    return Actuators(**{name: {"limit": limit} for name, limit in actuators.items()})


BASE_ONLY = only(base_force=1.0, base_torque=1.0)


SKEW = [{"axis": axis, "inertia": 0.05, "torque": 1.0} for axis in ([1, 0, 0.5], [0, 1, -1])]
JETS = [{"position": [0.5, -0.2, 0.1 * i], "direction": [1, i, 2], "force": 1.0} for i in range(2)]


def scene(**changes):
    return PAPER.replace(**{"initial_state": InitialState(), "spread": Spread(), "target": HERE, **changes})


ODD = {
    "base": scene(links=[], wrist=None, actuators=BASE_ONLY),
    "wrist": scene(links=[], actuators=only(base_force=1.0, wrist_rate=0.5)),
    "one link": scene(links=LINKS[1:2], wrist=None, actuators=only(joint_torque=1.0)),
    "wheels and jets": scene(
        links=LINKS[1:2],
        wrist=None,
        actuators=Actuators(wheels=SKEW, thrusters=JETS, joint_torque={"limit": 1.0}),
    ),
    "no actuator": scene(actuators=Actuators()),
    "wrist without motor": scene(actuators=BASE_ONLY),
    "passive middle joint": scene(links=[LINKS[0], LINKS[1] | {"actuated": False}, LINKS[2]]),
    "five links": scene(links=[LINKS[i % 3] | {"name": f"link {i}"} for i in range(5)]),
}


@pytest.mark.parametrize("name", ODD)
def test_dynamics_agree_with_the_papers_system(name, draw):
    kernels, states, inputs = draw(ODD[name], 5)
    for x, u in zip(states, inputs, strict=True):
        accelerations, wrenches = paper_solution(kernels, x, u)
        assert relative_error(kernels.forward_dynamics(x, u), accelerations) < 1e-12
        assert kernels.reaction_wrenches(x, u).shape == wrenches.shape
        if wrenches.size:
            assert relative_error(kernels.reaction_wrenches(x, u), wrenches) < 1e-12


def odd_scenes_and_integrators():
    """All pairs; methods that share their code with others are fast for small scenes only."""
    for name in ("base", "wrist", "one link", "wheels and jets", "no actuator", "wrist without motor"):
        for integrator in INTEGRATORS:
            is_slow = INTEGRATORS[integrator].curvature != integrator and name != "one link"
            is_slow |= integrator in ("rodas5p", "rk8")
            yield pytest.param(name, integrator, marks=[pytest.mark.endurance] if is_slow else [])


@pytest.mark.parametrize(("name", "integrator"), list(odd_scenes_and_integrators()))
@pytest.mark.slow
def test_linearization_agrees_with_complex_steps(name, integrator, draw):
    kernels, states, inputs = draw(ODD[name], 2)
    a, b = kernels.linearize(states, inputs, integrator=integrator)
    program = ScenePrograms(kernels.scene).build("step", integrator)
    for k in range(2):
        expected_a, expected_b = complex_step_jacobians(kernels, program, states[k], inputs[k])
        np.testing.assert_allclose(a[k], expected_a, rtol=0, atol=2e-13 * max(1.0, np.abs(expected_a).max()))
        np.testing.assert_allclose(b[k], expected_b.reshape(b[k].shape), rtol=0, atol=2e-13)


@pytest.mark.parametrize("name", ODD)
def test_everything_else_can_be_asked_for(name, draw):
    kernels, states, inputs = draw(ODD[name], 3)
    assert np.isfinite(kernels.momentum(states)).all()
    assert (kernels.energy(states) > 0.0).all()
    assert (kernels.cost(states, inputs) > 0.0).all()
    np.testing.assert_allclose(
        kernels.retract(states, np.zeros((3, kernels.n_t))), states, rtol=0, atol=1e-14
    )


@pytest.mark.slow
@pytest.mark.parametrize("name", ["base", "wrist"])
def test_the_expert_solves_scenes_without_joints(name):
    from experts import BoxDDP

    assert BoxDDP(ODD[name]).solve().converged
