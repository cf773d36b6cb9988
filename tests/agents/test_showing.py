"""A flight beside the expert's solution: the same start, the right numbers, pictures, and the script."""

import importlib.util
import json
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

from agents.evaluation import evaluate, evaluation_seeds
from agents.evaluation.policies import as_policy
from agents.policies import ExportedPolicy
from agents.showing import fly_beside_expert
from dq_space_arm_env import load_scene
from experts import GuidedDDP
from experts.arm_problem import ArmProblem

QUICK = load_scene("planar").replace(name="quick", simulation={"dt": 0.1, "steps": 150})
"""Its problems are solved in hundredths of a second; the same as in the tests of the evaluation."""
ROOT = Path(__file__).parents[2]


def load_script():
    spec = importlib.util.spec_from_file_location("evaluate_policy", ROOT / "scripts" / "evaluate_policy.py")
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


class Expert:
    """The expert's controls, flown by an agent that solves where it starts."""

    def __init__(self):
        self.problem = ArmProblem(QUICK)
        self.solver = GuidedDDP(self.problem)

    def begin(self, environment):
        self.actions = self.solver.solve(environment.states[0]).controls / self.problem.control_upper
        self.stage = 0

    def __call__(self, observations):
        self.stage += 1
        return self.actions[None, self.stage - 1]


@pytest.fixture
def exported(tmp_path):
    rng = np.random.default_rng(0)
    policy = ExportedPolicy(
        weights=(0.01 * rng.standard_normal((14, 6)),),
        biases=(np.zeros(6),),
        activation="tanh",
        mean=np.zeros(14),
        scale=np.ones(14),
        metadata={"agent": "stub", "scene": str(tmp_path / "quick.yaml")},
    )
    policy.save(tmp_path / "policy.npz")
    QUICK.to_yaml(tmp_path / "quick.yaml")
    return tmp_path / "policy.npz"


def test_the_experts_own_controls_have_no_gap():
    nominal, drawn = fly_beside_expert(as_policy(Expert()), QUICK, [None, 5])
    for pair in (nominal, drawn):
        assert pair.converged
        assert pair.cost_gap == pytest.approx(0.0, abs=1e-9)
        np.testing.assert_allclose(pair.agent.maneuver.states, pair.expert.maneuver.states, atol=1e-9)
        assert pair.agent.is_success
        assert pair.agent.effort == pytest.approx(pair.expert.effort)
    np.testing.assert_array_equal(nominal.agent.maneuver.states[0], ArmProblem(QUICK).initial_state)


def test_a_flight_is_that_of_an_evaluation(exported):
    """The same seed, the same policy: cost, errors and effort agree."""
    seed = evaluation_seeds(QUICK, 1)[0]
    (pair,) = fly_beside_expert(as_policy(exported), QUICK, [seed])
    flights = evaluate(exported, QUICK, 1, expert=False).flights
    assert pair.agent.cost == pytest.approx(flights.cost[0], rel=1e-12)
    assert pair.agent.attitude_error == pytest.approx(flights.attitude_error[0], rel=1e-9)
    assert pair.agent.position_error == pytest.approx(flights.position_error[0], rel=1e-9)
    assert pair.agent.effort == pytest.approx(flights.effort[0], rel=1e-9)
    json.dumps(pair.record(), allow_nan=False)


def test_a_scene_that_draws_its_target_is_refused():
    scene = load_scene("random-target").replace(simulation={"dt": 0.015, "steps": 4})
    with pytest.raises(ValueError, match="draws more than the start for each episode"):
        fly_beside_expert(as_policy(lambda observations: np.zeros((1, 12))), scene, [0])


def test_the_script_writes_numbers_and_pictures(exported, tmp_path, capsys):
    pytest.importorskip("matplotlib")
    out = tmp_path / "out"
    script = load_script()
    assert script.main(["--policy", str(exported), "-n", "2", "--out", str(out)]) == 1
    printed = capsys.readouterr().out
    assert "nominal" in printed
    assert "seed 0" in printed
    assert {path.name for path in out.iterdir()} == {"flight.json", "errors.png", "inputs.png"}
    flights = json.loads((out / "flight.json").read_text())["flights"]
    assert [flight["seed"] for flight in flights] == [None, 0]
    assert flights[0]["expert"]["is_success"]
    assert flights[0]["cost_gap"] > 0.0
    assert script.main(["--policy", str(exported), "-n", "0", "--out", str(out)]) == 2
    assert "-n: 0, should be at least 1" in capsys.readouterr().err
    assert script.main(["--policy", "nobody", "--out", str(out)]) == 2
    assert "the zoo has no policy 'nobody'" in capsys.readouterr().err


def test_without_pillow_a_gif_is_refused_before_anything_flies(exported, tmp_path, monkeypatch, capsys):
    monkeypatch.setattr("agents.showing.command.find_spec", lambda name: None)
    out = tmp_path / "out"
    options = ["--gif", str(tmp_path / "flight.gif"), "--out", str(out)]
    assert load_script().main(["--policy", str(exported), *options]) == 2
    assert 'pip install "dq-space-arm[plots]"' in " ".join(capsys.readouterr().err.split())
    assert not out.exists()


def test_the_script_draws_the_flight(exported, tmp_path):
    image = pytest.importorskip("PIL.Image")
    options = ["--no-picture", "--out", str(tmp_path), "--gif", str(tmp_path / "flight.gif")]
    assert load_script().main(["--policy", str(exported), *options]) == 1
    with image.open(tmp_path / "flight.gif") as picture:
        assert picture.size == (640, 480)
        assert picture.n_frames == 151


def test_the_script_needs_neither_torch_nor_matplotlib(exported, tmp_path):
    """In a process where neither can be imported: the core install."""
    code = """
import sys

class Missing:
    def find_spec(self, name, path=None, target=None):
        if name.partition(".")[0] in ("matplotlib", "stable_baselines3", "torch"):
            raise ModuleNotFoundError(f"No module named {name!r}", name=name)

sys.meta_path.insert(0, Missing())
import importlib.util
found = importlib.util.find_spec
importlib.util.find_spec = lambda name, package=None: None if name == "matplotlib" else found(name, package)
import runpy
sys.argv = sys.argv[1:]
runpy.run_path(sys.argv[0], run_name="__main__")
"""
    script = str(ROOT / "scripts" / "evaluate_policy.py")
    arguments = [script, "--policy", str(exported), "--out", str(tmp_path / "out")]
    command = [sys.executable, "-c", code, *arguments]
    result = subprocess.run(command, capture_output=True, text=True, cwd=ROOT, check=False)
    assert result.returncode == 1, result.stderr
    assert "No picture: it needs matplotlib" in result.stdout
    assert "does NOT reach the target" in result.stdout
