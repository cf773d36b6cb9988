"""Models of Stable-Baselines3 fly by their tensors; the code in their files runs only with --trust."""

import base64
import io
import json
import pickle
import struct
import zipfile

import numpy as np
import pytest

pytest.importorskip("stable_baselines3")
pytest.importorskip("sb3_contrib")

import torch
from sb3_contrib import TQC, CrossQ, RecurrentPPO
from stable_baselines3 import A2C, DDPG, PPO, SAC, TD3
from stable_baselines3.common import torch_layers
from stable_baselines3.common.policies import ActorCriticPolicy

from agents import DQSpaceArmVecEnv, ExportedPolicy
from agents.zoo.finding import PolicyError, as_policy
from dq_space_arm_env.command_line import main
from dq_space_arm_env.environment.rollouts import rollout

pytestmark = pytest.mark.agents

LEARNERS = {"PPO": PPO, "A2C": A2C, "SAC": SAC, "TQC": TQC, "TD3": TD3, "DDPG": DDPG}
NETWORK = {"net_arch": [16, 16]}


class OwnPolicy(ActorCriticPolicy):
    """Acts in its own way."""


class FlattenExtractor(torch_layers.FlattenExtractor):
    """Has the name of another class, and does something else."""

    def forward(self, observations):
        return torch.tanh(super().forward(observations))


class Tanh(torch.nn.Module):
    """Has the name of another class, and does something else."""

    def forward(self, values):
        return torch.sin(values)


class Bomb:
    """Unpickling this creates a file."""

    def __init__(self, path, state=None):
        self.path, self.state = path, state

    def __reduce__(self):
        return open, (str(self.path), "w"), self.state


def learner(kind, scene, policy="MlpPolicy", **options):
    environment = DQSpaceArmVecEnv(2, scene)
    if kind not in (PPO, A2C):
        options["buffer_size"] = 10
    return kind(policy, environment, device="cpu", seed=0, **{"policy_kwargs": dict(NETWORK), **options})


def rewritten(source, target, change):
    """A copy of an archive; `change` gets the name and content of each member, and returns the content."""
    with zipfile.ZipFile(source) as old, zipfile.ZipFile(target, "w") as new:
        for member in old.infolist():
            new.writestr(member.filename, change(member.filename, old.read(member)))
    return target


def armed(source, target, path):
    """A model with bombs in place of all that is pickled in it; those of spaces have their bounds."""

    def bomb(content):
        pickled = pickle.loads(base64.b64decode(content))
        bounds = {name: getattr(pickled, name) for name in ("low", "high") if hasattr(pickled, name)}
        return base64.b64encode(pickle.dumps(Bomb(path, bounds or None))).decode()

    def change(name, content):
        if name != "data":
            return content
        data = json.loads(content)
        for value in data.values():
            if isinstance(value, dict) and ":serialized:" in value:
                value[":serialized:"] = bomb(value[":serialized:"])
        return json.dumps(data).encode()

    return rewritten(source, target, change)


@pytest.fixture(scope="module")
def plain(small_scene, tmp_path_factory):
    """A model of a plain policy."""
    path = tmp_path_factory.mktemp("plain") / "plain.zip"
    learner(PPO, small_scene).save(path)
    return path


@pytest.fixture(scope="module")
def own(small_scene, tmp_path_factory):
    """A model of a policy class of somebody's."""
    path = tmp_path_factory.mktemp("own") / "own.zip"
    learner(PPO, small_scene, OwnPolicy).save(path)
    return path


def verbs(model, scene, folder):
    """Every verb that flies a model, on a scene's file."""
    few = ["--scene", scene, "-n", "2"]
    return {
        "simulate": ["simulate", scene, "--policy", model],
        "replay": ["replay", model, "--scene", scene, "--out", folder / "page.html"],
        "evaluate": ["evaluate", model, *few, "--no-expert"],
        "evaluate show": ["evaluate", "show", model, "--scene", scene, "--no-picture", "--out", folder],
        "compare": ["compare", model, *few, "--controller", "none", "--no-picture", "--out", folder],
    }


VERBS = ["simulate", "replay", "evaluate", "evaluate show", "compare"]


@pytest.mark.parametrize("verb", [*VERBS[:-1], pytest.param(VERBS[-1], marks=pytest.mark.slow)])
def test_no_verb_executes_what_a_model_holds(verb, plain, small_file, tmp_path, capsys):
    """The policy is a plain one, so its tensors fly."""
    model = armed(plain, tmp_path / "model.zip", tmp_path / "executed")
    status = main([str(word) for word in verbs(model, small_file, tmp_path)[verb]])
    assert not (tmp_path / "executed").exists()
    assert status in (0, 1), capsys.readouterr().err  # 1: the untrained agent misses its target


@pytest.mark.parametrize("verb", VERBS)
def test_a_model_that_needs_its_code_is_refused_without_trust(verb, own, small_file, tmp_path, capsys):
    model = armed(own, tmp_path / "model.zip", tmp_path / "executed")
    words = [str(word) for word in verbs(model, small_file, tmp_path)[verb]]
    assert main(words) == 2
    error = capsys.readouterr().err
    assert "--trust" in error
    assert "Traceback" not in error
    assert not (tmp_path / "executed").exists()


@pytest.mark.parametrize("verb", ["simulate", "evaluate"])
def test_trust_flies_a_model_by_its_code(verb, own, small_file, tmp_path):
    words = [str(word) for word in verbs(own, small_file, tmp_path)[verb]]
    assert main([*words, "--trust"]) == 0


def test_a_trusted_model_of_an_algorithm_that_is_not_known_is_refused_in_a_sentence(small_scene, tmp_path):
    learner(CrossQ, small_scene).save(tmp_path / "model.zip")
    with pytest.raises(PolicyError, match=r"SAC\.load fails on it .*: load it by its own class in Python"):
        as_policy(tmp_path / "model.zip", trust=True)


@pytest.mark.parametrize("kind", ["model", "file"])
def test_a_recurrent_model_remembers_its_flight(kind, small_scene, tmp_path):
    """And forgets it when the next one begins."""
    model = RecurrentPPO("MlpLstmPolicy", DQSpaceArmVecEnv(2, small_scene), device="cpu", seed=0)
    for parameter in model.policy.parameters():
        torch.nn.init.uniform_(parameter, -0.3, 0.3)
    model.save(tmp_path / "model.zip")
    memory = None

    def remembering(seen):
        nonlocal memory
        action, memory = model.predict(seen.astype(np.float32), state=memory, deterministic=True)
        return action

    expected = rollout(remembering, small_scene, [1, 2]).cost
    acting = as_policy(model if kind == "model" else tmp_path / "model.zip", trust=True)
    for _ in range(2):
        np.testing.assert_array_equal(rollout(acting.act, small_scene, [1, 2]).cost, expected)


def test_nothing_is_executed_from_python_either(plain, own, tmp_path):
    as_policy(armed(plain, tmp_path / "model.zip", tmp_path / "executed"))
    with pytest.raises(PolicyError, match="trust=True"):
        as_policy(armed(own, tmp_path / "model.zip", tmp_path / "executed"))
    assert not (tmp_path / "executed").exists()
    assert as_policy(own, trust=True).act(np.zeros((3, 14), np.float32)).shape == (3, 6)


@pytest.mark.parametrize(("name", "hidden"), [*((name, [16, 16]) for name in LEARNERS), ("PPO", [])])
def test_the_tensors_act_like_the_model(name, hidden, small_scene, tmp_path):
    model = learner(LEARNERS[name], small_scene, policy_kwargs={**NETWORK, "net_arch": hidden})
    model.save(tmp_path / "model.zip")
    seen = np.random.default_rng(0).normal(size=(50, 14)).astype(np.float32)
    expected = np.clip(model.predict(seen, deterministic=True)[0], -1.0, 1.0)
    acting = as_policy(tmp_path / "model.zip")
    np.testing.assert_allclose(acting.act(seen), expected, rtol=0.0, atol=1e-6)
    assert acting.sizes == (14, 6)
    assert np.ptp(expected, axis=0).min() > 0.0


@pytest.mark.parametrize(
    "options",
    [{"features_extractor_class": torch_layers.FlattenExtractor}, {"activation_fn": torch.nn.SiLU}],
)
def test_known_classes_that_the_file_names_act_like_the_model(options, small_scene, tmp_path):
    model = learner(PPO, small_scene, policy_kwargs={**NETWORK, **options})
    model.save(tmp_path / "model.zip")
    seen = np.random.default_rng(0).normal(size=(50, 14)).astype(np.float32)
    expected = np.clip(model.predict(seen, deterministic=True)[0], -1.0, 1.0)
    np.testing.assert_allclose(as_policy(tmp_path / "model.zip").act(seen), expected, rtol=0.0, atol=1e-6)


@pytest.mark.parametrize(
    ("kind", "options", "reason"),
    [
        (PPO, {"policy_kwargs": {**NETWORK, "activation_fn": torch.nn.ELU}}, "its activation is .*ELU'"),
        (PPO, {"policy_kwargs": {**NETWORK, "activation_fn": Tanh}}, "its activation is .*Tanh', not one of"),
        (
            PPO,
            {"policy_kwargs": {**NETWORK, "features_extractor_class": FlattenExtractor}},
            "its observations go through .*FlattenExtractor', not through one of",
        ),
        (SAC, {"use_sde": True}, "state-dependent exploration"),
        (PPO, {"policy": OwnPolicy}, "its policy is a class of"),
    ],
)
def test_what_tensors_do_not_tell_needs_trust(kind, options, reason, small_scene, tmp_path):
    learner(kind, small_scene, **options).save(tmp_path / "model.zip")
    with pytest.raises(PolicyError, match=reason + r".*--trust"):
        as_policy(tmp_path / "model.zip")
    acting = as_policy(tmp_path / "model.zip", trust=True)
    assert acting.act(np.zeros((2, 14), np.float32)).shape == (2, 6)


def tensors(value):
    content = io.BytesIO()
    torch.save(value, content)
    return content.getvalue()


def compressed(content):
    target = io.BytesIO()
    with (
        zipfile.ZipFile(io.BytesIO(content)) as old,
        zipfile.ZipFile(target, "w", zipfile.ZIP_DEFLATED) as new,
    ):
        for member in old.infolist():
            new.writestr(member.filename, old.read(member))
    return target.getvalue()


def claiming(content):
    """A file whose tensor of 1000 numbers claims to have 1e8."""
    target = io.BytesIO()
    rewritten(
        io.BytesIO(content),
        target,
        lambda name, part: part.replace(b"M\xe8\x03", b"J" + struct.pack("<i", 10**8)),
    )
    return target.getvalue()


def test_tensors_that_are_something_else_are_refused_in_a_sentence(plain, tmp_path):
    huge = torch.zeros(1).expand(10**12)
    many = tensors({"a": torch.zeros(1000)})
    cases = {
        "asks for": [tensors({"a": Bomb(tmp_path / "executed")}), tensors({"a": bytearray(10)})],
        "compressed": [compressed(many)],
        "more numbers than the file": [tensors({"a": huge})],
        "damaged": [claiming(many), many[: len(many) // 2], b"", pickle.dumps(Bomb(tmp_path / "executed"))],
        "should be a mapping": [tensors([torch.zeros(3)])],
        "is not a model": [tensors({"a": 3})],
        "its network": [tensors({}), many],
    }
    for reason, contents in cases.items():
        for content in contents:
            model = rewritten(
                plain,
                tmp_path / "model.zip",
                lambda name, part, content=content: content if name == "policy.pth" else part,
            )
            with pytest.raises(PolicyError, match=reason):
                as_policy(model)
    assert not (tmp_path / "executed").exists()


@pytest.mark.parametrize(
    "data",
    [
        b"",
        b"[]",
        b"{}",
        b"[" * 100_000,
        b'{"policy_class": 3, "policy_kwargs": {}}',
        b'{"policy_class": {"__module__": "stable_baselines3.common.policies"}, "policy_kwargs": []}',
        b'{"policy_class": {"__module__": "stable_baselines3.common.policies"}, "policy_kwargs": {}}',
    ],
)
def test_attributes_that_are_no_models_are_refused_in_a_sentence(data, plain, tmp_path):
    model = rewritten(plain, tmp_path / "model.zip", lambda name, part: data if name == "data" else part)
    with pytest.raises(PolicyError, match="is not a model of Stable-Baselines3"):
        as_policy(model)


def test_a_small_file_cannot_claim_large_tensors(plain, tmp_path):
    with (
        zipfile.ZipFile(plain) as old,
        zipfile.ZipFile(tmp_path / "model.zip", "w", zipfile.ZIP_DEFLATED) as new,
    ):
        new.writestr("data", old.read("data"))
        new.writestr("policy.pth", tensors({"mlp_extractor.policy_net.0.weight": torch.zeros(4_000_000)}))
    assert (tmp_path / "model.zip").stat().st_size < 100_000
    with pytest.raises(PolicyError, match="compressed"):
        as_policy(tmp_path / "model.zip")


def test_a_damaged_archive_is_refused_in_a_sentence(plain, tmp_path):
    content = plain.read_bytes()
    for cut in (0, 10, len(content) // 2, len(content) - 10):
        (tmp_path / "model.zip").write_bytes(content[:cut])
        with pytest.raises(PolicyError, match="is not a model of Stable-Baselines3"):
            as_policy(tmp_path / "model.zip")


def test_a_run_flies_its_exported_policy_although_its_model_lies_beside(own, small_file, tmp_path):
    armed(own, tmp_path / "model.zip", tmp_path / "executed")
    layers = np.random.default_rng(0).normal(size=(14, 6)), np.zeros(6)
    policy = ExportedPolicy((layers[0],), (layers[1],), "tanh", np.zeros(14), np.ones(14))
    policy.save(tmp_path / "policy.npz")
    assert main(["simulate", str(small_file), "--policy", str(tmp_path)]) == 0
    assert not (tmp_path / "executed").exists()
