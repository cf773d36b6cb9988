"""A flight beside the expert's solution: the same start, the right numbers, pictures, and the verb."""

import json
from dataclasses import replace

import numpy as np
import pytest

from agents.evaluation import evaluate, evaluation_seeds
from agents.evaluation.beside_expert import fly_beside_expert
from agents.evaluation.plan_followers import onboard_follower
from agents.evaluation.showing import _table
from agents.policies import ExportedPolicy
from agents.residual.informed import _solved
from agents.zoo.finding import as_policy
from dq_space_arm_env import DQSpaceArmEnv
from dq_space_arm_env.command_line import main
from experts import BoxDDP, GuidedDDP, StopReason
from experts.problems.arm_problem import ArmProblem


class Expert:
    """The expert's controls, flown by an agent that solves where it starts."""

    def __init__(self, scene):
        self.problem = ArmProblem(scene)
        self.solver = GuidedDDP(self.problem)

    def begin(self, environment):
        solution = self.solver.solve(environment.states[0], parameters=environment.parameters[0])
        self.actions = solution.controls / self.problem.control_upper
        self.stage = 0

    def __call__(self, observations):
        self.stage += 1
        return self.actions[None, self.stage - 1]


@pytest.fixture
def exported(tmp_path, quick):
    rng = np.random.default_rng(0)
    weights = 0.01 * rng.standard_normal((14, 6))
    metadata = {"agent": "stub", "scene": str(tmp_path / "quick.yaml")}
    policy = ExportedPolicy((weights,), (np.zeros(6),), "tanh", np.zeros(14), np.ones(14), metadata=metadata)
    policy.save(tmp_path / "policy.npz")
    quick.to_yaml(tmp_path / "quick.yaml")
    return tmp_path / "policy.npz"


@pytest.mark.slow
def test_the_experts_own_controls_have_no_gap(quick):
    nominal, drawn = fly_beside_expert(as_policy(Expert(quick)), quick, [None, 5])
    for pair in (nominal, drawn):
        assert pair.converged
        assert pair.cost_gap == pytest.approx(0.0, abs=1e-9)
        np.testing.assert_allclose(pair.agent.maneuver.states, pair.expert.maneuver.states, rtol=0, atol=1e-9)
        assert pair.agent.is_success
        assert pair.agent.record()["effort"] == pytest.approx(pair.expert.record()["effort"])
    np.testing.assert_array_equal(nominal.agent.maneuver.states[0], ArmProblem(quick).initial_state)


def test_an_interrupted_solve_is_no_result(exported, quick, monkeypatch):
    """Nothing is written, or flown, as if the expert had failed."""

    def interrupt(record):
        raise KeyboardInterrupt

    problem, solver = ArmProblem(quick), BoxDDP(quick)
    stopped = solver.solve(callback=interrupt)
    assert stopped.stop_reason is StopReason.INTERRUPTED
    for each in (BoxDDP, GuidedDDP):
        monkeypatch.setattr(each, "solve", lambda self, *arguments, **options: stopped)
    monkeypatch.setattr(GuidedDDP, "library", ())
    start, guess, parameters = problem.initial_state, stopped.controls, problem.parameters.rows[0]
    for call in (
        lambda: fly_beside_expert(as_policy(ExportedPolicy.load(exported)), quick, [None]),
        lambda: onboard_follower(quick, feedback=True),
        lambda: _solved(problem, solver, 0, start, guess, parameters),
    ):
        with pytest.raises(KeyboardInterrupt):
            call()


def test_a_flight_is_that_of_an_evaluation(exported, quick):
    """The same seed, the same policy: cost, errors and effort agree."""
    seed = evaluation_seeds(quick, 1)[0]
    (pair,) = fly_beside_expert(as_policy(exported), quick, [seed])
    maneuver = pair.agent.maneuver
    moving = maneuver.scene.replace(success={"velocity_error": 0.02})
    agent = replace(pair.agent, maneuver=replace(maneuver, scene=moving))
    assert _table([replace(pair, agent=agent)]).title == "Scene quick; tolerance 3°, 0.1 m, 0.02 m/s"
    flights = evaluate(exported, quick, 1, expert=False).flights
    assert pair.agent.cost == pytest.approx(flights.cost[0], rel=1e-12)
    for name in ("attitude_error", "position_error", "effort"):
        assert pair.agent.record()[name] == pytest.approx(getattr(flights, name)[0], rel=1e-9)
    json.dumps(pair.record(), allow_nan=False)


@pytest.mark.slow
def test_the_expert_knows_what_an_episode_draws(quick):
    """Target and masses are inputs of the machine code: they are given to a solve."""
    scene = quick.replace(spread={"target_position": 0.2, "link_masses": 0.3})
    (pair,) = fly_beside_expert(as_policy(Expert(scene)), scene, [5])
    assert pair.converged
    assert pair.cost_gap == pytest.approx(0.0, abs=1e-9)
    assert pair.expert.is_success
    env = DQSpaceArmEnv(scene)
    env.reset(seed=5)
    assert pair.agent.maneuver.scene == pair.expert.maneuver.scene == env.episode_scene
    assert pair.agent.record()["position_error"] == pytest.approx(pair.expert.record()["position_error"])


def test_the_verb_writes_numbers_and_pictures(exported, tmp_path, capsys):
    pytest.importorskip("matplotlib")
    out = tmp_path / "out"
    assert main(["evaluate", "show", "--policy", str(exported), "-n", "2", "--out", str(out)]) == 1
    printed = capsys.readouterr().out
    assert "seed 0" in printed
    assert {path.name for path in out.iterdir()} == {"flight.json", "errors.png", "inputs.png"}
    flights = json.loads((out / "flight.json").read_text())["flights"]
    assert [flight["seed"] for flight in flights] == [None, 0]
    assert flights[0]["expert"]["is_success"]
    assert flights[0]["cost_gap"] > 0.0
    words = ["evaluate", "show", str(exported), "--seed", "3", "--no-picture", "--out", str(out)]
    assert main(words) == 1
    assert {path.name for path in out.iterdir()} == {"flight.json"}  # the pictures showed another flight
    assert main(["evaluate", "show", "--policy", str(exported), "-n", "0", "--out", str(out)]) == 2
    assert "-n: 0, should be at least 1" in capsys.readouterr().err


def test_the_verb_refuses_an_animation_of_another_ending(exported, tmp_path, capsys):
    words = ["evaluate", "show", str(exported), "--no-picture", "--out", str(tmp_path / "out")]
    assert main([*words, "--gif", str(tmp_path / "flight.png")]) == 2
    assert "flight.png, should end in .gif" in " ".join(capsys.readouterr().err.split())
    assert not (tmp_path / "flight.png").exists()


def test_files_are_written_where_nothing_can_be_printed(exported, tmp_path, fill_output):
    fill_output()
    out = tmp_path / "out"
    assert main(["evaluate", "show", str(exported), "--no-picture", "--out", str(out)]) == 1
    assert len(json.loads((out / "flight.json").read_text())["flights"]) == 1


@pytest.mark.slow
def test_the_verb_draws_the_flight(exported, tmp_path):
    image = pytest.importorskip("PIL.Image")
    options = ["--no-picture", "--out", str(tmp_path), "--gif", str(tmp_path / "flight.gif")]
    assert main(["evaluate", "show", "--policy", str(exported), *options]) == 1
    with image.open(tmp_path / "flight.gif") as picture:
        assert picture.size == (640, 480)
        assert picture.n_frames == 151


@pytest.mark.slow
def test_the_verb_needs_neither_torch_nor_matplotlib(exported, run_without, tmp_path):
    """In a process where neither can be imported: the core install."""
    code = """
import importlib.util
found = importlib.util.find_spec
importlib.util.find_spec = lambda name, package=None: None if name == "matplotlib" else found(name, package)
from dq_space_arm_env.command_line import main
sys.exit(main(sys.argv[1:]))
"""
    arguments = ["evaluate", "show", str(exported), "--out", str(tmp_path / "out")]
    result = run_without(("matplotlib", "stable_baselines3", "torch"), code, *arguments)
    assert result.returncode == 1, result.stderr
    assert "No picture: it needs matplotlib" in result.stdout
    assert "does NOT reach the target" in result.stdout
