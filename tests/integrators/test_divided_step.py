"""Steps divided by the estimate of an embedded method: as accurate as asked, whole where that suffices."""

import numpy as np
import pytest

from dq_space_arm_env import SceneError, compile_scene, load_scene
from dq_space_arm_env.algebra import poses
from dq_space_arm_env.scene import INTEGRATORS

EMBEDDED = [name for name, entry in INTEGRATORS.items() if entry.is_embedded]


@pytest.fixture(scope="module")
def scene():
    return load_scene("planar").replace(simulation={"tolerance": 1e-6})


def states(kernels, rates, count=16):
    """Random states with joints that turn at some rates, and random inputs."""
    rng, layout = np.random.default_rng(0), kernels.layout
    x = np.tile(layout.initial_state, (count, 1))
    x[:, layout.state.joint_angles] = rng.uniform(-2.0, 2.0, x[:, layout.state.joint_angles].shape)
    x[:, layout.state.joint_rates] = rates * rng.uniform(-1.0, 1.0, x[:, layout.state.joint_rates].shape)
    return x, layout.control_limit * rng.uniform(-1.0, 1.0, (count, kernels.n_u))


@pytest.mark.parametrize("name", EMBEDDED)
def test_an_accurate_step_is_the_whole_step_to_the_bit(scene, name):
    kernels = compile_scene(scene)
    x, u = states(kernels, 0.5)
    end, error = kernels.checked_step(x, u, integrator=name)
    assert (error <= 1.0).all()
    np.testing.assert_array_equal(end, kernels.step(x, u, integrator=name))


@pytest.mark.sampled
@pytest.mark.parametrize("name", EMBEDDED)
@pytest.mark.parametrize("tolerance", [1e-5, 1e-8])
def test_a_fast_step_is_as_accurate_as_asked(scene, name, tolerance):
    kernels = compile_scene(scene.replace(simulation={"integrator": name, "tolerance": tolerance}))
    x, u = states(kernels, 60.0)
    whole, dt = kernels.step(x, u), scene.simulation.dt
    end, error = kernels.checked_step(x, u)
    right = x
    for _ in range(400):
        right = kernels.step(right, u, dt / 400, "rk8")
    assert np.abs(whole - right).max() > 10.0 * tolerance
    assert (error <= 1.0).all()
    off = kernels.difference(right, end)
    rates = [i for i, unit in enumerate(kernels.layout.tangent.units) if "/s" in unit]
    off[:, rates] *= dt
    # The substeps' errors add up; an embedded estimate is larger than the error.
    assert np.abs(off).max() < 10.0 * tolerance
    assert np.abs(off).max() > 1e-6 * tolerance


@pytest.mark.parametrize("name", EMBEDDED)
def test_the_estimate_is_of_the_order_of_the_embedded_method(scene, name):
    kernels = compile_scene(scene.replace(simulation={"integrator": name, "tolerance": 1e6}))
    x, u = states(kernels, 4.0)
    steps = np.array([0.08, 0.04])
    errors = np.array([kernels.checked_step(x, u, step)[1] for step in steps]) / steps[:, None]
    # The largest entry may be a velocity, which counts times the step.
    orders = np.log2(errors[0] / errors[1])
    expected = 4 if "rk4" in name else 6
    assert expected - 1.3 < np.median(orders) < expected + 1.3


def test_a_batch_is_divided_state_by_state(scene):
    kernels = compile_scene(scene)
    x, u = states(kernels, 60.0)
    x[::2] = states(kernels, 0.1)[0][::2]
    together, errors = kernels.checked_step(x, u)
    for row, state in enumerate(x):
        end, error = kernels.checked_step(state, u[row])
        np.testing.assert_array_equal(end, together[row])
        assert error == errors[row]


def test_what_cannot_be_followed_is_no_number(scene):
    kernels = compile_scene(scene)
    x, u = states(kernels, 1e9, 2)
    end, error = kernels.checked_step(x, u)
    assert np.isnan(end).all()
    assert not (error <= 1.0).any()


def test_nothing_is_estimated_where_the_scene_says_off_or_the_method_cannot(scene):
    whole = compile_scene(scene.replace(simulation={"tolerance": "off"}))
    x, u = states(whole, 0.1)
    with pytest.raises(ValueError, match="'rk4' estimates no error; choose from dormand_prince, rodas4"):
        whole.checked_step(x, u)
    with pytest.raises(ValueError, match="'symplectic_euler' estimates no error; choose from rk4, rk6"):
        compile_scene(scene).checked_step(x, u, integrator="symplectic_euler")


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"tolerance": "on"}, "simulation.tolerance = 'on': must be a finite number greater than 0, or off"),
        ({"tolerance": 0.0}, "finite number greater than 0, or off"),
        ({"tolerance": float("nan")}, "finite number greater than 0, or off"),
        ({"tolerance": False}, "simulation.tolerance"),
        ({"integrator": "rodas4", "tolerance": "off"}, "rodas4 cannot do without"),
        ({"integrator": "symplectic_euler"}, "symplectic_euler takes fixed steps"),
        ({"integrator": "dormand_prince"}, "dormand_prince has other tolerances"),
    ],
)
def test_a_tolerance_is_a_number_or_off(scene, changes, message):
    with pytest.raises(SceneError, match=message):
        scene.replace(simulation=changes)


def test_the_numerical_error_is_that_of_the_motion(scene):
    """A motion in steps that are too coarse, against adaptive integration."""
    coarse = compile_scene(scene.replace(simulation={"tolerance": "off"}))
    (x, *_), u = states(coarse, 6.0)
    motion = [x]
    for control in u:
        motion.append(coarse.step(motion[-1], control))
    errors = coarse.numerical_error(np.array(motion), u)
    assert errors.shape == (17,)
    assert errors[0] == 0.0
    true = coarse.integrate(x, u, 16 * scene.simulation.dt, rtol=1e-12, atol=1e-14).x[-1]
    tips = [np.array(coarse.tip_pose(each)) for each in (true, motion[-1])]
    # The distance of the tips is that of the dual parts, for equal attitudes.
    assert errors[-1] == pytest.approx(np.abs(tips[0] - tips[1]).max(), rel=3.0)
    assert errors[-1] > 1e-7
    both = coarse.numerical_error(np.stack([motion, motion], axis=1), np.stack([u, u], axis=1))
    np.testing.assert_allclose(both, np.stack([errors, errors], axis=1), rtol=1e-6)
    with pytest.raises(ValueError, match=r"states, u: shapes \(16, .*\) and \(16"):
        coarse.numerical_error(np.array(motion[1:]), u)
    n_p = coarse.n_p
    np.testing.assert_array_equal(coarse.numerical_error(np.array(motion), u, np.empty(n_p)), errors)
    with pytest.raises(ValueError, match=rf"p: shape \(2, {n_p}\), should be \({n_p},\)$"):
        coarse.numerical_error(np.array(motion), u, np.empty((2, n_p)))


@pytest.mark.parametrize(
    ("name", "tolerances", "rate"),
    [
        ("dormand_prince", {"rtol": 1e-2, "atol": 1e-2}, 6.0),
        pytest.param("rodas4", {"tolerance": 1e-2}, 6.0, marks=pytest.mark.slow),
        pytest.param("rodas5p", {"tolerance": 1e-2}, 10.0, marks=pytest.mark.slow),
        ("rk8", {"tolerance": "off"}, 1.5),
    ],
)
def test_the_numerical_error_of_a_whole_step_is_not_that_of_another_one(scene, name, tolerances, rate):
    """A companion of the same method would take the same step, and find no error."""
    settings = {"integrator": name, "dt": 0.05, "tolerance": None, **tolerances}
    kernels = compile_scene(scene.replace(simulation=settings))
    x, u = states(kernels, rate, 4)
    motion, right = np.stack([x, kernels.step(x, u)]), x
    for _ in range(50):
        right = kernels.step(right, u, 0.001, "rk8")
    errors = kernels.numerical_error(motion, u[None])[1]
    tips = [tuple(kernels.tip_pose(each).T) for each in (motion[1], right)]
    true = np.maximum(poses.error_distance(*tips), poses.error_angle(*tips))
    assert errors.min() > 0.0
    np.testing.assert_allclose(errors, true, rtol=0.01, atol=2e-8)
