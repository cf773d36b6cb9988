"""What imitation minimizes: errors of actions, of derivatives along tangent coordinates, and around."""

import numpy as np
import pytest

torch = pytest.importorskip("torch")

from agents.configuration.imitation import ObjectiveWeights  # noqa: E402
from agents.imitation.objective import Objective, observation_change  # noqa: E402
from agents.imitation.samples import COLUMNS, NAMES, Statistics  # noqa: E402
from agents.policies import PolicyNetwork  # noqa: E402
from dq_space_arm_env import compile_scene, load_scene  # noqa: E402
from experts.demonstrations.reading import Batch  # noqa: E402

pytestmark = [pytest.mark.agents, pytest.mark.slow]


@pytest.fixture(scope="module")
def statistics(demonstrations):
    return Statistics.of(demonstrations)


@pytest.fixture
def batch(demonstrations):
    return next(demonstrations.batches(200, NAMES, seed=0))


def linear_network(demonstrations, statistics, batch):
    """A policy that is linear in the observation, and demonstrations changed so that it is right."""
    kernels = demonstrations.kernels
    torch.manual_seed(0)
    network = PolicyNetwork(batch.arrays["observations"].shape[1], kernels.n_u, hidden=())
    seen = statistics.observation_mean, statistics.observation_deviation
    network.normalize(*seen, statistics.action_mean, statistics.action_deviation)
    with torch.no_grad():
        weight = network.layers[0].weight.double().numpy() * network.observation_scale.numpy()
    weight = network.action_scale.numpy()[:, None] * weight
    states, observations = batch.arrays["states"], batch.arrays["observations"]
    gains = np.empty_like(batch.arrays["feedback_gains"])
    for j, unit in enumerate(np.eye(kernels.n_t)):
        directions = np.broadcast_to(unit, (len(states), kernels.n_t))
        gains[:, :, j] = observation_change(kernels, states, observations, directions) @ weight.T
    arrays = {**batch.arrays, "actions": network.act(observations), "feedback_gains": gains}
    return network, Batch(batch.demonstration, batch.stage, arrays)


def losses(demonstrations, statistics, network, batch, **settings):
    objective = Objective(demonstrations.kernels, statistics, ObjectiveWeights(**settings))
    return objective(network, batch, np.random.default_rng(0))


@pytest.mark.parametrize("scene", ["paper", "planar", "reaction-wheels"])
def test_the_derivative_of_the_observation_is_exact(scene):
    kernels = compile_scene(load_scene(scene))
    rng = np.random.default_rng(0)
    start = np.broadcast_to(kernels.layout.initial_state, (40, kernels.n_x))
    states = kernels.retract(start, 0.3 * rng.normal(size=(40, kernels.n_t)))
    left = np.full((40, 1), 3.0)
    observations = kernels.observation(states, left)[0]
    directions = rng.normal(size=(40, kernels.n_t))

    def moved(step):
        return kernels.observation(kernels.retract(states, step * directions), left)[0]

    # Of fourth order, with a hundred times the step.
    step = 1e-3
    near, far = (moved(each) - moved(-each) for each in (step, 2.0 * step))
    reference = (8.0 * near - far) / (12.0 * step)
    found = observation_change(kernels, states, observations, directions)
    np.testing.assert_allclose(found, reference, rtol=0, atol=1e-8)
    assert np.abs(reference).max() > 0.1
    np.testing.assert_array_equal(found[:, -1], 0.0)


def test_observations_around_a_demonstration_are_relative_to_its_own_target(drawn):
    statistics = Statistics.of(drawn)
    objective = Objective(drawn.kernels, statistics, ObjectiveWeights(augmentation_weight=1.0))
    assert objective.needs == COLUMNS
    batch = next(drawn.batches(50, COLUMNS, seed=0))
    states, observations, parameters = (
        batch.arrays[name] for name in ("states", "observations", "parameters")
    )
    directions = np.random.default_rng(0).normal(size=(50, drawn.kernels.n_t))
    found = observation_change(drawn.kernels, states, observations, directions, parameters)
    step = 1e-4
    moved = drawn.kernels.retract(states, step * directions)
    after = drawn.kernels.observation(moved, observations[:, -1:], p=parameters)[0]
    np.testing.assert_allclose((after - observations) / step, found, rtol=0, atol=1e-2)
    nominal = observation_change(drawn.kernels, states, observations, directions)
    assert np.abs(nominal - found).max() > 0.05
    network = PolicyNetwork(observations.shape[1], drawn.kernels.n_u, hidden=())
    assert torch.isfinite(objective(network, batch, np.random.default_rng(0)).total)


def test_time_steps_have_the_target_and_the_masses_of_their_stage(staged):
    batch, kernels = next(staged.batches(200, COLUMNS, seed=0)), staged.kernels
    states, observations, parameters = (
        batch.arrays[name] for name in ("states", "observations", "parameters")
    )
    seen = kernels.observation(states, observations[:, -1:], p=parameters)[0]
    np.testing.assert_allclose(seen, observations, rtol=0, atol=1e-12)
    directions = np.random.default_rng(0).normal(size=(200, kernels.n_t))
    exact = kernels.observation_jacobian(states, p=parameters) @ directions[:, :, None]
    found = observation_change(kernels, states, observations, directions, parameters)
    np.testing.assert_allclose(found, exact[:, :, 0], rtol=0, atol=1e-8)


def test_a_policy_with_the_right_gains_has_no_gain_loss(demonstrations, statistics, batch):
    network, exact = linear_network(demonstrations, statistics, batch)

    def loss(factor):
        gains = np.float32(factor) * exact.arrays["feedback_gains"]
        changed = Batch(batch.demonstration, batch.stage, {**exact.arrays, "feedback_gains": gains})
        return losses(demonstrations, statistics, network, changed, gain_weight=2.0)

    found, size, whole = loss(1.0), loss(1.1), loss(0.0)
    assert found.action.item() < 1e-12
    assert found.gain.item() < 1e-10
    # Gains that are a tenth too large are wrong by a hundredth of their mean square.
    assert size.gain.item() == pytest.approx(0.01 * whole.gain.item(), rel=1e-3)
    assert size.total.item() == pytest.approx(size.action.item() + 2.0 * size.gain.item())


def test_gains_of_inputs_at_a_limit_do_not_count(demonstrations, statistics, batch):
    network, exact = linear_network(demonstrations, statistics, batch)
    arrays = {**exact.arrays, "actions": exact.arrays["actions"].copy()}
    arrays["actions"][:, 0] = 1.0
    arrays["feedback_gains"] = exact.arrays["feedback_gains"].copy()
    arrays["feedback_gains"][:, 0] = 0.0
    found = losses(demonstrations, statistics, network, Batch(batch.demonstration, batch.stage, arrays))
    assert found.gain.item() < 1e-10


def test_more_than_the_limit_is_as_good_as_the_limit(demonstrations, statistics, batch):
    network, exact = linear_network(demonstrations, statistics, batch)
    with torch.no_grad():
        network.layers[0].weight.zero_()
        network.layers[0].bias.copy_((3.0 - network.action_mean) / network.action_scale)  # all actions are 3
    for wanted, loss in ((1.0, 0.0), (-1.0, 16.0), (0.9, 2.1**2)):
        arrays = {**exact.arrays, "actions": np.full_like(exact.arrays["actions"], wanted)}
        changed = Batch(batch.demonstration, batch.stage, arrays)
        found = losses(demonstrations, statistics, network, changed, gain_weight=0.0)
        size = np.mean(loss / statistics.action_deviation**2)
        assert found.action.item() == pytest.approx(size, rel=1e-5)


def test_the_least_action_of_a_thruster_is_zero():
    """Idle, it may be wanted to pull: clipping undoes that, and its row of gains is zero."""
    kernels = compile_scene("thrusters")
    layout, n_u = kernels.layout, kernels.n_u
    jets = layout.control.thruster_force
    states = np.tile(layout.initial_state, (4, 1))
    observations = kernels.observation(states, np.full((4, 1), 3.0))[0]
    actions = np.full((4, n_u), 0.5)
    actions[:, jets] = 0.0
    gains = np.zeros((4, n_u, kernels.n_t), np.float32)
    arrays = {"states": states, "observations": observations, "actions": actions, "feedback_gains": gains}
    seen, given = np.zeros(observations.shape[1]), np.zeros(n_u)
    units = seen, seen + 1.0, given, given + 1.0
    statistics = Statistics(*units, np.ones(kernels.n_t), given + 1.0)
    network = PolicyNetwork(len(seen), n_u, hidden=())
    network.normalize(*units)
    with torch.no_grad():
        network.layers[0].weight.zero_()
        network.layers[0].weight[jets] = 0.01
        network.layers[0].bias.copy_(torch.from_numpy(actions[0]))
        network.layers[0].bias[jets] = -2.0
    batch = Batch(np.zeros(4, int), np.arange(4), arrays)
    weights = ObjectiveWeights(gain_weight=1.0, augmentation_weight=1.0)
    found = Objective(kernels, statistics, weights)(network, batch, np.random.default_rng(0))
    assert found.action.item() == found.gain.item() == found.augmentation.item() == 0.0


def test_augmentation_asks_for_the_action_that_the_gains_give(demonstrations, statistics, batch):
    network, exact = linear_network(demonstrations, statistics, batch)
    inside = np.abs(exact.arrays["actions"]).max(axis=1) < 0.9
    arrays = {name: array[inside] for name, array in exact.arrays.items()}
    exact = Batch(batch.demonstration[inside], batch.stage[inside], arrays)
    assert inside.sum() > 50

    def error(scale, factor=1.0):
        changed = {**arrays, "feedback_gains": np.float32(factor) * arrays["feedback_gains"]}
        settings = {"gain_weight": 0.0, "augmentation_weight": 1.0, "augmentation_scale": scale}
        given = Batch(exact.demonstration, exact.stage, changed)
        return losses(demonstrations, statistics, network, given, **settings).augmentation.item()

    # Right gains leave what is of second order in the deviation, so its square is of fourth.
    assert error(1e-2) < 1e-4 * error(1e-2, factor=0.0)
    assert error(2e-2) / error(1e-2) == pytest.approx(16.0, rel=0.3)


def test_statistics_are_those_of_all_time_steps(demonstrations, statistics):
    observations = np.concatenate([each.observations[:-1] for each in demonstrations])
    actions = np.concatenate([each.actions for each in demonstrations])
    np.testing.assert_allclose(statistics.observation_mean, observations.mean(axis=0), rtol=0, atol=1e-12)
    np.testing.assert_allclose(statistics.observation_deviation, observations.std(axis=0), rtol=0, atol=1e-12)
    np.testing.assert_allclose(statistics.action_deviation, actions.std(axis=0), rtol=0, atol=1e-12)
    # The root mean square of G d over random deviations d.
    rng = np.random.default_rng(0)
    gains = np.concatenate([each.feedback_gains for each in demonstrations])
    deviations = rng.standard_normal((100, *statistics.spread.shape)) * statistics.spread
    sampled = np.sqrt(np.mean((gains @ deviations.T) ** 2, axis=(0, 2)))
    np.testing.assert_allclose(statistics.gain_size, sampled, rtol=0.1)


def test_the_spread_is_that_of_states_at_the_same_stage(demonstrations, statistics):
    """Joint angles are tangent coordinates themselves: their spread is a plain standard deviation."""
    layout = demonstrations.kernels.layout
    states = np.array([each.states[:-1] for each in demonstrations])
    joints = np.sqrt(states[:, :, layout.state.joint_angles].var(axis=0).mean(axis=0))
    np.testing.assert_allclose(statistics.spread[layout.tangent.joint_angles], joints, rtol=0.05)
