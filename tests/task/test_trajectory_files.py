"""A trajectory's file holds what is known of it, and no more."""

import re
from pathlib import Path

import numpy as np
import pytest

from dq_space_arm_env.task.trajectory import Trajectory

STATES, CONTROLS = np.arange(12.0).reshape(4, 3), np.ones((3, 2))


@pytest.mark.parametrize("noise", [None, np.zeros((3, 2))])
def test_what_is_unknown_is_left_out(noise: np.ndarray | None, tmp_path: Path) -> None:
    path = tmp_path / "flight.npz"
    Trajectory("bare", STATES, CONTROLS, noise=noise).save(path)
    with np.load(path) as content:
        assert sorted(content.files) == ["controls", "facts", "states"]
    found = Trajectory.load(path)
    np.testing.assert_array_equal(found.states, STATES)
    np.testing.assert_array_equal(found.controls, CONTROLS)
    assert (found.label, found.noise, found.rewards, found.target, found.scene) == ("bare", *[None] * 4)
    assert np.isnan(found.cost)


def test_what_is_known_comes_back(tmp_path: Path) -> None:
    path, noise, rewards = tmp_path / "flight.npz", 0.1 * CONTROLS, np.array([-1.0, -2.0, -0.5])
    given = Trajectory("full", STATES, CONTROLS, noise=noise, rewards=rewards, target=np.arange(8.0), seed=3)
    given.save(path)
    found = Trajectory.load(path)
    for name in ("states", "controls", "noise", "rewards", "target"):
        np.testing.assert_array_equal(getattr(found, name), getattr(given, name))
    assert (found.cost, found.seed) == (3.5, 3)


def test_a_seed_below_zero_is_refused(tmp_path: Path) -> None:
    """No episode has one: policies that a replay starts there would fail."""
    Trajectory("bare", STATES, CONTROLS, seed=-3).save(tmp_path / "flight.npz")
    with pytest.raises(ValueError, match=r"flight.npz cannot be .* seed is -3, it should be 0 or greater"):
        Trajectory.load(tmp_path / "flight.npz")


@pytest.mark.parametrize("shape", [(8,), (4, 8)])
@pytest.mark.parametrize("name", ["target", "target_body"])
def test_a_target_rests_or_has_a_pose_for_each_state(
    name: str, shape: tuple[int, ...], tmp_path: Path
) -> None:
    path, poses = tmp_path / "flight.npz", np.arange(float(np.prod(shape))).reshape(shape)
    Trajectory("moving", STATES, CONTROLS, **{name: poses}).save(path)
    found = Trajectory.load(path)
    np.testing.assert_array_equal(getattr(found, name), poses)
    assert (found.target is None) is (name == "target_body")
    with np.load(path) as content:
        assert sorted(content.files) == sorted(["controls", "facts", "states", name])


@pytest.mark.parametrize("missing", ["states", "controls"])
def test_a_file_without_states_or_controls_is_no_flight(missing: str, tmp_path: Path) -> None:
    arrays = {"states": STATES, "controls": CONTROLS, "rewards": np.ones(3)}
    del arrays[missing]
    np.savez(tmp_path / "other.npz", **arrays)
    with pytest.raises(ValueError, match=f"lacks {missing}"):
        Trajectory.load(tmp_path / "other.npz")


@pytest.mark.parametrize(
    ("name", "array", "wanted"),
    [
        ("states", STATES[:3], "(4, 3)"),
        ("states", STATES[:, 0], "(4, 1)"),
        ("controls", CONTROLS[:, 0], "(3, 0)"),
        ("noise", np.ones((3, 3)), "(3, 2)"),
        ("rewards", np.ones((3, 1)), "(3,)"),
        ("target", np.ones(7), "(8,) or (4, 8)"),
        ("target", np.ones((3, 8)), "(8,) or (4, 8)"),
        ("target_body", np.ones((4, 7)), "(8,) or (4, 8)"),
        ("payload", np.ones(8), "(4, 8)"),
    ],
)
def test_arrays_that_do_not_fit_are_refused(
    name: str, array: np.ndarray, wanted: str, tmp_path: Path
) -> None:
    np.savez(tmp_path / "other.npz", **{"states": STATES, "controls": CONTROLS, name: array})
    with pytest.raises(ValueError, match=f"{name} has shape .*, it should have {re.escape(wanted)}"):
        Trajectory.load(tmp_path / "other.npz")
