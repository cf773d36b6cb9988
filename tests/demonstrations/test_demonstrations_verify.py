"""Verification covers every byte that demonstrations follow from; manifests are checked, then believed."""

import hashlib
import json
import os
import random
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from demonstration_files import replace_first_shard, rewrite

from dq_space_arm_env.common.bounded_reading import TEXT_BYTES
from experts import load_demonstrations
from experts.demonstrations import DemonstrationsError


def refusal(folder: Path, **options: bool) -> str:
    with pytest.raises(DemonstrationsError) as caught:
        load_demonstrations(folder, **options)
    return str(caught.value)


def test_a_sound_folder_is_verified(folder: Path) -> None:
    assert len(load_demonstrations(folder, verify=True)) == 18


def test_the_manifest_of_many_shards_is_read(folder: Path) -> None:
    path = folder / "manifest.json"
    path.write_text(path.read_text() + " " * TEXT_BYTES)  # as large as that of 31,000 shards
    assert len(load_demonstrations(folder)) == 18
    assert "manifest.json is damaged" in refusal(folder, verify=True)


def test_edited_settings_are_found(folder: Path) -> None:
    rewrite(folder / "settings.json", lambda settings: settings["scene"]["base"].update(mass=1e3))
    assert "settings.json is not what the demonstrations were made with" in refusal(folder, verify=True)


def test_every_bit_counts(folder: Path) -> None:
    """Flips anywhere in settings, manifest and shards, those included that leave JSON and sizes valid."""
    rng = random.Random(0)
    files = [folder / "settings.json", folder / "manifest.json", *sorted((folder / "shards").iterdir())]
    for file in files:
        content = file.read_bytes()
        for place in [0, len(content) - 1, *(rng.randrange(len(content)) for _ in range(20))]:
            damaged = bytearray(content)
            damaged[place] ^= 1 << rng.randrange(8)
            file.write_bytes(damaged)
            refusal(folder, verify=True)
        file.write_bytes(content)
    load_demonstrations(folder, verify=True)


def outside(folder: Path) -> tuple[str, str]:
    """A shard beside the folder, as a manifest may name it, and its hash."""
    (shard,) = list((folder / "shards").iterdir())[:1]
    content = shard.read_bytes()
    (folder.parent / shard.name).write_bytes(content)
    return shard.name, hashlib.sha256(content).hexdigest()


@pytest.mark.parametrize("place", ["../../{name}", "{folder}/{name}", "./{name}", "../shards/{name}"])
def test_a_manifest_does_not_point_elsewhere(folder: Path, place: str) -> None:
    name, _ = outside(folder)

    def point(manifest: Any) -> None:
        (shard,) = (shard for shard in manifest["shards"] if shard["file"] == name)
        shard["file"] = place.format(folder=folder.parent, name=name)

    rewrite(folder / "manifest.json", point)
    assert "manifest.json: file is " in refusal(folder)


@pytest.mark.skipif(os.name == "nt", reason="links need rights there")
def test_a_shard_does_not_link_elsewhere(folder: Path) -> None:
    name, _ = outside(folder)
    (folder / "shards" / name).unlink()
    (folder / "shards" / name).symlink_to(folder.parent / name)
    assert "is a link out of the folder" in refusal(folder)


@pytest.mark.parametrize(
    "change",
    [
        lambda manifest: [],
        lambda manifest: {},
        lambda manifest: manifest.pop("shards"),
        lambda manifest: manifest.update(shards=3),
        lambda manifest: manifest.update(shards=[3]),
        lambda manifest: manifest["shards"][0].pop("file"),
        lambda manifest: manifest["shards"][0].update(bytes="many"),
        lambda manifest: manifest["shards"][0].update(demonstrations=-4),
        lambda manifest: manifest["shards"][0].update(demonstrations=2**70),
        lambda manifest: manifest.update(demonstrations=10**6),
        lambda manifest: manifest.update(demonstrations=True),
        lambda manifest: manifest.pop("failures"),
        lambda manifest: manifest.pop("settings_sha256"),
    ],
)
def test_malformed_manifests(folder: Path, change: Callable[[Any], Any]) -> None:
    content = json.loads((folder / "manifest.json").read_text())
    result = change(content)
    rewrite(folder / "manifest.json", lambda manifest: result if result in ([], {}) else content)
    assert "manifest.json" in refusal(folder)


@pytest.mark.parametrize(
    "change",
    [
        lambda settings: settings.pop("scene"),
        lambda settings: settings.update(scene=3),
        lambda settings: settings["scene"]["base"].update(mass=-1.0),
        lambda settings: settings.update(seed="x"),
        lambda settings: settings.update(format=[["x"] * 10**5]),
    ],
)
def test_malformed_settings(folder: Path, change: Callable[[Any], Any]) -> None:
    rewrite(folder / "settings.json", lambda settings: (change(settings), settings)[1])
    sentence = refusal(folder)
    assert str(folder) in sentence
    assert len(sentence) < 1000


@pytest.mark.parametrize(
    ("changes", "said"),
    [
        ({"states": None}, "states is missing"),
        ({"states": np.zeros((4, 3))}, "states has shape (4, 3)"),
        ({"actions": np.zeros((4, 150, 6), dtype=np.float32)}, "it should have shape (4, 150,"),
        ({"index": np.zeros(3, dtype=np.int64)}, "it should have shape (3"),
        ({"guess": np.full(4, 200, dtype=np.uint8)}, "guess has entries beyond"),
    ],
)
def test_arrays_are_those_of_the_scene(folder: Path, changes: dict[str, Any], said: str) -> None:
    replace_first_shard(folder, **changes)
    demonstrations = load_demonstrations(folder)
    with pytest.raises(DemonstrationsError) as caught:
        demonstrations[0]
    assert said in str(caught.value)


def test_training_verifies(folder: Path) -> None:
    pytest.importorskip("torch")
    from agents.configuration.schema import DemonstrationSource
    from agents.demonstrations import prepare_demonstrations

    scene = load_demonstrations(folder).scene
    source = DemonstrationSource(folder=str(folder))
    assert len(prepare_demonstrations(source, scene, folder.parent / "unused")) == 18
    shard = min((folder / "shards").iterdir())
    content = bytearray(shard.read_bytes())
    content[-100] ^= 1
    shard.write_bytes(content)
    with pytest.raises(DemonstrationsError, match="is damaged: its hash"):
        prepare_demonstrations(source, scene, folder.parent / "unused")
