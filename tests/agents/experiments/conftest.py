"""A training of a quarter of a second, as a file and as a configuration."""

from pathlib import Path

import pytest

from agents.configuration import AgentConfiguration, load_configuration
from dq_space_arm_env.validation import dump_yaml


@pytest.fixture
def settings(small_file: Path) -> dict:
    return {
        "name": "quick",
        "scene": str(small_file),
        "network": {"hidden": [12]},
        "algorithm": {"name": "APG", "updates": 40, "copies": 8, "decisions": 40, "starts": 64},
        "progression": {"evaluate_every": 20, "evaluation_episodes": 8, "checkpoint_every": 20},
    }


@pytest.fixture
def configuration(settings: dict) -> AgentConfiguration:
    return load_configuration(settings)


@pytest.fixture
def configuration_file(settings: dict, tmp_path: Path) -> Path:
    path = tmp_path / "quick.yaml"
    path.write_text(dump_yaml(settings, ""))
    return path
