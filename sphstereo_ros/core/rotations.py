"""Rotations: matrices, quaternions, rotation vectors, roll–pitch–yaw, and the camera's mount.

Quaternions are (x, y, z, w), as in ROS messages; matrices act on column vectors.
"""
from __future__ import annotations

import math
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import ArrayLike, NDArray

from sphstereo_ros.core.config import BaselineConfig, CameraConfig

FloatArray = NDArray[np.float64]

# X_optical = OPTICAL_FROM_LINK · X_link (REP-103): link is x forward, y left, z up; optical is
# x right, y down, z forward.
OPTICAL_FROM_LINK: FloatArray = np.array([[0.0, -1.0, 0.0], [0.0, 0.0, -1.0], [1.0, 0.0, 0.0]])


def matrix_from_quaternion(quaternion: ArrayLike) -> FloatArray:
    """Quaternion (x, y, z, w) of any length but zero → (3, 3) rotation matrix.

    Raises
    ------
    ValueError
        where the quaternion is zero or not finite

    """
    q = np.asarray(quaternion, np.float64)
    norm = float(np.linalg.norm(q))
    if not (math.isfinite(norm) and norm > 0):
        raise ValueError(f'{q} is no rotation')
    x, y, z, w = (float(value) for value in q / norm)
    return np.array([
        [1 - 2 * (y * y + z * z), 2 * (x * y - z * w), 2 * (x * z + y * w)],
        [2 * (x * y + z * w), 1 - 2 * (x * x + z * z), 2 * (y * z - x * w)],
        [2 * (x * z - y * w), 2 * (y * z + x * w), 1 - 2 * (x * x + y * y)]])


def quaternion_from_matrix(rotation: FloatArray) -> FloatArray:
    """(3, 3) rotation matrix → unit quaternion (x, y, z, w) with w ≥ 0."""
    m = np.asarray(rotation, np.float64)
    # The four squared components; the greatest is the safe divisor.
    squares = np.array([1 + m[0, 0] - m[1, 1] - m[2, 2], 1 - m[0, 0] + m[1, 1] - m[2, 2],
                        1 - m[0, 0] - m[1, 1] + m[2, 2], 1 + m[0, 0] + m[1, 1] + m[2, 2]])
    sums = np.array([[0.0, m[0, 1] + m[1, 0], m[0, 2] + m[2, 0], m[2, 1] - m[1, 2]],
                     [0.0, 0.0, m[1, 2] + m[2, 1], m[0, 2] - m[2, 0]],
                     [0.0, 0.0, 0.0, m[1, 0] - m[0, 1]],
                     [0.0, 0.0, 0.0, 0.0]])
    products = sums + sums.T + np.diag(squares)  # 4 q qᵀ
    q: FloatArray = products[int(np.argmax(squares))]
    q = q / np.linalg.norm(q)
    return -q if q[3] < 0 else q


def matrix_from_rpy(roll: float, pitch: float, yaw: float) -> FloatArray:
    """Rz(yaw) · Ry(pitch) · Rx(roll), radians."""
    cr, sr = math.cos(roll), math.sin(roll)
    cp, sp = math.cos(pitch), math.sin(pitch)
    cy, sy = math.cos(yaw), math.sin(yaw)
    return np.array([[cy * cp, cy * sp * sr - sy * cr, cy * sp * cr + sy * sr],
                     [sy * cp, sy * sp * sr + cy * cr, sy * sp * cr - cy * sr],
                     [-sp, cp * sr, cp * cr]])


def rpy_from_matrix(rotation: FloatArray) -> FloatArray:
    """(3, 3) rotation matrix → (roll, pitch, yaw) with R = Rz(yaw) Ry(pitch) Rx(roll), radians.

    pitch lies in [−π/2, π/2]; where it is ±π/2, roll is zero.
    """
    m = np.asarray(rotation, np.float64)
    level = math.hypot(m[0, 0], m[1, 0])
    pitch = math.atan2(-m[2, 0], level)
    if level < 1e-9:
        return np.array([0.0, pitch, math.atan2(-m[0, 1], m[1, 1])])
    return np.array([math.atan2(m[2, 1], m[2, 2]), pitch, math.atan2(m[1, 0], m[0, 0])])


def skew(vector: ArrayLike) -> FloatArray:
    """(3,) → (3, 3) with skew(a) · b = a × b."""
    x, y, z = (float(value) for value in np.asarray(vector, np.float64))
    return np.array([[0.0, -z, y], [z, 0.0, -x], [-y, x, 0.0]])


def exp(rotation_vector: ArrayLike) -> FloatArray:
    """Rotation vector (3,) (axis · angle, radians) → (3, 3) matrix."""
    k = skew(rotation_vector)
    angle = math.hypot(k[2, 1], k[0, 2], k[1, 0])
    half = 0.5 * angle
    first = math.sin(angle) / angle if half > 0 else 1.0
    second = 0.5 * (math.sin(half) / half)**2 if half > 0 else 0.5
    return np.asarray(np.eye(3) + first * k + second * (k @ k))


def log(rotation: FloatArray) -> FloatArray:
    """(3, 3) rotation matrix → rotation vector (3,), length in [0, π]."""
    q = quaternion_from_matrix(rotation)
    sine = float(np.linalg.norm(q[:3]))
    if sine < 1e-9:
        return np.asarray(2.0 * q[:3])
    return np.asarray(q[:3] * (2.0 * math.atan2(sine, q[3]) / sine))


def angle(rotation: FloatArray) -> float:
    """Angle of a (3, 3) rotation matrix, radians in [0, π]."""
    return float(np.linalg.norm(log(rotation)))


@dataclass(frozen=True)
class Mount:
    """Where the camera is: X_base = rotation · X_optical + position.

    rotation : (3, 3), base_link ← camera_optical; position : (3,) of the camera, metres
    """

    rotation: FloatArray
    position: FloatArray


def mount(camera: CameraConfig) -> Mount:
    """Camera in `base_link` from the parameters `camera.mount.*`."""
    base_from_link = matrix_from_rpy(camera.mount_roll, camera.mount_pitch, camera.mount_yaw)
    position = np.array([camera.mount_x, camera.mount_y, camera.mount_z])
    return Mount(base_from_link @ OPTICAL_FROM_LINK.T, position)


def mounted_on(camera: CameraConfig, rotation: FloatArray, position: FloatArray) -> CameraConfig:
    """The camera at a pose (3, 3), (3,) in the optical frame of `camera`: its own mount."""
    first = mount(camera)
    x, y, z = (float(v) for v in first.position + first.rotation @ position)
    link = first.rotation @ rotation @ OPTICAL_FROM_LINK
    roll, pitch, yaw = (float(angle) for angle in rpy_from_matrix(link))
    return replace(camera, mount_x=x, mount_y=y, mount_z=z, mount_roll=roll, mount_pitch=pitch,
                   mount_yaw=yaw)


def top_rotation(camera: CameraConfig) -> FloatArray:
    """(3, 3), bottom camera_optical ← top camera_optical, from the parameters `camera.top.*`."""
    link = matrix_from_rpy(camera.top_roll, camera.top_pitch, camera.top_yaw)
    return np.asarray(OPTICAL_FROM_LINK @ link @ OPTICAL_FROM_LINK.T)


def top_rpy(rotation: FloatArray) -> FloatArray:
    """`camera.top.{roll,pitch,yaw}` of a rotation (3, 3), bottom ← top camera_optical."""
    return rpy_from_matrix(OPTICAL_FROM_LINK.T @ rotation @ OPTICAL_FROM_LINK)


def top_direction(baseline: BaselineConfig) -> FloatArray:
    """Unit vector (3,) from the bottom to the top camera, bottom camera_optical."""
    direction = OPTICAL_FROM_LINK @ np.asarray(baseline.direction, np.float64)
    return np.asarray(direction / np.linalg.norm(direction))
