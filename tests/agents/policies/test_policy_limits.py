"""Policies that would overflow, or take more memory than they have weights, are refused by name."""

import json
import zipfile
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from agents.policies import ExportedPolicy
from agents.policies.exported import PolicyFileError


def parts(**changes: Any) -> dict[str, Any]:
    shapes = ((3, 4), (4, 2))
    return {
        "weights": tuple(np.ones(shape, dtype=np.float32) for shape in shapes),
        "biases": tuple(np.zeros(shape[1], dtype=np.float32) for shape in shapes),
        "activation": "relu",
        "mean": np.zeros(3),
        "scale": np.ones(3),
        **changes,
    }


@pytest.mark.parametrize(
    ("changes", "said"),
    [
        ({"scale": np.full(3, 1e300)}, "scale and mean: an observation within"),
        ({"mean": np.full(3, 1e308)}, "scale and mean: an observation within"),
        (
            {
                "weights": tuple(
                    np.full(shape, 3e38, dtype=np.float32) for shape in ((3, 4), *[(4, 4)] * 9, (4, 2))
                ),
                "biases": tuple(np.zeros(size, dtype=np.float32) for size in (*[4] * 10, 2)),
            },
            r"weight_\d and bias_\d: an observation within",
        ),
    ],
)
def test_what_overflows_is_named(changes: dict[str, Any], said: str) -> None:
    with pytest.raises(ValueError, match=said):
        ExportedPolicy(**parts(**changes))


def test_what_is_accepted_acts_on_any_observation() -> None:
    policy = ExportedPolicy(**parts(scale=np.full(3, 1e150), mean=np.full(3, 1e140)))
    with np.errstate(all="raise", under="ignore"):
        for value in (1e6, -1e6, 0.0):
            assert (np.abs(policy(np.full(3, value))) <= 1.0).all()


def saved(folder: Path, **arrays: Any) -> Path:
    """A sound policy's file, some arrays of which are replaced."""
    path = folder / "policy.npz"
    ExportedPolicy(**parts(), metadata={"agent": "a"}).save(path)
    with np.load(path) as content:
        found = {name: content[name] for name in content.files}
    np.savez_compressed(path, **(found | arrays))
    return path


def refusal(path: Path) -> str:
    with pytest.raises(PolicyFileError) as caught:
        ExportedPolicy.load(path)
    return str(caught.value)


def test_metadata_nested_deep(tmp_path: Path) -> None:
    text = '{"a":' * 100_000 + "1" + "}" * 100_000
    assert "nested deeper than 64 levels" in refusal(saved(tmp_path, metadata=np.array(text)))
    assert "thousands of digits" in refusal(saved(tmp_path, metadata=np.array('{"a": ' + "9" * 5000 + "}")))


def test_a_small_file_does_not_unpack_to_gigabytes(tmp_path: Path) -> None:
    path = saved(tmp_path)
    header = "{'descr': '<f4', 'fortran_order': False, 'shape': (20000, 20000), }".ljust(117) + "\n"
    with zipfile.ZipFile(path, "a", zipfile.ZIP_DEFLATED) as archive:
        archive.writestr("weight_2.npy", b"\x93NUMPY\x01\x00\x76\x00" + header.encode() + bytes(10**6))
    sentence = refusal(path)
    assert "'weight_2': claims shape (20000, 20000) of float32" in sentence
    assert "at most" in sentence


@pytest.mark.parametrize("metadata", [{"runs": np.int64(3)}, {"a": {1, 2}}, {1: "a", "b": "c"}])
def test_metadata_of_other_values_are_named(metadata: dict[Any, Any], tmp_path: Path) -> None:
    policy = ExportedPolicy(**parts(metadata=metadata))
    with pytest.raises(TypeError, match=r"metadata: .* should be JSON values, with texts as keys"):
        policy.save(tmp_path / "policy.npz")
    assert not list(tmp_path.iterdir())


def test_what_could_not_be_read_is_not_written(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    policy, path = ExportedPolicy(**parts()), tmp_path / "policy.npz"
    policy.save(path)
    monkeypatch.setattr("agents.policies.policy_files.MOST_BYTES", 200)  # 28 weights and biases and units
    with pytest.raises(PolicyFileError, match=r"policy.npz would have \d+ bytes, .* at most 200 are read"):
        policy.save(path)
    assert "it should have at most" in refusal(path)


@pytest.mark.parametrize(
    ("arrays", "said"),
    [
        ({"weight_0": np.ones((3, 4), dtype=np.complex128)}, "holds complex128"),
        ({"weight_0": np.array("text")}, "weight_0: shape"),
        ({"activation": np.array(3)}, "activation: shape"),
        ({"normalized_limit": np.ones(3)}, "normalized_limit: shape"),
        ({"metadata": np.array(json.dumps([1]))}, "metadata: should be a mapping"),
        ({"scale": np.full(3, 1e300)}, "scale and mean"),
    ],
)
def test_arrays_of_another_kind(arrays: dict[str, Any], said: str, tmp_path: Path) -> None:
    sentence = refusal(saved(tmp_path, **arrays))
    assert "policy.npz" in sentence
    assert said in sentence
