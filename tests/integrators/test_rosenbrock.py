"""Rosenbrock methods: stiff springs and dampers at any deflection, locked joints, exact derivatives."""

from functools import cache

import casadi
import numpy as np
import pytest
from motions import exact_motion, moving_start, rollout, sprung
from scipy.integrate import solve_ivp

from dq_space_arm_env import compile_scene
from dq_space_arm_env.dynamics.linear import factorize_lu, solve_lu
from dq_space_arm_env.integrators.canonical_coordinates import CanonicalCoordinates
from dq_space_arm_env.integrators.rosenbrock_tableaus import RODAS4, RODAS5P
from dq_space_arm_env.kernels.programs.scene_programs import ScenePrograms

# They share all but numbers: what long motions show of one holds of the other, unless the numbers are wrong.
NAMES = ("rodas4", pytest.param("rodas5p", marks=pytest.mark.slow))
MOVED = ("rodas4", pytest.param("rodas5p", marks=pytest.mark.endurance))
TABLEAUS = {"rodas4": RODAS4, "rodas5p": RODAS5P}
STEPS = 10_000
DT = 0.015


def still(kernels, steps=STEPS):
    return np.zeros((steps, kernels.n_u))


@cache
def variable(name, **simulation):
    """Kernels of a scene whose springs and dampers are parameters: compiled once for all of them."""
    scene = sprung(name, 1.0, 1.0, **simulation)
    parts = [f"links.{j}.{part}" for j in range(len(scene.links)) for part in ("stiffness", "damping")]
    return compile_scene(scene.replace(parameters=parts))


def springs(kernels, stiffness, damping=0.0):
    """Parameters of `variable`, for all joints alike or one by one."""
    joints = np.zeros(kernels.n_p // 2)
    return np.stack([stiffness + joints, damping + joints], axis=1).ravel()


@pytest.mark.parametrize("name", NAMES)
def test_tableaus_are_consistent_and_l_stable(name):
    """On y' = a y a step multiplies by R(h a): |R| <= 1 in the left half plane, 0 at infinity."""
    tableau = TABLEAUS[name]

    def growth(z):
        stages = []
        for starts, couplings in zip(tableau.starts, tableau.couplings, strict=True):
            start = 1.0 + sum(a * u for a, u in zip(starts, stages, strict=True))
            carried = sum(c * u for c, u in zip(couplings, stages, strict=True))
            stages.append(tableau.gamma * (z * start + carried) / (1.0 - tableau.gamma * z))
        return start + stages[-1]

    for size in np.logspace(-3, 8, 400):
        assert abs(growth(1j * size)) < 1.0 + 1e-12
        assert abs(growth(-size)) < 1.0 + 1e-12
    assert abs(growth(-1e12)) < 1e-10
    errors = [abs(growth(z) - np.exp(z)) for z in (0.1, 0.2)]
    assert np.log2(errors[1] / errors[0]) > tableau.order + 0.8


@pytest.mark.sampled
@pytest.mark.parametrize(
    ("scene", "stiffness"), [("paper", 0.0), ("paper", 30.0), ("no-wrist", 5.0), ("tip-load", 0.0)]
)
@pytest.mark.parametrize("name", NAMES)
def test_errors_against_dop853_fall_with_the_order_of_the_method(name, scene, stiffness):
    kernels = variable(scene, integrator=name, tolerance=1e3)  # steps are not divided
    p = springs(kernels, stiffness, 0.05 * stiffness)
    x = moving_start(kernels, joint_rate=0.8, base_rate=0.4)
    u = np.random.default_rng(1).uniform(-0.3, 0.3, kernels.n_u)
    exact = exact_motion(kernels, x, u, 1.2, p=p)
    counts = {"rodas4": (32, 64, 128), "rodas5p": (16, 32, 64)}[name]
    errors = []
    for steps in counts:
        final = rollout(kernels, x, np.tile(u, (steps, 1)), 1.2 / steps, name, p)[-1]
        errors.append(np.linalg.norm(kernels.difference(exact, final)))
    orders = np.log2(np.divide(errors[:-1], errors[1:]))
    assert orders == pytest.approx(TABLEAUS[name].order, abs=0.3)


@pytest.mark.sampled
@pytest.mark.parametrize("name", MOVED)
@pytest.mark.parametrize(
    ("stiffness", "damping", "bound"), [(1e2, 20.0, 2e-9), (1e4, 200.0, 2e-9), (1e6, 2000.0, 4e-9)]
)
def test_stiff_damped_joints_agree_with_radau(name, stiffness, damping, bound):
    """Steps of 15 ms, while rk4 needs some of 1 ms and less to be stable."""
    kernels = variable("paper")
    p = springs(kernels, stiffness, damping)
    x = moving_start(kernels, joint_rate=0.0, base_rate=0.1)
    u = np.random.default_rng(1).uniform(-0.5, 0.5, kernels.n_u)
    exact = exact_motion(kernels, x, u, 0.6, "Radau", 1e-11, p)
    final = rollout(kernels, x, np.tile(u, (40, 1)), DT, name, p)[-1]
    assert np.linalg.norm(kernels.difference(exact, final)) < bound


@pytest.mark.sampled
@pytest.mark.parametrize("name", MOVED)
@pytest.mark.parametrize("scene", ["paper", "planar"])
@pytest.mark.parametrize("stiffness", [1e2, 1e4, 1e6, 1e8])
def test_stiff_springs_never_gain_energy_where_rk4_explodes(stiffness, scene, name):
    kernels = variable(scene)
    x, p = moving_start(kernels), springs(kernels, stiffness)
    states = rollout(kernels, x, still(kernels), DT, name, p)
    energy = kernels.energy(states, p=p)
    assert np.isfinite(states).all()
    assert energy.max() <= energy[0] * (1.0 + 1e-7)
    assert energy[-1] > 0.85 * energy[0]  # the base's motion stays; only vibrations may be damped
    momentum = kernels.momentum(states)
    assert np.abs(momentum - momentum[0]).max() < 1e-12 * np.linalg.norm(momentum[0])
    if stiffness >= 1e6:
        with np.errstate(all="ignore"):
            exploded = kernels.energy(rollout(kernels, x, still(kernels, 1000), DT, "rk4", p), p=p)
        assert not exploded[-1] < 10.0 * energy[0]


@pytest.mark.slow
@pytest.mark.parametrize("name", MOVED)
def test_soft_and_stiff_joints_get_along(name):
    kernels = variable("paper")
    p = springs(kernels, (1e2, 1e5, 1e8))
    states = rollout(kernels, moving_start(kernels), still(kernels), DT, name, p)
    energy = kernels.energy(states, p=p)
    assert energy.max() <= energy[0] * (1.0 + 1e-9)
    # The soft joint still swings, the others are held.
    angles = states[-1000:, kernels.layout.state.joint_angles]
    assert np.ptp(angles[:, 0]) > 1e-3
    assert np.ptp(angles[:, 2]) < 4e-6


@pytest.mark.sampled
@pytest.mark.parametrize("name", MOVED)
@pytest.mark.parametrize("stiffness", [0.0, 1e6])
def test_dampers_of_a_million_stop_the_joints_and_nothing_else(stiffness, name):
    kernels = variable("paper")
    x, p = moving_start(kernels), springs(kernels, stiffness, 1e6)
    states = rollout(kernels, x, still(kernels), DT, name, p)
    assert np.abs(states[-1, kernels.layout.state.joint_rates]).max() < 1e-6
    energy = kernels.energy(states, p=p)
    assert energy.max() <= energy[0] * (1.0 + 1e-9)
    momentum = kernels.momentum(states)
    assert np.abs(momentum - momentum[0]).max() < 1e-12 * np.linalg.norm(momentum[0])


@pytest.mark.slow
@pytest.mark.parametrize("name", MOVED)
def test_infinite_stiffness_is_a_locked_arm(name):
    """The base then moves as a rigid body with the arm's mass does: Euler's equations about its center."""
    end, errors = 3.0, []
    kernels = variable("free-floating", integrator=name, tolerance=1e-9)
    for stiffness in (3e2, 3e4, 3e6):
        p = springs(kernels, stiffness, 2.0 * stiffness**0.5)
        layout, x = kernels.layout.state, kernels.layout.initial_state.copy()
        x[layout.pose] = np.eye(8)[0]
        twists = np.tile(x, (3, 1))
        twists[:, layout.base_velocity][:, :3] = np.eye(3)
        inertia = kernels.momentum(twists)[:, 3:].T
        x[layout.base_velocity] = [0.3, -0.2, 0.4, 0.0, 0.0, 0.0]

        def euler(_, omega, inertia=inertia):
            return np.linalg.solve(inertia, np.cross(inertia @ omega, omega))

        exact = solve_ivp(euler, (0.0, end), [0.3, -0.2, 0.4], "DOP853", rtol=1e-12, atol=1e-12).y[:, -1]
        final = rollout(kernels, x, still(kernels, 200), DT, name, p)[-1]
        errors.append(np.linalg.norm(final[layout.base_velocity][:3] - exact))
    assert errors[2] < 1e-7
    # The arm bends by torque / stiffness.
    assert np.divide(errors[:-1], errors[1:]) == pytest.approx(100.0, rel=0.3)


@pytest.mark.slow
@pytest.mark.parametrize("name", NAMES)
def test_linearization_of_stiff_steps_agrees_with_differences(name):
    """Of undivided steps: the derivatives of others hold the lengths of their substeps fixed."""
    kernels = compile_scene(sprung("planar", 1e6, 100.0, integrator=name, tolerance=1e3))
    rng = np.random.default_rng(5)
    x, u = moving_start(kernels), rng.normal(size=kernels.n_u)
    a, b = kernels.linearize(x, u, integrator=name)
    size = 1e-6
    around = kernels.step(x, u, integrator=name)
    for matrix, directions, moved in (
        (a, np.eye(kernels.n_t), lambda d: (kernels.retract(x, d), u)),
        (b, np.eye(kernels.n_u), lambda d: (x, u + d)),
    ):
        for column, direction in zip(matrix.T, directions, strict=True):
            ends = [kernels.step(*moved(sign * size * direction), integrator=name) for sign in (1.0, -1.0)]
            change = [kernels.difference(around, end) for end in ends]
            numeric = (change[0] - change[1]) / (2.0 * size)
            np.testing.assert_allclose(column, numeric, rtol=0, atol=1e-6 * max(1.0, np.abs(numeric).max()))


@pytest.mark.parametrize("name", NAMES)
def test_a_batch_gives_the_bits_of_its_rows(name):
    kernels = compile_scene(sprung("planar", 1e4))
    states = np.array([moving_start(kernels, seed) for seed in range(11)])
    inputs = np.random.default_rng(6).normal(size=(11, kernels.n_u))
    one_by_one = [kernels.step(x, u, integrator=name) for x, u in zip(states, inputs, strict=True)]
    np.testing.assert_array_equal(kernels.step(states, inputs, integrator=name), one_by_one)


@pytest.mark.parametrize("name", NAMES)
def test_single_precision_is_stable_too(name):
    kernels = compile_scene(sprung("paper", 1e6, precision="float32"))
    x = moving_start(kernels).astype(np.float32)
    energies = [kernels.energy(x)]
    for _ in range(2000):
        x = kernels.step(x, np.zeros(kernels.n_u), integrator=name)
        energies.append(kernels.energy(x))
    assert max(energies) < energies[0] * (1.0 + 1e-5)
    assert energies[-1] > 0.85 * energies[0]


def test_elimination_without_pivoting_keeps_the_digits_of_stiff_systems():
    """1 + A E with E from 1e-8 to 1e8: as accurate, in scaled unknowns, as the symmetric system."""
    rng = np.random.default_rng(7)
    for _ in range(50):
        root = rng.normal(size=(6, 6))
        matrix, scale = root @ root.T, 10.0 ** rng.uniform(-8, 8, 6)
        system, exact = np.eye(6) + matrix * scale, rng.normal(size=6) / scale
        right = system @ exact
        solved = np.array(solve_lu(factorize_lu(system.tolist()), right.tolist()))
        residual = (system @ solved - right) / (np.abs(system) @ np.abs(solved) + np.abs(right))
        assert np.abs(residual).max() < 3e-15


@pytest.mark.parametrize("scene", ["planar", "paper", "tip-load", "six-joint", "reaction-wheels"])
def test_canonical_momenta_obey_the_given_equations_of_motion(scene):
    """With z(y) the canonical state, z_y y' = z': on the left stand the accelerations of other code."""
    field = ScenePrograms(sprung(scene, 7.0, 0.3)).field
    equations, rng = CanonicalCoordinates(field), np.random.default_rng(8)
    y, u = casadi.SX.sym("y", equations.n_y), casadi.SX.sym("u", field.n_u)
    entries = casadi.vertsplit(y), casadi.vertsplit(u)
    z, rates, z_by_y, rates_by_y = equations.linearized(*entries)
    given = casadi.vertcat(*equations.given.rates(*entries))
    outputs = [
        casadi.mtimes(z_by_y, given),
        casadi.vertcat(*rates),
        casadi.vertcat(*equations.rates(z, entries[1])),
    ]
    outputs += [casadi.vertcat(*equations.left(z)), rates_by_y - casadi.jacobian(casadi.vertcat(*rates), y)]
    values = rng.normal(size=equations.n_y) * 0.5, rng.normal(size=field.n_u)
    values[0][equations.given.rotation] *= 0.1  # power series serve rotations within a step
    carried, right, again, back, error = (
        np.array(each) for each in casadi.Function("f", [y, u], outputs).call(values)
    )
    np.testing.assert_allclose(carried, right, rtol=0, atol=1e-12)
    np.testing.assert_allclose(again, right, rtol=0, atol=2e-14)
    np.testing.assert_allclose(back[:, 0], values[0], rtol=0, atol=2e-14)
    assert np.abs(error).max() < 1e-14


# Finite deflections, beside the method of order 8 in steps that resolve them.


def off_rest(kernels, deflection=0.0, rate=0.0, joints=(1,)):
    """A slow motion, with some joints deflected from their rest or turning fast."""
    where, x = kernels.layout.state, kernels.layout.initial_state.copy()
    x[where.base_velocity] = [0.02, -0.01, 0.015, 0.01, 0.0, -0.01][: len(x[where.base_velocity])]
    x[where.joint_rates] = 0.05 * np.cos(np.arange(kernels.layout.n_joints))
    for j in joints:
        x[where.joint_angles.start + j] += deflection
        if rate:
            x[where.joint_rates.start + j] = rate
    return x


def checked(kernels, x, u, name, p=None, steps=20):
    """The end of some steps of 15 ms, and the largest of their errors in units of the tolerance."""
    errors = []
    for _ in range(steps):
        x, error = kernels.checked_step(x, u, integrator=name, p=p)
        errors.append(error)
    return x, np.max(errors)


CELLS = [  # stiffness, damping, deflection, rate, joints
    (1e4, 0.0, 0.1, 0.0, (1,)),
    (1e4, 0.0, 0.3, 0.0, (0, 1, 2)),
    (1e6, 0.0, 0.01, 0.0, (1,)),
    (1e6, 0.0, 0.1, 0.0, (1,)),
    (1e6, 700.0, 1.0, 0.0, (1,)),
    (1e6, 700.0, 0.1, 0.0, (0, 1, 2)),
    (1e8, 7e3, 0.1, 0.0, (1,)),
    (0.0, 1e4, 0.0, 1.0, (0, 2)),
]


@pytest.mark.sampled
@pytest.mark.parametrize("name", MOVED)
@pytest.mark.parametrize(
    ("scene", "stiffness", "damping", "deflection", "rate", "joints"),
    [
        *(("free-floating", *cell) for cell in CELLS),
        *(pytest.param("six-joint", *cell, marks=pytest.mark.slow) for cell in CELLS[::3]),
    ],
)
def test_steps_of_15_ms_are_right_at_finite_deflections(
    scene, stiffness, damping, deflection, rate, joints, name
):
    """Before, in velocities, both methods blew up in five of these cells."""
    kernels = variable(scene)
    x, u = off_rest(kernels, deflection, rate, joints), np.full(kernels.n_u, 0.02)
    is_sprung = np.isin(np.arange(kernels.n_p // 2), joints)
    p = springs(kernels, stiffness * is_sprung, damping * is_sprung)
    end, error = checked(kernels, x, u, name, p)
    finest = 4000 if scene == "free-floating" else 16000  # lighter links swing faster
    count = finest * int(np.sqrt(1.0 + stiffness / 1e4 + damping / 1e1))
    exact = kernels.simulate(x, u, count, 0.3 / count, "rk8", every=count, p=p)[-1]
    difference = np.abs(kernels.difference(exact, end))
    angles = slice(0, kernels.n_t - 6 - kernels.layout.n_joints)  # pose, joints and wrist
    assert error <= 1.0
    assert difference[angles].max() < 1e-3
    assert kernels.energy(end, p=p) == pytest.approx(kernels.energy(exact, p=p), rel=1e-3)
    if scene == "free-floating":  # without thrusters
        assert kernels.momentum(end) == pytest.approx(kernels.momentum(x), abs=1e-12)


@pytest.mark.sampled
@pytest.mark.parametrize("name", MOVED)
@pytest.mark.parametrize("damping", [1e6, 1e8])
@pytest.mark.parametrize("rate", [0.1, 1.0])
def test_a_moving_joint_that_meets_a_damper_stops_plastically(rate, damping, name):
    """The damper takes what a lock at that angle would: momentum stays, relative motion goes."""
    kernels = variable("free-floating", integrator=name, tolerance=1e-10)
    x, p = off_rest(kernels, rate=rate), springs(kernels, 0.0, np.array([0.0, damping, 0.0]))
    dt = 1e-4  # a thousand time constants, while the rest hardly moves
    end, error = kernels.checked_step(x, np.zeros(kernels.n_u), dt, name, p=p)
    where = kernels.layout.state
    assert error <= 1.0
    assert abs(end[where.joint_rates][1]) < 1e-6 + 10.0 / damping
    # M v+ = M v- but for the joint, whose impulse is that of the lock.
    mass = kernels.mass_matrix(x)
    free = [i for i in range(len(mass)) if i != len(mass) - 2]
    rates = np.concatenate([x[where.base_velocity], x[where.joint_rates]])
    after = np.linalg.solve(mass[np.ix_(free, free)], (mass @ rates)[free])
    turned = np.concatenate([end[where.base_velocity], end[where.joint_rates]])[free]
    np.testing.assert_allclose(turned, after, rtol=0, atol=5.0 * dt * rate + 20.0 / damping)


@pytest.mark.slow
@pytest.mark.parametrize("name", MOVED)
def test_a_vibration_beyond_the_budget_is_told(name):
    """Energy of 5e5 J: nothing is hidden, whether a state is found or not."""
    kernels = compile_scene(sprung("free-floating", 1e8, 0.0, (1,)))
    x = off_rest(kernels, 0.1)
    end, error = kernels.checked_step(x, np.zeros(kernels.n_u), integrator=name)
    assert not error <= 1.0
    assert np.isnan(error) == np.isnan(end).any()
    with pytest.raises(ValueError, match="'symplectic_euler' estimates no error; choose from rk4, rk6"):
        kernels.checked_step(x, np.zeros(kernels.n_u), integrator="symplectic_euler")


@pytest.mark.slow
@pytest.mark.parametrize("name", NAMES)
def test_a_smaller_tolerance_gives_a_smaller_error(name):
    x, ends = None, []
    for tolerance in (1e-4, 1e-6, 1e-8):
        kernels = compile_scene(sprung("free-floating", 1e4, 5.0, (1,), integrator=name, tolerance=tolerance))
        x = off_rest(kernels, 0.3)
        ends.append(checked(kernels, x, np.zeros(kernels.n_u), name)[0])
    exact = kernels.simulate(x, np.zeros(kernels.n_u), 20_000, 0.3 / 20_000, "rk8", every=20_000)[-1]
    errors = [np.abs(kernels.difference(exact, end)).max() for end in ends]
    assert errors[1] < errors[0] / 10.0
    assert errors[2] < errors[1] / 10.0
