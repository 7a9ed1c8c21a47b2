"""What arrives from the live nodes, seen from another process."""
from __future__ import annotations

import time
from collections import defaultdict
from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Any

import rclpy
from rclpy.executors import SingleThreadedExecutor
from rclpy.qos import QoSProfile

from sphstereo_ros.replay.player import stamp_of
from sphstereo_ros.ros.live_messages import message_class
from sphstereo_ros.ros.transport import prepare_process

DEPTH = 20
# Totals of a part of a node, by name.
Counts = dict[str, int]


@dataclass
class Topic:
    """Messages that came on a topic: (stamp, monotonic time of arrival), nanoseconds."""

    arrivals: list[tuple[int, int]] = field(default_factory=list)
    take: Callable[[int, bytes], None] | None = None

    def __call__(self, data: bytes) -> None:
        """Take a serialised message that begins with a header."""
        now = time.monotonic_ns()
        stamp = stamp_of(data)
        self.arrivals.append((stamp, now))
        if self.take is not None:
            self.take(stamp, data)


class Observer:
    """Subscribes to results as they are on the wire, and to /diagnostics; a context manager."""

    def __init__(self) -> None:
        prepare_process()
        # Ctrl-C stays Python's: whoever observes has processes to end.
        rclpy.init(signal_handler_options=rclpy.signals.SignalHandlerOptions.NO)
        self.node = rclpy.create_node('observer')
        self._executor = SingleThreadedExecutor()
        self._executor.add_node(self.node)
        self.topics: dict[str, Topic] = {}
        self.statuses: dict[str, dict[str, str]] = defaultdict(dict)
        self.node.create_subscription(message_class('diagnostic_msgs/msg/DiagnosticArray'),
                                      '/diagnostics', self._take_diagnostics, QoSProfile(depth=50))

    def __enter__(self) -> Observer:
        return self

    def __exit__(self, *_: object) -> None:
        self._executor.shutdown()
        self.node.destroy_node()
        rclpy.try_shutdown()

    def watch(self, topic: str, kind: str,
              take: Callable[[int, bytes], None] | None = None) -> Topic:
        """Subscribe; `take` is called with (stamp, serialised message)."""
        self.topics[topic] = Topic(take=take)
        self.node.create_subscription(message_class(kind), topic, self.topics[topic],
                                      QoSProfile(depth=DEPTH), raw=True)
        return self.topics[topic]

    def _take_diagnostics(self, message: Any) -> None:
        for status in message.status:
            self.statuses[status.name] = {v.key: v.value for v in status.values}

    def spin(self, seconds: float) -> None:
        """Take what comes for so long."""
        end = time.monotonic() + seconds
        while (left := end - time.monotonic()) > 0:
            self._executor.spin_once(timeout_sec=left)

    def until(self, condition: Callable[[], Any], timeout: float) -> bool:
        """Take what comes until `condition()` holds; returns whether it does."""
        end = time.monotonic() + timeout
        while not condition():
            if time.monotonic() > end:
                return False
            self._executor.spin_once(timeout_sec=0.05)
        return True

    def totals(self) -> dict[str, Counts]:
        """Frames in and out and drops by cause so far, of each part."""
        return {name: {key.removeprefix('drops.'): int(value) for key, value in values.items()
                       if key in ('frames_in', 'frames_out') or key.startswith('drops.')}
                for name, values in self.statuses.items()}

    def subscriptions(self, topic: str, node: str) -> set[bytes]:
        """Identities of the subscriptions that `node` has to `topic`."""
        return {bytes(info.endpoint_gid)
                for info in self.node.get_subscriptions_info_by_topic(topic)
                if info.node_name == node}


def since(before: dict[str, Counts], after: dict[str, Counts]) -> dict[str, Counts]:
    """What was added to totals."""
    return {part: {key: value - before.get(part, {}).get(key, 0) for key, value in counts.items()}
            for part, counts in after.items()}
