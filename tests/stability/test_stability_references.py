"""Oracles of the stability cases: Kane's equations, stability polynomials, plastic impacts."""

from dataclasses import replace

import numpy as np
import pytest

from dq_space_arm_env import compile_scene, load_scene
from dq_space_arm_env.algebra import rotations
from dq_space_arm_env.dynamics.kinematic_tree import KinematicTree, RigidBody
from dq_space_arm_env.environment import DQSpaceArmEnv
from dq_space_arm_env.integrators.tableaus import CALVO_6, DORMAND_PRINCE_5, DORMAND_PRINCE_8, ButcherTableau
from dq_space_arm_env.integrators.tableaus import RK4_OFFSETS as OFFSETS
from dq_space_arm_env.integrators.tableaus import RK4_WEIGHTS as WEIGHTS
from dq_space_arm_env.kernels.capture import Velocities, capture, catch_payload
from dq_space_arm_env.scene import INTEGRATORS

pytest.importorskip("mpmath")

from scripts.benchmarks.stability.masses import samples
from scripts.benchmarks.stability.references import (
    FORMULATIONS,
    MINIMAL,
    Sample,
    accelerations,
    errors,
    linear_system,
)
from scripts.benchmarks.stability.scenes import sprung_inertia, sprung_joint
from scripts.benchmarks.stability.stiff_joints import STIFF_METHODS, rate_left, stiff_arm, swing


@pytest.mark.parametrize("name", FORMULATIONS)
def test_kanes_equations_agree_with_every_formulation(name: str) -> None:
    for sample in samples(load_scene("paper"), 3):
        exact = accelerations(linear_system(sample.tree, sample.motion), sample.motion)
        found = FORMULATIONS[name](sample)
        tolerance = 1e-5 if "float32" in name else 1e-12
        assert np.abs(found - exact).max() < tolerance * np.abs(exact).max()


def test_a_wrong_acceleration_has_a_backward_error() -> None:
    """A relative error of 1e-6 in one acceleration cannot hide from the row-wise error (Oettli & Prager)."""
    (sample,) = samples(load_scene("paper"), 1)
    system, found = linear_system(sample.tree, sample.motion), FORMULATIONS[MINIMAL](sample)
    for entry in range(len(found)):
        wrong = found.copy()
        wrong[entry] *= 1.0 + 1e-6
        assert errors(system, sample.motion, wrong).by_row > 1e-9


def test_springs_and_dampers_are_in_the_reference() -> None:
    scene = sprung_joint(30.0, 0.7)
    spatial = scene.replace(base={"motion": "spatial"})
    sample = Sample.of(spatial, np.zeros(0), np.zeros(0))
    rng = np.random.default_rng(0)
    x = rng.normal(size=sample.kernels.n_x)
    sample = Sample.of(spatial, x, rng.normal(size=sample.kernels.n_u))
    found = errors(linear_system(sample.tree, sample.motion), sample.motion, FORMULATIONS[MINIMAL](sample))
    assert found.by_row < 1e-15


def test_inertia_of_the_sprung_joint_is_torque_over_acceleration() -> None:
    scene = sprung_joint(1e3)
    kernels = compile_scene(scene)
    x = kernels.layout.initial_state.copy()
    x[kernels.layout.state.joint_angles] = 1e-6
    acceleration = kernels.forward_dynamics(x, np.zeros(kernels.n_u))[-1]
    assert sprung_inertia(scene) == pytest.approx(-1e3 * 1e-6 / acceleration, rel=2e-12)


TABLEAUS = {
    "rk4": ButcherTableau(
        4, tuple((0.0,) * (i - 1) + (a,) * (i > 0) for i, a in enumerate(OFFSETS)), WEIGHTS
    ),
    "rk6": CALVO_6,
    "rk8": DORMAND_PRINCE_8,
}


def stability_polynomial(tableau: ButcherTableau) -> np.polynomial.Polynomial:
    """R(z) = 1 + z b'(1 - z A)^-1 1 (Hairer & Wanner II, IV.2), by powers of the nilpotent A."""
    count = len(tableau.weights)
    a, b, powers, coefficients = np.zeros((count, count)), np.array(tableau.weights), np.ones(count), [1.0]
    for i, row in enumerate(tableau.stages):
        a[i, : len(row)] = row
    for _ in range(count):
        coefficients.append(b @ powers)
        powers = a @ powers
    return np.polynomial.Polynomial(coefficients)


def first_above_one(growth: np.ndarray, at: np.ndarray) -> float:
    return float(at[np.argmax(growth > 1.0 + 1e-9)])


@pytest.mark.parametrize("name", TABLEAUS)
def test_limits_are_those_of_the_stability_polynomials(name: str) -> None:
    """|R| <= 1 on the imaginary axis for springs, on the negative real one for dampers."""
    polynomial, at = stability_polynomial(TABLEAUS[name]), np.linspace(1e-3, 10.0, 1_000_000)
    spring, damper = (first_above_one(np.abs(polynomial(z)), at) for z in (1j * at, -at))
    assert spring == pytest.approx(INTEGRATORS[name].imaginary_interval, abs=1e-3)
    assert damper == pytest.approx(INTEGRATORS[name].real_interval, abs=1e-3)


def test_limits_of_rk4_are_those_of_the_literature() -> None:
    """2 sqrt(2) and 2.785 (Hairer & Wanner II, IV.2)."""
    for name in ("rk4", "momentum_rk4"):
        assert INTEGRATORS[name].imaginary_interval == pytest.approx(2.0 * np.sqrt(2.0), abs=1e-3)
        assert INTEGRATORS[name].real_interval == pytest.approx(2.785, abs=1e-3)


def test_dormand_princes_own_limit_is_why_it_takes_shares_of_a_step() -> None:
    at = np.linspace(0.5, 10.0, 1_000_000)  # below, R is above 1 by rounding-like 1e-6 only
    polynomial = stability_polynomial(DORMAND_PRINCE_5)
    assert first_above_one(np.abs(polynomial(1j * at)) - 1e-5, at) < 1.1
    assert swing("dormand_prince", 1e4, 100.0).change < 0.01


@pytest.mark.parametrize("name", [name for name in INTEGRATORS if name not in STIFF_METHODS])
def test_a_method_is_stable_just_below_its_limits_and_not_above(name: str) -> None:
    """Each product stands for all: neither the spring's nor the damper's size matters."""
    entry = INTEGRATORS[name]
    assert swing(name, 1e4, 0.995 * entry.imaginary_interval).growth <= 1.0
    assert swing(name, 1e4, 1.01 * entry.imaginary_interval).growth > 1.0
    assert rate_left(name, 1e4, 0.995 * entry.real_interval) < 1e-7
    assert rate_left(name, 1e4, 1.01 * entry.real_interval) > 1e2


@pytest.mark.parametrize("name", STIFF_METHODS)
def test_a_stiff_method_bounds_the_energy_at_100(name: str) -> None:
    """A free arm with a joint at dt times frequency = 100, and the vibration of that joint itself."""
    assert np.abs(stiff_arm(name, 100.0)).max() < 1e-9
    energy = swing(name, 1e5, 100.0)
    assert energy.growth <= 0.0
    assert energy.change <= 1.0 + 1e-9


def test_an_explicit_method_does_not() -> None:
    assert not np.abs(stiff_arm("rk4", 100.0)).max() < 1e3


def test_a_caught_payload_at_rest_relative_to_the_tip_changes_nothing() -> None:
    loaded_scene = load_scene("payload")
    free, loaded = compile_scene(loaded_scene.replace(payload=None)), compile_scene(loaded_scene)
    x = free.layout.initial_state.copy()
    x[free.layout.state.linear_velocity] = [0.3, -0.2, 0.1]
    tip = free.tip_pose(x)
    # All move with the same velocity: that of the base, which the payload sees in the tip's axes.
    base_pose = x[free.layout.state.pose]
    inertial = rotations.rotate(tuple(base_pose[:4].tolist()), (0.3, -0.2, 0.1))
    w, *vector = tip[:4].tolist()
    seen = rotations.rotate((w, *(-entry for entry in vector)), inertial)
    after = catch_payload(free, loaded, x, [0.0, 0.0, 0.0, *seen])
    np.testing.assert_allclose(after, x, rtol=0, atol=1e-14)


def test_a_bullet_stops_in_a_single_body() -> None:
    """Without joints the plastic impact is that of textbooks: velocities weighted by the masses."""
    frame = KinematicTree.from_scene(load_scene("payload"))
    unit = ((1.0, 0.0, 0.0), (0.0, 1.0, 0.0), (0.0, 0.0, 1.0))
    tip = replace(frame.tip, position=(0.0,) * 3)
    free = replace(frame, base=RigidBody(3.0, (0.0,) * 3, unit), links=(), tip_body=0, tip=tip)
    double = ((2.0, 0.0, 0.0), (0.0, 2.0, 0.0), (0.0, 0.0, 2.0))
    loaded = replace(free, base=RigidBody(4.0, (0.0,) * 3, double))
    bullet = RigidBody(1.0, (0.0,) * 3, unit)
    rest = Velocities((0.0,) * 3, (0.0,) * 3, ())
    after = capture(free, loaded, bullet, [], rest, (0.0, 0.0, 2.0, 4.0, 0.0, 0.0))
    np.testing.assert_allclose(after.linear, [1.0, 0.0, 0.0], rtol=0, atol=1e-16)
    np.testing.assert_allclose(after.angular, [0.0, 0.0, 1.0], rtol=0, atol=1e-16)


def test_catching_refuses_scenes_that_differ_in_more_than_the_payload() -> None:
    loaded = compile_scene("payload")
    with pytest.raises(ValueError, match="has no payload to be caught"):
        catch_payload(loaded, compile_scene("paper"), loaded.layout.initial_state, np.zeros(6))
    with pytest.raises(ValueError, match=r"without its payload: wrist, tip"):
        catch_payload(compile_scene("paper"), loaded, loaded.layout.initial_state, np.zeros(6))
    free = compile_scene(loaded.scene.replace({"payload": None, "tip_link": "link 1"}))
    with pytest.raises(ValueError, match=r"without its payload: tip_body"):
        catch_payload(free, loaded, loaded.layout.initial_state, np.zeros(6))


def test_a_state_at_the_limit_of_the_environment_is_accepted() -> None:
    env = DQSpaceArmEnv("paper")
    x = env.kernels.layout.initial_state.copy()
    x[4:8] = [0.0, 2e5, 2e5, 2e5]
    x[:4] = [1.0, 0.0, 0.0, 0.0]
    observation, _ = env.reset(options={"initial_state": x})
    assert env.observation_space.contains(observation)
    assert not env.step(np.zeros(env.kernels.n_u))[4]["diverged"]
    with pytest.raises(ValueError, match=r"initial_state has a norm of 6.93e\+05, should be at most 500000"):
        env.reset(options={"initial_state": np.where(np.arange(len(x)) < 4, x, 2.0 * x)})
