"""Analytic policy gradients: exact slopes of whole episodes, and a training that resumes to the bit."""

import math

import numpy as np
import pytest

pytest.importorskip("threadpoolctl")

from agents.configuration import ConfigurationError, load_configuration
from agents.configuration.gradients import FlightMismatch
from agents.configuration.schema import Network
from agents.gradients import episodes, gradient_training
from agents.gradients.disturbed_flights import Met
from agents.gradients.episodes import Episodes, decision_times
from agents.gradients.gradient_training import train_by_gradients
from agents.gradients.layers import Layers, random_weights
from agents.gradients.starts import Starts, motions
from agents.policies import ExportedPolicy
from agents.run_folder import RunFolder, RunFolderError, validation_seeds
from dq_space_arm_env import DQSpaceArmEnv, DQSpaceArmVectorEnv, compile_scene, load_scene
from dq_space_arm_env.environment.disturbances import Disturbance
from dq_space_arm_env.environment.rollouts import rollout
from dq_space_arm_env.scene.constraint_rows import path_rows

pytestmark = pytest.mark.agents

COUNT, DECISIONS, HIDDEN, SEEDS = 16, 30, 12, list(range(16))


class Flown:
    """Episodes of a small scene, flown by a random network."""

    def __init__(self, scene, decisions=DECISIONS, outputs=3.0, *, noisy=False):
        environment = DQSpaceArmVectorEnv(COUNT, scene)
        seen = environment.reset(seed=SEEDS)[0]
        self.states, n_u = environment.states, environment.kernels.n_u
        rng = np.random.default_rng(0)
        self.weights = random_weights([seen.shape[1], HIDDEN, HIDDEN, n_u], rng)
        self.weights[-2] *= np.float32(outputs)
        self.mean, deviation = seen.mean(axis=0), seen.std(axis=0)
        self.scale = np.where(deviation > 1e-6, 1.0 / np.maximum(deviation, 1e-6), 0.0)
        layers = Layers(self.weights, decisions, COUNT)
        times = decision_times(scene, decisions, 0.4)
        self.episodes = Episodes(scene, layers, times, np.full(n_u, 0.05), noisy=noisy)
        if (kernels := environment.kernels).n_p:
            along = Starts.of(kernels, self.states, environment.parameters, times)
            self.episodes.parameters[:] = along.at(np.arange(COUNT))

    def in_double_precision(self):
        layers = self.episodes._layers
        for arrays in (self.weights, layers.values, layers._cotangents):
            arrays[:] = [each.astype(np.float64) for each in arrays]

    def meet(self, mismatch):
        rng, times = np.random.default_rng(2), self.episodes._times
        self.episodes.meet(Met.draw(mismatch, self.episodes._kernels.scene, times, COUNT, rng))
        return self.episodes._met

    def costs(self, emphasis=1.0):
        return self.episodes.fly(self.states, self.mean, self.scale, emphasis)

    def gradient(self, emphasis=1.0):
        return self.episodes.gradient(self.states, self.mean, self.scale, emphasis)

    def policy(self):
        return ExportedPolicy(
            weights=tuple(self.weights[::2]),
            biases=tuple(self.weights[1::2]),
            action_scale=np.full(len(self.weights[-1]), 0.05),
            activation="tanh",
            mean=self.mean,
            scale=self.scale,
        )


MISMATCH = FlightMismatch(mass_factors=(1.0,), noise=0.0, push=0.05, pushes=3, delay=1.0)


def with_phases(scene):
    """A scene whose base becomes lighter after a step in which the robot coasts, and the pose counts."""
    coasting = {"actuators": {"base_force": None, "base_torque": None, "joint_torque": None}}
    phases = [
        {"name": "full", "steps": scene.simulation.steps // 2},
        {"name": "coast", "steps": 1, "changes": {**coasting, "cost.pose": 1e4}},
        {"name": "light", "steps": (scene.simulation.steps - 1) // 2, "changes": {"base.mass": 60}},
    ]
    return scene.replace(name="phased", phases=phases)


@pytest.mark.parametrize("case", ["plain", "disturbed", "substeps", "phases"])
def test_gradients_agree_with_differences(small_scene, monkeypatch, case):
    monkeypatch.setattr(episodes, "STEEP", math.inf)  # which shortens slopes
    flown = Flown(with_phases(small_scene) if case == "phases" else small_scene)
    flown.in_double_precision()
    if case == "disturbed":
        flown.meet(MISMATCH)
    if case == "substeps":
        flown.episodes.divide(np.arange(DECISIONS) % 3 + 1)
    gradient, costs = flown.gradient(emphasis=10.0)
    np.testing.assert_array_equal(costs, flown.costs(emphasis=10.0))
    rng = np.random.default_rng(1)
    for weight, slope in zip(flown.weights, gradient, strict=True):
        direction = rng.normal(size=weight.shape)
        direction *= 1e-5 / np.linalg.norm(direction)
        kept, ends = weight.copy(), []
        for sign in (1, -1):
            weight[:] = kept + sign * direction
            ends.append(flown.costs(emphasis=10.0).mean())
        weight[:] = kept
        expected = (ends[0] - ends[1]) / 2.0
        assert expected == pytest.approx(float((slope * direction).sum()), rel=1e-6)


@pytest.fixture(scope="session")
def limited(small_scene):
    """The small scene with limits of its joints and of its momentum."""
    limits = {
        "kind": "joint_limits",
        "name": "joints",
        "lower": -0.9,
        "upper": 0.9,
        "rate": 0.3,
    }  # rad, rad/s
    momentum = {"kind": "momentum", "name": "whole", "linear": 2.0, "margin": 0.1, "tolerance": 0.1}  # N s
    return small_scene.replace(name="limited", constraints=[limits, momentum])


def penalty(t, slope_at_zero):
    """That of Ben-Tal & Zibulevsky with a penalty of 1."""
    inside = -0.25 * np.log(-2.0 * np.minimum(t, -0.5)) - 0.375
    return slope_at_zero * np.where(t < -0.5, inside, t + 0.5 * t * t)


def test_slopes_have_those_of_penalties(limited, monkeypatch):
    monkeypatch.setattr(episodes, "STEEP_PENALTIES", math.inf)
    flown = Flown(limited)
    flown.in_double_precision()
    kernels, rows, penalties = flown.episodes._kernels, path_rows(limited), flown.episodes.penalties
    tolerances, margins = (np.array([getattr(row, key) for row in rows]) for key in ("tolerance", "margin"))
    penalties.prices[:] = np.random.default_rng(2).uniform(0.5, 2.0, len(rows))
    penalties.cost = 100.0
    at_tolerance = penalties.prices * penalties.cost / limited.simulation.steps

    def costs():
        """Costs, and penalties from the residuals."""
        scene_costs = flown.costs(emphasis=10.0)
        states, inputs = flown.episodes._states, flown.episodes._inputs
        found = [kernels.constraints(x, u) for x, u in zip(states, inputs, strict=True)]
        each = penalty(5.0 * (np.array(found) + margins) / tolerances, at_tolerance / 5.0)
        return scene_costs + flown.episodes._weights @ each.sum(axis=-1), np.array(found)

    gradient, plain = flown.gradient(emphasis=10.0)
    np.testing.assert_array_equal(plain, flown.costs(emphasis=10.0))  # without penalties
    violated = (costs()[1] > 0.0).any(axis=(0, 1))
    assert violated.any()
    assert not violated.all()
    rng = np.random.default_rng(1)
    for weight, slope in zip(flown.weights, gradient, strict=True):
        direction = rng.normal(size=weight.shape)
        direction *= 1e-6 / np.linalg.norm(direction)
        kept, ends = weight.copy(), []
        for sign in (1, -1):
            weight[:] = kept + sign * direction
            ends.append(costs()[0].mean())
        weight[:] = kept
        assert (ends[0] - ends[1]) / 2.0 == pytest.approx(float((slope * direction).sum()), rel=1e-5)


def test_prices_rise_where_an_episode_violates(limited):
    flown = Flown(limited)
    flown.costs()
    penalties, states, inputs = flown.episodes.penalties, flown.episodes._states, flown.episodes._inputs
    tolerances = np.array([row.tolerance for row in path_rows(limited)])
    at_ends = zip(states[1:], inputs[:-1], strict=True)
    found = np.array([compile_scene(limited).constraints(*each) for each in at_ends])
    shares = (found > 0.5 * tolerances).any(axis=0).mean(axis=0)
    assert len(set(shares)) > 3
    flown.episodes.price_violations(1500.0)
    factors = np.exp(0.5 * (np.minimum(shares, 0.1) - 0.005))
    np.testing.assert_allclose(penalties.prices, 0.01 * np.maximum(factors, 1.0))  # 0.01 is the least
    penalties.prices[:] = 1.0
    flown.episodes.price_violations(1500.0)
    np.testing.assert_allclose(penalties.prices, factors)
    assert penalties.cost == 1500.0


def test_an_episode_that_diverges_does_not_count(small_scene):
    calm, wild = Flown(small_scene), Flown(small_scene)
    calm.states[-1] = calm.states[0]
    wild.states[-1] = wild.states[0]
    velocities = wild.episodes._kernels.layout.state.joint_rates
    wild.states[-1, velocities] = 1e6
    expected = [each.astype(np.float64) * COUNT for each in calm.gradient()[0]]
    calm.states[:-1] = calm.states[0]  # what the last one adds
    alone = [each.astype(np.float64) for each in calm.gradient()[0]]
    found = [each.astype(np.float64) * (COUNT - 1) for each in wild.gradient()[0]]
    for whole, one, rest in zip(expected, alone, found, strict=True):
        np.testing.assert_allclose(rest, whole - one, rtol=1e-3, atol=1e-4 * np.abs(whole).max())


@pytest.mark.parametrize("phased", [False, True])
def test_decisions_fly_as_at_every_time_step(phased):
    """Costs differ by the square of the time between decisions."""
    scene = with_phases(load_scene("planar")) if phased else load_scene("planar")
    flights = rollout(Flown(scene).policy(), scene, SEEDS)
    errors = [np.abs(Flown(scene, n).costs() / flights.cost - 1.0).mean() for n in (20, 40)]
    assert errors[1] < 1e-3
    assert errors[1] < 0.35 * errors[0]


@pytest.mark.parametrize("without", ["push", "delay"])
def test_disturbed_decisions_fly_as_at_every_time_step(without):
    """Delayed and pushed episodes cost what flights do that meet the same."""
    scene, row = load_scene("planar"), COUNT - 4
    flown, step = Flown(scene, 200), scene.simulation.dt
    met = flown.meet(MISMATCH.model_copy(update={without: 0.0}))
    delay, pushes = 0, None
    if without == "push":
        assert not met.delays[: COUNT // 2].any()
        delay = round(met.delays[row] / step)
        assert delay > 10
    else:
        assert not met.jumps[:, : COUNT // 2].any()
        assert met.jumps[:, row].any()
        pushes = Pushed(met.jumps[:, row], flown.episodes._times, step)
    flight = rollout(flown.policy(), scene, [SEEDS[row]], delay=delay, disturbances=pushes)
    calm = rollout(flown.policy(), scene, [SEEDS[row]])
    assert flown.costs()[row] == pytest.approx(flight.cost[0], rel=2e-3)
    assert calm.cost[0] != pytest.approx(flight.cost[0], rel=5e-3)


class Pushed:
    """The jumps of an episode's decisions at the time steps in which these begin."""

    def __init__(self, jumps, times, step):
        self.steps, self.jumps, self.step = np.rint(times[:-1] / step), jumps, -1

    def draw(self):
        self.step += 1
        return Disturbance(push=self.jumps[self.steps == self.step].sum(axis=0)[None])


def test_noise_is_that_of_means_over_decisions(small_scene):
    mismatch = MISMATCH.model_copy(update={"push": 0.0, "delay": 0.0, "noise": 0.01})
    flown, exact = Flown(small_scene, noisy=True), Flown(small_scene)
    np.testing.assert_array_equal(flown.costs(), exact.costs())
    noise = flown.meet(mismatch).noise
    assert not noise[:, : COUNT // 2].any()
    steps = np.diff(flown.episodes._times)[:, None, None] / small_scene.simulation.dt
    deviations = (noise * np.sqrt(steps))[:, COUNT // 2 :].std(axis=(0, 2))
    assert 0.0 < deviations.min() < deviations.max() < 0.0105
    costs = flown.costs()
    np.testing.assert_array_equal(costs[: COUNT // 2], exact.costs()[: COUNT // 2])
    assert (costs[COUNT // 2 :] != exact.costs()[COUNT // 2 :]).all()


def test_masses_are_those_of_starts(small_file, small_scene):
    factors = (0.5, 2.0)
    given = settings(small_file).model_copy(
        update={"mismatch": MISMATCH.model_copy(update={"mass_factors": factors})}
    )
    learner = gradient_training._Learner(given, small_scene)
    assert learner._mean.shape == DQSpaceArmVectorEnv(1, small_scene).single_observation_space.shape
    entry = learner._episodes._kernels.parameters.names.index("links.2.mass")
    learner._update()
    masses = learner._episodes.parameters[0, :, entry] / small_scene.links[2].mass
    assert set(masses.tolist()) == set(factors)
    learner._adapt()


def test_substeps_are_those_of_the_integrator(small_scene):
    flown, step = Flown(small_scene), compile_scene(small_scene).step
    flown.episodes.divide(np.full(DECISIONS, 3))
    flown.costs()
    states, lengths = flown.states, np.diff(decision_times(small_scene, DECISIONS, 0.4))
    for held, length in zip(flown.episodes._inputs, lengths, strict=False):
        for _ in range(3):
            states = step(states, held, length / 3.0)
    np.testing.assert_allclose(flown.episodes._states[-1], states, rtol=1e-12, atol=1e-12)


def test_errors_are_those_of_the_cost(small_scene, monkeypatch):
    """To first order, the cost changes by them with half as long steps."""
    monkeypatch.setattr(episodes, "STEEP", math.inf)
    flown = Flown(small_scene, outputs=30.0)
    flown.in_double_precision()
    before = flown.gradient()[1]
    errors = flown.episodes.errors()
    worst = int(errors.argmax())
    flown.episodes.divide(1 + (np.arange(DECISIONS) == worst))
    changes = np.abs(flown.costs() - before)
    assert errors[worst] > 1e-9 * before.mean()
    assert changes.mean() == pytest.approx(errors[worst], rel=0.05)


def test_decisions_are_divided_where_the_integration_errs(small_file, small_scene, monkeypatch):
    learner = gradient_training._Learner(settings(small_file), small_scene)
    learner._update()
    np.testing.assert_array_equal(learner._episodes.substeps, 1)  # calm at first
    monkeypatch.setattr(gradient_training, "TOLERATED", 1e-9)
    lengths, starts = np.diff(learner._times), learner._starts.states[:16]
    most = np.ceil(lengths / small_scene.simulation.dt - 1e-9)
    while learner._divide(learner._fly(starts)[1]):
        assert (learner._episodes.substeps <= most).all()
        assert math.isinf(learner._typical)
    substeps, errors = learner._episodes.substeps, learner._episodes.errors()
    assert substeps.min() < substeps.max()
    errs = errors > 1e-9 * learner._fly(starts)[1] / len(errors)
    np.testing.assert_array_equal(substeps[errs], most[errs])


def test_misses_are_those_of_the_end(small_scene):
    flown, environment, success = Flown(small_scene), DQSpaceArmEnv(small_scene), small_scene.success
    flown.costs()
    expected = []
    for state in flown.episodes._states[-1]:
        info = environment.reset(options={"initial_state": state})[1]
        angle = info["attitude_error"] / success.attitude_error_deg
        expected.append(max(angle, info["position_error"] / success.position_error))
    np.testing.assert_allclose(flown.episodes.misses(), expected, rtol=1e-9)


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
    trained = train_by_gradients(settings(small_file), tmp_path / "whole")
    curve = [line["median_cost"] for line in trained_curve(tmp_path / "whole")]
    idle = np.median(rollout(lambda seen: np.zeros((len(seen), 6)), small_scene, validation_seeds(8)).cost)
    assert curve[-1] < 0.2 * idle
    assert trained.policy.metadata["training"]["updates"] == 120

    resumed = resume_after(77, settings(small_file), tmp_path / "halves", monkeypatch)
    for one, other in zip(trained.policy.weights, resumed.policy.weights, strict=True):
        np.testing.assert_array_equal(one, other)
    assert len(trained_curve(tmp_path / "halves")) == 2


def resume_after(updates, configuration, folder, monkeypatch):
    """Train with an interruption."""

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
    return train_by_gradients(configuration, folder)


def test_constraints_are_learned_and_prices_resumed(limited, small_file, tmp_path, monkeypatch):
    limited.to_yaml(tmp_path / "limited.yaml")
    constrained = settings(tmp_path / "limited.yaml")
    trained = train_by_gradients(constrained, tmp_path / "whole")
    resumed = resume_after(77, constrained, tmp_path / "halves", monkeypatch)
    for one, other in zip(trained.policy.weights, resumed.policy.weights, strict=True):
        np.testing.assert_array_equal(one, other)
    prices = []
    for folder in ("whole", "halves"):
        last = max((tmp_path / folder / "checkpoints").glob("*/checkpoint.npz"))
        with np.load(last) as arrays:
            prices.append(arrays["prices"])
    np.testing.assert_array_equal(*prices)
    unaware = train_by_gradients(settings(small_file), tmp_path / "unaware").policy
    policies = trained.policy, unaware
    violated = [rollout(each, limited, SEEDS).constraint_violations.mean() for each in policies]
    assert violated[0] < 0.5 * violated[1], violated  # some starts violate


def test_units_follow_the_inputs_and_leave_the_policy(small_file, small_scene):
    learner = gradient_training._Learner(settings(small_file), small_scene)
    seen = DQSpaceArmVectorEnv(COUNT, small_scene).reset(seed=SEEDS)[0]
    for _ in range(60):
        learner._update()
    before, units = learner.export({})(seen), learner._episodes.units.copy()
    for _ in range(300):
        learner._adapt()
    np.testing.assert_allclose(learner.export({})(seen), before, atol=1e-6)
    sizes = learner._episodes.sizes()
    np.testing.assert_allclose(learner._episodes.units, 4.0 * sizes, rtol=1e-9)
    assert not np.allclose(units, 4.0 * sizes, rtol=0.1)


def test_light_joints_have_small_units(small_file, small_scene):
    strong = small_scene.replace(actuators={"joint_torque": {"limit": 1e3}})
    plain, light = (gradient_training._Learner(settings(small_file), each) for each in (small_scene, strong))
    np.testing.assert_array_equal(plain._episodes.units, 0.1)
    joints = compile_scene(small_scene).layout.control.joint_torque
    moved = light._episodes.units[joints] / 0.1 * motions(strong, 1e-3)[joints]
    np.testing.assert_allclose(moved, gradient_training.FARTHEST)
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
    monkeypatch.setattr(gradient_training, "PART", 1e-9)
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


def test_end_weights_rise_where_episodes_miss(small_file, small_scene):
    learner = gradient_training._Learner(settings(small_file), small_scene)
    learner._update()
    assert learner._end_weight == 400.0  # it is too early
    learner._updates = 100
    learner._adapt()
    assert learner._end_weight == pytest.approx(408.0)
    learner._episodes.misses = lambda: np.zeros(COUNT)
    learner._adapt()
    assert learner._end_weight == pytest.approx(408.0)


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


def trained_curve(folder):
    return RunFolder(folder, load_configuration(folder / "config.yaml")).evaluations()


def test_a_damaged_checkpoint_is_refused(small_file, tmp_path):
    train_by_gradients(settings(small_file, updates=20), tmp_path)
    (checkpoint,) = (tmp_path / "checkpoints").glob("*/checkpoint.npz")
    checkpoint.write_bytes(checkpoint.read_bytes()[:1000])
    with pytest.raises(RunFolderError, match=r"cannot be read .* remove it"):
        train_by_gradients(settings(small_file, updates=20), tmp_path)


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"crowding": 1.5}, "algorithm.*crowding = 1.5: must be at most 1"),
        ({"decisions": 1}, "algorithm.*decisions = 1: must be at least 2"),
        ({"copies": 10_000_000}, "algorithm.copies = 10000000: all copies take 400,000,000 decisions"),
    ],
)
def test_mistakes_are_named(small_file, changes, message):
    with pytest.raises(ConfigurationError, match=message):
        settings(small_file, **changes)
