"""Demonstrations of a scene with constraints and phases, exported with what the environment reports."""

import json
from dataclasses import replace
from pathlib import Path
from typing import Any

import gymnasium
import numpy as np
import pytest

from dq_space_arm_env import DQSpaceArmEnv, Scene
from experts import generate_demonstrations
from experts.demonstrations import (
    Demonstrations,
    SerialExecutor,
    export_to_lerobot,
    export_to_minari,
)
from experts.demonstrations.data_card import data_card
from experts.demonstrations.facts import gather

pytestmark = pytest.mark.slow

COUNT, TOLERANCE = 3, 1e-9
ROUNDING = 1e-14 / TOLERANCE


@pytest.fixture(scope="module")
def scene(quick_scene: Scene) -> Scene:
    """The base becomes lighter, and a joint stops; the least violation that the expert leaves is charged."""
    return quick_scene.replace(
        name="quick-phases",
        description="Reach the target while the tank empties.",
        phases=[
            {"name": "full", "steps": 70},
            {"name": "light", "steps": 80, "changes": {"base.mass": 60}},
        ],
        constraints=[{"name": "stop", "kind": "joint_limits", "upper": 1.2, "tolerance": TOLERANCE}],
    )


@pytest.fixture(scope="module")
def made(scene: Scene, tmp_path_factory: pytest.TempPathFactory) -> Demonstrations:
    folder = tmp_path_factory.mktemp("demonstrations") / "phases"
    found = generate_demonstrations(scene, COUNT, folder, 3, executor=SerialExecutor())
    assert found is not None
    assert len(found) == COUNT
    return found


def test_the_card_tells_what_phases_change_from_what_problems_do(made: Demonstrations) -> None:
    assert "between problems besides the start; and what phases change, as the first has it" in data_card(
        gather(made)
    )


@pytest.fixture(scope="module")
def reports(made: Demonstrations) -> list[dict[str, Any]]:
    """What `info` says of each episode, flown from its seed, N + 1 rows."""
    environment, found = gymnasium.make("DQSpaceArm-v0", scene=made.scene), []
    for demonstration in made:
        _, info = environment.reset(seed=demonstration.seed)
        rows = [info, *(environment.step(action)[-1] for action in demonstration.actions)]
        found.append({name: np.array([row[name] for row in rows]) for name in ("cost", "phase")})
    assert any(report["cost"].max() > 0 for report in found)
    return found


def test_costs_are_those_of_reset_and_steps(made: Demonstrations) -> None:
    states = made[0].states.copy()
    states[0, made.kernels.layout.state.joint_angles] = 1.5
    moved, environment = replace(made[0], states=states), DQSpaceArmEnv(made.scene)
    infos = [environment.reset(options={"initial_state": states[0]})[1]]
    infos += [environment.step(action)[-1] for action in moved.actions]
    assert infos[0]["cost"] > 1.0
    np.testing.assert_array_equal(moved.constraint_costs(), [info["cost"] for info in infos])


def test_minari_has_costs_and_phases(
    made: Demonstrations, reports: list[Any], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    minari = pytest.importorskip("minari")
    monkeypatch.setenv("MINARI_DATASETS_PATH", str(tmp_path))
    dataset = export_to_minari(made, "space-arm/phases-v0")
    for episode, report in zip(
        minari.load_dataset("space-arm/phases-v0").iterate_episodes(), reports, strict=True
    ):
        for name, expected in report.items():
            np.testing.assert_allclose(episode.infos[name], expected, rtol=0, atol=ROUNDING, err_msg=name)
    described = dataset.storage.metadata["description"]
    assert (
        ", cost (violations of constraints, each over its tolerance), phase (0: full, 1: light)" in described
    )


def test_lerobot_has_costs_and_subtasks(made: Demonstrations, reports: list[Any], tmp_path: Path) -> None:
    parquet = pytest.importorskip("pyarrow.parquet")
    folder = export_to_lerobot(made, tmp_path / "phases")
    settings = json.loads((folder / "meta" / "demonstrations.json").read_text(encoding="utf-8"))
    assert Scene.model_validate(settings["scene"]) == made.scene  # limits of -inf included
    rows = parquet.read_table(folder / "data").to_pydict()
    costs = np.concatenate([each["cost"][1:] for each in reports])
    np.testing.assert_allclose(rows["next.cost"], costs, rtol=0, atol=ROUNDING)
    assert rows["subtask_index"] == np.concatenate([each["phase"][:-1] for each in reports]).tolist()
    tables = {what: parquet.read_table(folder / "meta" / f"{what}s.parquet") for what in ("task", "subtask")}
    assert tables["task"].to_pydict() == {"task_index": [0], "task": [made.scene.description]}
    assert tables["subtask"].to_pydict() == {"subtask_index": [0, 1], "subtask": ["full", "light"]}
    assert tables["subtask"].schema.pandas_metadata["index_columns"] == ["subtask"]
    # By LeRobot's rule the words of a row are those at its index.
    words = [tables["subtask"]["subtask"][index].as_py() for index in rows["subtask_index"]]
    assert words == (["full"] * 70 + ["light"] * 80) * COUNT
