"""Rosenbrock methods: stiff springs and dampers, the limit of locked joints, exact derivatives."""

import numpy as np
import pytest
from motions import exact_motion, moving_start, rollout, sprung
from scipy.integrate import solve_ivp

from dq_space_arm_env import compile_scene, load_scene
from dq_space_arm_env.compiler.program import Buffer, Program
from dq_space_arm_env.dynamics.linear import factorize_lu, solve_lu
from dq_space_arm_env.integrators import integrator_of
from dq_space_arm_env.integrators.rosenbrock_tableaus import RODAS4, RODAS5P
from dq_space_arm_env.kernels.programs.paper_programs import PaperPrograms
from dq_space_arm_env.scene import Actuators, InitialState, Spread

interpreter = pytest.importorskip("graph_interpreter")

NAMES = ("rodas4", pytest.param("rodas5p", marks=pytest.mark.slow))  # they share all but numbers
TABLEAUS = {"rodas4": RODAS4, "rodas5p": RODAS5P}
STEPS = 10_000
DT = 0.015


def still(kernels, steps=STEPS):
    return np.zeros((steps, kernels.n_u))


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
    assert abs(growth(-1e12)) < 1e-9
    errors = [abs(growth(z) - np.exp(z)) for z in (0.1, 0.2)]
    assert np.log2(errors[1] / errors[0]) > tableau.order + 0.8


@pytest.mark.parametrize(
    ("scene", "stiffness"), [("paper", 0.0), ("paper", 30.0), ("no-wrist", 5.0), ("tip-load", 0.0)]
)
@pytest.mark.parametrize("name", NAMES)
def test_errors_against_dop853_fall_with_the_order_of_the_method(name, scene, stiffness):
    kernels = compile_scene(sprung(scene, stiffness, 0.05 * stiffness))
    x = moving_start(kernels, joint_rate=0.8, base_rate=0.4)
    u = np.random.default_rng(1).uniform(-0.3, 0.3, kernels.n_u)
    exact = exact_motion(kernels, x, u, 1.2)
    counts = {"rodas4": (32, 64, 128), "rodas5p": (16, 32, 64)}[name]
    errors = []
    for steps in counts:
        final = rollout(kernels, x, np.tile(u, (steps, 1)), 1.2 / steps, name)[-1]
        errors.append(np.linalg.norm(kernels.difference(exact, final)))
    orders = np.log2(np.divide(errors[:-1], errors[1:]))
    assert orders == pytest.approx(TABLEAUS[name].order, abs=0.3)


@pytest.mark.parametrize("name", NAMES)
@pytest.mark.parametrize(
    ("stiffness", "damping", "bound"), [(1e2, 20.0, 2e-9), (1e4, 200.0, 2e-9), (1e6, 2000.0, 4e-9)]
)
def test_stiff_damped_joints_agree_with_radau(name, stiffness, damping, bound):
    """Steps of 15 ms, while rk4 needs some of 1 ms and less to be stable."""
    kernels = compile_scene(sprung(stiffness=stiffness, damping=damping))
    x = moving_start(kernels, joint_rate=0.0, base_rate=0.1)
    u = np.random.default_rng(1).uniform(-0.5, 0.5, kernels.n_u)
    exact = exact_motion(kernels, x, u, 0.6, "Radau", 1e-11)
    final = rollout(kernels, x, np.tile(u, (40, 1)), DT, name)[-1]
    assert np.linalg.norm(kernels.difference(exact, final)) < bound


@pytest.mark.parametrize("name", NAMES)
@pytest.mark.parametrize("scene", ["paper", "planar"])
@pytest.mark.parametrize("stiffness", [1e2, 1e4, 1e6, 1e8])
def test_stiff_springs_never_gain_energy_where_rk4_explodes(stiffness, scene, name):
    kernels = compile_scene(sprung(scene, stiffness))
    x = moving_start(kernels)
    states = rollout(kernels, x, still(kernels), DT, name)
    energy = kernels.energy(states)
    assert np.isfinite(states).all()
    assert energy.max() <= energy[0] * (1.0 + 1e-7)
    assert energy[-1] > 0.85 * energy[0]  # the base's motion stays; only vibrations may be damped
    # Momentum: small errors as long as the vibration lasts, none afterwards.
    momentum = kernels.momentum(states)
    assert np.abs(momentum - momentum[0]).max() < 2e-3 * np.linalg.norm(momentum[0])
    if stiffness >= 1e6:
        with np.errstate(all="ignore"):
            exploded = kernels.energy(rollout(kernels, x, still(kernels, 1000), DT, "rk4"))
        assert not exploded[-1] < 10.0 * energy[0]


@pytest.mark.parametrize("name", NAMES)
def test_soft_and_stiff_joints_get_along(name):
    scene = sprung()
    stiffness = (1e2, 1e5, 1e8)
    links = [link.model_dump() | {"stiffness": k} for link, k in zip(scene.links, stiffness, strict=True)]
    kernels = compile_scene(scene.replace(links=links))
    states = rollout(kernels, moving_start(kernels), still(kernels), DT, name)
    energy = kernels.energy(states)
    assert energy.max() <= energy[0] * (1.0 + 1e-9)
    # The soft joint still swings, the others are held.
    angles = states[-1000:, kernels.layout.state.joint_angles]
    assert np.ptp(angles[:, 0]) > 1e-3
    assert np.ptp(angles[:, 2]) < 1e-6


@pytest.mark.parametrize("name", NAMES)
@pytest.mark.parametrize("stiffness", [0.0, 1e6])
def test_dampers_of_a_million_stop_the_joints_and_nothing_else(stiffness, name):
    kernels = compile_scene(sprung(stiffness=stiffness, damping=1e6))
    x = moving_start(kernels)
    states = rollout(kernels, x, still(kernels), DT, name)
    assert np.abs(states[-1, kernels.layout.state.joint_rates]).max() < 1e-6
    energy = kernels.energy(states)
    assert energy.max() <= energy[0] * (1.0 + 1e-9)
    momentum = kernels.momentum(states)
    assert np.abs(momentum - momentum[0]).max() < 5e-3 * np.linalg.norm(momentum[0])


@pytest.mark.parametrize("name", NAMES)
def test_infinite_stiffness_is_a_locked_arm(name):
    """The base then moves as a rigid body with the arm's mass does: Euler's equations about its center."""
    end, errors = 3.0, []
    for stiffness in (1e3, 1e5, 1e7):
        kernels = compile_scene(sprung("free-floating", stiffness, 2.0 * stiffness**0.5))
        layout, x = kernels.layout.state, kernels.layout.initial_state.copy()
        x[layout.pose] = np.eye(8)[0]
        twists = np.tile(x, (3, 1))
        twists[:, layout.base_velocity][:, :3] = np.eye(3)
        inertia = kernels.momentum(twists)[:, 3:].T
        x[layout.base_velocity] = [0.3, -0.2, 0.4, 0.0, 0.0, 0.0]

        def euler(_, omega, inertia=inertia):
            return np.linalg.solve(inertia, np.cross(inertia @ omega, omega))

        exact = solve_ivp(euler, (0.0, end), [0.3, -0.2, 0.4], "DOP853", rtol=1e-12, atol=1e-12).y[:, -1]
        final = rollout(kernels, x, still(kernels, 200), DT, name)[-1]
        errors.append(np.linalg.norm(final[layout.base_velocity][:3] - exact))
    assert errors[2] < 1e-7
    # The arm bends by torque / stiffness.
    assert np.divide(errors[:-1], errors[1:]) == pytest.approx(100.0, rel=0.3)


@pytest.mark.parametrize("name", NAMES)
def test_linearization_of_stiff_steps_agrees_with_differences(name):
    kernels = compile_scene(sprung("planar", 1e6, 100.0))
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
            np.testing.assert_allclose(column, numeric, atol=1e-6 * max(1.0, np.abs(numeric).max()))


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
        assert np.abs(residual).max() < 1e-13


@pytest.mark.slow
def test_the_papers_formulation_takes_the_same_steps_with_exact_derivatives():
    """Its pose is among the entries of y, number by number, instead of moving by an exponential."""
    paper = load_scene("paper")
    link = paper.links[1].model_dump() | {"stiffness": 40.0, "damping": 1.0}
    bare = {"wrist": None, "initial_state": InitialState(), "spread": Spread()}
    scene = paper.replace(links=[link], actuators=Actuators(joint_torque={"limit": 1.0}), **bare)
    kernels, programs = compile_scene(scene), PaperPrograms(scene)
    rng = np.random.default_rng(9)
    x, u = kernels.layout.initial_state.copy(), rng.normal(size=kernels.n_u)
    x[kernels.layout.state.pose.stop :] = rng.normal(size=kernels.n_x - 8)

    def evaluated(program, dtype=np.float64, **inputs):
        return interpreter.evaluate_program(program, inputs, dtype)

    from_minimal, step = programs.build("from_minimal"), Program("step", [], [])
    method, field, h = integrator_of(programs.scene.simulation, "rodas5p"), programs.field, [0.002]
    step.inputs = [Buffer("x", field.n_x), Buffer("u", field.n_u), Buffer("h", 1)]
    method.append_step(step, field)
    start = evaluated(from_minimal, x=x)["y"]
    end = evaluated(from_minimal, x=kernels.step(x, u, dt=h[0], integrator="rodas5p"))["y"]
    np.testing.assert_allclose(evaluated(step, x=start, u=u, h=h)["x_next"], end, rtol=1e-11, atol=1e-11)

    linearize = Program("linearize", step.inputs, [])
    pattern, _ = method.append_linearization(linearize, field)
    a = np.zeros(pattern.shape)
    a[pattern.get_triplet()] = evaluated(linearize, x=start, u=u, h=h)["A"]
    lanes = start[:, None] + 1e-30j * np.eye(field.n_x)
    ends = evaluated(step, np.complex128, x=lanes, u=np.tile(u[:, None], field.n_x), h=h)["x_next"]
    expected = 1e30 * ends.imag
    np.testing.assert_allclose(a, expected, atol=1e-12 * np.abs(expected).max())
