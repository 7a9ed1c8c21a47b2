from __future__ import annotations

import math
from collections.abc import Iterator
from functools import cache

import numpy as np
import pytest
from analytic_world import View, World, look, true_pose

pytest.importorskip('rclpy')

from nav_msgs.msg import Odometry, Path
from ros_graph import Graph, graph, mono8, odometry, set_stamp, value
from sensor_msgs.msg import Image, PointCloud2

from sphstereo_ros.core import rotations
from sphstereo_ros.core.frames import (
    AlignedWindow,
    Frame,
    FrameKey,
    Reference,
)
from sphstereo_ros.core.rotations import OPTICAL_FROM_LINK
from sphstereo_ros.ros.conversions import read_cloud, window_message
from sphstereo_ros.ros.live_messages import make

NODE, HEIGHT, STEP, COUNT = 'mapping', 80, 0.1, 24
PERIOD, T0 = 33_333_333, 1_700_000_000_000_000_000
START = (5.0, -3.0, 1.0)  # of the vehicle in `odom`
WORLD = World()


@pytest.fixture
def ros(tmp_path) -> Iterator[Graph]:
    with graph(tmp_path) as made:
        yield made


def stamp(k: int) -> int:
    return T0 + k * PERIOD


@cache
def views() -> list[View]:
    rng = np.random.default_rng(3)
    return [look(WORLD, (0, 0, STEP * k),
                 rotations.exp(rng.uniform(-0.05, 0.05, 3) * (k > 0)), HEIGHT)
            for k in range(COUNT)]


def window(k: int) -> Path:
    frame = Frame(FrameKey(stamp(k), 'camera_optical'), np.zeros((2, 4), np.uint8))
    return window_message(make, AlignedWindow(frame, tuple(
        Reference(Frame(FrameKey(stamp(n), 'camera_optical'), frame.image),
                  true_pose(views()[n], views()[k])) for n in (k - 1, k - 4, k - 10) if n >= 0)))


def floats(k: int, pixels: np.ndarray) -> Image:
    message = Image(height=pixels.shape[0], width=pixels.shape[1], step=4 * pixels.shape[1],
                    encoding='32FC1')
    message.data.frombytes(np.ascontiguousarray(pixels, np.float32).tobytes())
    set_stamp(message, stamp(k), 'camera_optical')
    return message


class Feed:
    """Publishes what the stages before would."""

    def __init__(self, ros: Graph, with_odometry: bool = False) -> None:
        client = ros.client
        self._depth = client.heard(Image, 'depth/image', NODE)
        self._sigma = client.heard(Image, 'depth/sigma', NODE)
        self._windows = client.heard(Path, 'pairs/aligned', NODE)
        self._frames = client.publisher(Image, 'frames')
        if with_odometry:
            self._odometry = client.heard(Odometry, 'odometry', NODE)
        self._client = client

    def frame(self, k: int) -> None:
        r = views()[k].range
        self._frames.publish(mono8(stamp(k), np.full((HEIGHT, 2 * HEIGHT), 77, np.uint8)))
        self._windows.publish(window(k))
        self.depth(k, r)

    def depth(self, k: int, r: np.ndarray) -> None:
        self._depth.publish(floats(k, r))
        self._sigma.publish(floats(k, 0.005 * r))

    def odometry(self, k: int) -> None:
        self._odometry.publish(odometry(stamp(k), START[0] + STEP * k, *START[1:]))

    def drive(self, first: int, last: int) -> None:
        """One frame after the other, each once the node is done with the one before."""
        for k in range(first, last):
            self.frame(k)
            self._client.stamped('map/odometry', stamp(k))


def off_walls(xyz: np.ndarray) -> np.ndarray:
    """Distance to the room's surfaces of points in `odom`, along the ray from mid-way."""
    room = (xyz.astype(float) - START) @ OPTICAL_FROM_LINK.T
    origin = np.array([0, 0, STEP * COUNT / 2])
    way = room - origin
    length = np.linalg.norm(way, axis=1)
    return np.abs(WORLD.range(origin, way / length[:, None]) - length)


def test_the_map_of_a_drive_is_in_odom(ros: Graph) -> None:
    client = ros.client
    client.subscribe(PointCloud2, 'map')
    client.subscribe(Odometry, 'map/odometry')
    # Every frame has its map, also where two are done within a hundredth of a second.
    ros.start(NODE, 'mapping.rate:=1000.0', 'mapping.min_frames:=2')
    feed = Feed(ros, with_odometry=True)
    feed.odometry(0)
    feed.drive(1, COUNT)
    for k in (1, 7, COUNT - 1):
        pose = client.stamped('map/odometry', stamp(k))
        assert (pose.header.frame_id, pose.child_frame_id) == ('odom', 'base_link')
        place = pose.pose.pose.position
        assert (place.x, place.y, place.z) == pytest.approx(
            (START[0] + STEP * k, *START[1:]), abs=1e-3)
        q = pose.pose.pose.orientation
        turned = OPTICAL_FROM_LINK @ rotations.matrix_from_quaternion(
            [q.x, q.y, q.z, q.w]) @ OPTICAL_FROM_LINK.T
        assert rotations.angle(turned.T @ views()[k].rotation) < 1e-3
    message = client.stamped('map', stamp(COUNT - 1))
    assert message.header.frame_id == 'odom'
    cloud = read_cloud(message)
    assert len(cloud.xyz) > 2000
    assert np.percentile(off_walls(cloud.xyz), 90) < 0.015
    assert (cloud.bgr == 77).all()
    client.until(lambda: value(client.statuses()[NODE], 'frames_out') == COUNT - 1,
                 'all frames in the diagnostics')
    assert value(client.statuses()[NODE], 'voxels') >= len(cloud.xyz)


def test_depth_without_its_window_is_a_named_drop(ros: Graph) -> None:
    ros.start(NODE)
    feed = Feed(ros)
    ahead = iter(range(1000))
    timer = ros.client.node.create_timer(0.05, lambda: feed.depth(next(ahead), views()[0].range))
    ros.client.dropped(NODE, 'window_missing', 2)
    ros.client.node.destroy_timer(timer)


def test_a_recording_that_loops_begins_a_new_map(ros: Graph) -> None:
    client = ros.client
    client.subscribe(Odometry, 'map/odometry')
    ros.start(NODE, 'pairing.max_gap:=0.1')
    feed = Feed(ros)
    feed.drive(1, 8)
    feed.frame(2)
    client.dropped(NODE, 'map_restarted')
    client.received['map/odometry'].clear()
    feed.drive(3, 6)
    place = client.stamped('map/odometry', stamp(5)).pose.pose.position
    assert math.hypot(place.x - 3 * STEP, place.y, place.z) < 0.02


def test_a_node_that_misses_frames_goes_on(ros: Graph) -> None:
    """Every third frame alone: they share references only."""
    client = ros.client
    client.subscribe(Odometry, 'map/odometry')
    ros.start(NODE)
    feed = Feed(ros)
    for k in range(3, COUNT, 3):
        feed.frame(k)
        place = client.stamped('map/odometry', stamp(k)).pose.pose.position
        # The first frame that is known is the nearest reference of the first window.
        assert place.x == pytest.approx(STEP * (k - 2), abs=0.03)
