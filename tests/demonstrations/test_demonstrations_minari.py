"""Demonstrations as a Minari data set: what a user of Minari gets, and that nobody ever sees half of it."""

import os
import re
import shutil
import sys
import warnings
from collections.abc import Iterator, Sequence
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import gymnasium
import numpy as np
import pytest

from dq_space_arm_env.command_line import main
from dq_space_arm_env.common.locks import locked
from experts.demonstrations import Demonstrations, DemonstrationsError, export_to_minari, minari_export

minari = pytest.importorskip("minari")
pytest.importorskip("h5py")

ID = "space-arm/quick/expert-v0"
STAGING = ".space-arm.quick.expert-v0.part"


@pytest.fixture
def root(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """Where Minari keeps data sets."""
    monkeypatch.setenv("MINARI_DATASETS_PATH", str(tmp_path / "minari"))
    return tmp_path / "minari"


@pytest.fixture(scope="module")
def exported(whole: Demonstrations, tmp_path_factory: pytest.TempPathFactory) -> Iterator[Any]:
    """The data set, loaded anew; nobody changes it."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("MINARI_DATASETS_PATH", str(tmp_path_factory.mktemp("minari")))
        export_to_minari(whole, ID)
        yield minari.load_dataset(ID)


def recovered(dataset: Any) -> gymnasium.Env[Any, Any]:
    with warnings.catch_warnings():
        warnings.filterwarnings("ignore", "Package dq-space-arm is not installed")  # but in its checkout
        return dataset.recover_environment()


def metadata_of(dataset: Any) -> list[dict[str, Any]]:
    return list(dataset.storage.get_episode_metadata(dataset.episode_indices))


@pytest.mark.slow
def test_every_episode_fits_the_spaces(exported: Any, whole: Demonstrations):
    assert (exported.total_episodes, exported.total_steps) == (len(whole), len(whole) * 150)
    assert exported.observation_space == recovered(exported).observation_space
    for episode, metadata in zip(exported.iterate_episodes(), metadata_of(exported), strict=True):
        assert metadata["id"] == episode.id
        assert metadata["total_steps"] == len(episode) == 150
        assert len(episode.observations) == 151
        assert all(exported.observation_space.contains(row) for row in episode.observations)
        assert all(exported.action_space.contains(row) for row in episode.actions)
        for array, dtype in (
            (episode.actions, np.float64),
            (episode.rewards, np.float64),
            (episode.terminations, np.bool_),
            (episode.truncations, np.bool_),
        ):
            assert array.dtype == dtype
            assert len(array) == 150
        assert np.flatnonzero(episode.terminations).tolist() == [149]
        assert not episode.truncations.any()
        assert {len(values) for values in episode.infos.values()} == {151}


def test_an_episode_is_a_demonstration(exported: Any, whole: Demonstrations):
    for episode, demonstration in zip(exported.iterate_episodes(), whole, strict=True):
        for name in ("observations", "actions", "rewards"):
            np.testing.assert_array_equal(getattr(episode, name), getattr(demonstration, name))
        np.testing.assert_array_equal(episode.infos["state"], demonstration.states)
        gains = episode.infos["feedback_gains"]
        assert gains.dtype == np.float32
        np.testing.assert_array_equal(gains[:-1], demonstration.feedback_gains)
        assert not gains[-1].any()


def test_it_replays_in_the_recovered_environment(exported: Any):
    environment = recovered(exported)
    for episode, metadata in zip(exported.iterate_episodes(), metadata_of(exported), strict=True):
        infos = episode.infos
        observation, info = environment.reset(seed=metadata["seed"])
        for k in range(len(episode) + 1):
            np.testing.assert_array_equal(observation, episode.observations[k])
            np.testing.assert_array_equal(environment.unwrapped.state, infos["state"][k])
            assert info["attitude_error"] == pytest.approx(infos["attitude_error"][k], rel=1e-9, abs=1e-5)
            assert info["position_error"] == pytest.approx(infos["position_error"][k], rel=1e-9)
            assert info["is_success"] == infos["is_success"][k]
            if k < len(episode):
                observation, reward, terminated, truncated, info = environment.step(episode.actions[k])
                assert reward == episode.rewards[k]
                assert (terminated, truncated) == (episode.terminations[k], episode.truncations[k])


def test_the_data_set_says_where_it_comes_from(exported: Any, whole: Demonstrations):
    metadata = exported.storage.metadata
    assert metadata["algorithm_name"] == minari_export.ALGORITHM
    assert metadata["requirements"] == ["dq-space-arm>=0.1.0"]
    assert "18 optimal maneuvers of scene 'quick'" in metadata["description"]
    assert "feedback_gains" in metadata["description"]
    assert "author" not in metadata
    assert metadata["demonstrations"]["source"] == whole.settings["source"]
    # The environment is made from the scene itself: no file and no name of it is needed.
    assert exported.env_spec.id == "DQSpaceArm-v0"
    assert recovered(exported).unwrapped.scene == whole.scene
    assert list(minari.list_local_datasets()) == [ID]


@pytest.mark.slow
def test_some_demonstrations_without_gains_and_with_an_author(whole: Demonstrations, root: Path):
    dataset = export_to_minari(
        whole.select([7, 2]),
        "quick-v3",
        feedback_gains=False,
        author="Ada",
        code_permalink="a link",
        card="# Card",
    )
    assert [metadata["problem"] for metadata in metadata_of(dataset)] == [7, 2]
    assert set(dataset[0].infos) == {"state", "attitude_error", "position_error", "is_success"}
    assert "feedback_gains" not in dataset.storage.metadata["description"]
    assert dataset.storage.metadata["author"] == {"Ada"}
    assert dataset.storage.metadata["code_permalink"] == "a link"
    assert (root / "quick-v3" / "README.md").read_text() == "# Card"


@pytest.mark.slow
def test_an_existing_data_set_is_only_replaced_when_asked(whole: Demonstrations, root: Path):
    export_to_minari(whole[:2], ID)
    with pytest.raises(DemonstrationsError, match=f"the Minari data set {ID} exists"):
        export_to_minari(whole[:3], ID)
    assert minari.load_dataset(ID).total_episodes == 2
    assert export_to_minari(whole[:3], ID, overwrite=True).total_episodes == 3
    assert [path.name for path in root.iterdir()] == ["space-arm"]
    assert list(minari.list_local_datasets()) == [ID]


@pytest.mark.slow
@pytest.mark.parametrize("dataset_id", [ID, "other-v0"])
@pytest.mark.parametrize("error", [KeyboardInterrupt(), OSError(28, "No space left on device")])
def test_what_stops_half_way_leaves_nothing(
    whole: Demonstrations, root: Path, monkeypatch: pytest.MonkeyPatch, error: BaseException, dataset_id: str
):
    monkeypatch.setattr(minari_export, "PIECE", 2)
    export_to_minari(whole[:2], ID)

    def stop(done: int) -> None:
        if done == 4:
            assert list(minari.list_local_datasets()) == [ID]
            raise error

    with pytest.raises((KeyboardInterrupt, DemonstrationsError)) as caught:
        export_to_minari(whole, dataset_id, overwrite=True, progress=stop)
    if isinstance(error, OSError):
        assert "No space left on device; nothing of it remains" in str(caught.value)
    assert [path.name for path in root.iterdir()] == ["space-arm"]
    assert minari.load_dataset(ID).total_episodes == 2
    assert os.environ["MINARI_DATASETS_PATH"] == str(root)


@pytest.mark.slow
def test_what_a_killed_process_left_is_cleared_away(whole: Demonstrations, root: Path):
    (root / STAGING / "space-arm" / "quick").mkdir(parents=True)
    assert minari.list_local_datasets() == {}
    assert export_to_minari(whole[:1], ID).total_episodes == 1
    assert not (root / STAGING).exists()


@pytest.mark.slow
def test_a_data_set_is_not_lost_between_two_renames(whole: Demonstrations, root: Path):
    place = export_to_minari(whole[:2], ID).storage.data_path.parent
    (root / STAGING).mkdir()
    place.rename(root / STAGING / "replaced")  # killed here
    with pytest.raises(RuntimeError, match="stop"):
        export_to_minari(whole, ID, overwrite=True, progress=_stop)
    assert minari.load_dataset(ID).total_episodes == 2


def _stop(done: int) -> None:
    raise RuntimeError("stop")


@pytest.mark.slow
def test_a_namespace_is_not_overwritten(whole: Demonstrations, root: Path):
    export_to_minari(whole[:1], "space-v0/quick-v0")
    with pytest.raises(DemonstrationsError, match="exists"):
        export_to_minari(whole[:1], "space-v0", overwrite=True)
    assert list(minari.list_local_datasets()) == ["space-v0/quick-v0"]


@pytest.mark.slow
def test_a_data_set_is_not_deleted_with_another(whole: Demonstrations, root: Path):
    place = export_to_minari(whole[:1], ID, card="# Card").storage.data_path.parent
    assert {path.name for path in place.iterdir()} == {"data", "README.md"}
    with pytest.raises(DemonstrationsError, match=f"is in the data set {ID}, with which it would be deleted"):
        export_to_minari(whole[:1], f"{ID}/more/other-v0")
    (place / "other-v0").mkdir()  # which another program made
    with pytest.raises(DemonstrationsError, match="it holds 'other-v0' too, so it is not overwritten"):
        export_to_minari(whole[:1], ID, overwrite=True)
    assert (place / "other-v0").is_dir()


@pytest.mark.slow
def test_a_link_is_followed(whole: Demonstrations, root: Path):
    place = export_to_minari(whole[:2], ID).storage.data_path.parent
    elsewhere = place.rename(root.parent / "elsewhere")
    place.symlink_to(elsewhere)
    assert export_to_minari(whole[:1], ID, overwrite=True).total_episodes == 1
    assert place.is_symlink()
    assert {path.name for path in root.parent.iterdir()} == {"minari", "elsewhere"}
    assert [path.name for path in root.iterdir()] == ["space-arm"]


def test_two_processes_do_not_write_the_same_data_set(whole: Demonstrations, root: Path):
    (root / STAGING).mkdir(parents=True)
    with (
        locked(root / STAGING / "lock", RuntimeError()),
        pytest.raises(DemonstrationsError, match="another process is writing"),
    ):
        export_to_minari(whole, ID)
    assert export_to_minari(whole[:1], ID).total_episodes == 1


@pytest.mark.slow
def test_names_that_differ_in_a_slash_are_written_side_by_side(whole: Demonstrations, root: Path):
    names = ["space/arm-v0", "space-arm-v0"]
    export_to_minari(whole[:1], names[0], progress=lambda done: export_to_minari(whole[:1], names[1]))
    assert {*minari.list_local_datasets()} == {*names}


def test_a_disk_without_room_is_refused_before_hdf5_finds_out(
    whole: Demonstrations, root: Path, monkeypatch: pytest.MonkeyPatch
):
    monkeypatch.setattr(shutil, "disk_usage", lambda path: SimpleNamespace(free=2**20))
    with pytest.raises(DemonstrationsError, match=r"the disk has 1 MB left, but \d\d MB are needed"):
        export_to_minari(whole, ID)
    assert list(root.iterdir()) == []


@pytest.mark.parametrize(
    "name", ["", "quick", "quick-v", "/quick-v0", "../quick-v0", ".quick-v0", "a b-v0", "a/quick-v0"]
)
def test_a_name_has_to_be_one(whole: Demonstrations, root: Path, name: str):
    with pytest.raises(ValueError, match=re.escape(f"dataset_id: {name!r}, should be a name with a version")):
        export_to_minari(whole, name)
    assert not root.exists()


def test_nothing_is_not_exported(whole: Demonstrations, root: Path):
    with pytest.raises(DemonstrationsError, match="has no demonstration to export"):
        export_to_minari(whole[:0], ID)
    assert not root.exists()


@pytest.mark.parametrize("package", ["minari", "h5py"])
def test_without_minari_there_is_a_sentence(
    whole: Demonstrations, root: Path, monkeypatch: pytest.MonkeyPatch, package: str
):
    monkeypatch.setitem(sys.modules, package, None)
    with pytest.raises(DemonstrationsError, match=re.escape('pip install "dq-space-arm[minari]"')):
        export_to_minari(whole, ID)
    assert not root.exists()


def run(arguments: Sequence[str]) -> int:
    return main(["demonstrations", "export", *arguments])


@pytest.mark.slow
def test_the_verb_exports_with_a_data_card(
    whole: Demonstrations, root: Path, capsys: pytest.CaptureFixture[str]
):
    arguments = [str(whole.path), ID, "--author", "Ada", "--no-gains"]
    assert run(arguments) == 0
    assert f"{ID}: 18 episodes" in capsys.readouterr().out
    dataset = minari.load_dataset(ID)
    assert dataset.storage.metadata["author"] == {"Ada"}
    card = (root / ID / "README.md").read_text(encoding="utf-8")
    assert f'minari.load_dataset("{ID}")' in card
    assert run(arguments) == 1
    assert "exists: choose another name" in capsys.readouterr().err
    assert run([*arguments, "--overwrite"]) == 0
    assert run([str(whole.path), "quick"]) == 2
    assert run([str(root), ID]) == 1
    assert "holds no demonstrations" in " ".join(capsys.readouterr().err.split())
