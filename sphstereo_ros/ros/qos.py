"""Quality of service of this package's topics; every one can be overridden by parameters."""
from __future__ import annotations

from rclpy.qos import DurabilityPolicy, HistoryPolicy, QoSProfile, ReliabilityPolicy
from rclpy.qos_overriding_options import QoSOverridingOptions


def _profile(reliability: ReliabilityPolicy, depth: int) -> QoSProfile:
    return QoSProfile(reliability=reliability, durability=DurabilityPolicy.VOLATILE,
                      history=HistoryPolicy.KEEP_LAST, depth=depth)


# Subscriptions that match any publisher.
IMAGE_INPUT = _profile(ReliabilityPolicy.BEST_EFFORT, 5)
SENSOR_INPUT = _profile(ReliabilityPolicy.BEST_EFFORT, 100)

RESULT = _profile(ReliabilityPolicy.RELIABLE, 5)
# Small messages of which several make one result.
PARTS = _profile(ReliabilityPolicy.RELIABLE, 50)
# fastdds.xml is sized for this depth.
LARGE_RESULT = _profile(ReliabilityPolicy.RELIABLE, 3)


def overridable() -> QoSOverridingOptions:
    """Options that declare `qos_overrides.<topic>.…` for reliability, history and depth."""
    return QoSOverridingOptions.with_default_policies()
