"""The package of agents is there without its extra, and says what to install where it is used."""

import re
import subprocess
import sys
from pathlib import Path

import pytest

import agents

WITHOUT_THE_EXTRA = """
import sys

class Missing:
    def find_spec(self, name, path=None, target=None):
        if name.partition(".")[0] in ("stable_baselines3", "torch"):
            raise ModuleNotFoundError(f"No module named {name!r}", name=name)

sys.meta_path.insert(0, Missing())
import agents
assert "DQSpaceArmVecEnv" in dir(agents)
from agents import DQSpaceArmVecEnv
"""


TRAINING = """
from agents.command_line import main
sys.exit(main(["train", "ppo", "--out", sys.argv[1]]))
"""


def run(code, *arguments):
    root = Path(agents.__file__).parents[1]
    command = [sys.executable, "-c", code, *arguments]
    return subprocess.run(command, capture_output=True, text=True, cwd=root)


def test_what_is_missing_is_named_with_the_extra():
    assert run(WITHOUT_THE_EXTRA).stderr.splitlines()[-1] == (
        'ImportError: DQSpaceArmVecEnv needs stable_baselines3: pip install "dq-space-arm[agents]"'
    )


def test_the_command_names_what_is_missing_in_a_sentence(tmp_path):
    code = WITHOUT_THE_EXTRA.partition("import agents")[0] + TRAINING
    done = run(code, str(tmp_path / "run"))
    assert done.returncode == 2
    assert re.fullmatch(r'Error: training needs \w+: pip install "dq-space-arm\[agents\]"\n', done.stderr)
    assert not (tmp_path / "run").exists()


def test_importing_loads_no_learning_library():
    code = 'import sys, agents; print({"torch", "stable_baselines3", "agents.vec_env"} & set(sys.modules))'
    assert run(code).stdout.strip() == "set()"


def test_unknown_names_are_refused():
    with pytest.raises(AttributeError, match="has no attribute 'nothing'"):
        _ = agents.nothing
