"""The network of a policy: its derivative, its units, and its twin in NumPy."""

import numpy as np
import pytest

torch = pytest.importorskip("torch")

from agents.policies import PolicyNetwork  # noqa: E402
from agents.policies.chunk_network import ChunkNetwork  # noqa: E402
from agents.policies.exported import units_of  # noqa: E402

pytestmark = pytest.mark.agents

N_OBS, N_U = 9, 4


def network(activation="tanh", constant=()):
    torch.manual_seed(0)
    made = PolicyNetwork(N_OBS, N_U, (32, 16), activation)
    rng = np.random.default_rng(0)
    deviation = rng.uniform(1.0, 5.0, N_OBS)
    deviation[list(constant)] = 0.0
    made.normalize(rng.normal(size=N_OBS), deviation, rng.uniform(-0.9, 0.9, N_U), rng.uniform(0.3, 1.0, N_U))
    with torch.no_grad():
        # Large enough that some actions are clipped.
        made.layers[-1].weight.mul_(10.0 if activation == "tanh" else 30.0)
    return made


def observations(count=100):
    return 3.0 * np.random.default_rng(1).normal(size=(count, N_OBS))


@pytest.mark.parametrize("activation", ["tanh", "silu"])
def test_the_exported_policy_gives_the_same_actions(activation):
    made = network(activation)
    actions = made.act(observations())
    policy = made.export({"scene": "none"})
    assert 0.02 < np.mean(np.abs(actions) == 1.0) < 0.98
    np.testing.assert_allclose(policy(observations()), actions, rtol=0, atol=1e-6)
    np.testing.assert_allclose([policy(each) for each in observations()], actions, rtol=0, atol=1e-6)
    assert policy.metadata == {"scene": "none"}


@pytest.mark.parametrize("activation", ["tanh", "silu"])
def test_the_derivative_is_that_of_automatic_differentiation(activation):
    made = network(activation)
    inputs, tangents = torch.randn(20, N_OBS), torch.randn(20, N_OBS)
    outputs, slopes = made.forward_with_tangent(inputs, tangents)
    same_outputs, same_slopes = torch.autograd.functional.jvp(made, inputs, tangents)
    torch.testing.assert_close(outputs, same_outputs)
    torch.testing.assert_close(slopes, same_slopes)


def test_entries_that_did_not_vary_are_ignored():
    made = network(constant=(3,))
    changed = observations()
    changed[:, 3] += 7.0
    np.testing.assert_array_equal(made.act(changed), made.act(observations()))
    policy = made.export({})
    np.testing.assert_array_equal(policy(changed), policy(observations()))


def test_networks_of_all_trainings_agree_on_what_is_constant():
    deviation = np.array([1e-8, 1e-7, 1e-5, 1.0])
    samples = np.outer([-1.0, 1.0], deviation)
    made = PolicyNetwork(4, 1)
    made.normalize(np.zeros(4), deviation, np.zeros(1), np.ones(1))
    np.testing.assert_array_equal(made.observation_scale.numpy(), units_of(samples)[1])
    assert made.observation_scale.tolist() == pytest.approx([0.0, 0.0, 1e5, 1.0])


@pytest.mark.parametrize("activation", ["tanh", "silu"])
def test_the_exported_transformer_predicts_the_same_chunks(activation):
    torch.manual_seed(0)
    sizes = {"hidden": (32, 16), "chunk": 5, "width": 24, "layers": 3, "heads": 4}
    made = ChunkNetwork(N_OBS, N_U, activation=activation, spacing=2, weighting=0.0, **sizes)
    rng = np.random.default_rng(0)
    made.normalize(
        rng.normal(size=N_OBS), rng.uniform(1.0, 5.0, N_OBS), rng.normal(size=N_U) / 3, np.ones(N_U)
    )
    with torch.no_grad():
        for each in made.parameters():  # normalizations begin as ones, biases as zeros
            each.add_(0.3 * torch.randn(each.shape))
    chunks, policy = made.act(observations()), made.export({"scene": "none"})
    assert chunks.shape == (100, 5, N_U)
    assert 0.02 < np.mean(np.abs(chunks) == 1.0) < 0.98
    assert np.abs(np.diff(chunks, axis=1)).mean() > 0.05
    # The last layer is rounded to single precision with the units of the actions in it.
    np.testing.assert_allclose(policy.chunks(observations()), chunks, rtol=0.0, atol=1e-6)
    assert (policy.n_observation, policy.n_action, policy.metadata) == (N_OBS, N_U, {"scene": "none"})
