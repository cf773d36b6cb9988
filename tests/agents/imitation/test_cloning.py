"""Training on demonstrations: it learns, it can be interrupted, and gains teach more than actions alone."""

import zipfile

import numpy as np
import pytest

torch = pytest.importorskip("torch")

from agents.configuration import Network  # noqa: E402
from agents.configuration.imitation import Cloning  # noqa: E402
from agents.imitation import Making, clone  # noqa: E402
from agents.imitation.trainer import CHECKPOINT, CheckpointError, Trainer  # noqa: E402
from agents.policies.flying import fly  # noqa: E402
from experts.demonstrations import DemonstrationsError  # noqa: E402

pytestmark = pytest.mark.agents

MAKING = Making(Network(hidden=(32, 32)))


def cloning(gain_weight=0.3, validation_share=0.1, **optimization):
    given = {"updates": 200, "batch_size": 128, "learning_rate": 1e-2, "warm_up": 10, **optimization}
    shares = {"validation_share": validation_share, "validate_every": 50}
    return Cloning.model_validate(
        {"objective": {"gain_weight": gain_weight}, "optimization": given, **shares}
    )


QUICK = cloning()


def learn(demonstrations, settings=QUICK, folder=None, making=MAKING, **others):
    return clone(demonstrations, settings, folder, making=making, **others)


def weights(cloned):
    return torch.cat([parameter.detach().flatten() for parameter in cloned.network.parameters()])


def losses(cloned):
    return [{**record, "seconds": None} for record in cloned.history]


@pytest.fixture(scope="module")
def quick(demonstrations):
    return learn(demonstrations)


def test_it_learns(quick):
    last = quick.history[-1]
    assert last["updates"] == QUICK.optimization.updates
    # One is what the mean action, and no feedback, would leave.
    assert last["validation_action"] < 0.5
    assert last["validation_gain"] < 0.85


def test_a_training_that_diverges_gives_no_policy(demonstrations):
    with pytest.raises(ValueError, match=r"losses are no longer finite; reduce optimization.learning_rate"):
        learn(demonstrations, cloning(learning_rate=1e18))


def test_the_weights_that_are_kept_are_watched_last(demonstrations, monkeypatch):
    """Those of the lowest validation loss: learning curves end with the policy that is exported."""
    totals, watched = iter([3.0, 1.0, 2.0, 4.0]), []
    monkeypatch.setattr(Trainer, "_validate", lambda *_: {"total": next(totals)})

    def watch(network, record, is_last):
        watched.append(network.export({}).weights[0])
        return {}

    kept = learn(demonstrations, watch=watch).export().weights[0]
    assert [np.array_equal(each, kept) for each in watched] == [False, True, False, True]


def test_equal_seeds_give_equal_weights(quick, demonstrations):
    before = torch.random.get_rng_state()
    again = learn(demonstrations)
    other = learn(demonstrations, making=Making(MAKING.network, seed=1))
    assert torch.equal(weights(again), weights(quick))
    assert not torch.equal(weights(other), weights(quick))
    assert torch.equal(torch.random.get_rng_state(), before)


@pytest.mark.parametrize("stop", [20, 100, 180])
def test_an_interrupted_training_ends_with_the_same_weights(quick, demonstrations, tmp_path, stop):
    def interrupt(advance):
        if advance.done >= stop:
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        learn(demonstrations, folder=tmp_path, progress=interrupt)
    told = []
    resumed = learn(demonstrations, folder=tmp_path, progress=told.append)
    assert torch.equal(weights(resumed), weights(quick))
    assert losses(resumed) == losses(quick)
    # It has gone on from the last checkpoint: there is one after every fifty updates, and a message every
    # twenty, before that.
    assert told[0].done == {20: 20, 100: 60, 180: 160}[stop]
    # Nothing is left to be done.
    assert torch.equal(weights(learn(demonstrations, folder=tmp_path)), weights(quick))


def test_a_checkpoint_may_have_as_long_a_history_as_there_are_validations(
    demonstrations, tmp_path, monkeypatch
):
    often = cloning(updates=100, validation_share=0.0).model_copy(update={"validate_every": 1})
    first = learn(demonstrations, often, tmp_path)
    with zipfile.ZipFile(tmp_path / CHECKPOINT) as archive:
        (structure,) = (each for each in archive.infolist() if each.filename.endswith("data.pkl"))
    assert structure.file_size > 10_000
    monkeypatch.setattr("agents.policies.tensor_files.MOST_STRUCTURE", 10_000)
    assert losses(learn(demonstrations, often, tmp_path)) == losses(first)


def test_a_damaged_checkpoint_and_that_of_another_training_are_refused(demonstrations, tmp_path):
    short = cloning(updates=5)
    learn(demonstrations, short, tmp_path)
    with pytest.raises(CheckpointError, match=r"optimization\.batch_size is 128 there and 64 here"):
        learn(demonstrations, cloning(updates=5, batch_size=64), tmp_path)
    with pytest.raises(CheckpointError, match="demonstrations is 24 there and 20 here"):
        learn(demonstrations[:20], short, tmp_path)
    path = tmp_path / CHECKPOINT
    path.write_bytes(path.read_bytes()[:500])
    with pytest.raises(CheckpointError, match="cannot be read"):
        learn(demonstrations, short, tmp_path)


@pytest.mark.parametrize(
    ("changes", "said"),
    [
        ({"seconds": None}, "it has no 'seconds'"),
        ({"identity": [1]}, "cannot be read"),
        ({"network": {"layers.0.weight": torch.zeros(3)}}, "cannot be read"),
    ],
)
def test_a_checkpoint_that_lacks_something_is_named(changes, said, demonstrations, tmp_path):
    short = cloning(updates=2)
    learn(demonstrations, short, tmp_path)
    content = torch.load(tmp_path / CHECKPOINT, weights_only=True) | changes
    torch.save({name: part for name, part in content.items() if part is not None}, tmp_path / CHECKPOINT)
    with pytest.raises(CheckpointError, match=said) as caught:
        learn(demonstrations, short, tmp_path)
    assert "remove it to restart the training" in str(caught.value)


def test_demonstrations_may_be_stricter_than_the_scene(demonstrations):
    looser = demonstrations.scene.replace(name="looser", success={"position_error": 0.5})
    facts = learn(demonstrations, cloning(updates=2), scene=looser).facts
    assert (facts["scene"], facts["scene_hash"]) == ("looser", looser.content_hash())
    heavier = demonstrations.scene.replace(cost={"pose": 99.0})
    with pytest.raises(DemonstrationsError, match=r"another scene than 'small': cost.*only the tolerances"):
        learn(demonstrations, cloning(updates=2), scene=heavier)


@pytest.mark.slow
def test_a_stationary_policy_does_without_the_time_left(demonstrations, quick):
    few = cloning(updates=5)
    stationary = learn(demonstrations, few.model_copy(update={"stationary": True})).export()
    seen = demonstrations[0].observations[::50].copy()
    later = seen.copy()
    later[:, -1] = 0.0
    np.testing.assert_array_equal(stationary(later), stationary(seen))
    assert np.abs(quick.export()(later) - quick.export()(seen)).max() > 1e-3


@pytest.mark.endurance
def test_gains_teach_more_than_actions_alone(demonstrations):
    """From eight demonstrations, flights from other starts cost less with gains than without."""
    few, others = demonstrations[:8], demonstrations[8:]
    gaps = {}
    for gain_weight in (0.0, 0.3):
        settings = cloning(gain_weight, validation_share=0.0, updates=1500)
        policy = learn(few, settings, making=Making(Network(hidden=(64, 64)))).export()
        flights = fly(policy, others.scene, others.column("seed").tolist())
        gaps[gain_weight] = np.median(flights.cost / others.column("cost") - 1.0)
    assert gaps[0.3] < 0.5 * gaps[0.0]
