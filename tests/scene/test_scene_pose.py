"""Poses: the ways to write one, what is refused, exact zeros, and agreement with r^Y = 2 q_d q_r*."""

import math
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from pydantic import ValidationError

from dq_space_arm_env.scene import Pose

PAPER_TARGET = (0.5, 0.5, -0.5, -0.5, 0.25, 2.25, 0.25, 2.25)

components = st.floats(-1, 1).filter(lambda number: abs(number) > 1e-3)
quaternions = st.tuples(components, components, components, components).map(
    lambda q: tuple(component / math.hypot(*q) for component in q)
)
positions = st.tuples(*[st.floats(-100, 100)] * 3)


@pytest.mark.parametrize("form", [{"dual_quaternion": PAPER_TARGET}, PAPER_TARGET, list(PAPER_TARGET)])
def test_target_of_the_paper(form: Any) -> None:
    pose = Pose.model_validate(form)
    assert pose.position == (0, -4, 5)
    assert pose.rotation == (0.5, 0.5, -0.5, -0.5)
    assert pose.dual_quaternion == PAPER_TARGET
    assert pose.rotation_matrix == ((0, 0, -1), (-1, 0, 0), (0, 1, 0))


def test_the_sign_of_the_quaternion_is_kept() -> None:
    minus = tuple(-component for component in PAPER_TARGET)
    assert Pose.model_validate(minus).dual_quaternion == minus
    assert Pose.model_validate({"rotation": [-1, 0, 0, 0]}).rotation == (-1, 0, 0, 0)


@pytest.mark.parametrize("axis", [[1, 0, 0], [0, -1, 0], [0, 0, 7], [1, 1, 1], [-1, 1, -1]])
@pytest.mark.parametrize("turns", range(-4, 5))
def test_rotations_of_the_cube_have_exact_entries(axis: list[int], turns: int) -> None:
    angle = turns * (120 if all(axis) else 90)
    matrix = np.array(Pose.model_validate({"rotation": {"axis": axis, "angle": angle}}).rotation_matrix)
    assert np.isin(matrix, [-1.0, 0.0, 1.0]).all()
    assert round(np.linalg.det(matrix)) == 1


def test_a_whole_turn_changes_the_sign_only() -> None:
    for turns in range(-3, 4):
        rotation = Pose.model_validate({"rotation": {"axis": [0, 0, 1], "angle": 30 + 360 * turns}}).rotation
        half = math.radians(15 + 180 * turns)
        assert rotation == pytest.approx((math.cos(half), 0, 0, math.sin(half)), abs=1e-14)
        assert "-0.0" not in repr(rotation)  # it would change the hash of the scene


def test_small_angles_are_not_taken_for_zero() -> None:
    pose = Pose.model_validate({"rotation": {"axis": [0, 0, 1], "angle": math.degrees(1e-12)}})
    assert pose.rotation_matrix[1][0] == pytest.approx(1e-12)


@settings(derandomize=True)
@given(quaternions, positions)
def test_dual_quaternion_gives_position(rotation: tuple[float, ...], position: tuple[float, ...]) -> None:
    pose = Pose.model_validate({"rotation": rotation, "position": position})
    again = Pose.model_validate({"dual_quaternion": pose.dual_quaternion})
    np.testing.assert_allclose(again.position, position, rtol=0, atol=1e-13)
    assert again.rotation == pose.rotation
    # q_d = 1/2 r^Y q_r, with the left matrix of r^Y written out
    x, y, z = position
    left = np.array([[0, -x, -y, -z], [x, 0, -z, y], [y, z, 0, -x], [z, -y, x, 0]])
    np.testing.assert_allclose(pose.dual_quaternion[4:], 0.5 * left @ pose.rotation, rtol=0, atol=1e-13)


@settings(derandomize=True)
@given(quaternions)
def test_rotation_matrix_is_a_rotation_by_the_quaternion(rotation: tuple[float, ...]) -> None:
    matrix = np.array(Pose.model_validate({"rotation": rotation}).rotation_matrix)
    np.testing.assert_allclose(matrix @ matrix.T, np.eye(3), rtol=0, atol=1e-14)
    w, *axis = rotation
    np.testing.assert_allclose(matrix @ axis, axis, rtol=0, atol=1e-14)
    assert np.trace(matrix) == pytest.approx(4 * w * w - 1, abs=1e-14)
    assert matrix[1, 0] - matrix[0, 1] == pytest.approx(4 * w * axis[2], abs=1e-14)


@settings(derandomize=True)
@given(quaternions, st.floats(-0.99e-6, 0.99e-6))
def test_normalization_within_the_tolerance_happens_once(rotation: tuple[float, ...], error: float) -> None:
    scaled = [(1 + error) * component for component in rotation]
    once = Pose.model_validate({"rotation": scaled}).rotation
    assert math.hypot(*once) == pytest.approx(1, abs=1e-15)
    np.testing.assert_allclose(once, rotation, rtol=0, atol=1e-15)
    assert Pose.model_validate({"rotation": once}).rotation == once


def test_dual_quaternions_within_the_tolerance_are_normalized() -> None:
    scaled = [(1 + 5e-7) * component for component in PAPER_TARGET]
    pose = Pose.model_validate(scaled)
    np.testing.assert_allclose(pose.dual_quaternion, PAPER_TARGET, rtol=0, atol=1e-14)


@pytest.mark.parametrize(
    ("form", "sentence"),
    [
        ([0, 0, 0.6], r"must be 8 finite numbers, or {position: \[x, y, z\]} .*; it has 3"),
        (np.zeros(7), "8 finite numbers, .*; it has 7"),
        ([2, 0, 0, 0, 0, 0, 0, 0], r"not a unit dual quaternion: \|q_r\| = 2, should be 1"),
        ([1, 0, 0, 0, 3, 0, 0, 0], "not a unit dual quaternion: q_r . q_d = 3, should be 0"),
        ([1, 0, 0, 0, 0, math.nan, 0, 0], "must be 8 finite numbers"),
        ({"dual_quaternion": [1.1, 0, 0, 0, 0, 0, 0, 0]}, r"dual_quaternion = .*\|q_r\| = 1.1, should be 1"),
        ({"dual_quaternion": PAPER_TARGET, "position": [0, 0, 0]}, "either dual_quaternion or .*remove pos"),
        ({"dual_quaternion": PAPER_TARGET, "scale": 1}, "scale: unknown key"),
        ({"rotation": [1, 1, 0, 0]}, r"rotation = .*: must be a unit quaternion .*1.41421356, should be 1"),
        ({"rotation": [1, 0, 0]}, r"rotation = \[1, 0, 0\]: must be 4 finite numbers; it has 3"),
        ({"rotation": "x"}, "rotation = 'x': must be a unit quaternion .* or {axis"),
        ({"rotation": {"axis": [0, 0, 0], "angle": 3}}, r"rotation.axis = .*: must not have zero"),
        ({"rotation": {"axis": [1.5e308, 1.5e308, 0], "angle": 3}}, "must not have zero [(]or infinite"),
        ({"rotation": {"axis": [0, 0, 1], "angle": "90"}}, "rotation.angle = '90': must be a finite number"),
        ({"position": [0, 0]}, r"position = \[0, 0\]: must be 3 finite numbers; it has 2"),
        (3, "must be a mapping"),
    ],
)
def test_refusals(form: Any, sentence: str) -> None:
    with pytest.raises(ValidationError, match=sentence):
        Pose.model_validate(form)
