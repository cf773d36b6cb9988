"""Rows, references, the function that hands payloads over, the script, and what of them can fail."""

import json
import math
from collections.abc import Sequence
from dataclasses import replace
from io import StringIO
from pathlib import Path

import numpy as np
import pytest
from rich.console import Console

from agents.command_line import main
from dq_space_arm_env import compile_scene, load_scene
from dq_space_arm_env.algebra import rotations
from dq_space_arm_env.dynamics.capture import Velocities, capture
from dq_space_arm_env.dynamics.chain import Chain, RigidBody
from dq_space_arm_env.environment import DQSpaceArmEnv
from dq_space_arm_env.integrators import INTEGRATORS
from dq_space_arm_env.integrators.rk4_stages import OFFSETS, WEIGHTS
from dq_space_arm_env.integrators.tableaus import (
    CALVO_6,
    DORMAND_PRINCE_5,
    DORMAND_PRINCE_8,
    ButcherTableau,
)
from dq_space_arm_env.kernels.capture import catch_payload

pytest.importorskip("mpmath")

from experts.report import to_json
from experts.report.command import INACCURATE, SUCCESS, UNUSABLE
from experts.report.stability import QUICK, Case, Row, Status, run_case
from experts.report.stability.formulations import FORMULATIONS, MINIMAL, Sample
from experts.report.stability.mass_properties import samples
from experts.report.stability.records import record
from experts.report.stability.references import accelerations, errors, linear_system
from experts.report.stability.rows import Handled, NotClaimed, Refused, refusal
from experts.report.stability.scenes import sprung_inertia, sprung_joint
from experts.report.stability.stiff_joints import LIMITS, STIFF_METHODS, rate_left, stiff_arm, swing
from experts.report.stability.tables import failures, print_rows, summary


def row_of(outcome: object, bound: float = 1.0) -> Row:
    def run(effort: object) -> object:
        if isinstance(outcome, Exception):
            raise outcome
        return outcome

    return run_case(Case("group", "name", "subject", "criterion", run, bound, "m"), QUICK)


@pytest.mark.parametrize(
    ("outcome", "status"),
    [
        (Handled(0.5), Status.HANDLED),
        (Handled(1.5), Status.FAILED),
        (Handled(math.nan), Status.FAILED),
        (Handled(math.inf), Status.FAILED),
        (Refused("no"), Status.REFUSED),
        (NotClaimed("too stiff"), Status.NOT_CLAIMED),
        (ZeroDivisionError("by zero"), Status.FAILED),
    ],
)
def test_a_row_is_never_missing_nor_has_it_a_nan(outcome: object, status: Status) -> None:
    row = row_of(outcome)
    assert row.status is status
    assert row.error is None or math.isfinite(row.error)
    assert row.sentence or status is Status.HANDLED


def test_an_exception_fails_with_its_sentence() -> None:
    assert row_of(ZeroDivisionError("by zero")).sentence == "ZeroDivisionError: by zero"


def test_points_of_a_curve_that_are_no_numbers_are_left_out() -> None:
    assert row_of(Handled(0.0, curve=((1.0, 2.0), (2.0, math.inf)))).curve == ((1.0, 2.0),)


def test_a_refusal_must_come_and_name_what_is_wrong() -> None:
    def refuse() -> None:
        raise ValueError("mass: -1, should be positive")

    assert refusal(refuse, naming="mass").sentence.startswith("mass")
    with pytest.raises(AssertionError, match="does not name 'inertia'"):
        refusal(refuse, naming="inertia")
    with pytest.raises(AssertionError, match="accepted"):
        refusal(lambda: 1, naming="mass")


@pytest.mark.parametrize("name", FORMULATIONS)
def test_kanes_equations_agree_with_every_formulation(name: str) -> None:
    for sample in samples(load_scene("paper"), 3):
        exact = accelerations(linear_system(sample.chain, sample.motion), sample.motion)
        found = FORMULATIONS[name](sample)
        tolerance = 1e-5 if "float32" in name else 1e-12
        assert np.abs(found - exact).max() < tolerance * np.abs(exact).max()


def test_a_wrong_acceleration_has_a_backward_error() -> None:
    """A relative error of 1e-6 in one acceleration cannot hide from the row-wise error (Oettli & Prager)."""
    (sample,) = samples(load_scene("paper"), 1)
    system, found = linear_system(sample.chain, sample.motion), FORMULATIONS[MINIMAL](sample)
    for entry in range(len(found)):
        wrong = found.copy()
        wrong[entry] *= 1.0 + 1e-6
        assert errors(system, sample.motion, wrong).by_row > 1e-9


def test_springs_and_dampers_are_in_the_reference() -> None:
    scene = sprung_joint(30.0, 0.7)
    spatial = scene.replace(base={**scene.base.model_dump(), "motion": "spatial"})
    sample = Sample.of(spatial, np.zeros(0), np.zeros(0))
    rng = np.random.default_rng(0)
    x = rng.normal(size=sample.kernels.n_x)
    sample = Sample.of(spatial, x, rng.normal(size=sample.kernels.n_u))
    found = errors(linear_system(sample.chain, sample.motion), sample.motion, FORMULATIONS[MINIMAL](sample))
    assert found.by_row < 1e-14


def test_inertia_of_the_sprung_joint_is_torque_over_acceleration() -> None:
    scene = sprung_joint(1e3)
    kernels = compile_scene(scene)
    x = kernels.layout.initial_state.copy()
    x[kernels.layout.state.joint_angles] = 1e-6
    acceleration = kernels.forward_dynamics(x, np.zeros(kernels.n_u))[-1]
    assert sprung_inertia(scene) == pytest.approx(-1e3 * 1e-6 / acceleration, rel=1e-9)


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
    assert first_above_one(np.abs(polynomial(1j * at)), at) == pytest.approx(LIMITS[name].spring, abs=1e-3)
    assert first_above_one(np.abs(polynomial(-at)), at) == pytest.approx(LIMITS[name].damper, abs=1e-3)


def test_limits_of_rk4_are_those_of_the_literature() -> None:
    """2 sqrt(2) and 2.785 (Hairer & Wanner II, IV.2)."""
    assert LIMITS["rk4"] == LIMITS["momentum_rk4"] == pytest.approx((2.0 * np.sqrt(2.0), 2.785), abs=1e-3)


def test_dormand_princes_own_limit_is_why_it_takes_shares_of_a_step() -> None:
    at = np.linspace(0.5, 10.0, 1_000_000)  # below, R is above 1 by rounding-like 1e-6 only
    polynomial = stability_polynomial(DORMAND_PRINCE_5)
    assert first_above_one(np.abs(polynomial(1j * at)) - 1e-5, at) < 1.1
    assert swing("dormand_prince", 1e4, 100.0).change < 0.01


def test_every_integrator_has_its_limits() -> None:
    assert set(LIMITS) == set(INTEGRATORS)
    assert set(STIFF_METHODS) == {"dormand_prince", "rodas4", "rodas5p", "momentum_rosenbrock"}


@pytest.mark.parametrize("name", [name for name in LIMITS if name not in STIFF_METHODS])
def test_a_method_is_stable_just_below_its_limits_and_not_above(name: str) -> None:
    """Each product stands for all: neither the spring's nor the damper's size matters."""
    limits = LIMITS[name]
    assert swing(name, 1e4, 0.995 * limits.spring).growth <= 1.0
    assert swing(name, 1e4, 1.01 * limits.spring).growth > 1.0
    assert rate_left(name, 1e4, 0.995 * limits.damper) < 1e-2
    assert rate_left(name, 1e4, 1.01 * limits.damper) > 1e2


@pytest.mark.parametrize("name", STIFF_METHODS)
def test_a_stiff_method_bounds_the_energy_at_100(name: str) -> None:
    """A free arm with a joint at dt times frequency = 100, and the vibration of that joint itself."""
    assert np.abs(stiff_arm(name, 100.0)).max() < 1e-6
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
    np.testing.assert_allclose(after, x, atol=1e-14)


def test_a_bullet_stops_in_a_single_body() -> None:
    """Without joints the plastic impact is that of textbooks: velocities weighted by the masses."""
    frame = Chain.from_scene(load_scene("payload"))
    unit = ((1.0, 0.0, 0.0), (0.0, 1.0, 0.0), (0.0, 0.0, 1.0))
    free = replace(
        frame, base=RigidBody(3.0, (0.0,) * 3, unit), links=(), tip=replace(frame.tip, position=(0.0,) * 3)
    )
    loaded = replace(
        free, base=RigidBody(4.0, (0.0,) * 3, ((2.0, 0.0, 0.0), (0.0, 2.0, 0.0), (0.0, 0.0, 2.0)))
    )
    bullet = RigidBody(1.0, (0.0,) * 3, unit)
    rest = Velocities((0.0,) * 3, (0.0,) * 3, ())
    after = capture(free, loaded, bullet, [], rest, (0.0, 0.0, 2.0, 4.0, 0.0, 0.0))
    np.testing.assert_allclose(after.linear, [1.0, 0.0, 0.0], atol=1e-16)
    np.testing.assert_allclose(after.angular, [0.0, 0.0, 1.0], atol=1e-16)


def test_catching_refuses_scenes_that_differ_in_more_than_the_payload() -> None:
    loaded = compile_scene("payload")
    with pytest.raises(ValueError, match="has no payload to be caught"):
        catch_payload(loaded, compile_scene("paper"), loaded.layout.initial_state, np.zeros(6))
    with pytest.raises(ValueError, match=r"without its payload: wrist, tip"):
        catch_payload(compile_scene("paper"), loaded, loaded.layout.initial_state, np.zeros(6))


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


def test_tables_and_record_show_every_row() -> None:
    rows = [row_of(Handled(0.5)), row_of(Handled(2.0)), row_of(Refused("two\nlines"))]
    assert summary(rows) == "3 cases: 1 handled, 1 refused, 0 not claimed, 1 failed."
    console = Console(width=160, file=StringIO(), highlight=False)
    print_rows(console, rows)
    assert isinstance(console.file, StringIO)
    page = console.file.getvalue()
    assert "two lines" in page
    assert "the error is above 1 m" in page
    assert failures(rows) == ["group: name, subject: the error is above 1 m."]
    found = json.loads(to_json(record(rows, QUICK)))
    assert [row["status"] for row in found["rows"]] == ["handled", "failed", "refused"]
    assert found["counts"] == {"handled": 1, "refused": 1, "not claimed": 0, "failed": 1}


def run(arguments: Sequence[str]) -> int:
    return main(["report", "stability", *arguments])


def test_script_writes_record_and_picture(tmp_path: Path) -> None:
    pytest.importorskip("matplotlib")
    assert run(["--group", "stiff joints", "--out", str(tmp_path)]) == SUCCESS
    found = json.loads((tmp_path / "stability.json").read_text(encoding="utf-8"))
    assert {row["group"] for row in found["rows"]} == {"stiff joints"}
    assert found["counts"]["failed"] == 0
    assert found["machine"]["processor_name"]
    assert (tmp_path / "stability.png").read_bytes().startswith(b"\x89PNG")


def test_script_fails_with_a_case(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    import experts.report.stability as package

    monkeypatch.setattr(package, "run_cases", lambda *_: [row_of(Handled(2.0))])
    assert run(["--no-picture", "--out", str(tmp_path)]) == INACCURATE
    assert not (tmp_path / "stability.png").exists()


def test_script_refuses_an_unknown_group(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert run(["--group", "mass", "--out", str(tmp_path / "out")]) == UNUSABLE
    assert "there are masses" in capsys.readouterr().err
