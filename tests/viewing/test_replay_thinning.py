"""Long flights on a page: fewer instants, the same ends, every peak and every violation."""

from dataclasses import replace

import numpy as np
import pytest

from dq_space_arm_env import load_scene
from dq_space_arm_env.viewing.replay import replay_page, thinning
from dq_space_arm_env.viewing.replay.flights import prepare, verdict
from dq_space_arm_env.viewing.replay.thinning import thinned


@pytest.fixture
def long_flight(paper, make_flight):
    """Of 1001 steps, its target moving, with noise, and rows of constraints."""
    scene = paper.replace(constraints=[{"name": "limits", "kind": "joint_limits", "rate": 1.0}])
    target = np.array(scene.target.pose.dual_quaternion) * np.ones((1002, 1))
    target[:, 5] += np.linspace(0.0, 1.0, 1002)
    flight = replace(make_flight(scene, steps=1001), target=target)
    rng = np.random.default_rng(0)
    return scene, replace(flight, noise=rng.normal(size=(1001, 12)))


def thin(monkeypatch, flights, parts):
    """So that of `parts` instants one stays."""
    size = sum(thinning._size(flight) for flight in flights)
    monkeypatch.setattr(thinning, "LARGEST", size / (parts - 0.5))
    return thinned(flights)


def test_short_flights_stay_as_they_are(paper, make_flight):
    flights = prepare([make_flight(paper, steps=1000)] * 6, paper)
    assert all(one is other for one, other in zip(thinned(flights), flights, strict=True))


def test_a_short_flight_keeps_its_steps_beside_a_long_one(paper, make_flight, monkeypatch):
    short, long, longer = prepare([make_flight(paper, steps=steps) for steps in (20, 500, 800)], paper)
    monkeypatch.setattr(thinning, "LARGEST", thinning._size(short) + thinning._size(long))
    flights = thinned([longer, short, long])
    assert flights[1] is short
    assert [flight.stride for flight in flights] == [4, 1, 2]
    assert sum(map(thinning._size, flights)) < thinning.LARGEST


def test_poses_and_errors_are_those_of_the_instants_that_stay(long_flight, monkeypatch):
    scene, flight = long_flight
    whole = prepare([flight], scene)[0]
    [few] = thin(monkeypatch, [whole], 10)
    assert (few.steps, few.stride) == (101, 10)
    assert few.dt * few.steps == pytest.approx(whole.dt * whole.steps, rel=1e-14)
    instants = np.rint(np.arange(102) * few.dt / whole.dt).astype(int)
    assert (instants[0], instants[-1]) == (0, 1001)
    assert np.abs(instants * whole.dt - np.arange(102) * few.dt).max() <= 0.5 * whole.dt + 1e-12
    for name in ("frames", "angle", "distance", "target"):
        np.testing.assert_array_equal(getattr(few, name), getattr(whole, name)[instants])
    assert verdict(few, scene) == verdict(whole, scene) + "; one in 10 steps shown"


@pytest.mark.parametrize("parts", [2, 7, 10, 300])
def test_no_peak_of_the_inputs_is_lost(long_flight, monkeypatch, parts):
    """Of every two steps that stay, one is the smallest value that there was, and one the largest."""
    scene, flight = long_flight
    controls = np.sin(np.linspace(0.0, 40.0, 1001))[:, None] * np.ones(12)
    controls[500, 3] = 8.0
    controls[501, 4] = -8.0
    whole = prepare([replace(flight, controls=controls)], scene)[0]
    [few] = thin(monkeypatch, [whole], parts)
    assert few.controls[:, 3].max() == 8.0
    assert few.controls[:, 4].min() == -8.0
    np.testing.assert_allclose(few.controls.max(axis=0), controls.max(axis=0))
    assert few.noise is not None
    disturbed = few.controls + few.noise
    np.testing.assert_allclose(disturbed.max(axis=0), (controls + whole.noise).max(axis=0))
    np.testing.assert_allclose(disturbed.min(axis=0), (controls + whole.noise).min(axis=0))
    # The peak is where it was.
    assert abs(few.controls[:, 3].argmax() * few.dt - 500 * whole.dt) <= 2.0 * few.dt


def test_a_violation_of_one_step_stays_one(long_flight, monkeypatch):
    scene, flight = long_flight
    whole = prepare([flight], scene)[0]
    violated = np.zeros_like(whole.violated)
    violated[1, 437] = violated[2, -1] = True
    [few] = thin(monkeypatch, [replace(whole, violated=violated)], 10)
    assert few.violated.shape == (len(violated), few.steps + 1)
    rows, instants = np.nonzero(few.violated)
    assert rows.tolist() == [1, 2]
    assert (instants * few.dt / whole.dt).tolist() == pytest.approx([437, 1001], abs=10.0)


@pytest.mark.slow
@pytest.mark.parametrize("name", ["paper", "dual-arm", "keep-out", "thrusters"])
def test_the_page_of_a_hundred_thousand_steps_stays_below_five_megabytes(name, make_flight):
    scene = load_scene(name)
    flight = make_flight(scene, steps=100_000)
    noise = np.random.default_rng(0).normal(size=flight.controls.shape)
    assert len(replay_page([replace(flight, noise=noise)], scene).encode()) < 5e6
