"""Kernels whose scene names parameters, against kernels of the scene in which these are constants."""

import numpy as np
import pytest

from dq_space_arm_env import Scene, compile_scene, load_scene
from dq_space_arm_env.scene import SceneError, StateLayout
from dq_space_arm_env.scene.start import episode_scene

EVERYTHING = ("target.pose", "base", "links", "cost", "actuators")


def varied(scene, seed=0):
    """Parameters up to a tenth more than nominal; the target, whose numbers depend on each other, stays."""
    parameters = StateLayout.of(scene).parameters
    factors = 1.0 + np.random.default_rng(seed).uniform(0.0, 0.1, len(parameters.names))
    # Inertias are scaled as a whole, or no body has them.
    first = {
        name.partition(".inertia")[0]: factor for name, factor in zip(parameters.names, factors, strict=True)
    }
    for index, name in enumerate(parameters.names):
        factors[index] = first[name.partition(".inertia")[0]] if ".inertia" in name else factors[index]
    factors[parameters.indices("target.pose")] = 1.0
    return parameters.nominal * factors


@pytest.fixture(scope="module")
def scene():
    links = [link.model_dump() | {"stiffness": 3.0, "damping": 0.4} for link in load_scene("planar").links]
    return load_scene("planar").replace(links=links, parameters=EVERYTHING)


@pytest.fixture(scope="module")
def twins(scene):
    """Kernels with parameters, their values, and kernels in which these are constants."""
    p = varied(scene)
    return compile_scene(scene), p, compile_scene(episode_scene(scene, p))


def moving(kernels, count, seed=1):
    rng = np.random.default_rng(seed)
    x = kernels.retract(kernels.layout.initial_state, rng.uniform(-0.5, 0.5, (count, kernels.n_t)))
    return x, rng.uniform(-1.0, 1.0, (count, kernels.n_u))


FUNCTIONS = {
    "step": lambda k, x, u, **p: k.step(x, u, **p),
    "symplectic": lambda k, x, u, **p: k.step(x, u, integrator="symplectic_euler", **p),
    "stiff": lambda k, x, u, **p: k.step(x, u, integrator="rodas4", **p),
    "linearize": lambda k, x, u, **p: np.concatenate(k.linearize(x, u, **p), axis=-1),
    "forward_dynamics": lambda k, x, u, **p: k.forward_dynamics(x, u, **p),
    "loaded_dynamics": lambda k, x, u, **p: k.forward_dynamics(x, u, np.ones(6) * (np.arange(6) != 2), **p),
    "reaction_wrenches": lambda k, x, u, **p: k.reaction_wrenches(x, u, **p),
    "tip_pose": lambda k, x, u, **p: k.tip_pose(x, **p),
    "momentum": lambda k, x, u, **p: k.momentum(x, **p),
    "energy": lambda k, x, u, **p: k.energy(x, **p),
    "cost": lambda k, x, u, **p: k.cost(x, u, **p),
    "terminal_cost": lambda k, x, u, **p: k.terminal_cost(x, **p),
    "observation": lambda k, x, u, **p: np.concatenate(k.observation(x, np.ones((len(x), 1)), **p), axis=1),
    "mass_matrix": lambda k, x, u, **p: k.mass_matrix(x, **p),
    "simulate": lambda k, x, u, **p: k.simulate(x[0], u, len(u), **p),
    "integrate": lambda k, x, u, **p: k.integrate(x[0], u, 0.5, **p).x[-1],
}


@pytest.mark.sampled
@pytest.mark.parametrize("name", FUNCTIONS)
def test_parameters_are_the_numbers_of_the_scene(twins, name):
    kernels, p, constant = twins
    x, u = moving(kernels, 5)
    found, expected = FUNCTIONS[name](kernels, x, u, p=p), FUNCTIONS[name](constant, x, u)
    np.testing.assert_allclose(found, expected, rtol=1e-11, atol=1e-11 * np.abs(expected).max())
    np.testing.assert_array_equal(
        FUNCTIONS[name](kernels, x, u), FUNCTIONS[name](kernels, x, u, p=kernels.parameters.nominal)
    )


def test_rows_have_parameters_of_their_own(twins):
    kernels, p, _ = twins
    x, u = moving(kernels, 4)
    rows = np.array([p, kernels.parameters.nominal, p, varied(kernels.scene, 2)])
    each = [kernels.step(*row[:2], p=row[2]) for row in zip(x, u, rows, strict=True)]
    np.testing.assert_array_equal(kernels.step(x, u, p=rows), each)
    flown = kernels.simulate(x[0], u, 4, p=rows)
    state = x[0]
    for k in range(4):
        state = kernels.step(state, u[k], p=rows[k])
        np.testing.assert_array_equal(flown[k + 1], state)
    parts = kernels.integrate(x[0], u, 0.4, p=rows).x[-1]
    state = x[0]
    for k in range(4):
        state = kernels.integrate(state, u[k], 0.1, p=rows[k]).x[-1]
    np.testing.assert_allclose(parts, state, rtol=0, atol=1e-7)


def test_parameters_have_names_units_and_nominal_values(scene):
    found = StateLayout.of(scene).parameters
    known = dict(zip(found.names, zip(found.units, found.nominal, strict=True), strict=True))
    assert known["base.mass"] == ("kg", scene.base.mass)
    assert known["links.1.stiffness"] == ("N m/rad", 3.0)
    assert known["target.pose.q_d1"][0] == "m"
    assert known["actuators.joint_torque.limit"] == ("N m", scene.actuators.joint_torque.limit)
    assert known["cost.base_torque.z"] == ("(N m)^-2", scene.cost.base_torque[2])
    # A planar robot has one moment of inertia per body, and a center of mass in the plane.
    assert [name for name in found.names if name.startswith("links.0.")] == [
        "links.0.mass",
        "links.0.center_of_mass.x",
        "links.0.center_of_mass.y",
        "links.0.inertia.zz",
        "links.0.stiffness",
        "links.0.damping",
    ]
    assert found.indices("links.0.center_of_mass") == [
        found.names.index(f"links.0.center_of_mass.{a}") for a in "xy"
    ]


def test_a_scene_that_names_none_is_what_it_was(scene):
    plain = scene.replace(parameters=())
    assert "parameters" not in plain.to_yaml()
    assert StateLayout.of(plain).n_p == 0
    again = Scene.model_validate(scene.model_dump())
    assert again == scene
    assert again.content_hash() == scene.content_hash() != plain.content_hash()


@pytest.mark.parametrize(
    ("paths", "message"),
    [
        (["links.0.lenght"], r"parameters\[0\] = 'links.0.lenght'.*leads to no number that may vary"),
        (["base.mass", "links.9.mass"], r"parameters\[1\] = 'links.9.mass'.*did you mean"),
        (["payload.mass"], r"leads to no number that may vary"),  # it has none
        ("base.mass", "parameters"),
        ([3], r"parameters\[0\]"),
    ],
)
def test_a_path_that_leads_nowhere_is_refused(scene, paths, message):
    with pytest.raises(SceneError, match=message):
        scene.replace(parameters=paths)


@pytest.mark.parametrize("p", [np.ones(3), np.ones((2, 2)), np.ones((7, 3)), 1.0, "no", [None]])
def test_parameters_of_another_shape_are_refused(twins, p):
    kernels, _, _ = twins
    x, u = moving(kernels, 5)
    for call in (lambda: kernels.step(x, u, p=p), lambda: kernels.step(x[0], u[0], p=p)):
        with pytest.raises((ValueError, TypeError), match=r"^p: |'p': "):
            call()
    with pytest.raises((ValueError, TypeError), match=r"^p: |'p': "):
        kernels.simulate(x[0], u, 5, p=p)


def test_the_shape_that_is_refused_is_the_given_one():
    kernels = compile_scene("planar")
    x, u = kernels.layout.initial_state, np.zeros(kernels.n_u)
    with pytest.raises(ValueError, match=r"p: shape \(1,\), should be \(0,\) or \(B, 0\); the parameters"):
        kernels.step(x, u, p=[1.0])
    with pytest.raises(ValueError, match=r"p: shape \(20, 1\), should be \(0,\) or \(B, 0\)"):
        kernels.step(x, u, p=np.ones((20, 1)))


def test_a_scene_of_constants_takes_none():
    kernels = compile_scene("planar")
    x, u = moving(kernels, 1)
    with pytest.raises(ValueError, match=r"p: .*the parameters of scene 'planar' are none"):
        kernels.step(x[0], u[0], p=[1.0])
    expected = kernels.step(x[0], u[0], p=np.empty(0))
    for wrong in ([1.0], np.ones(3), "wrong"):
        with pytest.raises((ValueError, TypeError), match=r"^p: "):
            kernels.step(x[0], u[0], p=wrong)
    np.testing.assert_array_equal(kernels.step(x[0], u[0], p=np.empty(0)), expected)
    with pytest.raises(ValueError, match="no parameters to differentiate by"):
        kernels.linearize_parameters(x[0], u[0])


def test_derivatives_by_parameters_come_in_batches(twins):
    kernels, p, _ = twins
    x, u = moving(kernels, 3)
    by_parameters = kernels.linearize_parameters(x, u, p=p)
    assert by_parameters.shape == (3, kernels.n_t, kernels.n_p)
    np.testing.assert_array_equal(kernels.linearize_parameters(x[1], u[1], p=p), by_parameters[1])
    size = 1e-6 * np.maximum(np.abs(p), 1.0)
    ahead = [kernels.step(x[0], u[0], p=p + d) for d in np.diag(size)]
    behind = [kernels.step(x[0], u[0], p=p - d) for d in np.diag(size)]
    slopes = np.array(kernels.difference(np.array(behind), np.array(ahead))).T / (2.0 * size)
    np.testing.assert_allclose(by_parameters[0], slopes, rtol=0, atol=1e-8 * np.abs(slopes).max())
    gradients = kernels.cost_by_parameters(x, u, p=p), kernels.terminal_cost_by_parameters(x, p=p)
    assert gradients[0].shape == gradients[1].shape == (3, kernels.n_p)
    # The cost is linear in its weights.
    weights = [i for i, name in enumerate(kernels.parameters.names) if name.startswith("cost.")]
    parts = gradients[0][0, weights] @ p[weights], gradients[1][0, weights] @ p[weights]
    np.testing.assert_allclose(parts, [kernels.cost(x[0], u[0], p=p), kernels.terminal_cost(x[0], p=p)])
