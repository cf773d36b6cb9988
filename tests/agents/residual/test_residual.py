"""Corrections of plans: without one the plan flies, with one it is bounded, and what is learned is kept."""

import json
import shlex
from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest

from agents.command_line.compare import residual
from agents.configuration import ConfigurationError, load_configuration
from agents.configuration.schema import Mismatch
from agents.evaluation.comparison_tables import mismatch_table, notes, record
from agents.evaluation.plan_followers import FEEDBACK, OPEN_LOOP, RECEDING, RecedingHorizon, follower
from agents.evaluation.plans import Followed, Plans
from agents.policies import ExportedPolicy
from agents.residual.corrections import (
    SMALL,
    CorrectionObserver,
    corrected,
    correcting,
    correction,
    correction_settings,
)
from agents.residual.mismatch import Condition, Worlds, fly_mismatched
from agents.residual.mismatch_comparison import (
    compare_under_mismatch,
    evaluation_plans,
    read_corrections,
    typical_seconds,
)
from dq_space_arm_env import DQSpaceArmVectorEnv, compile_scene, load_scene
from dq_space_arm_env.command_line import main
from dq_space_arm_env.common.console import UNUSABLE
from dq_space_arm_env.environment.rollouts import rollout
from experts.demonstrations import DemonstrationsError
from experts.demonstrations.shard import draw_starts

pytestmark = pytest.mark.slow

HEAVY = 1.3
"""A factor of masses."""
CALM = Worlds(1.0, 0.0, 0.0, 6.0, seed=0)
ROUGH = Worlds(HEAVY, 0.01, 0.02, 6.0, seed=3)
SETTINGS = {"repeat": 10, "memory": 0.5, "full_authority": 0.1}


@pytest.fixture(scope="module")
def plans(demonstrations):
    return Plans.of(demonstrations)


def test_steps_after_an_early_end_are_no_actions():
    seconds = np.r_[np.full(90, 2e-6), np.zeros(910)]
    assert typical_seconds(SimpleNamespace(action_seconds=seconds, length=np.array([90]))) == 2e-6


def test_no_demonstrations_make_no_plans(demonstrations):
    with pytest.raises(DemonstrationsError, match="has no demonstration to fly"):
        Plans.of(demonstrations[:0])


def constant(scene, value=0.0):
    """A policy that always gives the same correction."""
    kernels = compile_scene(scene)
    size = CorrectionObserver.size(kernels)
    weights, biases = (np.zeros((size, kernels.n_u)),), (np.full(kernels.n_u, value),)
    settings = SETTINGS | {"action_scale": [0.1] * kernels.n_u}
    metadata = {"scene": scene.name, "residual": settings}
    return ExportedPolicy(weights, biases, "tanh", np.zeros(size), np.ones(size), metadata=metadata)


def test_as_planned_plans_fly_as_in_the_environment(small_scene, demonstrations, plans):
    """With and without gains, the costs are those of the demonstrations, minus the sum of rewards."""
    for feedback in (False, True):
        controller = follower(small_scene, plans, feedback=feedback)
        flown = fly_mismatched(controller, small_scene, plans, CALM)
        np.testing.assert_allclose(flown.cost, demonstrations.column("cost"), rtol=1e-9)
        final = demonstrations.column("final_errors")
        errors = np.stack([flown.attitude_error, flown.position_error], axis=1)
        np.testing.assert_allclose(errors, final, rtol=1e-6, atol=1e-9)
        assert flown.is_success.all()


def fly_with_gains(scene, plans, worlds):
    return fly_mismatched(follower(scene, plans, feedback=True), scene, plans, worlds)


def test_feedback_is_that_of_the_demonstrations(small_scene, demonstrations, plans):
    kernels, stage = compile_scene(small_scene), 40
    rng = np.random.default_rng(0)
    measured = kernels.retract(plans.states[:, stage], 0.05 * rng.standard_normal((len(plans), kernels.n_t)))
    followed = plans.follow(kernels, stage, measured)
    for i, demonstration in enumerate(demonstrations):
        deviation = demonstrations.tangent(demonstration.states[stage], measured[i])
        wanted = demonstration.actions[stage] + demonstration.feedback_gains[stage] @ deviation
        np.testing.assert_allclose(followed.action[i], np.clip(wanted, -1.0, 1.0), rtol=0, atol=1e-12)


def test_no_correction_leaves_the_plan_with_its_gains(small_scene, plans):
    alone = fly_with_gains(small_scene, plans, ROUGH)
    nothing, something = (
        correction(constant(small_scene, value), small_scene, plans) for value in (0.0, 0.02)
    )
    with_nothing = fly_mismatched(nothing, small_scene, plans, ROUGH)
    with_something = fly_mismatched(something, small_scene, plans, ROUGH)
    np.testing.assert_array_equal(with_nothing.cost, alone.cost)
    assert (np.abs(with_something.cost / alone.cost - 1.0) > 1e-4).all()


def test_corrections_are_bounded_and_sums_within_the_limits():
    scale = np.array([0.1, 0.5])
    action = np.array([[0.0, 0.0], [0.95, -0.8]])
    many = corrected(action, np.array([[7.0, -0.2], [0.3, -0.9]]), scale)
    np.testing.assert_allclose(many, [[0.1, -0.2], [1.0, -1.0]])


def test_corrections_of_thrusters_begin_where_these_do():
    """A thruster does not pull: what feedback asks for below zero takes nothing from a correction."""
    scene = load_scene("thrusters")
    kernels, stage = compile_scene(scene), 3
    layout, steps = kernels.layout, scene.simulation.steps
    gains = np.zeros((1, steps, kernels.n_u, kernels.n_t), dtype=np.float32)
    gains[..., -1] = -1.0
    states = np.tile(layout.initial_state, (1, steps + 1, 1))
    plans = Plans(
        states, np.zeros((1, steps, kernels.n_u)), gains, np.zeros((1, kernels.n_p)), np.zeros(1, int)
    )
    measured = kernels.retract(states[:, stage], 0.3 * np.eye(kernels.n_t)[-1:])
    action = plans.follow(kernels, stage, measured).action[0]
    expected = np.where(np.arange(kernels.n_u) < layout.control.thruster_force.start, -0.3, 0.0)
    np.testing.assert_allclose(action, expected, rtol=0, atol=1e-12)


def test_corrections_are_held(small_scene, plans):
    asked = []

    def policy(seen):
        asked.append(seen)
        return np.zeros((len(seen), kernels.n_u))

    kernels = compile_scene(small_scene)
    settings = SETTINGS | {"action_scale": np.ones(kernels.n_u), "repeat": 40}
    fly_mismatched(correcting(small_scene, plans, policy, **settings), small_scene, plans, CALM)
    assert len(asked) == 4  # of 150 steps
    assert asked[0].shape == (len(plans), CorrectionObserver.size(kernels))
    np.testing.assert_allclose([seen[0, kernels.n_x] for seen in asked], [15, 11, 7, 3])


def test_deviations_are_averaged_over_the_memory(small_scene, plans):
    kernels = compile_scene(small_scene)
    observer = CorrectionObserver(small_scene, memory=0.5, full_authority=0.1)  # five steps
    offset = np.full((len(plans), kernels.n_t), 0.01)
    begin = kernels.n_x + 1 + kernels.n_t
    averages = []
    for stage in range(3):
        measured = kernels.retract(plans.states[:, stage], offset)
        seen = observer(stage, measured, plans.follow(kernels, stage, measured))
        averages.append(SMALL * np.sinh(seen[:, begin : begin + kernels.n_t]))
    for steps, average in enumerate(averages, start=1):
        np.testing.assert_allclose(average, 0.01 * (1.0 - 0.8**steps), rtol=1e-5)


def test_corrections_count_the_more_the_farther_a_flight_is_from_its_plan(small_scene, plans):
    kernels = compile_scene(small_scene)
    observer = CorrectionObserver(small_scene, memory=0.1, full_authority=0.2)  # one step: no memory
    sizes = np.linspace(0.0, 0.4, len(plans))
    offset = np.zeros((len(plans), kernels.n_t))
    offset[:, -1] = sizes
    measured = kernels.retract(plans.states[:, 0], offset)
    observer(0, measured, plans.follow(kernels, 0, measured))
    np.testing.assert_allclose(observer.authority()[:, 0], np.minimum(1.0, sizes / 0.2), rtol=0, atol=1e-9)


def write_correction(folder, scene, value=0.02):
    """The folder of a training run with a constant correction."""
    folder.mkdir(parents=True)
    constant(scene, value).save(folder / "policy.npz")
    return folder


PLANNED, TESTED = Condition("as-planned"), Condition("heavy-noise-pushes", HEAVY, 0.01, 0.02)
RUN, FEW = "stub-0", 3


@pytest.fixture(scope="module")
def comparison(small_scene, demonstrations, tmp_path_factory):
    run = write_correction(tmp_path_factory.mktemp("runs") / RUN, small_scene)
    conditions = [PLANNED, Condition("heavy", HEAVY), TESTED]
    return compare_under_mismatch([run], demonstrations, conditions=conditions, receding_starts=FEW)


def row_of(comparison, condition, name):
    (row,) = (row for row in comparison.under(condition) if row.name == name)
    return row


def test_controllers_are_compared_start_by_start(comparison, demonstrations):
    gains = row_of(comparison, "as-planned", FEEDBACK).evaluation
    assert gains.median_cost_gap.value == pytest.approx(0.0, abs=1e-9)
    assert gains.success_rate.value == 1.0
    # There is nothing to correct.
    assert row_of(comparison, "as-planned", RUN).facts["saving"][0] == pytest.approx(0.0, abs=1e-9)
    assert row_of(comparison, "as-planned", RECEDING).evaluation.median_cost_gap.value < 1e-3
    # No controller beats the one that knows; a bound as long as it has found the best maneuver.
    for name in (FEEDBACK, RUN, RECEDING):
        assert (row_of(comparison, "heavy", name).evaluation.cost_gaps > -1e-6).all()
    assert row_of(comparison, "heavy", FEEDBACK).evaluation.median_cost_gap.value < 0.1
    assert all(row.evaluation.action_seconds > 0.0 for row in comparison.rows)


def test_savings_are_of_the_starts_that_both_have_flown(comparison, demonstrations):
    base, receding = (row_of(comparison, TESTED.name, name) for name in (FEEDBACK, RECEDING))
    cost, base_cost = receding.evaluation.flights.cost, base.evaluation.flights.cost
    assert (len(base_cost), len(cost)) == (len(demonstrations), FEW)
    expected = 1.0 - np.prod(cost / base_cost[:FEW]) ** (1.0 / FEW)
    assert receding.facts["saving"][0] == pytest.approx(expected)
    assert base.facts["saving"] is None


def test_what_a_flight_meets_does_not_depend_on_how_many_fly(small_scene, plans):
    all_worlds = Worlds(np.full(len(plans), 1.0), 0.01, 0.02, 6.0, seed=3)
    everyone = fly_with_gains(small_scene, plans, all_worlds)
    few = fly_with_gains(small_scene, plans.choose(np.arange(FEW)), all_worlds)
    np.testing.assert_allclose(few.cost, everyone.cost[:FEW], rtol=1e-12)


def test_finished_rows_are_taken_up(small_scene, demonstrations, tmp_path, monkeypatch):
    run = write_correction(tmp_path / RUN, small_scene)
    arguments = {"conditions": [PLANNED, TESTED], "out": tmp_path / "out"}
    few = demonstrations[:4]
    first = compare_under_mismatch([run], few, **arguments)
    names = sorted(path.name for path in (tmp_path / "out" / "rows").iterdir())
    assert len(names) == 6
    assert "stub-0-as-planned.json" in names

    def refuse(*arguments, **options):
        raise AssertionError("flown again")

    monkeypatch.setattr("agents.residual.mismatch_comparison.fly_mismatched", refuse)
    monkeypatch.setattr("agents.residual.informed.BoxDDP", refuse)
    again = compare_under_mismatch([run], few, **arguments)
    assert json.dumps(record(again)) == json.dumps(record(first))
    twice = compare_under_mismatch([run], few, **arguments | {"conditions": [PLANNED, TESTED, PLANNED]})
    assert len(twice.rows) == len(first.rows)
    other = write_correction(tmp_path / "other" / RUN, small_scene, 0.01)
    changed = (
        ([run], few, {"seed": 1}),
        ([run], few, {"conditions": [PLANNED._replace(noise=0.001)]}),
        ([run], demonstrations[:3], {}),
        ([other], few, {}),
    )
    for policies, starts, changes in changed:
        with pytest.raises(AssertionError, match="flown again"):
            compare_under_mismatch(policies, starts, **arguments | changes)
    (tmp_path / "out" / "rows" / "stub-0-as-planned.json").write_text("{")
    with pytest.raises(AssertionError, match="flown again"):
        compare_under_mismatch([run], few, **arguments)


def test_rows_that_were_interrupted_go_on(small_scene, demonstrations, tmp_path):
    def interrupt(advance):
        if advance.stage == f"as-planned: {FEEDBACK}":
            raise KeyboardInterrupt

    arguments = {"conditions": [PLANNED], "out": tmp_path}
    with pytest.raises(KeyboardInterrupt):
        compare_under_mismatch([], demonstrations[:4], progress=interrupt, **arguments)
    stages = []
    compare_under_mismatch([], demonstrations[:4], progress=lambda a: stages.append(a.stage), **arguments)
    assert set(stages) == {f"as-planned: {FEEDBACK}"}


def test_plans_stay_in_the_folder_whatever_the_name_of_the_scene(small_scene, tmp_path, monkeypatch):
    made = []
    monkeypatch.setattr(
        "agents.residual.mismatch_comparison.generate_demonstrations",
        lambda scene, n, out, *settings, **options: made.append(out) or ["plan"],
    )
    evaluation_plans(small_scene.replace(name="a/../../b"), tmp_path, 2)
    evaluation_plans(small_scene, tmp_path, 2)
    assert made == [tmp_path / "plans-a-..-..-b-2-0.7", tmp_path / "plans-small-2-0.7"]


def test_the_table_says_what_it_shows(comparison):
    table = mismatch_table(comparison)
    assert [row[1] for row in table.rows[:4]] == [OPEN_LOOP, FEEDBACK, RUN, RECEDING]
    assert [row[2] for row in table.rows[:4]] == ["24", "24", "24", "3"]
    assert any("flies the first 3 starts" in sentence for sentence in notes(comparison))
    row = json.loads(json.dumps(record(comparison), allow_nan=False))["rows"][-1]
    assert (row["condition"], row["controller"]) == (TESTED._asdict(), RECEDING)


def test_the_command_writes_table_record_and_picture(small_scene, small_file, tmp_path, capsys, monkeypatch):
    pytest.importorskip("matplotlib")
    run, out = write_correction(tmp_path / RUN, small_scene), tmp_path / "out"
    arguments = ["compare", "residual", str(run), "--scene", str(small_file), "-n", "3"]
    arguments += ["--condition", "as-planned", "small-pushes", "--tolerance-scale", "1", "--workers", "1"]
    arguments += ["--out", str(out)]
    assert main(arguments) == 0
    (command,) = [line for line in capsys.readouterr().out.splitlines() if "dq-space-arm" in line]
    again = residual.make_context("test", shlex.split(command)[3:]).params
    assert (again["policies"], again["n"]) == ((str(run),), 3)
    assert again["conditions"] == ("as-planned", "small-pushes")
    files = {"rows", "table.md", "comparison.json", "comparison.png"}
    assert {path.name for path in out.iterdir()} == files | {"plans-small-3-1"}
    assert (out / "comparison.png").read_bytes()[:4] == b"\x89PNG"
    content = json.loads((out / "comparison.json").read_text())
    assert [row["controller"] for row in content["rows"][:3]] == [OPEN_LOOP, FEEDBACK, RUN]
    assert "versions" in content

    def interrupt(*arguments, **options):
        raise KeyboardInterrupt

    monkeypatch.setattr("agents.residual.mismatch_comparison.compare_under_mismatch", interrupt)
    assert main(arguments) == 130
    assert "finished rows are kept" in capsys.readouterr().err


def test_the_command_refuses_before_it_plans(small_scene, tmp_path, capsys):
    out = ["--out", str(tmp_path / "out")]
    assert main(["compare", "residual", str(tmp_path / "nothing.npz"), *out]) == 2
    assert "there is no such file or folder" in capsys.readouterr().err
    run = write_correction(tmp_path / RUN, small_scene)
    assert main(["compare", "residual", str(run), *out]) == 2
    assert "corrects scene 'small'" in capsys.readouterr().err
    assert not (tmp_path / "out").exists()
    assert list(read_corrections([run, run / "policy.npz"], small_scene)) == [f"{RUN} (1)", f"{RUN} (2)"]


def test_the_receding_horizon_plans_every_flight_and_pays_no_more_than_the_plan(small_scene, plans):
    """Where the tolerances bind, its plans keep a share of them free, which costs a little."""
    few = plans.choose([3, 5])
    replanned = fly_mismatched(RecedingHorizon(small_scene, 20).policy(), small_scene, few, CALM)
    planned = fly_with_gains(small_scene, few, CALM)
    assert (replanned.cost < planned.cost * (1.0 + 1e-3)).all()
    assert (replanned.cost > 0.9 * planned.cost).all()


@pytest.fixture(scope="module")
def drawing(small_scene):
    """A scene whose episodes differ in target and masses, and what the first three of them draw."""
    scene = small_scene.replace(spread={"target_position": 0.3, "link_masses": 0.3})
    return scene, draw_starts(scene, [0, 1, 2]).parameters


def test_corrections_see_the_target_of_each_plan(drawing):
    scene, drawn = drawing
    environment = DQSpaceArmVectorEnv(len(drawn), scene)
    expected, _ = environment.reset(seed=[0, 1, 2])
    kernels = environment.kernels
    still = Followed(np.zeros((len(drawn), kernels.n_u)), np.zeros((len(drawn), kernels.n_t)))
    observer = CorrectionObserver(scene, memory=0.5, full_authority=0.1)
    observer.reset(drawn)
    seen = observer(0, environment.states, still)
    np.testing.assert_allclose(seen[:, : kernels.n_x + 1], expected, rtol=1e-6, atol=1e-6)


def test_corrections_see_the_target_of_each_phase(small_scene):
    changed = {"target.pose.position": [1.0, 0.5, 0.0]}
    phases = [{"name": "there", "steps": 1}, {"name": "back", "steps": 149, "changes": changed}]
    scene = small_scene.replace(phases=phases)
    environment = DQSpaceArmVectorEnv(2, scene)
    expected, _ = environment.reset(seed=[0, 1])
    kernels = environment.kernels
    still = Followed(np.zeros((2, kernels.n_u)), np.zeros((2, kernels.n_t)))
    observer = CorrectionObserver(scene, memory=0.5, full_authority=0.1)
    observer.reset(environment.parameters)
    for stage in range(3):
        seen = observer(stage, environment.states, still)
        np.testing.assert_allclose(seen[:, : expected.shape[1]], expected, rtol=1e-6, atol=1e-6)
        expected = environment.step(still.action)[0]


def test_starts_of_the_receding_horizon_are_checked_before_planning(tmp_path, capsys):
    assert (
        main(["compare", "residual", "--receding-starts", "-1", "--out", str(tmp_path / "out")]) == UNUSABLE
    )
    assert "receding_starts: -1, should be at least 0" in capsys.readouterr().err
    assert not (tmp_path / "out").exists()


def test_the_receding_horizon_plans_with_what_it_is_told(drawing):
    scene, drawn = drawing
    expert = RecedingHorizon(scene, 20)
    told, untold = (rollout(expert.policy(known), scene, [0, 1, 2]) for known in (drawn, None))
    np.testing.assert_array_equal(told.parameters, drawn)
    assert told.is_success.all()
    assert (told.position_error < untold.position_error).all()


def test_a_policy_that_does_not_fit_is_refused(small_scene):
    plain = ExportedPolicy((np.zeros((3, 2)),), (np.zeros(2),), "tanh", np.zeros(3), np.ones(3))
    with pytest.raises(ValueError, match="chooses actions rather than corrections"):
        correction_settings(plain, small_scene)
    message = r"policy: corrects scene 'small', with .* scene 'paper' has 78 and 12"
    with pytest.raises(ValueError, match=message):
        correction_settings(constant(small_scene), load_scene("paper"))


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        (None, r"residual: \[\], should be a mapping of action_scale, full_authority, memory, repeat"),
        ({"more": 1}, "residual: .* should be a mapping of"),
        ({"repeat": 0}, "residual.repeat: 0, should be a whole number, at least 1"),
        ({"repeat": "10"}, "residual.repeat: '10', should be a whole number"),
        ({"memory": 0.0}, "residual.memory: 0.0, should be positive"),
        ({"full_authority": float("nan")}, "residual.full_authority: nan, should be positive"),
        ({"action_scale": [0.1]}, "residual.action_scale: .*0.1.*, should be 6 numbers from 0 to 1"),
        ({"action_scale": [0.1] * 5 + ["a"]}, "should be 6 numbers from 0 to 1"),
        ({"action_scale": [2.0] * 6}, "should be 6 numbers from 0 to 1"),
        ({"action_scale": None}, "residual.action_scale: None, should be 6 numbers from 0 to 1"),
    ],
)
def test_settings_that_no_training_notes_are_refused(changes, message, small_scene):
    policy = constant(small_scene)
    noted = [] if changes is None else policy.metadata["residual"] | changes
    with pytest.raises(ValueError, match=message):
        correction_settings(replace(policy, metadata={"residual": noted}), small_scene)


MINIMAL = {"name": "small", "algorithm": {"name": "residual-PPO"}, "schedule": {"total_steps": 1000}}


@pytest.mark.parametrize(
    ("changes", "sentence"),
    [
        ({"environment": {"copies": 2}}, "must be at least 5, one for each mass factor"),
        ({"environment": {"copies": 20}}, "batch_size = 4096: must be at most 1,000"),
        ({"algorithm": {"name": "residual-TD3"}}, "TD3, APG, cloning, dagger, act, residual-PPO"),
        ({"mismatch": {"mass_factors": ["0.7"]}}, "1 problem\n  - mismatch.mass_factors[0] = '0.7': must"),
        ({"mismatch": {"mass_factors": []}}, "1 problem\n  - mismatch.mass_factors = []: Tuple should have"),
        ({"algorithm": {"name": "residual-SAC", "hindsight": {}}}, "must be left out"),
        (
            {"algorithm": {"name": "residual-PPO", "lagrangian": {}}},
            "algorithm.lagrangian = 'given': must be left out",
        ),
    ],
)
def test_what_is_wrong_in_a_configuration_is_named(changes, sentence):
    with pytest.raises(ConfigurationError) as error:
        load_configuration(MINIMAL | changes)
    assert sentence in str(error.value)


def test_mismatch_is_drawn_within_its_bounds():
    mismatch = Mismatch(mass_factors=(0.7, 1.3), noise=0.01, push=0.02, pushes=3)
    first, second = (Worlds.drawn(mismatch, 50, seed=1) for _ in range(2))
    for a, b in zip(first, second, strict=True):
        np.testing.assert_array_equal(a, b)
    assert set(np.unique(first.mass_factors)) == {0.7, 1.3}
    assert 0.0 < np.min(first.noise) < np.max(first.noise) < 0.01
    assert 0.0 < np.min(first.push) < np.max(first.push) < 0.02
