"""DAgger: what the expert says about visited states, and a network that learns from it."""

from dataclasses import replace

import numpy as np
import pytest

torch = pytest.importorskip("torch")

from agents.configuration import Network  # noqa: E402
from agents.configuration.imitation import Cloning, Dagger, ObjectiveWeights  # noqa: E402
from agents.imitation import Making, aggregate, clone  # noqa: E402
from agents.imitation.aggregation import CORRECTIONS  # noqa: E402
from agents.imitation.labels import Solver, label_by_gains  # noqa: E402
from agents.imitation.samples import COLUMNS, NAMES, Corrections, Mixture  # noqa: E402
from agents.imitation.trainer import CheckpointError, TrainingAdvance  # noqa: E402
from dq_space_arm_env.environment.rollouts import rollout  # noqa: E402

pytestmark = [pytest.mark.agents, pytest.mark.slow]

STEPS = {"batch_size": 128, "warm_up": 10}
CLONING = Cloning.model_validate(
    {"optimization": {"updates": 200, "learning_rate": 1e-2, **STEPS}, "validate_every": 50}
)
MAKING = Making(Network(hidden=(32, 32)))


def dagger(updates=60, **changes):
    settings = {"rounds": 2, "episodes": 6, "solves": 2, "cloning": CLONING, **changes}
    optimization = {"updates": updates, "learning_rate": 2e-3, **STEPS}
    return Dagger.model_validate({**settings, "optimization": optimization})


class Replay:
    """The demonstrations' actions, stage by stage, changed by a constant."""

    def __init__(self, demonstrations, change=0.0):
        self.actions = np.array([each.actions for each in demonstrations]) + change
        self.stage = 0

    def __call__(self, observation):
        self.stage += 1
        return self.actions[:, self.stage - 1]


def flown(demonstrations, change=0.0):
    replay = Replay(demonstrations, change)
    return rollout(replay, demonstrations.scene, demonstrations.column("seed").tolist(), record=True)


@pytest.fixture(scope="module")
def some(demonstrations):
    return demonstrations[:5]


@pytest.fixture(scope="module")
def cloned(demonstrations):
    return clone(demonstrations, CLONING, making=MAKING)


def test_flights_of_the_expert_are_the_demonstrations(some):
    flights = flown(some)
    np.testing.assert_array_equal(flights.states[:, :-1], [each.states[:-1] for each in some])
    np.testing.assert_array_equal(flights.observations[:, :-1], [each.observations[:-1] for each in some])
    np.testing.assert_allclose(flights.cost, some.column("cost"), rtol=1e-9)
    assert flights.is_success.all()
    np.testing.assert_array_equal(flights.length, some.scene.simulation.steps)


def test_on_its_own_way_the_expert_confirms_itself(some):
    labels = label_by_gains(some, flown(some))
    np.testing.assert_allclose(
        labels.actions, np.concatenate([each.actions for each in some]), rtol=0, atol=1e-9
    )


def test_gains_correct_a_flight_that_strays(some):
    flights = flown(some, change=0.02)
    labels = label_by_gains(some, flights)
    states, gains = flights.states[0, 40], some[0].feedback_gains[40]
    deviation = some.kernels.difference(some[0].states[40], states)
    expected = np.clip(some[0].actions[40] + gains @ deviation, -1.0, 1.0)
    np.testing.assert_allclose(labels.actions[40], expected, rtol=0, atol=1e-9)
    assert np.abs(expected - some[0].actions[40]).max() > 0.01
    clamped = np.abs(labels.actions) == 1.0
    assert clamped.any()
    assert not labels.feedback_gains[clamped].any()


def test_new_plans_begin_where_the_flight_went_and_are_optimal(some):
    flights = flown(some, change=0.02)
    labels, plans = Solver(some.scene).label(some, flights, 2, np.random.default_rng(0))
    assert plans == 2 * len(some)
    # The stage follows from the time left; each plan begins with a visited state.
    simulation = some.scene.simulation
    stages = simulation.steps - np.rint(labels.observations[:, -1] / simulation.dt).astype(int)
    firsts = np.flatnonzero(np.diff(stages, prepend=-2) != 1)
    assert len(firsts) >= len(some)
    visited = flights.states.reshape(-1, flights.states.shape[2])
    for first in firsts:
        assert np.abs(visited - labels.states[first]).max(axis=1).min() < 1e-12
    # Bellman: the optimal way from an optimal state is the rest of the way.
    again, _ = Solver(some.scene).label(some, flown(some), 1, np.random.default_rng(0))
    stages = simulation.steps - np.rint(again.observations[:, -1] / simulation.dt).astype(int)
    firsts = [*np.flatnonzero(np.diff(stages, prepend=-2) != 1), len(stages)]
    for demonstration, begin, end in zip(some, firsts[:-1], firsts[1:], strict=True):
        rest = demonstration.actions[stages[begin] :]
        np.testing.assert_allclose(again.actions[begin:end], rest, rtol=0, atol=2e-3)


def test_an_interrupted_plan_ends_the_labels(some, monkeypatch):
    def interrupt(solver, state, callback):
        raise KeyboardInterrupt

    monkeypatch.setattr("experts.ddp.box_ddp.BoxDDP._iterate", interrupt)
    with pytest.raises(KeyboardInterrupt):
        Solver(some.scene).label(some, flown(some, change=0.02), 1, np.random.default_rng(0))


def test_plans_know_the_target_and_the_masses_of_each_stage(staged):
    plans_know_the_target_and_the_masses(staged)


def test_plans_know_the_target_and_the_masses_of_each_flight(drawn):
    plans_know_the_target_and_the_masses(drawn)


def plans_know_the_target_and_the_masses(drawn):
    flights = flown(drawn)
    np.testing.assert_allclose(flights.cost, drawn.column("cost"), rtol=1e-9)
    for labels in (
        label_by_gains(drawn, flights),
        Solver(drawn.scene).label(drawn, flights, 1, np.random.default_rng(0))[0],
    ):
        simulation = drawn.scene.simulation
        stages = simulation.steps - np.rint(labels.observations[:, -1] / simulation.dt).astype(int)
        firsts = [*np.flatnonzero(np.diff(stages, prepend=-2) != 1), len(stages)]
        assert len(firsts) == len(drawn) + 1
        for demonstration, begin, end in zip(drawn, firsts[:-1], firsts[1:], strict=True):
            rest = slice(stages[begin], -1)
            np.testing.assert_allclose(
                labels.actions[begin:end], demonstration.actions[rest.start :], rtol=0, atol=2e-3
            )
            np.testing.assert_allclose(
                labels.observations[begin:end], demonstration.observations[rest], rtol=0, atol=1e-2
            )
            rows = drawn.kernels.stage_parameters(demonstration.parameters)[stages[begin:end]]
            np.testing.assert_allclose(labels.parameters[begin:end], rows, rtol=0, atol=1e-12)


def test_a_network_learns_from_flights_to_other_targets(drawn, tmp_path):
    cloned = clone(drawn, CLONING, making=MAKING)
    first = aggregate(cloned, drawn, dagger(), tmp_path, making=MAKING)
    again = aggregate(cloned, drawn, dagger(), tmp_path, making=MAKING)  # reads its labels
    assert first.rounds == again.rounds
    assert (tmp_path / "round-00" / CORRECTIONS).is_file()


def test_labels_follow_the_dynamics(some):
    labels, _ = Solver(some.scene).label(some[:1], flown(some[:1], 0.02), 1, np.random.default_rng(0))
    limits = some.kernels.layout.control_limit
    after = some.kernels.step(labels.states[:-1], labels.actions[:-1] * limits)
    np.testing.assert_allclose(after, labels.states[1:], rtol=0, atol=1e-9)


def corrections(count, value):
    *rest, gains = (np.full((count, *shape), value) for shape in ((3,), (4,), (2,), (2, 3)))
    return Corrections(*rest, gains.astype(np.float32), np.zeros((count, 0)))


def test_a_mixture_keeps_its_shares():
    mixture = Mixture(corrections(30, 0.0), corrections(7, 1.0), share=0.4)
    batches = list(mixture.batches(10, NAMES, seed=0))
    assert len(batches) == 5
    # Every other time the second source ends with the three that are left.
    for batch, second in zip(batches, (4, 3, 4, 3, 4), strict=True):
        assert [len(array) for array in batch.arrays.values()] == [6 + second] * 4
        assert batch.arrays["actions"][:, 0].sum() == second


def test_corrections_are_gone_through_once():
    whole = Corrections(*(np.arange(10.0)[:, None] for _ in COLUMNS))
    rows = [batch.arrays["states"][:, 0] for batch in whole.batches(4, ("states",), seed=3)]
    assert [len(row) for row in rows] == [4, 4, 2]
    np.testing.assert_array_equal(np.sort(np.concatenate(rows)), np.arange(10.0))
    np.testing.assert_array_equal(whole.thinned(4).states[:, 0], [0.0, 4.0, 8.0])


def weights(network):
    return torch.cat([parameter.detach().flatten() for parameter in network.parameters()])


@pytest.mark.parametrize("labels", ["gains", "solve"])
def test_an_interrupted_run_ends_with_the_same_weights(demonstrations, cloned, tmp_path, labels):
    settings = dagger(labels=labels)
    whole = aggregate(cloned, demonstrations, settings, making=MAKING)
    told = []

    def interrupt(advance):
        told.append(advance.done if isinstance(advance, TrainingAdvance) else -1)
        if told.count(20) == 2:  # in the second round
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        aggregate(cloned, demonstrations, settings, tmp_path, making=MAKING, progress=interrupt)
    assert (tmp_path / "round-01" / CORRECTIONS).is_file()
    resumed = aggregate(cloned, demonstrations, settings, tmp_path, making=MAKING)
    assert torch.equal(weights(resumed.network), weights(whole.network))
    assert not torch.equal(weights(whole.network), weights(cloned.network))
    rounds, expected = ([each._replace(seconds=0.0) for each in run.rounds] for run in (resumed, whole))
    assert rounds == expected
    spent = [(each["updates"], each["environment_steps"]) for each in whole.history]
    assert spent[-5:] == [(200, 0), (250, 900), (260, 900), (310, 1800), (320, 1800)]
    assert [each.number for each in whole.rounds] == [0, 1]
    assert whole.rounds[1].corrections > whole.rounds[0].corrections
    assert whole.export().metadata["aggregation"]["labels"] == labels

    unlike = CLONING.model_copy(update={"objective": ObjectiveWeights(gain_weight=0.7)})
    others = [
        (dagger(61, labels=labels), MAKING),
        (settings, replace(MAKING, seed=1)),
        (dagger(labels=labels, cloning=unlike), MAKING),
    ]
    for other, making in others:
        with pytest.raises(CheckpointError, match="another run"):
            aggregate(cloned, demonstrations, other, tmp_path, making=making)


def test_a_round_has_no_more_flights_than_starts(demonstrations, cloned):
    settings = dagger(20, rounds=1, episodes=1000, labels="gains")
    corrected = aggregate(cloned, demonstrations, settings, making=MAKING, starts=demonstrations[:5])
    steps = demonstrations.scene.simulation.steps
    assert corrected.history[-1]["environment_steps"] == 5 * steps


def test_correction_brings_flights_closer_to_the_expert(demonstrations, cloned):
    def gap(network):
        seeds = demonstrations.column("seed").tolist()
        costs = rollout(network.act, demonstrations.scene, seeds).cost
        return np.median(costs / demonstrations.column("cost") - 1.0)

    corrected = aggregate(cloned, demonstrations, dagger(400, rounds=3, episodes=24), making=MAKING)
    assert gap(corrected.network) < 0.5 * gap(cloned.network)
