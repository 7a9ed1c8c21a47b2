"""What sensors say of the vehicle's motion: samples of odometry, twist and IMU."""
from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

Vector = NDArray[np.float64]


@dataclass(frozen=True)
class OdometrySample:
    """Pose of `base_link` in `odom` at a time.

    stamp : nanoseconds; position : (3,) metres; rotation : (3, 3), odom ← base_link;
    covariance : (6, 6) of position (m) then rotation (rad), REP-103 axes; None = unknown
    """

    stamp: int
    position: Vector
    rotation: NDArray[np.float64]
    covariance: NDArray[np.float64] | None = None


@dataclass(frozen=True)
class TwistSample:
    """Velocity of `base_link` in its own axes: linear (3,) m/s, angular (3,) rad/s."""

    stamp: int
    linear: Vector
    angular: Vector


@dataclass(frozen=True)
class ImuSample:
    """Angular velocity (3,) rad/s in `base_link` axes, and orientation (3, 3), world ← base_link,
    where the sensor gives one.
    """

    stamp: int
    angular: Vector
    orientation: NDArray[np.float64] | None = None
