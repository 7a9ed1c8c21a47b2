"""Plays a bag, a video or frames as live inputs of the chain, with /clock."""
from __future__ import annotations

import threading
import time
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import rclpy
from rclpy.duration import Duration
from rclpy.qos import QoSProfile, ReliabilityPolicy
from tqdm import tqdm

from sphstereo_ros.core.config import Config, ParameterError, ReplayConfig
from sphstereo_ros.replay.player import Due, Player, schedule
from sphstereo_ros.replay.records import COMPRESSED, IMAGE, BadInput, Source
from sphstereo_ros.replay.sources import open_source, replayed_topics
from sphstereo_ros.ros import qos
from sphstereo_ros.ros.live_messages import make, message_class
from sphstereo_ros.ros.messages import time_message
from sphstereo_ros.ros.shell import Shell, run

# Seconds for the last messages to arrive before the node ends.
LAST_ARRIVAL = 5.0
# Seconds by which a subscriber may find its publisher later than the publisher finds it.
SETTLING = 0.5


class BagReplay:
    """Publishes in a thread of its own, and shuts the node down at the end."""

    def __init__(self, shell: Shell) -> None:
        self._shell = shell
        self._config: ReplayConfig = shell.config.replay
        if not self._config.bag:
            raise ParameterError('replay.bag: must name a bag, a video or a folder of frames')
        try:
            self._source: Source = open_source(Path(self._config.bag))
            self._names = replayed_topics(self._source, self._config.topic)
        except BadInput as error:
            raise ParameterError(f'replay.bag: {error}') from error
        self._publishers = self._make_publishers(self._source.topics)
        self._clock = shell.node.create_publisher(
            message_class('rosgraph_msgs/msg/Clock'), '/clock',
            QoSProfile(depth=1, reliability=ReliabilityPolicy.RELIABLE))
        self.thread = threading.Thread(target=self._play, name='bag_replay', daemon=True)

    def _make_publishers(self, kinds: Mapping[str, str]) -> dict[str, Any]:
        publishers = {}
        for topic, name in self._names.items():
            profile = qos.LARGE_RESULT if kinds[topic] in (IMAGE, COMPRESSED) else qos.RESULT
            publishers[name] = self._shell.node.create_publisher(
                message_class(kinds[topic]), name, profile,
                qos_overriding_options=qos.overridable())
        return publishers

    def warm_up(self) -> None:
        """Nothing here is compiled."""

    def subscribe(self) -> None:
        """Begin to play."""
        self.thread.start()

    def configure(self, config: Config) -> None:
        """Nothing changes while it plays."""

    def _play(self) -> None:
        try:
            self._wait_for_subscription()
            done = self._play_all()
            for publisher in self._publishers.values():
                publisher.wait_for_all_acked(Duration(seconds=LAST_ARRIVAL))
            self._shell.log.info(f'played {done} messages')
            if self._source.problem:
                self._shell.log.warning(f'{self._config.bag}: {self._source.problem}')
        except Exception as error:  # a node that shuts down takes its publishers away
            if rclpy.ok():
                self._shell.log.error(f'replay ended: {type(error).__name__}: {error}')
        finally:
            rclpy.try_shutdown()

    def _wait_for_subscription(self) -> None:
        end = time.monotonic() + self._config.wait
        images = [p for name, p in self._publishers.items() if 'image' in name]
        while rclpy.ok() and time.monotonic() < end:
            if any(p.get_subscription_count() >= self._config.subscriptions for p in images):
                time.sleep(SETTLING)
                return
            time.sleep(0.02)

    def _play_all(self) -> int:
        config = self._config
        images = {topic for topic, name in self._names.items() if 'image' in name}
        total = None if config.loop else self._source.count(images)
        with tqdm(total=total, unit='frame', disable=None) as progress:
            def publish(due: Due) -> None:
                self._publishers[due.topic].publish(due.cdr)
                if due.kind in (IMAGE, COMPRESSED):
                    progress.update()

            player = Player(publish, self._publish_clock, config.rate,
                            stopped=lambda: not rclpy.ok())
            return player.play(schedule(self._source, self._names, config.rate, config.loop,
                                        config.start_offset))

    def _publish_clock(self, nanoseconds: int) -> None:
        self._clock.publish(make('rosgraph_msgs/msg/Clock',
                                 clock=time_message(make, nanoseconds)))


def main(args: list[str] | None = None) -> int:
    """Run the node `bag_replay`; returns its exit status."""
    return run('bag_replay', lambda shell: [BagReplay(shell)], args)
