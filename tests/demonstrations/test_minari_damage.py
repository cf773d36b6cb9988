"""A damaged Minari data set takes one sentence."""

from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest

from agents.minari_reading import read_from_minari
from experts.demonstrations import DemonstrationsError

minari = pytest.importorskip("minari")
pytest.importorskip("h5py")

SPEC = SimpleNamespace(kwargs={"scene": {"name": "x"}})


@pytest.mark.parametrize("error", [OSError("truncated file"), KeyError("metadata"), RuntimeError("bad link")])
def test_files_that_cannot_be_opened(
    error: Exception, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def fail(dataset_id: str) -> Any:
        raise error

    monkeypatch.setattr(minari, "load_dataset", fail)
    with pytest.raises(DemonstrationsError, match="Minari cannot read the data set a/b-v0: "):
        read_from_minari("a/b-v0", tmp_path / "folder")


@pytest.mark.parametrize("metadata", [{"demonstrations": {"seed": 3}}, {"demonstrations": 3}, None])
def test_metadata_of_another_kind(metadata: Any, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    dataset = SimpleNamespace(
        storage=SimpleNamespace(metadata=metadata), spec=SimpleNamespace(env_spec=SPEC), episode_indices=[]
    )
    monkeypatch.setattr(minari, "load_dataset", lambda dataset_id: dataset)
    with pytest.raises(DemonstrationsError, match="the Minari data set a/b-v0 is damaged"):
        read_from_minari("a/b-v0", tmp_path / "folder")
