"""Explicit methods of higher order: convergence, independent solutions, time reversal, single precision."""

import numpy as np
import pytest
from motions import convergence, exact_motion, free_body, moving_start, rollout, simulated
from scipy.special import ellipj, ellipk

from dq_space_arm_env import compile_scene, load_scene
from dq_space_arm_env.algebra import quaternion, screw
from dq_space_arm_env.integrators.munthe_kaas import slope
from dq_space_arm_env.scene import INTEGRATORS

HIGHER = ("rk6", "rk8", "dormand_prince")


def undivided(scene):
    """Kernels of a scene with tolerances so loose that an adaptive method takes each time step at once."""
    return compile_scene(simulated(scene, integrator="dormand_prince", rtol=1e6, atol=1e6))


# Steps that are short enough for the order to show, and long enough for errors above those of rounding.
STEPS = {"dormand_prince": (12, 24), "rk6": (8, 16), "rk8": (6, 10)}
STEPS_OF_SIX_JOINTS = {"dormand_prince": (180, 360), "rk6": (40, 80), "rk8": (30, 50)}


@pytest.mark.sampled
@pytest.mark.parametrize("scene", ["paper", "planar", "tip-load", "six-joint"])
@pytest.mark.parametrize("name", HIGHER)
def test_errors_fall_with_the_order_of_the_method(name, scene):
    counts = (STEPS_OF_SIX_JOINTS if scene == "six-joint" else STEPS)[name]
    errors = convergence(undivided(scene), name, counts, reference=("rk8", 800))
    assert errors[1] > 1e-13
    order = np.log(errors[0] / errors[1]) / np.log(counts[1] / counts[0])
    assert order > INTEGRATORS[name].order - 0.5


@pytest.mark.parametrize("name", HIGHER)
def test_a_tumbling_arm_agrees_with_dop853_on_the_vector_field_of_8_and_22(name):
    kernels = compile_scene("paper")
    x = moving_start(kernels, seed=3, joint_rate=1.0, base_rate=0.8)
    u = np.random.default_rng(2).uniform(-0.4, 0.4, kernels.n_u)
    final = rollout(kernels, x, np.tile(u, (400, 1)), 3.0 / 400, name)[-1]
    np.testing.assert_allclose(final, exact_motion(kernels, x, u, 3.0), rtol=0, atol=2e-11)


@pytest.mark.parametrize(("name", "h"), [("rk4", 0.1), ("dormand_prince", 0.1), ("rk6", 0.1), ("rk8", 0.28)])
def test_a_step_forth_and_back_returns_with_the_errors_order(name, h):
    """h and -h leave C h^(p+1) (1 + (-1)^(p+1)): one order more than a step has where p is even."""
    kernels = undivided("paper")
    x = moving_start(kernels, joint_rate=0.8, base_rate=0.4)
    still, gaps = np.zeros(kernels.n_u), []
    for step in (h, h / 2):
        there = kernels.step(x, still, step, name)
        gaps.append(np.linalg.norm(kernels.difference(x, kernels.step(there, still, -step, name))))
    order = INTEGRATORS[name].order
    assert gaps[1] > 1e-14
    assert np.log2(gaps[0] / gaps[1]) > order + (2 if order % 2 == 0 else 1) - 0.6


@pytest.mark.parametrize("order", [4, 6, 8])
def test_slopes_are_the_inverse_right_jacobian_as_far_as_the_order_needs(order):
    """Of exact size h^(order - 1): with an increment and commutators of size h."""
    rng = np.random.default_rng(order)
    twist, other = rng.normal(size=(2, 6))
    gaps = []
    for h in (0.4, 0.2):
        # Parallel to first order, as Omega = h omega + O(h^2) is.
        increment = h * twist + h * h * other
        expected = np.linalg.solve(screw.exponential_right_jacobian(tuple(increment)), twist)
        gaps.append(np.linalg.norm(np.subtract(slope(list(increment), list(twist), order), expected)))
    assert np.log2(gaps[0] / gaps[1]) > order - 0.3


INERTIA = (1.6, 2.0, 3.0)  # three different principal moments


def rigid_body():
    return free_body(base=load_scene("paper").base.model_dump() | {"inertia": np.diag(INERTIA).tolist()})


@pytest.mark.parametrize(("name", "bound"), [("rk4", 1e-6), ("rk6", 1e-11), ("rk8", 2e-13)])
def test_a_free_rigid_body_turns_as_jacobis_elliptic_functions_say(name, bound):
    """Landau & Lifshitz, Mechanics, section 37: omega = (a cn, b sn, c dn) where L^2 > 2 E I2."""
    kernels = rigid_body()
    x, (i1, i2, i3), (a, c) = kernels.layout.initial_state.copy(), INERTIA, (0.9, 1.1)
    x[kernels.layout.state.base_velocity] = [a, 0.0, c, 0.2, -0.1, 0.3]
    b = a * np.sqrt(i1 * (i3 - i1) / (i2 * (i3 - i2)))
    rate = c * np.sqrt((i3 - i2) * (i3 - i1) / (i1 * i2))
    m = (i2 - i1) * i1 * a**2 / ((i3 - i2) * i3 * c**2)
    assert 0.1 < m < 0.9
    times = 0.05 * np.arange(401)
    states = rollout(kernels, x, np.zeros((400, kernels.n_u)), 0.05, name)
    sn, cn, dn, _ = ellipj(rate * times, m)
    omega = states[:, kernels.layout.state.base_velocity][:, :3]
    np.testing.assert_allclose(omega, np.stack([a * cn, b * sn, c * dn], axis=1), rtol=0, atol=bound)
    # The attitude follows: angular momentum is constant in inertial axes, and the body moves straight on.
    momentum = kernels.momentum(states)
    np.testing.assert_allclose(
        momentum, np.broadcast_to(momentum[0], momentum.shape), rtol=0, atol=300 * bound
    )
    real, dual = tuple(states[-1][:4]), tuple(states[-1][4:8])
    position = np.array(quaternion.multiply(dual, quaternion.conjugate(real))[1:]) * 2.0
    np.testing.assert_allclose(position, 20.0 * np.array([0.2, -0.1, 0.3]), rtol=0, atol=20 * bound)


def test_a_body_spun_about_its_middle_axis_flips_after_half_an_analytic_period():
    """Dzhanibekov's wing nut: omega_2 changes sign every 2 K(m) / rate."""
    kernels = rigid_body()
    x, (i1, i2, i3) = kernels.layout.initial_state.copy(), INERTIA
    omega = np.array([0.002, 2.0, 0.003])
    x[kernels.layout.state.base_velocity] = [*omega, 0.0, 0.0, 0.0]
    twice_energy = np.dot(INERTIA, omega**2)
    square = np.dot(np.square(INERTIA), omega**2)
    assert square > twice_energy * i2
    rate = np.sqrt((i3 - i2) * (square - twice_energy * i1) / (i1 * i2 * i3))
    m = (i2 - i1) * (twice_energy * i3 - square) / ((i3 - i2) * (square - twice_energy * i1))
    flip = 2.0 * ellipk(m) / rate
    motion = kernels.integrate(x, np.zeros(kernels.n_u), 4.5 * flip, rtol=1e-13, atol=1e-14)
    spin = kernels.layout.state.base_velocity.start + 1
    times = np.linspace(0.0, 4.5 * flip, 100_001)
    values = motion.sol(times)[:, spin]
    before = np.flatnonzero(np.diff(np.sign(values)))
    assert len(before) == 4
    share = values[before] / (values[before] - values[before + 1])
    crossings = times[before] + share * np.diff(times)[before]
    np.testing.assert_allclose(np.diff(crossings), flip, rtol=1e-10)


@pytest.mark.sampled
@pytest.mark.parametrize("name", HIGHER)
@pytest.mark.parametrize("scene", ["paper", "planar"])
def test_single_precision_keeps_its_digits_and_batches_the_bits_of_single_states(name, scene):
    single, double = compile_scene(simulated(scene, precision="float32")), compile_scene(scene)
    starts = np.array([moving_start(double, seed) for seed in range(35)])
    u = np.random.default_rng(5).normal(size=(35, double.n_u))
    exact, rounded = double.step(starts, u, integrator=name), single.step(starts, u, integrator=name)
    assert rounded.dtype == np.float32
    np.testing.assert_allclose(rounded, exact, rtol=0, atol=3e-6)
    one_by_one = [single.step(x, v, integrator=name) for x, v in zip(starts, u, strict=True)]
    np.testing.assert_array_equal(rounded, one_by_one)
