"""Demonstrations of scenes in which targets, masses or limits vary: their parameters are a column."""

import hashlib
import json
import shutil
from dataclasses import replace
from pathlib import Path

import gymnasium
import numpy as np
import pytest
from demonstration_files import (
    CountingExecutor,
    contents,
    ends_inside,
    replace_first_shard,
    shard_files,
    solved_problems,
)
from rich.console import Console

from dq_space_arm_env import Scene, load_scene
from dq_space_arm_env.command_line import main
from dq_space_arm_env.command_line.replaying import collect_flights
from experts import BoxDDP, StopReason, generate_demonstrations, load_demonstrations
from experts.command_line.recorded_demonstrations import read_demonstration
from experts.demonstrations import Demonstrations, DemonstrationsError, SerialExecutor
from experts.demonstrations.data_card import data_card
from experts.demonstrations.facts import gather
from experts.demonstrations.outcomes import NEIGHBOR, find_better_ways, solve_again
from experts.demonstrations.settings import Settings
from experts.demonstrations.shard import FAILURES, PARAMETERS, SUMMARIES, TRAJECTORIES, draw_starts
from experts.demonstrations.tensors import map_tensors

pytestmark = pytest.mark.slow

N, SHARD_SIZE, SEED = 9, 4, 3


@pytest.fixture(scope="module")
def drawing_scene() -> Scene:
    """A target, masses and inertias that are drawn, and a limit that is named."""
    return load_scene("planar").replace(
        name="drawing",
        simulation={"dt": 0.1, "steps": 150},
        spread={"target_rotation": 0.2, "target_position": 0.15, "base_mass": 0.1, "link_inertias": 0.1},
        parameters=("actuators.joint_torque.limit",),
    )


@pytest.fixture(scope="module")
def drawn(drawing_scene: Scene, tmp_path_factory: pytest.TempPathFactory) -> Demonstrations:
    """A complete data set, which nobody changes."""
    made = go_on(drawing_scene, tmp_path_factory.mktemp("drawing") / "drawn")
    assert made is not None
    return made


@pytest.fixture
def copied(drawn: Demonstrations, tmp_path: Path) -> Path:
    """A copy to spoil."""
    return Path(shutil.copytree(drawn.path, tmp_path / "copy"))


def go_on(scene: Scene, folder: Path, executor=None) -> Demonstrations | None:
    return generate_demonstrations(
        scene, N, folder, SEED, shard_size=SHARD_SIZE, executor=executor or SerialExecutor()
    )


def assert_is_an_episode(made: Demonstrations, position: int) -> None:
    """The environment draws the same, and the actions earn the same rewards, bit for bit."""
    env, demonstration = gymnasium.make("DQSpaceArm-v0", scene=made.scene), made[position]
    env.reset(seed=demonstration.seed)
    np.testing.assert_array_equal(env.unwrapped.parameters, demonstration.parameters)
    np.testing.assert_array_equal(env.unwrapped.state, demonstration.states[0])
    assert demonstration.episode_scene == env.unwrapped.episode_scene
    info = {}
    for k, action in enumerate(demonstration.actions):
        observation, reward, _, _, info = env.step(action)
        assert reward == demonstration.rewards[k]
        np.testing.assert_array_equal(observation, demonstration.observations[k + 1])
    assert info["is_success"]
    assert demonstration.facts["final_errors"] == [info["attitude_error"], info["position_error"]]


def test_each_is_an_episode_with_parameters_of_its_own(drawn: Demonstrations):
    assert len(drawn) == N
    for position in (0, 5, -1):
        assert_is_an_episode(drawn, position)
    rows = drawn.column(PARAMETERS)
    assert rows.shape == (N, drawn.kernels.n_p) == (N, 9)
    assert rows.dtype == np.float64
    assert (rows[:, :-1].std(axis=0) > 0.0).all()
    np.testing.assert_array_equal(rows[:, -1], 2.0)  # named, not drawn
    np.testing.assert_array_equal(drawn.select([7, 2]).column(PARAMETERS), rows[[7, 2]])


@pytest.mark.parametrize("name", ["random-target", "random-masses"])
def test_shipped_scenes_that_draw_have_the_scene_of_the_episode(name: str, tmp_path: Path):
    # Steps so coarse err by more than the environment lets pass, and the expert plans with whole ones.
    scene = load_scene(name).replace(simulation={"dt": 0.3, "steps": 75, "tolerance": "off"})
    made = generate_demonstrations(scene, 2, tmp_path, SEED, executor=SerialExecutor())
    assert isinstance(made, Demonstrations)
    assert len(made) == 2
    assert_is_an_episode(made, 1)


def test_where_nothing_varies_there_is_no_column(whole: Demonstrations):
    arrays = map_tensors(shard_files(whole.path)[0]).arrays
    assert set(arrays) == {*TRAJECTORIES, *SUMMARIES, *(f"failures.{name}" for name in FAILURES)}
    assert whole[0].parameters.shape == (0,)
    env = gymnasium.make("DQSpaceArm-v0", scene=whole.scene)
    env.reset(seed=whole[0].seed)
    assert whole[0].episode_scene == env.unwrapped.episode_scene
    assert PARAMETERS not in whole.failures()
    with pytest.raises(ValueError, match="parameters: unknown"):
        whole.column(PARAMETERS)


def test_it_is_optimal_for_its_own_target_masses_and_limits(drawn: Demonstrations):
    solver = BoxDDP(drawn.scene)
    demonstration = next(each for each in drawn if ends_inside(each))
    limits = drawn.kernels.layout.limits_with(demonstration.parameters)
    controls = np.clip(demonstration.actions * limits, -limits, limits)
    given = {"u_init": controls, "parameters": demonstration.parameters}
    solution = solver.solve(demonstration.states[0], **given)
    assert solution.iterations == 0
    assert solution.cost == pytest.approx(demonstration.cost, rel=1e-9)
    nominal = solver.solve(demonstration.states[0], controls)
    assert nominal.cost != pytest.approx(demonstration.cost, rel=1e-3)


def test_batches_have_the_parameters_of_each_time_step(drawn: Demonstrations):
    batch = next(drawn.batches(100, ("observations", PARAMETERS), seed=0))
    expected = drawn.column(PARAMETERS)[batch.demonstration]
    np.testing.assert_array_equal(batch.arrays[PARAMETERS], expected)


def test_an_interrupted_run_is_resumed_to_the_same_bytes(
    drawn: Demonstrations, drawing_scene: Scene, tmp_path: Path
):
    first, second = CountingExecutor(most=1), CountingExecutor()
    with pytest.raises(KeyboardInterrupt):
        go_on(drawing_scene, tmp_path, first)
    assert go_on(drawing_scene, tmp_path, second) is not None
    assert sorted(first.made + second.made) == [0, 1, 2]
    assert contents(tmp_path) == contents(drawn.path)


def test_failures_keep_their_parameters(drawing_scene: Scene, tmp_path: Path):
    """The errors at start and end are to the target that was drawn."""
    spread = {**drawing_scene.spread.model_dump(), "target_position": 2.0}
    made = generate_demonstrations(
        drawing_scene.replace(spread=spread), 8, tmp_path, shard_size=8, executor=SerialExecutor()
    )
    assert made is not None
    failures = made.failures()
    assert len(failures["index"])
    starts = draw_starts(made.scene, failures["seed"].tolist())
    np.testing.assert_array_equal(failures[PARAMETERS], starts.parameters)
    np.testing.assert_array_equal(failures["start"], starts.states)
    env = gymnasium.make("DQSpaceArm-v0", scene=made.scene)
    _, info = env.reset(seed=int(failures["seed"][0]))
    found = gather(made).failures["start_errors"][0]
    assert found == pytest.approx([info["attitude_error"], info["position_error"]], rel=1e-9)


@pytest.mark.parametrize(
    ("name", "change", "said"),
    [
        ("parameters", lambda rows: None, "parameters is missing"),
        ("failures.parameters", lambda rows: None, "failures.parameters is missing"),
        ("parameters", lambda rows: rows[:, :-1], "parameters has shape (4, 8)"),
        ("parameters", lambda rows: rows.astype(np.float32), "of float32"),
        ("parameters", lambda rows: np.where(rows == rows[2], np.nan, rows), "parameters should be finite"),
    ],
)
def test_damaged_columns_are_refused(copied: Path, name: str, change, said: str):
    replace_first_shard(copied, **{name: change(map_tensors(shard_files(copied)[0]).arrays[name].copy())})
    demonstrations = load_demonstrations(copied)
    with pytest.raises(DemonstrationsError) as caught:
        demonstrations[0]
    assert said in str(caught.value)


def test_parameters_that_no_scene_may_have_are_refused(copied: Path):
    rows = map_tensors(shard_files(copied)[0]).arrays[PARAMETERS].copy()
    replace_first_shard(copied, parameters=-rows)
    with pytest.raises(DemonstrationsError, match=r"demonstration 1 is damaged: (?s:.*)base\.mass"):
        _ = load_demonstrations(copied)[1].episode_scene


def test_a_shard_with_a_column_of_earlier_versions_reads_as_ever(copied: Path):
    count = len(map_tensors(shard_files(copied)[0]).arrays["index"])
    expected = load_demonstrations(copied)[0]
    replace_first_shard(copied, emphasis=np.ones(count))
    read = load_demonstrations(copied)
    np.testing.assert_array_equal(read[0].actions, expected.actions)
    assert read[0].facts == expected.facts


def test_a_poor_minimum_is_found_out_by_a_neighbor_with_another_target(drawing_scene: Scene):
    expert, outcomes = solved_problems(Settings.of(drawing_scene, 12, SEED, 12))
    old = outcomes[5]
    poor = BoxDDP(expert.problem, max_iterations=1)
    solution = poor.solve(old.start, parameters=old.parameters)
    assert solution.cost > 1.002 * old.solution.cost
    reason = StopReason.MAX_ITERATIONS.value
    outcomes[5] = replace(old, solution=solution, guess="zero controls", reason=reason)
    retries = find_better_ways(expert, outcomes)
    assert 5 in [retry.position for retry in retries]
    solve_again(expert, outcomes, retries)
    assert outcomes[5].guess == NEIGHBOR
    assert outcomes[5].solution.cost == pytest.approx(old.solution.cost, rel=1e-6)
    np.testing.assert_array_equal(outcomes[5].parameters, old.parameters)


def test_card_and_summary_name_what_varies(copied: Path, capsys: pytest.CaptureFixture[str]):
    card = data_card(gather(load_demonstrations(copied)))
    assert "| `parameters` | (9,) |" in card
    assert "| base.mass | kg | 105 |" in card
    assert main(["demonstrations", "show", str(copied), "--json"]) == 0
    shown = json.loads(capsys.readouterr().out)
    assert [row["name"] for row in shown["Parameters"]][-1] == "actuators.joint_torque.limit"
    assert main(["demonstrations", "generate", *_again(copied)]) == 0
    assert "base.mass" in (copied / "summary" / "summary.md").read_text(encoding="utf-8")
    assert (copied / "summary" / "samples.png").is_file()


def _again(folder: Path) -> list[str]:
    """Arguments of the command that made a folder."""
    load_demonstrations(folder).scene.to_yaml(folder.parent / "scene.yaml")
    sizes = ["-n", str(N), "--seed", str(SEED), "--shard-size", str(SHARD_SIZE), "--workers", "1"]
    return ["--scene", str(folder.parent / "scene.yaml"), "--out", str(folder), *sizes]


def test_a_replayed_demonstration_shows_its_own_target(drawn: Demonstrations):
    flight = read_demonstration(f"{drawn.path}#4", None)
    env = gymnasium.make("DQSpaceArm-v0", scene=drawn.scene)
    env.reset(seed=drawn[4].seed)
    np.testing.assert_array_equal(flight.target, env.unwrapped.target)
    assert not np.allclose(flight.target, drawn.kernels.layout.target, atol=1e-3)

    # Policies beside it fly with the target and the masses of the demonstration.
    sources = [(None, f"{drawn.path}#4"), (None, "zero")]
    [((_, policy), _)] = collect_flights(sources, None, Console(quiet=True))
    np.testing.assert_array_equal(policy.target, flight.target)
    np.testing.assert_array_equal(policy.states[0], flight.states[0])
    env.step(np.zeros(6))
    np.testing.assert_allclose(policy.states[1], env.unwrapped.state, rtol=0, atol=1e-14)


def test_minari_has_the_parameters_in_every_row_and_gives_them_back(
    drawn: Demonstrations, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
):
    pytest.importorskip("minari")
    pytest.importorskip("h5py")
    pytest.importorskip("torch")
    from agents.minari_reading import read_from_minari
    from experts.demonstrations import export_to_minari

    monkeypatch.setenv("MINARI_DATASETS_PATH", str(tmp_path / "minari"))
    dataset = export_to_minari(drawn, "drawing-v0")
    assert "base.mass [kg]" in dataset.storage.metadata["description"]
    for episode, demonstration in zip(dataset.iterate_episodes(), drawn, strict=True):
        expected = np.tile(demonstration.parameters, (151, 1))
        np.testing.assert_array_equal(episode.infos[PARAMETERS], expected)
        final = [episode.infos[f"{what}_error"][-1] for what in ("attitude", "position")]
        assert final == pytest.approx(demonstration.facts["final_errors"], rel=1e-6, abs=1e-5)
    read = read_from_minari("drawing-v0", tmp_path / "read")
    for name in (PARAMETERS, "seed", "cost"):
        np.testing.assert_array_equal(read.column(name), drawn.column(name))
    assert read.failures()[PARAMETERS].shape == (0, 9)
    assert read[3].episode_scene == drawn[3].episode_scene


def test_the_bytes_are_those_of_the_name(drawn: Demonstrations):
    for path in shard_files(drawn.path):
        assert hashlib.sha256(path.read_bytes()).hexdigest() in path.name
    assert len(load_demonstrations(drawn.path, verify=True)) == N
