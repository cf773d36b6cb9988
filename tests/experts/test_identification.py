"""The receding horizon in worlds that differ from its scene: what it finds out, and what it leaves alone."""

import numpy as np
import pytest

from dq_space_arm_env import load_scene
from experts import GuidedDDP, RecedingHorizonExpert
from experts.identification import Identification, MismatchDetector, doubtful_numbers
from experts.problems.arm_problem import ArmProblem

SPRINGS = {f"links.{index}.stiffness": 2.0 for index in range(3)}
DAMPERS = {"links.0.damping": 0.2, "links.1.damping": 0.4}
LOADS = {"links.2.mass": 2.0, "links.2.inertia.zz": 2.0}  # factors


@pytest.fixture(scope="module")
def experts(varying_scene):
    """One that estimates, one that does not."""
    return {each: RecedingHorizonExpert(varying_scene, horizon=30, identify=each) for each in (True, False)}


def world(kernels, changes, factors):
    """Parameters of a world that differs from the nominal one."""
    names, p = kernels.parameters.names, kernels.parameters.nominal.copy()
    for name, value in changes.items():
        p[names.index(name)] = value
    for name, factor in factors.items():
        p[names.index(name)] *= factor
    return p


def fly(expert, p, measure=lambda x, k: x):
    """Cost and miss of an episode in a world with parameters p, and its actions."""
    kernels, maneuver = expert.maneuver.kernels, expert.maneuver
    x, cost, actions = kernels.layout.initial_state, 0.0, []
    expert.reset(x)
    for k in range(maneuver.horizon):
        actions.append(expert(measure(x, k)))
        u = actions[-1] * kernels.layout.control_limit
        cost += kernels.cost(x, u, p=p)
        x = kernels.step(x, u, p=p)
    return cost + kernels.terminal_cost(x, p=p), maneuver.misses(x), np.array(actions)


@pytest.mark.slow
def test_with_unknown_springs_only_who_estimates_them_reaches_the_target(experts):
    expert = experts[True]
    p = world(expert.maneuver.kernels, SPRINGS, {})
    _, unaware, _ = fly(experts[False], p)
    cost, missed, _ = fly(expert, p)
    informed = GuidedDDP(expert.maneuver.scene).solve(parameters=p)
    assert expert.maneuver.misses(informed.states[-1]) <= 1.0
    assert unaware > 1.5
    assert missed <= 0.5
    assert cost < 1.2 * informed.cost  # a second is spent until it knows
    assert 1 <= expert.replans <= 4
    assert experts[False].replans == expert.fallbacks == 0


@pytest.mark.sampled
@pytest.mark.parametrize(
    ("changes", "factors"), [(SPRINGS, {}), (DAMPERS, {}), ({}, LOADS)], ids=["springs", "dampers", "load"]
)
def test_the_numbers_are_found(changes, factors, experts):
    expert = experts[True]
    p = world(expert.maneuver.kernels, changes, factors)
    fly(expert, p)
    truth = dict(zip(expert.maneuver.kernels.parameters.names, p, strict=True))
    assert expert.estimates.keys() == {number.name for number in doubtful_numbers(expert.maneuver)}
    for name, value in expert.estimates.items():
        assert value == pytest.approx(truth[name], rel=5e-3, abs=0.02), name
    expert.reset()
    assert expert.estimates == {}


@pytest.mark.slow
def test_a_spring_is_found_where_all_commands_act_later():
    boom = {"name": "boom", "mass": 5.0, "inertia": [0.4, 0.4, 0.4], "center_of_mass": [0.5, 0.0, 0.0]}
    scene = load_scene(
        {
            "name": "late commands",
            "base": {"motion": "planar", "mass": 100.0, "inertia": [10.0, 10.0, 9.0]},
            "links": [{**boom, "joint": {"position": [0.5, 0.0, 0.0]}}],
            "tip": {"position": [1.0, 0.0, 0.0]},
            "actuators": {"joint_torque": {"limit": 2.0, "delay": 1}},
            "target": {"pose": {"position": [0.8, 0.6, 0.0]}},
            "simulation": {"steps": 60, "dt": 0.1},
            "parameters": ["links.0.stiffness"],
        }
    )
    expert = RecedingHorizonExpert(scene, horizon=15)
    fly(expert, np.array([3.0]))
    assert expert.estimates["links.0.stiffness"] == pytest.approx(3.0, rel=5e-3)


def test_what_is_told_in_mid_flight_is_not_estimated_on_top(experts):
    expert, told = experts[True], 40
    kernels = expert.maneuver.kernels
    p = world(kernels, {}, LOADS)
    x = kernels.layout.initial_state
    expert.reset(x)
    for k in range(60):
        if k == told:
            assert expert.estimates["links.2.mass"] > 1.5 * expert.maneuver.scene.links[2].mass
            expert.inform(p)
        x = kernels.step(x, expert(x) * kernels.layout.control_limit, p=p)
        if k >= told:
            assert expert.estimates["links.2.mass"] == pytest.approx(
                p[kernels.parameters.names.index("links.2.mass")], rel=1e-2
            )


def test_a_mass_stays_a_share_of_the_told_one(varying_scene):
    """Also where that is less than the scene's: a share of the scene's would allow negative ones."""
    maneuver, rng = ArmProblem(varying_scene), np.random.default_rng(0)
    kernels, name = maneuver.kernels, "links.2.mass"
    told, p = (world(kernels, {}, {name: factor}) for factor in (0.5, 1e-3))
    maneuver.parameters.set(told)
    found = Identification(maneuver)
    found.begin(np.full(6, 1e-8))
    x = kernels.layout.initial_state
    for k in range(60):
        u = kernels.layout.control_limit * rng.uniform(-1.0, 1.0, kernels.n_u)
        landed = kernels.step(x, u, p=p)
        found.update(x, u, landed, k)
        x = landed
    assert found.values[name] == pytest.approx(0.1 * told[kernels.parameters.names.index(name)])


def test_where_the_scene_is_right_actions_are_the_same_bits(experts):
    p = experts[True].maneuver.kernels.parameters.nominal
    flights = [fly(expert, p) for expert in experts.values()]
    np.testing.assert_array_equal(flights[0][2], flights[1][2])
    assert experts[True].estimates == {}


def test_measurements_that_drop_out_teach_nothing(experts):
    expert = experts[True]
    p = world(expert.maneuver.kernels, SPRINGS, {})

    def measure(x, k):
        return np.full_like(x, np.nan) if k % 7 == 3 else x

    _, missed, actions = fly(expert, p, measure)
    assert expert.dropouts == 21
    assert expert.fallbacks == 0
    assert np.isfinite(actions).all()
    assert expert.estimates["links.0.stiffness"] == pytest.approx(2.0, abs=0.05)
    assert missed <= 0.6


def test_a_lasting_force_is_told_from_noise_pushes_and_what_is_negligible():
    rng, authority, count = np.random.default_rng(0), np.full(3, 0.01), 1000

    def is_ever_certain(innovations):
        detector = MismatchDetector(3)
        for innovation in innovations:
            detector.observe(innovation, authority)
            if detector.is_certain:
                return True
        return False

    noise = 0.01 * rng.normal(size=(count + 1, 3))
    early = np.vstack([np.zeros((3, 3)), np.ones((1, 3)), np.zeros((30, 3))])
    pushes = np.where(rng.random((count, 1)) < 0.005, 1e200 * rng.normal(size=(count, 3)), 0.0)
    lasting = np.full((count, 3), 0.005)
    assert not is_ever_certain(np.diff(noise, axis=0))
    assert not is_ever_certain(pushes)
    assert not is_ever_certain(early)
    assert not is_ever_certain(1e-4 * lasting)
    assert is_ever_certain(lasting[:30])
    assert is_ever_certain(lasting + 0.5 * np.diff(noise, axis=0))


def test_a_joint_without_a_motor_has_its_spring_as_well():
    scene = load_scene("planar")
    links = [link.model_dump() for link in scene.links]
    links[1]["actuated"] = False
    found = {number.name: number for number in doubtful_numbers(ArmProblem(scene.replace(links=links)))}
    assert found["links.0.stiffness"].deviation == scene.actuators.joint_torque.limit
    assert found["links.1.stiffness"].deviation == 1.0
    assert found["links.2.mass"].least == pytest.approx(-0.9 * scene.links[2].mass)
