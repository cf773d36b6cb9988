"""The robot's matrices: mass matrix, bias forces, Jacobians; against Pinocchio and against each other."""

import numpy as np
import pytest
from test_kernels_odd_scenes import ODD

from dq_space_arm_env import load_scene, pinocchio_model, to_pinocchio
from dq_space_arm_env.algebra import dual_quaternion as dq

SCENES = ("paper", "planar", "six-joint", "payload")


def relative_error(actual, expected):
    return np.linalg.norm(np.asarray(actual) - expected) / np.linalg.norm(expected)


def sprung(name):
    """A scene with springs and dampers in its joints."""
    scene = load_scene(name)
    parts = {"stiffness": 3.0, "rest_angle": 0.4, "damping": 0.7}
    return scene.replace(links=[{**link.model_dump(), **parts} for link in scene.links])


def ours_from_pinocchio(planar, joints):
    """Pinocchio's velocities (linear, angular, joints) in our order (angular, linear, joints)."""
    base = [2, 0, 1] if planar else [3, 4, 5, 0, 1, 2]
    return [*base, *range(len(base), len(base) + joints)]


def forces(kernels, u):
    """Generalized forces of inputs (B, n_u): torque and force on the base, joint torques."""
    control, layout = kernels.layout.control, kernels.layout
    n_base = 3 if layout.planar else 6
    n_turning = 1 if layout.planar else 3
    result = np.zeros((len(u), n_base + layout.n_joints))
    if u[:, control.base_torque].size:
        result[:, :n_turning] = u[:, control.base_torque]
    if u[:, control.base_force].size:
        result[:, n_turning:n_base] = u[:, control.base_force]
    result[:, [n_base + joint for joint in layout.actuated_joints]] = u[:, control.joint_torque]
    return result


@pytest.mark.parametrize("name", SCENES)
def test_they_are_pinocchios(name, draw):
    pin = pytest.importorskip("pinocchio")
    scene = load_scene(name)
    kernels, states, _ = draw(name, 4)
    # Pinocchio's tip holds the wrist at its initial angles.
    states[:, kernels.layout.state.wrist_angles] = scene.initial_state.wrist_angles
    model = pinocchio_model(scene)
    data, order = model.createData(), ours_from_pinocchio(kernels.layout.planar, kernels.layout.n_joints)
    tip, twice = model.getFrameId("tip"), [3, 4, 5, 0, 1, 2]
    for x in states:
        q, v = to_pinocchio(scene, x)
        upper = np.triu(pin.crba(model, data, q))
        mass = (upper + np.triu(upper, 1).T)[np.ix_(order, order)]
        assert relative_error(kernels.mass_matrix(x), mass) < 1e-12
        bias = pin.nonLinearEffects(model, data, q, v)[order]
        assert relative_error(kernels.bias_forces(x), bias) < 1e-12
        jacobian = pin.computeFrameJacobian(model, data, q, tip, pin.ReferenceFrame.LOCAL)
        found = kernels.tip_jacobian(x)[:, : len(order)]
        assert relative_error(found, jacobian[twice][:, order]) < 1e-12
        assert relative_error(kernels.tip_twist(x), (jacobian @ v)[twice]) < 1e-12


MOVING = {
    **{name: load_scene(name) for name in SCENES},
    "sprung": sprung("tip-load"),
    **{name: ODD[name] for name in ("base", "no actuator", "wrist without motor")},
}


@pytest.mark.parametrize("name", MOVING)
def test_they_are_the_equations_of_motion(name, draw):
    kernels, states, inputs = draw(MOVING[name], 5)
    accelerations = kernels.forward_dynamics(states, inputs, np.zeros(6))
    mass, bias = kernels.mass_matrix(states), kernels.bias_forces(states)
    np.testing.assert_array_equal(mass, mass.transpose(0, 2, 1))
    solved = np.linalg.solve(mass, (forces(kernels, inputs) - bias)[..., None])[..., 0]
    assert relative_error(accelerations, solved) < 1e-11
    # A wrench at the tip acts through the Jacobian: power is force times velocity.
    wrench = np.random.default_rng(3).normal(size=6)
    loaded = kernels.forward_dynamics(states, inputs, wrench) - accelerations
    columns = kernels.tip_jacobian(states)[:, :, : mass.shape[-1]]
    load = columns.transpose(0, 2, 1) @ np.array([*wrench[3:], *wrench[:3]])
    assert relative_error((mass @ loaded[..., None])[..., 0], load) < 1e-11


@pytest.mark.parametrize("name", SCENES)
def test_the_mass_matrix_gives_the_kinetic_energy(name, draw):
    kernels, states, _ = draw(name, 5)
    entries = kernels.layout.state
    velocities = np.concatenate([states[:, entries.base_velocity], states[:, entries.joint_rates]], axis=1)
    energy = 0.5 * np.einsum("bi,bij,bj->b", velocities, kernels.mass_matrix(states), velocities)
    np.testing.assert_allclose(kernels.energy(states), energy, rtol=1e-12)


@pytest.mark.parametrize("name", SCENES)
def test_the_twist_is_the_rate_of_the_tip_pose(name, draw):
    """q_{G/I}' = 1/2 q_{G/I} xi, for motion along base velocity, joint rates and Euler rates of the wrist."""
    kernels, states, inputs = draw(name, 4)
    tangent, entries, step = kernels.layout.tangent, kernels.layout.state, 1e-6
    dx = np.zeros((len(states), kernels.n_t))
    dx[:, : tangent.translation.stop] = states[:, entries.base_velocity]
    dx[:, tangent.joint_angles] = states[:, entries.joint_rates]
    dx[:, tangent.wrist_angles] = inputs[:, kernels.layout.control.wrist_rate]
    ahead, behind = (kernels.tip_pose(kernels.retract(states, sign * step * dx)) for sign in (1.0, -1.0))
    rate = (ahead - behind) / (2.0 * step)
    twist = kernels.tip_twist(states, inputs)
    expected = [
        0.5 * np.array(dq.multiply(pose, (0.0, *xi[:3], 0.0, *xi[3:])))
        for pose, xi in zip(kernels.tip_pose(states), twist, strict=True)
    ]
    assert relative_error(rate, expected) < 1e-8
    rates = [states[:, entries.base_velocity], states[:, entries.joint_rates]]
    rates = np.concatenate([*rates, inputs[:, kernels.layout.control.wrist_rate]], axis=1)
    by_columns = (kernels.tip_jacobian(states) @ rates[..., None])[..., 0]
    assert relative_error(twist, by_columns) < 1e-14


@pytest.mark.parametrize("name", SCENES)
def test_the_generalized_jacobian_holds_at_zero_momentum(name, draw):
    kernels, states, inputs = draw(name, 5)
    entries, planar = kernels.layout.state, kernels.layout.planar
    base = range(kernels.n_x)[entries.base_velocity]
    free = [0, 1, 5] if planar else range(6)  # entries of the momentum that the base can change
    # Momentum is linear in the velocities: the base's follow from unit vectors.
    for x in states:
        still = x.copy()
        still[base] = 0.0
        units = np.tile(still, (len(base), 1))
        units[range(len(base)), base] = 1.0
        rest = kernels.momentum(still)
        columns = (kernels.momentum(units) - rest)[:, free].T
        x[base] = np.linalg.solve(columns, -rest[free])
    assert np.abs(kernels.momentum(states)).max() < 1e-12
    rates = [states[:, entries.joint_rates], inputs[:, kernels.layout.control.wrist_rate]]
    expected = (kernels.generalized_jacobian(states) @ np.concatenate(rates, axis=1)[..., None])[..., 0]
    assert relative_error(kernels.tip_twist(states, inputs), expected) < 1e-12


@pytest.mark.parametrize("name", SCENES)
def test_the_observation_changes_as_its_jacobian_says(name, draw):
    kernels, states, _ = draw(name, 3)
    left, step = np.array([3.0]), 1e-6
    jacobian = kernels.observation_jacobian(states)
    for x, found in zip(states, jacobian, strict=True):
        dx = step * np.eye(kernels.n_t)
        ahead, behind = (kernels.observation(kernels.retract(x, sign * dx), left)[0] for sign in (1.0, -1.0))
        assert relative_error(found, (ahead - behind).T / (2.0 * step)) < 1e-8
    assert not jacobian[:, -1].any()  # the time left


@pytest.mark.parametrize("name", SCENES)
def test_batches_have_the_bits_of_single_states(name, draw):
    kernels, states, inputs = draw(name, 9)
    n, wrist = kernels.layout.n_joints, 3 if kernels.layout.has_wrist else 0
    size = n + (3 if kernels.layout.planar else 6)
    shapes = {
        "mass_matrix": (size, size),
        "bias_forces": (size,),
        "tip_jacobian": (6, size + wrist),
        "generalized_jacobian": (6, n + wrist),
        "tip_twist": (6,),
        "observation_jacobian": (kernels.n_x + 1, kernels.n_t),
    }
    for function, shape in shapes.items():
        compute = getattr(kernels, function)
        batch = compute(states)
        assert batch.shape == (len(states), *shape)
        np.testing.assert_array_equal(batch, [compute(x) for x in states], err_msg=function)
        with pytest.raises(ValueError, match=f"{function}: x has 5 entries per row"):
            compute(states[:, :5])
    twists = kernels.tip_twist(states, inputs)
    rows = [kernels.tip_twist(x, u) for x, u in zip(states, inputs, strict=True)]
    np.testing.assert_array_equal(twists, rows)
    with pytest.raises(ValueError, match=f"tip_twist: u has {kernels.n_u + 1} entries per row"):
        kernels.tip_twist(states, np.zeros(kernels.n_u + 1))


def test_a_base_without_joints_has_them_too(draw):
    kernels, states, _ = draw(ODD["base"], 2)
    mass = kernels.mass_matrix(states[0])
    np.testing.assert_array_equal(mass[3:, 3:], kernels.scene.base.mass * np.eye(3))
    assert not mass[:3, 3:].any()
    assert kernels.generalized_jacobian(states[0]).shape == (6, 0)
    assert kernels.tip_jacobian(states).shape == (2, 6, 6)


def test_masses_that_vary_are_those_given(draw):
    scene = load_scene("payload").replace(spread={"base_mass": 0.2, "link_masses": 0.3, "payload_mass": 0.4})
    kernels, states, inputs = draw(scene, 3)
    p = kernels.parameters.nominal * np.random.default_rng(0).uniform(0.8, 1.2, (3, kernels.n_p))
    mass, bias = kernels.mass_matrix(states, p), kernels.bias_forces(states, p)
    assert not np.array_equal(mass, kernels.mass_matrix(states))
    solved = np.linalg.solve(mass, (forces(kernels, inputs) - bias)[..., None])[..., 0]
    assert relative_error(kernels.forward_dynamics(states, inputs, np.zeros(6), p), solved) < 1e-11
