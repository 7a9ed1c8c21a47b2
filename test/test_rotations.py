from __future__ import annotations

import math

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from sphstereo_ros.core import rotations
from sphstereo_ros.core.config import CameraConfig

angles = st.floats(-math.pi, math.pi)
components = st.floats(-3.0, 3.0)
vectors = st.tuples(components, components, components).map(np.array)


def test_link_and_optical_axes():
    forward, left, up = np.eye(3)
    np.testing.assert_array_equal(rotations.OPTICAL_FROM_LINK @ forward, [0, 0, 1])
    np.testing.assert_array_equal(rotations.OPTICAL_FROM_LINK @ left, [-1, 0, 0])
    np.testing.assert_array_equal(rotations.OPTICAL_FROM_LINK @ up, [0, -1, 0])


def test_quaternion_of_a_quarter_turn_about_z():
    half = math.sqrt(0.5)
    np.testing.assert_allclose(rotations.matrix_from_quaternion([0, 0, half, half]) @ [1, 0, 0],
                               [0, 1, 0], atol=1e-15)


@given(vectors)
def test_exp_is_a_rotation_about_its_axis(vector):
    matrix = rotations.exp(vector)
    np.testing.assert_allclose(matrix @ matrix.T, np.eye(3), atol=1e-12)
    assert np.linalg.det(matrix) == pytest.approx(1.0)
    np.testing.assert_allclose(matrix @ vector, vector, atol=1e-12)
    cosine = (np.trace(matrix) - 1) / 2
    assert cosine == pytest.approx(math.cos(float(np.linalg.norm(vector))), abs=1e-12)


@given(vectors, vectors)
def test_exp_turns_to_the_right_side(vector, other):
    small = vector * 1e-6
    np.testing.assert_allclose(rotations.exp(small) @ other, other + np.cross(small, other),
                               atol=1e-9)


@given(vectors.filter(lambda v: np.linalg.norm(v) < math.pi - 1e-6))
def test_log_undoes_exp(vector):
    np.testing.assert_allclose(rotations.log(rotations.exp(vector)), vector, atol=1e-8)


@pytest.mark.parametrize('axis', [(1, 0, 0), (0, 1, 0), (0, 0, 1), (0.6, 0, -0.8)])
def test_log_of_half_a_turn(axis):
    matrix = rotations.exp(math.pi * np.array(axis))
    assert rotations.angle(matrix) == pytest.approx(math.pi)
    np.testing.assert_allclose(rotations.exp(rotations.log(matrix)), matrix, atol=1e-9)


@given(vectors)
def test_quaternions_round_trip(vector):
    matrix = rotations.exp(vector)
    quaternion = rotations.quaternion_from_matrix(matrix)
    assert np.linalg.norm(quaternion) == pytest.approx(1.0)
    assert quaternion[3] >= 0
    np.testing.assert_allclose(rotations.matrix_from_quaternion(quaternion), matrix, atol=1e-12)


@given(st.floats(0.01, 100.0), vectors)
def test_length_of_a_quaternion_does_not_matter(scale, vector):
    quaternion = rotations.quaternion_from_matrix(rotations.exp(vector))
    np.testing.assert_allclose(rotations.matrix_from_quaternion(scale * quaternion),
                               rotations.exp(vector), atol=1e-12)


@pytest.mark.parametrize('bad', [(0, 0, 0, 0), (math.nan, 0, 0, 1), (math.inf, 0, 0, 1)])
def test_what_is_no_rotation_is_refused(bad):
    with pytest.raises(ValueError, match='no rotation'):
        rotations.matrix_from_quaternion(bad)


@given(angles, angles, angles)
def test_rpy_is_yaw_times_pitch_times_roll(roll, pitch, yaw):
    expected = (rotations.exp([0, 0, yaw]) @ rotations.exp([0, pitch, 0])
                @ rotations.exp([roll, 0, 0]))
    np.testing.assert_allclose(rotations.matrix_from_rpy(roll, pitch, yaw), expected, atol=1e-12)


def test_default_mount_looks_forward():
    mount = rotations.mount(CameraConfig())
    np.testing.assert_array_equal(mount.position, [0, 0, 0])
    np.testing.assert_allclose(mount.rotation @ [0, 0, 1], [1, 0, 0], atol=1e-15)
    np.testing.assert_allclose(mount.rotation @ [1, 0, 0], [0, -1, 0], atol=1e-15)


def test_mount_turned_left_and_raised():
    mount = rotations.mount(CameraConfig(mount_z=1.5, mount_yaw=math.pi / 2))
    np.testing.assert_array_equal(mount.position, [0, 0, 1.5])
    np.testing.assert_allclose(mount.rotation @ [0, 0, 1], [0, 1, 0], atol=1e-15)


def test_positive_pitch_looks_down():
    mount = rotations.mount(CameraConfig(mount_pitch=0.3))
    np.testing.assert_allclose(mount.rotation @ [0, 0, 1],
                               [math.cos(0.3), 0, -math.sin(0.3)], atol=1e-15)
