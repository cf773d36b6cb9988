"""The package of agents is there without its extra, and says what to install where it is used."""

import re

import pytest

import agents
import agents.imitation
import agents.policies
import dq_space_arm_env
import experts
from agents.configuration import load_configuration
from agents.training import with_changes

EXTRA = ("stable_baselines3", "torch")

TRAINING = """
from dq_space_arm_env.command_line import main
sys.exit(main(["train", "ppo", "--out", sys.argv[1]]))
"""


def test_what_is_missing_is_named_with_the_extra(run_without):
    code = 'import agents\nassert "DQSpaceArmVecEnv" in dir(agents)\nfrom agents import DQSpaceArmVecEnv'
    assert run_without(EXTRA, code).stderr.splitlines()[-1] == (
        'ImportError: DQSpaceArmVecEnv needs stable_baselines3: pip install "dq-space-arm[agents]"'
    )


def test_the_command_names_what_is_missing_in_a_sentence(run_without, tmp_path):
    done = run_without(EXTRA, TRAINING, tmp_path / "run")
    assert done.returncode == 2
    assert re.fullmatch(r'Error: training needs \w+: pip install "dq-space-arm\[agents\]"\n', done.stderr)
    assert not (tmp_path / "run").exists()


def test_a_scene_that_is_not_there_leaves_no_folder(tmp_path):
    pytest.importorskip("threadpoolctl")
    configuration = with_changes(load_configuration("apg"), scene=str(tmp_path / "nothing.yaml"))
    with pytest.raises(dq_space_arm_env.SceneError, match=r"nothing\.yaml: there is no such file"):
        agents.train(configuration, tmp_path / "run")
    assert not (tmp_path / "run").exists()


def test_importing_loads_no_learning_library(run_without):
    code = 'import agents; print({"torch", "stable_baselines3", "agents.vec_env"} & set(sys.modules))'
    assert run_without((), code).stdout.strip() == "set()"


@pytest.mark.agents
@pytest.mark.parametrize(
    "package",
    [agents, agents.imitation, agents.policies, dq_space_arm_env, experts],
    ids=lambda p: p.__name__,
)
def test_every_name_that_is_imported_on_first_use_is_there(package):
    pytest.importorskip("stable_baselines3")
    for name in package.__all__:
        assert getattr(package, name) is not None
