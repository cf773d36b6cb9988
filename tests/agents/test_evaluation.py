"""The evaluation protocol: what it counts, on which starts, and what it compares with."""

import json
import math
from dataclasses import replace

import gymnasium
import numpy as np
import pytest

from agents import evaluate
from agents.command_line import main
from agents.evaluation import (
    CONDITIONS,
    EVALUATION_SEEDS,
    Recording,
    evaluation_seeds,
    fly,
    optimal_costs,
    scene_under,
)
from agents.evaluation.command import remarks
from agents.evaluation.conditions import physics_hash
from agents.evaluation.policies import PolicyError, as_policy
from agents.evaluation.records import evaluation_of, evaluation_record
from agents.policies import ExportedPolicy
from dq_space_arm_env import compile_scene, load_scene
from experts.demonstrations import SerialExecutor, generate_demonstrations
from experts.demonstrations.settings import Settings

PAPER = load_scene("paper")
SHORT = PAPER.replace(name="short", simulation={"dt": 0.015, "steps": 12})
QUICK = load_scene("planar").replace(name="quick", simulation={"dt": 0.1, "steps": 150})
"""Its problems are solved in hundredths of a second."""


class Counting:
    """An executor that counts the tasks it is given."""

    def __init__(self, limit=math.inf):
        self.tasks, self.limit = 0, limit

    def run(self, tasks):
        for result in SerialExecutor().run(tasks):
            if self.tasks == self.limit:
                raise KeyboardInterrupt
            self.tasks += 1
            yield result


@pytest.fixture
def cache(monkeypatch, tmp_path):
    """A place for the optimal costs alone: compiled kernels stay where they are."""
    monkeypatch.setattr("agents.evaluation.cached_groups.cache_directory", lambda: tmp_path)
    return tmp_path


def gentle(observations):
    """A feedback of no use, that depends on all of the observation."""
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
        if not over:
            overlap = min(abs(first @ env.unwrapped.state[:4]), 1.0)
            turn = max(turn, math.degrees(2.0 * math.acos(overlap)))
    return cost, effort, turn, info


def test_flights_are_those_of_single_environments():
    seeds = [3, 11, 2**40]
    flights = fly(gentle, SHORT, seeds)
    for i, seed in enumerate(seeds):
        cost, effort, turn, info = single_episode(SHORT, seed, gentle)
        assert flights.cost[i] == pytest.approx(cost, rel=1e-12)
        assert flights.effort[i] == pytest.approx(effort, rel=1e-12)
        assert flights.base_turn[i] == pytest.approx(turn, abs=1e-6)
        for name in ("attitude_error", "position_error", "is_success", "diverged"):
            assert getattr(flights, name)[i] == info[name]


def test_flights_that_diverge_are_counted_once():
    """Links so stiff that most episodes blow up on the way; what begins anew is not counted."""
    links = [link.model_dump() | {"stiffness": 200.0} for link in PAPER.links]
    simulation = {"dt": 0.1, "steps": 7, "integrator": "symplectic_euler"}
    scene = PAPER.replace(links=links, simulation=simulation)
    seeds = list(range(12))
    flights = fly(gentle, scene, seeds)
    assert flights.diverged.sum() > 0
    for i, seed in enumerate(seeds):
        cost, effort, _, info = single_episode(scene, seed, gentle)
        assert flights.cost[i] == pytest.approx(cost, rel=1e-12)
        assert flights.effort[i] == pytest.approx(effort, rel=1e-12)
        assert flights.diverged[i] == info["diverged"]
        assert (flights.length[i] < 7) == info["diverged"] or flights.length[i] == 7


def test_a_policy_that_fails_is_no_success_and_stops_nobody_else():
    """Numbers that are none, in one of three episodes: it goes on without control, the others as ever."""

    def failing(observations):
        actions = gentle(observations)
        if failing.steps > 4:
            actions[1, 3] = np.nan
        failing.steps += 1
        return actions

    failing.steps = 0
    scene = SHORT.replace(success={"attitude_error_deg": 180.0, "position_error": 100.0})
    flights, whole = (fly(policy, scene, [3, 4, 5]) for policy in (failing, gentle))
    assert flights.policy_failed.tolist() == [False, True, False]
    assert flights.is_success.tolist() == [True, False, True]
    assert whole.is_success.all()
    np.testing.assert_array_equal(flights.cost[[0, 2]], whole.cost[[0, 2]])
    assert np.isfinite(flights.cost[1])
    assert flights.effort[1] < whole.effort[1]
    evaluation = evaluate(lambda seen: np.full((len(seen), 12), np.nan), SHORT, 3, expert=False)
    assert evaluation.summary()["policy_failed"] == 3
    assert remarks([evaluation]) == [
        "<lambda> gave something that is no number in 3 episodes: they went on without control, and count as "
        "failures."
    ]


def test_a_recording_has_what_the_policy_saw():
    seen, recording = [], Recording()

    def policy(observations):
        seen.append(observations.copy())
        return gentle(observations)

    flights = fly(policy, SHORT, [3, 11], recording=recording)
    np.testing.assert_array_equal(recording.observations, np.stack(seen, axis=1))
    assert recording.states.shape == (2, 12, 23)
    kernels = compile_scene(SHORT)
    again = kernels.state_from_observation(recording.observations[:, 7])
    np.testing.assert_allclose(kernels.difference(recording.states[:, 7], again), 0.0, atol=1e-12)
    assert flights.length.tolist() == [12, 12]


def test_actions_of_a_wrong_shape_are_refused():
    with pytest.raises(ValueError, match=r"shape \(2, 3\); 2 episodes of scene 'short' want \(2, 12\)"):
        fly(lambda observations: np.zeros((2, 3)), SHORT, [1, 2])


def test_evaluation_seeds_are_fixed_and_their_own():
    seeds = evaluation_seeds(PAPER)
    assert len(set(seeds)) == EVALUATION_SEEDS == 500
    assert seeds[:2] == [3003083155383472103, 4629164122600116775]
    assert seeds[:7] == evaluation_seeds(PAPER, 7)
    training = Settings(PAPER, 1000, 0, 32)
    assert not set(seeds) & {training.problem_seed(problem) for problem in range(1000)}
    for n in (0, 501):
        with pytest.raises(ValueError, match="should be from 1 to 500"):
            evaluation_seeds(PAPER, n)


def test_optimal_costs_are_those_of_demonstrations(cache, tmp_path):
    costs = optimal_costs(QUICK, 30, executor=SerialExecutor())
    from agents.evaluation.expert_costs import GROUP, SEED_OF_SEEDS

    demonstrations = generate_demonstrations(
        QUICK, GROUP, tmp_path / "same", SEED_OF_SEEDS, shard_size=GROUP, executor=SerialExecutor()
    )
    expected = {demonstration.seed: demonstration.cost for demonstration in demonstrations}
    assert len(expected) > 20
    known = {seed: cost for seed, cost in zip(costs.seeds, costs.cost, strict=True) if seed in expected}
    assert known == expected
    assert (costs.seconds > 0.0).all()


def test_optimal_costs_are_computed_once_and_go_on_where_they_were(cache):
    executor = Counting(limit=1)
    with pytest.raises(KeyboardInterrupt):
        optimal_costs(QUICK, 60, executor=executor)
    seen = []
    executor = Counting()
    first = optimal_costs(QUICK, 60, executor=executor, progress=lambda *done: seen.append(done))
    assert executor.tasks == 2
    assert seen == [(25, 60), (50, 60), (60, 60)]
    executor = Counting()
    again = optimal_costs(QUICK, 60, executor=executor)
    assert executor.tasks == 0
    np.testing.assert_array_equal(again.cost, first.cost)
    damaged = sorted(cache.rglob("*.json"))[1]
    damaged.write_text(damaged.read_text()[:-7])
    repaired = optimal_costs(QUICK, 60, executor=executor)
    assert executor.tasks == 1
    np.testing.assert_array_equal(repaired.cost, first.cost)


def test_optimal_costs_of_another_scene_are_others(cache):
    optimal_costs(QUICK, 1, executor=SerialExecutor())
    executor = Counting()
    optimal_costs(QUICK.replace(name="renamed"), 1, executor=executor)
    assert executor.tasks == 0
    optimal_costs(QUICK.replace(success={"position_error": 0.2}), 1, executor=executor)
    assert executor.tasks == 1


def test_the_optimal_actions_have_no_gap(cache, tmp_path):
    """The expert's own actions, from the same starts: every gap is zero, every flight a success."""
    from agents.evaluation.expert_costs import GROUP, SEED_OF_SEEDS

    demonstrations = generate_demonstrations(
        QUICK, GROUP, tmp_path / "same", SEED_OF_SEEDS, shard_size=GROUP, executor=SerialExecutor()
    )
    plans = {demonstration.seed: demonstration.actions for demonstration in demonstrations}

    class Replay:
        def begin(self, environment):
            self.step, self.copies = 0, environment.num_envs

        def __call__(self, observations):
            self.step += 1
            idle = np.zeros((150, environment_inputs))
            return np.array([plans.get(seed, idle)[self.step - 1] for seed in seeds[: self.copies]])

    seeds = evaluation_seeds(QUICK, GROUP)
    environment_inputs = demonstrations[0].actions.shape[1]
    flights = fly(Replay(), QUICK, seeds)
    optimal = optimal_costs(QUICK, GROUP, executor=SerialExecutor())
    planned = np.isin(seeds, list(plans))
    np.testing.assert_allclose(flights.cost[planned], optimal.cost[planned], rtol=1e-9)
    assert flights.is_success[planned].all()
    evaluation = evaluate(Replay(), QUICK, GROUP, executor=SerialExecutor())
    assert evaluation.summary()["cheaper_than_expert"] == 0
    dearer = evaluation.optimal._replace(cost=1.01 * optimal.cost)
    assert replace(evaluation, optimal=dearer).summary()["cheaper_than_expert"] == planned.sum()


def test_an_evaluation_reports_what_the_protocol_asks_for(cache):
    n_u, evaluation = 5, None
    environment = gymnasium.make("DQSpaceArm-v0", scene=QUICK)
    n_u = environment.action_space.shape[0]

    def idle(observations):
        return np.zeros((len(observations), n_u))

    evaluation = evaluate(idle, QUICK, 10, executor=SerialExecutor())
    summary = evaluation.summary()
    json.dumps(summary, allow_nan=False)
    assert summary["policy"] == "idle"
    assert summary["episodes"] == 10
    assert summary["success_rate"][0] == evaluation.flights.is_success.mean()
    gaps = evaluation.flights.cost / evaluation.optimal.cost - 1.0
    assert (gaps[~np.isnan(gaps)] > 0.0).all()
    assert summary["median_cost_gap"][0] == pytest.approx(np.nanmedian(gaps))
    assert summary["tail_cost_gap"][0] == pytest.approx(np.nanpercentile(gaps, 95))
    assert summary["effort"] == 0.0
    assert 0.0 < summary["action_seconds"] < 1e-3
    assert summary["training_steps"] is None
    without = evaluate(idle, QUICK, 10, expert=False).summary()
    assert without["median_cost_gap"] is None
    assert without["success_rate"] == summary["success_rate"]


def test_conditions_change_what_they_say():
    changed = {condition: scene_under(PAPER, condition) for condition in CONDITIONS}
    assert changed["training"] is PAPER
    assert changed["wide_starts"].spread.joint_angles == 0.75
    assert changed["light_payload"].links[2].mass == pytest.approx(7.0)
    assert changed["heavy_payload"].links[2].mass == pytest.approx(13.0)
    assert changed["heavy_payload"].links[2].inertia[1][1] == pytest.approx(0.65)
    assert changed["heavy_payload"].links[:2] == PAPER.links[:2]
    assert changed["spin"].initial_state.base_velocity[2] == pytest.approx(0.05)
    carrying = load_scene("payload")
    assert scene_under(carrying, "heavy_payload").payload.mass == pytest.approx(1.3 * carrying.payload.mass)
    assert scene_under(carrying, "heavy_payload").links == carrying.links
    with pytest.raises(ValueError, match="condition: 'rain' is unknown; there are training, wide_starts"):
        scene_under(PAPER, "rain")


def exported(n_observation=24, n_action=12, **metadata):
    rng = np.random.default_rng(0)
    return ExportedPolicy(
        weights=(rng.standard_normal((n_observation, 8)), 0.1 * rng.standard_normal((8, n_action))),
        biases=(np.zeros(8), np.zeros(n_action)),
        activation="tanh",
        mean=np.zeros(n_observation),
        scale=np.ones(n_observation),
        metadata=metadata,
    )


def test_files_functions_and_objects_are_one_policy(tmp_path):
    policy = exported(agent="stub", training={"environment_steps": 7, "seconds": 3.0, "expert_solves": 2})
    policy.save(tmp_path / "policy.npz")
    ways = [policy, tmp_path / "policy.npz", str(tmp_path), lambda observations: policy(observations)]
    summaries = [evaluate(way, SHORT, 5, expert=False).summary() for way in ways]
    assert len({summary["median_cost"] for summary in summaries}) == 1
    assert summaries[0]["policy"] == "stub"
    assert summaries[1]["training_steps"] == 7
    assert summaries[1]["expert_solves"] == 2


def test_what_is_no_policy_is_refused(tmp_path):
    with pytest.raises(PolicyError, match="should be a path, an ExportedPolicy"):
        as_policy(3)
    (tmp_path / "policy.txt").touch()
    with pytest.raises(PolicyError, match=r"should be an exported policy \(.npz\)"):
        as_policy(tmp_path / "policy.txt")
    (tmp_path / "model.zip").write_bytes(b"nothing")
    with pytest.raises(PolicyError, match="is no model of Stable-Baselines3"):
        as_policy(tmp_path / "model.zip")


def test_a_policy_of_the_goal_environment_sees_what_that_shows():
    """Its observations are the goal environment's own, joined in alphabetical order."""
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
            np.testing.assert_allclose(seen[step][copy], joined, atol=1e-6)
            observation = env.step(policy(joined))[0]


def test_a_policy_of_another_scene_is_refused_in_a_sentence(tmp_path):
    policy = exported(agent="stub", scene="paper")
    with pytest.raises(PolicyError, match="stub turns 24 numbers into 12 inputs, as it was trained"):
        evaluate(policy, QUICK, 3, expert=False)
    with pytest.raises(PolicyError, match=r"cannot fly alone: use `dq-space-arm compare residual`"):
        evaluate(exported(agent="stub", observation="residual"), SHORT, 3, expert=False)
    with pytest.raises(PolicyError, match="scene 'short' shows 24 and has 12"):
        evaluate(exported(n_observation=31), SHORT, 3, expert=False)


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


def test_records_give_evaluations_back(cache):
    n_u = load_n_u(QUICK)
    evaluation = evaluate(
        lambda observations: np.zeros((len(observations), n_u)), QUICK, 4, executor=SerialExecutor()
    )
    text = json.dumps(evaluation_record(evaluation), allow_nan=False)
    again = evaluation_of(json.loads(text))
    assert again.summary() == evaluation.summary()
    for old, new in zip(evaluation.flights, again.flights, strict=True):
        np.testing.assert_array_equal(new, old)


def load_n_u(scene):
    return compile_scene(scene).layout.n_u


def test_the_command_prints_json_for_programs(tmp_path, capsys):
    exported(agent="stub").save(tmp_path / "policy.npz")
    SHORT.to_yaml(tmp_path / "short.yaml")
    arguments = ["--policy", str(tmp_path / "policy.npz"), "--scene", str(tmp_path / "short.yaml")]
    assert (
        main(["evaluate", *arguments, "-n", "3", "--no-expert", "--json", "--condition", "training", "spin"])
        == 0
    )
    summaries = json.loads(capsys.readouterr().out)
    assert [summary["condition"] for summary in summaries] == ["training", "spin"]
    assert summaries[0]["success_rate"][0] == 0.0


def test_the_command_writes_a_table_and_every_episode(tmp_path, capsys):
    for seed in range(3):
        configuration = {"name": "stub", "seed": seed}
        exported(agent="stub", configuration=configuration).save(tmp_path / f"{seed}.npz")
    exported(agent="other", configuration={"name": "other", "seed": 0}).save(tmp_path / "3.npz")
    SHORT.to_yaml(tmp_path / "short.yaml")
    policies = [str(tmp_path / f"{number}.npz") for number in range(4)]
    arguments = ["--policy", *policies, "--scene", str(tmp_path / "short.yaml")]
    assert main(["evaluate", *arguments, "-n", "4", "--no-expert", "--out", str(tmp_path / "out")]) == 0
    printed = capsys.readouterr().out
    assert "Scene short, 4 episodes" in printed
    assert "stub, 3 runs (seeds 0, 1, 2): success 0.0 % [0.0, 0.0]" in printed
    records = [json.loads(path.read_text()) for path in sorted((tmp_path / "out").iterdir())]
    assert len(records) == 4
    assert len(records[0]["episodes"]["cost"]) == 4
    assert records[0]["episodes"]["seed"] == evaluation_seeds(SHORT, 4)


def test_the_command_refuses_what_it_cannot_use(tmp_path, capsys):
    assert main(["evaluate", str(tmp_path / "policy.npz"), "--no-expert"]) == 2
    assert "there is no such file or folder" in capsys.readouterr().err
    (tmp_path / "damaged.npz").write_bytes(b"nothing")
    assert main(["evaluate", "--policy", str(tmp_path / "damaged.npz"), "--no-expert"]) == 1
    assert "cannot be read as a policy" in capsys.readouterr().err
    assert main(["evaluate", "--policy", "nobody", "--no-expert"]) == 2
    assert "the zoo has no policy 'nobody'" in capsys.readouterr().err
    exported().save(tmp_path / "policy.npz")
    assert main(["evaluate", "--policy", str(tmp_path / "policy.npz"), "--no-expert", "-n", "501"]) == 2
    assert "should be from 1 to 500" in capsys.readouterr().err
