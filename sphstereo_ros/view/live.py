"""The running topics, as they come."""
from __future__ import annotations

import time
from collections.abc import Callable
from functools import partial
from typing import Any

import rclpy
from rclpy.executors import SingleThreadedExecutor

from sphstereo_ros.ros import qos
from sphstereo_ros.ros.live_messages import message_class
from sphstereo_ros.ros.transport import prepare_process
from sphstereo_ros.view.topics import DIAGNOSTICS, PICTURES, VIEWED

_INPUTS = {*PICTURES, '/odometry'}
_POLL = 0.1


def follow(namespace: str, take: Callable[[str, Any], None], seconds: float) -> None:
    """Subscribe to all that is viewed, and call `take(name, message)`; 0 seconds = for ever.

    An interruption ends it too.
    """
    prepare_process()
    rclpy.init(signal_handler_options=rclpy.signals.SignalHandlerOptions.NO)
    node = rclpy.create_node('sphstereo_view', namespace=namespace.strip('/') or None)
    executor = SingleThreadedExecutor()
    executor.add_node(node)
    try:
        for name, kind in VIEWED.items():
            profile = qos.IMAGE_INPUT if name in _INPUTS else qos.LARGE_RESULT
            node.create_subscription(message_class(kind),
                                     name if name == DIAGNOSTICS else name[1:],
                                     partial(take, name), profile)
        end = time.monotonic() + seconds if seconds else float('inf')
        while (left := end - time.monotonic()) > 0:
            executor.spin_once(timeout_sec=min(left, _POLL))
    finally:
        executor.shutdown()
        node.destroy_node()
        rclpy.try_shutdown()
