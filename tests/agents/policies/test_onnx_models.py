"""Networks in ONNX files: flown as their numbers say, with open and fixed batches, and refused in words."""

import json

import numpy as np
import pytest

from agents import compare, evaluate
from agents.command_line.agent_policies import owns_policy
from agents.zoo.finding import PolicyError, as_policy
from dq_space_arm_env import DQSpaceArmVectorEnv

onnx = pytest.importorskip("onnx")
pytest.importorskip("onnxruntime")
N_OBSERVATION, N_ACTION = 13, 6


def write(
    path,
    batch="B",
    kind=np.float32,
    inputs=1,
    rank=2,
    n_observation=N_OBSERVATION,
    size=1.0,
    *,
    outside=False,
    seen_size=None,
    seed=0,
):
    """A layer with tanh, its matrix and bias."""
    rng = np.random.default_rng(seed)
    matrix = size * rng.normal(size=(n_observation, N_ACTION)).astype(kind)
    bias = size * rng.normal(size=N_ACTION).astype(kind)
    helper, numpy_helper = onnx.helper, onnx.numpy_helper
    number = onnx.helper.np_dtype_to_tensor_dtype(np.dtype(kind))
    shape = [batch, seen_size or n_observation] if rank == 2 else [batch, 1, n_observation]
    result = [batch, N_ACTION] if rank == 2 else [batch, 1, N_ACTION]
    seen = [helper.make_tensor_value_info(f"seen{i}", number, shape) for i in range(inputs)]
    acts = helper.make_tensor_value_info("acts", number, result)
    nodes = [
        helper.make_node("MatMul", ["seen0", "matrix"], ["product"]),
        helper.make_node("Add", ["product", "bias"], ["sum"]),
        helper.make_node("Tanh", ["sum"], ["acts"]),
    ]
    given = [numpy_helper.from_array(matrix, "matrix"), numpy_helper.from_array(bias, "bias")]
    graph = helper.make_graph(nodes, "policy", seen, [acts], given)
    model = helper.make_model(graph, opset_imports=[helper.make_opsetid("", 17)], ir_version=8)
    beside = {"save_as_external_data": True, "location": f"{path.name}.data", "size_threshold": 0}
    path.with_name(f"{path.name}.data").unlink(missing_ok=True)  # else it would be appended to
    onnx.save(model, path, **(beside if outside else {}))
    return lambda observations: np.tanh(observations.astype(kind) @ matrix + bias)


@pytest.mark.parametrize("kind", [np.float32, np.float64])
@pytest.mark.parametrize("batch", ["B", 1, 4])
def test_actions_are_those_of_the_network(tmp_path, batch, kind):
    file = tmp_path / "net.onnx"
    expected = write(file, batch, kind)
    acting = as_policy(file)
    assert acting.sizes == (N_OBSERVATION, N_ACTION)
    assert acting.label == "net.onnx"
    assert owns_policy(str(file))
    for count in (1, 4, 7):
        observations = np.random.default_rng(count).normal(size=(count, N_OBSERVATION))
        np.testing.assert_allclose(
            acting.act(observations), expected(observations), rtol=1e-6 if kind is np.float32 else 1e-14
        )


def test_a_network_flies(tmp_path, small_scene):
    file = tmp_path / "net.onnx"
    space = DQSpaceArmVectorEnv(1, small_scene).single_observation_space
    expected = write(file, kind=np.float64, n_observation=space.shape[0], size=1e-3)  # tame
    found, direct = (evaluate(each, small_scene, 3, expert=False) for each in (file, expected))
    np.testing.assert_allclose(found.flights.cost, direct.flights.cost, rtol=1e-6)
    json.dumps(found.record())


@pytest.mark.parametrize(
    ("changes", "sentence"),
    [
        ({"inputs": 2}, "has the inputs seen0, seen1, should have one"),
        ({"rank": 3}, r"should map floats of shape \(B, n_obs\)"),
        ({"kind": np.float16}, r"maps tensor\(float16\)"),
    ],
)
def test_other_networks_are_refused(tmp_path, changes, sentence):
    write(tmp_path / "net.onnx", **changes)
    with pytest.raises(PolicyError, match=sentence):
        as_policy(tmp_path / "net.onnx")


def test_unreadable_files_and_wrong_sizes_are_refused(tmp_path, small_scene, run_without):
    file = tmp_path / "net.onnx"
    file.write_bytes(b"\x00" * 100)
    with pytest.raises(PolicyError, match=r"net\.onnx: cannot be read as ONNX"):
        as_policy(file)
    write(file, n_observation=3)
    with pytest.raises(PolicyError, match=r"net\.onnx maps 3 observations to 6 inputs"):
        evaluate(file, small_scene, 1, expert=False)
    done = run_without(
        ("onnxruntime",), "from agents.zoo.finding import as_policy; as_policy(sys.argv[1])", file
    )
    assert 'pip install "dq-space-arm[onnx]"' in done.stderr


def test_a_network_of_open_sizes_that_does_not_fit_the_scene_fails_in_a_sentence(tmp_path, small_scene):
    file = tmp_path / "net.onnx"
    write(file, n_observation=3, seen_size="n_obs")
    assert as_policy(file).sizes is None
    with pytest.raises(ValueError, match=r"net\.onnx: fails on observations of shape \(1, \d+\): "):
        evaluate(file, small_scene, 1, expert=False)


@pytest.mark.parametrize("name", ["net", "n" * 150])  # whose length takes one byte or two
def test_tensors_outside_of_the_file_belong_to_the_policy_of_a_kept_row(
    tmp_path, small_scene, monkeypatch, name
):
    """PyTorch writes them beside it, and the file itself is the same after another training."""
    file, flown = tmp_path / f"{name}.onnx", []
    size = DQSpaceArmVectorEnv(1, small_scene).single_observation_space.shape[0]

    def fly(policy, scene, n, **options):
        flown.append(evaluate(policy, scene, n, expert=False, label=options["label"]))
        return flown[-1]

    monkeypatch.setattr("agents.evaluation.comparing.evaluate", fly)
    contents = set()
    for seed in (0, 0, 1):
        write(file, n_observation=size, size=1e-3, outside=True, seed=seed)
        contents.add(file.read_bytes())
        (row,) = compare([file], small_scene, 2, controllers=(), out=tmp_path / "out").rows
    assert len(contents) == 1
    assert len(flown) == 2
    assert row.evaluation is flown[-1]
