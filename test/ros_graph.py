"""A ROS graph for tests: nodes as processes, and a client that knows standard messages only."""
from __future__ import annotations

import os
import random
import signal
import subprocess
import sys
import time
from collections import defaultdict
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np
import pytest

rclpy = pytest.importorskip('rclpy')

from diagnostic_msgs.msg import DiagnosticArray  # noqa: E402
from rclpy.executors import SingleThreadedExecutor  # noqa: E402
from rclpy.qos import QoSProfile  # noqa: E402

from sphstereo_ros.ros.transport import SMALL_PROFILE  # noqa: E402

START = ('import sys; from sphstereo_ros.nodes.{} import main; '
         'sys.argv[0] = "node"; sys.exit(main())')
PATIENCE = 40.0  # seconds until a condition that should long hold fails a test


def environment() -> dict[str, str]:
    """A private domain on this machine."""
    return {'ROS_DOMAIN_ID': str(random.randint(1, 101)),
            'ROS_AUTOMATIC_DISCOVERY_RANGE': 'LOCALHOST'}


class NodeProcess:
    """One of the package's nodes in a process of its own."""

    def __init__(self, code: str, environment: dict[str, str], log: Path, *words: str) -> None:
        self._log = log
        with log.open('w') as file:
            self.process = subprocess.Popen(
                [sys.executable, '-c', code, *words],
                env={**os.environ, **environment}, stdout=file, stderr=subprocess.STDOUT)

    @property
    def log(self) -> str:
        """What it has written so far."""
        return self._log.read_text()

    def ended(self) -> int:
        """Exit status, once it ends."""
        return self.process.wait(PATIENCE)

    def stop(self, number: int = signal.SIGINT) -> int:
        """Send a signal; returns the exit status."""
        self.process.send_signal(number)
        return self.ended()


class Client:
    """Publishes, subscribes and waits, by standard messages alone."""

    def __init__(self, domain: int) -> None:
        self._context = rclpy.Context()
        with pytest.MonkeyPatch.context() as patch:
            # With ROS's own transport it would find late nodes after 3 s only.
            patch.setenv('FASTRTPS_DEFAULT_PROFILES_FILE', str(SMALL_PROFILE))
            rclpy.init(context=self._context, domain_id=domain)
        self.node = rclpy.create_node('client', context=self._context)
        self._executor = SingleThreadedExecutor(context=self._context)
        self._executor.add_node(self.node)
        self.received: defaultdict[str, list[Any]] = defaultdict(list)
        self.subscribe(DiagnosticArray, '/diagnostics')

    def close(self) -> None:
        self._executor.shutdown()
        self.node.destroy_node()
        rclpy.shutdown(context=self._context)

    def subscribe(self, kind: Any, topic: str, depth: int = 20) -> None:
        self.node.create_subscription(kind, topic, self.received[topic].append,
                                      QoSProfile(depth=depth))

    def publisher(self, kind: Any, topic: str, readers: int = 1) -> Any:
        """A reliable publisher that `readers` subscriptions have found."""
        publisher = self.node.create_publisher(kind, topic, QoSProfile(depth=20))
        self.until(lambda: publisher.get_subscription_count() >= readers, f'a reader of {topic}')
        return publisher

    def heard(self, kind: Any, topic: str, node: str) -> Any:
        """A publisher that `node` surely hears.

        A reader may not know its writer yet when the writer knows it already, so empty messages
        are sent until the node has counted one more drop.
        """
        publisher = self.publisher(kind, topic)
        self.until(lambda: node in self.statuses(), f'a status of {node}')
        before = value(self.statuses()[node], 'drops')
        probe = self.node.create_timer(0.1, lambda: publisher.publish(kind()))
        self.until(lambda: value(self.statuses()[node], 'drops') > before,
                   f'{node} to hear {topic}')
        self.node.destroy_timer(probe)
        return publisher

    def until(self, condition: Callable[[], Any], what: str) -> Any:
        """Spin until `condition()` is true, and return it."""
        deadline = time.monotonic() + PATIENCE
        while not (found := condition()):
            if time.monotonic() > deadline:
                told = {s.name: (s.message, drops(s)) for s in self.statuses().values()}
                pytest.fail(f'waited in vain for {what}; diagnostics: {told}')
            self._executor.spin_once(timeout_sec=0.1)
        return found

    def linked(self, topic: str, readers: int = 1, writers: int = 1) -> None:
        """Wait until a topic has its subscriptions and publishers."""
        self.until(lambda: self.node.count_subscribers(topic) >= readers
                   and self.node.count_publishers(topic) >= writers, f'both ends of {topic}')

    def message(self, topic: str, index: int) -> Any:
        """The message of that number on a topic, once it is there."""
        return self.until(lambda: self.received[topic][index:index + 1],
                          f'message {index} on {topic}')[0]

    def stamped(self, topic: str, stamp: int) -> Any:
        """The message of that stamp on a topic, once it is there."""
        return self.until(lambda: [m for m in self.received[topic]
                                   if nanoseconds(m.header.stamp) == stamp],
                          f'stamp {stamp} on {topic}')[0]

    def statuses(self) -> dict[str, Any]:
        """The newest status of each name in /diagnostics."""
        return {status.name: status for message in self.received['/diagnostics']
                for status in message.status}

    def dropped(self, name: str, cause: str, count: int = 1) -> None:
        """Wait until a node has counted `count` drops of a cause."""
        self.until(lambda: name in self.statuses()
                   and drops(self.statuses()[name]).get(cause, 0) >= count,
                   f'{count} drops {cause} of {name}')

    def call(self, kind: Any, name: str, request: Any) -> Any:
        """Call a service."""
        client = self.node.create_client(kind, name)
        self.until(client.service_is_ready, name)
        future = client.call_async(request)
        self.until(future.done, f'the answer of {name}')
        self.node.destroy_client(client)
        return future.result()


def drops(status: Any) -> dict[str, int]:
    """Drops by cause that a status tells."""
    return {v.key.removeprefix('drops.'): int(v.value) for v in status.values
            if v.key.startswith('drops.')}


def value(status: Any, key: str) -> float:
    """A number that a status tells."""
    return next(float(v.value) for v in status.values if v.key == key)


def nanoseconds(stamp: Any) -> int:
    return int(stamp.sec) * 10**9 + int(stamp.nanosec)


def set_stamp(message: Any, stamp: int, frame_id: str) -> None:
    message.header.stamp.sec, message.header.stamp.nanosec = divmod(stamp, 10**9)
    message.header.frame_id = frame_id


def mono8(stamp: int, image: np.ndarray, frame_id: str = 'camera_optical') -> Any:
    from sensor_msgs.msg import Image
    message = Image(height=image.shape[0], width=image.shape[1], step=image.shape[1],
                    encoding='mono8')
    message.data.frombytes(image.tobytes())
    set_stamp(message, stamp, frame_id)
    return message


def odometry(stamp: int, x: float, y: float = 0.0, z: float = 0.0) -> Any:
    from nav_msgs.msg import Odometry
    message = Odometry(child_frame_id='base_link')
    set_stamp(message, stamp, 'odom')
    position = message.pose.pose.position
    position.x, position.y, position.z = x, y, z
    return message


class Graph:
    """A private domain with its client and the processes started in it."""

    def __init__(self, folder: Path) -> None:
        self._folder = folder
        self._processes: list[NodeProcess] = []
        self.environment = environment()
        os.environ.update(self.environment)
        self.client = Client(int(self.environment['ROS_DOMAIN_ID']))

    def start(self, name: str, *words: str, code: str = '') -> NodeProcess:
        """Start a node with parameters `name:=value`, or other words of the command line.

        code : Python to run in place of the node of that name
        """
        extra = [w for word in words for w in (('-p', word) if ':=' in word and '-' not in word[:1]
                                               else word.split(' '))]
        log = self._folder / f'{name}_{len(self._processes)}.log'
        process = NodeProcess(code or START.format(name), self.environment, log,
                              *(['--ros-args', *extra] if extra else []))
        self._processes.append(process)
        return process

    def close(self) -> None:
        self.client.close()
        running = [p.process for p in self._processes if p.process.poll() is None]
        for process in running:
            process.terminate()
        for process in running:
            try:
                process.wait(PATIENCE)
            except subprocess.TimeoutExpired:
                process.kill()  # leaves its shared memory behind
                process.wait()


@contextmanager
def graph(folder: Path) -> Iterator[Graph]:
    """Open a graph; whatever runs in it at the end is ended."""
    saved = dict(os.environ)
    made = Graph(folder)
    try:
        yield made
    finally:
        made.close()
        os.environ.clear()
        os.environ.update(saved)
