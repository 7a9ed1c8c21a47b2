"""The level frame: `base_link` without its roll and pitch; x forward, y left, z up."""
from __future__ import annotations

import math
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import ArrayLike, NDArray

from . import rotations
from .baseline import GYRO_HOLD, SECOND, Track, interpolate_odometry
from .frames import Drop
from .motion import ImuSample, OdometrySample

Floats = NDArray[np.float64]

# cos of the steepest pitch at which "forward" still is a direction on the map.
_LEAST_FORWARD = math.cos(math.radians(85))
_MAX_GAP = SECOND // 2
_UNIT_TOLERANCE = 1e-3


@dataclass(frozen=True)
class Attitude:
    """How the vehicle lies, and where it goes.

    rotation : (3, 3), level frame ← `base_link`: its roll and pitch
    velocity : (3,) m/s in the level frame; None where it is not known
    """

    rotation: Floats = field(default_factory=lambda: np.eye(3))
    velocity: Floats | None = None


def attitude(rotation: ArrayLike, velocity: ArrayLike | None = None) -> Attitude | Drop:
    """The attitude from an orientation in any frame whose z points up.

    Parameters
    ----------
    rotation : (3, 3), that frame ← `base_link`; its yaw does not matter
    velocity : (3,) m/s in `base_link` axes, where it is known; what is not finite is not known

    Drops: `not_finite`; `steep_attitude`, where the nose points up or down so steeply that there
    is no forward.

    """
    turn = np.asarray(rotation, np.float64)
    if turn.shape != (3, 3) or not np.isfinite(turn).all():
        return Drop('not_finite', 'attitude')
    ahead = math.hypot(turn[0, 0], turn[1, 0])
    if ahead < _LEAST_FORWARD:
        return Drop('steep_attitude', f'pitch {math.degrees(math.acos(min(ahead, 1))):.0f}°')
    c, s = turn[0, 0] / ahead, turn[1, 0] / ahead
    level = np.array([[c, s, 0.0], [-s, c, 0.0], [0.0, 0.0, 1.0]]) @ turn
    if velocity is None or not np.isfinite(moved := level @ np.asarray(velocity, float)).all():
        return Attitude(level)
    return Attitude(level, moved)


def attitude_from_quaternion(quaternion: ArrayLike,
                             velocity: ArrayLike | None = None) -> Attitude | Drop:
    """As `attitude`, from the orientation (x, y, z, w) of a message.

    Drops: `not_finite`, `invalid_quaternion` (its length is not 1), `steep_attitude`.
    """
    q = np.asarray(quaternion, np.float64)
    norm = float(np.linalg.norm(q))
    if not math.isfinite(norm):
        return Drop('not_finite', f'orientation {q}')
    if abs(norm - 1) > _UNIT_TOLERANCE:
        return Drop('invalid_quaternion', f'length {norm:.6g}')
    return attitude(rotations.matrix_from_quaternion(q), velocity)


class AttitudeHistory:
    """The newest samples of odometry and IMU; attitude and velocity at a frame's exposure.

    Odometry is preferred, since it tells the velocity, too. A sample that comes just before the
    frame serves where none after it is there.
    """

    def __init__(self) -> None:
        self._odometry: Track[OdometrySample] = Track('odometry', _MAX_GAP)
        self._imu: Track[ImuSample] = Track('imu', _MAX_GAP)

    def add_odometry(self, sample: OdometrySample) -> Drop | None:
        """Take a sample; the Drop tells what was thrown away for it."""
        return self._odometry.add(sample)

    def add_imu(self, sample: ImuSample) -> Drop | None:
        """Take a sample; one without orientation tells nothing here."""
        return self._imu.add(sample) if sample.orientation is not None else None

    def at(self, stamp: int) -> Attitude | Drop | None:
        """Attitude at `stamp` (ns); None where no sensor tells of that time."""
        pose = interpolate_odometry(self._odometry, stamp)
        if pose is not None:
            return attitude(pose.rotation, self._velocity(pose))
        return self._by_imu(stamp) or self._latest(stamp)

    def _velocity(self, pose: OdometrySample) -> Floats | None:
        """In `base_link`, from the positions about `pose`."""
        found = self._odometry.around(pose.stamp)
        assert found is not None
        earlier = found[0] if found[0].stamp < pose.stamp else self._odometry.before(pose.stamp)
        later = found[1]
        if earlier is None or not 0 < later.stamp - earlier.stamp <= _MAX_GAP:
            return None
        step = (later.position - earlier.position) * (SECOND / (later.stamp - earlier.stamp))
        return np.asarray(pose.rotation.T @ step)

    def _by_imu(self, stamp: int) -> Attitude | Drop | None:
        found = self._imu.around(stamp)
        if found is None:
            return None
        a, b, share = found[0].orientation, found[1].orientation, found[2]
        assert a is not None
        assert b is not None
        return attitude(a @ rotations.exp(share * rotations.log(a.T @ b)))

    def _latest(self, stamp: int) -> Attitude | Drop | None:
        pose = self._odometry.before(stamp)
        if pose is not None and stamp - pose.stamp <= GYRO_HOLD:
            return attitude(pose.rotation)
        sample = self._imu.before(stamp)
        if sample is None or stamp - sample.stamp > GYRO_HOLD:
            return None
        assert sample.orientation is not None
        return attitude(sample.orientation)
