"""Obstacle detection as a node over DDS, and to the autopilot: values, silence, bad input."""
from __future__ import annotations

import math
from collections.abc import Iterator
from contextlib import closing
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

pytest.importorskip('rclpy')
pytest.importorskip('pymavlink')

import room
from nav_msgs.msg import Odometry
from ros_graph import Graph, drops, graph, mono8, odometry, set_stamp
from sectors import LEFT
from sensor_msgs.msg import Image, Imu, LaserScan, PointCloud2, Range
from std_msgs.msg import Float32
from test_mavlink import TcpAutopilot, UdpAutopilot
from test_obstacle_messages import ray
from visualization_msgs.msg import MarkerArray

from sphstereo_ros.core.camera import Equirectangular
from sphstereo_ros.core.config import resolve
from sphstereo_ros.core.frames import Drop, FrameKey, RangeImage
from sphstereo_ros.core.level import Attitude
from sphstereo_ros.core.obstacles import ObstacleDetection
from sphstereo_ros.core.rotations import matrix_from_rpy
from sphstereo_ros.nodes.obstacle_detection import ObstacleDetectionComponent
from sphstereo_ros.ros.matching import MAX_PENDING, RangeMatcher
from sphstereo_ros.ros.monitor import Monitor

ROWS = 240
NODE = 'obstacle_detection'
STEP = 100_000_000  # nanoseconds from frame to frame
TOPICS = {'obstacles/scan': LaserScan, 'obstacles/mavros': LaserScan,
          'obstacles/points': PointCloud2, 'obstacles/nearest': Range,
          'obstacles/time_to_contact': Float32, 'obstacles/markers': MarkerArray}


@pytest.fixture
def ros(tmp_path: Path) -> Iterator[Graph]:
    with graph(tmp_path) as made:
        yield made


def column_on_the_left(distance: float = 5.0) -> tuple[np.ndarray, np.ndarray]:
    """Range and sigma: a round column, 20° wide, on the left; nothing else is known."""
    rays = Equirectangular(ROWS, 2 * ROWS).bearings()  # x right, y down, z forward
    horizontal = np.hypot(rays[..., 0], rays[..., 2])
    left = (-rays[..., 0] / horizontal > math.cos(math.radians(10))) & (np.abs(rays[..., 1]) < .3)
    depth = np.where(left, distance / horizontal, np.nan).astype(np.float32)
    return depth, np.where(left, 0.01, np.nan).astype(np.float32)


def floats(stamp: int, pixels: np.ndarray) -> Image:
    message = Image(height=pixels.shape[0], width=pixels.shape[1], step=4 * pixels.shape[1],
                    encoding='32FC1')
    message.data.frombytes(np.ascontiguousarray(pixels, np.float32).tobytes())
    set_stamp(message, stamp, 'camera_optical')
    return message


def imu(stamp: int, roll: float = 0.0) -> Imu:
    message = Imu()
    set_stamp(message, stamp, 'base_link')
    message.orientation.x, message.orientation.w = math.sin(roll / 2), math.cos(roll / 2)
    return message


class Feed:
    """Publishes depth and attitude that the node surely hears."""

    def __init__(self, ros: Graph) -> None:
        self._client = ros.client
        self._depth = self._client.heard(Image, 'depth/image', NODE)
        self._sigma = self._client.heard(Image, 'depth/sigma', NODE)
        self._imu = self._client.publisher(Imu, 'imu')
        self._settled = 0
        # The node hears a sample once it tells that it cannot use one.
        bad = Imu()
        bad.angular_velocity_covariance[0] = -1.0
        probe = self._client.node.create_timer(0.1, lambda: self._imu.publish(bad))
        self._client.dropped(NODE, 'imu_no_angular_velocity')
        self._client.node.destroy_timer(probe)

    def level(self, *stamps: int) -> None:
        self.roll(*((stamp, 0.0) for stamp in stamps))

    def roll(self, *samples: tuple[int, float]) -> None:
        """Samples of stamp and roll, which the node has on return: depth cannot overtake them."""
        for sample in samples:
            self._imu.publish(imu(*sample))
        last = imu(STEP)
        last.angular_velocity.x = math.nan
        self._imu.publish(last)
        self._settled += 1
        self._client.dropped(NODE, 'imu_not_finite', self._settled)

    def depth(self, stamp: int, depth: np.ndarray, sigma: np.ndarray | None = None) -> None:
        self._depth.publish(floats(stamp, depth))
        if sigma is not None:
            self._sigma.publish(floats(stamp, sigma))


def test_what_is_on_the_left_is_told_on_the_left(ros: Graph) -> None:
    client = ros.client
    with closing(UdpAutopilot()) as autopilot:
        # All about the column is unknown: anything could stand there.
        ros.start(NODE, f'obstacles.mavlink.url:={autopilot.url}', 'obstacles.hidden_width:=0.0')
        for topic, kind in TOPICS.items():
            client.subscribe(kind, topic)
        feed = Feed(ros)
        depth, sigma = column_on_the_left()
        feed.roll((9 * STEP, 0.0), (11 * STEP, 0.2))
        feed.depth(10 * STEP, depth, sigma)
        scan = client.stamped('obstacles/scan', 10 * STEP)
        expected = ObstacleDetection(resolve({'obstacles.hidden_width': 0.0})).process(
            RangeImage(FrameKey(10 * STEP, 'camera_optical'), depth, sigma, True),
            Attitude(matrix_from_rpy(0.1, 0, 0)))  # between the two samples
        assert not isinstance(expected, Drop)
        assert ray(scan, 90) == expected.distance[LEFT] == pytest.approx(5.0, rel=0.02)
        assert math.isnan(ray(scan, -90))  # unknown, not free
        assert math.isnan(ray(scan, 0))
        assert scan.header.frame_id == 'base_link_level'
        dialect = client.stamped('obstacles/mavros', 10 * STEP)
        assert dialect.ranges[LEFT] == expected.distance[LEFT]
        assert np.isfinite(dialect.ranges).sum() == np.isfinite(scan.ranges).sum()
        nearest = client.stamped('obstacles/nearest', 10 * STEP)
        assert nearest.range == pytest.approx(5.0, rel=0.02)
        cloud = client.stamped('obstacles/points', 10 * STEP)
        points = np.frombuffer(bytes(cloud.data), '<f4').reshape(-1, 3)
        np.testing.assert_array_equal(points, expected.points)
        assert (points[:, 1] > 4).all()
        assert math.isnan(client.message('obstacles/time_to_contact', 0).data)
        assert client.message('obstacles/markers', 0).markers
        message, = autopilot.wait('OBSTACLE_DISTANCE')
        assert message.distances[LEFT] == pytest.approx(100 * expected.distance[LEFT], abs=1)
        assert message.distances[22] == 65535
        assert message.time_usec == 10 * STEP // 1000
        check_silence_on_stall(ros, autopilot)


def check_silence_on_stall(ros: Graph, autopilot: UdpAutopilot) -> None:
    """Depth has stopped: an error that names it, no scan and no message is repeated."""
    client = ros.client
    client.until(lambda: client.statuses()[NODE].level == b'\2', 'an error')
    assert 'stalled: no input' in client.statuses()[NODE].message
    client.until(lambda: autopilot.of('HEARTBEAT')[-1].system_status == 3, 'standby')
    assert len(autopilot.of('OBSTACLE_DISTANCE')) == 1
    assert [len(client.received[topic]) for topic in TOPICS] == [1] * len(TOPICS)


def test_bad_input_is_a_named_drop(ros: Graph) -> None:
    client = ros.client
    autopilot = TcpAutopilot()
    process = ros.start(NODE, f'obstacles.mavlink.url:={autopilot.url}')
    client.subscribe(LaserScan, 'obstacles/scan')
    client.linked('obstacles/scan')
    feed = Feed(ros)
    depth, sigma = column_on_the_left()
    feed.depth(STEP, depth, sigma)
    client.dropped(NODE, 'no_attitude')
    feed.level(*range(9 * STEP, 40 * STEP, STEP))
    feed.depth(10 * STEP, depth[:100], sigma[:100])
    client.dropped(NODE, 'wrong_size')
    feed.depth(11 * STEP, depth, sigma[:100, :200])
    client.dropped(NODE, 'wrong_size', 2)
    short = floats(12 * STEP, depth)
    del short.data[-1:]
    feed._depth.publish(short)
    feed.depth(13 * STEP, depth, sigma)
    client.stamped('obstacles/scan', 13 * STEP)
    assert len(autopilot.wait('OBSTACLE_DISTANCE')) == 1
    autopilot.close()  # the socket, too
    feed.depth(12 * STEP, depth, sigma)
    client.dropped(NODE, 'stamp_backward')
    feed.depth(12 * STEP, depth, sigma)
    client.dropped(NODE, 'duplicate_stamp')
    client.dropped(f'{NODE}: mavlink', 'mavlink_lost')
    autopilot = TcpAutopilot(autopilot.port)
    autopilot.wait('HEARTBEAT')
    feed.depth(14 * STEP, depth)  # without sigma
    feed.depth(15 * STEP, np.full_like(depth, np.nan), np.full_like(depth, np.nan))
    blind = client.stamped('obstacles/scan', 15 * STEP)
    assert np.isnan(blind.ranges).all()  # nothing is known: nothing is free
    message, = autopilot.wait('OBSTACLE_DISTANCE')
    assert set(message.distances) == {65535}
    autopilot.close()
    client.dropped(NODE, 'sigma_missing')
    client.dropped(NODE, 'wrong_data_length')
    assert [m.header.stamp.nanosec for m in client.received['obstacles/scan']] == [
        300_000_000, 500_000_000]
    assert drops(client.statuses()[NODE]).get('internal_error', 0) == 0
    assert process.stop() == 0


def test_pipeline_hands_depth_on_and_tells_metres_alone(ros: Graph) -> None:
    client = ros.client
    with closing(UdpAutopilot()) as autopilot:
        ros.start('pipeline', 'stereo.matcher:=bm', 'baseline.source:=odometry',
                  f'obstacles.mavlink.url:={autopilot.url}', 'obstacles.max:=3.0')
        client.subscribe(LaserScan, 'obstacles/scan')
        client.linked('obstacles/scan')
        motion = client.publisher(Odometry, 'odometry', 2)
        probe = client.node.create_timer(
            0.1, lambda: motion.publish(odometry(STEP, math.nan)))
        for part in 'frame_pairing', 'obstacle_detection':
            client.dropped(f'pipeline: {part}', 'odometry_not_finite')
        client.node.destroy_timer(probe)
        image = client.heard(Image, 'image', 'pipeline: frame_pairing')
        frames = list(room.forward(4, 0.15, ROWS))
        for i, frame in enumerate(frames):
            motion.publish(odometry(frame.key.stamp, 0.15 * i))
            image.publish(mono8(frame.key.stamp, frame.image))
            if i:
                client.stamped('obstacles/scan', frame.key.stamp)
        messages = autopilot.wait('OBSTACLE_DISTANCE', 3)
        assert [m.time_usec for m in messages] == [f.key.stamp // 1000 for f in frames[1:]]
        scan = client.stamped('obstacles/scan', frames[-1].key.stamp)
        measured = [r for r in scan.ranges if math.isfinite(r)]
        assert len(measured) > 10
        assert not client.node.count_subscribers('/depth/image')
        distances = [d for d in messages[-1].distances if d <= 300]
        assert sorted(distances) == pytest.approx(sorted(100 * np.array(measured)), abs=1.5)


def test_no_obstacles_without_metres(ros: Graph) -> None:
    client = ros.client
    ros.start('pipeline', 'stereo.matcher:=bm', 'obstacles.require_attitude:=false')
    client.subscribe(LaserScan, 'obstacles/scan')
    client.linked('obstacles/scan')
    image = client.heard(Image, 'image', 'pipeline: frame_pairing')
    for frame in room.forward(2, 0.15, ROWS):
        image.publish(mono8(frame.key.stamp, frame.image))
    client.dropped('pipeline: obstacle_detection', 'not_metric')
    assert not client.received['obstacles/scan']


@pytest.mark.parametrize(('word', 'told'), [
    ('obstacles.mavlink.url:=udpout:nowhere', 'obstacles.mavlink.url'),
    ('obstacles.mavlink.url:=udp:1.2.3.4:14550', 'udpout sends there'),
    ('obstacles.mavlink.component_id:=300', 'obstacles.mavlink.component_id')])
def test_wrong_words_end_the_start_with_one_line(ros: Graph, word: str, told: str) -> None:
    process = ros.start(NODE, word)
    assert process.ended() == 2, process.log
    line, = [line for line in process.log.splitlines() if '[rcl]' not in line]
    assert line.startswith(f'{NODE}: ')
    assert told in line


# Matching, without a graph

class Counted:
    """A shell whose node is asked for everything and says what it worked on."""

    def __init__(self, rate: float) -> None:
        self.config, self.mask, self.node = resolve({'obstacles.max_rate': rate}), None, None
        self.stamps: list[int] = []

    def monitor(self, part: str, stall: float, level: int) -> Monitor:
        self.told = Monitor(part)
        return self.told

    def worker(self, name: str, monitor: Monitor) -> Any:
        return SimpleNamespace(put_newest=lambda job: self.stamps.append(job.args[0].key.stamp))

    def output(self, kind: str, topic: str) -> Any:
        return SimpleNamespace(wanted=True)


@pytest.mark.parametrize(('hertz', 'rate', 'taken'), [(30, 20.0, 15), (20, 20.0, 20),
                                                      (30, 0.0, 30), (23, 20.0, 12)])
def test_rate_limit_by_stamps(hertz: int, rate: float, taken: int) -> None:
    shell = Counted(rate)
    component = ObstacleDetectionComponent(shell)  # type: ignore[arg-type]
    depth = np.zeros((2, 4), np.float32)
    for i in range(hertz):
        component.offer(RangeImage(FrameKey(10**9 + i * 10**9 // hertz, 'camera'), depth, depth,
                                   True), 0.0)
    assert len(shell.stamps) == taken
    assert shell.told.count('rate_limit') == hertz - taken
    component.offer(RangeImage(FrameKey(5, 'camera'), depth, depth, True), 0.0)
    assert shell.stamps[-1] == 5  # time that runs back is for the detection to drop


def decided(given: list[tuple[Any, float]]) -> list[Any]:
    return [r.cause if isinstance(r, Drop) else r.key.stamp for r, _ in given]


def test_halves_of_a_frame_are_joined() -> None:
    matcher = RangeMatcher()
    a, b = np.full((2, 4), 1, np.float32), np.full((2, 4), 2, np.float32)
    key = [FrameKey(i, 'camera') for i in range(9)]
    assert matcher.add_sigma(key[1], b, 5.0) == []
    (image, arrival), = matcher.add_range(key[1], a, 6.0)
    assert isinstance(image, RangeImage)
    assert (image.range is a, image.sigma is b, image.is_metric, arrival) == (True, True, True,
                                                                              6.0)
    assert matcher.add_range(key[2], a, 7.0) == []
    assert matcher.add_sigma(key[3], b, 8.0) == []
    assert matcher.add_range(key[4], a, 9.0) == []
    assert decided(matcher.add_sigma(key[4], b, 10.0)) == ['sigma_missing', 'range_missing', 4]
    for i in range(5, 5 + MAX_PENDING):
        assert matcher.add_range(FrameKey(i, 'camera'), a, 11.0) == []
    assert decided(matcher.add_range(FrameKey(20, 'camera'), a, 12.0)) == ['sigma_missing']
