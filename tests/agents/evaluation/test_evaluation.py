"""The evaluation protocol: what it counts, on which starts, and what it compares with."""

import dataclasses
import json
import math

import gymnasium
import numpy as np
import pytest
from rich.console import Console

from agents import compare, evaluate
from agents.evaluation import CONDITIONS, EVALUATION_SEEDS, evaluation_seeds, fly, optimal_costs, scene_under
from agents.evaluation.comparison_tables import evaluation_table, remarks
from agents.evaluation.conditions import FlightDisturbance, physics_hash
from agents.evaluation.evaluating import Evaluation, fly_under
from agents.evaluation.evaluation_verbs import evaluate_policies
from agents.evaluation.expert_costs import KIND, OptimalCosts, cost_rows
from agents.evaluation.statistics import wilson_interval
from agents.policies import ExportedPolicy
from agents.policies.flying import Flights, time_per_action
from agents.suite import load_suite, run_suite
from agents.zoo.finding import PolicyError, as_policy, check_fit
from dq_space_arm_env import compile_scene, load_scene
from dq_space_arm_env.command_line import main
from dq_space_arm_env.environment.disturbances import Disturbances
from dq_space_arm_env.environment.rollouts import rollout
from dq_space_arm_env.scene import StateLayout
from dq_space_arm_env.task.step_report import n_observations
from experts.demonstrations import SerialExecutor, generate_demonstrations
from experts.demonstrations.outcomes import MISSED_TARGET, REASONS
from experts.demonstrations.settings import Settings
from experts.demonstrations.shard import ShardResult

PAPER = load_scene("paper")
SHORT = PAPER.replace(name="short", simulation={"dt": 0.015, "steps": 12})


def gentle(observations):
    """A useless feedback that depends on the whole observation."""
    return 0.01 * np.sin(observations.sum(axis=1, keepdims=True) + np.arange(12))


def single_episode(scene, seed, policy):
    """The same in a single environment, everything counted by hand."""
    env = gymnasium.make("DQSpaceArm-v0", scene=scene)
    observation, _ = env.reset(seed=seed)
    first = env.unwrapped.state[:4]
    cost = effort = turn = 0.0
    over = False
    while not over:
        observation, reward, over, _, info = env.step(policy(observation[None])[0])
        cost, effort = cost - reward, effort + info["cost_control"]
        overlap = min(abs(first @ env.unwrapped.state[:4]), 1.0)
        turn = max(turn, math.degrees(2.0 * math.acos(overlap)))
    return cost, effort, turn, info


STIFF = PAPER.replace(
    links=[link.model_dump() | {"stiffness": 200.0} for link in PAPER.links],
    simulation={"dt": 0.1, "steps": 7, "integrator": "symplectic_euler"},
)
"""Most of its episodes diverge, and restart without being counted."""


@pytest.mark.sampled
@pytest.mark.parametrize(("scene", "seeds"), [(SHORT, [3, 11, 2**40]), (STIFF, list(range(12)))])
def test_flights_are_those_of_single_environments(scene, seeds):
    flights = fly(gentle, scene, seeds)
    assert flights.diverged.any() == (scene is STIFF)
    for i, seed in enumerate(seeds):
        cost, effort, turn, info = single_episode(scene, seed, gentle)
        assert flights.cost[i] == pytest.approx(cost, rel=1e-12)
        assert flights.effort[i] == pytest.approx(effort, rel=1e-12)
        assert info["diverged"] or flights.length[i] == scene.simulation.steps
        for name in ("attitude_error", "position_error", "is_success", "diverged"):
            np.testing.assert_equal(getattr(flights, name)[i], info[name])
        if scene is SHORT:
            assert flights.base_turn[i] == pytest.approx(turn, abs=1e-6)


@pytest.mark.slow
def test_a_policy_that_gives_nan_is_no_success():
    scene = SHORT.replace(success={"attitude_error_deg": 180.0, "position_error": 100.0})
    evaluation = evaluate(lambda seen: np.full((len(seen), 12), np.nan), scene, 3, expert=False)
    assert evaluation.summary()["policy_failed"] == 3
    assert "0 % reach the target; the policy failed (gave NaN) in 3 of 3 flights>" in repr(evaluation)
    assert evaluation.summary()["success_rate"][0] == 0.0
    (remark,) = remarks([evaluation])
    assert remark.startswith("<lambda>, training: in 3 flights the policy gave NaN")


def test_flights_that_all_start_alike_are_told():
    still = SHORT.replace(spread=dict.fromkeys(SHORT.spread.model_dump(exclude={"observed"}), 0.0))
    with pytest.warns(UserWarning, match=r"scene 'short' has no spread, so all 3 flights are the same"):
        found = evaluate(gentle, still, 3, expert=False)
    assert len(set(found.flights.cost.tolist())) == 1
    with pytest.raises(ValueError, match=r"no spread, so all evaluation starts are the same"):
        evaluate(gentle, still, 3)
    evaluate(gentle, still, 1, expert=False)  # without a warning
    pushed = evaluate(gentle, still, 3, condition="push", expert=False)
    assert len(set(pushed.flights.cost.tolist())) == 3


def test_evaluation_seeds_are_fixed_and_their_own():
    seeds = evaluation_seeds(PAPER)
    assert len(set(seeds)) == EVALUATION_SEEDS == 500
    assert seeds[:2] == [3003083155383472103, 4629164122600116775]
    assert seeds[:7] == evaluation_seeds(PAPER, 7)
    training = Settings(PAPER, 1000, 0, 32)
    assert not set(seeds) & {training.problem_seed(problem) for problem in range(1000)}
    for n in (0, 501, 2.0, "3", True):
        with pytest.raises(ValueError, match="should be from 1 to 500"):
            evaluation_seeds(PAPER, n)


def test_a_scene_whose_starts_are_all_the_same_is_refused_with_what_helps():
    """Whatever the number of starts."""
    still = SHORT.replace(spread=dict.fromkeys(type(SHORT.spread).model_fields, 0.0) | {"observed": False})
    with pytest.raises(ValueError, match=r"all evaluation starts are the same: give it a spread, or .*--no"):
        optimal_costs(still, 1)


def test_cached_optima_mean_what_the_name_of_their_folder_says():
    """Caches outlive this code: rows that mean something else need another `KIND`, here too."""
    safetensors = pytest.importorskip("safetensors.numpy")
    reasons = (REASONS.index(MISSED_TARGET), REASONS.index("max_iterations"))
    content = safetensors.save(
        {
            **{"index": np.array([26]), "seed": np.array([7]), "cost": np.array([1.5])},
            **{"failures.index": np.array([25, 27]), "failures.seed": np.array([5, 9])},
            **{"failures.cost": np.array([2.5, 3.5]), "failures.stop_reason": np.array(reasons)},
        }
    )
    assert (KIND, cost_rows(ShardResult(1, content, "", "", 1, 2, [0.1, 0.2, 0.3], {}))) == (
        "optimal-costs",
        [  # an optimum that misses the target is one; what did not converge is none
            {"seed": 5, "cost": 2.5, "is_success": False, "seconds": 0.1},
            {"seed": 7, "cost": 1.5, "is_success": True, "seconds": 0.2},
            {"seed": 9, "cost": None, "is_success": False, "seconds": 0.3},
        ],
    )


@pytest.mark.slow
def test_optimal_costs_are_those_of_demonstrations(cache, tmp_path, quick):
    costs = optimal_costs(quick, 30, executor=SerialExecutor())
    from agents.configuration.schema import RESERVED_SEED
    from agents.evaluation.expert_costs import GROUP

    demonstrations = generate_demonstrations(
        quick, GROUP, tmp_path / "same", RESERVED_SEED, shard_size=GROUP, executor=SerialExecutor()
    )
    expected = {demonstration.seed: demonstration.cost for demonstration in demonstrations}
    assert len(expected) > 20
    known = {seed: cost for seed, cost in zip(costs.seeds, costs.cost, strict=True) if seed in expected}
    assert known == expected
    assert (costs.seconds > 0.0).all()


@pytest.mark.slow
def test_optimal_costs_are_computed_once_and_go_on_where_they_were(cache, counting, quick):
    executor = counting(limit=1)
    with pytest.raises(KeyboardInterrupt):
        optimal_costs(quick, 30, executor=executor)
    seen = []
    executor = counting()
    first = optimal_costs(quick, 30, executor=executor, progress=lambda *done: seen.append(done))
    assert executor.tasks == 1
    assert seen == [(25, 30), (30, 30)]
    executor = counting()
    again = optimal_costs(quick, 30, executor=executor)
    assert executor.tasks == 0
    np.testing.assert_array_equal(again.cost, first.cost)
    damaged = sorted(cache.rglob("*.json"))[1]
    damaged.write_text(damaged.read_text()[:-7])
    repaired = optimal_costs(quick, 30, executor=executor)
    assert executor.tasks == 1
    np.testing.assert_array_equal(repaired.cost, first.cost)


@pytest.mark.slow
def test_optimal_costs_of_another_scene_are_others(cache, counting, quick):
    optimal_costs(quick, 1, executor=SerialExecutor())
    executor = counting()
    optimal_costs(quick.replace(name="renamed"), 1, executor=executor)
    assert executor.tasks == 0
    optimal_costs(quick.replace(success={"position_error": 0.2}), 1, executor=executor)
    assert executor.tasks == 1


def idle(scene):
    n_u = compile_scene(scene).layout.n_u
    return lambda observations: np.zeros((len(observations), n_u))


@pytest.mark.slow
def test_an_evaluation_reports_what_the_protocol_asks_for(cache, quick):
    evaluation = evaluate(idle(quick), quick, 10, executor=SerialExecutor(), label="idle")
    summary = evaluation.summary()
    json.dumps(summary, allow_nan=False)
    assert (summary["policy"], summary["episodes"], summary["training_steps"]) == ("idle", 10, None)
    assert summary["success_rate"][0] == evaluation.flights.is_success.mean()
    gaps = evaluation.flights.cost / evaluation.optimal.cost - 1.0
    assert (gaps[~np.isnan(gaps)] > 0.0).all()
    assert summary["median_cost_gap"][0] == pytest.approx(np.nanmedian(gaps))
    assert summary["tail_cost_gap"][0] == pytest.approx(np.nanpercentile(gaps, 95))
    assert summary["effort"] == 0.0
    assert 0.0 < summary["action_seconds"] < 1e-3
    without = evaluate(idle(quick), quick, 10, expert=False).summary()
    assert without["median_cost_gap"] is None
    assert without["success_rate"] == summary["success_rate"]


def test_violations_have_intervals_and_columns():
    limits = {"kind": "joint_limits", "name": "elbow", "lower": [-4, 0.85, -4], "tolerance": 0.01}  # rad
    scene = SHORT.replace(constraints=[limits])
    evaluation = evaluate(gentle, scene, 40, expert=False)
    summary, shares = evaluation.summary(), []
    for seed in evaluation_seeds(scene, 40):
        env = gymnasium.make("DQSpaceArm-v0", scene=scene)
        seen = env.reset(seed=seed)[0]
        costs = []
        for _ in range(12):
            seen, *_, info = env.step(gentle(seen[None])[0])
            costs.append(info["cost"])
        shares.append(np.mean(np.array(costs) > 1.0))
    assert 0.2 < np.mean(np.array(shares) > 0.0) < 0.8
    assert summary["violating_episodes"] == list(wilson_interval(np.count_nonzero(shares), 40))
    mean, low, high = summary["constraint_violations"]
    assert mean == pytest.approx(np.mean(shares))
    half = 1.96 * np.std(shares) / math.sqrt(40)  # of the normal approximation
    assert high - low == pytest.approx(2.0 * half, rel=0.15)
    clean = dataclasses.replace(
        evaluation, flights=evaluation.flights._replace(constraint_violations=np.zeros(40))
    )
    assert clean.constraint_violations == clean.violating_episodes == wilson_interval(0, 40)
    assert "violating" in str(evaluation_table([evaluation]).headings)
    # What leaves the limits may cost less than the optimum within them: no better optimum is known for that.
    flights = evaluation.flights._replace(is_success=np.ones(40, dtype=np.bool_))
    dearer = OptimalCosts(evaluation.seeds, 1.01 * flights.cost, np.ones(40, dtype=np.bool_), np.zeros(40))
    cheaper = dataclasses.replace(evaluation, flights=flights, optimal=dearer).summary()
    assert cheaper["cheaper_than_expert"] == 40 - np.count_nonzero(shares)
    plain = evaluate(gentle, SHORT, 2, expert=False)
    assert plain.summary()["violating_episodes"] is plain.summary()["constraint_violations"] is None
    assert "violat" not in str(evaluation_table([plain]).headings)


def test_one_flight_has_gaps_without_intervals():
    limits = {"kind": "joint_limits", "name": "elbow", "lower": [-4, 0.85, -4], "tolerance": 0.01}  # rad
    plain = evaluate(gentle, SHORT.replace(constraints=[limits]), 1, expert=False)
    optimal = OptimalCosts(plain.seeds, np.ones(1), np.ones(1, bool), np.zeros(1))
    evaluation = dataclasses.replace(plain, optimal=optimal)
    summary = json.loads(json.dumps(evaluation.summary(), allow_nan=False))
    for name in ("median_cost_gap", "tail_cost_gap"):
        assert summary[name][1:] == [None, None]
    for name in ("success_rate", "constraint_violations"):
        assert None not in summary[name]  # Wilson's interval holds for one flight too
    table = evaluation_table([evaluation])
    cells = dict(zip(table.headings, table.rows[0], strict=True))
    assert float(cells["cost gap\n%"].replace(",", "")) == pytest.approx(
        100.0 * summary["median_cost_gap"][0], rel=0.01
    )


def test_a_table_shows_costs_where_no_gap_is_known_and_no_empty_column():
    plain = evaluate(gentle, SHORT, 2, expert=False)
    optimal = OptimalCosts(plain.seeds, np.ones(2), np.ones(2, bool), np.zeros(2))
    found = {}
    for name, evaluation in (("plain", plain), ("compared", dataclasses.replace(plain, optimal=optimal))):
        found[name] = {heading.replace("\n", " ") for heading in evaluation_table([evaluation]).headings}
    assert found["plain"] - found["compared"] == {"median cost J"}
    assert found["compared"] - found["plain"] == {"cost gap %", "95th perc. %"}
    assert "training time" not in found["plain"]
    shown = "<Evaluation of gentle in 'short', training: 2 flights, 0 % reach the target>"
    assert repr(plain) == shown
    assert "median cost gap" in repr(evaluation)


def test_conditions_change_what_they_say():
    changed = {condition: scene_under(PAPER, condition) for condition in CONDITIONS}
    assert changed["training"] is PAPER
    assert changed["wide_starts"].spread.joint_angles == 0.75
    for speed, wide in ((60.0, 90.0), (120.0, 160.0)):  # rad/s, around 380 of 540
        wheels = load_scene("wheels").replace(spread={"wheel_speeds": speed})
        assert scene_under(wheels, "wide_starts").spread.wheel_speeds == wide
    masses = [changed[name].links[2].mass for name in ("light_payload", "heavy_payload")]
    assert masses == pytest.approx([7.0, 13.0])
    assert changed["heavy_payload"].links[2].inertia[1][1] == pytest.approx(0.65)
    assert changed["heavy_payload"].links[:2] == PAPER.links[:2]
    assert changed["spin"].initial_state.base_velocity[2] == pytest.approx(0.05)
    carrying = load_scene("payload")
    assert scene_under(carrying, "heavy_payload").payload.mass == pytest.approx(1.3 * carrying.payload.mass)
    assert scene_under(carrying, "heavy_payload").links == carrying.links
    with pytest.raises(ValueError, match="condition: 'rain' is unknown; choose from training, wide_starts"):
        scene_under(PAPER, "rain")


def test_a_load_is_changed_in_all_phases_or_not_at_all():
    scene = load_scene("capture-and-detumble")
    masses, heavier = (
        each.staged.values["payload.mass"] for each in (scene, scene_under(scene, "heavy_payload"))
    )
    assert heavier == pytest.approx(1.3 * np.array(masses))
    phases = [phase.model_dump(exclude_unset=True) for phase in load_scene("refuelling").phases]
    phases[1]["changes"]["links.2.mass"] = 7.0
    with pytest.raises(ValueError, match=r"phases that change links\.2\.mass: no load"):
        scene_under(load_scene("refuelling").replace(phases=phases), "heavy_payload")


def test_a_condition_that_does_not_suit_the_scene_is_refused_before_anything_flies(monkeypatch, tmp_path):
    """Whoever evaluates, and wherever among the conditions it stands."""
    for module in ("evaluation_verbs", "comparing"):
        monkeypatch.setattr(f"agents.evaluation.{module}.evaluate", lambda *_, **__: pytest.fail("flown"))
    monkeypatch.setattr("agents.evaluation.comparing.fly_plans", lambda *_, **__: pytest.fail("flown"))
    scene, refusal = (
        load_scene("wheel-saturation"),
        "condition: 'spin' does not suit scene 'wheel-saturation'",
    )
    policy = exported(n_observation=n_observations(scene), n_action=StateLayout.of(scene).n_u)
    policy.save(tmp_path / "policy.npz")
    with pytest.raises(ValueError, match=refusal):
        compare([tmp_path], scene, 2, controllers=("gains",), conditions=("training", "spin"))
    with pytest.raises(ValueError, match=refusal):
        evaluate_policies(Console(), [str(tmp_path)], "wheel-saturation", 2, conditions=["all"])
    suite = load_suite()
    with pytest.raises(ValueError, match=refusal):
        run_suite(["gains"], suite.model_copy(update={"conditions": ("training", "spin")}), out=tmp_path)


def test_a_delayed_action_acts_steps_later():
    """Nothing acts before the first one arrives, and nothing that is observed tells of it."""
    steps = FlightDisturbance(delay=0.15).steps(SHORT)
    assert steps == round(0.15 / SHORT.simulation.dt) > 1
    policy = exported(n_observation=n_observations(SHORT), n_action=compile_scene(SHORT).n_u)
    flown = rollout(policy, SHORT, [3, 4], delay=steps, record=True)
    limits = compile_scene(SHORT).layout.control_limit
    asked = np.clip([policy(seen) for seen in flown.observations], -1.0, 1.0) * limits
    assert not flown.controls[:, :steps].any()
    np.testing.assert_allclose(flown.controls[:, steps:], asked[:, : -steps - 1], rtol=0, atol=1e-7)
    with pytest.raises(ValueError, match="delay: -1, should be at least 0 steps"):
        rollout(policy, SHORT, delay=-1)


@pytest.mark.parametrize("condition", ["delay", "noise", "push"])
def test_disturbances_of_a_flight_depend_on_its_start_alone(condition):
    policy = exported(n_observation=n_observations(SHORT), n_action=compile_scene(SHORT).n_u)
    seeds = evaluation_seeds(SHORT, 6)
    together = fly_under(condition, policy, SHORT, seeds)
    some = fly_under(condition, policy, SHORT, [seeds[4], seeds[1]])
    np.testing.assert_array_equal(some.cost, together.cost[[4, 1]])
    calm = fly_under("training", policy, SHORT, seeds)
    np.testing.assert_array_equal(calm.cost, fly(policy, SHORT, seeds).cost)
    assert np.sum(calm.cost != together.cost) >= 4
    assert scene_under(SHORT, condition).content_hash() == SHORT.content_hash()


def exported(n_observation=24, n_action=12, **metadata):
    rng = np.random.default_rng(0)
    weights = rng.standard_normal((n_observation, 8)), 0.1 * rng.standard_normal((8, n_action))
    biases, mean, scale = (np.zeros(8), np.zeros(n_action)), np.zeros(n_observation), np.ones(n_observation)
    return ExportedPolicy(weights, biases, "tanh", mean, scale, metadata=metadata)


def test_files_functions_and_objects_are_one_policy(tmp_path):
    policy = exported(agent="stub", training={"environment_steps": 7, "seconds": 3.0, "expert_solves": 2})
    policy.save(tmp_path / "policy.npz")
    ways = [policy, tmp_path / "policy.npz", str(tmp_path), lambda observations: policy(observations)]
    summaries = [evaluate(way, SHORT, 5, expert=False).summary() for way in ways]
    assert len({summary["median_cost"] for summary in summaries}) == 1
    assert summaries[0]["policy"] == "stub"
    assert summaries[1]["training_steps"] == 7
    assert summaries[1]["expert_solves"] == 2


@pytest.mark.parametrize("training", [None, "two hours", {"seconds": "long", "expert_solves": True}])
def test_what_a_policy_says_of_its_training_in_words_counts_as_unknown(training):
    evaluation = evaluate(exported(training=training), SHORT, 2, expert=False)
    for name in ("training_steps", "training_seconds", "expert_solves"):
        assert evaluation.summary()[name] is None
    assert evaluation_table([evaluation]).rows


def test_what_is_no_policy_is_refused(tmp_path):
    with pytest.raises(PolicyError, match="should be a path, an ExportedPolicy"):
        as_policy(3)
    (tmp_path / "model.zip").write_bytes(b"nothing")
    with pytest.raises(PolicyError, match="is not a model of Stable-Baselines3"):
        as_policy(tmp_path / "model.zip")


@pytest.mark.slow
def test_a_policy_of_the_goal_environment_sees_what_that_shows():
    """Its observations are the goal environment's own, joined in alphabetical order; noise disturbs them."""
    seen = []
    scene = load_scene("random-target").replace(simulation={"dt": 0.015, "steps": 4})
    policy = exported(8 + 8 + 23, observation="goal")

    class Spy(ExportedPolicy):
        def __call__(self, observation):
            seen.append(np.array(observation))
            return super().__call__(observation)

    spy = Spy(policy.weights, policy.biases, "tanh", policy.mean, policy.scale, metadata=policy.metadata)
    fly(as_policy(spy).act, scene, [5, 6])
    env = gymnasium.make("DQSpaceArmGoal-v0", scene=scene)
    for copy, seed in enumerate([5, 6]):
        observation, _ = env.reset(seed=seed)
        for step in range(4):
            joined = np.concatenate([observation[key] for key in sorted(observation)]).astype(np.float32)
            np.testing.assert_allclose(seen[step][copy], joined, rtol=0, atol=1e-6)
            observation = env.step(policy(joined))[0]
    first = seen[0]
    seen.clear()
    noise = Disturbances(scene, np.random.default_rng(0), measurement=0.1, count=2)
    fly(as_policy(spy).act, scene, [5, 6], disturbances=noise)
    assert np.abs(seen[0] - first).max() > 0.05


def test_a_policy_of_another_scene_is_refused_in_a_sentence(tmp_path, quick):
    policy = exported(agent="stub", scene="paper")
    with pytest.raises(PolicyError, match="stub maps 24 observations to 12 inputs"):
        evaluate(policy, quick, 3, expert=False)
    with pytest.raises(PolicyError, match=r"cannot fly alone: use `dq-space-arm compare residual`"):
        evaluate(exported(agent="stub", observation="residual"), SHORT, 3, expert=False)


def test_a_policy_of_the_goal_environment_fits_a_scene_with_phases_and_a_moving_target():
    env = gymnasium.make("DQSpaceArmGoal-v0", scene="capture-and-detumble")
    seen = sum(part.shape[0] for part in env.observation_space.values())
    acting = as_policy(exported(seen, env.action_space.shape[0], observation="goal"))
    check_fit(acting, env.unwrapped.scene)
    with pytest.raises(PolicyError, match=f"maps {seen} observations"):
        check_fit(acting, SHORT)


def test_a_policy_of_several_observations_at_once_is_told_what_flies_it():
    with pytest.raises(PolicyError, match="if it sees the last 3 observations, as of VecFrameStack"):
        check_fit(as_policy(exported(3 * 24, 12, observation="plain")), load_scene("paper"))


def test_the_time_of_an_action_is_that_of_actions_before_the_end():
    """A constraint ends the episode after a few of the timed steps."""
    scene = load_scene("planar")
    joints = len(scene.links)
    stop = {"kind": "joint_limits", "name": "stop", "upper": [0.1] * joints, "lower": [-1.0] * joints}
    ending = {**stop, "tolerance": 0.01, "terminates": True}
    scene = scene.replace(initial_state={"joint_angles": [0.0] * joints}, constraints=[ending])

    def push(observations):
        return np.ones((len(observations), compile_scene(scene).n_u))

    assert rollout(push, scene, [0], steps=320).length[0] < 100
    assert time_per_action(push, scene) > 0.0


@pytest.mark.slow
def test_it_is_told_whether_the_scene_is_that_of_the_training():
    for made_in, same in ((SHORT.content_hash(), True), ("another", False), (None, None)):
        metadata = {"scene": "short"} | ({} if made_in is None else {"scene_hash": made_in})
        evaluation = evaluate(exported(**metadata), SHORT, 2, condition="spin", expert=False)
        assert evaluation.summary()["same_scene"] is same
    renamed = SHORT.replace(name="renamed", description="the same")
    assert evaluate(exported(scene_hash=SHORT.content_hash()), renamed, 2, expert=False).same_scene


def test_the_physics_are_neither_names_nor_tolerances():
    same = SHORT.replace(name="renamed", success={"position_error": 9.0}, spread={"base_rotation": 0.1})
    assert physics_hash(same) == physics_hash(SHORT) == physics_hash(scene_under(SHORT, "spin"))
    assert physics_hash(scene_under(SHORT, "heavy_payload")) != physics_hash(SHORT)


@pytest.mark.slow
def test_records_give_evaluations_back(cache, quick):
    evaluation = evaluate(idle(quick), quick, 4, executor=SerialExecutor())
    text = json.dumps(evaluation.record(), allow_nan=False)
    again = Evaluation.from_record(json.loads(text))
    assert again.summary() == evaluation.summary()
    for old, new in zip(evaluation.flights, again.flights, strict=True):
        np.testing.assert_array_equal(new, old)


@pytest.mark.parametrize(
    "change",
    [
        {"is_success": [None] * 3},
        {"is_success": ["no"] * 3},
        {"expert_success": [None] * 3},
        {"is_success": [True]},
        {"cost": [1.0]},
        {"cost": [[1.0]] * 3},
        {"expert_cost": [1.0]},
        {"seed": [1, 2]},
        {key: [] for key in (*Flights._fields, "seed", "expert_cost", "expert_success", "expert_seconds")},
    ],
    ids=str,
)
def test_records_whose_columns_do_not_fit_are_no_results(change):
    """Neither NaN nor a text is a success, and one flight is not that of all starts."""
    plain = evaluate(gentle, SHORT, 3, expert=False)
    optimal = OptimalCosts(plain.seeds, np.ones(3), np.ones(3, bool), np.zeros(3))
    record = dataclasses.replace(plain, optimal=optimal).record()
    assert Evaluation.from_record(record).summary()["success_rate"][0] == 0.0
    with pytest.raises(ValueError, match=r"neither true nor false|different lengths"):
        Evaluation.from_record({**record, "episodes": {**record["episodes"], **change}})


def test_the_command_writes_a_table_json_and_every_episode(tmp_path, capsys):
    for seed in range(3):
        configuration = {"name": "stub", "seed": seed}
        exported(agent="stub", configuration=configuration).save(tmp_path / f"{seed}.npz")
    SHORT.to_yaml(tmp_path / "short.yaml")
    policies = [str(tmp_path / f"{number}.npz") for number in range(3)]
    arguments = ["--scene", str(tmp_path / "short.yaml"), "-n", "4", "--no-expert"]
    out = ["--out", str(tmp_path / "out")]
    assert main(["evaluate", "--policy", *policies, *arguments, *out]) == 0
    assert "All training runs of an agent" in capsys.readouterr().out
    assert main(["evaluate", "--policy", *policies[:2], *arguments]) == 0
    assert "stub: two training seeds are too few to be aggregated" in capsys.readouterr().out
    records = [json.loads(path.read_text()) for path in sorted((tmp_path / "out").glob("[1-3]-*"))]
    seeds = json.loads((tmp_path / "out" / "seeds-training.json").read_text())
    assert [group["seeds"] for group in seeds["groups"]] == [[0, 1, 2]]
    assert [record["episodes"]["seed"] for record in records] == [evaluation_seeds(SHORT, 4)] * 3
    assert len(records[0]["episodes"]["cost"]) == 4
    assert main(["evaluate", "--policy", *policies[:2], *arguments, *out]) == 0
    assert not (tmp_path / "out" / "seeds-training.json").exists()  # it took three seeds together
    capsys.readouterr()
    conditions = ["--condition", "training", "spin"]
    assert main(["evaluate", "--policy", policies[0], *arguments, "--json", *conditions]) == 0
    summaries = json.loads(capsys.readouterr().out)
    assert [summary["condition"] for summary in summaries] == ["training", "spin"]
    assert summaries[0]["success_rate"][0] == 0.0


def test_policies_fly_in_the_scene_that_they_were_trained_in(tmp_path, capsys, monkeypatch):
    SHORT.to_yaml(tmp_path / "short.yaml")
    settings = {"scene": str(tmp_path / "short.yaml")}
    for number in range(2):
        exported(scene="short", configuration=settings).save(tmp_path / f"{number}.npz")
    arguments = ["-n", "2", "--no-expert", "--json"]
    both = [str(tmp_path / f"{number}.npz") for number in range(2)]
    assert main(["evaluate", *both, *arguments]) == 0
    assert {summary["scene"] for summary in json.loads(capsys.readouterr().out)} == {"short"}
    exported(14, 6, scene="planar").save(tmp_path / "other.npz")
    monkeypatch.setattr("agents.evaluation.evaluation_verbs.evaluate", lambda *_, **__: pytest.fail("flown"))
    vector = "dq_space_arm_env.environment.vector"
    monkeypatch.setattr(f"{vector}.compile_scene", lambda *_: pytest.fail("compiled"))
    assert main(["evaluate", *both, str(tmp_path / "other.npz"), *arguments]) == 2
    assert "maps 14 observations to 6 inputs" in capsys.readouterr().err


def test_the_command_refuses_what_it_cannot_use(tmp_path, capsys):
    assert main(["evaluate", str(tmp_path / "policy.npz"), "--no-expert"]) == 2
    assert "there is no such file or folder" in capsys.readouterr().err
    (tmp_path / "config.yaml").write_text("name: begun\n")
    assert main(["evaluate", str(tmp_path), "--no-expert"]) == 2
    assert f"{tmp_path}: this training has no policy yet; run its command again" in capsys.readouterr().err
    messages = {"damaged.npz": "cannot be read as a policy", "damaged.zip": "is not a model"}
    for name, message in messages.items():
        (tmp_path / name).write_bytes(b"nothing")
        assert main(["evaluate", "--policy", str(tmp_path / name), "--no-expert"]) == 2
        assert f"{name} {message}" in capsys.readouterr().err
    assert main(["evaluate", "--policy", "nobody", "--no-expert"]) == 2
    assert "the zoo has no policy 'nobody'" in capsys.readouterr().err
