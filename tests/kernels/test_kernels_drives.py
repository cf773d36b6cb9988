"""Motors in machine code: rotors, friction and elastic gears, by every integrator, with exact derivatives."""

import numpy as np
import pytest
from test_kernels_derivatives import complex_step_jacobians
from test_kernels_second_order import check_lagrangian

from dq_space_arm_env import SceneError, compile_scene, load_scene
from dq_space_arm_env.interoperability.pinocchio_twin import (
    generalized_forces,
    pinocchio_model,
    to_pinocchio,
)
from dq_space_arm_env.kernels.programs.scene_programs import ScenePrograms
from dq_space_arm_env.scene import INTEGRATORS

PLANAR = load_scene("planar")
GEARED = {"inertia": 2e-4, "gear": -40.0, "friction": 0.3, "friction_speed": 0.4}
ELASTIC = {
    "inertia": 1e-4,
    "gear": 30.0,
    "coupling": "armature",
    "friction": 0.2,
    "friction_speed": 0.3,
    "stiffness": 40.0,
    "damping": 0.3,
}
DRIVEN = PLANAR.replace({"name": "driven", "links.0.motor": GEARED, "links.1.motor": ELASTIC})


def with_stiffness(stiffness, **others):
    motor = {"inertia": 1e-5, "gear": 100.0, "coupling": "armature", "stiffness": stiffness, **others}
    return PLANAR.replace({f"links.{i}.motor": motor for i in range(len(PLANAR.links))})


@pytest.mark.sampled
@pytest.mark.parametrize(
    "integrator",
    [
        "rk4",
        "gauss6",
        *(
            pytest.param(
                name, marks=pytest.mark.endurance if name in ("rodas5p", "rk8") else pytest.mark.slow
            )
            for name in INTEGRATORS
            if name not in ("rk4", "gauss6")
        ),
    ],
)
def test_derivatives_of_a_step_with_motors_agree_with_complex_steps(integrator, draw):
    kernels, (x,), (u,) = draw(DRIVEN, 1)
    program = ScenePrograms(DRIVEN).build("step", integrator)
    for found, expected in zip(
        kernels.linearize(x, u, integrator=integrator),
        complex_step_jacobians(kernels, program, x, u),
        strict=True,
    ):
        np.testing.assert_allclose(found, expected, rtol=0, atol=1e-9 * np.abs(expected).max())


@pytest.mark.slow
def test_second_derivatives_with_motors_and_a_wheel_agree_with_differences(draw):
    wheel = {"axis": [0, 0, 1], "inertia": 0.01, "torque": 1.0}
    kernels, states, inputs = draw(DRIVEN.replace({"actuators.wheels": [wheel]}), 1)
    check_lagrangian(kernels, "rk4", states[0], inputs[0], 0)


def test_an_elastic_gear_drives_the_link_and_holds_the_rotor_back(draw):
    """Spong's equations: Pinocchio's arm under the gear's torque, and the rotor's own equation."""
    pin = pytest.importorskip("pinocchio")
    kernels, (x,), (u,) = draw(DRIVEN.replace({"links.0.motor.coupling": "armature"}), 1)
    state, motor = kernels.layout.state, kernels.scene.links[1].motor
    angle, rate = x[state.joint_angles][1], x[state.joint_rates][1]
    (motor_angle,), (motor_rate,) = x[state.motor_angles], x[state.motor_rates]
    gear = motor.stiffness * (motor_angle - angle) + motor.damping * (motor_rate - rate)
    rigid = kernels.scene.replace({"links.1.motor": None})
    plain, v = np.delete(x, [state.motor_angles.start, state.motor_rates.start]), u.copy()
    v[kernels.layout.control.joint_torque.start + 1] = gear
    model = pinocchio_model(rigid)
    q, qd = to_pinocchio(rigid, plain)
    a = pin.aba(model, model.createData(), q, qd, generalized_forces(rigid, plain, v))
    found, expected = kernels.forward_dynamics(x, u), np.array([a[2], *a[:2], *a[3:]])
    np.testing.assert_allclose(found, expected, rtol=0, atol=1e-12 * np.abs(expected).max())
    h, friction = 1e-6, motor.friction * np.tanh(motor_rate / motor.friction_speed)
    ahead, behind = (kernels.step(x, u, dt=dt)[state.motor_rates.start] for dt in (h, -h))
    torque = u[kernels.layout.control.joint_torque][1] - gear - friction
    assert (ahead - behind) / (2 * h) == pytest.approx(torque / motor.reflected_inertia, rel=1e-7)
    with pytest.raises(SceneError, match="no elastic gears"):
        pinocchio_model(kernels.scene)


def test_stiff_gears_tend_to_rigid_ones_like_one_over_their_stiffness():
    """With the rotors an armature of the joints."""
    rigid = compile_scene(with_stiffness(None))
    x, u = rigid.layout.initial_state, np.array([0.0, 0.0, 0.0, 2.0, -1.0, 0.5])[: rigid.n_u]
    times = {"dt": 1e-3, "steps": 400, "integrator": "rk8"}
    expected = rigid.simulate(x, u, **times)
    errors = []
    for stiffness in (500.0, 2000.0, 8000.0):
        damping = 2.0 * np.sqrt(0.1 * stiffness)
        kernels = compile_scene(with_stiffness(stiffness, damping=damping))
        found = kernels.simulate(kernels.layout.initial_state, u, **times)
        angles = kernels.layout.state.joint_angles
        errors.append(np.abs(found[:, angles] - expected[:, angles]).max())
    assert errors[0] < 0.02
    np.testing.assert_allclose(np.array(errors[:-1]) / errors[1:], 4.0, rtol=0.15)


@pytest.mark.parametrize("integrator", ["gauss6", "momentum_rk4"])
def test_motors_leave_the_momentum_as_it_is(integrator, draw):
    kernels, (x,), (u,) = draw(DRIVEN, 1)
    u[: kernels.layout.control.joint_torque.start] = 0.0
    states = kernels.simulate(x, u, steps=200, dt=0.005, integrator=integrator)
    momentum = kernels.momentum(states)
    assert np.abs(momentum - momentum[0]).max() < 2e-13 * np.abs(momentum).max()


def test_energy_is_conserved_by_rotors_and_gears_that_do_not_rub(draw):
    still = {"links.0.motor.friction": 0.0, "links.1.motor.friction": 0.0, "links.1.motor.damping": 0.0}
    kernels, (x,), _ = draw(DRIVEN.replace(still), 1)
    states = kernels.simulate(x, np.zeros(kernels.n_u), steps=400, dt=0.005, integrator="gauss6")
    energy = kernels.energy(states)
    assert np.abs(energy / energy[0] - 1.0).max() < 1e-8


def test_the_numbers_of_motors_may_be_parameters(draw):
    paths = ("links.0.motor", "links.1.motor")
    kernels, (x,), (u,) = draw(DRIVEN.replace(parameters=paths), 1)
    names = [name.partition("motor.")[2] for name in kernels.parameters.names]
    assert names == ["inertia", "friction", "inertia", "friction", "stiffness", "damping"]
    p = kernels.parameters.nominal * 1.1
    changes = dict(zip(kernels.parameters.names, p.tolist(), strict=True))
    other = compile_scene(DRIVEN.replace(changes))
    np.testing.assert_allclose(kernels.step(x, u, p=p), other.step(x, u), rtol=0, atol=1e-13)


@pytest.mark.parametrize(
    ("motor", "sentence"),
    [
        ({"gear": 10}, "needs an inertia, friction or stall_torque"),
        ({"inertia": 1e-4, "gear": 0}, "other than 0"),
        ({"inertia": 1e-4, "stiffness": 10.0}, "set it to armature"),
        ({"friction": 1.0, "stiffness": 10.0, "coupling": "armature"}, "needs an inertia: give it"),
        ({"inertia": 1e-4, "damping": 1.0}, "a rigid gear has none"),
    ],
)
def test_impossible_motors_are_refused(motor, sentence):
    with pytest.raises(SceneError, match=sentence):
        PLANAR.replace({"links.0.motor": motor})
