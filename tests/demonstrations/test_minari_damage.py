"""A Minari data set that others wrote executes nothing, and takes one sentence where it is damaged."""

import json
import os
import shutil
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from agents.minari_reading import read_from_minari
from experts.demonstrations import Demonstrations, DemonstrationsError, export_to_minari, minari_export

pytest.importorskip("minari")
h5py = pytest.importorskip("h5py")

ID = "quick/expert-v0"


@pytest.fixture(scope="module")
def exported(whole: Demonstrations, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A good data set; nobody changes it."""
    root = tmp_path_factory.mktemp("minari")
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("MINARI_DATASETS_PATH", str(root))
        export_to_minari(whole[:3], ID)
    return root


@pytest.fixture
def data(exported: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[Path]:
    """The files of a copy."""
    shutil.copytree(exported, tmp_path / "minari")
    monkeypatch.setenv("MINARI_DATASETS_PATH", str(tmp_path / "minari"))
    return tmp_path / "minari" / ID / "data"


def change_metadata(data: Path, change: Callable[[dict[str, Any]], None]) -> None:
    metadata = json.loads((data / "metadata.json").read_text())
    change(metadata)
    (data / "metadata.json").write_text(json.dumps(metadata))


@pytest.mark.slow
def test_it_comes_back(data: Path, whole: Demonstrations, tmp_path: Path) -> None:
    found = read_from_minari(ID, tmp_path / "copy")
    assert len(found) == 3
    for ours, theirs in zip(whole[:3], found, strict=True):
        for name in ("states", "observations", "actions", "rewards", "feedback_gains"):
            np.testing.assert_array_equal(getattr(ours, name), getattr(theirs, name))
        assert ours.cost == theirs.cost
    again = read_from_minari(ID, tmp_path / "copy")
    assert [each.cost for each in again] == [each.cost for each in found]


@pytest.mark.slow
def test_nothing_that_it_names_is_called(data: Path, tmp_path: Path) -> None:
    """Without its spaces, Minari makes the environment of a data set: any function of any module."""

    def trap(metadata: dict[str, Any]) -> None:
        made = json.loads(metadata["env_spec"])
        made |= {"entry_point": "os:mkdir", "kwargs": {**made["kwargs"], "path": str(tmp_path / "trapped")}}
        metadata["env_spec"] = json.dumps(made)
        del metadata["observation_space"]

    change_metadata(data, trap)
    assert len(read_from_minari(ID, tmp_path / "copy")) == 3
    assert not (tmp_path / "trapped").exists()


@pytest.mark.parametrize(
    ("name", "value", "said"),
    [
        ("demonstrations", 3, "holds no demonstrations"),
        ("demonstrations", None, "holds no demonstrations"),
        ("env_spec", "{", "is damaged .*not valid JSON"),
        ("env_spec", "{}", "holds no demonstrations"),
        ("env_spec", '{"kwargs": {"scene": {"name": "x"}}}', "is damaged"),
        ("total_episodes", 10**9, "is damaged .*has no episode_3"),
        ("total_episodes", -1, "is damaged .*should be a positive number"),
    ],
)
def test_metadata_of_another_kind(name: str, value: Any, said: str, data: Path, tmp_path: Path) -> None:
    change_metadata(data, lambda metadata: metadata.update({name: value}))
    with pytest.raises(DemonstrationsError, match=f"the Minari data set {ID} {said}"):
        read_from_minari(ID, tmp_path / "copy")


@pytest.mark.parametrize("metadata", ["", "[1]", "{" * 3000])
def test_metadata_that_is_none(metadata: str, data: Path, tmp_path: Path) -> None:
    (data / "metadata.json").write_text(metadata)
    with pytest.raises(DemonstrationsError, match=f"the Minari data set {ID} is damaged"):
        read_from_minari(ID, tmp_path / "copy")


def remove(file: Any) -> None:
    del file["episode_1/rewards"]


def claim_terabytes(file: Any) -> None:
    del file["episode_1/rewards"]
    file.create_dataset("episode_1/rewards", (2**40,), "f8", chunks=(2**10,))


def claim_a_chunk_of_gigabytes(file: Any) -> None:
    del file["episode_1/rewards"]
    file.create_dataset("episode_1/rewards", (150,), "f8", maxshape=(None,), chunks=(2**28,))


def link_elsewhere(file: Any) -> None:
    del file["episode_1/rewards"]
    file["episode_1/rewards"] = h5py.ExternalLink("/etc/passwd", "/")


def lie_elsewhere(file: Any) -> None:
    del file["episode_1/rewards"]
    file.create_dataset("episode_1/rewards", (150,), "f8", external=[("/etc/passwd", 0, 1200)])


def be_no_number(file: Any) -> None:
    file["episode_1/rewards"][3] = np.nan


def have_text(file: Any) -> None:
    file["episode_1"].attrs["cost"] = "x"


@pytest.mark.sampled
@pytest.mark.parametrize(
    ("change", "said"),
    [
        (remove, "has no rewards"),
        (claim_terabytes, r"of shape \(1099511627776,\)"),
        (claim_a_chunk_of_gigabytes, "in chunks of"),
        (link_elsewhere, "has no rewards"),
        (lie_elsewhere, "is float64 of shape"),
        (be_no_number, "should be finite"),
        (have_text, "cost: 'x', should be a number"),
    ],
)
def test_arrays_of_another_kind(change: Callable[[Any], None], said: str, data: Path, tmp_path: Path) -> None:
    with h5py.File(data / "main_data.hdf5", "r+") as file:
        change(file)
    with pytest.raises(DemonstrationsError, match=f"the Minari data set {ID} is damaged .*{said}"):
        read_from_minari(ID, tmp_path / "copy")


def abort(*arguments: object) -> None:
    os.abort()


@pytest.mark.slow
def test_a_crash_of_hdf5_is_a_sentence(
    data: Path, whole: Demonstrations, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("agents.minari_reading.packed_episodes", abort)
    with pytest.raises(DemonstrationsError, match=f"the Minari data set {ID} is damaged .*HDF5 crashes"):
        read_from_minari(ID, tmp_path / "copy")
    monkeypatch.setattr(minari_export, "_add", abort)
    with pytest.raises(DemonstrationsError, match=r"HDF5 ended the process .* nothing of it remains"):
        export_to_minari(whole[:1], "other-v0")
    assert [path.name for path in (tmp_path / "minari").iterdir()] == ["quick"]


@pytest.mark.parametrize("dataset_id", ["../expert-v0", "/etc-v0", "expert"])
def test_a_name_is_no_path(dataset_id: str, data: Path, tmp_path: Path) -> None:
    with pytest.raises(DemonstrationsError, match=r"dataset_id: .* should be a name with a version"):
        read_from_minari(dataset_id, tmp_path / "copy")
    with pytest.raises(DemonstrationsError, match="has no data set other-v0 here"):
        read_from_minari("other-v0", tmp_path / "copy")
