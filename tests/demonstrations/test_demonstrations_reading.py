"""Reading maps files, goes through them in batches, and splits them by problem."""

import copy
import pickle
from pathlib import Path

import numpy as np
import pytest

from experts import load_demonstrations
from experts.demonstrations import Demonstrations, DemonstrationsError
from experts.demonstrations import reading as reading_module
from experts.demonstrations.shard import SUMMARIES
from experts.demonstrations.tensors import map_tensors, pack


def test_shapes(whole: Demonstrations):
    assert len(whole) == 18
    demonstration, layout = whole[0], whole.kernels.layout
    assert demonstration.states.shape == (151, layout.n_x)
    assert demonstration.observations.shape == (151, layout.n_x + 1)
    assert demonstration.actions.shape == (150, layout.n_u)
    assert demonstration.rewards.shape == (150,)
    assert demonstration.feedback_gains.shape == (150, layout.n_u, layout.n_t)
    assert demonstration.facts["stop_reason"] == "converged"
    assert demonstration.facts["guess"] in ("policy", "screw motion", "zero controls", "neighbor")
    for name in SUMMARIES:
        assert whole.column(name).shape[0] == 18
    np.testing.assert_array_equal(whole[0].constraint_costs(), np.zeros(151))  # nothing to violate


def test_they_are_shown_in_a_line(whole: Demonstrations):
    first, where = whole[0], whole.scene.name
    assert repr(whole) == f"<18 Demonstrations in {where!r}, {str(whole.path)!r}>"
    expected = (
        f"<Demonstration {first.index} in {where!r}: seed {first.seed}, J = {first.cost:.6g}, 150 steps>"
    )
    assert repr(first) == expected


def test_arrays_are_views_of_mapped_files(whole: Demonstrations):
    demonstration = load_demonstrations(whole.path)[5]
    for array in (demonstration.states, demonstration.feedback_gains):
        assert not array.flags.writeable
        assert not array.flags.owndata
        base = array
        while isinstance(base.base, np.ndarray):
            base = base.base
        assert isinstance(base, np.memmap)


def test_few_files_are_open_at_a_time(whole: Demonstrations, monkeypatch: pytest.MonkeyPatch):
    monkeypatch.setattr(reading_module, "OPEN_SHARDS", 2)
    demonstrations = load_demonstrations(whole.path)
    costs = [demonstration.cost for demonstration in demonstrations]
    assert demonstrations._files.mapped.cache_info().currsize == 2
    assert costs == whole.column("cost").tolist()


def test_it_is_a_sequence(whole: Demonstrations):
    assert [d.index for d in whole] == list(range(18))
    assert whole[-1].index == 17
    assert [d.index for d in whole[3:9:2]] == [3, 5, 7]
    assert whole.select([9, 2]).column("index").tolist() == [9, 2]
    assert len(whole.select([])) == 0
    cheap = whole.column("cost") < np.median(whole.column("cost"))
    assert whole.select(cheap).column("index").tolist() == np.flatnonzero(cheap).tolist()
    with pytest.raises(ValueError, match=r"positions is a mask of shape \(3,\); expected \(18,\)"):
        whole.select(cheap[:3])
    with pytest.raises(TypeError, match="positions are of type float64; expected whole numbers, or a mask"):
        whole.select([0.0, 1.0])
    for wrong in (3, [[0, 1], [2, 3]]):
        with pytest.raises(ValueError, match=r"positions have shape .*; expected \(M,\)"):
            whole.select(wrong)
    with pytest.raises(IndexError):
        whole[18]


def test_copies_and_pickles_open_the_files_anew(whole: Demonstrations):
    some = whole.select([9, 2])
    some[0]  # maps a file
    for twin in (pickle.loads(pickle.dumps(some)), copy.deepcopy(some)):
        assert twin.column("index").tolist() == [9, 2]
        np.testing.assert_array_equal(twin[0].actions, some[0].actions)
        assert twin.scene == some.scene


def test_a_relative_path_is_that_of_the_moment(whole: Demonstrations, monkeypatch: pytest.MonkeyPatch):
    monkeypatch.chdir(whole.path.parent)
    relative = load_demonstrations(whole.path.name)
    monkeypatch.chdir("/")
    np.testing.assert_array_equal(relative[9].actions, whole[9].actions)


def test_a_split_shares_no_problem(whole: Demonstrations):
    train, test, rest = whole.split(0.5, 0.25, 0.25, seed=1)
    assert (len(train), len(test), len(rest)) == (9, 5, 4)
    together = [index for part in (train, test, rest) for index in part.column("index").tolist()]
    assert sorted(together) == list(range(18))
    assert train.column("index").tolist() == whole.split(0.5, seed=1)[0].column("index").tolist()
    assert train.column("index").tolist() != whole.split(0.5, seed=2)[0].column("index").tolist()
    for fractions in ((), (0.7, 0.7), (-0.1,), (np.nan,), (0.5, np.nan)):
        with pytest.raises(ValueError, match="should be positive and at most 1 together"):
            whole.split(*fractions)
    with pytest.raises(TypeError, match="fractions: of type <U1, should be real numbers"):
        whole.split("a")


@pytest.mark.parametrize("seed", [None, 5])
def test_batches_have_every_time_step_once(
    whole: Demonstrations, seed: int | None, monkeypatch: pytest.MonkeyPatch
):
    monkeypatch.setattr(reading_module, "MIXED", 4)
    names = ("observations", "actions", "rewards", "feedback_gains")
    batches = list(whole.batches(64, names, seed=seed))
    assert [len(batch.stage) for batch in batches] == [64] * 42 + [18 * 150 - 42 * 64]
    seen = [(d, k) for b in batches for d, k in zip(b.demonstration.tolist(), b.stage.tolist(), strict=True)]
    everything = [(d, k) for d in range(18) for k in range(150)]
    assert sorted(seen) == everything
    assert (seen == everything) == (seed is None)
    batch = batches[7]
    for row, (d, k) in enumerate(zip(batch.demonstration, batch.stage, strict=True)):
        for name in names:
            np.testing.assert_array_equal(batch.arrays[name][row], getattr(whole[int(d)], name)[k])
    assert len(list(whole.batches(64, seed=seed, drop_last=True))) == 42


def test_shuffled_batches_repeat_with_their_seed_and_mix_demonstrations(whole: Demonstrations):
    first, again, other = (next(whole.batches(50, seed=seed)) for seed in (1, 1, 2))
    np.testing.assert_array_equal(first.arrays["actions"], again.arrays["actions"])
    assert not np.array_equal(first.stage, other.stage)
    assert len(set(first.demonstration.tolist())) > 5


def test_batches_refuse_nonsense(whole: Demonstrations):
    for size in (0, 2.5):
        with pytest.raises(ValueError, match=f"size: {size}, should be a whole number of at least 1"):
            whole.batches(size)
    with pytest.raises(ValueError, match="velocities: unknown; choose from states"):
        whole.batches(10, ("states", "velocities"))
    with pytest.raises(ValueError, match="price: unknown; choose from index"):
        whole.column("price")


def test_tangent_coordinates_are_those_of_the_kernels(whole: Demonstrations):
    demonstration, kernels = whole[4], whole.kernels
    deviations = np.random.default_rng(0).normal(scale=0.1, size=(151, kernels.n_t))
    moved = kernels.retract(demonstration.states, deviations)
    np.testing.assert_allclose(whole.tangent(demonstration.states, moved), deviations, rtol=0, atol=1e-9)
    # One reference for several states.
    one = whole.tangent(demonstration.states[3], demonstration.states[:6])
    assert one.shape == (6, kernels.n_t)
    np.testing.assert_allclose(one[3], 0.0, rtol=0, atol=1e-12)
    for states in (0.0, demonstration.states[:, :5]):
        with pytest.raises(ValueError, match=rf"states have shape .*; expected \(\.\.\., {kernels.n_x}\)"):
            whole.tangent(states, states)


def test_a_folder_that_is_none_is_refused(tmp_path: Path):
    with pytest.raises(DemonstrationsError, match=r"holds no demonstrations: it has no settings.json"):
        load_demonstrations(tmp_path)


def test_damage_is_named(folder: Path):
    path = next((folder / "shards").iterdir())
    content = path.read_bytes()
    path.write_bytes(content[:-1])
    with pytest.raises(DemonstrationsError, match=f"has {len(content) - 1} bytes instead of {len(content)}"):
        load_demonstrations(folder)
    path.unlink()
    with pytest.raises(DemonstrationsError, match="is missing"):
        load_demonstrations(folder)
    (folder / "manifest.json").write_text("{")
    with pytest.raises(DemonstrationsError, match=r"manifest.json cannot be read"):
        load_demonstrations(folder)


def test_other_formats_are_refused(folder: Path):
    path = folder / "settings.json"
    path.write_text(path.read_text().replace('"format": 1', '"format": 2'))
    with pytest.raises(DemonstrationsError, match="has format 2, this version reads 1"):
        load_demonstrations(folder)


def test_files_are_safetensors_and_equal_arrays_give_equal_bytes(tmp_path: Path):
    from safetensors.numpy import load_file

    arrays = {
        "b": np.arange(6.0).reshape(2, 3),
        "a": np.ones((1, 2), dtype=np.float32),
        "none": np.zeros((0, 3)),
        "c": np.arange(3, dtype=np.uint8),
        "d": np.arange(4),
    }
    content = pack(arrays, {"z": 1, "a": ["x"]})
    assert content == pack(dict(reversed(arrays.items())), {"a": ["x"], "z": 1})
    path = tmp_path / "file.safetensors"
    path.write_bytes(content)
    mapped = map_tensors(path)
    assert mapped.notes == {"z": 1, "a": ["x"]}
    for read in (load_file(path), mapped.arrays):
        assert set(read) == set(arrays)
        for name, array in arrays.items():
            assert read[name].dtype == array.dtype
            np.testing.assert_array_equal(read[name], array)
    for damaged in (b"", b"\xff" * 100, content[:40]):
        path.write_bytes(damaged)
        with pytest.raises(DemonstrationsError, match="cannot be read"):
            map_tensors(path)
