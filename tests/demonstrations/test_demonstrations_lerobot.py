"""Demonstrations as a data set of LeRobot: every number of it, read back with pyarrow."""

import json
import re
import sys
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import gymnasium
import numpy as np
import pytest

from dq_space_arm_env.command_line import main
from dq_space_arm_env.common.locks import locked
from experts.demonstrations import Demonstrations, DemonstrationsError, export_to_lerobot, lerobot_export

pyarrow = pytest.importorskip("pyarrow")
parquet = pytest.importorskip("pyarrow.parquet")

N, STAGES = 18, 150
PLACES = ("data", "meta/episodes")


@pytest.fixture(scope="module")
def exported(whole: Demonstrations, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The data set, which nobody changes."""
    return export_to_lerobot(whole, tmp_path_factory.mktemp("lerobot") / "quick")


def read(folder: Path) -> dict[str, Any]:
    """Columns of all files below a folder, in the order in which LeRobot reads them."""
    table = pyarrow.concat_tables([parquet.read_table(path) for path in sorted(folder.glob("*/*.parquet"))])
    return {name: np.array(table[name].to_pylist()) for name in table.column_names if name != "tasks"}


def information(folder: Path) -> Mapping[str, Any]:
    return json.loads((folder / "meta" / "info.json").read_text(encoding="utf-8"))


def test_a_row_is_a_stage(exported: Path, whole: Demonstrations):
    rows = read(exported / "data")
    for name, array in (
        ("observation.state", [each.observations[:-1] for each in whole]),
        ("action", [each.actions for each in whole]),
        ("next.reward", [each.rewards for each in whole]),
        ("state", [each.states[:-1] for each in whole]),
    ):
        assert rows[name].dtype == np.float64
        np.testing.assert_array_equal(rows[name], np.concatenate(array), err_msg=name)
    np.testing.assert_array_equal(rows["index"], np.arange(N * STAGES))
    np.testing.assert_array_equal(rows["episode_index"], np.repeat(np.arange(N), STAGES))
    np.testing.assert_array_equal(rows["frame_index"], np.tile(np.arange(STAGES), N))
    np.testing.assert_allclose(rows["timestamp"], rows["frame_index"] * 0.1, rtol=1e-6)
    np.testing.assert_array_equal(np.flatnonzero(rows["next.done"]), np.arange(1, N + 1) * STAGES - 1)
    assert not rows["task_index"].any()


def test_the_features_are_those_of_the_rows(exported: Path, whole: Demonstrations):
    info = information(exported)
    assert info["codebase_version"] == "v3.0"
    assert info["fps"] == 10
    assert isinstance(info["fps"], int)
    assert (info["total_episodes"], info["total_frames"], info["total_tasks"]) == (N, N * STAGES, 1)
    assert info["splits"] == {"train": f"0:{N}"}
    schema = parquet.read_schema(exported / info["data_path"].format(chunk_index=0, file_index=0))
    assert list(info["features"]) == schema.names
    for name, feature in info["features"].items():
        (width,), kind = feature["shape"], schema.field(name).type
        if width > 1:
            assert kind.list_size == width == len(feature["names"])
            kind = kind.value_type
        assert {"double": "float64", "float": "float32"}.get(str(kind), str(kind)) == feature["dtype"]
    assert info["features"]["action"]["names"] == list(whole.kernels.layout.control.names)
    assert info["features"]["observation.state"]["names"][-1] == "time left [s]"


def test_an_episode_says_where_it_is(exported: Path, whole: Demonstrations):
    episodes = read(exported / "meta" / "episodes")
    np.testing.assert_array_equal(episodes["episode_index"], np.arange(N))
    np.testing.assert_array_equal(episodes["dataset_from_index"], np.arange(N) * STAGES)
    np.testing.assert_array_equal(episodes["dataset_to_index"], np.arange(1, N + 1) * STAGES)
    assert (episodes["length"] == STAGES).all()
    for name, column in (("problem", "index"), ("seed", "seed"), ("cost", "cost")):
        np.testing.assert_array_equal(episodes[name], whole.column(column))
    tasks = parquet.read_table(exported / "meta" / "tasks.parquet")
    assert tasks.schema.pandas_metadata["index_columns"] == ["task"]
    (table,) = (exported / "meta" / "episodes").glob("*/*.parquet")
    assert parquet.read_table(table)["tasks"].to_pylist() == [tasks["task"].to_pylist()] * N


def test_statistics_are_those_of_numpy(exported: Path):
    rows, episodes = read(exported / "data"), read(exported / "meta" / "episodes")
    stats = json.loads((exported / "meta" / "stats.json").read_text(encoding="utf-8"))
    assert set(stats) == set(rows) == set(information(exported)["features"])
    for name, column in rows.items():
        values, found = column.reshape(N * STAGES, -1).astype(np.float64), stats[name]
        np.testing.assert_array_equal(found["min"], values.min(axis=0))
        np.testing.assert_array_equal(found["max"], values.max(axis=0))
        np.testing.assert_allclose(found["mean"], values.mean(axis=0), rtol=1e-12, atol=1e-14)
        np.testing.assert_allclose(found["std"], values.std(axis=0), rtol=1e-10, atol=1e-14)
        assert found["count"] == [N * STAGES]
        parts = values.reshape(N, STAGES, -1)
        for key, share in (("q01", 0.01), ("q50", 0.5), ("q99", 0.99)):
            quantiles = np.quantile(parts, share, axis=1)
            np.testing.assert_array_equal(episodes[f"stats/{name}/{key}"], quantiles)
            np.testing.assert_allclose(found[key], quantiles.mean(axis=0), rtol=1e-12, atol=1e-14)
        np.testing.assert_array_equal(episodes[f"stats/{name}/mean"], parts.mean(axis=1))
        np.testing.assert_array_equal(episodes[f"stats/{name}/count"], np.full((N, 1), STAGES))


def test_an_episode_replays_in_the_environment_of_its_scene(exported: Path):
    rows, episodes = read(exported / "data"), read(exported / "meta" / "episodes")
    settings = json.loads((exported / "meta" / "demonstrations.json").read_text(encoding="utf-8"))
    environment = gymnasium.make("DQSpaceArm-v0", scene=settings["scene"])
    observation, _ = environment.reset(seed=int(episodes["seed"][7]))
    for row in range(7 * STAGES, 8 * STAGES):
        np.testing.assert_array_equal(observation, rows["observation.state"][row])
        np.testing.assert_array_equal(environment.unwrapped.state, rows["state"][row])
        observation, reward, terminated, _, info = environment.step(rows["action"][row])
        assert (reward, terminated) == (rows["next.reward"][row], rows["next.done"][row])
    assert info["is_success"]


def test_files_of_bounded_size_hold_the_same(
    whole: Demonstrations, exported: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
):
    monkeypatch.setattr(lerobot_export, "MEGABYTES", 0.05)
    monkeypatch.setattr(lerobot_export, "CHUNK", 2)
    monkeypatch.setattr(lerobot_export, "_ROWS", 4)
    many = export_to_lerobot(whole, tmp_path / "many")
    episodes = parquet.read_table(many / "meta" / "episodes").to_pylist()
    for part, files in zip(PLACES, (N, 2), strict=True):
        paths = sorted((many / part).glob("*/*.parquet"))
        names = [f"chunk-{i // 2:03d}/file-{i % 2:03d}.parquet" for i in range(files)]
        assert [path.relative_to(many / part).as_posix() for path in paths] == names
        expected, found = read(exported / part), read(many / part)
        for name in expected.keys() - {
            f"{kind}/{what}_index" for kind in PLACES for what in ("chunk", "file")
        }:
            np.testing.assert_array_equal(found[name], expected[name], err_msg=name)
        for row in episodes:
            place = {what: row[f"{part}/{what}"] for what in ("chunk_index", "file_index")}
            table = parquet.read_table(many / part / lerobot_export.FILES.format(**place))
            assert row["episode_index"] in table["episode_index"].to_pylist()
            assert table.nbytes < 1.2 * 0.05 * 2**20


def test_a_rate_is_an_integer_where_the_time_step_allows_it():
    assert lerobot_export._fps(0.015) == pytest.approx(200 / 3)
    assert [lerobot_export._fps(dt) for dt in (0.1, 0.02, 1 / 30)] == [10, 50, 30]


def test_an_existing_data_set_is_only_replaced_when_asked(whole: Demonstrations, tmp_path: Path):
    place = export_to_lerobot(whole[:2], tmp_path / "a" / "set", card="# Card")
    with pytest.raises(DemonstrationsError, match="exists: choose another name, or allow it"):
        export_to_lerobot(whole[:3], place)
    assert information(place)["total_episodes"] == 2
    assert (place / "README.md").read_text() == "# Card"
    export_to_lerobot(whole.select([7, 2, 4]), place, overwrite=True)
    assert read(place / "meta" / "episodes")["problem"].tolist() == [7, 2, 4]
    assert [path.name for path in place.parent.iterdir()] == ["set"]
    (tmp_path / "other").mkdir()
    (tmp_path / "other" / "work.txt").write_text("mine")
    with pytest.raises(DemonstrationsError, match=r"holds no meta/info\.json, so it is not overwritten"):
        export_to_lerobot(whole[:1], tmp_path / "other", overwrite=True)
    assert (tmp_path / "other" / "work.txt").read_text() == "mine"


def test_a_link_is_followed(whole: Demonstrations, tmp_path: Path):
    place = export_to_lerobot(whole[:2], tmp_path / "a" / "set")
    (tmp_path / "link").symlink_to(place)
    assert export_to_lerobot(whole[:3], tmp_path / "link", overwrite=True) == place
    assert (tmp_path / "link").is_symlink()
    assert information(place)["total_episodes"] == 3
    assert [path.name for path in place.parent.iterdir()] == ["set"]


@pytest.mark.parametrize("error", [KeyboardInterrupt(), OSError(28, "No space left on device")])
def test_what_stops_half_way_leaves_nothing(whole: Demonstrations, tmp_path: Path, error: BaseException):
    export_to_lerobot(whole[:2], tmp_path / "set")

    def stop(done: int) -> None:
        if done == 4:
            raise error

    for name in ("set", "new"):
        with pytest.raises((KeyboardInterrupt, DemonstrationsError)) as caught:
            export_to_lerobot(whole, tmp_path / name, overwrite=True, progress=stop)
        if isinstance(error, OSError):
            assert "No space left on device; nothing of it remains" in str(caught.value)
    assert [path.name for path in tmp_path.iterdir()] == ["set"]
    assert information(tmp_path / "set")["total_episodes"] == 2


def test_what_a_killed_process_left_is_cleared_away(whole: Demonstrations, tmp_path: Path):
    staging = tmp_path / ".set.part"
    (staging / "made" / "data").mkdir(parents=True)
    place = export_to_lerobot(whole[:2], tmp_path / "set")
    staging.mkdir()
    place.rename(staging / "replaced")  # killed between two renames
    with (
        pytest.raises(DemonstrationsError, match="another process is writing"),
        locked(staging / "lock", RuntimeError()),
    ):
        export_to_lerobot(whole, place)
    with pytest.raises(DemonstrationsError, match="exists: choose another name"):
        export_to_lerobot(whole, place)
    assert information(place)["total_episodes"] == 2
    export_to_lerobot(whole[:3], place, overwrite=True)
    assert information(place)["total_episodes"] == 3
    assert [path.name for path in tmp_path.iterdir()] == ["set"]


def test_nothing_is_not_exported(whole: Demonstrations, tmp_path: Path):
    with pytest.raises(DemonstrationsError, match="has no demonstration to export"):
        export_to_lerobot(whole[:0], tmp_path / "a" / "set")
    assert list(tmp_path.iterdir()) == []


def test_without_pyarrow_there_is_a_sentence(
    whole: Demonstrations, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
):
    monkeypatch.setitem(sys.modules, "pyarrow", None)
    monkeypatch.delitem(sys.modules, "pyarrow.parquet")
    with pytest.raises(DemonstrationsError, match=re.escape('pip install "dq-space-arm[lerobot]"')):
        export_to_lerobot(whole, tmp_path / "a" / "set")
    assert list(tmp_path.iterdir()) == []


@pytest.mark.slow
def test_the_verb_exports_with_a_data_card(
    whole: Demonstrations, tmp_path: Path, capsys: pytest.CaptureFixture[str]
):
    arguments = ["demonstrations", "export", str(whole.path), str(tmp_path / "set"), "--format", "lerobot"]
    assert main(arguments) == 0
    assert f"{tmp_path / 'set'}: 18 episodes" in capsys.readouterr().out
    card = (tmp_path / "set" / "README.md").read_text(encoding="utf-8")
    assert "- LeRobot\n" in card.split("\n---\n")[0]
    assert "\n  data_files: data/*/*.parquet\n---\n" in card
    assert "LeRobotDataset(" in card
    assert main(arguments) == 1
    assert "exists: choose another name" in " ".join(capsys.readouterr().err.split())
    assert main([*arguments, "--overwrite", "--json"]) == 0
    assert json.loads(capsys.readouterr().out)["episodes"] == N
    for option in (["--no-gains"], ["--author", "Ada"]):
        assert main([*arguments, "--overwrite", *option]) == 2
        assert "are for --format minari" in " ".join(capsys.readouterr().err.split())
