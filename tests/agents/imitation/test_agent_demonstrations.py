"""Demonstrations for agents: generated, found, or from Minari, and refused where they do not fit."""

from pathlib import Path

import numpy as np
import pytest

from agents.configuration import DemonstrationSource
from agents.configuration.schema import RESERVED_SEED
from agents.demonstrations import check_scene, expert_seconds, prepare_demonstrations, stricter
from experts.demonstrations import DemonstrationsError, export_to_minari
from experts.demonstrations.shard import SUMMARIES, TRAJECTORIES

pytestmark = pytest.mark.slow

ID = "space-arm/small/expert-v0"


def test_they_are_generated_once(small_scene, tmp_path):
    source = DemonstrationSource(problems=4, seed=3)
    told = []
    made = prepare_demonstrations(source, small_scene, tmp_path, workers=1, progress=told.append)
    assert told[-1].done == 4
    seconds = expert_seconds(made)
    assert seconds > 0.0
    with (tmp_path / "log" / "part-1-of-1.jsonl").open("a") as log:
        log.write('{"shard": 1, "sec')  # by a run that was killed
    assert expert_seconds(made) == seconds
    again = []
    prepare_demonstrations(source, small_scene, tmp_path, workers=1, progress=again.append)
    assert again[0].found == 4


def test_only_tolerances_may_differ(demonstrations, small_scene, tmp_path):
    check_scene(demonstrations, stricter(small_scene, 0.5))
    assert stricter(small_scene, 0.5).success.position_error == 0.5 * small_scene.success.position_error
    source = DemonstrationSource(folder=str(demonstrations.path))
    assert len(prepare_demonstrations(source, small_scene, tmp_path / "unused")) == len(demonstrations)
    assert not (tmp_path / "unused").exists()
    heavier = small_scene.replace(cost={"pose": 99.0})
    with pytest.raises(DemonstrationsError, match=r"than 'small': cost\.pose.*only the tolerances"):
        prepare_demonstrations(source, heavier, tmp_path)


def test_starts_of_the_evaluation_are_refused(small_scene, tmp_path):
    with pytest.raises(DemonstrationsError, match="where agents are evaluated: use another seed"):
        prepare_demonstrations(DemonstrationSource(seed=RESERVED_SEED), small_scene, tmp_path)
    with pytest.raises(ValueError, match=r"demonstrations\.seed is absent: give one"):
        prepare_demonstrations(DemonstrationSource(), small_scene, tmp_path)


@pytest.fixture
def datasets(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """An empty place for the data sets of Minari."""
    pytest.importorskip("minari")
    pytest.importorskip("h5py")
    monkeypatch.setenv("MINARI_DATASETS_PATH", str(tmp_path / "minari"))


def test_what_minari_gives_back_is_what_was_exported(demonstrations, datasets, tmp_path):
    export_to_minari(demonstrations, ID)
    source = DemonstrationSource(minari=ID)
    for _ in range(2):  # the second time it is there
        read = prepare_demonstrations(source, demonstrations.scene, tmp_path / "copied")
        assert read.scene == demonstrations.scene
        assert len(read) == len(demonstrations)
    for name in SUMMARIES:
        np.testing.assert_array_equal(read.column(name), demonstrations.column(name), err_msg=name)
    for ours, theirs in zip(read, demonstrations, strict=True):
        for name in TRAJECTORIES:
            np.testing.assert_array_equal(getattr(ours, name), getattr(theirs, name), err_msg=name)
    assert not read.failures()["index"].size
    assert expert_seconds(read) == 0.0


def test_without_gains_they_can_be_cloned_plainly_only(demonstrations, datasets, tmp_path):
    pytest.importorskip("torch")
    from agents.configuration.imitation import Cloning, Dagger, ObjectiveWeights, Optimization
    from agents.imitation import aggregate, clone

    export_to_minari(demonstrations, ID, feedback_gains=False)
    read = prepare_demonstrations(DemonstrationSource(minari=ID), demonstrations.scene, tmp_path / "copied")
    few = Optimization(updates=20, batch_size=64)
    with pytest.raises(ValueError, match="have no feedback gains, which gain_weight"):
        clone(read, Cloning(optimization=few))
    plain = Cloning(objective=ObjectiveWeights(gain_weight=0.0), optimization=few)
    with pytest.raises(ValueError, match="have no feedback gains, which labels: gains follows"):
        aggregate(clone(read, plain), read, Dagger(cloning=plain, labels="gains", rounds=1))
    ours, theirs = clone(read, plain).export(), clone(demonstrations, plain).export()
    for one, other in zip(ours.weights, theirs.weights, strict=True):
        np.testing.assert_array_equal(one, other)


def test_other_data_sets_and_folders_are_refused(demonstrations, datasets, tmp_path):
    def prepare(name):
        prepare_demonstrations(DemonstrationSource(minari=name), demonstrations.scene, tmp_path / "copied")

    with pytest.raises(DemonstrationsError, match="Minari has no data set space-arm/small/expert-v0"):
        prepare(ID)
    export_to_minari(demonstrations[:2], ID)
    export_to_minari(demonstrations[:3], ID.replace("v0", "v1"))
    prepare(ID)
    with pytest.raises(DemonstrationsError, match="holds other demonstrations"):
        prepare(ID.replace("v0", "v1"))
