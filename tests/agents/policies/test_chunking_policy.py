"""A policy of chunks of actions: its ensemble, its memory, its file, and that it needs NumPy alone."""

import pickle

import numpy as np
import pytest

from agents.policies import ChunkingPolicy, ExportedPolicy, PolicyFileError
from agents.policies.chunking import Ensemble, tensor_shapes
from agents.zoo.finding import as_policy
from agents.zoo.starting import load_start
from dq_space_arm_env import compile_scene
from dq_space_arm_env.environment.rollouts import rollout

N_OBS, N_U, CHUNK, WIDTH = 7, 3, 4, 8


def parts(n_obs=N_OBS, n_u=N_U, **changes):
    rng = np.random.default_rng(0)
    shapes = dict(tensor_shapes(n_obs, (6,), (CHUNK, WIDTH), (16, 16), n_u))
    return {
        "tensors": {name: 0.5 * rng.normal(size=shape) for name, shape in shapes.items()},
        "activation": "silu",
        "heads": 2,
        "spacing": 3,
        "weighting": 0.2,
        "mean": rng.normal(size=n_obs),
        "scale": rng.uniform(0.5, 2.0, size=n_obs),
        "metadata": {"scene": "paper"},
    } | changes


def without(*names):
    return {name: array for name, array in parts()["tensors"].items() if name not in names}


def observations(*shape):
    return np.random.default_rng(1).normal(size=(*shape, N_OBS))


def flight(policy, seen):
    policy.begin()
    return np.array([policy(each) for each in seen])


def test_a_policy_stays_what_it_was_when_the_arrays_that_it_was_made_of_change(tmp_path):
    given, seen = parts(), observations(5)
    given["tensors"] = {name: array.astype(np.float32) for name, array in given["tensors"].items()}
    policy = ChunkingPolicy(**given)
    for array in given["tensors"].values():
        array += 1.0
    policy.save(tmp_path / "policy.npz")
    np.testing.assert_array_equal(
        flight(ChunkingPolicy.load(tmp_path / "policy.npz"), seen), flight(policy, seen)
    )


def test_a_policy_is_shown_by_its_sizes():
    shown = "<ChunkingPolicy 7 -> 8 -> 3, 4 actions, silu, trained in 'paper'>"
    assert repr(ChunkingPolicy(**parts())) == shown


@pytest.mark.parametrize("weighting", [0.0, 0.2, -0.3])
def test_an_action_is_the_weighted_mean_of_all_predictions_of_it(weighting):
    rng = np.random.default_rng(2)
    chunks, spacing = rng.normal(size=(12, 2, CHUNK, N_U)), 3
    ensemble = Ensemble((2, CHUNK, N_U), spacing, weighting)
    for step in range(12):
        found = ensemble.add(chunks[step])
        predictions, weights = [], []
        for earlier in range(max(0, step - (CHUNK - 1) * spacing), step + 1):
            age = step - earlier
            before, between = divmod(age, spacing)
            after = min(before + 1, CHUNK - 1)
            share = between / spacing
            predictions.append((1 - share) * chunks[earlier, :, before] + share * chunks[earlier, :, after])
            weights.append(np.exp(weighting * age))
        np.testing.assert_allclose(
            found, np.average(predictions, axis=0, weights=weights), rtol=0, atol=1e-12
        )


def test_two_steps_are_averaged_as_by_hand():
    ensemble = Ensemble((1, 2, 1), 2, np.log(3.0))
    assert ensemble.add(np.array([[[1.0], [5.0]]])) == 1.0
    # The first chunk says 3 here, halfway from 1 to 5, and weighs three times as much as the new one's 7.
    assert ensemble.add(np.array([[[7.0], [9.0]]])) == pytest.approx((3 * 3.0 + 7.0) / 4)
    # 5 with weight 9, 8 with weight 3, 2 with weight 1.
    assert ensemble.add(np.array([[[2.0], [2.0]]])) == pytest.approx((9 * 5.0 + 3 * 8.0 + 2.0) / 13)


def test_flights_of_a_batch_are_those_flown_alone():
    policy, seen = ChunkingPolicy(**parts()), observations(20, 5)
    together = flight(policy, seen)
    assert together.shape == (20, 5, N_U)
    assert together.dtype == np.float32
    assert np.mean(np.abs(together) < 0.99) > 0.2
    for i in range(5):
        np.testing.assert_allclose(flight(policy, seen[:, i]), together[:, i], rtol=0, atol=1e-6)


def test_it_remembers_within_an_episode_and_forgets_at_the_next():
    policy, seen = ChunkingPolicy(**parts()), observations(10)
    first = flight(policy, seen)
    assert not np.array_equal(policy(seen[0]), first[0])
    np.testing.assert_array_equal(flight(policy, seen), first)
    with pytest.raises(ValueError, match=r"shape \(2, 7\), should be \(7,\).*call begin\(\)"):
        policy(seen[:2])
    with pytest.raises(ValueError, match=r"shape \(8,\), should be \(7,\) or \(B, 7\)"):
        policy(np.zeros(N_OBS + 1))


def test_rows_that_start_an_episode_forget_their_chunks_alone():
    policy, seen = ChunkingPolicy(**parts()), observations(12, 3)
    starts = np.zeros((12, 3), bool)
    starts[0] = starts[4, 1] = starts[7, 1] = starts[7, 2] = True
    policy(observations(2))  # another batch, which the first step forgets
    together = [policy.predict(*given) for given in zip(seen, [None] * 12, starts, strict=True)]
    assert {state for _, state in together} == {None}
    for i in range(3):
        alone = []
        for row, start in zip(seen[:, i], starts[:, i], strict=True):
            alone.append(policy.predict(row, None, [start])[0])
        np.testing.assert_allclose(alone, np.array([each for each, _ in together])[:, i], rtol=0, atol=1e-6)
    with pytest.raises(ValueError, match=r"episode_start: shape \(2,\), should be \(1,\)"):
        policy.predict(seen[0, 0], None, [True, False])


def test_a_batch_may_be_empty():
    assert ChunkingPolicy(**parts())(np.empty((0, N_OBS))).shape == (0, N_U)


def test_every_rollout_begins_anew(small_scene):
    kernels = compile_scene(small_scene)
    n_obs = len(kernels.observation(kernels.layout.initial_state, [1.0])[0])
    policy = ChunkingPolicy(**parts(n_obs, kernels.n_u, metadata={}))
    acting = as_policy(policy)
    flown = [rollout(acting.act, small_scene, [3, 4], steps=20, record=True).controls for _ in range(2)]
    np.testing.assert_array_equal(flown[0], flown[1])
    alone = rollout(acting.act, small_scene, [4], steps=20, record=True).controls
    np.testing.assert_allclose(alone[0], flown[0][1], rtol=0, atol=1e-5)


def test_saved_and_loaded_it_is_the_same(tmp_path):
    policy, seen = ChunkingPolicy(**parts()), observations(10)
    policy.save(tmp_path / "policy.npz")
    loaded = as_policy(tmp_path / "policy.npz")
    assert loaded.metadata == policy.metadata
    assert loaded.sizes == (N_OBS, N_U)
    np.testing.assert_array_equal(flight(loaded.act, seen), flight(policy, seen))
    np.testing.assert_array_equal(flight(pickle.loads(pickle.dumps(policy)), seen), flight(policy, seen))


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"activation": "sine"}, "activation: 'sine' is unknown; choose from tanh, silu, relu"),
        ({"heads": 3}, "heads: 3, should divide the size of a token, 8"),
        ({"spacing": 0}, "spacing: 0, should be positive"),
        (
            {"weighting": 100.0},
            "weighting: 100.0, should be at most 60 either way for chunks of 10",
        ),
        ({"weighting": np.nan}, "weighting: nan, should be at most 60"),
        ({"mean": np.zeros(N_OBS + 1)}, r"embed_weight_0: shape \(7, 6\), should be \(8, 6\)"),
        ({"scale": np.full(N_OBS, np.inf)}, "scale: has entries that are not finite"),
        (
            {"tensors": {**without(), "positions": np.zeros(4)}},
            r"positions: shape \(4,\), should be \(k",
        ),
        ({"tensors": {**without(), "norm_bias": np.full(WIDTH, np.nan)}}, "norm_bias: has entries that are"),
        ({"tensors": {**without(), "weight_0": np.zeros(3)}}, "'weight_0': is of no layer"),
    ],
)
def test_parts_that_do_not_fit_are_named(changes, message):
    with pytest.raises(ValueError, match=message):
        ChunkingPolicy(**parts(**changes))


def rewritten(path, **changes):
    """Change arrays of a saved policy; None removes one."""
    ChunkingPolicy(**parts()).save(path)
    with np.load(path) as content:
        arrays = {**{name: content[name] for name in content.files}, **changes}
    np.savez(path, **{name: array for name, array in arrays.items() if array is not None})
    return path


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        (
            {"chunk_format": np.array(99)},
            "has chunk_format 99, this version reads 1: export",
        ),
        ({"chunk_format": None}, "holds no policy of chunks of actions"),
        ({"feed_in_bias_1": None}, "is not a policy: 'attend_in_bias_1': is of no layer"),
        ({"out_weight": None}, "is not a policy: 'out_weight': is missing"),
        ({"heads": None}, "is not a policy: it has no heads"),
        ({"metadata": np.array("[1]")}, "is not a policy: metadata: should be a mapping"),
        ({"heads": np.array(2.5)}, r"heads: shape \(\) of float64, should be a whole number"),
        ({"mean": np.array(["a"] * N_OBS)}, "is not a policy: mean: .*should be numbers"),
    ],
)
def test_files_that_hold_no_policy_are_refused(tmp_path, changes, message):
    path = rewritten(tmp_path / "policy.npz", **changes)
    with pytest.raises(PolicyFileError, match=message):
        ChunkingPolicy.load(path)


def test_what_wants_single_actions_says_that_chunks_will_not_do(tmp_path):
    path = rewritten(tmp_path / "policy.npz")
    with pytest.raises(PolicyFileError, match="holds a policy of chunks of actions, which flies, but"):
        ExportedPolicy.load(path)
    with pytest.raises(ValueError, match=r"start_from: .*policy of chunks of actions"):
        load_start(str(path), None, N_OBS, N_U)


WITHOUT_TORCH = """
import numpy as np
from agents.zoo.finding import as_policy
policy = as_policy(sys.argv[1]).act
print(policy(np.zeros(7)).tolist())
"""


def test_it_runs_without_pytorch(run_without, tmp_path):
    policy = ChunkingPolicy(**parts())
    policy.save(tmp_path / "policy.npz")
    run = run_without(("stable_baselines3", "torch"), WITHOUT_TORCH, tmp_path / "policy.npz")
    assert run.stdout.strip() == str(policy(np.zeros(N_OBS)).tolist())
