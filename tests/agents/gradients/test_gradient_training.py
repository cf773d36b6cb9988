"""Training by analytic policy gradients: its rules, its constraints, and that it resumes to the bit."""

import math
from dataclasses import replace

import numpy as np
import pytest

pytest.importorskip("threadpoolctl")

from agents import train
from agents.configuration import ConfigurationError, load_configuration
from agents.configuration.gradients import FlightMismatch
from agents.configuration.schema import Network
from agents.experiments.many_trainings import train_seeds
from agents.gradients import first_units, gradient_training
from agents.gradients.first_units import motions
from agents.gradients.gradient_training import train_by_gradients
from agents.run_folder import DivergedError, RunFolder, RunFolderError, validation_seeds
from dq_space_arm_env import DQSpaceArmVectorEnv, compile_scene
from dq_space_arm_env.environment.rollouts import rollout
from experts.demonstrations import SerialExecutor

pytestmark = pytest.mark.agents

COUNT, SEEDS = 16, list(range(16))


def test_masses_are_those_of_starts(small_file, small_scene):
    factors = (0.5, 2.0)
    given = settings(small_file).model_copy(
        update={"mismatch": FlightMismatch(mass_factors=factors, noise=0.0, push=0.05, pushes=3, delay=1.0)}
    )
    learner = gradient_training._Learner(given, small_scene)
    assert learner._mean.shape == DQSpaceArmVectorEnv(1, small_scene).single_observation_space.shape
    entry = learner._episodes._kernels.parameters.names.index("links.2.mass")
    learner._update()
    masses = learner._episodes.parameters[0, :, entry] / small_scene.links[2].mass
    assert set(masses.tolist()) == set(factors)
    learner._adapt()


def test_decisions_are_divided_where_the_integration_errs(small_file, small_scene, monkeypatch):
    learner = gradient_training._Learner(settings(small_file), small_scene)
    learner._update()
    np.testing.assert_array_equal(learner._episodes.substeps, 1)  # calm at first
    monkeypatch.setattr(gradient_training, "TOLERATED", 1e-9)
    lengths, starts = np.diff(learner._times), learner._starts.states[:16]
    most = np.ceil(lengths / small_scene.simulation.dt - 1e-9)
    while learner._divide(learner._fly(starts)[1]):
        assert (learner._episodes.substeps <= most).all()
        assert math.isinf(learner._fallback.cost)
    substeps, errors = learner._episodes.substeps, learner._episodes.errors()
    assert substeps.min() < substeps.max()
    errs = errors > 1e-9 * learner._fly(starts)[1] / len(errors)
    np.testing.assert_array_equal(substeps[errs], most[errs])


def test_constrained_episodes_decide_at_every_time_step_at_last(limited, small_file, small_scene):
    """What violates a constraint for a moment may do so between decisions; starts are new ones then."""
    free, learner = (
        gradient_training._Learner(settings(small_file, updates=20), each) for each in (small_scene, limited)
    )
    for _ in range(18):
        free._update()
        learner._update()
    assert len(learner._times) == 41
    prices, units = (each.copy() for each in (learner._episodes.penalties.prices, learner._episodes.units))
    learner._adapt = lambda: None  # or they change
    weights = learner._weights[0].copy()
    learner._update()
    free._update()
    dt, steps = limited.simulation.dt, limited.simulation.steps
    np.testing.assert_array_equal(learner._times, dt * np.arange(steps + 1))
    np.testing.assert_array_equal(learner._episodes.penalties.prices, prices)
    np.testing.assert_array_equal(learner._episodes.units, units)
    assert not np.array_equal(learner._weights[0], weights)
    assert learner.effort()["environment_steps"] == 16 * (18 * 40 + steps)
    assert len(free._times) == 41
    assert free.effort()["environment_steps"] == 16 * 19 * 40
    first = learner._starts.states
    learner._update()
    known = {row.tobytes() for row in (*free._starts.states, *first)}
    assert len(known) == 256 + 16
    assert known.isdisjoint(row.tobytes() for row in learner._starts.states)


def test_starts_are_new_at_last_where_episodes_decide_at_every_time_step_throughout(limited, small_file):
    steps = limited.simulation.steps
    learner = gradient_training._Learner(settings(small_file, updates=20, decisions=steps, copies=4), limited)
    drawn = []
    for _ in range(20):
        learner._update()
        drawn.append(learner._starts.states.tobytes())
    assert len(set(drawn[:18])) == 1
    assert len(set(drawn)) == 3
    assert learner.effort()["environment_steps"] == 4 * 20 * steps


def settings(small_file, **algorithm):
    changes = {"updates": 120, "copies": 16, "decisions": 40, "starts": 256, **algorithm}
    return load_configuration(
        {
            "name": "small",
            "scene": str(small_file),
            "network": {"hidden": [16, 16]},
            "algorithm": {"name": "APG", **changes},
            "progression": {"evaluate_every": 60, "evaluation_episodes": 8, "checkpoint_every": 60},
        }
    )


def test_training_lowers_the_cost_and_resumes_to_the_bit(small_file, small_scene, tmp_path, monkeypatch):
    monkeypatch.setattr(gradient_training, "TOLERATED", 1e-9)  # such that decisions are divided
    long = settings(small_file, updates=240)
    trained = train_by_gradients(long, tmp_path / "whole")
    curve = [line["median_cost"] for line in trained_curve(tmp_path / "whole")]
    idle = np.median(rollout(lambda seen: np.zeros((len(seen), 6)), small_scene, validation_seeds(8)).cost)
    assert curve[-1] < 0.2 * idle
    assert trained.policy.metadata["training"]["updates"] == 240

    resumed = resume_after(177, long, tmp_path / "halves", monkeypatch)
    for one, other in zip(trained.policy.weights, resumed.policy.weights, strict=True):
        np.testing.assert_array_equal(one, other)
    assert len(trained_curve(tmp_path / "halves")) == 4


def resume_after(updates, configuration, folder, monkeypatch, meanwhile=lambda: None):
    """Train with an interruption, during which something happens."""

    class StopError(Exception):
        """As if the process were killed."""

    update, done = gradient_training._Learner._update, []

    def stopped(learner):
        if len(done) == updates:
            raise StopError
        done.append(learner)
        return update(learner)

    monkeypatch.setattr(gradient_training._Learner, "_update", stopped)
    with pytest.raises(StopError):
        train_by_gradients(configuration, folder)
    monkeypatch.setattr(gradient_training._Learner, "_update", update)
    meanwhile()
    return train_by_gradients(configuration, folder)


def test_constraints_are_learned_and_prices_resumed(limited, small_file, tmp_path, monkeypatch):
    limited.to_yaml(tmp_path / "limited.yaml")
    constrained = settings(tmp_path / "limited.yaml")
    often = constrained.progression.model_copy(update={"checkpoint_every": 38})
    constrained = constrained.model_copy(update={"progression": often})
    trained = train_by_gradients(constrained, tmp_path / "whole")
    prices = []
    for folder, updates in (("whole", 0), ("before", 77), ("amid", 117)):  # of the last, at every time step
        if updates:
            resumed = resume_after(updates, constrained, tmp_path / folder, monkeypatch)
            for one, other in zip(trained.policy.weights, resumed.policy.weights, strict=True):
                np.testing.assert_array_equal(one, other)
        last = max((tmp_path / folder / "checkpoints").glob("*/checkpoint.npz"))
        with np.load(last) as arrays:
            prices.append(arrays["prices"])
            assert len(arrays["substeps"]) == limited.simulation.steps
    for each in prices[1:]:
        np.testing.assert_array_equal(each, prices[0])
    unaware = train_by_gradients(settings(small_file), tmp_path / "unaware").policy
    policies = trained.policy, unaware
    violated = [rollout(each, limited, SEEDS).constraint_violations.mean() for each in policies]
    assert violated[0] < 0.5 * violated[1], violated  # some starts violate


def test_units_follow_the_inputs_and_leave_the_policy(small_file, small_scene):
    learner = gradient_training._Learner(settings(small_file), small_scene)
    seen = DQSpaceArmVectorEnv(COUNT, small_scene).reset(seed=SEEDS)[0]
    for _ in range(61):  # the integration is not measured now
        learner._update()
    before, units = learner.export({})(seen), learner._episodes.units.copy()
    for _ in range(300):
        learner._adapt()
    np.testing.assert_allclose(learner.export({})(seen), before, rtol=0, atol=1e-6)
    sizes = learner._episodes.sizes()
    np.testing.assert_allclose(learner._episodes.units, 4.0 * sizes, rtol=1e-9)
    assert not np.allclose(units, 4.0 * sizes, rtol=0.1)
    shares = learner._episodes._relative
    learner._decide_at_every_step()  # a resumed training comes here with its first units
    np.testing.assert_array_equal(learner._episodes._relative, shares)


def test_light_joints_have_small_units(small_file, small_scene):
    strong = small_scene.replace(actuators={"joint_torque": {"limit": 1e3}})
    plain, light = (gradient_training._Learner(settings(small_file), each) for each in (small_scene, strong))
    np.testing.assert_array_equal(plain._episodes.units, 0.1)
    joints = compile_scene(small_scene).layout.control.joint_torque
    moved = light._episodes.units[joints] / 0.1 * motions(strong, 1e-3)[joints]
    np.testing.assert_allclose(moved, first_units.FARTHEST)
    light._update()
    sizes = light._episodes.sizes()[joints]  # in the same proportions
    np.testing.assert_allclose(
        sizes / sizes[0], light._episodes.units[joints] / light._episodes.units[joints][0]
    )


def test_observations_that_small_inputs_hardly_vary_are_scaled_by_motions(
    small_file, small_scene, monkeypatch
):
    """In honey, joints turn much faster in a maneuver than under small inputs that change all the time."""
    links = [{**link.model_dump(exclude_none=True), "damping": 0.3} for link in small_scene.links]
    slow = small_scene.replace(links=links, spread={"joint_rates": 0})
    scale = gradient_training._Learner(settings(small_file, decisions=150), slow)._scale
    monkeypatch.setattr(first_units, "PART", 1e-9)
    by_small_inputs = gradient_training._Learner(settings(small_file, decisions=150), slow)._scale
    relative, rates = scale / by_small_inputs, slice(-4, -2)  # of the first two joints
    assert (relative <= 1.0).all()
    assert (relative > 0.0).all()
    assert relative[rates].max() < 0.8


def test_methods_that_adapt_their_steps_do_so_less(small_scene):
    assert gradient_training.coarser(small_scene) is small_scene
    stiff = small_scene.replace(simulation={"integrator": "rodas4"})
    assert gradient_training.coarser(stiff).simulation.tolerance == 1e-4
    rough = stiff.replace(simulation={"tolerance": 1e-3})
    assert gradient_training.coarser(rough).simulation.tolerance == 1e-3
    explicit = small_scene.replace(simulation={"integrator": "dormand_prince"})
    assert gradient_training.coarser(explicit).simulation.rtol == 1e-4


def test_end_weights_fall_where_episodes_reach_and_missing_has_a_price_later(small_file, small_scene):
    learner = gradient_training._Learner(settings(small_file), small_scene)
    prices = learner._episodes.penalties.prices
    learner._update()
    assert learner._end_weight == 400.0  # they miss
    learner._episodes.misses = lambda: np.where(np.arange(COUNT) < 5, 1.1, 0.9)
    learner._adapt()
    assert learner._end_weight == 400.0  # five of 16
    learner._episodes.misses = lambda: np.where(np.arange(COUNT) < 4, 1.1, 0.9)
    learner._adapt()
    assert learner._end_weight == pytest.approx(400.0 / 1.01)
    assert not prices.any()
    learner._updates = 78  # 60 % of what comes after 30 % of the updates
    learner._update()
    assert learner._episodes.penalties.hardening == pytest.approx(0.5)
    assert prices.all()


@pytest.mark.parametrize("updates", [120, 121])  # the integration is measured next, or not
def test_unstable_motions_go_back_to_the_last_copy_but_one(small_file, small_scene, updates):
    learner = gradient_training._Learner(settings(small_file), small_scene)
    for _ in range(updates):
        learner._update()
    fallback = learner._fallback
    kept, rate = fallback.kept.arrays["weight0"].copy(), fallback.rate
    learner._weights[0][:] += 0.1
    measured = []
    learner._divide = lambda _: measured.append(learner._weights[0].copy())  # or costs would be others
    fallback.cost = 1e-3  # even the copy is no better: training goes on from its cost
    learner._update()
    np.testing.assert_array_equal(measured, [kept])  # not what has become unstable
    for weights in (learner._weights[0], fallback.newer.arrays["weight0"]):  # what came of the last is lost
        np.testing.assert_array_equal(weights, kept)
    assert fallback.rate < rate
    assert 1e-3 < fallback.cost == fallback.kept.cost
    rate = fallback.rate
    learner._update()
    assert not np.array_equal(learner._weights[0], kept)
    assert fallback.rate == pytest.approx(1.001 * rate)


def test_slopes_that_overflow_go_back_to_a_copy(small_file, small_scene):
    """They would leave weights that are no numbers, and have no eigenbases."""
    learner = gradient_training._Learner(settings(small_file), small_scene)
    kept, exact = learner._fallback.kept.arrays["weight0"].copy(), learner._episodes.gradient

    def overflowing(*given):
        learner._episodes.gradient = exact  # the next ones do not
        gradient, costs = exact(*given)
        gradient[0][:] = np.inf
        return gradient, costs

    learner._episodes.gradient = overflowing
    learner._weights[0][:] += 0.1
    learner._update()
    np.testing.assert_array_equal(learner._weights[0], kept)
    assert learner._fallback.rate < 1.0
    learner._update()
    assert not np.array_equal(learner._weights[0], kept)


@pytest.mark.parametrize("what", ["costs", "misses"])
def test_what_drifts_goes_back_to_a_copy(small_file, small_scene, what):
    learner = gradient_training._Learner(settings(small_file), small_scene)
    for _ in range(61):  # the integration is not measured now
        learner._update()
    fallback = learner._fallback
    kept, rate = fallback.kept.arrays["weight0"].copy(), fallback.rate
    assert not np.array_equal(learner._weights[0], kept)
    if what == "costs":
        fallback.kept.cost = fallback.cost / 1.6
    else:
        fallback.kept.missing = fallback.missing - 0.31
    learner._update()
    np.testing.assert_array_equal(learner._weights[0], kept)
    assert fallback.rate < rate
    assert fallback.cost <= fallback.kept.cost
    assert fallback.missing <= fallback.kept.missing


@pytest.mark.parametrize(
    ("what", "said"),
    [
        ("costs", r"at update 62 flights cost \d.* where they did \d.*; reduce algorithm.learning_rate = 0"),
        ("misses", r"at update 62 the share of flights that miss rose from 0.30 to 0.65, again and again"),
    ],
)
def test_a_training_that_gives_up_says_what_was_lost(small_file, small_scene, what, said):
    learner = gradient_training._Learner(settings(small_file), small_scene)
    for _ in range(61):  # the integration is not measured now
        learner._update()
    fallback = learner._fallback
    fallback.rate = 1e-3
    if what == "costs":
        fallback.kept.cost = fallback.cost / 1.6
    fallback.kept.missing, fallback.missing = 0.3, 0.65
    with pytest.raises(DivergedError, match=f"training diverged: {said}"):
        learner._update()


@pytest.mark.parametrize(
    ("factor", "more", "taken"), [(1.1, 0.05, True), (1.3, 0.05, False), (1.1, 0.15, False)]
)
def test_copies_are_taken_while_costs_and_misses_stay(small_file, small_scene, factor, more, taken):
    learner = gradient_training._Learner(settings(small_file), small_scene)
    for _ in range(50):
        learner._update()
    fallback = learner._fallback
    copies = fallback.newer, fallback.kept
    before = [learner._weights[0].copy(), *(copy.arrays["weight0"].copy() for copy in copies)]
    fallback.kept.cost = fallback.cost / factor
    fallback.kept.missing = fallback.missing - more
    learner._update()
    found = fallback.newer.arrays["weight0"], fallback.kept.arrays["weight0"]
    np.testing.assert_array_equal(found, before[:2] if taken else before[1:])


@pytest.mark.slow
def test_episodes_that_all_start_alike_are_told_once(small_scene, tmp_path):
    nothing = dict.fromkeys(small_scene.spread.model_dump(exclude={"observed"}), 0.0)
    small_scene.replace(name="still", spread=nothing).to_yaml(tmp_path / "still.yaml")
    given = settings(tmp_path / "still.yaml", updates=2)
    said = r"scene 'still' has no spread, so all episodes start alike: the policy learns to fly from this"
    with pytest.warns(UserWarning, match=said):
        train(given, tmp_path / "alone")
    with pytest.warns(UserWarning, match=said) as told:
        rows = train_seeds([given], 2, tmp_path / "runs", executor=SerialExecutor())
    assert [row["outcome"] for row in rows] == ["trained"] * 2
    assert len(told) == 1


def test_training_starts_from_a_policy(small_file, tmp_path):
    first = train_by_gradients(settings(small_file), tmp_path / "first").policy
    start = {"start_from": str(tmp_path / "first")}
    going_on = settings(small_file, updates=2, learning_rate=1e-9).model_copy(update=start)
    after = train_by_gradients(going_on, tmp_path / "second").policy
    for one, other in zip(first.weights, after.weights, strict=True):
        np.testing.assert_allclose(other, one, rtol=1e-5, atol=1e-6)
    assert after.metadata["training"]["seconds"] > first.metadata["training"]["seconds"]
    wider = {**start, "network": Network(hidden=[8])}
    with pytest.raises(ConfigurationError, match=r"start_from: .* not fit: network.hidden is \[16, 16\]"):
        train_by_gradients(settings(small_file).model_copy(update=wider), tmp_path / "third")


def test_a_training_goes_on_without_the_policy_that_it_started_from(small_file, tmp_path, monkeypatch):
    first = train_by_gradients(settings(small_file, updates=3), tmp_path / "first").policy
    taken = {"seconds": 1000.0, "expert_solves": 7}
    start = tmp_path / "start.npz"
    replace(first, metadata={"training": taken}).save(start)
    longer = settings(small_file, updates=70).model_copy(update={"start_from": str(start)})
    whole = train_by_gradients(longer, tmp_path / "whole").policy
    halves = tmp_path / "halves"
    resumed = resume_after(65, longer, halves, monkeypatch, start.unlink).policy
    for one, other in zip(whole.weights, resumed.weights, strict=True):
        np.testing.assert_array_equal(one, other)
    noted = resumed.metadata["training"]
    assert noted["seconds"] > taken["seconds"]
    assert noted["expert_solves"] == 7
    (checkpoint,) = (halves / "checkpoints").glob("*/checkpoint.npz")
    with np.load(checkpoint) as found:  # as earlier ones were
        np.savez(checkpoint, **{name: found[name] for name in found.files if name != "expert_solves"})
    with pytest.raises(ConfigurationError, match=r"start_from: .*start\.npz"):
        train_by_gradients(longer, halves)
    replace(first, metadata={"training": taken}).save(start)
    again = train_by_gradients(longer, halves).policy
    assert again.metadata["training"]["expert_solves"] == 7


def test_normalization_is_that_of_the_checkpoint(small_file, tmp_path, monkeypatch):
    """Weights belong to it; the policy that a training starts from may have been trained anew since."""
    first = resume_after(10, settings(small_file, updates=20), tmp_path, monkeypatch).policy
    measured = gradient_training.first_units

    def others(*arguments):
        mean, scale, outputs = measured(*arguments)
        return mean + 1.0, 2.0 * scale, outputs

    monkeypatch.setattr(gradient_training, "first_units", others)
    (tmp_path / "policy.npz").unlink()
    again = train_by_gradients(settings(small_file, updates=20), tmp_path).policy
    np.testing.assert_array_equal(again.mean, first.mean)
    np.testing.assert_array_equal(again.scale, first.scale)


def trained_curve(folder):
    return RunFolder(folder, load_configuration(folder / "config.yaml")).evaluations()


def test_checkpoints_may_be_as_large_as_their_network_asks_for(small_file, tmp_path, monkeypatch):
    monkeypatch.setattr(gradient_training, "ARRAY_BYTES", 0)  # what they may have beside
    first, again = (train_by_gradients(settings(small_file, updates=3), tmp_path).policy for _ in range(2))
    for one, other in zip(first.weights, again.weights, strict=True):
        np.testing.assert_array_equal(one, other)


def test_a_damaged_checkpoint_is_refused(small_file, tmp_path):
    train_by_gradients(settings(small_file, updates=20), tmp_path)
    (checkpoint,) = (tmp_path / "checkpoints").glob("*/checkpoint.npz")
    checkpoint.write_bytes(checkpoint.read_bytes()[:1000])
    with pytest.raises(RunFolderError, match=r"cannot be read .* remove it"):
        train_by_gradients(settings(small_file, updates=20), tmp_path)


def test_a_learning_curve_of_another_kind_is_refused_before_the_training(small_file, tmp_path):
    """As one of reinforcement learning, whose lines have no updates."""
    line = '{"environment_steps": 40, "seconds": 1.0, "success_rate": 0.0, "median_cost": 2.0}\n'
    (tmp_path / "evaluations.jsonl").write_text(line)
    with pytest.raises(RunFolderError, match=r"jsonl is damaged .* lacks a number of .*, updates"):
        train_by_gradients(settings(small_file, updates=3), tmp_path)
    assert not list((tmp_path / "checkpoints").iterdir())


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"crowding": 1.5}, "algorithm.*crowding = 1.5: must be at most 1"),
        ({"decisions": 2}, "algorithm.*decisions = 2: must be at least 3"),
        ({"copies": 10_000_000}, "algorithm.copies = 10000000: all copies take 400,000,000 decisions"),
    ],
)
def test_mistakes_are_named(small_file, changes, message):
    with pytest.raises(ConfigurationError, match=message):
        settings(small_file, **changes)
