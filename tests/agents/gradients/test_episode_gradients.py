"""Exact slopes of whole episodes, and what these cost when they are flown at every time step."""

import math

import numpy as np
import pytest

pytest.importorskip("threadpoolctl")

from agents.configuration.gradients import FlightMismatch
from agents.gradients import episodes, penalties
from agents.gradients.disturbed_flights import Met
from agents.gradients.episodes import Episodes, decision_times
from agents.gradients.layers import Layers, random_weights
from agents.gradients.penalties import priced_rows
from agents.gradients.starts import Starts
from agents.policies import ExportedPolicy
from dq_space_arm_env import DQSpaceArmEnv, DQSpaceArmVectorEnv, compile_scene, load_scene
from dq_space_arm_env.environment.disturbances import Disturbance
from dq_space_arm_env.environment.rollouts import rollout
from dq_space_arm_env.scene.constraint_rows import path_rows, terminal_rows
from dq_space_arm_env.scene.start import unit_quaternions

pytestmark = pytest.mark.agents

COUNT, DECISIONS, HIDDEN, SEEDS = 16, 30, 12, list(range(16))
EIGHT = load_scene("planar").replace(simulation={"steps": 8})


class Flown:
    """Episodes of a small scene, flown by a random network."""

    def __init__(
        self,
        scene,
        decisions=DECISIONS,
        outputs=3.0,
        *,
        hidden=(HIDDEN, HIDDEN),
        noisy=False,
        dtype=np.float32,
    ):
        environment = DQSpaceArmVectorEnv(COUNT, scene)
        seen = environment.reset(seed=SEEDS)[0]
        self.states, n_u = environment.states, environment.kernels.n_u
        rng = np.random.default_rng(0)
        weights = random_weights([seen.shape[1], *hidden, n_u], rng)
        self.weights = [each.astype(dtype) for each in weights]
        self.weights[-2] *= np.float32(outputs)
        self.mean, deviation = seen.mean(axis=0), seen.std(axis=0)
        self.scale = np.where(deviation > 1e-6, 1.0 / np.maximum(deviation, 1e-6), 0.0)
        layers = Layers(self.weights, decisions, COUNT)
        times = decision_times(scene, decisions, 0.4)
        self.episodes = Episodes(scene, layers, times, np.full(n_u, 0.05), noisy=noisy)
        if (kernels := environment.kernels).n_p:
            along = Starts.of(kernels, self.states, environment.parameters, times)
            self.episodes.parameters[:] = along.at(np.arange(COUNT))

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


def with_phases(scene, coast=1):
    """A scene whose base becomes lighter, and its thrust dearer, after coasting, when the pose counts."""
    coasting = {"actuators": {"base_force": None, "base_torque": None, "joint_torque": None}}
    dearer = {f"cost.{name}": 10.0 * getattr(scene.cost, name)[0] for name in ("base_force", "base_torque")}
    phases = [
        {"name": "full", "steps": scene.simulation.steps // 2},
        {"name": "coast", "steps": coast, "changes": {**coasting, "cost.pose": 1e4}},
        {
            "name": "light",
            "steps": -(-scene.simulation.steps // 2) - coast,
            "changes": {"base.mass": 60, **dearer},
        },
    ]
    return scene.replace(name="phased", phases=phases)


@pytest.mark.parametrize("case", ["plain", "disturbed", "substeps", "phases", "disturbed phases"])
def test_gradients_agree_with_differences(small_scene, monkeypatch, case):
    monkeypatch.setattr(episodes, "STEEP", math.inf)  # which shortens slopes
    monkeypatch.setattr(episodes, "ROUGH", 0.0)
    flown = Flown(with_phases(small_scene) if "phases" in case else small_scene, dtype=np.float64)
    if "disturbed" in case:
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


@pytest.mark.parametrize(
    "hidden", [(33, 7), *(pytest.param(each, marks=pytest.mark.slow) for each in ((), (5,), (33, 7, 16)))]
)  # loops are compiled for each depth
def test_outputs_are_those_of_the_exported_policy(small_scene, hidden):
    """Of layers that fill no whole vectors of numbers, for episodes that fill no whole tiles."""
    flown = Flown(small_scene, outputs=30.0, hidden=hidden)
    flown.costs()
    observations, outputs = flown.episodes._flown.observations, flown.episodes._layers.outputs
    seen = observations.reshape(-1, observations.shape[-1])
    expected = flown.policy()(seen) / 0.05
    inside = np.abs(expected) < 1.0  # beyond, it clips them
    assert inside.mean() > 0.4
    found = outputs.reshape(expected.shape)
    np.testing.assert_allclose(found[inside], expected[inside], rtol=0, atol=2e-6)


@pytest.mark.parametrize("phases", [False, True])
def test_slopes_have_those_of_roughness(small_scene, phases):
    flown = Flown(with_phases(small_scene) if phases else small_scene, dtype=np.float64)
    found = {}
    for rough in (0.0, 1e3):  # large beside the cost
        flown.episodes.roughness = rough
        found[rough], costs = flown.gradient()
    firsts = flown.episodes._firsts
    assert len(firsts) == (3 if phases else 1)

    def roughness():
        flown.costs()
        outputs = 0.05 * flown.episodes._layers.outputs
        parts = np.split(outputs, firsts[1:])
        squares = sum((np.diff(part, n=2, axis=0) ** 2).sum() for part in parts)
        return 1e3 * np.median(costs) * squares / (DECISIONS * COUNT)

    rng = np.random.default_rng(1)
    for weight, *slopes in zip(flown.weights, found[0.0], found[1e3], strict=True):
        direction = rng.normal(size=weight.shape)
        direction *= 1e-5 / np.linalg.norm(direction)
        kept, ends = weight.copy(), []
        for sign in (1, -1):
            weight[:] = kept + sign * direction
            ends.append(roughness())
        weight[:] = kept
        expected = float(((slopes[1] - slopes[0]) * direction).sum())
        assert (ends[0] - ends[1]) / 2.0 == pytest.approx(expected, rel=1e-6)


@pytest.mark.parametrize("phases", [False, True])
def test_roughness_has_a_price_while_inputs_alternate(small_scene, phases):
    flown = Flown(with_phases(small_scene) if phases else small_scene).episodes
    limits, decisions = flown._kernels.layout.control_limit, np.arange(DECISIONS)
    ramp = 0.5 * np.sin(decisions / 5.0)[:, None, None] * limits
    zigzag = 0.02 * (-1.0) ** decisions[:, None, None] * limits * (np.arange(len(limits)) == 1)
    flown._inputs[:-1] = ramp
    flown.price_roughness()
    assert flown.roughness == episodes.ROUGH  # the least
    flown._inputs[:-1] = zigzag
    for factor in (1.1, 1.21):
        flown.price_roughness()
        assert flown.roughness == pytest.approx(episodes.ROUGH * factor)
        flown._inputs[DECISIONS // 2 :, 0] = np.nan  # of an episode that diverges
    flown._inputs[:-1] = ramp + 0.2 * zigzag
    flown.price_roughness()
    assert flown.roughness == pytest.approx(episodes.ROUGH * 1.21 * 0.99)
    flown.roughness = episodes.ROUGHEST
    flown._inputs[:-1] = zigzag
    flown.price_roughness()
    assert flown.roughness == episodes.ROUGHEST


def penalty(t, slope_at_zero):
    """That of Ben-Tal & Zibulevsky with a penalty of 1."""
    inside = -0.25 * np.log(-2.0 * np.minimum(t, -0.5)) - 0.375
    return slope_at_zero * np.where(t < -0.5, inside, t + 0.5 * t * t)


def test_slopes_have_those_of_penalties(limited, monkeypatch):
    monkeypatch.setattr(episodes, "STEEP_PENALTIES", math.inf)
    monkeypatch.setattr(episodes, "ROUGH", 0.0)
    flown = Flown(limited, dtype=np.float64)
    kernels, path, penalties = flown.episodes._kernels, path_rows(limited), flown.episodes.penalties
    success = [row for row in terminal_rows(limited) if row.name.startswith("success")]
    assert terminal_rows(limited)[-len(success) :] == tuple(success)
    (tolerances, margins), (last_tolerances, last_margins) = (
        [np.array([getattr(row, key) for row in rows]) for key in ("tolerance", "margin")]
        for rows in (path, success)
    )
    penalties.prices[:] = np.random.default_rng(2).uniform(0.5, 2.0, len(path) + len(success))
    penalties.cost, penalties.hardening = 100.0, 0.5
    along, at_end = np.split(penalties.prices * penalties.cost, [len(path)])
    along /= limited.simulation.steps

    def costs():
        """Costs, penalties from the residuals, and these."""
        scene_costs = flown.costs(emphasis=10.0)
        states, inputs = flown.episodes._states, flown.episodes._inputs
        found = [kernels.constraints(x, u) for x, u in zip(states, inputs, strict=True)]
        each = penalty(5.0 * (np.array(found) + margins) / tolerances, along / 5.0)
        ends = kernels.terminal_constraints(states[-1])[:, -len(success) :]
        steep = 5.0 * math.sqrt(10.0)
        last = penalty(steep * (ends + last_margins) / last_tolerances, at_end / steep)
        total = scene_costs + flown.episodes._weights @ each.sum(axis=-1) + last.sum(axis=-1)
        return total, np.array(found), ends

    gradient, plain = flown.gradient(emphasis=10.0)
    np.testing.assert_array_equal(plain, flown.costs(emphasis=10.0))  # without penalties
    violated = (costs()[1] > 0.0).any(axis=(0, 1))
    assert violated.any()
    assert not violated.all()
    assert (costs()[2] > 0.0).any()
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


def test_slopes_are_shortened_less_where_success_is_as_dear_as_may_be(small_scene, monkeypatch):
    monkeypatch.setattr(episodes, "STEEP_PENALTIES", math.inf)
    flown, norms = Flown(small_scene), []
    for dearest, steep in ((6.1, 0.5), (6.1, math.inf), (6.0, 0.5)):
        monkeypatch.setattr(penalties, "AT_END", penalties.AT_END._replace(dearest=dearest))
        monkeypatch.setattr(episodes, "STEEP", steep)
        flown.episodes.penalties.prices[:] = 6.0
        norms.append([np.linalg.norm(each) for each in flown.gradient()[0]])
    assert np.greater(norms[1], 1.1 * np.array(norms[0])).all()
    np.testing.assert_array_equal(norms[2], norms[1])


def test_torques_to_which_environments_clip_have_no_price():
    assert not priced_rows(load_scene("motors")).any()
    assert priced_rows(load_scene("servicing")).tolist() == [True] * 4


def test_prices_rise_where_an_episode_violates(limited):
    flown = Flown(limited)
    flown.costs()
    penalties, states, inputs = flown.episodes.penalties, flown.episodes._states, flown.episodes._inputs
    tolerances = np.array([row.tolerance for row in path_rows(limited)])
    at_ends = zip(states[1:], inputs[:-1], strict=True)
    found = np.array([compile_scene(limited).constraints(*each) for each in at_ends])
    violating, near = ((found > each * tolerances).any(axis=0).mean(axis=0) for each in (0.5, -5.0))
    assert len(set(violating)) > 3
    far = near == 0.0
    assert far.any()

    def factors(with_prices, most=0.1):
        """One rises by up to 5 %, falls slowly where episodes come near, and else as fast as it rises."""
        allowed = 0.01 / max(1, with_prices)
        rises = np.minimum(violating, most) - allowed
        falls_fast = most - np.minimum(near, most)
        return np.exp(0.05 / most * (rises - falls_fast * (most - allowed) / most))

    n = len(tolerances)
    flown.episodes.price_violations(1500.0, judged=0)
    np.testing.assert_allclose(penalties.prices[:n], 0.01 * np.maximum(factors(0), 1.0))  # 0.01 is the least
    assert not penalties.prices[n:].any()
    penalties.prices[:n] = 1.0
    flown.episodes.price_violations(1500.0, judged=0)
    np.testing.assert_allclose(penalties.prices[:n], factors(len(violating)))
    np.testing.assert_allclose(penalties.prices[:n][far], math.exp(-0.05))
    assert penalties.cost == 1500.0
    penalties.prices[:n], penalties.hardening = 1.0, 1.0  # towards the end by few violations, too
    flown.episodes.price_violations(1500.0, judged=0)
    np.testing.assert_allclose(penalties.prices[:n], factors(len(violating), most=0.02))


def test_prices_of_success_follow_where_judged_episodes_end(small_scene):
    flown = Flown(small_scene)
    flown.costs()
    episodes_, penalties = flown.episodes, flown.episodes.penalties
    tolerances = np.radians(small_scene.success.attitude_error_deg), small_scene.success.position_error
    np.testing.assert_array_equal(penalties.prices, 0.0)
    judged = COUNT // 2
    episodes_.price_violations(1500.0, judged=judged)
    np.testing.assert_array_equal(penalties.prices, 0.01)
    errors = episodes_._kernels.observation(episodes_._states[-1, :judged], np.zeros((judged, 1)))[1]
    shares = (errors > 0.93 * np.array(tolerances)).mean(axis=0)
    assert (shares > 0.1).all()
    penalties.prices[:] = 1.0, 5.99
    assert not penalties.are_strict
    episodes_.price_violations(1500.0, judged=judged)
    np.testing.assert_allclose(penalties.prices, [math.exp(0.038), 6.0])
    assert penalties.are_strict
    loose = Flown(small_scene.replace({"success.position_error": 100.0}))
    loose.costs()
    loose.episodes.penalties.prices[:] = 1.0
    loose.episodes.price_violations(1500.0, judged=judged)
    np.testing.assert_allclose(loose.episodes.penalties.prices, [math.exp(0.038), math.exp(-0.002)])


@pytest.mark.parametrize("lost", [1, COUNT // 2 + 1])
def test_episodes_that_diverge_do_not_count(small_scene, lost):
    calm, wild = Flown(small_scene), Flown(small_scene)
    calm.states[-lost:] = wild.states[-lost:] = calm.states[0]
    velocities = wild.episodes._kernels.layout.state.joint_rates
    wild.states[-lost:, velocities] = 1e6
    expected = [each.astype(np.float64) * COUNT for each in calm.gradient()[0]]
    calm.states[:-1] = calm.states[0]  # what a lost one adds
    alone = [each.astype(np.float64) * lost for each in calm.gradient()[0]]
    found = [each.astype(np.float64) * (COUNT - lost) for each in wild.gradient()[0]]
    for whole, added, rest in zip(expected, alone, found, strict=True):
        np.testing.assert_allclose(rest, whole - added, rtol=1e-3, atol=1e-4 * np.abs(whole).max())


def test_diverged_episodes_leave_prices_to_the_others(limited):
    flown = Flown(limited)
    flown.costs()
    penalties, p = flown.episodes.penalties, flown.episodes.parameters
    ends = np.repeat(flown.states[:1], COUNT, axis=0)
    penalties.prices[:] = 1.0
    penalties.follow_ends(np.full_like(ends, np.nan), p)
    assert (penalties.prices == 1.0).all()
    penalties.follow_ends(ends, p)
    expected = penalties.prices.copy()
    penalties.prices[:] = 1.0
    ends[0] = np.nan
    penalties.follow_ends(ends, p)
    np.testing.assert_array_equal(penalties.prices, expected)


def test_noise_is_refused_by_episodes_made_without(small_scene):
    with pytest.raises(ValueError, match=r"noise: .* should be made with noisy=True"):
        Flown(small_scene).meet(MISMATCH.model_copy(update={"noise": 0.02}))


@pytest.mark.parametrize("case", ["plain", "phases", "dear phases"])
def test_decisions_fly_as_at_every_time_step(case):
    """Costs differ by the square of the time between decisions."""
    scene = load_scene("planar")
    if "dear" in case:
        scene = scene.replace(cost={"base_force": 1e4, "base_torque": 1e4})
    scene = with_phases(scene) if "phases" in case else scene
    flights = rollout(Flown(scene).policy(), scene, SEEDS)
    errors = [np.abs(Flown(scene, n).costs() / flights.cost - 1.0).mean() for n in (20, 40, 80)]
    assert errors[0] < 5e-3
    assert errors[1] < 0.35 * errors[0]
    assert errors[2] < 0.35 * errors[1]  # not so if actions were not half a time step old


def test_actuators_delay_by_whole_time_steps(small_scene):
    """Each of which is a decision, however many are asked for."""
    delay = {f"actuators.{name}.delay": steps for name, steps in (("joint_torque", 5), ("base_force", 3))}
    delayed = small_scene.replace({"name": "delayed", **delay})
    steps = delayed.simulation.steps
    even = decision_times(small_scene, steps, 0.0)
    np.testing.assert_allclose(decision_times(delayed, 20, 0.4), even, rtol=0, atol=1e-12)
    flown = Flown(delayed, steps)
    flights = rollout(flown.policy(), delayed, SEEDS)
    np.testing.assert_allclose(flown.costs(), flights.cost, rtol=1e-5)


@pytest.mark.slow
@pytest.mark.parametrize("coast", [2, 10])
def test_phases_shorter_than_a_share_of_decisions_count_in_full(coast):
    scene = with_phases(load_scene("planar"), coast)
    flights = rollout(Flown(scene).policy(), scene, SEEDS)
    np.testing.assert_allclose(Flown(scene, 40).costs(), flights.cost, rtol=5e-3)


@pytest.mark.parametrize("coast", [1, 2, 10])
def test_the_last_decision_of_a_phase_is_a_time_step(coast):
    """Where there are more steps in the phase, another one is before it."""
    scene = with_phases(load_scene("planar"), coast)
    dt, half = scene.simulation.dt, scene.simulation.steps // 2
    times = np.rint(decision_times(scene, 40, 0.4) / dt)
    inside = times[(times >= half) & (times <= half + coast)] - half
    np.testing.assert_array_equal(inside, sorted({0, coast - 1, coast}))


def test_no_decision_takes_no_time():
    """Where there are more of them than time steps, the last of a phase is still one of these."""
    times = decision_times(with_phases(EIGHT), 40, 0.4)
    assert np.diff(times).min() > 0.0
    np.testing.assert_allclose(times[-1], EIGHT.simulation.steps * EIGHT.simulation.dt, rtol=1e-12)


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

    episodes = 1

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


@pytest.mark.slow
def test_noise_leaves_quaternions_of_spherical_joints_rotations():
    scene = load_scene("heavy-wrist")
    (where,) = unit_quaternions(scene)
    flown = Flown(scene, 200, outputs=0.0, noisy=True)
    flown.meet(MISMATCH.model_copy(update={"push": 0.0, "noise": 0.02}))
    flown.costs()
    measured, states = (each[:-1, :, where] for each in (flown.episodes._measured, flown.episodes._states))
    assert np.abs(measured - states).max() > 0.01
    np.testing.assert_allclose(np.linalg.norm(measured, axis=-1), 1.0, rtol=0, atol=1e-9)


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
    flown = Flown(small_scene, outputs=30.0, dtype=np.float64)
    before = flown.gradient()[1]
    errors = flown.episodes.errors()
    worst = int(errors.argmax())
    flown.episodes.divide(1 + (np.arange(DECISIONS) == worst))
    changes = np.abs(flown.costs() - before)
    assert errors[worst] > 1e-9 * before.mean()
    assert changes.mean() == pytest.approx(errors[worst], rel=0.05)


def test_misses_are_those_of_the_end(small_scene):
    flown, environment, success = Flown(small_scene), DQSpaceArmEnv(small_scene), small_scene.success
    flown.costs()
    expected = []
    for state in flown.episodes._states[-1]:
        info = environment.reset(options={"initial_state": state})[1]
        angle = info["attitude_error"] / success.attitude_error_deg
        expected.append(max(angle, info["position_error"] / success.position_error))
    np.testing.assert_allclose(flown.episodes.misses(), expected, rtol=1e-9)
