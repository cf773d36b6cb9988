"""Corrections of plans: without one the plan flies, with one it is bounded, and what is learned is kept."""

import json
import shlex

import numpy as np
import pytest

from agents.command_line import main
from agents.command_line.comparing import residual
from agents.comparison.controllers import FEEDBACK, OPEN_LOOP, RECEDING
from agents.configuration import ConfigurationError, load_configuration
from agents.configuration.residual import Mismatch, ResidualConfiguration
from agents.plans import Plans
from agents.policies import ExportedPolicy
from agents.residual.conditions import CONDITIONS, Condition
from agents.residual.controllers import (
    SMALL,
    Corrected,
    GainScheduled,
    OpenLoop,
    RecedingHorizon,
    Sight,
    corrected,
)
from agents.residual.evaluation import compare_under_mismatch, read_corrections
from agents.residual.flights import Adversity, fly
from agents.residual.tables import commands, markdown, notes, record, table
from agents.residual.worlds import Disturbances, Worlds
from dq_space_arm_env import DQSpaceArmVectorEnv, compile_scene, load_scene
from experts.demonstrations import DemonstrationsError

HEAVY = 1.3
"""The one factor of masses that is compiled for these tests."""
CALM = Adversity(1.0, 0.0, 0.0, 6.0, seed=0)
ROUGH = Adversity(HEAVY, 0.01, 0.02, 6.0, seed=3)
SETTINGS = {"repeat": 10, "memory": 0.5, "full_authority": 0.1}


@pytest.fixture(scope="module")
def plans(demonstrations):
    return Plans.of(demonstrations)


def correction(scene, value=0.0):
    """A policy that always corrects alike."""
    kernels = compile_scene(scene)
    size = Sight.size(kernels)
    return ExportedPolicy(
        weights=(np.zeros((size, kernels.n_u)),),
        biases=(np.full(kernels.n_u, value),),
        activation="tanh",
        mean=np.zeros(size),
        scale=np.ones(size),
        metadata={"scene": scene.name, "residual": SETTINGS | {"action_scale": [0.1] * kernels.n_u}},
    )


def test_as_planned_plans_fly_as_in_the_environment(small_scene, demonstrations, plans):
    """With and without gains, the costs are those of the demonstrations, minus the sum of rewards."""
    for controller in (OpenLoop(), GainScheduled(small_scene)):
        flown = fly(controller, small_scene, plans, CALM)
        np.testing.assert_allclose(flown.cost, demonstrations.column("cost"), rtol=1e-9)
        final = demonstrations.column("final_errors")
        np.testing.assert_allclose(
            np.stack([flown.attitude_error, flown.position_error], axis=1), final, rtol=1e-6, atol=1e-9
        )
        assert flown.is_success.all()


def test_other_masses_are_those_of_another_scene(small_scene, plans):
    """The same actions lead where they lead in the environment of a scene whose last link is heavier."""
    *links, last = small_scene.model_dump()["links"]
    last |= {"mass": HEAVY * last["mass"], "inertia": (HEAVY * np.array(last["inertia"])).tolist()}
    heavy = small_scene.replace(links=[*links, last])
    few = plans.choose(np.arange(4))
    environment = DQSpaceArmVectorEnv(4, heavy, autoreset_mode="SameStep")
    environment.reset(options={"initial_state": few.starts})
    returns = np.zeros(4)
    for stage in range(small_scene.simulation.steps):
        returns += environment.step(few.planned(stage))[1]
    flown = fly(OpenLoop(), small_scene, few, CALM._replace(mass_factors=HEAVY))
    np.testing.assert_allclose(flown.cost, -returns, rtol=1e-9)
    nominal = fly(OpenLoop(), small_scene, few, CALM)
    assert (np.abs(flown.cost / nominal.cost - 1.0) > 1e-3).all()


def test_feedback_is_that_of_the_demonstrations(small_scene, demonstrations, plans):
    kernels, stage = compile_scene(small_scene), 40
    rng = np.random.default_rng(0)
    measured = kernels.retract(plans.states[:, stage], 0.05 * rng.standard_normal((len(plans), kernels.n_t)))
    followed = plans.follow(kernels, stage, measured)
    for i, demonstration in enumerate(demonstrations):
        deviation = demonstrations.tangent(demonstration.states[stage], measured[i])
        wanted = demonstration.actions[stage] + demonstration.feedback_gains[stage] @ deviation
        np.testing.assert_allclose(followed.action[i], np.clip(wanted, -1.0, 1.0), atol=1e-12)


def test_no_correction_leaves_the_plan_with_its_gains(small_scene, plans):
    alone = fly(GainScheduled(small_scene), small_scene, plans, ROUGH)
    with_nothing = fly(Corrected.by(correction(small_scene), small_scene), small_scene, plans, ROUGH)
    with_something = fly(Corrected.by(correction(small_scene, 0.02), small_scene), small_scene, plans, ROUGH)
    np.testing.assert_array_equal(with_nothing.cost, alone.cost)
    assert (np.abs(with_something.cost / alone.cost - 1.0) > 1e-4).all()


def test_corrections_are_bounded_and_sums_within_the_limits():
    scale = np.array([0.1, 0.5])
    action = np.array([[0.0, 0.0], [0.95, -0.8]])
    many = corrected(action, np.array([[7.0, -0.2], [0.3, -0.9]]), scale)
    np.testing.assert_allclose(many, [[0.1, -0.2], [1.0, -1.0]])


def test_corrections_are_held(small_scene, plans):
    asked = []

    def policy(seen):
        asked.append(seen)
        return np.zeros((len(seen), compile_scene(small_scene).n_u))

    scale = np.ones(compile_scene(small_scene).n_u)
    controller = Corrected(small_scene, policy, action_scale=scale, repeat=40, memory=0.5, full_authority=0.1)
    fly(controller, small_scene, plans, CALM)
    assert len(asked) == 4  # of 150 steps
    assert asked[0].shape == (len(plans), Sight.size(compile_scene(small_scene)))
    np.testing.assert_allclose([seen[0, small_scene_clock(small_scene)] for seen in asked], [15, 11, 7, 3])


def small_scene_clock(scene):
    """Place of the time left in an observation."""
    return compile_scene(scene).n_x


def test_deviations_are_averaged_over_the_memory(small_scene, plans):
    kernels = compile_scene(small_scene)
    sight = Sight(small_scene, memory=0.5, full_authority=0.1)  # five steps
    offset = np.full((len(plans), kernels.n_t), 0.01)
    begin = kernels.n_x + 1 + kernels.n_t
    averages = []
    for stage in range(3):
        measured = kernels.retract(plans.states[:, stage], offset)
        seen = sight(stage, measured, plans.follow(kernels, stage, measured))
        averages.append(SMALL * np.sinh(seen[:, begin : begin + kernels.n_t]))
    for steps, average in enumerate(averages, start=1):
        np.testing.assert_allclose(average, 0.01 * (1.0 - 0.8**steps), rtol=1e-5)


def test_corrections_count_the_more_the_farther_a_flight_is_from_its_plan(small_scene, plans):
    kernels, sight = (
        compile_scene(small_scene),
        Sight(small_scene, memory=0.1, full_authority=0.2),
    )  # no memory
    sizes = np.linspace(0.0, 0.4, len(plans))
    offset = np.zeros((len(plans), kernels.n_t))
    offset[:, -1] = sizes
    measured = kernels.retract(plans.states[:, 0], offset)
    sight(0, measured, plans.follow(kernels, 0, measured))
    np.testing.assert_allclose(sight.authority()[:, 0], np.minimum(1.0, sizes / 0.2), atol=1e-9)


def test_disturbances_are_as_strong_and_as_many_as_they_should_be(small_scene):
    rng = np.random.default_rng(0)
    noise, push = np.tile([0.0, 0.01], 200), np.tile([0.02, 0.0], 200)
    disturbances = Disturbances(small_scene, noise, push, 6.0, rng)
    draws = [disturbances.draw() for _ in range(small_scene.simulation.steps)]
    jumps, noises = (np.stack(parts) for parts in zip(*draws, strict=True))
    velocity = compile_scene(small_scene).layout.tangent.base_velocity
    assert not np.delete(jumps, np.r_[velocity], axis=2).any()
    assert not jumps[:, 1::2].any()
    assert not noises[:, ::2].any()
    assert np.std(noises[:, 1::2]) == pytest.approx(0.01, rel=0.01)
    struck = jumps[:, ::2, velocity].any(axis=2)
    assert struck.sum(axis=0).mean() == pytest.approx(6.0, rel=0.1)
    assert np.std(jumps[:, ::2, velocity][struck]) == pytest.approx(0.02, rel=0.05)


def test_what_blows_up_stays_and_is_charged(small_scene, plans):
    worlds = Worlds(small_scene, [1.0, 1.0])
    flight = worlds.begin(plans.choose([0, 1]).starts)
    mild = np.zeros((2, compile_scene(small_scene).n_u))
    flight.act(mild)
    flight.states[1, compile_scene(small_scene).layout.state.base_velocity] = 1e9
    before = flight.states[1].copy()
    first, second = flight.act(mild), flight.act(mild)
    assert flight.diverged.tolist() == [False, True]
    np.testing.assert_array_equal(flight.states[1], before)
    assert first[1] == second[1] > 0.0
    assert first[0] != second[0]


@pytest.fixture(scope="module", autouse=True)
def cache(tmp_path_factory):
    """A place for the informed expert's costs alone: compiled kernels stay where they are."""
    folder = tmp_path_factory.mktemp("cache")
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr("agents.evaluation.cached_groups.cache_directory", lambda: folder)
        yield folder


def write_correction(folder, scene, value=0.02):
    """A run that never was."""
    folder.mkdir(parents=True)
    correction(scene, value).save(folder / "policy.npz")
    return folder


PLANNED, TESTED = Condition("as-planned"), Condition("heavy-noise-pushes", HEAVY, 0.01, 0.02)
RUN, FEW = "stub-0", 3


@pytest.fixture(scope="module")
def comparison(small_scene, demonstrations, tmp_path_factory):
    run = write_correction(tmp_path_factory.mktemp("runs") / RUN, small_scene)
    conditions = [PLANNED, Condition("heavy", HEAVY), TESTED]
    return compare_under_mismatch([run], demonstrations, conditions=conditions, receding_starts=FEW)


def row_of(comparison, condition, name):
    (row,) = (row for row in comparison.under(condition) if row.controller == name)
    return row


def test_controllers_are_compared_start_by_start(comparison, demonstrations):
    gains = row_of(comparison, "as-planned", FEEDBACK)
    assert gains.cost_gap.value == pytest.approx(0.0, abs=1e-9)
    assert gains.success_rate.value == 1.0
    # There is nothing to correct.
    assert comparison.saving(row_of(comparison, "as-planned", RUN)).value == pytest.approx(0.0, abs=1e-9)
    assert row_of(comparison, "as-planned", RECEDING).cost_gap.value < 1e-3
    # No controller beats the one that knows; a bound as long as it has found the best maneuver.
    for name in (FEEDBACK, RUN, RECEDING):
        row = row_of(comparison, "heavy", name)
        assert (row.flown.cost > row.informed_cost * (1.0 - 1e-6)).all()
    assert row_of(comparison, "heavy", FEEDBACK).cost_gap.value < 0.1
    assert all(row.action_seconds > 0.0 for row in comparison.rows)


def test_savings_are_of_the_starts_that_both_have_flown(comparison, demonstrations):
    base, receding = (row_of(comparison, TESTED.name, name) for name in (FEEDBACK, RECEDING))
    assert (len(base.flown.cost), len(receding.flown.cost)) == (len(demonstrations), FEW)
    expected = 1.0 - np.prod(receding.flown.cost / base.flown.cost[:FEW]) ** (1.0 / FEW)
    assert comparison.saving(receding).value == pytest.approx(expected)
    assert comparison.saving(base) is None


def test_what_a_flight_meets_does_not_depend_on_how_many_fly(small_scene, plans):
    all_worlds = Adversity(np.full(len(plans), 1.0), 0.01, 0.02, 6.0, seed=3)
    everyone = fly(GainScheduled(small_scene), small_scene, plans, all_worlds)
    few = fly(GainScheduled(small_scene), small_scene, plans.choose(np.arange(FEW)), all_worlds)
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

    monkeypatch.setattr("agents.residual.evaluation.fly", refuse)
    monkeypatch.setattr("agents.residual.informed.BoxDDP", refuse)
    again = compare_under_mismatch([run], few, **arguments)
    assert json.dumps(record(again, [])) == json.dumps(record(first, []))
    for changes in ({"seed": 1}, {"conditions": [PLANNED._replace(noise=0.001)]}):
        with pytest.raises(AssertionError, match="flown again"):
            compare_under_mismatch([run], few, **arguments | changes)
    with pytest.raises(AssertionError, match="flown again"):
        compare_under_mismatch([run], demonstrations[:3], **arguments)
    other = write_correction(tmp_path / "other" / RUN, small_scene, 0.01)
    with pytest.raises(AssertionError, match="flown again"):
        compare_under_mismatch([other], few, **arguments)
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


def test_conditions_need_no_quotes():
    assert list(CONDITIONS) == shlex.split(shlex.join(CONDITIONS)) == shlex.join(CONDITIONS).split()


def test_the_table_says_what_it_shows(comparison):
    made = table(comparison)
    assert [row[1] for row in made.rows[:4]] == [OPEN_LOOP, FEEDBACK, RUN, RECEDING]
    assert {len(row) for row in made.rows} == {len(made.headings)}
    assert [row[2] for row in made.rows[:4]] == ["24", "24", "24", "3"]
    again = commands(comparison, ["-n", "24"])
    text = markdown(comparison, again)
    for sentence in [*notes(comparison), "dq-space-arm compare residual -n 24"]:
        assert sentence in text
    assert any("flies the first 3 starts" in sentence for sentence in notes(comparison))
    json.dumps(record(comparison, again), allow_nan=False)


def test_the_figure_has_a_mark_for_each_row(comparison):
    pytest.importorskip("matplotlib")
    from agents.residual.figure import mismatch_figure

    panels = mismatch_figure(comparison).axes
    assert len(panels) == 2
    for axes in panels:
        marks = [line for line in axes.lines if line.get_marker() not in ("None", None, "")]
        assert len(marks) == len(comparison.rows)


def test_the_command_writes_table_record_and_picture(small_scene, tmp_path, capsys, monkeypatch):
    pytest.importorskip("matplotlib")
    small_scene.to_yaml(tmp_path / "small.yaml")
    run, out = write_correction(tmp_path / RUN, small_scene), tmp_path / "out"
    arguments = [
        "compare",
        "residual",
        str(run),
        "--scene",
        str(tmp_path / "small.yaml"),
        "-n",
        "3",
        "--workers",
        "1",
    ]
    arguments += ["--condition", "as-planned", "small-pushes", "--tolerance-scale", "1", "--out", str(out)]
    assert main(arguments) == 0
    (command,) = [line for line in capsys.readouterr().out.splitlines() if "dq-space-arm" in line]
    again = residual.make_context("test", shlex.split(command)[3:]).params
    assert (again["policies"], again["n"]) == ((str(run),), 3)
    assert again["conditions"] == ("as-planned", "small-pushes")
    assert {path.name for path in out.iterdir()} == {
        "plans-small-3-1",
        "rows",
        "table.md",
        "comparison.json",
        "comparison.png",
    }
    assert (out / "comparison.png").read_bytes()[:4] == b"\x89PNG"
    content = json.loads((out / "comparison.json").read_text())
    assert [row["controller"] for row in content["rows"][:3]] == [OPEN_LOOP, FEEDBACK, RUN]
    assert "versions" in content

    def interrupt(*arguments, **options):
        raise KeyboardInterrupt

    monkeypatch.setattr("agents.residual.command.compare_under_mismatch", interrupt)
    assert main(arguments) == 130
    assert "what is finished is kept" in capsys.readouterr().err


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
    """Some demonstrations have an emphasis on the final pose, which costs a little; its plans have none."""
    few = plans.choose([3, 5])
    replanned = fly(RecedingHorizon(small_scene, 20), small_scene, few, CALM)
    planned = fly(GainScheduled(small_scene), small_scene, few, CALM)
    assert (replanned.cost < planned.cost * (1.0 + 1e-3)).all()
    assert (replanned.cost > 0.9 * planned.cost).all()


def test_a_policy_that_does_not_fit_is_refused(small_scene):
    with pytest.raises(ValueError, match="chooses actions rather than corrections"):
        Corrected.by(
            ExportedPolicy((np.zeros((3, 2)),), (np.zeros(2),), "tanh", np.zeros(3), np.ones(3)), small_scene
        )
    policy = correction(small_scene)
    paper = load_scene("paper")
    with pytest.raises(
        ValueError, match=r"policy: corrects scene 'small', with .* scene 'paper' has 78 and 12"
    ):
        Corrected.by(policy, paper)


def test_a_scene_without_masses_to_change_is_refused(small_scene):
    bare = small_scene.replace(
        links=[], initial_state={}, spread={}, actuators={"base_force": {"limit": 1}}, tip={}
    )
    with pytest.raises(ValueError, match="neither payload nor links: mass_factors should be 1"):
        Worlds(bare, [1.0, HEAVY])


MINIMAL = {"name": "small", "algorithm": {"name": "residual-PPO"}, "schedule": {"total_steps": 1000}}


def test_configurations_tell_the_class_by_the_algorithm(tmp_path):
    configuration = load_configuration(MINIMAL)
    assert isinstance(configuration, ResidualConfiguration)
    assert load_configuration(configuration) == configuration
    assert load_configuration(configuration.model_dump(mode="json", exclude_none=True)) == configuration
    assert configuration.learner().algorithm.name == "PPO"
    assert isinstance(load_configuration("residual"), ResidualConfiguration)


@pytest.mark.parametrize(
    ("changes", "sentence"),
    [
        ({"mismatch": {"nois": 0.1}}, "did you mean 'noise'"),
        ({"environment": {"copies": 2}}, "must be at least 5, one for each mass factor"),
        ({"environment": {"cost_power": 1.5}}, "must be at most 1"),
        ({"algorithm": {"name": "residual-TD3"}}, "TD3, cloning, dagger, residual-PPO, residual-SAC"),
        ({"algorithm": {"name": "residual-SAC", "hindsight": {}}}, "must be left out"),
    ],
)
def test_what_is_wrong_in_a_configuration_is_named(changes, sentence):
    with pytest.raises(ConfigurationError) as error:
        load_configuration(MINIMAL | changes)
    assert sentence in str(error.value)


def test_mismatch_is_drawn_within_its_bounds():
    mismatch = Mismatch(mass_factors=(0.7, 1.3), noise=0.01, push=0.02, pushes=3)
    first, second = (Adversity.drawn(mismatch, 50, seed=1) for _ in range(2))
    for a, b in zip(first, second, strict=True):
        np.testing.assert_array_equal(a, b)
    assert set(np.unique(first.mass_factors)) == {0.7, 1.3}
    assert 0.0 < np.min(first.noise) < np.max(first.noise) < 0.01
    assert 0.0 < np.min(first.push) < np.max(first.push) < 0.02


def test_demonstrations_of_another_scene_are_refused(demonstrations, small_scene):
    from agents.demonstrations import check_scene

    with pytest.raises(DemonstrationsError, match="another scene"):
        check_scene(demonstrations, small_scene.replace(simulation={"dt": 0.1, "steps": 100}))
