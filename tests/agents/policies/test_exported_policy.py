"""An exported policy: what it computes, what its file holds, and that it needs NumPy alone."""

import io
import pickle
import zipfile
from itertools import pairwise
from pathlib import Path

import numpy as np
import pytest

from agents.policies import ExportedPolicy, PolicyFileError

N_OBS, N_U, HIDDEN = 7, 3, (16, 8)

FUNCTIONS = {
    "tanh": np.tanh,
    "silu": lambda z: z / (1.0 + np.exp(-z)),
    "relu": lambda z: np.where(z > 0.0, z, 0.0),
    "clip": lambda z: np.clip(z, -1.0, 1.0),
}


def parts(seed=0, **changes):
    rng = np.random.default_rng(seed)
    sizes = [N_OBS, *HIDDEN, N_U]
    shapes = list(pairwise(sizes))
    return {
        "weights": tuple(rng.normal(size=shape).astype(np.float32) for shape in shapes),
        "biases": tuple(rng.normal(size=shape[1]).astype(np.float32) for shape in shapes),
        "activation": "tanh",
        "mean": rng.normal(size=N_OBS),
        "scale": rng.uniform(0.5, 2.0, size=N_OBS),
        "metadata": {"scene": "paper", "training": {"updates": 3}},
    } | changes


def expected(policy, observation):
    """The same in double precision, in the plainest words."""
    values = (observation - policy.mean) * policy.scale
    values = np.clip(values, -policy.normalized_limit, policy.normalized_limit)
    for i, (weight, bias) in enumerate(zip(policy.weights, policy.biases, strict=True)):
        values = values @ weight.astype(np.float64) + bias
        last = i == len(policy.weights) - 1
        values = FUNCTIONS[policy.squash if last else policy.activation](values)
    return values


def observations(count=50):
    return np.random.default_rng(1).normal(size=(count, N_OBS))


def test_a_policy_stays_what_it_was_when_the_arrays_that_it_was_made_of_change(tmp_path):
    given, seen = parts(), observations()
    policy = ExportedPolicy(**given)
    actions = policy(seen)
    for array in (*given["weights"], *given["biases"], given["mean"], given["scale"]):
        array += 1.0
    policy.save(tmp_path / "policy.npz")
    np.testing.assert_array_equal(policy(seen), actions)
    np.testing.assert_array_equal(ExportedPolicy.load(tmp_path / "policy.npz")(seen), actions)


@pytest.mark.parametrize("limit", [np.inf, 0.7])
@pytest.mark.parametrize("squash", ["clip", "tanh"])
@pytest.mark.parametrize("activation", ["tanh", "silu", "relu"])
def test_actions_are_those_of_the_formula(activation, squash, limit):
    # Small last weights, so that not all actions are at the limit.
    given = parts(activation=activation, squash=squash, normalized_limit=limit)
    given["weights"] = (*given["weights"][:-1], 0.1 * given["weights"][-1])
    policy = ExportedPolicy(**given)
    batch = observations()
    actions = policy(batch)
    assert actions.shape == (50, N_U)
    assert actions.dtype == np.float32
    np.testing.assert_allclose(actions, expected(policy, batch), rtol=0, atol=1e-7)
    assert np.mean(np.abs(actions) < 0.99) > 0.05
    for observation, action in zip(batch, actions, strict=True):
        np.testing.assert_allclose(policy(observation), action, rtol=0, atol=1e-7)
    for large in (1e6, -1e6):
        assert np.isfinite(policy(np.full(N_OBS, large))).all()


def test_an_action_stays_what_it_was_when_another_is_asked_for():
    policy = ExportedPolicy(**parts())
    first, second = observations(2)
    action = policy(first)
    before = action.copy()
    assert not np.array_equal(policy(second), before)
    np.testing.assert_array_equal(action, before)


def test_entries_without_scale_are_ignored():
    scale = parts()["scale"]
    scale[2] = 0.0
    policy = ExportedPolicy(**parts(scale=scale))
    observation = observations(1)[0]
    changed = observation.copy()
    changed[2] += 100.0
    np.testing.assert_array_equal(policy(changed), policy(observation))
    changed[3] += 1.0
    assert not np.array_equal(policy(changed), policy(observation))


def test_saved_and_loaded_it_is_the_same(tmp_path):
    policy = ExportedPolicy(**parts(squash="tanh", activation="silu", normalized_limit=5.0))
    policy.save(tmp_path / "policy.npz")
    loaded = ExportedPolicy.load(tmp_path / "policy.npz")
    assert (loaded.activation, loaded.squash, loaded.normalized_limit) == ("silu", "tanh", 5.0)
    assert loaded.metadata == policy.metadata
    np.testing.assert_array_equal(loaded(observations()), policy(observations()))
    copied = pickle.loads(pickle.dumps(policy))
    np.testing.assert_array_equal(copied(observations()), policy(observations()))
    # What Stable-Baselines3 calls.
    actions, state = policy.predict(observations(), deterministic=True)
    assert state is None
    np.testing.assert_array_equal(actions, policy(observations()))


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"activation": "sine"}, "activation: 'sine' is unknown; choose from tanh, silu, relu"),
        ({"mean": np.zeros(N_OBS + 1)}, r"scale: shape \(7,\), should be \(8,\)"),
        ({"mean": np.zeros((N_OBS, 1))}, r"mean: shape \(7, 1\), should be \(n_obs,\)"),
        ({"scale": np.full(N_OBS, np.nan)}, "scale: has entries that are not finite"),
        ({"weights": parts()["weights"][:2]}, "2 weights and 3 biases, should be one of each per layer"),
        (
            {"weights": (*parts()["weights"][:1], np.zeros((9, 8)), parts()["weights"][2])},
            r"weight_1: shape \(9, 8\), should be \(16, 8\)",
        ),
        ({"normalized_limit": 0.0}, "normalized_limit: 0.0, should be positive"),
    ],
)
def test_parts_that_do_not_fit_are_named(changes, message):
    with pytest.raises(ValueError, match=message):
        ExportedPolicy(**parts(**changes))


@pytest.mark.parametrize("shape", [(N_OBS + 1,), (2, 3, N_OBS)])
def test_observations_of_another_shape_are_refused(shape):
    with pytest.raises(ValueError, match=r"should be \(7,\) or \(B, 7\)"):
        ExportedPolicy(**parts())(np.zeros(shape))


def rewritten(path, **changes):
    """Change arrays of a saved policy; None removes one."""
    ExportedPolicy(**parts()).save(path)
    with np.load(path) as content:
        arrays = {**{name: content[name] for name in content.files}, **changes}
    np.savez(path, **{name: array for name, array in arrays.items() if array is not None})
    return path


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"format": np.array(99)}, "has format 99, this version reads 1: export the policy again"),
        ({"bias_1": None}, "is not a policy: it has no bias_1"),
        ({"metadata": np.array("[1]")}, "is not a policy: metadata: should be a mapping"),
        ({"mean": np.array(["a"] * N_OBS)}, "is not a policy: "),
    ],
)
def test_files_that_hold_no_policy_are_refused(tmp_path, changes, message):
    path = rewritten(tmp_path / "policy.npz", **changes)
    with pytest.raises(PolicyFileError, match=message):
        ExportedPolicy.load(path)


class Malicious:
    def __reduce__(self):
        return exec, ("raise SystemExit('executed')",)


def test_nothing_in_a_file_is_executed(tmp_path):
    path = rewritten(tmp_path / "policy.npz")
    array = np.empty((), dtype=object)
    array[()] = Malicious()
    stream = io.BytesIO()
    np.lib.format.write_array(stream, array, allow_pickle=True)
    with zipfile.ZipFile(path, "a") as archive:
        archive.writestr("weight_3.npy", stream.getvalue())
    with pytest.raises(PolicyFileError, match="holds object, it should hold numbers"):
        ExportedPolicy.load(path)


def test_a_damaged_file_is_refused_whichever_byte_it_is(tmp_path):
    path = tmp_path / "policy.npz"
    policy = ExportedPolicy(**parts())
    policy.save(path)
    content, rng, refused = path.read_bytes(), np.random.default_rng(0), 0
    for damaged in (b"", b"nothing", b"PK\x03\x04 broken"):
        path.write_bytes(damaged)
        with pytest.raises(PolicyFileError, match=r"policy.npz cannot be read as a policy"):
            ExportedPolicy.load(path)
    for _ in range(300):
        damaged = bytearray(content)
        for place in rng.integers(len(content), size=4):
            damaged[place] ^= 1 << rng.integers(8)
        path.write_bytes(damaged)
        try:
            ExportedPolicy.load(path)  # what the archive does not check, such as dates, may be damaged
        except PolicyFileError:
            refused += 1
    assert refused > 200


WITHOUT_TORCH = """
import numpy as np
from agents.policies import ExportedPolicy
policy = ExportedPolicy.load(sys.argv[1])
print(policy(np.zeros(7)).tolist())
"""


def test_it_runs_without_pytorch(run_without, tmp_path):
    policy = ExportedPolicy(**parts())
    policy.save(tmp_path / "policy.npz")
    run = run_without(("stable_baselines3", "torch"), WITHOUT_TORCH, tmp_path / "policy.npz")
    assert run.stdout.strip() == str(policy(np.zeros(N_OBS)).tolist())


def test_a_solution_is_told_from_a_policy(tmp_path: Path) -> None:
    file = tmp_path / "solution.npz"
    np.savez(file, states=np.zeros((2, 3)), controls=np.zeros((1, 2)), feedback_gains=np.zeros((1, 2, 3)))
    with pytest.raises(PolicyFileError, match="the solution from one start, which `dq-space-arm simulate"):
        ExportedPolicy.load(file)
