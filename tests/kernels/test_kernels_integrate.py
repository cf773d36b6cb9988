"""`Kernels.integrate`: accuracy, the curve between the steps, held inputs, what it refuses."""

import numpy as np
import pytest

from dq_space_arm_env import compile_scene, load_scene


@pytest.fixture(scope="module")
def arm():
    kernels = compile_scene("paper")
    rng = np.random.default_rng(0)
    x, layout = kernels.layout.initial_state.copy(), kernels.layout.state
    x[layout.joint_rates] = rng.uniform(-0.8, 0.8, 3)
    x[layout.base_velocity] = rng.uniform(-0.4, 0.4, 6)
    return kernels, x


def simulated(scene, **changes):
    return compile_scene(scene.replace(simulation=changes))


def followed(kernels, x, u, times, step=1e-3):
    """States at multiples of a step of rk8."""
    states = [x]
    for _ in range(round(times[-1] / step)):
        states.append(kernels.step(states[-1], u, step, "rk8"))
    return np.array(states)[np.rint(np.asarray(times) / step).astype(int)]


@pytest.mark.slow
def test_errors_follow_the_tolerance_at_the_ends_of_steps_and_between(arm):
    kernels, x = arm
    u, times = np.zeros(kernels.n_u), np.linspace(0.0, 1.0, 201)
    reference = followed(kernels, x, u, times)
    steps = []
    for tolerance in (1e-6, 1e-8, 1e-10):
        motion = kernels.integrate(x, u, 1.0, rtol=tolerance, atol=tolerance)
        steps.append(motion.steps)
        errors = np.abs(motion.sol(times) - reference).max(axis=1)
        assert 0.01 * tolerance < errors[-1] < 20.0 * tolerance
        assert errors.max() < 300.0 * tolerance
        np.testing.assert_array_equal(motion.t[[0, -1]], [0.0, 1.0])
        np.testing.assert_allclose(motion.sol(motion.t), motion.x, rtol=0, atol=1e-13)
    # Errors of order 5: a hundredth takes 100^(1/5) = 2.5 times the steps.
    assert 1.8 < steps[1] / steps[0] < 3.2
    assert 1.8 < steps[2] / steps[1] < 3.2


@pytest.mark.slow
def test_the_curve_is_of_order_4_inside_a_step(arm):
    kernels, x = arm
    u, errors = np.zeros(kernels.n_u), []
    for h in (0.08, 0.04):
        motion = simulated(kernels.scene, dt=h).integrate(x, u, h, rtol=1e3, atol=1e3)
        assert motion.steps == 1
        times = h / 8 * np.arange(8)
        errors.append(np.abs(motion.sol(times) - followed(kernels, x, u, times, 0.005)).max())
    assert np.log2(errors[0] / errors[1]) > 4.6  # a local error: one order more


def test_times_asked_for(arm):
    kernels, x = arm
    motion = kernels.integrate(x, np.zeros(kernels.n_u), 2.0, times=[2.0, 0.0, 0.5])
    assert motion.x.shape == (3, kernels.n_x)
    np.testing.assert_array_equal(motion.t, [2.0, 0.0, 0.5])
    np.testing.assert_allclose(motion.x[1], x, rtol=0, atol=1e-15)
    np.testing.assert_array_equal(motion.sol(0.5), motion.x[2])
    assert np.abs(np.linalg.norm(motion.x[:, :4], axis=1) - 1.0).max() < 1e-15


def test_inputs_are_held_for_equal_parts_of_the_time(arm):
    kernels, x = arm
    controls = np.random.default_rng(1).uniform(-1.0, 1.0, (20, kernels.n_u))
    motion = kernels.integrate(x, controls, 3.0, rtol=1e-10, atol=1e-12)
    expected = x
    for u in controls:
        for _ in range(10):
            expected = kernels.step(expected, u, 0.015, "rk8")
    np.testing.assert_allclose(motion.x[-1], expected, rtol=0, atol=1e-8)
    # No step crosses a switch.
    assert np.isclose(motion.t[:, None], np.linspace(0.0, 3.0, 21), atol=1e-12).any(axis=0).all()


def test_backward_in_time(arm):
    kernels, x = arm
    u = np.full(kernels.n_u, 0.2)
    there = kernels.integrate(x, u, 2.0, rtol=1e-11, atol=1e-13)
    back = kernels.integrate(there.x[-1], u, -2.0, rtol=1e-11, atol=1e-13)
    np.testing.assert_allclose(back.x[-1], x, rtol=0, atol=1e-9)
    np.testing.assert_allclose(back.sol(-1.0), there.sol(1.0), rtol=0, atol=1e-9)


def test_planar_scenes_and_single_precision():
    double, single = compile_scene("planar"), simulated(load_scene("planar"), precision="float32")
    x, u = double.layout.initial_state, np.full(double.n_u, 0.1)
    exact, rounded = double.integrate(x, u, 5.0), single.integrate(x, u, 5.0)
    assert rounded.x.dtype == np.float32
    np.testing.assert_allclose(rounded.x[-1], exact.x[-1], rtol=0, atol=2e-4)


def test_steps_that_become_nan_are_rejected(arm):
    """The first step tried is as long as the scene's, at which the method overflows."""
    kernels, x = arm
    fast = x.copy()
    fast[kernels.layout.state.joint_rates] = [40.0, -50.0, 30.0]
    long = simulated(kernels.scene, dt=1000.0)
    u = np.zeros(kernels.n_u)
    assert np.isnan(long.step(fast, u, integrator="rk6")).any()
    with pytest.raises(RuntimeError, match=r"followed to t = 0\.\d+ s only: max_steps = 60 were tried"):
        long.integrate(fast, u, 2000.0, max_steps=60)


def test_a_motion_that_ends_is_reported(arm):
    kernels, x = arm
    fast = x.copy()
    fast[kernels.layout.state.joint_rates] = 1e200
    with pytest.raises(RuntimeError, match=r"cannot be followed beyond t = 0.0 s"):
        kernels.integrate(fast, np.zeros(kernels.n_u), 1.0)
    with pytest.raises(RuntimeError, match=r"s only: max_steps = 5 were tried"):
        kernels.integrate(x, np.zeros(kernels.n_u), 10.0, max_steps=5)


@pytest.mark.parametrize(
    ("changes", "sentence"),
    [
        ({"x": np.zeros(3)}, r"x: shape \(3,\), should be \(23,\)"),
        ({"u": np.zeros(5)}, r"u: shape \(5,\), should be \(12,\) or \(N, 12\)"),
        ({"x": np.full(23, np.nan)}, r"x: nan is not a finite number"),
        ({"duration": 0.0}, r"duration: 0.0, should be a finite time"),
        ({"duration": "1"}, r"duration: '1', should be a finite time"),
        ({"duration": None}, r"duration: None, should be a finite time"),
        ({"rtol": 1e-17}, r"rtol: 1e-17, should be at least 8.9e-16 in float64"),
        ({"rtol": "1e-6"}, r"rtol: '1e-6', should be a positive number"),
        ({"rtol": np.array([1e-6, 1e-6])}, r"rtol: array\(.*\), should be a positive number"),
        ({"atol": np.nan}, r"atol: nan, should be a positive number"),
        ({"max_steps": 0}, r"max_steps: 0, should be a number of at least 1"),
        ({"max_steps": "9"}, r"max_steps: '9', should be a number of at least 1"),
        ({"max_steps": np.nan}, r"max_steps: nan, should be a number of at least 1"),
        ({"times": [0.5, 1.5]}, r"times: 1.5 is not between 0 and 1.0 s"),
        ({"times": [[0.5]]}, r"times: shape \(1, 1\), should be a number or \(k,\)"),
    ],
)
def test_bad_arguments_are_refused(arm, changes, sentence):
    kernels, x = arm
    arguments = {"x": x, "u": np.zeros(kernels.n_u), "duration": 1.0, **changes}
    with pytest.raises(ValueError, match=sentence):
        kernels.integrate(arguments.pop("x"), arguments.pop("u"), arguments.pop("duration"), **arguments)


@pytest.mark.parametrize("times", ["a", [0.5j], np.ma.masked_array([0.5], [True])])
def test_times_are_real_numbers(arm, times):
    kernels, x = arm
    u = np.zeros(kernels.n_u)
    with pytest.raises(TypeError, match=r"^times: .* should be real numbers"):
        kernels.integrate(x, u, 1.0, times=times)
    motion = kernels.integrate(x, u, 1.0)
    with pytest.raises(TypeError, match=r"^t: .* should be real numbers"):
        motion.sol(times)
    with pytest.raises(ValueError, match=r"^t: 1.5 is not between 0 and 1.0 s"):
        motion.sol(1.5)


def test_the_global_error_is_estimated(arm):
    kernels, x = arm
    u, times = np.zeros(kernels.n_u), np.linspace(0.0, 2.0, 5)
    reference = followed(kernels, x, u, times)
    for tolerance in (1e-4, 1e-8):
        motion = kernels.integrate(x, u, 2.0, rtol=tolerance, atol=tolerance, times=times)
        true, estimate = kernels.difference(reference, motion.x), motion.global_error()
        assert estimate.shape == (5, kernels.n_t)
        assert np.abs(estimate - true).max() < 0.2 * np.abs(true).max()
    with pytest.raises(ValueError, match="rtol"):
        kernels.integrate(x, u, 0.1, rtol=1e-15, atol=1e-15).global_error()


def test_the_global_error_is_estimated_in_single_precision(arm):
    single = compile_scene(arm[0].scene.replace({"simulation.precision": "float32"}))
    motion = single.integrate(arm[1], np.zeros(single.n_u), 2.0)
    true = arm[0].difference(followed(*arm, np.zeros(single.n_u), [2.0])[-1], motion.x[-1].astype(float))
    assert np.abs(motion.global_error()[-1] - true).max() < 1e-4
    with pytest.raises(ValueError, match=r"rtol: 1e-06, should be at least 3\.8e-06 to estimate"):
        single.integrate(arm[1], np.zeros(single.n_u), 0.1, rtol=1e-6).global_error()


@pytest.mark.slow
def test_what_happens_step_by_step_is_refused(arm):
    late = compile_scene(arm[0].scene.replace({"actuators.base_torque.delay": 2}))
    with pytest.raises(ValueError, match=r"base torque x delays or lags by time steps, .*: use simulate"):
        late.integrate(late.layout.initial_state, np.zeros(late.n_u), 1.0)
    catching = compile_scene("capture-and-detumble")
    rows = catching.stage_parameters()
    (stage,) = np.flatnonzero(rows[:, catching.parameters.names.index("catch.now")])
    x, u = catching.layout.initial_state, np.zeros((stage + 1, catching.n_u))
    with pytest.raises(ValueError, match=f"p: a payload is caught at the end of part {stage}, should be 0"):
        catching.integrate(x, u, 1.0, p=rows[: stage + 1])
    assert catching.integrate(x, u[:stage], 0.1, p=rows[:stage]).t[-1] == 0.1
