"""The Gauss method: order, symmetry, symplecticity, energy over many steps, convergence of its passes."""

import numpy as np
import pytest
from motions import convergence, free_body, moving_start, simulated, sprung

from dq_space_arm_env import compile_scene
from dq_space_arm_env.integrators.gauss import GAUSS_6
from dq_space_arm_env.scene import INTEGRATORS

NAME = "gauss6"
STEP = 0.015  # s


def test_coefficients_are_those_of_collocation_at_gauss_points():
    """B(6), C(3) and D(3) imply order 6: Hairer, Lubich & Wanner, II.1.3; B and C define the tableau."""
    a, b = np.array(GAUSS_6.coefficients()), np.array(GAUSS_6.weights)
    c = a.sum(axis=1)
    for k in range(1, GAUSS_6.order + 1):
        assert b @ c ** (k - 1) == pytest.approx(1.0 / k, abs=1e-16)
    for k in range(1, GAUSS_6.stages + 1):
        np.testing.assert_allclose(a @ c ** (k - 1), c**k / k, rtol=0, atol=1e-16)
        np.testing.assert_allclose((b * c ** (k - 1)) @ a, b * (1.0 - c**k) / k, rtol=0, atol=1e-16)


@pytest.mark.sampled
@pytest.mark.parametrize(
    ("scene", "first"), [("paper", 4), ("planar", 4), ("tip-load", 4), ("six-joint", 32)]
)
def test_errors_fall_with_the_sixth_power_of_the_step(scene, first):
    errors = convergence(compile_scene(scene), NAME, (first, 2 * first), ("rk8", 4096))
    assert np.log2(errors[0] / errors[1]) == pytest.approx(6.0, abs=0.15)


@pytest.mark.parametrize(
    ("stiffness", "damping", "tolerance"), [(0.0, 0.0, 2e-13), (300.0, 0.0, 2e-13), (1e4, 50.0, 2e-11)]
)
def test_springs_and_dampers_agree_with_order_8(stiffness, damping, tolerance):
    kernels = compile_scene(sprung("paper", stiffness, damping))
    x, u = moving_start(kernels), np.full(kernels.n_u, 0.2)
    x[kernels.layout.state.joint_angles] += 0.1
    ends = [
        kernels.simulate(x, u, steps, 0.15 / steps, name, every=steps)[-1]
        for name, steps in ((NAME, 160), ("rk8", 1000))
    ]
    assert np.abs(kernels.difference(*ends)).max() < tolerance


@pytest.mark.parametrize("scene", ["paper", "planar", "six-joint"])
def test_a_step_forward_and_one_back_return_to_the_start(scene):
    """Symmetry; inputs are held, dampers would act forward in both directions."""
    kernels = compile_scene(scene)
    u = np.random.default_rng(1).uniform(-0.3, 0.3, kernels.n_u)
    for seed in range(5):
        x = moving_start(kernels, seed, joint_rate=2.0, base_rate=0.5)
        there = kernels.step(x, u, 0.03, NAME)
        back = kernels.step(there, u, -0.03, NAME)
        assert np.abs(kernels.difference(x, back)).max() < 2e-14
        explicit = kernels.step(kernels.step(x, u, 0.03, "rk4"), u, -0.03, "rk4")
        assert np.abs(kernels.difference(x, explicit)).max() > 5e-11


def symplectic_form(kernels, x):
    """The form d(mu . xi) on tangent states (twist, angles, velocities), mu = M v the body momenta.

    It pairs changes of momenta with those of positions; in axes that turn along, minus mu . [xi, eta].
    """
    layout = kernels.layout
    n = 6 + layout.n_joints
    velocities = [*range(layout.tangent.base_velocity.start, layout.tangent.base_velocity.stop)]
    velocities += [*range(layout.tangent.joint_rates.start, layout.tangent.joint_rates.stop)]
    positions = [*range(6), *range(layout.tangent.joint_angles.start, layout.tangent.joint_angles.stop)]
    where = layout.state
    v = np.concatenate([x[where.base_velocity], x[where.joint_rates]])
    momenta, by_state = kernels.mass_matrix(x) @ v, np.zeros((n, kernels.n_t))
    by_state[:, velocities] = kernels.mass_matrix(x)
    for j, index in enumerate(positions[6:]):
        ahead, behind = x.copy(), x.copy()
        ahead[where.joint_angles.start + j] += 1e-5
        behind[where.joint_angles.start + j] -= 1e-5
        by_state[:, index] = (kernels.mass_matrix(ahead) - kernels.mass_matrix(behind)) @ v / 2e-5
    form = np.zeros((kernels.n_t, kernels.n_t))
    form[positions] = by_state
    form = form - form.T
    for i in range(6):
        for j in range(6):
            xi, eta = np.eye(6)[i], np.eye(6)[j]
            turned = np.cross(xi[:3], eta[:3])
            moved = np.cross(xi[:3], eta[3:]) + np.cross(xi[3:], eta[:3])
            form[i, j] += momenta[:6] @ np.concatenate([turned, moved])
    return form


@pytest.mark.slow
@pytest.mark.parametrize("stiffness", [pytest.param(0.0, marks=pytest.mark.endurance), 100.0])
def test_a_step_is_symplectic(stiffness):
    """A' form(x+) A = form(x), whatever the step; the methods beside it are off by their errors."""
    scene = sprung("free-floating", stiffness) if stiffness else simulated("free-floating")
    kernels = compile_scene(scene)
    x, u = moving_start(kernels, joint_rate=1.0, base_rate=0.5), np.zeros(kernels.n_u)
    before, defects = symplectic_form(kernels, x), {}
    for name in (NAME, "rk6", "momentum_rk4"):
        a, _ = kernels.linearize(x, u, 0.2, name)
        after = symplectic_form(kernels, kernels.step(x, u, 0.2, name))
        defects[name] = np.abs(a.T @ after @ a - before).max() / np.abs(before).max()
    assert defects[NAME] < 1e-11
    assert min(defects["rk6"], defects["momentum_rk4"]) > 1e2 * defects[NAME]


def walked(kernels, x, steps, name):
    """Relative changes of the energy along a free motion."""
    energy = kernels.energy(
        kernels.simulate(x, np.zeros(kernels.n_u), steps, STEP, name, every=steps // 1000)
    )
    return energy / energy[0] - 1.0


@pytest.mark.parametrize("stiffness", [0.0, 10.0])
def test_the_energy_does_not_drift(stiffness):
    """Means over both halves of 1e5 steps agree to the rounding of their number."""
    kernels = compile_scene(sprung("paper", stiffness))
    x = moving_start(kernels, joint_rate=0.5, base_rate=0.15)
    x[kernels.layout.state.joint_angles] += 0.5
    change = walked(kernels, x, 100_000, NAME)
    first, second = np.array_split(change, 2)
    assert np.abs(change).max() < 5e-12
    assert abs(second.mean() - first.mean()) < 1e-13
    assert np.abs(walked(kernels, x, 100_000, "rk4")).max() > 2e-8


@pytest.mark.endurance
@pytest.mark.parametrize("joint_rate", [0.3, 1.0])
def test_the_energy_over_a_million_steps_of_winding_joints(joint_rate):
    """Joints turn by thousands of radians; what rounding cuts off their angles is handed on."""
    kernels = compile_scene("paper")
    x = moving_start(kernels, joint_rate=joint_rate, base_rate=0.3 * joint_rate)
    change = walked(kernels, x, 1_000_000, NAME)
    quarters = [part.mean() for part in np.array_split(change, 4)]
    assert np.ptp(quarters) < 1e-12
    assert np.abs(change).max() < 1e-10


@pytest.mark.endurance
def test_fast_joints_never_stall_over_a_million_steps():
    """At 4 rad/s some steps turn a joint by half a radian: the passes settle to some fifty roundings."""
    kernels = compile_scene("paper")
    x, rng, where = kernels.layout.initial_state.copy(), np.random.default_rng(0), kernels.layout.state
    x[where.joint_rates] = rng.uniform(-4.0, 4.0, 3)
    x[where.base_velocity] = rng.uniform(-1.2, 1.2, 6)
    assert np.abs(walked(kernels, x, 1_200_000, NAME)).max() < 1e-5


def test_single_precision_keeps_the_energy():
    kernels = compile_scene(simulated("paper", precision="float32"))
    exact = compile_scene("paper")
    x = moving_start(exact, joint_rate=0.5, base_rate=0.15)
    states = kernels.simulate(x, np.zeros(kernels.n_u), 20_000, STEP, NAME, every=200).astype(np.float64)
    assert np.abs(exact.energy(states) / exact.energy(x) - 1.0).max() < 2e-4


@pytest.mark.parametrize("scene", ["paper", "six-joint"])
def test_passes_that_do_not_converge_end_in_nan(scene):
    """A step as long as a fast joint's turn; in a batch, other lanes stay as they are alone."""
    kernels = compile_scene(scene)
    x, u = moving_start(kernels), np.zeros(kernels.n_u)
    wild = x.copy()
    wild[kernels.layout.state.joint_rates] = 300.0
    assert np.isnan(kernels.step(wild, u, 0.1, NAME)).all()
    batch = np.array([x, wild, x, x])
    ends = kernels.step(batch, np.tile(u, (4, 1)), 0.1, NAME)
    np.testing.assert_array_equal(ends[[0, 2, 3]], np.tile(kernels.step(x, u, 0.1, NAME), (3, 1)))
    assert np.isnan(ends[1]).all()
    lost = x.copy()
    lost[kernels.layout.state.joint_rates] = np.nan
    assert np.isnan(kernels.step(lost, u, 0.1, NAME)).any()


def test_angles_of_many_turns_cost_no_digits():
    """Joints without springs are periodic: 1e5 turns away, a step changes the angles by the same amount."""
    kernels = compile_scene("paper")
    x, u, where = moving_start(kernels), np.zeros(kernels.n_u), kernels.layout.state
    far = x.copy()
    far[where.joint_angles] += 2e5 * np.pi
    near = x.copy()
    turns = np.longdouble(far[where.joint_angles]) - 1e5 * 2 * np.longdouble(
        "3.14159265358979323846264338328"
    )
    near[where.joint_angles] = turns.astype(np.float64)
    ends = [kernels.step(start, u, STEP, NAME) for start in (near, far)]
    rates = [end[where.joint_rates] for end in ends]
    np.testing.assert_allclose(*rates, rtol=0, atol=1e-14)


@pytest.mark.parametrize("joint", ["boom", "drive"])
def test_joints_that_slide_far_are_where_they_are(joint):
    """3.5 m and 3.5 rad, beyond half a turn, where only joints that do nothing but turn may be wrapped."""
    kernels = compile_scene("sliding")
    x, u, where = moving_start(kernels), np.zeros(kernels.n_u), kernels.layout.state.joint_angles
    place = next(i for i, name in enumerate(kernels.layout.state.names[where]) if name.startswith(joint))
    x[where.start + place] = 3.5
    assert np.abs(kernels.step(x, u, STEP, NAME) - kernels.step(x, u, STEP, "rk8")).max() < 1e-14


def test_a_free_body_turns_by_the_exact_momentum():
    """Torque-free precession of a body without joints: energy and momentum at every step."""
    kernels = free_body()
    x = kernels.layout.initial_state.copy()
    x[kernels.layout.state.base_velocity] = [0.7, 1.1, -0.4, 0.1, 0.0, 0.2]
    states = kernels.simulate(x, np.zeros(kernels.n_u), 10_000, 0.05, NAME, every=10)
    assert np.abs(kernels.energy(states) / kernels.energy(x) - 1.0).max() < 5e-15
    assert np.abs(kernels.momentum(states) - kernels.momentum(x)).max() < 1e-13


def test_the_registry_says_which_methods_are_symplectic():
    assert [name for name, entry in INTEGRATORS.items() if entry.symplectic] == [NAME]


@pytest.mark.parametrize("scene", ["paper", "planar"])
def test_lanes_that_wait_for_others_give_the_bits_of_single_states(scene):
    """Fast and slow joints take different numbers of passes, or do not converge."""
    kernels = compile_scene(simulated(scene, integrator=NAME, dt=0.05))
    rng = np.random.default_rng(2)
    x = np.array([moving_start(kernels, seed, joint_rate=0.1, base_rate=0.1) for seed in range(64)])
    x[:, kernels.layout.state.joint_rates] *= rng.choice([0.0, 1.0, 30.0, 300.0, 3e4], (64, 1))
    u = rng.uniform(-1.0, 1.0, (64, kernels.n_u)) * kernels.layout.control_limit
    stepped, linearized = kernels.step(x, u), kernels.linearize(x, u)
    assert np.isnan(stepped).any()
    for row in range(64):
        np.testing.assert_array_equal(kernels.step(x[row], u[row]), stepped[row])
        for alone, together in zip(kernels.linearize(x[row], u[row]), linearized, strict=True):
            np.testing.assert_array_equal(alone, together[row])
